"""Norms that see the room: weights, masks, distances and the draw of points, by closed forms."""

import drjit as dr
import numpy as np
import pytest
from conftest import diffuse, disk, facing, largest_z, rectangle, scene, sphere
from scipy.spatial import cKDTree

from mi_prt.errors import SettingsError
from mi_prt.evaluate import metrics
from mi_prt.evaluate.ground_truth import Reference
from mi_prt.evaluate.near_emitters import distance_to_triangles, near_emitters, near_triangles
from mi_prt.evaluate.norms import errors_at_points, image_errors
from mi_prt.evaluate.views import compared_points, first_hits, visible_weights
from mi_prt.points.locate import PatchLocator
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()

# --- weighted errors ------------------------------------------------------------------------------

KEYS = {
    "relative_rmse",
    "bias",
    "reference_noise",
    "relative_rmse_beyond_noise",
    "brightest_share",
    "median_relative_error",
    "median_reference_noise",
}


def estimates(count, seed=0):
    """A result (count, 3) and a Reference, random."""
    rng = np.random.default_rng(seed)
    mean = rng.lognormal(0, 2, (count, 3))
    return mean * rng.normal(1, 0.1, (count, 3)), Reference(mean, 0.03 * mean)


def test_a_weight_is_a_repetition():
    """Rows of whole-number weights give what rows repeated as often give without weights, by the
    definition of a weight; a common factor of the weights changes nothing.
    """
    result, truth = estimates(50)
    weights = np.random.default_rng(1).integers(0, 5, 50)
    again = [np.repeat(x, weights, axis=0) for x in (result, truth.mean, truth.standard_error)]
    repeated = Reference(*again[1:])
    for factor in (1, 0.37):
        w = weights * factor
        for function in (metrics.relative_rmse, metrics.relative_bias):
            assert function(result, truth.mean, w) == pytest.approx(function(*again[:2]), rel=1e-12)
        assert metrics.relative_noise(truth, w) == pytest.approx(repeated.noise, rel=1e-12)
        assert metrics.brightest_share(truth.mean, 0.1, w) == pytest.approx(
            metrics.brightest_share(again[1], 0.1), rel=1e-12
        )
        assert metrics.median_relative_error(result - truth.mean, truth.mean, w) == pytest.approx(
            metrics.median_relative_error(again[0] - again[1], again[1]), rel=1e-12
        )
    assert metrics.relative_rmse(result, truth.mean) != pytest.approx(
        metrics.relative_rmse(result, truth.mean, weights), rel=0.01
    )


def test_the_brightest_share_of_known_rows():
    """1 % of 200 equal rows hold 1 %. Two rows of size 3 among 198 of size 1 hold 2·9 of 2·9 + 198
    in squares; half of the brightest row counts where the share asks for half a row.
    """
    assert metrics.brightest_share(np.ones((200, 3))) == pytest.approx(0.01)
    assert metrics.brightest_share(np.zeros((4, 3))) == 0
    values = np.ones((200, 3))
    values[[7, 90]] = 3
    assert metrics.brightest_share(values) == pytest.approx(18 / 216)
    assert metrics.brightest_share(values, 0.0025) == pytest.approx(4.5 / 216)


def test_the_median_counts_a_dim_room():
    """A dim room of 60 points is 30 % off, a bright one of 40 points 1000 times as bright
    1 % off. The norm sees 1 %, the median 30 %. Below a thousandth of the mean size the
    error is taken relative to that: black points of a result that is nearly black do not count.
    """
    truth = np.ones((100, 3))
    truth[60:] = 1000
    error = np.where(truth > 1, 0.01, 0.3) * truth
    assert metrics.relative_rmse(truth + error, truth) == pytest.approx(0.01, rel=1e-3)
    assert metrics.median_relative_error(error, truth) == pytest.approx(0.3)
    assert metrics.median_relative_error(error, truth, np.where(truth[:, 0] > 1, 2, 1)) == (
        pytest.approx(0.01)
    )
    dark = np.zeros((100, 3))
    dark[0] = 100  # the mean size is 1 per channel
    assert metrics.median_relative_error(np.full((100, 3), 1e-5), dark) == pytest.approx(1e-2)
    assert metrics.median_relative_error(dark * 0, dark * 0) == 0
    assert metrics.median_relative_error(dark, dark * 0) == float("inf")


def test_errors_at_points_leave_points_at_a_lamp_apart():
    """Ten points beside a lamp get 1000 times the light and are 300 % off, as in the scene
    `ashtray`; the others are 5 % too bright, 10 % those that are seen. Each figure is that of its
    points alone, of those that are seen too, as the sensor sees the points beside the lamp.
    """
    truth = np.ones((200, 3))
    near = np.arange(200) < 10
    seen = np.arange(200) >= 150
    truth[near] = 1000
    factor = np.where(near, 4, np.where(seen, 1.1, 1.05))
    areas = np.where(seen, 3.0, 1.0)
    found = errors_at_points(
        truth * factor[:, None], Reference(truth, truth * 0.02), areas, (seen | near) / 60, near
    )
    # 140 points of area 1 that are 5 % off and 50 of area 3 that are 10 % off
    rmse = np.sqrt((140 * 0.05**2 + 150 * 0.1**2) / 290)
    assert set(found) == KEYS | {"visible", "near_emitters"}
    assert found["relative_rmse"] == pytest.approx(rmse)
    assert found["bias"] == pytest.approx((140 * 0.05 + 150 * 0.1) / 290)
    assert found["reference_noise"] == pytest.approx(0.02)
    assert found["relative_rmse_beyond_noise"] == pytest.approx(np.sqrt(rmse**2 - 0.02**2))
    assert found["median_relative_error"] == pytest.approx(0.1)
    assert found["median_reference_noise"] == pytest.approx(0.02)
    assert set(found["visible"]) == KEYS
    assert found["visible"]["relative_rmse"] == pytest.approx(0.1)
    assert set(found["near_emitters"]) == KEYS | {"count"}
    assert found["near_emitters"]["count"] == 10
    assert found["near_emitters"]["relative_rmse"] == pytest.approx(3)
    # what the norm over all points would say
    assert metrics.relative_rmse(truth * factor[:, None], truth) > 2.99


def test_figures_of_no_points_are_none():
    """No point near an emitter, no sensor: there is no error to report, and 0 would be one."""
    result, truth = estimates(5)
    found = errors_at_points(result, truth, np.ones(5), None, np.zeros(5, bool))
    assert found["visible"] is None
    assert found["near_emitters"] == {"count": 0} | dict.fromkeys(KEYS)
    unseen = errors_at_points(result, truth, np.ones(5), np.zeros(5), np.zeros(5, bool))
    assert unseen["visible"] == dict.fromkeys(KEYS)


def test_image_errors_see_beside_a_lamp():
    """A lamp in 1 % of the pixels, rendered exactly, holds all but 99/10099 of the squared norm;
    the rest is 10 % off. The norm of all pixels says 10 % · √(99/10099), less than 1 %.
    """
    mean = np.ones((10, 20, 3))
    mean[4, :2] = 10 * 10**0.5 * 10**0.5
    emits = mean[..., 0] > 1
    covered = np.ones((10, 20), bool)
    covered[0] = False
    mean[0] = 5
    result = np.where(emits[..., None], mean, 1.1 * mean)
    found = image_errors(result, Reference(mean, mean * 0), covered, emits)
    assert found["relative_rmse"] == pytest.approx(0.1) == found["median_relative_error"]
    assert found["bias"] == pytest.approx(0.1)
    assert (found["covered"], found["emitting"]) == pytest.approx((0.9, 0.01))
    assert found["emitting_norm_share"] == pytest.approx(20000 / 20178)
    assert found["brightest_share"] == pytest.approx(0.01)
    assert found["size"] == [20, 10]
    assert set(found) > KEYS and {"psnr", "flip", "exposure"} < set(found)
    with pytest.raises(SettingsError, match="show an emitter"):
        image_errors(result, Reference(mean, mean * 0), emits, emits)
    with pytest.raises(SettingsError, match="sees no surface"):
        image_errors(result, Reference(mean, mean * 0), covered & False, emits)


# --- what a sensor sees ---------------------------------------------------------------------------


def from_above(width=40, height=30, rfilter="box", **rest):
    """An orthographic sensor that looks down on x from −2 to 2 and z from −1.5 to 1.5, a pixel
    every 0.1 m.
    """
    return {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f()
        .look_at([0, 3, 0], [0, 0, 0], [0, 0, 1])
        .scale([2, 2, 1]),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": rfilter},
            **rest,
        },
    }


def lamp(half_width=0.25, height=0.5, normal=(0, 1, 0), radiance=5.0):
    return rectangle(
        normal,
        (0, height, 0),
        half_width,
        emitter={"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    )


def seen(spp=64, **parts):
    opened = mi.load_dict(scene(**parts))
    return first_hits(opened, opened.sensors()[0], spp)


@pytest.mark.parametrize("pixel_format", ["rgb", "luminance", "xyza"])
def test_pixels_that_show_a_lamp(pixel_format):
    """A lamp of 0.5 m square between pixel boundaries shows in 6 × 6 pixels of 0.1 m, in the middle
    pixel rows and columns wholly; a pixel at its corner shows 0.5² of it, so that 64 samples miss
    it once in 10^8. A plane of 2.4 m × 2.4 m covers 24 of 30 rows and 24 of 40 columns.
    """
    hits = seen(eye=from_above(pixel_format=pixel_format), floor=rectangle(size=1.2), lamp=lamp())
    assert hits.coverage.shape == hits.emits.shape == (30, 40)
    # the lamp hangs over x and z from −0.25 to 0.25; 0.1 m pixels start at whole tenths
    expected = np.zeros((30, 40), bool)
    expected[12:18, 17:23] = True
    assert np.array_equal(hits.emits, expected)
    floor = np.zeros((30, 40), bool)
    floor[3:27, 8:32] = True
    assert np.array_equal(hits.covered, floor)


@pytest.mark.parametrize(
    ("what", "parts"),
    [
        ("turned away", {"lamp": lamp(normal=(0, -1, 0))}),
        ("dark", {"lamp": lamp(radiance=0.0)}),
        ("hidden", {"lamp": lamp(), "roof": rectangle(position=(0, 1, 0))}),
        ("point", {"bulb": {"type": "point", "position": [0, 1, 0]}}),
        ("sky", {"sky": {"type": "constant"}}),
    ],
)
def test_what_does_not_emit_toward_the_sensor(what, parts):
    """Nothing emits in these pictures, so that all their pixels count."""
    assert not seen(eye=from_above(), floor=rectangle(size=1.2), **parts).emits.any(), what


def test_a_filter_that_reaches_over_pixels_spreads_the_lamp():
    """A tent filter of radius 1 takes samples up to half a pixel beyond a pixel: from the lamp's
    edge at the middle of a pixel no further pixel, and one more on each side of a lamp whose edge
    is at three quarters of a pixel.
    """
    for half_width, pixels in ((0.24, 6), (0.28, 8)):
        hits = seen(
            spp=256,
            eye=from_above(rfilter="tent"),
            floor=rectangle(size=1.2),
            lamp=lamp(half_width),
        )
        assert hits.emits.sum() == pixels**2


class Picked:
    """One of the three points around a hit, by their barycentric weights."""

    def __init__(self, opened, points):
        self._locator = PatchLocator(opened, points)

    def picked(self, pi, si, ray, active, random):
        (a, b, c), (u, v, _), found = self._locator.locate(pi, si, active)
        return dr.select(random < u, a, dr.select(random < u + v, b, c)), found


def weights_from_above(spp, **parts):
    opened = open_scene(scene(eye=from_above(), **parts))
    points = sample_points(opened, 0.2)
    found = visible_weights(
        opened.mi_scene,
        Picked(opened, points),
        len(points),
        opened.mi_scene.sensors()[0],
        spp,
        seed=3,
    )
    return points, found


def test_visible_weights_of_a_plane_are_areas():
    """Seen from straight above, a plane's points have weights in proportion to the area of their
    hats, which is the points' area: n·share are multinomial counts, whose z is bounded (Šidák, 1 %
    of false positives). Points of a table's underside and of what is out of the picture get none.
    """
    points, found = weights_from_above(
        100,
        floor=rectangle(size=1),
        under=rectangle(normal=(0, -1, 0), position=(0, -1, 0)),
        aside=rectangle(position=(5, 0, 0)),
    )
    assert found.sum() == pytest.approx(1)
    floor = points.surface == 0
    assert (found[~floor] == 0).all() and (~floor).sum() > 200
    area = points.areas[floor].astype(float)
    expected = area / area.sum()
    rays = 20 * 20 * 100  # those that meet the floor
    z = (found[floor] - expected) / np.sqrt(expected * (1 - expected) / rays)
    assert np.abs(z).max() < largest_z(len(z))


def test_visible_weights_leave_out_lamps_and_what_they_hide():
    """The lamp's own points determine no visible irradiance, nor do those of the floor behind it;
    all others of the floor in view do.
    """
    points, found = weights_from_above(100, floor=rectangle(size=1), lamp=lamp(0.5))
    x, _, z = points.positions.T
    floor = points.surface == 0
    hidden = np.maximum(np.abs(x), np.abs(z)) < 0.5 - 0.2  # a cell further in than the lamp's edge
    assert (found[~floor] == 0).all() and (found[floor & hidden] == 0).all()
    beside = np.maximum(np.abs(x), np.abs(z)) > 0.5 + 0.01
    assert (found[floor & beside] > 0).all() and (floor & hidden).sum() >= 4


def test_a_sensor_that_sees_no_points():
    with pytest.raises(SettingsError, match="sees no surface"):
        weights_from_above(1, aside=rectangle(position=(9, 0, 0)))


# --- the draw of points ---------------------------------------------------------------------------


def room(count=400, seed=5):
    rng = np.random.default_rng(seed)
    areas = rng.lognormal(0, 1, count)
    visible = np.where(rng.random(count) < 0.03, rng.lognormal(0, 1, count), 0)
    buried = rng.random(count) < 0.1
    return buried, areas, visible / visible.sum(), rng.random(count)


def test_drawn_points_estimate_both_figures_without_bias():
    """Over 3000 draws of 40 from 400 points the mean of Σ weight·area·f is Σ area·f of all points,
    and so with visibility; its z is bounded (Šidák, 1 % of false positives). 3 % of the points are
    seen, so that a uniform draw of 40 would hold one of them: here they are nearly half.
    """
    buried, areas, visible, f = room()
    sums, drawn_seen = [], []
    for seed in range(3000):
        index, weights = compared_points(buried, areas, visible, 40, seed)
        assert len(index) == len(np.unique(index)) == 40
        assert not buried[index].any() and (weights >= 1).all()
        values = weights * f[index]
        sums.append([areas[index] @ values, visible[index] @ values, areas[index] @ weights])
        drawn_seen.append((visible[index] > 0).sum())
    shown = ~buried
    expected = [areas[shown] @ f[shown], visible[shown] @ f[shown], areas[shown].sum()]
    sums = np.array(sums)
    spread = sums.std(axis=0, ddof=1)
    z = (sums.mean(axis=0) - expected) / (spread / np.sqrt(len(sums)))
    assert np.abs(z).max() < largest_z(3)
    assert (visible[shown] > 0).sum() < 16 and np.mean(drawn_seen) > 8
    # Seen points of a large share are drawn for certain; the estimate of what is seen is good.
    assert spread[1] / expected[1] < 0.15


def test_points_are_drawn_as_often_as_their_weights_say():
    """A weight is 1 over the probability: frequencies in 3000 draws are binomial, z bounded
    (Šidák); and the probabilities sum to what is drawn.
    """
    buried, areas, visible, _ = room(60)
    often, chance = np.zeros(60), np.zeros(60)
    for seed in range(3000):
        index, weights = compared_points(buried, areas, visible, 20, seed)
        often[index] += 1
        chance[index] = 1 / weights
    assert chance.sum() == pytest.approx(20)
    certain = chance == 1
    assert (often[certain] == 3000).all() and certain.any()
    random = (chance > 0) & ~certain
    z = (often - 3000 * chance)[random] / np.sqrt(3000 * chance * (1 - chance))[random]
    assert np.abs(z).max() < largest_z(len(z))


def test_few_points_are_all_drawn():
    """With room for all, each that is not buried is there once with weight 1; where all are buried
    they are compared none the less, as nothing else is there.
    """
    buried, areas, visible, _ = room(30)
    index, weights = compared_points(buried, areas, visible, 30)
    assert np.array_equal(index, np.flatnonzero(~buried)) and (weights == 1).all()
    index, weights = compared_points(np.ones(30, bool), areas, None, 100)
    assert np.array_equal(index, np.arange(30)) and (weights == 1).all()
    assert np.array_equal(
        *(compared_points(buried, areas, visible, 9, seed=4)[0] for _ in range(2))
    )
    with pytest.raises(SettingsError, match="at least 1"):
        compared_points(buried, areas, visible, 0)
    with pytest.raises(SettingsError, match="nothing to compare"):
        compared_points(buried, areas * 0, None, 9)


# --- points beside emitters -----------------------------------------------------------------------

SHINES = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}}
TURNED = (1, 2, -0.5)
EMITTERS = {
    "rectangle": rectangle(TURNED, (0.2, 0, 0.1), 0.4, **SHINES),
    "disk": disk(TURNED, (0.2, 0, 0.1), 0.5, **SHINES),
    "sphere": sphere((0.1, 0.2, 0), 0.4, **SHINES),
    "cylinder": {
        "type": "cylinder",
        "p0": [-0.4, 0.1, 0],
        "p1": [0.5, 0.2, 0.3],
        "radius": 0.25,
        **SHINES,
    },
    "cube": {
        "type": "cube",
        "to_world": facing(TURNED, (0.1, 0, 0), 1).scale([0.4, 0.1, 0.3]),
        **SHINES,
    },
}


@pytest.mark.parametrize("kind", EMITTERS)
def test_points_near_an_emitter_by_brute_force(kind):
    """Against the nearest of 400 × 400 places that Mitsuba samples on the shape: no place of the
    shape is farther than 0.01 m from one of them, so that only distances within 0.01 m of the
    spacing are undecided, few of them.
    """
    opened = mi.load_dict(scene(lamp=EMITTERS[kind], floor=rectangle(size=1)))
    shape = next(e.get_shape() for e in opened.emitters())
    grid = (np.indices((400, 400)).reshape(2, -1) + 0.5) / 400
    sample = shape.sample_position(0.0, mi.Point2f(grid))
    rng = np.random.default_rng(0)
    positions = rng.uniform(-1, 1, (5000, 3))
    spacing = rng.uniform(0.05, 0.3, 5000)
    tree = cKDTree(np.array(sample.p).T)
    distance = tree.query(positions, distance_upper_bound=0.4)[0]  # infinite beyond
    near = near_emitters(opened, positions, spacing)
    assert near[distance <= spacing].all()
    assert not near[distance > spacing + 0.01].any()
    undecided = (distance > spacing) & (distance <= spacing + 0.01)
    assert near.sum() > 200 and undecided.sum() < 0.02 * 5000
    # one number is an array of equal ones
    assert np.array_equal(
        near_emitters(opened, positions, 0.2),
        near_emitters(opened, positions, np.full(5000, 0.2)),
    )


def test_points_near_lights_without_a_surface():
    """Spheres about a point light and a spot; distant and dark emitters have no near points."""
    turned = mi.ScalarTransform4f().look_at([0, 0.5, 0], [0, 0, 1], [0, 1, 0])
    opened = mi.load_dict(
        scene(
            floor=rectangle(size=1),
            bulb={"type": "point", "position": [0.3, 0, 0.1]},
            spot={"type": "spot", "to_world": turned},
            sky={"type": "constant"},
            dark=lamp(height=-0.5, radiance=0.0),
        )
    )
    positions = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    expected = np.linalg.norm(positions[:, None] - [[0.3, 0, 0.1], [0, 0.5, 0]], axis=2).min(axis=1)
    for spacing in (0.2, 0.5):
        near = near_emitters(opened, positions, spacing)
        assert np.array_equal(near, expected <= spacing) and near.any()
    unlit = mi.load_dict(scene(floor=rectangle(size=1), sky={"type": "constant"}))
    assert not near_emitters(unlit, positions, 9.0).any()


def test_distances_to_triangles_of_known_position():
    """By hand, from the triangle (0,0,0), (1,0,0), (0,1,0): above its inside, beyond an edge,
    beyond a corner, beyond the long edge; and from one that is only a segment, or a point.
    """
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    places = np.array([[0.2, 0.2, 3], [0.5, -2, 0], [-3, -4, 0], [1, 1, 0], [0.3, 0.3, 0]])
    found = distance_to_triangles(places, np.broadcast_to(triangle, (5, 3, 3)))
    assert found == pytest.approx([3, 2, 5, 0.5**0.5, 0])
    flat = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1, 1, 1]] * 3], float)
    assert distance_to_triangles(np.array([[1.5, 2, 0], [1, 1, 4]]), flat) == pytest.approx([2, 3])


def test_near_triangles_of_all_sizes_by_brute_force(monkeypatch):
    """The search through the tree, in many small blocks, finds what all pairs give."""
    monkeypatch.setattr("mi_prt.evaluate.near_emitters._PAIRS", 500)
    rng = np.random.default_rng(2)
    corners = rng.uniform(-1, 1, (60, 1, 3)) + rng.normal(size=(60, 3, 3)) * rng.lognormal(
        -3, 1.5, (60, 1, 1)
    )
    positions, spacing = rng.uniform(-1, 1, (700, 3)), rng.uniform(0, 0.2, 700)
    pairs = distance_to_triangles(np.repeat(positions, 60, axis=0), np.tile(corners, (700, 1, 1)))
    expected = pairs.reshape(700, 60).min(axis=1) <= spacing
    assert np.array_equal(near_triangles(corners, positions, spacing), expected)
    assert 50 < expected.sum() < 650


def test_weights_of_an_albedo_do_not_matter():
    """What a sensor sees of points does not depend on their material: only lamps are left out."""
    bright = weights_from_above(4, floor=rectangle(size=1, bsdf=diffuse(0.9)))[1]
    dark = weights_from_above(4, floor=rectangle(size=1, bsdf=diffuse(0.0)))[1]
    assert np.array_equal(bright, dark)
