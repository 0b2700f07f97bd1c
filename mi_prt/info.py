"""What a scene requires and what precomputing it will cost, and what an asset holds."""

import time
from dataclasses import asdict

import numpy as np

from .basis.pca import BLOCK_ROWS
from .directions import parse_directions
from .points.points import POINT_BUDGET, sample_points
from .precompute import DEFAULT_COEFFICIENTS, Settings
from .provenance import left_out
from .runtime import peak_memory_bytes
from .scene.scene import open_scene
from .transport.direct import LANES, sample_direct

PROBE_POINTS = 256
# Work of the basis in passes over all rows: moments, the sample's iterations, the full one, Rayleigh–Ritz, encoding.
BASIS_PASSES = 4.5


def describe(source, parameters=None, **settings):
    """What precomputing a scene requires, would use, leaves out and costs.

    The cost is predicted from a probe: 256 of the scene's points are traced and compressed.

    Parameters
    ----------
    source : path, dict, mi.Scene
    parameters : dict, optional
    **settings
        Fields of `Settings`.

    Returns
    -------
    dict
        requires{…}, settings{… each with value and reason}, left_out[…], predicted{seconds, peak_memory_bytes, bytes}.
    """
    settings = Settings(**settings)
    started = time.perf_counter()
    scene = open_scene(source, parameters)
    loading = time.perf_counter() - started
    started = time.perf_counter()
    points = sample_points(scene, settings.edge_length)
    sampling = time.perf_counter() - started
    directions = parse_directions(settings.directions)
    coefficients = settings.coefficients
    if coefficients is None:
        coefficients = min(DEFAULT_COEFFICIENTS, len(points) - 1, len(directions))
    probe = _probe(scene, points, directions, settings, coefficients)
    n, s, rays = len(points), len(directions), settings.rays_per_direction
    transport = probe["rays"] * n / probe["rate"]
    basis = probe["pass"] * n * BASIS_PASSES
    stored = n * (4 * coefficients + 60) + s * 4 * (coefficients + 6) + 4 * len(points.patches.nodes)
    working = n * s * rays // 16 + LANES * 30 + 40 * s * (coefficients + 16) + stored
    return {
        "requires": _requirements(scene, points, int(probe["rays"] * n)),
        "settings": _reasons(settings, points, directions, coefficients),
        "left_out": left_out(scene),
        "predicted": {
            "seconds": round(loading + sampling + transport + basis + 1.0, 1),
            "peak_memory_bytes": int(peak_memory_bytes() + working),
            "bytes": int(stored),
        },
    }


def describe_asset(asset):
    """What an asset holds, as plain data."""
    d = len(asset.basis.vectors)
    n, s = len(asset.points), len(asset.directions)
    return {
        "points": n,
        "directions": s,
        "coefficients": d,
        "captured_variance": asset.report["captured_variance"],
        "captured_variance_per_component": [round(float(v), 6) for v in asset.basis.captured_variance],
        "relighting_bytes": 4 * d * (n + 1),  # Eigentransport section 7.1
        "projection_bytes": 4 * d * s,
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
    basis = np.ones((len(directions), coefficients + 16), np.float32)
    transport.rows(slice(0, BLOCK_ROWS)) @ basis
    started = time.perf_counter()
    for first in range(0, len(index), BLOCK_ROWS):
        block = transport.rows(slice(first, first + BLOCK_ROWS))
        block.T @ (block @ basis)
    return {
        "rays": transport.rays / len(index),
        "rate": rate,
        "pass": (time.perf_counter() - started) / len(index),
    }


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
            "grey": bool(np.ptp(albedo, axis=1).max() < 1e-4),
        },
        "distant_emitters": [e.class_name() for e in scene.distant_emitters],
        "local_emitters": [e.class_name() for e in scene.local_emitters],
        "sensors": len(scene.mi_scene.sensors()),
        "points": len(points),
        "irregular": {k: v for k, v in points.report.items() if k != "edge_length"},
        "rays": rays,
    }


def _reasons(settings, points, directions, coefficients):
    """The settings that would be used, each with its reason."""
    chosen = asdict(settings)
    edge = points.report["edge_length"]
    auto = f"finest of 1/400…1/4 of the scene's scale that keeps it near {POINT_BUDGET:,} points beyond its vertices"
    reasons = {
        "directions": f"{len(directions):,} cells, about {np.degrees(np.sqrt(4 * np.pi / len(directions))):.1f}° wide: "
        "sharper shadows need more",
        "coefficients": "48 relight in about a millisecond; more of them sharpen shadows"
        if settings.coefficients is None
        else "as asked",
        "edge_length": auto if settings.edge_length == "auto" else "as asked",
        "rays_per_direction": "1 samples the middle of each cell; 4 antialias the edges of shadows",
        "seed": "start of the randomized fit",
    }
    chosen |= {"coefficients": coefficients, "edge_length": round(edge, 6)}
    return {name: {"value": chosen[name], "reason": reason} for name, reason in reasons.items()}
