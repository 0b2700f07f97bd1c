"""Light of any kind, distant and local: what counts as light, and sums of it."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import LightError
from .environment import EnvironmentMap, rotation_matrix


KINDS = "an environment map (a path, an array (h, w, 3), a mi.Bitmap or EnvironmentMap), a DirectionalLight, PointLight or Light"


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Light from a single direction.

    Parameters
    ----------
    direction : (3,) array
        Direction in which the light travels (Mitsuba's `direction`), any positive length.
    irradiance : (3,) array or float
        Irradiance on a surface that faces the light, RGB in W/m²; one number is grey.

    Raises
    ------
    LightError
        If a value is not finite, the direction is zero or the irradiance negative.
    """

    direction: np.ndarray
    irradiance: np.ndarray

    def __post_init__(self):
        direction = _numbers(self.direction)
        length = np.linalg.norm(direction) if direction.shape == (3,) else 0.0
        if not (np.isfinite(length) and length > 0):
            raise LightError(f"a light's direction must be three numbers and not zero, got {self.direction}")
        object.__setattr__(self, "direction", direction / length)
        object.__setattr__(self, "irradiance", _rgb("irradiance", self.irradiance))

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed."""
        return DirectionalLight(rotation_matrix(axis, degrees) @ self.direction, self.irradiance)


@dataclass(frozen=True, eq=False)
class PointLight:
    """Light from a single place, equal in all directions (Mitsuba's `point`).

    Parameters
    ----------
    position : (3,) array
        World space, m.
    intensity : (3,) array or float
        RGB in W/sr; one number is grey. A surface that faces the light at a distance of r metres receives
        intensity/r² W/m².

    Raises
    ------
    LightError
        If a value is not finite or the intensity negative.
    """

    position: np.ndarray
    intensity: np.ndarray

    def __post_init__(self):
        position = _numbers(self.position)
        if position.shape != (3,) or not _is_finite(position):
            raise LightError(f"a light's position must be three finite float32 numbers, got {self.position}")
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "intensity", _rgb("intensity", self.intensity))


@dataclass(frozen=True, eq=False)
class Light:
    """The sum of any number of environment maps, directional lights and point lights.

    Parameters
    ----------
    maps : tuple of EnvironmentMap
    directionals : tuple of DirectionalLight
    point_lights : tuple of PointLight
    """

    maps: tuple = field(default=())
    directionals: tuple = field(default=())
    point_lights: tuple = field(default=())

    @property
    def distant(self):
        """The same without its local lights."""
        return replace(self, point_lights=())

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed.

        Distant light turns; local lights stay where they are.
        """
        return replace(
            self,
            maps=tuple(m.rotated(axis, degrees) for m in self.maps),
            directionals=tuple(d.rotated(axis, degrees) for d in self.directionals),
        )


def as_light(light):
    """What the user passed as light, as one Light.

    Parameters
    ----------
    light : Light, EnvironmentMap, DirectionalLight, PointLight, path, (h, w, 3) array, mi.Bitmap, or list or tuple of these
        A list is the sum of its entries, which may be lists themselves.

    Raises
    ------
    LightError
        If it is none of these, the list is empty, or see EnvironmentMap.
    """
    if isinstance(light, Light):
        return light
    if isinstance(light, DirectionalLight):
        return Light(directionals=(light,))
    if isinstance(light, PointLight):
        return Light(point_lights=(light,))
    if isinstance(light, EnvironmentMap):
        return Light(maps=(light,))
    if isinstance(light, str | Path | np.ndarray) or type(light).__module__.startswith("mitsuba"):
        return Light(maps=(EnvironmentMap(light),))
    if not isinstance(light, list | tuple):
        raise LightError(f"light must be {KINDS}, or a list of these, got {light!r}")
    if not light:
        raise LightError("the list of lights is empty: pass one light at least")
    parts = [as_light(part) for part in light]
    return Light(*(sum((getattr(part, kind) for part in parts), ()) for kind in ("maps", "directionals", "point_lights")))


def _rgb(what, value):
    """One number or three as (3,) float64, finite and not negative."""
    rgb = _numbers(value)
    if rgb.shape not in ((), (3,)) or not _is_finite(rgb) or (rgb < 0).any():
        raise LightError(f"a light's {what} must be one or three finite float32 numbers ≥ 0, got {value}")
    return np.broadcast_to(rgb, 3).copy()


def _is_finite(values):
    """Whether float32, which Mitsuba computes in, holds all of them."""
    with np.errstate(over="ignore"):
        return np.isfinite(values.astype(np.float32)).all()


def _numbers(value):
    """As float64; an array of no entries if it is none."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
