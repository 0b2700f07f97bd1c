"""Distant light of Mitsuba's emitters as this program's; local light is in `local_emitters`."""

from weakref import WeakKeyDictionary

import numpy as np

from ..errors import LightError
from ..scene.traversal import digest_of, transform_of
from ..system.runtime import mitsuba
from .directional import DirectionalLight
from .environment import EnvironmentMap
from .light import Light
from .sky import baked, evaluate, origin, rgb_of

_known = WeakKeyDictionary()  # of an OwnLight: digest of its parameters, and the part that it is


def scene_light(scene):
    """All distant light of a scene: `envmap`, `constant`, `sunsky`, `directional`, and any other
    distant emitter.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Light

    Raises
    ------
    LightError
        If the scene has no distant emitter, or one holds NaN, infinite or negative radiance.
    """
    distant = [own for own in scene.own_lights if own.is_distant]
    if not distant:
        raise LightError(
            "the scene has no distant light (envmap, constant, sunsky, directional): pass a light"
            " (--envmap sky.exr, or --light)"
        )
    return Light(tuple(map(distant_part, distant)))


def distant_part(own):
    """A scene's own distant emitter (OwnLight) as a part of light.

    Returns
    -------
    LightPart
        The same object each time, as long as the emitter is not edited.

    Raises
    ------
    LightError
        See `scene_light`.
    """
    part = known_part(own)
    if part is None:
        part = _part_of(own.emitter)
        _known[own] = digest_of([own.emitter]), part
    return part


def known_part(own):
    """What `distant_part` returned for an emitter as it is now; None if it did not."""
    digest, part = _known.get(own, (None, None))
    return part if part is not None and digest == digest_of([own.emitter]) else None


def _part_of(emitter):
    return _CONVERSIONS.get(emitter.class_name(), baked)(emitter)


def _constant(emitter):
    radiance = evaluate(emitter, np.array([[0.0, 1.0, 0.0]]))
    return EnvironmentMap(np.broadcast_to(radiance, (2, 4, 3)))


def _directional(emitter):
    it = origin(1)
    sample, irradiance = emitter.sample_direction(it, mitsuba().Point2f(0.5))
    return DirectionalLight(-np.array(sample.d).reshape(-1, 3)[0], rgb_of(irradiance)[0])


def _environment_map(emitter):
    mi = mitsuba()
    parameters = mi.traverse(emitter)
    data = np.array(parameters["data"])
    # Mitsuba pads the rows with a column at either end, for wrapping round.
    return EnvironmentMap(
        data[:, 1:-1, :3],
        transform_of(emitter)[:3, :3],
        scale=float(np.array(parameters["scale"]).ravel()[0]),
    )


_CONVERSIONS = {
    "DirectionalEmitter": _directional,
    "EnvironmentMapEmitter": _environment_map,
    "ConstantBackgroundEmitter": _constant,
}
