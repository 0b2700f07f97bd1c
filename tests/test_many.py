"""Several maps and sensors in one run of `mi-prt relight`, and cameras on the command line."""

import json

import numpy as np
import OpenEXR
import pytest
from small_assets import SCENE

import mi_prt
from mi_prt.cli import main
from mi_prt.output.many import map_files

SENSOR = """<sensor type="perspective">
    <transform name="to_world"><lookat origin="{}" target="0, 0.5, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
  </sensor>"""
SETTINGS = {
    "transports": "distant,own",
    "edge_length": 9.0,
    "directions": "cubemap:4",
    "coefficients": 4,
    "bounces": 0,
    "lamp_rays": 16,
}
CAMERA = "0,2,4:0,0.5,0:39.3"


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as left:
        main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return left.value.code or 0, out, err


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An asset of a scene with two sensors, and a folder of two maps."""
    folder = tmp_path_factory.mktemp("many")
    sensors = SENSOR.format("0, 2, 4") + SENSOR.format("4, 2, 0")
    (folder / "scene.xml").write_text(SCENE.replace("</scene>", sensors + "</scene>"))
    mi_prt.precompute(folder / "scene.xml", **SETTINGS).save(folder / "a.prt")
    (folder / "skies").mkdir()
    for name, value in (("dim", 0.5), ("white", 1.0)):
        file = OpenEXR.File({}, {"RGB": np.full((4, 8, 3), value, np.float32)})
        file.write(str(folder / "skies" / f"{name}.exr"))
    (folder / "skies" / "notes.txt").write_text("no map")
    return folder


def test_maps_times_sensors(folder, capsys):
    """A file for each; a map of half the radiance gives half the light."""
    arguments = ["relight", folder / "a.prt", "--spp", "1", "--json", "--envmap", folder / "skies"]
    pattern = folder / "{map}_{sensor}.exr"
    code, out, err = run(capsys, *arguments, "-o", pattern, "--sensor", "all")
    assert code == 0, err
    files = json.loads(out)["files"]
    assert [file["sensor"] for file in files] == [0, 1, 0, 1]
    names = ["dim_0", "dim_1", "white_0", "white_1"]
    assert [file["file"] for file in files] == [str(folder / f"{name}.exr") for name in names]
    assert all((folder / f"{name}.exr").stat().st_size for name in names)
    code, *_ = run(capsys, *arguments, "-o", folder / "{map}.npz")
    dim, white = (np.load(folder / f"{name}.npz")["irradiance"] for name in ("dim", "white"))
    assert code == 0 and white.max() > 0
    np.testing.assert_allclose(dim, white / 2, rtol=1e-5)


def test_lights_shine_under_every_map(folder, capsys):
    maps = [x for name in ("dim", "white") for x in ("--envmap", folder / "skies" / f"{name}.exr")]
    arguments = [folder / "a.prt", "-o", folder / "lit_{map}.npz", *maps, "--light", "scene:bulb"]
    assert run(capsys, "relight", *arguments)[0] == 0
    asset = mi_prt.load(folder / "a.prt")
    expected = asset.irradiance([np.ones((2, 4, 3)), asset.own_lights["bulb"]])
    found = np.load(folder / "lit_white.npz")["irradiance"]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_a_camera_on_the_command_line(folder, capsys):
    shown = ["--camera", CAMERA, "--size", "8x6", "--envmap", folder / "skies" / "white.exr"]
    picture = folder / "by_camera.exr"
    code, _, err = run(capsys, "relight", folder / "a.prt", "-o", picture, *shown, "--spp", "16")
    assert code == 0, err
    with OpenEXR.File(str(picture), separate_channels=True) as file:
        seen = np.stack([file.channels()[c].pixels for c in "RGB"], axis=-1)
    asset = mi_prt.load(folder / "a.prt")
    expected = asset.render(folder / "skies" / "white.exr", spp=16)  # the first sensor's place
    np.testing.assert_allclose(seen.mean(), expected.mean(), rtol=0.05)
    # in eight by six pixels, none is surface alone
    shown[3] = "32x24"
    code, out, err = run(
        capsys, "compare", folder / "a.prt", "-o", folder / "r", *shown, "--spp", "2", "--json"
    )
    assert code == 0 and json.loads(out)["image"], err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("-o", "{folder}/x.exr", "--sensor", "all"), "x_{sensor}.exr"),
        (("-o", "{folder}/x.npz", "--envmap", "{folder}/skies"), "x_{map}.npz"),
        (("-o", "{folder}/x.exr", "--sensor", "first"), "or all, got 'first'"),
        (("-o", "{folder}/x.exr", "--sensor", "2"), "sensors 0…1"),
        (("-o", "{folder}/x.exr", "--sensor", "1", "--camera", CAMERA), "give one of them"),
        (("-o", "{folder}/x.exr", "--camera", "1,2,3"), "0,2,6:0,0.5,0:45"),
        (
            (
                "-o",
                "{folder}/{map}.npz",
                "--envmap",
                "{folder}/skies",
                "--envmap",
                "{folder}/skies/dim.exr",
            ),
            "rename one",
        ),
        (
            ("-o", "{folder}/x.gif", "--envmap", "{folder}/skies", "--light-path", "0,1,0 1,1,1"),
            "one film",
        ),
    ],
)
def test_what_cannot_be_shown(folder, capsys, arguments, said):
    told = [a.replace("{folder}", str(folder)) for a in arguments]
    code, _, err = run(capsys, "relight", folder / "a.prt", *told)
    assert code == 2 and said in err


def test_compare_takes_one_sensor(folder, capsys):
    code, _, err = run(capsys, "compare", folder / "a.prt", "-o", folder / "r", "--sensor", "all")
    assert code == 2 and "give an index" in err


def test_a_folder_without_maps(tmp_path):
    with pytest.raises(mi_prt.LightError, match=r"\.exr, \.hdr"):
        map_files([tmp_path])
