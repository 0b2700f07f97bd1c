"""Comparing with ground truth: which truth, and that errors are those of the pictures."""

import numpy as np
import OpenEXR
import pytest
from conftest import cube, rectangle, scene

import mi_prt
from mi_prt.evaluate import metrics
from mi_prt.runtime import mitsuba

mi = mitsuba()


def lit_room():
    """A floor, a box of rough plastic, a lamp above them, and a uniform sky."""
    plastic = {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": 0.5}}
    return scene(
        floor=rectangle(size=2),
        box=cube((0, 0.5, 0), 0.5, bsdf=plastic),
        bulb={"type": "point", "position": [1, 2, 1], "intensity": {"type": "rgb", "value": 8.0}},
        sky={"type": "constant"},
        eye={
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([3, 3, 3], [0, 0.3, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 48, "height": 36, "rfilter": {"type": "box"}},
        },
    )


def read(path):
    with OpenEXR.File(str(path)) as file:
        return file.channels()["RGB"].pixels


@pytest.fixture(scope="module")
def room():
    return mi_prt.precompute(lit_room(), directions="cubemap:16", edge_length=0.2)


def test_the_reference_is_the_scene_as_modelled_or_as_written(room, tmp_path):
    """As modelled the bulb is dark and the plastic diffuse, so the result is right; as written it lacks their light.

    The bulb gives the floor about as much irradiance as a third of the sky's π, far more than the tolerance of 2 %.
    """
    reports = {
        name: mi_prt.compare(room, tmp_path / name, scene=lit_room(), spp=64, reference=name) for name in ("modelled", "full")
    }
    for name, report in reports.items():
        assert report["reference"] == name
        assert {"RoughPlastic", "PointLight"} <= {entry["what"].split(":")[0] for entry in report["left_out"]}
    assert abs(reports["modelled"]["points"]["bias"]) < 0.02
    assert abs(reports["modelled"]["image"]["bias"]) < 0.03
    assert reports["full"]["points"]["bias"] < -0.1
    assert reports["full"]["image"]["bias"] < -0.1
    assert "in the reference, not in the result" in (tmp_path / "full" / "index.html").read_text()


def test_reported_errors_are_those_of_the_pictures(room, tmp_path):
    """The EXRs it leaves give the reported relative RMSE; pixels that no surface covers do not count."""
    report = mi_prt.compare(room, tmp_path, scene=lit_room(), spp=32)
    result, reference = read(tmp_path / "result.exr"), read(tmp_path / "reference.exr")
    sky = np.abs(reference - 1).max(axis=2) < 1e-6  # the background is exactly the sky's radiance of 1
    assert 0.1 < sky.mean() < 0.9
    assert metrics.relative_rmse(result, reference) < report["image"]["relative_rmse"] + 1e-6  # the background adds no error
    inside = ~(sky | np.roll(sky, 1, 0) | np.roll(sky, -1, 0) | np.roll(sky, 1, 1) | np.roll(sky, -1, 1))
    assert metrics.relative_rmse(result[inside], reference[inside]) == pytest.approx(report["image"]["relative_rmse"], rel=0.15)


def test_another_light_and_its_rotation_reach_both_sides(room, tmp_path):
    """Result and reference are lit by the same turned map: unbiased, and not what the map gives unturned."""
    pixels = np.full((16, 32, 3), 0.1, np.float32)
    pixels[3:7, 2:8] = 5
    reports = [
        mi_prt.compare(room, tmp_path / str(i), light=pixels, rotate=rotate, scene=lit_room(), spp=64)
        for i, rotate in enumerate([None, ("y", 140)])
    ]
    assert all(abs(report["points"]["bias"]) < 0.02 for report in reports)
    images = [read(tmp_path / str(i) / "reference.exr") for i in range(2)]
    assert metrics.relative_rmse(*images) > 0.1


def test_errors_of_known_arrays():
    """By hand: ‖(1, −1)‖/‖(3, 4)‖ = √2/5; sums 7 and 7 have no bias; a tenth of grey in all pixels is 20 dB."""
    assert metrics.relative_rmse([4.0, 3.0], [3.0, 4.0]) == pytest.approx(2**0.5 / 5)
    assert metrics.relative_bias([4.0, 3.0], [3.0, 4.0]) == 0
    assert metrics.relative_bias([2.0], [4.0]) == -0.5
    grey = np.full((4, 4, 3), 0.5)
    assert metrics.psnr(grey + 0.1, grey) == pytest.approx(20)
    assert metrics.psnr(grey, grey) == float("inf")
    assert metrics.flip(grey, grey)[0] == pytest.approx(0, abs=1e-6)
