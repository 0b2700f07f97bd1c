"""An asset against Mitsuba's ground truth, at the points and in the image, with the error
explained.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..asset.provenance import open_scene_of
from ..errors import SettingsError
from ..lighting.light import Light
from ..lighting.to_mitsuba import lit_scene
from ..render.image import pick_sensor, render_image, resized
from ..render.integrator import check_direct
from ..render.picture import Picture
from ..render.rendered import check_picture
from ..scene.scene import Scene
from ..system.files import check_own
from ..transport.transport import Question
from . import ground_truth
from .local_lights import stand_in_error
from .near_emitters import near_emitters
from .norms import errors_at_points, image_errors
from .report import NAMES, is_report, write_report
from .views import compared_points, first_hits, visible_weights

REFERENCES = ("modelled", "full")
COMPARED_POINTS = 4096
POINT_SAMPLES = 4096  # samples of the emitters at each compared point
POINT_PATHS = 1024  # paths from each compared point, where light is reflected
# samples per pixel of the asset's own image: it has no noise but that of antialiasing
IMAGE_SAMPLES = 64
VIEW_SAMPLES = 16  # rays of each pixel that tell which points are seen


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
    nearest=None,
    direct="points",
    force=False,
):
    """Compare an asset with Mitsuba and write the comparison to a folder.

    Parameters
    ----------
    asset : Asset
    folder : path
        Gets report.json, index.html, EXRs and PNGs; created if need be.
    light : what `as_light` accepts, 'scene', or a list of these, optional
        By default the scene's own light, as far as the asset holds it.
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
    nearest : int, optional
        Directions that stand for a local light, see `Asset.irradiance`.
    direct : 'points' or 'pixels'
        Where direct light of local lights is computed for the image.
    force : bool
        Whether to replace files in the folder that are of no report.

    Returns
    -------
    dict
        points{count and what `errors_at_points` gives}, image{what `image_errors` gives},
        components{direct, indirect: as points} where all transports tell them apart,
        transports{kind: what it holds}, ledger, seconds{relight, reference}, and what was compared.
        Where transport of distant light stands in for local lights also
        local_light_error{relative_rmse, bias, points}: that of their irradiance alone.

    Raises
    ------
    SettingsError, SceneError, LightError

    Warns
    -----
    LightWarning
        If a local light is inside the convex hull of the scene and only transport of distant light
        is there for it; with the measured error.
    """
    if reference not in REFERENCES:
        raise SettingsError(f"reference '{reference}' is not known: use {' or '.join(REFERENCES)}")
    check_picture(size, sensor, spp, seed)
    check_direct(direct)
    Question(Light(()), nearest=nearest)  # which checks it
    if spp < 2:
        raise SettingsError(
            f"spp {spp} is too low: the reference's noise is told from two halves, so at least 2"
        )
    folder = _made_folder(folder, force)
    opened = open_scene_of(asset, scene)
    resolved = asset.resolved(light, rotate, opened)
    as_written = reference == "full" and light is None and rotate is None
    shown = None if as_written else resolved
    truth = lit_scene(opened, shown, modelled=reference == "modelled")
    picture = Picture(asset, opened, resolved, "total", direct, nearest)

    seconds = {}
    progress("relight", 0, 3)
    started = time.perf_counter()
    irradiance = picture.at_points()
    seconds["relight"] = time.perf_counter() - started

    started = time.perf_counter()
    bounces = asset.reference_bounces
    with resized(pick_sensor(truth, sensor), size) as camera:
        progress("reference at the points", 1, 3)
        points = _Points(asset, opened, truth, camera, bounces, seed)
        progress("reference image", 2, 3)
        depth = ground_truth.path_depth(bounces)
        expected = ground_truth.image(truth, camera, spp, seed, depth)
        seconds["reference"] = time.perf_counter() - started
        result = render_image(
            asset, truth, camera, IMAGE_SAMPLES, seed, picture.irradiance(), picture.direct
        )
        hits = first_hits(truth, camera, IMAGE_SAMPLES, seed)
    progress("report", 3, 3)

    report = {
        "asset": str(asset.path) if asset.path else None,
        "scene": opened.source.path,
        "light": [part.words for part in resolved.parts],
        "reference": reference,
        "left_out": asset.scene["left_out"],
        "reference_bounces": "any number" if bounces is None else bounces,
        "transports": {kind: t.summary() for kind, t in asset.transports.items()},
        # reflections that were not asked for are missing in the truth as well
        "ledger": [e.as_dict() for e in asset.ledger() if bounces is None or e.knob != "bounces"],
        **stand_in_error(asset, resolved, nearest, opened, seed),
        "points": {"count": len(points.index)} | points.errors(irradiance),
        "components": points.component_errors(picture),
        "image": image_errors(result, expected, hits.covered, hits.emits),
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
    }
    write_report(folder, report, result, expected.mean, hits.covered)
    return report


@dataclass(eq=False)
class _Points:
    """Points at which an asset is compared, and the truth there.

    They are drawn where the sensor looks and evenly over all points, half each.
    """

    asset: Any
    opened: Any
    truth: Any
    camera: Any
    bounces: Any
    seed: int

    def __post_init__(self):
        points, seed = self.asset.points, self.seed
        visible = visible_weights(
            self.truth,
            points.locator(Scene(self.truth, self.opened.source)),
            len(points),
            self.camera,
            VIEW_SAMPLES,
            seed,
        )
        self.index, weights = compared_points(
            points.buried, points.areas, visible, COMPARED_POINTS, seed
        )
        self._areas = points.areas[self.index] * weights
        self._visible = visible[self.index] * weights
        chosen = points.at(self.index)
        spacing = np.broadcast_to(points.layout.spacing(points), len(points))[self.index]
        self._near = near_emitters(self.truth, chosen.positions, spacing)
        self._direct = ground_truth.point_irradiance(self.truth, chosen, POINT_SAMPLES, seed)
        self._indirect = ground_truth.indirect_irradiance(
            self.truth, chosen, POINT_PATHS, self.bounces, seed
        )

    def errors(self, irradiance, component="total"):
        """Errors of irradiance (n, 3) of all points."""
        expected = {
            "direct": self._direct,
            "indirect": self._indirect,
            "total": self._direct + self._indirect,
        }[component]
        found = irradiance[self.index]
        return errors_at_points(found, expected, self._areas, self._visible, self._near)

    def component_errors(self, picture):
        """Errors of direct and indirect light, where the asset tells them apart."""
        return {
            name: self.errors(picture.component_at_points(name), name)
            for name in ("direct", "indirect")
            if picture.holds(name)
        }


def _made_folder(folder, force):
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".writable").touch()
        (folder / ".writable").unlink()
    except OSError as error:
        raise SettingsError(
            f"output folder '{folder}' cannot be written: {error.strerror}"
        ) from None
    for name in NAMES:
        check_own(folder / name, lambda _: is_report(folder), force)
    return folder
