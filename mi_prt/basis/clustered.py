"""Bases of single clusters: principal components of matrices that fit into memory (Meshless PRT,
section 3.3).
"""

import numpy as np

from ..system.parallel import one_blas_thread

OVERSAMPLING = 16
ITERATIONS = 3


def leading_components(matrix, count, seed=0):
    """The leading singular triplets of a matrix by randomized subspace iteration (Halko, Martinsson
    and Tropp 2011).

    Parameters
    ----------
    matrix : (m, k) float32
    count : int
        Triplets; fewer come back where the matrix is of lower rank.
    seed : int

    Returns
    -------
    left : (m, r) float32
    values : (r,) float64
        Descending.
    right : (r, k) float32
    """
    matrix = np.asarray(matrix, np.float32)
    width = min(count + OVERSAMPLING, *matrix.shape)
    with one_blas_thread():
        span = matrix @ np.random.default_rng(seed).standard_normal(
            (matrix.shape[1], width)
        ).astype(np.float32)
        for _ in range(ITERATIONS):
            span = matrix @ (matrix.T @ np.linalg.qr(span)[0])
        span = np.linalg.qr(span)[0]
        left, values, right = np.linalg.svd(
            (span.T @ matrix).astype(np.float64), full_matrices=False
        )
    kept = min(count, int((values > 1e-6 * values[0]).sum())) if len(values) else 0
    left = (span @ left[:, :kept]).astype(np.float32)
    signs = (
        np.where(left[np.abs(left).argmax(axis=0), np.arange(kept)] < 0, -1, 1).astype(np.float32)
        if kept
        else np.ones(0)
    )
    return left * signs, values[:kept], right[:kept].astype(np.float32) * signs[:, None]
