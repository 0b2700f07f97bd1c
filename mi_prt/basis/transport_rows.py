"""Rows of direct transport, kept as visibility bits."""

from dataclasses import dataclass, replace

import numpy as np

from ..system.parallel import BLOCK_ROWS, map_chunks


@dataclass(frozen=True, eq=False)
class DirectTransport:
    """The sampled transport matrix, one bit for every ray.

    T is visibility times a cosine that normals and directions give back, so bits are all that must
    be stored; and of two opposite directions one lies below the horizon, so one bit serves both.
    That is 64 times less than float32.

    Parameters
    ----------
    normals : (n, 3) float32
    vectors : (r, s/2, 3) float32
        The r directions sampled in each cell of the first half of the lattice, scaled by the share
        of the cell's solid angle that each stands for. The cells of the second half are their
        antipodes.
    bits : (n, ceil(s·r/16)) uint8, array or RowFile
        Visibility along each of `vectors` or its opposite, whichever is above the horizon; packed
        in their order.
    rays : int
        Rays traced.
    """

    normals: np.ndarray
    vectors: np.ndarray
    bits: np.ndarray
    rays: int

    @property
    def shape(self):
        """(n, s)."""
        return len(self.normals), 2 * self.vectors.shape[1]

    def rows(self, index):
        """Rows of the transport matrix.

        Parameters
        ----------
        index : slice or (b,) array

        Returns
        -------
        (b, s) float32
            Irradiance per unit radiance of each cell, per steradian.
        """
        rays, half, _ = self.vectors.shape
        seen = self.normals[index] @ self.vectors.reshape(-1, 3).T
        seen *= np.unpackbits(self.bits[index], axis=1, count=seen.shape[1])
        # max(0, x) goes to a direction, max(0, −x) = max(0, x) − x to its opposite.
        rows = np.empty((len(seen), 2 * half), np.float32)
        if rays == 1:
            np.maximum(seen, 0, out=rows[:, :half])
        else:
            np.maximum(seen, 0).reshape(-1, rays, half).sum(axis=1, out=rows[:, :half])
            seen = seen.reshape(-1, rays, half).sum(axis=1)
        np.subtract(rows[:, :half], seen, out=rows[:, half:])
        return rows

    def __getitem__(self, index):
        """The transport of some points, still as bits."""
        return replace(self, normals=self.normals[index], bits=self.bits[index])

    def __array__(self, dtype=None, copy=None):
        return self.rows(slice(None)).astype(dtype or np.float32, copy=False)

    def entries(self, cells):
        """Single entries (n, k) float32 of the matrix: those of each row in cells (n, k), without
        expanding it.
        """
        rays, half, _ = self.vectors.shape
        ray = np.arange(rays)[:, None, None]
        pair = cells % half
        place = ray * half + pair
        seen = self.bits[np.arange(len(cells))[:, None], place >> 3] >> (7 - (place & 7)) & 1
        cosines = np.einsum("bi,rbki->rbk", self.normals, self.vectors[ray, pair])
        return np.sum(
            np.maximum(np.where(cells < half, cosines, -cosines), 0) * seen,
            axis=0,
            dtype=np.float32,
        )

    def __matmul__(self, light):
        """Product (n, k) float32 with a matrix (s, k), block by block."""
        starts = range(0, len(self.normals), BLOCK_ROWS)
        return np.concatenate(
            list(map_chunks(lambda i: self.rows(slice(i, i + BLOCK_ROWS)) @ light, starts))
        )

    def irradiance(self, radiance, solid_angles):
        """Irradiance (n, 3) under cell radiance (s, 3): what no basis has touched."""
        return self @ (radiance * solid_angles[:, None]).astype(np.float32)

    def in_memory(self):
        """The same with all bits in memory."""
        bits = np.empty(self.bits.shape, np.uint8)
        step = 1 << 14
        for first in range(0, len(bits), step):
            block = slice(first, first + step)
            bits[block] = self.bits[block]
        return replace(self, bits=bits)

    def dark(self):
        """Which points (n,) see no direction at all."""
        return self._of_bits(lambda bits: ~bits.any(axis=1))

    def open(self):
        """Which points (n,) see all directions."""
        rays = self.vectors.shape[0] * self.vectors.shape[1]
        full = np.packbits(np.ones(rays, bool))
        return self._of_bits(lambda bits: (bits == full).all(axis=1))

    def _of_bits(self, function):
        step = 1 << 14
        return np.concatenate(
            [function(self.bits[slice(i, i + step)]) for i in range(0, len(self.normals), step)]
        )
