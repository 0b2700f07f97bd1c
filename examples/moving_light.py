"""A lamp carried through two rooms: precompute once, then a film of it, and its error in one place.

Usage: python examples/moving_light.py [--count 20000] [--out out/moving_light]
"""

import argparse
import time
from pathlib import Path

import mi_prt

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "room.xml"
# through the doorway
WALK = "1.6,1.7,1.6 -0.6,1.7,1.5 0.1,1.6,0.2 0.1,1.6,-1.4 -1.6,1.7,-1.8 1.4,1.7,-2.0"
INTENSITY = (3.2, 2.9, 2.5)  # W/sr
SIZE = (480, 300)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=20_000, help="samples")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument(
        "--out", type=Path, default=Path("out/moving_light"), help="folder for the results"
    )
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    started = time.perf_counter()
    asset = mi_prt.precompute(
        SCENE,
        points="samples",
        transports="local",
        count=arguments.count,
        cluster_size=max(1, arguments.count // 45),
    )
    asset.save(arguments.out / "room.prt")
    print(
        f"{len(asset.points):,} samples in {len(asset.transports['local'].clusters)} clusters:"
        f" {time.perf_counter() - started:.0f} s"
    )

    lamp = mi_prt.PointLight((1.6, 1.7, 1.6), INTENSITY)
    film = arguments.out / "walk.mp4"
    told = mi_prt.animate(
        asset, film, WALK, arguments.frames, light=lamp, size=SIZE, renderer="raster"
    )
    seconds = told["seconds"]
    print(
        f"{film}: relight {1e3 * seconds['relight'] / arguments.frames:.1f} ms, draw"
        f" {1e3 * seconds['render'] / arguments.frames:.0f} ms a frame"
    )

    report = mi_prt.compare(
        asset, arguments.out / "report", lamp, size=SIZE, spp=64, direct="pixels"
    )
    for name, errors in (report["components"] | {"all": report["points"]}).items():
        print(
            f"{name} light at the points: {errors['relative_rmse_beyond_noise']:.1%} off, bias"
            f" {errors['bias']:+.1%}"
        )


if __name__ == "__main__":
    main()
