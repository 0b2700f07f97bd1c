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
from .quadtree import CHILDREN

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
    faces, and behind them those that some of them are cut into, see `QuadTree`.

    Parameters
    ----------
    levels : (p, 2) int32
        (k, 0) for a triangle, (k_u, k_v) for a rectangle; of one that is cut (1, 0) or (1, 1).
    offsets : (p,) int64
        Where each patch's nodes begin in `nodes`.
    nodes : (t,) int32
        Index of the point at every node.
    back : (p,) int32
        Added to a point's index gives the point on the back of the surface; 0 where the back does
        not reflect.
    children : (p,) int32
        The first of the four patches that each is cut into, higher than itself; 0 where it is not
        cut. A patch that is has no nodes.
    """

    levels: np.ndarray
    offsets: np.ndarray
    nodes: np.ndarray
    back: np.ndarray
    children: np.ndarray

    kind = "patches"
    SHAPES: ClassVar[dict] = {
        "levels": Array("i4", ("patches", 2), least=0, below=MAX_LEVEL),
        "offsets": Array("i8", ("patches",), least=0, below="nodes+1"),
        "nodes": Array("i4", ("nodes",), least=0, below="n"),
        "back": Array("i4", ("patches",), least=0, below="n"),
        "children": Array("i4", ("patches",), least=0, below="patches"),
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
        sizes = np.where(self.children > 0, 0, node_count(u, v))
        roots = len(sizes) - CHILDREN * int((self.children > 0).sum())
        first = np.sort(self.children[self.children > 0])
        if not len(u):
            raise ValueError("layout/levels are of no patch")
        if roots < 1 or not np.array_equal(first, np.arange(roots, len(sizes), CHILDREN)):
            raise ValueError("layout/children are not the patches behind the roots, each once")
        if (self.children[self.children > 0] <= np.flatnonzero(self.children)).any():
            raise ValueError("layout/children come before the patch that is cut into them")
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
        if first != roots:
            raise ValueError(f"points.surfaces list {first} patches of {roots}")

    def triangles(self):
        """Triangles of points, (m, 3) int32; fronts only, those of zero extent left out."""
        return leaf_triangles(self.levels[self.children == 0], self.nodes)[0]

    def domain(self, patch):
        """The (u, v) domain of an analytic shape, with nodes of their own along a seam.

        Parameters
        ----------
        patch : int
            Its root.

        Returns
        -------
        points : (t,) int32
            Of all nodes.
        uv : (t, 2) float64
        triangles : (m, 3) int64
            Of nodes.
        """
        points, uv, triangles, count = [], [], [], 0
        open_ = [(patch, np.zeros(2), 1.0)]
        while open_:
            patch, low, size = open_.pop()
            first = int(self.children[patch])
            if first:
                corners = [low + size / 2 * np.array([i % 2, i // 2]) for i in range(CHILDREN)]
                open_ += [(first + i, corner, size / 2) for i, corner in enumerate(corners)]
                continue
            level = self.levels[patch]
            nodes = lattice_nodes(*level)
            start = self.offsets[patch]
            points.append(self.nodes[start : start + len(nodes)])
            uv.append(low + size * nodes / level)
            triangles.append(lattice_triangles(*level) + count)
            count += len(nodes)
        return np.concatenate(points), np.concatenate(uv), np.concatenate(triangles)


def joined_patches(surfaces):
    """The Patches of several surfaces.

    Parameters
    ----------
    surfaces : sequence of (tree, levels, nodes, back)
        Of each the QuadTree, the levels (l, 2) and nodes (t,) of patches that are not cut, with
        nodes as points of all surfaces, and what leads to the back, or 0.
    """
    roots, children = [], []  # (levels, first child, nodes, back) of each surface
    total = sum(tree.roots for tree, *_ in surfaces)
    for tree, levels, nodes, back in surfaces:
        leaves, first = tree.leaves, tree.children
        every = np.tile([1, int(levels[0, 1] > 0)], (len(tree), 1))
        every[leaves] = levels
        behind = total - tree.roots + sum(len(x[0]) for x in children)
        first = np.where(first > 0, first + behind, 0)
        end = int(node_count(*levels[leaves < tree.roots].astype(np.int64).T).sum())
        r = tree.roots
        roots.append((every[:r], first[:r], nodes[:end], np.full(r, back)))
        children.append((every[r:], first[r:], nodes[end:], np.full(len(tree) - r, back)))
    levels, first, nodes, back = (np.concatenate(x) for x in zip(*roots, *children))
    sizes = np.where(first > 0, 0, node_count(*levels.astype(np.int64).T))
    return Patches(
        levels.astype(np.int32),
        np.cumsum(sizes) - sizes,
        nodes.astype(np.int32),
        back.astype(np.int32),
        first.astype(np.int32),
    )


def leaf_triangles(levels, nodes):
    """Small triangles of patches that are not cut.

    Parameters
    ----------
    levels : (l, 2) int
    nodes : (t,) int
        Of one patch behind those of another.

    Returns
    -------
    triangles : (m, 3)
        Entries of `nodes`; those with two equal ones are left out.
    patch : (m,) int64
        Which patch each is of.
    """
    counts = node_count(*levels.astype(np.int64).T)
    offsets = np.cumsum(counts) - counts
    parts, patches = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for level in np.unique(levels, axis=0):
        same = np.flatnonzero((levels == level).all(axis=1))
        corners = lattice_triangles(*level)
        parts.append((offsets[same][:, None, None] + corners[None]).reshape(-1, 3))
        patches.append(np.repeat(same, len(corners)))
    triangles, patch = nodes[np.concatenate(parts)], np.concatenate(patches)
    a, b, c = triangles.T
    whole = (a != b) & (b != c) & (c != a)
    return triangles[whole], patch[whole]


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
