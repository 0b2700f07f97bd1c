"""The box around a scene."""

import warnings

import numpy as np

from ..errors import SceneError

WIDE = 1 / 16  # of the scene's size, above which a shape may be a ground to all others
FAR = 1000  # extents of a scene from the origin, from which on it is blurred


def bounds_of(mi_scene):
    """Least and largest coordinates (2, 3) float64 of an mi.Scene.

    Mitsuba's own box is taken where it is one; of meshes that its loader merged it holds none, and
    then the vertices tell.

    Raises
    ------
    SceneError
        If a shape has positions that are NaN or infinite; it is named.
    """
    box = _box(mi_scene)
    if np.isfinite(box).all():
        return box
    boxes = np.array([box_of(shape) for shape in mi_scene.shapes()])
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def _box(node):
    box = node.bbox()
    return np.array([box.min, box.max], dtype=np.float64).reshape(2, 3)


def box_of(shape):
    """Least and largest coordinates (2, 3) float64 of an mi.Shape; raises as `bounds_of` does."""
    box = _box(shape)
    if shape.is_mesh() and not np.isfinite(box).all():
        positions = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
        box = np.stack([positions.min(axis=0), positions.max(axis=0)])
    if not np.isfinite(box).all():
        raise SceneError(
            f"the shape '{shape.id()}' ({shape.class_name()}) reaches from {box[0]} to {box[1]}: it"
            " has positions that are NaN or infinite; repair it first"
        )
    return box


def scale_of(mi_scene):
    """Length that offsets and tolerances are measured by: diagonal of the box around a scene, or
    its largest coordinate.

    Where some shapes are far wider than all others together (a ground of kilometres under a house)
    it is a sixteenth of that, or the largest coordinate of the others: rays would start decimetres
    off the surface otherwise.

    Raises
    ------
    SceneError
        If it is not finite, see `bounds_of`.
    """
    box = bounds_of(mi_scene)
    whole = _diagonal(box)
    boxes = np.array([box_of(shape) for shape in mi_scene.shapes()]).reshape(-1, 2, 3)
    others = boxes[_diagonal(boxes) <= WIDE * whole]
    if len(others):
        rest = np.stack([others[:, 0].min(axis=0), others[:, 1].max(axis=0)])
        if _diagonal(rest) <= WIDE * whole:
            return float(max(WIDE * whole, np.abs(rest).max()))
    return float(max(whole, np.abs(box).max()))


def _diagonal(boxes):
    """Of boxes (…, 2, 3)."""
    return np.linalg.norm(boxes[..., 1, :] - boxes[..., 0, :], axis=-1)


def warn_if_far(mi_scene):
    """Warn of a scene so far from the origin that single precision blurs it, in Mitsuba too."""
    low, high = box = _box(mi_scene)
    if not np.isfinite(box).all():
        return  # told later, by the shape
    extent, farthest = np.linalg.norm(high - low), np.abs(box).max()
    if farthest > FAR * extent > 0:
        step = np.spacing(np.float32(farthest))
        warnings.warn(
            f"the scene of {extent:.3g} m lies {farthest:.3g} m from the origin, where single"
            f" precision places things to {step:.2g} m: Mitsuba's own pictures of it are damaged,"
            " and so is what is computed here; move it to the origin",
            stacklevel=3,
        )
