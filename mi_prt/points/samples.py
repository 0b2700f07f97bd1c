"""Meshless sample points (Meshless PRT, section 4.1)."""

import numpy as np
from scipy.spatial import cKDTree

from ..errors import SettingsError
from .clusters import make_clusters
from .layout import Spacing
from .particles import cross_surfaces, trace_particles
from .points import Points
from .sample_locator import SampleLocator
from .thinning import embedded, thin

CANDIDATES = 24  # particles' hits for each sample that stays
CROSSINGS = 16  # random places on surfaces for each sample, that measure its area
COVERED = 1.25  # radii from a sample up to which a surface counts as reachable
MOST_SAMPLES = 1_000_000
_MOST_BLOCKS = 512


def scatter_points(scene, count, clusters, seed=0):
    """Samples in blue noise on all surfaces that light can reach, ordered by cluster.

    Parameters
    ----------
    scene : Scene
    count : int
        Samples.
    clusters : int
        Number of clusters.
    seed : int

    Returns
    -------
    points : Points
        `report` holds radius, reachable_area (m², the sum of the points' areas) and coverage: the
        share of the reachable area that is within a radius of a sample.
    clusters : Clusters
    flights : (k, 2, 3) float32
        Flights of particles through the space between surfaces, see `particles.example_places`.

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
    found = make_clusters(hits, clusters, seed)
    hits = hits.at(found.order)
    areas, coverage = _areas(scene, hits, radius, seed)
    points = Points(
        hits.positions,
        hits.normals,
        hits.geometric_normals,
        hits.albedo,
        np.zeros_like(hits.positions),
        areas.astype(np.float32),
        hits.uv,
        hits.surface,
        np.zeros(len(hits), bool),
        Spacing(radius),
        tuple({"name": s.name, "kind": s.kind} for s in scene.surfaces),
        {"radius": radius, "reachable_area": float(areas.sum()), "coverage": coverage},
    )
    return points, found.in_order(), flights


def _areas(scene, hits, radius, seed):
    """Area (n,) of each sample in m², and the share of it that lies within a radius of a sample.

    Random lines cross surfaces in places of equal density; each place counts for the nearest
    sample.
    """
    import drjit as dr

    locator = SampleLocator(hits.positions, hits.normals, radius)
    low, high = hits.positions.min(axis=0), hits.positions.max(axis=0)
    ball = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2 * 1.01, radius)
    counts, near = np.zeros(len(hits), np.int64), 0
    for blocks, (crossings, area) in enumerate(cross_surfaces(scene, *ball, seed), 1):
        if len(crossings):
            index, distance = locator.nearest(
                *(_lanes(x) for x in (crossings.positions, crossings.normals))
            )
            dr.eval(index, distance)
            distance = np.array(distance)
            covered = distance < COVERED * radius
            counts += np.bincount(np.array(index)[covered], minlength=len(hits))
            near += int((distance < radius).sum())
        areas = counts * (area / blocks)
        if counts.sum() >= CROSSINGS * len(hits) or blocks == _MOST_BLOCKS:
            break
    total = max(int(counts.sum()), 1)
    return _smoothed(hits, radius, areas), near / total


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

    from ..system.arrays import packets
    from ..system.runtime import mitsuba

    mi = mitsuba()
    return dr.gather(mi.Vector3f, packets(vectors), dr.arange(mi.UInt32, len(vectors)))
