"""The convex hull of a scene: outside of it, what is visible from a point to infinity is visible to
a light.
"""

import numpy as np
import scipy.spatial

# depth that is still outside, as a share of the points' extent: float32 positions and flat scenes
TOLERANCE = 1e-5


class ConvexHull:
    """The convex hull of some positions.

    Parameters
    ----------
    positions : (n, 3)
        Those that lie in a plane or on a line have a hull without an inside.
    """

    def __init__(self, positions):
        low, high = (
            np.min(positions, axis=0).astype(np.float64),
            np.max(positions, axis=0).astype(np.float64),
        )
        self._centre, self._extent = (
            (low + high) / 2,
            max((high - low).max(), np.finfo(np.float64).tiny),
        )
        try:
            self._planes = scipy.spatial.ConvexHull(
                (positions - self._centre) / self._extent
            ).equations
        except scipy.spatial.QhullError:
            self._planes = np.array([[0.0, 0.0, 0.0, 1.0]])  # everything is outside

    def contains(self, position):
        """Whether a position (3,) is inside.

        One on the hull is outside: what hides it, hides what is behind it.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            height = (
                self._planes[:, :3] @ ((position - self._centre) / self._extent)
                + self._planes[:, 3]
            )
        return bool(height.max() < -TOLERANCE)
