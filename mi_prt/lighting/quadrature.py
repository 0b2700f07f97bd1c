"""Samples that cover the sphere, with the energy and the first moment of the light in each."""

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse

from ..system.parallel import one_blas_thread

_KEPT = 4  # sizes of maps whose grids are kept


class Samples:
    """What quadratures have in common; see `Quadrature` for what they hold."""

    vectors: Any
    solid_angles: Any
    energy: Any
    moments: Any
    place: Hashable

    def moments_in(self, order, ends):
        """First moments (s, 3, 3) float64 of s groups, channels first.

        Parameters
        ----------
        order : (k,) int
            Samples by groups.
        ends : (s + 1,) int
            Where groups begin and end in `order`.
        """
        ones = np.ones(len(order), np.float32)
        groups = scipy.sparse.csr_matrix((ones, order, ends), (len(ends) - 1, len(order)))
        return (groups @ self.moments.reshape(-1, 9).astype(np.float64)).reshape(-1, 3, 3)

    @property
    def radiance(self):
        """Mean radiance (k, 3) of each piece."""
        return self.energy / self.solid_angles[:, None]


@dataclass(frozen=True, eq=False)
class Quadrature(Samples):
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
    Samples
        With what a Quadrature holds.
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
        # column by column
        theta, phi = self._down.middles, self._across.middles[:, None]
        up, around = (np.sin(theta), np.cos(theta)), (np.sin(phi), -np.cos(phi))
        self._vectors = _stacked(around[0] * up[0], up[1], around[1] * up[0])
        self._tangents = (
            _stacked(around[0] * up[1], -up[0], around[1] * up[1]),
            _stacked(-around[1] * up[0], 0.0, around[0] * up[0]),
        )
        self._solid_angles = (
            (self._across.sizes[:, None] * self._down.sizes).ravel().astype(np.float32)
        )

    def quadrature(self, pixels, rotation):
        """See `of_map`."""
        height, width, _ = pixels.shape
        down, across = self._down, self._across

        def columns(matrix):  # of summed rows: (w, m·3)
            rows = (matrix @ pixels.reshape(height, -1)).reshape(-1, width, 3)
            return np.ascontiguousarray(rows.transpose(1, 0, 2)).reshape(width, -1)

        straight = columns(down.zeroth)
        energy = (across.zeroth @ straight).reshape(-1, 3)
        terms = [(energy, self._vectors)]
        if down.sums or across.sums:
            offsets = across.zeroth @ columns(down.first), across.first @ straight
            terms += [(o.reshape(-1, 3), tangent) for o, tangent in zip(offsets, self._tangents)]
        turn = rotation.T.astype(np.float32)
        place = (*self._key, rotation.tobytes())
        return _MapQuadrature(self._solid_angles, energy, terms, turn, place)


class _MapQuadrature(Samples):
    """That of a map. Its moments are the sum of products of light and vectors, in the map's frame;
    these and the vectors are written out only where they are asked for one by one.

    Parameters
    ----------
    terms : list of ((k, 3), (k, 3))
        Light, and vectors that it is multiplied with; of the first, those of the samples.
    turn : (3, 3) float32
        From the map's frame, vectors as rows.
    """

    def __init__(self, solid_angles, energy, terms, turn, place):
        self.solid_angles, self.energy, self.place = solid_angles, energy, place
        self._terms, self._turn = terms, turn

    @property
    def vectors(self):
        """See `Quadrature`."""
        with one_blas_thread():
            return self._terms[0][1] @ self._turn

    @property
    def moments(self):
        """See `Quadrature`."""
        found = np.zeros((len(self.energy), 3, 3), np.float32)
        for light, vectors in self._terms:
            found += light[:, :, None] * vectors[:, None]
        with one_blas_thread():
            return (found.reshape(-1, 3) @ self._turn).reshape(-1, 3, 3)

    def moments_in(self, order, ends):
        """See `Quadrature.moments_in`."""
        shape = (len(ends) - 1, len(order))
        found = np.zeros((shape[0], 3, 3))
        for light, vectors in self._terms:
            light = light.astype(np.float64)
            for axis, values in enumerate(vectors.T):
                weighted = scipy.sparse.csr_matrix((values[order], order, ends), shape)
                found[:, :, axis] += weighted @ light
        return found @ self._turn


def _stacked(x, y, z):
    """Vectors (rows · columns, 3) float32 of a grid, from what broadcasts to it."""
    found = np.empty((*np.broadcast(x, y, z).shape, 3), np.float32)
    for axis, values in enumerate((x, y, z)):
        found[..., axis] = values
    return found.reshape(-1, 3)
