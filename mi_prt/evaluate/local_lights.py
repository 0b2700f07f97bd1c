"""How far an asset's local lights are from Mitsuba's."""

import warnings

import numpy as np

from ..lighting.environment import LightWarning
from ..lighting.local import hull_warning
from . import ground_truth, metrics

MEASURED_POINTS = 4096


def measure_error(asset, lights, nearest, scene, seed=0):
    """Measure the error of local lights, and warn with it of those that stand inside the scene's convex hull.

    Parameters
    ----------
    asset : Asset
    lights : tuple of PointLight
    nearest : int
        Directions that stand for a light.
    scene : Scene
        That of the asset.
    seed : int
        Picks the points.

    Returns
    -------
    dict
        relative_rmse and bias (signed, relative) of the irradiance against Mitsuba's at `points` points, 4,096 at most.

    Warns
    -----
    LightWarning
        If a light is inside the hull.
    """
    chosen = np.sort(np.random.default_rng(seed).permutation(len(asset.points))[:MEASURED_POINTS])
    irradiance = asset.local_irradiance(lights, nearest)
    truth = ground_truth.local_irradiance(scene.occluders, asset.points.at(chosen), lights)
    error = {
        "relative_rmse": metrics.relative_rmse(irradiance[chosen], truth),
        "bias": metrics.relative_bias(irradiance[chosen], truth),
        "points": len(chosen),
    }
    warning = hull_warning(lights, asset.points.hull)
    if warning:
        measured = f"relative RMSE {error['relative_rmse']:.1%} and bias {error['bias']:+.1%} at {len(chosen):,} points"
        warnings.warn(f"{warning}: {measured}", LightWarning, stacklevel=3)
    return error
