"""Mesh files and trimesh objects as scenes: each mesh diffuse, a camera that sees them, no light.

trimesh reads them; it is imported only here.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SceneError
from ..system.runtime import mitsuba
from .camera import Camera

ENDINGS = (".ply", ".obj", ".glb", ".stl")
GREY = 0.5
FLOOR_SIZE = 4.0  # half side of a floor, in radii of what stands on it
# What -D takes for these scenes, and its values; the first is the default.
CHOICES = {"floor": ("off", "on"), "normals": ("file", "flat"), "up": ("y", "z")}
_UP = {"y": 1, "z": 2}


@dataclass(frozen=True)
class _Look:
    """How meshes are made a scene: `CHOICES`, and the grey of what has no colour."""

    floor: str = "off"
    normals: str = "file"
    up: str = "y"
    grey: float = GREY


def is_mesh_file(path):
    """Whether the name of a Path is that of a mesh."""
    return path.suffix.lower() in ENDINGS


def is_mesh_object(source):
    """Whether something is a mesh or scene of trimesh."""
    return type(source).__module__.split(".")[0] == "trimesh" and hasattr(source, "bounds")


def mesh_scene(source, parameters):
    """A scene dict of a mesh.

    Shading normals are those of the file, else smooth as Mitsuba's own readers make them; those of
    STL files, and of `normals=flat`, are the faces'. Colours of 8 bits are taken as sRGB.

    Parameters
    ----------
    source : Path or trimesh.Trimesh or trimesh.Scene
    parameters : dict of str
        floor 'off' or 'on', normals 'file' or 'flat', up 'y' or 'z', and grey, the reflectance of
        meshes without colours, 0…1.

    Returns
    -------
    dict

    Raises
    ------
    SceneError
        If the file cannot be read, holds no triangles, or a parameter is another.
    """
    look = _look_of(parameters)
    meshes, has_file_normals = _meshes(source)
    if not meshes:
        raise SceneError(f"{_named(source)} holds no triangles: there is nothing to light")
    corners = np.concatenate([mesh.bounds for mesh in meshes])
    if not np.isfinite(corners).all():
        raise SceneError(f"{_named(source)} has positions that are not finite: repair it first")
    low, high = corners.min(axis=0), corners.max(axis=0)
    scene = {"type": "scene", "camera": Camera.looking_at(low, high, look.up).to_mitsuba()}
    for number, mesh in enumerate(meshes):
        flat = look.normals == "flat" or not has_file_normals
        scene[f"mesh_{number + 1}"] = _shape(mesh, flat, look.grey)
    if look.floor == "on":
        scene["floor"] = _floor(low, high, _UP[look.up])
    return scene


def _look_of(parameters):
    known = (*CHOICES, "grey")
    for name, value in parameters.items():
        if name not in known:
            raise SceneError(
                f"a mesh has no parameter '{name}': use {', '.join(known)} (-D {known[0]}=on)"
            )
        if name in CHOICES and value not in CHOICES[name]:
            raise SceneError(f"-D {name} must be {' or '.join(CHOICES[name])}, got '{value}'")
    try:
        grey = float(parameters.get("grey", GREY))
    except ValueError:
        grey = np.nan
    if not 0 <= grey <= 1:
        raise SceneError(f"-D grey must be a reflectance from 0 to 1, got '{parameters['grey']}'")
    return _Look(**(parameters | {"grey": grey}))


def _named(source):
    return f"mesh '{source}'" if isinstance(source, Path) else "the trimesh object"


def _meshes(source):
    """Trimeshes in world space, and whether their normals are of use."""
    import trimesh

    if not isinstance(source, Path):
        scene = source if hasattr(source, "dump") else trimesh.Scene(source)
        return _triangles(scene), True
    try:
        scene = trimesh.load_scene(source, process=False)
    except Exception as error:  # trimesh and what it calls raise of all kinds
        words = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"mesh '{source}' cannot be read: {words}") from None
    meshes = _triangles(scene)
    is_soup = source.suffix.lower() == ".stl"  # it knows neither shared vertices nor normals
    if is_soup:
        for mesh in meshes:
            mesh.merge_vertices()
    return meshes, not is_soup


def _triangles(scene) -> list[Any]:
    return [mesh for mesh in scene.dump() if len(getattr(mesh, "faces", ()))]


def _shape(mesh, flat, grey):
    """A mi.Mesh of a Trimesh."""
    mi = mitsuba()
    normals = None if flat else _file_normals(mesh)
    uv, reflectance, colours = _appearance(mesh, grey)
    properties = mi.Properties()
    properties["face_normals"] = flat
    material = {"type": "twosided", "material": {"type": "diffuse", "reflectance": reflectance}}
    properties["bsdf"] = mi.load_dict(material)
    shape = mi.Mesh(
        "mesh",
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=not flat,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    for name, values in colours.items():
        shape.add_attribute(name, 3, values.ravel())
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(mesh.vertices).astype(np.float32)
    parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    if normals is not None:
        parameters["vertex_normals"] = np.ravel(normals).astype(np.float32)
    if uv is not None:
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    if normals is None and not flat:
        shape.recompute_vertex_normals()
    return shape


def _file_normals(mesh):
    """Vertex normals (v, 3) that a file gave, or None: trimesh makes others where it is asked."""
    given = "vertex_normals" in mesh._cache.cache
    return mesh.vertex_normals if given else None


def _appearance(mesh, grey):
    """Texture coordinates or None, the plugin dict of a reflectance, and attributes by name."""
    visual = mesh.visual
    plain = {"type": "rgb", "value": [grey] * 3}
    if visual.kind in ("vertex", "face"):
        name = f"{visual.kind}_color"
        values = np.asarray(getattr(visual, f"{visual.kind}_colors"))[:, :3]
        return None, {"type": "mesh_attribute", "name": name}, {name: _linear(values)}
    material = getattr(visual, "material", None)
    if material is None:
        return None, plain, {}
    uv = getattr(visual, "uv", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and uv is not None and len(uv) == len(mesh.vertices):
        pixels = np.array(image.convert("RGB"))  # Mitsuba refuses read-only arrays
        bitmap = {"type": "bitmap", "bitmap": mitsuba().Bitmap(pixels)}
        return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1), bitmap, {}  # Mitsuba's v goes down
    colour = np.asarray(getattr(material, "main_color", [255 * grey] * 3))[:3]
    return None, {"type": "rgb", "value": _linear(colour).tolist()}, {}


def _linear(colours):
    """Linear float32 of sRGB in 8 bits."""
    x = np.asarray(colours, np.float32) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _floor(low, high, axis):
    """A square under a box, facing up."""
    transform = mitsuba().ScalarTransform4f
    middle = (low + high) / 2
    middle[axis] = low[axis]
    to_world = transform().translate(middle.tolist())
    if axis == _UP["y"]:
        to_world = to_world @ transform().rotate([1, 0, 0], -90)
    half = FLOOR_SIZE * float(np.linalg.norm(high - low)) / 2
    material = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [GREY] * 3}}
    return {
        "type": "rectangle",
        "to_world": to_world @ transform().scale(half),
        "bsdf": {"type": "twosided", "material": material},
    }
