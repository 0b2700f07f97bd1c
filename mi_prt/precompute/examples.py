"""Example lights: what direct light on clusters is like, and which of it matters (Meshless PRT,
section 4.3.1).
"""

import numpy as np
import scipy.sparse

from ..directions.hemisphere import Hemisphere
from ..system.parallel import map_chunks
from ..transport.examples import trace_examples
from ..transport.hemispheres import NOTHING, HemisphereTracer, cluster_frames
from ..transport.transfer import fit_senders

FUNCTIONALS = 256  # random sums over receivers that show how much light at a point matters
IMPORTANCE_DIRECTIONS = 256  # rays of each receiver for that


class Examples:
    """Direct light of example lights at clustered points.

    Parameters
    ----------
    job : Job
    places : (e, 3) float32
    lanes : int
    """

    def __init__(self, job, places, lanes):
        self._job, self._places, self._lanes = job, places, lanes

    @staticmethod
    def bytes(points, lights):
        """Memory that examples and their importance take."""
        return 4 * points * (2 * lights + 3 * FUNCTIONALS + IMPORTANCE_DIRECTIONS * 3)

    def fit(self, clusters, importance):
        """The SenderBasis, in the order of the clusters."""
        job, settings = self._job, self._job.settings
        irradiance = job.workspace.keep("examples", lambda: self._traced(clusters))
        points = job.points.at(clusters.order)
        reflected = np.where(points.buried, 0, points.areas) * points.albedo.mean(axis=1)
        flux = reflected @ irradiance
        # Each example counts alike, however much of its light falls on what reflects.
        scale = np.where(flux > 0, 1 / np.maximum(flux, np.float32(1e-30)), 0)
        irradiance *= scale.astype(np.float32)
        importance = job.workspace.keep("importance", importance)
        return fit_senders(
            irradiance, importance, clusters.slices, settings.transfer_coefficients, settings.seed
        )

    def _traced(self, clusters):
        job, n = self._job, len(self._job.points)
        irradiance = np.empty((n, len(self._places)), np.float32)
        points = job.points.at(clusters.order)
        for block, values in trace_examples(job.scene, points, self._places, self._lanes):
            irradiance[block] = values
            job.progress("example lights", block.stop, n, "")
        return irradiance


def importance(job, clusters, lanes):
    """A function that computes random functionals (k, n) of irradiance in the order of clusters:
    sums, with random signs, over what receivers get of it after one reflection.
    """

    def compute():
        hemisphere = Hemisphere(IMPORTANCE_DIRECTIONS)
        tracer = HemisphereTracer(job.scene, job.points, clusters, hemisphere, 1, lanes)
        points = job.points.at(clusters.order)
        n = len(points)
        random = np.random.default_rng(job.settings.seed)
        receivers = random.standard_normal((n, FUNCTIONALS), dtype=np.float32)
        receivers *= np.sqrt(np.where(points.buried, 0, points.areas))[:, None]
        result = np.zeros((n, FUNCTIONALS), np.float32)
        for cluster in clusters.slices:
            seen = tracer.trace(cluster, cluster_frames(points.normals[cluster]))
            _add(result, seen, hemisphere.weights, receivers[cluster], n)
            job.progress("importance", cluster.stop, n, "")
        return np.ascontiguousarray(result.T)

    return compute


def _add(result, seen, weights, receivers, n):
    """Add what a cluster of receivers gets from each point."""
    found = seen.sample != NOTHING
    ends = np.concatenate([[0], np.cumsum(found.sum(axis=1))])
    shares = (seen.albedo[..., 0] * weights)[found]
    entries = (shares, seen.sample[found].astype(np.int32), ends)
    hops = scipy.sparse.csr_array(entries, (len(found), n)).T

    def add(columns):
        result[:, columns] += hops @ np.ascontiguousarray(receivers[:, columns])

    half = FUNCTIONALS // 2
    list(map_chunks(add, [slice(0, half), slice(half, None)]))
