"""How far an asset's local lights are from Mitsuba's."""

import warnings

from ..errors import SceneError
from ..lighting.environment import LightWarning
from ..lighting.to_mitsuba import lit_scene
from ..transport.transport import Question
from . import ground_truth, metrics
from .views import compared_points

MEASURED_POINTS = 4096
MEASURED_SAMPLES = 64  # of each light, from each of them
MEASURED_PATHS = 128  # from each of them, where light is reflected


def measure_error(asset, light, nearest, scene, seed=0):
    """Measure the error of local lights, and warn with it of those that stand inside the scene's
    convex hull.

    Parameters
    ----------
    asset : Asset
    light : Light
        Resolved, of local parts.
    nearest : int, optional
        Directions that stand for a light.
    scene : Scene
        That of the asset.
    seed : int
        Picks the points.

    Returns
    -------
    dict
        relative_rmse and bias (signed, relative) of the irradiance against Mitsuba's, weighted by
        area, at `points` points that are not buried, 4,096 at most.

    Raises
    ------
    SceneError
        If the scene cannot be rebuilt with the materials that the transport models.

    Warns
    -----
    LightWarning
        If a light is inside the hull.
    """
    points = asset.points
    chosen, weights = compared_points(points.buried, points.areas, None, MEASURED_POINTS, seed)
    weights = weights * points.areas[chosen]
    transport = asset.transports["distant"]
    irradiance = transport.respond(points, Question(light, nearest=nearest))
    lit = lit_scene(scene, light, modelled=True)
    truth = ground_truth.irradiance(
        lit, points.at(chosen), MEASURED_SAMPLES, MEASURED_PATHS, asset.reference_bounces, seed
    ).mean
    error = {
        "relative_rmse": metrics.relative_rmse(irradiance[chosen], truth, weights),
        "bias": metrics.relative_bias(irradiance[chosen], truth, weights),
        "points": len(chosen),
    }
    warning = transport.check(points, light)
    if warning:
        measured = (
            f"relative RMSE {error['relative_rmse']:.1%} and bias {error['bias']:+.1%} at"
            f" {len(chosen):,} points"
        )
        warnings.warn(f"{warning}: {measured}", LightWarning, stacklevel=3)
    return error


def stand_in_error(asset, light, nearest, scene, seed=0):
    """The entry local_light_error{…} where transport of distant light stands in for local lights;
    nothing where it does not, or where the scene cannot be rebuilt (with a warning).

    Parameters
    ----------
    asset : Asset
    light : Light
        Resolved.
    nearest : int, optional
    scene : Scene
        That of the asset.
    seed : int
    """
    shares = asset.shared_out(light)
    local = shares["distant"].local if "distant" in shares else None
    if local is None or local.is_empty:
        return {}
    found = asset.warnings(shares)
    try:
        return {"local_light_error": measure_error(asset, local, nearest, scene, seed)}
    except SceneError as error:
        warning = f"{found[0]}; by" if found else "local lights: by"
        warnings.warn(
            f"{warning} how much it errs cannot be measured: {error}", LightWarning, stacklevel=3
        )
        return {}
