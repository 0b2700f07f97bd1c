"""What a precomputation takes of memory, told before it starts."""

from .basis.bases import coefficient_bytes, fit_bytes
from .errors import SettingsError
from .memory import resident_bytes
from .parallel import BLOCK_ROWS
from .runtime import thread_count
from .transport.direct import LANES

LANE_BYTES = 40  # of a wavefront, for each of its rays
LEAST_LANES = 1 << 16
POINT_BYTES = 240  # for each point, what the ray tracer and the fit hold of it beside the points themselves
COPIES = {"haar": 3.2}  # of the stored coefficients in memory, where blocks are put together: indices are wider there; else 2


def held_coefficient_bytes(basis, points, directions, components, rays_per_direction=1):
    """Memory that the coefficients of all points take while they are put together."""
    return int(COPIES.get(basis, 2) * coefficient_bytes(basis, points, directions, components, rays_per_direction))


class Room:
    """What fits into the memory that a run may take.

    Parameters
    ----------
    limit : int
        Bytes that the process may have resident.
    scene : Scene
        Its shapes for the ray tracer are built here, so that they count: they are a copy of all triangles.
    points : Points
    directions : DirectionLattice
    settings : Settings
    target : Target

    Attributes
    ----------
    lanes : int
        Rays of a wavefront.
    basis : int
        Bytes that fitting a basis may take beside the coefficients.

    Raises
    ------
    SettingsError
        If the least that the run needs does not fit.
    """

    def __init__(self, limit, scene, points, directions, settings, target):
        _ = scene.occluders
        held = resident_bytes()
        n, s, rays = len(points), len(directions), settings.rays_per_direction
        components = target.components or 0
        blocks = BLOCK_ROWS * s * (6 * rays + 12) * thread_count()
        fixed = POINT_BYTES * n + blocks + held_coefficient_bytes(settings.basis, n, s, components, rays)
        needed = fixed + fit_bytes(settings.basis, n, s, components) + LANE_BYTES * LEAST_LANES
        if limit - held < needed:
            raise SettingsError(
                f"memory {limit / 1e6:,.0f} MB is too little: the scene holds {held / 1e6:,.0f} MB and the run needs "
                f"{needed / 1e6:,.0f} MB more; raise max_memory (--max-memory) or use fewer points, directions or coefficients"
            )
        self.lanes = int(min(LANES, (limit - held - fixed) // LANE_BYTES))
        self.basis = limit - held - fixed
