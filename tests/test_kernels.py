"""One kernel serves all numbers of directions, rays, paths and points: numbers are data, not
literals, each of which would be compiled anew (a second or more).
"""

import gc

import numpy as np
import pytest
from conftest import cube, open_scene, rectangle, sample_points, sampled, scene

from mi_prt.directions import parse_directions
from mi_prt.directions.hemisphere import Hemisphere
from mi_prt.points.clusters import make_clusters
from mi_prt.system.runtime import count_kernels, mitsuba
from mi_prt.transport.bits import find_buried, sample_direct
from mi_prt.transport.hemispheres import HemisphereTracer, cluster_frames

PARTS = dict(floor=rectangle(), wall=rectangle((1, 0, 0), (-1, 1, 0)), box=cube((0, 0.3, 0), 0.2))


@pytest.fixture(scope="module")
def scenes():
    """A scene's transport on some lattices."""
    return {
        lattice: sampled(scene(**PARTS), 0.25, lattice)
        for lattice in ("cubemap:2", "cubemap:3", "cubemap:4", "cubemap:5", "cubemap:6")
    }


def compiled(run, values):
    """Kernels that are compiled for values after the first.

    Shapes of scenes that are no longer used are in each kernel until they are collected.
    """
    gc.collect()
    gc.disable()
    try:
        run(values[0])
        with count_kernels() as kernels:
            for value in values[1:]:
                run(value)
    finally:
        gc.enable()
    assert kernels.launched >= len(values) - 1
    return kernels.compiled


def test_numbers_of_directions(scenes):
    one = scenes["cubemap:4"]
    lattices = [
        parse_directions(x)
        for x in ("cubemap:4", "cubemap:5", "latlong:12x8", "halton:90", "halton:70")
    ]
    assert compiled(lambda x: sample_direct(one.scene, one.points, x), lattices) == 0
    assert compiled(lambda x: scenes[x].hops(16), list(scenes)) == 0
    assert compiled(lambda x: scenes[x].samples_of_paths(8, 2, np.arange(5)), list(scenes)) == 0


def test_numbers_of_rays(scenes):
    one = scenes["cubemap:4"]
    lattice = parse_directions("cubemap:4")
    assert (
        compiled(lambda x: sample_direct(one.scene, one.points, lattice, x), [1, 4, 2, 6, 9]) == 0
    )
    assert compiled(one.hops, [16, 24, 64, 40, 80]) == 0
    assert compiled(lambda x: one.samples_of_paths(x, 2, np.arange(5)), [8, 16, 18, 24, 40]) == 0


def test_numbers_of_points():
    opened = open_scene(scene(**PARTS))
    points = [sample_points(opened, length) for length in (0.5, 0.3, 0.21, 0.25, 0.4)]
    dark = [np.ones(len(p), bool) for p in points]
    assert compiled(lambda i: find_buried(opened, points[i], dark[i]), range(5)) == 0


def test_the_scale_of_a_scene_is_data():
    """As many shapes of another size."""
    sizes = [
        open_scene(scene(floor=rectangle(size=s), box=cube(size=s / 9)))
        for s in (1.0, 3.0, 0.1, 7.0, 2.0)
    ]
    points = [sample_points(opened, opened.scale / 6) for opened in sizes]
    dark = [np.ones(len(p), bool) for p in points]
    assert compiled(lambda i: find_buried(sizes[i], points[i], dark[i]), range(5)) == 0


def test_directions_of_depth_buffers():
    """Those that are traced, and those that are looked up."""
    mi = mitsuba()
    opened = open_scene(scene(**PARTS))
    points = sample_points(opened, 0.3)
    clusters = make_clusters(points, 2, 0)
    first = clusters.slices[0]
    rotations = cluster_frames(points.normals[clusters.order][first])

    def trace(count):
        HemisphereTracer(opened, points, clusters, Hemisphere(count), 3).trace(first, rotations)

    def look_up(count):
        import drjit as dr

        x, y = dr.linspace(mi.Float, -0.5, 0.5, 40), dr.linspace(mi.Float, 0.3, -0.4, 40)
        index, share = Hemisphere(count).around(dr.normalize(mi.Vector3f(x, y, 0.6)))
        dr.eval(index, share)
        assert max(np.array(i).max() for i in index) < count

    assert compiled(trace, [16, 64, 36, 100, 144]) == 0
    assert compiled(look_up, [16, 64, 132, 36, 100]) == 0
