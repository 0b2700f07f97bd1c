"""Light after any number of reflections, from the operator of one (`Hops`).

With A that operator, irradiance after k reflections is Aᵏ·E₀ and all of it E = E₀ + A·E: the
Neumann series of (I − A)⁻¹. Both work on whatever is linear in light: on the coefficients of direct
transport in a basis, so that no matrix of points × directions is needed, and the same rays serve
any number of reflections.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.sparse.linalg import LinearOperator, bicgstab

from ..errors import SceneError
from ..system.parallel import one_blas_thread

BOUNCE_TOLERANCE = 1e-3  # share of the irradiance under a uniform sky that `auto` leaves out
MOST_COUNTED_BOUNCES = 64  # to which `auto` follows the energy of reflections
ROUNDING = 1e-7  # share of the irradiance that single precision does not tell
MOST_SUMMED_BOUNCES = 24  # more of them are solved for: a Krylov method then takes fewer products
SOLVER_TOLERANCE = 1e-5
MOST_ITERATIONS = 500
FAR_FROM_WHITE = 0.9  # albedo up to which a bound by albedo alone says enough
ALBEDO_ROUNDING = 1e-4
LEAST_RAYS = 8  # of a point, to which the rays of late reflections are thinned
COLUMNS = 32  # coefficients worked on at a time; fixed, so that results do not depend on memory
LARGEST_GROWTH = 1e12  # of light by reflections


@dataclass(frozen=True)
class BounceSplit:
    """How irradiance under a uniform sky of radiance 1 splits by the number of reflections.

    Parameters
    ----------
    energy : tuple of float
        Mean irradiance over the surface (weighted by area, mean of the colour channels) in units of
        π, what an open sky gives: direct, after one reflection, after two, ….
    left : float
        What further reflections would add, in the same unit, or a bound of it; inf where none is
        known.
    """

    energy: tuple
    left: float

    @property
    def bounces(self):
        """Number of reflections that are counted."""
        return len(self.energy) - 1


def split_by_bounces(hops, direct, weights, channels, bounces=None):
    """Follow light of a uniform sky from reflection to reflection.

    Parameters
    ----------
    hops : Hops
    direct : (n,) float32
        Direct irradiance at each point in units of π.
    weights : (n,) array
        The points' share in the mean, summing to 1.
    channels : 1 or 3
    bounces : int or None
        How many reflections; None for as many as it takes until what is left is below
        `BOUNCE_TOLERANCE` of the whole.

    Returns
    -------
    BounceSplit

    Raises
    ------
    SceneError
        If any number of reflections is wanted, and they do not end.
    """
    term = np.broadcast_to(direct[None, :, None], (channels, len(direct), 1)).astype(np.float32)
    albedo = hops.largest_albedo()
    energy = [_mean(term, weights)]
    whole, left = np.inf, np.inf
    if bounces is None:
        check_ending(albedo)
    if bounces is None and albedo > FAR_FROM_WHITE:
        whole = energy[0] + _mean(_converged(hops, term), weights)
    while len(energy) <= (MOST_COUNTED_BOUNCES if bounces is None else bounces):
        term = hops.apply(term)
        energy.append(_mean(term, weights))
        if energy[0] > 0:
            check_growth(energy[-1] / energy[0], len(energy) - 1, albedo)
        # A reflection leaves at most the largest albedo of the flux that arrives at all surfaces,
        # and a mean weighted by area is flux. Where that is nearly all, the bound is of no use, and
        # what all reflections come to is solved for.
        bound = energy[-1] * albedo / (1 - albedo) if albedo < 1 else np.inf
        left = min(bound, max(whole - sum(energy), 0.0))
        if left <= (BOUNCE_TOLERANCE if bounces is None else ROUNDING) * sum(energy):
            break
    while len(energy) > 1 and energy[-1] == 0:
        energy.pop()
    return BounceSplit(tuple(energy), left)


def check_ending(albedo):
    """Raise SceneError where any number of reflections need not end, because a surface of this
    albedo reflects more than arrives.
    """
    if albedo > 1 + ALBEDO_ROUNDING:
        raise SceneError(
            f"a surface reflects {albedo:.4g} times the light that arrives at it, so reflections"
            " need not end: correct its reflectance, or give a number of bounces (--bounces)"
        )


def check_growth(growth, number, albedo):
    """Raise SceneError where a number of reflections has made light grow more than
    `LARGEST_GROWTH`: squares of it would soon be more than float32 holds.
    """
    if not (np.asarray(growth) <= LARGEST_GROWTH).all():
        raise SceneError(
            f"light grows without bound within {number:,} reflections: a surface reflects"
            f" {albedo:.4g} times the light that arrives at it; correct its reflectance, or use"
            " fewer bounces (--bounces)"
        )


def _mean(term, weights):
    return float((term[..., 0] @ weights).mean())


def solve(hops, direct, channels, split, progress=lambda done: None):
    """Coefficients of indirect transport.

    Parameters
    ----------
    hops : Hops
    direct : (n, m) float32
        Coefficients of direct transport, without a mean taken off.
    channels : 1 or 3
    split : BounceSplit or None
        How many reflections, and how much energy each has: rays are spent in proportion to it. None
        for all of them.
    progress : callable(done)
        Called with the columns that are done.

    Returns
    -------
    (c, n, m) float32

    Raises
    ------
    SceneError
        If all reflections are wanted and they do not end.
    """
    n, m = direct.shape
    operators = (
        [] if split is None else [hops.thinned(factor) for factor in _thinning(split, hops.count)]
    )
    indirect = np.empty((channels, n, m), np.float32)
    for first in range(0, m, COLUMNS):
        columns = slice(first, first + COLUMNS)
        emitted = np.broadcast_to(direct[:, columns], (channels, n, len(direct[0, columns])))
        indirect[..., columns] = (
            _converged(hops, emitted) if split is None else _summed(operators, emitted)
        )
        progress(min(first + COLUMNS, m))
    return indirect


def _thinning(split, rays):
    """Of each reflection, by what power of two its rays may be thinned.

    Noise of a reflection goes with its energy over the square root of its rays; what all
    reflections together have is least, for so many rays in all, where these are in proportion to
    the energy.
    """
    first = split.energy[1]
    for energy in split.energy[1:]:
        most = max(rays // LEAST_RAYS, 1)
        yield 1 << int(np.log2(np.clip(first / energy, 1, most)))


def _summed(operators, direct):
    """A₁·(E₀ + A₂·(E₀ + …)), from the innermost on.

    What a point receives is gathered by A₁ with all its rays, whatever reflection it is of; and as
    what each operator gathers adds up to the same share of the hemisphere, a white furnace stays
    white though they differ. A₁·E₀ + A₂·A₁·E₀ + … would do neither.
    """
    arriving = direct
    for operator in operators[:0:-1]:
        arriving = direct + operator.apply(arriving)
    return operators[0].apply(arriving)


def _converged(hops, direct):
    """(I − A)⁻¹·A·E₀, all columns together."""
    first = hops.apply(direct)

    def remaining(flat):
        irradiance = flat.reshape(first.shape)
        return (irradiance - hops.apply(irradiance)).ravel()

    operator = LinearOperator((first.size, first.size), matvec=remaining, dtype=np.float32)
    solution, failed = bicgstab(
        operator, first.ravel(), rtol=SOLVER_TOLERANCE, atol=0.0, maxiter=MOST_ITERATIONS
    )
    if failed:
        raise SceneError(
            "light between the scene's surfaces does not die away: give a number of bounces"
            " (--bounces)"
        )
    return solution.reshape(first.shape)


def combined(halves, kept, denoise=True):
    """One estimate of coefficients from two that are independent and equally good, with the noise
    taken out that can be told.

    Their covariance is that of the signal, half the variance of their difference twice the noise of
    their mean. Components that diagonalize both (maximum noise fraction, Green et al. 1988) are
    scaled by the share of their variance that is signal: the linear filter with the least mean
    squared error. Components that are all noise go; what both halves agree on stays as it is.

    Parameters
    ----------
    halves : pair of (c, n, m) float32
        The first is overwritten.
    kept : (n,) bool
        Points that the statistics are taken of.
    denoise : bool
        Whether to filter.

    Returns
    -------
    mean : (c, n, m) float32
    noise : float
        Norm of the noise of the mean at kept points, before filtering.
    kept_noise : float
        Share of the noise's squared norm that the filter lets through; 1 without it.
    """
    first, second = halves
    difference = first - second
    first += second
    first *= np.float32(0.5)
    m = first.shape[-1]
    total, noise, centre = _moments(first, difference, kept)
    size = float(np.trace(noise)) ** 0.5
    if not denoise or not np.trace(noise) > 0:
        return first, size, 1.0
    with one_blas_thread():
        values, vectors = scipy.linalg.eigh(total)
        significant = values > values[-1] * m * np.finfo(np.float32).eps
        # Coordinates in which the coefficients have unit variance; the noise is then at most all of
        # it.
        whiten = vectors[:, significant] / np.sqrt(values[significant])
        fractions, rotation = scipy.linalg.eigh(whiten.T @ noise @ whiten)
        gains = np.clip(1 - fractions, 0, 1)
        back = rotation.T @ (vectors[:, significant] * np.sqrt(values[significant])).T
        # what the filter takes away of a deviation from the mean
        taken = (whiten @ rotation * (1 - gains)) @ back
        passed = float(
            np.trace((np.eye(m) - taken).T @ noise @ (np.eye(m) - taken)) / np.trace(noise)
        )
        for channel in first:
            channel -= (channel - centre.astype(np.float32)) @ taken.astype(np.float32)
    return first, size, passed


def _moments(mean, difference, kept):
    """Scatter matrices (m, m) of the mean (about its centre) and of its noise, and the centre (m,),
    over points and channels.
    """
    m = mean.shape[-1]
    total, noise, centre, count = np.zeros((m, m)), np.zeros((m, m)), np.zeros(m), 0
    with one_blas_thread():
        for values, differences in zip(mean, difference):
            values, differences = values[kept], differences[kept]
            total += values.T @ values
            noise += differences.T @ differences / 4
            centre += values.sum(axis=0, dtype=np.float64)
            count += len(values)
        centre /= max(count, 1)
        return total - count * np.outer(centre, centre), noise, centre
