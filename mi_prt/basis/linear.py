"""Bases of one set of functions for all points: what principal components, spherical harmonics and shared wavelets have in common."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .basis import Basis


@dataclass(frozen=True, eq=False)
class LinearBasis(Basis):
    """A basis of d rows in the √w-weighted space, and a mean.

    A transport row is T ≈ mean + (c · vectors)/√w with c = ((T − mean)·√w) · dualsᵀ. Under cell radiance L the
    irradiance is then exactly c·ℓ + m with ℓ = (L√w)·vectorsᵀ and m = Σ_j w_j L_j mean_j; nothing of the mean is lost.

    Parameters
    ----------
    vectors : (d, s) float32
    mean : (s,) float32
    sqrt_weights : (s,) float32
        √w.
    captured_variance : (d,) float64
        Energy of each component over the transport's variance. Where there is a mean these are shares of the variance.
    """

    vectors: np.ndarray
    mean: np.ndarray
    sqrt_weights: np.ndarray
    captured_variance: np.ndarray

    ARRAYS = ("vectors", "mean", "sqrt_weights", "captured_variance")

    def __len__(self):
        """Number of components d."""
        return len(self.vectors)

    @property
    def duals(self):
        """The rows (d, s) whose products with a weighted row are its coefficients: `vectors` where they are orthonormal."""
        return self.vectors

    def encode(self, rows):
        """Coefficients (b, d) float32 of transport rows (b, s)."""
        weighted, mean_coefficients = self._encoder
        coefficients = rows @ weighted
        coefficients -= mean_coefficients
        return coefficients

    @cached_property
    def _encoder(self):
        """√w·dualsᵀ (s, d) and the mean's coefficients (d,): weights and mean then cost nothing per row."""
        return (self.duals * self.sqrt_weights).T.copy(), self.duals @ (self.mean * self.sqrt_weights)

    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of coefficients (b, d)."""
        return (coefficients @ self.vectors) / self.sqrt_weights + self.mean

    def at(self, coefficients, cells):
        """Transport (b, k) float32 of points with coefficients (b, d) in some cells (b, k) of the lattice each."""
        functions, mean = self._decoder
        return np.einsum("bd,bkd->bk", coefficients, functions[cells]) + mean[cells]

    @cached_property
    def _decoder(self):
        """The functions (s, d) that coefficients multiply in each cell, without weights, and the mean (s,)."""
        return (self.vectors / self.sqrt_weights).T.copy(), self.mean

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
