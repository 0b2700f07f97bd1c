"""What all direction lattices have in common."""

from abc import ABC, abstractmethod
from functools import cached_property
from math import ceil, sqrt

import numpy as np
from scipy.spatial import cKDTree

from ..errors import SettingsError

MAX_CUBEMAP_RESOLUTION = 512
# 1.6 million: beyond any transport matrix this program could hold
MAX_DIRECTIONS = 6 * MAX_CUBEMAP_RESOLUTION**2


class DirectionLattice(ABC):
    """s unit vectors, each in a cell of its own; the cells partition the sphere.

    Lattices are frozen and hashable, and equal where their settings are.
    `parse_directions(str(lattice))` gives the same lattice, and `len(lattice)` is s. Every lattice
    is symmetric about the origin: direction j + s/2 is exactly the opposite of direction j, its
    cell the point reflection of cell j, and ray r of `subdivided` the opposite of ray r there.
    Transport keeps one bit for such a pair.
    """

    @abstractmethod
    def __len__(self) -> int:
        """Number of directions s."""

    @cached_property
    def vectors(self):
        """Unit vectors of the directions, (s, 3) float32."""
        return self.subdivided(1)[0][:, 0]

    @property
    @abstractmethod
    def solid_angles(self) -> np.ndarray:
        """Exact solid angles w of the cells, (s,) float64 in sr, Σw = 4π; kept once computed."""

    @abstractmethod
    def subdivided(self, rays) -> tuple[np.ndarray, np.ndarray]:
        """Split every cell into `rays` sub-cells.

        Parameters
        ----------
        rays : int
            Number of sub-cells r of a cell.

        Returns
        -------
        vectors : (s, r, 3) float32
            Unit vectors in the middle of the sub-cells; `vectors` of the lattice if r = 1.
        fractions : (s, r) float32
            Share of the cell's solid angle that each sub-cell has; rows sum to 1.

        Raises
        ------
        SettingsError
            If there is not at least one ray.
        """

    @abstractmethod
    def cells(self, vectors) -> np.ndarray:
        """Index of the cell that each direction falls in.

        Parameters
        ----------
        vectors : (k, 3) array
            Directions of any positive length.

        Returns
        -------
        (k,) int64
        """

    def nearest(self, vectors, k):
        """The directions nearest by angle, nearest first (Eigentransport, section 4.2.1).

        One alone is that of the cell, in closed form; more go by their angles. That differs along
        the borders of a cubemap's cells, which are sheared at the cube's corners: there another
        direction is the nearest to 5 % of all directions, on average by 6 % of a cell's side. Of a
        latitude-longitude map it differs for 0.3 % and less, of Halton cells never.

        Parameters
        ----------
        vectors : (m, 3) array
            Directions of any positive length.
        k : int
            How many, 1…s.

        Returns
        -------
        (m, k) int64

        Raises
        ------
        SettingsError
            If k is outside 1…s.
        """
        if not is_integer_in(k, 1, len(self)):
            raise SettingsError(
                f"the number of nearest directions must be 1…{len(self)} for {self}, got {k}"
            )
        if k == 1:
            return self.cells(vectors)[:, None]
        return self._tree.query(unit(vectors), k, workers=-1)[1]

    def refined(self, factor):
        """A cubemap whose cells are about `factor` times finer along their sides than this
        lattice's.

        Parameters
        ----------
        factor : int

        Returns
        -------
        Cubemap
            Of a resolution of at most 512.
        """
        from .cubemap import Cubemap  # itself a lattice

        return Cubemap(min(ceil(sqrt(len(self) / 6)) * factor, MAX_CUBEMAP_RESOLUTION))

    @cached_property
    def _tree(self):
        return cKDTree(self.vectors)


def near_square(rays):
    """The factors (smaller, larger) of the number of rays in a cell that are nearest to each other.

    Raises
    ------
    SettingsError
        If there is not at least one ray.
    """
    if not is_integer_in(rays, 1, np.inf):
        raise SettingsError(f"the rays of a cell must be a whole number ≥ 1, got {rays}")
    smaller = max(i for i in range(1, int(rays**0.5) + 1) if rays % i == 0)
    return smaller, rays // smaller


def is_integer_in(value, least, most):
    """Whether a value is an integer of Python or NumPy (and no bool) in least…most."""
    return (
        isinstance(value, int | np.integer)
        and not isinstance(value, bool)
        and least <= value <= most
    )


def unit(vectors):
    """Vectors (…, 3) of any positive length as unit vectors, float64."""
    vectors = np.asarray(vectors, dtype=np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
