"""Point light: one place that shines alike in all directions."""

from dataclasses import dataclass, replace

import numpy as np

from .emission import Emission
from .part import LIGHTS, LocalPart
from .values import fields_from_text, rgb, rgb_factor, rgb_spectrum, vector


@LIGHTS.register
@dataclass(frozen=True, eq=False)
class PointLight(LocalPart):
    """Light from a single place, equal in all directions (Mitsuba's `point`).

    Parameters
    ----------
    position : (3,) array
        World space, m.
    intensity : (3,) array or float
        RGB in W/sr; one number is grey. A surface that faces the light at a distance of r metres
        receives intensity/r² W/m².

    Raises
    ------
    LightError
        If a value is not finite or the intensity negative.
    """

    position: np.ndarray
    intensity: np.ndarray

    kind = "point"
    FORM = "point:x,y,z:r,g,b (intensity in W/sr)"
    is_movable = True

    def __post_init__(self):
        object.__setattr__(self, "position", vector("position", self.position))
        object.__setattr__(self, "intensity", rgb("intensity", self.intensity))

    @classmethod
    def parse(cls, text):
        """See `LightPart.parse`."""
        return cls(*fields_from_text(text, vectors=1))

    def emission(self):
        """See `LocalPart.emission`."""
        return Emission(
            self.position[None], [[0, 0, 1]], self.intensity[None], [0], [np.pi], [np.pi]
        )

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(self, intensity=self.intensity * rgb_factor(factor))

    def moved(self, position):
        """See `LocalPart.moved`."""
        return replace(self, position=position)

    def to_mitsuba(self):
        """See `LightPart.to_mitsuba`."""
        return {
            "type": "point",
            "position": [float(x) for x in self.position],
            "intensity": rgb_spectrum(self.intensity),
        }
