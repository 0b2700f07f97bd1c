"""Principal components of transport (Eigentransport, section 3), fitted over blocks of rows.

Rows are weighted by √w, the square root of each direction's solid angle, so that what is minimised is the L2 error
over the sphere whatever the lattice (erratum 2 of the project's reading of the paper).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from ..parallel import map_chunks

BLOCK_ROWS = 128  # rows worked on at a time: a block of a few MB stays in the processor's cache
CHUNKS = 16  # parts that the rows are split into for the threads; fixed, so that sums do not depend on their number
OVERSAMPLING = 16
SAMPLE_ITERATIONS = 2  # power iterations on a quarter of the rows, which find nearly the subspace of all
ITERATIONS = 1  # power iterations on all rows, before the final projection
RANK_TOLERANCE = 100 * float(np.finfo(np.float32).eps) ** 2  # of squared singular values, against the sum of squares
EXACT_SIDE = 768  # up to here the Gram matrix of the smaller side is decomposed outright, in float64


@dataclass(frozen=True, eq=False)
class PCA:
    """A basis of d rows, orthonormal in the √w-weighted space, and the mean.

    A transport row is T ≈ mean + (c · vectors)/√w with c = ((T − mean)·√w) · vectorsᵀ. Under cell radiance L the
    irradiance is then exactly c·ℓ + m with ℓ = (L√w)·vectorsᵀ and m = Σ_j w_j L_j mean_j; nothing of the mean is lost.

    Parameters
    ----------
    vectors : (d, s) float32
    mean : (s,) float32
    sqrt_weights : (s,) float32
        √w.
    captured_variance : (d,) float64
        Share of the transport's variance in each component, in descending order.
    """

    vectors: np.ndarray
    mean: np.ndarray
    sqrt_weights: np.ndarray
    captured_variance: np.ndarray

    def encode(self, rows):
        """Coefficients (b, d) float32 of transport rows (b, s)."""
        weighted, mean_coefficients = self._encoder
        coefficients = rows @ weighted
        coefficients -= mean_coefficients
        return coefficients

    @cached_property
    def _encoder(self):
        """√w·vectorsᵀ (s, d) and the mean's coefficients (d,): weights and mean then cost nothing per row."""
        return (self.vectors * self.sqrt_weights).T.copy(), self.vectors @ (self.mean * self.sqrt_weights)

    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of coefficients (b, d)."""
        return (coefficients @ self.vectors) / self.sqrt_weights + self.mean

    def project_light(self, radiance):
        """Light in the basis.

        Parameters
        ----------
        radiance : (s, 3) float32
            Mean radiance of each cell.

        Returns
        -------
        coefficients : (d, 3) float32
            ℓ, so that irradiance is c·ℓ + m.
        mean_response : (3,) float32
            m, the irradiance that the mean transport gives.
        """
        weighted = radiance * self.sqrt_weights[:, None]
        return self.vectors @ weighted, (self.mean * self.sqrt_weights) @ weighted

    def paper_irradiance(self, coefficients, radiance):
        """Irradiance (n, 3) by the paper's mean compensation (eqs. 3 and 8–10), for comparison.

        It drops the part of the mean transport outside the span of the basis (erratum 1).
        """
        compensated = coefficients + self._encoder[1]
        return compensated @ (self.vectors @ (radiance * self.sqrt_weights[:, None]))


def fit_pca(rows, index, weights, components, seed=0, progress=lambda done, total: None):
    """Fit the basis to a matrix that is only ever seen in blocks of rows.

    The leading subspace comes from block subspace iteration on the covariance (a randomized range finder with power
    iterations, the first of them on a sample of the rows); small problems are solved by an exact eigendecomposition.

    Parameters
    ----------
    rows : callable(index) returning (b, s) float32
        Rows of the matrix.
    index : (n,) int array
        The rows to fit to.
    weights : (s,) float
        Solid angles in sr.
    components : int
        d; fewer are returned where the matrix has a lower rank.
    seed : int
        Of the random start.
    progress : callable(done, total)
        Called after every pass over the rows.

    Returns
    -------
    PCA
    """
    weights = np.asarray(weights, dtype=np.float64)
    sqrt_weights = np.sqrt(weights).astype(np.float32)
    n, s = len(index), len(weights)
    mean, squares = _moments(rows, index, sqrt_weights)
    variance = max(squares - n * float(mean @ mean), 0.0)
    largest = min(n - 1, s)
    subspace = components + max(OVERSAMPLING, components // 4)
    if subspace > largest / 3 or min(n, s) <= EXACT_SIDE:
        values, vectors = _exact(rows, index, mean, sqrt_weights, components)
    else:
        values, vectors = _subspace_iteration(rows, index, mean, sqrt_weights, components, subspace, seed, progress)
    # Rows are float32: what is below their rounding carries nothing.
    rank = int((values > RANK_TOLERANCE * squares).sum())
    captured = values[:rank] / variance if variance > 0 else values[:rank]
    return PCA(
        np.ascontiguousarray(_fixed_signs(vectors[:, :rank]).T, dtype=np.float32),
        (mean / sqrt_weights).astype(np.float32),
        sqrt_weights,
        captured,
    )


def _blocks(rows, index):
    for first in range(0, len(index), BLOCK_ROWS):
        yield rows(index[first : first + BLOCK_ROWS])


def _moments(rows, index, sqrt_weights):
    """Weighted mean (s,) float64 of the rows and the sum of their squares."""

    def moments(chunk):
        total = np.zeros(len(sqrt_weights))
        squares = 0.0
        for block in _blocks(rows, chunk):
            total += block.sum(axis=0)
            block *= sqrt_weights
            squares += float(np.vdot(block, block))
        return total, squares

    totals, squares = zip(*map_chunks(moments, np.array_split(index, CHUNKS)))
    return sum(totals) / len(index) * sqrt_weights, sum(squares)


def _subspace_iteration(rows, index, mean, sqrt_weights, components, subspace, seed, progress):
    random = np.random.default_rng(seed)
    basis = random.standard_normal((len(sqrt_weights), subspace)).astype(np.float32)
    sample = index
    if len(index) > 40 * subspace:
        # At random, not every fourth: the order of points may repeat.
        sample = np.sort(random.choice(index, len(index) // 4, replace=False))
    passes = [sample] * SAMPLE_ITERATIONS + [index] * ITERATIONS
    for done, part in enumerate(passes, start=1):
        basis = np.linalg.qr(_covariance_times(rows, part, mean, sqrt_weights, basis))[0].astype(np.float32)
        progress(done, len(passes) + 1)

    def gram(chunk):
        return sum(narrow.T @ narrow for _, narrow in _narrow(rows, chunk, mean, sqrt_weights, basis))

    ritz = sum(g.astype(np.float64) for g in map_chunks(gram, np.array_split(index, CHUNKS)))
    progress(len(passes) + 1, len(passes) + 1)
    values, rotation = scipy.linalg.eigh(ritz)
    leading = slice(None, -components - 1, -1)
    return np.maximum(values[leading], 0), basis @ rotation[:, leading]


def _covariance_times(rows, index, mean, sqrt_weights, basis):
    """XᵀX·basis for the centred, weighted rows X."""

    def product(chunk):
        product = np.zeros(basis.shape)
        total = np.zeros(basis.shape[1])
        for block, narrow in _narrow(rows, chunk, mean, sqrt_weights, basis):
            product += block.T @ narrow
            total += narrow.sum(axis=0, dtype=np.float64)
        return product, total

    products, totals = 0.0, 0.0
    for one, total in map_chunks(product, np.array_split(index, CHUNKS)):
        products, totals = products + one, totals + total
    return products * sqrt_weights[:, None] - np.outer(mean, totals)


def _narrow(rows, index, mean, sqrt_weights, basis):
    """Blocks of rows and their product X·basis; weights and mean are applied to the narrow side only."""
    weighted = basis * sqrt_weights[:, None]
    centre = (mean @ basis).astype(np.float32)
    for block in _blocks(rows, index):
        yield block, block @ weighted - centre


def _exact(rows, index, mean, sqrt_weights, components):
    """Leading eigenpairs of the s × s or n × n Gram matrix, whichever is smaller, in float64."""
    n, s = len(index), len(mean)
    keep = [min(n, s) - min(components, min(n, s)), min(n, s) - 1]
    centred = (block.astype(np.float64) * sqrt_weights - mean for block in _blocks(rows, index))
    if keep[0] > keep[1]:
        return np.zeros(0), np.zeros((s, 0))
    if s <= n:
        gram = np.zeros((s, s))
        for block in centred:
            gram += block.T @ block
        values, vectors = scipy.linalg.eigh(gram, subset_by_index=keep)
        return np.maximum(values[::-1], 0), vectors[:, ::-1]
    matrix = np.concatenate(list(centred))
    values, left = scipy.linalg.eigh(matrix @ matrix.T, subset_by_index=keep)
    values, left = np.maximum(values[::-1], 0), left[:, ::-1]
    return values, matrix.T @ left / np.maximum(np.sqrt(values), 1e-300)


def _fixed_signs(vectors):
    """Make each vector's largest entry positive, so that the same data give the same basis."""
    largest = np.abs(vectors).argmax(axis=0)
    return vectors * np.where(vectors[largest, np.arange(vectors.shape[1])] < 0, -1, 1)
