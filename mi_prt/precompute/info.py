"""What a scene requires and what precomputing it will cost, and what an asset holds."""

import time
from dataclasses import asdict

import numpy as np

from ..asset.asset_file import coefficient_arrays
from ..asset.meshless_asset import MeshlessAsset
from ..asset.provenance import left_out
from ..basis.bases import coefficient_bytes, fit_bytes
from ..directions import parse_directions
from ..points.points import POINT_BUDGET, sample_points
from ..scene.scene import open_scene
from ..system.memory import resident_bytes
from ..system.parallel import BLOCK_ROWS, map_chunks
from ..transport.direct import LANES, find_buried, sample_direct
from ..transport.hops import blocked_share
from ..transport.interreflection import BOUNCE_TOLERANCE
from ..transport.paths import PathSampler, energies
from .budget import LANE_BYTES, POINT_BYTES, expected_channels, held_coefficient_bytes
from .meshless_info import describe_meshless, describe_meshless_asset
from .reflections import GREY, surface_shares
from .settings import DIRECT_ONLY, MeshlessSettings, Settings

PROBE_POINTS = 256
PROBE_BLOCKS = 32
PROBE_PATHS = 256
EXPECTED_PATHS = 256  # what `auto` is predicted with
# time of a multiplication in the sparse products of reflections, in those of a dense product
SPARSE_WORK = 50
# what `auto` is predicted with: how many it takes is known once it is fitted
AUTO_COEFFICIENTS = 64
# Work of fitting and encoding: how often all rows are expanded (and transformed), and multiplied
# with as many vectors as components.
BASIS_WORK = {"pca": (3, 20), "sh": (1, 2), "haar": (3, 0), "haar-shared": (2, 1), "none": (0, 0)}


def describe(source, parameters=None, points="vertices", **settings):
    """What precomputing a scene requires, would use, leaves out and costs.

    The cost is predicted from a probe: 256 of the scene's points are traced and compressed.

    Parameters
    ----------
    source : path, dict, mi.Scene
    parameters : dict, optional
    points : 'vertices' or 'samples'
    **settings
        Fields of `Settings` or `MeshlessSettings`.

    Returns
    -------
    dict
        requires{…}, settings{… each with value and reason}, left_out[…], predicted{seconds,
        peak_memory_bytes, bytes}.
    """
    if points == "samples":
        return describe_meshless(open_scene(source, parameters), MeshlessSettings(**settings))
    settings = Settings(**settings)
    started = time.perf_counter()
    scene = open_scene(source, parameters)
    loading = time.perf_counter() - started
    started = time.perf_counter()
    points = sample_points(scene, settings.edge_length)
    sampling = time.perf_counter() - started
    held = resident_bytes()
    directions = parse_directions(settings.directions)
    target = settings.target(len(points))
    coefficients = AUTO_COEFFICIENTS if target.components is None else target.components
    probe = _probe(scene, points, directions, settings, coefficients)
    n, s, rays = len(points), len(directions), settings.rays_per_direction
    transport = probe["rays"] * n / probe["rate"]
    expanded, multiplied = BASIS_WORK[settings.basis]
    basis = n * (expanded * probe["expanding"] + multiplied * probe["multiplying"])
    reflections = _probe_reflections(scene, points, directions, settings)
    channels = expected_channels(points, settings) if reflections["bounces"] else 1
    indirect = _indirect_seconds(
        reflections, n, coefficients, channels, probe["multiplying"] / s / max(coefficients, 1)
    )
    relighting, projection = storage_bytes(settings.basis, n, s, coefficients, rays, channels)
    stored = relighting + projection + n * 77 + s * 24 + 4 * len(points.patches.nodes)
    working = (
        LANES * LANE_BYTES // 2 + POINT_BYTES * n + fit_bytes(settings.basis, n, s, coefficients)
    )
    working += held_coefficient_bytes(settings, n, s, coefficients, channels)
    return {
        "requires": (
            _requirements(scene, points, int(probe["rays"] * n))
            | {"bounce_energy": reflections["energy"]}
        ),
        "settings": _reasons(settings, points, directions, coefficients, reflections),
        "left_out": left_out(scene),
        "predicted": {
            "seconds": round(loading + sampling + transport + basis + indirect + 0.5, 1),
            "peak_memory_bytes": int(held + working),
            "bytes": int(stored),
            "relighting_bytes": int(relighting),
            "projection_bytes": int(projection),
        },
    }


def storage_bytes(basis, points, directions, coefficients, rays_per_direction=1, channels=1):
    """What has to be kept for relighting (Eigentransport, section 7.1).

    Parameters
    ----------
    basis : str
    points, directions, coefficients : int
        v, s and d of the paper.
    rays_per_direction : int
    channels : 1 or 3
        Of the transport. Principal components hold all of them; in other bases each has
        coefficients of its own.

    Returns
    -------
    relighting : int
        Bytes of the coefficients of all points and of the light: 4d(v + 1), single precision.
        `haar` adds the indices of its coefficients, `none` takes a bit for each ray.
    projection : int
        Bytes of the matrix that projects light: 4ds. `haar` needs none, its transform is computed.
    """
    light = {"haar": directions, "none": directions}.get(basis, coefficients)
    sets, functions = (1, channels) if basis == "pca" else (channels, 1)
    relighting = (
        sets * coefficient_bytes(basis, points, directions, coefficients, rays_per_direction)
        + 4 * light
    )
    projection = {"haar": 0, "none": 4 * directions}.get(
        basis, 4 * functions * coefficients * directions
    )
    return relighting, projection


def describe_asset(asset):
    """What an asset holds, as plain data.

    `storage` has bytes as predicted by the formula of the paper's section 7.1 (see `storage_bytes`)
    and as measured: of the arrays in the file and of the file.
    """
    if isinstance(asset, MeshlessAsset):
        return describe_meshless_asset(asset)
    n, s, d = len(asset.points), len(asset.directions), len(asset.basis)
    relighting, projection = storage_bytes(
        asset.basis.kind, n, s, d, asset.settings["rays_per_direction"], asset.channels
    )
    measured = {
        "coefficients": sum(
            array.nbytes for array in coefficient_arrays(asset.coefficients).values()
        ),
        "basis": sum(getattr(asset.basis, name).nbytes for name in asset.basis.ARRAYS),
        "file": asset.path.stat().st_size if asset.path else None,
    }
    # Without a mean the components also hold that of the transport, and their energies sum to more
    # than the variance.
    per_component = (
        "captured_variance_per_component"
        if asset.basis.kind == "pca"
        else "energy_over_variance_per_component"
    )
    return {
        "points": n,
        "directions": s,
        "basis": asset.basis.kind,
        "coefficients": d,
        "bounces": asset.report["bounces"],
        "captured_variance": asset.report["captured_variance"],
        "relative_error": asset.report["relative_error"],
        per_component: [round(float(v), 6) for v in asset.basis.captured_variance],
        "storage": {
            "predicted": {"relighting": relighting, "projection": projection},
            "measured": measured,
        },
        "buried_points": int(asset.buried.sum()),
        "scene": asset.scene,
        "settings": asset.settings,
        "versions": asset.versions,
        "report": asset.report | asset.points.report,
    }


def _probe(scene, points, directions, settings, coefficients):
    """Rays and seconds per point, from a sample of the points."""
    index = np.random.default_rng(settings.seed).permutation(len(points))[:PROBE_POINTS]
    few = points.at(index)
    sample_direct(scene, few, directions, settings.rays_per_direction)  # compiles the kernel
    started = time.perf_counter()
    transport = sample_direct(scene, few, directions, settings.rays_per_direction)
    rate = max(transport.rays, 1) / (time.perf_counter() - started)
    vectors = np.ones((len(directions), coefficients), np.float32)
    rows = transport.rows(slice(0, BLOCK_ROWS))
    seconds = {}
    for name, run in {
        "expanding": lambda: transport.rows(slice(0, BLOCK_ROWS)),
        "multiplying": lambda: rows @ vectors,
    }.items():
        list(map_chunks(lambda _: run(), range(8)))  # until memory is warm
        started = time.perf_counter()
        list(map_chunks(lambda _: run(), range(PROBE_BLOCKS)))
        seconds[name] = (time.perf_counter() - started) / (PROBE_BLOCKS * len(rows))
    return {"rays": transport.rays / len(few), "rate": rate} | seconds


def _probe_reflections(scene, points, directions, settings):
    """How light splits by reflections, told by paths from a sample of the points, and how fast they
    are traced.

    Returns
    -------
    dict
        energy (see `BounceSplit`; direct light within about 3 %, reflections 20 %), bounces
        (expected), rate (paths per second), paths (from each point).
    """
    index = np.random.default_rng(settings.seed).permutation(len(points))[:PROBE_POINTS]
    few = points.at(index)
    transport = sample_direct(scene, few, directions)
    weights = surface_shares(few, find_buried(scene, few, transport.dark()))
    direct = float(weights @ (1 - blocked_share(transport, directions.solid_angles)))
    wanted = None if settings.bounces == "auto" else settings.bounces
    paths = settings.paths_per_point if settings.paths_per_point != "auto" else EXPECTED_PATHS
    if wanted == 0:
        return {"energy": [round(direct, 6)], "bounces": 0, "rate": 1.0, "paths": 0}
    sampler = PathSampler(scene, few, directions, PROBE_PATHS, wanted, 1, None, settings.seed)
    sampler.escapes(np.arange(len(few)))  # compiles the kernel
    started = time.perf_counter()
    split = weights @ energies(sampler.escapes(np.arange(len(few))), PROBE_PATHS)
    rate = len(few) * PROBE_PATHS / (time.perf_counter() - started)
    left = np.append(split, 0)[::-1].cumsum()[::-1]
    bounces = int(
        np.argmax(left <= (BOUNCE_TOLERANCE * (direct + left[0]) if wanted is None else 0))
    )
    return {
        "energy": [round(x, 6) for x in (direct, *split[:bounces].tolist())],
        "bounces": bounces,
        "rate": rate,
        "paths": paths,
    }


def _indirect_seconds(reflections, points, coefficients, channels, product):
    """Seconds that reflections are expected to take; `product` is the time of one multiplication in
    a dense product.
    """
    traced = points * reflections["paths"] / reflections["rate"]
    return traced * (
        1
        + SPARSE_WORK
        * product
        * reflections["rate"]
        * coefficients
        * channels
        * reflections["bounces"]
    )


def _requirements(scene, points, rays):
    materials = {s.material for s in scene.surfaces}
    albedo = points.albedo
    return {
        **scene.statistics(),
        "textured_materials": sum(m.textured for m in materials),
        "two_sided_materials": sum(m.two_sided for m in materials),
        "materials": len(materials),
        "albedo": {
            "mean": [round(float(x), 4) for x in albedo.mean(axis=0)],
            "largest": round(float(albedo.max()), 4),
            "grey": bool(np.ptp(albedo, axis=1).max() <= GREY),
        },
        "distant_emitters": [e.class_name() for e in scene.distant_emitters],
        "local_emitters": [e.class_name() for e in scene.local_emitters],
        "sensors": len(scene.mi_scene.sensors()),
        "points": len(points),
        "irregular": {k: v for k, v in points.report.items() if k != "edge_length"},
        "rays": rays,
    }


def _reasons(settings, points, directions, coefficients, reflections):
    """The settings that would be used, each with its reason."""
    chosen = asdict(settings)
    edge = points.report["edge_length"]
    auto = (
        f"finest of 1/400…1/4 of the scene's scale that keeps it near {POINT_BUDGET:,} points"
        " beyond its vertices"
    )
    reasons = {
        "directions": (
            f"{len(directions):,} cells, about"
            f" {np.degrees(np.sqrt(4 * np.pi / len(directions))):.1f}° wide: sharper shadows need"
            " more"
        ),
        "basis": (
            "components of this scene's own transport: the least error for their number"
            if settings.basis == "pca"
            else "as asked"
        ),
        "coefficients": _coefficients_reason(settings),
        "edge_length": auto if settings.edge_length == "auto" else "as asked",
        "rays_per_direction": "1 samples the middle of each cell; 4 antialias the edges of shadows",
        "bounces": _bounces_reason(settings, reflections),
        "indirect": (
            "light goes from point to point, in coefficients: least noise"
            if settings.indirect == "solve"
            else "unbiased paths from each point: more noise"
        ),
        "paths_per_point": (
            "so many that noise is about 1 % of the transport; the prediction takes"
            f" {EXPECTED_PATHS}"
            if settings.paths_per_point == "auto"
            else "as asked"
        ),
        "denoise": (
            "components of reflected light keep the share of their variance that is signal"
            if settings.denoise
            else "as asked"
        ),
        "seed": (
            "start of the randomized fit"
            if settings.basis == "pca"
            else "nothing is random with this basis"
        ),
    }
    chosen |= {"coefficients": coefficients, "edge_length": round(edge, 6)}
    if settings.variance is not None:
        chosen["coefficients"] = "auto"
        reasons["variance"] = "share of the transport's variance to capture"
    return {name: {"value": chosen[name], "reason": reason} for name, reason in reasons.items()}


def _bounces_reason(settings, reflections):
    if settings.basis in DIRECT_ONLY:
        return f"the basis {settings.basis} holds direct light only"
    if settings.bounces != "auto":
        return "as asked"
    if reflections["bounces"] == 0:
        return "none: no point sees another that reflects"
    return f"until 0.1 % of the light is left, here about {reflections['bounces']}"


def _coefficients_reason(settings):
    if settings.basis == "none":
        return "no basis: all directions are kept, as bits of visibility"
    if settings.variance is not None:
        return (
            f"as few as capture {settings.variance:g} of the variance; the prediction takes"
            f" {AUTO_COEFFICIENTS}"
        )
    if settings.coefficients is None:
        return "so many relight in about a millisecond; more of them sharpen shadows"
    return "as asked"
