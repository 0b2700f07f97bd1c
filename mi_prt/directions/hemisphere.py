"""Directions over a hemisphere, on a grid that is looked up in closed form.

The unit square is mapped to the disk by Shirley and Chiu's concentric map and from there to the
hemisphere, both with equal area: the cells of a grid have equal solid angles, neighbours in the
grid are neighbours on the hemisphere, and the four directions around any other one are found
without a search.
"""

import numpy as np

from ..errors import SettingsError
from ..system.runtime import mitsuba

LEAST, MOST = 16, 1 << 16
_SKEW = 1.5  # between the sides of the grid, at most
_OPPOSITE = 1e-6  # length of the sum of two unit vectors, below which they count as opposite


class Hemisphere:
    """A grid of directions over the hemisphere around z.

    Parameters
    ----------
    count : int
        Directions: a product of two numbers that differ by half at most, such as 2016 = 42·48.

    Attributes
    ----------
    rows, columns : int
    vectors : (count, 3) float32
        Unit vectors, row by row. Each stands for 2π/count sr.
    weights : (count,) float32
        Share of each direction's cosine-weighted solid angle in that of all.

    Raises
    ------
    SettingsError
        If the count is out of range or no such product; with the nearest that are.
    """

    def __init__(self, count):
        sides = _sides(count) if LEAST <= count <= MOST else None
        if sides is None:
            fitting = sorted(
                (c for c in range(LEAST, MOST + 1) if _sides(c)), key=lambda c: abs(c - count)
            )[:2]
            raise SettingsError(
                f"{count} depth directions make no grid with sides of about the same length: take"
                f" {' or '.join(map(str, sorted(fitting)))}"
            )
        self.rows, self.columns = sides
        j, i = np.indices(sides).reshape(2, -1)
        x, y = (i + 0.5) / self.columns, (j + 0.5) / self.rows
        self.vectors = _to_hemisphere(x, y).astype(np.float32)
        self.weights = (self.vectors[:, 2] / self.vectors[:, 2].sum(dtype=np.float64)).astype(
            np.float32
        )

    def __len__(self):
        return len(self.vectors)

    def around(self, direction):
        """The four directions around others, and their shares in bilinear interpolation on the
        grid.

        Parameters
        ----------
        direction : mi.Vector3f
            Unit, z ≥ 0.

        Returns
        -------
        index : tuple of four mi.UInt32
        share : tuple of four mi.Float
        """
        import drjit as dr

        mi = mitsuba()
        # To the disk with equal area, r² = 1 − cos θ, and from there to the square.
        z = dr.clip(direction.z, 0, 1)
        scale = dr.sqrt(1 / (1 + z))
        square = mi.warp.uniform_disk_to_square_concentric(
            mi.Point2f(direction.x * scale, direction.y * scale)
        )
        columns, rows = (dr.opaque(mi.UInt32, n) for n in (self.columns, self.rows))
        x = dr.clip(square.x * mi.Float(columns) - 0.5, 0, mi.Float(columns - 1))
        y = dr.clip(square.y * mi.Float(rows) - 0.5, 0, mi.Float(rows - 1))
        i, j = dr.minimum(mi.UInt32(x), columns - 2), dr.minimum(mi.UInt32(y), rows - 2)
        u, v = x - mi.Float(i), y - mi.Float(j)
        first = j * columns + i
        return (
            (first, first + 1, first + columns, first + columns + 1),
            ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v),
        )


def frames(normals, reference):
    """Rotations (n, 3, 3) whose third columns are normals (n, 3), each turned the shortest way from
    one frame (3, 3).

    Directions of neighbouring points on a surface are then as parallel as they can be.
    """
    reference, normals = np.asarray(reference, np.float64), np.asarray(normals, np.float64)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    z = reference[:, 2] / np.linalg.norm(reference[:, 2])
    # A half turn about z and one about the middle between z and the normal together take z to the
    # normal the shortest way.
    middle = normals + z
    length = np.linalg.norm(middle, axis=1, keepdims=True)
    opposite = length[:, 0] < _OPPOSITE
    middle = np.where(opposite[:, None], reference[:, 0], middle / np.maximum(length, _OPPOSITE))
    return _half_turns(middle) @ _half_turns(z[None]) @ reference


def frame_of(normal):
    """A rotation (3, 3) whose third column is a unit vector."""
    normal = np.asarray(normal, np.float64)
    other = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(other, normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal], axis=1)


def _half_turns(axes):
    """Rotations (n, 3, 3) by 180 degrees about unit axes (n, 3)."""
    return 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)


def _sides(count):
    for rows in range(int(count**0.5), 1, -1):
        if count % rows == 0:
            return (rows, count // rows) if count // rows <= _SKEW * rows else None
    return None


def _to_hemisphere(x, y):
    """Concentric map of the unit square to the hemisphere (k, 3), equal area."""
    a, b = 2 * x - 1, 2 * y - 1
    wide = np.abs(a) > np.abs(b)
    r = np.where(wide, a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        phi = np.where(wide, np.pi / 4 * (b / a), np.pi / 2 - np.pi / 4 * (a / b))
    phi = np.where(r == 0, 0, phi)
    z = 1 - r * r
    sine = r * np.sqrt(2 - r * r)
    return np.stack([np.cos(phi) * sine, np.sin(phi) * sine, z], axis=-1)
