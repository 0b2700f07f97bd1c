"""The tie between an asset and the scene it came from."""

import os
import stat
import warnings
from collections import Counter
from pathlib import Path

from ..errors import SceneError
from ..lighting.environment import LightWarning
from ..scene.scene import Scene, open_scene

REPAINTED = (
    "the scene's materials changed since it was precomputed: light that they reflect onto other"
    " surfaces is still that of the old ones"
)


def describe_scene(scene, points, transports):
    """What an asset records of its scene: kind, path, is_relative (whether files keep the path
    relative to themselves), parameters, hash, appearance, left_out (which see).
    """
    source = scene.source
    return {
        "kind": source.kind,
        "path": source.path,
        "is_relative": source.is_relative,
        "parameters": source.parameters,
        "hash": scene.hash,
        "appearance": scene.appearance,
        "left_out": left_out(scene, points, transports),
    }


def emitter_records(scene):
    """What an asset records of a scene's emitters: name, kind, distant (a list of dict)."""
    return [
        {"name": own.name, "kind": own.kind, "distant": own.is_distant} for own in scene.own_lights
    ]


def left_out(scene, points, transports):
    """What of a scene an asset does not model, in words, one entry for each kind.

    Parameters
    ----------
    scene : Scene
    points : Points
    transports : collection of str
        Kinds of transport that the asset has.

    Returns
    -------
    list of dict
        what, shapes (names), share (part of the light at 45° that those materials scatter beyond
        their models, below 0 where they scatter less; None where it cannot be found out).
    """
    by_material = {}
    for surface in scene.surfaces:
        for what in surface.material.left_out:
            by_material.setdefault((surface.material, what), []).append(surface.name)
    entries = [
        {"what": what, "shapes": names, "share": round(material.left_out_albedo(), 3)}
        for (material, what), names in by_material.items()
    ]
    for surface in points.surfaces:
        if surface.get("patches") == 0:
            what = f"{surface['kind']}: blocks light but reflects none"
            entries.append({"what": what, "shapes": [surface["name"]], "share": None})
    for surface in scene.surfaces:
        if surface.shape.interior_medium() or surface.shape.exterior_medium():
            what = "participating medium"
            entries.append({"what": what, "shapes": [surface.name], "share": None})
    return entries + _lights_left_out(scene, transports)


def _lights_left_out(scene, transports):
    counts = Counter()
    held = {True: "distant" in transports, False: "own" in transports or "local" in transports}
    for emitters, distant in ((scene.distant_emitters, True), (scene.local_emitters, False)):
        if not held[distant]:
            where = "distant" if distant else "local"
            counts.update((emitter.class_name(), where) for emitter in emitters)
    return [
        {"what": f"{kind}: light of {count} {where} emitters", "shapes": [], "share": None}
        for (kind, where), count in counts.items()
    ]


def open_scene_of(asset, scene=None, parameters=None):
    """The scene that an asset came from, checked to be the same.

    Parameters
    ----------
    asset : Asset
    scene : path, dict or mi.Scene, optional
        Where it is now; by default where it was.
    parameters : dict, optional
        Values for `<default>` parameters; by default those it was precomputed with.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the scene is not there any more, was given in memory, or its geometry changed.

    Warns
    -----
    LightWarning
        If reflected light is that of other materials.
    """
    recorded = asset.scene
    if scene is None:
        if recorded["kind"] != "file":
            raise SceneError(
                f"the asset came from a scene {recorded['kind']} in memory: pass the scene"
                " (--scene)"
            )
        scene = _checked_place(recorded["path"])
    opened = open_scene(scene, recorded["parameters"] if parameters is None else parameters)
    if opened.hash != recorded["hash"]:
        name = opened.source.path or f"the scene {opened.source.kind}"
        raise SceneError(
            f"'{name}' is not the scene of the asset: its geometry or sidedness changed since it"
            " was precomputed; precompute it again, or pass the right one (--scene)"
        )
    if asset.reflects and opened.appearance != recorded["appearance"]:
        warnings.warn(REPAINTED, LightWarning, stacklevel=2)
    return opened


def scene_is_open(scene):
    """Whether this is a Scene, and not what one could be opened from."""
    return isinstance(scene, Scene)


def path_in_file(recorded, asset):
    """How a file keeps the path of the scene that is recorded (dict): from its own folder on where
    it was given relative, so that both can be moved together.

    Parameters
    ----------
    recorded : dict
        See `describe_scene`.
    asset : path
        The file.
    """
    path = recorded["path"]
    if path is None or not recorded["is_relative"]:
        return path
    try:
        relative = os.path.relpath(path, Path(asset).absolute().parent)
    except ValueError:  # on another drive
        return path
    return Path(relative).as_posix()


def path_from_file(path, asset):
    """The absolute path of what `path_in_file` gave. No file is touched."""
    if path is None or path.startswith(_NETWORK) or os.path.isabs(path):
        return path
    return os.path.normpath(os.path.join(Path(asset).absolute().parent, path))


_NETWORK = ("//", "\\\\")
_SYSTEM = ("/dev/", "/proc/", "/sys/")  # files there may have no end, or act when they are read


def _checked_place(path):
    """A recorded path, if it leads to a regular file of this machine; else SceneError."""
    shown = ascii(path)[1:-1][:200]
    if path.startswith(_NETWORK):
        raise SceneError(
            f"the asset's scene '{shown}' is no file of this machine: pass it (--scene)"
        )
    try:
        mode = os.stat(path).st_mode
        is_file = stat.S_ISREG(mode) and not os.path.realpath(path).startswith(_SYSTEM)
    except (OSError, ValueError):  # names that no file can have
        raise SceneError(
            f"the asset's scene '{shown}' is not there any more: pass its new path (--scene)"
        ) from None
    if not is_file:
        raise SceneError(
            f"the asset's scene '{shown}' is no regular file: pass the scene (--scene)"
        )
    return path
