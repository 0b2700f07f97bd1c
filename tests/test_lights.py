"""Local lights and sums of lights: closed forms, Mitsuba, by how much they err, and the command
line's specs.
"""

import json
import warnings

import numpy as np
import OpenEXR
import pytest
from conftest import (
    bias,
    cube,
    diffuse,
    distant,
    emitted,
    matrix_transform,
    random_rotation,
    rectangle,
    relative_l2,
    scene,
    sky_of,
    sphere,
    uniform_directions,
    uniform_sky,
)

import mi_prt
from mi_prt import (
    DirectionalLight,
    EnvironmentMap,
    Light,
    LightError,
    LightWarning,
    PointLight,
    SettingsError,
)
from mi_prt.cli import main
from mi_prt.directions import parse_directions
from mi_prt.evaluate import ground_truth
from mi_prt.evaluate.local_lights import stand_in_error
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.light import as_light
from mi_prt.lighting.local import arrival, hull_warning
from mi_prt.lighting.parse import parse_light, parse_rotation
from mi_prt.lighting.summed import summed_maps
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.hull import ConvexHull
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()


def camera(width=32, height=24):
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([3, 3, 3], [0, 0.3, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
    }


def box_on_floor(**rest):
    return scene(floor=rectangle(size=2), box=cube((0, 0.3, 0), 0.3), eye=camera(), **rest)


def walled():
    """A wall between two halves of a floor; a lamp on one side leaves the other dark."""
    return scene(
        floor=rectangle(size=2, bsdf=diffuse()),
        wall=rectangle((1, 0, 0), (0, 1, 0), 2, bsdf={"type": "twosided", "bsdf": diffuse()}),
        eye=camera(),
    )


def unoccluded(points, lights):
    """Closed form: Σ I max(0, cos θ)/r²."""
    total = np.zeros((len(points), 3))
    for light in lights:
        toward = light.position - points.positions.astype(np.float64)
        distance = np.linalg.norm(toward, axis=1, keepdims=True)
        cosine = np.maximum((toward / distance * points.normals).sum(axis=1, keepdims=True), 0)
        total += light.intensity * cosine / distance**2
    return total


def seen(light, positions, directions, nearest=1):
    """Cells and irradiance of a light of one place."""
    ((cells, _, irradiance),) = arrival(light.emission(), positions, directions, nearest)
    return cells, irradiance


def precompute(content, directions="cubemap:16", **settings):
    """Without compression, so that only the lattice is between the asset and the truth."""
    return mi_prt.precompute(
        content, directions=directions, **{"basis": "none", "edge_length": 0.25} | settings
    )


@pytest.fixture(scope="module")
def floor():
    return precompute(scene(floor=rectangle(size=2)))


@pytest.fixture(scope="module")
def box():
    return precompute(box_on_floor(), rays_per_direction=4)


@pytest.fixture(scope="module")
def room():
    return precompute(walled(), "cubemap:8", edge_length=0.2)


# --- closed forms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("nearest", [1, 4, None])
@pytest.mark.parametrize(
    "content", [scene(floor=rectangle(size=2)), scene(ball=sphere((0, 0.5, 0), 0.7))]
)
def test_irradiance_is_that_of_the_inverse_square_law(content, nearest):
    """E = I cos θ / r² where nothing is in between. The cell's direction is at most its radius off,
    √(8/3)·π/4/N at the corners of a cubemap of N, and of four the farthest is less than two cells
    off; |Δ cos θ| ≤ Δθ. Over all points these errors average out but for the few cells in which
    most of the light arrives: less than half a cell's width is left.
    """
    light = PointLight([1.0, 2.5, -0.7], [3.0, 1.0, 0.2])
    for resolution in (8, 32):
        asset = precompute(content, f"cubemap:{resolution}")
        off = np.pi / 4 / resolution * (8 / 3) ** 0.5 * (1 if nearest == 1 else 3)
        _, arriving = seen(light, asset.points.positions, distant(asset).directions)
        result, expected = (
            asset.irradiance(light, nearest=nearest),
            unoccluded(asset.points, [light]),
        )
        assert (np.abs(result - expected) <= arriving * off + 1e-6).all()
        assert abs(bias(result, expected)) < 0.5 / resolution


def test_the_three_directions_around_have_the_cosine_of_the_light():
    """Where nothing is in between, their error is of second order in the cell's side (but at the
    horizon of a point): a seventh of that of the nearest direction, on cubemap:32 below 0.3 %.
    """
    light = PointLight([1.0, 2.5, -0.7], [3.0, 1.0, 0.2])
    asset = precompute(scene(ball=sphere((0, 0.5, 0), 0.7)), "cubemap:32")
    expected = unoccluded(asset.points, [light])
    around, one = (relative_l2(asset.irradiance(light, nearest=n), expected) for n in (None, 1))
    assert around < one / 5 and around < 0.003


@pytest.mark.parametrize("nearest", [1, 4])
def test_a_finer_lattice_is_nearer_to_it_at_first_order(nearest):
    """The direction's error is proportional to the cell's width: four times finer, four times less,
    give or take 1.6.
    """
    light = PointLight([0.5, 2.5, -0.7], 1.0)
    errors = []
    for resolution in (8, 32):
        asset = precompute(scene(ball=sphere()), f"cubemap:{resolution}")
        errors.append(
            relative_l2(asset.irradiance(light, nearest=nearest), unoccluded(asset.points, [light]))
        )
    assert 4 / 1.6 < errors[0] / errors[1] < 4 * 1.6


@pytest.mark.parametrize("directions", ["latlong:32x16", "halton:800", "cubemap:9"])
def test_local_lights_on_every_lattice(directions):
    """Some 500 directions, 0.16 rad wide each: errors of that order at most, without bias."""
    light = PointLight([0.5, 2.5, -0.7], 1.0)
    asset = precompute(scene(ball=sphere()), directions)
    for nearest in (1, 3):
        result = asset.irradiance(light, nearest=nearest)
        assert relative_l2(result, unoccluded(asset.points, [light])) < 0.16
        assert abs(bias(result, unoccluded(asset.points, [light]))) < 0.05


def test_strength_falls_with_the_square_and_follows_the_intensity(floor):
    """Exact up to float32 rounding: along one direction from a point, twice the distance is a
    quarter of the light.
    """
    cells, near = seen(
        PointLight([0, 3.0, 0], [1, 2, 3]), np.zeros((1, 3)), distant(floor).directions
    )
    again, far = seen(
        PointLight([0, 6.0, 0], [1, 2, 3]), np.zeros((1, 3)), distant(floor).directions
    )
    np.testing.assert_array_equal(cells, again)
    np.testing.assert_allclose(near, [[1 / 9, 2 / 9, 3 / 9]], rtol=1e-6)
    np.testing.assert_allclose(far, near / 4, rtol=1e-6)
    one = floor.irradiance(PointLight([0.1, 2, 0.3], [1, 1, 1]))
    np.testing.assert_allclose(
        floor.irradiance(PointLight([0.1, 2, 0.3], [1e6, 0, 3])), one * [1e6, 0, 3], rtol=1e-6
    )
    assert not floor.irradiance(PointLight([0.1, 2, 0.3], 0)).any()


def test_extreme_places_give_finite_light(floor):
    """In a point: no direction, so nothing. A hair above it: I/r² beyond float32 is clipped. Below
    the floor, or so far away that float32 does not hold I/r²: nothing. On the floor's plane: cos θ
    is 0, and its cell is at most its radius off.
    """
    at = floor.points.positions[7].astype(np.float64)
    cells, arriving = seen(
        PointLight(at, 1e6), floor.points.positions, distant(floor).directions, 3
    )
    assert (
        not arriving[7].any()
        and np.isfinite(arriving).all()
        and cells.shape == (len(floor.points), 3)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for gap in (1e-25, 1e-140, 1e-250):
            assert np.isfinite(floor.irradiance(PointLight(at + [0, gap, 0], 1e6))).all()
    assert floor.irradiance(PointLight(at + [0, 1e-25, 0], 1e6))[7, 0] > 1e37
    assert not floor.irradiance(PointLight([0.3, -1, 0.2], 5)).any()
    assert floor.irradiance(PointLight([0, 1e30, 0], 1e6)).max() <= 1e6 / 1e30 / 1e30
    grazing = PointLight([0.31, 0, 0.17], 1)
    _, arriving = seen(grazing, floor.points.positions, distant(floor).directions)
    assert (floor.irradiance(grazing) <= arriving * np.pi / 4 / 16 * (8 / 3) ** 0.5).all()


@pytest.mark.parametrize("nearest", [0, -1, 1.5, True, 10**6])
def test_a_number_of_directions_that_the_lattice_does_not_have(floor, nearest):
    with pytest.raises(SettingsError):
        floor.irradiance(PointLight([0, 1, 0], 1), nearest=nearest)


# --- against Mitsuba ------------------------------------------------------------------------------


def test_reference_of_local_lights_is_mitsubas_own():
    """Light by light with Mitsuba's shadow rays, exactly what its emitter sampling gives where one
    light is all there is.
    """
    opened = open_scene(
        box_on_floor(lamp={"type": "point", "position": [0, 3, 0]}, sky={"type": "constant"})
    )
    points = sample_points(opened, 0.3)
    lights = [PointLight([1, 2, 0.5], [8, 4, 2]), PointLight([-3, 1, 1], 3.0)]
    alone = [ground_truth.local_irradiance(opened.occluders, points, [light]) for light in lights]
    for light, truth in zip(lights, alone):
        dark = open_scene(box_on_floor())
        sampled = ground_truth.point_irradiance(lit_scene(dark, light), points, 2)
        assert sampled.noise == 0
        np.testing.assert_allclose(truth, sampled.mean, rtol=1e-6)
        assert 0.02 < (truth == 0).mean() < 0.98
    np.testing.assert_allclose(
        ground_truth.local_irradiance(opened.occluders, points, lights), sum(alone), rtol=1e-6
    )


def test_sampled_reference_of_many_lights_is_unbiased_and_knows_its_noise():
    """Maps, sun and lamps together against the sum of each alone; picking among five emitters adds
    little noise.

    The relative error of all entries is the claimed noise, up to what 300 points tell (a factor of
    1.5).
    """
    opened = open_scene(box_on_floor())
    points = sample_points(opened, 0.4)
    sky = sky_of(lambda d: np.exp(d), 32)
    parts = [
        sky,
        DirectionalLight([0.3, -1, 0.1], 2.0),
        PointLight([1, 2, 0.5], 8.0),
        PointLight([-3, 1, 1], 3.0),
    ]
    alone = [
        ground_truth.point_irradiance(lit_scene(opened, part), points, 1 << 14, 3) for part in parts
    ]
    expected = sum(reference.mean for reference in alone)
    together = ground_truth.point_irradiance(lit_scene(opened, parts), points, 256, 4)
    assert 1 / 1.5 < relative_l2(together.mean, expected) / together.noise < 1.5
    assert together.noise < 0.1
    assert abs(bias(together.mean, expected)) < 0.01


def test_shadows_of_a_light_outside_the_hull_are_mitsubas(box):
    """Lattice of 5.6° cells: shadows are shifted by up to half a cell, which an RMSE of 15 % allows
    for; no bias.

    Without shadows it would be off by far more.
    """
    light = PointLight([2.0, 3.0, 1.0], [20.0, 10.0, 5.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = box.irradiance(light)
    truth = ground_truth.local_irradiance(open_scene(box_on_floor()).occluders, box.points, [light])
    assert relative_l2(result, truth) < 0.15 and abs(bias(result, truth)) < 0.03
    assert relative_l2(unoccluded(box.points, [light]), truth) > 0.2


def test_compression_keeps_local_lights(box):
    """What the basis reconstructs of each point's transport is what its local light sees; 96
    components of some 1,000.
    """
    light = PointLight([2.0, 3.0, 1.0], 10.0)
    compressed = precompute(
        box_on_floor(), basis="pca", rays_per_direction=4, coefficients=96, bounces=0
    )
    result = compressed.irradiance(light, nearest=1)
    cells, arriving = seen(light, box.points.positions, distant(box).directions)
    rows = distant(compressed).total.rows(np.arange(len(box.points)))
    np.testing.assert_allclose(
        result,
        arriving * np.maximum(np.take_along_axis(rows, cells, axis=1), 0),
        rtol=1e-3,
        atol=1e-3 * result.max(),
    )
    assert relative_l2(result, box.irradiance(light)) < 0.1


# --- sums -----------------------------------------------------------------------------------------


def test_irradiance_of_a_sum_is_the_sum_of_irradiances(box):
    """Environments, suns and lamps, nested in lists, in one call: equal to its parts to float32
    rounding.
    """
    parts = [
        uniform_sky([0.5, 0.7, 1.0]),
        EnvironmentMap(sky_of(lambda d: np.exp(d), 16)).rotated("x", 40),
        DirectionalLight([0.2, -1, 0.4], [3, 2, 1]),
        DirectionalLight([-1, -1, 0], 0.5),
        PointLight([2, 3, 1], [9, 8, 7]),
        PointLight([-3, 2, 0], 4),
    ]
    nested = [
        parts[0],
        [parts[1], (parts[2],)],
        Light((parts[3], parts[4])),
        parts[5],
    ]
    light = as_light(nested)
    assert [part.kind for part in light.parts] == ["envmap"] * 2 + ["directional"] * 2 + [
        "point"
    ] * 2
    expected = sum(box.irradiance(part).astype(np.float64) for part in parts)
    np.testing.assert_allclose(
        box.irradiance(nested), expected, rtol=1e-5, atol=1e-6 * expected.max()
    )
    np.testing.assert_allclose(
        box.relight(nested), box.outgoing_radiance(expected), rtol=1e-5, atol=1e-6 * expected.max()
    )


def test_turning_turns_distant_light_only(box):
    light = as_light(
        [EnvironmentMap(uniform_sky()), DirectionalLight([0, 0, -1], 1), PointLight([0, 0, 5], 1)]
    )
    turned = light.rotated("y", 90)  # +z to +x
    _, sun, lamp = light.parts
    np.testing.assert_allclose(turned.parts[1].direction, [-1, 0, 0], atol=1e-12)
    assert turned.parts[2] is lamp and turned.local.parts == (lamp,)
    assert turned.distant.parts == turned.parts[:2] and turned.distant.local.is_empty
    assert box.prepare_light(light).parts[1:] == (sun, lamp)
    only_lamp = box.prepare_light(lamp)
    np.testing.assert_array_equal(box.irradiance(only_lamp), box.irradiance(lamp))


@pytest.mark.parametrize("directions", ["cubemap:16", "latlong:40x20", "halton:1000"])
def test_turning_on_the_lattice_is_turning_the_map_and_mitsubas_emitter(directions):
    """Eigentransport section 5, on any lattice: light on a four times finer lattice, turned there
    and averaged over the cells, gives the irradiance of the map's pixels turned and averaged, and
    of Mitsuba's emitter turned by to_world.

    A smooth sky with a lobe of 20°. A fine cell moves by at most 2°, which changes irradiance by
    far less than 1 %. Against Mitsuba, whose noise is below 1 %, there is the lattice too: 3 % at
    7°.
    """
    opened = open_scene(box_on_floor())
    asset = precompute(opened.mi_scene, directions, edge_length=0.5, rays_per_direction=4)
    sky = EnvironmentMap(
        sky_of(lambda d: 0.3 + 4 * np.exp(8 * (d @ [[0.6], [0.8], [0]] - 1)) * [1, 0.8, 0.5], 32)
    )
    prepared = asset.prepare_light(sky)
    for axis, degrees in (([0, 1, 0], 75), ([0.48, -0.6, 0.64], 30)):
        fast, exact = (asset.irradiance(light.rotated(axis, degrees)) for light in (prepared, sky))
        assert relative_l2(fast, exact) < 0.01 and abs(bias(fast, exact)) < 1e-3
        turned = mi.ScalarTransform4f().rotate(axis, degrees)
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(sky.pixels.copy()), "to_world": turned}
        truth = ground_truth.point_irradiance(
            mi.load_dict(box_on_floor(sky=emitter)), asset.points, 1 << 14
        )
        assert truth.noise < 0.01
        assert relative_l2(fast, truth.mean) < 0.03 and abs(bias(fast, truth.mean)) < 0.01


def test_local_light_has_no_place_on_a_lattice():
    with pytest.raises(LightError, match="local light"):
        cell_radiance(PointLight([0, 1, 0], 1), parse_directions("cubemap:2"))


@pytest.mark.parametrize(
    ("position", "intensity"),
    [
        ([0, 1], 1),
        ([0, 1, np.nan], 1),
        ([0, 1, np.inf], 1),
        ([0, 1, 1e39], 1),
        ([0, 1, 0], 1e39),
        (None, 1),
        ("up", 1),
        ([0, 1, 0], -1),
        ([0, 1, 0], [1, -1, 1]),
        ([0, 1, 0], [1, 2]),
        ([0, 1, 0], np.nan),
        ([0, 1, 0], [1, np.inf, 1]),
        ([0, 1, 0], "bright"),
        ([0, 1, 0], None),
        ([[0, 1, 0]], 1),
        ([0, 1, 0], [[1, 1, 1]]),
        ([0, 1, 0], 1j),
    ],
)
def test_bad_point_lights(position, intensity):
    with pytest.raises(LightError) as caught:
        PointLight(position, intensity)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "source", [[], (), [[]], [None], [PointLight([0, 0, 0], 1), 5], [uniform_sky(), "missing.exr"]]
)
def test_lists_that_are_no_light(source):
    with pytest.raises(LightError) as caught:
        as_light(source)
    assert "\n" not in str(caught.value)


def test_lights_keep_their_own_arrays():
    """Neither shares memory with what the caller passed."""
    position, intensity = np.zeros(3), np.ones(3)
    light = PointLight(position, intensity)
    position[:], intensity[:] = 9, 9
    np.testing.assert_array_equal([light.position, light.intensity], [[0, 0, 0], [1, 1, 1]])
    np.testing.assert_array_equal(DirectionalLight([0, -2, 0], 3).irradiance, [3, 3, 3])


# --- the convex hull ------------------------------------------------------------------------------


def test_inside_and_outside_of_the_hull():
    """Of a cube, turned and off the origin: a place is inside if it is between each pair of faces;
    on a face it is not.
    """
    rng = np.random.default_rng(0)
    rotation, centre = random_rotation(rng), np.array([100.0, -50, 20])
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    positions = (np.r_[corners, rng.uniform(-1, 1, (500, 3))] @ rotation.T + centre).astype(
        np.float32
    )
    local = rng.uniform(-1.5, 1.5, (300, 3))
    local = local[np.abs(np.abs(local).max(axis=1) - 1) > 1e-3]
    for place in local:
        assert ConvexHull(positions).contains(rotation @ place + centre) == (
            np.abs(place).max() < 1
        )
    for place in ([0, 0, 1], [1, 1, 1], [0.3, -1, 0.2]):
        assert not ConvexHull(positions).contains(rotation @ np.array(place, float) + centre)
    assert not ConvexHull(positions).contains(np.array([1e300, 0, 0]))


def test_flat_scenes_have_no_inside():
    """A plane, also turned so that float32 makes it rough, a line, a point many times, one
    point.
    """
    rng = np.random.default_rng(1)
    plane = np.c_[rng.uniform(-1, 1, (2000, 2)), np.zeros(2000)]
    rotation = random_rotation(rng)
    for positions in (
        plane,
        plane @ rotation.T,
        plane[:, :1] * [1, 2, 3],
        np.ones((50, 3)),
        np.ones((1, 3)),
        plane[:2],
    ):
        positions = positions.astype(np.float32)
        for place in (positions[0], positions.mean(axis=0), rotation @ [0.1, 0.2, 1e-7]):
            assert not ConvexHull(positions).contains(np.asarray(place, np.float64))


def test_warning_inside_the_hull_and_none_outside(room):
    """Named with its place; several at once; the light itself is still there."""
    inside, outside = PointLight([0.5, 1, 0.25], 1), PointLight([5, 5, 0], 1)
    with pytest.warns(LightWarning, match=r"0\.5, 1, 0\.25 lies inside the convex hull"):
        assert room.irradiance([inside, outside]).any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        room.irradiance(outside)
    places = [inside.position] * 5 + [outside.position]
    text = hull_warning(places, room.points.hull)
    assert text.startswith("local light at 5 places") and "…" in text and "\n" not in text
    assert hull_warning([outside.position], room.points.hull) is None
    assert hull_warning([], room.points.hull) is None


# --- files and the measured error -----------------------------------------------------------------


def measured(asset, lamp, content):
    """The error that a comparison tells of a lamp's light, `local_light_error`."""
    opened = open_scene(content)
    light = asset.resolved(lamp, None, opened)
    return stand_in_error(asset, light, 1, opened)["local_light_error"]


def test_measured_error_is_large_where_distant_visibility_is_wrong(room):
    """A lamp close to the wall, inside the hull. To infinity, directions from the lamp's side of
    the floor end on the wall behind the lamp, so the asset takes that light for hidden: a large
    error, in the result and in the warning.
    """
    with pytest.warns(LightWarning, match="relative RMSE") as caught:
        error = measured(room, PointLight([0.3, 1, 0], 5), walled())
    assert set(error) == {"relative_rmse", "bias", "points"} and error["points"] == min(
        len(room.points), 4096
    )
    assert error["relative_rmse"] > 0.3
    lines = [str(w.message) for w in caught if issubclass(w.category, LightWarning)]
    assert len(lines) == 1 and f"{error['relative_rmse']:.1%}" in lines[0] and "\n" not in lines[0]


@pytest.mark.parametrize("name", ["a.exr", "a.npz"])
def test_relighting_warns_and_does_not_measure(room, tmp_path, monkeypatch, name):
    """Tracing paths for a comparison takes seconds that nobody asked for; also where the scene is
    at hand.
    """

    def refuse(*_, **__):
        raise AssertionError("paths are traced")

    monkeypatch.setattr(ground_truth, "irradiance", refuse)
    monkeypatch.setattr(ground_truth, "indirect_irradiance", refuse)
    content = walled() if name == "a.exr" else None
    with pytest.warns(LightWarning, match="inside the convex hull .*mi-prt compare") as caught:
        result = mi_prt.relight_to_file(
            room, tmp_path / name, PointLight([0.3, 1, 0], 5), scene=content, size=(16, 12), spp=2
        )
    assert set(result) == {"points", "exposure", "seconds"}
    assert len([w for w in caught if issubclass(w.category, LightWarning)]) == 1


def test_measured_error_is_small_outside(box, tmp_path):
    """No warning, and the error of 5.6° cells."""
    lamp = PointLight([2, 3, 1], 5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi_prt.relight_to_file(box, tmp_path / "a.ply", lamp)
        error = measured(box, lamp, box_on_floor())
    assert error["relative_rmse"] < 0.15 and abs(error["bias"]) < 0.03


def test_measured_error_counts_reflections():
    """A lamp so far away that distances and directions to all points are alike is a distant light:
    what is reflected of it is right too, with the error of 5.6° cells. Against a truth of direct
    light, a tenth less, the bias would show.
    """
    content = scene(
        floor=rectangle(size=2, bsdf=diffuse([0.9, 0.6, 0.5])),
        box=cube((0, 0.5, 0), 0.5, bsdf=diffuse(0.8)),
        eye=camera(),
    )
    asset = precompute(content, basis="pca", rays_per_direction=4, coefficients=96, bounces="auto")
    lamp = PointLight([60, 40, 20], 1e4)
    error = measured(asset, lamp, content)
    assert error["relative_rmse"] < 0.15 and abs(error["bias"]) < 0.03
    shown = asset.points.at(~asset.buried)
    direct = ground_truth.local_irradiance(open_scene(content).occluders, shown, [lamp])
    assert bias(asset.irradiance(lamp)[~asset.buried], direct) > 0.06


def test_images_show_local_lights(box, tmp_path):
    """The image of the integrator is Mitsuba's path tracer's, up to the lattice; nothing else
    shines in it.
    """
    lights = [
        PointLight([2, 3, 1], [20, 10, 5]),
        PointLight([-1, 4, 2], 8),
        DirectionalLight([1, -2, 0], 1),
    ]
    report = mi_prt.compare(
        box, tmp_path, lights, scene=box_on_floor(sky={"type": "constant"}), spp=64
    )
    for part in ("points", "image"):
        assert (
            report[part]["relative_rmse_beyond_noise"] < 0.15 and abs(report[part]["bias"]) < 0.03
        )
    assert report["local_light_error"]["relative_rmse"] < 0.15
    with OpenEXR.File(str(tmp_path / "reference.exr")) as file:
        assert file.channels()["RGB"].pixels.min() == 0  # no sky behind
    json.loads((tmp_path / "report.json").read_text())


def test_both_renderers_show_the_same_light(box, tmp_path):
    lights = [PointLight([2, 3, 1], [20, 10, 5]), uniform_sky(0.1)]
    images = []
    for renderer in ("mitsuba", "raster"):
        path = tmp_path / f"{renderer}.exr"
        mi_prt.relight_to_file(box, path, lights, scene=box_on_floor(), renderer=renderer, spp=64)
        with OpenEXR.File(str(path)) as file:
            images.append(file.channels()["RGB"].pixels)
    assert relative_l2(images[1], images[0]) < 0.06 and abs(bias(images[1], images[0])) < 0.01


def test_integrator_takes_irradiance(box):
    """A given irradiance is shown whatever the scene's emitters are; another shape is refused."""
    from mi_prt.render.image import render_image

    loaded = mi.load_dict(box_on_floor(), parallel=False)  # without any light
    image = render_image(
        box,
        loaded,
        loaded.sensors()[0],
        4,
        irradiance=np.full((len(box.points), 3), [1.0, 2.0, 3.0]),
    )
    lit = image[image.sum(axis=-1) > 0]
    np.testing.assert_allclose(
        lit / lit[:, :1], np.broadcast_to([1.0, 2.0, 3.0], lit.shape), rtol=1e-4
    )
    with pytest.raises(SettingsError, match="shape"):
        render_image(box, loaded, loaded.sensors()[0], 4, irradiance=np.ones((3, 3)))


# --- several maps in Mitsuba ----------------------------------------------------------------------


def test_maps_of_one_grid_are_summed_exactly():
    rng = np.random.default_rng(0)
    rotation = random_rotation(rng)
    maps = [EnvironmentMap(rng.random((8, 16, 3)), rotation) for _ in range(3)]
    total = summed_maps(maps)
    np.testing.assert_allclose(total.pixels, sum(m.pixels for m in maps), rtol=1e-6)
    np.testing.assert_array_equal(total.rotation, rotation)
    assert summed_maps(maps[:1]) is maps[0]


def test_maps_of_other_grids_are_resampled():
    """In every direction Mitsuba shows about the sum: exactly with a constant, whose interpolation
    is constant, within the interpolation error of smooth maps (second order in the pixel, 1e-3
    here) with a turned one.
    """
    rng = np.random.default_rng(1)
    directions = uniform_directions(rng, 2000)
    large = EnvironmentMap(rng.random((20, 40, 3)), random_rotation(rng))
    smooth = EnvironmentMap(
        sky_of(lambda d: np.exp(d @ rng.standard_normal((3, 3))), 32), random_rotation(rng)
    )
    for maps, limit in (
        ((large, EnvironmentMap(uniform_sky(2.0))), 1e-5),
        ((smooth, smooth.rotated("x", 50)), 2e-3),
    ):
        emitters = (
            {
                "type": "envmap",
                "bitmap": mi.Bitmap(m.pixels.copy()),
                "to_world": matrix_transform(m.rotation),
            }
            for m in maps
        )
        expected = sum(emitted(mi.load_dict(emitter), directions) for emitter in emitters)
        lit = lit_scene(mi.load_dict(scene(s=sphere())), list(maps))
        assert relative_l2(emitted(lit.environment(), directions), expected) < limit
        np.testing.assert_allclose(
            sum(m.at(directions) for m in maps), expected, rtol=1e-3, atol=1e-4
        )


def test_a_sun_keeps_its_energy_when_maps_are_summed():
    """The worst case, suns of a single pixel in turned maps, whose hats are sampled at three nodes
    a pixel: 2 %.
    """

    def energy(environment):  # of Mitsuba's interpolation, exactly: see test_directions_lighting
        return environment.quadrature(0.1).energy.sum(dtype=np.float64)

    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(20):
        pixels = np.full((32, 64, 3), 0.01, np.float32)
        pixels[rng.integers(4, 28), rng.integers(64)] = 1e3
        maps = [EnvironmentMap(np.ones((32, 64, 3))), EnvironmentMap(pixels, random_rotation(rng))]
        ratios.append((energy(summed_maps(maps)) - 12 * np.pi) / energy(maps[1]))
    np.testing.assert_allclose(ratios, 1, atol=0.02)


def test_light_kept_on_a_lattice_is_shown_too(box, tmp_path):
    """`prepare_light` gives a map of cells: the picture's background is its cells' radiance."""
    sky = EnvironmentMap(sky_of(lambda d: 1 + d[:, :1], 32))
    prepared = box.prepare_light([sky, PointLight([2, 3, 1], 3)]).rotated("y", 130)
    lit = lit_scene(mi.load_dict(box_on_floor()), prepared)
    directions = uniform_directions(np.random.default_rng(3), 1000)
    np.testing.assert_allclose(
        emitted(lit.environment(), directions), sky.rotated("y", 130).at(directions), atol=0.06
    )
    mi_prt.relight_to_file(
        box, tmp_path / "a.png", prepared, scene=box_on_floor(), size=(16, 12), spp=2
    )


# --- the command line -----------------------------------------------------------------------------


def test_specs(tmp_path):
    lamp = parse_light("point:1,-2e0,.5:3,2,1")
    np.testing.assert_array_equal([lamp.position, lamp.intensity], [[1, -2, 0.5], [3, 2, 1]])
    np.testing.assert_array_equal(parse_light("point:0,0,0:7").intensity, [7, 7, 7])
    sun = parse_light("directional:0,-2,0:3")
    np.testing.assert_array_equal([sun.direction, sun.irradiance], [[0, -1, 0], [3, 3, 3]])
    for name in ("sky.exr", "a,b c.exr", "with:colon.exr", "y:30.exr"):
        file = tmp_path / name
        OpenEXR.File({}, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(file))
        np.testing.assert_array_equal(parse_light(f"envmap:{file}").rotation, np.eye(3))
        for rotation, expected in (("y:90", ("y", 90)), ("0,0,2:-30", ((0, 0, 2), -30))):
            turned = parse_light(f"envmap:{file}:{rotation}")
            np.testing.assert_allclose(
                turned.rotation, EnvironmentMap(uniform_sky()).rotated(*expected).rotation
            )
    assert parse_rotation("x:1e1") == ("x", 10.0) and parse_rotation("1,2,3:-4") == ((1, 2, 3), -4)


@pytest.mark.parametrize(
    "spec",
    [
        "",
        "point",
        "point:",
        "point:1,2,3",
        "point:1,2:3",
        "point:1,2,3:4,5",
        "point:1,2,3:4:5",
        "point:a,b,c:1",
        "point:1,2,3:-1",
        "point:nan,0,0:1",
        "point:0,0,0:inf",
        "point::1",
        "spot:1,2,3:4",
        "directional:0,0,0:1",
        "directional:0,-1,0:-1",
        "directional:0,-1,0",
        "envmap",
        "envmap:",
        "envmap:missing.exr",
        "envmap:missing.exr:y:30",
        "envmap:missing.exr:w:30",
        "1,2,3:4",
        "POINT:1,2,3:4",
    ],
)
def test_specs_that_are_refused_are_named(spec):
    with pytest.raises(LightError) as caught:
        parse_light(spec)
    assert f"light '{spec}'" in str(caught.value) and "\n" not in str(caught.value)


def test_bad_rotations_of_a_map(tmp_path):
    OpenEXR.File({}, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(tmp_path / "sky.exr"))
    for rotation in ("y:fast", "0,0,0:10", "x:nan"):
        with pytest.raises(LightError, match="light 'envmap:"):
            parse_light(f"envmap:{tmp_path / 'sky.exr'}:{rotation}")


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as exit:
        main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return exit.value.code or 0, captured.out, captured.err


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A scene of a floor, a wall and a sky, its asset, and a map."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "walled.xml").write_text(
        """<scene version='3.0.0'> <shape type='rectangle'><transform name='to_world'><rotate x='1'
        angle='-90'/><scale value='2'/></transform></shape> <shape type='rectangle'><transform
        name='to_world'><rotate y='1' angle='90'/><translate y='1'/></transform></shape> <sensor
        type='perspective'><transform name='to_world'><lookat origin='3,3,3' target='0,0,0'
        up='0,1,0'/></transform> <film type='hdrfilm'><integer name='width' value='24'/><integer
        name='height' value='16'/></film></sensor> <emitter type='constant'/></scene>
        """
    )
    mi_prt.precompute(
        folder / "walled.xml", directions="cubemap:8", coefficients=16, edge_length=0.4
    ).save(folder / "a.prt")
    OpenEXR.File({}, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(folder / "sky.exr"))
    return folder


def test_lights_of_the_command_line_add_up(files, tmp_path, capsys):
    """--envmap and each --light alone give parts of what all give together; --rotate leaves the
    lamp where it is.
    """
    specs = ["point:3,4,1:30,20,10", "directional:0,-1,0.5:2", f"envmap:{files / 'sky.exr'}:y:30"]

    def irradiance(*arguments):
        code, out, err = run(
            capsys, "relight", files / "a.prt", "-o", tmp_path / "a.npz", "--json", *arguments
        )
        assert code == 0 and err == "" and set(json.loads(out)) == {"points", "exposure", "seconds"}
        return np.load(tmp_path / "a.npz")["irradiance"].astype(np.float64)

    parts = [irradiance("--light", spec) for spec in specs] + [
        irradiance("--envmap", files / "sky.exr")
    ]
    together = irradiance(
        *(x for spec in specs for x in ("--light", spec)), "--envmap", files / "sky.exr"
    )
    # What compression leaves below zero is cut off the sum once: it is linear where no part was
    # cut, and never above.
    whole = np.all([part > 0 for part in parts], axis=0)
    assert whole.mean() > 0.4
    np.testing.assert_allclose(together[whole], sum(parts)[whole], rtol=1e-4)
    assert (together <= sum(parts) * (1 + 1e-4)).all()
    with_sky = ("--light", specs[0], "--envmap", files / "sky.exr")
    turned = irradiance(*with_sky, "--rotate", "y:90") - irradiance(*with_sky)
    only_sky = irradiance("--envmap", files / "sky.exr", "--rotate", "y:90") - parts[3]
    np.testing.assert_allclose(turned[whole], only_sky[whole], atol=1e-4 * parts[0].max())
    assert relative_l2(irradiance("--light", specs[0], "--nearest", "4"), parts[0]) > 1e-3


def test_the_scenes_own_light_beside_others(files, tmp_path, capsys):
    """`--light scene` is what is taken where no light is given, and adds to others."""

    def irradiance(*arguments):
        code, _, _ = run(capsys, "relight", files / "a.prt", "-o", tmp_path / "a.npz", *arguments)
        assert code == 0
        return np.load(tmp_path / "a.npz")["irradiance"].astype(np.float64)

    own, lamp = irradiance(), irradiance("--light", "point:3,4,1:30,20,10")
    np.testing.assert_array_equal(irradiance("--light", "scene"), own)
    both = irradiance("--light", "scene", "--light", "point:3,4,1:30,20,10")
    whole = (own > 0) & (lamp > 0)
    np.testing.assert_allclose(both[whole], (own + lamp)[whole], rtol=1e-4)
    np.testing.assert_array_equal(
        irradiance("--light", "scene", "--rotate", "y:90"), irradiance("--rotate", "y:90")
    )


@pytest.mark.parametrize("bad", [5, None, {"a": 1}, 1.5, object()], ids=lambda x: type(x).__name__)
def test_what_is_no_light_is_refused_by_its_kinds(bad):
    with pytest.raises(LightError, match="DirectionalLight.* or Light"):
        as_light(bad)


def test_a_lamp_inside_the_hull_is_warned_of_in_one_line(files, tmp_path, capsys):
    light = ("--light", "point:.2,.5,0:4")
    code, out, err = run(
        capsys, "relight", files / "a.prt", "-o", tmp_path / "a.ply", "--json", *light
    )
    result = json.loads(out)
    assert code == 0 and set(result) == {"points", "exposure", "seconds"}
    assert len(err.splitlines()) == 1 and "lies inside the convex hull of the scene" in err


def test_compare_takes_lights(files, tmp_path, capsys):
    arguments = (
        "compare",
        files / "a.prt",
        "-o",
        tmp_path,
        "--spp",
        "16",
        "--nearest",
        "2",
        "--json",
    )
    code, out, _ = run(
        capsys, *arguments, "--light", "point:3,4,1:30", "--light", "directional:0,-1,0.5:2"
    )
    result = json.loads(out)
    assert code == 0 and abs(result["points"]["bias"]) < 0.1 and "local_light_error" in result


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--light", "lamp:1,2,3:4"), "point:x,y,z:r,g,b"),
        (("--light", "point:1,2,3:-4"), "light 'point:1,2,3:-4'"),
        (("--light", "point:1,2,3:4", "--nearest", "0"), "nearest"),
        (("--light", "envmap:missing.exr"), "does not exist"),
    ],
)
def test_bad_lights_of_the_command_line(files, tmp_path, capsys, arguments, said):
    for command, output in (("relight", "a.npz"), ("compare", "c")):
        code, out, err = run(capsys, command, files / "a.prt", "-o", tmp_path / output, *arguments)
        assert code == 2 and out == "" and said in err and "Traceback" not in err
