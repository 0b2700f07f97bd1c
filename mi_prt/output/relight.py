"""From an asset and light to a file: image, mesh with vertex radiance, or plain arrays."""

import time
import warnings

from ..asset.provenance import open_scene_of
from ..errors import SettingsError
from ..lighting.environment import LightWarning
from ..lighting.light import Light
from ..points.filled import filled
from ..render.display import check_exposure, exposure_factor, exposure_report
from ..render.integrator import check_direct
from ..render.picture import RENDERERS, Picture
from ..render.rendered import check_picture
from ..system.files import check_own, check_writable
from ..transport.transport import Question
from .dark import dark_warning
from .formats import FORMATS, Relit, format_of


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
    nearest=None,
    component="total",
    direct="points",
    force=False,
    exposure="auto",
):
    """Relight an asset and write the result.

    Parameters
    ----------
    asset : Asset
    output : path
        .exr (linear) or .png (exposed, sRGB) image; .ply or .npz of the points; see `FORMATS`.
    light : what `as_light` accepts, 'scene', or a list of these, optional
        By default the scene's own light, as far as the asset holds it.
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
    nearest : int, optional
        Directions that stand for a local light where only transport of distant light is there, see
        `Asset.irradiance`.
    component : 'total', 'direct' or 'indirect'
        What is shown.
    direct : 'points' or 'pixels'
        Where direct light of local lights is computed: at the points, or with shadow rays at each
        pixel.
    force : bool
        Whether to replace a file that this program has not written.
    exposure : 'auto' or float
        Of .png and .ply: EV (0 shows radiance 1 as white), or what takes the log-average luminance
        at the points to mid grey.

    Returns
    -------
    dict
        points, exposure{ev, factor}, seconds{relight, render}.

    Raises
    ------
    SettingsError, SceneError, LightError

    Warns
    -----
    LightWarning
        If a local light is inside the convex hull of the scene and only transport of distant light
        is there for it; `compare` measures its error. If light gives the scene almost nothing.
    """
    written = format_of(output)
    RENDERERS[renderer]
    check_picture(size, sensor, spp)
    exposure = check_exposure(exposure)
    Question(Light(()), component, nearest)  # which checks them
    if check_direct(direct) == "pixels" and not written.is_picture:
        pictures = " or ".join(name for name in FORMATS if FORMATS[name].is_picture)
        raise SettingsError(
            f"direct light at pixels is of pictures, and '{output}' holds points: write {pictures},"
            " or leave direct (--direct) at points"
        )
    check_writable(output)
    check_own(output, written.is_own, force)
    opened = open_scene_of(asset, scene) if written.is_picture else None
    resolved = asset.resolved(light, rotate, opened or scene)
    clock = [time.perf_counter()]
    if written.is_picture:
        picture = Picture(asset, opened, resolved, component, direct, nearest, exposure)
        irradiance = picture.irradiance()
        clock.append(time.perf_counter())
        with picture.drawn(sensor, size, renderer, spp) as draw:
            image = draw(irradiance)
        relit = Relit(asset, irradiance, None, picture.exposure(), image)
    else:
        shares = asset.shared_out(resolved)
        irradiance = filled(asset.points, asset.answered(shares, component, nearest))
        radiance = asset.outgoing_radiance(irradiance)
        clock.append(time.perf_counter())
        factor = exposure_factor(exposure, radiance[~asset.buried])
        relit = Relit(asset, irradiance, radiance, factor)
    written.write(output, relit)
    clock.append(time.perf_counter())
    seconds = zip(("relight", "render"), clock, clock[1:])
    for warning in asset.warnings(asset.shared_out(resolved)):
        text = f"{warning}; compare tells how far such light is off (mi-prt compare)"
        warnings.warn(text, LightWarning, stacklevel=2)
    if component != "indirect" and (dark := dark_warning(asset.points, irradiance, resolved)):
        warnings.warn(dark, LightWarning, stacklevel=2)
    return {
        "points": len(asset.points),
        "exposure": exposure_report(relit.exposure),
        "seconds": {name: round(b - a, 5) for name, a, b in seconds},
    }
