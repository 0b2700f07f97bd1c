"""No basis at all: transport as it was sampled."""

from dataclasses import dataclass

import numpy as np

from .basis import Basis


@dataclass(frozen=True, eq=False)
class NoBasis(Basis):
    """Coefficients are the sampled `DirectTransport` itself.

    Parameters
    ----------
    weights : (s,) float32
        Solid angles.
    """

    weights: np.ndarray

    kind = "none"
    ARRAYS = ("weights",)
    captured_variance = np.zeros(0)

    def __len__(self):
        """Number of coefficients of a point: the directions s."""
        return len(self.weights)

    def encode(self, rows):
        """The rows (b, s) themselves."""
        return rows

    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of a `DirectTransport` of b points, or of the rows that
        `encode` gave.
        """
        return np.asarray(coefficients, np.float32)

    def at(self, coefficients, cells):
        """Transport (b, k) float32 of a `DirectTransport` of b points in some cells (b, k) of the
        lattice each.
        """
        return coefficients.entries(cells)

    def project_light(self, radiance):
        """Light (s, 3) float32 that irradiance is the product with, and no mean response (3,)."""
        return (radiance * self.weights[:, None]).astype(np.float32), np.zeros(3, np.float32)
