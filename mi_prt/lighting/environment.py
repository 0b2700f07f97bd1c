"""Environment maps: equirectangular radiance in Mitsuba's convention, with a rotation."""

import re
import warnings
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LightError
from ..system.runtime import mitsuba
from .average import average, sample_spacing
from .kept import kept_means
from .map_file import read_pixels
from .part import LIGHTS, DistantPart
from .quadrature import of_map
from .rotation import orthonormal, parse_rotation, rotation_matrix
from .values import rgb_factor

# share of a map's energy beyond which negative pixels are damage, not compression noise
NEGATIVE_ENERGY_LIMIT = 1e-3
_TURNED_FILE = re.compile(r"(.+?):([xyz]|[^:,]+,[^:,]+,[^:,]+):([^:]+)")


class LightWarning(UserWarning):
    """Lighting that was usable only after a correction; the message counts what was corrected."""


@LIGHTS.register
@dataclass(frozen=True, eq=False)
class EnvironmentMap(DistantPart):
    """Distant light from an equirectangular map of radiance.

    The convention is that of Mitsuba's `envmap`: +y is up, and the point (u, v) of the image looks
    along (sin 2πu · sin πv, cos πv, −cos 2πu · sin πv) in the map's frame. Radiance is interpolated
    bilinearly between pixels at u = (column + ½)/w and v = row/(h − 1): the first and last rows lie
    on the poles.

    Parameters
    ----------
    source : path, (h, w, 3) array, or mi.Bitmap
        Files are read by Mitsuba, as those of a scene's own envmap are. Linear RGB, W/(m²·sr).
    rotation : (3, 3) array, default identity
        Orthonormal matrix that takes directions of the map's frame to the world's (`to_world`).
    scale : float, default 1
        Factor on the radiance.

    Attributes
    ----------
    pixels : (h, w, 3) float32
        Read-only, as means over cells are computed once for each map; `mi.Bitmap` takes a copy.
    negative_pixels : int
        Pixels in which a negative value was set to zero.

    Raises
    ------
    LightError
        If the file cannot be read or lacks a channel, the array is not of shape (h, w, 3), pixels
        are NaN or infinite, or negative pixels carry more than 1e-3 of the energy.
    """

    source: Any = field(repr=False)
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    pixels: np.ndarray = field(init=False, repr=False)
    negative_pixels: int = field(init=False, default=0)

    kind = "envmap"
    FORM = "envmap:FILE or envmap:FILE:AXIS:DEGREES"
    is_environment = True

    def __post_init__(self):
        pixels, negative = _validated(read_pixels(self.source), self.scale)
        pixels.flags.writeable = False
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "negative_pixels", negative)
        object.__setattr__(
            self, "source", str(self.source) if isinstance(self.source, str | Path) else pixels
        )
        object.__setattr__(self, "rotation", orthonormal(self.rotation))
        object.__setattr__(self, "scale", 1.0)

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed,
        in world space.
        """
        turned = copy(self)  # the pixels are checked already
        object.__setattr__(turned, "rotation", rotation_matrix(axis, degrees) @ self.rotation)
        return turned

    def scaled(self, factor):
        """See `LightPart.scaled`.

        Raises
        ------
        LightError
            If float32 does not hold the result.
        """
        with np.errstate(over="ignore"):
            pixels = self.pixels * rgb_factor(factor).astype(np.float32)
        if not np.isfinite(pixels).all():
            raise LightError(f"an environment map times {factor} is not finite in float32")
        pixels.flags.writeable = False
        dimmed = copy(self)
        object.__setattr__(dimmed, "pixels", pixels)
        object.__setattr__(dimmed, "source", pixels)
        return dimmed

    @classmethod
    def parse(cls, text):
        """See `LightPart.parse`."""
        turned = _TURNED_FILE.fullmatch(text)
        if not turned:
            return cls(text)
        file, axis, degrees = turned.groups()
        return cls(file).rotated(*parse_rotation(f"{axis}:{degrees}"))

    def to_mitsuba(self):
        """See `LightPart.to_mitsuba`."""
        mi = mitsuba()
        to_world = np.eye(4)
        to_world[:3, :3] = self.rotation
        return {
            "type": "envmap",
            "bitmap": mi.Bitmap(self.pixels.copy()),  # Mitsuba refuses read-only arrays
            "to_world": mi.ScalarTransform4f(to_world),
        }

    def radiance(self, directions, samples_per_side):
        """See `DistantPart.radiance`; read-only, and computed once for each lattice."""
        return kept_means(self, directions, samples_per_side, self._averaged)

    def _averaged(self, directions, samples_per_side):
        spacing = sample_spacing(directions, samples_per_side)
        return average(self.quadrature(spacing), directions, self.at)

    @property
    def size(self):
        """Rows and columns."""
        return self.pixels.shape[:2]

    def at(self, vectors):
        """Radiance (k, 3) that arrives from unit directions (k, 3) in world space, bilinear as in
        Mitsuba.
        """
        height, width = self.size
        x, y, z = (vectors @ self.rotation).T
        column = np.arctan2(x, -z) * (width / (2 * np.pi)) - 0.5
        row = np.arctan2(np.hypot(x, z), y) * ((height - 1) / np.pi)
        left = np.floor(column).astype(np.int64)
        above = np.minimum(row.astype(np.int64), max(height - 2, 0))
        below = np.minimum(above + 1, height - 1)
        weight_u, weight_v = (column - left)[:, None], (row - above)[:, None]
        left, right = left % width, (left + 1) % width
        upper = self.pixels[above, left] * (1 - weight_u) + self.pixels[above, right] * weight_u
        lower = self.pixels[below, left] * (1 - weight_u) + self.pixels[below, right] * weight_u
        return upper * (1 - weight_v) + lower * weight_v

    def quadrature(self, spacing):
        """The map in samples no farther apart than `spacing` radians, a Quadrature."""
        return of_map(self.pixels, self.rotation, spacing)


def _validated(pixels, scale):
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise LightError(f"an environment map must be of shape (h, w, 3), got {pixels.shape}")
    if pixels.dtype.kind not in "fiub":
        raise LightError(f"an environment map must hold real numbers, got {pixels.dtype}")
    if not np.isfinite(scale):
        raise LightError(f"an environment map's scale must be finite, got {scale}")
    # what float32 cannot hold becomes infinite, and is refused below
    with np.errstate(over="ignore"):
        pixels = pixels.astype(np.float32) * np.float32(scale)
    broken = int((~np.isfinite(pixels)).any(axis=2).sum())
    if broken:
        raise LightError(
            f"environment map has {broken} pixels that are NaN or infinite: repair them first"
        )
    negative = int((pixels < 0).any(axis=2).sum())
    if negative:
        sines = np.sin((np.arange(len(pixels)) + 0.5) * np.pi / len(pixels))[:, None, None]
        lost = float(-(np.minimum(pixels, 0) * sines).sum(dtype=np.float64))
        kept = float((np.maximum(pixels, 0) * sines).sum(dtype=np.float64))
        share = lost / kept if kept > 0 else np.inf
        if share > NEGATIVE_ENERGY_LIMIT:
            raise LightError(
                f"environment map has {negative} negative pixels with {share:.2g} of its energy,"
                f" more than the {NEGATIVE_ENERGY_LIMIT:g} that compression can explain: repair it"
                " first"
            )
        warnings.warn(
            f"environment map: {negative} negative pixels ({share:.1g} of its energy) set to zero",
            LightWarning,
            stacklevel=4,
        )
        pixels = np.maximum(pixels, 0)
    return pixels, negative
