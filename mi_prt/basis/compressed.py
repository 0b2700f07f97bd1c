"""Transport in a basis: the pair of a basis and the coefficients of all points."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..system.parallel import BLOCK_ROWS, map_chunks, one_blas_thread

BATCH_ROWS = 1024  # points of one product where many lights are asked for


@dataclass(frozen=True, eq=False)
class Compressed:
    """Transport of n points in a basis.

    Parameters
    ----------
    basis : Basis
    coefficients : (n, d) float32, or what else `Basis.encode` gives
        (n, 3, d) where reflections colour the light and the basis does not join channels.
    """

    basis: Any
    coefficients: Any

    def __len__(self):
        return self.coefficients.shape[0]

    @cached_property
    def _channels_apart(self):
        """Whether each channel has coefficients of its own."""
        return len(self.coefficients.shape) == 3

    def respond(self, light, mean_response):
        """Irradiance (n, 3) float32 in W/m² under projected light, c·ℓ + m (Eigentransport eq. 10,
        mean kept exactly); compression leaves some of it below zero.

        Parameters
        ----------
        light : (d, 3) float32
        mean_response : (3,) float32
        """
        with one_blas_thread():
            if self._channels_apart:
                products = np.matmul(self.coefficients.swapaxes(0, 1), light.T[..., None])
                irradiance = products[..., 0].T
            else:
                irradiance = self.coefficients @ light
        irradiance += mean_response
        return irradiance

    def respond_all(self, lights, mean_responses):
        """Irradiance (m, n, 3) float32 under m projected lights, by one matrix product in blocks of
        points; see `respond`.

        Parameters
        ----------
        lights : (m, d, 3) float32
        mean_responses : (m, 3) float32
        """
        if len(lights) == 1:
            return self.respond(lights[0], mean_responses[0])[None]
        irradiance = np.empty((len(lights), len(self), 3), np.float32)
        if self._channels_apart:
            joined = np.ascontiguousarray(lights.transpose(2, 1, 0))  # (3, d, m)
        else:
            joined = lights.transpose(1, 0, 2).reshape(lights.shape[1], 3 * len(lights))

        def fill(first):
            block = slice(first, first + BATCH_ROWS)
            if self._channels_apart:
                products = self.coefficients[block].swapaxes(0, 1) @ joined
                irradiance[:, block] = products.transpose(2, 1, 0)
            else:
                products = self.coefficients[block] @ joined
                irradiance[:, block] = products.reshape(-1, len(lights), 3).transpose(1, 0, 2)

        for _ in map_chunks(fill, range(0, len(self), BATCH_ROWS)):
            pass
        irradiance += mean_responses[:, None]
        return irradiance

    def in_cells(self, cells, shares):
        """Transport (n, 1) or (n, 3) float32, the sum over some cells (n, k) of each point times
        their shares (n, k).
        """

        def transport(first):
            block = slice(first, first + BLOCK_ROWS)
            found = self.basis.at(self.coefficients[block], cells[block])
            return np.einsum("nk...,nk->n...", found, shares[block])

        seen = np.concatenate(list(map_chunks(transport, range(0, len(self), BLOCK_ROWS))))
        return seen if seen.ndim == 2 else seen[:, None]

    def rows(self, index):
        """Transport (b, s) float32 as the basis reconstructs it, or (b, 3, s)."""
        return self.basis.reconstruct(self.coefficients[index])
