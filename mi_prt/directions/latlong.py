"""The cells of a latitude-longitude map."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import SettingsError
from .lattice import MAX_DIRECTIONS, DirectionLattice, is_integer_in, near_square


@dataclass(frozen=True)
class LatLong(DirectionLattice):
    """Latitude-longitude lattice with W·H cells, equally wide in either angle, in the convention of
    Mitsuba's `envmap`.

    +y is up, and the point (u, v) of the map looks along (sin 2πu · sin πv, cos πv, −cos 2πu · sin
    πv); the cell in row i and column j reaches from (j/W, i/H) to ((j+1)/W, (i+1)/H), and its
    direction is that of the middle of the two. (The direction that halves the cell's solid angle
    would make integrals over the sphere twice as wrong.)

    Cell index: the upper hemisphere in rows, i·W + j with i < H/2, from the pole down; then the
    antipodes of these cells in the same order, so that W·H/2 + i·W + j is the cell in row H − 1 − i
    and column (j + W/2) mod W.

    Parameters
    ----------
    width : int
        W, cells around the equator.
    height : int
        H, cells from pole to pole.

    Raises
    ------
    SettingsError
        If a side is not an even integer ≥ 2, or there are more than 1,572,864 cells.
    """

    width: int
    height: int

    def __post_init__(self):
        sides = (self.width, self.height)
        if (
            not all(is_integer_in(side, 2, MAX_DIRECTIONS) and side % 2 == 0 for side in sides)
            or len(self) > MAX_DIRECTIONS
        ):
            raise SettingsError(
                f"latlong size {self.width}x{self.height} must be two even numbers ≥ 2 of a product"
                f" of at most {MAX_DIRECTIONS:,}: use for example latlong:128x64"
            )

    def __str__(self):
        return f"latlong:{self.width}x{self.height}"

    def __len__(self):
        return self.width * self.height

    @cached_property
    def solid_angles(self):
        """Exact solid angles of the cells, (s,) float64 in sr."""
        return np.tile(np.repeat(_bands(self.height) * (2 * np.pi / self.width), self.width), 2)

    def subdivided(self, rays):
        """Sub-cells equally wide in either angle; see `DirectionLattice.subdivided`."""
        # towards the poles cells are narrow: the larger factor goes along the meridian
        columns, rows = near_square(rays)
        shape = (self.height // 2, self.width, rows, columns)
        theta = (np.arange(self.height // 2 * rows) + 0.5) * (np.pi / (self.height * rows))
        phi = (np.arange(self.width * columns) + 0.5) * (2 * np.pi / (self.width * columns))
        theta, phi = theta.reshape(-1, 1, rows, 1), phi.reshape(self.width, 1, columns)
        upper = np.empty((*shape, 3), np.float32)
        upper[..., 0] = np.sin(theta) * np.sin(phi)
        upper[..., 1] = np.cos(theta)
        upper[..., 2] = -np.sin(theta) * np.cos(phi)
        upper = upper.reshape(-1, rays, 3)
        shares = _bands(self.height * rows).reshape(-1, 1, rows, 1)
        shares = shares / (columns * shares.sum(axis=2, keepdims=True))
        fractions = np.broadcast_to(shares, shape).reshape(-1, rays).astype(np.float32)
        return np.concatenate([upper, -upper]), np.tile(fractions, (2, 1))

    def cells(self, vectors):
        """Index of the cell that each direction falls in; see `DirectionLattice.cells`."""
        x, y, z = np.ascontiguousarray(vectors.T)
        lower = y < 0
        # Directions of the lower hemisphere are looked up by their antipode.
        phi = np.arctan2(np.where(lower, -x, x), np.where(lower, z, -z))
        theta = np.arctan2(np.hypot(x, z), np.abs(y))
        row = np.minimum((theta * (self.height / np.pi)).astype(np.int64), self.height // 2 - 1)
        column = np.floor(phi * (self.width / (2 * np.pi))).astype(np.int64) % self.width
        return row * self.width + column + lower * (len(self) // 2)


def _bands(height):
    """cos θ₀ − cos θ₁ of the upper half of `height` equally high bands, without cancellation at the
    pole.
    """
    middle = (np.arange(height // 2) + 0.5) * (np.pi / height)
    return 2 * np.sin(middle) * np.sin(np.pi / height / 2)
