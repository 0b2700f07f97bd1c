"""The cells of an equi-angular cubemap."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import SettingsError
from .lattice import MAX_CUBEMAP_RESOLUTION, DirectionLattice, is_integer_in, near_square

# Frame of each cube face: its rows are the axes of the face coordinates (a, b) and the outward
# normal. The faces −x, −y, −z are the point reflections of +x, +y, +z, so that cell j + s/2 is the
# antipode of cell j.
_POSITIVE_FACES = np.array(
    [
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # +x
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # +y
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # +z
    ],
    dtype=np.float64,
)
_FACES = np.concatenate([_POSITIVE_FACES, -_POSITIVE_FACES])


@dataclass(frozen=True)
class Cubemap(DirectionLattice):
    """Equi-angular cubemap lattice with 6·N·N cells.

    The cells of a face are equally wide in angle, not in the face's plane, so that the solid angles
    of one map differ by at most √2 instead of 5.2 and the resolution is the same in the middle of a
    face and at its corners. Cell index: (face·N + row)·N + column, faces in the order +x, +y, +z,
    −x, −y, −z.

    Parameters
    ----------
    resolution : int
        N, cells along an edge of a face.

    Raises
    ------
    SettingsError
        If the resolution is not an integer in 1…512.
    """

    resolution: int

    def __post_init__(self):
        if not is_integer_in(self.resolution, 1, MAX_CUBEMAP_RESOLUTION):
            raise SettingsError(
                f"cubemap resolution {self.resolution} is outside 1…{MAX_CUBEMAP_RESOLUTION}: use"
                " for example cubemap:32"
            )

    def __str__(self):
        return f"cubemap:{self.resolution}"

    def __len__(self):
        return 6 * self.resolution**2

    @cached_property
    def solid_angles(self):
        """Exact solid angles of the cells, (s,) float64 in sr."""
        return _cell_solid_angles(self.resolution, self.resolution).ravel()

    def subdivided(self, rays):
        """Equi-angular sub-cells, as square as their number allows; see
        `DirectionLattice.subdivided`.
        """
        rows, columns = near_square(rays)
        n = self.resolution
        a = np.tan(np.pi / 4 * _centres(n * columns))
        b = np.tan(np.pi / 4 * _centres(n * rows))
        grid = np.stack(np.broadcast_arrays(a[None, :], b[:, None], 1.0), axis=-1)
        vectors = np.einsum("hwi,fij->fhwj", grid, _FACES)
        vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
        solid_angles = _cell_solid_angles(n * rows, n * columns)

        def by_cell(x):
            x = x.reshape(6, n, rows, n, columns, -1).transpose(0, 1, 3, 2, 4, 5)
            return x.reshape(len(self), rays, -1)

        solid_angles = by_cell(solid_angles[..., None])[..., 0]
        fractions = solid_angles / solid_angles.sum(axis=1, keepdims=True)
        return by_cell(vectors).astype(np.float32), fractions.astype(np.float32)

    def cells(self, vectors):
        """Index of the cell that each direction falls in; see `DirectionLattice.cells`."""
        x, y, z = np.ascontiguousarray(vectors.T)
        ax, ay, az = np.abs(x), np.abs(y), np.abs(z)
        on_x = (ax >= ay) & (ax >= az)
        on_y = ~on_x & (ay >= az)
        major = np.where(on_x, x, np.where(on_y, y, z))
        scale = 1 / major
        # Coordinates in the frames of _FACES; the sign of the major axis reflects them on the
        # negative faces.
        z_scaled = -z * scale
        a = np.where(on_x, z_scaled, x * scale)
        b = np.where(on_y, z_scaled, y * scale)
        face = np.where(on_x, 0, np.where(on_y, 1, 2)) + 3 * np.signbit(major)
        n = self.resolution
        column = _index_along(a, n)
        row = _index_along(b, n)
        return (face * n + row) * n + column


def _index_along(tangent, n):
    return np.clip((np.arctan(tangent) * (2 * n / np.pi) + n / 2).astype(np.int64), 0, n - 1)


def _centres(n):
    return (np.arange(n) + 0.5) * (2 / n) - 1


def _cell_solid_angles(rows, columns):
    """Exact solid angles (6, rows, columns) of equi-angular cells, from the solid angle of a
    rectangle at its corner.
    """
    a = np.tan(np.pi / 4 * np.linspace(-1, 1, columns + 1))
    b = np.tan(np.pi / 4 * np.linspace(-1, 1, rows + 1))[:, None]
    corner = np.arctan2(a * b, np.sqrt(a * a + b * b + 1))
    face = np.diff(np.diff(corner, axis=0), axis=1)
    return np.broadcast_to(face, (6, rows, columns)).copy()
