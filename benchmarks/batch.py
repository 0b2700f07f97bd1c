"""Batches of environment maps against calls one by one, in one run: several meshes, bakes excluded,
caches cold.

Usage: python benchmarks/batch.py [--meshes 10] [--maps 200] [--size 512x256] [--single 20]

One by one, each call is given a new map, so that nothing is shared between calls; so many maps as
--single says are timed and the time is scaled. Prints a Markdown table and
checks that both give the same. Nothing else should run on the machine meanwhile.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import mi_prt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))
from batch import AT_ONCE, meshes, skies


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--meshes", type=int, default=10)
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--size", default="512x256")
    parser.add_argument("--single", type=int, default=20)
    parser.add_argument("--directions", default="cubemap:32")
    parser.add_argument("--edge-length", default="auto")
    parser.add_argument("--coefficients", type=int, default=96)
    arguments = parser.parse_args()

    width, height = map(int, arguments.size.split("x"))
    assets = [
        mi_prt.precompute(
            scene,
            transports="distant",
            directions=arguments.directions,
            edge_length=arguments.edge_length,
            coefficients=arguments.coefficients,
        )
        for _, scene in meshes(arguments.meshes)
    ]
    maps = list(skies(arguments.maps, width, height))
    count = min(arguments.single, len(maps))
    alone, single = timed(lambda: one_by_one(assets, maps[:count]))
    alone *= len(maps) / count
    first, batch = timed(lambda: in_batches(assets, maps, count))
    again, _ = timed(lambda: in_batches(assets, maps, count))
    difference = max(float(np.abs(a - b).max() / a.max()) for a, b in zip(single, batch))
    if difference > 1e-4:
        raise SystemExit(f"batches differ from single calls by {difference:.1e} of the maximum")
    points = sum(len(asset.points) for asset in assets)
    print(f"{len(assets)} meshes of {points:,} points, {len(maps)} maps of {arguments.size}\n")
    print("| way | seconds | times faster |\n|---|---:|---:|")
    for name, seconds in (
        ("one by one", alone),
        ("batches", first),
        ("batches, maps met before", again),
    ):
        print(f"| {name} | {seconds:.2f} | {alone / seconds:.1f} |")


def timed(work):
    """Seconds, and what `work` returns."""
    started = time.perf_counter()
    found = work()
    return time.perf_counter() - started, found


def one_by_one(assets, maps):
    """Irradiance under the last of the maps, of each asset."""
    found = []
    for asset in assets:
        for sky in maps:
            last = asset.irradiance(sky.rotated("y", 0))  # another object: nothing is known of it
        found.append(last)
    return found


def in_batches(assets, maps, count):
    """Irradiance under map number `count`, counted from 1, of each asset."""
    found = []
    for asset in assets:
        for first in range(0, len(maps), AT_ONCE):
            irradiance = asset.irradiance(maps[first : first + AT_ONCE], batch=True)
            if first < count <= first + AT_ONCE:
                found.append(irradiance[count - 1 - first].copy())
    return found


if __name__ == "__main__":
    main()
