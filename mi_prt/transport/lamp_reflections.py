"""Light of a scene's own lamps after reflections, at its points.

Irradiance after one reflection and more is E = G + A·E. The gather G sums what rays from a point
see reflected of the lamps' direct light, by shadow rays from the very places that the rays meet, so
that shadows and spots are as sharp as they are. What those places receive after reflections varies
slowly and is taken from the points around them: A is the operator of one reflection (`Hops`) by the
same rays.
"""

from dataclasses import dataclass

import numpy as np

from ..errors import SettingsError
from .bits import LANES
from .hops import HOP, Hops
from .interreflection import (
    BOUNCE_TOLERANCE,
    COLUMNS,
    FAR_FROM_WHITE,
    MOST_SUMMED_BOUNCES,
    ROUNDING,
    _converged,
    check_ending,
    check_growth,
)
from .lamp_rays import AIMED, LampRays
from .lamp_table import Lamps
from .lamps import relative_noise

RAYS = 256  # of each point
HOP_RAYS = 64  # of those that are kept, for second reflections and later ones


@dataclass(frozen=True, eq=False)
class ReflectedLight:
    """Irradiance of k lamps at n points after reflections.

    Parameters
    ----------
    irradiance : (n, k, 3) float32
        W/m², after 1…`bounces` reflections.
    standard_error : (n, k) float32
        Norm over the channels: half the difference of two halves of the rays.
    bounces : tuple of int or None
        Reflections that are counted, for each block of 32 lamps; None for all of them.
    """

    irradiance: np.ndarray
    standard_error: np.ndarray
    bounces: tuple

    def noise(self, weights):
        """Relative RMS noise (k,) of each lamp's irradiance, see `lamps.relative_noise`."""
        return relative_noise(self.irradiance, self.standard_error, weights)


def reflected_light(
    scene,
    points,
    buried,
    emitters,
    direct,
    locator,
    rays=RAYS,
    bounces=None,
    aimed=AIMED,
    seed=0,
    lanes=LANES,
    hop_rows=None,
    progress=lambda done, total: None,
):
    """Irradiance at points after 1…∞ diffuse reflections of each of some lamps.

    Parameters
    ----------
    scene : Scene
    points : Points
    buried : (n,) bool
        Points that have no share in means over the surface.
    emitters : sequence of mi.Emitter
        k local emitters of the scene.
    direct : (n, k, 3) float32
        Direct irradiance of each at the points, see `lamps.direct_light`.
    locator : Locator
        Has `picked(pi, si, ray, active, random) -> (index, found)`: one of the points around a hit,
        none of them buried.
    rays : int
        K, of each point; a multiple of 4.
    bounces : int or None
        Most reflections; None for any number, until `BOUNCE_TOLERANCE` of the light is left.
    aimed : int
        Most shadow rays from each place that a ray meets. More lamps than that are chosen among at
        random there, in proportion to what is expected of each.
    seed : int
    lanes : int
        Most lanes of one wavefront. Results do not depend on it.
    hop_rows : callable(count, row_bytes) -> RowFile, optional
        Where rays are kept, 16 bytes each, 64 of each point; in memory by default. One that already
        holds rows is not taken over: the gather is not among them.
    progress : callable(done, total)
        Points.

    Returns
    -------
    ReflectedLight

    Raises
    ------
    LightError
        See `lamp_table.Lamps`.
    SettingsError
        If `rays` is not a positive multiple of 4.
    SceneError
        If all reflections are wanted and they do not end.
    """
    if rays < 4 or rays % 4:
        raise SettingsError(f"rays {rays} of a point must be a positive multiple of 4")
    n, k = len(points), len(emitters)
    if bounces == 0 or not k:
        return ReflectedLight(np.zeros((n, k, 3), np.float32), np.zeros((n, k), np.float32), (0,))
    sampler = LampRays(
        scene, points, Lamps(scene, emitters), direct, locator, rays, aimed, seed, lanes
    )
    kept = min(HOP_RAYS, rays)
    store = (_InMemory if hop_rows is None else hop_rows)(n, kept * HOP.itemsize)
    gather = np.empty((2, 3, n, k), np.float32)
    for block, hops, gathered in sampler.blocks(kept):
        store.append(hops)
        gather[:, :, block] = gathered
        progress(block.stop, n)
    hops = Hops(store.rows if hop_rows is None else store, np.ones(n, np.float32))
    weights = np.where(buried & ~buried.all(), 0, points.areas).astype(np.float64)
    counted = []
    for operator, half in zip(hops.halves(), gather):
        for first in range(0, k, COLUMNS):
            columns = slice(first, first + COLUMNS)
            half[..., columns], number = _after_reflections(
                operator, half[..., columns], weights, bounces
            )
            counted.append(number)
    first, second = gather
    error = np.linalg.norm(first - second, axis=0) / 2
    first += second
    first *= np.float32(0.5)
    return ReflectedLight(np.ascontiguousarray(np.moveaxis(first, 0, 2)), error, tuple(counted))


def _after_reflections(hops, gather, weights, bounces):
    """Σ Aⁱ·G (3, n, m) for i < `bounces`, and how many reflections that are."""
    gather = np.ascontiguousarray(gather)
    albedo = hops.largest_albedo()
    if bounces is None:
        check_ending(albedo)
        if albedo > FAR_FROM_WHITE:
            return gather + _converged(hops, gather), None
    total, term, number = gather.copy(), gather, 1
    started = np.einsum("cnm,n->m", gather, weights, dtype=np.float64)
    lit = started > 0
    most = MOST_SUMMED_BOUNCES if bounces is None else bounces
    while number < most:
        term = hops.apply(term)
        total += term
        number += 1
        # A reflection leaves at most the largest albedo of the flux.
        flux, whole = (np.einsum("cnm,n->m", x, weights, dtype=np.float64) for x in (term, total))
        check_growth(whole[lit] / started[lit], number, albedo)
        left = flux * albedo / (1 - albedo) if albedo < 1 else np.inf * flux
        if (left <= (BOUNCE_TOLERANCE if bounces is None else ROUNDING) * whole).all():
            return total, number
    if bounces is None:
        return gather + _converged(hops, gather), None
    return total, number


class _InMemory:
    """Rows of bytes in memory, appended to as those of a `RowFile`."""

    def __init__(self, count, row_bytes):
        self.rows, self._filled = np.empty((count, row_bytes), np.uint8), 0

    def append(self, block):
        self.rows[self._filled : self._filled + len(block)] = block
        self._filled += len(block)
