"""How far an asset's local lights are from Mitsuba's."""

import warnings

from ..lighting.environment import LightWarning
from ..lighting.light import Light
from ..lighting.local import hull_warning
from ..lighting.scene_light import lit_scene
from . import ground_truth, metrics

MEASURED_POINTS = 4096
MEASURED_PATHS = 128  # from each of them, where light is reflected


def measure_error(asset, lights, nearest, scene, seed=0):
    """Measure the error of local lights, and warn with it of those that stand inside the scene's
    convex hull.

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
        relative_rmse and bias (signed, relative) of the irradiance against Mitsuba's at `points`
        points that are not buried, 4,096 at most.

    Raises
    ------
    SceneError
        If the transport holds reflections, and the scene cannot be rebuilt with the materials that
        it models.

    Warns
    -----
    LightWarning
        If a light is inside the hull.
    """
    chosen = ground_truth.compared_points(asset, MEASURED_POINTS, seed)
    irradiance = asset.local_irradiance(lights, nearest)
    points = asset.points.at(chosen)
    truth = ground_truth.local_irradiance(scene.occluders, points, lights)
    if asset.settings["bounces"] != 0:
        lit = lit_scene(scene.modelled(), Light(point_lights=tuple(lights)))
        truth += ground_truth.indirect_irradiance(
            lit, points, MEASURED_PATHS, asset.reference_bounces, seed
        ).mean
    error = {
        "relative_rmse": metrics.relative_rmse(irradiance[chosen], truth),
        "bias": metrics.relative_bias(irradiance[chosen], truth),
        "points": len(chosen),
    }
    warning = hull_warning(lights, asset.points.hull)
    if warning:
        measured = (
            f"relative RMSE {error['relative_rmse']:.1%} and bias {error['bias']:+.1%} at"
            f" {len(chosen):,} points"
        )
        warnings.warn(f"{warning}: {measured}", LightWarning, stacklevel=3)
    return error
