"""What each sample point sees over its hemisphere: how far, and which sample there (Meshless PRT,
sections 4.2 and 4.3).

One set of rays serves both. Distances become depth buffers, which tell whether a local light is
visible; the samples that are seen make the one-hop transport from point to point, E(x) = Σ_j w_j
ρ_j E(y_j) with the cosine-weighted shares w_j of the directions, which sum to one.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ..directions.hemisphere import frame_of, frames
from ..scene.materials import facing, reflectance_at
from ..system.arrays import indices, packets
from ..system.parallel import map_chunks
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET

# in the place of a sample: what is seen reflects nothing, or no sample is near it
NOTHING = 0xFFFFFFFF
_CHUNK_ROWS = 64  # points whose hops a thread gathers at a time


@dataclass(frozen=True, eq=False)
class Hemispheres:
    """What m points see in N directions each.

    Parameters
    ----------
    distance : (m, N) float32
        Metres; infinite where a ray escapes.
    sample : (m, N) uint32
        The point nearest to what is seen, by its place in the order of the clusters, or
        `NOTHING`.
    albedo : (m, N, channels) float32
        Of what is seen.
    """

    distance: np.ndarray
    sample: np.ndarray
    albedo: np.ndarray


class HemisphereTracer:
    """Traces the hemispheres of a scene's sample points.

    Parameters
    ----------
    scene : Scene
    points : Points
    clusters : Clusters
        In whose order points are traced and counted.
    hemisphere : Hemisphere
    channels : 1 or 3
        Of the albedo that is kept; one channel is the mean of three.
    lanes : int
        Most rays of one wavefront. Results do not depend on it.
    """

    def __init__(self, scene, points, clusters, hemisphere, channels, lanes=LANES):
        self._scene, self._hemisphere = scene, hemisphere
        self._channels = channels
        self._locator = points.locator(scene)
        self._rank = indices(clusters.rank)
        self._vectors = packets(np.pad(hemisphere.vectors, ((0, 0), (0, 1))))
        self._origins = packets(points.at(clusters.order).ray_origins(RAY_OFFSET * scene.scale))
        self._step = max(1, lanes // len(hemisphere))

    def trace(self, cluster, rotations):
        """Hemispheres of a cluster.

        Parameters
        ----------
        cluster : slice
        rotations : (m, 3, 3)
            From the hemisphere's frame to the world, one for each point.
        """
        n, count = cluster.stop - cluster.start, len(self._hemisphere)
        distance, sample = np.empty((n, count), np.float32), np.empty((n, count), np.uint32)
        albedo = np.empty((n, count, self._channels), np.float32)
        for first in range(0, n, self._step):
            part = slice(first, min(first + self._step, n))
            seen = self._trace(cluster.start + first, rotations[part])
            distance[part], sample[part], albedo[part] = seen
        return Hemispheres(distance, sample, albedo)

    def _trace(self, first, rotations):
        import drjit as dr

        mi = mitsuba()
        size, count = len(rotations), len(self._hemisphere)
        lane = dr.arange(mi.UInt32, size * count)
        per_point = dr.opaque(mi.UInt32, count)
        local = lane // per_point
        v = dr.gather(mi.Vector4f, self._vectors, lane - local * per_point)
        rows = packets(np.ascontiguousarray(rotations, np.float32))
        x, y, z = (dr.gather(mi.Vector3f, rows, 3 * local + i) for i in range(3))
        direction = mi.Vector3f(*(a.x * v.x + a.y * v.y + a.z * v.z for a in (x, y, z)))
        origin = dr.gather(mi.Point3f, self._origins, local + dr.opaque(mi.UInt32, first))
        ray = mi.Ray3f(origin, direction)
        pi = self._scene.occluders.ray_intersect_preliminary(ray)
        si = self._scene.interaction(pi, ray, True)
        _, si.wi, reflects = facing(si, ray, self._scene.surfaces)
        reflects &= si.is_valid()
        upward = mi.Vector3f(x.z, y.z, z.z)
        point, found = self._locator.nearest(pi, si, ray, reflects, (origin, upward))
        reflectance = reflectance_at(si, self._scene.surfaces, reflects)
        sample = dr.select(found, dr.gather(mi.UInt32, self._rank, point, found), NOTHING)
        channels = list(reflectance) if self._channels == 3 else [dr.mean(reflectance)]
        dr.eval(si.t, sample, channels)
        albedo = np.stack([np.array(c) for c in channels], axis=-1)
        return (
            a.reshape(size, count, *a.shape[1:]) for a in (np.array(si.t), np.array(sample), albedo)
        )


def cluster_frames(normals):
    """Rotations (m, 3, 3) from the hemisphere's frame to those around the normals of a cluster, as
    parallel as they can be.
    """
    mean = normals.mean(axis=0, dtype=np.float64)
    length = np.linalg.norm(mean)
    return frames(normals, frame_of(mean / length if length > 1e-6 else normals[0]))


def gathered(seen, weights, labels, clusters, features):
    """What points receive from each cluster, for features of samples: Σ_j w_j ρ_j f(y_j) over the
    directions that see the cluster.

    Parameters
    ----------
    seen : Hemispheres
        Of m points.
    weights : (N,) float32
        Shares of the directions.
    labels : (n,) int
        Cluster of each sample.
    clusters : int
    features : (n, d) float32

    Returns
    -------
    (m, clusters, d, channels) float32
    """
    m, _, channels = seen.albedo.shape
    result = np.empty((m, clusters, features.shape[1], channels), np.float32)

    def gather(first):
        block = slice(first, first + _CHUNK_ROWS)
        sample = seen.sample[block]
        size = len(sample)
        found = sample != NOTHING
        column = sample[found].astype(np.int32)
        row = (np.repeat(np.arange(size), found.sum(axis=1)) * clusters + labels[column]).astype(
            np.int32
        )
        order = np.argsort(row, kind="stable")
        ends = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=size * clusters))]).astype(
            np.int32
        )
        share = (seen.albedo[block] * weights[:, None])[found]
        for channel in range(channels):
            matrix = scipy.sparse.csr_array(
                (share[order, channel], column[order], ends), (size * clusters, len(features))
            )
            result[block, :, :, channel] = (matrix @ features).reshape(size, clusters, -1)

    for _ in map_chunks(gather, range(0, m, _CHUNK_ROWS)):
        pass
    return result
