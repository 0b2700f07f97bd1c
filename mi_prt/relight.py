"""From an asset and light to a file: image, mesh with vertex radiance, or plain arrays."""

import time
from pathlib import Path

from .errors import SettingsError
from .files import check_writable
from .lighting.scene_light import lit_scene, turned_light
from .provenance import open_scene_of
from .render.display import exposure
from .render.export import write_image, write_npz, write_ply
from .render.image import pick_sensor, render_image, resized
from .scene.scene import Scene

IMAGES = (".exr", ".png")
MESHES = (".ply", ".npz")
RENDERERS = ("mitsuba", "raster")


def relight_to_file(asset, output, light=None, rotate=None, scene=None, sensor=0, size=None, renderer="mitsuba", spp=64):
    """Relight an asset and write the result.

    Parameters
    ----------
    asset : Asset
    output : path
        .exr (linear) or .png (exposed, sRGB) image; .ply or .npz of the points.
    light : what `as_light` accepts, optional
        By default the scene's own distant light.
    rotate : (axis, degrees), optional
        Turns the light.
    scene : path, dict or mi.Scene, optional
        If the asset's scene is somewhere else by now.
    sensor : int
    size : (width, height), optional
    renderer : 'mitsuba' or 'raster'
        The integrator `prt`, or pyrender.
    spp : int
        Samples per pixel of the integrator.

    Returns
    -------
    dict
        points, seconds{project, relight, render}.

    Raises
    ------
    SettingsError, SceneError, LightError
    """
    output = Path(output)
    suffix = output.suffix.lower()
    if suffix not in IMAGES + MESHES:
        raise SettingsError(f"output '{output}' must end in {', '.join(IMAGES + MESHES)}")
    if renderer not in RENDERERS:
        raise SettingsError(f"renderer '{renderer}' is not known: use {' or '.join(RENDERERS)}")
    check_writable(output)

    needs_scene = suffix in IMAGES or light is None
    opened = open_scene_of(asset, scene) if needs_scene else None
    shown, cells_light = turned_light(opened, light, rotate)
    if renderer == "raster":
        from .render.raster import RasterScene  # opens OpenGL: only where it is asked for

    clock = [time.perf_counter()]
    projected = asset.project_light(cells_light)
    clock.append(time.perf_counter())
    irradiance = asset.irradiance_from(*projected)
    radiance = asset.outgoing_radiance(irradiance)
    clock.append(time.perf_counter())
    if suffix == ".ply":
        write_ply(output, asset, radiance)
    elif suffix == ".npz":
        write_npz(output, asset, radiance, irradiance)
    else:
        factor = exposure(radiance[~asset.buried])
        lit = Scene(lit_scene(opened.mi_scene, shown), opened.source)
        with resized(pick_sensor(lit.mi_scene, sensor), size) as camera:
            if renderer == "raster":
                with RasterScene(asset, lit, camera) as raster:
                    image = raster.radiance(irradiance)
            else:
                image = render_image(asset, lit.mi_scene, camera, spp)
        write_image(output, image, factor)
    clock.append(time.perf_counter())
    stages = zip(("project", "relight", "render"), clock, clock[1:])
    return {"points": len(asset.points), "seconds": {name: round(b - a, 5) for name, a, b in stages}}

