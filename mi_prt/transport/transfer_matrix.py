"""Transfer matrices between the coefficients of direct light and those of indirect irradiance, made
small by an error budget.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

SPARSE_BELOW = 0.3  # share of entries that are not zero, below which a sparse product is faster


@dataclass(frozen=True, eq=False)
class Transfer:
    """Direct-to-indirect transfer between all pairs of clusters (Meshless PRT, eq. 10, with an
    uncentred basis).

    Indirect irradiance of the points of cluster r is E_r = U_r · Σ_s M_rs P_sᵀ E_s for the direct
    irradiance E_s of each cluster s.

    Parameters
    ----------
    encoder : (n, d) float32
        P: coefficients of direct light from its irradiance.
    receivers : (n, q) float32
        U: patterns of indirect irradiance on each cluster, the columns that it does not need being
        zero.
    matrix : (c, q, c·d, channels) float32
        M. Zero in the rows that a cluster does not need, and in what was dropped.
    """

    encoder: np.ndarray
    receivers: np.ndarray
    matrix: np.ndarray

    @cached_property
    def _channels(self):
        """The matrix (c·q, c·d) of each channel, sparse where most of it is zero: reading it is
        what a product costs.
        """
        c, q, columns, channels = self.matrix.shape
        matrices = [
            np.ascontiguousarray(self.matrix[..., i].reshape(c * q, columns))
            for i in range(channels)
        ]
        return [
            scipy.sparse.csr_array(m) if np.count_nonzero(m) < SPARSE_BELOW * m.size else m
            for m in matrices
        ]

    def indirect(self, irradiance, clusters):
        """Indirect irradiance (n, 3) float32 of direct irradiance (n, 3)."""
        c, q, _, channels = self.matrix.shape
        light = np.concatenate(
            [self.encoder[cluster].T @ irradiance[cluster] for cluster in clusters]
        )
        products = (
            matrix @ light[:, i if channels == 3 else slice(None)]
            for i, matrix in enumerate(self._channels)
        )
        received = (np.stack(list(products), axis=-1) if channels == 3 else next(products)).reshape(
            c, q, 3
        )
        result = np.empty_like(irradiance)
        for cluster, coefficients in zip(clusters, received):
            result[cluster] = self.receivers[cluster] @ coefficients
        return result


def within_budget(matrix, examples, budget):
    """A transfer matrix without what makes too little difference.

    Rows, then single entries, are dropped in the order of the squared irradiance that they bring,
    until what is dropped would make a share of the whole; each gets half of the budget. Rows are
    those of an orthonormal basis, so their squares add up; entries are taken as independent, and
    where that was too much, fewer are dropped.

    Parameters
    ----------
    matrix : (c, q, k, channels) float32
    examples : (k, e) float32
        Coefficients of direct light.
    budget : float
        Relative RMS error of indirect irradiance under the examples that may be made; 0 drops
        nothing but zeros.

    Returns
    -------
    reduced : (c, q, k, channels) float32
    ranks : (c,) int64
        Rows of each cluster that are left, its first ones.
    error : float
        Relative RMS error that was made.
    """
    c, q, k, channels = matrix.shape
    received = np.stack(
        [matrix[..., i].reshape(c * q, k) @ examples for i in range(channels)], axis=-1
    )
    energy = np.einsum("ijk,ijk->i", received, received, dtype=np.float64).reshape(c, q)
    total = energy.sum()
    kept = ~_smallest(energy, budget**2 / 2 * total)
    ranks = (kept * np.arange(1, q + 1)).max(axis=1)
    reduced = matrix * (np.arange(q) < ranks[:, None])[..., None, None]
    strength = np.einsum("ij,ij->i", examples, examples, dtype=np.float64)
    squares = np.square(reduced, dtype=np.float64) * strength[:, None]
    share = budget**2 / 2
    while True:
        kept = np.where(_smallest(squares, share * total), 0, reduced)
        lost = np.stack(
            [(matrix - kept)[..., i].reshape(c * q, k) @ examples for i in range(channels)], axis=-1
        )
        error = float(np.sqrt(np.square(lost, dtype=np.float64).sum() / total)) if total else 0.0
        if error <= budget or share == 0:
            return kept, ranks, error
        share = share / 2 if share > budget**2 / 1000 else 0.0


def _smallest(squares, budget):
    """Which entries are the smallest that together stay within a budget."""
    order = np.argsort(squares, axis=None)
    dropped = np.zeros(squares.size, bool)
    dropped[order[: np.searchsorted(np.cumsum(squares.ravel()[order]), budget, side="right")]] = (
        True
    )
    return dropped.reshape(squares.shape)
