"""Mesh files and trimesh objects as scenes."""

import json

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

import mi_prt
from mi_prt.cli import main
from mi_prt.scene.mesh_scene import ENDINGS, mesh_scene
from mi_prt.scene.scene import mesh_arrays

FAST = {"directions": "cubemap:4", "coefficients": 4, "edge_length": 9.0, "bounces": 0}
WHITE = np.ones((2, 4, 3), np.float32)


def run(*arguments):
    with pytest.raises(SystemExit) as left:
        main([str(a) for a in arguments])
    return left.value.code or 0


@pytest.fixture(params=ENDINGS)
def file(request, tmp_path):
    """A box of sides 1, 2, 3 in each format."""
    path = tmp_path / f"box{request.param}"
    trimesh.creation.box((1, 2, 3)).export(path)
    return path


def test_every_format_is_the_same_mesh(file):
    """A convex body under a white sky: irradiance is π everywhere, whatever the file."""
    opened = mi_prt.open_scene(file, {"normals": "flat"})
    assert opened.source.kind == "file" and opened.statistics()["triangles"] == 12
    positions = mesh_arrays(opened.surfaces[0].shape)[0]
    np.testing.assert_allclose(np.ptp(positions, axis=0), (1, 2, 3), atol=1e-6)
    assert opened.surfaces[0].material.two_sided
    asset = mi_prt.precompute(opened, **FAST)
    np.testing.assert_allclose(asset.irradiance(WHITE), np.pi, rtol=0.02)
    np.testing.assert_allclose(asset.points.albedo, 0.5, atol=1e-6)


def test_a_mesh_is_precomputed_and_shown_by_its_name(file, tmp_path, capsys):
    """From the command line, with a floor; asking for light names the option for maps."""
    asset, sky = tmp_path / "a.prt", tmp_path / "sky.exr"
    OpenEXR.File({}, {"RGB": WHITE}).write(str(sky))
    options = [x for k, v in FAST.items() for x in ("--" + k.replace("_", "-"), v)]
    assert run("precompute", file, "-o", asset, "--floor", *options, "--json") == 0
    assert json.loads(capsys.readouterr().out)["points"] > 8
    assert run("relight", asset, "-o", tmp_path / "a.png", "--size", "12x9") == 2
    assert "--envmap" in capsys.readouterr().err
    shown = ["--envmap", sky, "--size", "24x18", "--spp", "4"]
    assert run("relight", asset, "-o", tmp_path / "a.png", *shown) == 0
    image = mi_prt.load(asset).render(WHITE, size=(24, 18), spp=4)
    # all grey: the mesh is in the middle of the picture, on its floor
    np.testing.assert_allclose(image[9, 12], image[9, 12, 0], rtol=1e-3)
    assert 0 < image[9, 12, 0] <= 0.5 + 1e-3


def test_the_floor_lies_under_the_mesh():
    box = trimesh.creation.box((1, 2, 3))
    for up, axis in (("y", 1), ("z", 2)):
        opened = mi_prt.open_scene(box, {"floor": "on", "up": up})
        floor = opened.mi_scene.bbox()
        assert floor.min[axis] == pytest.approx(-box.extents[axis] / 2, abs=1e-5)
        names = [surface.name for surface in opened.surfaces]
        assert names == ["mesh_1", "floor"] or sorted(names) == ["floor", "mesh_1"]
        under_sky = mi_prt.precompute(opened, **FAST)
        normals = under_sky.points.normals[under_sky.points.positions[:, axis] < -1.0001]
        assert under_sky.irradiance(WHITE).max() <= np.pi * 1.02
        assert len(normals) == 0 or up == "z"


def test_colours_of_the_file_are_taken(tmp_path):
    """8 bits are sRGB: 188 is 0.503 linear."""
    box = trimesh.creation.box()
    box.visual.vertex_colors = [188, 0, 255, 255]
    box.export(tmp_path / "box.ply")
    box.visual = trimesh.visual.ColorVisuals(box, face_colors=[[188, 0, 255, 255]] * 12)
    for source in (tmp_path / "box.ply", box):
        asset = mi_prt.precompute(source, **FAST)
        np.testing.assert_allclose(asset.points.albedo.mean(axis=0), (0.503, 0, 1), atol=2e-3)


def test_textures_are_the_right_way_up(tmp_path):
    """A square whose texture is white above and black below (v goes up in files)."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:4] = 255
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels))
    vertices = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    visual = trimesh.visual.TextureVisuals(vertices[:, :2], material=material)
    square = trimesh.Trimesh(vertices, [(0, 1, 2), (0, 2, 3)], visual=visual, process=False)
    square.export(tmp_path / "square.glb")
    for source in (square, tmp_path / "square.glb"):
        asset = mi_prt.precompute(source, **(FAST | {"edge_length": 0.2, "coefficients": 1}))
        points = asset.points
        height = points.positions[:, 1]  # at its rim a texture meets its other end
        above, below = abs(height - 0.8) < 0.15, abs(height - 0.2) < 0.15
        assert points.albedo[above].min() > 0.9 and points.albedo[below].max() < 0.1


def test_objects_of_trimesh_are_passed_again():
    """Two parts, one moved; what is in memory is passed to render."""
    scene = trimesh.Scene(trimesh.creation.icosphere(1))
    scene.add_geometry(
        trimesh.creation.box(), transform=trimesh.transformations.translation_matrix((3, 0, 0))
    )
    asset = mi_prt.precompute(scene, {"floor": "on"}, **FAST)
    assert asset.points.positions[:, 0].max() > 3.4
    with pytest.raises(mi_prt.SceneError, match="pass the scene"):
        asset.render(WHITE)
    assert asset.render(WHITE, scene=scene, size=(8, 6), spp=1).shape == (6, 8, 3)


def test_a_mesh_is_compared_with_the_truth(tmp_path):
    trimesh.creation.icosphere(2).export(tmp_path / "ball.ply")
    asset = mi_prt.precompute(tmp_path / "ball.ply", **(FAST | {"directions": "cubemap:16"}))
    report = mi_prt.compare(asset, tmp_path / "report", WHITE, size=(16, 12), spp=16)
    assert abs(report["points"]["bias"]) < 0.02


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"spp": "3"}, "no parameter 'spp'"),
        ({"floor": "yes"}, "off or on"),
        ({"up": "x"}, "y or z"),
        ({"grey": "1.5"}, "from 0 to 1"),
        ({"grey": "dark"}, "from 0 to 1"),
    ],
)
def test_parameters_that_a_mesh_has_not(parameters, said):
    with pytest.raises(mi_prt.SceneError, match=said):
        mesh_scene(trimesh.creation.box(), parameters)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("content", [b"", b"\0\xff" * 300, b"ply\nformat ascii 1.0\nend_header\n"])
def test_files_that_are_no_mesh(ending, content, tmp_path):
    path = tmp_path / f"bad{ending}"
    path.write_bytes(content)
    with pytest.raises(mi_prt.SceneError, match=r"bad\."):
        mi_prt.open_scene(path)


def test_positions_that_are_not_finite():
    box = trimesh.creation.box()
    box.vertices[0, 0] = np.nan
    with pytest.raises(mi_prt.SceneError):
        mi_prt.open_scene(box)
