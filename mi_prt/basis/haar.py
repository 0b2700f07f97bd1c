"""Haar wavelets over the faces of a cubemap (Ng, Ramamoorthi and Hanrahan 2003), orthonormal over
the sphere.

The wavelets are unbalanced: they know the solid angle of every cell. Neighbours with values t₁, t₂
and weights w₁, w₂ become

    difference t₁ − t₂ of weight w₁w₂/(w₁ + w₂)   and   mean (w₁t₁ + w₂t₂)/(w₁ + w₂) of weight w₁ +
    w₂,

which keeps Σ w t². Each level does this to the columns in pairs and then to the rows in pairs (the
nonstandard decomposition), and the next level to the means of means. A value times the root of its
weight is an orthonormal coefficient; with aᵢ = √wᵢ tᵢ these are (√w₂ a₁ − √w₁ a₂)/√(w₁ + w₂) and
(√w₁ a₁ + √w₂ a₂)/√(w₁ + w₂). A constant has six, one a face.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from math import inf, log2, sqrt
from typing import cast

import numpy as np
import scipy.sparse

from ..directions import MAX_CUBEMAP_RESOLUTION, Cubemap
from ..errors import SettingsError
from ..system.schema import Array
from .basis import BASES, Basis, compute_anew
from .linear import LinearBasis
from .rows import Rows, encoded
from .target import Fit, Target, centred, check_room, shares

# for each wavelet of a shared set and direction: as a function, weighted, and to encode with
FIT_BYTES = 12


@BASES.register
@dataclass(frozen=True, eq=False)
class HaarBasis(Basis):
    """The k Haar wavelets of each transport row that matter most to it: the best approximation of
    the row by k of them.

    A row's coefficients are a row of a sparse matrix, which multiplied by the light's coefficients
    gives the irradiance.

    Parameters
    ----------
    sqrt_weights : (s,) float32
        √w of the cells of a cubemap.
    captured_variance : (k,) float64
        Energy of the rows' largest coefficient, their second largest, …, over the transport's
        variance.
    """

    sqrt_weights: np.ndarray
    captured_variance: np.ndarray

    kind = "haar"
    ARRAYS = ("sqrt_weights", "captured_variance")
    holds_reflections = False
    work = (3, 0)
    copies = 3.2  # indices are wider in memory

    @classmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=inf, keep=compute_anew):
        """See `fit_haar`."""
        return fit_haar(rows, target, seed, progress or _quiet, max_bytes)

    @classmethod
    def check(cls, directions, components):
        """See `check_haar`."""
        check_haar(directions, None if components == "auto" else components)

    def check_stored(self, directions):
        """On a cubemap whose sides are a power of two; see `Basis.check_stored`."""
        super().check_stored(directions)
        check_haar(directions, len(self))

    @classmethod
    def coefficient_bytes(cls, points, directions, components, rays_per_direction=1):
        """Each number with the index of its wavelet."""
        return points * components * (6 if directions <= 1 << 16 else 8)

    @classmethod
    def light_bytes(cls, directions, components):
        """Light in all wavelets."""
        return 4 * directions

    @classmethod
    def projection_bytes(cls, directions, components):
        """None: the transform is computed."""
        return 0

    @classmethod
    def shapes(cls, channels):
        """See `Basis.shapes`."""
        return {
            "sqrt_weights": Array("f4", ("s",), least=1e-12, unit="sr^(1/2)"),
            "captured_variance": Array("f8", ("d",)),
        }

    @classmethod
    def coefficient_shapes(cls, channels):
        """See `Basis.coefficient_shapes`."""
        return {
            "coefficients/indices": Array(("u2", "u4"), ("n", "d"), least=0, below="s"),
            "coefficients/values": Array("f4", ("n", "d"), unit="sr^(1/2)"),
        }

    @classmethod
    def pack(cls, coefficients):
        """See `Basis.pack`."""
        n, s = coefficients.shape
        index = coefficients.indices.reshape(n, -1)
        return {
            "coefficients/indices": index.astype(np.uint16 if s <= 1 << 16 else np.uint32),
            "coefficients/values": coefficients.data.reshape(n, -1),
        }

    @classmethod
    def unpack(cls, arrays, normals, directions):
        """See `Basis.unpack`."""
        values, index = arrays["coefficients/values"], arrays["coefficients/indices"]
        n, k = values.shape
        entries = (values.ravel(), index.ravel().astype(np.int32), row_ends(n, k))
        return scipy.sparse.csr_array(entries, shape=(n, directions))

    def __len__(self):
        """Number of coefficients of a row, k."""
        return len(self.captured_variance)

    @property
    def _transform(self):
        return haar_transform(round(sqrt(len(self.sqrt_weights) / 6)))

    def encode(self, rows):
        """Coefficients of transport rows (b, s): csr_array (b, s) float32 with exactly k entries a
        row, by column.

        A row that has fewer wavelets is filled up with zeros.
        """
        coefficients = self._transform.forward(np.array(rows, np.float32))
        count, s = coefficients.shape
        # Smallest first: with the largest last, NumPy is ten times slower on rows that are mostly
        # zeros, as these are.
        largest = np.argpartition(-np.abs(coefficients), len(self) - 1, axis=1)[:, : len(self)]
        largest.sort(axis=1)
        entries = np.take_along_axis(coefficients, largest, axis=1)
        ends = row_ends(count, len(self))
        return scipy.sparse.csr_array(
            (entries.ravel(), largest.ravel().astype(np.int32), ends), shape=(count, s)
        )

    def encode_all(self, transport, progress=None):
        """A csr_array (n, s)."""
        return encoded(
            self.encode, transport, progress, lambda b: scipy.sparse.vstack(b, format="csr")
        )

    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of coefficients (b, s)."""
        return self._transform.inverse(coefficients.toarray())

    def at(self, coefficients, cells):
        """Transport (b, k) float32 of points with coefficients (b, s) in some cells (b, k) of the
        cubemap each.

        It reads the 3·log₂ N + 1 wavelets that do not vanish in a cell.
        """
        wavelets, values = self._transform.support
        point = np.arange(len(cells))[:, None]
        found = coefficients[point, wavelets[cells].reshape(len(cells), -1)].toarray()
        return np.einsum("bkl,bkl->bk", found.reshape(*cells.shape, -1), values[cells])

    def project_light(self, radiance):
        """Light in all wavelets.

        Parameters
        ----------
        radiance : (s, 3) float32
            Mean radiance of each cell.

        Returns
        -------
        coefficients : (s, 3) float32
            ℓ, so that irradiance is c·ℓ.
        mean_response : (3,) float32
            Zero: this basis has no mean.
        """
        coefficients = self._transform.forward(np.array(radiance.T, np.float32, order="C"))
        return np.ascontiguousarray(coefficients.T), np.zeros(3, np.float32)


@BASES.register
class SharedHaarBasis(LinearBasis):
    """One set of Haar wavelets for all transport rows: those that carry the most energy of all rows
    together.
    """

    kind = "haar-shared"
    work = (2, 1)

    @classmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=inf, keep=compute_anew):
        """See `fit_haar_shared`."""
        return fit_haar_shared(rows, target, seed, progress or _quiet, max_bytes)

    @classmethod
    def check(cls, directions, components):
        """See `check_haar`."""
        check_haar(directions, None if components == "auto" else components)

    def check_stored(self, directions):
        """On a cubemap whose sides are a power of two; see `Basis.check_stored`."""
        super().check_stored(directions)
        check_haar(directions, len(self))

    @classmethod
    def fit_bytes(cls, points, directions, components):
        """The wavelets as functions."""
        return FIT_BYTES * components * directions


class HaarTransform:
    """The orthonormal Haar transform of functions on a cubemap.

    It works in place (lifting): 2 × 2 cells leave their mean at the last of them, where the next
    level finds it, and their details at the three others. The index of a coefficient is thus that
    of a cell. A face's mean is at its last cell. For the details of level e, row and column end in
    e binary ones; the bit before these is 0 in the row for a difference of rows, in the column for
    a difference of columns, and in both for the difference of differences.

    Parameters
    ----------
    resolution : int
        N, a power of two.
    """

    def __init__(self, resolution):
        self.resolution = resolution
        weights = (
            Cubemap(resolution).solid_angles[: resolution**2].reshape(resolution, resolution).copy()
        )
        # w₁/(w₁ + w₂) of each level's pairs: of columns (2m, m) and of rows (m, 2m)
        self._shares = []
        level = weights
        while len(level) > 1:
            self._shares.append(
                tuple(_merge_weights(*pairs).astype(np.float32) for pairs in _pairs(level[None]))
            )
            level = level[1::2, 1::2]
        self._roots = np.sqrt(weights).astype(np.float32)  # of what each coefficient weighs

    def forward(self, rows):
        """Coefficients (b, s) float32 in the √w-weighted space of functions (b, s); a float32 array
        is overwritten.
        """
        faces = self._faces(rows)
        self._analyse(faces, 0)
        faces *= self._roots
        return faces.reshape(rows.shape)

    def inverse(self, coefficients):
        """Functions (b, s) float32 of coefficients (b, s); a float32 array is overwritten."""
        faces = self._faces(coefficients)
        faces /= self._roots
        self._synthesise(faces, 0)
        return faces.reshape(coefficients.shape)

    @cached_property
    def support(self):
        """The wavelets that do not vanish in a cell, and their values there.

        Returns
        -------
        wavelets : (s, 3·log₂ N + 1) int64
        values : (s, 3·log₂ N + 1) float32
            Without weights: a function's value in cell j is Σ of its coefficients `wavelets[j]`
            times `values[j]`.
        """
        n = self.resolution
        rows, columns = np.indices((n, n)).reshape(2, -1)
        wavelets, values = [np.full(n * n, n * n - 1)], [np.ones(n * n, np.float32)]
        for level, (column_shares, row_shares) in enumerate(self._shares):
            row, column = rows >> level, columns >> level
            block_row, block_column = row // 2, column // 2
            # What a difference adds to the first of its pair, and to the second, for which the mean
            # stands.
            across = (column % 2 == 0) - column_shares[row, block_column]
            down_difference = (row % 2 == 0) - row_shares[block_row, 2 * block_column]
            down_mean = (row % 2 == 0) - row_shares[block_row, 2 * block_column + 1]
            details = {(0, 0): across * down_difference, (0, 1): down_mean, (1, 0): across}
            for (i, j), value in details.items():
                place = [
                    ((2 * block + last + 1) << level) - 1
                    for block, last in ((block_row, i), (block_column, j))
                ]
                wavelets.append(place[0] * n + place[1])
                values.append(value)
        wavelets, values = np.stack(wavelets, axis=1), np.stack(values, axis=1)
        values /= self._roots.ravel()[wavelets]
        faces = np.arange(6)[:, None, None] * (n * n)
        return (faces + wavelets).reshape(6 * n * n, -1), np.tile(values, (6, 1))

    def _faces(self, rows):
        return np.ascontiguousarray(rows, np.float32).reshape(-1, self.resolution, self.resolution)

    def _analyse(self, faces, level):
        if level == len(self._shares):
            return
        for (first, second), share in zip(_pairs(faces), self._shares[level]):
            first -= second
            second += share * first
        means = faces[:, 1::2, 1::2].copy()  # close together they are faster to work on
        self._analyse(means, level + 1)
        faces[:, 1::2, 1::2] = means

    def _synthesise(self, faces, level):
        if level == len(self._shares):
            return
        means = faces[:, 1::2, 1::2].copy()
        self._synthesise(means, level + 1)
        faces[:, 1::2, 1::2] = means
        for (first, second), share in zip(reversed(_pairs(faces)), reversed(self._shares[level])):
            second -= share * first
            first += second


haar_transform = cache(HaarTransform)


def _quiet(done, total):
    """The progress of a fit that nobody follows."""


def row_ends(rows, entries):
    """Where the rows of a sparse array end that have so many entries each; of 32 bits, as SciPy
    then keeps the indices too.
    """
    return np.arange(rows + 1, dtype=np.int32 if rows * entries < 1 << 31 else np.int64) * entries


def _pairs(faces):
    """Views of the first and the second of neighbouring columns, and of neighbouring rows."""
    return (faces[:, :, 0::2], faces[:, :, 1::2]), (faces[:, 0::2], faces[:, 1::2])


def _merge_weights(first, second):
    """Put the weights of differences and means in the place of weights w₁, w₂; returns w₁/(w₁ + w₂)
    of one face.
    """
    both = first + second
    share = first / both
    first *= second / both
    second[...] = both
    return share[0]


def fit_haar(
    rows: Rows, target: Target, seed=0, progress=lambda done, total: None, max_bytes=inf
) -> Fit:
    """Find how many Haar wavelets a row are wanted, each row with its own, and how well they
    represent the rows.

    Parameters
    ----------
    rows : Rows
        On a cubemap whose resolution is a power of two.
    target : Target
        1…s components, or a share of the variance of all rows together.
    seed : int
        Not used: nothing is random.
    progress : callable(done, total)
        Called after the one pass over the rows.
    max_bytes : float
        Memory that the fit may take; this one takes next to nothing.

    Returns
    -------
    Fit
        Of a `HaarBasis`.

    Raises
    ------
    SettingsError
        If the lattice is another, or the number of components out of range.
    """
    check_haar(rows.directions, target.components)
    energies, variance = _energies(rows, ranked=True)
    progress(1, 1)
    components, residual = _fewest(target, energies, variance)
    basis = HaarBasis(rows.sqrt_weights, shares(energies[:components], variance))
    return Fit(basis, residual, variance, energies.sum())


def fit_haar_shared(
    rows: Rows, target: Target, seed=0, progress=lambda done, total: None, max_bytes=inf
) -> Fit:
    """Find the one set of Haar wavelets that carries the most energy of all rows.

    Parameters, progress and errors are those of `fit_haar`; the wavelets as functions must fit into
    `max_bytes`.

    Returns
    -------
    Fit
        Of a `SharedHaarBasis`, its wavelets in descending order of energy.
    """
    check_haar(rows.directions, target.components)
    energies, variance = _energies(rows, ranked=False)
    progress(1, 1)
    order = np.argsort(-energies, kind="stable")
    components, residual = _fewest(target, energies[order], variance)
    s = len(energies)
    check_room(f"a basis of {components:,} wavelets", FIT_BYTES * components * s, max_bytes)
    chosen, lattice = order[:components], cast(Cubemap, rows.directions)
    vectors = np.zeros((components, s), np.float32)
    vectors[np.arange(components), chosen] = 1
    basis = SharedHaarBasis(
        haar_transform(lattice.resolution).inverse(vectors) * rows.sqrt_weights,
        np.zeros(s, np.float32),
        rows.sqrt_weights,
        shares(energies[chosen], variance),
    )
    return Fit(basis, residual, variance, energies.sum())


def _energies(rows, ranked):
    """Energies (s,) of the coefficients of all rows, and the rows' variance.

    They are of each wavelet, or `ranked` of the rows' largest coefficient, their second largest, ….
    """
    transform = haar_transform(rows.directions.resolution)
    s = rows.shape[1]

    def sums(chunk):
        energies, total = np.zeros((2, s))
        for block in rows.blocks(chunk):
            coefficients = transform.forward(block)
            total += coefficients.sum(axis=0)
            squares = np.square(coefficients, out=coefficients)
            if ranked:
                squares.sort(axis=1)
                squares = squares[:, ::-1]
            energies += squares.sum(axis=0)
        return energies, total

    energies, total = rows.sums(sums)
    return energies, centred(float(energies.sum()), total, len(rows.index))


def check_haar(directions, components=None):
    """Raise SettingsError where there are no Haar wavelets on a lattice, or not so many; see
    `fit_haar`.
    """
    if not (isinstance(directions, Cubemap) and directions.resolution.bit_count() == 1):
        below = 2 ** int(log2(min(max(sqrt(len(directions) / 6), 1), MAX_CUBEMAP_RESOLUTION // 2)))
        raise SettingsError(
            f"Haar wavelets need a cubemap whose resolution is a power of two, got {directions}:"
            f" use cubemap:{below} or cubemap:{2 * below}"
        )
    if components is not None and not 1 <= components <= len(directions):
        raise SettingsError(
            f"{components:,} Haar wavelets are outside 1…{len(directions):,}, the number of"
            " directions: ask for one within"
        )


def _fewest(target, energies, variance):
    """How many of all energies, in descending order, the target takes, and how much is then
    left.
    """
    left = np.append(np.cumsum(energies[::-1])[::-1], 0.0)
    components = target.components
    if components is None:
        components = max(1, int(np.argmax(left <= target.allowed_residual(variance, left[0]))))
    return components, float(left[components])
