"""An asset against Mitsuba's ground truth, at the points and in the image, with the error
explained.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..asset.meshless_asset import MeshlessAsset
from ..asset.provenance import open_scene_of
from ..errors import SettingsError
from ..lighting.emission import emission_of
from ..lighting.to_mitsuba import lit_scene
from ..render.display import display, exposure
from ..render.image import coverage, pick_sensor, render_image, resized
from . import ground_truth, metrics
from .local_lights import (
    distant_and_given,
    local_and_given,
    measure_error,
    with_own_lamps,
)
from .report import write_report

REFERENCES = ("modelled", "full")
COMPARED_POINTS = 4096
POINT_SAMPLES = 4096  # samples of the emitters at each compared point
POINT_PATHS = 1024  # paths from each compared point, where light is reflected
# samples per pixel of the asset's own image: it has no noise but that of antialiasing
IMAGE_SAMPLES = 64


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
    direct="points",
):
    """Compare an asset with Mitsuba and write the comparison to a folder.

    Parameters
    ----------
    asset : Asset
    folder : path
        Gets report.json, index.html, EXRs and PNGs; created if need be.
    light : what `as_light` accepts, or a list of such and 'scene', optional
        By default 'scene': the scene's own distant light, or its local light if the asset is one of
        local lights.
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
        Truth as modelled (other materials replaced by their diffuse albedo, emitters that are not
        asked for dark) or as written.
    seed : int
    progress : callable(stage, done, total)
    nearest : int
        Directions that stand for a local light, see `Asset.irradiance`.
    direct : 'points' or 'pixels'
        Of an asset of local lights, where direct light of the image is computed.

    Returns
    -------
    dict
        points{count, relative_rmse, bias, reference_noise, …}, image{relative_rmse, bias, psnr,
        flip, reference_noise, …}, seconds{relight, reference}, and what was compared. Of an asset
        of distant light, with local lights, also local_light_error{relative_rmse, bias, points}:
        that of their irradiance alone. Of one of local lights also components{direct, indirect}
        with errors as those of the points.

    Warns
    -----
    LightWarning
        If a local light is inside the convex hull of the scene; with the measured error.
    """
    if reference not in REFERENCES:
        raise SettingsError(f"reference '{reference}' is not known: use {' or '.join(REFERENCES)}")
    if spp < 2:
        raise SettingsError(
            f"spp {spp} is too low: the reference's noise is told from two halves, so at least 2"
        )
    folder = _made_folder(folder)
    opened = open_scene_of(asset, scene)
    if isinstance(asset, MeshlessAsset):
        if rotate is not None or nearest != 1:
            raise SettingsError(
                "rotate and nearest are for distant light, and this asset is one of local lights"
                " (points='samples')"
            )
        case = _under_local_lights(asset, opened, light, reference, direct, seed)
    else:
        if direct != "points":
            raise SettingsError(
                f"direct '{direct}' is for an asset of local lights (points='samples'), and this is"
                " one of distant light"
            )
        case = _under_distant_light(asset, opened, light, rotate, reference, nearest, seed)
    seconds = {}

    progress("relight", 0, 3)
    started = time.perf_counter()
    irradiance = case.irradiance()
    seconds["relight"] = time.perf_counter() - started

    progress("reference at the points", 1, 3)
    started = time.perf_counter()
    chosen = ground_truth.compared_points(asset, COMPARED_POINTS, seed)
    bounces = asset.reference_bounces
    points = asset.points.at(chosen)
    truth_direct = ground_truth.point_irradiance(case.truth, points, POINT_SAMPLES, seed)
    truth_indirect = ground_truth.indirect_irradiance(
        case.truth, points, POINT_PATHS, bounces, seed
    )

    progress("reference image", 2, 3)
    with resized(pick_sensor(case.truth, sensor), size) as camera:
        expected = ground_truth.image(
            case.truth, camera, spp, seed, ground_truth.path_depth(bounces)
        )
        seconds["reference"] = time.perf_counter() - started
        result = case.image(camera, irradiance)
        covered = coverage(case.truth, camera, IMAGE_SAMPLES, seed) > 1 - 1e-4
    progress("report", 3, 3)

    report = {
        "asset": str(asset.path) if asset.path else None,
        "scene": opened.source.path,
        "reference": reference,
        "left_out": asset.scene["left_out"],
        "bounces": asset.report["bounces"],
        "reference_bounces": "any number" if bounces is None else bounces,
        **case.told(chosen, truth_direct, truth_indirect),
        "points": (
            {"count": len(chosen)} | _errors(irradiance[chosen], truth_direct + truth_indirect)
        ),
        "image": _image_errors(result, expected, covered),
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
    }
    write_report(folder, report, result, expected.mean, covered)
    return report


@dataclass(frozen=True, eq=False)
class _Case:
    """What is compared.

    Parameters
    ----------
    truth : mi.Scene
    irradiance : callable() -> (n, 3)
    image : callable(sensor, irradiance) -> (h, w, 3)
    told : callable(chosen, truth_direct, truth_indirect) -> dict
        What a report says of this kind of asset.
    """

    truth: object
    irradiance: Callable
    image: Callable
    told: Callable


def _under_distant_light(asset, opened, light, rotate, reference, nearest, seed):
    chosen_light = distant_and_given(opened, light, rotate)
    if reference == "modelled":
        truth = lit_scene(opened, chosen_light, modelled=True)
    else:
        truth = lit_scene(opened, with_own_lamps(opened, chosen_light))

    def told(*_):
        any_number = asset.reference_bounces is None
        report = {
            "basis": asset.basis.kind,
            "coefficients": len(asset.basis),
            "directions": len(asset.directions),
            # What the reference has more:
            "bounce_energy_left": (
                asset.report.get("bounce_energy_left", 0.0) if any_number else 0.0
            ),
            "indirect_noise": asset.report.get("indirect_noise", 0.0),
            "captured_variance": asset.report["captured_variance"],
        }
        if not chosen_light.local.is_empty:
            report["local_light_error"] = measure_error(
                asset, chosen_light.local, nearest, opened, seed
            )
        return report

    return _Case(
        truth,
        lambda: asset.irradiance_from(*asset.project_light(chosen_light), chosen_light, nearest),
        lambda camera, irradiance: render_image(
            asset, truth, camera, IMAGE_SAMPLES, seed, irradiance
        ),
        told,
    )


def _under_local_lights(asset, opened, light, reference, direct, seed):
    chosen_light = local_and_given(opened, light)
    truth = lit_scene(opened, chosen_light, modelled=reference == "modelled")

    def told(chosen, truth_direct, truth_indirect):
        components = {"direct": truth_direct, "indirect": truth_indirect}
        return {
            "coefficients": asset.settings["depth_coefficients"],
            "directions": asset.settings["depth_directions"],
            "transfer_coefficients": asset.settings["transfer_coefficients"],
            "misclassified_visibility": asset.report["misclassified_visibility"],
            "components": {
                name: _errors(asset.irradiance(chosen_light, name)[chosen], expected)
                for name, expected in components.items()
            },
        }

    def image(camera, irradiance):
        if direct == "points":
            return render_image(asset, truth, camera, IMAGE_SAMPLES, seed, irradiance)
        indirect = asset.irradiance(chosen_light, "indirect")
        return render_image(
            asset, truth, camera, IMAGE_SAMPLES, seed, indirect, emission_of(chosen_light)
        )

    return _Case(truth, lambda: asset.irradiance(chosen_light), image, told)


def _made_folder(folder):
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".writable").touch()
        (folder / ".writable").unlink()
    except OSError as error:
        raise SettingsError(
            f"output folder '{folder}' cannot be written: {error.strerror}"
        ) from None
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
