"""Light put on a direction lattice with its energy and its first moment."""

from functools import lru_cache

import numpy as np
import scipy.sparse

from ..directions.triangles import triangles_of

_KEPT = 4  # sets of directions whose cells are kept
_ASTRAY = 2.0  # a centroid this many cell sides away from its cell is one of rounding


def sample_spacing(directions, samples_per_side):
    """Distance of samples in radians that puts so many along the side of a cell."""
    return np.sqrt(4 * np.pi / len(directions)) / samples_per_side


def put(directions, vectors, energy):
    """Light from single directions, spread over those of the lattice around each.

    Energy is kept, and so is the direction of the first moment Σ E ω: irradiance on a surface that
    sees all of it is that of the light, not of the middle of its cell. See `Triangles` for the
    moment's length.

    Parameters
    ----------
    directions : direction lattice
    vectors : (k, 3)
        Of any positive length.
    energy : (k, c)
        W/m².

    Returns
    -------
    (s, c) float64
        Energy of the cells.
    """
    cells, shares = triangles_of(directions).around(vectors)
    rows = np.repeat(np.arange(len(cells)), 3)
    spread = scipy.sparse.csr_matrix(
        (shares.ravel(), (cells.ravel(), rows)), (len(directions), len(cells))
    )
    return spread @ energy


def average(quadrature, directions, at):
    """Mean radiance of each cell from samples that cover the sphere.

    Each sample is first given whole to the cell that holds its direction. The solid angle a cell
    receives then differs a little from its own; the difference is traded with its neighbours at the
    radiance of the cell's dimmest sample, which keeps a sun whole and a constant constant, and what
    imbalance that leaves (of the order of 1e-4) is scaled away. What a cell holds beyond its
    dimmest sample then moves from the cell's middle to its own centroid, see `put`.

    Parameters
    ----------
    quadrature : Quadrature
    directions : direction lattice
    at : callable((k, 3) vectors) returning (k, 3)
        Radiance at directions, for cells so thin that no sample falls into them (at the pole of a
        long latitude-longitude lattice).

    Returns
    -------
    (s, 3) float64
    """
    w = directions.solid_angles[:, None]
    base, beyond, moments = split(quadrature, directions, at)
    for channel in range(3):
        moved = np.flatnonzero(beyond[:, channel] > 0)
        toward = moments[moved, channel]
        astray = _is_astray(toward, directions.vectors[moved], len(directions))
        toward[astray] = directions.vectors[moved[astray]]
        excess = beyond[moved, channel]
        base[:, channel] += put(directions, toward, excess[:, None])[:, 0] if len(moved) else 0
    return base / w


def split(quadrature, directions, at):
    """What cells hold, see `average`: energy of their dimmest sample everywhere (s, 3), energy
    beyond it (s, 3), and its first moment (s, 3, 3), channels first.
    """
    w = directions.solid_angles[:, None]
    groups, order, starts, filled, covered, reach = _groups(quadrature, directions)
    energy = groups @ quadrature.energy.astype(np.float64)
    moments = quadrature.moments_in(order, groups.indptr)
    dimmest = np.empty((len(directions), 3))
    dimmest[filled] = np.minimum.reduceat(quadrature.radiance[order], starts, axis=0)
    if not filled.all():
        dimmest[~filled] = at(directions.vectors[~filled])
    beyond = np.maximum(energy - dimmest * covered, 0)
    moments -= dimmest[:, :, None] * reach[:, None]
    total = (dimmest * w + beyond).sum(axis=0)
    whole = np.divide(energy.sum(axis=0), total, out=np.zeros(3), where=total > 0)
    return dimmest * w * whole, beyond * whole, moments


def _is_astray(toward, middles, count):
    length = np.linalg.norm(toward, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.sum(toward * middles, axis=1) / length
    return ~(cosine > np.cos(min(_ASTRAY * np.sqrt(4 * np.pi / count), np.pi / 2)))


def _groups(quadrature, directions):
    """Samples by cells: the matrix (s, k) that sums them; their order, where the cells start in it,
    which cells (s,) have any, and of each cell the solid angle (s, 1) and its moment (s, 3).
    """
    if quadrature.place is None:
        return _grouped(quadrature, directions)
    return _grouped_once(_Placed(quadrature), directions)


class _Placed:
    """Where samples are: equal where their place is. It is kept, and the samples are not."""

    def __init__(self, quadrature):
        self._quadrature, self._place = quadrature, quadrature.place

    def take(self):
        """The samples, once."""
        quadrature, self._quadrature = self._quadrature, None
        return quadrature

    def __eq__(self, other):
        return self._place == other._place

    def __hash__(self):
        return hash(self._place)


@lru_cache(_KEPT)
def _grouped_once(placed, directions):
    return _grouped(placed.take(), directions)


def _grouped(quadrature, directions):
    vectors, solid_angles = quadrature.vectors, quadrature.solid_angles.astype(np.float64)
    cells = directions.cells(vectors)
    order = np.argsort(cells, kind="stable")
    numbers = np.bincount(cells, minlength=len(directions))
    ends = np.concatenate([[0], np.cumsum(numbers)])
    ones = np.ones(len(cells), np.float32)
    groups = scipy.sparse.csr_matrix((ones, order, ends), (len(directions), len(cells)))
    filled = numbers > 0
    covered = groups @ solid_angles[:, None]
    reach = groups @ (solid_angles[:, None] * vectors)
    return groups, order, ends[:-1][filled], filled, covered, reach
