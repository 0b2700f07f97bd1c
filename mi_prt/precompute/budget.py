"""What a precomputation of distant transport takes of memory, found out before it starts."""

import numpy as np

from ..basis.basis import BASES
from ..basis.total import PROBES
from ..errors import SettingsError
from ..system.memory import resident_bytes
from ..system.parallel import BLOCK_ROWS
from ..system.runtime import thread_count
from ..transport.bits import LANES
from ..transport.interreflection import COLUMNS
from .reflections import GREY, MOST_RAYS

LANE_BYTES = 40  # of a wavefront, for each of its rays
LEAST_LANES = 1 << 16
# for each point, what the ray tracer and the fit hold of it beside the points themselves
POINT_BYTES = 240
# the same of rays that are followed to surfaces, with what they bring back
INDIRECT_LANE_BYTES = 400
# while blocked directions are drawn, for each of those that there are and of those drawn
CHOICE_BYTES, CHOSEN_BYTES = 30, 60
SUMMED_TERMS, SOLVED_TERMS = 3, 9  # vectors that a series, and a Krylov method, work on at a time


def held_coefficient_bytes(settings, points, directions, components, channels):
    """Memory that the coefficients of all points take while they are put together.

    Parameters
    ----------
    settings : Settings
    points, directions, components : int
    channels : 1 or 3
        Of total transport; see `expected_channels`.
    """
    basis = BASES[settings.basis]
    size = basis.coefficient_bytes(points, directions, components, settings.rays_per_direction)
    held = basis.copies * size
    if settings.distant_bounces != 0:
        size = size * (components + PROBES) // max(components, 1)
        # Direct transport; two estimates of indirect transport, and their difference or the rows
        # they come from; what is summed of some columns.
        terms = SUMMED_TERMS if settings.distant_bounces != "auto" else SOLVED_TERMS
        columns = 4 * points * channels * terms * min(COLUMNS, components + 1)
        held = size + (3 if settings.indirect == "solve" else 4) * size * channels + columns
    return int(held)


def expected_channels(points, settings):
    """Colour channels of total transport, as the points' own albedo tells."""
    coloured = np.ptp(points.albedo, axis=1).max(initial=0) > GREY
    return 3 if settings.distant_bounces != 0 and coloured else 1


class Budget:
    """What fits into the memory that a run may take.

    Parameters
    ----------
    limit : int
        Bytes that the process may have resident.
    scene : Scene
        Its shapes for the ray tracer are built here, so that they count: they are a copy of all
        triangles.
    points : Points
    directions : DirectionLattice
    settings : Settings
    target : Target

    Attributes
    ----------
    lanes : int
        Rays of a wavefront.
    channels : 1 or 3
        Colour channels that total transport is expected to have.
    basis : int
        Bytes that fitting a basis may take beside the coefficients.

    Raises
    ------
    SettingsError
        If the least that the run needs does not fit.
    """

    def __init__(self, limit, scene, points, directions, settings, target):
        _ = scene.occluders, scene.interaction
        held = resident_bytes()
        n, s, rays = len(points), len(directions), settings.rays_per_direction
        components = target.components or 0
        self.channels = expected_channels(points, settings)
        blocks = s * (6 * rays + 12)
        if settings.distant_bounces != 0 and settings.indirect == "solve":
            drawn = MOST_RAYS if settings.paths_per_point == "auto" else settings.paths_per_point
            blocks = max(blocks, CHOICE_BYTES * s // 2 * rays + CHOSEN_BYTES * drawn)
        blocks *= BLOCK_ROWS * thread_count()
        fixed = (
            POINT_BYTES * n
            + blocks
            + held_coefficient_bytes(settings, n, s, components, self.channels)
        )
        fit = BASES[settings.basis].fit_bytes(n, s, components)
        needed = fixed + fit + LANE_BYTES * LEAST_LANES
        if limit - held < needed:
            raise SettingsError(
                f"memory {limit / 1e6:,.0f} MB is too little: the scene holds {held / 1e6:,.0f} MB"
                f" and the run needs {needed / 1e6:,.0f} MB more; raise max_memory (--max-memory)"
                " or use fewer points, directions or coefficients"
            )
        self.lanes = int(min(LANES, (limit - held - fixed) // LANE_BYTES))
        self.basis = limit - held - fixed
