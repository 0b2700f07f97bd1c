"""A Mitsuba scene under light of this program."""

from ..scene.rebuild import kept_parts, rebuilt_scene
from ..scene.scene import open_scene
from .from_mitsuba import known_part
from .light import Light
from .own_light import resolve
from .summed import summed_maps


def lit_scene(scene, light=None, modelled=False):
    """A scene's shapes and sensors as a new mi.Scene under some light, with watertight
    intersections.

    An area light becomes a rectangle that reflects nothing. It is a shape like others then: it
    blocks light, which the area light of this program does not, and is seen in pictures.

    Parameters
    ----------
    scene : Scene, or what `open_scene` accepts
    light : what `resolve` accepts, optional
        All that shines: the scene's own lights are in it where they are named or 'scene' is, and
        dark otherwise. By default the scene's own light, if it has any.
    modelled : bool
        Whether materials are those that transport stands for.

    Returns
    -------
    mi.Scene

    Raises
    ------
    LightError
        If a part has no emitter in Mitsuba (an Emission), or a lamp cannot be dimmed.
    SceneError
        If the scene was given as Mitsuba objects and would have to be changed, see `Scene.relit`.

    Notes
    -----
    A distant emitter of the scene that the light holds just as it is written stays the very same
    object: its light does not pass through this program's maps. Mitsuba takes one environment map,
    so several become one, see `summed_maps`.
    """
    scene = open_scene(scene)
    distant = {own.name: own for own in scene.own_lights if own.is_distant}
    if light is None:
        lamps = {own.name: 1 for own in scene.own_lights if not own.is_distant}
        parts = kept_parts(scene, lamps, modelled, distant)
        return rebuilt_scene(parts)
    light = resolve(light, scene)
    factors, parts = {}, []
    for part in light.parts:
        if part.own_name is None:
            parts.append(part)
        else:
            factors[part.own_name] = factors.get(part.own_name, 0) + part.factor
    as_written, parts = _as_written(distant, parts)
    return rebuilt_scene(kept_parts(scene, factors, modelled, as_written), _emitters(Light(parts)))


def _as_written(distant, parts):
    """Names of own distant lights that are among some parts as they are written, and the parts
    without these.
    """
    found = {}
    for name, own in distant.items():
        part = known_part(own)
        if part is not None and any(part is x for x in parts):
            found[name] = part
    environments = sum(part.is_environment for part in parts)
    if environments > 1:  # Mitsuba takes one: they are summed
        found = {name: part for name, part in found.items() if not part.is_environment}
    others = list(parts)
    for part in found.values():
        others.pop(next(i for i, x in enumerate(others) if x is part))
    return set(found), others


def _emitters(light):
    """Mitsuba plugin dicts of a Light by name."""
    emitters = {}
    environments = [part for part in light.parts if part.is_environment]
    if environments:
        one = environments[0] if len(environments) == 1 else summed_maps(environments)
        emitters["environment"] = one.to_mitsuba()
    others = (part for part in light.parts if not part.is_environment)
    return emitters | {f"{part.kind}{i}": part.to_mitsuba() for i, part in enumerate(others)}
