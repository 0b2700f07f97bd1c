"""Patches: regular lattices of points over mesh faces and over the (u, v) domain of analytic
shapes.

A patch is either a triangle of level k, whose nodes (i, j), i + j ≤ k, have the barycentric
coordinates (1 − (i + j)/k, i/k, j/k), or a rectangle of levels (k_u, k_v), whose nodes lie at
(i/k_u, j/k_v). Nodes are numbered row by row in j. A hit's position on its face therefore gives the
three points around it in closed form, with no search: `Patches.triangles` and `locate.PatchLocator`
use the same numbering.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Patches:
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
