"""Error of distant relighting on a bunny on a plane, under real environment maps, against Mitsuba.

Usage: python benchmarks/bunny.py [--assets DIR] [--points 3000] [--samples 16384]

DIR holds meshes/bunny.ply and hdr/*.exr (see benchmarks/README.md). Prints a Markdown table. The
reference is Mitsuba's own emitter sampling at a random subset of the vertices; "full" is the
sampled transport with no basis at all, so what is left there is the lattice's and the reference's
error.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np

import mi_prt
from mi_prt import LightWarning
from mi_prt.basis.pca import fit_pca
from mi_prt.basis.rows import Rows
from mi_prt.basis.target import Target
from mi_prt.directions import parse_directions
from mi_prt.evaluate import metrics
from mi_prt.evaluate.ground_truth import point_irradiance
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import sample_direct

ASSETS = Path(__file__).resolve().parents[2] / "shared" / "assets"
COEFFICIENTS = (48, 192)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--assets", type=Path, default=ASSETS)
    parser.add_argument(
        "--points", type=int, default=3000, help="points at which the reference is taken"
    )
    parser.add_argument(
        "--samples", type=int, default=16384, help="samples of the reference at each point"
    )
    parser.add_argument("--directions", default="cubemap:32")
    parser.add_argument("--rays-per-direction", type=int, default=1)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LightWarning)

    scene = open_scene(bunny_on_plane(arguments.assets))
    points = sample_points(scene)
    directions = parse_directions(arguments.directions)
    transport = sample_direct(scene, points, directions, arguments.rays_per_direction)
    lit = Rows(transport.rows, np.flatnonzero(~transport.dark()), directions)
    bases = {d: fit_pca(lit, Target(d)).basis for d in COEFFICIENTS}
    chosen = np.sort(np.random.default_rng(0).permutation(len(points))[: arguments.points])
    rows = transport.rows(chosen)

    print(
        f"{len(points):,} points, {directions}, {arguments.rays_per_direction} rays per direction,"
        f" {transport.rays:,} rays\n"
    )
    headings = [f"{d}: RMSE | beyond noise | bias | paper's mean" for d in COEFFICIENTS]
    print(
        "| map | reference noise | full: RMSE | beyond noise | bias | "
        + " | ".join(headings)
        + " |"
    )
    print("|---|" + "---:|" * (4 + 4 * len(COEFFICIENTS)))
    for path in sorted((arguments.assets / "hdr").glob("*.exr")):
        environment = mi_prt.EnvironmentMap(path)
        truth = point_irradiance(
            lit_scene(scene, environment), points.at(chosen), arguments.samples
        )
        radiance = cell_radiance(environment, directions)
        full = rows @ (radiance * directions.solid_angles[:, None]).astype(np.float32)
        cells = [path.stem, f"{truth.noise:.4f}", *_errors(full, truth)]
        for basis in bases.values():
            light, mean = basis.project_light(radiance)
            coefficients = basis.encode(rows)
            paper = basis.paper_irradiance(coefficients, radiance)
            cells += _errors(np.maximum(coefficients @ light + mean, 0), truth)
            cells.append(f"{metrics.relative_rmse(paper, truth.mean):.4f}")
        print("| " + " | ".join(cells) + " |", flush=True)


def _errors(result, truth):
    rmse = metrics.relative_rmse(result, truth.mean)
    beyond = np.sqrt(max(rmse**2 - truth.noise**2, 0))
    return f"{rmse:.4f}", f"{beyond:.4f}", f"{metrics.relative_bias(result, truth.mean):+.4f}"


def bunny_on_plane(assets):
    """Scene dict: the bunny, 2 m tall, on a plane of 8 m × 8 m."""
    transform = mitsuba().ScalarTransform4f
    return {
        "type": "scene",
        "bunny": {"type": "ply", "filename": str(assets / "meshes" / "bunny.ply")},
        "plane": {"type": "rectangle", "to_world": transform().rotate([1, 0, 0], -90).scale(4)},
    }


if __name__ == "__main__":
    main()
