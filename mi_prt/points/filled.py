"""Values at buried points, for programs that show vertices without knowing which are buried."""

import numpy as np
from scipy.spatial import cKDTree


def filled(points, values):
    """Values (n, c) with those of buried points taken from the nearest point that is not, on the
    same side of the same surface; as they are where a surface has none.

    Parameters
    ----------
    points : Points
    values : (n, c)

    Returns
    -------
    (n, c)
        Of the same type; `values` themselves where no point is buried.
    """
    buried = points.buried
    if not buried.any():
        return values
    found = np.array(values)
    for surface in np.unique(points.surface[buried]):
        own = points.surface == surface
        free, hidden = np.flatnonzero(own & ~buried), np.flatnonzero(own & buried)
        if not len(free):
            continue
        # points with another normal, such as those of the back, are as far as the surface is wide
        extent = np.ptp(points.positions[own], axis=0).max()
        places = np.hstack([points.positions, extent * points.normals])
        found[hidden] = found[free[cKDTree(places[free]).query(places[hidden])[1]]]
    return found
