"""The command line: exact JSON keys, exit codes, one-line errors, files written."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import mi_prt
from mi_prt.asset.container import opened
from mi_prt.cli import main

SCENES = Path(__file__).resolve().parent.parent / "scenes"
FAST = ("--directions", "cubemap:8", "--coefficients", "16", "--edge-length", "0.2")


def run(capsys, *arguments):
    """Exit code, stdout and stderr of `mi-prt arguments` in this process."""
    with pytest.raises(SystemExit) as exit:
        main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return exit.value.code or 0, captured.out, captured.err


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A copy of the Cornell box, so that it may be moved and changed."""
    folder = tmp_path_factory.mktemp("scene")
    shutil.copytree(SCENES / "textures", folder / "textures")
    return Path(shutil.copy(SCENES / "cornell_sky.xml", folder / "box.xml"))


@pytest.fixture(scope="module")
def asset(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("asset") / "box.prt"
    mi_prt.precompute(scene, directions="cubemap:8", coefficients=16, edge_length=0.2).save(path)
    return path


@pytest.mark.parametrize(
    ("options", "bounces", "stages"),
    [
        ((), range(4, 20), {"indirect"}),
        (("--bounces", "2"), [2], {"indirect"}),
        (("--bounces", "0"), [0], {"coefficients"}),
        (
            ("--bounces", "1", "--indirect", "paths", "--paths-per-point", "16", "--no-denoise"),
            [1],
            {"indirect"},
        ),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, tuple) else "",
)
def test_precompute_prints_the_promised_keys_and_nothing_else_on_stdout(
    scene, tmp_path, capsys, options, bounces, stages
):
    """Without an option it is light after as many reflections as it takes: in a box of albedos of
    about a half more than four.
    """
    code, out, _ = run(
        capsys, "precompute", scene, "-o", tmp_path / "a.prt", *FAST, *options, "--json"
    )
    result = json.loads(out)
    assert code == 0
    assert set(result) == {
        "points",
        "kind_of_points",
        "transports",
        "bytes",
        "rays",
        "kernels",
        "peak_memory_bytes",
        "seconds",
    }
    assert (
        set(result["seconds"])
        == {"scene", "points", "transport", "basis", "distant", "write", "total"} | stages
    )
    assert result["kind_of_points"] == "vertices" and set(result["transports"]) == {"distant"}
    held = result["transports"]["distant"]
    assert set(held) == {
        "directions",
        "cells",
        "basis",
        "coefficients",
        "components",
        "bounces",
        "captured_variance",
        "relative_error",
    }
    assert held["bounces"] in bounces
    assert held["cells"] == 384 and held["coefficients"] == 16
    assert result["bytes"] == (tmp_path / "a.prt").stat().st_size
    assert result["rays"] == result["points"] * 384 // 2


@pytest.mark.parametrize("bounces", ["1", "3", "auto"])
def test_json_is_strict(tmp_path, capsys, bounces):
    """Between white walls there is no bound of what a few reflections leave out; and infinity is no
    JSON.
    """
    wall = """<shape type='rectangle'>
        <transform name='to_world'><translate z='-1'/><rotate {}/></transform>
        <bsdf type='diffuse'><rgb name='reflectance' value='1'/></bsdf></shape>"""
    walls = "".join(
        wall.format(f"{axis}='1' angle='{degrees}'")
        for axis, degrees in (("x", 0), ("x", 90), ("x", -90), ("y", 90), ("y", -90))
    )
    (tmp_path / "white.xml").write_text(
        f"""<scene version='3.0.0'>{walls}<emitter type='constant'/>
        <sensor type='perspective'><transform name='to_world'>
        <lookat origin='0.1,-0.3,3' target='0,0,0' up='0,0,1'/></transform></sensor></scene>"""
    )

    settings = ("--directions", "cubemap:4", "--edge-length", "1", "--bounces", bounces)

    def refuse(constant):
        raise AssertionError(constant)

    for arguments in (
        ("precompute", tmp_path / "white.xml", "-o", tmp_path / "a.prt", *settings),
        ("info", tmp_path / "white.xml", *settings),
        ("info", tmp_path / "a.prt"),
        ("compare", tmp_path / "a.prt", "-o", tmp_path / "r", "--size", "16x12", "--spp", "4"),
    ):
        code, out, _ = run(capsys, *arguments, "--json")
        assert code == 0
        json.loads(out, parse_constant=refuse)
    with opened(tmp_path / "a.prt") as file:
        json.dumps(file.header, allow_nan=False)
    page = (tmp_path / "r" / "index.html").read_text()
    causes = page.split("What makes the error")[1]
    assert "distant: basis" in causes and "inf" not in causes and "nan" not in causes


def test_relight_writes_every_format(asset, tmp_path, capsys):
    for name, extra in (
        ("a.exr", ()),
        ("a.png", ()),
        ("raster.png", ("--renderer", "raster")),
        ("a.ply", ()),
        ("a.npz", ("--rotate", "0,1,1:30")),
    ):
        code, out, _ = run(
            capsys,
            "relight",
            asset,
            "-o",
            tmp_path / name,
            "--size",
            "32x24",
            "--spp",
            "4",
            "--json",
            *extra,
        )
        result = json.loads(out)
        assert code == 0 and set(result) == {"points", "exposure", "seconds"}
        assert set(result["seconds"]) == {"relight", "render"}
        assert (tmp_path / name).stat().st_size > 100
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert file.channels()["RGB"].pixels.shape == (24, 32, 3)
    assert set(np.load(tmp_path / "a.npz")) >= {"positions", "irradiance", "radiance"}


def test_turning_the_light_once_round_changes_nothing_and_half_way_does(asset, tmp_path, capsys):
    """A rotation by 360 degrees is the identity; the box is open to one side, so 180 degrees is
    not.
    """
    radiance = {}
    for degrees in (0, 180, 360):
        run(capsys, "relight", asset, "-o", tmp_path / "a.npz", "--rotate", f"y:{degrees}")
        radiance[degrees] = np.load(tmp_path / "a.npz")["radiance"]
    assert np.linalg.norm(radiance[360] - radiance[0]) < 1e-3 * np.linalg.norm(radiance[0])
    assert np.linalg.norm(radiance[180] - radiance[0]) > 0.1 * np.linalg.norm(radiance[0])


def test_compare_prints_the_promised_keys_and_leaves_a_report(asset, tmp_path, capsys):
    code, out, _ = run(
        capsys, "compare", asset, "-o", tmp_path / "r", "--size", "64x48", "--spp", "32", "--json"
    )
    result = json.loads(out)
    assert code == 0
    assert set(result["points"]) >= {"count", "relative_rmse", "bias", "reference_noise"}
    assert set(result["image"]) >= {"relative_rmse", "bias", "psnr", "flip", "reference_noise"}
    assert set(result["seconds"]) == {"relight", "reference"}
    assert result["reference"] == "modelled"
    assert result["transports"]["distant"]["bounces"] > 4
    assert result["reference_bounces"] == "any number"
    # what is known of errors: of the basis, of rays' noise, and of reflections left out
    known = {entry["stage"]: entry["value"] for entry in result["ledger"]}
    assert set(known) == {"distant: basis", "distant: rays", "distant: bounces"}
    assert 0 < known["distant: bounces"] < 1e-3 and 0 < known["distant: rays"] < 0.02
    names = {path.name for path in (tmp_path / "r").iterdir()}
    assert names == {
        "report.json",
        "index.html",
        "result.exr",
        "reference.exr",
        "result.png",
        "reference.png",
        "error.png",
        "flip.png",
        "side_by_side.png",
    }
    assert json.loads((tmp_path / "r" / "report.json").read_text()) == result
    page = (tmp_path / "r" / "index.html").read_text()
    assert "{" not in page.split("</style>")[1] and "modelled" in page
    assert "reflections after the last one" in page and "the setting coefficients lowers it" in page


def test_info_of_a_scene_and_of_an_asset(scene, asset, capsys):
    code, out, _ = run(capsys, "info", scene, "--directions", "cubemap:4", "--json")
    result = json.loads(out)
    assert code == 0
    assert set(result) == {"requires", "lights", "settings", "left_out", "predicted"}
    predicted = result["predicted"]
    assert set(predicted) == {"seconds", "peak_memory_bytes", "bytes", "transports"}
    assert set(predicted["transports"]) == {"distant"}
    assert set(predicted["transports"]["distant"]) == {
        "seconds",
        "bytes",
        "relighting_bytes",
        "projection_bytes",
    }
    assert all({"value", "reason"} == set(entry) for entry in result["settings"].values())
    # the scene has a sky and nothing else; settings of what is not built are not there
    assert [light["distant"] for light in result["lights"]] == [True]
    assert result["settings"]["transports"]["value"] == "distant"
    assert "lamp_rays" not in result["settings"] and "count" not in result["settings"]
    assert result["settings"]["bounces"]["value"] == "auto"
    code, out, _ = run(capsys, "info", asset, "--json")
    held = json.loads(out)
    distant = held["transports"]["distant"]
    report = distant["report"]
    assert code == 0 and distant["coefficients"] == 16
    assert distant["bounces"] == report["bounces"] > 4 and report["channels"] == 3
    energy = report["bounce_energy"]
    # Each reflection keeps less than the largest albedo of the light.
    assert len(energy) == distant["bounces"] + 1 and all(
        0 < after < 0.9 * before for before, after in pairwise(energy[1:])
    )
    assert 0 < report["bounce_energy_left"] < 2e-3 * sum(energy)
    chosen = held["settings"]
    assert [chosen[name] for name in ("bounces", "indirect", "paths_per_point", "denoise")] == [
        None,
        "solve",
        "auto",
        True,
    ]
    assert held["lights"] == result["lights"] and held["bytes"] == asset.stat().st_size
    predicted = result["requires"]["bounce_energy"]
    assert predicted[0] == pytest.approx(energy[0], rel=0.1) and predicted[1] == pytest.approx(
        energy[1], rel=0.3
    )


def test_info_names_lights_and_says_what_they_call_for(capsys):
    """A room with a window and three lamps: its sky and its lamps are built, with the reason."""
    arguments = ("info", SCENES / "day_room.xml", "--edge-length", "1", "--directions", "cubemap:4")
    code, out, _ = run(capsys, *arguments, "--json")
    found = json.loads(out)
    assert code == 0
    names = {light["name"]: light["distant"] for light in found["lights"]}
    assert names == {"sky": True, "ceiling_lamp": False, "floor_lamp": False, "desk_lamp": False}
    chosen = found["settings"]["transports"]
    assert chosen["value"] == "distant,own" and "3 lamps" in chosen["reason"]
    assert found["left_out"] == []
    predicted = found["predicted"]
    assert set(predicted["transports"]) == {"distant", "own"}
    assert all(part["seconds"] >= 0 for part in predicted["transports"].values())
    code, out, _ = run(capsys, *arguments)
    assert code == 0 and "name ceiling_lamp" in out and "3 lamps" in out


@pytest.mark.parametrize("command", ["doctor", "info", "precompute", "relight", "compare"])
def test_help_is_whole(command, capsys):
    """What stands in brackets is shown, not taken for markup, and forms of lights are not cut."""
    code, out, _ = run(capsys, command, "--help")
    words = " ".join(out.replace("│", " ").split())
    assert code == 0 and f"mi-prt {command}" in words and "…" not in words.replace("x,y,z …", "")
    if command in ("info", "precompute"):
        assert "[auto: until 0.1 % is left; with the bases haar and none: 0]" in words
        assert "[auto]" in words and "[cubemap:32]" in words
    if command in ("relight", "compare"):
        assert "spot:x,y,z:dx,dy,dz:r,g,b[:cutoff[:beam]]" in words


def test_what_info_predicts_is_what_precompute_needs(scene, tmp_path, capsys):
    """Points and rays are counted, not guessed, so they agree exactly; bytes to 20 % (the
    container's own overhead).
    """
    _, out, _ = run(capsys, "info", scene, *FAST, "--json")
    predicted = json.loads(out)
    _, out, _ = run(capsys, "precompute", scene, "-o", tmp_path / "a.prt", *FAST, "--json")
    found = json.loads(out)
    assert predicted["requires"]["points"] == found["points"]
    assert predicted["requires"]["rays"] == found["rays"]
    assert predicted["predicted"]["bytes"] == pytest.approx(found["bytes"], rel=0.2)


def test_same_seed_same_file(scene, tmp_path, capsys):
    files = []
    for name in ("a.prt", "b.prt"):
        run(capsys, "precompute", scene, "-o", tmp_path / name, *FAST, "--seed", "3")
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("precompute", "missing.xml", "-o", "x.prt"), "does not exist"),
        (("precompute", "{broken}", "-o", "x.prt"), "Mitsuba rejects"),
        (("precompute", "{empty}", "-o", "x.prt"), "no shapes"),
        (("precompute", "{scene}", "-o", "missing/x.prt"), "does not exist"),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--coefficients", "99999"),
            "at most 6144",
        ),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--directions", "cubemap:0"),
            "outside 1…512",
        ),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "--directions", "ball:3"), "cubemap:N"),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--edge-length", "short"),
            "neither 'auto'",
        ),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "--rays-per-direction", "0"), "1…64"),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--bounces", "many"),
            "bounces must be an integer or auto, got 'many'",
        ),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--bounces", "-1"),
            "bounces must be 0…10,000 or auto",
        ),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--bounces", "1", "--basis", "haar"),
            "direct transport only",
        ),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--indirect", "photons"),
            "solve or paths",
        ),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--paths-per-point", "3"),
            "even number",
        ),
        (
            ("precompute", "{scene}", "-o", "{folder}/x.prt", "--paths-per-point", "few"),
            "paths per point must be an integer or auto, got 'few'",
        ),
        (("info", "{scene}", "--bounces", "2.5"), "bounces must be an integer or auto, got '2.5'"),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "--threads", "0"), "threads"),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "-D", "nonsense"), "NAME=VALUE"),
        (("relight", "missing.prt", "-o", "{folder}/x.png"), "does not exist"),
        (("relight", "{scene}", "-o", "{folder}/x.png"), "no mi_prt asset"),
        (("relight", "{old}", "-o", "{folder}/x.png"), "older version of mi_prt"),
        (("relight", "{truncated}", "-o", "{folder}/x.png"), "truncated"),
        (("relight", "{foreign}", "-o", "{folder}/x.png"), "no mi_prt asset"),
        (("relight", "{asset}", "-o", "{folder}/x.jpg"), ".exr, .npz, .ply, .png"),
        (("relight", "{folder}", "-o", "{folder}/x.png"), "is a folder"),
        (("compare", "{fifo}", "-o", "{folder}/c"), "is a fifo"),
        (("info", "{fifo}"), "is no regular file"),
        (("info", "{folder}"), "is a folder"),
        (("info", "{old}"), "older version of mi_prt"),
        (("precompute", "{folder}", "-o", "{folder}/x.prt"), "is a folder"),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "--lamp-rays", "8"), "transport own"),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "--transports", "own"), "no lamps"),
        (("precompute", "{scene}", "-o", "{folder}/x.prt", "--transports", "sky"), "own, local"),
        (
            ("info", "{scene}", "--points", "samples", "--edge-length", "1"),
            "points vertices, and these are samples",
        ),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--light", "scene:nobody"), "it has sky_1"),
        (("compare", "{asset}", "-o", "{folder}/c", "--light", "scene:nobody"), "it has sky_1"),
        (("relight", "{asset}", "-o", "{folder}/x.npz", "--light", "scene*x"), "not of the form"),
        (("relight", "{asset}", "-o", "{folder}/x.npz", "--light", "sun:1"), "no known kind"),
        (("relight", "{asset}", "-o", "{folder}/x.npz", "--component", "direct"), "--keep-direct"),
        (("relight", "{asset}", "-o", "{folder}/x.npz", "--nearest", "0"), "integer ≥ 1"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--spp", "0"), "spp must be 1…"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--frames", "3"), "--light-path"),
        (
            ("relight", "{asset}", "-o", "{folder}/x.gif", "--light-path", "0,0,0 1,0,0"),
            "moves the first point, spot or area light",
        ),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--sensor", "7"), "sensors 0…0"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--size", "0x4"), "at least 1x1"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--size", "big"), "WxH"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--rotate", "y"), "AXIS:DEGREES"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--rotate", "0,0,0:3"), "no axis"),
        (
            ("relight", "{asset}", "-o", "{folder}/x.png", "--envmap", "missing.exr"),
            "does not exist",
        ),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--envmap", "{nan}"), "NaN or infinite"),
        (("relight", "{asset}", "-o", "{folder}/x.png", "--envmap", "{red_green}"), "lacks B"),
        (
            ("relight", "{asset}", "-o", "{folder}/x.png", "--envmap", "{negative}"),
            "negative pixels",
        ),
        (
            ("relight", "{asset}", "-o", "{folder}/x.png", "--renderer", "crayons"),
            "mitsuba, raster",
        ),
        (("compare", "{asset}", "-o", "{folder}/c", "--reference", "hearsay"), "modelled or full"),
        (("compare", "{asset}", "-o", "{asset}"), "cannot be written"),
        (
            ("compare", "{asset}", "-o", "{folder}/c", "--scene", "{other}"),
            "not the scene of the asset",
        ),
        (("relight",), "Missing argument"),
        (("frobnicate",), "No such command"),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(arguments, said, bad_inputs, capsys):
    code, out, err = run(capsys, *(a.format(**bad_inputs) for a in arguments))
    assert code == 2
    assert said in " ".join(err.split())
    assert out == "" and "Traceback" not in err
    if "Missing argument" not in said and "No such command" not in said:
        assert [line for line in err.splitlines() if line.strip()][-1].startswith("mi-prt: ")


@pytest.fixture(scope="module")
def bad_inputs(scene, asset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    (folder / "broken.xml").write_text("<scene version='3.0.0'><shape type='sphere'></scene>")
    (folder / "empty.xml").write_text("<scene version='3.0.0'><emitter type='constant'/></scene>")
    (folder / "other.xml").write_text(
        "<scene version='3.0.0'><shape type='sphere'/><emitter type='constant'/></scene>"
    )
    (folder / "truncated.prt").write_bytes(asset.read_bytes()[: asset.stat().st_size // 2])
    (folder / "old.prt").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(1000))
    header = b'{"x":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}'
    (folder / "foreign.prt").write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
    pixels = np.ones((8, 16, 3), np.float32)
    for name, value in (("nan", np.nan), ("negative", -1.0)):
        changed = pixels.copy()
        changed[3, 4] = value
        OpenEXR.File({}, {"RGB": changed}).write(str(folder / f"{name}.exr"))
    OpenEXR.File({}, {"R": pixels[..., 0], "G": pixels[..., 0]}).write(
        str(folder / "red_green.exr")
    )
    os.mkfifo(folder / "fifo")
    return {path.stem: path for path in folder.iterdir()} | {
        "scene": scene,
        "asset": asset,
        "folder": folder,
    }


def test_few_negative_pixels_are_counted_in_a_warning(asset, tmp_path, capsys):
    pixels = np.ones((64, 128, 3), np.float32)
    pixels[30, 4:7] = -1e-3
    OpenEXR.File({}, {"RGB": pixels}).write(str(tmp_path / "sky.exr"))
    code, _, err = run(
        capsys, "relight", asset, "-o", tmp_path / "a.npz", "--envmap", tmp_path / "sky.exr"
    )
    assert code == 0 and "3 negative pixels" in err


def test_a_scene_without_light_needs_a_map(tmp_path, capsys):
    (tmp_path / "dark.xml").write_text("<scene version='3.0.0'><shape type='sphere'/></scene>")
    assert run(capsys, "precompute", tmp_path / "dark.xml", "-o", tmp_path / "a.prt", *FAST)[0] == 0
    code, _, err = run(capsys, "relight", tmp_path / "a.prt", "-o", tmp_path / "a.npz")
    assert code == 2 and "no light of its own" in err
    OpenEXR.File({}, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(tmp_path / "sky.exr"))
    assert (
        run(
            capsys,
            "relight",
            tmp_path / "a.prt",
            "-o",
            tmp_path / "a.npz",
            "--envmap",
            tmp_path / "sky.exr",
        )[0]
        == 0
    )


def test_a_moved_scene_is_named_and_found_again(scene, tmp_path, capsys):
    moved = tmp_path / "moved"
    shutil.copytree(scene.parent, tmp_path / "here")
    run(capsys, "precompute", tmp_path / "here" / "box.xml", "-o", tmp_path / "a.prt", *FAST)
    (tmp_path / "here").rename(moved)
    code, _, err = run(capsys, "relight", tmp_path / "a.prt", "-o", tmp_path / "a.npz")
    assert code == 2 and "not there any more" in err and "--scene" in err
    code, _, _ = run(
        capsys,
        "relight",
        tmp_path / "a.prt",
        "-o",
        tmp_path / "a.npz",
        "--scene",
        moved / "box.xml",
    )
    assert code == 0


def test_interrupting_leaves_only_what_can_be_continued(scene, tmp_path):
    """SIGINT while rays are traced: exit code 130, no asset, no traceback, a word on how to go on;
    the folder of the run, from which it goes on.
    """
    command = [
        sys.executable,
        "-m",
        "mi_prt",
        "precompute",
        str(scene),
        "-o",
        str(tmp_path / "a.prt"),
    ]
    process = subprocess.Popen(
        [*command, "--rays-per-direction", "64"], stderr=subprocess.PIPE, text=True
    )
    partial, end = tmp_path / "a.prt.partial", time.monotonic() + 60
    while not (partial.exists() and any(partial.iterdir())) and time.monotonic() < end:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert [path.name for path in tmp_path.iterdir()] == ["a.prt.partial"]
    assert "interrupted" in err and "--resume continues" in err
    assert "Traceback" not in err
