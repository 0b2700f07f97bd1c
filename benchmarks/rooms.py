"""Rooms under their own light: sky and lamps of one asset against Mitsuba, by defaults.

Usage: python benchmarks/rooms.py [SCENE.xml …] [--points vertices --points samples] [--spp 128]
By default scenes/day_room.xml and scenes/room.xml. Prints a table in Markdown.
"""

import argparse
import tempfile
import time
from pathlib import Path

import mi_prt

SCENES = Path(__file__).resolve().parent.parent / "scenes"
COLUMNS = (
    "scene",
    "points",
    "precompute, s",
    "MB",
    "points: RMSE",
    "bias",
    "seen: RMSE",
    "bias",
    "direct",
    "indirect",
    "image: RMSE",
    "bias",
    "FLIP",
    "truth's noise",
)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--points", action="append", help="vertices, samples or auto")
    parser.add_argument("--coefficients", type=int)
    parser.add_argument("--keep-direct", action="store_true")
    parser.add_argument("--spp", type=int, default=128)
    arguments = parser.parse_args()
    print("| " + " | ".join(COLUMNS) + " |")
    print("|---|---|" + "---:|" * (len(COLUMNS) - 2))
    for scene in arguments.scenes or [SCENES / "day_room.xml", SCENES / "room.xml"]:
        for points in arguments.points or ["auto"]:
            print("| " + " | ".join(row(scene, points, arguments)) + " |", flush=True)


def row(scene, points, arguments):
    """A line of the table: an asset of a scene against Mitsuba."""
    begun = time.perf_counter()
    settings = {"coefficients": arguments.coefficients} if arguments.coefficients else {}
    if arguments.keep_direct:
        settings["keep_direct"] = True
    asset = mi_prt.precompute(scene, points=points, **settings)
    seconds = time.perf_counter() - begun
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.prt"
        asset.save(path)
        report = mi_prt.compare(
            asset, Path(folder) / "report", scene=scene, size=(320, 240), spp=arguments.spp
        )
        size = path.stat().st_size / 1e6
    at_points, image = report["points"], report["image"]
    parts = [report["components"].get(name) for name in ("direct", "indirect")]
    return [
        scene.parent.name if scene.stem == "scene" else scene.stem,
        f"{len(asset.points):,} {asset.settings['points']}",
        f"{seconds:.0f}",
        f"{size:.1f}",
        *two(at_points),
        *two(at_points["visible"]),
        *(" / ".join(two(part)) if part else "" for part in parts),
        *two(image),
        f"{image['flip']:.3f}",
        f"{at_points['reference_noise']:.1%}",
    ]


def two(errors):
    """RMSE beyond the truth's noise, and bias."""
    return f"{errors['relative_rmse_beyond_noise']:.1%}", f"{errors['bias']:+.1%}"


if __name__ == "__main__":
    main()
