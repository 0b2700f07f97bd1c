"""A low-discrepancy lattice: Halton points and the cells of the sphere that are nearest to them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import SphericalVoronoi

from ..errors import SettingsError
from .lattice import DirectionLattice, is_integer_in, near_square, unit

MIN_HALTON_COUNT = 6  # three pairs of opposite directions; fewer leave cells without corners
MAX_HALTON_COUNT = 98_304  # as many as cubemap:128
TABLE_REFINEMENT = 16  # table cells along the side of a cell: a quarter of them then touch a border


@dataclass(frozen=True)
class Halton(DirectionLattice):
    """Halton lattice of s directions, each in the cell of what is nearer to it than to any other.

    The first half are the points 1…s/2 of the Halton sequence in the bases 2 and 3, brought to the
    upper hemisphere with equal areas: y is the first coordinate, and the second the azimuth φ/2π in
    (sin φ · √(1 − y²), y, −cos φ · √(1 − y²)). The second half are their antipodes. Cells are
    spherical Voronoi cells, exact, and may differ tenfold in solid angle.

    Parameters
    ----------
    count : int
        s, even.

    Raises
    ------
    SettingsError
        If the count is not an even integer in 6…98,304.
    """

    count: int

    def __post_init__(self):
        if not is_integer_in(self.count, MIN_HALTON_COUNT, MAX_HALTON_COUNT) or self.count % 2:
            raise SettingsError(
                f"halton count {self.count} must be an even number in"
                f" {MIN_HALTON_COUNT}…{MAX_HALTON_COUNT:,}: use for example halton:6144"
            )

    def __str__(self):
        return f"halton:{self.count}"

    def __len__(self):
        return self.count

    @cached_property
    def solid_angles(self):
        """Exact solid angles of the cells, (s,) float64 in sr."""
        _, ends = self._fans
        return np.tile(ends[:, -1], 2)

    def subdivided(self, rays):
        """Sub-cells of equal solid angle; see `DirectionLattice.subdivided`.

        A square grid, as square as the number allows, is brought to the disc by the concentric map
        of Shirley and Chiu (1997), and the disc to each cell along rays from its direction. Both
        maps keep shares of area.
        """
        rows, columns = near_square(rays)
        x, y = np.meshgrid(
            (2 * np.arange(columns) + 1) / columns - 1, (2 * np.arange(rows) + 1) / rows - 1
        )
        half = np.stack(
            [self._at(*place) for place in zip(*_concentric(x.ravel(), y.ravel()))], axis=1
        ).astype(np.float32)
        return np.concatenate([half, -half]), np.full((self.count, rays), 1 / rays, np.float32)

    def cells(self, vectors):
        """Index of the cell that each direction falls in; see `DirectionLattice.cells`."""
        fine, table = self._table
        cells = table[fine.cells(vectors)]
        border = np.flatnonzero(cells < 0)
        cells[border] = self._tree.query(unit(vectors[border]), workers=-1)[1]
        return cells

    @cached_property
    def _directions(self):
        """The first half of the directions, (s/2, 3) float64."""
        index = np.arange(1, self.count // 2 + 1)
        y, phi = _radical_inverse(index, 2), 2 * np.pi * _radical_inverse(index, 3)
        radius = np.sqrt(1 - y * y)
        return np.stack([radius * np.sin(phi), y, -radius * np.cos(phi)], axis=-1)

    @cached_property
    def _fans(self):
        """The cells of the first half as fans of c triangles about their directions.

        Returns
        -------
        corners : (s/2, c + 1, 3) float64
            Triangle t lies between corners t and t + 1; those that a cell lacks are empty.
        ends : (s/2, c) float64
            Solid angle of the fan up to and with each triangle.
        """
        half = self._directions
        voronoi = SphericalVoronoi(np.concatenate([half, -half]))
        voronoi.sort_vertices_of_regions()
        regions = voronoi.regions[: len(half)]
        count = max(map(len, regions)) + 1
        corners = voronoi.vertices[
            [region + region[:1] * (count - len(region)) for region in regions]
        ]
        centre, a, b = half[:, None], corners[:, :-1], corners[:, 1:]
        # Solid angle of a triangle (Van Oosterom and Strackee, 1983).
        triangles = 2 * np.arctan2(
            np.abs(_dot(centre, np.cross(a, b))), 1 + _dot(centre, a) + _dot(a, b) + _dot(b, centre)
        )
        return corners, np.cumsum(triangles, axis=1)

    def _at(self, turn, share):
        """The direction in each cell of the first half at a share (0…1) of the cell's solid angle
        about its own direction and at a share of it outwards; (s/2, 3) float64.

        The border is reached where the fan's solid angle says, the place on the way there where the
        cap's does (Arvo 1995, Stratified sampling of spherical triangles).
        """
        centre, (corners, ends) = self._directions, self._fans
        cell, target = np.arange(len(centre)), turn * ends[:, -1]
        triangle = (ends <= target[:, None]).sum(axis=1)
        before = np.where(triangle > 0, ends[cell, triangle - 1], 0)
        a, b = corners[cell, triangle], corners[cell, triangle + 1]
        along = unit(b - a * _dot(a, b)[:, None])
        # The triangle (centre, a, border) has the solid angle target − before; solved for the arc
        # from a to the border.
        tangent = np.tan((target - before) / 2)
        volume = np.abs(_dot(centre, np.cross(a, along)))
        arc = 2 * np.arctan(
            tangent * (1 + _dot(centre, a)) / (volume - tangent * _dot(centre, along))
        )
        border = a * np.cos(arc)[:, None] + along * np.sin(arc)[:, None]
        reach = _dot(centre, border)
        cosine = (1 - share * (1 - reach))[:, None]
        return centre * cosine + unit(border - centre * reach[:, None]) * np.sqrt(1 - cosine**2)

    @cached_property
    def _table(self):
        """A fine cubemap, and which cell each of its cells lies in; −1 where a border may cross
        it.
        """
        fine = self.refined(TABLE_REFINEMENT)
        half = len(fine) // 2
        chords, nearest = self._tree.query(fine.vectors[:half], 2, workers=-1)
        nearer, next_near = 2 * np.arcsin(chords.T / 2)
        # No direction of a fine cell is farther from its centre than √(8/3) times half its side, at
        # the cube's corners.
        reach = np.pi / 4 / fine.resolution * (8 / 3) ** 0.5 + 1e-6  # and what float32 may err
        first = np.where(next_near - nearer > 2 * reach, nearest[:, 0], -1)
        second = np.where(first < 0, -1, (first + self.count // 2) % self.count)
        return fine, np.concatenate([first, second])


def _radical_inverse(index, base):
    """The digits of integers mirrored at the point (van der Corput): float64 in [0, 1)."""
    result, digit = np.zeros(len(index)), 1 / base
    while index.any():
        result += index % base * digit
        index, digit = index // base, digit / base
    return result


def _concentric(x, y):
    """Shares (of the turn, of the area) on a disc of points of the square [−1, 1]², by the
    concentric map.
    """
    wide = np.abs(x) >= np.abs(y)
    longer = np.where(wide, x, y)
    slope = np.divide(np.where(wide, y, x), longer, out=np.zeros(len(x)), where=longer != 0)
    turn = np.where(wide, slope, 2 - slope) / 8 + (longer < 0) / 2
    return turn % 1, longer**2


def _dot(a, b):
    return np.einsum("...i,...i->...", a, b)
