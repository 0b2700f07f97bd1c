"""Real spherical harmonics: their values, how they turn with the sphere, and the basis of transport
that they make.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf, isqrt, pi, sqrt
from typing import Any

import numpy as np
import scipy.linalg

from ..errors import SettingsError
from ..lighting.light import Light
from ..lighting.part import DistantPart
from ..lighting.rotation import rotation_matrix
from ..lighting.values import rgb_factor
from .basis import BASES, Basis, compute_anew
from .linear import LinearBasis
from .rows import Rows
from .target import Fit, Target, centred, check_room, shares

# 1,089 functions: far beyond what low-frequency light needs, and cheap to turn still
MAX_BANDS = 33
DEFAULT_HARMONICS = 49  # 7 bands
FIRST_BANDS = 10  # where a search for a share of the variance starts
FIT_BYTES = 32  # for each function and direction: in float64, made orthonormal, and in float32
# of the functions' Gram matrix over a lattice's directions; 1 on the sphere
LEAST_EIGENVALUE = 0.25


def evaluate(vectors, bands):
    """Real spherical harmonics, orthonormal over the sphere.

    Their order is l·l + l + m with m = −l…l. With the polar angle θ from +z and the azimuth φ from
    +x towards +y they are √2 P̄ₗᵐ(cos θ) cos mφ for m > 0, √2 P̄ₗ^|m|(cos θ) sin |m|φ for m < 0 and
    P̄ₗ(cos θ) for m = 0, P̄ normalized and without the Condon-Shortley phase: l = 1 is √(3/4π) (y,
    z, x).

    Parameters
    ----------
    vectors : (k, 3) array
        Directions of any positive length.
    bands : int
        Number of bands l = 0…bands − 1.

    Returns
    -------
    (bands², k) float64
    """
    vectors = np.asarray(vectors, np.float64)
    x, y, z = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).T
    sine, azimuth = np.hypot(x, y), np.arctan2(y, x)
    values = np.empty((bands * bands, len(vectors)))
    sectoral = np.full(len(vectors), sqrt(1 / (4 * pi)))  # P̄ₘᵐ
    for m in range(bands):
        if m > 0:
            sectoral = sectoral * sine * sqrt(1 + 1 / (2 * m))
        cosine_m, sine_m = sqrt(2) * np.cos(m * azimuth), sqrt(2) * np.sin(m * azimuth)
        # P̄ₗ₋₁ᵐ and P̄ₗᵐ by the recurrence in l, which is stable upwards
        before, legendre = 0.0, sectoral
        for band in range(m, bands):
            if band > m:
                grow = sqrt((4 * band * band - 1) / (band * band - m * m))
                shrink = sqrt(((band - 1) ** 2 - m * m) / (4 * (band - 1) ** 2 - 1))
                before, legendre = legendre, grow * (z * legendre - shrink * before)
            values[band * band + band - m] = legendre * sine_m
            values[band * band + band + m] = legendre * cosine_m if m > 0 else legendre
    return values


def rotation(matrix, bands):
    """How spherical harmonics turn: Y(R ω) = D Y(ω), D of one block for each band.

    Light L turned by R is L(R⁻¹ω), and its coefficients are Dℓ. The blocks follow from those of l =
    1 by the recursion of Ivanic and Ruedenberg (J. Phys. Chem. 100, 1996, tables 1 and 2, with the
    additions and corrections of 102, 1998). Every term is a product of l = 1 and l − 1, so that a
    reflection's sign (−1)ˡ comes out of it by itself.

    Parameters
    ----------
    matrix : (3, 3) array
        R, a rotation or a reflection.
    bands : int

    Returns
    -------
    list of (2l + 1, 2l + 1) float64
        For l = 0…bands − 1.

    Raises
    ------
    SettingsError
        If the matrix does not keep lengths.
    """
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4):
        raise SettingsError(
            "spherical harmonics turn by a rotation or a reflection (3, 3), without scale or"
            f" shear, got {matrix.tolist()}"
        )
    order = [1, 2, 0]  # l = 1 is y, z, x
    first = matrix[np.ix_(order, order)]
    blocks = [np.ones((1, 1)), first][:bands]
    for band in range(2, bands):
        blocks.append(_next_block(first, blocks[-1], band))
    return blocks


def _next_block(first, before, band):
    """The block of a band l from those of bands 1 and l − 1, in the paper's notation.

    The square root of the denominator that u, v and w have in common is divided by at the end.
    """
    # Pᵢ of i = −1, 0, 1. Rows are μ of band l − 1, between zeros: u, v and w take μ beyond it, with
    # a factor of zero. Columns are m' of band l.
    p = np.zeros((3, 2 * band + 3, 2 * band + 1))
    p[:, 2:-2, 1:-1] = first[:, 1, None, None] * before
    p[:, 2:-2, 0] = first[:, 2, None] * before[:, 0] + first[:, 0, None] * before[:, -1]
    p[:, 2:-2, -1] = first[:, 2, None] * before[:, -1] - first[:, 0, None] * before[:, 0]
    minus, zero, plus = p
    centre = band + 1  # the row of μ = 0
    m = np.arange(1, band + 1)
    near, far = m - 1, m + 1
    u = np.sqrt(band * band - m * m)[:, None]
    v = np.sqrt((band + m) * (band + m - 1))[:, None] / 2
    w = -np.sqrt((band - m) * (band - m - 1))[:, None] / 2
    v_same, v_other = v * np.where(near == 0, sqrt(2), 1)[:, None], v * (near != 0)[:, None]
    block = np.empty((2 * band + 1, 2 * band + 1))
    block[band] = band * zero[centre] - sqrt(band * (band - 1) / 2) * (
        plus[centre + 1] + minus[centre - 1]
    )
    block[band + m] = (
        u * zero[centre + m] + v_same * plus[centre + near] - v_other * minus[centre - near]
    )
    block[band + m] += w * (plus[centre + far] + minus[centre - far])
    block[band - m] = (
        u * zero[centre - m] + v_same * minus[centre + near] + v_other * plus[centre - near]
    )
    block[band - m] += w * (plus[centre - far] - minus[centre + far])
    denominators = band * band - np.arange(-band, band + 1) ** 2
    denominators[[0, -1]] = 2 * band * (2 * band - 1)
    return block / np.sqrt(denominators)


def rotate(coefficients, matrix):
    """Coefficients (bands², channels) of light after it is turned by a (3, 3) rotation or
    reflection; see `rotation`.
    """
    blocks = rotation(matrix, _bands_of(len(coefficients)))
    return np.concatenate(
        [block @ coefficients[band * band : (band + 1) ** 2] for band, block in enumerate(blocks)]
    )


@BASES.register
class HarmonicBasis(LinearBasis):
    """Spherical harmonics (Sloan, Kautz and Snyder 2002), sampled in the directions of a lattice.

    There they are orthonormal only nearly: encoding is the least-squares projection on them, so
    that a reconstruction is the best that they allow, and its response to light is c·ℓ exactly. The
    mean is zero.
    """

    kind = "sh"
    work = (1, 2)

    @classmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=inf, keep=compute_anew):
        """See `fit_harmonics`."""
        return fit_harmonics(rows, target, seed, progress or _quiet, max_bytes)

    @classmethod
    def check(cls, directions, components):
        """See `check_harmonics`."""
        check_harmonics(directions, None if components == "auto" else components)

    @classmethod
    def default_components(cls, directions, points):
        """Seven bands, or as many as the lattice tells apart."""
        return most_harmonics(directions, DEFAULT_HARMONICS)

    @classmethod
    def fit_bytes(cls, points, directions, components):
        """The harmonics as functions."""
        return FIT_BYTES * components * directions

    def check_stored(self, directions):
        """All functions of its bands are there; see `Basis.check_stored`."""
        super().check_stored(directions)
        if self.bands**2 != len(self):
            raise ValueError(f"{len(self)} spherical harmonics are no whole bands")

    @property
    def bands(self):
        """Number of bands."""
        return isqrt(len(self))

    @cached_property
    def duals(self):
        """The rows (d, s) whose products with a weighted row are its least-squares coefficients."""
        vectors = self.vectors.astype(np.float64)
        return scipy.linalg.solve(vectors @ vectors.T, vectors, assume_a="pos").astype(np.float32)

    def project(self, light, directions):
        """Light (d, 3) float32 in the basis, and no mean response; maps that `prepare` returned are
        turned in closed form.
        """
        functions = str(directions), len(self)
        known = [p for p in light.parts if getattr(p, "functions", None) == functions]
        others = Light(p for p in light.parts if p not in known)
        coefficients, mean = super().project(others, directions)
        return sum((m.turned() for m in known), coefficients), mean

    def truncated(self, components):
        """See `Basis.truncated`: whole bands."""
        _bands_of(components)
        return super().truncated(components)

    project_all = Basis.project_all  # by `project`, which knows maps that turn in closed form

    def prepare(self, light, directions):
        """A `Light` whose maps turn in closed form."""
        maps = Light(part for part in light.parts if part.is_environment)
        prepared = super().prepare(light, directions)
        if maps.is_empty:
            return prepared
        coefficients = super().project(maps, directions)[0]
        functions = str(directions), len(self)
        return Light(
            HarmonicMap(part, functions, coefficients) if part.is_environment else part
            for part in prepared.parts
        )


@dataclass(frozen=True, eq=False)
class HarmonicMap(DistantPart):
    """Environment maps and their spherical harmonics, which turn in closed form.

    To a `HarmonicBasis` of the same functions it is its coefficients, to everything else the map.

    Parameters
    ----------
    environment : LatticeMap
        As it is turned now.
    functions : (str, int)
        Lattice and number of the harmonics.
    coefficients : (d, 3) float32
        ℓ before anything is turned.
    rotation : (3, 3) float64
    """

    environment: Any
    functions: tuple
    coefficients: np.ndarray
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    kind = "environment in spherical harmonics"
    is_environment = True
    pixels = None  # none of an equirectangular map

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(
            self,
            environment=self.environment.scaled(factor),
            coefficients=self.coefficients * rgb_factor(factor).astype(np.float32),
        )

    def to_mitsuba(self):
        """See `LightPart.to_mitsuba`."""
        return self.environment.to_mitsuba()

    def radiance(self, directions, samples_per_side):
        """See `DistantPart.radiance`."""
        return self.environment.radiance(directions, samples_per_side)

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`,
        right-handed.
        """
        turn = rotation_matrix(axis, degrees)
        return replace(
            self, environment=self.environment.rotated(axis, degrees), rotation=turn @ self.rotation
        )

    def turned(self):
        """ℓ (d, 3) float32 after the rotation."""
        return rotate(self.coefficients, self.rotation).astype(np.float32)

    @property
    def size(self):
        """See `LatticeMap`."""
        return self.environment.size

    def at(self, vectors):
        """See `LatticeMap`."""
        return self.environment.at(vectors)

    def quadrature(self, spacing):
        """See `LatticeMap`."""
        return self.environment.quadrature(spacing)


def fit_harmonics(
    rows: Rows, target: Target, seed=0, progress=lambda done, total: None, max_bytes=inf
) -> Fit:
    """Find how many bands are wanted and how well they represent the rows.

    A lattice tells functions apart as long as the eigenvalues of their Gram matrix over its
    directions stay above `LEAST_EIGENVALUE`: on ``cubemap:N`` these are 2N bands.

    Parameters
    ----------
    rows : Rows
    target : Target
        A square number of components, or a share of the variance that the fewest bands are taken
        for.
    seed : int
        Not used: nothing is random.
    progress : callable(done, total)
        Called after every pass over the rows, which is the only one unless a large share of the
        variance is asked for.
    max_bytes : float
        Memory that the fit may take.

    Returns
    -------
    Fit
        Of a `HarmonicBasis`.

    Raises
    ------
    SettingsError
        If the number of components is not a square, or above what the lattice tells apart or
        `MAX_BANDS` gives, or if that many bands do not capture the share of the variance, or need
        more than `max_bytes`.
    """
    largest = MAX_BANDS**2 if target.components is None else target.components
    check_room(
        f"a basis of {largest:,} spherical harmonics",
        FIT_BYTES * largest * rows.shape[1],
        max_bytes,
    )
    functions, gram = _functions(rows.directions, target.components)
    most = isqrt(len(functions))
    bands = most if target.variance is None else min(FIRST_BANDS, most)
    while True:
        energies, variance, energy = _energies(
            rows, functions[: bands**2], gram[: bands**2, : bands**2]
        )
        progress(bands, most)
        # with 1…bands bands
        residuals = np.maximum(energy - np.cumsum(energies)[np.arange(1, bands + 1) ** 2 - 1], 0)
        if target.variance is None:
            break
        enough = residuals <= target.allowed_residual(variance, energy)
        if enough.any():
            bands = 1 + int(np.argmax(enough))
            break
        if bands == most:
            captured = Fit(None, residuals[-1], variance, energy).captured_variance
            raise SettingsError(
                f"spherical harmonics do not capture {target.variance} of the variance: the"
                f" {bands**2:,} that {rows.directions} allows capture {captured:.6g}; ask for less,"
                " or for another basis"
            )
        bands = min(2 * bands, most)
    progress(most, most)
    basis = HarmonicBasis(
        functions[: bands**2].astype(np.float32),
        np.zeros(functions.shape[1], np.float32),
        rows.sqrt_weights,
        shares(energies[: bands**2], variance),
    )
    return Fit(basis, residuals[bands - 1], variance, energy)


def _energies(rows, functions, gram):
    """Energy (d,) that each function adds to those before it, the rows' variance, and their
    energy.
    """
    # Orthonormal functions in the same order: the first b² span the first b bands for every b.
    nested = scipy.linalg.solve_triangular(
        scipy.linalg.cholesky(gram, lower=True), functions, lower=True
    )
    nested = np.ascontiguousarray(nested.T, np.float32)

    def sums(chunk):
        energies, total, energy = np.zeros(nested.shape[1]), np.zeros(len(nested)), 0.0
        for block in rows.blocks(chunk):
            block *= rows.sqrt_weights
            total += block.sum(axis=0)
            energy += float(np.vecdot(block, block).sum(dtype=np.float64))
            energies += np.square(block @ nested).sum(axis=0)
        return energies, total, energy

    energies, total, energy = rows.sums(sums)
    return energies, centred(energy, total, len(rows.index)), energy


def _quiet(done, total):
    """The progress of a fit that nobody follows."""


def check_harmonics(directions, components):
    """Raise SettingsError where so many spherical harmonics cannot be had on a lattice; see
    `fit_harmonics`.
    """
    if components is not None:
        _functions(directions, components)


def most_harmonics(directions, components):
    """The largest number of spherical harmonics, up to so many, that a lattice tells apart."""
    functions = evaluate(directions.vectors, isqrt(components)) * np.sqrt(directions.solid_angles)
    return _told_apart(functions @ functions.T) ** 2


def _functions(directions, components=None):
    """That many weighted functions (d, s) on a lattice, or as many as it tells apart, and their
    Gram matrix (d, d).
    """
    bands = MAX_BANDS if components is None else _bands_of(components)
    functions = evaluate(directions.vectors, bands) * np.sqrt(directions.solid_angles)
    gram = functions @ functions.T
    usable = _told_apart(gram)
    if components is not None and bands > usable:
        raise SettingsError(
            f"{components:,} spherical harmonics are above what {directions} tells apart: use at"
            f" most {usable**2:,} ({usable} bands), or finer directions"
        )
    return functions[: usable**2], gram[: usable**2, : usable**2]


def _told_apart(gram):
    """Bands whose Gram matrix, a leading part of the one given, has no eigenvalue under
    `LEAST_EIGENVALUE`.
    """
    # Where an eigenvalue is too small, a Cholesky factorization breaks off at the first leading
    # minor that is not positive.
    _, minor = scipy.linalg.lapack.dpotrf(gram - LEAST_EIGENVALUE * np.eye(len(gram)))
    return isqrt(minor - 1 if minor > 0 else len(gram))


def _bands_of(components):
    bands = isqrt(components)
    if components == 0 or bands**2 != components or bands > MAX_BANDS:
        nearest = sorted({min(max(b, 1), MAX_BANDS) ** 2 for b in (bands, bands + 1)})
        raise SettingsError(
            f"{components:,} spherical harmonics are not a whole number of bands from 1 to"
            f" {MAX_BANDS}: use {' or '.join(f'{square:,}' for square in nearest)}"
        )
    return bands
