"""Samples that cover the sphere, with the energy and the first moment of the light in each."""

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse

_KEPT = 4  # sizes of maps whose grids are kept


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Light in k pieces of the sphere.

    Parameters
    ----------
    vectors : (k, 3) float32
        Unit vectors in world space.
    solid_angles : (k,) float32
        In sr; their sum is 4π.
    energy : (k, 3) float32
        ∫ L dω of each piece, RGB.
    moments : (k, 3, 3) float32
        ∫ L ω dω: channels, then x, y, z.
    place : hashable, optional
        Equal for quadratures of equal vectors, so that what depends on them is computed once.
    """

    vectors: np.ndarray
    solid_angles: np.ndarray
    energy: np.ndarray
    moments: np.ndarray
    place: Hashable = None

    @property
    def radiance(self):
        """Mean radiance (k, 3) of each piece."""
        return self.energy / self.solid_angles[:, None]


def of_map(pixels, rotation, spacing):
    """The quadrature of an equirectangular map in Mitsuba's convention.

    Parameters
    ----------
    pixels : (h, w, 3) float32
        Nodes of a bilinear function, see `EnvironmentMap`.
    rotation : (3, 3)
        Takes the map's frame to the world's.
    spacing : float
        About the distance of neighbouring samples, in radians. A map that is coarser is split, one
        that is finer is summed: the cost does not depend on its resolution beyond one pass.

    Returns
    -------
    Quadrature
    """
    return _grid(*pixels.shape[:2], float(spacing)).quadrature(pixels, np.asarray(rotation))


class _Axis:
    """Integrals along one axis of a map over intervals between samples' borders.

    Attributes
    ----------
    middles : (m,)
        Mean angle of each interval, radians.
    sizes : (m,)
        Of the intervals, in the measure of the sphere along this axis.
    sums : bool
        Whether an interval holds several nodes.
    zeroth, first : (m, nodes) sparse
        Integral of the function between nodes, and of the function times the angle's difference
        from the middle.
    """

    def __init__(self, nodes, lower, share, angles, measure, group):
        parts = np.arange(len(angles)) // group
        self.sums = group > 1
        count = parts[-1] + 1
        self.sizes = np.bincount(parts, measure, count)
        self.middles = np.bincount(parts, measure * angles, count) / self.sizes
        upper = (lower + 1) % nodes
        values = np.concatenate([measure * (1 - share), measure * share])
        rows, columns = np.tile(parts, 2), np.concatenate([lower, upper])
        offsets = np.tile(angles - self.middles[parts], 2)
        self.zeroth, self.first = (
            scipy.sparse.csr_matrix((x, (rows, columns)), (count, nodes), dtype=np.float32)
            for x in (values, values * offsets)
        )


def _intervals(step, spacing):
    """Into how many parts to split intervals of a size, and how many of these to sum."""
    return max(1, round(step / spacing)), max(1, round(spacing / step))


def _around_pole(height, spacing):
    """The axis from +y to −y: rows are nodes from pole to pole."""
    intervals = max(height - 1, 1)
    splits, group = _intervals(np.pi / intervals, spacing)
    row = np.arange(intervals * splits)
    first, last = row * (np.pi / len(row)), (row + 1) * (np.pi / len(row))
    # Exact solid angle of a band, and the mean of θ over it: ∫ θ sin θ = sin θ − θ cos θ.
    ring = np.cos(first) - np.cos(last)
    mean = (_theta_moment(last) - _theta_moment(first)) / ring
    above = row // splits
    share = mean * (intervals / np.pi) - above if height > 1 else np.zeros(len(row))
    return _Axis(height, above, share, mean, ring, group)


def _theta_moment(theta):
    return np.sin(theta) - theta * np.cos(theta)


def _around_y(width, spacing):
    """The axis around +y: columns are nodes in a circle, each in the middle of its pixel."""
    step = 2 * np.pi / width
    splits, group = _intervals(step, spacing)
    column = np.arange(width * splits)
    share = (column % splits + 0.5) / splits
    angle = (column // splits + 0.5 + share) * step
    return _Axis(width, column // splits, share, angle, np.full(len(column), step / splits), group)


@lru_cache(_KEPT)
def _grid(height, width, spacing):
    return _Grid(height, width, spacing)


class _Grid:
    """What the quadrature of all maps of one size has in common."""

    def __init__(self, height, width, spacing):
        self._key = height, width, spacing
        self._down, self._across = _around_pole(height, spacing), _around_y(width, spacing)
        theta, phi = self._down.middles[:, None], self._across.middles
        up, around = (np.sin(theta), np.cos(theta)), (np.sin(phi), -np.cos(phi))
        self._vectors = _stacked(around[0] * up[0], up[1], around[1] * up[0])
        self._tangents = (
            _stacked(around[0] * up[1], -up[0], around[1] * up[1]),
            _stacked(-around[1] * up[0], 0.0, around[0] * up[0]),
        )
        self._solid_angles = (
            (self._down.sizes[:, None] * self._across.sizes).ravel().astype(np.float32)
        )

    def quadrature(self, pixels, rotation):
        """See `of_map`."""
        height, width, _ = pixels.shape
        down, across = self._down, self._across

        def along(matrix, rows):  # (m, w, 3) to (m, m', 3)
            turned = rows.transpose(1, 0, 2).reshape(width, -1)
            return (matrix @ turned).reshape(matrix.shape[0], -1, 3).transpose(1, 0, 2)

        flat = pixels.reshape(height, -1)
        rows = (down.zeroth @ flat).reshape(-1, width, 3)
        energy = along(across.zeroth, rows).reshape(-1, 3)
        moments = energy[:, :, None] * self._vectors[:, None]
        if down.sums or across.sums:
            tilted = (down.first @ flat).reshape(-1, width, 3)
            for offset, tangent in zip(
                (along(across.zeroth, tilted), along(across.first, rows)), self._tangents
            ):
                moments += offset.reshape(-1, 3)[:, :, None] * tangent[:, None]
        turn = rotation.T.astype(np.float32)
        moments = (moments.reshape(-1, 3) @ turn).reshape(-1, 3, 3)
        place = (*self._key, rotation.tobytes())
        return Quadrature(self._vectors @ turn, self._solid_angles, energy, moments, place)


def _stacked(x, y, z):
    """Vectors (rows · columns, 3) float32 of a grid, from what broadcasts to it."""
    found = np.empty((*np.broadcast(x, y, z).shape, 3), np.float32)
    for axis, values in enumerate((x, y, z)):
        found[..., axis] = values
    return found.reshape(-1, 3)
