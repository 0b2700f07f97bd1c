"""Points of both layouts, vertices and samples, under one set of tests: look-ups, clusters,
transport against Mitsuba, and what of their files is refused.

Bounds are 1.3 to 2 times what was found; Mitsuba's own noise is subtracted from squared errors and
its standard error added to the bounds of biases.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import (
    SampledScene,
    bias,
    cube,
    diffuse,
    largest_z,
    rectangle,
    relative_l2,
    scene,
    sky_of,
    sphere,
    uniform_directions,
)
from scipy.spatial import cKDTree

import mi_prt
from mi_prt import EnvironmentMap, PointLight
from mi_prt.directions import parse_directions
from mi_prt.evaluate.ground_truth import indirect_irradiance, local_irradiance
from mi_prt.lighting.light import as_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.clusters import Clusters, make_clusters
from mi_prt.points.layout import LAYOUTS, Spacing
from mi_prt.points.points import sample_points
from mi_prt.points.samples import scatter_points
from mi_prt.scene.materials import facing
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import find_buried, sample_direct
from mi_prt.transport.hops import blocked_share

mi = mitsuba()

TWO_SIDED = {"type": "twosided", "nested": diffuse()}
# about 2,500 points in each scene, by each layout; no vertices in the middle, where walls are
POINTS = {
    "vertices": {"points": "vertices", "edge_length": 0.17},
    "samples": {"points": "samples", "count": 2500},
}
both = pytest.mark.parametrize("layout", POINTS)


def eye(origin, target=(0, 0, 0)):
    """A sensor, from which particles start."""
    look = mi.ScalarTransform4f().look_at(
        origin=list(map(float, origin)), target=list(map(float, target)), up=[0, 1, 0]
    )
    return {"type": "perspective", "to_world": look}


def walled():
    """A closed room of 2 m, seen from both sides of a wall without thickness across all of it."""
    wall = mi.ScalarTransform4f().rotate([0, 1, 0], 90)
    return scene(
        eye=eye((0.6, 0.2, 0.5)),
        other=eye((-0.6, 0.2, 0.5), (-1, 0, 0)),
        shell={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.6)},
        wall={"type": "rectangle", "to_world": wall, "bsdf": TWO_SIDED},
    )


def courtyard():
    """A coloured yard without a roof, with a block and a ball in it."""
    return scene(
        eye=eye((0.2, 2.5, 0.3)),
        floor=rectangle((0, 1, 0), (0, 0, 0), bsdf=diffuse(0.6)),
        red=rectangle((1, 0, 0), (-1, 1, 0), bsdf=diffuse([0.8, 0.2, 0.1])),
        back=rectangle((0, 0, 1), (0, 1, -1), bsdf=diffuse(0.6)),
        green=rectangle((-1, 0, 0), (1, 1, 0), bsdf=diffuse([0.2, 0.7, 0.2])),
        block=cube((-0.4, 0.3, -0.3), 0.3, bsdf=diffuse(0.6)),
        ball=sphere((0.45, 0.3, 0.2), 0.3, bsdf=diffuse(0.6)),
    )


def rooms():
    """Two rooms of 2 × 2 × 1 m with a doorway between them and a block, as of scenes/room.xml, in
    one-sided materials: the outer sides of walls of two would take half of the vertices. The
    partition goes through floor and ceiling: where it ends in their plane, vertices in it see them
    and are not buried.
    """
    grey = diffuse(0.7)
    return scene(
        eye=eye((0.3, 0.4, 0.9)),
        floor=rectangle((0, 1, 0), (0, -1, 0), bsdf=grey),
        ceiling=rectangle((0, -1, 0), (0, 1, 0), bsdf=grey),
        back=rectangle((0, 0, 1), (0, 0, -1), bsdf=grey),
        front=rectangle((0, 0, -1), (0, 0, 1), bsdf=grey),
        red=rectangle((1, 0, 0), (-1, 0, 0), bsdf=diffuse([0.7, 0.2, 0.1])),
        green=rectangle((-1, 0, 0), (1, 0, 0), bsdf=diffuse([0.1, 0.6, 0.3])),
        partition={
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([-0.5, 0, -0.1]).scale([0.6, 1.1, 0.05]),
            "bsdf": grey,
        },
        block=cube((0.5, -0.75, 0.5), 0.25, bsdf=grey),
    )


def points_of(opened, layout, edge_length=0.17, count=2500, clusters=12):
    """Points and Clusters of a Scene."""
    if layout == "samples":
        return scatter_points(opened, count, clusters)[:2]
    points = sample_points(opened, edge_length)
    return points, make_clusters(points, clusters)


@pytest.fixture(scope="module", params=POINTS)
def found(request):
    """Scene, points, clusters of `walled`."""
    opened = open_scene(walled())
    return opened, *points_of(opened, request.param, clusters=25)


# --- look-ups -------------------------------------------------------------------------------------


def hits(opened, origins, directions):
    """Hits of rays (k, 3), as tracers ask for them: arguments of a Locator, and their positions and
    normals on the side that is met.
    """
    ray = mi.Ray3f(
        *(
            kind(np.float32(x).T)
            for kind, x in zip((mi.Point3f, mi.Vector3f), (origins, directions))
        )
    )
    pi = opened.occluders.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray)
    normals, si.wi, reflects = facing(si, ray, opened.surfaces)
    active = si.is_valid() & reflects
    assert np.array(active).all()
    return (pi, si, ray, active), np.array(si.p).T, np.array(normals.shading).T


def rays_in_the_room(count, seed=0):
    """Rays from places in both halves of `walled`."""
    random = np.random.default_rng(seed)
    origins = random.uniform(-0.9, 0.9, (count, 3))
    origins[:, 0] = np.where(np.abs(origins[:, 0]) < 0.05, 0.5, origins[:, 0])
    return origins, uniform_directions(random, count)


def repeated(at, times):
    """A Locator's arguments, each hit `times` times in a row."""
    import drjit as dr

    lane = dr.arange(mi.UInt32, times * dr.width(at[1].p)) // times
    return [dr.gather(type(part), part, lane) for part in at]


def with_buried(points):
    """The same of which every third point is buried."""
    return replace(points, buried=np.arange(len(points)) % 3 == 0)


def test_picked_is_interpolated_in_the_mean(found):
    """A picked point's value is that of interpolation in the mean. 1,000 hits, 4,000 picks of each:
    the largest z-value; 1 % of correct programs fail (Šidák). The variance of picks is exact, also
    by interpolation; hits at which it is small are left out, because their sums are of a few rare
    picks and not Gaussian.
    """
    opened, points, _ = found
    if points.layout.buries:
        points = with_buried(points)
    locator, times, random = points.locator(opened), 4000, np.random.default_rng(0)
    at, _, _ = hits(opened, *rays_in_the_room(1000))
    values = random.random((len(points), 3)).astype(np.float32)
    values[:, 1] = values[:, 0] ** 2
    expected, _ = locator.interpolated(mi.Float(values.ravel()), *at)
    mean, square = np.array(expected)[:2].astype(np.float64)
    uniform = mi.Float(random.random(1000 * times, dtype=np.float32))
    index, some = (
        np.array(x).reshape(1000, times) for x in locator.picked(*repeated(at, times), uniform)
    )
    assert (some.all(axis=1) == some.any(axis=1)).all() and some.any(axis=1).mean() > 0.9
    assert not points.buried[index[some]].any()
    spread = np.sqrt(np.maximum(square - mean**2, 0))
    used = some[:, 0] & (spread > 0.15)
    assert used.sum() > 300
    z = (values[index[used], 0].mean(axis=1, dtype=np.float64) - mean[used]) / spread[used]
    assert np.abs(z).max() * np.sqrt(times) < largest_z(used.sum())


def test_points_around_a_hit_are_on_the_side_that_is_met(found):
    """Of both sides of the wall and of all walls: the normals of what is picked or nearest agree
    with that of the hit, and they are near; interpolated normals are those of the hit. (2.5 radii
    are a sample's reach; a triangle's nodes are within its longest edge, 0.17 m.)
    """
    opened, points, _ = found
    locator = points.locator(opened)
    at, position, normal = hits(opened, *rays_in_the_room(20_000))
    on_wall = np.abs(position[:, 0]) < 1e-4
    assert (on_wall & (normal[:, 0] > 0)).mean() > 0.05 and (on_wall & (normal[:, 0] < 0)).any()
    uniform = mi.Float(np.random.default_rng(1).random(20_000, dtype=np.float32))
    reach = 2.5 * float(np.max(points.layout.spacing(points)))
    nearest, some = locator.nearest(*at)
    for index, ok in ((nearest, some), locator.picked(*at, uniform)):
        index, ok = np.array(index), np.array(ok)
        assert ok.all()
        assert (np.einsum("ij,ij->i", points.normals[index], normal) > 0.5).all()
        assert np.linalg.norm(points.positions[index] - position, axis=1).max() < reach
    values, ok = locator.interpolated(mi.Float(points.normals.ravel()), *at)
    assert np.array(ok).all()
    cosine = np.einsum("ij,ij->i", np.array(values).T, normal)
    assert np.mean(cosine) > 0.99
    if points.layout.kind == "patches":
        np.testing.assert_allclose(cosine, 1, atol=1e-5)
        # the largest weight is that of the nearest node of its row and column, or about
        apart = np.linalg.norm(points.positions[np.array(nearest)] - position, axis=1)
        assert apart.max() < 0.75 * 0.17
    else:
        tree = cKDTree(np.hstack([points.positions, points.layout.radius * points.normals]))
        expected = tree.query(np.hstack([position, points.layout.radius * normal]))[1]
        assert (np.array(nearest) == expected).mean() > 0.99


def test_nearest_is_not_behind_a_thin_wall(found):
    """Seen from the wall, points of the floor on its other side do not count, however near. Without
    the place that looks some of them are nearest.
    """
    opened, points, _ = found
    locator, random, count = points.locator(opened), np.random.default_rng(2), 20_000
    origins = random.uniform(-0.9, 0.9, (count, 3))
    origins[:, 0] = 1e-4 * np.where(np.arange(count) % 2, 1, -1)
    side = np.sign(origins[:, 0])
    steep = np.stack([0.05 * side, -np.ones(count), np.zeros(count)], axis=-1)
    at, position, _ = hits(opened, origins, steep / np.linalg.norm(steep, axis=1)[:, None])
    assert (position[:, 0] * side > 0).all() and (np.abs(position[:, 0]) < 0.11).all()
    up = mi.Vector3f(mi.Float(np.float32(side)), mi.Float(0), mi.Float(0))
    index, some = locator.nearest(*at, (mi.Point3f(np.float32(origins).T), up))
    index, some = np.array(index), np.array(some)
    behind = 0.11 * float(np.median(points.layout.spacing(points)))
    assert some.mean() > 0.99
    assert (points.positions[index[some], 0] * side[some] > -behind).all()
    free = np.array(locator.nearest(*at)[0])
    assert (points.positions[free, 0] * side < -behind).mean() > 0.02


# --- clusters -------------------------------------------------------------------------------------


def test_clusters_divide_the_points(found):
    """Each point is in one cluster; order and rank are inverse to each other; roots are in their
    clusters, and labels count them.
    """
    _, points, clusters = found
    n = len(points)
    clusters.check(n)
    np.testing.assert_array_equal(np.sort(clusters.order), np.arange(n))
    np.testing.assert_array_equal(clusters.order[clusters.rank], np.arange(n))
    np.testing.assert_array_equal(clusters.rank[clusters.order], np.arange(n))
    assert len(clusters) == len(clusters.slices) == 25
    for number, (part, root) in enumerate(zip(clusters.slices, clusters.roots)):
        assert part.start <= root < part.stop
        assert (clusters.labels[part] == number).all()
    sizes = np.diff(clusters.starts)
    assert sizes.sum() == n and sizes.max() < 3 * n / 25
    again = points_of(
        found[0], "samples" if points.layout.kind == "spacing" else "vertices", clusters=25
    )
    np.testing.assert_array_equal(again[1].order, clusters.order)


def test_no_cluster_holds_both_sides_of_a_wall(found):
    """All normals of a cluster are within 60° of its root's, so that none are opposite."""
    _, points, clusters = found
    for part, root in zip(clusters.slices, clusters.roots):
        normals = points.normals[clusters.order[part]]
        assert (normals @ points.normals[clusters.order[root]] > 0.5).all()
        assert (normals @ normals.T).min() > -0.5


@pytest.mark.parametrize("count", [1, 3, 10_000])
def test_any_number_of_clusters(count):
    """One, and as many as there are points, where more were asked for."""
    points = sample_points(open_scene(scene(a=rectangle())), 0.7)
    clusters = make_clusters(points, count)
    clusters.check(len(points))
    assert len(clusters) == min(count, len(points))


BROKEN_CLUSTERS = [
    (dict(starts=[1, 2, 4]), "starts do not divide"),
    (dict(starts=[0, 2, 3]), "starts do not divide"),
    (dict(starts=[0, 4, 4]), "starts do not divide"),
    (dict(starts=[0, 0, 4]), "starts do not divide"),
    (dict(order=[0, 1, 2, 2]), "order does not hold each point once"),
    (dict(order=[0, 1, 2, 4]), "order does not hold each point once"),
    (dict(roots=[2, 3]), "roots are not in their clusters"),
    (dict(roots=[0, 1]), "roots are not in their clusters"),
]


@pytest.mark.parametrize(("change", "match"), BROKEN_CLUSTERS)
def test_clusters_that_do_not_fit_are_refused(change, match):
    whole = dict(order=[3, 1, 0, 2], starts=[0, 2, 4], roots=[1, 2])
    made = Clusters(**{k: np.array(v) for k, v in whole.items()})
    made.check(4)
    np.testing.assert_array_equal(made.in_order().order, np.arange(4))
    with pytest.raises(ValueError, match=match):
        Clusters(**{k: np.array(v) for k, v in (whole | change).items()}).check(4)


# --- files of layouts -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def vertices():
    parts = scene(a=rectangle(bsdf=TWO_SIDED), b=sphere((0, 2, 0)))
    return sample_points(open_scene(parts), 0.5)


def changed(points, **arrays):
    """Points whose layout's arrays are the results of functions of them."""
    layout = points.layout
    new = {name: change(getattr(layout, name).copy()) for name, change in arrays.items()}
    return replace(points, layout=replace(layout, **new))


def surfaces(points, number, **values):
    """Points with a record of a surface changed."""
    records = list(points.surfaces)
    records[number] = records[number] | values
    return replace(points, surfaces=tuple(records))


def at(number, value):
    """A function that puts a value into a place of an array."""

    def change(array):
        array[number] = value
        return array

    return change


BROKEN_PATCHES = {
    "level 0": (lambda p: changed(p, levels=at((0, 0), 0)), "offsets do not fit the levels"),
    "other level": (lambda p: changed(p, levels=at((0, 0), 9)), "offsets do not fit the levels"),
    "last level": (lambda p: changed(p, levels=at((-1, 1), 99)), "nodes are .* instead of"),
    "an offset": (lambda p: changed(p, offsets=at(1, 7)), "offsets do not fit the levels"),
    "too few nodes": (lambda p: changed(p, nodes=lambda a: a[:-1]), "nodes are .* instead of"),
    "back beyond": (lambda p: changed(p, back=at(-1, len(p) - 1)), "back leads beyond the points"),
    "order": (lambda p: surfaces(p, 1, first_patch=1), "do not list the patches in order"),
    "too few": (lambda p: replace(p, surfaces=p.surfaces[:1]), "list .* patches of"),
    "too many": (lambda p: surfaces(p, 1, patches=5), "list .* patches of"),
}


@pytest.mark.parametrize("name", BROKEN_PATCHES)
def test_patches_that_do_not_fit_are_refused(vertices, name):
    """Each array and record that leads elsewhere is found before anything follows it."""
    vertices.layout.check(vertices)
    change, match = BROKEN_PATCHES[name]
    broken = change(vertices)
    with pytest.raises(ValueError, match=match):
        broken.layout.check(broken)


@pytest.mark.parametrize(
    "report", [{}, *({"radius": r} for r in (0.0, -1.0, 1, "1", True, None, [], 1e300, np.nan))]
)
def test_a_radius_that_is_none_is_refused(report):
    with pytest.raises(ValueError, match="points.report.radius"):
        LAYOUTS["spacing"].from_arrays({}, report)


def test_a_layout_comes_back_from_its_arrays(found, vertices):
    """By the kind of the layout alone; with the same answers."""
    for points in (found[1], vertices):
        layout, report = points.layout, points.report
        again = LAYOUTS[layout.kind].from_arrays(layout.arrays(), report)
        again.check(points)
        np.testing.assert_array_equal(again.spacing(points), layout.spacing(points))
        np.testing.assert_array_equal(again.triangles(), layout.triangles())
        assert set(layout.arrays()) == set(layout.SHAPES)
    assert len(Spacing(0.1).triangles()) == 0 and not Spacing(0.1).buries


# --- light from afar ------------------------------------------------------------------------------


def some(points, count, kept, seed=0):
    """Some of the points that are kept (n,) bool, and their indices."""
    index = np.sort(np.random.default_rng(seed).permutation(np.flatnonzero(kept))[:count])
    return points.at(index), index


@both
@pytest.mark.parametrize("name", ["open box", "cube on a floor"])
def test_white_surfaces_under_a_white_sky_vanish(layout, name):
    """Albedo 1 and radiance 1 from all around: outgoing radiance is 1 everywhere. What is found to
    be blocked meets a point, so that no light is lost; what a point sees of the sky errs by the
    lattice's quadrature (1e-3 for cubemap:16), and no average of other points errs more. (There is
    no sensor: particles that start at one leave holes where they rarely get.)
    """
    white = diffuse(1.0)
    parts = dict(floor=rectangle(size=2, bsdf=white))
    if name == "open box":
        for i, n in enumerate([(1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1)]):
            parts[f"wall{i}"] = rectangle(n, np.add([0, 2, 0], -2 * np.array(n)), 2, bsdf=white)
    else:
        parts["box"] = cube((0, 0.5, 0), 0.5, bsdf=white)
    opened = open_scene(scene(**parts))
    points, _ = points_of(opened, layout, 0.3, 800)
    lattice = parse_directions("cubemap:16")
    transport = sample_direct(opened, points, lattice, 1)
    if points.layout.buries:
        points = replace(points, buried=find_buried(opened, points, transport.dark()))
    blocked = blocked_share(transport, lattice.solid_angles)
    assert blocked.max() > 0.2
    made = SampledScene(opened, points, lattice, transport, blocked)
    direct, hops = made.direct(), made.hops(64)
    once = direct + made.reflections(hops, direct, 1, 1)[0]
    radiance = (direct + made.reflections(hops, direct, 1, None)[0])[:, 0] / np.pi
    np.testing.assert_allclose(radiance[made.kept], 1, atol=2e-3)
    assert (once[made.kept, 0] / np.pi < 1 + 2e-3).all()


@pytest.mark.slow
@both
def test_reflected_sky_against_mitsuba(layout):
    """Colours of a yard bleed under a coloured sky; Mitsuba's path tracer at 300 points."""
    opened = open_scene(courtyard())
    sky = EnvironmentMap(
        sky_of(
            lambda d: (
                np.maximum(0, [1, 1, 2] + d @ np.diag([1, 0.5, 1])) + [2, 1, 0] * d[:, :1] ** 2
            ),
            32,
        )
    )
    asset = mi_prt.precompute(
        courtyard(),
        transports="distant",
        directions="cubemap:16",
        coefficients=64,
        keep_direct=True,
        paths_per_point=256,
        **POINTS[layout],
    )
    assert list(asset.transports) == ["distant"] and asset.transports["distant"].channels == 3
    points, index = some(asset.points, 300, ~asset.buried)
    lit = lit_scene(opened, as_light(sky), modelled=True)
    truth = indirect_irradiance(lit, points, 1024, None, 1)
    result = asset.irradiance(sky, "indirect")[index]
    squared = relative_l2(result, truth.mean) ** 2 - truth.noise**2
    of_sum = np.sqrt((truth.standard_error**2).sum()) / truth.mean.sum()
    # 6 % with either layout: 64 components hold 94 % of the transport's variance
    assert np.sqrt(max(squared, 0)) < 0.10
    assert abs(bias(result, truth.mean)) < 0.015 + largest_z(1) * of_sum


# --- light that moves -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured():
    """Errors of direct and indirect irradiance by layout, under eight lights: relative RMSE and
    bias of the mean over lights, at 150 points that are not beside a light.
    """
    opened, result = open_scene(rooms()), {}
    places = np.random.default_rng(1).uniform(-0.85, 0.85, (60, 3))
    inside = (np.abs(places[:, 2] + 0.1) < 0.15) | (np.abs(places - [0.5, -0.75, 0.5]) < 0.35).all(
        axis=1
    )
    for layout, settings in POINTS.items():
        asset = mi_prt.precompute(
            rooms(),
            transports="local",
            cluster_size=250,
            depth_directions=576,
            example_lights=200,
            transfer_coefficients=20,
            **settings,
        )
        points, index = some(asset.points, 150, ~asset.buried)
        squares, biases = [], []
        for place in places[~inside][:8]:
            light = PointLight(place, (1.0, 2.0, 3.0))
            direct = local_irradiance(opened.occluders, points, [light])
            lit = lit_scene(opened, as_light(light), modelled=True)
            paths = indirect_irradiance(lit, points, 512, None, 1)
            found = [asset.irradiance(light, c)[index] for c in ("direct", "indirect")]
            squares.append(
                [
                    relative_l2(found[0], direct) ** 2,
                    max(relative_l2(found[1], paths.mean) ** 2 - paths.noise**2, 0),
                ]
            )
            biases.append([bias(found[0], direct), bias(found[1], paths.mean)])
        rmse, mean = np.sqrt(np.mean(squares, axis=0)), np.mean(biases, axis=0)
        result[layout] = asset, rmse, mean
    return result


@pytest.mark.slow
@both
def test_moved_lights_against_mitsuba(measured, layout):
    """Eight lights that were no examples, at 150 points: shadow rays have the direct irradiance,
    Mitsuba's paths the reflected one.
    """
    asset, (direct, indirect), mean = measured[layout]
    assert 2000 < len(asset.points) < 3500
    assert direct < 0.15 and indirect < 0.20, (direct, indirect)
    assert (np.abs(mean) < [0.04, 0.06]).all(), mean
    report = asset.transports["local"].report
    assert report["misclassified_visibility"] < 0.09 and report["transfer_error"] <= 0.02


def test_vertices_are_about_as_good_as_samples(measured):
    """At about equal number, neither is better by half."""
    (one, first, _), (other, second, _) = (measured[layout] for layout in POINTS)
    assert 0.7 < len(one.points) / len(other.points) < 1.4
    assert (first < 1.5 * second).all() and (second < 1.5 * first).all(), (first, second)


@both
def test_clusters_of_a_file_are_those_of_the_run(measured, layout, tmp_path):
    """Order, depth buffers and transfer belong together in files too: the same irradiance."""
    asset = measured[layout][0]
    asset.save(tmp_path / "a.prt")
    loaded = mi_prt.load(tmp_path / "a.prt")
    light = PointLight((0.3, 0.2, 0.6), 1.0)
    in_order = np.array_equal(
        loaded.transports["local"].clusters.order, np.arange(len(asset.points))
    )
    assert in_order == (layout == "samples")
    for component in ("direct", "indirect"):
        np.testing.assert_array_equal(
            loaded.irradiance(light, component), asset.irradiance(light, component)
        )


@both
def test_reflected_light_stays_on_its_side_of_a_thin_wall(layout):
    """Two closed rooms that share a wall without thickness; the truth behind it is darkness. What
    leaks is that of points of the floor and walls that are met in one room and nearest in the
    other, in a strip of a point's spacing.
    """
    asset = mi_prt.precompute(
        walled(),
        transports="local",
        cluster_size=250,
        depth_directions=576,
        example_lights=200,
        transfer_coefficients=20,
        **POINTS[layout],
    )
    points, shown = asset.points, ~asset.buried
    behind = shown & (
        (points.positions[:, 0] < -1e-3)
        | ((np.abs(points.positions[:, 0]) < 1e-3) & (points.normals[:, 0] < -0.9))
    )
    ahead = shown & ~behind
    for place in ((0.5, 0.1, -0.2), (0.7, -0.5, 0.4), (0.45, 0.6, 0.6)):
        for component, most in (("direct", 0.003), ("indirect", 0.07)):
            values = asset.irradiance(PointLight(place, 1.0), component)[:, 0]
            power = values.astype(np.float64) * points.areas
            assert power[behind].sum() < most * 4 * np.pi
            assert power[ahead].sum() > 5 * power[behind].sum()
