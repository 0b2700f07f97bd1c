"""Bases of one set of functions for all points: what principal components, spherical harmonics and
shared wavelets have in common.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..lighting.cells import cell_radiance
from ..system.parallel import one_blas_thread
from ..system.schema import Array
from .basis import Basis


@dataclass(frozen=True, eq=False)
class LinearBasis(Basis):
    """A basis of d rows in the √w-weighted space, and a mean.

    A transport row is T ≈ mean + (c · vectors)/√w with c = ((T − mean)·√w) · dualsᵀ. Under cell
    radiance L the irradiance is then exactly c·ℓ + m with ℓ = (L√w)·vectorsᵀ and m = Σ_j w_j L_j
    mean_j; nothing of the mean is lost. Functions may hold all three colour channels of transport,
    so that a point needs one set of coefficients for them.

    Parameters
    ----------
    vectors : (d, s) or (d, 3, s) float32
    mean : (s,) or (3, s) float32
    sqrt_weights : (s,) float32
        √w.
    captured_variance : (d,) float64
        Energy of each component over the transport's variance. Where there is a mean these are
        shares of the variance.
    """

    vectors: np.ndarray
    mean: np.ndarray
    sqrt_weights: np.ndarray
    captured_variance: np.ndarray

    ARRAYS = ("vectors", "mean", "sqrt_weights", "captured_variance")

    @classmethod
    def shapes(cls, channels):
        """Functions of (d, s), or of (d, 3, s) where they hold the colour channels."""
        colour = (3,) if channels == 3 and cls.joins_channels else ()
        return {
            "vectors": Array("f4", ("d", *colour, "s"), unit="sr^(-1/2)"),
            "mean": Array("f4", (*colour, "s"), unit="irradiance per unit radiance and steradian"),
            "sqrt_weights": Array("f4", ("s",), least=1e-12, unit="sr^(1/2)"),
            "captured_variance": Array("f8", ("d",)),
        }

    def __len__(self):
        """Number of components d."""
        return len(self.vectors)

    @property
    def duals(self):
        """The rows (d, s) or (d, 3, s) whose products with a weighted row are its coefficients:
        `vectors` where they are orthonormal.
        """
        return self.vectors

    def encode(self, rows):
        """Coefficients (b, d) float32 of transport rows (b, s), or (b, 3, s) if the functions hold
        three channels.
        """
        weighted, mean_coefficients = self._encoder
        coefficients = (rows if self.mean.ndim == 1 else rows.reshape(len(rows), -1)) @ weighted
        coefficients -= mean_coefficients
        return coefficients

    @cached_property
    def _encoder(self):
        """√w·dualsᵀ (s, d) or (3·s, d) and the mean's coefficients (d,): weights and mean then cost
        nothing per row.
        """
        flat = (len(self), self.mean.size)
        weighted = (self.duals * self.sqrt_weights).reshape(flat)
        return weighted.T.copy(), self.duals.reshape(flat) @ (self.mean * self.sqrt_weights).ravel()

    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of coefficients (b, d); (b, 3, s) of coefficients (b, 3,
        d), or of functions of three channels.
        """
        return np.tensordot(coefficients, self.vectors, 1) / self.sqrt_weights + self.mean

    def at(self, coefficients, cells):
        """Transport (b, k) float32 of points with coefficients (b, d) in some cells (b, k) of the
        lattice each; (b, k, 3) where it has three channels.
        """
        functions, mean = self._decoder
        if coefficients.ndim == 3:
            return np.einsum("bcd,bkd->bkc", coefficients, functions[cells])
        return np.einsum("bd,bk...d->bk...", coefficients, functions[cells]) + mean[cells]

    @cached_property
    def _decoder(self):
        """The functions (s, d) or (s, 3, d) that coefficients multiply in each cell, without
        weights, and the mean (s,) or (s, 3).
        """
        return (self.vectors / self.sqrt_weights).T.copy(), self.mean.T.copy()

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
        mean = self.mean * self.sqrt_weights
        if self.mean.ndim == 1:
            return self.vectors @ weighted, mean @ weighted
        light = np.stack(
            [self.vectors[:, channel] @ weighted[:, channel] for channel in range(3)], axis=-1
        )
        return light, np.einsum("cs,sc->c", mean, weighted)

    def truncated(self, components):
        """See `Basis.truncated`: the first functions."""
        return replace(
            self,
            vectors=self.vectors[:components].copy(),
            captured_variance=self.captured_variance[:components].copy(),
        )

    def project_all(self, lights, directions):
        """Light (m, d, 3) and the mean's response (m, 3) of m `Light`s, by one matrix product."""
        radiance = np.stack([cell_radiance(light, directions) for light in lights], axis=1)
        radiance *= self.sqrt_weights[:, None, None]
        means = (self.mean * self.sqrt_weights).reshape(-1, len(self.sqrt_weights))
        functions = self.vectors.reshape(len(self), *means.shape)
        light = np.empty((len(lights), len(self), 3), np.float32)
        response = np.empty((len(lights), 3), np.float32)
        shape = len(lights), 3 // len(means)
        with one_blas_thread():
            for own, mean in enumerate(means):  # one for all channels, or one for each
                channels = slice(own, None, len(means))
                incoming = radiance[:, :, channels].reshape(len(radiance), -1)
                projected = (functions[:, own] @ incoming).reshape(len(self), *shape)
                light[:, :, channels] = projected.swapaxes(0, 1)
                response[:, channels] = (mean @ incoming).reshape(shape)
        return light, response


class Span(LinearBasis):
    """What a basis and its mean span together, itself without a mean."""

    kind = "span"

    @classmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=0, keep=None):
        """Refused: a span is made from a basis."""
        raise TypeError("a span is made from a basis, not fitted")
