"""Irradiance in scenes whose answer is known: closed forms, symmetry, and integrals that share no
code with mi_prt.
"""

import drjit as dr
import numpy as np
import pytest
import scipy.stats
from conftest import (
    bias,
    cosine_directions,
    cube,
    diffuse,
    disk,
    matrix_transform,
    random_rotation,
    ray_test,
    rectangle,
    relative_l2,
    scene,
    sky_of,
    sphere,
    uniform_directions,
    uniform_sky,
)

import mi_prt
from mi_prt.directions import Cubemap
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import sample_direct

mi = mitsuba()

# no direction is farther than this from its cell's centre in cubemap:8
CELL_RADIUS = np.pi / 4 / 8 * (8 / 3) ** 0.5


def precompute(parts, directions="cubemap:32", **settings):
    return mi_prt.precompute(parts, directions=directions, **settings)


def under_own_light(parts, **settings):
    """Irradiance (n, 3) of a scene under the distant emitters that it holds."""
    asset = precompute(parts, **settings)
    return asset.irradiance(scene_light(open_scene(parts)))


@pytest.fixture(scope="module")
def plane():
    """An unoccluded square that faces up; its transport is one row, so the basis is empty and
    nothing is lost.
    """
    return precompute(scene(plane=rectangle(bsdf=diffuse([0.2, 0.5, 0.8]))), edge_length=1.0)


@pytest.fixture(scope="module")
def coarse_plane():
    """The same in front of a coarser lattice, for what does not depend on it."""
    return precompute(
        scene(plane=rectangle(bsdf=diffuse([0.2, 0.5, 0.8]))), "cubemap:8", edge_length=1.0
    )


@pytest.fixture(scope="module")
def ball():
    """A unit sphere: 482 points, normals in all directions, and components up to the 12th spherical
    harmonic.
    """
    return precompute(scene(ball=sphere(bsdf=diffuse(1.0))), edge_length=1.0, coefficients=118)


CLUTTER = dict(
    floor=rectangle(size=2, bsdf=diffuse(0.5)),
    ball=sphere((0.3, 0.48, 0.2), 0.5),
    box=cube((-0.87, 0.37, 0.43), 0.4),
    roof=disk((0.3, 1, 0.2), (0, 1.6, 0), 0.7, bsdf={"type": "twosided", "nested": diffuse()}),
)


@pytest.fixture(scope="module")
def clutter():
    """Occlusion of every kind: curved and flat, sunk in, two-sided; with the light that is
    reflected there.
    """
    return precompute(scene(**CLUTTER), edge_length=0.5)


# --- a constant sky -------------------------------------------------------------------------------


@pytest.mark.parametrize("normal", [(0, 1, 0), (0, 0, -1), (1, 1, 0), (1, -2, 3)])
def test_unoccluded_plane_under_a_constant_sky(normal):
    """∫ L max(0, n·ω) dω = πL whatever the tilt; the lattice's quadrature of the cosine is good to
    1e-3.
    """
    asset = precompute(scene(plane=rectangle(normal)), edge_length=1.0)
    radiance = np.array([0.3, 1.0, 70.0])
    np.testing.assert_allclose(
        asset.irradiance(uniform_sky(radiance)) / (np.pi * radiance), 1, atol=1e-3
    )
    np.testing.assert_allclose(
        asset.points.normals,
        np.broadcast_to(normal / np.linalg.norm(normal), (len(asset.points), 3)),
        atol=1e-6,
    )


@pytest.mark.parametrize("radius", [1e-3, 1e3])
def test_sphere_under_a_constant_sky(radius):
    """A sphere is convex: each point sees its whole outer hemisphere and receives πL, at any scale
    and place.
    """
    asset = precompute(
        scene(ball=sphere((5 * radius, -radius, 0), radius)), "cubemap:16", edge_length=radius
    )
    np.testing.assert_allclose(asset.irradiance(uniform_sky(2.0)), 2 * np.pi, rtol=2e-3)


@pytest.mark.parametrize("far", [0.0, 1e4])
def test_cube_under_a_constant_sky_far_from_the_origin(far):
    """A cube is convex too: πL at each point, also on its edges, and where float32 positions are
    coarse.
    """
    asset = precompute(scene(box=cube((far, 0, -far), 1.0)), "cubemap:16", edge_length=0.7)
    np.testing.assert_allclose(asset.irradiance(uniform_sky()), np.pi, rtol=2e-3)


def test_inside_of_a_closed_surface_is_dark():
    """A sphere turned inside out sees nothing but itself: irradiance is exactly zero."""
    asset = precompute(scene(ball=sphere(flip_normals=True)), "cubemap:8", edge_length=1.0)
    assert not asset.irradiance(uniform_sky()).any()


# --- light from half of the sky -------------------------------------------------------------------

HALVES = {
    "x>0": (lambda d: d[:, :1] > 0, np.pi / 2),
    "z<0": (lambda d: d[:, 2:] < 0, np.pi / 2),
    "upper": (lambda d: d[:, 1:2] > 0, np.pi),
    "lower": (lambda d: d[:, 1:2] < 0, 0.0),
}


@pytest.mark.parametrize("half", HALVES)
def test_half_sky_over_a_plane(plane, half):
    """Half of a sky gives half of π by symmetry, its upper half all, its lower half nothing.

    Interpolation spreads the map's edge over one row or column (0.025 rad): it moves less than 1e-3
    over the horizon.
    """
    function, expected = HALVES[half]
    np.testing.assert_allclose(plane.irradiance(sky_of(function)), expected, atol=1e-3)


@pytest.mark.parametrize("half", HALVES)
def test_half_sky_from_the_scenes_own_envmap_turned_with_the_plane(half):
    """Turning sky and plane together changes nothing, but the sky's edge now cuts cells: a part of
    a cell's worth, 2 %.
    """
    function, expected = HALVES[half]
    rotation = random_rotation(np.random.default_rng(list(HALVES).index(half)))
    parts = scene(
        plane=rectangle(rotation[:, 1]),
        sky={
            "type": "envmap",
            "bitmap": mi.Bitmap(sky_of(function)),
            "to_world": matrix_transform(rotation),
            "scale": 3.0,
        },
    )
    np.testing.assert_allclose(
        under_own_light(parts, directions="cubemap:16", edge_length=1.0),
        3 * expected,
        atol=0.02 * 3 * np.pi,
    )


# --- a known occluder -----------------------------------------------------------------------------


def disk_form_factor(offset, height, radius):
    """View factor of a parallel disk from a surface element `offset` beside its axis (Howell's
    catalogue, B-13).
    """
    offset = np.maximum(offset, 1e-9)
    h, r = height / offset, radius / offset
    z = 1 + h * h + r * r
    return (1 - (z - 2 * r * r) / np.sqrt(z * z - 4 * r * r)) / 2


@pytest.mark.parametrize(("radius", "height"), [(0.3, 0.4), (0.8, 0.5), (1.0, 2.0)])
def test_plane_below_a_disk(radius, height):
    """E = π(1 − F), F the disk's form factor, in closed form on its axis, R²/(R² + h²), and beside
    it.

    With one ray a cell the disk's rim is a staircase: errors of half a cell along the rim, random
    in sign; 16 rays make it four times finer and the error about eight times smaller.
    Deterministic. There are 25 points on the plane and the disk faces the sky, so that 48
    coefficients hold the transport exactly.
    """
    parts = scene(plane=rectangle(), blocker=disk((0, 1, 0), (0, height, 0), radius))
    errors = {}
    for rays in (1, 16):
        asset = precompute(parts, edge_length=0.75, rays_per_direction=rays, bounces=0)
        on_plane = asset.points.surface == 0
        position = asset.points.positions[on_plane]
        result = asset.irradiance(uniform_sky())[on_plane, 0]
        expected = np.pi * (
            1 - disk_form_factor(np.hypot(position[:, 0], position[:, 2]), height, radius)
        )
        (axis,) = np.flatnonzero(np.linalg.norm(position, axis=1) < 1e-6)
        assert expected[axis] == pytest.approx(
            np.pi * (1 - radius**2 / (radius**2 + height**2)), rel=1e-6
        )
        errors[rays] = relative_l2(result, expected)
        assert abs(result[axis] / expected[axis] - 1) < (0.01 if rays == 1 else 3e-3)
        assert abs(bias(result, expected)) < (1e-3 if rays == 1 else 2e-4)
    assert errors[1] < 5e-3 and errors[16] < 5e-4 and errors[16] < errors[1] / 3


def test_transport_of_clutter_integrates_to_what_random_rays_find(clutter):
    """White check: Σ_j w_j T_ij / π is the share of cosine-distributed directions that see the sky.

    The reference takes 1,024 random rays of Mitsuba's at each point, in numbers of its own, from
    the same offset. Its count is binomial: no |z| may exceed what one of the points does once in
    10,000 runs, and Σz² over points that see part of the sky is χ² distributed (two-sided 1e-4).
    The lattice's own error (4 rays in each cell) is far below.
    """
    wrapped, points = open_scene(scene(**CLUTTER)), clutter.points
    lattice = Cubemap(32)
    transport = sample_direct(wrapped, points, lattice, rays_per_direction=4)
    share = transport.irradiance(np.ones((len(lattice), 3)), lattice.solid_angles)[:, 0] / np.pi

    count, rng = 1024, np.random.default_rng(7)
    watertight = mi.load_dict(
        scene(**CLUTTER, embree_use_robust_intersections=True), optimize=False, parallel=False
    )
    extent = np.array(watertight.bbox().max - watertight.bbox().min).ravel()
    offset = 2e-5 * np.linalg.norm(extent)
    directions = cosine_directions(rng, np.repeat(points.normals.astype(float), count, axis=0))
    origins = np.repeat(points.positions + offset * points.geometric_normals, count, axis=0)
    seen = (~ray_test(watertight, origins, directions)).reshape(-1, count).sum(axis=1)

    p = (seen + 1) / (count + 2)
    z = (share - seen / count) / np.sqrt(p * (1 - p) / count)
    assert np.abs(z).max() < scipy.stats.norm.isf(1e-4 / 2 / len(z))
    partly = (p > 0.02) & (p < 0.98)
    assert partly.sum() > 200
    assert (
        scipy.stats.chi2.interval(1 - 1e-4, partly.sum())[0]
        < (z[partly] ** 2).sum()
        < scipy.stats.chi2.isf(5e-5, partly.sum())
    )
    assert (share[seen == 0] < 5e-3).all() and (seen == 0).sum() > 3  # the floor inside the box


# --- directional light ----------------------------------------------------------------------------


@pytest.mark.parametrize("cell", [17, 3000, 6143])
def test_sphere_lit_along_the_centre_of_a_cell(ball, cell):
    """E·max(0, n·ω): exact but for the harmonics beyond the 12th, whose share of the clamped cosine
    is below 1 %.
    """
    toward = Cubemap(32).vectors[cell].astype(float)
    light = mi_prt.DirectionalLight(-3 * toward, [2.0, 0.0, 5.0])
    expected = np.maximum(ball.points.normals @ toward, 0)[:, None] * [2.0, 0.0, 5.0]
    result = ball.irradiance(light)
    assert relative_l2(result, expected) < 0.01
    assert abs(bias(result, expected)) < 5e-3


def test_directional_emitters_of_a_scene(coarse_plane):
    """E·cos θ within the cell's radius r: the light is moved to the centre of its cell, and |Δcos
    θ| ≤ r.
    """
    rng = np.random.default_rng(3)
    for toward in uniform_directions(rng, 8):
        emitter = {
            "type": "directional",
            "direction": list(-toward),
            "irradiance": {"type": "rgb", "value": [1.0, 2.0, 4.0]},
        }
        light = scene_light(open_scene(scene(plane=rectangle(), sun=emitter)))
        expected = max(0, toward[1]) * np.array([1.0, 2.0, 4.0])
        np.testing.assert_array_less(
            np.abs(coarse_plane.irradiance(light)[0] - expected),
            1.001 * CELL_RADIUS * np.array([1.0, 2.0, 4.0]),
        )
        turned = coarse_plane.irradiance(
            light.rotated(np.cross(toward, [0, 1, 0]), np.degrees(np.arccos(toward[1])))
        )
        # now it comes from straight above
        np.testing.assert_allclose(turned[0], [1.0, 2.0, 4.0], rtol=CELL_RADIUS**2 / 2)


# --- distant emitters of scenes -------------------------------------------------------------------


def sunsky(toward, **rest):
    """Mitsuba's, whose own up is z, turned to y."""
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    return {
        "type": "sunsky",
        "sun_direction": list(map(float, toward)),
        "to_world": to_world,
        **rest,
    }


def emitter_energy(emitter, normal, count=1 << 18):
    """∫ L dω and ∫ L max(0, n·ω) dω (2, 3) with standard errors, from Mitsuba's own sampling of an
    emitter.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(5, count)
    sample, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, count), sampler.next_2d())
    weight = np.array(mi.Color3f(weight)).T.astype(float)
    cosine = np.maximum(np.array(sample.d).T @ normal, 0)[:, None]
    values = np.stack([weight, weight * cosine])
    return values.mean(axis=1), values.std(axis=1) / count**0.5


def at_altitude(degrees):
    return np.array(
        [
            np.cos(np.radians(degrees)) * 0.6,
            np.sin(np.radians(degrees)),
            np.cos(np.radians(degrees)) * 0.8,
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize("altitude", [90, 89.5, 30, 5])
def test_energy_of_a_sunsky(altitude):
    """Σ_j w_j L_j equals ∫ L dω of Mitsuba's emitter: the sun is whole wherever in the sky it
    stands.

    z-test against Mitsuba's own emitter sampling, |z| < 5 (three channels, 1e-6 false positives),
    beside 0.5 % for the map of 512 rows that the sky is baked to.
    """
    parts = scene(ball=sphere(), sky=sunsky(at_altitude(altitude)))
    opened = open_scene(parts)
    lattice = Cubemap(8)
    energy = (cell_radiance(scene_light(opened), lattice) * lattice.solid_angles[:, None]).sum(
        axis=0
    )
    (mean, _), (error, _) = emitter_energy(opened.distant_emitters[0], np.array([0.0, 1, 0]))
    np.testing.assert_array_less(np.abs(energy - mean), 5 * error + 5e-3 * mean)


def test_sunset_is_usable():
    """Mitsuba's sun below 3° has a negative blue (its red is outside sRGB); that is no damage for
    the user to repair.
    """
    light = scene_light(open_scene(scene(ball=sphere(), sky=sunsky(at_altitude(2)))))
    assert light.parts[0].pixels.max() > 100


def test_irradiance_under_a_sky_without_sun():
    """∫ L max(0, n·ω) dω of Mitsuba's sunsky with the sun switched off: nothing is smaller than a
    cell.

    z-test as above, beside 0.3 % for lattice and map.
    """
    parts = scene(plane=rectangle((1, 2, 0)), sky=sunsky(at_altitude(40), sun_scale=0.0))
    (_, mean), (_, error) = emitter_energy(
        open_scene(parts).distant_emitters[0], np.array([1, 2, 0]) / 5**0.5
    )
    np.testing.assert_array_less(
        np.abs(under_own_light(parts, edge_length=1.0)[0] - mean), 5 * error + 3e-3 * mean
    )


def test_lights_of_a_scene_add_up(coarse_plane):
    """Light is additive: a scene's `constant` and two `directional` emitters give the sum of what
    each gives.
    """
    emitters = {
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}},
        "sun": {
            "type": "directional",
            "direction": [0.3, -1, 0],
            "irradiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]},
        },
        "moon": {"type": "directional", "direction": [0, -0.2, 1], "irradiance": 0.5},
    }
    alone = [
        coarse_plane.irradiance(scene_light(open_scene(scene(p=rectangle(), e=e))))
        for e in emitters.values()
    ]
    together = coarse_plane.irradiance(scene_light(open_scene(scene(p=rectangle(), **emitters))))
    np.testing.assert_allclose(together, sum(alone), rtol=1e-5)
    np.testing.assert_allclose(
        alone[0], np.pi * np.broadcast_to([0.1, 0.2, 0.3], alone[0].shape), rtol=0.01
    )


def test_scale_of_an_envmap_is_honoured(coarse_plane):
    """Radiance is linear in `scale`, in the scene's emitter and in EnvironmentMap."""
    pixels = sky_of(lambda d: 1 + d[:, :1] ** 2, 16)
    parts = scene(
        plane=rectangle(), sky={"type": "envmap", "bitmap": mi.Bitmap(pixels), "scale": 2.5}
    )
    once = coarse_plane.irradiance(pixels)
    np.testing.assert_allclose(
        coarse_plane.irradiance(scene_light(open_scene(parts))), 2.5 * once, rtol=1e-5
    )
    np.testing.assert_allclose(
        coarse_plane.irradiance(mi_prt.EnvironmentMap(pixels, scale=2.5)), 2.5 * once, rtol=1e-5
    )


# --- linearity and albedo -------------------------------------------------------------------------


def test_superposition_and_sign(clutter):
    """E is linear in the light where nothing is cut off below zero, and never negative."""
    rng = np.random.default_rng(11)
    one, two = rng.exponential(size=(2, 16, 32, 3)).astype(np.float32)
    results = [clutter.irradiance(light) for light in (one, two, 2 * one + 3 * two)]
    positive = np.all([r > 0 for r in results], axis=0)
    assert positive.mean() > 0.8
    np.testing.assert_allclose(
        results[2][positive], (2 * results[0] + 3 * results[1])[positive], rtol=1e-3
    )
    sun = mi_prt.DirectionalLight([0.2, -1, 0.1], [1e5, 1e5, 1e5])
    assert (clutter.irradiance(sun) >= 0).all() and (clutter.relight(sun) >= 0).all()


def test_radiance_is_albedo_over_pi_times_irradiance(coarse_plane):
    """B = ρ/π · E, a definition."""
    light = uniform_sky([1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        coarse_plane.relight(light),
        coarse_plane.irradiance(light) * np.array([0.2, 0.5, 0.8]) / np.pi,
        rtol=1e-5,
    )
    np.testing.assert_allclose(coarse_plane.relight(light)[0], [0.2, 1.0, 2.4], rtol=0.01)


@pytest.mark.parametrize("kind", ["checkerboard", "bitmap", "vertex colours"])
def test_albedo_of_textures_at_the_points(kind):
    """Each point's albedo is what Mitsuba finds where a ray straight onto the point hits.

    The edge itself is left out: there a texture wraps round to its other side.
    """
    shape = rectangle((0.2, 1, 0.3))
    if kind == "vertex colours":
        shape = mi.load_dict(
            {
                "type": "cube",
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "mesh_attribute", "name": "vertex_color"},
                },
            }
        )
        corners = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
        shape.add_attribute("vertex_color", 3, ((corners + 1) * [0.3, 0.4, 0.5]).ravel())
    else:
        pixels = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
        texture = {
            "type": "bitmap",
            "bitmap": mi.Bitmap(pixels),
            "raw": True,
            "to_uv": mi.ScalarTransform3f().scale([2, 1]),
        }
        texture = (
            {"type": "checkerboard", "to_uv": mi.ScalarTransform3f().scale([1.7, 1.3])}
            if kind == "checkerboard"
            else texture
        )
        shape["bsdf"] = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": texture}}
    asset = precompute(scene(shape=shape), "cubemap:8", edge_length=0.4, coefficients=0)
    points = asset.points
    inside = (
        (np.abs(points.uv - 0.5) < 0.499).all(axis=1)
        if kind != "vertex colours"
        else np.full(len(points), True)
    )
    if kind == "vertex colours":
        expected = (points.positions + 1) * [0.3, 0.4, 0.5]
    else:
        origins, normals = points.positions + points.normals, points.normals
        ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(-normals.T))
        alone = mi.load_dict(scene(shape=shape))  # kept: what follows is evaluated lazily
        si = alone.ray_intersect(ray)
        expected = np.array(si.bsdf().eval_diffuse_reflectance(si)).T
        assert len(np.unique(expected[inside].round(4), axis=0)) >= 2
    np.testing.assert_allclose(points.albedo[inside], expected[inside], atol=1e-4)
    sky = uniform_sky(3.0)
    np.testing.assert_allclose(
        asset.relight(sky)[inside], 3 * expected[inside], rtol=0.01, atol=1e-4
    )
