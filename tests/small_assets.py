"""Small assets of every kind of transport, basis, points and storage, for tests of their file.

    python tests/small_assets.py FOLDER

writes them, for the fuzzer.
"""

import json
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

import mi_prt
from mi_prt.asset.describe import describe_asset
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

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


def relight(asset):
    """Under light of all kinds that it holds; and all that it says of itself."""
    lights = [asset.own_lights[name] for name in getattr(asset.transports.get("own"), "names", ())]
    if "distant" in asset.transports:
        lights.append(mi_prt.DirectionalLight((1, -1, 0.3), 2))
        if asset.transports["distant"].basis.kind == "sh":  # maps turn in closed form
            sky = asset.prepare_light(np.ones((2, 4, 3), np.float32))
            asset.irradiance(sky.rotated("y", 30))
    if asset.transports.keys() & {"distant", "local"}:
        lights.append(mi_prt.PointLight((0.3, 1, 0.4), 2))
    with np.errstate(all="ignore"):
        for component in asset.components:
            asset.relight(lights, component)
    json.dumps(describe_asset(asset), allow_nan=False)
    assert asset.reference_bounces is None or asset.reference_bounces >= 0
    triangles = asset.points.layout.triangles()
    asset.points.positions[triangles]
    _locate(asset.points)


def _locate(points):
    """Light between the points, where rays hit the scene of the small assets."""
    import drjit as dr

    mi, scene = mitsuba(), opened_scene()
    x, z = dr.meshgrid(dr.linspace(mi.Float, -0.9, 0.9, 8), dr.linspace(mi.Float, -0.9, 0.9, 8))
    ray = mi.Ray3f(mi.Point3f(x, 1.9, z), mi.Vector3f(0.1, -1, -0.5))
    pi = scene.mi_scene.ray_intersect_preliminary(ray)
    active = pi.is_valid()
    si = pi.compute_surface_interaction(ray)
    locator = points.locator(scene)
    values, found = locator.interpolated(mi.Float(points.albedo.ravel()), pi, si, ray, active)
    index, _ = locator.nearest(pi, si, ray, active)
    dr.eval(values, found, index)


if __name__ == "__main__":
    make(sys.argv[1])
