"""Distant light of any kind: a sum of environment maps and directional lights, and what counts as one."""

from dataclasses import dataclass, field

import numpy as np

from ..errors import LightError
from .environment import EnvironmentMap, rotation_matrix


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Light from a single direction.

    Parameters
    ----------
    direction : (3,) array
        Direction in which the light travels (Mitsuba's `direction`), any positive length.
    irradiance : (3,) array
        Irradiance on a surface that faces the light, RGB in W/m².

    Raises
    ------
    LightError
        If a value is not finite, the direction is zero or the irradiance negative.
    """

    direction: np.ndarray
    irradiance: np.ndarray

    def __post_init__(self):
        direction = np.asarray(self.direction, dtype=np.float64)
        irradiance = np.asarray(self.irradiance, dtype=np.float64)
        length = np.linalg.norm(direction) if direction.shape == (3,) else 0.0
        if not (np.isfinite(length) and length > 0):
            raise LightError(f"a light's direction must be three numbers and not zero, got {self.direction}")
        if irradiance.shape != (3,) or not np.isfinite(irradiance).all() or (irradiance < 0).any():
            raise LightError(f"a light's irradiance must be three finite numbers ≥ 0, got {self.irradiance}")
        object.__setattr__(self, "direction", direction / length)
        object.__setattr__(self, "irradiance", irradiance)

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed."""
        return DirectionalLight(rotation_matrix(axis, degrees) @ self.direction, self.irradiance)


@dataclass(frozen=True, eq=False)
class DistantLight:
    """The sum of any number of environment maps and directional lights.

    Parameters
    ----------
    maps : tuple of EnvironmentMap
    directionals : tuple of DirectionalLight
    """

    maps: tuple = field(default=())
    directionals: tuple = field(default=())

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed."""
        return DistantLight(
            tuple(m.rotated(axis, degrees) for m in self.maps),
            tuple(d.rotated(axis, degrees) for d in self.directionals),
        )


def as_light(light):
    """What the user passed as light, as a DistantLight.

    Parameters
    ----------
    light : DistantLight, EnvironmentMap, DirectionalLight, path, (h, w, 3) array or mi.Bitmap

    Raises
    ------
    LightError
        If it is none of these, or see EnvironmentMap.
    """
    if isinstance(light, DistantLight):
        return light
    if isinstance(light, DirectionalLight):
        return DistantLight(directionals=(light,))
    if isinstance(light, EnvironmentMap):
        return DistantLight(maps=(light,))
    return DistantLight(maps=(EnvironmentMap(light),))
