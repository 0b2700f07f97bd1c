"""The tie between an asset and the scene it came from."""

import warnings
from pathlib import Path

from ..errors import SceneError
from ..lighting.environment import LightWarning
from ..points.tessellate import TESSELLATED_SHAPES
from ..scene.scene import open_scene


def describe_scene(scene, local_lights=False):
    """What an asset records of its scene: kind, path, parameters, hash, appearance, left_out (which
    see).
    """
    source = scene.source
    return {
        "kind": source.kind,
        "path": source.path,
        "parameters": source.parameters,
        "hash": scene.hash,
        "appearance": scene.appearance,
        "left_out": left_out(scene, local_lights),
    }


def left_out(scene, local_lights=False):
    """What of a scene the transport does not model, in words, one entry for each kind.

    Parameters
    ----------
    scene : Scene
    local_lights : bool
        Whether the transport is that of local lights, at samples on any shape, or that of distant
        light, at vertices.

    Returns
    -------
    list of dict
        what, shapes (names), share (part of the light at 45° that those materials scatter in the
        way that is left out; None where it cannot be told).
    """
    by_material = {}
    for surface in scene.surfaces:
        for what in surface.material.left_out:
            by_material.setdefault((surface.material, what), []).append(surface.name)
    entries = [
        {"what": what, "shapes": names, "share": round(material.left_out_albedo(), 3)}
        for (material, what), names in by_material.items()
    ]
    for surface in scene.surfaces:
        if surface.kind not in TESSELLATED_SHAPES and not local_lights:
            what = f"{surface.kind}: blocks light but reflects none"
            entries.append({"what": what, "shapes": [surface.name], "share": None})
        if surface.shape.interior_medium() or surface.shape.exterior_medium():
            entries.append(
                {"what": "participating medium", "shapes": [surface.name], "share": None}
            )
    lamps = {}
    for emitter in scene.distant_emitters if local_lights else scene.local_emitters:
        lamps[emitter.class_name()] = lamps.get(emitter.class_name(), 0) + 1
    where = "distant" if local_lights else "local"
    for kind, count in lamps.items():
        entries.append(
            {"what": f"{kind}: light of {count} {where} emitters", "shapes": [], "share": None}
        )
    return entries


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
        if not Path(recorded["path"]).is_file():
            raise SceneError(
                f"the asset's scene '{recorded['path']}' is not there any more: pass its new path"
                " (--scene)"
            )
        scene = recorded["path"]
    opened = open_scene(scene, recorded["parameters"] if parameters is None else parameters)
    if opened.hash != recorded["hash"]:
        name = opened.source.path or f"the scene {opened.source.kind}"
        raise SceneError(
            f"'{name}' is not the scene of the asset: its geometry or sidedness changed since it"
            " was precomputed; precompute it again, or pass the right one (--scene)"
        )
    if asset.report["bounces"] and opened.appearance != recorded["appearance"]:
        warnings.warn(
            "the scene's materials changed since it was precomputed: light that they reflect onto"
            " other surfaces is still that of the old ones",
            LightWarning,
            stacklevel=2,
        )
    return opened
