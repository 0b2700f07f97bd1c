"""What is refused before it does harm: files of others, settings that say nothing, light that grows
without bound.
"""

import numpy as np
import pytest
from conftest import rectangle, scene

import mi_prt
from mi_prt.cli import main
from mi_prt.errors import SceneError, SettingsError
from mi_prt.output.film import light_path
from mi_prt.output.moving import animate
from mi_prt.precompute.forecast import describe
from mi_prt.precompute.precompute import measure
from mi_prt.precompute.settings import Settings
from mi_prt.system.files import is_marked
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.transfer import all_reflections

SETTINGS = {"directions": "cubemap:4", "coefficients": 4, "edge_length": 1.0}
FOREIGN = b"\x89PNG<scene> of a user, who would miss it"
XML = """<scene version="3.0.0"><shape type="cube"/><emitter type="constant"/>
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="16"/><integer name="height" value="12"/></film>
<transform name="to_world"><lookat origin="0,2,5" target="0,0,0" up="0,1,0"/></transform></sensor>
</scene>"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A scene file."""
    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(XML)
    return path


@pytest.fixture(scope="module")
def asset(file):
    return mi_prt.precompute(file, bounces=0, **SETTINGS)


# --- files of others ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.npz", "a.ply", "a.mp4", "a.gif", "a-%d.png"])
def test_pictures_and_points_of_others_stay(asset, tmp_path, name):
    """Refused with the remedy, replaced with force, and replaced without where it is our own."""

    def write(**rest):
        if name in ("a.mp4", "a.gif", "a-%d.png"):
            light, path = mi_prt.PointLight((9, 9, 9), 1.0), light_path("9,9,9 8,9,9")
            return animate(
                asset, tmp_path / name, path, 2, light=light, spp=1, renderer="mitsuba", **rest
            )
        return mi_prt.relight_to_file(asset, tmp_path / name, spp=1, **rest)

    there = tmp_path / name.replace("%d", "1")
    there.write_bytes(FOREIGN)
    with pytest.raises(SettingsError, match="was not written by mi_prt: .*--force"):
        write()
    assert there.read_bytes() == FOREIGN and len(list(tmp_path.iterdir())) == 1
    write(force=True)
    written = there.read_bytes()
    assert written != FOREIGN and is_marked(there)
    write()
    there.write_bytes(b"")  # holds nothing to miss
    write()
    assert len(there.read_bytes()) > 100


@pytest.mark.parametrize(
    "content",
    [FOREIGN, XML.encode(), (16).to_bytes(8, "little") + b'{"w":{}}' + bytes(99), b"mi_prt asset"],
    ids=["binary", "scene", "safetensors of others", "text"],
)
def test_assets_replace_assets_only(asset, file, tmp_path, content):
    path = tmp_path / "out.prt"
    path.write_bytes(content)
    for write in (lambda: asset.save(path), lambda: measure(file, output=path, **SETTINGS)):
        with pytest.raises(SettingsError, match="was not written by mi_prt"):
            write()
        assert path.read_bytes() == content and len(list(tmp_path.iterdir())) == 1
    asset.save(path, force=True)
    asset.save(path)
    assert len(mi_prt.load(path).points) == len(asset.points)


def test_a_report_replaces_a_report_only(asset, tmp_path):
    (tmp_path / "index.html").write_text("my page")
    with pytest.raises(SettingsError, match="index.html' is there and was not written by mi_prt"):
        mi_prt.compare(asset, tmp_path, spp=2)
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]
    mi_prt.compare(asset, tmp_path, spp=2, force=True)
    mi_prt.compare(asset, tmp_path, spp=2)
    assert "mi_prt comparison" in (tmp_path / "index.html").read_text()


def test_force_on_the_command_line(asset, file, tmp_path, capsys):
    """Of all three commands that write."""
    asset.save(tmp_path / "a.prt")
    for arguments, name in (
        (["precompute", file, "--directions", "cubemap:4", "--bounces", "0"], "b.prt"),
        (["relight", tmp_path / "a.prt", "--spp", "1"], "a.npz"),
        (["compare", tmp_path / "a.prt", "--spp", "2"], "report"),
    ):
        place = tmp_path / name
        if name == "report":
            place.mkdir()
            (place / "report.json").write_text("{}")
        else:
            place.write_bytes(FOREIGN)
        codes = []
        for force in ([], ["--force"], []):
            with pytest.raises(SystemExit) as exit:
                main([str(a) for a in [*arguments, "-o", place, *force]])
            codes.append(exit.value.code or 0)
            capsys.readouterr()
        assert codes == [2, 0, 0], arguments


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "asked",
    [
        {"coefficients": "auto", "variance": 0.9},
        {"coefficients": None},
        {"basis": "none"},
        {"basis": "haar", "coefficients": "auto"},
        {"basis": "sh"},
    ],
    ids=str,
)
def test_settings_of_an_asset_are_settings(file, tmp_path, asked):
    """They make the same asset again, also those of a file."""
    first = mi_prt.precompute(file, **SETTINGS | {"coefficients": None, "bounces": 0} | asked)
    first.save(tmp_path / "a.prt")
    again = mi_prt.precompute(file, **mi_prt.load(tmp_path / "a.prt").settings)
    assert Settings(**again.settings) == Settings(**first.settings)
    light = np.ones((2, 4, 3), np.float32)
    np.testing.assert_array_equal(again.irradiance(light), first.irradiance(light))


@pytest.mark.parametrize(
    "asked",
    [
        {"points": "typo"},
        {"points": None},
        {"transports": "typo"},
        {"transports": []},
        {"transports": 5},
        {"basis": "typo"},
        {"indirect": "typo"},
        {"typo": 1},
    ],
    ids=str,
)
def test_unknown_words_are_refused_by_info_and_precompute(file, asked):
    for function in (describe, mi_prt.precompute):
        with pytest.raises(SettingsError, match=r"typo|None|\[\]|5"):
            function(file, **asked)


@pytest.mark.parametrize("name", ["a.npz", "a.ply"])
def test_direct_light_at_pixels_needs_pixels(asset, tmp_path, name):
    with pytest.raises(SettingsError, match=r"holds points: write \.exr or \.png"):
        mi_prt.relight_to_file(asset, tmp_path / name, direct="pixels")
    with pytest.raises(SettingsError, match="direct 'rays' is not known"):
        mi_prt.relight_to_file(asset, tmp_path / name, direct="rays")


# --- light that grows -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def white_box():
    """Five walls that return 1.5 times the light."""
    mi = mitsuba()
    bitmap = {
        "type": "bitmap",
        "raw": True,
        "bitmap": mi.Bitmap(np.full((4, 4, 3), 1.5, np.float32)),
    }
    wall = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap}}
    sides = [(0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1)]
    walls = {f"wall{i}": rectangle(n, [-x for x in n], 1, bsdf=wall) for i, n in enumerate(sides)}
    lamp = {"type": "point", "position": [0.1, 0, 0], "intensity": 1.0}
    return scene(**walls, sky={"type": "constant"}, lamp=lamp)


@pytest.mark.parametrize(
    "settings",
    [
        {"transports": "distant", "directions": "cubemap:4", "coefficients": 4},
        {"transports": "own", "lamp_rays": 16},
        {
            "transports": "local",
            "depth_directions": 16,
            "depth_coefficients": 4,
            "example_lights": 10,
            "transfer_coefficients": 4,
        },
    ],
    ids=lambda s: s["transports"],
)
def test_light_that_grows_is_said(white_box, settings):
    """A few reflections of albedo 1.5 are finite; 120 of them come to 10¹² times the light at a
    point, and 10,000 to infinity.
    """
    few = mi_prt.precompute(white_box, edge_length=1.0, bounces=3, **settings)
    assert few.reflects
    with pytest.raises(SceneError, match="grows without bound within .* fewer bounces"):
        mi_prt.precompute(white_box, edge_length=1.0, bounces=10_000, **settings)


@pytest.mark.parametrize("bounces", [1, 2, 3, 7, 8, 12])
def test_sums_by_doubling_are_the_sums(bounces):
    """1 + B + … + Bⁿ⁻¹, term by term."""
    hop = np.random.default_rng(1).random((5, 5, 2)) / 4
    expected = np.zeros_like(hop)
    for channel in range(2):
        for power in range(bounces):
            expected[..., channel] += np.linalg.matrix_power(hop[..., channel], power)
    np.testing.assert_allclose(all_reflections(hop, bounces), expected, rtol=1e-12)
