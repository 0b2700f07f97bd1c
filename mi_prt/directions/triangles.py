"""The triangles between neighbouring directions of a lattice, and the one around a direction."""

from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from .lattice import unit

_KEPT = 8  # lattices whose triangles are kept
_ROUNDING = 1e-9  # a weight below zero by less is one of zero
_NEAREST = 4  # directions whose triangles are looked through next
_BLOCK = 1 << 16  # directions looked up at a time


@lru_cache(_KEPT)
def triangles_of(lattice):
    """The `Triangles` of a direction lattice; the same object for equal lattices."""
    return Triangles(lattice)


class Triangles:
    """The spherical triangles between the directions of a lattice (their Delaunay triangulation).

    A direction is a sum of the three around it, with weights that are not negative. Light put there
    with those weights, scaled to sum to 1, keeps its energy and the direction of its first moment
    ∫ L ω dω; no set of other directions can keep its length too. On cells of an angle δ it is
    shorter by δ²/2 at most.

    Parameters
    ----------
    lattice : DirectionLattice

    Attributes
    ----------
    corners : (t, 3) int64
        Indices of directions; none where the lattice has too few of them to enclose the origin.
        Each direction is then that of its cell.
    """

    def __init__(self, lattice):
        self._lattice = lattice
        vectors = unit(lattice.vectors)
        corners = self.corners = _hull(vectors)
        # weights of a direction in the corners: the inverse of the matrix whose columns they are
        self._inverse = np.linalg.inv(vectors[corners].transpose(0, 2, 1))
        self._beside = _incidence(corners, len(vectors))

    def around(self, directions):
        """The directions around others, and their shares.

        Parameters
        ----------
        directions : (k, 3) array
            Of any positive length.

        Returns
        -------
        cells : (k, 3) int64
        shares : (k, 3) float64
            Not negative; rows sum to 1.
        """
        directions = unit(directions)
        cells = np.empty((len(directions), 3), np.int64)
        shares = np.empty((len(directions), 3))
        for first in range(0, len(directions), _BLOCK):
            block = slice(first, first + _BLOCK)
            cells[block], shares[block] = self._around(directions[block])
        return cells, shares

    def _around(self, directions):
        home = self._lattice.cells(directions)
        cells, shares = np.repeat(home[:, None], 3, axis=1), np.tile([1.0, 0, 0], (len(home), 1))
        if not len(self.corners):
            return cells, shares
        left = np.arange(len(directions))
        for candidates in (self._beside_home, self._beside_nearest, self._every):
            left = self._search(
                directions, left, candidates(directions[left], home[left]), cells, shares
            )
            if not len(left):
                break
        return cells, shares

    def _beside_home(self, directions, home):
        return self._beside[home]

    def _beside_nearest(self, directions, home):
        """Where the cells of a lattice are not those of the nearest direction."""
        near = self._lattice.nearest(directions, min(_NEAREST, len(self._lattice)))
        return self._beside[near].reshape(len(directions), -1)

    def _every(self, directions, home):
        return np.broadcast_to(np.arange(len(self.corners)), (len(home), len(self.corners)))

    def _search(self, directions, rows, candidates, cells, shares):
        """Fill in the rows that one of their candidate triangles (r, m) holds; the other rows."""
        open_rows = np.arange(len(rows))
        for column in range(candidates.shape[1]):
            if not len(open_rows):
                break
            triangle, row = candidates[open_rows, column], rows[open_rows]
            weights = np.einsum("kij,kj->ki", self._inverse[triangle], directions[row])
            inside = weights.min(axis=1) >= -_ROUNDING * np.abs(weights).max(axis=1)
            inside &= weights.max(axis=1) > 0
            cells[row[inside]] = self.corners[triangle[inside]]
            clipped = np.maximum(weights[inside], 0)
            shares[row[inside]] = clipped / clipped.sum(axis=1, keepdims=True)
            open_rows = open_rows[~inside]
        return rows[open_rows]


def _hull(vectors):
    """Triangles (t, 3) of the convex hull of unit vectors (s, 3), if the origin is inside."""
    none = np.empty((0, 3), np.int64)
    try:
        hull = ConvexHull(vectors)
    except (QhullError, ValueError):
        return none
    if (hull.equations[:, 3] > -_ROUNDING).any():
        return none
    return hull.simplices.astype(np.int64)


def _incidence(corners, count):
    """Triangles (count, m) that each direction is a corner of; padded with one of them."""
    if not len(corners):
        return np.empty((count, 0), np.int64)
    order = np.argsort(corners.ravel(), kind="stable")
    owner, triangle = corners.ravel()[order], order // 3
    numbers = np.bincount(owner, minlength=count)
    starts = np.cumsum(numbers) - numbers
    place = np.arange(len(owner)) - starts[owner]
    table = np.repeat(triangle[starts][:, None], numbers.max(), axis=1)
    table[owner, place] = triangle
    return table
