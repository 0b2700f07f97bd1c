"""Principal components of transport (Eigentransport, section 3), fitted over blocks of rows.

Rows are weighted by √w, the square root of each direction's solid angle, so that what is minimised
is the L2 error over the sphere whatever the lattice (erratum 2 of the project's reading of the
paper).

Two ways lead to them, and the cheaper one for the shape at hand is taken:

- the Gram matrix of the smaller side, summed over blocks and decomposed in float64: exact to
  rounding;
- block subspace iteration on the covariance, at first on a sample of the rows, and a Rayleigh-Ritz
  projection on the span
  of its last two subspaces (a block Lanczos step). The variance that it reports is what its vectors
  do capture, and by Halko, Martinsson and Tropp (2011, theorem 10.6 and corollary 10.10) the
  spectral error of such a subspace after q iterations is in the mean at most (1 + √(d/(p − 1)) +
  e·√(d + p)/p · √(min(n, s) − d))^(1/(2q + 1)) times that of the best, with oversampling p.
  Measured losses of captured variance are 1e-6 (docs/architecture.md).
"""

import numpy as np
import scipy.linalg

from ..system.parallel import map_chunks, one_blas_thread
from ..system.runtime import thread_count
from .basis import BASES, compute_anew
from .linear import LinearBasis
from .rows import CHUNKS, Rows
from .target import Fit, Target, check_room

OVERSAMPLING = 16
# power iterations on a quarter of the rows, which find nearly the subspace of all
SAMPLE_ITERATIONS = 2
ITERATIONS = 2  # power iterations on all rows, before the final projection
# of squared singular values, against the sum of squares
RANK_TOLERANCE = 100 * float(np.finfo(np.float32).eps) ** 2
FIRST_COMPONENTS = 64  # where a search for a share of the variance starts
MARGIN = 1.1  # above what that search expects to need

# Seconds on two cores, of which only the ratios matter: for each element of a row and column of the
# subspace, for each element of a row, for each product of the Gram matrix, and for each s³ of its
# decomposition.
ITERATION_COST, ROW_COST, GRAM_COST, DECOMPOSITION_COST = 1.3e-10, 4e-9, 2e-11, 6e-11
GRAM_PARTS = 2  # parts of a Gram matrix that there are at a time, on any number of threads
# for each entry of a Gram matrix: the sum, these parts, the decomposition
GRAM_BYTES = 40
GRAM_ROWS = 1024  # rows of one product: fewer would pass over the Gram matrix too often
NEGLIGIBLE = 0.5  # seconds that exactness is worth
MOST_GRAM_BYTES = 1 << 29  # a larger Gram matrix is no choice, only where there is no other
# for each direction and column of the subspace: sums of some threads in float64, and the
# orthonormalization
ITERATION_BYTES, SUM_BYTES = 94, 8  # the latter for each thread


@BASES.register
class PCA(LinearBasis):
    """Eigentransport: the orthonormal components that capture the most variance of a scene's own
    transport.
    """

    kind = "pca"
    why = "components of this scene's own transport: the least error for their number"
    joins_channels = True
    work = (3, 20)

    @classmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=np.inf, keep=compute_anew):
        """See `fit_pca`."""
        return fit_pca(rows, target, seed, progress or _quiet, max_bytes, keep)

    @classmethod
    def most_components(cls, directions, points):
        """The rank that centred transport can have."""
        return min(points - 1, len(directions))

    @classmethod
    def fit_bytes(cls, points, directions, components):
        """See `fit_bytes` of this module."""
        return fit_bytes(points, directions, components)

    def paper_irradiance(self, coefficients, radiance):
        """Irradiance (n, 3) by the paper's mean compensation (eqs. 3 and 8–10), for comparison.

        It drops the part of the mean transport outside the span of the basis (erratum 1).
        """
        compensated = coefficients + self._encoder[1]
        return compensated @ self.project_light(radiance)[0]


def _quiet(done, total):
    """The progress of a fit that nobody follows."""


def fit_pca(
    rows: Rows,
    target: Target,
    seed=0,
    progress=_quiet,
    max_bytes=np.inf,
    keep=compute_anew,
) -> Fit:
    """Fit principal components to a matrix that is only ever seen in blocks of rows.

    Parameters
    ----------
    rows : Rows
    target : Target
        Fewer components are returned where the matrix has a lower rank.
    seed : int
        Of the random start.
    progress : callable(done, total)
        Called after every pass over the rows.
    max_bytes : float
        Memory that the fit may take.
    keep : callable(name, compute) returning an array
        Called for what each pass over the rows gives, so that a caller may store and restore it;
        `name` tells the pass.

    Returns
    -------
    Fit
        Of a `PCA`.

    Raises
    ------
    SettingsError
        If it does not fit into `max_bytes`.
    """
    mean, squares = _unpacked(keep("moments", lambda: np.append(*rows.moments())))
    n, s = rows.shape
    variance = max(squares - n * float(mean @ mean), 0.0)
    largest = min(n - 1, s)
    components = min(FIRST_COMPONENTS, largest) if target.components is None else target.components
    vectors = np.zeros((s, 0), np.float32)
    while True:
        values, vectors = _leading(rows, mean, components, vectors, seed, progress, keep, max_bytes)
        # Rows are float32: what is below their rounding carries nothing.
        values = values[values > RANK_TOLERANCE * squares]
        enough = target.variance is None or values.sum() >= target.variance * variance
        if enough or components >= largest or len(values) < components:
            break
        components = min(_more(values, variance, target.variance), largest)
    if target.variance is not None and enough:
        values = values[: 1 + int(np.searchsorted(np.cumsum(values), target.variance * variance))]
    basis = PCA(
        np.ascontiguousarray(fixed_signs(vectors[:, : len(values)]).T, dtype=np.float32),
        (mean / rows.sqrt_weights).astype(np.float32),
        rows.sqrt_weights,
        values / variance if variance > 0 else values,
    )
    return Fit(basis, max(variance - values.sum(), 0.0), variance, squares)


def _unpacked(moments):
    return moments[:-1], float(moments[-1])


def _more(values, variance, share):
    """How many components to try next for a share of the variance, where these did not capture it.

    What is left falls about as a power of their number, which the second half of them tells.
    """
    d = len(values)
    left = variance - np.cumsum(values)
    power = np.log(left[d // 2 - 1] / left[-1]) / np.log(d / (d // 2))
    wanted = d * (left[-1] / ((1 - share) * variance)) ** (1 / max(power, 0.1))
    return int(np.clip(MARGIN * wanted, d + OVERSAMPLING, 4 * d))


def fit_bytes(n, s, components):
    """Memory that fitting so many components to a matrix (n, s) takes."""
    return _plan(n, s, components)[1]


def _plan(n, s, components):
    """Whether the Gram matrix is used, and the bytes that the way chosen takes.

    It does not depend on how much memory there is: the same run gives the same result anywhere.
    """
    subspace = _subspace(components)
    side = min(n, s)
    gram_bytes = GRAM_BYTES * side**2 + (16 * n * s if n < s else 0)
    sums = SUM_BYTES * min(CHUNKS, thread_count())
    iteration_bytes = (ITERATION_BYTES + sums) * s * subspace
    iteration = n * s * (subspace * ITERATION_COST + ROW_COST)
    gram = n * s * side * GRAM_COST + side**3 * DECOMPOSITION_COST
    # Subspaces that together reach a large part of the space are no smaller problem than the whole.
    exact = 2 * subspace > side or (
        gram_bytes <= MOST_GRAM_BYTES and gram <= max(iteration, NEGLIGIBLE)
    )
    return exact, gram_bytes if exact else iteration_bytes


def _subspace(components):
    return components + max(OVERSAMPLING, components // 4)


def _leading(rows, mean, components, start, seed, progress, keep, max_bytes):
    """Leading squared singular values, descending, and right singular vectors (s, components) of
    the centred, weighted rows.
    """
    n, s = rows.shape
    exact, needed = _plan(n, s, components)
    check_room(f"fitting {components:,} components", needed, max_bytes)
    if exact:
        return _exact(rows, mean, components, progress)
    return _subspace_iteration(rows, mean, components, start, seed, progress, keep)


def _subspace_iteration(rows, mean, components, start, seed, progress, keep):
    """`start` (s, k) are vectors of an earlier fit with fewer components: what they span need not
    be found again.
    """
    subspace = _subspace(components)
    random = np.random.default_rng(seed)
    basis = random.standard_normal((len(mean), subspace)).astype(np.float32)
    basis[:, : start.shape[1]] = start
    sample = rows.index
    if len(sample) > 40 * subspace:
        # At random, not every fourth: the order of points may repeat.
        sample = np.sort(random.choice(sample, len(sample) // 4, replace=False))
    passes = [sample] * (0 if start.shape[1] else SAMPLE_ITERATIONS) + [rows.index] * ITERATIONS
    for done, part in enumerate(passes, start=1):
        before = basis
        basis = keep(f"subspace-{subspace}-{done}", lambda: _iterated(rows, part, mean, before))
        progress(done, len(passes) + 1)
    span = _orthonormal(np.concatenate([before, basis], axis=1))

    def gram(chunk):
        return (
            sum(
                (narrow.T @ narrow).astype(np.float64)
                for _, narrow in _narrow(rows, chunk, mean, span)
            ),
        )

    (ritz,) = rows.sums(gram)
    progress(len(passes) + 1, len(passes) + 1)
    leading = slice(None, -components - 1, -1)
    with one_blas_thread():
        values, rotation = scipy.linalg.eigh(ritz)
        return np.maximum(values[leading], 0), span @ rotation[:, leading]


def _iterated(rows, index, mean, basis):
    """An orthonormal basis of XᵀX·basis for the centred, weighted rows X of an index."""

    def product(chunk):
        product = np.zeros(basis.shape)
        total = np.zeros(basis.shape[1])
        for block, narrow in _narrow(rows, chunk, mean, basis):
            product += block.T @ narrow
            total += narrow.sum(axis=0, dtype=np.float64)
        return product, total

    product, total = rows.sums(product, index)
    return _orthonormal(product * rows.sqrt_weights[:, None] - np.outer(mean, total))


def _orthonormal(vectors):
    with one_blas_thread():
        return np.linalg.qr(vectors)[0].astype(np.float32)


def _narrow(rows, index, mean, basis):
    """Blocks of rows and their product X·basis; weights and mean are applied to the narrow side
    only.
    """
    weighted = basis * rows.sqrt_weights[:, None]
    centre = (mean @ basis).astype(np.float32)
    for block in rows.blocks(index):
        yield block, block @ weighted - centre


def _exact(rows, mean, components, progress):
    """Leading eigenpairs of the s × s or n × n Gram matrix, whichever is smaller, in float64."""
    n, s = rows.shape
    components = min(components, n, s)
    if components == 0:
        return np.zeros(0), np.zeros((s, 0))
    keep = [min(n, s) - components, min(n, s) - 1]
    chunks = np.array_split(rows.index, -(-n // GRAM_ROWS))

    def centred(chunk):
        return (
            np.concatenate([block * rows.sqrt_weights for block in rows.blocks(chunk)]).astype(
                np.float64
            )
            - mean
        )

    def reported(parts):
        for done, part in enumerate(parts, start=1):
            progress(done, len(chunks))
            yield part

    if s <= n:
        gram = np.zeros((s, s))
        products = map_chunks(lambda chunk: (block := centred(chunk)).T @ block, chunks, GRAM_PARTS)
        for part in reported(products):
            gram += part
        with one_blas_thread():
            values, vectors = scipy.linalg.eigh(gram, subset_by_index=keep, overwrite_a=True)
        return np.maximum(values[::-1], 0), vectors[:, ::-1]
    matrix = np.concatenate(list(reported(map_chunks(centred, chunks))))
    gram = np.concatenate(
        list(map_chunks(lambda part: part @ matrix.T, np.array_split(matrix, len(chunks))))
    )
    with one_blas_thread():
        values, left = scipy.linalg.eigh(gram, subset_by_index=keep, overwrite_a=True)
        values, left = np.maximum(values[::-1], 0), left[:, ::-1]
        return values, matrix.T @ left / np.maximum(np.sqrt(values), 1e-300)


def fixed_signs(vectors):
    """Make each vector's largest entry positive, so that the same data give the same basis."""
    largest = np.abs(vectors).argmax(axis=0)
    return vectors * np.where(vectors[largest, np.arange(vectors.shape[1])] < 0, -1, 1)
