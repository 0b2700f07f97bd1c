"""Speed as ratios measured in one run: sampling against raw rays, relighting, turning light,
kernels compiled.

Usage: python benchmarks/speed.py [SCENE.xml] [--repeat 7]

Prints a Markdown table of medians. Nothing else should run on the machine meanwhile.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import mi_prt
from mi_prt.directions import parse_directions
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import count_kernels, thread_count
from mi_prt.transport import bits

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "teapot.xml"


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", type=Path, default=SCENE)
    parser.add_argument("--repeat", type=int, default=7)
    arguments = parser.parse_args()

    scene = open_scene(arguments.scene)
    points = sample_points(scene)
    directions = parse_directions("cubemap:32")
    print(
        f"{arguments.scene.name}: {len(points):,} points, {directions}, {thread_count()} threads\n"
    )
    print("| what | median | bound |\n|---|---:|---:|")
    sampling(scene, points, directions, arguments.repeat)
    kernels(scene, points, directions)
    relighting(arguments.scene, arguments.repeat)


def sampling(scene, points, directions, repeat):
    """Transport sampling against `ray_test` alone on the same rays, already in memory."""
    import drjit as dr

    tracer = bits.VisibilityTracer(scene, points, directions.vectors)
    size = bits.LANES // tracer.lanes_per_point
    starts = [int(first) for first in np.linspace(0, len(points) - size, 8)]
    blocks = [(first, size) for first in starts]
    rays = [tracer.rays(*block) for block in blocks]
    dr.eval(rays)
    collections = [], []
    for _ in range(repeat + 1):
        collections[0].append(_timed(lambda: list(tracer.stream(blocks))))
        collections[1].append(
            _timed(lambda: [_finish(scene.occluders.ray_test(ray)) for ray in rays])
        )
    # the first run compiles the kernels
    sampled, raw = (np.array(times[1:]) for times in collections)
    rate = len(blocks) * size * tracer.lanes_per_point / np.median(sampled)
    _row("transport sampling, million rays/s", f"{rate / 1e6:.1f}", "")
    _row(
        "sampling rate / rate of ray_test alone, same rays",
        f"{np.median(raw / sampled):.2f}",
        "≥ 0.8",
    )


def kernels(scene, points, directions):
    """Kernels compiled for many blocks, after one block."""
    tracer = bits.VisibilityTracer(scene, points, directions.vectors)
    list(tracer.stream([(0, 100)]))
    with count_kernels() as counted:
        list(tracer.stream((100 * block + 7, 90 + block) for block in range(10)))
    _row("kernels compiled by 10 more blocks of other sizes", f"{counted.compiled}", "0")


def relighting(path, repeat):
    """Relighting alone, and turning + projecting + relighting; of direct light, and of light that
    reflections colour.
    """
    for bounces, bound in ((0, "≤ 2"), ("auto", "")):
        asset = mi_prt.precompute(path, coefficients=48, bounces=bounces)
        what = "direct light" if bounces == 0 else "with coloured reflections"
        transport = asset.transports["distant"]
        light = transport.basis.project(scene_light(open_scene(path)), transport.directions)
        relit = [
            _timed(lambda: asset.outgoing_radiance(transport.total.respond(*light)))
            for _ in range(20 * repeat)
        ]
        copied = [_timed(transport.coefficients.copy) for _ in range(20 * repeat)]
        _row(
            f"relight {len(asset.points):,} points, 48 coefficients, {what}, ms",
            f"{1e3 * np.median(relit):.2f}",
            bound,
        )
        _row(
            "relight / copy of the coefficients (memory bandwidth)",
            f"{np.median(relit) / np.median(copied):.2f}",
            "",
        )
        _turning(asset, path, repeat)


def _turning(asset, path, repeat):
    prepared = asset.prepare_light(scene_light(open_scene(path)))
    turned = [_timed(lambda: asset.relight(prepared.rotated("y", k))) for k in range(10 * repeat)]
    _row("turn + project + relight, times/s", f"{1 / np.median(turned):.0f}", "≥ 100")


def _timed(run):
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


def _finish(value):
    import drjit as dr

    dr.eval(value)
    dr.sync_thread()


def _row(what, value, bound):
    print(f"| {what} | {value} | {bound} |", flush=True)


if __name__ == "__main__":
    main()
