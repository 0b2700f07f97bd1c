"""The trade that mi_prt offers on one scene: coefficients against error, file size, precompute and
relight time.

Usage: python benchmarks/trade.py [SCENE.xml] [--plot docs/trade.png]

Prints a Markdown table and draws the plot. Errors are those of irradiance at 2,000 points under the
scene's own light turned to four angles, reflections included, against Mitsuba's emitter sampling
and path tracer, with the reference's noise taken out.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from mi_prt.evaluate import metrics
from mi_prt.evaluate.ground_truth import irradiance
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.precompute.precompute import measure
from mi_prt.scene.scene import open_scene

ROOT = Path(__file__).resolve().parent.parent
COEFFICIENTS = (16, 48, 96, 192, 384)
SETTINGS = (("cubemap:16", 1), ("cubemap:32", 1), ("cubemap:32", 4))
ANGLES = (0, 90, 180, 270)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", type=Path, default=ROOT / "scenes" / "still_life.xml")
    parser.add_argument("--plot", type=Path, default=ROOT / "docs" / "trade.png")
    arguments = parser.parse_args()

    scene = open_scene(arguments.scene)
    lights = [scene_light(scene).rotated("y", angle) for angle in ANGLES]
    truths = chosen = None
    curves = {}
    print(
        "| directions | rays each | coefficients | file, MB | precompute, s | relight, ms |"
        " relative RMSE | bias |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for directions, rays in SETTINGS:
        for coefficients in COEFFICIENTS:
            asset, cost = measure(
                scene, directions=directions, rays_per_direction=rays, coefficients=coefficients
            )
            if truths is None:
                chosen = np.sort(np.random.default_rng(0).permutation(len(asset.points))[:2000])
                at = asset.points.at(chosen)
                truths = [irradiance(lit_scene(scene, light), at, 8192, 2048) for light in lights]
            results = np.stack([asset.irradiance(light)[chosen] for light in lights])
            transport = asset.transports["distant"]
            projected = transport.basis.project(lights[0], transport.directions)
            expected = np.stack([truth.mean for truth in truths])
            noise = np.linalg.norm([truth.standard_error for truth in truths]) / np.linalg.norm(
                expected
            )
            error = np.sqrt(max(metrics.relative_rmse(results, expected) ** 2 - noise**2, 0))
            relight = np.median(
                [
                    _timed(lambda: asset.outgoing_radiance(transport.total.respond(*projected)))
                    for _ in range(50)
                ]
            )
            size = _file_size(asset)
            curves.setdefault((directions, rays), []).append((1e3 * relight, error, coefficients))
            print(
                f"| {directions} | {rays} | {coefficients} | {size / 1e6:.1f} |"
                f" {sum(cost['seconds'].values()):.1f} | {1e3 * relight:.2f} | {error:.4f} |"
                f" {metrics.relative_bias(results, expected):+.4f} |",
                flush=True,
            )
    print(f"\n{len(asset.points):,} points; the reference's own noise is {noise:.4f}")
    plot(curves, arguments.plot)


def plot(curves, path):
    """Relight time against error, a curve for each setting, labelled with the number of
    coefficients.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.2), layout="constrained")
    for (directions, rays), curve in curves.items():
        milliseconds, errors, counts = np.array(curve).T
        axes.plot(
            milliseconds,
            100 * errors,
            "o-",
            label=f"{directions}, {rays} ray{'s' * (rays > 1)} per direction",
        )
    for x, y, count in zip(milliseconds, 100 * errors, counts):
        axes.annotate(
            f"{int(count)}", (x, y), textcoords="offset points", xytext=(4, 6), fontsize=8
        )
    axes.set(xscale="log", yscale="log", xlabel="time to relight all points, ms (2 cores)")
    axes.set_ylabel("relative RMSE of irradiance, %")
    axes.set_title("Number of coefficients (labels) against error and time", fontsize=10)
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=130)


def _file_size(asset):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "asset.prt"
        asset.save(path)
        return path.stat().st_size


def _timed(run):
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


if __name__ == "__main__":
    main()
