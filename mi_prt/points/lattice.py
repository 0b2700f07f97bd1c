"""Patches: regular lattices of points over mesh faces and over the (u, v) domain of analytic
shapes.

A patch is either a triangle of level k, whose nodes (i, j), i + j ≤ k, have the barycentric
coordinates (1 − (i + j)/k, i/k, j/k), or a rectangle of levels (k_u, k_v), whose nodes lie at
(i/k_u, j/k_v). Nodes are numbered row by row in j. A hit's position on its face therefore gives the
three points around it in closed form, with no search: `Patches.triangles` and `locate.PatchLocator`
use the same numbering.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..system.schema import Array, Flag, Number, Record, Text
from .layout import LAYOUTS, Layout

MAX_LEVEL = 1 << 15
_COUNT = Number(0, 1 << 40, whole=True)
_SURFACE = Record(
    {
        "name": Text(),
        "kind": Text(),
        "signature": Text(),
        "flipped": Flag(),
        "first_patch": _COUNT,
        "patches": _COUNT,
    }
)


@LAYOUTS.register
@dataclass(frozen=True, eq=False)
class Patches(Layout):
    """The patches of a point set, one per mesh face or analytic shape, in the order of surfaces and
    faces.

    Parameters
    ----------
    levels : (p, 2) int32
        (k, 0) for a triangle, (k_u, k_v) for a rectangle.
    offsets : (p,) int64
        Where each patch's nodes begin in `nodes`.
    nodes : (t,) int32
        Index of the point at every node.
    back : (p,) int32
        Added to a point's index gives the point on the back of the surface; 0 where the back does
        not reflect.
    """

    levels: np.ndarray
    offsets: np.ndarray
    nodes: np.ndarray
    back: np.ndarray

    kind = "patches"
    SHAPES: ClassVar[dict] = {
        "levels": Array("i4", ("patches", 2), least=0, below=MAX_LEVEL),
        "offsets": Array("i8", ("patches",), least=0, below="nodes+1"),
        "nodes": Array("i4", ("nodes",), least=0, below="n"),
        "back": Array("i4", ("patches",), least=0, below="n"),
    }

    SURFACE: ClassVar[Record] = _SURFACE

    def locator(self, scene, points):
        """See `Layout.locator`."""
        from .locate import PatchLocator

        return PatchLocator(scene, points)

    def spacing(self, points):
        """Root of each point's area."""
        return np.sqrt(points.areas)

    def arrays(self):
        """See `Layout.arrays`."""
        return {name: getattr(self, name) for name in self.SHAPES}

    @classmethod
    def from_arrays(cls, arrays, report):
        """See `Layout.from_arrays`."""
        return cls(**arrays)

    def check(self, points):
        """Nodes of all patches are there, and so are the points behind them; surfaces know their
        patches.
        """
        u, v = self.levels.astype(np.int64).T
        sizes = node_count(u, v)
        if not len(u):
            raise ValueError("layout/levels are of no patch")
        if (u < 1).any() or (self.offsets != np.cumsum(sizes) - sizes).any():
            raise ValueError("layout/offsets do not fit the levels of the patches")
        if sizes.sum() != len(self.nodes):
            raise ValueError(f"layout/nodes are {len(self.nodes)} instead of {sizes.sum()}")
        if (self.nodes + np.repeat(self.back.astype(np.int64), sizes) >= len(points)).any():
            raise ValueError("layout/back leads beyond the points")
        first = 0
        for surface in points.surfaces:
            if surface["first_patch"] != first:
                raise ValueError("points.surfaces do not list the patches in order")
            first += surface["patches"]
        if first != len(sizes):
            raise ValueError(f"points.surfaces list {first} patches of {len(sizes)}")

    def triangles(self):
        """Triangles of points, (m, 3) int32; fronts only, those of zero extent left out."""
        parts = []
        for level in np.unique(self.levels, axis=0):
            same = (self.levels == level).all(axis=1)
            corners = self.offsets[same][:, None, None] + lattice_triangles(*level)[None]
            parts.append(self.nodes[corners].reshape(-1, 3))
        triangles = np.concatenate(parts) if parts else np.zeros((0, 3), np.int32)
        a, b, c = triangles.T
        return triangles[(a != b) & (b != c) & (c != a)]


def node_count(levels_u, levels_v):
    """Number of nodes of patches of these levels; arrays or scalars."""
    return np.where(
        levels_v == 0, (levels_u + 1) * (levels_u + 2) // 2, (levels_u + 1) * (levels_v + 1)
    )


def lattice_nodes(level_u, level_v):
    """Node coordinates (i, j) of a patch in the order of their numbers, (t, 2) int64."""
    i, j = np.meshgrid(np.arange(level_u + 1), np.arange((level_v or level_u) + 1))
    inside = (i + j <= level_u) if level_v == 0 else np.ones_like(i, bool)
    return np.stack([i[inside], j[inside]], axis=-1)


def lattice_triangles(level_u, level_v):
    """Node numbers of a patch's small triangles, (m, 3) int64."""
    nodes = lattice_nodes(level_u, level_v)
    number = np.full((level_u + 2, (level_v or level_u) + 2), -1)
    number[nodes[:, 0], nodes[:, 1]] = np.arange(len(nodes))
    i, j = nodes.T
    lower = np.stack([number[i, j], number[i + 1, j], number[i, j + 1]], axis=-1)
    upper = np.stack([number[i + 1, j + 1], number[i, j + 1], number[i + 1, j]], axis=-1)
    triangles = np.concatenate([lower, upper])
    return triangles[(triangles >= 0).all(axis=1)]
