"""Surfaces: the shapes of a scene as they stand in the world."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import SceneError
from ..system.runtime import mitsuba
from .materials import Material, model_material
from .own_lights import is_made_up
from .traversal import children, digest_of, find_transform, transform_of

# Least extent of a shape in any direction, as a share of its largest, that a transform may leave.
_FLATTEST = 1e-7
_MARK = "a group of mi_prt, number {};"


@dataclass(frozen=True, eq=False)
class Surface:
    """One shape as it stands in the world: a shape of the scene, or one shape of an instanced
    group.

    Parameters
    ----------
    name : str
        The shape's id; of instanced shapes "instance/shape".
    shape : mi.Shape
    instance : mi.Shape or None
    to_world : (4, 4) float64
        The instance's transform; identity for plain shapes.
    material : Material
    """

    name: str
    shape: Any
    instance: Any
    to_world: np.ndarray
    material: Material

    @property
    def kind(self):
        """'mesh', or the plugin's class name: Sphere, Cylinder, Disk, …"""
        return "mesh" if self.shape.is_mesh() else self.shape.class_name()

    @cached_property
    def shape_to_world(self):
        """The `to_world` (4, 4) float64 of an analytic shape itself; None where it has none."""
        return None if self.kind == "mesh" else find_transform(self.shape)

    @cached_property
    def signature(self):
        """Kind and place of an analytic shape as text, the same each time the scene is loaded; ''
        for meshes.
        """
        if self.kind == "mesh":
            return ""
        if self.shape_to_world is None:
            return (
                f"{self.kind} {self.shape.bbox()}"
                f" {digest_of([self.shape], lambda key: '.' not in key)}"
            )
        place = self.to_world @ self.shape_to_world
        flipped = " flipped" if self.shape.has_flipped_normals() else ""
        return self.kind + flipped + " " + " ".join(f"{x:.6g}" for x in place[:3].ravel() + 0.0)


def list_surfaces(mi_scene):
    """Surfaces of an mi.Scene in the order of its shapes.

    Raises
    ------
    SceneError
        If a shape is none that light can meet: without extent, without a material, or a group of
        nothing.
    """
    groups = _groups(mi_scene)
    instances = [shape for shape in mi_scene.shapes() if _is_instance(shape)]
    group_of = dict(zip(instances, _groups_of(instances, list(groups))))
    models, checked = {}, set()

    def material(shape, name):
        bsdf = shape.bsdf()
        if bsdf is None:
            raise SceneError(
                f"the shape '{name}' ({shape.class_name()}) has no surface that light could meet:"
                " remove it from the scene"
            )
        if bsdf not in models:
            models[bsdf] = model_material(bsdf)
        return models[bsdf]

    def surface(name, shape, instance, to_world):
        found = Surface(name, shape, instance, to_world, material(shape, name))
        _check_extent(found)
        if shape not in checked and found.kind == "mesh":
            _check_faces(found)
        checked.add(shape)
        return found

    for i, shape in enumerate(mi_scene.shapes()):
        if shape not in group_of:
            yield surface(_name(shape, i), shape, None, np.eye(4))
            continue
        to_world = transform_of(shape)
        for j, member in enumerate(groups[group_of[shape]]):
            yield surface(f"{_name(shape, i)}/{_name(member, j)}", member, shape, to_world)


def _is_instance(shape):
    return shape.class_name() == "Instance"


def _groups(mi_scene):
    """The shapes of each shape group of a scene: a dict by the group."""
    mi = mitsuba()
    groups = {}
    for _, child in children(mi_scene):
        if child.class_name() == "ShapeGroupPlugin":
            groups[child] = [c for _, c in children(child) if isinstance(c, mi.Shape)]
            if not groups[child]:
                raise SceneError(
                    f"the shape group '{child.id()}' holds no shapes, and Mitsuba traces no rays"
                    " beside such a group: remove it and its instances from the scene"
                )
    return groups


def _groups_of(instances, groups):
    """The group that each instance shows.

    Only the printed form of an instance tells, by the id of its group. Ids may be any text, so the
    groups bear marks of ours while the instances are printed.
    """
    if len(groups) < 2:
        return groups * len(instances)
    ids = [group.id() for group in groups]
    try:
        for i, group in enumerate(groups):
            group.set_id(_MARK.format(i))
        printed = [str(instance) for instance in instances]
    finally:
        for group, name in zip(groups, ids):
            group.set_id(name)
    marks = {_MARK.format(i): group for i, group in enumerate(groups)}
    return [next(group for mark, group in marks.items() if mark in text) for text in printed]


def _check_faces(surface):
    """Raise SceneError for a mesh whose faces name vertices that it does not have."""
    mesh = surface.shape
    count = mesh.vertex_count()
    if not mesh.face_count():
        raise SceneError(f"the mesh '{surface.name}' has no faces: remove it from the scene")
    largest = int(np.array(mesh.faces_buffer()).max())
    if largest >= count:
        raise SceneError(
            f"the mesh '{surface.name}' has a face with vertex {largest}, and only the {count:,}"
            f" vertices 0…{count - 1}: repair its file"
        )


def _check_extent(surface):
    """Raise SceneError for a transform that leaves a shape no extent in some direction."""
    own = surface.shape_to_world
    placed = surface.to_world if own is None else surface.to_world @ own
    extents = np.zeros(3)
    if np.isfinite(placed).all():
        extents = np.linalg.svd(placed[:3, :3], compute_uv=False)
    if not extents[2] > _FLATTEST * extents[0]:
        raise SceneError(
            f"the shape '{surface.name}' ({surface.shape.class_name()}) has no extent in some"
            f" direction ({extents[2]:g} beside {extents[0]:g} in another: is a radius or a scale"
            " 0, or a to_world not finite?): give it one, or remove it"
        )


def _name(shape, index):
    """A shape's id; one that Mitsuba made up (it holds an address, which changes at each run) is
    replaced.
    """
    return f"{shape.class_name()}-{index}" if is_made_up(shape.id()) else shape.id()
