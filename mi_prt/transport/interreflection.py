"""Light after any number of reflections, from the operator of one (`Hops`).

With A that operator, irradiance after k reflections is Aᵏ·E₀ and all of it E = E₀ + A·E: the Neumann series of (I − A)⁻¹. Both work on
whatever is linear in light: on the coefficients of direct transport in a basis, so that no matrix of points × directions is needed,
and the same rays serve any number of reflections.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.sparse.linalg import LinearOperator, bicgstab

from ..parallel import one_blas_thread

BOUNCE_TOLERANCE = 1e-3  # share of the irradiance under a uniform sky that `auto` leaves out
MOST_COUNTED_BOUNCES = 64  # to which `auto` follows the energy of reflections
ROUNDING = 1e-7  # share of the irradiance that single precision does not tell
MOST_SUMMED_BOUNCES = 24  # more of them are solved for: a Krylov method then takes fewer products
SOLVER_TOLERANCE = 1e-5
COLUMNS = 32  # coefficients worked on at a time; fixed, so that results do not depend on memory


@dataclass(frozen=True)
class BounceSplit:
    """How irradiance under a uniform sky of radiance 1 splits by the number of reflections.

    Parameters
    ----------
    energy : tuple of float
        Mean irradiance over the surface (weighted by area, mean of the colour channels) in units of π, what an open sky gives: direct,
        after one reflection, after two, ….
    left : float
        Bound of what further reflections would add, in the same unit; inf where none is known.
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
        How many reflections; None for as many as it takes until what is left is below `BOUNCE_TOLERANCE` of the whole.

    Returns
    -------
    BounceSplit
    """
    term = np.broadcast_to(direct[None, :, None], (channels, len(direct), 1)).astype(np.float32)
    albedo = hops.largest_albedo()
    energy = [_mean(term, weights)]
    left = np.inf
    while len(energy) <= (MOST_COUNTED_BOUNCES if bounces is None else bounces):
        before, term = term, hops.apply(term)
        energy.append(_mean(term, weights))
        left = _remainder(before, term, weights, albedo)
        if left <= (BOUNCE_TOLERANCE if bounces is None else ROUNDING) * sum(energy):
            break
    while len(energy) > 1 and energy[-1] == 0:
        energy.pop()
    return BounceSplit(tuple(energy), left)


def _mean(term, weights):
    return float((term[..., 0] @ weights).mean())


def _remainder(before, term, weights, albedo):
    """Bound of the mean of all terms after this one.

    A reflection leaves at most the largest albedo of the flux that arrives at all surfaces, and a mean weighted by area is flux. And as
    the operator has no negative entries, where no point receives more than q times what it received a reflection earlier, the same
    holds ever after. What follows is at most q/(1 − q) of this term, q being the albedo or that ratio.
    """
    ratios = [albedo]
    lit = term > 0
    if not (before[lit] == 0).any():
        ratios.append(float((term[lit] / before[lit]).max(initial=0.0)))
    q = min(ratios)
    return _mean(term, weights) * q / (1 - q) if q < 1 else np.inf


def solve(hops, direct, channels, bounces, progress=lambda done: None):
    """Coefficients of indirect transport.

    Parameters
    ----------
    hops : Hops
    direct : (n, m) float32
        Coefficients of direct transport, without a mean taken off.
    channels : 1 or 3
    bounces : int or None
        How many reflections; None for all.
    progress : callable(done)
        Called with the columns that are done.

    Returns
    -------
    (c, n, m) float32
    """
    n, m = direct.shape
    indirect = np.empty((channels, n, m), np.float32)
    for first in range(0, m, COLUMNS):
        columns = slice(first, first + COLUMNS)
        emitted = np.broadcast_to(direct[:, columns], (channels, n, len(direct[0, columns])))
        indirect[..., columns] = _converged(hops, emitted) if bounces is None else _summed(hops, emitted, bounces)
        progress(min(first + COLUMNS, m))
    return indirect


def _summed(hops, direct, bounces):
    """A·E₀ + … + Aᵏ·E₀."""
    term = total = hops.apply(direct)
    for _ in range(bounces - 1):
        term = hops.apply(term)
        total = total + term
    return total


def _converged(hops, direct):
    """(I − A)⁻¹·A·E₀, all columns together."""
    first = hops.apply(direct)

    def remaining(flat):
        irradiance = flat.reshape(first.shape)
        return (irradiance - hops.apply(irradiance)).ravel()

    operator = LinearOperator((first.size, first.size), matvec=remaining, dtype=np.float32)
    solution, failed = bicgstab(operator, first.ravel(), rtol=SOLVER_TOLERANCE, atol=0.0, maxiter=MOST_COUNTED_BOUNCES)
    return solution.reshape(first.shape) if not failed else _summed(hops, direct, MOST_COUNTED_BOUNCES)


def combined(halves, kept, denoise=True):
    """One estimate of coefficients from two that are independent and equally good, with the noise taken out that can be told.

    Their covariance is that of the signal, half the variance of their difference twice the noise of their mean. Components that
    diagonalize both (maximum noise fraction, Green et al. 1988) are scaled by the share of their variance that is signal: the linear
    filter with the least mean squared error. Components that are all noise go; what both halves agree on stays as it is.

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
        Share of the mean's squared norm that is noise, before filtering.
    kept_noise : float
        Share of the noise's squared norm that the filter lets through; 1 without it.
    """
    first, second = halves
    difference = first - second
    first += second
    first *= np.float32(0.5)
    m = first.shape[-1]
    total, noise, centre = _moments(first, difference, kept)
    share = float(np.trace(noise) / max(np.trace(total) + kept.sum() * len(first) * centre @ centre, 1e-300))
    if not denoise or not np.trace(noise) > 0:
        return first, share, 1.0
    with one_blas_thread():
        values, vectors = scipy.linalg.eigh(total)
        significant = values > values[-1] * m * np.finfo(np.float32).eps
        # Coordinates in which the coefficients have unit variance; the noise is then at most all of it.
        whiten = vectors[:, significant] / np.sqrt(values[significant])
        fractions, rotation = scipy.linalg.eigh(whiten.T @ noise @ whiten)
        gains = np.clip(1 - fractions, 0, 1)
        back = rotation.T @ (vectors[:, significant] * np.sqrt(values[significant])).T
        taken = (whiten @ rotation * (1 - gains)) @ back  # what the filter takes away of a deviation from the mean
        passed = float(np.trace((np.eye(m) - taken).T @ noise @ (np.eye(m) - taken)) / np.trace(noise))
        for channel in first:
            channel -= (channel - centre.astype(np.float32)) @ taken.astype(np.float32)
    return first, share, passed


def _moments(mean, difference, kept):
    """Scatter matrices (m, m) of the mean (about its centre) and of its noise, and the centre (m,), over points and channels."""
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
