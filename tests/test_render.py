"""Pictures of an asset as arrays, by sensors of the scene and by cameras of one's own."""

from pathlib import Path

import numpy as np
import pytest
from small_assets import SCENE, write_scene

import mi_prt
from mi_prt.render.image import pick_sensor

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = {
    "transports": "distant,own",
    "edge_length": 9.0,
    "directions": "cubemap:4",
    "coefficients": 4,
    "paths_per_point": 16,
    "lamp_rays": 16,
}
SENSOR = """<sensor type="perspective">
    <transform name="to_world">
      <lookat origin="0, 2, 4" target="0, 0.5, 0" up="0, 1, 0"/>
    </transform>
    <float name="fov" value="40"/><string name="fov_axis" value="x"/>
    <film type="hdrfilm">
      <integer name="width" value="24"/><integer name="height" value="16"/>
    </film>
  </sensor></scene>"""
SAME = mi_prt.Camera((0, 2, 4), (0, 0.5, 0), fov=40)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("render") / "scene.xml"
    path.write_text(SCENE.replace("</scene>", SENSOR))
    return path


@pytest.fixture(scope="module")
def asset(scene):
    return mi_prt.precompute(scene, **SETTINGS)


def test_a_picture_is_an_array(asset, scene):
    image = asset.render(spp=4)
    assert image.shape == (16, 24, 3) and image.dtype == np.float32
    assert np.isfinite(image).all() and image.mean() > 0
    sky = np.ones((2, 4, 3), np.float32)
    assert asset.render(sky, size=(12, 8), spp=4).shape == (8, 12, 3)
    # light is linear: lamps at half their power halve the picture
    half = asset.render([lamp * 0.5 for lamp in asset.own_lights.values()], spp=4)
    np.testing.assert_allclose(half[4:], image[4:] / 2, rtol=1e-3, atol=1e-4)


def test_a_camera_like_the_sensor_sees_the_same(asset):
    """One seed, one film: the same rays."""
    by_sensor, by_camera = (
        asset.render(spp=4, size=(24, 16), **chosen) for chosen in ({"sensor": 0}, {"camera": SAME})
    )
    np.testing.assert_allclose(by_camera, by_sensor, rtol=1e-3, atol=1e-4)


def test_a_camera_is_taken_wherever_a_sensor_is(asset, tmp_path):
    mi_prt.relight_to_file(asset, tmp_path / "a.exr", sensor=SAME, size=(24, 16), spp=4)
    assert (tmp_path / "a.exr").stat().st_size > 0


def test_scenes_in_memory_are_passed_again(tmp_path):
    opened = mi_prt.open_scene(write_scene(tmp_path))
    held = mi_prt.precompute(opened.mi_scene, **SETTINGS)
    with pytest.raises(mi_prt.SceneError, match="pass the scene"):
        held.render(camera=SAME)
    assert held.render(camera=SAME, scene=opened.mi_scene, size=(4, 3), spp=1).shape == (3, 4, 3)
    with pytest.raises(mi_prt.SettingsError, match="--camera"):
        held.render(scene=opened.mi_scene)


def test_a_sensor_or_a_camera(asset):
    with pytest.raises(mi_prt.SettingsError, match="one of them"):
        asset.render(sensor=1, camera=SAME)


# --- cameras --------------------------------------------------------------------------------------


def test_cameras_from_text():
    assert mi_prt.Camera.parse("0,2,4:0,0.5,0:40") == SAME
    assert mi_prt.Camera.parse("0,2,4:0,0.5,0").fov == 45
    assert mi_prt.Camera.parse("0,2,4:0,0.5,0:40:z").up == (0, 0, 1)
    assert mi_prt.Camera.parse("1,2,3:0,0,0:40:0,1,1").up == (0, 1, 1)
    assert mi_prt.Camera((0, 5, 0), (0, 0, 0)).up == (0, 0, 1)  # it looks along y


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "FROM:TO"),
        ("1,2,3", "FROM:TO"),
        ("1,2,3:4,5,6:7:8:9", "FROM:TO"),
        ("1,2:0,0,0", "three finite numbers"),
        ("a,b,c:0,0,0", "FROM:TO"),
        ("1,nan,3:0,0,0", "three finite numbers"),
        ("1,2,3:1,2,3", "its own place"),
        ("1,2,3:0,0,0:180", "between 0 and 180"),
        ("1,2,3:0,0,0:nan", "between 0 and 180"),
        ("0,2,0:0,0,0:40:y", "along its view"),
        ("1,2,3:0,0,0:40:up", "FROM:TO"),
    ],
)
def test_texts_that_are_no_camera(text, said):
    with pytest.raises(mi_prt.SettingsError, match=said):
        mi_prt.Camera.parse(text)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_a_box_is_seen_whole(up):
    """All its corners fall into the image, and take at least a third of its height."""
    from mi_prt.render.view import view_of

    low, high = np.array([-1, 2, 3.0]), np.array([2, 3, 7.0])
    view = view_of(pick_sensor(None, mi_prt.Camera.looking_at(low, high, up)))
    corners = np.stack(np.meshgrid(*zip(low, high), [1.0]), -1).reshape(-1, 4)
    places = view.image @ corners.T / (view.axis @ corners.T)
    assert np.abs(places).max() < 1
    assert np.ptp(places[1]) > 2 / 3


# --- public names ---------------------------------------------------------------------------------


def test_public_names(asset, scene, tmp_path):
    asset.save(tmp_path / "a.prt")
    assert mi_prt.info(asset)["points"] == mi_prt.info(tmp_path / "a.prt")["points"]
    assert mi_prt.info(scene, **SETTINGS)["requires"]
    assert mi_prt.Settings(coefficients=4).coefficients == 4
    told = mi_prt.animate(
        asset,
        tmp_path / "f.gif",
        [(0, 1, 1), (1, 1, 1)],
        2,
        light=mi_prt.PointLight((0, 3, 0), 5),
        renderer="mitsuba",
        sensor=SAME,
        size=(8, 6),
        spp=1,
    )
    assert told["frames"] == 2
    assert set(mi_prt.__all__) <= set(dir(mi_prt)) and sorted(mi_prt.__all__) == mi_prt.__all__


@pytest.mark.parametrize("name", ["python_api", "moving_light", "xml_to_image", "batch"])
def test_examples_import_nothing_private(name):
    assert "from mi_prt" not in (ROOT / "examples" / f"{name}.py").read_text()
