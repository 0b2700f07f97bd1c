"""Opening Mitsuba scenes and listing the surfaces in them."""

import hashlib
import os
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import SceneError
from ..system.runtime import a_worker_at_least, mitsuba
from .materials import Material, model_material
from .traversal import children, digest_of, transform_of


@dataclass(frozen=True)
class SceneSource:
    """Where a scene came from, so that it can be opened again.

    Parameters
    ----------
    kind : 'file', 'dict' or 'object'
    path : str or None
        Absolute path of a file.
    parameters : dict
        Values for the file's `<default>` parameters.
    content : dict or mi.Scene or None
        The dict or scene itself; not written to assets.
    """

    kind: str
    path: str | None = None
    parameters: dict = field(default_factory=dict)
    content: object = field(default=None, repr=False, compare=False)


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
    shape: object
    instance: object
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


class Scene:
    """A Mitsuba scene, its surfaces and emitters.

    Attributes
    ----------
    mi_scene : mi.Scene
        As written.
    source : SceneSource
    surfaces : tuple of Surface
        In the order of the scene's shapes.
    distant_emitters, local_emitters : tuple of mi.Emitter

    Raises
    ------
    SceneError
        If the scene holds no shapes.
    """

    def __init__(self, mi_scene, source):
        mi = mitsuba()
        self.mi_scene = mi_scene
        self.source = source
        self._children = children(mi_scene)
        self.surfaces = tuple(self._list_surfaces())
        if not self.surfaces:
            raise SceneError("the scene holds no shapes: there is nothing to light")
        empty = [s.name for s in self.surfaces if s.kind == "mesh" and s.shape.face_count() == 0]
        if empty:  # Dr.Jit cannot read from arrays without entries
            raise SceneError(f"the mesh '{empty[0]}' has no faces: remove it from the scene")
        emitters = mi_scene.emitters()
        is_distant = [mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in emitters]
        self.distant_emitters = tuple(e for e, distant in zip(emitters, is_distant) if distant)
        self.local_emitters = tuple(e for e, distant in zip(emitters, is_distant) if not distant)

    def _list_surfaces(self):
        groups = {c.id(): c for _, c in self._children if c.class_name() == "ShapeGroupPlugin"}
        models = {}

        def material(shape):
            bsdf = shape.bsdf()
            if bsdf not in models:
                models[bsdf] = model_material(bsdf)
            return models[bsdf]

        for i, shape in enumerate(self.mi_scene.shapes()):
            if shape.class_name() != "Instance":
                yield Surface(_name(shape, i), shape, None, np.eye(4), material(shape))
                continue
            members = [
                c for _, c in children(groups[_group_of(shape)]) if isinstance(c, mitsuba().Shape)
            ]
            for j, member in enumerate(members):
                name = f"{_name(shape, i)}/{_name(member, j)}"
                yield Surface(name, member, shape, transform_of(shape), material(member))

    @cached_property
    def scale(self):
        """See `scale_of`."""
        return scale_of(self.mi_scene)

    @cached_property
    def occluders(self):
        """The same shapes as an mi.Scene whose intersections are watertight.

        Embree's robust mode is off in scenes by default; rays that start at vertices then leak
        through shared edges.
        """
        return rebuilt_scene([c for _, c in self._children if isinstance(c, mitsuba().Shape)])

    @cached_property
    def hash(self):
        """SHA-256 of what direct transport depends on: the geometry of every surface, and which
        sides reflect.
        """
        digest = hashlib.sha256()
        for surface in self.surfaces:
            digest.update(f"{surface.kind} {surface.material.two_sided}".encode())
            digest.update(surface.signature.encode())
            digest.update(surface.to_world.tobytes())
            if surface.kind == "mesh":
                digest.update(str(surface.shape.has_flipped_normals()).encode())
                for values in mesh_arrays(surface.shape)[:3]:
                    digest.update(b"-" if values is None else values.tobytes())
        return digest.hexdigest()

    @cached_property
    def appearance(self):
        """SHA-256 of the reflectance of every surface, which reflected light depends on."""
        materials = {
            material: digest_of([material.modelled])
            for material in dict.fromkeys(s.material for s in self.surfaces)
        }
        shapes = {s.shape: digest_of([s.shape], _is_appearance) for s in self.surfaces}
        return hashlib.sha256(
            "".join(materials[s.material] + shapes[s.shape] for s in self.surfaces).encode()
        ).hexdigest()

    def statistics(self):
        """Counts for reports: shapes by kind, triangles, vertices."""
        meshes = [s.shape for s in self.surfaces if s.kind == "mesh"]
        return {
            "shapes": len(self.surfaces),
            "kinds": dict(Counter(s.shape.class_name() for s in self.surfaces)),
            "instances": sum(s.instance is not None for s in self.surfaces),
            "triangles": sum(m.face_count() for m in meshes),
            "vertices": sum(m.vertex_count() for m in meshes),
        }

    def modelled(self, keep_local=False):
        """The scene that the transport stands for: diffuse reflection only, local emitters dark or,
        with `keep_local`, as they are.

        Returns
        -------
        mi.Scene
            A fresh scene where something has to be changed; this one is left as it is.

        Raises
        ------
        SceneError
            If the scene was given as an mi.Scene and would have to be changed.
        """
        return self._changed(
            [i for i, s in enumerate(self.surfaces) if s.material.left_out], keep_local
        )

    def unlit(self):
        """The scene as written, but for its local emitters, which are dark; see `modelled`."""
        return self._changed([], keep_local=False)

    def _changed(self, replaced, keep_local):
        """The scene with the modelled materials on some surfaces, and local emitters kept or
        dark.
        """
        if not replaced and (keep_local or not self.local_emitters):
            return self.mi_scene
        if self.source.kind == "object" or _holds_objects(self.source.content):
            raise SceneError(
                "a scene given as Mitsuba objects cannot be rebuilt with diffuse materials and"
                " without local emitters: pass its path or dict, or compare with reference 'full'"
            )
        copy = open_scene(self.source.path or self.source.content, self.source.parameters)
        for i in replaced:
            copy.surfaces[i].shape.set_bsdf(copy.surfaces[i].material.modelled)
        for emitter in () if keep_local else copy.local_emitters:
            _darken(emitter)
        return copy.mi_scene


def open_scene(source, parameters=None):
    """Open a scene.

    Parameters
    ----------
    source : path, dict or mi.Scene
        A Mitsuba XML file, a scene dict (`type: scene`) or a loaded scene.
    parameters : dict, optional
        Values for an XML file's `<default>` parameters.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the file is missing, Mitsuba rejects it, it is no scene, or it holds no shapes.
    """
    mi = mitsuba()
    if isinstance(source, Scene):
        return source
    if isinstance(source, mi.Scene):
        return Scene(source, SceneSource("object", content=source))
    parameters = {str(k): str(v) for k, v in (parameters or {}).items()}
    if isinstance(source, dict):
        loaded = _loaded("the scene dict", mi.load_dict, source)
        return Scene(loaded, SceneSource("dict", content=source))
    if not isinstance(source, str | os.PathLike):
        raise SceneError(f"a scene is a path, a dict or an mi.Scene, got {type(source).__name__}")
    path = Path(source).absolute()
    if not path.is_file():
        raise SceneError(f"scene '{path}' does not exist")
    loaded = _loaded(f"scene '{path}'", mi.load_file, str(path), **parameters)
    return Scene(loaded, SceneSource("file", str(path), parameters))


def _loaded(what, load, *arguments, **parameters):
    # optimize=False keeps every shape what it is in the file; parallel=False avoids a known
    # deadlock.
    try:
        with a_worker_at_least():
            scene = load(*arguments, optimize=False, parallel=False, **parameters)
    except Exception as error:  # Mitsuba raises RuntimeError, ValueError and others
        raise SceneError(f"Mitsuba rejects {what}: {' '.join(str(error).split())}") from None
    if not isinstance(scene, mitsuba().Scene):
        raise SceneError(f"{what} is a {type(scene).__name__}, not a scene")
    return scene


def rebuilt_scene(parts, additions=None):
    """A new mi.Scene with watertight intersections, of objects of another and of plugin dicts.

    Parameters
    ----------
    parts : list of mi.Object
        They keep their ids (Mitsuba renames what it is given by the keys of the dict).
    additions : dict, optional
        Entries of a scene dict.

    Returns
    -------
    mi.Scene
    """
    ids = [part.id() for part in parts]
    entries = {f"part{i}": part for i, part in enumerate(parts)} | (additions or {})
    try:
        return mitsuba().load_dict(
            {"type": "scene", "embree_use_robust_intersections": True, **entries},
            optimize=False,
            parallel=False,
        )
    finally:
        for part, name in zip(parts, ids):
            part.set_id(name)


def scale_of(mi_scene):
    """Length that offsets and tolerances are measured by: the bounding box's diagonal or the
    largest coordinate.

    Raises
    ------
    SceneError
        If the bounding box is not finite.
    """
    box = mi_scene.bbox()
    low, high = (
        np.array(box.min, dtype=np.float64).ravel(),
        np.array(box.max, dtype=np.float64).ravel(),
    )
    if not np.isfinite([low, high]).all():
        raise SceneError(
            f"the scene's bounding box {low}…{high} is not finite: a mesh holds NaN or infinite"
            " positions"
        )
    return float(max(np.linalg.norm(high - low), np.abs([low, high]).max()))


def mesh_arrays(mesh):
    """Buffers of a mesh in its own frame.

    Returns
    -------
    positions : (v, 3) float32
    faces : (f, 3) int64
    normals : (v, 3) float32 or None
        Shading normals as Mitsuba uses them (flip_normals applied); None if the mesh is faceted.
    uv : (v, 2) float32 or None
    """
    positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    normals = uv = None
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        normals = np.array(mesh.vertex_normals_buffer(), dtype=np.float32).reshape(-1, 3)
        if mesh.has_flipped_normals():
            normals = -normals
    if mesh.has_vertex_texcoords():
        uv = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float32).reshape(-1, 2)
    return positions, faces, normals, uv


def _holds_objects(content):
    """Whether a scene dict contains loaded objects, which a second scene of it would share."""
    if isinstance(content, dict):
        return any(_holds_objects(entry) for entry in content.values())
    return isinstance(content, mitsuba().Object)


def _name(shape, index):
    """A shape's id; one that Mitsuba made up (it holds an address, which changes at each run) is
    replaced.
    """
    made_up = not shape.id() or re.fullmatch(r"(object|_unnamed)_\d+", shape.id())
    return f"{shape.class_name()}-{index}" if made_up else shape.id()


def _group_of(instance):
    """Id of the shape group that an instance shows. Only its printed form tells."""
    found = re.search(r'ShapeGroup\[\s*name = "([^"]*)"', str(instance))
    if not found:
        raise SceneError(
            f"the shape group of instance '{instance.id()}' cannot be told: expand it into shapes"
        )
    return found[1]


def _is_appearance(key):
    """Whether a shape's parameter is one that materials look up: texture coordinates or an
    attribute such as vertex_color.
    """
    return key.startswith(("vertex_", "face_")) and key not in (
        "vertex_positions",
        "vertex_normals",
    )


def is_dark(emitter):
    """Whether an emitter sends no light."""
    parameters = mitsuba().traverse(emitter)
    return not any(
        np.any(np.array(parameters[key]))
        for key in _emitted(parameters)
        if key != "sampling_weight"
    )


def _darken(emitter):
    parameters = mitsuba().traverse(emitter)
    for key in _emitted(parameters):
        parameters[key] = parameters[key] * 0
    parameters.update()


def _emitted(parameters):
    """Keys of what an emitter's light is proportional to, and of how often it is sampled."""
    kinds = ("radiance", "intensity", "irradiance", "sampling_weight")
    # it iterates over pairs
    return [key for key in parameters.keys() if key.split(".")[0] in kinds and "to_uv" not in key]
