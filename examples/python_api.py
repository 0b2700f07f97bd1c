"""The Python API on a scene dict: points, transport, irradiance and outgoing radiance as NumPy
arrays.
"""

import numpy as np

import mi_prt

scene = {
    "type": "scene",
    "floor": {
        "type": "rectangle",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.5, 0.6]}},
    },
    "ball": {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.3},
}
asset = mi_prt.precompute(scene, directions="cubemap:16", coefficients=32)
# An asset is points and transports: of distant light here, as the scene has no light of its own.
distant = asset.transports["distant"]
print(
    f"{len(asset.points):,} points, {distant.directions}, captured variance"
    f" {distant.report['captured_variance']:.3f}, {distant.report['bounces']} reflections: mean"
    f" irradiance under a white sky {sum(distant.report['bounce_energy']):.3f} of π"
)

# A map of any size: here a bright band of sky around the horizon (+y is up in a map; this scene has
# +z up).
height, width = 64, 128
pixels = np.full((height, width, 3), 0.05, np.float32)
pixels[height // 4 : height // 2] = [1.0, 0.9, 0.7]
light = mi_prt.EnvironmentMap(pixels).rotated(axis="x", degrees=90)

irradiance = asset.irradiance(light)  # (n, 3) W/m²
radiance = asset.relight(light)  # (n, 3) W/(m²·sr)
# (1, 3, s), or (1, s) where all is grey: the first point's transport as the basis holds it
row = distant.total.rows([0])
print("mean irradiance", irradiance.mean(axis=0), "mean outgoing radiance", radiance.mean(axis=0))
print("transport of point 0, integrated over the sphere:", row[0] @ distant.directions.solid_angles)

# Several lights at once: a list is their sum. A local light is seen right from outside the scene's
# convex hull.
sun = mi_prt.DirectionalLight(direction=[1, 0, -2], irradiance=3.0)  # travels down, W/m²
lamp = mi_prt.PointLight(position=[1.5, -1.0, 2.0], intensity=[8, 6, 4])  # W/sr
print("sky, sun and lamp:", asset.irradiance([light, sun, lamp]).mean(axis=0))

# Turning light: prepared once, then milliseconds for each angle.
prepared = asset.prepare_light(light)
for degrees in (0, 90, 180, 270):
    print(degrees, "degrees:", asset.irradiance(prepared.rotated("z", degrees)).mean(axis=0))
