"""Surfaces: the shapes of a scene as they stand in the world."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import SceneError
from ..system.runtime import mitsuba
from .materials import Material, model_material
from .own_lights import is_made_up
from .traversal import children, digest_of, transform_of


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
    def signature(self):
        """Kind and place of an analytic shape as text, the same each time the scene is loaded; ''
        for meshes.
        """
        if self.kind == "mesh":
            return ""
        if "to_world" not in mitsuba().traverse(self.shape):
            return (
                f"{self.kind} {self.shape.bbox()}"
                f" {digest_of([self.shape], lambda key: '.' not in key)}"
            )
        place = self.to_world @ transform_of(self.shape)
        flipped = " flipped" if self.shape.has_flipped_normals() else ""
        return self.kind + flipped + " " + " ".join(f"{x:.6g}" for x in place[:3].ravel() + 0.0)


def list_surfaces(mi_scene):
    """Surfaces of an mi.Scene in the order of its shapes."""
    groups = {c.id(): c for _, c in children(mi_scene) if c.class_name() == "ShapeGroupPlugin"}
    models = {}

    def material(shape):
        bsdf = shape.bsdf()
        if bsdf not in models:
            models[bsdf] = model_material(bsdf)
        return models[bsdf]

    for i, shape in enumerate(mi_scene.shapes()):
        if shape.class_name() != "Instance":
            yield Surface(_name(shape, i), shape, None, np.eye(4), material(shape))
            continue
        members = [
            c for _, c in children(groups[_group_of(shape)]) if isinstance(c, mitsuba().Shape)
        ]
        for j, member in enumerate(members):
            name = f"{_name(shape, i)}/{_name(member, j)}"
            yield Surface(name, member, shape, transform_of(shape), material(member))


def _name(shape, index):
    """A shape's id; one that Mitsuba made up (it holds an address, which changes at each run) is
    replaced.
    """
    return f"{shape.class_name()}-{index}" if is_made_up(shape.id()) else shape.id()


def _group_of(instance):
    """Id of the shape group that an instance shows. Only its printed form tells."""
    found = re.search(r'ShapeGroup\[\s*name = "([^"]*)"', str(instance))
    if not found:
        raise SceneError(
            f"the shape group of instance '{instance.id()}' cannot be told: expand it into shapes"
        )
    return found[1]
