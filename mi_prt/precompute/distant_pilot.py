"""How many components a share of the variance will take, told from some of the points."""

import warnings

import numpy as np

from ..basis.basis import BASES
from ..basis.rows import Rows
from ..basis.target import Target
from ..errors import SettingsError
from ..transport.bits import find_buried, sample_direct
from .budget import held_coefficient_bytes

PILOT_POINTS = 2048  # their rows need fewer components than those of all points
SPREAD = 4  # how many times as many all points may need: from 1.1 to 3 times were measured
MANY = 512  # components: where so many fit, nothing is tried out


def check_share(job, directions, target, budget):
    """Refuse, before the rays of all points, a share of the variance whose components cannot be
    held.

    Parameters
    ----------
    job : Job
    directions : DirectionLattice
    target : Target
        A share of the variance.
    budget : Budget

    Raises
    ------
    SettingsError
        If as many components as some of the points need do not fit. The fit of all points, which
        may need more, checks again.

    Warns
    -----
    UserWarning
        If they fit, but `SPREAD` times as many do not.
    """
    settings, n = job.settings, len(job.points)

    def held(count):
        return held_coefficient_bytes(settings, n, len(directions), count, budget.channels)

    if held(min(MANY, n, len(directions))) <= budget.basis:
        return
    count = expected_components(job, directions, target)
    if held(count) > budget.basis:
        raise SettingsError(
            f"variance {target.variance:g} takes about {count:,} coefficients or more, and keeping"
            f" them of {n:,} points needs {held(count) / 1e6:,.0f} MB, of max_memory (--max-memory)"
            f" {budget.basis / 1e6:,.0f} MB are left: raise it, ask for a smaller share"
            " (--variance), or use fewer points"
        )
    if held(min(SPREAD * count, n, len(directions))) > budget.basis:
        warnings.warn(
            f"variance {target.variance:g} takes {count:,} coefficients or more, up to"
            f" {SPREAD * count:,}, and of {n:,} points max_memory (--max-memory) holds"
            f" {_most(held, budget.basis):,}: the run may end after its rays, raise it to be sure"
        )


def _most(held, room):
    """The largest number of components that there is room for."""
    return max((count for count in range(1, MANY) if held(count) <= room), default=0)


def expected_components(job, directions, target):
    """Components that some of the points need for the share of the variance of a Target."""
    settings, points = job.settings, job.points
    index = np.random.default_rng(settings.seed).permutation(len(points))[:PILOT_POINTS]
    few = points.at(np.sort(index))
    transport = sample_direct(job.scene, few, directions, settings.rays_per_direction)
    buried = find_buried(job.scene, few, transport.dark())
    fitted = np.flatnonzero(~buried if not buried.all() else np.ones_like(buried))
    try:
        fit = BASES[settings.basis].fit(
            Rows(transport.rows, fitted, directions), Target(variance=target.variance)
        )
    except SettingsError:  # no number captures the share in these: all points will tell
        return 0
    return len(fit.basis)
