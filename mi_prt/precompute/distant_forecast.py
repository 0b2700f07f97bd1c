"""What distant transport will cost, predicted from a probe of some points."""

import time

import numpy as np

from ..basis.basis import BASES
from ..system.parallel import BLOCK_ROWS, map_chunks
from ..transport.bits import LANES, find_buried, sample_direct
from ..transport.distant import storage_bytes
from ..transport.hops import blocked_share
from ..transport.interreflection import BOUNCE_TOLERANCE
from ..transport.paths import PathSampler, energies
from .budget import LANE_BYTES, POINT_BYTES, expected_channels, held_coefficient_bytes

PROBE_POINTS = 256
PROBE_BLOCKS = 32
PROBE_PATHS = 256
EXPECTED_PATHS = 256  # what `auto` is predicted with
# time of a multiplication in the sparse products of reflections, in those of a dense product
SPARSE_WORK = 50
# what `auto` is predicted with: how many it takes is known once it is fitted
AUTO_COEFFICIENTS = 64


def forecast(job, directions, target):
    """Predict the cost of distant transport; 256 points are traced and compressed.

    Parameters
    ----------
    job : Job
    directions : DirectionLattice
    target : Target

    Returns
    -------
    dict
        seconds, bytes, memory (bytes beside what is held), relighting_bytes, projection_bytes,
        requires{rays, bounce_energy}, chosen and reasons of settings.
    """
    settings, points = job.settings, job.points
    basis = BASES[settings.basis]
    components = AUTO_COEFFICIENTS if target.components is None else target.components
    probe = _probe(job, directions, components)
    n, s = len(points), len(directions)
    expanded, multiplied = basis.work
    fitting = n * (expanded * probe["expanding"] + multiplied * probe["multiplying"])
    reflections = _probe_reflections(job, directions)
    channels = expected_channels(points, settings) if reflections["bounces"] else 1
    product = probe["multiplying"] / s / max(components, 1)
    indirect = _indirect_seconds(reflections, n, components, channels, product)
    rays = settings.rays_per_direction
    relighting, projection = storage_bytes(basis, n, s, components, rays, channels)
    working = LANES * LANE_BYTES // 2 + POINT_BYTES * n + basis.fit_bytes(n, s, components)
    working += held_coefficient_bytes(settings, n, s, components, channels)
    return {
        "seconds": round(probe["rays"] * n / probe["rate"] + fitting + indirect, 2),
        "bytes": int(relighting + projection + s * 24),
        "memory": int(working),
        "relighting_bytes": int(relighting),
        "projection_bytes": int(projection),
        "requires": {"rays": int(probe["rays"] * n), "bounce_energy": reflections["energy"]},
        "chosen": _chosen(settings, components),
        "reasons": _reasons(settings, directions, reflections),
    }


def _probe(job, directions, components):
    """Rays and seconds per point, from a sample of the points."""
    settings, points = job.settings, job.points
    index = np.random.default_rng(settings.seed).permutation(len(points))[:PROBE_POINTS]
    few, rays = points.at(index), settings.rays_per_direction
    sample_direct(job.scene, few, directions, rays)  # compiles the kernel
    started = time.perf_counter()
    transport = sample_direct(job.scene, few, directions, rays)
    rate = max(transport.rays, 1) / (time.perf_counter() - started)
    vectors = np.ones((len(directions), components), np.float32)
    rows = transport.rows(slice(0, BLOCK_ROWS))
    jobs = {
        "expanding": lambda: transport.rows(slice(0, BLOCK_ROWS)),
        "multiplying": lambda: rows @ vectors,
    }
    seconds = {name: _seconds(run) / len(rows) for name, run in jobs.items()}
    return {"rays": transport.rays / len(few), "rate": rate} | seconds


def _seconds(run):
    """Mean time of a function on all threads."""
    list(map_chunks(lambda _: run(), range(8)))  # until memory is warm
    started = time.perf_counter()
    list(map_chunks(lambda _: run(), range(PROBE_BLOCKS)))
    return (time.perf_counter() - started) / PROBE_BLOCKS


def _probe_reflections(job, directions):
    """How light splits by reflections, by paths from a sample of the points, and how fast they are
    traced.

    Returns
    -------
    dict
        energy (see `BounceSplit`; direct light within about 3 %, reflections 20 %), bounces
        (expected), rate (paths per second), paths (from each point).
    """
    settings = job.settings
    few = job.points.at(_by_area(job.points.areas, settings.seed))
    transport = sample_direct(job.scene, few, directions)
    shown = ~find_buried(job.scene, few, transport.dark())
    weights = shown / max(shown.sum(), 1)
    direct = float(weights @ (1 - blocked_share(transport, directions.solid_angles)))
    wanted = None if settings.distant_bounces == "auto" else settings.distant_bounces
    if wanted == 0:
        return {"energy": [round(direct, 6)], "bounces": 0, "rate": 1.0, "paths": 0}
    auto = settings.paths_per_point == "auto"
    sampler = PathSampler(job.scene, few, directions, PROBE_PATHS, wanted, 1, None, settings.seed)
    sampler.escapes(np.arange(len(few)))  # compiles the kernel
    started = time.perf_counter()
    split = weights @ energies(sampler.escapes(np.arange(len(few))), PROBE_PATHS)
    rate = len(few) * PROBE_PATHS / (time.perf_counter() - started)
    left = np.append(split, 0)[::-1].cumsum()[::-1]
    enough = BOUNCE_TOLERANCE * (direct + left[0]) if wanted is None else 0
    bounces = int(np.argmax(left <= enough))
    return {
        "energy": [round(x, 6) for x in (direct, *split[:bounces].tolist())],
        "bounces": bounces,
        "rate": rate,
        "paths": EXPECTED_PATHS if auto else settings.paths_per_point,
    }


def _by_area(areas, seed):
    """Indices of the probed points, each drawn in proportion to its area: light is told in means
    over surface, and of points drawn evenly a few large ones would be nearly all of it.
    """
    ends = np.cumsum(areas, dtype=np.float64)
    count = min(PROBE_POINTS, len(areas))
    places = (np.arange(count) + np.random.default_rng(seed).random()) / count * ends[-1]
    return np.minimum(np.searchsorted(ends, places, side="right"), len(areas) - 1)


def _indirect_seconds(reflections, points, components, channels, product):
    """Seconds that reflections are expected to take; `product` is the time of one multiplication in
    a dense product.
    """
    traced = points * reflections["paths"] / reflections["rate"]
    work = SPARSE_WORK * product * reflections["rate"] * components * channels
    return traced * (1 + work * reflections["bounces"])


def _chosen(settings, components):
    """Settings that are chosen in the run."""
    return {"coefficients": "auto" if settings.variance is not None else components}


def _reasons(settings, directions, reflections):
    """Reasons of settings."""
    width = np.degrees(np.sqrt(4 * np.pi / len(directions)))
    reasons = {
        "directions": f"{len(directions):,} cells, about {width:.1f}° wide: sharper shadows need"
        " more",
        "basis": BASES[settings.basis].why,
        "coefficients": _coefficients_reason(settings),
        "rays_per_direction": "1 samples the middle of each cell; 4 antialias the edges of shadows",
        "bounces": _bounces_reason(settings, reflections),
        "seed": "start of what is random",
    }
    if settings.paths_per_point == "auto":
        reasons["paths_per_point"] = (
            "so many that noise is about 1 % of the transport; the prediction takes"
            f" {EXPECTED_PATHS}"
        )
    if settings.denoise:
        reasons["denoise"] = (
            "components of reflected light keep the share of their variance that is signal"
        )
    if settings.variance is not None:
        reasons["variance"] = "share of the transport's variance to capture"
    return reasons


def _bounces_reason(settings, reflections):
    if not BASES[settings.basis].holds_reflections:
        return f"the basis {settings.basis} holds direct light only"
    if settings.distant_bounces != "auto":
        return "as asked"
    if reflections["bounces"] == 0:
        return f"none: at {PROBE_POINTS} points that were probed no reflected light arrives"
    return f"until 0.1 % of the light is left, here about {reflections['bounces']}"


def _coefficients_reason(settings):
    if settings.variance is not None:
        return (
            f"as few as capture {settings.variance:g} of the variance; the prediction takes"
            f" {AUTO_COEFFICIENTS}"
        )
    if settings.coefficients is None:
        return "so many relight in a few milliseconds; more of them sharpen shadows"
    return "as asked"
