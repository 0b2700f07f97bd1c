"""Local lights of every kind as one: places that emit, each with an intensity, an axis and a shape
of emission.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import LightError
from .part import LocalPart
from .values import is_finite, numbers, rgb_factor

_SHAPES = {
    "positions": (3,),
    "axes": (3,),
    "intensity": (3,),
    "cosine": (),
    "cutoff": (),
    "beam": (),
}
BLOCK = 1 << 20  # pairs of surface points and emitting places computed at a time


@dataclass(frozen=True, eq=False)
class Emission(LocalPart):
    """k places that emit light.

    A place with the intensity I sends the irradiance E = I · f(ω) · V · max(0, −ω·n)/r² to a
    surface with the normal n that it sees (V = 1, else 0) at the distance r in the direction ω; f
    is `shape`.

    Parameters
    ----------
    positions : (k, 3) float32
        World space, m.
    axes : (k, 3) float32
        Unit vectors, in which most light travels; any where light is equal in all directions.
    intensity : (k, 3) float32
        RGB in W/sr along the axis.
    cosine : (k,) float32
        1 where intensity falls with the cosine of the angle to the axis, as that of a small flat
        area, and is zero behind; else 0.
    cutoff : (k,) float32
        Angle to the axis, in radians, beyond which it is dark; π if there is no such.
    beam : (k,) float32
        Angle to the axis from which on intensity falls linearly to zero at the cutoff; π if there
        is no such.

    Attributes
    ----------
    exact : dict
        The same arrays by name in float64, as they were given.

    Raises
    ------
    LightError
        If a value is not finite, an intensity negative, or a shape another.
    """

    positions: Any
    axes: Any
    intensity: Any
    cosine: Any
    cutoff: Any
    beam: Any
    exact: dict = field(init=False, repr=False)

    kind = "emission"

    def __post_init__(self):
        count = len(np.atleast_1d(self.positions))
        exact = {}
        for name, shape in _SHAPES.items():
            values = numbers(getattr(self, name))
            if values.shape != (count, *shape) or not is_finite(values):
                raise LightError(
                    f"an emission's {name} must be {(count, *shape)} finite float32 numbers, got"
                    f" shape {values.shape}"
                )
            exact[name] = values
            object.__setattr__(self, name, values.astype(np.float32))
        object.__setattr__(self, "exact", exact)
        if (self.intensity < 0).any():
            raise LightError(
                f"an emission's intensity must not be negative, got {self.intensity.min():g}"
            )

    def __len__(self):
        return len(self.positions)

    def emission(self):
        """Itself; see `LocalPart.emission`."""
        return self

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return Emission(**self.exact | {"intensity": self.exact["intensity"] * rgb_factor(factor)})

    def to_mitsuba(self):
        """Refused: see `LightPart.to_mitsuba`.

        Raises
        ------
        LightError
            Always.
        """
        raise LightError(
            f"an emission of {len(self)} places has no emitter in Mitsuba: use point, spot or area"
            " lights, or the scene's own lamps by their names (scene:NAME)"
        )

    def shape(self, directions, places=slice(None)):
        """Share of the intensity that is sent in some directions.

        Parameters
        ----------
        directions : (…, k, 3)
            Unit vectors, in which the light of each place travels.
        places : slice
            Those k that are asked for.

        Returns
        -------
        (…, k) float64
            1 along the axis, 0 to 1 elsewhere.
        """
        axes, falls, cutoff, beam = (
            x[places] for x in (self.axes, self.cosine, self.cutoff, self.beam)
        )
        cosine = np.clip((directions * axes.astype(np.float64)).sum(axis=-1), -1, 1)
        angle = np.arccos(cosine)
        transition = np.maximum(cutoff - beam, np.finfo(np.float32).tiny).astype(np.float64)
        cone = np.where(angle <= beam, 1, np.clip((cutoff - angle) / transition, 0, 1))
        return np.where(falls > 0, np.maximum(cosine, 0), 1) * cone

    def irradiance(self, positions, normals):
        """Irradiance of surfaces that see all of it, the sum over all places.

        Parameters
        ----------
        positions, normals : (n, 3)
            World space.

        Returns
        -------
        (n, 3) float64
            W/m². A place in the point itself adds nothing: it has no direction there.
        """
        positions, normals = np.asarray(positions, np.float64), np.asarray(normals, np.float64)
        total = np.zeros((len(positions), 3))
        step = max(1, BLOCK // max(1, len(self)))
        for first in range(0, len(positions), step):
            block = slice(first, first + step)
            travel = positions[block, None] - self.positions.astype(np.float64)
            distance = np.linalg.norm(travel, axis=-1, keepdims=True)
            here = distance == 0
            travel /= np.where(here, 1, distance)
            received = np.maximum(-(travel * normals[block, None]).sum(axis=-1), 0) * self.shape(
                travel
            )
            total[block] = (
                received / np.where(here, np.inf, distance)[..., 0] ** 2
            ) @ self.intensity.astype(np.float64)
        return total


def emission_of(light):
    """All local light as one emission; distant light is left aside.

    Parameters
    ----------
    light : Light

    Returns
    -------
    Emission
        Of the local parts in their order; of no places where there are none.

    Raises
    ------
    LightError
        If a part is one of the scene's own lights that is not resolved.
    """
    parts = [part.emission().exact for part in light.parts if not part.is_distant]
    empty = {name: np.empty((0, *shape)) for name, shape in _SHAPES.items()}
    return Emission(
        **{name: np.concatenate([empty[name], *(part[name] for part in parts)]) for name in empty}
    )


def flat_emission(positions, normals, intensity):
    """Emission of small flat areas: that of a Lambertian surface, which falls with the cosine to
    its normal.

    Parameters
    ----------
    positions, normals : (k, 3)
    intensity : (k, 3)
        Radiance times area, in W/sr.
    """
    count = len(positions)
    return Emission(
        positions, normals, intensity, np.ones(count), np.full(count, np.pi), np.full(count, np.pi)
    )
