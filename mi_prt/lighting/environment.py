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
from .map_file import read_pixels
from .part import LIGHTS, DistantPart
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
            "bitmap": mi.Bitmap(self.pixels),
            "to_world": mi.ScalarTransform4f(to_world),
        }

    def radiance(self, directions, samples_per_side):
        """See `DistantPart.radiance`."""
        return average(self, sample_spacing(directions, samples_per_side), directions)

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

    def quadrature(self, spacing, band=1 << 20):
        """Samples that integrate the map over the sphere, in bands of rows so that memory stays
        bounded.

        Every pixel is split until its samples are no farther apart than `spacing`; radiance between
        the pixel centres is bilinear, as Mitsuba evaluates it.

        Parameters
        ----------
        spacing : float
            Largest distance of neighbouring samples, in radians.
        band : int
            About the number of samples in a band.

        Yields
        ------
        vectors : (k, 3) float32
            Unit vectors in world space.
        solid_angles : (k,) float32
            In sr; all bands together sum to 4π.
        radiance : (k, 3) float32
        """
        # Pixels are nodes of a bilinear function. The intervals between them are split, so that no
        # sample spans a kink and every sample's mean radiance is exact: at the middle in u, at the
        # mean of v over the sphere in v.
        height, width, _ = self.pixels.shape
        intervals = max(height - 1, 1)
        splits_v = max(1, int(np.ceil(np.pi / intervals / spacing)))
        splits_u = max(1, int(np.ceil(2 * np.pi / width / spacing)))
        rows, columns = intervals * splits_v, width * splits_u
        phi = ((np.arange(columns) + 0.5) / splits_u + 0.5) * (2 * np.pi / width)
        around = np.stack([np.sin(phi), np.zeros(columns), -np.cos(phi)], axis=-1)
        left = np.arange(columns) // splits_u
        right = (left + 1) % width
        weight_u = ((np.arange(columns) % splits_u + 0.5) / splits_u).astype(np.float32)[:, None]
        step = max(1, band // columns)
        for first in range(0, rows, step):
            row = np.arange(first, min(first + step, rows))
            first_theta, last_theta = row * (np.pi / rows), (row + 1) * (np.pi / rows)
            # Exact solid angle of a latitude band, and the mean of θ over it: ∫ θ sin θ = sin θ − θ
            # cos θ.
            ring = np.cos(first_theta) - np.cos(last_theta)
            mean_theta = (_theta_moment(last_theta) - _theta_moment(first_theta)) / ring
            above = row // splits_v
            below = np.minimum(above + 1, height - 1)
            weight_v = (mean_theta * (intervals / np.pi) - above).astype(np.float32)[:, None, None]
            lines = self.pixels[above] * (1 - weight_v) + self.pixels[below] * weight_v
            radiance = lines[:, left] * (1 - weight_u) + lines[:, right] * weight_u
            vectors = np.sin(mean_theta)[:, None, None] * around + np.cos(mean_theta)[
                :, None, None
            ] * np.array([0.0, 1.0, 0.0])
            vectors = (vectors.reshape(-1, 3) @ self.rotation.T).astype(np.float32)
            solid_angles = np.repeat(ring * (2 * np.pi / columns), columns).astype(np.float32)
            yield vectors, solid_angles, radiance.reshape(-1, 3).astype(np.float32)


def _theta_moment(theta):
    return np.sin(theta) - theta * np.cos(theta)


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
