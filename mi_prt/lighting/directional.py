"""Directional light: parallel rays from one direction."""

from dataclasses import dataclass, replace

import numpy as np

from .average import put
from .part import LIGHTS, DistantPart
from .rotation import rotation_matrix
from .values import direction, fields_from_text, rgb, rgb_factor, rgb_spectrum


@LIGHTS.register
@dataclass(frozen=True, eq=False)
class DirectionalLight(DistantPart):
    """Light from a single direction (Mitsuba's `directional`).

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

    kind = "directional"
    FORM = "directional:dx,dy,dz:r,g,b (direction of travel, irradiance in W/m²)"

    def __post_init__(self):
        object.__setattr__(self, "direction", direction(self.direction))
        object.__setattr__(self, "irradiance", rgb("irradiance", self.irradiance))

    @classmethod
    def parse(cls, text):
        """See `LightPart.parse`."""
        return cls(*fields_from_text(text, vectors=1))

    def radiance(self, directions, samples_per_side):
        """Its irradiance in the cells around its direction, see `put`."""
        found = put(directions, -self.direction[None], self.irradiance[None])
        return found / directions.solid_angles[:, None]

    def rotated(self, axis, degrees):
        """See `LightPart.rotated`."""
        return replace(self, direction=rotation_matrix(axis, degrees) @ self.direction)

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(self, irradiance=self.irradiance * rgb_factor(factor))

    def to_mitsuba(self):
        """See `LightPart.to_mitsuba`."""
        return {
            "type": "directional",
            "direction": [float(x) for x in self.direction],
            "irradiance": rgb_spectrum(self.irradiance),
        }
