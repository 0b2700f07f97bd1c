"""Scenes put together anew from the objects of others: other materials, other lamps."""

import numpy as np

from ..errors import LightError, SceneError
from ..system.runtime import mitsuba
from .own_lights import darken, dim, is_dark
from .traversal import children


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


def kept_parts(scene, factors, modelled, distant):
    """Shapes, sensors and emitters of a scene with its lamps dimmed.

    Parameters
    ----------
    scene : Scene
    factors : dict
        Of local lights by name, numbers or RGB; those that are not there are dark.
    modelled : bool
        Whether materials are the modelled ones.
    distant : collection of str
        Names of the distant lights that stay.

    Returns
    -------
    list of mi.Object
        Those of the scene itself where they need no change.

    Raises
    ------
    LightError, SceneError
        See `Scene.relit`.
    """
    factors = _checked(scene, factors)
    lamps = [own for own in scene.own_lights if not own.is_distant]
    absent = [own for own in lamps if not factors[own.name].any()]
    dark = [own for own in absent if own.shape is not None and not is_dark(own.emitter)]
    dimmed = [own for own in lamps if own not in absent and (factors[own.name] != 1).any()]
    replaced = [i for i, s in enumerate(scene.surfaces) if modelled and s.material.left_out]
    gone = [own.name for own in absent if own.shape is None]
    gone += [own.name for own in scene.own_lights if own.is_distant and own.name not in distant]
    source = scene
    if dark or dimmed or replaced:
        source = scene.copy()
        now = {own.name: own for own in source.own_lights}
        for i in replaced:
            source.surfaces[i].shape.set_bsdf(source.surfaces[i].material.modelled)
        for own in dark:
            darken(now[own.name].emitter)
        for own in dimmed:
            dim(now[own.name].emitter, factors[own.name], own.name)
    return _listed(scene, source, gone)


def _listed(scene, source, gone):
    """Shapes, sensors and emitters of a copy of a scene, without emitters of some names. Distant
    emitters are those of the scene itself.
    """
    mi = mitsuba()
    written = {own.name: own.emitter for own in scene.own_lights if own.is_distant}
    named = {own.emitter: own.name for own in source.own_lights if own.shape is None}
    parts = []
    for _, child in children(source.mi_scene):
        if isinstance(child, mi.Emitter):
            name = named[child]
            if name not in gone:
                parts.append(written.get(name, child))
        elif isinstance(child, mi.Shape | mi.Sensor):
            parts.append(child)
    return parts


def _checked(scene, factors):
    """RGB (3,) of every local light by name."""
    known = [own.name for own in scene.own_lights if not own.is_distant]
    unknown = [name for name in factors if name not in known]
    if unknown:
        raise LightError(
            f"the scene has no lamp '{unknown[0]}'; it has {', '.join(known) or 'none'}"
        )
    found = {name: np.zeros(3) for name in known}
    for name, factor in factors.items():
        factor = np.broadcast_to(np.asarray(factor, np.float64), 3)
        if not (np.isfinite(factor).all() and (factor >= 0).all()):
            raise LightError(f"a lamp's factor must be finite and ≥ 0, got {factor} for '{name}'")
        found[name] = factor
    return found


def check_can_be_copied(scene, holds_objects):
    """Raise a SceneError if a scene cannot be opened again."""
    if scene.source.kind == "object" or holds_objects:
        raise SceneError(
            "a scene given as Mitsuba objects cannot be rebuilt with diffuse materials, or with"
            " other lamps: pass its path or dict, or compare with reference 'full' and the lamps as"
            " they are"
        )
