"""Direct light of local emitters at pixels: closed forms and Mitsuba, with something in every part
of the way of a shadow ray; and the footprints that light of lamps is averaged over.
"""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from conftest import bias, diffuse, disk, rectangle, relative_l2, scene, sphere

from mi_prt.evaluate import ground_truth
from mi_prt.points.points import sample_points
from mi_prt.render.direct_light import LocalEmitters
from mi_prt.render.image import render_image
from mi_prt.render.integrator import integrator_for
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import find_buried
from mi_prt.transport.lamp_rays import LEAST_COSINE, LampRays
from mi_prt.transport.lamp_table import Lamps
from mi_prt.transport.lamps import direct_light

HEIGHT, INTENSITY = 2.0, 3.0


def bulb(position=(0, HEIGHT, 0), intensity=INTENSITY):
    return {
        "type": "point",
        "position": list(map(float, position)),
        "intensity": {"type": "rgb", "value": intensity},
    }


def shining(radiance=1.0):
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def places(side=21, half=0.9):
    """Places (k, 3) of a grid on the floor."""
    x, z = np.meshgrid(*2 * [np.linspace(-half, half, side)], indexing="ij")
    return np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)


def at_pixels(parts, where, below=False, samples=1):
    """Irradiance (k, 3) at places of the floor that rays from above (or below) meet, the mean of
    some pixels' samples.
    """
    mi = mitsuba()
    opened = open_scene(parts)
    emitters = LocalEmitters(opened)
    start = np.repeat(where, samples, axis=0) + [0, -1e-2 if below else 1e-2, 0]
    ray = mi.Ray3f(mi.Point3f(start.T), mi.Vector3f(0, 1 if below else -1, 0))
    si = opened.mi_scene.ray_intersect(ray)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(start))
    value = emitters.irradiance(si, ray, sampler, si.is_valid())
    values = np.stack([np.array(x) for x in value], axis=-1)
    values = np.broadcast_to(values, (len(start), 3)).reshape(len(where), samples, 3)
    return values.mean(axis=1)


def closed_form(where, position=(0, HEIGHT, 0), intensity=INTENSITY):
    toward = np.subtract(position, where)
    distance = np.linalg.norm(toward, axis=1)
    return intensity * np.maximum(toward[:, 1], 0) / distance**3


def floor(**rest):
    return rectangle(size=1, bsdf=diffuse(0.5), **rest)


@pytest.mark.parametrize("share", [0.01, 0.2, 0.5, 0.75, 0.9, 0.99])
def test_shadows_of_what_stands_anywhere_on_the_way(share):
    """A disk at this share of the way from the floor to a bulb throws a disk of shadow of a known
    radius; outside of it light is I·cos/d², without noise.
    """
    radius = 0.5
    parts = scene(
        floor=floor(),
        bulb=bulb(),
        screen=disk((0, -1, 0), (0, share * HEIGHT, 0), radius * (1 - share)),
    )
    where = places()
    distance = np.linalg.norm(where, axis=1)
    where = where[np.abs(distance - radius) > 0.02]
    inside = np.linalg.norm(where, axis=1) < radius
    found = at_pixels(parts, where)
    assert 20 < inside.sum() < len(where) - 20
    assert (found[inside] == 0).all()
    expected = closed_form(where)[~inside]
    np.testing.assert_allclose(found[~inside], expected[:, None] * np.ones(3), rtol=1e-4)


def test_what_is_beyond_a_lamp_throws_no_shadow():
    """Nor does the surface itself, seen from the side that is lit."""
    parts = scene(floor=floor(), bulb=bulb(), roof=disk((0, -1, 0), (0, 1.003 * HEIGHT, 0), 1))
    where = places()
    np.testing.assert_allclose(at_pixels(parts, where)[:, 0], closed_form(where), rtol=1e-4)


def test_the_side_that_is_seen_is_lit():
    """A bulb above a floor seen from below lights it if it is two-sided and shines there: one below
    does, the one above does not.
    """
    two_sided = {"type": "twosided", "bsdf": diffuse(0.5)}
    where = places(9)
    for material, expected in ((two_sided, 1), (diffuse(0.5), 0)):
        parts = scene(
            floor=rectangle(size=1, bsdf=material), up=bulb(), down=bulb((0, -HEIGHT, 0), 7.0)
        )
        below = at_pixels(parts, where, below=True)[:, 0]
        np.testing.assert_allclose(below, expected * closed_form(where, intensity=7.0), rtol=1e-4)
        np.testing.assert_allclose(at_pixels(parts, where)[:, 0], closed_form(where), rtol=1e-4)


def test_each_emitter_once_and_no_distant_one():
    """Three bulbs of other colours among a sky and a sun, which are not local: the sum."""
    colours = np.array([[1, 0, 0], [0, 2, 0], [0, 0.5, 4]])
    spots = [(0.5, 1, 0), (-0.5, 1.5, 0.2), (0, 0.7, -0.6)]
    bulbs = {f"b{i}": bulb(p, list(map(float, c))) for i, (p, c) in enumerate(zip(spots, colours))}
    parts = scene(
        floor=floor(),
        sky={"type": "constant"},
        sun={"type": "directional", "direction": [0, -1, 0]},
        **bulbs,
    )
    where = places(9)
    expected = sum(closed_form(where, p, 1.0)[:, None] * c for p, c in zip(spots, colours))
    np.testing.assert_allclose(at_pixels(parts, where), expected, rtol=1e-4)


def test_no_local_emitter_is_no_light():
    parts = scene(floor=floor(), sky={"type": "constant"})
    assert (at_pixels(parts, places(3)) == 0).all()


@pytest.mark.parametrize("kind", ["rectangle", "sphere", "spot", "textured"])
def test_lamps_with_an_extent_are_mitsubas(kind):
    """Against Mitsuba's own sampling of its emitters, with a ball between the lamp and the floor
    and one just before the lamp. Noise is told by the reference and by the number of samples.
    """
    mi = mitsuba()
    picture = np.zeros((4, 4, 3), np.float32)
    picture[0, 1], picture[3, 2], picture[1, 1] = (9, 3, 1), (1, 2, 8), (2, 2, 2)
    shown = {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True}
    lamp = {
        "rectangle": rectangle((0, -1, 0), (0.1, 1.2, 0), 0.3, emitter=shining([4.0, 2.0, 1.0])),
        "sphere": sphere((0.1, 1.2, 0), 0.2, emitter=shining([4.0, 2.0, 1.0])),
        "spot": {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([0.1, 1.2, 0], [0, 0, 0], [0, 0, 1]),
            "intensity": 5.0,
            "cutoff_angle": 40.0,
        },
        "textured": rectangle(
            (0, -1, 0), (0.1, 1.2, 0), 0.3, emitter={"type": "area", "radiance": shown}
        ),
    }[kind]
    parts = scene(
        floor=floor(),
        lamp=lamp,
        low=sphere((0.3, 0.4, 0.1), 0.15),
        high=sphere((-0.1, 0.9, 0.05), 0.06),
    )
    opened = open_scene(parts)
    points = sample_points(opened, 0.25)
    chosen = np.flatnonzero(points.surface == 0)
    chosen = chosen[np.abs(points.positions[chosen]).max(axis=1) < 0.95]
    expected = ground_truth.point_irradiance(opened.mi_scene, points.at(chosen), 4096, 5)
    found = at_pixels(parts, points.positions[chosen].astype(float), samples=512)
    assert len(chosen) > 30
    assert relative_l2(found, expected.mean) < 0.02 + expected.noise
    assert abs(bias(found, expected.mean)) < 0.005


def test_an_image_with_light_at_pixels_only():
    """Through the integrator: an asset of no light at its points, a screen close to the bulb, and
    each pixel against Mitsuba's direct light.
    """
    import mi_prt

    mi = mitsuba()
    parts = scene(
        floor=floor(),
        bulb=bulb(),
        screen=disk((0, -1, 0), (0, 0.8 * HEIGHT, 0), 0.1, bsdf=diffuse(0.0)),
        camera={
            "type": "perspective",
            "fov": 30,
            "to_world": mi.ScalarTransform4f().look_at([0, 3, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}},
        },
    )
    asset = mi_prt.precompute(parts, transports="own", edge_length=1.0, bounces=0)
    loaded = mi.load_dict(parts)
    camera = loaded.sensors()[0]
    dark = np.zeros((len(asset.points), 3), np.float32)
    image = render_image(asset, loaded, camera, 256, 1, dark, "pixels")
    expected = ground_truth.image(loaded, camera, 512, 2).mean
    assert 0.05 < (expected == 0).all(axis=2).mean() < 0.95
    assert relative_l2(image, expected) < 0.03
    assert abs(bias(image, expected)) < 0.005


def test_the_plugin_takes_the_lamps_of_each_scene_that_it_renders():
    """One integrator, two scenes of one geometry with lamps in other places and of another number:
    the second image is that of an integrator of its own.
    """
    import mi_prt

    mi = mitsuba()
    look = mi.ScalarTransform4f().look_at([0, 3, 0.1], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "to_world": look, "film": film}
    lamps = {"one": bulb((-0.5, 1, 0))}, {"one": bulb((0.5, 1, 0)), "two": bulb((0, 0.5, 0.3))}
    asset = mi_prt.precompute(
        scene(floor=floor(), **lamps[0]), transports="own", edge_length=1.0, bounces=0
    )
    dark = np.zeros((len(asset.points), 3), np.float32)
    first, second = (mi.load_dict(scene(floor=floor(), camera=camera, **x)) for x in lamps)
    shared = integrator_for(asset, dark, "pixels")
    mi.render(first, integrator=shared, spp=1)
    found = np.array(mi.render(second, integrator=shared, spp=4))
    own = np.array(mi.render(second, integrator=integrator_for(asset, dark, "pixels"), spp=4))
    assert own.max() > 0
    np.testing.assert_array_equal(found, own)


def test_footprints_of_rays_grow_with_distance_and_at_grazing_incidence():
    """A ray of K stands for π/K of its hemisphere, and so for π·t²/(K·cos) of the surface that it
    meets; at grazing incidence no more than for `LEAST_COSINE`, a bound far below what most rays
    have. The footprint decides over how much of a wall a bulb beside it is averaged.
    """
    rays = 256
    opened = open_scene(
        scene(
            floor=rectangle(size=0.2, bsdf=diffuse(0.5)),
            roof=rectangle((0, -1, 0), (0, 1, 0), 60, bsdf=diffuse(0.5)),
            bulb=bulb((0, 0.5, 0)),
        )
    )
    points = sample_points(opened, 10.0)
    buried = find_buried(opened, points, np.ones(len(points), bool))
    direct = direct_light(opened, points, opened.local_emitters).irradiance
    locator = replace(points, buried=buried).locator(opened)
    tracer = LampRays(opened, points, Lamps(opened, opened.local_emitters), direct, locator, rays)
    _, albedo, position, normal, footprint = tracer._met(0, len(points))
    dr.eval(albedo, position, normal, footprint)
    position = np.stack([np.array(x) for x in position], axis=-1).reshape(len(points), rays, 3)
    footprint = np.array(footprint).reshape(len(points), rays)
    on_roof = (position[..., 1] > 0.99) & (points.positions[:, None, 1] < 0.01)
    toward = (position - points.positions[:, None])[on_roof]
    distance = np.linalg.norm(toward, axis=1)
    cosine = toward[:, 1] / distance
    expected = np.pi * distance**2 / (np.maximum(cosine, LEAST_COSINE) * rays)
    assert (cosine < LEAST_COSINE).any() and np.median(cosine) > 0.5 and len(cosine) > 500
    np.testing.assert_allclose(
        footprint[on_roof], expected, rtol=0.02
    )  # rays begin a little inward
    assert LEAST_COSINE <= 0.1  # else many rays of a hemisphere would have another footprint
