"""What a picture is shown with: sRGB, exposure, the size of the film."""

import warnings

import numpy as np
import pytest
from conftest import cube, rectangle, scene

import mi_prt
from mi_prt.render.display import display, exposure
from mi_prt.render.image import resized
from mi_prt.render.picture import Picture
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba


@pytest.mark.parametrize(
    ("linear", "shown"),
    [
        (0.0, 0.0),
        (0.002, 0.02584),
        (0.0031308, 0.04045),
        (0.005, 0.06101),
        (0.01, 0.09985),
        (0.02, 0.15170),
        (0.18, 0.46136),
        (0.5, 0.73536),
        (1.0, 1.0),
        (7.0, 1.0),
        (-1.0, 0.0),
    ],
)
def test_displayed_values_are_srgb(linear, shown):
    """Values of IEC 61966-2-1 on both sides of where its two pieces meet, and clipped."""
    assert display([linear], 1.0)[0] == pytest.approx(shown, abs=2e-5)
    assert display([linear / 4], 4.0)[0] == pytest.approx(shown, abs=2e-5)


def test_exposure_takes_grey_to_mid_grey():
    """Of one luminance to 0.18; black does not count; of all black the factor is 1."""
    assert exposure(np.full((5, 3), 0.6)) == pytest.approx(0.3)
    assert exposure([[0.6] * 3, [0.0] * 3]) == pytest.approx(0.3)
    assert exposure([[0.1] * 3, [10.0] * 3]) == pytest.approx(0.18)
    assert exposure(np.zeros((5, 3))) == 1


def test_buried_points_do_not_expose_a_picture():
    """Nobody sees them, whatever light they were given."""
    parts = scene(floor=rectangle(), box=cube((0, 0.2, 0), 0.2), sky={"type": "constant"})
    opened = open_scene(parts)
    asset = mi_prt.precompute(parts, directions="cubemap:4", edge_length=0.1, bounces=0)
    picture = Picture(asset, opened, asset.resolved(None, None, opened))
    assert 0 < asset.buried.sum() < len(asset.buried) / 2
    irradiance = np.where(asset.buried[:, None], 1e6, 1.0) * np.ones(3)
    picture.at_points = lambda: irradiance
    expected = exposure(asset.outgoing_radiance(irradiance)[~asset.buried])
    assert picture.exposure() == pytest.approx(expected, rel=1e-6)


def test_a_film_has_its_own_size_again():
    """After a picture of another size, and after one that failed: size, crop and where it is."""
    mi = mitsuba()
    film = {"type": "hdrfilm", "width": 40, "height": 30}
    film |= {"crop_offset_x": 5, "crop_offset_y": 6, "crop_width": 20, "crop_height": 10}
    sensor = mi.load_dict({"type": "perspective", "film": film})

    def sizes():
        made = sensor.film()
        return [list(map(int, x)) for x in (made.size(), made.crop_size(), made.crop_offset())]

    before = sizes()
    with resized(sensor, (16, 12)):
        assert sizes() == [[16, 12], [16, 12], [0, 0]]
    assert sizes() == before
    with pytest.raises(ZeroDivisionError), resized(sensor, (8, 8)):
        raise ZeroDivisionError
    assert sizes() == before
    with resized(sensor, None):
        assert sizes() == before


# --- exposure that was asked for ------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """An asset of a box on a floor with a sensor, in a file, and its scene."""
    sensor = {
        "type": "perspective",
        "to_world": mitsuba().ScalarTransform4f().look_at([0, 2, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 12},
    }
    parts = scene(floor=rectangle(), box=cube((0, 0.2, 0), 0.2), sensor=sensor)
    return mi_prt.precompute(parts, directions="cubemap:4", edge_length=0.2, bounces=0), parts


def shown(path):
    from PIL import Image

    return np.array(Image.open(path)).astype(int)


def test_an_exposure_is_told_and_can_be_given(plain, tmp_path):
    """A map and ten times it: by `auto` the same picture, and EV that differ by log2 10; with one
    EV for both they differ. One EV more is the picture of twice the light.
    """
    asset, parts = plain
    path = tmp_path / "a.png"

    def relit(strength, exposure):
        sky = mi_prt.EnvironmentMap(np.full((2, 4, 3), strength))
        told = mi_prt.relight_to_file(
            asset, path, sky, scene=parts, spp=4, exposure=exposure, force=True
        )
        return shown(path), told["exposure"]

    one, at = relit(0.2, "auto")
    ten, at_ten = relit(2.0, "auto")
    np.testing.assert_allclose(one, ten, atol=1)
    assert at["ev"] - at_ten["ev"] == pytest.approx(np.log2(10), abs=1e-3)
    assert at["factor"] == pytest.approx(2 ** at["ev"], rel=1e-3)
    again, told = relit(0.2, at["ev"])
    np.testing.assert_allclose(one, again, atol=1)
    assert told["ev"] == pytest.approx(at["ev"], abs=1e-3)
    dark, bright = relit(0.2, -2)[0], relit(0.4, -2)[0]
    assert bright.mean() > 1.2 * dark.mean()
    np.testing.assert_allclose(relit(0.2, -1)[0], bright, atol=1)


@pytest.mark.parametrize("value", ["bright", "nan", "inf", 101, None, True, []])
def test_an_exposure_that_is_none_is_refused(plain, tmp_path, value):
    asset, parts = plain
    with pytest.raises(mi_prt.SettingsError, match="exposure.*EV"):
        mi_prt.relight_to_file(asset, tmp_path / "a.png", scene=parts, exposure=value)
    assert not list(tmp_path.iterdir())


def test_light_that_gives_almost_nothing_is_told(tmp_path):
    """A lamp outside a closed room; a black sky; and no word of a lamp above an open floor."""
    walls = {
        f"wall_{i}": rectangle(-np.array(n), np.array(n) * 1.0, 1.0)
        for i, n in enumerate([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
    }
    asset = mi_prt.precompute(
        scene(**walls), directions="cubemap:8", points="vertices", edge_length=0.4, bounces=0
    )
    with pytest.warns(mi_prt.LightWarning, match="gives the scene (almost )?nothing"):
        mi_prt.relight_to_file(asset, tmp_path / "a.npz", mi_prt.PointLight((3, 2, 0.5), 10))
    floor = mi_prt.precompute(
        scene(floor=rectangle()), directions="cubemap:4", edge_length=0.4, bounces=0
    )
    with pytest.warns(mi_prt.LightWarning, match="black"):
        mi_prt.relight_to_file(
            floor, tmp_path / "b.npz", mi_prt.EnvironmentMap(np.zeros((2, 4, 3)))
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error", mi_prt.LightWarning)
        mi_prt.relight_to_file(floor, tmp_path / "c.npz", mi_prt.PointLight((3, 2, 0.5), 10))
