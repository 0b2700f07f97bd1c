"""Small assets of every kind of transport, basis, points and storage, for tests of their file.

    python tests/small_assets.py FOLDER

writes them, for the fuzzer.
"""

import sys
import tempfile
from functools import cache
from pathlib import Path

import mi_prt
from mi_prt.scene.scene import open_scene

VERTICES = {"edge_length": 9.0}
DISTANT = {"transports": "distant", "directions": "cubemap:4", "paths_per_point": 16, **VERTICES}
LOCAL = {
    "transports": "local",
    "depth_directions": 16,
    "depth_coefficients": 4,
    "example_lights": 10,
}
KINDS = {
    "pca": {"basis": "pca", "coefficients": 6, **DISTANT},
    "sh": {"basis": "sh", "coefficients": 9, **DISTANT},
    "haar": {"basis": "haar", "coefficients": 5, "bounces": 0, **DISTANT},
    "none": {"basis": "none", "bounces": 0, **DISTANT},
    "haar-shared": {"basis": "haar-shared", "coefficients": 8, "keep_direct": True, **DISTANT},
    "own": {"transports": "own", "lamp_rays": 16, **VERTICES},
    "dense": {
        "transfer_coefficients": 1,
        "transfer_error": 0,
        "cluster_size": 60,
        **LOCAL,
        **VERTICES,
    },
    "sparse": {"transfer_error": 0.3, "cluster_size": 60, **LOCAL, **VERTICES},
    "samples": {"points": "samples", "count": 40, "cluster_size": 20, **LOCAL},
    "all": {
        "points": "samples",
        "count": 40,
        "cluster_size": 20,
        "coefficients": 4,
        "lamp_rays": 16,
        "quantize": "none",
        **(DISTANT | LOCAL),
        "transports": "distant,own,local",
    },
}
del KINDS["all"]["edge_length"]


SCENE = """<scene version="3.0.0">
  <default name="red" value="0.7"/>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="$red, 0.3, 0.2"/></bsdf>
  </shape>
  <shape type="cube" id="box">
    <transform name="to_world"><scale value="0.2"/><translate x="0.6" y="0.3" z="0.5"/></transform>
  </shape>
  <shape type="sphere" id="ball">
    <point name="center" x="0" y="0.5" z="0"/><float name="radius" value="0.4"/>
  </shape>
  <shape type="rectangle" id="lamp">
    <transform name="to_world">
      <scale value="0.2"/><rotate x="1" angle="90"/><translate y="2"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="5, 4, 3"/></emitter>
  </shape>
  <emitter type="point" id="bulb">
    <point name="position" x="0.5" y="1.5" z="0.5"/><rgb name="intensity" value="2"/>
  </emitter>
</scene>
"""


@cache
def opened_scene():
    """The Scene of the assets; opened once."""
    with tempfile.TemporaryDirectory() as folder:
        return open_scene(write_scene(folder))


def write_scene(folder):
    """Its file: a floor, a box and a ball under two lamps."""
    path = Path(folder) / "scene.xml"
    path.write_text(SCENE)
    return path


def make(folder):
    """Write the assets and their scene: paths of the assets, by kind."""
    paths, scene = {}, write_scene(folder)
    for kind, settings in KINDS.items():
        paths[kind] = Path(folder) / f"{kind}.prt"
        mi_prt.precompute(scene, **settings).save(paths[kind])
    return paths


if __name__ == "__main__":
    make(sys.argv[1])
