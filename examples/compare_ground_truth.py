"""Measure an asset's error against Mitsuba, as modelled and under another light.

Usage: python examples/compare_ground_truth.py [SCENE.xml] [OUTPUT FOLDER]
"""

import sys
from pathlib import Path

import mi_prt

scene = Path(
    sys.argv[1]
    if len(sys.argv) > 1
    else Path(__file__).parent.parent / "scenes" / "cornell_sky.xml"
)
folder = Path(sys.argv[2] if len(sys.argv) > 2 else "out/compare_ground_truth")

for coefficients in (16, 48, 128):
    asset = mi_prt.precompute(scene, coefficients=coefficients)
    report = mi_prt.compare(asset, folder / f"{coefficients}", size=(320, 240), spp=128)
    points, image = report["points"], report["image"]
    print(
        f"{coefficients:4d} coefficients: irradiance RMSE {points['relative_rmse']:.2%} (noise"
        f" {points['reference_noise']:.2%}), bias {points['bias']:+.2%}; image PSNR"
        f" {image['psnr']:.1f} dB, FLIP {image['flip']:.3f}"
    )
print(f"reports are in {folder.resolve()}")
