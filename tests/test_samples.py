"""Meshless samples: blue noise, particles, areas, clusters, look-ups, and the hemisphere's grid of
directions.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.stats
from conftest import (
    FALSE_POSITIVES,
    cube,
    diffuse,
    disk,
    mesh,
    rectangle,
    scene,
    sphere,
    uniform_directions,
)
from scipy.spatial import cKDTree

from mi_prt import SceneError, SettingsError
from mi_prt.directions.hemisphere import Hemisphere, frame_of, frames
from mi_prt.points.particles import (
    PARTICLES,
    STEPS,
    WARM_UP,
    cross_surfaces,
    example_places,
    free_places,
    trace_particles,
)
from mi_prt.points.sample_locator import ALIGNMENT, REACH, SHARPNESS, SampleLocator
from mi_prt.points.samples import scatter_points
from mi_prt.points.thinning import embedded, thin
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()

TWO_SIDED = {"type": "twosided", "nested": diffuse()}


def camera(origin=(0.3, -0.2, 0.1), target=(1, 0.2, 0.4), near=1e-2):
    """A perspective camera; its view is 60° high."""
    to_world = mi.ScalarTransform4f().look_at(
        origin=list(map(float, origin)), target=list(map(float, target)), up=[0, 1, 0]
    )
    return {
        "type": "perspective",
        "fov": 60,
        "fov_axis": "smaller",
        "to_world": to_world,
        "near_clip": near,
        "far_clip": 1e6 * near,
    }


def room(size=1.0, centre=(0, 0, 0), **rest):
    """A closed cube of half side `size`, seen from within."""
    centre = np.asarray(centre, float)
    to_world = [centre + size * np.array([0.3, -0.2, 0.1]), centre + size * np.array([1, 0.2, 0.4])]
    return scene(
        room=cube(centre, size, bsdf=TWO_SIDED), camera=camera(*to_world, near=1e-2 * size), **rest
    )


@dataclass(frozen=True)
class Samples:
    """Points, their clusters, and flights of the particles that found them."""

    points: object
    clusters: object
    flights: object

    @property
    def radius(self):
        return self.points.layout.radius


def scattered(parts, count=4000, cluster_size=200, seed=0):
    clusters = max(1, round(count / cluster_size))
    return Samples(*scatter_points(open_scene(parts), count, clusters, seed))


def lanes(vectors, kind=None):
    return (kind or mi.Point3f)(np.ascontiguousarray(np.asarray(vectors, np.float32).T))


# --- thinning -------------------------------------------------------------------------------------


def plane(count=32000, seed=1):
    """Candidates on the unit square: positions and normals."""
    positions = np.zeros((count, 3), np.float32)
    positions[:, :2] = np.random.default_rng(seed).random((count, 2))
    return positions, np.tile(np.float32([0, 0, 1]), (count, 1))


def ball(count=32000, radius=1.0, seed=2):
    normals = uniform_directions(np.random.default_rng(seed), count).astype(np.float32)
    return np.float32(radius) * normals, normals


def joined(*parts):
    return tuple(np.concatenate(arrays) for arrays in zip(*parts))


def nearest_other(points):
    return cKDTree(points).query(points, 2)[0][:, 1]


@pytest.mark.parametrize("count", [1, 2, 77, 2000])
@pytest.mark.parametrize("candidates", [plane, ball])
def test_exactly_so_many_stay_and_keep_their_distance(candidates, count):
    positions, normals = candidates()
    chosen, radius = thin(positions, normals, count)
    assert len(chosen) == len(set(chosen)) == count and (np.diff(chosen) > 0).all()
    if count > 1:
        # 0.99: while the radius shrinks to the one that is returned, normals count as before; that
        # is 3 % a step of a small part.
        assert (
            nearest_other(embedded(positions[chosen], normals[chosen], radius)).min()
            >= (1 if candidates is plane else 0.99) * radius
        )


@pytest.mark.parametrize(
    "candidates",
    [plane, ball, lambda: (np.random.default_rng(3).random((32000, 3), np.float32), None)],
)
def test_samples_cover_all_candidates(candidates):
    """Thinning is greedy: a candidate farther than the radius from all others would have been
    chosen, but for those at its end.
    """
    positions, normals = candidates()
    chosen, radius = thin(positions, normals, 2000, dimension=2 if normals is not None else 3)
    points = embedded(positions, normals, radius)
    hole = cKDTree(points[chosen]).query(points)[0] / radius
    assert (hole < 1).mean() > 0.97
    assert hole.max() < 1.6


def test_the_same_seed_gives_the_same_samples():
    first, second, other = (thin(*ball(), 500, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1] == second[1]
    assert not np.array_equal(first[0], other[0])


def test_all_candidates_may_stay():
    positions, normals = plane(500)
    chosen, radius = thin(positions, normals, 500)
    np.testing.assert_array_equal(chosen, np.arange(500))
    assert 0 <= radius <= nearest_other(positions).min()


def test_more_samples_than_candidates_are_refused():
    with pytest.raises(SettingsError, match="501 points are more than the 500 candidates"):
        thin(*plane(500), 501)


def test_coincident_candidates_fill_up_last():
    """101 places for 200 points: every place is taken, and only then any of them twice."""
    positions, normals = plane(600)
    positions[100:] = 0.5
    chosen, radius = thin(positions, normals, 200)
    assert len(set(chosen)) == 200
    assert len(np.unique(positions[chosen], axis=0)) == 101
    assert radius == 0


def test_crowded_candidates_count_no_more_than_sparse_ones():
    """Three in four candidates lie in a tenth of the width; density then must be that of the area,
    0.1, not of the candidates, 0.775.
    """
    positions, normals = plane(40000)
    positions[10000:, 0] *= 0.1
    chosen, _ = thin(positions, normals, 1000)
    # The sparse part leaves holes, of 11 candidates a sample, and the strip's long rim takes more
    # than its area.
    assert 0.1 < (positions[chosen, 0] < 0.1).mean() < 0.2


def test_points_come_closer_where_the_surface_is_curved():
    """On a ball of radius R normals turn by |Δp|/R, so the metric's r is the distance r/√(1 +
    r²/R²) there, and r on the plane.
    """
    small = 0.02
    curved, flat = ball(8000, small), plane(32000)
    positions, normals = joined((curved[0] + np.float32([0, 0, 1]), curved[1]), flat)
    chosen, radius = thin(positions, normals, 2000)
    on_ball = chosen < 8000
    factor = np.sqrt(1 + (radius / small) ** 2)
    assert factor > 1.2
    assert nearest_other(positions[chosen[~on_ball]]).min() == pytest.approx(radius, rel=0.01)
    assert nearest_other(positions[chosen[on_ball]]).min() == pytest.approx(
        radius / factor, rel=0.05
    )
    assert nearest_other(positions[chosen[on_ball]]).min() >= 0.999 * radius / factor


def test_the_sides_of_a_thin_wall_do_not_thin_each_other():
    """Opposite normals are 2r apart: each side gets what it would get alone."""
    front, back = plane(16000), plane(16000, seed=7)
    positions, normals = joined(front, (back[0], -back[1]))
    chosen, radius = thin(positions, normals, 1000)
    is_front = chosen < 16000
    assert 0.47 < is_front.mean() < 0.53
    for side, own in ((is_front, front), (~is_front, back)):
        mine = positions[chosen[side]]
        assert nearest_other(mine).min() >= radius
        assert (cKDTree(mine).query(own[0])[0] < radius).mean() > 0.97
    across = cKDTree(positions[chosen[is_front]]).query(positions[chosen[~is_front]])[0]
    assert across.min() < 0.2 * radius


# --- blue noise -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def square():
    """Blue noise (2000, 2) on the unit square, and its radius."""
    positions, normals = plane()
    chosen, radius = thin(positions, normals, 2000)
    return positions[chosen, :2].astype(np.float64), radius


def test_the_radial_distribution_is_that_of_blue_noise(square):
    """Zero below the radius, one finite peak just above (a crystal's would grow with finer bins),
    and one far away.
    """
    positions, radius = square
    # Centres this far from the border see rings that are whole.
    centres = positions[((positions > 0.15) & (positions < 0.85)).all(axis=1)]
    edges = radius * np.arange(0.5, 8.01, 0.25)
    within = cKDTree(positions).count_neighbors(cKDTree(centres), edges).astype(float)
    density = np.diff(within) / (len(centres) * len(positions) * np.pi * np.diff(edges**2))
    ratio = edges / radius
    assert (density[ratio[1:] <= 1] == 0).all()
    peak = density[(ratio[:-1] >= 1) & (ratio[:-1] < 1.5)].max()
    assert 1.3 < peak < 3.5
    assert density.argmax() == np.flatnonzero(ratio[:-1] >= 1)[0]
    np.testing.assert_allclose(density[ratio[:-1] >= 4], 1, atol=0.1)


def test_the_spectrum_is_low_at_low_frequencies(square):
    """Power of random points is 1 at all frequencies; that of blue noise is small below half the
    frequency 1/r, and 1 far above.
    """
    positions, radius = square

    def power(points, low, high):
        reach = np.arange(-int(high), int(high) + 1)
        waves = np.stack(np.meshgrid(reach, reach), -1).reshape(-1, 2)
        length = np.linalg.norm(waves, axis=1)
        waves = waves[(length >= max(low, 1)) & (length < high)]
        waves = waves[:: max(1, len(waves) // 300)]
        return np.mean(np.abs(np.exp(2j * np.pi * waves @ points.T).sum(axis=1)) ** 2) / len(points)

    random = np.random.default_rng(4).random((2000, 2))
    low = 0.5 / radius
    assert power(random, 1, low) == pytest.approx(1, abs=0.15)
    assert power(positions, 1, low) < 0.2
    assert power(positions, 2 / radius, 2.5 / radius) == pytest.approx(1, abs=0.2)


# --- particles ------------------------------------------------------------------------------------


def p_value(counts, expected=None):
    return scipy.stats.chisquare(counts, expected).pvalue


@pytest.fixture(scope="module")
def traced():
    """Hits and flights of particles in a closed cube of half side 1."""
    return trace_particles(open_scene(room()), 4 * PARTICLES)


def test_particles_end_in_equal_density(traced):
    """χ² over 96 equal cells of the cube's faces, of the hits of one step: those are independent.

    Fails in 2 of 100 correct runs.
    """
    hits, _ = traced
    # but for a few at the edges none is lost in a closed room
    assert len(hits) > 0.999 * PARTICLES * (STEPS - WARM_UP)
    for step in (slice(0, 16000), slice(-16000, None)):
        positions = hits.positions[step]
        axis = np.abs(positions).argmax(axis=1)
        face = 2 * axis + (np.take_along_axis(positions, axis[:, None], 1)[:, 0] > 0)
        others = np.stack([positions[np.arange(len(axis)), (axis + i) % 3] for i in (1, 2)])
        row, column = np.clip((2 * (others + 1)).astype(int), 0, 3)
        assert p_value(np.bincount((face * 4 + row) * 4 + column, minlength=96)) > FALSE_POSITIVES


def test_flights_fill_the_space_evenly(traced):
    """χ² over 4³ cells of a few of very many flights, so that hardly two are of one flight.

    Fails in 1 of 100 correct runs.
    """
    _, flights = traced
    places = free_places(flights, 4000, seed=1)
    assert np.abs(places).max() <= 1.0001
    cell = np.clip((2 * (places + 1)).astype(int), 0, 3)
    assert p_value(np.bincount(cell @ [16, 4, 1], minlength=64)) > FALSE_POSITIVES


def test_hits_lie_on_the_side_that_particles_come_from(traced):
    hits, _ = traced
    assert (np.einsum("ij,ij->i", hits.normals, -hits.positions) > 0.99).all()
    np.testing.assert_allclose(np.abs(hits.positions).max(axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(hits.albedo, 0.5, atol=1e-6)
    np.testing.assert_allclose(hits.normals, hits.geometric_normals, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_no_particle_leaves_a_closed_room(seed):
    """Not even through its edges: of a million hits one that leaks is alone on the outer side, and
    thinning keeps what is alone.
    """
    centre = np.float32([50, 3, 20])
    hits, _ = trace_particles(open_scene(room(1.0, centre)), 900_000, seed)
    assert (np.einsum("ij,ij->i", hits.normals, centre - hits.positions) > 0.99).all()


def test_particles_are_seeded():
    opened = open_scene(room())
    first, second, other = (trace_particles(opened, 1000, seed)[0].positions for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_nothing_is_sampled_where_light_cannot_come():
    """A closed box in the room: its inner sides and the room's outer ones, all of which would
    reflect, are never met.
    """
    hits, flights = trace_particles(
        open_scene(room(box=cube((-0.5, -0.5, -0.5), 0.25, bsdf=TWO_SIDED))), 1_000_000
    )
    box = hits.surface == 0
    centre, half = np.float32([-0.5, -0.5, -0.5]), 0.25
    if np.abs(hits.positions[box]).max() > 0.9:
        box = ~box
    assert box.any() and (~box).any()
    assert (np.einsum("ij,ij->i", hits.normals[box], hits.positions[box] - centre) > 0.2).all()
    assert (np.einsum("ij,ij->i", hits.normals[~box], -hits.positions[~box]) > 0.99).all()
    inside = np.abs(free_places(flights, 20000) - centre).max(axis=1) < half - 1e-3
    assert not inside.any()


def test_an_open_scene_is_sampled_where_the_camera_sees_it():
    """A lone ball reflects particles into nowhere: all hits are on the cap n·o > 1/3 that an eye at
    distance 3 sees.
    """
    opened = open_scene(scene(ball=sphere(bsdf=diffuse()), camera=camera((0, 0, 3), (0, 0, 0))))
    hits, flights = trace_particles(opened, 5000)
    assert len(hits) >= 5000
    assert hits.positions[:, 2].min() > 1 / 3 - 1e-3
    assert np.isfinite(flights).all()


def test_a_scene_without_sensors_is_sampled_from_everywhere():
    """Random lines meet a ball, which is convex, in equal density. χ² over 16 equal zones and
    sectors; the particles' start is a pool of rays, whose noise is in the counts too: they are
    compared between distinct hits only.
    """
    hits, _ = trace_particles(open_scene(scene(ball=sphere(bsdf=diffuse()))), 5000)
    distinct = np.unique(hits.positions, axis=0)
    zone = np.clip((2 * (distinct[:, 2] + 1)).astype(int), 0, 3)
    sector = np.clip(
        ((np.arctan2(distinct[:, 1], distinct[:, 0]) / np.pi + 1) * 2).astype(int), 0, 3
    )
    assert p_value(np.bincount(4 * zone + sector, minlength=16)) > FALSE_POSITIVES


@pytest.mark.parametrize("emitter", ["point", "area"])
def test_particles_leave_local_emitters(emitter):
    lamp = {
        "type": "point",
        "position": [0.5, 0.2, -0.3],
        "intensity": {"type": "rgb", "value": 1.0},
    }
    if emitter == "area":
        radiance = {"type": "rgb", "value": 1.0}
        lamp = disk(
            (0, -1, 0),
            (0.1, 0.9, 0.2),
            0.2,
            bsdf=diffuse(),
            emitter={"type": "area", "radiance": radiance},
        )
    hits, flights = trace_particles(open_scene(scene(room=cube(bsdf=TWO_SIDED), lamp=lamp)), 1000)
    assert np.abs(hits.positions).max() < 1.0001
    assert np.abs(flights).max() < 1.0001


def test_a_sensor_that_sends_no_rays_does_not_matter():
    """An irradiance meter has a surface and no direction: particles leave the camera alone."""
    meter = {
        "type": "irradiancemeter",
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "filter": {"type": "box"}},
    }
    plate = rectangle((0, 1, 0), (0, -0.5, 0), 0.3, bsdf=diffuse(), meter=meter)
    assert len(trace_particles(open_scene(room(plate=plate)), 1000)[0]) >= 1000


@pytest.mark.parametrize(
    "parts",
    [
        # from within, where it does not reflect
        scene(ball=sphere(bsdf=diffuse()), camera=camera((0, 0, 0), (1, 0, 0))),
        scene(sheet=rectangle((0, 0, -1), bsdf=diffuse()), camera=camera((0, 0, 3), (0, 0, 0))),
        scene(sheet=rectangle(bsdf=TWO_SIDED), camera=camera((0, 1, 0), (0, 2, 1))),  # looks away
    ],
)
def test_scenes_without_a_reflecting_side_in_reach_are_refused(parts):
    with pytest.raises(SceneError, match="find 0 places on surfaces that reflect"):
        scattered(parts, 100, 10)


# --- areas ----------------------------------------------------------------------------------------


def furnished():
    return room(
        box=cube((-0.3, 0.2, 0), 0.4, bsdf=TWO_SIDED),
        sheet=rectangle((0, 1, 0), (0, -0.5, 0), 0.5, bsdf=diffuse()),
    )


def instances():
    """Nine balls of radius 0.2 in a room."""
    transform = mi.ScalarTransform4f
    parts = {"group": {"type": "shapegroup", "ball": sphere(radius=0.2, bsdf=diffuse())}}
    for i in range(9):
        to_world = transform().translate([0.6 * (i % 3) - 0.6, 0.1 * i - 0.4, 0.6 * (i // 3) - 0.6])
        parts[f"i{i}"] = {
            "type": "instance",
            "to_world": to_world,
            "group": {"type": "ref", "id": "group"},
        }
    return room(**parts)


def spline(folder):
    """A straight tube of radius 0.1 and length 0.6: a cubic b-spline starts and ends one control
    point from its ends.
    """
    path = folder / "curve.txt"
    path.write_text("".join(f"{x} 0 0 0.1\n" for x in (-0.9, -0.3, 0.3, 0.9)))
    return room(curve={"type": "bsplinecurve", "filename": str(path), "bsdf": diffuse()})


def signed_distances():
    """A ball of radius 0.7 as a grid of signed distances."""
    line = np.linspace(-1, 1, 32)
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    grid = mi.TensorXf((np.sqrt(x * x + y * y + z * z) - 0.7).astype(np.float32)[..., None])
    to_world = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    return scene(
        ball={
            "type": "sdfgrid",
            "grid": grid,
            "normals": "smooth",
            "to_world": to_world,
            "bsdf": diffuse(),
        }
    )


# floor less the boxes' feet, 4 − 2·0.58²; three walls of 4; sides and tops of the boxes,
# 0.58·(4·1.2 + 0.58) and 0.58²·5
CORNELL = 20.1296

AREAS = {
    "ball from within": (
        lambda folder: scene(b=sphere(flip_normals=True, bsdf=diffuse()), c=camera()),
        4000,
        4 * np.pi,
    ),
    "ball from outside": (lambda folder: scene(b=sphere(bsdf=diffuse())), 2000, 4 * np.pi),
    "box over a sheet of one side": (lambda folder: furnished(), 4000, 24 + 24 * 0.16 + 1),
    "instances": (lambda folder: instances(), 6000, 24 + 9 * 4 * np.pi * 0.04),
    "spline": (spline, 6000, 24 + 2 * np.pi * 0.1 * 0.6),
    "signed distances": (lambda folder: signed_distances(), 2000, 4 * np.pi * 0.49),
    "cornell": (lambda folder: "scenes/cornell_sky.xml", 10000, CORNELL),
}


@pytest.mark.parametrize("name", AREAS)
def test_areas_sum_to_the_reachable_area(name, tmp_path):
    """Closed forms.

    Of 16 crossings a sample the sum's noise is 0.25 % … 0.55 % for these counts; 1 % is what must
    be kept.
    """
    make, count, area = AREAS[name]
    parts = make(tmp_path)
    samples = scattered(parts, count)
    assert samples.points.areas.sum() == pytest.approx(area, rel=0.01)
    assert samples.points.report["reachable_area"] == pytest.approx(
        samples.points.areas.sum(), rel=1e-5
    )
    assert (samples.points.areas >= 0).all()
    assert samples.points.report["coverage"] > 0.95
    assert len(samples.points) == count


def test_areas_are_unbiased():
    """The mean of 6 seeds is within 3.5 standard errors of 24 m²: each counts 34,000 random
    crossings, so 0.55 %. (5 in 10,000 runs.)
    """
    opened = open_scene(room())
    sums = [next(_crossed_area(opened, seed)) for seed in range(6)]
    assert np.mean(sums) == pytest.approx(24, rel=3.5 * 0.0055 / 6**0.5)


def _crossed_area(opened, seed):
    """Area of the room's inner sides by one block of lines."""
    for hits, area in cross_surfaces(opened, (0, 0, 0), 1.8, seed):
        inner = np.einsum("ij,ij->i", hits.normals, hits.positions) < 0
        yield inner.sum() * area


def test_surfaces_get_samples_and_area_in_proportion(room_samples):
    """Six faces of 4 m² of the room: each has a sixth of the samples (blue noise counts evener than
    chance) and of the area (±3 %).
    """
    points = room_samples.points
    assert points.areas.sum() == pytest.approx(24, rel=0.01)
    axis = np.abs(points.positions).argmax(axis=1)
    face = 2 * axis + (np.take_along_axis(points.positions, axis[:, None], 1)[:, 0] > 0)
    np.testing.assert_allclose(np.bincount(face), len(points) / 6, rtol=0.04)
    np.testing.assert_allclose(np.bincount(face, points.areas), 4, rtol=0.03)


def test_both_sides_of_a_thin_wall_have_samples(wall_samples):
    points = wall_samples.points
    assert points.areas.sum() == pytest.approx(24 + 2, rel=0.01)
    wall = np.abs(points.positions[:, 1] + 0.5) < 1e-4
    wall &= np.abs(points.normals[:, 1]) > 0.99
    up = wall & (points.normals[:, 1] > 0)
    assert points.areas[up].sum() == pytest.approx(1, rel=0.1)
    assert points.areas[wall & ~up].sum() == pytest.approx(1, rel=0.1)
    assert 0.4 < up.sum() / wall.sum() < 0.6


# --- samples and clusters -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room_samples():
    return scattered(room())


@pytest.fixture(scope="module")
def wall_samples():
    """A room with a sheet of 1 m² in it, both sides of which reflect."""
    return scattered(room(wall=rectangle((0, 1, 0), (0, -0.5, 0), 0.5, bsdf=TWO_SIDED)), 4000)


@pytest.fixture(scope="module")
def cornell_samples():
    return scattered("scenes/cornell_sky.xml", 8000, 250)


@pytest.mark.parametrize("name", ["room_samples", "cornell_samples"])
def test_every_sample_is_in_one_cluster_of_about_the_wanted_size(name, request):
    samples = request.getfixturevalue(name)
    clusters, count = samples.clusters, len(samples.points)
    sizes = np.diff(clusters.starts)
    wanted = 200 if name == "room_samples" else 250
    # samples are in the order of their clusters
    np.testing.assert_array_equal(clusters.order, np.arange(count))
    assert clusters.starts[0] == 0 and clusters.starts[-1] == count
    assert len(clusters) == len(clusters.slices) == len(clusters.roots) == round(count / wanted)
    assert (sizes > 0).all() and sizes.max() < 3 * wanted
    assert wanted / 2 < np.median(sizes) < 1.5 * wanted
    assert all(
        cluster.start <= root < cluster.stop
        for cluster, root in zip(clusters.slices, clusters.roots)
    )


@pytest.mark.parametrize("name", ["room_samples", "cornell_samples"])
def test_clusters_are_compact_and_face_one_way(name, request):
    """Normals within 60° of the root's, so none opposite; and no member much farther than a
    cluster's radius on a plane, √(A/πc).
    """
    samples = request.getfixturevalue(name)
    points, clusters = samples.points, samples.clusters
    for cluster, root in zip(clusters.slices, clusters.roots):
        assert (points.normals[cluster] @ points.normals[root] > 0.5).all()
        assert (points.normals[cluster] @ points.normals[cluster].T > -0.5).all()
        reach = np.linalg.norm(points.positions[cluster] - points.positions[root], axis=1).max()
        assert reach < 3 * np.sqrt(points.areas.sum() / np.pi / len(clusters))


def test_clusters_do_not_mix_the_sides_of_a_thin_wall(wall_samples):
    normals = wall_samples.points.normals
    clusters = wall_samples.clusters.slices
    assert min((normals[cluster] @ normals[cluster].T).min() for cluster in clusters) > 0.99


@pytest.mark.parametrize("count, cluster_size, clusters", [(1, 1000, 1), (40, 1, 40)])
def test_small_counts(count, cluster_size, clusters):
    samples = scattered(room(), count, cluster_size)
    assert len(samples.points) == count and len(samples.clusters) == clusters
    assert np.diff(samples.clusters.starts).sum() == count
    assert np.isfinite(samples.points.areas).all() and samples.points.areas.sum() > 0


def test_samples_are_seeded():
    opened = open_scene(room())
    first, second = (Samples(*scatter_points(opened, 500, 10, seed=1)) for _ in range(2))
    for name in ("positions", "normals", "areas", "albedo"):
        np.testing.assert_array_equal(getattr(first.points, name), getattr(second.points, name))
    np.testing.assert_array_equal(first.clusters.starts, second.clusters.starts)
    places, again = (example_places(opened, 20, 1, made.flights) for made in (first, second))
    np.testing.assert_array_equal(places, again)
    other = scatter_points(opened, 500, 10, seed=2)[0]
    assert not np.array_equal(first.points.positions, other.positions)


@pytest.mark.parametrize("flown", [True, False], ids=["of the samples", "of their own"])
def test_places_for_lights_keep_a_distance_in_the_room(room_samples, flown):
    """Whether the flights are those that found samples, or are traced for the places alone."""
    flights = room_samples.flights if flown else None
    places = example_places(open_scene(room()), 200, 0, flights)
    assert places.shape == (200, 3) and np.abs(places).max() < 1
    # 200 places in 8 m³ each have 0.04 m³, a ball of radius 0.21 m; at random the nearest two of
    # them would be 0.02 m apart.
    assert nearest_other(places).min() > 0.2


@pytest.mark.parametrize("count", [0, -1, 1_000_001])
def test_counts_out_of_range_are_refused(count):
    with pytest.raises(SettingsError, match="1,000,000"):
        scatter_points(open_scene(room()), count, 10)


@pytest.mark.parametrize("size", [1e-3, 1e4])
def test_rooms_of_any_size(size, room_samples):
    """Everything scales: the radius with the room, the area with its square."""
    samples = scattered(room(size), 1000)
    assert samples.radius / size == pytest.approx(2 * room_samples.radius, rel=0.05)
    assert samples.points.areas.sum() == pytest.approx(24 * size**2, rel=0.02)


def test_a_room_far_from_the_origin():
    samples = scattered(room(1.0, (500, -500, 500)), 1000)
    assert samples.points.areas.sum() == pytest.approx(24, rel=0.02)


# --- look-up --------------------------------------------------------------------------------------


def located(scale=1.0, shift=0.0, count=2000):
    """Samples on a ball: positions, normals, radius and their locator."""
    positions, normals = ball(16000, scale)
    positions = (positions + np.float32(shift)).astype(np.float32)
    chosen, radius = thin(positions, normals, count)
    return (
        positions[chosen],
        normals[chosen],
        radius,
        SampleLocator(positions[chosen], normals[chosen], radius),
    )


@pytest.mark.parametrize("scale, shift", [(1, 0), (1e-3, 0), (1e4, 0), (1, 1e3), (1e-3, 1)])
def test_the_nearest_sample_is_that_of_an_exhaustive_search(scale, shift):
    """Places on, above and far off the ball, some with foreign normals; compared with a kd-tree in
    double precision.
    """
    positions, normals, radius, locator = located(scale, shift)
    random = np.random.default_rng(9)
    toward = uniform_directions(random, 4000)
    heights = np.where(np.arange(4000) % 2, random.uniform(-3, 3, 4000) * radius, 0)
    places = ((scale + heights)[:, None] * toward + shift).astype(np.float32)
    facing = np.where(
        np.arange(4000)[:, None] % 3 == 2, uniform_directions(random, 4000), toward
    ).astype(np.float32)
    index, distance = (
        np.array(x) for x in locator.nearest(lanes(places), lanes(facing, mi.Normal3f))
    )
    samples, queries = (
        np.hstack([p.astype(np.float64), radius * n.astype(np.float64)])
        for p, n in ((positions, normals), (places, facing))
    )
    expected, nearest = cKDTree(samples).query(queries)
    inside, outside = expected < 0.999 * REACH * radius, expected > 1.001 * REACH * radius
    assert inside.sum() > 2000 and outside.sum() > 200
    # Positions that float32 rounds may have two nearest ones: their distance is compared, to what
    # float32 holds of a coordinate.
    limit = 1e-5 * radius + 4e-7 * (scale + abs(shift))
    np.testing.assert_allclose(distance[inside], expected[inside], atol=limit)
    assert (index == nearest)[inside].mean() > 0.99
    assert np.isinf(distance[outside]).all()


def test_interpolation_is_the_weighted_mean_of_all_samples_in_reach():
    positions, normals, radius, locator = located()
    random = np.random.default_rng(3)
    values = random.random((len(positions), 3)).astype(np.float32)
    toward = uniform_directions(random, 500).astype(np.float32)
    result, found = locator.interpolated(
        mi.Float(values.ravel()), lanes(toward), lanes(toward, mi.Normal3f)
    )
    apart = np.linalg.norm(
        embedded(positions, normals, radius)[None] - embedded(toward, toward, radius)[:, None],
        axis=-1,
    )
    weights = (
        np.maximum(1 - (apart / (REACH * radius)) ** 2, 0) ** SHARPNESS
        * np.maximum(toward @ normals.T, 0) ** ALIGNMENT
    )
    expected = weights @ values / weights.sum(axis=1, keepdims=True)
    assert np.array(found).all()
    np.testing.assert_allclose(np.array(result).T, expected, atol=1e-4)


def test_interpolation_keeps_constants():
    """Weights are normalised: only the rounding of the sums is left."""
    positions, _, _, locator = located()
    constant = np.float32([0.1, 7.0, 1e6])
    toward = uniform_directions(np.random.default_rng(1), 20000)
    result, found = locator.interpolated(
        mi.Float(np.tile(constant, len(positions))), lanes(toward), lanes(toward, mi.Normal3f)
    )
    assert np.array(found).all()
    np.testing.assert_allclose(
        np.array(result), np.broadcast_to(constant[:, None], (3, 20000)), rtol=2e-6
    )


def test_interpolation_is_continuous():
    """Along a circle, through voxels and across samples: the largest jump falls with the step, as
    of a Lipschitz function.
    """
    positions, _, _, locator = located()
    values = mi.Float(
        np.repeat(np.random.default_rng(5).standard_normal(len(positions)), 3).astype(np.float32)
    )

    def largest_jump(steps):
        angle = np.linspace(0.1, 0.4, steps)
        place = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.ones(steps)], -1) / np.sqrt(1.09)
        result, found = locator.interpolated(values, lanes(place), lanes(place, mi.Normal3f))
        assert np.array(found).all()
        return np.abs(np.diff(np.array(result)[0])).max()

    coarse, fine = largest_jump(1001), largest_jump(8001)
    assert coarse > 0
    assert fine < coarse / 6


def test_out_of_reach_is_told():
    """Beside, beyond the grid on all sides, with an opposite normal, of no number, and where the
    mask forbids.
    """
    positions, normals, radius, locator = located()
    toward = uniform_directions(np.random.default_rng(6), 64)
    places = np.concatenate(
        [
            (1 + 2.6 * radius) * toward,
            -100 * toward,
            1e20 * toward,
            np.full((64, 3), np.nan),
            toward,
            toward,
        ]
    )
    facing = np.tile(toward, (6, 1))
    active = np.repeat([True, True, True, True, True, False], 64)
    # their samples are 2r from here in the metric, and beyond the reach of 2.5r only with their
    # distance
    facing[256:320] *= -1
    reach = np.linalg.norm(
        embedded(positions, normals, radius)[None] - embedded(places, facing, radius)[:, None],
        axis=-1,
    )
    expected = (np.nan_to_num(reach, nan=np.inf).min(axis=1) < REACH * radius) & active
    arguments = lanes(places), lanes(facing, mi.Normal3f), mi.Bool(active)
    _, distance = locator.nearest(*arguments)
    result, found = locator.interpolated(
        mi.Float(np.ones(3 * len(positions), np.float32)), *arguments
    )
    np.testing.assert_array_equal(np.isfinite(np.array(distance)), expected)
    assert not np.array(found)[~expected].any()
    assert (np.array(result).T[~expected] == 0).all()


def test_samples_behind_the_place_that_looks_do_not_count():
    """Two sheets 0.01 apart, less than their samples, that both face up: seen from above the lower,
    the upper one alone is above.
    """
    positions, normals = plane(4000)
    chosen, radius = thin(positions, normals, 400)
    lower, up = positions[chosen], normals[chosen]
    upper = lower + np.float32([0, 0, radius / 2])
    locator = SampleLocator(np.concatenate([upper, lower]), np.concatenate([up, up]), radius)
    places = (lanes(lower), lanes(up, mi.Normal3f))
    origin = lower + np.float32([0, 0, radius / 4])
    free, _ = locator.nearest(*places)
    above, _ = locator.nearest(*places, seen_from=(lanes(origin), lanes(up, mi.Vector3f)))
    below, _ = locator.nearest(*places, seen_from=(lanes(origin), lanes(-up, mi.Vector3f)))
    np.testing.assert_array_equal(np.array(free), 400 + np.arange(400))
    np.testing.assert_array_equal(np.array(below), np.array(free))
    np.testing.assert_array_equal(np.array(above), np.arange(400))


def test_a_locator_of_one_sample_and_of_none():
    up = np.float32([[0, 0, 1]])
    locator = SampleLocator(np.zeros((1, 3), np.float32), up, 1.0)
    _, distance = locator.nearest(
        lanes([[0, 0, 0], [2.4, 0, 0], [2.6, 0, 0]]), mi.Normal3f(0, 0, 1)
    )
    np.testing.assert_allclose(np.array(distance), [0, 2.4, np.inf], rtol=1e-6)
    with pytest.raises(SceneError, match="no samples"):
        SampleLocator(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), 1.0)


# --- hemisphere -----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [16, 30, 576, 2016])
def test_directions_partition_the_hemisphere_into_equal_cells(count):
    """Directions that stand for equal solid angles have the hemisphere's moments: ∫z = 1/2, ∫z² =
    ∫x² = 1/3, ∫x = ∫y = 0.
    """
    vectors = Hemisphere(count).vectors.astype(np.float64)
    assert len(vectors) == len(Hemisphere(count)) == count
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    assert (vectors[:, 2] > 0).all()
    error = 2 / count  # of the midpoint rule: second order in the cell's side
    np.testing.assert_allclose(vectors.mean(axis=0), [0, 0, 0.5], atol=error)
    np.testing.assert_allclose(vectors.T @ vectors / count, np.eye(3) / 3, atol=error)
    # All first moments of one octant of the horizon too, so that no side is denser: ∫|x| = ∫|y| =
    # 1/2.
    np.testing.assert_allclose(np.abs(vectors[:, :2]).mean(axis=0), 0.5, atol=10 * error)


def test_cells_have_equal_solid_angles():
    """Uniform directions fall into each cell equally often; the cell is told by the largest share
    of the interpolation. χ², fails in 1 of 100 correct runs.
    """
    hemisphere = Hemisphere(30)
    directions = uniform_directions(np.random.default_rng(8), 60000)
    directions[:, 2] = np.abs(directions[:, 2])
    index, share = _around(hemisphere, directions)
    cell = np.take_along_axis(index, share.argmax(axis=1)[:, None], 1)[:, 0]
    assert p_value(np.bincount(cell, minlength=30)) > FALSE_POSITIVES


@pytest.mark.parametrize("count", [16, 30, 576, 2016, 65536])
def test_weights_are_shares_of_the_cosine(count):
    hemisphere = Hemisphere(count)
    assert hemisphere.weights.sum(dtype=np.float64) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(
        hemisphere.weights / hemisphere.vectors[:, 2],
        1 / hemisphere.vectors[:, 2].sum(dtype=float),
        rtol=1e-5,
    )
    # They integrate what is as smooth as the cosine: ∫ z · z/π dω = 2/3.
    assert hemisphere.weights @ hemisphere.vectors[:, 2] == pytest.approx(2 / 3, rel=2 / count)


def _around(hemisphere, directions):
    index, share = hemisphere.around(lanes(directions, mi.Vector3f))
    return np.stack([np.array(i) for i in index], 1).astype(np.int64), np.stack(
        [np.array(s) for s in share], 1
    )


@pytest.mark.parametrize("count", [16, 30, 2016])
def test_the_four_directions_around_hold_the_nearest(count):
    hemisphere = Hemisphere(count)
    directions = uniform_directions(np.random.default_rng(2), 5000)
    directions[:, 2] = np.abs(directions[:, 2])
    directions[0], directions[1], directions[2] = [0, 0, 1], [1, 0, 0], [0, -1, 0]
    index, share = _around(hemisphere, directions)
    np.testing.assert_allclose(share.sum(axis=1), 1, atol=1e-6)
    assert share.min() >= 0 and index.min() >= 0 and index.max() < count
    assert all(len(set(row)) == 4 for row in index[:100].tolist())
    nearest = (directions @ hemisphere.vectors.astype(np.float64).T).argmax(axis=1)
    assert (index == nearest[:, None]).any(axis=1).all()
    # No cell is longer than 2.1 times its equal-area side; two of them lie between the four, at
    # most.
    apart = np.arccos(
        np.clip(np.einsum("nkd,nd->nk", hemisphere.vectors[index], directions), -1, 1)
    )
    assert apart.max() < 3 * np.sqrt(2 * np.pi / count)


@pytest.mark.parametrize("count", [16, 30, 2016])
def test_interpolation_is_exact_at_the_grids_own_directions(count):
    hemisphere = Hemisphere(count)
    index, share = _around(hemisphere, hemisphere.vectors)
    own = (share * (index == np.arange(count)[:, None])).sum(axis=1)
    np.testing.assert_allclose(own, 1, atol=1e-4)


@pytest.mark.parametrize("z", [0.0, -1e-7, 1e-7])
def test_directions_at_the_horizon_are_finite(z):
    """Rounding may put them a little below it; the four are then at the rim."""
    hemisphere = Hemisphere(2016)
    turn = np.linspace(0, 2 * np.pi, 361)
    index, share = _around(hemisphere, np.stack([np.cos(turn), np.sin(turn), np.full(361, z)], -1))
    assert np.isfinite(share).all()
    np.testing.assert_allclose(share.sum(axis=1), 1, atol=1e-6)
    assert (
        hemisphere.vectors[np.take_along_axis(index, share.argmax(1)[:, None], 1)[:, 0], 2].max()
        < 0.06
    )


@pytest.mark.parametrize("count", [0, -5, 15, 17, 2017, 65537])
def test_counts_that_make_no_grid_are_refused_with_some_that_do(count):
    with pytest.raises(SettingsError, match=f"{count} depth directions") as error:
        Hemisphere(count)
    fitting = [int(word) for word in str(error.value).split("take ")[1].split(" or ")]
    assert len(fitting) == 2
    for other in fitting:
        assert len(Hemisphere(other)) == other


# --- frames ---------------------------------------------------------------------------------------


def _check_rotations(rotations, normals, tolerance=1e-6):
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1),
        np.broadcast_to(np.eye(3), rotations.shape),
        atol=tolerance,
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=tolerance)
    np.testing.assert_allclose(rotations[:, :, 2], normals, atol=tolerance)


@pytest.mark.parametrize(
    "normal", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [0.6, 0, -0.8], [1e-9, 1, 0]]
)
def test_a_frame_of_one_normal(normal):
    _check_rotations(frame_of(normal)[None], np.array([normal], float))


def test_frames_are_turned_the_shortest_way():
    """A rotation by the angle between two normals has the trace 1 + 2 cos; a longer way has a
    smaller one.
    """
    random = np.random.default_rng(3)
    reference, normals = (
        frame_of(uniform_directions(random, 1)[0]),
        uniform_directions(random, 2000),
    )
    normals = normals[normals @ reference[:, 2] > -0.99]
    rotations = frames(normals, reference)
    _check_rotations(rotations, normals)
    trace = np.einsum("nij,ij->n", rotations, reference)
    np.testing.assert_allclose(trace, 1 + 2 * normals @ reference[:, 2], atol=1e-6)
    np.testing.assert_allclose(frames(reference[None, :, 2], reference)[0], reference, atol=1e-12)


def test_neighbouring_normals_have_neighbouring_frames():
    """Within 90° of the reference the way there turns what is between two normals by twice their
    angle at most.
    """
    random = np.random.default_rng(4)
    reference = frame_of([0.6, 0, 0.8])
    normals = uniform_directions(random, 2000)
    normals[normals @ reference[:, 2] < 0] *= -1
    for step in (1e-1, 1e-3, 1e-5):
        moved = normals + step * uniform_directions(random, 2000)
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        change = np.linalg.norm(frames(moved, reference) - frames(normals, reference), axis=(1, 2))
        assert (change < 4 * np.linalg.norm(moved - normals, axis=1) + 1e-9).all()


@pytest.mark.parametrize("angle", [0, 1e-8, 1e-6, 1e-4, 1e-2, 0.1])
@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_frames_of_opposite_normals_are_rotations(angle, precision):
    """The two sides of a wall in one cluster; in float32, as samples are, unit vectors and their
    products are rounded.
    """
    random = np.random.default_rng(5)
    for toward in uniform_directions(random, 20).astype(precision):
        reference = frame_of(toward)
        normals = -toward + angle * uniform_directions(random, 50)
        normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(precision)
        _check_rotations(frames(normals, reference), normals)


# --- bad scenes -----------------------------------------------------------------------------------

TRIANGLE = [[-0.5, 0, 0], [0.5, 0, 0], [0, 0.5, 0]]


def test_vertex_normals_that_are_none_are_those_of_the_faces():
    """Of zeros and of no numbers; beside triangles without area, which get no samples."""
    parts = {
        "zero": mesh(TRIANGLE, [[0, 1, 2]], np.zeros((3, 3)), bsdf=TWO_SIDED),
        "none": mesh(
            np.array(TRIANGLE) + [0, 0, 0.3], [[0, 1, 2]], np.full((3, 3), np.nan), bsdf=TWO_SIDED
        ),
        "sliver": mesh(TRIANGLE + [[0.7, 0, 0]], [[0, 1, 3], [0, 0, 1]], bsdf=TWO_SIDED),
    }
    points = scattered(room(**parts), 2000).points
    np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1, atol=1e-4)
    sheets = np.abs(points.positions).max(axis=1) < 0.9
    assert sheets.any()
    np.testing.assert_allclose(np.abs(points.normals[sheets, 2]), 1, atol=1e-4)
    assert points.areas.sum() == pytest.approx(24 + 4 * 0.25, rel=0.02)


def test_meshes_without_faces_are_refused():
    """They are named: Dr.Jit, which reads the arrays of all shapes at once, fails with words of its
    own.
    """
    empty = mesh(np.zeros((0, 3)), np.zeros((0, 3)), bsdf=diffuse())
    with pytest.raises(SceneError, match="'empty' has no faces"):
        open_scene(room(empty=empty))


@pytest.mark.parametrize(
    "vertices",
    [
        np.full((3, 3), np.nan),
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[0, 0, 0], [1e-20, 0, 0], [0, 1e-20, 0]],
    ],
)
def test_scenes_that_nothing_can_meet_are_refused(vertices):
    with pytest.raises(SceneError):
        scattered(scene(triangle=mesh(vertices, [[0, 1, 2]], bsdf=diffuse())), 100)


def test_a_single_triangle():
    """Few of the random lines that measure it meet it: there still are distinct candidates for all
    samples.
    """
    samples = scattered(scene(triangle=mesh(TRIANGLE, [[0, 1, 2]], bsdf=diffuse())), 2000)
    assert len(np.unique(samples.points.positions, axis=0)) == 2000
    assert samples.points.areas.sum() == pytest.approx(0.25, rel=0.02)


def test_what_a_camera_sees_of_a_ball():
    """The cap cos θ > 1/3 is 2π·2/3 m²; its rim is met at grazing angles, hence rarely: 5 %."""
    samples = scattered(
        scene(ball=sphere(bsdf=diffuse()), camera=camera((0, 0, 3), (0, 0, 0))), 2000
    )
    assert samples.points.positions[:, 2].min() > 1 / 3 - 1e-3
    assert samples.points.areas.sum() == pytest.approx(2 * np.pi * 2 / 3, rel=0.05)
