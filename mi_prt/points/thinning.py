"""Blue noise by thinning: of many candidates those stay that keep a distance from each other
(Meshless PRT, section 4.1).

Distance is measured in position and normal together, d² = |Δp|² + (r·Δn)² for a radius r. On a
curved surface of curvature κ normals turn by κ|Δp|, so that points come closer by √(1 + κ²r²): the
radius shrinks with curvature, as the paper asks. And points whose normals are more than 60° apart
never are nearer than r: the two sides of a thin wall do not thin each other.
"""

import numpy as np
from scipy.spatial import cKDTree

from ..errors import SettingsError

_SHRINK = 0.97  # of the radius, until there are enough
_GROW = 1.06  # of a radius that is too small
_MARGIN = 1.06  # of the first radius over the one that is expected to be right
_PILOT = 8192  # candidates that the radius is first told from
_BATCH = 512  # candidates that are tried first
_MANY = 8192  # candidates that are looked at in several threads


def embedded(positions, normals, radius):
    """Points (n, 6) whose Euclidean distances are those of the module's metric; of free positions
    (normals None) just these.
    """
    return positions if normals is None else np.hstack([positions, np.float32(radius) * normals])


def thin(positions, normals, count, seed=0, dimension=2):
    """A blue-noise subset of some candidates.

    Parameters
    ----------
    positions : (m, 3) float32
    normals : (m, 3) float32 or None
        None for points in free space.
    count : int
        How many stay.
    seed : int
    dimension : 2 or 3
        Of what the candidates fill: a surface or a volume.

    Returns
    -------
    chosen : (count,) int64
        Indices of candidates, ascending.
    radius : float
        Metres that neighbours keep from each other, but for those that filled the count up last.

    Raises
    ------
    SettingsError
        If there are fewer candidates than wanted.
    """
    m = len(positions)
    if m < count:
        raise SettingsError(f"{count:,} points are more than the {m:,} candidates that there are")
    order = np.random.default_rng(seed).permutation(m)  # candidates are tried one after the other
    radius = _expected_radius(positions, normals, count, order[:_PILOT], dimension)
    nothing = chosen = np.empty(0, np.int64)
    # Too small at first would leave holes: points end before every candidate is near one.
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    while (
        m > count
        and 0 < radius < extent
        and len(_add(embedded(positions, normals, radius), order, nothing, radius, count)) == count
    ):
        radius *= _GROW
    while True:
        chosen = _add(embedded(positions, normals, radius), order, chosen, radius, count)
        if len(chosen) == count:
            return np.sort(chosen), float(radius)
        radius = radius * _SHRINK if radius > 1e-30 else 0.0


def _expected_radius(positions, normals, count, pilot, dimension):
    """A radius a little above the one at which `count` points stay, told by thinning a few of the
    candidates to fewer.
    """
    positions, normals = positions[pilot], None if normals is None else normals[pilot]
    radius = float(np.linalg.norm(np.ptp(positions, axis=0))) / 4
    wanted = min(max(len(pilot) // 8, 2), count)
    while radius > 1e-30:
        found = len(
            _add(
                embedded(positions, normals, radius),
                np.arange(len(pilot)),
                np.empty(0, np.int64),
                radius,
            )
        )
        if found >= wanted:
            return _MARGIN * radius * (found / count) ** (1 / dimension)
        radius *= 0.8
    return 0.0


def _add(points, order, chosen, radius, most=None):
    """Choose more points in their order, until none is left that keeps its distance or there are
    `most`.

    Points come in batches that double: crowds of them are struck out by the first few, before any
    pair of them is looked at.
    """
    taken = np.zeros(len(points), bool)
    taken[chosen] = True
    waiting = order[~taken[order]]
    first, size = 0, _BATCH
    while first < len(waiting):
        batch = waiting[first : first + size]
        first, size = first + size, 2 * size
        if len(chosen):
            distance, _ = cKDTree(points[chosen]).query(
                points[batch],
                distance_upper_bound=max(radius, 1e-300),
                # SciPy starts threads in every call, which takes longer than a small one
                workers=-1 if len(batch) >= _MANY else 1,
            )
            batch = batch[distance >= radius]
        new = batch[_keep_distance(points[batch], radius)]
        chosen = np.concatenate([chosen, new])
        if most is not None and len(chosen) >= most:
            return chosen[:most]
    return chosen


def _keep_distance(points, radius):
    """Which points (n,) bool stay when each strikes out the later ones that are nearer to it than a
    radius.

    All that come before each of their undecided neighbours are chosen at once: the result is that
    of one after the other.
    """
    kept = np.zeros(len(points), bool)
    first, second = (
        cKDTree(points).query_pairs(np.nextafter(radius, 0), output_type="ndarray").T
        if radius
        else np.empty((2, 0), int)
    )
    undecided = ~kept
    while undecided.any():
        now = undecided.copy()
        now[np.maximum(first, second)] = False
        kept |= now
        undecided &= ~now
        undecided[second[now[first]]] = False
        undecided[first[now[second]]] = False
        alive = undecided[first] & undecided[second]
        first, second = first[alive], second[alive]
    return kept
