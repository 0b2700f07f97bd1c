"""A scene's own lights: their names, and what of them may change."""

import hashlib
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import LightError
from ..system.runtime import mitsuba
from .traversal import digest_of

# Of an emitter's parameters: what its light is proportional to.
_STRENGTHS = ("radiance", "intensity", "irradiance")
_LINEAR = ("value", "data", "scale")  # last words of what scales with light, see `dim`
_MADE_UP = re.compile(r"(object|_unnamed)_\d+|")
_UNNAMED_EMITTER = "emitter"  # of a shape in a dict


@dataclass(frozen=True, eq=False)
class OwnLight:
    """One emitter of a scene.

    Parameters
    ----------
    name : str
        Unique in the scene, see `Scene.own_lights`.
    emitter : mi.Emitter
    shape : mi.Shape or None
        The shape that shines.
    is_distant : bool
    """

    name: str
    emitter: Any
    shape: Any
    is_distant: bool

    @property
    def kind(self):
        """Mitsuba's class name: AreaLight, PointLight, …"""
        return self.emitter.class_name()

    @property
    def strength(self):
        """RGB (3,) that its light is proportional to; None where no such number says it all, as
        that of a textured emitter.
        """
        key = self._strength_key()
        if key is None:
            return None
        values = np.array(mitsuba().traverse(self.emitter)[key], dtype=np.float64).ravel()
        return np.broadcast_to(values, 3).copy()

    def digest(self):
        """SHA-256 of all but its strength: kind, place, shape, texture. While it stays the same,
        the light changes by `strength` alone.
        """
        strength = self._strength_key()
        kept = digest_of([self.emitter], lambda key: key not in ("sampling_weight", strength))
        if self.shape is not None:
            kept += digest_of([self.shape], lambda key: "." not in key)
        return hashlib.sha256(kept.encode()).hexdigest()

    def _strength_key(self):
        """The parameter that holds its strength; None if there is none or it is a texture."""
        parameters = mitsuba().traverse(self.emitter)
        keys = _keys(parameters, _STRENGTHS)
        if len(keys) != 1 or keys[0].split(".")[-1] not in ("value", "scale"):
            return None
        return keys[0] if np.size(np.array(parameters[keys[0]])) in (1, 3) else None


def list_own_lights(mi_scene):
    """The emitters of an mi.Scene as OwnLights, see `Scene.own_lights`."""
    mi = mitsuba()
    found, counts, taken = [], Counter(), Counter()
    for emitter in mi_scene.emitters():
        is_distant = bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite))
        counts[is_distant] += 1
        shape = emitter.get_shape()
        name = _given_name(emitter, shape)
        name = name or f"{'sky' if is_distant else 'lamp'}_{counts[is_distant]}"
        while True:
            taken[name] += 1
            if taken[name] == 1:
                break
            name = f"{name}#{taken[name]}"
        found.append(OwnLight(name, emitter, shape, is_distant))
    return tuple(found)


def _given_name(emitter, shape):
    """The id that the scene's author gave; None if there is none."""
    if shape is None:
        return None if is_made_up(emitter.id()) else emitter.id()
    ids = [shape.id()] + [emitter.id()] * (emitter.id() != _UNNAMED_EMITTER)
    return next((name for name in ids if not is_made_up(name)), None)


def is_made_up(name):
    """Whether an id is one that Mitsuba made up: it may hold an address, which changes at each
    run.
    """
    return _MADE_UP.fullmatch(name) is not None


def is_dark(emitter):
    """Whether an emitter sends no light."""
    parameters = mitsuba().traverse(emitter)
    return not any(np.any(np.array(parameters[key])) for key in _keys(parameters, _STRENGTHS))


def darken(emitter):
    """Set an emitter's light to zero, and how often it is sampled."""
    parameters = mitsuba().traverse(emitter)
    for key in _keys(parameters, (*_STRENGTHS, "sampling_weight")):
        parameters[key] = parameters[key] * 0
    parameters.update()


def dim(emitter, factor, name):
    """Scale an emitter's light by an RGB factor, in place.

    Parameters
    ----------
    emitter : mi.Emitter
    factor : (3,) array
    name : str
        The light's, for errors.

    Raises
    ------
    LightError
        If its spectrum does not scale by RGB.
    """
    mi = mitsuba()
    parameters = mi.traverse(emitter)
    keys = _keys(parameters, _STRENGTHS)
    if not keys or any(key.split(".")[-1] not in _LINEAR for key in keys):
        raise LightError(
            f"the {emitter.class_name()} '{name}' cannot be dimmed, its light is given by"
            f" {', '.join(keys) or 'no number'}: write it as rgb or a bitmap in the scene"
        )
    grey = (factor == factor[0]).all()
    for key in keys:
        value = parameters[key]
        if grey:
            parameters[key] = value * float(factor[0])
        elif isinstance(value, mi.Color3f):
            parameters[key] = value * mi.Color3f(*map(float, factor))
        elif isinstance(value, mi.TensorXf):
            parameters[key] = mi.TensorXf(np.array(value) * factor.astype(np.float32))
        else:
            raise LightError(
                f"the {emitter.class_name()} '{name}' is grey ({key} is one number) and cannot be"
                f" dimmed by the colour {factor}: use one number as factor, or write its light as"
                " rgb in the scene"
            )
    parameters.update()


def _keys(parameters, kinds):
    # it iterates over pairs
    return [key for key in parameters.keys() if key.split(".")[0] in kinds and "to_uv" not in key]
