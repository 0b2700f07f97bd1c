"""The folder that `compare` leaves: numbers, pictures, and a page to look at."""

import html
import json
from pathlib import Path

import numpy as np

from ..render.display import LUMINANCE, display
from ..render.image_file import write_displayed, write_image
from ..system.files import replacing
from . import metrics

_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8">{mark}
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto }}
body {{ padding: 0 1rem; color: #222 }}
main {{ display: grid; grid-template-columns: 1fr 1fr; gap: 1rem }} figure {{ margin: 0 }}
img {{ max-width: 100%; image-rendering: auto }}
table {{ border-collapse: collapse; margin: 1rem 0 }}
td, th {{ padding: .2rem 1rem .2rem 0; text-align: right }}
th:first-child, td:first-child {{ text-align: left }} tr {{ border-bottom: 1px solid #ddd }}
</style>
<h1>{title}</h1>
<p>{summary}</p>
<main>
<figure><img src="result.png" alt=""><figcaption>mi_prt</figcaption></figure>
<figure><img src="reference.png" alt=""><figcaption>Mitsuba, {reference}</figcaption></figure>
<figure><img src="error.png" alt=""><figcaption>Signed luminance error:
blue darker, red brighter, full colour at
&plusmn;{error_range:.0%} of the mean</figcaption></figure>
<figure><img src="flip.png" alt=""><figcaption>FLIP: dark is equal to the eye,
bright is different</figcaption></figure>
</main>
<table><tr><th></th><th>relative RMSE</th><th>beyond noise</th><th>bias</th>
<th>reference noise</th><th>PSNR</th><th>FLIP</th></tr>
<tr><td>{count:,} points, irradiance</td>{points}<td></td><td></td></tr>
{components}<tr><td>image, radiance where geometry covers the pixel</td>{image}
<td>{psnr:.1f} dB</td><td>{flip:.4f}</td></tr></table>
<h2>What makes the error</h2>
<ul>{causes}</ul>
</html>
"""
_TITLE = "<title>mi_prt comparison</title>"
ERROR_RANGE = 0.5
_PICTURES = ("result", "reference", "error", "flip", "side_by_side")
NAMES = ("report.json", "index.html", "result.exr", "reference.exr") + tuple(
    f"{name}.png" for name in _PICTURES
)


def is_report(folder):
    """Whether a folder holds a report of this program."""
    try:
        with open(Path(folder) / "index.html", encoding="utf-8", errors="replace") as file:
            return _TITLE in file.read(1 << 12)
    except OSError:
        return False


def write_report(folder, report, result, reference, covered):
    """Write report.json, index.html, EXRs and PNGs.

    Parameters
    ----------
    folder : Path
    report : dict
        As `compare` returns it.
    result, reference : (h, w, 3) float32
        Linear radiance.
    covered : (h, w) bool
        Pixels that geometry covers wholly.
    """
    folder = Path(folder)
    factor = report["image"]["exposure"]
    shown, truth = display(result, factor), display(reference, factor)
    error = _error_map(result, reference, covered)
    flip_map = _coloured(metrics.flip(shown, truth)[1], "magma")
    write_image(folder / "result.exr", result)
    write_image(folder / "reference.exr", reference)
    for name, picture in (
        ("result", shown),
        ("reference", truth),
        ("error", error),
        ("flip", flip_map),
    ):
        write_displayed(folder / f"{name}.png", picture)
    write_displayed(folder / "side_by_side.png", np.concatenate([shown, truth, error], axis=1))
    numbers = json.dumps(finite(report), indent=2, allow_nan=False) + "\n"
    for name, text in (("report.json", numbers), ("index.html", _page(report))):
        with replacing(folder / name) as temporary:
            Path(temporary).write_text(text, encoding="utf-8", errors="backslashreplace")


def finite(value):
    """Plain data with null for numbers that JSON cannot hold (the PSNR of equal images is
    infinite).
    """
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _error_map(result, reference, covered):
    mean = (reference[covered] @ LUMINANCE).mean()
    error = (result - reference) @ LUMINANCE / max(mean, 1e-30)
    return _coloured(np.where(covered, error, 0) / (2 * ERROR_RANGE) + 0.5, "seismic")


def _coloured(values, colours):
    import matplotlib

    return matplotlib.colormaps[colours](np.clip(values, 0, 1))[..., :3].astype(np.float32)


def _page(report):
    points, picture = report["points"], report["image"]

    def cells(errors):
        keys = ("relative_rmse", "relative_rmse_beyond_noise", "bias", "reference_noise")
        return "".join(f"<td>{errors[key]:.2%}</td>" for key in keys)

    return _PAGE.format(
        mark=_TITLE,
        title=html.escape(Path(report["scene"] or "scene in memory").name),
        summary=html.escape(
            f"{_held(report)} Relit in {1e3 * report['seconds']['relight']:.0f} ms; the reference"
            f" took {report['seconds']['reference']:.1f} s."
        ),
        reference=report["reference"],
        error_range=ERROR_RANGE,
        count=points["count"],
        points=cells(points),
        components="".join(
            f"<tr><td>{name} light of it</td>{cells(errors)}<td></td><td></td></tr>\n"
            for name, errors in report.get("components", {}).items()
        ),
        image=cells(picture),
        psnr=picture["psnr"],
        flip=picture["flip"],
        causes="".join(f"<li>{html.escape(cause)}</li>" for cause in _causes(report)),
    )


def _held(report):
    """What the asset holds, in words."""
    parts = []
    for kind, summary in report["transports"].items():
        shown = {k: v for k, v in summary.items() if isinstance(v, int | float | str)}
        parts.append(f"{kind}: " + ", ".join(f"{k} {_number(v)}" for k, v in shown.items()))
    return "; ".join(parts) + "."


def _number(value):
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _causes(report):
    """The sources of error that this comparison can hold, in words."""
    yield (
        f"Reference noise: {report['points']['reference_noise']:.2%} at the points and"
        f" {report['image']['reference_noise']:.2%} in the image are Mitsuba's own; more spp lower"
        " them."
    )
    for entry in sorted(report["ledger"], key=lambda entry: -entry["value"]):
        yield (
            f"{entry['stage']}: {entry['what']}, {entry['value']:.2%} of {entry['norm']}"
            f" ({entry['how']}); the setting {entry['knob']} lowers it."
        )
    if "local_light_error" in report:
        local = report["local_light_error"]
        yield (
            f"Local lights: {local['relative_rmse']:.1%} relative RMSE and {local['bias']:+.1%}"
            " bias by themselves. They are seen through the nearest directions of the lattice, and"
            " where they stand inside the scene's convex hull, with visibility to infinity."
        )
    if "distant" in report["transports"]:
        cells = report["transports"]["distant"]["cells"]
        yield (
            "Directions: distant light and its shadows are averaged over cells of"
            f" {np.degrees(np.sqrt(4 * np.pi / cells)):.1f}°, which blurs the shadow of a small"
            " sun."
        )
    yield (
        "Points: irradiance is interpolated between points; shadows narrower than their distance"
        " are lost."
    )
    for entry in report["left_out"]:
        share = (
            f" ({entry['share']:.0%} of the light those shapes scatter)"
            if entry["share"] is not None
            else ""
        )
        seen = (
            "in the reference, not in the result"
            if report["reference"] == "full"
            else "in neither image"
        )
        yield f"Not modelled: {entry['what']}{share}, {seen}."
