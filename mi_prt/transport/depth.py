"""Depth buffers of sample points, compressed cluster by cluster, and what they tell of visibility
(Meshless PRT, section 4.2).

What is compressed is the logarithm of depth. Along a ray a plane lies at h/(n·ω), so that a wall
has two terms in the logarithm, one of the point and one of the direction; an error of it is a
relative error of the depth, the same for near and far occluders, and its range is bounded by
clamping. Directions count by the cosine that their light arrives with. Encodings, weights and the
test were chosen by misclassified visibility: docs/meshless.md.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..basis.clustered import leading_components
from ..directions.hemisphere import Hemisphere

NEAREST = 0.002  # share of the samples' extent at which depth is clamped
GRAZING = 0.1  # added to the cosine in the weights of directions, so that the horizon counts too


@dataclass(frozen=True, eq=False)
class DepthBuffers:
    """Log-depth of n points in N directions of their hemispheres, log d = mean + coefficients ·
    vectors.

    Parameters
    ----------
    means : (c, N) float32
        Of each cluster.
    vectors : (c, N, d) float32
    coefficients : (n, d) float32
    extent : float
        Metres from which on depth is not told apart.
    """

    means: np.ndarray
    vectors: np.ndarray
    coefficients: np.ndarray
    extent: float

    @cached_property
    def hemisphere(self):
        """The Hemisphere that directions are from."""
        return Hemisphere(self.means.shape[1])

    def depth(self, cluster, number):
        """Depth (m, N) in metres of the points of a cluster, as the basis has it."""
        return np.exp(self.means[number] + self.coefficients[cluster] @ self.vectors[number].T)


def log_depth(distance, extent):
    """Logarithm of distances in metres, clamped."""
    return np.log(np.clip(distance, np.float32(NEAREST * extent), np.float32(extent)))


def compress(distance, extent, hemisphere, count, seed=0):
    """Principal components of a cluster's log-depth.

    Parameters
    ----------
    distance : (m, N) float32
        Metres; infinite where nothing is hit.
    extent : float
        Metres.
    hemisphere : Hemisphere
    count : int
        d. Components that the depth does not have are zero.
    seed : int

    Returns
    -------
    mean : (N,) float32
    vectors : (N, d) float32
    coefficients : (m, d) float32
    """
    m, directions = distance.shape
    values = log_depth(distance, extent)
    mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
    weights = np.sqrt(hemisphere.vectors[:, 2] + np.float32(GRAZING))
    left, sizes, right = leading_components((values - mean) * weights, count, seed)
    k = len(sizes)
    vectors, coefficients = (
        np.zeros((directions, count), np.float32),
        np.zeros((m, count), np.float32),
    )
    coefficients[:, :k] = left * sizes.astype(np.float32)
    vectors[:, :k] = right.T / weights[:, None]
    return mean, vectors, coefficients
