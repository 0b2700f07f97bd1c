"""Which points lie beside an emitter."""

import numpy as np
from scipy.spatial import cKDTree

from ..scene.bounds import box_of
from ..scene.mesh import mesh_arrays
from ..scene.own_lights import is_dark
from ..scene.traversal import transform_of
from ..system.runtime import mitsuba

_PAIRS = 1 << 20  # pairs of a point and a triangle at a time: about 300 MB


def near_emitters(mi_scene, positions, spacing):
    """Points within one spacing of a local emitter that is not dark.

    There irradiance changes over less than the distance between points, and is large.

    Parameters
    ----------
    mi_scene : mi.Scene
    positions : (n, 3)
        Metres.
    spacing : float or (n,)
        Distance between neighbouring points, metres.

    Returns
    -------
    (n,) bool

    Notes
    -----
    Distances to meshes, spheres, disks and cylinders are exact. Of any other shape, elliptic disks
    too, the distance to its bounding box counts, which is never larger, so that no near point is
    missed.
    """
    mi = mitsuba()
    positions = np.asarray(positions, np.float64)
    spacing = np.broadcast_to(np.asarray(spacing, np.float64), len(positions))
    near = np.zeros(len(positions), bool)
    shapes = [shape for shape in mi_scene.shapes() if shape.is_emitter()]
    lamps = [(shape.emitter(), shape) for shape in shapes]
    lamps += [(e, None) for e in mi_scene.emitters() if e.get_shape() is None]
    for emitter, shape in lamps:
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) or is_dark(emitter):
            continue
        left = np.flatnonzero(~near)
        if shape is not None and shape.is_mesh():
            vertices, faces, _, _ = mesh_arrays(shape)
            near[left] = near_triangles(
                vertices.astype(np.float64)[faces], positions[left], spacing[left]
            )
        else:
            near[left] = _distance(emitter, shape, positions[left]) <= spacing[left]
    return near


def _distance(emitter, shape, positions):
    """Distance (n,) of positions from an emitter that is no mesh."""
    if shape is None:
        return np.linalg.norm(positions - _place(emitter), axis=1)
    kind = shape.class_name()
    if kind in _SHAPES and _is_round(to_world := transform_of(shape)):
        return _SHAPES[kind](to_world, positions)
    low, high = box_of(shape)
    return np.linalg.norm(positions - np.clip(positions, low, high), axis=1)


def _place(emitter):
    """Where an emitter without a shape stands, (3,)."""
    import drjit as dr

    mi = mitsuba()
    sample = emitter.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))[0]
    return np.array(sample.p, dtype=np.float64).ravel()


# --- analytic shapes: transformed from Mitsuba's unit shape ---------------------------------------


def _is_round(to_world):
    """Whether a transform takes a circle about the z axis to a circle about the new z axis."""
    gram = to_world[:3, :3].T @ to_world[:3, :3]
    off = [gram[0, 0] - gram[1, 1], gram[0, 1], gram[0, 2], gram[1, 2]]
    return np.abs(off).max() <= 1e-5 * gram.diagonal().max()


def _from_sphere(to_world, positions):
    radius = np.linalg.norm(to_world[:3, 0])
    return np.abs(np.linalg.norm(positions - to_world[:3, 3], axis=1) - radius)


def _from_disk(to_world, positions):
    beside, along = _cylindrical(to_world, positions)
    return np.hypot(np.maximum(beside - np.linalg.norm(to_world[:3, 0]), 0), along)


def _from_cylinder(to_world, positions):
    beside, along = _cylindrical(to_world, positions)
    beyond = np.maximum(np.maximum(-along, along - np.linalg.norm(to_world[:3, 2])), 0)
    return np.hypot(beside - np.linalg.norm(to_world[:3, 0]), beyond)


def _cylindrical(to_world, positions):
    """Distance of positions from a transform's z axis, and how far along it they are, metres."""
    axis = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
    offset = positions - to_world[:3, 3]
    along = offset @ axis
    return np.linalg.norm(offset - along[:, None] * axis, axis=1), along


_SHAPES = {"Sphere": _from_sphere, "Disk": _from_disk, "Cylinder": _from_cylinder}


# --- triangles ------------------------------------------------------------------------------------


def near_triangles(corners, positions, spacing):
    """Points within a spacing of the nearest of some triangles.

    Parameters
    ----------
    corners : (t, 3, 3)
    positions : (n, 3)
    spacing : (n,)

    Returns
    -------
    (n,) bool
    """
    # Points beside a corner or a centre are near without more ado; on fine meshes that is all.
    marks = np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1)])
    # Trees of equal coordinates, which lattices have, are slow to balance; and so is a search that
    # starts far from a plane of many marks, unless it is bounded.
    most = spacing.max(initial=0)
    tree = cKDTree(marks, balanced_tree=False)
    near = tree.query(positions, distance_upper_bound=2 * most)[0] <= spacing
    left = np.flatnonzero(~near)
    if not len(left):
        return near
    tree, most = cKDTree(positions[left]), spacing[left].max()
    low, high = corners.min(axis=1), corners.max(axis=1)
    centres, radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2 + most
    radii *= 1 + 1e-9  # what is just within must not be lost to rounding
    counts = tree.query_ball_point(centres, radii, return_length=True)
    blocks = np.cumsum(counts) // _PAIRS
    for block in np.unique(blocks[counts > 0]):
        triangle = np.flatnonzero((blocks == block) & (counts > 0))
        found = tree.query_ball_point(centres[triangle], radii[triangle])
        point = left[np.concatenate([np.asarray(x, np.int64) for x in found])]
        triangle = np.repeat(triangle, counts[triangle])
        distance = distance_to_triangles(positions[point], corners[triangle])
        near[point[distance <= spacing[point]]] = True
    return near


def distance_to_triangles(positions, corners):
    """Distance (k,) of each position (k, 3) from its own triangle (k, 3, 3).

    The nearest place is inside the triangle if the foot of the perpendicular is, or else on one of
    its edges. A triangle without area has only edges.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    squared = np.einsum("ij,ij->i", normal, normal)
    inside = squared > 0
    nearest = np.full(len(positions), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, offset = end - start, positions - start
        length = np.einsum("ij,ij->i", edge, edge)
        t = np.einsum("ij,ij->i", offset, edge) / np.where(length > 0, length, 1)
        t = np.clip(t, 0, 1)[:, None]
        nearest = np.minimum(nearest, np.linalg.norm(offset - t * edge, axis=1))
        inside &= np.einsum("ij,ij->i", np.cross(edge, offset), normal) >= 0
    height = np.abs(np.einsum("ij,ij->i", positions - a, normal)) / np.sqrt(
        np.where(squared > 0, squared, 1)
    )
    return np.where(inside, height, nearest)
