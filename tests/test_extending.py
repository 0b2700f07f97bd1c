"""The four examples of docs/extending.md are what they claim: a basis, a light, a material and an
output format in one registration each, used through the command line.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import cube, diffuse, rectangle, relative_l2, scene

import mi_prt
from mi_prt.basis.basis import BASES
from mi_prt.cli import main
from mi_prt.evaluate import ground_truth
from mi_prt.lighting.parse import parse_light
from mi_prt.lighting.part import LIGHTS
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.output.formats import FORMATS
from mi_prt.scene.models import MATERIALS
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"
EXAMPLES = dict(re.findall(r"```python (\w+)\n(.*?)```", PAGE.read_text(), re.DOTALL))
REGISTRIES = {"basis": BASES, "light": LIGHTS, "material": MATERIALS, "output": FORMATS}
SCENE = """<scene version="3.0.0">
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
    <bsdf type="diffuse"/>
  </shape>
  <shape type="cube">
    <transform name="to_world"><scale value="0.4"/><translate y="0.6"/></transform>
    <bsdf type="roughconductor"/>
  </shape>
  <emitter type="constant" id="sky"/>
  <sensor type="perspective">
    <transform name="to_world">
      <lookat origin="3, 2, 3" target="0, 0.4, 0" up="0, 1, 0"/>
    </transform>
    <film type="hdrfilm">
      <integer name="width" value="24"/><integer name="height" value="24"/>
    </film>
  </sensor>
</scene>"""


@pytest.fixture
def registered(request):
    """Register an example of the page; afterwards the registry is as it was."""
    registry = REGISTRIES[request.param]
    before = {name: registry[name] for name in registry}
    exec(
        compile(EXAMPLES[request.param], f"{PAGE}:{request.param}", "exec"), {"__name__": "example"}
    )
    yield
    registry.restore(before)


def run(*arguments):
    """The command line in this process; its exit code."""
    with pytest.raises(SystemExit) as ended:
        main([str(a) for a in arguments])
    return ended.value.code


def made(folder, *options):
    """An asset of the scene, by the command line."""
    (folder / "scene.xml").write_text(SCENE)
    few = ("--directions", "cubemap:8", "--edge-length", "0.5")
    assert run("precompute", folder / "scene.xml", "-o", folder / "a.prt", *few, *options) == 0
    return folder / "a.prt"


def picture(asset, path, *options):
    assert run("relight", asset, "-o", path, "--spp", 16, *options) == 0
    return np.array(mitsuba().Bitmap(str(path)))[..., :3]


def test_page_has_all_examples():
    assert set(EXAMPLES) == set(REGISTRIES)


@pytest.mark.parametrize("registered", ["basis"], indirect=True)
def test_basis(registered, tmp_path, capsys):
    """Under a constant sky patches lose nothing: any partition integrates a constant exactly."""
    asset = made(tmp_path, "--basis", "sky-patches", "--coefficients", "32", "--bounces", "0")
    exact = (
        made(tmp_path / "exact", "--basis", "none") if (tmp_path / "exact").mkdir() is None else 0
    )
    first, second = (mi_prt.load(path).irradiance(np.ones((2, 4, 3))) for path in (asset, exact))
    assert relative_l2(first, second) < 1e-4
    capsys.readouterr()
    assert run("info", asset, "--json") == 0
    held = json.loads(capsys.readouterr().out)["transports"]["distant"]
    assert (held["basis"], held["coefficients"]) == ("sky-patches", 32)
    assert run("info", tmp_path / "scene.xml", "--basis", "sky-patches", "--json") == 0
    chosen = json.loads(capsys.readouterr().out)["settings"]["basis"]
    assert "daylight" in chosen["reason"]


@pytest.mark.parametrize("registered", ["light"], indirect=True)
def test_light(registered, tmp_path, capsys):
    """Irradiance of an open floor under the lamp equals Mitsuba's: 64 places stand for the disk, at
    five radii off, which is within 1 %.
    """
    light = parse_light("disk:0,1.5,0:0,-1,0:0.3,0,0:9,8,7")
    parts = scene(floor=rectangle((0, 1, 0), size=1.0, bsdf=diffuse(0.5)), sky={"type": "constant"})
    opened = open_scene(parts)
    asset = mi_prt.precompute(
        parts,
        transports="local",
        points="samples",
        count=500,
        cluster_size=100,
        depth_directions=504,
        example_lights=50,
    )
    chosen = np.arange(0, 500, 5)
    found = asset.irradiance(light, "direct")[chosen]
    lit = lit_scene(opened, light)
    truth = ground_truth.point_irradiance(lit, asset.points.at(chosen), 1024)
    assert relative_l2(found, truth.mean) < 0.03
    path = made(tmp_path)
    lamp = "disk:0,0.5,0.9:0,-1,0:0.1,0,0:5"  # within the hull of floor and cube
    capsys.readouterr()
    picture(path, tmp_path / "disk.exr", "--light", lamp)
    assert "inside the convex hull" in capsys.readouterr().err


def test_material(tmp_path):
    """Metal is black by default; with the example it reflects, onto the floor too."""
    before = picture(made(tmp_path), tmp_path / "before.exr")
    kinds = {name: MATERIALS[name] for name in MATERIALS}
    try:
        exec(compile(EXAMPLES["material"], str(PAGE), "exec"), {"__name__": "example"})
        after = picture(made(tmp_path), tmp_path / "after.exr")
    finally:
        MATERIALS.restore(kinds)
    changed = np.abs(after - before).max(axis=2) > 0.05
    assert 0.02 < changed.mean() < 0.6
    assert after.sum() > 1.05 * before.sum()


@pytest.mark.parametrize("registered", ["output"], indirect=True)
def test_output(registered, tmp_path):
    path = made(tmp_path)
    assert run("relight", path, "-o", tmp_path / "a.csv") == 0
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    asset = mi_prt.load(path)
    expected = np.hstack([asset.points.positions, asset.relight()])
    assert np.allclose(table, expected, rtol=1e-5, atol=1e-6)


def test_unknown_kinds_are_named():
    with pytest.raises(mi_prt.SettingsError, match=r"output 'a\.csv' must end in \.exr"):
        from mi_prt.output.formats import format_of

        format_of("a.csv")
    with pytest.raises(mi_prt.SettingsError, match="basis 'sky-patches' is not known: use .*pca"):
        mi_prt.precompute(scene(a=cube()), basis="sky-patches")
