"""Clusters of points: neighbours on surfaces that face alike."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from ..system.schema import Array
from .thinning import embedded, thin


@dataclass(frozen=True, eq=False)
class Clusters:
    """Points by cluster.

    Parameters
    ----------
    order : (n,) int64
        Points, cluster by cluster.
    starts : (c + 1,) int64
        Cluster i holds the points order[starts[i]] … order[starts[i + 1] − 1].
    roots : (c,) int64
        Where in the order the point in the middle of each cluster is.
    """

    order: np.ndarray
    starts: np.ndarray
    roots: np.ndarray

    SHAPES: ClassVar[dict] = {
        "order": Array("i8", ("n",), least=0, below="n"),
        "starts": Array("i8", ("c+1",), least=0, below="n+1"),
        "roots": Array("i8", ("c",), least=0, below="n"),
    }

    def __len__(self):
        return len(self.roots)

    @property
    def slices(self):
        """Of each cluster, its part of the order."""
        return [slice(int(a), int(b)) for a, b in zip(self.starts, self.starts[1:])]

    @property
    def labels(self):
        """Cluster of each point in the order, (n,) int32."""
        return np.repeat(np.arange(len(self.roots), dtype=np.int32), np.diff(self.starts))

    @property
    def rank(self):
        """Where in the order each point is, (n,) int64."""
        rank = np.empty_like(self.order)
        rank[self.order] = np.arange(len(self.order))
        return rank

    def in_order(self):
        """The same clusters of points that were brought into this order."""
        return Clusters(np.arange(len(self.order)), self.starts, self.roots)

    def check(self, count):
        """Raise ValueError unless they divide so many points, each with its root inside."""
        if self.starts[0] != 0 or self.starts[-1] != count or (np.diff(self.starts) <= 0).any():
            raise ValueError("clusters/starts do not divide the points")
        if (np.bincount(self.order, minlength=count) != 1).any():
            raise ValueError("clusters/order does not hold each point once")
        if (self.roots < self.starts[:-1]).any() or (self.roots >= self.starts[1:]).any():
            raise ValueError("clusters/roots are not in their clusters")


def make_clusters(points, count, seed=0):
    """Clusters of points, about equally large on the surface.

    Roots are thinned like samples, at a larger radius, and each point belongs to the nearest. No
    point is farther from its root than about the radius, so that its normal is within 60° of the
    root's: no cluster holds both sides of a wall. (With fewer clusters than there are such
    directions, six in a room, that cannot be.)

    Parameters
    ----------
    points : Points, or what else has positions and normals (n, 3)
    count : int
        Fewer come back where fewer points differ in position or normal.
    seed : int

    Returns
    -------
    Clusters
    """
    positions, normals = points.positions, points.normals
    # Meshes that meet may share points; two roots in one place would be one cluster too many.
    distinct = np.unique(np.hstack([positions, normals]) + 0.0, axis=0, return_index=True)[1]
    distinct.sort()
    few = min(count, len(distinct))
    roots, radius = thin(positions[distinct], normals[distinct], few, seed)
    roots = distinct[roots]
    tree = cKDTree(embedded(positions[roots], normals[roots], radius))
    label = tree.query(embedded(positions, normals, radius))[1]
    used, label = np.unique(label, return_inverse=True)
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(len(used) + 1))
    return Clusters(order, starts, np.argsort(order)[roots[used]])
