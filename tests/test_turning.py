"""Films of distant light that turns: each frame is the picture of the turned light."""

import numpy as np
import pytest
from conftest import cube, rectangle, scene, sky_of
from PIL import Image

import mi_prt
from mi_prt import LightError, SettingsError
from mi_prt.system.runtime import mitsuba

LIGHT = sky_of(
    lambda d: 0.1 + 20 * np.maximum(d @ [[0.8], [0.5], [0.2]], 0) ** 4 * [1, 0.8, 0.5], 32
)


@pytest.fixture(scope="module")
def baked():
    """An asset of a box on a floor, and its scene."""
    sensor = {
        "type": "perspective",
        "to_world": mitsuba().ScalarTransform4f().look_at([0, 2, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 24, "height": 18},
    }
    parts = scene(floor=rectangle(), box=cube((0, 0.2, 0), 0.2), sensor=sensor)
    return mi_prt.precompute(parts, directions="cubemap:8", edge_length=0.2, bounces=0), parts


def shown(path):
    return np.array(Image.open(path)).astype(int)


def test_each_frame_is_the_picture_of_turned_light(baked, tmp_path):
    """Four quarters of a turn, beside a lamp that moves: at the first frame's exposure they are the
    pictures of the map turned by as much and the lamp in its place, to a few of 256 steps (light
    that turns is kept on a lattice), and differ from each other by more.
    """
    asset, parts = baked
    lamp = mi_prt.PointLight((-1, 2, 0.5), 1.0)
    told = mi_prt.animate(
        asset,
        tmp_path / "f%d.png",
        [(-1, 2, 0.5), (1, 2, 0.5)],
        frames=4,
        light=[mi_prt.EnvironmentMap(LIGHT), lamp],
        scene=parts,
        renderer="mitsuba",
        spp=16,
        turn=("y", 360),
    )
    pictures = [shown(path) for path in sorted(tmp_path.glob("f*.png"))]
    assert len(pictures) == told["frames"] == 4
    for i, picture in enumerate(pictures):
        moved = mi_prt.PointLight((-1 + 2 * i / 3, 2, 0.5), 1.0)
        mi_prt.relight_to_file(
            asset,
            tmp_path / f"still{i}.png",
            [mi_prt.EnvironmentMap(LIGHT), moved],
            ("y", 90 * i),
            parts,
            spp=16,
            exposure=told["exposure"]["ev"],
        )
        assert np.abs(picture - shown(tmp_path / f"still{i}.png")).mean() < 1
        assert np.abs(picture - pictures[i - 1]).mean() > 2.5


def test_films_that_nothing_moves_in_are_refused(baked, tmp_path):
    asset, parts = baked
    with pytest.raises(SettingsError, match="--turn"):
        mi_prt.animate(asset, tmp_path / "a.gif", scene=parts)
    with pytest.raises(LightError, match="turn is of distant light"):
        mi_prt.animate(
            asset,
            tmp_path / "a.gif",
            light=mi_prt.PointLight((0, 5, 0), 1),
            scene=parts,
            turn=("y", 90),
        )
    assert not list(tmp_path.iterdir())
