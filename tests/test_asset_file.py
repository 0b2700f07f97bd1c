"""The asset's file: its documentation is true, and the recorded scene is found and safe."""

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import small_assets

import mi_prt
from mi_prt.asset.provenance import open_scene_of
from mi_prt.directions import parse_directions
from mi_prt.errors import SceneError
from mi_prt.lighting.cells import cell_radiance

DOCUMENT = Path(__file__).parents[1] / "docs" / "asset-format.md"
FAST = {"transports": "distant", "directions": "cubemap:4", "edge_length": 9.0, "bounces": 0}


@pytest.mark.parametrize("kind", ["pca", "sh", "haar-shared"])
def test_the_documented_reader_relights(kind, tmp_path, monkeypatch):
    """Its code alone, of one and of three channels, gives what the program gives: both add up the
    same products, in another order.
    """
    monkeypatch.chdir(tmp_path)
    asset = mi_prt.precompute(small_assets.write_scene(tmp_path), **small_assets.KINDS[kind])
    asset.save("scene.prt")
    sky = np.random.default_rng(0).random((8, 16, 3), np.float32)
    names = {"L": cell_radiance(sky, parse_directions("cubemap:4"))}
    exec(re.search("```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)[1], names)
    scale = names["radiance"].max()
    assert names["header"]["transports"]["distant"]["basis"] == kind
    np.testing.assert_allclose(names["irradiance"], asset.irradiance(sky), atol=1e-5 * scale)
    np.testing.assert_allclose(names["radiance"], asset.relight(sky), atol=1e-5 * scale)


def test_safetensors_opens_it_and_all_arrays_are_documented(tmp_path):
    """Names of arrays in the document are the last parts of those in files."""
    text = DOCUMENT.read_text()
    scene = small_assets.write_scene(tmp_path)
    for kind in ("pca", "haar", "none", "own"):
        asset = mi_prt.precompute(scene, **small_assets.KINDS[kind])
        asset.save(tmp_path / "a.prt")
        arrays = safetensors.numpy.load_file(tmp_path / "a.prt")
        np.testing.assert_array_equal(arrays["points/positions"], asset.points.positions)
        for name in arrays:
            assert re.search(f"`([a-z_]+/)*{name.split('/')[-1]}`", text), name


# --- the recorded scene ---------------------------------------------------------------------------


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with a scene and the asset of it, made by a relative path."""
    (tmp_path / "one" / "scenes").mkdir(parents=True)
    (tmp_path / "one" / "assets").mkdir()
    small_assets.write_scene(tmp_path / "one" / "scenes")
    monkeypatch.chdir(tmp_path / "one")
    asset = mi_prt.precompute("scenes/scene.xml", {"red": 0.5}, **FAST)
    asset.save("assets/a.prt")
    return tmp_path, asset


def test_a_relative_scene_moves_with_the_asset(project):
    folder, asset = project
    assert asset.scene["path"] == str(folder / "one" / "scenes" / "scene.xml")
    shutil.move(folder / "one", folder / "two")
    loaded = mi_prt.load(folder / "two" / "assets" / "a.prt")
    assert loaded.scene["path"] == str(folder / "two" / "scenes" / "scene.xml")
    assert open_scene_of(loaded).source.path == loaded.scene["path"]


def test_an_asset_saved_elsewhere_still_leads_to_its_scene(project):
    """The relative path is made anew for each file."""
    folder, asset = project
    (folder / "far" / "away").mkdir(parents=True)
    loaded = mi_prt.load("assets/a.prt")
    loaded.save(folder / "far" / "away" / "b.prt")
    again = mi_prt.load(folder / "far" / "away" / "b.prt")
    assert again.scene == loaded.scene == asset.scene
    assert open_scene_of(again).hash == asset.scene["hash"]


def test_an_absolute_scene_stays_where_it_is(tmp_path):
    """It is found from a copy of the asset in any folder."""
    scene = small_assets.write_scene(tmp_path)
    mi_prt.precompute(scene, **FAST).save(tmp_path / "a.prt")
    (tmp_path / "b").mkdir()
    shutil.copy(tmp_path / "a.prt", tmp_path / "b")
    assert mi_prt.load(tmp_path / "b" / "a.prt").scene["path"] == str(scene)


@pytest.mark.parametrize(
    "path, words",
    [
        ("//host/share/scene.xml", "no file of this machine"),
        ("\\\\host\\share\\scene.xml", "no file of this machine"),
        ("/dev/zero", "no regular file"),
        ("/proc/self/environ", "no regular file"),
        ("fifo", "no regular file"),
        (".", "no regular file"),
        ("no.xml", "not there any more"),
        ("http://host/scene.xml", "not there any more"),
        ("x" * 5000, "not there any more"),
        ("a\0b", "not there any more"),
    ],
)
@pytest.mark.skipif(os.name != "posix", reason="names of POSIX")
def test_places_that_are_no_scene_are_not_opened(project, path, words):
    """A hostile file may record any place. To open the fifo would wait for ever."""
    os.mkfifo("assets/fifo")
    _, asset = project
    asset.scene.update(path=path, is_relative=False)
    asset.save("assets/b.prt")
    loaded = mi_prt.load("assets/b.prt")
    with pytest.raises(SceneError, match=words) as caught:
        open_scene_of(loaded)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400
