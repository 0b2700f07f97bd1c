"""What a picture is shown with: sRGB, exposure, the size of the film."""

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
