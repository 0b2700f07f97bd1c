"""Spot light: one place that shines into a cone."""

from dataclasses import dataclass, replace

import numpy as np

from ..errors import LightError
from ..system.runtime import mitsuba
from .emission import Emission
from .part import LIGHTS, LocalPart
from .values import direction, fields_from_text, numbers, rgb, rgb_factor, rgb_spectrum, vector


@LIGHTS.register
@dataclass(frozen=True, eq=False)
class SpotLight(LocalPart):
    """Light from a single place into a cone (Mitsuba's `spot`).

    Within the beam it has its full intensity, which falls to zero from there to the cutoff,
    linearly in the angle.

    Parameters
    ----------
    position : (3,) array
        World space, m.
    direction : (3,) array
        The axis, in which the light travels; any positive length.
    intensity : (3,) array or float
        RGB in W/sr along the axis; one number is grey.
    cutoff_degrees : float, default 20
        Angle to the axis beyond which it is dark; above 0, at most 90.
    beam_degrees : float, optional
        Angle to the axis up to which the intensity is full, 0 to the cutoff; by default ¾ of the
        cutoff, as in Mitsuba.

    Raises
    ------
    LightError
        If a value is not finite, the direction zero, the intensity negative, or an angle out of its
        range.
    """

    position: np.ndarray
    direction: np.ndarray
    intensity: np.ndarray
    cutoff_degrees: float = 20.0
    beam_degrees: float | None = None

    kind = "spot"
    FORM = "spot:x,y,z:dx,dy,dz:r,g,b[:cutoff[:beam]] (direction of travel, W/sr, degrees)"
    is_movable = True

    def __post_init__(self):
        object.__setattr__(self, "position", vector("position", self.position))
        object.__setattr__(self, "direction", direction(self.direction))
        object.__setattr__(self, "intensity", rgb("intensity", self.intensity))
        cutoff = numbers(self.cutoff_degrees)
        if cutoff.shape != () or not 0 < cutoff <= 90:
            raise LightError(
                "a spot light's cutoff must be above 0 and at most 90 degrees, got"
                f" {self.cutoff_degrees}"
            )
        beam = 0.75 * cutoff if self.beam_degrees is None else numbers(self.beam_degrees)
        if beam.shape != () or not 0 <= beam <= cutoff:
            raise LightError(
                f"a spot light's beam must be 0 degrees to its cutoff of {cutoff:g}, got"
                f" {self.beam_degrees}"
            )
        object.__setattr__(self, "cutoff_degrees", float(cutoff))
        object.__setattr__(self, "beam_degrees", float(beam))

    @classmethod
    def parse(cls, text):
        """See `LightPart.parse`."""
        return cls(*fields_from_text(text, vectors=2, options=(float, float)))

    def emission(self):
        """See `LocalPart.emission`."""
        cutoff, beam = np.radians(np.array([[self.cutoff_degrees], [self.beam_degrees]], float))
        return Emission(
            self.position[None], self.direction[None], self.intensity[None], [0], cutoff, beam
        )

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(self, intensity=self.intensity * rgb_factor(factor))

    def moved(self, position):
        """See `LocalPart.moved`."""
        return replace(self, position=position)

    def to_mitsuba(self):
        """See `LightPart.to_mitsuba`."""
        aside = np.eye(3)[np.argmin(np.abs(self.direction))]
        to_world = (
            mitsuba()
            .ScalarTransform4f()
            .look_at(list(self.position), list(self.position + self.direction), list(aside))
        )
        return {
            "type": "spot",
            "to_world": to_world,
            "intensity": rgb_spectrum(self.intensity),
            "cutoff_angle": self.cutoff_degrees,
            "beam_width": self.beam_degrees,
        }
