"""Splats: what they show is a weighted mean of samples at what Mitsuba hits, and nothing of what it
does not hit.

Points on a lattice stand in for the samples of an asset, and irradiance is set by hand.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import cube, diffuse, disk, emitted, matrix_transform, mesh, rectangle, sky_of, sphere
from test_raster import SENSORS, camera, film, hits, opened, two_sided

from mi_prt.errors import SettingsError
from mi_prt.render.display import display
from mi_prt.render.image import resized
from mi_prt.render.raster import RasterScene
from mi_prt.render.splats import SplatScene
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import count_kernels, mitsuba

SPACING = 0.1


def splatted(points, irradiance, scene, sensor, samples=1, radius=2 * SPACING):
    with SplatScene(
        points.positions, points.normals, np.full(len(points), radius), scene, sensor, samples
    ) as splats:
        return splats.radiance(irradiance)


def surroundings(spacing=SPACING, **parts):
    """As `opened`, but the points and not an asset."""
    scene, asset, sensor = opened(spacing, **parts)
    return scene, asset.points, sensor


def uniform(points, value=np.pi):
    return np.full((len(points), 3), value, np.float32)


def weighted_mean(values, points, radius, places, normals):
    """Values (k, 3) at places (k, 3) by the formula in the manual of SplatScene, written anew in
    NumPy.
    """
    result = np.zeros((len(places), 3))
    for k, (place, normal) in enumerate(zip(places, normals)):
        q = place - points.positions
        d2 = (q**2).sum(axis=1) + 15 * (q * points.normals).sum(axis=1) ** 2
        weight = (
            np.exp(-4.5 * d2 / radius**2)
            * np.maximum(points.normals @ normal, 0) ** 8
            * (d2 < radius**2)
        )
        result[k] = weight @ values / weight.sum()
    return result


# --- where light is shown -------------------------------------------------------------------------


@pytest.mark.parametrize("name", SENSORS)
def test_shows_the_weighted_mean_at_each_pixels_hit(name):
    """A sample is 0.5/π times the weighted mean of the splats' irradiance at Mitsuba's own hit, on
    flat and curved shapes.

    Expectation: equal to rounding, but at the few hits that lie so near a splat's edge that
    rounding decides whether it counts. There it weighs e^-4.5, so that is below 1 % of the
    irradiance's variation among neighbours. On the ball, splats that stick out of it lose a part
    near their edges where they are seen at a slant: some percent of that variation along the
    outline.
    """
    scene, points, sensor = surroundings(
        sensor=camera((0.5, 4, 1.2), (0.1, 0, 0.1), **SENSORS[name]),
        floor=rectangle(size=2, bsdf=diffuse()),
        plate=rectangle((0.3, 1, 0.2), (0.2, 0.7, 0), 0.4, bsdf=diffuse()),
        ball=sphere((-0.5, 0.4, 0.3), 0.3, bsdf=diffuse()),
    )
    irradiance = np.random.default_rng(0).uniform(1, 2, (len(points), 3)).astype(np.float32)
    if name == "thinlens":
        with pytest.warns(UserWarning, match="pinhole"):
            seen = splatted(points, irradiance, scene, sensor)
    else:
        seen = splatted(points, irradiance, scene, sensor)
    width, height = sensor.film().crop_size()
    assert seen.shape == (height, width, 3) and seen.dtype == np.float32
    si, _ = hits(scene, sensor)
    hit = np.array(si.is_valid())
    assert hit.mean() > 0.5
    normals = np.array(si.sh_frame.n).T[hit]
    expected = (
        0.5 / np.pi * weighted_mean(irradiance, points, 2 * SPACING, np.array(si.p).T[hit], normals)
    )
    error = np.abs(seen.reshape(-1, 3)[hit] / expected - 1).max(axis=1)
    ball = np.array(si.shape == mitsuba().ShapePtr(scene.surfaces[2].shape))[hit]
    assert np.quantile(error[~ball], 0.99) < 2e-5
    assert error[~ball].max() < 0.01
    assert np.median(error[ball]) < 5e-4
    assert error[ball].mean() < 0.005
    assert error.max() < 0.05
    assert not seen.reshape(-1, 3)[~hit].any()


def test_a_smooth_function_is_shown_as_it_is():
    """The mean over a splat's Gaussian of σ = 2/3 of the spacing blurs waves of length λ by 1 −
    exp(−2π²σ²/λ²).

    Set-up: waves of 12 spacings on a floor with jittered samples: a cell of a grid has one sample
    anywhere in it, so that they are rougher than blue noise. Expectation: the blur, 6 % of the
    amplitude, and the noise of where the samples lie, which is as much again. A lattice shows the
    blur alone.
    """
    rng = np.random.default_rng(1)
    scene, points, sensor = surroundings(
        sensor=camera((0.8, 2, 1), fov=40), floor=rectangle(size=2, bsdf=diffuse(1.0))
    )
    si, _ = hits(scene, sensor)

    def wave(x):
        return 1 + np.sin(2 * np.pi * x[:, [0]] / (12 * SPACING)) * [1, 0.5, 0.2]

    blur = 1 - np.exp(-2 * (np.pi * 2 / 3 / 12) ** 2)
    for jitter, blurred, most in ((0, blur, 0.01), (SPACING / 2, blur, 0.1)):
        moved = points.positions + rng.uniform(-jitter, jitter, points.positions.shape) * [1, 0, 1]
        radii = np.full(len(points), 2 * SPACING)
        with SplatScene(moved, points.normals, radii, scene, sensor, 1) as splats:
            shown = np.pi * splats.radiance(wave(moved)).reshape(-1, 3)
        expected = 1 + (1 - blurred) * (wave(np.array(si.p).T) - 1)
        error = (shown - expected)[:, 0]
        assert np.sqrt((error**2).mean()) < most
        assert abs(error.mean()) < most / 5


@pytest.mark.parametrize("samples", [1, 3])
def test_constant_light_stays_constant(samples):
    """Albedo ½, irradiance π and a sky of ½ make every pixel ½, as in a furnace, outlines and
    creases included.
    """
    tube = {
        "type": "cylinder",
        "p0": [-1, 0, 0.7],
        "p1": [1, 0, 0.7],
        "radius": 0.3,
        "bsdf": two_sided(0.5, 0.5),
    }
    plate = disk((1, 0.2, 0), (0.9, 0, -0.3), 0.4, bsdf=two_sided(0.5, 0.5))
    box = cube((-0.2, 0, -0.3), 0.4, bsdf=diffuse())
    ball = sphere((0.4, 0.2, 0.1), 0.3, bsdf=diffuse())
    sky = {"type": "constant", "radiance": 0.5}
    scene, points, sensor = surroundings(box=box, ball=ball, tube=tube, plate=plate, sky=sky)
    np.testing.assert_allclose(
        splatted(points, uniform(points), scene, sensor, samples), 0.5, rtol=1e-5
    )


def test_from_within_a_room():
    """Splats all around the viewer, some across the plane of the eye, and the nearest one at a
    thousandth of its radius.
    """
    near = film(64, 48)
    for origin in ((0.3, 0.2, 0.1), (0.0, -0.9998, 0.3)):
        sensor = camera(origin, (1, -1, 0.9), film=near, fov=100, near_clip=1e-4)
        room = cube(bsdf=diffuse(), flip_normals=True)
        scene, points, sensor = surroundings(sensor=sensor, room=room)
        np.testing.assert_allclose(splatted(points, uniform(points), scene, sensor), 0.5, rtol=1e-5)


def test_far_planes_and_large_scenes():
    """The same image in metres and in thousandths of them, with a near plane at 1e-2 and a far one
    at 1e4 or 1e7 of it.
    """
    images = []
    for scale in (1.0, 1000.0):
        scene, points, sensor = surroundings(
            spacing=0.2 * scale,
            sensor=camera((0, 30 * scale, scale), near_clip=0.01, far_clip=1e4 * scale, fov=8),
            floor=rectangle(size=2 * scale, bsdf=diffuse()),
            plate=rectangle(position=(0, 0.4 * scale, 0), size=scale, bsdf=diffuse()),
        )
        irradiance = np.repeat(3 + points.positions[:, :1] / scale, 3, axis=1)
        images.append(splatted(points, irradiance, scene, sensor, radius=0.4 * scale))
    assert (images[0] > 0).mean() > 0.5
    np.testing.assert_allclose(images[0], images[1], rtol=2e-3)


@pytest.mark.parametrize("tilt", [0, 1])
def test_something_right_in_front_of_the_lens(tilt):
    """A disk a twentieth of a unit away takes no light from a floor at 30,000, though depth has 24
    binary digits.
    """
    scene, points, sensor = surroundings(
        spacing=500,
        sensor=camera((0, 0, 0), (0, -1, 0), near_clip=0.01, far_clip=1e6, fov=20),
        floor=rectangle((tilt, 1, 0), (0, -3e4, 0), 1.5e4, bsdf=diffuse()),
        disk=disk(position=(0, -0.05, 0), size=0.002, bsdf=diffuse()),
    )
    seen = splatted(points, uniform(points), scene, sensor, radius=1e3)[..., 0].ravel()
    on_floor = np.array(hits(scene, sensor)[0].shape == mitsuba().ShapePtr(scene.surfaces[0].shape))
    assert 0.5 < on_floor.mean() < 1
    np.testing.assert_allclose(seen[on_floor], 0.5, rtol=1e-5)


# --- where none is shown --------------------------------------------------------------------------


def test_outlines_are_those_of_the_scene():
    """Lit are exactly the pixels whose ray hits the lit shape first, however far its splats reach
    beyond it.
    """
    scene, points, sensor = surroundings(
        floor=rectangle(size=2, bsdf=diffuse()),
        ball=sphere((0, 0.6, 0), 0.3, bsdf=diffuse()),
        plate=rectangle((1, 1, 0), (0.1, 1.2, 0.2), 0.15, bsdf=diffuse()),
    )
    si, _ = hits(scene, sensor)
    first = np.full(len(si.p[0]), -1)
    for i, surface in enumerate(scene.surfaces):
        first[np.array(si.shape == mitsuba().ShapePtr(surface.shape))] = i
    for i in range(3):
        irradiance = np.where((points.surface == i)[:, None], uniform(points), 0)
        seen = splatted(points, irradiance, scene, sensor, radius=0.4).reshape(-1, 3)
        np.testing.assert_array_equal(seen.any(axis=1), first == i)


@pytest.mark.parametrize("height, expected", [(4, [0.2, 0.4, 0.6]), (-4, [0.5, 0.3, 0.1])])
def test_each_side_has_its_own_light_and_albedo(height, expected):
    """A two-sided plane fills the view; its front's irradiance is π, its back's 2π, so radiance is
    ρ and 2ρ.
    """
    plane = rectangle(size=9, bsdf=two_sided([0.2, 0.4, 0.6], [0.25, 0.15, 0.05]))
    scene, points, sensor = surroundings(spacing=1.0, sensor=camera((0, height, 0.1)), plane=plane)
    irradiance = uniform(points) * np.where(points.normals[:, 1:2] < 0, 2, 1)
    seen = splatted(points, irradiance, scene, sensor, radius=2)
    np.testing.assert_allclose(seen, np.broadcast_to(expected, seen.shape), rtol=1e-5)


def test_black_back_hides_what_is_behind():
    """Seen from behind, a one-sided plane is black; it is no hole."""
    plane = rectangle(size=9, bsdf=diffuse())
    ball = sphere((0, 2, 0), bsdf=diffuse())
    sky = {"type": "constant"}
    scene, points, sensor = surroundings(
        spacing=0.5, sensor=camera((0, -4, 0.1)), plane=plane, ball=ball, sky=sky
    )
    assert not splatted(points, uniform(points), scene, sensor, radius=1).any()


def test_no_leak_round_corners_and_through_thin_walls():
    """A dark wall on a bright floor, a dark sheet of 0.26 radii above it, and the dark side of a
    bright sheet: black all over.

    Walls meet the floor at right angles, where n·n' is 0; and a splat reaches a quarter of its
    radius off its plane.
    """
    radius = 2 * SPACING
    scene, points, sensor = surroundings(
        sensor=camera((0, 3, 3), (0, 0.3, 0), film=film(160, 120), fov=50),
        floor=rectangle(size=1, bsdf=diffuse()),
        wall=rectangle((0, 0, 1), (0, 0.5, -0.5), 0.5, bsdf=two_sided(0.5, 0.5)),
        sheet=rectangle((0, 1, 0), (0.4, 0.26 * radius, 0.4), 0.3, bsdf=two_sided(0.5, 0.5)),
    )
    # floor, and hidden sides
    bright = (points.surface == 0) | (points.normals[:, 1] < -0.9) | (points.normals[:, 2] < -0.9)
    seen = splatted(points, np.where(bright[:, None], uniform(points), 0), scene, sensor).reshape(
        -1, 3
    )
    si, _ = hits(scene, sensor)
    floor = np.array(si.shape == mitsuba().ShapePtr(scene.surfaces[0].shape))
    dark = np.array(si.is_valid()) & ~floor
    assert dark.sum() > 1000 and floor.sum() > 1000
    assert not seen[dark].any()
    # what the sheet above takes from the floor is as little
    edge = np.abs(seen[floor] - 0.5).max(axis=1) > 1e-5
    assert not edge.any()


def test_where_no_splat_reaches_it_is_black():
    """A floor with samples in one half of it only: the other is black beyond a splat's radius, and
    hides the sky.
    """
    scene, points, sensor = surroundings(
        sky={"type": "constant"}, floor=rectangle(size=1, bsdf=diffuse())
    )
    half = points.positions[:, 0] < 0
    radii = np.full(half.sum(), 2 * SPACING)
    with SplatScene(
        points.positions[half], points.normals[half], radii, scene, sensor, 1
    ) as splats:
        seen = splats.radiance(np.full((half.sum(), 3), np.pi))[..., 0].ravel()
    si, _ = hits(scene, sensor)
    x, hit = np.array(si.p[0]), np.array(si.is_valid())
    np.testing.assert_allclose(seen[hit & (x < -SPACING)], 0.5, rtol=1e-5)
    assert not seen[hit & (x > 2 * SPACING)].any()
    np.testing.assert_array_equal(seen[~hit], 1)


# --- what is not in the splats --------------------------------------------------------------------


def test_textures_lamps_and_sky_are_as_fine_as_the_image():
    """Under constant irradiance π a pixel is the albedo at its centre's hit, or what an emitter
    sends along the ray.

    Checks of 0.02 m are far below the samples' spacing. Expectation: Mitsuba's own values at the
    same rays, to rounding.
    """
    transform = mitsuba().ScalarTransform4f
    checks = {
        "type": "checkerboard",
        "color0": 0.2,
        "color1": 0.7,
        "to_uv": transform().scale([100, 100, 1]),
    }
    sky = sky_of(
        lambda d: np.stack([2 + d[:, 0], 1 + 0.5 * np.sin(3 * d[:, 1]), 1.5 - d[:, 2]], axis=-1)
    )
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [7, 6, 5]}}
    scene, points, sensor = surroundings(
        sensor=camera((0, 3, 0.8), film=film(96, 72)),
        sky={"type": "envmap", "bitmap": mitsuba().Bitmap(sky)},
        floor=rectangle(size=1, bsdf={"type": "diffuse", "reflectance": checks}),
        lamp=rectangle(position=(0, 0.3, 0), size=0.2, bsdf=diffuse(0.0), emitter=lamp),
    )
    seen = splatted(points, uniform(points), scene, sensor).reshape(-1, 3)
    si, directions = hits(scene, sensor)
    hit, shining = np.array(si.is_valid()), np.array(si.shape.is_emitter())
    si.wi = mitsuba().Vector3f(0, 0, 1)
    albedo = np.array(mitsuba().Color3f(si.bsdf().eval_diffuse_reflectance(si))).T
    on_floor = hit & ~shining
    assert on_floor.sum() > 1000 and shining.sum() > 100 and (~hit).sum() > 100
    np.testing.assert_allclose(seen[on_floor], albedo[on_floor], rtol=1e-5)
    np.testing.assert_allclose(
        seen[shining], np.broadcast_to([7, 6, 5], seen[shining].shape), rtol=1e-6
    )
    np.testing.assert_allclose(
        seen[~hit], emitted(scene.mi_scene.environment(), directions)[~hit], atol=2e-5
    )


def test_smooth_normals_and_instances():
    """A coarse ball of smooth normals and a moved instance of another: constant light stays
    constant on both.
    """
    around = np.linspace(0, 2 * np.pi, 13)[:-1]
    ring = [
        [np.cos(a) * np.sin(t), np.cos(t), np.sin(a) * np.sin(t)]
        for t in np.radians([30, 60, 90, 120, 150])
        for a in around
    ]
    vertices = np.array([[0, 1, 0], *ring, [0, -1, 0]])
    faces = [[0, 1 + (i + 1) % 12, 1 + i] for i in range(12)] + [
        [61, 49 + i, 49 + (i + 1) % 12] for i in range(12)
    ]
    for row in range(4):
        for i in range(12):
            a, b = 1 + 12 * row + i, 1 + 12 * row + (i + 1) % 12
            faces += [[a, b, b + 12], [a, b + 12, a + 12]]
    turn = matrix_transform(np.eye(3)) @ mitsuba().ScalarTransform4f().translate([0.6, 0, 0])
    scene, points, sensor = surroundings(
        ball=mesh(0.5 * vertices - [0.6, 0, 0], np.array(faces), vertices, diffuse()),
        group={"type": "shapegroup", "ball": sphere(radius=0.5, bsdf=diffuse())},
        placed={"type": "instance", "to_world": turn, "group": {"type": "ref", "id": "group"}},
    )
    seen = splatted(points, uniform(points), scene, sensor).reshape(-1, 3)
    hit = np.array(hits(scene, sensor)[0].is_valid())
    assert 0.1 < hit.mean() < 0.9
    np.testing.assert_allclose(seen[hit], 0.5, rtol=1e-5)
    assert not seen[~hit].any()


# --- use ------------------------------------------------------------------------------------------


def test_draws_again_under_other_light_and_beside_the_other_renderer():
    """Linear in irradiance, and back to the first image bit for bit, also when triangles were drawn
    in between.
    """
    scene, asset, sensor = opened(
        floor=rectangle(size=1, bsdf=diffuse()), ball=sphere(radius=0.4, bsdf=diffuse(0.3))
    )
    points = asset.points
    irradiance = np.random.default_rng(1).uniform(0, 2, points.positions.shape).astype(np.float32)
    with RasterScene(asset, scene, sensor) as raster:
        triangles = raster.radiance(irradiance)
        with SplatScene(
            points.positions, points.normals, np.full(len(points), 0.5), scene, sensor
        ) as splats:
            first, double = splats.radiance(irradiance), splats.radiance(2 * irradiance)
            np.testing.assert_array_equal(raster.radiance(irradiance), triangles)
            again = splats.radiance(irradiance)
            shown = splats.draw(irradiance, 0.7)
        np.testing.assert_array_equal(raster.radiance(irradiance), triangles)
    np.testing.assert_allclose(double, 2 * first, rtol=1e-5)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(shown, display(first, 0.7))


def test_a_moving_camera_compiles_nothing():
    """Three cameras, as a turntable has them: all that the second and third one need was compiled
    for the first.
    """
    floor = rectangle(size=1, bsdf=diffuse())
    for height in (3, 3.5, 4.1):
        scene, points, sensor = surroundings(sensor=camera((0, height, 0.1)), floor=floor)
        with count_kernels() as kernels:
            splatted(points, uniform(points), scene, sensor)
    assert kernels.launched > 0 and kernels.compiled == 0


def test_nothing_to_see():
    """A camera that looks away, and splats that all face away: the sky, and black."""
    floor, sky = rectangle(size=1, bsdf=diffuse()), {"type": "constant", "radiance": 2.0}
    scene, points, sensor = surroundings(sensor=camera(target=(0, 8, 0)), floor=floor, sky=sky)
    np.testing.assert_allclose(splatted(points, uniform(points), scene, sensor), 2, rtol=1e-6)
    scene, points, sensor = surroundings(floor=rectangle(size=9, bsdf=diffuse()), spacing=1.0)
    with SplatScene(
        points.positions, -points.normals, np.full(len(points), 2.0), scene, sensor, 1
    ) as splats:
        assert not splats.radiance(uniform(points)).any()


def test_errors_name_what_is_supported():
    scene, points, sensor = surroundings(floor=rectangle(bsdf=diffuse()))
    x, n, r = points.positions, points.normals, np.full(len(points), 0.2)
    with pytest.raises(SettingsError, match="samples"):
        SplatScene(x, n, r, scene, sensor, 0)
    with pytest.raises(SettingsError, match=r"normals .* shape \(\d+, 3\)"):
        SplatScene(x, n[:-1], r, scene, sensor)
    with pytest.raises(SettingsError, match=r"radii .* shape \(\d+,\)"):
        SplatScene(x, n, r[:, None], scene, sensor)
    for radii in (0 * r, -r, np.where(np.arange(len(r)) == 3, np.nan, r), np.inf * r):
        with pytest.raises(SettingsError, match="radii > 0"):
            SplatScene(x, n, radii, scene, sensor)
    with pytest.raises(SettingsError, match="1 or more"):
        SplatScene(x[:0], n[:0], r[:0], scene, sensor)
    with (
        SplatScene(x, n, r, scene, sensor) as splats,
        pytest.raises(SettingsError, match=r"irradiance .* shape \(\d+, 3\)"),
    ):
        splats.radiance(x[:-1])
    with resized(sensor, (20_000, 4)), pytest.raises(SettingsError, match="limit"):
        SplatScene(x, n, r, scene, sensor)
    fluxmeter = open_scene(
        {"type": "scene", "floor": rectangle(sensor={"type": "irradiancemeter", "film": film()})}
    )
    with pytest.raises(SettingsError, match="perspective, thinlens, orthographic"):
        SplatScene(x, n, r, scene, fluxmeter.mi_scene.sensors()[0])


PROGRAM = """
import sys, numpy as np
from test_splats import diffuse, rectangle, sphere, splatted, surroundings
floor = rectangle(bsdf=diffuse([0.2, 0.5, 0.8]))
parts = dict(floor=floor, ball=sphere(radius=0.5, bsdf=diffuse()))
scene, points, sensor = surroundings(**parts)
np.save(sys.argv[1], splatted(points, 3 + points.positions, scene, sensor))
"""


@pytest.mark.parametrize("platform", ["osmesa", "egl"])
def test_platforms_draw_the_same(platform, tmp_path):
    """A process of its own for each platform, because it cannot be changed once OpenGL is loaded;
    see test_raster.
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
    floor, ball = rectangle(bsdf=diffuse([0.2, 0.5, 0.8])), sphere(radius=0.5, bsdf=diffuse())
    scene, points, sensor = surroundings(floor=floor, ball=ball)
    here = splatted(points, 3 + points.positions, scene, sensor)
    difference = np.abs(np.load(tmp_path / "image.npy") - here).max(axis=-1)
    assert np.mean(difference > 1e-4) < 0.02
    assert difference.max() < 0.02
