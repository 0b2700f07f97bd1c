"""The sample scenes: their generated files are reproducible, the teapot is sound, and Mitsuba loads
them.
"""

import importlib.util
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import mi_prt  # noqa: F401  (selects LLVM for Mitsuba)

SCENES = Path(__file__).resolve().parents[1] / "scenes"
_spec = importlib.util.spec_from_file_location("scenes_generate", SCENES / "generate.py")
generate = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(generate)


@pytest.fixture(scope="module")
def teapot():
    vertex, face = generate.teapot()
    return vertex[:, :3], vertex[:, 3:6], vertex[:, 6:], face


def boundary_edges(face):
    """Edges that only one triangle has; asserts that no edge has more than two, nor two with the
    same direction.
    """
    directed = face[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    edges, count = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    return edges[count == 1], len(edges)


def pixels(path):
    if path.suffix == ".exr":
        with OpenEXR.File(str(path)) as file:
            return file.channels()["RGB"].pixels.copy()
    return np.asarray(Image.open(path))


def test_generator_reproduces_the_committed_files(tmp_path):
    first = generate.generate(tmp_path / "first")
    second = generate.generate(tmp_path / "second")
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]

    names = {p.relative_to(tmp_path / "first") for p in first}
    committed = {
        p.relative_to(SCENES)
        for folder in ("meshes", "textures")
        for p in (SCENES / folder).iterdir()
    }
    assert names == committed
    for path in first:
        original = SCENES / path.relative_to(tmp_path / "first")
        if path.read_bytes() != original.read_bytes():
            # Another release of zlib or OpenEXR may pack the same pixels differently; nothing else
            # may differ.
            assert path.suffix in (".exr", ".png"), f"{path.name} differs"
            np.testing.assert_array_equal(pixels(path), pixels(original), err_msg=path.name)


def test_patches_interpolate_their_corners_and_match_finite_differences():
    nets = generate.teapot_nets()
    assert len(nets) == 32
    ends = np.array([0.0, 1.0])
    for _, _, net in nets:
        point, normal = generate.evaluate_patch(net, ends, ends)
        np.testing.assert_allclose(point, net[::3, ::3], atol=1e-12)
        at, h = np.array([0.3, 0.6]), 1e-5
        point, normal = generate.evaluate_patch(net, at, at)
        along_u = (
            generate.evaluate_patch(net, at + h, at)[0]
            - generate.evaluate_patch(net, at - h, at)[0]
        ) / (2 * h)
        along_v = (
            generate.evaluate_patch(net, at, at + h)[0]
            - generate.evaluate_patch(net, at, at - h)[0]
        ) / (2 * h)
        cross = np.cross(along_u, along_v)
        np.testing.assert_allclose(
            normal, cross / np.linalg.norm(cross, axis=-1, keepdims=True), atol=1e-7
        )


def test_teapot_normals_and_winding(teapot):
    position, normal, uv, face = teapot
    assert np.isfinite(position).all() and np.isfinite(normal).all()
    assert uv.min() >= 0 and uv.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    a, b, c = position[face].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1) / 2
    assert area.min() > 1e-5  # no slivers, in particular none at the poles
    facing = np.einsum("fkc,fc->fk", normal[face], cross) / (2 * area[:, None])
    assert facing.min() > 0.5 and np.percentile(facing, 1) > 0.9
    # Outwards: an inside-out surface would have a negative volume. Body of revolution: radius <= 2,
    # height <= 3.15.
    volume = np.einsum("fc,fc->", a, np.cross(b, c)) / 6
    assert 20 < volume < np.pi * 2**2 * 3.15


def test_teapot_stands_on_the_ground_and_has_exact_poles(teapot):
    position, normal, _, _ = teapot
    np.testing.assert_allclose(position.min(axis=0), [-3, 0, -2], atol=1e-6)
    assert position[:, 1].max() == pytest.approx(3.15, abs=1e-6)
    assert 3.4 < position[:, 0].max() < 3.525  # the tip of the spout, inside its control net
    for height, up in ((0.0, -1), (3.15, 1)):
        (pole,) = np.flatnonzero(np.all(np.abs(position - [0, height, 0]) < 1e-7, axis=1))
        np.testing.assert_array_equal(normal[pole], [0, up, 0])


def test_teapot_topology(teapot):
    position, _, _, face = teapot
    n = generate.TEAPOT_DIVISIONS
    boundary, edges = boundary_edges(face)
    # Open edges: the rim and the lid (4 patches round each), both ends of the handle and of the
    # spout (2 patches each).
    assert len(boundary) == (4 + 4 + 2 * 2 + 2 * 2) * n
    # Pot and lid are discs (Euler characteristic 1), handle and spout are open tubes (0).
    assert len(position) - edges + len(face) == 2
    assert len(np.unique(face)) == len(position) == 6330
    # Welded: the one position that occurs twice is where the handle's end touches the pot.
    where, count = np.unique(np.round(position, 5), axis=0, return_counts=True)
    np.testing.assert_allclose(where[count > 1], [[-2, 0.9, 0]], atol=1e-6)


def test_teapot_file_holds_the_mesh(teapot):
    position, normal, uv, face = teapot
    mesh = mi.load_dict({"type": "ply", "filename": str(SCENES / "meshes/teapot.ply")})
    params = mi.traverse(mesh)
    np.testing.assert_array_equal(
        np.array(params["vertex_positions"]).reshape(-1, 3), position.astype(np.float32)
    )
    # Mitsuba normalises again on loading.
    np.testing.assert_allclose(np.array(params["vertex_normals"]).reshape(-1, 3), normal, atol=1e-6)
    np.testing.assert_array_equal(
        np.array(params["vertex_texcoords"]).reshape(-1, 2), uv.astype(np.float32)
    )
    np.testing.assert_array_equal(np.array(params["faces"]).reshape(-1, 3), face)


@pytest.mark.parametrize("name", ["sky_noon.exr", "sky_evening.exr", "sky_morning.exr"])
def test_environment_maps_follow_mitsubas_layout(name):
    image = pixels(SCENES / "textures" / name).astype(np.float32)
    assert np.isfinite(image).all() and image.min() >= 0
    emitter = mi.load_dict({"type": "envmap", "filename": str(SCENES / "textures" / name)})
    # at the poles a column has no direction of its own
    direction = generate.latlong_directions(*image.shape[:2])[1:-1]
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(
        *(mi.Float(-c.astype(np.float32).ravel()) for c in np.moveaxis(direction, -1, 0))
    )
    seen = np.array(emitter.eval(si)).T.reshape(direction.shape)
    np.testing.assert_allclose(seen, image[1:-1], rtol=1e-2, atol=1e-3)


def test_lampshade_is_an_open_cone():
    vertex, face = generate.lampshade(narrow=0.7)
    position, normal = vertex[:, :3], vertex[:, 3:6]
    np.testing.assert_allclose(np.hypot(position[:, 0], position[:, 2]), 1 - 0.3 * position[:, 1])
    a, b, c = position[face].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    assert np.einsum("fkc,fc->fk", normal[face], cross).min() > 0  # wound outwards
    # the area of 48 flat trapezoids; open are both rims (48 edges) and both sides of the seam (4)
    slant = np.hypot(0.3 * np.cos(np.pi / 48), 1)
    side = 48 * 2 * np.sin(np.pi / 48) * (1 + 0.7) / 2 * slant
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(side, rel=1e-6)
    assert len(boundary_edges(face)[0]) == 2 * 48 + 2 * 4


def test_day_room_has_three_named_lamps_and_a_sky():
    scene = mi.load_file(str(SCENES / "day_room.xml"), optimize=False, parallel=False)
    names = [e.get_shape().id() if e.get_shape() else e.id() for e in scene.emitters()]
    assert sorted(names) == ["ceiling_lamp", "desk_lamp", "floor_lamp", "sky"]


def test_day_room_is_closed_but_for_its_window():
    """Every ray that leaves the room passes the window: from places all over the room, all ways.

    The share of 1e-5 is for rays that meet an edge of two walls to the last bit: without Embree's
    robust mode some pass. A gap of 1 mm round the window is 6e-3 of 87 m² and lets about 7e-5 out.
    """
    scene = mi.load_file(str(SCENES / "day_room.xml"), optimize=False, parallel=False)
    rng = np.random.default_rng(11)
    origin = rng.uniform([-2.4, 0.1, -1.9], [2.4, 2.65, 1.9], (1_000_000, 3))
    direction = rng.standard_normal(origin.shape)
    hit = scene.ray_test(
        mi.Ray3f(
            mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32))
        )
    )
    gone = ~np.array(hit)
    passed = direction[:, 0] < 0
    for x in (-2.5, -2.75):  # the opening's inner and outer end
        y_and_z = (origin + direction * ((x - origin[:, :1]) / direction[:, :1]))[:, 1:]
        passed &= (np.abs(y_and_z - [1.5625, 0.125]) < [0.6876, 0.8751]).all(axis=1)
    assert gone.mean() > 0.01  # the window lets light in
    assert (gone & ~passed).mean() < 1e-5


def test_floor_texture_is_a_plausible_albedo():
    srgb = pixels(SCENES / "textures/planks.png") / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    assert linear.min() > 0.099 and linear.max() < 0.801 and linear.std() > 0.05


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.xml")), ids=lambda p: p.stem)
def test_scene_loads_and_renders(path):
    scene = mi.load_file(str(path), optimize=False, parallel=False, width=16, height=12)
    assert len(scene.sensors()) == 1 and scene.shapes()
    distant = [mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters()]
    # all scenes are under the sky alone, but for a room with a lamp, and one with a sky and lamps
    assert distant == {"room": [False], "day_room": [True] + 3 * [False]}.get(path.stem, [True])
    image = np.array(mi.render(scene, spp=8))
    assert image.shape == (12, 16, 3) and np.isfinite(image).all() and 0.05 < image.mean() < 1.0
