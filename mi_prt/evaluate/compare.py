"""An asset against Mitsuba's ground truth, at the points and in the image, with the error explained."""

import time
from pathlib import Path

import numpy as np

from ..errors import SettingsError
from ..lighting.scene_light import lit_scene, turned_light
from ..provenance import open_scene_of
from ..render.display import display, exposure
from ..render.image import coverage, pick_sensor, render_image, resized
from . import ground_truth, metrics
from .local_lights import measure_error
from .report import write_report

REFERENCES = ("modelled", "full")
COMPARED_POINTS = 4096
POINT_SAMPLES = 4096  # samples of the emitters at each compared point
POINT_PATHS = 1024  # paths from each compared point, where light is reflected
IMAGE_SAMPLES = 64  # samples per pixel of the asset's own image: it has no noise but that of antialiasing


def compare(
    asset,
    folder,
    light=None,
    rotate=None,
    scene=None,
    sensor=0,
    size=None,
    spp=256,
    reference="modelled",
    seed=0,
    progress=lambda stage, done, total: None,
    nearest=1,
):
    """Compare an asset with Mitsuba and write the comparison to a folder.

    Parameters
    ----------
    asset : Asset
    folder : path
        Gets report.json, index.html, EXRs and PNGs; created if need be.
    light : what `as_light` accepts, or a list of such and 'scene', optional
        By default 'scene', the scene's own distant light.
    rotate : (axis, degrees), optional
        Turns the distant light.
    scene : path, dict or mi.Scene, optional
        If the asset's scene is somewhere else by now.
    sensor : int
    size : (width, height), optional
        By default the sensor's.
    spp : int
        Samples per pixel of the reference image.
    reference : 'modelled' or 'full'
        Truth as modelled (other materials replaced by their diffuse albedo, local emitters dark) or as written.
    seed : int
    progress : callable(stage, done, total)
    nearest : int
        Directions that stand for a local light, see `Asset.irradiance`.

    Returns
    -------
    dict
        points{count, relative_rmse, bias, reference_noise, …}, image{relative_rmse, bias, psnr, flip,
        reference_noise, …}, seconds{relight, reference}, and what was compared. With local lights also
        local_light_error{relative_rmse, bias, points}: that of their irradiance alone.

    Warns
    -----
    LightWarning
        If a local light is inside the convex hull of the scene; with the measured error.
    """
    if reference not in REFERENCES:
        raise SettingsError(f"reference '{reference}' is not known: use {' or '.join(REFERENCES)}")
    if spp < 2:
        raise SettingsError(f"spp {spp} is too low: the reference's noise is told from two halves, so at least 2")
    folder = _made_folder(folder)
    opened = open_scene_of(asset, scene)
    shown, chosen_light = turned_light(opened, light, rotate)
    truth = lit_scene(opened.modelled() if reference == "modelled" else opened.mi_scene, shown)
    seconds = {}

    progress("relight", 0, 3)
    started = time.perf_counter()
    irradiance = asset.irradiance_from(*asset.project_light(chosen_light), chosen_light.point_lights, nearest)
    seconds["relight"] = time.perf_counter() - started

    progress("reference at the points", 1, 3)
    started = time.perf_counter()
    chosen = ground_truth.compared_points(asset, COMPARED_POINTS, seed)
    bounces = asset.reference_bounces
    at_points = ground_truth.irradiance(truth, asset.points.at(chosen), POINT_SAMPLES, POINT_PATHS, bounces, seed)

    progress("reference image", 2, 3)
    with resized(pick_sensor(truth, sensor), size) as camera:
        expected = ground_truth.image(truth, camera, spp, seed, ground_truth.path_depth(bounces))
        seconds["reference"] = time.perf_counter() - started
        result = render_image(asset, truth, camera, IMAGE_SAMPLES, seed, irradiance)
        covered = coverage(truth, camera, IMAGE_SAMPLES, seed) > 1 - 1e-4
    progress("report", 3, 3)

    report = {
        "asset": str(asset.path) if asset.path else None,
        "scene": opened.source.path,
        "reference": reference,
        "left_out": asset.scene["left_out"],
        "basis": asset.basis.kind,
        "coefficients": len(asset.basis),
        "directions": len(asset.directions),
        "bounces": asset.report["bounces"],
        "reference_bounces": "any number" if bounces is None else bounces,
        "bounce_energy_left": asset.report.get("bounce_energy_left", 0.0) if bounces is None else 0.0,  # what the reference has more
        "indirect_noise": asset.report.get("indirect_noise", 0.0),
        "captured_variance": asset.report["captured_variance"],
        "points": {"count": len(chosen)} | _errors(irradiance[chosen], at_points),
        "image": _image_errors(result, expected, covered),
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
    }
    if chosen_light.point_lights:
        report["local_light_error"] = measure_error(asset, chosen_light.point_lights, nearest, opened, seed)
    write_report(folder, report, result, expected.mean, covered)
    return report


def _made_folder(folder):
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".writable").touch()
        (folder / ".writable").unlink()
    except OSError as error:
        raise SettingsError(f"output folder '{folder}' cannot be written: {error.strerror}") from None
    return folder


def _errors(result, reference):
    rmse = metrics.relative_rmse(result, reference.mean)
    noise = reference.noise
    return {
        "relative_rmse": rmse,
        "bias": metrics.relative_bias(result, reference.mean),
        "reference_noise": noise,
        "relative_rmse_beyond_noise": float(np.sqrt(max(rmse**2 - noise**2, 0.0))),
    }


def _image_errors(result, expected, covered):
    """Linear errors and PSNR over pixels that geometry covers wholly; FLIP over the whole image."""
    if not covered.any():
        raise SettingsError("the sensor sees no surface: nothing to compare in the image")
    masked = ground_truth.Reference(expected.mean[covered], expected.standard_error[covered])
    factor = exposure(masked.mean)
    shown, truth = display(result, factor), display(expected.mean, factor)
    mean_flip, _ = metrics.flip(shown, truth)
    return _errors(result[covered], masked) | {
        "psnr": metrics.psnr(shown, truth, covered),
        "flip": mean_flip,
        "exposure": factor,
        "covered": float(covered.mean()),
        "size": [result.shape[1], result.shape[0]],
    }
