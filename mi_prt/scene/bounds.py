"""The box around a scene."""

import numpy as np

from ..errors import SceneError


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
