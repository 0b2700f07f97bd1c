"""Local lights: lights that stand somewhere in the scene."""

from dataclasses import dataclass, field
from math import isqrt

import numpy as np

from ..errors import LightError
from .values import direction, is_finite, numbers, rgb, vector

# sine of the least angle between the edges of an area light: with less, float32 does not tell its
# normal
FLATTEST = 1e-6


@dataclass(frozen=True, eq=False)
class PointLight:
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

    def __post_init__(self):
        object.__setattr__(self, "position", vector("position", self.position))
        object.__setattr__(self, "intensity", rgb("intensity", self.intensity))


@dataclass(frozen=True, eq=False)
class SpotLight:
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


@dataclass(frozen=True, eq=False)
class AreaLight:
    """A parallelogram of one radiance in all directions on one of its sides (Mitsuba's `area` on a
    `rectangle`).

    It shines to the side of edge_u × edge_v; the other is dark. It casts no shadow.

    Parameters
    ----------
    centre : (3,) array
        World space, m.
    edge_u, edge_v : (3,) array
        Edges in m: its corners are centre ± edge_u/2 ± edge_v/2.
    radiance : (3,) array or float
        RGB in W/(m² sr); one number is grey.
    samples : int, default 25
        Places that stand for it, a square number: the centres of √samples × √samples equal parts. A
        surface nearer than about the size of a part tells them apart.

    Raises
    ------
    LightError
        If a value is not finite, the area zero, the radiance negative, or the number of samples not
        square.
    """

    centre: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    radiance: np.ndarray
    samples: int = 25
    area: float = field(init=False, repr=False)
    normal: np.ndarray = field(init=False, repr=False)

    def __post_init__(self):
        for name in ("centre", "edge_u", "edge_v"):
            object.__setattr__(self, name, vector(name, getattr(self, name)))
        object.__setattr__(self, "radiance", rgb("radiance", self.radiance))
        across = np.cross(self.edge_u, self.edge_v)
        area = np.linalg.norm(across)
        if not area > FLATTEST * np.linalg.norm(self.edge_u) * np.linalg.norm(self.edge_v):
            raise LightError(
                f"an area light's edges must span an area, got edges {self.edge_u} and"
                f" {self.edge_v}"
            )
        if not is_finite(area * self.radiance):
            raise LightError(
                "an area light's radiance times its area must be a finite float32 number, got"
                f" {area:g} m²"
            )
        count = self.samples
        if (
            isinstance(count, bool)
            or not isinstance(count, int | np.integer)
            or count < 1
            or isqrt(count) ** 2 != count
        ):
            raise LightError(
                "an area light's samples must be a square number such as 1, 4, 9, 16 or 25, got"
                f" {count}"
            )
        object.__setattr__(self, "samples", int(count))
        object.__setattr__(self, "area", float(area))
        object.__setattr__(self, "normal", across / area)
