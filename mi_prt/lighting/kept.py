"""Means of light over the cells of lattices, computed once for each light and shared by all assets.

They are kept beside the light and go when it goes. Lights do not change: a turned or dimmed one is
another object, which has means of its own.
"""

from weakref import WeakKeyDictionary

LATTICES = 4  # of each light whose means are kept; the oldest gives way

_kept = WeakKeyDictionary()


def kept_means(light, directions, samples_per_side, compute):
    """Mean radiance of each cell, from `compute` where it is not known yet.

    Parameters
    ----------
    light : LightPart
        Told apart by identity.
    directions : direction lattice
    samples_per_side : int
    compute : callable(directions, samples_per_side) returning (s, 3)

    Returns
    -------
    (s, 3)
        Read-only.
    """
    found = _kept.setdefault(light, {})
    key = directions, samples_per_side
    means = found.get(key)
    if means is None:
        means = compute(directions, samples_per_side)
        means.flags.writeable = False
        for oldest in list(found)[: max(len(found) + 1 - LATTICES, 0)]:
            found.pop(oldest, None)
        found[key] = means
    return means
