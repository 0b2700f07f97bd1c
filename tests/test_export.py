"""Exported points and images: exact round trips through other readers, and files that are whole or
not there.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
from conftest import cube, diffuse, rectangle, scene
from PIL import Image

from mi_prt.errors import SettingsError
from mi_prt.output import npz, ply
from mi_prt.points.filled import filled
from mi_prt.points.points import sample_points
from mi_prt.render import image_file
from mi_prt.render.display import display
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba


@pytest.fixture(scope="module")
def asset():
    """Points of a box on a two-sided plate, some buried: all that these functions use of an
    asset.
    """
    plate = rectangle(bsdf={"type": "twosided", "side": diffuse()})
    points = sample_points(
        open_scene(scene(box=cube((0, 0.3, 0), 0.3, bsdf=diffuse([0.8, 0.4, 0.2])), plate=plate)),
        0.2,
    )
    return SimpleNamespace(points=points, buried=points.positions[:, 1] < 0.01)


@pytest.fixture(scope="module")
def radiance(asset):
    """Values over nine decades: nothing may be clipped or rounded."""
    return (10 ** np.random.default_rng(0).uniform(-5, 4, asset.points.positions.shape)).astype(
        np.float32
    )


def read_ply(path):
    """Vertices and faces (m, 3) of a binary PLY, by its header alone."""
    types = {"float": "<f4", "uchar": "u1"}
    header, data = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in header.decode().splitlines()]
    vertices, faces = (int(line[2]) for line in lines if line[0] == "element")
    layout = np.dtype(
        [(line[2], types[line[1]]) for line in lines if line[0] == "property" and line[1] != "list"]
    )
    assert ["property", "list", "uchar", "int", "vertex_indices"] in lines
    vertex = np.frombuffer(data, layout, vertices)
    face = np.frombuffer(data, [("count", "u1"), ("vertices", "<i4", 3)], faces, vertex.nbytes)
    assert len(data) == vertex.nbytes + face.nbytes and (face["count"] == 3).all()
    return vertex, face["vertices"]


def columns(vertex, names):
    return np.stack([vertex[name] for name in names.split()], axis=-1)


def test_ply_holds_points_and_radiance(asset, radiance, tmp_path):
    path = tmp_path / "points.ply"
    ply.write_ply(path, asset, radiance, 0.3)
    vertex, face = read_ply(path)
    np.testing.assert_array_equal(columns(vertex, "x y z"), asset.points.positions)
    np.testing.assert_array_equal(columns(vertex, "nx ny nz"), asset.points.normals)
    np.testing.assert_array_equal(columns(vertex, "radiance_r radiance_g radiance_b"), radiance)
    np.testing.assert_array_equal(face, asset.points.layout.triangles())
    shown = display(radiance, 0.3)
    np.testing.assert_allclose(
        columns(vertex, "red green blue") / 255, shown, atol=0.5 / 255 + 1e-6
    )


def test_mitsuba_reads_the_ply(asset, radiance, tmp_path):
    """Mitsuba names the attribute after the properties: `radiance_r`, g, b become
    `vertex_radiance_color`.
    """
    mi = mitsuba()
    path = tmp_path / "points.ply"
    ply.write_ply(path, asset, radiance, 0.3)
    mesh = mi.load_dict({"type": "ply", "filename": str(path)})
    parameters = mi.traverse(mesh)
    np.testing.assert_array_equal(np.array(parameters["vertex_radiance_color"]), radiance.ravel())
    np.testing.assert_array_equal(
        np.array(parameters["vertex_positions"]), asset.points.positions.ravel()
    )
    np.testing.assert_array_equal(
        np.array(parameters["vertex_normals"]), asset.points.normals.ravel()
    )
    np.testing.assert_array_equal(
        np.array(parameters["faces"]), asset.points.layout.triangles().ravel()
    )


def test_trimesh_reads_the_ply(asset, radiance, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "points.ply"
    ply.write_ply(path, asset, radiance, 0.3)
    mesh = trimesh.load(path, process=False)
    vertex, face = read_ply(path)
    np.testing.assert_allclose(mesh.vertices, asset.points.positions)
    np.testing.assert_array_equal(mesh.faces, face)
    np.testing.assert_array_equal(
        mesh.visual.vertex_colors[:, :3], columns(vertex, "red green blue")
    )


def test_npz_holds_plain_arrays(asset, radiance, tmp_path):
    """NumPy reads it without pickles; the name is kept as it is."""
    path = tmp_path / "points.npz"
    irradiance = radiance * 2
    npz.write_npz(path, asset, radiance, irradiance)
    points = asset.points
    expected = {
        "positions": points.positions,
        "normals": points.normals,
        "albedo": points.albedo,
        "areas": points.areas,
        "buried": points.buried,
        "triangles": points.layout.triangles(),
        "irradiance": irradiance,
        "radiance": radiance,
    }
    with np.load(path, allow_pickle=False) as file:
        assert set(file.files) == set(expected)
        for name, values in expected.items():
            np.testing.assert_array_equal(file[name], values)
            assert file[name].dtype == values.dtype, name


def test_exr_keeps_every_bit(tmp_path):
    """Single precision is kept, below 0, above 65504 (where half precision ends) and between its
    steps.
    """
    image = np.random.default_rng(0).normal(0, 1e5, (7, 11, 3)).astype(np.float32)
    image_file.write_image(tmp_path / "image.EXR", image, factor=3.0)
    with OpenEXR.File(str(tmp_path / "image.EXR")) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, image)


def test_png_holds_displayed_values(tmp_path):
    """All 256 values of 8 bits are reached, each rounded to the nearest; the exposure comes
    first.
    """
    image = np.linspace(-0.1, 1.2, 3 * 4096).reshape(64, 64, 3)
    image_file.write_image(tmp_path / "image.png", image / 4, factor=4.0)
    pixels = np.asarray(Image.open(tmp_path / "image.png"))
    assert pixels.dtype == np.uint8 and pixels.shape == image.shape
    np.testing.assert_allclose(pixels / 255, display(image, 1.0), atol=0.5 / 255 + 1e-6)
    assert len(np.unique(pixels)) == 256
    image_file.write_displayed(tmp_path / "shown.png", display(image, 1.0))
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "shown.png")), pixels)


def test_a_failed_write_leaves_the_previous_file(asset, radiance, tmp_path, monkeypatch):
    """The disk fills up, or the process is stopped, while a file is half written: the old one stays
    and nothing else.
    """
    path = tmp_path / "points.npz"
    npz.write_npz(path, asset, radiance, radiance)
    before = path.read_bytes()

    def full(error):
        def savez(file, **arrays):
            file.write(b"half of it")
            raise error

        return savez

    monkeypatch.setattr(np, "savez", full(OSError("No space left on device")))
    with pytest.raises(SettingsError, match="No space left"):
        npz.write_npz(path, asset, radiance, radiance)
    monkeypatch.setattr(np, "savez", full(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        npz.write_npz(path, asset, radiance, radiance)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["points.npz"]


def test_unusable_paths_are_refused(asset, radiance, tmp_path):
    image = np.zeros((2, 2, 3), np.float32)
    with pytest.raises(SettingsError, match=r"\.exr or \.png"):
        image_file.write_image(tmp_path / "image.jpg", image)
    with pytest.raises(SettingsError, match=r"\.png"):
        image_file.write_displayed(tmp_path / "image.exr", image)
    for write in (
        lambda path: image_file.write_image(path.with_suffix(".exr"), image),
        lambda path: image_file.write_image(path.with_suffix(".png"), image),
        lambda path: ply.write_ply(path, asset, radiance, 0.3),
        lambda path: npz.write_npz(path, asset, radiance, radiance),
    ):
        with pytest.raises(SettingsError, match="create it first"):
            write(tmp_path / "missing" / "file")
    assert not list(tmp_path.iterdir())


def test_files_get_the_usual_permissions(tmp_path):
    """Temporary files are private; what takes the place of the output is as readable as any new
    file.
    """
    (tmp_path / "usual").touch()
    image_file.write_image(tmp_path / "image.png", np.zeros((2, 2, 3)))
    assert (tmp_path / "image.png").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_buried_points_are_exported_with_their_neighbours_light():
    """Each has the value of the nearest free one on its side of its surface, by brute force;
    without any free one it stays as it is.
    """
    parts = scene(
        plate={"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
        box=cube((0, 0, 0), 0.4),
    )
    points = sample_points(open_scene(parts), 0.25)
    inside = (points.surface == 0) & (np.abs(points.positions[:, :2]).max(axis=1) < 0.4)
    points = replace(points, buried=inside | (points.surface == 1))
    values = np.random.default_rng(0).random((len(points), 3)).astype(np.float32)
    found = filled(points, values)
    assert found.dtype == values.dtype and inside.sum() > 4
    np.testing.assert_array_equal(found[~inside], values[~inside])
    for i in np.flatnonzero(inside):
        free = ~points.buried & (points.normals @ points.normals[i] > 0) & (points.surface == 0)
        distance = np.linalg.norm(points.positions - points.positions[i], axis=1)
        nearest = free & (distance < distance[free].min() + 1e-6)
        assert (found[i] == values[nearest]).all(axis=1).any()
    free = replace(points, buried=np.zeros_like(points.buried))
    assert filled(free, values) is values
