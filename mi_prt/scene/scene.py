"""Opening Mitsuba scenes and listing the surfaces in them."""

import hashlib
import os
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PrtError, SceneError
from ..system.files import why_no_file
from ..system.passing import one_line
from ..system.runtime import mitsuba
from ..system.workers import a_worker_at_least
from .bounds import bounds_of, scale_of, warn_if_far
from .interactions import make_interactions
from .mesh import mesh_arrays
from .mesh_scene import is_mesh_file, is_mesh_object, mesh_scene
from .own_lights import list_own_lights
from .rebuild import check_can_be_copied, kept_parts, rebuilt_scene
from .surface import list_surfaces
from .traversal import children, digest_of


@dataclass(frozen=True)
class SceneSource:
    """Where a scene came from, so that it can be opened again.

    Parameters
    ----------
    kind : 'file', 'dict' or 'object'
        A trimesh object counts as a dict: both are opened again from what was given.
    path : str or None
        Absolute path of a file.
    parameters : dict
        Values for the file's `<default>` parameters.
    is_relative : bool
        Whether the path was given relative to the working directory.
    content : dict or mi.Scene or None
        The dict, scene or mesh itself; not written to assets.
    """

    kind: str
    path: str | None = None
    parameters: dict = field(default_factory=dict)
    is_relative: bool = False
    content: Any = field(default=None, repr=False, compare=False)


class Scene:
    """A Mitsuba scene, its surfaces and emitters.

    Attributes
    ----------
    mi_scene : mi.Scene
        As written.
    source : SceneSource
    surfaces : tuple of Surface
        In the order of the scene's shapes.
    own_lights : tuple of OwnLight
        Its emitters in the scene's order. Each is named by the id of the shape that shines or of
        the emitter; where Mitsuba made that up, `lamp_3` is the third local light and `sky_1` the
        first distant one. A second light of a name is `name#2`.

    Raises
    ------
    SceneError
        If the scene holds no shapes.
    """

    def __init__(self, mi_scene, source):
        self.mi_scene = mi_scene
        self.source = source
        self._children = children(mi_scene)
        self.surfaces = tuple(list_surfaces(mi_scene))
        if not self.surfaces:
            raise SceneError("the scene holds no shapes: there is nothing to light")
        self.own_lights = list_own_lights(mi_scene)

    @property
    def distant_emitters(self):
        """mi.Emitters whose light comes from infinity, a tuple."""
        return tuple(own.emitter for own in self.own_lights if own.is_distant)

    @property
    def local_emitters(self):
        """All other mi.Emitters, a tuple."""
        return tuple(own.emitter for own in self.own_lights if not own.is_distant)

    @cached_property
    def bounds(self):
        """See `bounds_of`."""
        return bounds_of(self.mi_scene)

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
    def interaction(self):
        """Surface interactions of hits in it, see `make_interactions`."""
        return make_interactions(self.surfaces)

    def intersect(self, ray, active=True):
        """The surface interactions (mi.SurfaceInteraction3f) of rays, watertight."""
        pi = self.occluders.ray_intersect_preliminary(ray, coherent=True, active=active)
        return self.interaction(pi, ray, active)

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
                positions, faces, normals, _ = mesh_arrays(surface.shape)
                digest.update(positions.tobytes() + faces.tobytes())
                digest.update(b"-" if normals is None else _print_of(normals))
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

    def relit(self, factors, modelled=False):
        """The scene with its lamps dimmed and, if asked for, with modelled materials.

        Parameters
        ----------
        factors : dict
            Of its local lights by name (see `own_lights`), numbers or RGB (3,); those that are not
            there are dark. Distant lights stay as they are.
        modelled : bool
            Whether materials are those that transport stands for: their diffuse parts.

        Returns
        -------
        mi.Scene
            The scene itself where nothing has to be changed; else a new one, with watertight
            intersections, and this one is left as it is.

        Raises
        ------
        LightError
            If a name is not one of a lamp, a factor is negative or not finite, or a lamp cannot be
            dimmed.
        SceneError
            If the scene was given as Mitsuba objects and would have to be changed.
        """
        distant = [own.name for own in self.own_lights if own.is_distant]
        parts = kept_parts(self, factors, modelled, distant)
        changed = set(map(id, self._lit_objects())) ^ set(map(id, parts))
        return rebuilt_scene(parts) if changed else self.mi_scene

    def _lit_objects(self):
        mi = mitsuba()
        return [c for _, c in self._children if isinstance(c, mi.Shape | mi.Sensor | mi.Emitter)]

    def copy(self):
        """The same scene opened again, whose objects are others.

        Raises
        ------
        SceneError
            If it was given as Mitsuba objects.
        """
        check_can_be_copied(self, _holds_objects(self.source.content))
        return open_scene(self.source.path or self.source.content, self.source.parameters)


def open_scene(source, parameters=None):
    """Open a scene.

    Parameters
    ----------
    source : path, dict, mi.Scene, trimesh.Trimesh or trimesh.Scene
        A Mitsuba XML file, a scene dict (`type: scene`), a loaded scene, or a mesh (.ply, .obj,
        .glb, .stl, or of trimesh), which is diffuse and comes without light: see `mesh_scene`.
    parameters : dict, optional
        Values for an XML file's `<default>` parameters; of a mesh floor, normals, up and grey.

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
    if is_mesh_object(source):
        loaded = _loaded("the mesh", mi.load_dict, mesh_scene(source, parameters))
        return Scene(loaded, SceneSource("dict", None, parameters, content=source))
    if isinstance(source, dict):
        loaded = _loaded("the scene dict", mi.load_dict, source)
        return Scene(loaded, SceneSource("dict", content=source))
    if not isinstance(source, str | os.PathLike):
        raise SceneError(
            "a scene is a path, a dict, an mi.Scene or a trimesh object, got"
            f" {type(source).__name__}"
        )
    path = Path(source).absolute()
    if reason := why_no_file(path):
        raise SceneError(f"scene '{path}' {reason}: give a Mitsuba XML file or a mesh")
    if is_mesh_file(path):
        loaded = _loaded(f"mesh '{path}'", mi.load_dict, mesh_scene(path, parameters))
    else:
        loaded = _loaded(f"scene '{path}'", mi.load_file, str(path), **parameters)
    return Scene(loaded, SceneSource("file", str(path), parameters, not Path(source).is_absolute()))


def _loaded(what, load, *arguments, **parameters):
    # optimize=False keeps every shape what it is in the file; parallel=False avoids a known
    # deadlock.
    try:
        with a_worker_at_least():
            scene = load(*arguments, optimize=False, parallel=False, **parameters)
    except PrtError:  # of a plugin of this package
        raise
    except Exception as error:  # Mitsuba raises RuntimeError, ValueError and others
        text = one_line(error)
        hint = " (or a film has no pixels)" if "field of view must" in text else ""
        raise SceneError(f"Mitsuba rejects {what}: {text}{hint}") from None
    if not isinstance(scene, mitsuba().Scene):
        raise SceneError(f"{what} is a {type(scene).__name__}, not a scene")
    warn_if_far(scene)
    return scene


def _print_of(normals):
    """Bytes of normals (v, 3) that rounding does not change. Where a file has none, Mitsuba sums
    those of the faces in an order that changes from run to run.
    """
    weights = 1 + np.cos(np.arange(len(normals)))
    total = weights @ normals.astype(np.float64) / np.sqrt(max(len(normals), 1))
    return (np.round(total, 3) + 0.0).astype(np.float32).tobytes()


def _holds_objects(content):
    """Whether a scene dict contains loaded objects, which a second scene of it would share."""
    if isinstance(content, dict):
        return any(_holds_objects(entry) for entry in content.values())
    mi = mitsuba()
    return isinstance(content, mi.Object) and not isinstance(content, mi.Bitmap)


def _is_appearance(key):
    """Whether a shape's parameter is one that materials look up: texture coordinates or an
    attribute such as vertex_color.
    """
    return key.startswith(("vertex_", "face_")) and key not in (
        "vertex_positions",
        "vertex_normals",
    )
