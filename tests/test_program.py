"""The program in its surroundings: signals, full and narrow terminals, odd paths. Each ends in one
clear line and an exit code.
"""

import errno
import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

import mi_prt
from mi_prt.cli import main
from mi_prt.cli.show import printable
from mi_prt.errors import AssetError, InputError, LightError, SceneError, SettingsError
from mi_prt.system import files, starting

ROOT = Path(__file__).resolve().parent.parent
SCENE = """<scene version="3.0.0"><shape type="sphere"/><emitter type="constant"/>
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="32"/><integer name="height" value="24"/></film>
<transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform></sensor>
</scene>"""
SETTINGS = {"directions": "cubemap:4", "coefficients": 4, "edge_length": 1.0}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def asset(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("asset") / "a.prt"
    mi_prt.precompute(scene, **SETTINGS).save(path)
    return path


def environment(**variables):
    return os.environ | {"PYTHONPATH": str(ROOT)} | variables


def start(*arguments, **rest):
    """The program in a process of its own."""
    command = [sys.executable, "-m", "mi_prt", *map(str, arguments)]
    return subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True, **rest)


def wait_until(condition, process):
    end = time.monotonic() + 60
    while not condition():
        assert process.poll() is None and time.monotonic() < end, process.stderr.read()
        time.sleep(0.005)


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as exit:
        main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return exit.value.code or 0, captured.out, captured.err


def one_line(err):
    """Whether stderr is one line of the program (and the empty one of a bar that has not begun)."""
    return err.count("\n") <= 2 and err.strip("\n").count("\n") == 0 and "mi-prt: " in err


# --- signals --------------------------------------------------------------------------------------


@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="asks Linux what is loaded")
@pytest.mark.parametrize("library", ["_multiarray_umath", "libmitsuba"])
def test_interrupted_while_it_starts(scene, library):
    """Ctrl-C at stages of the imports, told by what the process has loaded."""
    process = start("info", scene)
    maps = Path(f"/proc/{process.pid}/maps")
    wait_until(lambda: library in maps.read_text(), process)
    process.send_signal(signal.SIGINT)
    err = process.communicate(timeout=60)[1]
    assert (process.returncode, err) == (130, "mi-prt: interrupted\n")


def test_only_the_program_handles_ctrl_c():
    """A session that imports mi_prt keeps its own handler."""
    code = (
        "import signal; before = signal.getsignal(signal.SIGINT); import mi_prt;"
        " print(signal.getsignal(signal.SIGINT) is before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment(), capture_output=True, text=True
    )
    assert done.stdout == "True\n"


@pytest.mark.parametrize(
    ("name", "original", "expected"),
    [
        ("/usr/bin/mi-prt", ["python", "/usr/bin/mi-prt"], True),
        ("mi-prt.exe", ["mi-prt.exe"], True),
        ("-m", ["python", "-m", "mi_prt", "info"], True),
        ("-m", ["python", "-m", "pytest"], False),
        ("/x/mi_prt/__main__.py", ["python", "-m", "mi_prt"], True),
        ("/x/other/__main__.py", ["python", "-m", "other"], False),
        ("-c", ["python", "-c", "…"], False),
    ],
)
def test_the_program_is_told_from_a_session(monkeypatch, name, original, expected):
    monkeypatch.setattr(sys, "argv", [name])
    monkeypatch.setattr(sys, "orig_argv", original)
    assert starting.is_program() is expected


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_leaves_no_half_written_file(asset, tmp_path, name):
    """A film is written for as long as its frames take: signalled while its temporary file is
    there, nothing is left.
    """
    if not hasattr(signal, name):
        pytest.skip("no such signal here")
    process = start(
        *("relight", asset, "-o", tmp_path / "film.mp4", "--frames", "100000"),
        *("--light", "point:3,3,3:9", "--light-path", "3,3,3 -3,3,3", "--renderer", "mitsuba"),
        *("--spp", "1"),
    )
    wait_until(lambda: any(p.suffix == ".part" for p in tmp_path.iterdir()), process)
    process.send_signal(number := getattr(signal, name))
    err = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + number and "Traceback" not in err
    assert "nothing is left half-written" in err
    assert not any(tmp_path.iterdir())


# --- terminals ------------------------------------------------------------------------------------


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
@pytest.mark.parametrize("arguments", [("info", "{asset}"), ("-h",)])
def test_a_full_output_is_said(asset, arguments):
    with open("/dev/full", "w") as full:
        process = start(*(a.format(asset=asset) for a in arguments), stdout=full)
        err = process.communicate(timeout=60)[1]
    assert process.returncode == 1
    assert err.count("\n") == 1 and "No space left" in err and err.startswith("mi-prt: ")


def test_a_reader_that_goes_is_no_error(asset):
    """`mi-prt info … | head -0`: no traceback."""
    read, write = os.pipe()
    os.close(read)
    process = start("info", asset, stdout=write)
    os.close(write)
    assert process.communicate(timeout=60)[1] == "" and process.returncode == 1


@pytest.mark.parametrize(
    ("variables", "what"), [({"PYTHONIOENCODING": "ascii"}, "info"), ({"LC_ALL": "C"}, "help")]
)
def test_a_terminal_of_ascii(asset, tmp_path, variables, what):
    """A recorded path with letters of its own, and help with … and ², are shown as far as they
    can be.
    """
    (tmp_path / "szene_ä_→.xml").write_text(SCENE)
    mi_prt.precompute(tmp_path / "szene_ä_→.xml", **SETTINGS).save(tmp_path / "a.prt")
    arguments = ("info", str(tmp_path / "a.prt")) if what == "info" else ("relight", "--help")
    done = subprocess.run(
        [sys.executable, "-m", "mi_prt", *arguments],
        env=environment(**variables),
        capture_output=True,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    shown = done.stdout.decode("ascii" if "PYTHONIOENCODING" in variables else "utf-8")
    assert ("szene_" if what == "info" else "--light-path") in shown


# --- paths ----------------------------------------------------------------------------------------


def test_control_characters_are_shown_as_escapes(tmp_path, capsys):
    """A recorded path that would clear the terminal and colour it; names of lights and shapes
    come from the scene too.
    """
    folder = tmp_path / "a\x1b[2J\x1b[31m\rb\nc"
    folder.mkdir()
    (folder / "scene.xml").write_text(
        SCENE.replace('type="constant"', 'type="constant" id="a\u009bb"')
    )
    mi_prt.precompute(folder / "scene.xml", **SETTINGS).save(folder / "a.prt")
    code, out, err = run(capsys, "info", folder / "a.prt")
    assert code == 0 and r"a\x1b[2J\x1b[31m\rb\nc" in out
    (folder / "scene.xml").unlink()
    code, out2, err = run(capsys, "relight", folder / "a.prt", "-o", tmp_path / "a.png")
    assert code == 2 and one_line(err)
    code, out3, err2 = run(capsys, "relight", folder / "none.prt", "-o", tmp_path / "a.png")
    assert code == 2 and one_line(err2) and r"\x1b[2J" in err2
    for text in (out, out2, out3, err, err2):
        assert all(c.isprintable() or c == "\n" for c in text)
    code, out, _ = run(capsys, "info", folder / "a.prt", "--json")
    assert json.loads(out)["scene"]["path"] == str(folder / "scene.xml")
    assert printable("ä → 𝄞 ²\t\u202e\ud800") == r"ä → 𝄞 ²\t\u202e\ud800"


LONG = "x" * 300


@pytest.mark.parametrize("odd", ["long", "longer", "loop", "inside a file", "inside a loop"])
def test_odd_paths_are_refused_in_one_line(scene, asset, tmp_path, capsys, odd):
    """Names too long for a file or for all, loops of links: as scene, asset, map, output and folder
    of a report.
    """
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    path = {
        "long": tmp_path / LONG,
        "longer": Path("/".join([str(tmp_path), *["y" * 200] * 30])),
        "loop": tmp_path / "loop",
        "inside a file": scene / "a.prt",
        "inside a loop": tmp_path / "loop" / "a.prt",
    }[odd]
    for arguments in (
        ("precompute", path, "-o", tmp_path / "a.prt"),
        ("info", path),
        ("relight", path, "-o", tmp_path / "a.npz"),
        ("relight", asset, "-o", tmp_path / "a.npz", "--envmap", path),
        ("relight", asset, "-o", tmp_path / "a.png", "--scene", path),
        ("precompute", scene, "-o", path),
        ("relight", asset, "-o", path.with_name(path.name + ".npz") if odd != "loop" else path),
        ("compare", asset, "-o", path),
    ):
        code, _, err = run(capsys, *arguments)
        assert code == 2 and one_line(err), (arguments, err)


@pytest.mark.parametrize("reason", [errno.EACCES, errno.EIO, errno.ESTALE])
def test_what_cannot_be_reached_is_a_typed_error(tmp_path, monkeypatch, reason):
    """A folder that may not be entered; root may enter all, so the system's answer is put in."""
    truly, hidden = os.stat, tmp_path / "hidden"

    def answer(path, *rest, **named):
        if str(path).startswith(str(hidden)):
            raise OSError(reason, os.strerror(reason), str(path))
        return truly(path, *rest, **named)

    monkeypatch.setattr(os, "stat", answer)
    said = os.strerror(reason)
    with pytest.raises(SceneError, match=said):
        mi_prt.precompute(hidden / "scene.xml")
    with pytest.raises(AssetError, match=said):
        mi_prt.load(hidden / "a.prt")
    with pytest.raises(LightError, match=said):
        mi_prt.EnvironmentMap(hidden / "sky.exr")
    with pytest.raises(SettingsError, match=said):
        files.check_writable(hidden / "a.png")
    with pytest.raises(InputError):
        files.check_writable(hidden)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read all")
def test_unreadable_files_and_folders(tmp_path, capsys):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "scene.xml").chmod(0)
    assert run(capsys, "info", tmp_path / "scene.xml")[0] == 2
    (tmp_path / "closed").mkdir(mode=stat.S_IWUSR)
    assert run(capsys, "info", tmp_path / "closed" / "scene.xml")[0] == 2


def test_what_nobody_expected_is_one_line_too(monkeypatch, capsys):
    """An error of the system that no code names ends without a traceback."""

    def fail():
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), "/some/file")

    monkeypatch.setattr("mi_prt.system.doctor.examine", fail)
    code, _, err = run(capsys, "doctor")
    assert code == 2 and err == "mi-prt: '/some/file' cannot be used: Too many open files\n"
