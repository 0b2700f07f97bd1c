"""From an asset and light to a file: image, mesh with vertex radiance, or plain arrays."""

import time
import warnings
from pathlib import Path

from ..asset.meshless_asset import MeshlessAsset
from ..asset.provenance import open_scene_of
from ..errors import SceneError, SettingsError
from ..evaluate.local_lights import distant_and_given, measure_error, with_own_lamps
from ..lighting.emission import emission_of
from ..lighting.environment import LightWarning
from ..lighting.light import as_light
from ..lighting.local import hull_warning
from ..lighting.to_mitsuba import lit_scene
from ..render.display import exposure
from ..render.image import pick_sensor, render_image, resized
from ..scene.scene import Scene
from ..system.files import check_writable
from .export import write_image, write_npz, write_ply
from .relight_local import IMAGES, MESHES, relight_local

RENDERERS = ("mitsuba", "raster")


def relight_to_file(
    asset,
    output,
    light=None,
    rotate=None,
    scene=None,
    sensor=0,
    size=None,
    renderer="mitsuba",
    spp=64,
    nearest=1,
    component="total",
    direct="points",
):
    """Relight an asset and write the result.

    Parameters
    ----------
    asset : Asset
    output : path
        .exr (linear) or .png (exposed, sRGB) image; .ply or .npz of the points.
    light : what `as_light` accepts, or a list of such and 'scene', optional
        By default 'scene': the scene's own distant light, or its local light if the asset is one of
        local lights.
    rotate : (axis, degrees), optional
        Turns the distant light.
    scene : path, dict or mi.Scene, optional
        If the asset's scene is somewhere else by now.
    sensor : int
    size : (width, height), optional
    renderer : 'mitsuba' or 'raster'
        The integrator `prt`, or pyrender: triangles between vertices, splats of samples.
    spp : int
        Samples per pixel of the integrator.
    nearest : int
        Directions that stand for a local light in an asset of distant light, see
        `Asset.irradiance`.
    component : 'total', 'direct' or 'indirect'
        Of an asset of local lights, what is shown.
    direct : 'points' or 'pixels'
        Of an asset of local lights, where direct light is computed: at the points, or with shadow
        rays at each pixel.

    Returns
    -------
    dict
        points, seconds{project, relight, render}. With local lights, and where the scene is opened,
        which it is for images and if one of them is inside its convex hull:
        local_light_error{relative_rmse, bias, points}, the error of their irradiance against
        Mitsuba's.

    Raises
    ------
    SettingsError, SceneError, LightError

    Warns
    -----
    LightWarning
        If a local light is inside the convex hull of the scene; with the measured error.
    """
    if isinstance(asset, MeshlessAsset):
        if rotate is not None or nearest != 1:
            raise SettingsError(
                "rotate and nearest are for distant light, and this asset is one of local lights"
                " (points='samples')"
            )
        return relight_local(
            asset, output, light, scene, sensor, size, renderer, spp, component, direct
        )
    if (component, direct) != ("total", "points"):
        raise SettingsError(
            f"component '{component}', direct '{direct}': an asset of distant light holds all light"
            " in one; precompute the scene with points='samples' to tell them apart"
        )
    output = Path(output)
    suffix = output.suffix.lower()
    if suffix not in IMAGES + MESHES:
        raise SettingsError(f"output '{output}' must end in {', '.join(IMAGES + MESHES)}")
    if renderer not in RENDERERS:
        raise SettingsError(f"renderer '{renderer}' is not known: use {' or '.join(RENDERERS)}")
    check_writable(output)

    needs_scene = suffix in IMAGES or (light is None or as_light(light).of_scene)
    opened = open_scene_of(asset, scene) if needs_scene else None
    chosen = distant_and_given(opened, light, rotate)
    if renderer == "raster":
        from ..render.raster import RasterScene  # opens OpenGL: only where it is asked for

    clock = [time.perf_counter()]
    projected = asset.project_light(chosen)
    clock.append(time.perf_counter())
    irradiance = asset.irradiance_from(*projected, chosen, nearest)
    radiance = asset.outgoing_radiance(irradiance)
    clock.append(time.perf_counter())
    if suffix == ".ply":
        write_ply(output, asset, radiance)
    elif suffix == ".npz":
        write_npz(output, asset, radiance, irradiance)
    else:
        factor = exposure(radiance[~asset.buried])
        lit = Scene(lit_scene(opened, with_own_lamps(opened, chosen)), opened.source)
        with resized(pick_sensor(lit.mi_scene, sensor), size) as camera:
            if renderer == "raster":
                with RasterScene(asset, lit, camera) as raster:
                    image = raster.radiance(irradiance)
            else:
                image = render_image(asset, lit.mi_scene, camera, spp, irradiance=irradiance)
        write_image(output, image, factor)
    clock.append(time.perf_counter())
    stages = zip(("project", "relight", "render"), clock, clock[1:])
    result = {
        "points": len(asset.points),
        "seconds": {name: round(b - a, 5) for name, a, b in stages},
    }
    if not chosen.local.is_empty:
        result |= _local_light_error(asset, chosen.local, nearest, opened, scene)
    return result


def _local_light_error(asset, lights, nearest, opened, scene):
    """The entry local_light_error, or none where the scene is neither open nor needed, or not to be
    had.
    """
    warning = hull_warning(emission_of(lights).positions, asset.points.hull)
    if opened is None and not warning:
        return {}
    try:
        return {
            "local_light_error": measure_error(
                asset, lights, nearest, opened or open_scene_of(asset, scene)
            )
        }
    except SceneError as error:
        warning = f"{warning}; by" if warning else "local lights: by"
        warnings.warn(
            f"{warning} how much it errs cannot be measured: {error}", LightWarning, stacklevel=3
        )
        return {}
