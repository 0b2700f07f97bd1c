"""How far an asset's local lights are from Mitsuba's."""

import warnings

from ..errors import LightError
from ..lighting.emission import emission_of
from ..lighting.environment import LightWarning
from ..lighting.light import Light, as_light
from ..lighting.local import hull_warning
from ..lighting.own_light import SceneLight, resolve
from ..lighting.to_mitsuba import lit_scene
from . import ground_truth, metrics

MEASURED_POINTS = 4096
MEASURED_SAMPLES = 512  # of lights that are not a single place
MEASURED_PATHS = 128  # from each of them, where light is reflected


def distant_and_given(scene, light=None, rotate=None):
    """Light for an asset of distant light: resolved, without the scene's own lamps.

    Raises
    ------
    LightError
        If nothing is left.
    """
    resolved = as_light(SceneLight() if light is None else light)
    if resolved.of_scene:
        resolved = resolve(resolved, scene)
    chosen = Light(part for part in resolved.parts if part.own_name is None)
    if chosen.is_empty:
        raise LightError(
            "the scene has no distant light (envmap, constant, sunsky, directional): pass a light"
        )
    return chosen if rotate is None else chosen.rotated(*rotate)


def local_and_given(scene, light=None):
    """Light for an asset of local lights: resolved, without the scene's own distant light.

    Raises
    ------
    LightError
        If the scene's own local light is in it and the scene has none.
    """
    parts = as_light(SceneLight() if light is None else light).parts
    if not any(part.of_scene for part in parts):
        return Light(parts)
    if not scene.local_emitters:
        raise LightError("the scene has no local light (point, spot, area): pass a light, --light")
    found = []
    for part in parts:
        own = resolve(part, scene)
        found += own.local.parts if part.of_scene else own.parts
    return Light(found)


def with_own_lamps(scene, light):
    """A Light and all lamps of the scene as they are written."""
    own = resolve(None, scene).local if scene.local_emitters else Light()
    return light + own


def measure_error(asset, lights, nearest, scene, seed=0):
    """Measure the error of local lights, and warn with it of those that stand inside the scene's
    convex hull.

    Parameters
    ----------
    asset : Asset
    lights : Light
        Local.
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
    if any(part.is_shape or part.own_name for part in lights.parts):
        lit = lit_scene(scene, lights)
        truth = ground_truth.point_irradiance(lit, points, MEASURED_SAMPLES, seed).mean
    else:
        truth = ground_truth.local_irradiance(scene.occluders, points, lights.parts)
    if asset.settings["bounces"] != 0:
        lit = lit_scene(scene, lights, modelled=True)
        truth += ground_truth.indirect_irradiance(
            lit, points, MEASURED_PATHS, asset.reference_bounces, seed
        ).mean
    error = {
        "relative_rmse": metrics.relative_rmse(irradiance[chosen], truth),
        "bias": metrics.relative_bias(irradiance[chosen], truth),
        "points": len(chosen),
    }
    warning = hull_warning(emission_of(lights).positions, asset.points.hull)
    if warning:
        measured = (
            f"relative RMSE {error['relative_rmse']:.1%} and bias {error['bias']:+.1%} at"
            f" {len(chosen):,} points"
        )
        warnings.warn(f"{warning}: {measured}", LightWarning, stacklevel=3)
    return error
