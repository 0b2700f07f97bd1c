"""Points of one surface: mesh vertices, and lattices over coarse faces and analytic shapes."""

from dataclasses import dataclass

import numpy as np

from ..errors import SceneError
from ..scene.mesh import mesh_arrays
from ..scene.traversal import transform_of
from .lattice import lattice_nodes, lattice_triangles, leaf_triangles, node_count
from .quadtree import with_middles

MAX_LEVEL = 4096
_FINEST = 1 << 30  # steps along u and v, to which places of nodes are rounded to compare them
# Least levels (k_u, k_v) that keep the polygonal outline of a curved shape smooth, for any edge
# length.
_LEAST_LEVELS = {"Sphere": (32, 16), "Cylinder": (32, 1), "Disk": (1, 32)}
TESSELLATED_SHAPES = ("mesh", *_LEAST_LEVELS)


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of one surface and the patches that connect them.

    Parameters
    ----------
    positions, normals, geometric_normals : (n, 3) float64
        World space; the geometric normals look to the side of the shading normals.
    insets : (n, 3) float64
        At the rim of the surface the unit vector along it and inward, elsewhere 0. A rim often lies
        exactly on another surface (a floor ends at a wall): rays must start this side of it.
    uv : (n, 2) float32
    areas : (n,) float64
        m²; they sum to the area of the surface, or of the polyhedron that stands for it.
    primitives : (n,) int64
        A face that the point lies on.
    local_positions : (n, 3) float64
        In the frame of the shape, where its attributes are looked up.
    levels : (l, 2), nodes : (t,)
        Patches that are not cut as in `Patches`, with node indices local to this surface.
    sealed : bool
        Whether the surface encloses a volume with the reflecting side outside, so that its back is
        never seen.
    counts : dict
        Irregularities found: degenerate_faces, zero_normals, flipped_normals.
    """

    positions: np.ndarray
    normals: np.ndarray
    geometric_normals: np.ndarray
    insets: np.ndarray
    uv: np.ndarray
    areas: np.ndarray
    primitives: np.ndarray
    local_positions: np.ndarray
    levels: np.ndarray
    nodes: np.ndarray
    sealed: bool
    counts: dict


def patch_levels(surface, tree, edge_lengths):
    """Levels (l, 2) of the patches of a surface that are not cut, so that no edge of their lattices
    exceeds `edge_lengths` (l,), metres.

    Raises
    ------
    SceneError
        If a mesh has positions that are NaN or infinite.
    """
    leaves = tree.leaves
    parts = 2.0 ** tree.depth[leaves]
    if surface.kind == "mesh":
        # the children of a triangle are like it, and half as large
        longest = longest_edges(surface)[tree.root[leaves]] / parts
        k = np.clip(np.ceil(longest / edge_lengths - 1e-6), 1, MAX_LEVEL).astype(np.int32)
        return np.stack([k, np.zeros_like(k)], axis=-1)
    least = np.ceil(np.array(_LEAST_LEVELS[surface.kind]) / parts[:, None])
    wanted = _lengths(surface, tree) / np.asarray(edge_lengths)[:, None]
    return np.clip(np.ceil(wanted - 1e-6), least, MAX_LEVEL).astype(np.int32)


def longest_edges(surface):
    """The longest edge (f,) of each face of a mesh, metres.

    Raises
    ------
    SceneError
        If a mesh has positions that are NaN or infinite.
    """
    corners = world_corners(surface)
    if not np.isfinite(corners).all():
        raise SceneError(
            f"mesh '{surface.name}' has positions that are NaN or infinite: repair it first"
        )
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)


def tessellate(surface, tree, levels):
    """Points of a surface, see SurfacePoints.

    Parameters
    ----------
    surface : Surface
    tree : QuadTree
        Of its faces, or of the (u, v) domain of an analytic shape.
    levels : (l, 2) int
        Of the patches that are not cut, see `patch_levels`.
    """
    return (
        _tessellate_mesh(surface, tree, levels)
        if surface.kind == "mesh"
        else _tessellate_analytic(surface, tree, levels)
    )


# --- meshes ---------------------------------------------------------------------------------------


def _tessellate_mesh(surface, tree, levels):
    positions, faces, normals, uv = mesh_arrays(surface.shape)
    world = _transformed(positions, surface.to_world)
    face_normals, face_areas = _face_geometry(world, faces)
    degenerate = face_areas <= 1e-12 * max(face_areas.max(initial=0.0), 1e-300)
    # Mitsuba turns normals with flip_normals, and with an instance that mirrors: positions mirror,
    # normals do not.
    sign = float(np.sign(np.linalg.det(surface.to_world[:3, :3]))) * (
        -1.0 if surface.shape.has_flipped_normals() else 1.0
    )
    zero = 0
    if normals is None:
        # A faceted mesh has one normal per face: split each vertex into one per distinct normal
        # around it.
        faces, source = _split_by_normal(faces, face_normals)
        world, positions = world[source], positions[source]
        uv = None if uv is None else uv[source]
        normals = np.zeros_like(world)
        normals[faces.ravel()] = np.repeat(sign * face_normals, 3, axis=0)
    else:
        normals, zero = _repaired_normals(normals, faces, sign * face_normals * face_areas[:, None])
        # inverse transpose, for row vectors
        normals = normals @ np.linalg.inv(surface.to_world[:3, :3])
    uv = np.zeros((len(world), 2), np.float32) if uv is None else uv
    whole = faces[~degenerate]

    leaves = tree.leaves
    root, corners = tree.root[leaves], tree.barycentrics()[leaves]
    patches, ends = tree.triangles(faces, len(world))
    patch, barycentric, shares, identity = _mesh_nodes(
        patches[leaves], levels[:, 0], degenerate[root]
    )
    face = root[patch]
    in_face = np.einsum("tc,tcx->tx", barycentric, corners[patch])
    count = int(identity.max(initial=-1)) + 1
    if count == 0 or degenerate.all():
        raise SceneError(f"mesh '{surface.name}' has no face of positive area: remove it")
    used = ~degenerate[face]
    first = np.full(count, -1)
    first[identity[used][::-1]] = np.flatnonzero(used)[::-1]

    def at_points(values):
        values = with_middles(values, ends)[patches[leaves[patch[first]]]]
        return np.einsum("nc,ncx->nx", barycentric[first], values)

    node_areas = shares * (face_areas[root] / 4.0 ** tree.depth[leaves])[patch]
    areas = np.bincount(identity[used], node_areas[used], count)
    geometric = np.stack(
        [
            np.bincount(identity[used], (node_areas * face_normals[face, x])[used], count)
            for x in range(3)
        ],
        axis=-1,
    )
    geometric = sign * _unit(geometric)
    shading = _unit(at_points(normals))
    # opposite normals cancel in between
    shading = np.where(shading.any(axis=1)[:, None], shading, geometric)
    facing = np.sum(shading * geometric, axis=1)
    senses = np.unique(np.sign(facing))
    nodes = identity[_patch_order(levels[:, 0])]
    placed = at_points(world)
    on_rim = ((in_face == 0) & _rim_edges(faces, degenerate)[face]).any(axis=1)
    rim = np.bincount(identity[used], on_rim[used], count) > 0
    return SurfacePoints(
        positions=placed,
        normals=shading,
        geometric_normals=np.where(facing[:, None] < 0, -geometric, geometric),
        insets=_insets(placed, geometric, rim, levels, nodes),
        uv=at_points(uv).astype(np.float32),
        areas=areas,
        primitives=face[first],
        local_positions=at_points(positions),
        levels=levels,
        nodes=nodes,
        sealed=(_is_sealed(world, whole, senses[0] * sign) if len(senses) == 1 else False),
        counts={
            "degenerate_faces": int(degenerate.sum()),
            "zero_normals": zero,
            "flipped_normals": int((facing < -0.1).sum()),
        },
    )


def _mesh_nodes(faces, levels, degenerate):
    """Nodes of all faces, grouped by level.

    Returns the face (t,) and barycentric coordinates (t, 3) of each node, its share (t,) of the
    face's area (a third of each small triangle that it is a corner of), and the identity (t,) of
    the point there.

    Corners are the mesh's vertices, nodes inside an edge are shared by the faces of the same level
    along it. Vertices that only degenerate faces use get no point; nodes of degenerate faces point
    anywhere (they can't be hit).
    """
    vertices = int(faces.max(initial=-1)) + 1
    face_parts, barycentric_parts, share_parts, corner_parts, edge_parts = [], [], [], [], []
    for k in np.unique(levels):
        of_level = np.flatnonzero(levels == k)
        i, j = lattice_nodes(k, 0).T
        steps = np.stack([k - i - j, i, j], axis=-1)
        f = np.repeat(of_level, len(steps))
        steps = np.tile(steps, (len(of_level), 1))
        zeros = (steps == 0).sum(axis=1)
        face_parts.append(f)
        barycentric_parts.append(steps / k)
        triangles = lattice_triangles(k, 0)
        share_parts.append(
            np.tile(np.bincount(triangles.ravel()) / 3 / len(triangles), len(of_level))
        )
        corner_parts.append(np.where(zeros == 2, faces[f, steps.argmax(axis=1)], -1))
        # An edge node is known by its end vertices in ascending order, the level, and the steps
        # from the first.
        opposite = steps.argmin(axis=1)
        one, two = (opposite + 1) % 3, (opposite + 2) % 3
        rows = np.arange(len(f))
        v_one, v_two = faces[f, one], faces[f, two]
        from_low = np.where(v_one < v_two, steps[rows, two], steps[rows, one])
        key = np.stack(
            [
                np.minimum(v_one, v_two) * vertices + np.maximum(v_one, v_two),
                k * (MAX_LEVEL + 1) + from_low,
            ],
            -1,
        )
        edge_parts.append(np.where((zeros == 1)[:, None], key, -1))
    face, barycentric = np.concatenate(face_parts), np.concatenate(barycentric_parts)
    corner, edge = np.concatenate(corner_parts), np.concatenate(edge_parts)

    used = ~degenerate[face]
    on_vertex, on_edge = used & (corner >= 0), used & (edge[:, 0] >= 0)
    inside = used & ~on_vertex & ~on_edge
    identity = np.zeros(len(face), np.int64)
    vertex_ids, identity[on_vertex] = np.unique(corner[on_vertex], return_inverse=True)
    edge_ids, inverse = np.unique(edge[on_edge], axis=0, return_inverse=True)
    identity[on_edge] = len(vertex_ids) + inverse.ravel()
    identity[inside] = len(vertex_ids) + len(edge_ids) + np.arange(inside.sum())
    return face, barycentric, np.concatenate(share_parts), identity


def _patch_order(levels):
    """Where the nodes of `_mesh_nodes`, which are grouped by level, must go so that patches follow
    the faces' order.
    """
    counts = node_count(levels, 0)
    grouped = np.argsort(levels, kind="stable")  # the faces in the order of their groups
    starts = np.empty(len(levels), np.int64)
    starts[grouped] = np.cumsum(counts[grouped]) - counts[grouped]
    return (
        np.repeat(starts, counts)
        + np.arange(counts.sum())
        - np.repeat(np.cumsum(counts) - counts, counts)
    )


def _split_by_normal(faces, face_normals):
    keys = np.round(face_normals * 4096).astype(np.int64) + 4097
    packed = (keys[:, 0] * 8195 + keys[:, 1]) * 8195 + keys[:, 2]
    corner_keys = np.stack([faces.ravel(), np.repeat(packed, 3)], axis=-1)
    split, inverse = np.unique(corner_keys, axis=0, return_inverse=True)
    return inverse.reshape(faces.shape), split[:, 0]


def world_corners(surface):
    """Corners (f, 3, 3) of a mesh's faces in the world."""
    positions, faces, _, _ = mesh_arrays(surface.shape)
    return _transformed(positions, surface.to_world)[faces]


def _face_geometry(positions, faces):
    a, b, c = positions[faces[:, 0]], positions[faces[:, 1]], positions[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    return _unit(cross), np.linalg.norm(cross, axis=1) / 2


def _repaired_normals(normals, faces, weighted_face_normals):
    """Vertex normals (v, 3) with those that are zero or not finite replaced by the faces' around,
    and their number.
    """
    broken = np.zeros(len(normals), bool)
    broken[faces.ravel()] = True
    broken &= ~(np.linalg.norm(normals, axis=1) > 1e-8)  # also true for NaN
    if not broken.any():
        return normals, 0
    around = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(weighted_face_normals[:, x], 3), len(normals))
            for x in range(3)
        ],
        axis=-1,
    )
    return np.where(broken[:, None], _unit(around), normals), int(broken.sum())


def _rim_edges(faces, degenerate):
    """Whether the edge opposite to each corner (f, 3) is of no other face."""
    edges = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
    keys = edges[..., 0] * (int(faces.max(initial=0)) + 1) + edges[..., 1]
    whole, uses = np.unique(keys[~degenerate], return_counts=True)
    return np.isin(keys, whole[uses == 1])


def _insets(positions, normals, rim, levels, nodes):
    """Unit vectors (n, 3) from points on the `rim` (n,) toward the triangles they belong to, along
    the surface; 0 elsewhere.
    """
    triangles = leaf_triangles(levels, nodes)[0]
    inward = np.zeros_like(positions)
    centres = positions[triangles].mean(axis=1)
    for corner in triangles.T:
        for x in range(3):
            inward[:, x] += np.bincount(
                corner, centres[:, x] - positions[corner, x], len(positions)
            )
    inward -= np.sum(inward * normals, axis=1, keepdims=True) * normals
    return np.where(rim[:, None], _unit(inward), 0)


def _is_sealed(positions, faces, sign):
    """Whether every edge, welded by position, joins two faces of one sense, and the side of `sign`
    is outside.
    """
    welded = np.unique(positions, axis=0, return_inverse=True)[1].ravel()[faces]
    count = len(positions) + 1
    edges = np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]])
    forward, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    backward = np.unique(edges[:, 1] * count + edges[:, 0])
    if (uses != 1).any() or not np.array_equal(forward, backward):
        return False
    a, b, c = (positions[faces[:, i]].astype(np.float64) for i in range(3))
    return bool(sign * np.sum(a * np.cross(b, c)) > 0)


# --- analytic shapes ------------------------------------------------------------------------------


def _tessellate_analytic(surface, tree, levels):
    nodes = domain_nodes(tree, levels)
    # Nodes on the seam and at the poles of a shape lie at one place: one point each.
    u, v = np.round(nodes * _FINEST).astype(np.int64).T
    if surface.kind in ("Sphere", "Cylinder"):
        u[u == _FINEST] = 0
    if surface.kind == "Sphere":
        u[(v == 0) | (v == _FINEST)] = 0
    if surface.kind == "Disk":
        v[(v == _FINEST) | (u == 0)] = 0
    _, first, identity = np.unique(v * (_FINEST + 1) + u, return_index=True, return_inverse=True)
    uv = nodes[first].astype(np.float32)
    rim = {"Sphere": u < 0, "Cylinder": (v == 0) | (v == _FINEST), "Disk": u == _FINEST}
    local, normals = _evaluate(surface, uv)
    world = _transformed(local, surface.to_world)
    normals = _unit(normals @ np.linalg.inv(surface.to_world[:3, :3]))
    triangles = leaf_triangles(levels, identity)[0]
    areas = np.bincount(
        triangles.ravel(), np.repeat(_face_geometry(world, triangles)[1] / 3, 3), len(first)
    )
    return SurfacePoints(
        positions=world,
        normals=normals,
        geometric_normals=normals,
        insets=_insets(world, normals, rim[surface.kind][first], levels, identity),
        uv=uv,
        areas=areas,
        primitives=np.zeros(len(first), np.int64),
        local_positions=local,
        levels=levels,
        nodes=identity,
        sealed=surface.kind == "Sphere" and not surface.shape.has_flipped_normals(),
        counts={"degenerate_faces": 0, "zero_normals": 0, "flipped_normals": 0},
    )


def _evaluate(surface, uv):
    """Positions and unit normals (k, 3) at the shape's own (u, v), in the frame of the shape or its
    group.

    Mitsuba's parametrisations of the unit shapes, in closed form: its `eval_parameterization`
    misses the rims of cylinders and forgets `flip_normals` of spheres.
    """
    u, v = uv.T.astype(np.float64)
    to_world = transform_of(surface.shape)
    if surface.kind == "Sphere":
        local = _on_circle(u, np.sin(np.pi * v), np.cos(np.pi * v))
        normals = local
    elif surface.kind == "Cylinder":
        local = _on_circle(u, 1.0, v)
        # The normal is the product of tangents, so a mirroring transform turns it inside.
        mirrored = np.linalg.det(to_world[:3, :3]) < 0
        normals = (-1 if mirrored else 1) * _on_circle(u, 1.0, np.zeros_like(v))
    else:
        local = _on_circle(v, u, np.zeros_like(u))
        normals = np.broadcast_to([0.0, 0.0, 1.0], local.shape)
    normals = _unit(normals @ np.linalg.inv(to_world[:3, :3]))
    return _transformed(local, to_world), (
        -normals if surface.shape.has_flipped_normals() else normals
    )


def _on_circle(turn, radius, height):
    phi = 2 * np.pi * turn
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), height], axis=-1)


def domain_nodes(tree, levels):
    """Places (t, 2) in (u, v) of the nodes of an analytic shape's patches that are not cut."""
    parts = []
    for (low_u, low_v, high_u, high_v), level in zip(tree.rectangles()[tree.leaves], levels):
        low, size = np.array([low_u, low_v]), np.array([high_u - low_u, high_v - low_v])
        parts.append(low + lattice_nodes(*level) / level * size)
    return np.concatenate(parts)


def places_of(surface, uv):
    """Places (k, 3) of an analytic shape at some (u, v), in the world."""
    return _transformed(_evaluate(surface, uv)[0], surface.to_world)


def _lengths(surface, tree):
    """Longest extents (l, 2) along u and v of the patches that are not cut, metres."""
    if not tree.cuts:
        return np.array([analytic_lengths(surface)])
    bounds, side = tree.rectangles()[tree.leaves], 5
    steps = np.linspace(0, 1, side)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    uv = bounds[:, None, :2] + grid * (bounds[:, None, 2:] - bounds[:, None, :2])
    world = places_of(surface, uv.reshape(-1, 2)).reshape(-1, side, side, 3)
    along = [
        np.linalg.norm(np.diff(world, axis=a), axis=-1).sum(axis=a).max(axis=1) for a in (2, 1)
    ]
    return np.stack(along, axis=1)


def analytic_lengths(surface):
    """Longest extents (u, v) of the shape along its parameters, in metres."""
    side = 33
    grid = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)), axis=-1).reshape(
        -1, 2
    )
    local, _ = _evaluate(surface, grid)
    world = _transformed(local, surface.to_world).reshape(side, side, 3)
    along_u = np.linalg.norm(np.diff(world, axis=1), axis=-1).sum(axis=1).max()
    along_v = np.linalg.norm(np.diff(world, axis=0), axis=-1).sum(axis=0).max()
    return along_u, along_v


def _transformed(positions, to_world):
    return positions.astype(np.float64) @ to_world[:3, :3].T + to_world[:3, 3]


def _unit(vectors):
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
