"""Principal components of transport (Eigentransport, section 3), fitted over blocks of rows.

Rows are weighted by √w, the square root of each direction's solid angle, so that what is minimised is the L2 error
over the sphere whatever the lattice (erratum 2 of the project's reading of the paper).
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

OVERSAMPLING = 16
ITERATIONS = 4
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
        return ((rows - self.mean) * self.sqrt_weights) @ self.vectors.T

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
        compensated = coefficients + (self.mean * self.sqrt_weights) @ self.vectors.T
        return compensated @ (self.vectors @ (radiance * self.sqrt_weights[:, None]))


def fit_pca(blocks, shape, weights, components, seed=0):
    """Fit the basis to a matrix that is only ever seen in blocks of rows.

    The leading subspace comes from block subspace iteration on the covariance (a randomized range finder with 4 power
    iterations: the captured variance falls short of the optimum by less than 1e-3 of it for the spectra of transport);
    small problems are solved by an exact eigendecomposition.

    Parameters
    ----------
    blocks : callable returning an iterable of (b, s) float32
        All rows in the same order at each call.
    shape : (n, s)
    weights : (s,) float
        Solid angles in sr.
    components : int
        d; fewer are returned where the matrix has a lower rank.
    seed : int
        Of the random start.

    Returns
    -------
    PCA
    """
    n, s = shape
    sqrt_weights = np.sqrt(weights).astype(np.float32)
    mean, variance = _moments(blocks, n, s, sqrt_weights)
    largest = min(n - 1, s)
    subspace = components + max(OVERSAMPLING, components // 4)
    if subspace > largest / 3 or min(n, s) <= EXACT_SIDE:
        values, vectors = _exact(blocks, n, s, mean, sqrt_weights, components)
    else:
        values, vectors = _subspace_iteration(blocks, s, mean, sqrt_weights, components, subspace, seed)
    # Directions whose singular value is rounding noise against the largest carry nothing (NumPy's rank tolerance).
    tolerance = (max(n, s) * np.finfo(np.float32).eps) ** 2
    rank = int((values > tolerance * max(values.max(initial=0.0), _rounding_floor(mean, n))).sum())
    vectors = _fixed_signs(vectors[:, :rank])
    captured = values[:rank] / variance if variance > 0 else values[:rank]
    return PCA(
        np.ascontiguousarray(vectors.T, dtype=np.float32),
        (mean / sqrt_weights).astype(np.float32),
        sqrt_weights,
        captured.astype(np.float64),
    )


def _moments(blocks, n, s, sqrt_weights):
    """Weighted mean (s,) float64 and total variance Σ‖row − mean‖² of the rows."""
    total = np.zeros(s)
    squares = 0.0
    for block in blocks():
        total += block.sum(axis=0, dtype=np.float64)
        block = block * sqrt_weights
        squares += float(np.einsum("bs,bs->", block, block, dtype=np.float64))
    mean = total / n * sqrt_weights
    return mean, max(squares - n * float(mean @ mean), 0.0)


def _rounding_floor(mean, n):
    """Scale of the squared singular values that rows equal to the mean have from rounding alone."""
    return n * float(mean @ mean)


def _centred(blocks, mean, sqrt_weights, dtype=np.float32):
    centre = mean.astype(dtype)
    for block in blocks():
        yield block.astype(dtype, copy=False) * sqrt_weights.astype(dtype) - centre


def _subspace_iteration(blocks, s, mean, sqrt_weights, components, subspace, seed):
    basis = np.random.default_rng(seed).standard_normal((s, subspace)).astype(np.float32)
    for _ in range(ITERATIONS):
        basis = np.linalg.qr(_covariance_times(blocks, mean, sqrt_weights, basis))[0].astype(np.float32)
    ritz = basis.T.astype(np.float64) @ _covariance_times(blocks, mean, sqrt_weights, basis)
    values, rotation = scipy.linalg.eigh((ritz + ritz.T) / 2)
    leading = slice(None, -components - 1, -1)
    return np.maximum(values[leading], 0), basis @ rotation[:, leading]


def _covariance_times(blocks, mean, sqrt_weights, basis):
    product = np.zeros(basis.shape)
    for block in _centred(blocks, mean, sqrt_weights):
        product += block.T @ (block @ basis)
    return product


def _exact(blocks, n, s, mean, sqrt_weights, components):
    """Leading eigenpairs of the s × s or n × n Gram matrix, whichever is smaller, in float64."""
    largest = min(n, s)
    keep = [largest - min(components, largest), largest - 1]
    if s <= n:
        gram = np.zeros((s, s))
        for block in _centred(blocks, mean, sqrt_weights, np.float64):
            gram += block.T @ block
        values, vectors = scipy.linalg.eigh(gram, subset_by_index=keep)
        return np.maximum(values[::-1], 0), vectors[:, ::-1]
    rows = np.concatenate(list(_centred(blocks, mean, sqrt_weights, np.float64)))
    values, left = scipy.linalg.eigh(rows @ rows.T, subset_by_index=keep)
    values, left = np.maximum(values[::-1], 0), left[:, ::-1]
    vectors = rows.T @ left
    return values, vectors / np.maximum(np.sqrt(values), 1e-300)


def _fixed_signs(vectors):
    """Make each vector's largest entry positive, so that the same data give the same basis."""
    largest = np.abs(vectors).argmax(axis=0)
    return vectors * np.where(vectors[largest, np.arange(vectors.shape[1])] < 0, -1, 1)
