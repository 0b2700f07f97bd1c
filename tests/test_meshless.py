"""Light that moves inside a scene: closed forms, Mitsuba's path tracer, and the numerics of depth
buffers and transfer matrices.

Most tests compare what an asset gives with the truth and state a bound. Seeds are fixed, so results
differ from machine to machine by rounding only. Bounds are 1.3 to 2 times what was found; where the
truth is Mitsuba's, its own noise, which is told from its paths, is subtracted from squared errors
and its standard error added to the bounds of biases, so that a wrong alarm is less likely than
`FALSE_POSITIVES`.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import bias, cube, diffuse, largest_z, rectangle, relative_l2, scene, sphere

import mi_prt
from mi_prt import AreaLight, PointLight, SceneError, SpotLight
from mi_prt.basis.clustered import leading_components
from mi_prt.directions.hemisphere import Hemisphere
from mi_prt.evaluate.ground_truth import indirect_irradiance, local_irradiance, point_irradiance
from mi_prt.lighting.emission import emission_of
from mi_prt.lighting.light import as_light
from mi_prt.lighting.own_light import SceneLight, resolve
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.particles import example_places
from mi_prt.points.samples import scatter_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import count_kernels, mitsuba
from mi_prt.transport.depth import GRAZING, NEAREST, DepthBuffers, compress, log_depth
from mi_prt.transport.examples import RAISE, trace_examples
from mi_prt.transport.hemispheres import (
    NOTHING,
    Hemispheres,
    HemisphereTracer,
    cluster_frames,
    gathered,
)
from mi_prt.transport.local_direct import BEHIND, CELLS, CLEARANCE, FAR, SOFTNESS, TOLERANCE
from mi_prt.transport.transfer import all_reflections, fit_senders
from mi_prt.transport.transfer_matrix import Transfer, within_budget

mi = mitsuba()

SMALL = dict(
    count=2000,
    cluster_size=200,
    depth_directions=576,
    depth_coefficients=50,
    example_lights=200,
    transfer_coefficients=20,
    transfer_error=0.01,
)


def precompute(parts, **settings):
    return mi_prt.precompute(parts, points="samples", transports="local", **(SMALL | settings))


def local(asset):
    """The transport of lights that move."""
    return asset.transports["local"]


def direct_kernel(asset):
    """The LocalDirect with which an asset answers."""
    return local(asset)._direct_light(asset.points)


def scattered(opened, count, cluster_size, examples):
    """Samples, their clusters, and places of example lights, as a precomputation finds them."""
    points, clusters, flights = scatter_points(opened, count, round(count / cluster_size))
    places = example_places(opened, examples, 0, flights)
    return SimpleNamespace(points=points, clusters=clusters, places=places)


def eye(origin, target=(0, 0, 0)):
    """A sensor, from which particles start: they find the rooms that it is in."""
    look = mi.ScalarTransform4f().look_at(
        origin=list(map(float, origin)), target=list(map(float, target)), up=[0, 1, 0]
    )
    return {"type": "perspective", "to_world": look}


def twosided(reflectance):
    return {"type": "twosided", "bsdf": diffuse(reflectance)}


def screen(x, z=0.0, half_width=1.0, reflectance=0.6):
    """A wall without thickness across the height of a room, at right angles to x."""
    place = (
        mi.ScalarTransform4f().translate([x, 0, z]).rotate([0, 1, 0], 90).scale([half_width, 1, 1])
    )
    return {"type": "rectangle", "to_world": place, "bsdf": twosided(reflectance)}


def shell(reflectance=0.6):
    """The inside of a cube of 2 m, and a sensor in it."""
    return dict(
        eye=eye((0.3, 0.4, 0.9)),
        shell={"type": "cube", "flip_normals": True, "bsdf": diffuse(reflectance)},
    )


def received(asset, light, component="total"):
    """Power (n,) in W that each sample receives in the mean over the channels."""
    return asset.irradiance(light, component).mean(axis=1, dtype=np.float64) * asset.points.areas


def some(points, count, seed=0):
    """So many of the points, and their indices."""
    index = np.sort(np.random.default_rng(seed).permutation(len(points))[:count])
    return points.at(index), index


def unblocked(points, place):
    """Irradiance (n,) by a point light of 1 W/sr that nothing hides, cos θ/r², and whether it is in
    front.
    """
    toward = np.asarray(place, np.float64) - points.positions
    height = np.einsum("ij,ij->i", toward, points.normals)
    return np.maximum(height, 0) / np.linalg.norm(toward, axis=1) ** 3, height > 0


def errors(result, reference):
    """Relative RMSE without the noise of a Reference, which is independent of the error and adds to
    it in squares; and relative bias with its standard error.
    """
    squared = relative_l2(result, reference.mean) ** 2 - reference.noise**2
    of_sum = np.sqrt((reference.standard_error**2).sum()) / reference.mean.sum()
    return np.sqrt(max(squared, 0)), bias(result, reference.mean), of_sum


# --- the inside of a sphere -----------------------------------------------------------------------

RADIUS, ALBEDO = 2.0, 0.5
PARTIAL_SUMS = {0: 0.0, 1: 0.5, 2: 0.75, "auto": 1.0}  # ρ + ρ² + … of a half


@pytest.fixture(scope="module")
def ball():
    """The asset of a closed sphere by the number of bounces; each is made once."""
    made = {}

    def asset(bounces="auto"):
        if bounces not in made:
            parts = scene(
                eye=eye((0.3, 0.4, 0.9)),
                ball=sphere(radius=RADIUS, flip_normals=True, bsdf=diffuse(ALBEDO)),
            )
            made[bounces] = precompute(
                parts, count=800, depth_directions=256, example_lights=100, bounces=bounces
            )
        return made[bounces]

    return asset


@pytest.mark.parametrize("bounces", PARTIAL_SUMS, ids=str)
@pytest.mark.parametrize("place", [(0, 0, 0), (0.5, 0.3, -1)], ids=["centre", "off centre"])
def test_an_integrating_sphere(ball, bounces, place):
    """Each part of a sphere's inside sees all others alike: what is reflected is uniform, wherever
    the light stands.

    Of the flux 4πI the share ρ is reflected, and again ρ of that …, over the area 4πR²: the
    indirect irradiance is I/R² · (ρ + ρ² + …). The direct one is I·cos θ/r², with nothing in the
    way: exact.
    """
    asset, light = ball(bounces), PointLight(place, 3.0)
    expected, facing = unblocked(asset.points, place)
    assert facing.all()
    np.testing.assert_allclose(
        asset.irradiance(light, "direct"), 3 * np.repeat(expected[:, None], 3, axis=1), rtol=1e-5
    )
    indirect = asset.irradiance(light, "indirect")
    value = 3 / RADIUS**2 * PARTIAL_SUMS[bounces]
    assert abs(np.average(indirect[:, 0], weights=asset.points.areas) - value) <= 0.015 * value
    assert np.abs(indirect - value).max() <= 0.06 * value
    np.testing.assert_allclose(
        asset.irradiance(light), asset.irradiance(light, "direct") + indirect, rtol=1e-6
    )


def test_outgoing_radiance_is_irradiance_times_albedo_over_pi(ball):
    """In the middle of the sphere B = ρ/π · I/R² · 1/(1 − ρ)."""
    asset = ball()
    result = asset.relight(PointLight((0, 0, 0), 1.0))
    assert np.abs(result / (ALBEDO / np.pi / RADIUS**2 / (1 - ALBEDO)) - 1).max() < 0.03
    # nothing is coloured
    assert local(asset).channels == 1 and local(asset).transfer.matrix.shape[3] == 1


def test_flux_of_a_light_near_a_wall(ball):
    """Half of the light of a lamp on a wall falls on a spot smaller than a sample. At 0.3 m, about
    two distances of samples, no more than 4 % of the flux is lost; at 1 mm a share of up to 45 %
    (as low as 60 % was found), and it never grows by more than 5 %.
    """
    asset = ball()
    random, shares = np.random.default_rng(0), {0.3: [], 1e-3: []}
    for _ in range(20):
        outward = random.standard_normal(3)
        outward /= np.linalg.norm(outward)
        for height, found in shares.items():
            light = PointLight(outward * (RADIUS - height), 1.0)
            found.append(
                received(asset, light, "indirect").sum() / (4 * np.pi * PARTIAL_SUMS["auto"])
            )
    assert min(shares[0.3]) > 0.96 and max(shares[0.3]) < 1.02
    assert min(shares[1e-3]) > 0.55 and max(shares[1e-3]) < 1.05


def test_particles_from_a_point_light_alone():
    """Its rays share one origin.

    Without any other source all of them start there, in free space: samples and places lie in the
    sphere.
    """
    parts = scene(
        lamp={"type": "point", "position": [0.3, 0.2, -0.4], "intensity": 1.0},
        ball=sphere(radius=2, flip_normals=True),
    )
    samples, again = (scattered(open_scene(parts), 300, 100, 50) for _ in range(2))
    assert (np.linalg.norm(samples.places, axis=1) < 2).all()
    np.testing.assert_array_equal(samples.places, again.places)
    np.testing.assert_array_equal(samples.points.positions, again.points.positions)


# --- white furnace, conservation ------------------------------------------------------------------

FURNACE = 0.8


def furniture(reflectance):
    """A closed room with a cube on the floor, a ball in the air and a screen without thickness."""
    return scene(
        **shell(reflectance),
        table=cube((-0.4, -0.8, 0.2), 0.2, bsdf=diffuse(reflectance)),
        ball=sphere((0.55, -0.5, -0.4), 0.3, bsdf=diffuse(reflectance)),
        screen=screen(0.1, -0.4, 0.6, reflectance),
    )


@pytest.fixture(scope="module")
def furnace():
    return precompute(furniture(FURNACE))


def under_constant_light(asset):
    """What is reflected to each sample, relative to what it should be, where all surfaces get the
    irradiance 1 directly.
    """
    constant = np.ones((len(asset.points), 3), np.float32)
    indirect = local(asset).transfer.indirect(constant, local(asset).clusters.slices)
    return indirect[:, 0] * (1 - FURNACE) / FURNACE


def test_white_furnace(furnace):
    """All surfaces of a closed room get the irradiance 1: each point sees the radiance ρ/π all
    around, then ρ²/π, …, whatever stands in the room, so that 1/(1 − ρ) comes together, of which
    ρ/(1 − ρ) is reflected.

    That light is no example; 20 patterns of each cluster represent it to some 10 % (RMS), and lose
    up to 6 % of it (4 seeds).
    """
    result = under_constant_light(furnace)
    assert 0.90 < np.average(result, weights=furnace.points.areas) < 1.01
    assert np.sqrt(np.mean((result - 1) ** 2)) < 0.14


def test_white_furnace_with_more_patterns(furnace):
    """The error is of the patterns, not of the transfer: with four times as many it halves, and no
    energy is lost or made.
    """
    finer = precompute(
        furniture(FURNACE), transfer_coefficients=80, transfer_error=0, quantize="none"
    )
    result = under_constant_light(finer)
    assert abs(np.average(result, weights=finer.points.areas) - 1) < 0.01
    assert np.sqrt(np.mean((result - 1) ** 2)) < 0.6 * np.sqrt(
        np.mean((under_constant_light(furnace) - 1) ** 2)
    )


def one_hop(opened, samples, channels, count=256):
    """The operator (n, n, channels) from irradiance of samples to what they receive after one
    reflection, by the core's rays, written out.
    """
    tracer, hemisphere = (
        HemisphereTracer(opened, samples.points, samples.clusters, Hemisphere(count), channels),
        Hemisphere(count),
    )
    n = len(samples.points)
    operator = np.zeros((n, n, channels))
    for cluster in samples.clusters.slices:
        seen = tracer.trace(cluster, cluster_frames(samples.points.normals[cluster]))
        found = seen.sample != NOTHING
        row = cluster.start + np.nonzero(found)[0]
        np.add.at(
            operator, (row, seen.sample[found]), (hemisphere.weights[:, None] * seen.albedo)[found]
        )
    return operator


@pytest.mark.parametrize("reflectance", [0.8, [0.9, 0.5, 0.1]], ids=["grey", "coloured"])
def test_rows_of_one_hop_are_the_albedo(reflectance):
    """In a closed room of one albedo every direction of a point ends on it: the shares of the
    directions sum up to one, the row to ρ.
    """
    opened = open_scene(furniture(reflectance))
    samples = scattered(opened, 600, 200, 10)
    rows = one_hop(opened, samples, np.size(reflectance)).sum(axis=1)
    np.testing.assert_allclose(rows, np.broadcast_to(reflectance, rows.shape), rtol=2e-5)


def test_one_hop_conserves_energy():
    """No row is above the largest albedo, where light escapes too; and what falls on one sample is
    not reflected to all others more than once: Σ_i A_i H_ij ≤ ρ_j A_j (reciprocity), but for the
    noise of the areas and of 256 rays.
    """
    parts = scene(
        floor=rectangle(bsdf=diffuse(0.9)),
        wall=rectangle((1, 0, 0.3), (-0.6, 0.5, 0), 0.5, bsdf=diffuse(0.3)),
        eye=eye((2, 2, 0.5)),
    )
    opened = open_scene(parts)
    samples = scattered(opened, 600, 200, 10)
    operator, areas, albedo = (
        one_hop(opened, samples, 1)[..., 0],
        samples.points.areas,
        samples.points.albedo[:, 0],
    )
    assert operator.sum(axis=1).max() <= 0.9 * (1 + 1e-5) and (operator >= 0).all()
    assert operator.sum(axis=1).min() < 0.2
    for surface in np.unique(samples.points.surface):
        column = samples.points.surface == surface
        assert (areas @ operator)[column].sum() <= 1.05 * (albedo * areas)[column].sum()


# --- linearity, colours, nothing to reflect -------------------------------------------------------


def cornell(**rest):
    """A closed room with a red and a green wall, a block, a thin partition with a way around it,
    and a lamp under the ceiling.
    """
    return scene(
        floor=rectangle((0, 1, 0), (0, -1, 0), bsdf=diffuse(0.7)),
        ceiling=rectangle((0, -1, 0), (0, 1, 0), bsdf=diffuse(0.7)),
        back=rectangle((0, 0, 1), (0, 0, -1), bsdf=diffuse(0.7)),
        front=rectangle((0, 0, -1), (0, 0, 1), bsdf=diffuse(0.7)),
        red=rectangle((1, 0, 0), (-1, 0, 0), bsdf=diffuse([0.7, 0.1, 0.1])),
        green=rectangle((-1, 0, 0), (1, 0, 0), bsdf=diffuse([0.1, 0.7, 0.1])),
        block=cube((-0.5, -0.7, 0.3), 0.3, bsdf=diffuse(0.6)),
        partition=screen(0.1, -0.4, 0.6),
        lamp=rectangle(
            (0, -1, 0),
            (-0.5, 0.95, 0),
            0.15,
            bsdf=diffuse(0.0),
            emitter={"type": "area", "radiance": {"type": "rgb", "value": [10, 8, 5]}},
        ),
        **rest,
    )


@pytest.fixture(scope="module")
def room():
    return precompute(
        cornell(), count=3000, cluster_size=300, depth_directions=1024, example_lights=300
    )


LIGHTS = (
    PointLight((0.38, -0.53, 0.7), (3.0, 2.0, 1.0)),
    PointLight((-0.2, 0.4, -0.5), (1.0, 2.0, 4.0)),
    SpotLight((0.6, 0.8, 0.5), (-0.5, -1, -0.3), 5.0, 40),
)


@pytest.mark.parametrize("component", ["direct", "indirect", "total"])
def test_intensity(room, component):
    """Light of no intensity is dark, and a million times the light is a million times the
    irradiance, to rounding.
    """
    assert not room.irradiance(PointLight((0.3, 0, 0.2), 0.0), component).any()
    one = room.irradiance(PointLight((0.3, 0, 0.2), (1.0, 2.0, 3.0)), component)
    bright = room.irradiance(PointLight((0.3, 0, 0.2), (1e6, 2e6, 3e6)), component)
    assert np.isfinite(bright).all() and (one >= 0).all()
    np.testing.assert_allclose(bright, 1e6 * one, rtol=1e-4, atol=1e-5 * bright.max())


def test_lights_add_up(room):
    """Direct irradiance of several lights is the sum, and so is what transfer makes of it; only
    what is cut off below zero, a compression error of each light alone, makes that of the asset
    less than the sum, by very little.
    """
    together, alone = list(LIGHTS), [room.irradiance(light, "direct") for light in LIGHTS]
    np.testing.assert_allclose(
        room.irradiance(together, "direct"), sum(alone), rtol=1e-5, atol=1e-6
    )
    transfer, clusters = local(room).transfer, local(room).clusters.slices
    indirect = [transfer.indirect(direct, clusters) for direct in alone]
    summed = transfer.indirect(sum(alone), clusters)
    assert relative_l2(sum(indirect), summed) < 1e-5
    cut = sum(room.irradiance(light, "indirect") for light in LIGHTS) - room.irradiance(
        together, "indirect"
    )
    assert cut.min() > -1e-4 * summed.max() and cut.sum() < 0.03 * summed.sum()


def test_colours_do_not_mix(room):
    """Diffuse reflection keeps wavelengths apart: a red light leaves green and blue dark, and white
    light is the sum of three.
    """
    place, result = (-0.3, 0.1, 0.2), []
    for channel in range(3):
        result.append(room.irradiance(PointLight(place, np.eye(3)[channel])))
        assert not np.delete(result[-1], channel, axis=1).any() and result[-1][:, channel].max() > 0
    assert relative_l2(room.irradiance(PointLight(place, 1.0)), sum(result)) < 1e-5


def test_walls_bleed_their_colour(room):
    """White light in the left half makes the floor along the red wall redder than green, and that
    along the green wall greener than red; no wall is blue, so blue is below grey everywhere.
    """
    assert local(room).channels == 3
    indirect, points = room.irradiance(PointLight((-0.3, 0.2, 0.4), 1.0), "indirect"), room.points
    floor = (points.normals[:, 1] > 0.9) & (points.positions[:, 1] < -0.99)
    red, green = (
        indirect[floor & (sign * points.positions[:, 0] > 0.6)].sum(axis=0) for sign in (-1, 1)
    )
    assert red[0] > 1.2 * red[1] and green[1] > 1.1 * green[0]
    assert red[2] < red[0] and green[2] < green[1]


@pytest.mark.parametrize(
    "parts",
    [
        dict(box=cube(bsdf=diffuse([0.9, 0.5, 0.1]))),
        dict(
            ball=sphere((0, 0, 0), 3, flip_normals=True, bsdf=diffuse(0.0)),
            block=cube(size=0.5, bsdf=diffuse(0.0)),
        ),
    ],
    ids=["convex and coloured", "black"],
)
def test_nothing_to_reflect(parts):
    """No point of a convex body sees another one, and what is black reflects nothing: there is no
    transfer, or none that does anything.
    """
    try:
        asset = precompute(
            scene(eye=eye((2, 1.5, 1)), **parts),
            count=300,
            cluster_size=100,
            depth_directions=144,
            example_lights=30,
        )
    except SceneError as error:  # black surfaces get no samples
        assert "reflect" in str(error) and parts["ball"]["bsdf"]["reflectance"]["value"] == 0
        return
    light = PointLight((1.8, 1.5, 1), 5.0)
    assert local(asset).transfer is None and not asset.reflects
    assert local(asset).channels == 1 and local(asset).report["bounces"] == 0
    assert not asset.irradiance(light, "indirect").any() and asset.irradiance(light, "direct").any()
    np.testing.assert_array_equal(asset.irradiance(light), asset.irradiance(light, "direct"))


# --- against Mitsuba ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def opened_room():
    return open_scene(cornell())


def places_in_the_room(count, seed=1):
    """Places of lights, none of which is an example: 0.1 m off all walls and out of the block."""
    places = np.random.default_rng(seed).uniform(-0.9, 0.9, (4 * count, 3))
    inside = (np.abs(places - [-0.5, -0.7, 0.3]) < 0.4).all(axis=1) | (
        (np.abs(places[:, 0] - 0.1) < 0.1) & (places[:, 2] < 0.3)
    )
    return places[~inside][:count]


def reflected_truth(opened, light, points, paths=1024, bounces=None, seed=0):
    """Indirect irradiance at points by Mitsuba's path tracer, a Reference."""
    return indirect_irradiance(
        lit_scene(opened, as_light(light), modelled=True),
        points,
        paths,
        bounces,
        seed,
    )


def test_against_the_path_tracer(room, opened_room):
    """Eight lights that were no examples: Mitsuba's shadow rays have the direct irradiance at all
    samples, its paths the indirect one at 150.

    At 3,000 samples, RMS over the lights: direct 10 %, indirect 20 %, total 10 % at most (the
    product's default of 45,000 does better, see docs/meshless.md); the mean bias is below 2 %, 6 %
    and 4 %.
    """
    points, index = some(room.points, 150)
    squares, biases, noise = [], [], []
    for number, place in enumerate(places_in_the_room(8)):
        light = PointLight(place, 1.0)
        truth = local_irradiance(opened_room.occluders, points, [light])
        paths = reflected_truth(opened_room, light, points, seed=number)
        direct, indirect = (
            room.irradiance(light, component)[index] for component in ("direct", "indirect")
        )
        total = dataclasses.replace(paths, mean=truth + paths.mean)
        everywhere, result = (
            local_irradiance(opened_room.occluders, room.points, [light]),
            room.irradiance(light, "direct"),
        )
        both = [
            (relative_l2(result, everywhere), bias(result, everywhere), 0.0),
            errors(indirect, paths),
            errors(direct + indirect, total),
        ]
        squares.append([rmse**2 for rmse, _, _ in both])
        biases.append([b for _, b, _ in both])
        noise.append([error for _, _, error in both])
    rmse, mean = np.sqrt(np.mean(squares, axis=0)), np.mean(biases, axis=0)
    allowed = largest_z(3) * np.sqrt(np.square(noise).sum(axis=0)) / len(noise)
    assert (rmse < [0.10, 0.20, 0.10]).all(), rmse
    assert (np.abs(mean) < [0.02, 0.06, 0.04] + allowed).all(), mean


@pytest.mark.parametrize(
    ("light", "most"),
    [
        (SpotLight((0.6, 0.8, 0.5), (-0.5, -1, -0.3), 5.0, 40), 0.20),
        (AreaLight((0.5, 0.95, 0.3), (0.3, 0, 0), (0, 0, 0.3), (4, 3, 2)), 0.06),
        (None, 0.10),
    ],
    ids=["spot", "area", "own lamp"],
)
def test_spot_and_area_lights_against_mitsuba(room, opened_room, light, most):
    """Mitsuba samples the area light as a whole, which 25 places stand for here; the scene's own
    lamp is taken where no light is given.

    Direct light at all samples (11 to 14 % RMSE of the spot with its hard edges in 4 runs, 3 % and
    4 to 6 % of the others), reflected at 150.
    """
    if light is None:
        light = resolve(SceneLight(), opened_room)
    lit = lit_scene(opened_room, as_light(light), modelled=True)
    points, index = some(room.points, 150)
    rmse, found, noise = errors(
        room.irradiance(light, "direct"), point_irradiance(lit, room.points, 64)
    )
    assert rmse < most and abs(found) < 0.04 + largest_z(2) * noise
    rmse, found, noise = errors(
        room.irradiance(light, "indirect")[index], indirect_irradiance(lit, points, 512)
    )
    assert rmse < 0.2 and abs(found) < 0.10 + largest_z(2) * noise


def test_misclassified_visibility(room, opened_room):
    """Depth buffers say of at most 5 % of the points in front of a light the wrong thing of whether
    it is visible, by rays that Mitsuba casts; and the report, which counts it for examples, says
    about the same.
    """
    wrong = facing = 0
    for place in places_in_the_room(12, seed=2):
        light = PointLight(place, 1.0)
        open_air, front = unblocked(room.points, place)
        visible = local_irradiance(opened_room.occluders, room.points, [light])[:, 0] > open_air / 2
        wrong += (
            ((room.irradiance(light, "direct")[:, 0] > open_air / 2) != visible) & front
        ).sum()
        facing += front.sum()
    assert wrong / facing < 0.05
    assert abs(local(room).report["misclassified_visibility"] - wrong / facing) < 0.02


def test_bounces_against_mitsubas_depth(room, opened_room):
    """Light reflected once, twice, and without end: what each run receives in all is that of
    Mitsuba at the same depth, and of no other.
    """
    light, sums, truths, noise = PointLight((0.3, 0.2, 0.5), 1.0), [], [], []
    for bounces in (1, 2, "auto"):
        few = dict(count=1500, cluster_size=150, depth_directions=256, example_lights=150)
        asset = room if bounces == "auto" else precompute(cornell(), bounces=bounces, **few)
        assert local(asset).report["bounces"] == bounces == (asset.reference_bounces or "auto")
        points, index = some(asset.points, 200)
        truth = reflected_truth(opened_room, light, points, 256, asset.reference_bounces)
        weight = points.areas[:, None]
        sums.append((weight * asset.irradiance(light, "indirect")[index]).sum() / weight.sum())
        truths.append((weight * truth.mean).sum() / weight.sum())
        noise.append(
            np.sqrt((weight**2 * truth.standard_error**2).sum()) / (weight * truth.mean).sum()
        )
    ratio = np.divide(sums, truths)
    assert (np.abs(ratio - 1) < 0.08 + largest_z(3) * np.array(noise)).all(), ratio
    assert truths[1] > 1.25 * truths[0] and truths[2] > 1.15 * truths[1]


# --- lights in odd places -------------------------------------------------------------------------

ODD_PLACES = {
    "on the floor": (0.5, -1, 0.5),
    "on the partition": (0.1, 0.2, -0.4),
    "in a corner": (1, 1, 1),
    "a hair off a corner": (0.9999, 0.9999, 0.9999),
    "in the block": (-0.5, -0.7, 0.3),
    "under the floor": (0.5, -1.001, 0.5),
    "in a wall's plane outside": (1, 3, 0),
    "far away": (300, 200, 100),
    "as far as numbers go": (1e18, 0, 0),
}


@pytest.mark.parametrize("place", ODD_PLACES)
def test_lights_in_odd_places(room, place):
    """Finite, not negative, and no more than twice what the light sends arrives, of all reflections
    (0.7 · 6 sides at most: × 3.3).
    """
    result = [
        room.irradiance(PointLight(ODD_PLACES[place], 1.0), component)
        for component in ("direct", "indirect", "total")
    ]
    assert all(np.isfinite(values).all() and (values >= 0).all() for values in result)
    areas = room.points.areas
    assert (areas @ result[1]).max() < 4 * np.pi * 3.3


@pytest.mark.parametrize("height", [0.0, 1e-20, 1e-6, 1e-3])
def test_a_light_at_a_sample(room, height):
    """A light in a sample has no direction there; above it by h it gives I/h² (as float32 numbers
    go). What the rest gets does not depend on it, and what is reflected stays what a light can
    send.
    """
    number = int(
        np.argmax(
            (room.points.normals[:, 1] > 0.9)
            & (np.abs(room.points.positions[:, [0, 2]] - [0.5, 0.5]).max(axis=1) < 0.2)
        )
    )
    place = room.points.positions[number].astype(np.float64) + height * room.points.normals[number]
    height = float(np.linalg.norm(place.astype(np.float32) - room.points.positions[number]))
    direct, indirect = (
        room.irradiance(PointLight(place, 1.0), component) for component in ("direct", "indirect")
    )
    assert np.isfinite(direct).all() and np.isfinite(indirect).all() and (indirect >= 0).all()
    np.testing.assert_allclose(direct[number], 1 / height**2 if height else 0, rtol=1e-3)
    assert np.delete(direct, number, axis=0).max() < 1 / (0.5 * room.points.layout.radius) ** 2
    assert 0.05 * 4 * np.pi < (room.points.areas @ indirect).max() < 3.3 * 4 * np.pi


def test_light_near_samples_against_mitsuba(room, opened_room):
    """A light 1e-3 m above a sample of the floor: all samples farther than three radii off get what
    Mitsuba's rays say, within 10 % of it in all; the near surroundings are told apart only as far
    as depth buffers go.
    """
    number = int(
        np.argmax(
            (room.points.normals[:, 1] > 0.9)
            & (np.abs(room.points.positions[:, [0, 2]] - [0.5, 0.5]).max(axis=1) < 0.2)
        )
    )
    light = PointLight(room.points.positions[number] + 1e-3 * room.points.normals[number], 1.0)
    truth = local_irradiance(opened_room.occluders, room.points, [light])
    far = (
        np.linalg.norm(room.points.positions - light.position, axis=1)
        > 3 * room.points.layout.radius
    )
    result = room.irradiance(light, "direct")
    assert relative_l2(result[far], truth[far]) < 0.25 and abs(bias(result[far], truth[far])) < 0.1


@pytest.fixture(scope="module")
def chambers():
    """Two closed rooms that share a wall without thickness."""
    parts = shell() | dict(other=eye((-0.5, 0, 0), (-1, 0, 0.1)), wall=screen(0.0))
    return precompute(scene(**parts))


@pytest.mark.parametrize(
    ("near", "far", "direct", "indirect"),
    [(0.3, 0.9, 0.003, 0.07), (0.1, 0.3, 0.05, 0.10), (0.02, 0.02, 0.005, 0.30)],
)
def test_light_behind_a_thin_wall(chambers, near, far, direct, indirect):
    """The truth behind the wall is darkness. Of what lights in the other room send, at most these
    shares arrive: from farther than 3 distances of samples from the wall, from 1 to 3, and from a
    fifth of one. Reflected light leaks because samples of the floor on both sides stand for the
    same places, in a strip as wide as their distance: that of the default count is a fifth of this
    one's.
    """
    points, random = chambers.points, np.random.default_rng(0)
    behind = (points.positions[:, 0] < -1e-4) | (
        (points.positions[:, 0] < 1e-4) & (points.normals[:, 0] < -0.9)
    )
    assert 15.7 < points.areas[behind].sum() < 16.3  # 4 sides of 2 m², 2 of 4 m²
    for _ in range(8):
        place = random.uniform(-0.9, 0.9, 3)
        place[0] = random.uniform(near, far)
        for component, most in (("direct", direct), ("indirect", indirect)):
            power = received(chambers, PointLight(place, 1.0), component)
            assert (
                power[behind].sum() < most * 4 * np.pi
                and power[~behind].sum() > 2.5 * power[behind].sum()
            )


@pytest.mark.parametrize(
    ("distance", "most"),
    [(0.02, 0.015), (0.1, 0.008), (0.2, 0.004), (0.5, 0.001), (10.0, 1e-6), (200.0, 1e-6)],
)
def test_light_outside_a_closed_room(chambers, distance, most):
    """No light gets in: of what is sent at a distance from the walls (samples are 0.1 m apart) at
    most this share, direct and reflected.
    """
    random = np.random.default_rng(3)
    for _ in range(8):
        place = random.uniform(-0.9, 0.9, 3)
        place[random.integers(3)] = (1 + distance) * random.choice([-1, 1])
        assert received(chambers, PointLight(place, 1.0)).sum() < most * 4 * np.pi


def test_lights_far_outside_of_an_open_scene():
    """At 100 times the scene's size a light is distant: irradiance I/r² · cos θ, shadows included,
    and its colour stays. From below the floor nothing is lit.
    """
    opened = open_scene(
        scene(
            eye=eye((0, 3, 3)),
            floor=rectangle(bsdf=diffuse(0.5)),
            box=cube((0.2, 0.3, 0), 0.3, bsdf=diffuse(0.5)),
        )
    )
    asset = precompute(opened.mi_scene, depth_directions=1024)
    for place in ([0, 300, 0], [240, 200, -120], [400, 60, 0]):
        light = PointLight(place, (1e5, 2e5, 0))
        truth = local_irradiance(opened.occluders, asset.points, [light])
        result = asset.irradiance(light, "direct")
        assert relative_l2(result, truth) < 0.22 and abs(bias(result, truth)) < 0.06
        assert not asset.irradiance(light)[:, 2].any()
    assert not asset.irradiance(PointLight([0, -300, 0], 1e5), "direct").any()


# --- the basis of direct light --------------------------------------------------------------------


@pytest.fixture(scope="module")
def hop(room, opened_room):
    """Samples of the room, the dense operator of one hop, and irradiance under examples and other
    lights, each scaled to its reflected flux.
    """
    samples = scattered(opened_room, 900, 90, 240)
    lights = np.concatenate(
        [values for _, values in trace_examples(opened_room, samples.points, samples.places)]
    )
    lights /= np.maximum(
        (samples.points.areas * samples.points.albedo.mean(axis=1)) @ lights, 1e-30
    )
    return (
        samples,
        one_hop(opened_room, samples, 1)[..., 0].astype(np.float32),
        lights[:, ::2].copy(),
        lights[:, 1::2].copy(),
    )


def represented(senders, clusters, light):
    """Light (n, e) in the patterns of each cluster."""
    return np.concatenate(
        [senders.decoder[c] @ (senders.encoder[c].T @ light[c]) for c in clusters]
    )


def test_importance_gives_better_reflections_than_pca(hop):
    """The paper's PCA has the least error of direct light; patterns fitted to what receivers get of
    it have the least of reflected light, also (by less) under lights that were no examples. Both
    are optimal for their own aim, of all bases of the same size.
    """
    samples, operator, examples, others = hop
    area, clusters = np.sqrt(samples.points.areas)[:, None], samples.clusters.slices
    pca = fit_senders(examples, np.eye(len(area), dtype=np.float32) * area, clusters, 8)
    important = fit_senders(examples, operator * area, clusters, 8)
    direct, reflected = {}, {}
    for name, senders in (("pca", pca), ("important", important)):
        direct[name] = relative_l2(area * represented(senders, clusters, examples), area * examples)
        reflected[name] = [
            relative_l2(
                area * (operator @ represented(senders, clusters, x)), area * (operator @ x)
            )
            for x in (examples, others)
        ]
    assert direct["pca"] < direct["important"]
    assert (
        reflected["important"][0] < 0.75 * reflected["pca"][0]
        and reflected["important"][1] < 0.9 * reflected["pca"][1]
    )


def test_sender_patterns_are_consistent(hop):
    """P is the left inverse of Q, coefficients are PᵀE of the examples, the captured share is one
    minus the squared error, and it grows with d.
    """
    samples, operator, examples, _ = hop
    captured = []
    for count in (2, 6, 12):
        senders = fit_senders(examples, operator, samples.clusters.slices, count)
        lost = total = 0.0
        for number, cluster in enumerate(samples.clusters.slices):
            p, q = senders.encoder[cluster].astype(float), senders.decoder[cluster].astype(float)
            np.testing.assert_allclose(p.T @ q, np.eye(count), atol=2e-3)
            np.testing.assert_allclose(
                p.T @ examples[cluster],
                senders.coefficients[number],
                atol=1e-3 * np.abs(senders.coefficients[number]).max(),
            )
            response = operator[:, cluster] @ examples[cluster]
            lost += np.sum((response - operator[:, cluster] @ (q @ (p.T @ examples[cluster]))) ** 2)
            total += np.sum(response.astype(float) ** 2)
        assert abs(senders.captured - (1 - lost / total)) < 1e-3
        captured.append(senders.captured)
    assert captured[0] < captured[1] < captured[2] <= 1


def test_senders_of_dark_clusters_are_zero():
    """No example reaches the second cluster, and only one pattern is in the first: what is not
    there is zero, not NaN.
    """
    examples = np.zeros((6, 4), np.float32)
    examples[:3] = np.outer([1, 2, 3], [1, 0, 2, 1])
    senders = fit_senders(examples, np.eye(6, dtype=np.float32), [slice(0, 3), slice(3, 6)], 3)
    assert (
        all(np.isfinite(x).all() for x in (senders.encoder, senders.decoder, senders.coefficients))
        and abs(senders.captured - 1) < 1e-6
    )
    assert (
        not senders.encoder[3:].any()
        and not senders.coefficients[1].any()
        and not senders.encoder[:, 1:].any()
    )
    np.testing.assert_allclose(
        represented(senders, [slice(0, 3), slice(3, 6)], examples), examples, atol=1e-5
    )
    dark = fit_senders(np.zeros((6, 4), np.float32), np.eye(6, dtype=np.float32), [slice(0, 6)], 2)
    assert dark.captured == 1 and not dark.encoder.any()


def test_leading_components():
    """Those of a singular value decomposition of NumPy, up to the sign; of a matrix of rank 3 there
    are 3, of zeros none.
    """
    random = np.random.default_rng(0)
    matrix = (random.standard_normal((60, 40)) * 0.7 ** np.arange(40)).astype(np.float32)
    left, values, right = leading_components(matrix, 6)
    expected = np.linalg.svd(matrix.astype(float), compute_uv=False)
    np.testing.assert_allclose(values, expected[:6], rtol=1e-3)
    assert np.linalg.norm(matrix - left * values @ right) < 1.01 * np.linalg.norm(expected[6:])
    low = (random.standard_normal((60, 3)) @ random.standard_normal((3, 40))).astype(np.float32)
    assert len(leading_components(low, 10)[1]) == 3
    assert len(leading_components(np.zeros((5, 7), np.float32), 3)[1]) == 0
    assert len(leading_components(matrix[:1], 10)[1]) == 1


# --- depth buffers --------------------------------------------------------------------------------


def plane_depths(count, extent, heights=(0.2, 1.5)):
    """Distances (count, 144) along a hemisphere's directions to a ceiling, at several heights, with
    a window in it.
    """
    vectors = Hemisphere(144).vectors
    height = np.linspace(*heights, count)[:, None]
    distance = height / np.maximum(vectors[:, 2], 1e-6)
    distance[:, np.abs(vectors[:, 0]) < 0.2] = np.inf
    return distance.astype(np.float32)


def test_log_depth_is_clamped():
    values = log_depth(np.array([0, 1e-9, 0.5, 3.0, 1e9, np.inf], np.float32), 2.0)
    np.testing.assert_allclose(values, np.log([2 * NEAREST, 2 * NEAREST, 0.5, 2, 2, 2]), rtol=1e-6)


def test_a_wall_is_two_terms_of_log_depth():
    """h/cos θ has a logarithm that is the sum of one of the point and one of the direction: the
    mean and one component are exact where nothing is clamped.
    """
    hemisphere = Hemisphere(144)
    distance = (np.linspace(0.5, 1.5, 30)[:, None] / hemisphere.vectors[:, 2]).astype(np.float32)
    extent = 1.01 * distance.max()
    assert NEAREST * extent < 0.5
    mean, vectors, coefficients = compress(distance, extent, hemisphere, 1)
    np.testing.assert_allclose(np.exp(mean + coefficients @ vectors.T), distance, rtol=1e-4)


@pytest.mark.parametrize("m", [1, 2, 30])
def test_depth_with_as_many_components_as_it_has_is_exact(m):
    """m points differ from their mean in m − 1 ways; further components are zero."""
    hemisphere, extent = Hemisphere(144), 5.0
    distance = plane_depths(m, extent)
    mean, vectors, coefficients = compress(distance, extent, hemisphere, 40)
    depth = DepthBuffers(mean[None], vectors[None], coefficients, extent)
    assert (
        vectors.shape == (144, 40)
        and coefficients.shape == (m, 40)
        and depth.hemisphere.rows == hemisphere.rows
    )
    np.testing.assert_allclose(
        depth.depth(slice(0, m), 0), np.clip(distance, NEAREST * extent, extent), rtol=1e-3
    )
    assert not coefficients[:, max(m - 1, 1) :].any()


def test_depth_that_does_not_vary_has_no_components():
    """All points see the same: nothing but the mean, and no NaN. So do points that see nothing."""
    hemisphere = Hemisphere(144)
    for distance in (
        np.tile(plane_depths(1, 5.0), (20, 1)),
        np.full((20, 144), np.inf, np.float32),
        np.zeros((20, 144), np.float32),
    ):
        mean, vectors, coefficients = compress(distance, 5.0, hemisphere, 8)
        assert np.isfinite(vectors).all() and np.isfinite(coefficients).all()
        result = np.exp(mean + coefficients @ vectors.T)
        np.testing.assert_allclose(result, np.clip(distance, NEAREST * 5, 5), rtol=1e-5)


def test_more_components_of_depth_are_better_and_weighted_by_the_cosine():
    """The error that is least is that of log-depth weighted by cos θ + GRAZING: that of a singular
    value decomposition of NumPy.
    """
    hemisphere, random = Hemisphere(144), np.random.default_rng(0)
    distance = (plane_depths(60, 5.0) * np.exp(0.3 * random.standard_normal((60, 144)))).astype(
        np.float32
    )
    values, weight = (
        log_depth(distance, 5.0).astype(float),
        np.sqrt(hemisphere.vectors[:, 2] + GRAZING),
    )
    spectrum = np.linalg.svd((values - values.mean(axis=0)) * weight, compute_uv=False)
    for count in (1, 5, 20):
        mean, vectors, coefficients = compress(distance, 5.0, hemisphere, count)
        error = np.linalg.norm((mean + coefficients @ vectors.T - values) * weight)
        assert (
            np.linalg.norm(spectrum[count:]) * 0.999
            < error
            < np.linalg.norm(spectrum[count:]) * 1.02
        )


# --- dropping within a budget ---------------------------------------------------------------------


def random_matrix(seed=0, c=4, q=6, k=40, channels=3):
    """Rows and entries of sizes over several orders of magnitude, the largest rows first, with
    zeros among them.
    """
    random = np.random.default_rng(seed)
    matrix = (
        random.standard_normal((c, q, k, channels))
        * np.exp(-random.uniform(0, 6, (c, q, k, 1)))
        * 0.5 ** np.arange(q)[:, None, None]
    )
    matrix[random.random(matrix.shape) < 0.1] = 0
    return matrix.astype(np.float32), (random.standard_normal((k, 30)) + 0.3).astype(np.float32)


def made_error(matrix, reduced, examples):
    """Relative RMS error of what examples cause, written out."""
    before, after = (
        np.einsum("cqkx,ke->cqxe", m.astype(float), examples.astype(float))
        for m in (matrix, reduced)
    )
    return relative_l2(after, before)


@pytest.mark.parametrize("seed", range(3))
def test_the_budget_is_kept(seed):
    """The error is what is told, within the budget; the more is allowed the more is dropped; a
    budget of 0 drops nothing but zeros.
    """
    matrix, examples = random_matrix(seed)
    left = []
    for budget in (0.0, 0.003, 0.03, 0.3, 0.9):
        reduced, ranks, error = within_budget(matrix, examples, budget)
        assert (
            error <= budget
            and abs(error - made_error(matrix, reduced, examples)) < 1e-4 + 1e-3 * budget
        )
        assert ((reduced == 0) | (reduced == matrix)).all()
        assert all(
            not reduced[i, rank:].any() and (rank == 0 or reduced[i, rank - 1].any())
            for i, rank in enumerate(ranks)
            if budget < 0.3
        )
        left.append((reduced != 0).sum())
        if budget == 0:
            np.testing.assert_array_equal(reduced, matrix)
    assert left == sorted(left, reverse=True) and left[0] > 1.5 * left[2] > 1.5 * left[4] > 0


def test_the_budget_is_kept_where_entries_pull_the_same_way():
    """A thousand entries that are a thousandth of the whole each, under light that adds all of
    them: none may be dropped as if errors averaged out.
    """
    matrix, examples = np.full((1, 3, 1000, 1), 1e-3, np.float32), np.ones((1000, 1), np.float32)
    reduced, _, error = within_budget(matrix, examples, 0.05)
    assert made_error(matrix, reduced, examples) <= 0.05 and error <= 0.05


def test_budgets_of_nothing():
    """A matrix of zeros, no example light, and a single entry: no error, no NaN."""
    for matrix, examples in (
        (np.zeros((2, 3, 4, 1)), np.ones((4, 2))),
        (np.ones((2, 3, 4, 1)), np.zeros((4, 2))),
        (np.ones((1, 1, 1, 3)), np.ones((1, 1))),
    ):
        reduced, ranks, error = within_budget(
            matrix.astype(np.float32), examples.astype(np.float32), 0.1
        )
        assert (
            np.isfinite(reduced).all()
            and np.isfinite(error)
            and error <= 0.1
            and len(ranks) == len(matrix)
        )


def test_the_report_tells_the_error_that_dropping_made(furnace):
    """Against the run that drops nothing: within the budget of 1 %, under example lights."""
    report = local(furnace).report
    assert 0 < report["transfer_error"] <= furnace.settings["transfer_error"] == 0.01
    assert 0 < report["transfer_density"] < 1 and 0 < report["transfer_rank"] <= 64


# --- all reflections ------------------------------------------------------------------------------


def hops(size=7, channels=3, radius=0.6, seed=0):
    """Random matrices of a spectral radius."""
    matrix = np.random.default_rng(seed).standard_normal((channels, size, size))
    matrix *= radius / np.abs(np.linalg.eigvals(matrix)).max(axis=1)[:, None, None]
    return np.moveaxis(matrix, 0, 2)


@pytest.mark.parametrize("bounces", [1, 2, 3, 8, None], ids=str)
def test_all_reflections_are_a_neumann_series(bounces):
    """1 + B + … up to the power bounces − 1; the last reflection is that to the receivers.

    All of them is the limit, at 0.6²⁰⁰ ≈ 0.
    """
    hop = hops()
    result = all_reflections(hop, bounces)
    for channel in range(3):
        expected = sum(
            np.linalg.matrix_power(hop[..., channel], power)
            for power in range(200 if bounces is None else bounces)
        )
        np.testing.assert_allclose(result[..., channel], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "growing",
    [
        hops(radius=1.01),
        hops(radius=1.0),
        np.stack([hops(radius=0.5)[..., 0], hops(radius=1.5)[..., 0]], axis=2),  # one channel alone
        np.array([[0, -1.1], [1.1, 0]])[..., None],  # turns and grows: complex eigenvalues
        np.diag([-1.2, 0.1])[..., None],
        # does nothing to equal coefficients, and 1.25 to opposite ones
        np.array([[0.625, -0.625], [-0.625, 0.625]])[..., None],
    ],
    ids=["above one", "one", "one channel", "turning", "negative", "hidden"],
)
def test_reflections_that_do_not_end_are_refused(growing):
    """(1 − B)⁻¹ would exist and be wrong. So many bounces as are asked for are finite and given."""
    with pytest.raises(SceneError, match="lower the albedo, or ask for a number of bounces"):
        all_reflections(growing)
    assert np.isfinite(all_reflections(growing, 3)).all()


def test_reflections_that_grow_before_they_end_are_not_refused():
    """Powers of a matrix may grow at first: only the spectral radius tells."""
    hop = np.array([[0.5, 100.0], [0.0, 0.5]])[..., None]
    np.testing.assert_allclose(all_reflections(hop)[..., 0], [[2, 400], [0, 2]], rtol=1e-9)
    np.testing.assert_allclose(
        all_reflections(np.array([[0.0, 5.0], [0.0, 0.0]])[..., None])[..., 0], [[1, 5], [0, 1]]
    )


# --- gathering and transfer -----------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3])
def test_gathered_is_the_dense_product(channels):
    """Random things seen, `NOTHING` among them, by more points than are gathered at a time: entry
    by entry.
    """
    random, m, count, n, c, d = np.random.default_rng(0), 150, 20, 40, 5, 3
    sample = random.integers(0, n, (m, count)).astype(np.uint32)
    sample[random.random((m, count)) < 0.2] = NOTHING
    sample[7] = NOTHING
    seen = Hemispheres(
        np.ones((m, count), np.float32),
        sample,
        random.random((m, count, channels), dtype=np.float32),
    )
    weights, features = (
        random.random(count, dtype=np.float32),
        random.standard_normal((n, d)).astype(np.float32),
    )
    labels = np.sort(random.integers(0, c, n)).astype(np.int32)
    expected = np.zeros((m, c, d, channels))
    for i in range(m):
        for j in range(count):
            if sample[i, j] != NOTHING:
                expected[i, labels[sample[i, j]]] += weights[j] * np.outer(
                    features[sample[i, j]], seen.albedo[i, j]
                )
    np.testing.assert_allclose(
        gathered(seen, weights, labels, c, features), expected, rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("channels", [1, 3])
def test_transfer_is_its_formula(channels):
    """E_r = U_r Σ_s M_rs P_sᵀ E_s, summed up pair by pair."""
    random, c, q, d = np.random.default_rng(1), 3, 4, 2
    clusters = [slice(0, 5), slice(5, 6), slice(6, 13)]
    encoder, receivers = (random.standard_normal((13, k)).astype(np.float32) for k in (d, q))
    matrix = random.standard_normal((c, q, c * d, channels)).astype(np.float32)
    light = random.random((13, 3), dtype=np.float32)
    result = Transfer(encoder, receivers, matrix).indirect(light, clusters)
    for r in range(c):
        for channel in range(3):
            m = matrix[r, :, :, min(channel, channels - 1)].reshape(q, c, d)
            expected = sum(
                receivers[clusters[r]]
                @ (m[:, s] @ (encoder[clusters[s]].T @ light[clusters[s], channel]))
                for s in range(c)
            )
            np.testing.assert_allclose(result[clusters[r], channel], expected, rtol=1e-4, atol=1e-4)


# --- the kernel of direct light -------------------------------------------------------------------


def test_moving_lights_compile_nothing(room):
    """After the first call: other places, colours, kinds and numbers of lights run the same
    kernels. The number of lights changes the width of no kernel, the number of points is that of
    the asset.
    """
    room.irradiance(LIGHTS[0])
    lights = [
        *LIGHTS,
        list(LIGHTS),
        AreaLight((0.2, 0.5, 0.4), (0.2, 0, 0), (0, 0, 0.1), 1.0, 16),
        [PointLight((x, 0.1, 0.3), 2.0) for x in (0.2, 0.3)],
    ]
    with count_kernels() as kernels:
        for light in lights:
            for component in ("direct", "indirect", "total"):
                room.irradiance(light, component)
    assert kernels.compiled == 0 and kernels.launched >= 3 * len(lights)


def to_square(direction):
    """Shirley and Chiu's concentric map, inverted: unit vectors (…, 3) to the unit square (…, 2),
    by its definition.

    On the disk r² = 1 − cos θ = sin² θ / (1 + cos θ), and an angle of π/4 is an edge's half. Below
    the horizon cos θ counts as 0.
    """
    r = np.linalg.norm(direction[..., :2], axis=-1) / np.sqrt(1 + np.maximum(direction[..., 2], 0))
    phi = np.arctan2(direction[..., 1], direction[..., 0])
    phi = np.where(phi < -np.pi / 4, phi + 2 * np.pi, phi)
    quarter = np.floor((phi + np.pi / 4) / (np.pi / 2)).astype(int)
    along = (phi - quarter * np.pi / 2) * r * 4 / np.pi
    a = np.choose(quarter % 4, [r, -along, -r, along])
    b = np.choose(quarter % 4, [along, r, -along, -r])
    return np.stack([a, b], axis=-1) / 2 + 0.5


def test_to_square_inverts_the_grid():
    """The directions of a grid are its cell centres: this file's own map agrees with the core's."""
    hemisphere = Hemisphere(24)
    j, i = np.indices((hemisphere.rows, hemisphere.columns)).reshape(2, -1)
    expected = np.stack([(i + 0.5) / hemisphere.columns, (j + 0.5) / hemisphere.rows], axis=-1)
    np.testing.assert_allclose(to_square(hemisphere.vectors.astype(float)), expected, atol=1e-5)


def direct_by_formula(asset, emission, sides):
    """Irradiance (n, 3), and averaged over areas, as the documentation says it: point by point,
    place by place.

    `sides` (k, 8) tell of each place which surface it stands over, see
    `test_what_a_light_stands_over`.
    """
    points, depth, hemisphere = asset.points, local(asset).depth, local(asset).depth.hemisphere
    clusters = local(asset).clusters.slices
    rotations = np.concatenate([cluster_frames(points.normals[cluster]) for cluster in clusters])
    distances = np.concatenate(
        [depth.depth(cluster, number) for number, cluster in enumerate(clusters)]
    ).astype(float)
    rows, columns = hemisphere.rows, hemisphere.columns
    cell = CELLS * np.sqrt(2 * np.pi / len(hemisphere))
    plain, averaged = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    for k, i in np.ndindex(len(emission), len(points)):
        toward = emission.positions[k].astype(float) - points.positions[i]
        r, height = np.linalg.norm(toward), toward @ points.normals[i].astype(float)
        strength = emission.shape(np.tile(-toward / r, (len(emission), 1)))[k]
        if height <= 0 or strength <= 0:
            continue
        away, clearance, room = sides[k, :3], sides[k, 3], sides[k, 4]
        in_front = toward @ away < 0
        free = room if in_front else np.inf
        pushed = toward + away * max(min(CLEARANCE * r, free) - clearance, 0)
        compared = min(
            np.linalg.norm(pushed) - min((TOLERANCE if in_front else BEHIND) * r, free),
            FAR * depth.extent,
        )
        seen_in = toward + away * max(min(cell * r, free) - clearance, 0)
        at = to_square(seen_in / np.linalg.norm(seen_in) @ rotations[i]) * [columns, rows] - 0.5
        at = np.clip(at, 0, [columns - 1, rows - 1])
        u, v = np.minimum(at.astype(int), [columns - 2, rows - 2])
        x, y = at - [u, v]
        visible = 0.0
        for row, column, share in (
            (v, u, (1 - x) * (1 - y)),
            (v, u + 1, x * (1 - y)),
            (v + 1, u, (1 - x) * y),
            (v + 1, u + 1, x * y),
        ):
            visible += share * np.clip(
                (distances[i, row * columns + column] / compared - 1) / SOFTNESS + 0.5, 0, 1
            )
        raised = np.sqrt(height**2 + RAISE * points.areas[i])
        light = emission.intensity[k] * visible * strength
        plain[i] += light * height / r**3
        averaged[i] += light * raised / (r**2 - height**2 + raised**2) ** 1.5
    return plain, averaged


@pytest.mark.parametrize("height", [0.05, 0.01, -0.05, 1.0])
def test_what_a_light_stands_over(room, height):
    """Over the floor, its normal and the height; under it, the other side.

    Not more than three quarters of what is free ahead are its room.
    """
    away, clearance, free = np.split(
        direct_kernel(room)._sides(emission_of(as_light(PointLight((0.5, height - 1, 0.5), 1.0))))[
            0, :5
        ],
        [3, 4],
    )
    if height < 0.5:
        np.testing.assert_allclose(away, [0, np.sign(height), 0], atol=1e-5)
        assert abs(clearance[0] - abs(height)) < 1e-5
    assert 0 <= free[0] <= 0.75 * 2


def test_the_kernel_is_its_formula():
    """A tiny asset, all of it: a NumPy program of the same formula agrees to float32.

    Lights of all kinds, near, far and on a surface.
    """
    asset = precompute(
        cornell(),
        count=40,
        cluster_size=12,
        depth_directions=16,
        depth_coefficients=3,
        example_lights=20,
        quantize="none",
    )
    kernel = direct_kernel(asset)
    lights = [
        PointLight((0.38, -0.53, 0.7), (3.0, 2.0, 1.0)),
        PointLight((0.5, -0.999, 0.5), 1.0),
        PointLight((30, 200, 10), 1e4),
        SpotLight((0.6, 0.8, 0.5), (-0.5, -1, -0.3), 5.0, 60, 20),
        AreaLight((0.5, 1, 0.3), (0.3, 0, 0), (0, 0, 0.3), 4.0, 4),
    ]
    for light in lights:
        emission = emission_of(as_light(light))
        for result, expected in zip(
            kernel.irradiance(emission), direct_by_formula(asset, emission, kernel._sides(emission))
        ):
            assert np.abs(result - expected).max() < 2e-3 * expected.max(initial=1e-6)
    assert (
        np.mean(
            [x.any() for light in lights for x in kernel.irradiance(emission_of(as_light(light)))]
        )
        >= 0.6
    )
    together, apart = (
        kernel.irradiance(emission_of(as_light(part))) for part in (lights, lights[:1])
    )
    for total, one in zip(together, apart):
        assert (np.array(total) >= np.array(one) * (1 - 1e-5)).all()


def test_no_light_is_dark(room):
    assert not any(
        values.any()
        for values in direct_kernel(room).irradiance(
            emission_of(as_light(PointLight((0, 0, 0), 1.0)).distant)
        )
    )
