"""Many meshes under many environment maps: each mesh is precomputed once, then all maps are one
matrix product.

    python examples/batch.py OUTPUT [--meshes 10] [--maps 200] [--size 256x128]

writes OUTPUT/NAME.npy for each mesh: outgoing radiance (maps, points, 3), float16.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import mi_prt

FOLDER = Path(__file__).resolve().parent.parent / "scenes" / "meshes"
AT_ONCE = 50  # maps in one product: what they give of 40,000 points is 24 MB


def meshes(count):
    """Names and scenes of meshes: the project's own, each time in another colour."""
    files, rng = sorted(FOLDER.glob("*.ply")), np.random.default_rng(0)
    for number in range(count):
        file = files[number % len(files)]
        colour = {"type": "rgb", "value": rng.uniform(0.2, 0.8, 3).tolist()}
        material = {"type": "twosided", "material": {"type": "diffuse", "reflectance": colour}}
        mesh = {"type": "ply", "filename": str(file), "bsdf": material}
        yield f"{number:02d}_{file.stem}", {"type": "scene", "mesh": mesh}


def skies(count, width, height):
    """Environment maps: a gradient, and a sun somewhere in its upper half."""
    rng = np.random.default_rng(1)
    rising = np.linspace(1, 0, height)[:, None, None]  # +y is up: the first row of a map
    for _ in range(count):
        pixels = rising * rng.uniform(0.2, 1, 3) + (1 - rising) * rng.uniform(0, 0.3, 3)
        pixels = np.repeat(pixels, width, axis=1)
        pixels[rng.integers(1, height // 2), rng.integers(width)] += 20 * height
        yield mi_prt.EnvironmentMap(pixels)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path)
    parser.add_argument("--meshes", type=int, default=10)
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--size", default="256x128")
    parser.add_argument("--directions", default="cubemap:32")
    parser.add_argument("--edge-length", default="auto")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)

    width, height = map(int, arguments.size.split("x"))
    # The same objects for all meshes: what is known of a map is computed once.
    maps = list(skies(arguments.maps, width, height))
    for name, scene in meshes(arguments.meshes):
        asset = mi_prt.precompute(
            scene,
            transports="distant",
            directions=arguments.directions,
            edge_length=arguments.edge_length,
            coefficients=48,
        )
        started = time.perf_counter()
        file = arguments.output / f"{name}.npy"
        shape = (len(maps), len(asset.points), 3)
        radiance = np.lib.format.open_memmap(file, "w+", np.float16, shape)
        for first in range(0, len(maps), AT_ONCE):
            block = slice(first, first + AT_ONCE)
            radiance[block] = asset.relight(maps[block], batch=True)
        seconds = time.perf_counter() - started
        print(f"{file}: {len(maps)} maps on {len(asset.points):,} points in {seconds:.2f} s")


if __name__ == "__main__":
    main()
