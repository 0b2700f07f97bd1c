"""Environment maps: equirectangular radiance in Mitsuba's convention, with a rotation."""

import warnings
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import LightError

# share of a map's energy beyond which negative pixels are damage, not compression noise
NEGATIVE_ENERGY_LIMIT = 1e-3


class LightWarning(UserWarning):
    """Lighting that was usable only after a correction; the message counts what was corrected."""


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Distant light from an equirectangular map of radiance.

    The convention is that of Mitsuba's `envmap`: +y is up, and the point (u, v) of the image looks
    along (sin 2πu · sin πv, cos πv, −cos 2πu · sin πv) in the map's frame. Radiance is interpolated
    bilinearly between pixels at u = (column + ½)/w and v = row/(h − 1): the first and last rows lie
    on the poles.

    Parameters
    ----------
    source : path, (h, w, 3) array, or mi.Bitmap
        EXR files are read by OpenEXR; other image formats by Mitsuba. Linear RGB, W/(m²·sr).
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

    source: object = field(repr=False)
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    pixels: np.ndarray = field(init=False, repr=False)
    negative_pixels: int = field(init=False, default=0)

    def __post_init__(self):
        pixels, negative = _validated(_read(self.source), self.scale)
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


def rotation_matrix(axis, degrees):
    """Right-handed rotation about an axis.

    Parameters
    ----------
    axis : 'x', 'y', 'z' or sequence of 3 numbers
        Need not be of unit length.
    degrees : float

    Returns
    -------
    (3, 3) float64

    Raises
    ------
    LightError
        If the axis is unknown, zero or not finite, or the angle is not finite.
    """
    named = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    vector = np.asarray(named.get(axis, axis) if isinstance(axis, str) else axis)
    if vector.shape != (3,) or vector.dtype.kind not in "iuf":
        raise LightError(f"rotation axis must be x, y, z or three numbers, got {axis!r}")
    length = np.linalg.norm(vector)
    if not (np.isfinite(length) and length > 0 and np.isfinite(degrees)):
        raise LightError(
            f"rotation about {axis!r} by {degrees} degrees is not finite or has no axis"
        )
    x, y, z = vector / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(float(degrees))
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def orthonormal(matrix):
    """The matrix as (3, 3) float64, after checking that it keeps lengths (a rotation or a
    reflection).
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4):
        raise LightError("an environment's to_world must be a rotation without scale or shear")
    return matrix


def _read(source):
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.is_file():
            raise LightError(f"environment map '{path}' does not exist")
        return _read_exr(path) if path.suffix.lower() == ".exr" else _read_by_mitsuba(path)
    if type(source).__module__.startswith("mitsuba"):
        return _from_bitmap(source)
    try:
        return np.asarray(source)
    except ValueError:
        raise LightError(
            "an environment map is a path, an array (h, w, 3) or a mi.Bitmap, got"
            f" {type(source).__name__}"
        ) from None


def _read_exr(path):
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # OpenEXR raises bare RuntimeErrors
        raise LightError(
            f"environment map '{path}' cannot be read as OpenEXR: {_one_line(error)}"
        ) from None
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise LightError(
            f"environment map '{path}' has the channels {', '.join(sorted(channels)) or 'none'} and"
            f" lacks {', '.join(missing)}: write it with R, G and B"
        )
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def _read_by_mitsuba(path):
    from ..system.runtime import mitsuba

    mi = mitsuba()
    try:
        return _from_bitmap(mi.Bitmap(str(path)))
    except RuntimeError as error:
        raise LightError(f"environment map '{path}' cannot be read: {_one_line(error)}") from None


def _from_bitmap(bitmap):
    from ..system.runtime import mitsuba

    mi = mitsuba()
    if not isinstance(bitmap, mi.Bitmap):
        raise LightError(
            "an environment map is a path, an array (h, w, 3) or a mi.Bitmap, got"
            f" {type(bitmap).__name__}"
        )
    return np.array(
        bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    )


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


def _one_line(error):
    return " ".join(str(error).split())
