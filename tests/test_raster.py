"""Raster images: they show what the integrator `prt` shows, and what closed forms say.

Most tests set the irradiance at the points by hand, so they need no transport: points stand in for
an asset.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import diffuse, disk, emitted, rectangle, scene, sky_of, sphere

import mi_prt
from mi_prt.errors import SceneError, SettingsError
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.points.points import sample_points
from mi_prt.render.display import display, exposure
from mi_prt.render.image import render_image, resized
from mi_prt.render.raster import RasterScene, render_raster
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

SCENES = Path(__file__).resolve().parents[1] / "scenes"


def film(width=48, height=36, **rest):
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **rest}


def camera(origin=(0, 4, 0.1), target=(0, 0, 0), kind="perspective", film=film(), **rest):
    look = (
        mitsuba()
        .ScalarTransform4f()
        .look_at(origin=list(origin), target=list(target), up=[0, 0, -1])
    )
    if kind == "orthographic":
        look = look @ mitsuba().ScalarTransform4f().scale([1.1, 1.1, 1])
    return {"type": kind, "to_world": look, "film": film, **rest}


def opened(edge_length=0.25, sensor=None, **parts):
    """A scene with one sensor, its points as a stand-in for an asset, and the sensor."""
    opened = open_scene(scene(sensor=sensor or camera(), **parts))
    points = sample_points(opened, edge_length)
    lit = np.full((len(points), 3), np.pi, np.float32)
    asset = SimpleNamespace(
        points=points, buried=points.buried, irradiance=lambda light=None: lit, path=None
    )
    return opened, asset, opened.mi_scene.sensors()[0]


def linear(asset, opened, sensor, irradiance, samples=2):
    with RasterScene(asset, opened, sensor, samples) as raster:
        return raster.radiance(irradiance)


def hits(opened, sensor):
    """Mitsuba's intersections along the rays through the pixels' centres, in the order of the
    pixels.
    """
    mi = mitsuba()
    width, height = sensor.film().crop_size()
    row, column = np.indices((height, width)).reshape(2, -1)
    image = np.stack([(column + 0.5) / width, (row + 0.5) / height]).astype(np.float32)
    ray = sensor.sample_ray(0.0, 0.5, mi.Point2f(image), mi.Point2f(0.5))[0]
    return opened.mi_scene.ray_intersect(ray), np.array(ray.d).T


# --- against the integrator -----------------------------------------------------------------------


def inside_surfaces(opened, sensor):
    """Pixels (h, w) with no outline or crease in their 3x3 neighbourhood: one shape, and normals
    within 15 degrees.

    Shapes and normals are compared at the corners of the pixels, of which a neighbourhood has 4x4.
    """
    import drjit as dr

    mi = mitsuba()
    width, height = sensor.film().crop_size()
    row, column = np.indices((height + 3, width + 3)).reshape(2, -1) - 1.0
    image = mi.Point2f(np.stack([column / width, row / height]).astype(np.float32))
    si = opened.mi_scene.ray_intersect(sensor.sample_ray(0.0, 0.5, image, mi.Point2f(0.5))[0])
    shape = np.stack(
        [np.array(dr.reinterpret_array(mi.UInt32, x)) for x in (si.shape, si.instance)], axis=-1
    )
    shape = shape.reshape(height + 3, width + 3, 2)
    normal = np.array(si.n).T.reshape(height + 3, width + 3, 3)
    corners = [(slice(i, i + height), slice(j, j + width)) for i in range(4) for j in range(4)]
    same = np.all([(shape[c] == shape[:height, :width]).all(axis=-1) for c in corners], axis=0)
    spread = np.ptp([normal[c] for c in corners], axis=0).max(axis=-1)
    return same & (spread < np.sin(np.radians(15)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, mean, high", [("still_life", 0.004, 0.04), ("teapot", 0.0003, 0.004)]
)
def test_agrees_with_the_integrator(name, mean, high):
    """Outside outlines the two images are the same, in display values 0…1.

    Rationale: both interpolate the same irradiance on the same triangles, one in hardware, one in
    closed form. The teapot has no textures, so only rounding and the shading across a pixel's four
    samples are left (below 1/255 at the 99th percentile). In the still life, planks and checks have
    edges that cross pixels: a pixel of contrast 0.5 has a standard error of 0.25/√64 = 0.03 in the
    integrator's image and steps of a quarter in the raster's. Those errors have no sign, so the
    bias stays small. Measured: mean 0.0021 and 0.00014, 99th percentile 0.028 and 0.0015.
    """
    opened = open_scene(SCENES / f"{name}.xml")
    asset = mi_prt.precompute(
        opened, directions="cubemap:16", coefficients=32, bounces=0
    )  # any irradiance will do
    irradiance = asset.irradiance(scene_light(opened))
    factor = exposure(asset.outgoing_radiance(irradiance))
    with resized(opened.mi_scene.sensors()[0], (320, 240)) as sensor:
        raster = render_raster(asset, opened, irradiance, sensor, factor)
        reference = display(render_image(asset, opened.mi_scene, sensor, spp=64), factor)
        inside = inside_surfaces(opened, sensor)
    error = np.abs(raster - reference).max(axis=-1)
    assert raster.dtype == np.float32 and raster.shape == (240, 320, 3)
    assert inside.mean() > 0.8
    print(
        f"{name}: mean {error[inside].mean():.5f}, 99th percentile"
        f" {np.quantile(error[inside], 0.99):.5f}"
    )
    assert error[inside].mean() < mean
    assert np.quantile(error[inside], 0.99) < high
    assert abs((raster - reference)[inside].mean()) < mean / 5
    assert error.mean() < 0.006  # outlines included


def two_sided(front, back):
    return {"type": "twosided", "front": diffuse(front), "back": diffuse(back)}


def test_agrees_with_the_integrator_on_lights_textures_and_either_side():
    """Area lights, a rotated bitmap, its seam on a sphere, flipped normals, both sides of a disk,
    and one-sided backs.

    Set-up: all points have irradiance π, so radiance is albedo; one sample per pixel, compared with
    what Mitsuba's own emitters and materials give at the pixel's centre. Expectation: the same up
    to half precision (2⁻¹¹) away from textures; where the bitmap has a kink (twice in 3 pixels
    here), the texture's filter, half a pixel wide, rounds it: up to an eighth of the change in
    slope there, 0.03. Single pixels on outlines may fall on the other side. Measured: 98.9 % within
    0.03, mean 0.002.
    """
    mi = mitsuba()
    texels = np.random.default_rng(3).uniform(0, 1, (6, 9, 3)).astype(np.float32)
    turned = mi.ScalarTransform3f().rotate(30).scale(1.5)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "to_uv": turned}
    textured = {"type": "twosided", "side": {"type": "diffuse", "reflectance": bitmap}}
    radiance = {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 0.5]}}
    scene, asset, sensor = opened(
        0.05,
        sensor=camera((0.3, 5, 1), film=film(160, 120), fov=45),
        sky={"type": "constant", "radiance": 0.2},
        painted=rectangle(position=(-1.2, 0, -0.8), size=0.6, bsdf=textured),
        ball=sphere((1.2, 0.1, -0.8), 0.7, bsdf=textured),
        lamp=disk((0.2, 1, 0), (-1.2, 0, 0.9), 0.5, emitter=radiance, bsdf=diffuse(0.3)),
        dark_lamp=disk((0, -1, 0), (0, 0, 0.9), 0.4, emitter=radiance, bsdf=diffuse(0.3)),
        back=disk((0, -1, 0), (0, 0, -0.8), 0.4, bsdf=two_sided([0.9, 0.1, 0.1], [0.1, 0.2, 0.9])),
        flipped=disk((0, -1, 0), (1.2, 0, 0.9), 0.5, flip_normals=True, bsdf=diffuse(0.6)),
    )
    irradiance = asset.irradiance(None)
    raster = linear(asset, scene, sensor, irradiance, samples=1).reshape(-1, 3)
    si, _ = hits(scene, sensor)
    expected = np.array(si.emitter(scene.mi_scene).eval(si)).T
    lit = np.array(si.wi.z > 0) | np.array(mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide))
    albedo = np.array(si.bsdf().eval_diffuse_reflectance(si)).T
    expected += np.where((np.array(si.is_valid()) & lit)[:, None], albedo, 0)
    error = np.abs(raster - expected).max(axis=1)
    # Of black backs and of light there must be some to see.
    assert (expected.max(axis=1) == 0).sum() > 100 and (expected[:, 0] > 3).sum() > 100
    assert np.mean(error < 0.03) > 0.98
    assert error.mean() < 0.004
    whole = render_image(asset, scene.mi_scene, sensor, spp=16, irradiance=irradiance)
    assert np.abs(linear(asset, scene, sensor, irradiance) - whole).mean() < 0.02


@pytest.mark.parametrize("reverse", [False, True])
def test_side_is_that_of_the_shading_normal(reverse, tmp_path):
    """A one-sided quad whose winding disagrees with its normals is lit on the side of its normals,
    as in Mitsuba.
    """
    mi = mitsuba()
    mesh = mi.Mesh("quad", 4, 2, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.array(
        [[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32
    ).ravel()
    parameters["faces"] = np.array([0, 1, 2, 0, 2, 3] if reverse else [0, 2, 1, 0, 3, 2], np.uint32)
    parameters["vertex_normals"] = np.tile(np.float32([0, 1, 0]), 4)
    parameters.update()
    mesh.write_ply(str(tmp_path / "quad.ply"))
    quad = {"type": "ply", "filename": str(tmp_path / "quad.ply"), "bsdf": diffuse(0.5)}
    for height, expected in ((4, 0.5), (-4, 0.0)):
        scene, asset, sensor = opened(sensor=camera((0, height, 0.1), fov=20), quad=quad)
        assert linear(asset, scene, sensor, asset.irradiance(None)) == pytest.approx(
            expected, abs=1e-6
        )


# --- closed forms ---------------------------------------------------------------------------------

SENSORS = {
    "perspective": {"fov": 40},
    "shifted": {
        "fov": 50,
        "fov_axis": "y",
        "principal_point_offset_x": 0.2,
        "principal_point_offset_y": -0.1,
    },
    "cropped": {
        "film": film(64, 48, crop_width=30, crop_height=20, crop_offset_x=20, crop_offset_y=5)
    },
    "orthographic": {"kind": "orthographic"},
    "thinlens": {"kind": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.0},
}


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_sees_a_linear_field_exactly(name):
    """Irradiance that is linear in position is reproduced by linear interpolation, at each pixel's
    own hit.

    Set-up: a floor and a tilted plate above it, whose irradiance is e(x) = 4 + (x, y, z).
    Expectation: radiance is 0.5/π · e at Mitsuba's hit, to single precision (2e-5 relative), but at
    the few pixels that an edge crosses within rounding. A projection wrong by a hundredth of a
    pixel gives errors of 3e-4.
    """
    options = SENSORS[name]
    scene, asset, sensor = opened(
        sensor=camera((0.5, 4, 1.2), (0.1, 0, 0.1), **options),
        floor=rectangle(size=20, bsdf=diffuse()),
        plate=rectangle((0.3, 1, 0.2), (0.2, 0.5, 0), 0.4, bsdf=diffuse()),
    )
    irradiance = 4 + asset.points.positions
    if name == "thinlens":
        with pytest.warns(UserWarning, match="pinhole"):
            seen = linear(asset, scene, sensor, irradiance, samples=1)
    else:
        seen = linear(asset, scene, sensor, irradiance, samples=1)
    width, height = sensor.film().crop_size()
    assert seen.shape == (height, width, 3)
    si, _ = hits(scene, sensor)
    expected = 0.5 / np.pi * (4 + np.array(si.p).T)
    error = np.abs(seen.reshape(-1, 3) / expected - 1).max(axis=1)
    assert np.quantile(error, 0.995) < 2e-5


def test_background_is_the_environment():
    """Uncovered pixels show what Mitsuba's emitter gives along the sensor's rays; a pixel is the
    mean of its samples.

    With one sample the ray goes through the pixel's centre, so both are the same number up to the
    single precision of the direction, times a gradient of the sky of at most 3 per radian. Without
    environment the background is black.
    """
    sky = sky_of(
        lambda d: np.stack([2 + d[:, 0], 1 + 0.5 * np.sin(3 * d[:, 1]), 1.5 - d[:, 2]], axis=-1)
    )
    envmap = {"type": "envmap", "bitmap": mitsuba().Bitmap(sky)}
    ball = sphere(radius=0.3, bsdf=diffuse(0.0))
    scene, asset, sensor = opened(sensor=camera((0, 2, 3)), sky=envmap, ball=ball)
    black = np.zeros_like(asset.points.positions)
    si, directions = hits(scene, sensor)
    away = ~np.array(si.is_valid())
    assert 0.5 < away.mean() < 0.98
    one = linear(asset, scene, sensor, black, samples=1).reshape(-1, 3)
    expected = emitted(scene.mi_scene.environment(), directions)
    np.testing.assert_allclose(one[away], expected[away], atol=2e-5)
    assert np.mean(one[~away] == 0) > 0.9  # pixels on the ball; it is a polygon
    np.testing.assert_allclose(
        linear(asset, scene, sensor, black, samples=3).mean(), one.mean(), rtol=0.02
    )

    bare, asset, sensor = opened(sensor=camera((0, 2, 3)), ball=ball)
    assert not linear(asset, bare, sensor, black).any()
    with RasterScene(asset, bare, sensor, samples=1) as raster:
        other = raster.radiance(black, background=scene.mi_scene).reshape(-1, 3)
    np.testing.assert_array_equal(other, one)


@pytest.mark.parametrize("height, expected", [(4, [0.2, 0.4, 0.6]), (-4, [0.5, 0.3, 0.1])])
def test_each_side_has_its_own_light_and_albedo(height, expected):
    """A two-sided plane fills the view; its front's irradiance is π, its back's 2π, so radiance is
    ρ and 2ρ.
    """
    plane = rectangle(size=9, bsdf=two_sided([0.2, 0.4, 0.6], [0.25, 0.15, 0.05]))
    scene, asset, sensor = opened(sensor=camera((0, height, 0.1)), plane=plane)
    is_back = asset.points.normals[:, 1] < 0
    assert is_back.sum() == len(is_back) / 2
    irradiance = np.where(is_back[:, None], 2 * np.pi, np.pi) * np.ones(3)
    seen = linear(asset, scene, sensor, irradiance)
    np.testing.assert_allclose(seen, np.broadcast_to(expected, seen.shape), rtol=1e-5)


def test_curved_shapes_have_no_dark_rims():
    """Albedo ½, irradiance π and a sky of ½ make every pixel ½, as in a furnace.

    The triangles that stand for a ball or tube are seen at its outline where the ball's own normals
    look away. A coarse lattice makes these rims wide.
    """
    tube = {
        "type": "cylinder",
        "p0": [-1, 0, 0.7],
        "p1": [1, 0, 0.7],
        "radius": 0.3,
        "bsdf": diffuse(),
    }
    plate = disk((1, 0.2, 0), (0.9, 0, -0.3), 0.4, bsdf=two_sided(0.5, 0.5))
    ball = sphere((-0.2, 0, -0.3), 0.6, bsdf=diffuse())
    scene, asset, sensor = opened(
        0.5, ball=ball, tube=tube, plate=plate, sky={"type": "constant", "radiance": 0.5}
    )
    np.testing.assert_allclose(linear(asset, scene, sensor, asset.irradiance(None)), 0.5, rtol=1e-5)


def test_black_back_hides_what_is_behind():
    """Seen from behind, a one-sided plane is black; it is no hole."""
    plane = rectangle(size=9, bsdf=diffuse())
    scene, asset, sensor = opened(
        sensor=camera((0, -4, 0.1)),
        plane=plane,
        ball=sphere((0, 2, 0), bsdf=diffuse()),
        sky={"type": "constant"},
    )
    assert not linear(asset, scene, sensor, asset.irradiance(None)).any()


def test_buried_points_give_their_share_to_the_others():
    """Buried corners drop out of interpolation; where all corners are buried, they count as they
    are.

    Set-up: on a floor, points at x < 0 are buried and have irradiance 0, the others 1; the lattice
    has a column of points at x = 0 or on either side. Expectation: a triangle with at least one
    corner at x ≥ 0 shows 1 all over, the others 0: nothing in between, but for the weight 1e-5 of
    buried points, which matters in a sliver at the seam.
    """
    scene, asset, sensor = opened(
        sensor=camera((0, 4, 0.1), fov=20), floor=rectangle(size=1, bsdf=diffuse(1.0))
    )
    x = asset.points.positions[:, 0]
    asset.points = replace(asset.points, buried=x < 0)
    asset.buried = asset.points.buried
    irradiance = np.pi * np.where(asset.buried, 0.0, 1.0)[:, None] * np.ones(3)
    seen = linear(asset, scene, sensor, irradiance, samples=1)[..., 0]
    between = (seen > 1e-3) & (seen < 0.999)
    assert between.mean() < 0.01
    assert 0.5 < (seen >= 0.999).mean() < 0.75  # half the floor and one column of triangles
    scene_lit, _, sensor_lit = opened(
        sensor=camera((0, 4, 0.1), fov=20),
        floor=rectangle(size=1, bsdf=diffuse(1.0)),
        sky={"type": "constant"},
    )
    reference = render_image(asset, scene_lit.mi_scene, sensor_lit, spp=4, irradiance=irradiance)[
        ..., 0
    ]
    assert np.abs(seen - reference).mean() < 0.01


def test_draws_again_under_other_light():
    """One scene drawn three times: linear in irradiance, and back to the first image, bit for
    bit.
    """
    scene, asset, sensor = opened(
        floor=rectangle(size=1, bsdf=diffuse()), ball=sphere(radius=0.4, bsdf=diffuse(0.3))
    )
    irradiance = (
        np.random.default_rng(1).uniform(0, 2, asset.points.positions.shape).astype(np.float32)
    )
    with RasterScene(asset, scene, sensor) as raster:
        first, double, again = (raster.radiance(f * irradiance) for f in (1, 2, 1))
        shown = raster.draw(irradiance, 0.7)
    np.testing.assert_allclose(double, 2 * first, rtol=1e-5)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(shown, display(first, 0.7))


def test_far_surfaces_do_not_fight():
    """A sheet 2 mm above a floor is seen everywhere from 30 m away, with a near plane at 1 cm and a
    far one at 10 km.
    """
    scene, asset, sensor = opened(
        edge_length=5.0,
        sensor=camera((0, 30, 1), near_clip=0.01, far_clip=1e4, fov=20),
        floor=rectangle(size=20, bsdf=diffuse(0.1)),
        sheet=rectangle(position=(0, 0.002, 0), size=20, bsdf=diffuse(0.9)),
    )
    np.testing.assert_allclose(linear(asset, scene, sensor, asset.irradiance(None)), 0.9, rtol=1e-5)


# --- refusals and platforms -----------------------------------------------------------------------


def test_errors_name_what_is_supported():
    scene, asset, sensor = opened(floor=rectangle(bsdf=diffuse()))
    lit = asset.irradiance(None)
    fluxmeter = open_scene(
        {"type": "scene", "floor": rectangle(sensor={"type": "irradiancemeter", "film": film()})}
    )
    with pytest.raises(SettingsError, match="perspective, thinlens, orthographic"):
        render_raster(asset, scene, lit, fluxmeter.mi_scene.sensors()[0], 1.0)
    with pytest.raises(SettingsError, match=r"shape \(\d+, 3\)"):
        render_raster(asset, scene, lit[:-1], sensor, 1.0)
    with pytest.raises(SettingsError, match="samples"):
        render_raster(asset, scene, lit, sensor, 1.0, samples=0)
    with resized(sensor, (20_000, 4)), pytest.raises(SettingsError, match="limit"):
        render_raster(asset, scene, lit, sensor, 1.0)
    other, _, _ = opened(ball=sphere(bsdf=diffuse()))
    with pytest.raises(SceneError, match="shapes"):
        render_raster(asset, other, lit, sensor, 1.0)


PROGRAM = """
import sys, numpy as np
from test_raster import diffuse, linear, opened, rectangle, sphere
scene, asset, sensor = opened(
    floor=rectangle(bsdf=diffuse([0.2, 0.5, 0.8])),
    ball=sphere(radius=0.5, bsdf=diffuse()),
    sky={"type": "constant"},
)
np.save(sys.argv[1], linear(asset, scene, sensor, asset.irradiance(None)))
"""


@pytest.mark.parametrize("platform", ["osmesa", "egl"])
def test_platforms_draw_the_same(platform, tmp_path):
    """A process of its own for each platform, because it cannot be changed once OpenGL is loaded.

    Coverage and interpolation follow one specification, but rounding is each driver's own: single
    samples on outlines may fall on the other side.
    """
    tests = Path(__file__).parent
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "image.npy")],
        env=os.environ
        | {
            "PYOPENGL_PLATFORM": platform,
            "PYTHONPATH": os.pathsep.join([str(tests), str(tests.parent)]),
        },
        capture_output=True,
        text=True,
        timeout=120,
    )
    if "RuntimeSetupError" in result.stderr:
        pytest.skip(result.stderr.strip().splitlines()[-1])
    assert result.returncode == 0, result.stderr
    scene, asset, sensor = opened(
        floor=rectangle(bsdf=diffuse([0.2, 0.5, 0.8])),
        ball=sphere(radius=0.5, bsdf=diffuse()),
        sky={"type": "constant"},
    )
    difference = np.abs(
        np.load(tmp_path / "image.npy") - linear(asset, scene, sensor, asset.irradiance(None))
    ).max(axis=-1)
    assert np.mean(difference > 1e-5) < 0.01
