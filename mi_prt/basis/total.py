"""Compressing total transport, from the coefficients of direct and of indirect transport in one
span.

Indirect transport is made of the direct transport of other points, so that it lies in the span of
what direct transport was compressed with. Fitting a basis to both together therefore needs no row
of transport, only coefficients.
"""

from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add

import numpy as np
import scipy.linalg

from ..system.parallel import map_chunks, one_blas_thread
from .linear import LinearBasis, Span
from .pca import PCA, fixed_signs
from .target import Fit, shares

PROBES = 16  # random functions that tell how much is lost, to some 2 %
_CHUNK = 1 << 12  # points that are summed over at a time
# share of the mean's norm outside the principal components, below which it is rounding
_IN_SPAN = 1e-6


@dataclass(frozen=True, eq=False)
class Carrier:
    """What is carried of transport from point to point: coefficients without a mean, and probes of
    what they leave out.

    What compression loses of direct transport is reflected too. Its size after reflections is told
    by products with a few random functions (Hutchinson's estimator), which take the same way as
    coefficients do.

    Parameters
    ----------
    span : LinearBasis
        Of a basis and its mean, itself without one.
    probes : (p, s) float32
        Random functions, normally distributed and independent in the √w-weighted space.
    """

    span: LinearBasis
    probes: np.ndarray

    def encode(self, rows):
        """Coefficients (b, m) of transport rows (b, s), and p products of the probes with what
        these leave out: (b, m + p) float32.
        """
        return rows @ self._encoder

    @cached_property
    def _encoder(self):
        duals, roots = self.span.duals, self.span.sqrt_weights
        return (
            np.concatenate([duals, self.probes - (self.probes @ self.span.vectors.T) @ duals])
            * roots
        ).T.copy()


def carrier(basis):
    """The Carrier of a basis.

    Parameters
    ----------
    basis : LinearBasis
        Bases without a mean span themselves; to principal components the mean's part outside them
        is added.
    """
    random = (
        np.random.default_rng(0)
        .standard_normal((PROBES, len(basis.sqrt_weights)))
        .astype(np.float32)
    )
    if not basis.joins_channels:
        return Carrier(basis, random)
    mean = basis.mean.astype(np.float64) * basis.sqrt_weights
    beyond = mean - (basis.vectors @ mean) @ basis.vectors
    size = np.linalg.norm(beyond)
    vectors = basis.vectors
    if size > _IN_SPAN * np.linalg.norm(mean):
        vectors = np.concatenate([vectors, (beyond / size)[None].astype(np.float32)])
    return Carrier(
        Span(vectors, np.zeros_like(basis.mean), basis.sqrt_weights, np.zeros(len(vectors))),
        random,
    )


def fit_total(fit, target, span, direct, indirect, growth, kept):
    """Fit a basis to total transport and give its coefficients.

    Parameters
    ----------
    fit : Fit
        Of direct transport.
    target : Target
        How many principal components are wanted; other bases stay what they are.
    span : LinearBasis
        Its carrier.
    direct : (n, m) float32
        Coefficients of direct transport in the carrier.
    indirect : (c, n, m) float32
        Those of indirect transport, for each colour channel.
    growth : float
        Squared norm of what compression loses of total transport, all channels, over that of direct
        transport.
    kept : (n,) bool
        Points to fit to.

    Returns
    -------
    fit : Fit
        Principal components hold all channels: colours vary so much alike that one set of
        coefficients does for them.
    coefficients : (n, d) float32
        Or (n, 3, d) of three channels in a basis that stays what it is.
    """
    channels, m = len(indirect), direct.shape[1]
    gram = (span.vectors @ span.vectors.T).astype(np.float64)
    count = max(int(kept.sum()), 1)
    alone, alone_centre = _scatter(direct, None, kept)
    scatter, centre = _scatter(direct, indirect, kept)

    def in_span(products):
        """Σ of squared norms, from the products (c·m, c·m) of coefficients."""
        return sum(
            float(np.sum(products[i : i + m, i : i + m] * gram)) for i in range(0, len(products), m)
        )

    # What is lost of total transport, and the share of direct transport's mean in that.
    lost = max(fit.energy - in_span(alone), 0.0) * growth
    lost_mean = max(
        fit.energy - fit.variance - count * in_span(np.outer(alone_centre, alone_centre)), 0.0
    )
    covariance = scatter - count * np.outer(centre, centre)
    energy = in_span(scatter) + lost
    variance = max(in_span(covariance), 0.0) + max(lost - channels * lost_mean, 0.0)
    if span is fit.basis:
        energies = np.diag(scatter).reshape(channels, m).sum(axis=0) * np.diag(gram)
        basis = replace(fit.basis, captured_variance=shares(energies, variance))
        joined = _encoded(direct, indirect, lambda totals: totals.reshape(len(totals), channels, m))
        return Fit(basis, lost, variance, energy), joined[:, 0] if channels == 1 else joined
    with one_blas_thread():
        values, rotation = scipy.linalg.eigh(covariance)
    values, rotation = np.maximum(values[::-1], 0), rotation[:, ::-1]
    components = len(fit.basis)
    if target.variance is not None:
        left = lost + values.sum() - np.cumsum(values)
        enough = left <= target.allowed_residual(variance, energy)
        components = 1 + int(np.argmax(enough)) if enough.any() else len(values)
    rotation = fixed_signs(rotation[:, :components])
    shape = (channels, len(span.sqrt_weights)) if channels > 1 else (len(span.sqrt_weights),)
    vectors = np.einsum(
        "cmd,ms->dcs", rotation.reshape(channels, m, components), span.vectors, optimize=True
    )
    basis = PCA(
        np.ascontiguousarray(vectors.reshape(components, *shape), dtype=np.float32),
        (centre.reshape(channels, m) @ span.vectors / span.sqrt_weights)
        .astype(np.float32)
        .reshape(shape),
        span.sqrt_weights,
        shares(values[:components], variance),
    )
    shift, turn = (centre @ rotation).astype(np.float32), rotation.astype(np.float32)
    residual = lost + float(values[components:].sum())
    return Fit(basis, residual, variance, energy), _encoded(
        direct, indirect, lambda totals: totals @ turn - shift
    )


def _scatter(direct, indirect, kept):
    """Σ xᵀx (c·m, c·m) and the mean (c·m,) of the coefficients x of kept points, all channels in a
    row.
    """

    def sums(first):
        block = slice(first, first + _CHUNK)
        totals = _totals(direct, indirect, block)[kept[block]].astype(np.float64)
        return totals.T @ totals, totals.sum(axis=0)

    scatter, total = (
        reduce(add, parts) for parts in zip(*map_chunks(sums, range(0, len(direct), _CHUNK)))
    )
    return scatter, total / max(int(kept.sum()), 1)


def _encoded(direct, indirect, encode):
    """What `encode` makes of all points' total coefficients (b, c·m), block by block."""
    blocks = (slice(first, first + _CHUNK) for first in range(0, len(direct), _CHUNK))
    return np.concatenate(
        list(map_chunks(lambda block: encode(_totals(direct, indirect, block)), blocks))
    )


def _totals(direct, indirect, block):
    """Coefficients (b, c·m) of total transport, or (b, m) of direct transport if there is no
    indirect.
    """
    if indirect is None:
        return direct[block]
    totals = direct[block] + indirect[:, block]
    return totals.swapaxes(0, 1).reshape(totals.shape[1], -1)
