"""The length that offsets are measured by."""

import pytest
from conftest import cube, rectangle, scene

from mi_prt.scene.scene import open_scene


def test_a_wide_ground_does_not_set_the_scale():
    """Of a house alone its diagonal; on a ground 200 times as wide a sixteenth of the ground's, not
    all of it; far from the origin the largest coordinate, which float32 calls for.
    """
    house = cube((0, 1, 0), 1.0)
    alone = open_scene(scene(house=house)).scale
    assert alone == pytest.approx(12**0.5, rel=1e-5)
    ground = open_scene(scene(house=house, ground=rectangle(size=200))).scale
    assert ground == pytest.approx((2 * 400**2 + 4) ** 0.5 / 16, rel=1e-4)
    far = open_scene(scene(house=cube((900, 1, 0), 1.0), ground=rectangle(size=2000))).scale
    assert far == pytest.approx(901, rel=1e-5)
    some = open_scene(scene(house=house, ground=rectangle(size=10))).scale
    assert some == pytest.approx((2 * 20**2 + 4) ** 0.5, rel=1e-5)
