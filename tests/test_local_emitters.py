"""Point, spot and area lights as one emission: closed forms, Mitsuba's own emitters, scenes' own
lights, and bad input.
"""

import warnings

import numpy as np
import pytest
import trimesh
from conftest import (
    bias,
    cube,
    diffuse,
    disk,
    rectangle,
    relative_l2,
    scene,
    sphere,
    uniform_directions,
    uniform_sky,
)

import mi_prt
from mi_prt import (
    AreaLight,
    DirectionalLight,
    LightError,
    PointLight,
    SceneError,
    SceneLight,
    SettingsError,
    SpotLight,
)
from mi_prt.directions import parse_directions
from mi_prt.evaluate.ground_truth import point_irradiance
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.emission import Emission, emission_of, flat_emission
from mi_prt.lighting.light import Light, as_light
from mi_prt.lighting.local_emitters import local_scene_light
from mi_prt.lighting.parse import parse_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()
UP = np.array([0.0, 1.0, 0.0])


def rgb(value):
    return {"type": "rgb", "value": value}


def area(radiance):
    return {"type": "area", "radiance": radiance if isinstance(radiance, dict) else rgb(radiance)}


def looking(origin, target):
    return mi.ScalarTransform4f().look_at(origin, target, [1, 0, 0])


def floor_places(count=500, size=2.0, seed=0):
    """Places (count, 3) on the floor y = 0, and its normals."""
    places = np.random.default_rng(seed).uniform(-size, size, (count, 3)) * [1, 0, 1]
    return places, np.broadcast_to(UP, places.shape)


def floor_irradiance(light):
    return emission_of(as_light(light)).irradiance(*floor_places())


def truth_on_floor(mi_scene, spp=1 << 15):
    """144 points on the floor y = 0, and Mitsuba's irradiance (Reference) there in a scene."""
    points = sample_points(open_scene(scene(floor=rectangle(size=2))), 0.25)
    return points, point_irradiance(mi_scene, points, spp)


def sampled_by_mitsuba(emitter, places):
    """Irradiance (n, 3) of a floor at some places by one of Mitsuba's emitters that stand in one
    place.
    """
    import drjit as dr

    it = dr.zeros(mi.SurfaceInteraction3f, len(places))
    it.p = mi.Point3f(places.T.astype(np.float32))
    sample, weight = mi.load_dict(emitter).sample_direction(it, mi.Point2f(0.5))
    return (np.array(mi.Color3f(weight)) * np.maximum(np.array(sample.d)[1], 0)).T


def polygon_irradiance(corners, radiance, place, normal):
    """Lambert's formula for a polygon of one radiance above a surface's horizon: E = L/2 |Σ θ_i
    n·Γ_i|.
    """
    toward = (corners - place) / np.linalg.norm(corners - place, axis=1, keepdims=True)
    following = np.roll(toward, -1, axis=0)
    across = np.cross(toward, following)
    angles = np.arccos(np.clip((toward * following).sum(axis=1), -1, 1))
    return (
        radiance
        / 2
        * abs(angles @ (across / np.linalg.norm(across, axis=1, keepdims=True) @ normal))
    )


def corners_of(light):
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    return light.centre + signs[:, :1] * light.edge_u + signs[:, 1:] * light.edge_v


# sheared, shines down
LAMP = AreaLight([0.3, 1.0, -0.2], [0.8, 0, 0.1], [0.3, 0.2, 0.6], [3, 2, 1], samples=25)


# --- closed forms ---------------------------------------------------------------------------------


def test_irradiance_of_a_point_light_is_the_inverse_square_law():
    light = PointLight([0.2, 1.5, 0.4], [3, 2, 1])
    places, _ = floor_places()
    toward = light.position - places
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(
        floor_irradiance(light), light.intensity * toward[:, 1:2] / distance**3, rtol=1e-6
    )


def test_the_truth_close_to_a_large_lamp():
    """A lamp 2 cm above a floor. A sample of its area alone may count 200 times the mean (noise
    of 75 %); beside rays of directions each counts a few times at most. χ² of all points within 6
    standard deviations: false positives below 1e-8.
    """
    height, radiance = 0.02, 5.0
    lamp = rectangle((0, -1, 0), (0, height, 0), 1.0, emitter=area(radiance))
    points = sample_points(open_scene(scene(floor=rectangle(size=1.2))), 0.2)
    found = point_irradiance(mi.load_dict(scene(lamp=lamp)), points, 1024, 5)
    corners = np.array([[-1, height, -1], [1, height, -1], [1, height, 1], [-1, height, 1]])
    expected = [
        polygon_irradiance(corners, radiance, p, np.array([0, 1, 0])) for p in points.positions
    ]
    assert found.noise < 0.03
    z = (found.mean[:, 0] - expected) / found.standard_error[:, 0]
    assert abs((z**2).sum() - len(z)) < 6 * np.sqrt(2 * len(z))


def test_power_of_a_spot_is_that_of_its_cone():
    """∫ I f dω over the sphere: with a step at the cutoff (beam = cutoff) 2π (1 − cos c), and with
    a beam of 0 falling linearly 2π (1 − sin(c)/c). By 400,000 uniform directions: within 2 % for
    cones of a steradian (a z of 5).
    """
    directions = uniform_directions(np.random.default_rng(1), 400_000)
    c = np.radians(40)
    for beam, share in ((40, 1 - np.cos(c)), (0, 1 - np.sin(c) / c)):
        emission = emission_of(as_light(SpotLight([0, 0, 0], [1, -2, 0.5], 1, 40, beam)))
        assert 4 * np.pi * emission.shape(directions[:, None]).mean() == pytest.approx(
            2 * np.pi * share, rel=0.02
        )


def test_spot_is_full_in_its_beam_and_dark_from_the_cutoff_on():
    """At angles of 0, 15, 20, 25, 30 and 180 degrees: the fall from 15 to 25 is linear."""
    emission = emission_of(as_light(SpotLight([0, 0, 0], [0, 0, 3], 1, 25, 15)))
    angles = np.radians([0, 15 - 1e-4, 20, 25, 30, 180])
    directions = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    np.testing.assert_allclose(
        emission.shape(directions[:, None])[:, 0], [1, 1, 0.5, 0, 0, 0], atol=1e-5
    )
    assert SpotLight([0, 0, 0], [0, 0, 1], 1, 24).beam_degrees == 18


@pytest.mark.parametrize(("samples", "limit"), [(1, 0.25), (25, 0.01), (400, 6e-4)])
def test_area_light_tends_to_lamberts_formula(samples, limit):
    """The midpoint rule's error falls with the square of the parts' width, as 1/samples."""
    light = AreaLight(LAMP.centre, LAMP.edge_u, LAMP.edge_v, LAMP.radiance, samples)
    places, _ = floor_places()
    expected = np.array(
        [polygon_irradiance(corners_of(light), light.radiance, place, UP) for place in places]
    )
    result = floor_irradiance(light)
    assert result.shape == expected.shape and expected.min() > 0
    assert relative_l2(result, expected) < limit and abs(bias(result, expected)) < limit


def test_area_light_shines_to_one_side_only():
    """Turned over, by its edges in the other order, the floor is dark and a ceiling would not
    be.
    """
    turned = AreaLight(LAMP.centre, LAMP.edge_v, LAMP.edge_u, LAMP.radiance)
    places, normals = floor_places()
    assert floor_irradiance(LAMP).min() > 0 and not floor_irradiance(turned).any()
    assert emission_of(as_light(turned)).irradiance(places + 2 * UP, -normals).min() > 0
    np.testing.assert_allclose(LAMP.normal, -turned.normal)
    assert LAMP.area == pytest.approx(np.linalg.norm(np.cross(LAMP.edge_u, LAMP.edge_v)))


def test_power_of_an_area_light_does_not_depend_on_its_samples():
    """Σ I = L A, in places that lie in the parallelogram and are as many as asked for."""
    for samples in (1, 4, 49):
        light = AreaLight(LAMP.centre, LAMP.edge_u, LAMP.edge_v, LAMP.radiance, samples)
        emission = emission_of(as_light(light))
        assert len(emission) == samples and len(np.unique(emission.positions, axis=0)) == samples
        np.testing.assert_allclose(
            emission.intensity.sum(axis=0), light.radiance * light.area, rtol=1e-5
        )
        np.testing.assert_allclose(emission.positions.mean(axis=0), light.centre, atol=1e-6)
        inside = np.linalg.lstsq(
            np.stack([light.edge_u, light.edge_v], axis=-1), (emission.positions - light.centre).T
        )[0]
        assert np.abs(inside).max() < 0.5


def test_emission_of_a_sum_is_the_sum_and_of_nothing_is_nothing():
    lights = [
        PointLight([0, 1, 0], 1),
        SpotLight([1, 1, 0], [0, -1, 0], [1, 2, 3]),
        LAMP,
        PointLight([2, 1, 0], 5),
    ]
    own = flat_emission([[0, 2, 0]], [[0, -1, 0]], [[1, 1, 1]])
    light = as_light([*lights, own, uniform_sky(), DirectionalLight([0, -1, 0], 1)])
    assert len(emission_of(light)) == 1 + 1 + 25 + 1 + 1
    np.testing.assert_allclose(
        floor_irradiance(light), sum(map(floor_irradiance, [*lights, own])), rtol=1e-6
    )
    assert light.local.parts == light.parts[:5] and light.distant.parts == light.parts[5:]
    assert light.distant.local.is_empty and not light.local.is_empty
    np.testing.assert_array_equal(floor_irradiance(light.local), floor_irradiance(light))
    nothing = emission_of(light.distant)
    assert len(nothing) == 0 and not nothing.irradiance(*floor_places()).any()
    assert light.rotated("y", 90).local.parts == light.local.parts


def test_extreme_places_and_strengths_are_finite():
    """In a light there is no direction, so no light; far away it fades; strength scales exactly
    while float32 holds it.
    """
    places, normals = floor_places(50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        here = emission_of(as_light(PointLight(places[3], 1e6)))
        assert (
            not here.irradiance(here.positions, UP[None]).any()
            and np.isfinite(here.irradiance(places, normals)).all()
        )
        for light in (
            PointLight([0, 1e30, 0], 1e6),
            SpotLight([0, 1e30, 0], [0, -1, 0], 1e6, 1e-3),
            LAMP,
        ):
            assert np.isfinite(emission_of(as_light(light)).irradiance(places, normals)).all()
        assert not floor_irradiance(SpotLight([0, 1, 0], [0, -1, 0], 0)).any()
        one, many = (
            floor_irradiance(AreaLight([0, 1, 0], [1, 0, 0], [0, 0, 1], radiance))
            for radiance in (1, 1e6)
        )
    np.testing.assert_allclose(many, 1e6 * one, rtol=1e-6)


# --- Mitsuba's own emitters -----------------------------------------------------------------------


@pytest.mark.parametrize("angles", [(20, None), (90, 0), (45, 45), (60, 30), (5, 2.5)])
def test_spot_is_mitsubas(angles):
    """The same falloff to float32 rounding of cosines: 6e-8, at 5 degrees 1e-6 rad of a transition
    of 0.04, is below 1e-4.
    """
    cutoff, beam = angles
    light = SpotLight([0.3, 1, 0.2], [0.3, -1, 0.1], [3, 2, 1], cutoff, beam)
    emitter = {
        "type": "spot",
        "to_world": looking([0.3, 1, 0.2], [0.6, 0, 0.3]),
        "intensity": rgb([3, 2, 1]),
    }
    emitter["cutoff_angle"] = cutoff
    if beam is not None:
        emitter["beam_width"] = beam
    places, normals = floor_places(20_000)
    expected = sampled_by_mitsuba(emitter, places)
    result = emission_of(as_light(light)).irradiance(places, normals)
    assert (expected > 0).sum() > 10
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-4 * expected.max())


def test_lights_become_mitsubas_emitters():
    """A floor lit by Mitsuba's emitters of all kinds, sampled in strata; the lights agree to the
    area light's own error at 400 samples (6e-4) and Mitsuba's noise. The sheared rectangle is as
    Mitsuba has it.
    """
    finer = AreaLight(LAMP.centre, LAMP.edge_u, LAMP.edge_v, LAMP.radiance, 400)
    # None stands between another and the floor, where the rectangle would cast a shadow.
    for light in (
        SpotLight([0.4, 1, 0], [0, -1, 0.4], [1, 2, 3], 50),
        PointLight([0, 2, 1], 4),
        finer,
    ):
        points, truth = truth_on_floor(
            lit_scene(mi.load_dict(scene(floor=rectangle(size=2))), light)
        )
        result = emission_of(as_light(light)).irradiance(points.positions, points.normals)
        assert truth.noise < 0.003
        assert (
            relative_l2(result, truth.mean) < 0.001 + 2 * truth.noise
            and abs(bias(result, truth.mean)) < 0.001
        )


def test_a_spot_in_the_direction_of_an_axis_has_a_place_in_mitsuba():
    """Looking along any axis needs an up vector that is another."""
    for direction in (*np.eye(3), *-np.eye(3)):
        lit = lit_scene(mi.load_dict(scene(s=sphere())), SpotLight([0, 0, 0], direction, 1))
        (found,) = local_scene_light(open_scene(lit)).parts
        np.testing.assert_allclose(found.direction, direction, atol=1e-6)


def test_area_light_in_mitsuba_is_a_black_shape():
    """Its rectangle hides what is behind and reflects nothing, so that the truth has no light that
    this program has not.
    """
    dark_floor = scene(floor=rectangle(size=2))
    lit = lit_scene(
        mi.load_dict(dark_floor),
        [AreaLight([0, 1, 0], [1, 0, 0], [0, 0, 1], 0), PointLight([0, 2, 0], 1)],
    )
    lamp = next(shape for shape in lit.shapes() if shape.is_emitter())
    assert not np.any(np.array(mi.traverse(lamp.bsdf())["reflectance.value"]))
    points, truth = truth_on_floor(lit, 64)
    below = np.abs(points.positions[:, [0, 2]]).max(axis=1) < 0.9
    assert not truth.mean[below].any() and truth.mean[~below].max() > 0


# --- a scene's own light --------------------------------------------------------------------------


def test_own_point_and_spot_lights_are_taken_as_they_are():
    parts = scene(
        floor=rectangle(),
        bulb={
            "type": "point",
            "to_world": mi.ScalarTransform4f().translate([100, 2, 0.3]),
            "intensity": rgb([1, 2, 3]),
        },
        spot={
            "type": "spot",
            "to_world": looking([0, 1.5, 0], [0.3, 0, 0]),
            "intensity": rgb([5, 2, 3]),
            "cutoff_angle": 50.0,
        },
        wide={"type": "spot", "cutoff_angle": 90.0, "beam_width": 90.0},
    )
    light = local_scene_light(open_scene(parts))
    (bulb,) = (part for part in light.parts if part.kind == "point")
    spots = (part for part in light.parts if part.kind == "spot")
    np.testing.assert_allclose(bulb.position, [100, 2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(bulb.intensity, [1, 2, 3], rtol=1e-5)
    spot, wide = sorted(spots, key=lambda spot: spot.cutoff_degrees)
    np.testing.assert_allclose(spot.position, [0, 1.5, 0], rtol=1e-6)
    np.testing.assert_allclose(
        spot.direction, np.array([0.3, -1.5, 0]) / np.hypot(0.3, 1.5), atol=1e-6
    )
    np.testing.assert_allclose(spot.intensity, [5, 2, 3], rtol=1e-5)
    np.testing.assert_allclose([spot.cutoff_degrees, spot.beam_degrees], [50, 37.5], rtol=1e-6)
    assert (wide.cutoff_degrees, wide.beam_degrees) == (90, 90)


def ellipsoid(tmp_path):
    """A smooth mesh of 1,280 triangles, many more than samples."""
    ball = trimesh.creation.icosphere(3, 0.5)
    ball.apply_scale([1, 0.4, 0.6])
    ball.apply_translation([0, 1.2, 0])
    ball.export(tmp_path / "ball.ply")
    return {"type": "ply", "filename": str(tmp_path / "ball.ply"), "face_normals": True}


SHAPES = {
    "rectangle": rectangle((0.3, -1, 0), (0, 1.2, 0), 0.5),
    "disk": disk((0, -1, 0.2), (0, 1.2, 0), 0.5),
    "sphere": sphere((0.3, 1.3, 0), 0.3),
    "cylinder": {"type": "cylinder", "p0": [-0.5, 1.2, 0], "p1": [0.5, 1.2, 0.2], "radius": 0.1},
    "plate": {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 1.2, 0]).scale([0.5, 0.01, 0.4]),
    },
    "mesh": None,
}


@pytest.mark.parametrize("name", SHAPES)
def test_own_area_emitters_are_mitsubas(name, tmp_path):
    """The floor below convex shapes, which do not hide themselves. The quadrature over 64 places of
    half the distance's size has an error of up to 3 % (the mesh, whose samples run along its list
    of faces), a third or less of it with 256; Mitsuba's noise is below 1 %.
    """
    shape = SHAPES[name] or ellipsoid(tmp_path)
    opened = open_scene(scene(floor=rectangle(size=2), lamp=shape | {"emitter": area([3, 2, 1])}))
    points, truth = truth_on_floor(lit_scene(opened))
    assert truth.noise < 0.01
    for samples, limit in ((64, 0.03), (256, 0.01)):
        (emission,) = local_scene_light(opened, samples).parts
        result = emission.irradiance(points.positions, points.normals)
        assert len(emission) == samples
        assert (
            relative_l2(result, truth.mean) < limit + 2 * truth.noise
            and abs(bias(result, truth.mean)) < limit
        )


def test_a_sphere_shines_as_if_from_its_centre():
    """A sphere of radiance L and radius R above the horizon: E = π L R²/d² cos θ, exactly."""
    centre, radius = np.array([0.2, 1.5, 0.1]), 0.4
    opened = open_scene(scene(lamp=sphere(centre, radius, emitter=area([1, 2, 0.5]))))
    places, normals = floor_places()
    toward = centre - places
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    expected = np.pi * np.array([1, 2, 0.5]) * (radius / distance) ** 2 * toward[:, 1:2] / distance
    result = emission_of(local_scene_light(opened, 256)).irradiance(places, normals)
    assert relative_l2(result, expected) < 0.005 and abs(bias(result, expected)) < 0.002


def test_textured_emitters_keep_their_power():
    """A 16 × 16 picture, black but for one pixel in eight, on a square of 1 m²: Σ I is its mean,
    though 64 places between 256 pixels would miss most. What is left, 2 %, is the error of 4,096
    samples of edges. The floor is lit as by Mitsuba.
    """
    rng = np.random.default_rng(4)
    picture = rng.random((16, 16, 3)).astype(np.float32) * (rng.random((16, 16, 1)) < 0.125)
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(picture.astype(np.float32)),
        "filter_type": "nearest",
        "raw": True,
    }
    lamp = rectangle((0, -1, 0), (0, 1, 0), 0.5, emitter=area(texture))
    opened = open_scene(scene(floor=rectangle(size=2), lamp=lamp))
    (emission,) = local_scene_light(opened).parts
    np.testing.assert_allclose(emission.intensity.sum(axis=0), picture.mean(axis=(0, 1)), rtol=0.02)
    points, truth = truth_on_floor(lit_scene(opened))
    result = emission.irradiance(points.positions, points.normals)
    assert (
        relative_l2(result, truth.mean) < 0.02 + 2 * truth.noise
        and abs(bias(result, truth.mean)) < 0.02
    )


def test_the_lights_of_a_scene_add_up_and_are_the_same_each_time():
    parts = scene(
        floor=rectangle(size=2),
        bulb={"type": "point", "position": [-1, 1, 0]},
        lamp=sphere((1, 1, 0), 0.1, emitter=area(3.0)),
        panel=rectangle((0, -1, 0), (0, 1.5, 1), 0.2, emitter=area([1, 2, 3])),
    )
    light, again = (local_scene_light(open_scene(parts), 16) for _ in range(2))
    assert [part.kind for part in light.parts] == ["point", "emission", "emission"]
    assert len(emission_of(light)) == 33
    for name in ("positions", "axes", "intensity"):
        np.testing.assert_array_equal(
            getattr(emission_of(light), name), getattr(emission_of(again), name)
        )
    points, truth = truth_on_floor(lit_scene(open_scene(parts)))
    lower = points.at(points.positions[:, 1] < 0.5)
    result = emission_of(light).irradiance(lower.positions, lower.normals)
    # The lamp shades a little of the floor from the bulb: 1 % on average, and nowhere is the floor
    # brighter than without it.
    assert abs(bias(result, truth.mean)) < 0.01 + 2 * truth.noise


def curve(tmp_path):
    (tmp_path / "curve.txt").write_text("0 0 0 .1\n1 0 0 .1\n2 1 0 .1\n3 1 1 .1\n")
    return {"type": "bsplinecurve", "filename": str(tmp_path / "curve.txt"), "emitter": area(1.0)}


def coloured_cube(colours):
    lamp = mi.load_dict(
        {"type": "cube", "emitter": area({"type": "mesh_attribute", "name": "vertex_color"})}
    )
    lamp.add_attribute("vertex_color", 3, np.full(lamp.vertex_count() * 3, colours, np.float32))
    return lamp


def patterned():
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3)),
        "raw": True,
    }


@pytest.mark.parametrize(
    ("lamp", "said"),
    [
        (lambda _: {"type": "projector", "irradiance": patterned()}, "Projector"),
        (lambda _: disk(emitter={"type": "directionalarea"}), "lamp"),
        (lambda _: {"type": "spot", "texture": patterned()}, "texture"),
        (lambda _: {"type": "spot", "cutoff_angle": 120.0}, "120"),
        (lambda _: coloured_cube(1.0), "attribute"),
        (curve, "lamp"),
        (lambda _: sphere(emitter=area([1.0, -1.0, 1.0])), "negative"),
        (lambda _: sphere(emitter=area([1.0, float("nan"), 1.0])), "finite"),
    ],
)
def test_emitters_that_cannot_be_taken_are_named(lamp, said, tmp_path):
    opened = open_scene(scene(floor=rectangle(), lamp=lamp(tmp_path)))
    with pytest.raises(LightError, match="pass a light instead") as caught:
        local_scene_light(opened)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_scene_without_local_light_is_refused():
    with pytest.raises(LightError, match="--light"):
        local_scene_light(open_scene(scene(floor=rectangle(), sky={"type": "constant"})))
    opened = open_scene(scene(floor=rectangle(), bulb={"type": "point"}))
    for samples in (0, -1, 2.5, True, None, "many"):
        with pytest.raises(SettingsError):
            local_scene_light(opened, samples)


# --- other light in a scene -----------------------------------------------------------------------


def lit_room():
    return scene(
        floor=rectangle(size=2, bsdf=diffuse()),
        bulb={"type": "point", "position": [0, 1, 0]},
        spot={"type": "spot"},
        sky={"type": "constant"},
        lamp=sphere((0, 1, 1), 0.2, emitter=area({"type": "checkerboard"})),
    )


def test_only_the_light_that_is_given_shines():
    """As in the same scene without emitters, though the lamp's shape is still there; modelled or
    not. The opened scene itself is left as it is.
    """
    opened = open_scene(lit_room())
    light = PointLight([0.5, 1, 0], [1, 2, 3])
    dark = scene(floor=rectangle(size=2, bsdf=diffuse()), lamp=sphere((0, 1, 1), 0.2))
    _, expected = truth_on_floor(lit_scene(mi.load_dict(dark), light), 64)
    for modelled in (False, True):
        lit = lit_scene(opened, light, modelled)
        assert len(lit.shapes()) == 2
        assert sorted(e.class_name() for e in lit.emitters()) == ["AreaLight", "PointLight"]
        _, truth = truth_on_floor(lit, 64)
        np.testing.assert_allclose(truth.mean, expected.mean, rtol=1e-5, atol=1e-7)
    own, again = (
        emission_of(local_scene_light(x)).intensity for x in (opened, open_scene(lit_room()))
    )
    np.testing.assert_array_equal(own, again)


def test_a_scene_of_objects_takes_other_light_where_no_object_has_to_change():
    """Lamps without a shape are left out; a shape that shines would have to be made dark."""
    light = PointLight([0.5, 1, 0], 1)
    bulb_only = scene(floor=rectangle(), bulb={"type": "point", "position": [0, 1, 0]})
    lit = lit_scene(mi.load_dict(bulb_only), light)
    assert [e.class_name() for e in lit.emitters()] == ["PointLight"]
    opened = open_scene(mi.load_dict(lit_room()))
    assert len(lit_scene(opened).emitters()) == len(opened.own_lights)
    for refused in (light, SceneLight("lamp") * 0.5):
        with pytest.raises(SceneError, match="Mitsuba objects"):
            lit_scene(opened, refused)


def test_a_scene_relit_as_it_is_is_itself():
    """A copy is made only where something has to be changed: a material, a lamp."""
    glossy = {"type": "roughconductor"}
    opened = open_scene(
        scene(floor=rectangle(bsdf=glossy), bulb={"type": "point", "position": [0, 1, 0]})
    )
    assert opened.relit({"bulb": 1}) is opened.mi_scene
    modelled = open_scene(opened.relit({"bulb": 1}, modelled=True))
    assert (
        modelled.surfaces[0].shape.bsdf().class_name()
        != opened.surfaces[0].shape.bsdf().class_name()
    )
    expected, found = (emission_of(local_scene_light(x)).intensity for x in (opened, modelled))
    np.testing.assert_array_equal(found, expected)
    assert not opened.relit({}).emitters()
    plain = open_scene(lit_room())
    every = {own.name: 1 for own in plain.own_lights if not own.is_distant}
    assert plain.relit(every, modelled=True) is plain.mi_scene
    dark = open_scene(scene(floor=rectangle()))
    assert dark.relit({}, modelled=True) is dark.mi_scene
    for bad in ({"nobody": 1}, {"bulb": -1}, {"bulb": np.nan}, {"sky": 1}):
        with pytest.raises(LightError, match="nobody|bulb|sky"):
            opened.relit(bad)


def test_emission_is_no_emitter():
    opened = open_scene(lit_room())
    with pytest.raises(LightError, match="no emitter in Mitsuba"):
        lit_scene(opened, flat_emission([[0, 2, 0]], [[0, -1, 0]], [[1, 1, 1]]))


# --- transport of distant light -------------------------------------------------------------------


OTHERS = [
    SpotLight([1.5, 2.5, 0.5], [-1.5, -2.5, -0.5], [3, 2, 1], 40, 20),
    AreaLight([2.0, 2.5, 0.3], [0.4, -0.3, 0], [0, 0, 0.6], [3, 2, 1]),
]


@pytest.mark.parametrize("light", OTHERS, ids=lambda light: light.kind)
def test_transport_of_distant_light_takes_any_local_light_outside_the_hull(light):
    """A box on a floor under 5.6° cells, against Mitsuba. A place's direction is off by up to
    2.8°·√(8/3) = 4.6°, and so is a shadow's edge: for a point light the same box stays below 15 %
    (test_lights), and the rim of a spot's cone is exact. 1 % of bias and noise below 1 % beside.
    """
    parts = scene(
        floor=rectangle(size=2, bsdf=diffuse()), box=cube((0, 0.5, 0), 0.5, bsdf=diffuse())
    )
    asset = mi_prt.precompute(
        parts, directions="cubemap:16", basis="none", edge_length=0.2, rays_per_direction=4
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = asset.irradiance(light)
    shown = ~asset.buried
    truth = point_irradiance(lit_scene(open_scene(parts), light), asset.points.at(shown), 1 << 12)
    assert truth.noise < 0.01 and (truth.mean == 0).any(axis=1).mean() > 0.1
    assert relative_l2(result[shown], truth.mean) < 0.15
    assert abs(bias(result[shown], truth.mean)) < 0.03
    open_air = emission_of(as_light(light)).irradiance(
        asset.points.positions[shown], asset.points.normals[shown]
    )
    assert relative_l2(open_air, truth.mean) > 0.15  # so the limit above sees shadows
    with pytest.raises(LightError):
        cell_radiance(light, parse_directions("cubemap:2"))


# --- descriptions and bad input -------------------------------------------------------------------


def test_descriptions():
    spot = parse_light("spot:1,-2e0,.5:0,-2,0:3,2,1")
    np.testing.assert_array_equal(
        [spot.position, spot.direction, spot.intensity], [[1, -2, 0.5], [0, -1, 0], [3, 2, 1]]
    )
    assert (spot.cutoff_degrees, spot.beam_degrees) == (20, 15)
    assert parse_light("spot:0,0,0:0,1,0:7:40").beam_degrees == 30
    narrow = parse_light("spot:0,0,0:0,1,0:7:40:10")
    assert (narrow.cutoff_degrees, narrow.beam_degrees) == (
        40,
        10,
    ) and narrow.intensity.tolist() == [7, 7, 7]
    panel = parse_light("area:0,2,0:1,0,0:0,0,2:5,6,7")
    np.testing.assert_array_equal(
        [panel.centre, panel.edge_u, panel.edge_v], [[0, 2, 0], [1, 0, 0], [0, 0, 2]]
    )
    assert panel.radiance.tolist() == [5, 6, 7] and panel.samples == 25 and panel.area == 2
    np.testing.assert_array_equal(panel.normal, [0, -1, 0])
    assert parse_light("area:0,2,0:1,0,0:0,0,2:5:1").samples == 1


@pytest.mark.parametrize(
    "description",
    [
        "spot",
        "spot:",
        "spot:0,0,0",
        "spot:0,0,0:0,1,0",
        "spot:0,0:0,1,0:1",
        "spot:0,0,0:0,0,0:1",
        "spot:0,0,0:0,1,0:1:0",
        "spot:0,0,0:0,1,0:1:91",
        "spot:0,0,0:0,1,0:1:nan",
        "spot:0,0,0:0,1,0:1:wide",
        "spot:0,0,0:0,1,0:1:40:41",
        "spot:0,0,0:0,1,0:1:40:20:3",
        "spot:0,0,0:0,1,0:-1",
        "area:0,0,0:1,0,0:0,1,0",
        "area:0,0,0:1,0,0:2,0,0:1",
        "area:0,0,0:1,0,0:0,1,0:1:24",
        "area:0,0,0:1,0,0:0,1,0:1:2.5",
        "area:0,0,0:1,0,0:0,1,0:1:0",
        "area:0,0,0:1,0,0:0,1,0:1:4:4",
        "area:0,0,0:1,0,0:0,1,0:-1",
        "area:0,0,0:nan,0,0:0,1,0:1",
        "point:0,0,0:1:2",
        "SPOT:0,0,0:0,1,0:1",
    ],
)
def test_descriptions_that_are_refused_are_named(description):
    with pytest.raises(LightError) as caught:
        parse_light(description)
    assert f"light '{description}'" in str(caught.value) and "\n" not in str(caught.value)


SPOT = {
    "position": [0, 1, 0],
    "direction": [0, -1, 0],
    "intensity": 1,
    "cutoff_degrees": 20,
    "beam_degrees": 10,
}
AREA = {"centre": [0, 1, 0], "edge_u": [1, 0, 0], "edge_v": [0, 0, 1], "radiance": 1, "samples": 25}


@pytest.mark.parametrize(
    ("kind", "changed"),
    [
        *(
            (SpotLight, {"position": bad})
            for bad in ([0, 1], [0, np.nan, 0], [0, 1e39, 0], None, "up", [[0, 1, 0]])
        ),
        *(
            (SpotLight, {"direction": bad})
            for bad in ([0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0], None, 3)
        ),
        *(
            (SpotLight, {"intensity": bad})
            for bad in (-1, [1, 2], np.nan, [1, np.inf, 1], "bright")
        ),
        *(
            (SpotLight, {"cutoff_degrees": bad})
            for bad in (0, -1, 90.1, 180, np.nan, np.inf, None, "wide", [20], 1j)
        ),
        *((SpotLight, {"beam_degrees": bad}) for bad in (-1, 20.1, np.nan, "wide", [10])),
        *((AreaLight, {"centre": bad}) for bad in ([0, 1], [0, np.nan, 0], [0, 1e39, 0], None)),
        *(
            (AreaLight, {"edge_u": bad})
            for bad in ([0, 0, 0], [0, 0, 2], [1e-9, 0, 1], [np.nan, 0, 0], [1e39, 0, 0], 1, None)
        ),
        *((AreaLight, {"radiance": bad}) for bad in (-1, [1, -1, 1], np.nan, [1, 2], 1e39, None)),
        (AreaLight, {"radiance": 1e30, "edge_u": [1e20, 0, 0]}),
        *((AreaLight, {"samples": bad}) for bad in (0, -4, 2, 24, 25.0, True, None, "many")),
    ],
)
def test_bad_lights(kind, changed):
    with pytest.raises(LightError) as caught:
        kind(**(SPOT if kind is SpotLight else AREA) | changed)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "changed",
    [
        {"positions": [0, 1, 0]},
        {"positions": [[0, 1]]},
        {"positions": None},
        {"positions": [[0, np.nan, 0]]},
        {"cutoff": [1, 2]},
        {"intensity": [[1, -1, 1]]},
        {"intensity": [[1e39, 1, 1]]},
        {"axes": np.zeros((2, 3))},
        {"beam": "wide"},
    ],
)
def test_bad_emissions(changed):
    good = {"positions": [[0, 1, 0]], "axes": [[0, 0, 1]], "intensity": [[1, 1, 1]]}
    good |= {"cosine": [0], "cutoff": [np.pi], "beam": [np.pi]}
    assert len(Emission(**good)) == 1
    with pytest.raises(LightError):
        Emission(**good | changed)


def test_lights_keep_their_own_arrays():
    arrays = [np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.ones(3)]
    panel, spot = AreaLight(*arrays), SpotLight(arrays[0], arrays[1], arrays[3])
    for array in arrays:
        array[:] = 9
    np.testing.assert_array_equal(
        [panel.centre, panel.edge_u, panel.edge_v], [[0, 0, 0], [1, 0, 0], [0, 0, 1]]
    )
    np.testing.assert_array_equal(
        [spot.position, spot.direction, spot.intensity], [[0, 0, 0], [1, 0, 0], [1, 1, 1]]
    )
    assert as_light(Light()).is_empty
