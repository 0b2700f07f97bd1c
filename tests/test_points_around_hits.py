"""What is around a hit, among curved and buried points too; and how local light finds its points.

Tests run on vertices and on samples alike; tests/test_layouts.py has look-ups at flat walls, and
transport against Mitsuba. Lengths in metres.
"""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import scipy.stats
from conftest import FALSE_POSITIVES, cube, diffuse, rectangle, scene, sphere, uniform_directions

import mi_prt
from mi_prt.directions import parse_directions
from mi_prt.directions.hemisphere import Hemisphere
from mi_prt.lighting.emission import emission_of
from mi_prt.lighting.light import as_light
from mi_prt.points.clusters import Clusters, make_clusters
from mi_prt.points.points import sample_points
from mi_prt.points.sample_locator import REACH
from mi_prt.points.samples import scatter_points
from mi_prt.scene.materials import facing
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import find_buried, sample_direct
from mi_prt.transport.depth import DepthBuffers
from mi_prt.transport.hemispheres import NOTHING, HemisphereTracer, cluster_frames
from mi_prt.transport.local_direct import LocalDirect

mi = mitsuba()

EDGE, COUNT = 0.15, 3000
FOOTPRINT = (-0.4, -0.3), 0.25  # of a cube on the floor: centre (x, z) and half its side


def two_sided(bsdf):
    return {"type": "twosided", "side": bsdf}


def furnished():
    """A box of 2 m, open above, with a cube on its floor, a ball, and a sheet in the air."""
    white = two_sided(diffuse(0.7))
    (x, z), half = FOOTPRINT
    return scene(
        floor=rectangle((0, 1, 0), (0, 0, 0), bsdf=white),
        left=rectangle((1, 0, 0), (-1, 1, 0), bsdf=white),
        right=rectangle((-1, 0, 0), (1, 1, 0), bsdf=white),
        back=rectangle((0, 0, 1), (0, 1, -1), bsdf=white),
        front=rectangle((0, 0, -1), (0, 1, 1), bsdf=white),
        cube=cube((x, half, z), half, bsdf=diffuse(0.5)),
        ball=sphere((0.45, 0.35, 0.3), 0.35, bsdf=diffuse([0.7, 0.2, 0.1])),
        sheet=rectangle((0, 1, 0), (0.3, 1.2, -0.3), 0.4, bsdf=white),
    )


@pytest.fixture(scope="module")
def room():
    return open_scene(furnished())


@pytest.fixture(scope="module", params=("patches", "spacing"))
def points(room, request):
    """Points of one layout; those that are buried are known."""
    if request.param == "spacing":
        made = scatter_points(room, COUNT, 20)[0]
    else:
        made = sample_points(room, EDGE)
    assert made.layout.kind == request.param
    return replace(made, buried=find_buried(room, made))


class Hits:
    """Where rays meet sides that reflect."""

    def __init__(self, opened, origins, directions):
        # flat and gathered: arrays read lane by lane compile another kernel for another alignment
        lane = mi.UInt32(np.arange(len(origins), dtype=np.uint32))
        origins, directions = (
            mi.Float(np.ravel(x).astype(np.float32)) for x in (origins, directions)
        )
        ray = mi.Ray3f(
            dr.gather(mi.Point3f, origins, lane), dr.gather(mi.Vector3f, directions, lane)
        )
        pi = opened.occluders.ray_intersect_preliminary(ray)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        normals, si.wi, reflects = facing(si, ray, opened.surfaces)
        active = si.is_valid() & reflects
        self.around = (pi, si, ray, active)  # what a locator is asked with
        self.active = np.array(active)
        self.positions, self.normals = (np.array(x).T for x in (si.p, normals.shading))


def rays_in_air(count, seed=1):
    """Origins and directions (count, 3) between the furniture of the box."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform([-0.95, 0.72, -0.95], [0.95, 1.1, 0.95], (count, 3))
    return origins, uniform_directions(rng, count)


def uniform(count, seed=0):
    """Random numbers, one for each of so many lanes."""
    return mi.Float(np.random.default_rng(seed).random(count, dtype=np.float32))


def reach_of(points):
    """How far from a hit the points around it may be: the diagonal of a cell, or samples' reach."""
    return 1.01 * (
        EDGE * 2**0.5 if points.layout.kind == "patches" else REACH * points.layout.radius
    )


# --- what is around a hit -------------------------------------------------------------------------


def test_every_visible_hit_has_points_around_it(room, points):
    """No hit on a visible side is without points, and those given are near it and on its side.

    `picked` and `nearest` may miss hits that have buried points alone around them: a rim of less
    than one edge around the cube's footprint, which rays from the air hardly see.
    """
    hits = Hits(room, *rays_in_air(20000))
    locator = points.locator(room)
    values = mi.Float(np.tile(np.float32([1, 2, 3]), len(points)))
    value, found = locator.interpolated(values, *hits.around)
    np.testing.assert_array_equal(np.array(found), hits.active)
    # weights sum to one
    np.testing.assert_allclose(np.array(value).T[hits.active] - [1, 2, 3], 0, atol=1e-5)
    for index, found in (
        locator.picked(*hits.around, uniform(20000)),
        locator.nearest(*hits.around),
    ):
        index, found = np.array(index), np.array(found)
        assert not (found & ~hits.active).any() and found[hits.active].mean() > 0.995
        off = points.positions[index[found]] - hits.positions[found]
        assert np.linalg.norm(off, axis=1).max() < reach_of(points)
        assert np.sum(points.normals[index[found]] * hits.normals[found], axis=1).min() > 0


def weights_at(locator, hits, index, count):
    """Weight of some points (k,) at each hit (h, k), by interpolation of ones and zeros."""
    found = []
    for first in range(0, len(index), 3):
        three = index[first : first + 3]
        values = np.zeros((count, 3), np.float32)
        values[three, np.arange(len(three))] = 1
        value, _ = locator.interpolated(mi.Float(values.ravel()), *hits.around)
        found.append(np.array(value).T[:, : len(three)])
    return np.concatenate(found, axis=1).astype(np.float64)


def test_points_are_picked_by_their_weights(room, points):
    """How often each point is picked, in 60,000 picks at each of 30 hits, by its weight there: χ²
    over all points of a hit that expect eight picks or more, the others in one class. The least of
    30 p-values has a false-positive rate of 1 % (Šidák); a weight of 10 % that is wrong by a
    twentieth fails.
    """
    count, picks = 30, 60000
    rays = rays_in_air(120)
    chosen = np.flatnonzero(Hits(room, *rays).active)[:count]
    rays = [x[chosen] for x in rays]
    locator = points.locator(room)
    hits, again = Hits(room, *rays), Hits(room, *(np.repeat(x, picks // 30, axis=0) for x in rays))
    picked = []
    for seed in range(30):
        index, found = locator.picked(*again.around, uniform(count * picks // 30, seed))
        assert np.array(found).all()
        picked.append(np.array(index).reshape(count, -1))
    picked = np.concatenate(picked, axis=1)
    p_values = []
    for number, index in enumerate(picked):
        one = Hits(room, *(x[number : number + 1] for x in rays))
        given, times = np.unique(index, return_counts=True)
        expected = picks * weights_at(locator, one, given, len(points))[0]
        large = expected >= 8
        expected = np.append(expected[large], max(picks - expected[large].sum(), 0))
        times = np.append(times[large], picks - times[large].sum())
        if expected[-1] < 8:  # one class with the one before
            expected, times = (np.append(x[:-2], x[-2] + x[-1]) for x in (expected, times))
        if len(expected) > 1:
            chi = ((times - expected) ** 2 / expected).sum()
            p_values.append(scipy.stats.chi2.sf(chi, len(expected) - 1))
    assert len(hits.active) == count and len(p_values) > 20
    assert min(p_values) > 1 - (1 - FALSE_POSITIVES) ** (1 / len(p_values))


def test_buried_points_have_no_share(room, points):
    """Value 1 at a third of the points, which are buried, and 0 at the others: wherever others are
    around, interpolation is 0, and no buried point is given.
    """
    buried = np.random.default_rng(5).random(len(points)) < 1 / 3
    locator = replace(points, buried=buried).locator(room)
    hits = Hits(room, *rays_in_air(20000))
    values = mi.Float(np.repeat(buried, 3).astype(np.float32))
    value = np.array(locator.interpolated(values, *hits.around)[0]).T
    for index, found in (
        locator.picked(*hits.around, uniform(20000)),
        locator.nearest(*hits.around),
    ):
        index, found = np.array(index), np.array(found)
        assert found.sum() > 0.9 * hits.active.sum() and not buried[index[found]].any()
        assert not value[found].any()


def test_where_all_points_are_buried_none_is_given(room, points):
    locator = replace(points, buried=np.ones(len(points), bool)).locator(room)
    hits = Hits(room, *rays_in_air(1000))
    for _, found in (locator.picked(*hits.around, uniform(1000)), locator.nearest(*hits.around)):
        assert not np.array(found).any()


def test_buried_points_are_known_without_a_sky(room, points):
    """The same points as by visibility: those that see a direction of the sky are not buried.

    Vertices of the floor below the cube are; samples are where particles get, so none is.
    """
    dark = sample_direct(room, points, parse_directions("cubemap:16")).dark()
    np.testing.assert_array_equal(find_buried(room, points, dark), points.buried)
    centre, half = FOOTPRINT
    below = (np.abs(points.positions[:, [0, 2]] - centre) < half - 1e-3).all(axis=1)
    below &= (np.abs(points.positions[:, 1]) < 1e-3) & (points.normals[:, 1] > 0.9)
    if points.layout.kind == "patches":
        assert below.sum() > 5 and points.buried[below].all()
    else:
        assert not below.any() and not points.buried.any()


# --- in the order of clusters ---------------------------------------------------------------------


def test_hemispheres_see_the_points_that_rays_meet(room, points):
    """A point seen, named by its place in the order of the clusters, is where the ray ends."""
    clusters = make_clusters(points, 40, 1)
    assert (clusters.order != np.arange(len(points))).any()  # else the order is not tested
    hemisphere, seen_by = Hemisphere(256), 0
    tracer = HemisphereTracer(room, points, clusters, hemisphere, 3)
    for cluster in clusters.slices:
        members = clusters.order[cluster]
        rotations = cluster_frames(points.normals[members])
        seen = tracer.trace(cluster, rotations)
        directions = np.einsum("mij,nj->mni", rotations, hemisphere.vectors)
        found = seen.sample != NOTHING
        ends = points.positions[members][:, None] + seen.distance[..., None] * directions
        given = points.positions[clusters.order[seen.sample[found]]]
        assert (np.linalg.norm(given - ends[found], axis=1) < reach_of(points)).all()
        seen_by += found.sum()
    assert seen_by > 0.3 * len(points) * len(hemisphere)


def test_local_light_comes_in_the_order_of_the_points(room):
    """The same samples in another order get the same light, bit for bit."""
    points, clusters, _ = scatter_points(room, 800, 8)
    rng = np.random.default_rng(6)
    depth = DepthBuffers(
        rng.uniform(-1, 0.5, (8, 256)).astype(np.float32),
        rng.standard_normal((8, 256, 4)).astype(np.float32) / 4,
        rng.standard_normal((800, 4)).astype(np.float32),
        3.0,
    )
    emission = emission_of(as_light(mi_prt.PointLight((0.1, 0.9, 0.4), (1, 2, 3))))
    expected, _ = LocalDirect(points, clusters, depth).irradiance(emission)
    order = rng.permutation(800)
    shuffled = Clusters(np.argsort(order), clusters.starts, clusters.roots)
    found, _ = LocalDirect(points.at(order), shuffled, depth).irradiance(emission)
    assert expected.any() and (expected == 0).any()
    np.testing.assert_array_equal(found, expected[order])
