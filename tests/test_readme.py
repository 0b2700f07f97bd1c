"""The README's section on meshes, cameras and many maps does what it says."""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import mi_prt
from mi_prt.cli import main

ROOT = Path(__file__).resolve().parent.parent
SECTION = "### Meshes, cameras, many maps"
FAST = {"directions": "cubemap:4", "coefficients": "16", "bounces": "0", "edge_length": "9.0"}


def blocks(language):
    section = (ROOT / "README.md").read_text().split(SECTION)[1].split("\n### ")[0]
    return re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A place like the project's folder, to be written into."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_its_commands_run(folder):
    """Coarsely and in small pictures, to be quick."""
    fast = [x for name, value in FAST.items() for x in ("--" + name.replace("_", "-"), value)]
    small = {"precompute": fast, "relight": ["--size", "16x12", "--spp", "1"]}
    for line in blocks("sh")[0].splitlines():
        program, command, *rest = shlex.split(line, comments=True)
        assert program == "mi-prt"
        with pytest.raises(SystemExit) as left:
            main([command, *rest, *small[command]])
        assert not left.value.code, line
    written = {path.name for path in folder.glob("*.png")}
    assert written == {"ring.png", "ring_sky_noon.png", "ring_sky_evening.png"}


def test_its_python_runs(folder, monkeypatch):
    whole = mi_prt.precompute
    settings = FAST | {"coefficients": 20, "bounces": 0}
    monkeypatch.setattr(mi_prt, "precompute", lambda *given: whole(*given, **settings))
    names = {}
    exec(blocks("python")[0], names)
    assert names["image"].shape == (240, 320, 3) and names["image"].mean() > 0
    assert len(mi_prt.load("small.prt").transports["distant"].basis) == 16
    assert os.path.getsize("small.prt") > 0


def test_turning_a_map_for_a_scene_whose_up_is_z():
    """What was at the top of the map, +y, then comes from +z."""
    pixels = np.zeros((5, 8, 3), np.float32)
    pixels[0] = 1
    turned = mi_prt.EnvironmentMap(pixels).rotated("x", 90)
    np.testing.assert_allclose(turned.at(np.array([[0, 0, 1.0], [0, 1.0, 0]]))[:, 0], (1, 0))
