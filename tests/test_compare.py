"""Comparing with ground truth: which truth, and that errors are those of the pictures."""

import numpy as np
import OpenEXR
import pytest
from conftest import cube, rectangle, scene

import mi_prt
from mi_prt.evaluate import metrics
from mi_prt.system.runtime import mitsuba

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
    """Of distant light alone: the bulb is left out."""
    return mi_prt.precompute(
        lit_room(), transports="distant", directions="cubemap:16", edge_length=0.2
    )


def known_errors(report):
    """What the report knows of reflected light's errors, by what makes them."""
    return {entry["stage"]: entry["value"] for entry in report["ledger"]}


@pytest.fixture(scope="module")
def whole(room, tmp_path_factory):
    """The comparison with any number of reflections: the report and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    return mi_prt.compare(room, folder, scene=lit_room(), spp=64), folder


def test_the_reference_is_the_scene_as_modelled_or_as_written(room, whole, tmp_path):
    """As modelled the bulb is dark and the plastic diffuse, so the result is right; as written it
    lacks their light.

    The bulb gives the floor about as much irradiance as a third of the sky's π, far more than the
    tolerance of 2 %.
    """
    reports = {
        "modelled": whole[0],
        "full": mi_prt.compare(room, tmp_path / "full", scene=lit_room(), spp=64, reference="full"),
    }
    for name, report in reports.items():
        assert report["reference"] == name
        assert {"RoughPlastic", "PointLight"} <= {
            entry["what"].split(":")[0] for entry in report["left_out"]
        }
    assert abs(reports["modelled"]["points"]["bias"]) < 0.02
    assert abs(reports["modelled"]["image"]["bias"]) < 0.03
    assert reports["full"]["points"]["bias"] < -0.1
    assert reports["full"]["image"]["bias"] < -0.1
    assert "in the reference, not in the result" in (tmp_path / "full" / "index.html").read_text()


@pytest.mark.parametrize(("bounces", "indirect"), [(0, "solve"), (1, "solve"), (1, "paths")])
def test_the_reference_has_the_reflections_that_were_asked_for(whole, tmp_path, bounces, indirect):
    """Then the result is right, by the tolerances of above, and the report says what both sides
    have. Of the picture's light the reflections are 3.6 %, and those after the first 0.5 %; five
    renders with other seeds differ by 0.06 %.
    """
    settings = dict(
        transports="distant",
        directions="cubemap:16",
        edge_length=0.2,
        bounces=bounces,
        indirect=indirect,
        paths_per_point=256,
    )
    report = mi_prt.compare(
        mi_prt.precompute(lit_room(), **settings), tmp_path, scene=lit_room(), spp=64
    )
    assert report["transports"]["distant"]["bounces"] == report["reference_bounces"] == bounces
    assert "distant: bounces" not in known_errors(report)
    most, folder = whole
    assert most["transports"]["distant"]["bounces"] > 1
    assert most["reference_bounces"] == "any number"
    assert 0 < known_errors(most)["distant: bounces"] < 1e-3
    assert ("distant: rays" in known_errors(report)) == (bounces > 0)
    noise = known_errors(report).get("distant: rays", 0)
    assert noise < (0.02 if indirect == "solve" else 0.1)
    assert abs(report["points"]["bias"]) < 0.02 and abs(report["image"]["bias"]) < 0.03
    less = np.sum(read(tmp_path / "reference.exr")) / np.sum(read(folder / "reference.exr")) - 1
    assert less < (-0.03 if bounces == 0 else -0.003)
    assert ("distant: rays" in (tmp_path / "index.html").read_text()) == (bounces > 0)


def test_buried_points_are_not_compared(room, whole):
    """No picture shows them, and they have no light of their own: 64 of the points, on the floor
    under the box.
    """
    report, _ = whole
    assert (
        room.buried.sum() > 40
        and report["points"]["count"] == len(room.points) - room.buried.sum() < 4096
    )


def test_reported_errors_are_those_of_the_pictures(whole):
    """The EXRs it leaves give the reported relative RMSE; pixels that no surface covers do not
    count.
    """
    report, folder = whole
    result, reference = read(folder / "result.exr"), read(folder / "reference.exr")
    # the background is exactly the sky's radiance of 1
    sky = np.abs(reference - 1).max(axis=2) < 1e-6
    assert 0.1 < sky.mean() < 0.9
    # the background adds no error
    assert metrics.relative_rmse(result, reference) < report["image"]["relative_rmse"] + 1e-6
    inside = ~(
        sky | np.roll(sky, 1, 0) | np.roll(sky, -1, 0) | np.roll(sky, 1, 1) | np.roll(sky, -1, 1)
    )
    assert metrics.relative_rmse(result[inside], reference[inside]) == pytest.approx(
        report["image"]["relative_rmse"], rel=0.15
    )


def test_another_light_and_its_rotation_reach_both_sides(room, tmp_path):
    """Result and reference are lit by the same turned map: unbiased, and not what the map gives
    unturned.
    """
    pixels = np.full((16, 32, 3), 0.1, np.float32)
    pixels[3:7, 2:8] = 5
    reports = [
        mi_prt.compare(
            room, tmp_path / str(i), light=pixels, rotate=rotate, scene=lit_room(), spp=64
        )
        for i, rotate in enumerate([None, ("y", 140)])
    ]
    assert all(abs(report["points"]["bias"]) < 0.02 for report in reports)
    images = [read(tmp_path / str(i) / "reference.exr") for i in range(2)]
    assert metrics.relative_rmse(*images) > 0.1


def test_errors_of_known_arrays():
    """By hand: ‖(1, −1)‖/‖(3, 4)‖ = √2/5; sums 7 and 7 have no bias; a tenth of grey in all pixels
    is 20 dB.
    """
    assert metrics.relative_rmse([4.0, 3.0], [3.0, 4.0]) == pytest.approx(2**0.5 / 5)
    assert metrics.relative_bias([4.0, 3.0], [3.0, 4.0]) == 0
    assert metrics.relative_bias([2.0], [4.0]) == -0.5
    grey = np.full((4, 4, 3), 0.5)
    assert metrics.psnr(grey + 0.1, grey) == pytest.approx(20)
    assert metrics.psnr(grey, grey) == float("inf")
    assert metrics.flip(grey, grey)[0] == pytest.approx(0, abs=1e-6)
