"""Meshless sample points and their clusters (Meshless PRT, section 4.1)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..errors import SettingsError
from .lattice import Patches
from .particles import cross_surfaces, free_places, trace_particles
from .points import Points
from .sample_locator import SampleLocator
from .thinning import embedded, thin

CANDIDATES = 24  # particles' hits for each sample that stays
CROSSINGS = 16  # random places on surfaces for each sample, that measure its area
COVERED = 1.25  # radii from a sample up to which a surface counts as reachable
MOST_SAMPLES = 1_000_000
_MOST_BLOCKS = 512
_FREE_CANDIDATES = 8  # for each place in free space that stays


@dataclass(frozen=True, eq=False)
class Samples:
    """Sample points of a scene, ordered by cluster.

    Parameters
    ----------
    points : Points
        Without patches.
    starts : (c + 1,) int64
        Cluster i holds the points starts[i] … starts[i + 1] − 1.
    roots : (c,) int64
        The point in the middle of each cluster.
    radius : float
        Metres that samples keep from each other, less on curved surfaces.
    """

    points: Points
    starts: np.ndarray
    roots: np.ndarray
    radius: float

    def __len__(self):
        return len(self.points)

    @property
    def clusters(self):
        """Slices of points."""
        return [slice(int(a), int(b)) for a, b in zip(self.starts, self.starts[1:])]

    @property
    def labels(self):
        """Cluster of each point, (n,) int32."""
        return np.repeat(np.arange(len(self.roots), dtype=np.int32), np.diff(self.starts))

    def locator(self):
        """A SampleLocator of these points."""
        return SampleLocator(self.points.positions, self.points.normals, self.radius)


def scatter_samples(scene, count, cluster_size, examples, seed=0):
    """Samples in blue noise on all surfaces that light can reach, in clusters, and places for
    lights between them.

    Parameters
    ----------
    scene : Scene
    count : int
        Samples.
    cluster_size : int
        Samples in a cluster, on average.
    examples : int
        Places in free space.
    seed : int

    Returns
    -------
    samples : Samples
        `points.report` holds radius, reachable_area (m², the sum of the points' areas) and
        coverage: the share of the reachable area that is within a radius of a sample.
    places : (examples, 3) float32

    Raises
    ------
    SceneError, SettingsError
        See `trace_particles`.
    """
    if not 1 <= count <= MOST_SAMPLES:
        raise SettingsError(f"count {count} must be from 1 to {MOST_SAMPLES:,} samples")
    hits, flights = trace_particles(scene, CANDIDATES * count, seed)
    # A run of particles may find far more than are needed to leave no hole.
    hits = hits.at(np.random.default_rng(seed).permutation(len(hits))[: CANDIDATES * count])
    chosen, radius = thin(hits.positions, hits.normals, count, seed)
    if not radius > 0:
        raise SettingsError(
            f"count {count:,} is too high: particles find fewer places on surfaces that are apart"
            " from each other"
        )
    hits = hits.at(chosen)
    roots, starts, order = _clusters(hits, max(1, round(count / cluster_size)), seed)
    hits = hits.at(order)
    areas, coverage = _areas(scene, hits, radius, seed)
    places = free_places(flights, _FREE_CANDIDATES * examples, seed)
    places = places[thin(places, None, examples, seed, dimension=3)[0]]
    points = Points(
        hits.positions,
        hits.normals,
        hits.geometric_normals,
        hits.albedo,
        np.zeros_like(hits.positions),
        areas.astype(np.float32),
        hits.uv,
        hits.surface,
        Patches(np.zeros((0, 2), np.int32), *(np.zeros(0, np.int32) for _ in range(3))),
        tuple({"name": s.name, "kind": s.kind} for s in scene.surfaces),
        {"radius": radius, "reachable_area": float(areas.sum()), "coverage": coverage},
    )
    return Samples(points, starts, roots, radius), places


def _clusters(hits, count, seed):
    """Roots (c,) as positions in the new order, starts (c + 1,), and the order of points by
    cluster.

    Roots are thinned like samples, at a larger radius, and each sample belongs to the nearest. No
    sample is farther from its root than about the radius, so that its normal is within 60° of the
    root's: no cluster holds both sides of a wall. (With fewer clusters than there are such
    directions, six in a room, that cannot be.)
    """
    roots, radius = thin(hits.positions, hits.normals, count, seed)
    tree = cKDTree(embedded(hits.positions[roots], hits.normals[roots], radius))
    label = tree.query(embedded(hits.positions, hits.normals, radius))[1]
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(count + 1))
    return np.argsort(order)[roots], starts, order


def _areas(scene, hits, radius, seed):
    """Area (n,) of each sample in m², and the share of it that lies within a radius of a sample.

    Random lines cross surfaces in places of equal density; each place counts for the nearest
    sample.
    """
    import drjit as dr

    locator = SampleLocator(hits.positions, hits.normals, radius)
    low, high = hits.positions.min(axis=0), hits.positions.max(axis=0)
    ball = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2 * 1.01, radius)
    counts, near, blocks = np.zeros(len(hits), np.int64), 0, 0
    for crossings, area in cross_surfaces(scene, *ball, seed):  # noqa: B007  (the last area)
        blocks += 1
        if len(crossings):
            index, distance = locator.nearest(
                *(_lanes(x) for x in (crossings.positions, crossings.normals))
            )
            dr.eval(index, distance)
            distance = np.array(distance)
            covered = distance < COVERED * radius
            counts += np.bincount(np.array(index)[covered], minlength=len(hits))
            near += int((distance < radius).sum())
        if counts.sum() >= CROSSINGS * len(hits) or blocks == _MOST_BLOCKS:
            break
    total = max(int(counts.sum()), 1)
    return _smoothed(hits, radius, counts * (area / blocks)), near / total


def _smoothed(hits, radius, areas):
    """Areas less the noise of their counts: the mean over neighbours; their sum stays."""
    points = embedded(hits.positions, hits.normals, radius)
    neighbours = (
        cKDTree(points).query(points, min(9, len(points)), workers=-1)[1].reshape(len(points), -1)
    )
    smooth = areas[neighbours].mean(axis=1)
    return smooth * (areas.sum() / max(smooth.sum(), 1e-300))


def _lanes(vectors):
    """Vectors (m, 3) in Dr.Jit, gathered: what is read lane by lane compiles another kernel where
    its memory is aligned otherwise.
    """
    import drjit as dr

    from ..system.runtime import mitsuba

    mi = mitsuba()
    return dr.gather(mi.Vector3f, mi.Float(vectors.ravel()), dr.arange(mi.UInt32, len(vectors)))
