"""From a Mitsuba XML file to an asset to images, through the integrator `prt`.

Usage: python examples/xml_to_image.py [SCENE.xml] [OUTPUT FOLDER]
"""

import sys
from pathlib import Path

import mi_prt

scene = Path(
    sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent.parent / "scenes" / "still_life.xml"
)
folder = Path(sys.argv[2] if len(sys.argv) > 2 else "out/xml_to_image")
folder.mkdir(parents=True, exist_ok=True)

mi_prt.precompute(scene).save(folder / "scene.prt")

# The scene's own light, then the same light turned; EXR is linear radiance, PNG is exposed for a
# display.
asset = mi_prt.load(folder / "scene.prt")
mi_prt.relight_to_file(asset, folder / "own_light.exr")
mi_prt.relight_to_file(asset, folder / "own_light.png")
mi_prt.relight_to_file(asset, folder / "turned.png", rotate=("y", 120))
mi_prt.relight_to_file(asset, folder / "vertex_radiance.ply")

# Two lamps instead of it; a list of lights is their sum.
lamps = [mi_prt.PointLight([4, 5, 3], [90, 60, 40]), mi_prt.PointLight([-5, 4, 1], [20, 30, 60])]
mi_prt.relight_to_file(asset, folder / "lamps.png", lamps)

# The integrator is an ordinary Mitsuba plugin too.
import mitsuba as mi  # noqa: E402

integrator = mi.load_dict({"type": "prt", "filename": str(folder / "scene.prt")})
image = mi.render(mi.load_file(str(scene)), integrator=integrator, spp=32)
mi.Bitmap(image).write(str(folder / "by_plugin.exr"))
print(f"images are in {folder.resolve()}")
