"""Errors that are raised while Mitsuba runs: they arrive as they were raised, from `mi.render` and
from its loaders, in Python and on the command line; and images of any number of samples.
"""

import json

import numpy as np
import pytest
from conftest import rectangle, relative_l2, scene, sphere

import mi_prt
from mi_prt.cli import main
from mi_prt.errors import AssetError, InputError, LightError, SceneError, SettingsError
from mi_prt.evaluate import ground_truth, views
from mi_prt.output.film import LightPath
from mi_prt.output.moving import animate
from mi_prt.render import rendered as module
from mi_prt.render.image import render_image
from mi_prt.system.passing import one_line
from mi_prt.system.runtime import mitsuba

SETTINGS = {"directions": "cubemap:4", "coefficients": 4, "edge_length": 1.0, "bounces": 0}


def parts(height=0.5, width=24, **rest):
    mi = mitsuba()
    return (
        scene(
            floor=rectangle(),
            ball=sphere((0, height, 0), 0.3),
            sky={"type": "constant"},
            camera={
                "type": "perspective",
                "fov": 20,
                "to_world": mi.ScalarTransform4f().look_at([0, 3, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": width, "height": 16},
            },
        )
        | rest
    )


@pytest.fixture(scope="module")
def asset():
    return mi_prt.precompute(parts(), **SETTINGS)


@pytest.fixture(scope="module")
def path(asset, tmp_path_factory):
    path = tmp_path_factory.mktemp("asset") / "a.prt"
    asset.save(path)
    return path


# --- errors within Mitsuba ------------------------------------------------------------------------


def test_the_plugin_raises_what_it_says(path):
    """In `mi.render`, of a scene that is another, that changed after it was rendered, and that has
    no light.
    """
    mi = mitsuba()
    prt = mi.load_dict({"type": "prt", "filename": str(path)})
    with pytest.raises(SceneError, match="geometry changed"):
        mi.render(mi.load_dict(parts(0.6)), integrator=prt, spp=1)
    loaded = mi.load_dict(parts())
    mi.render(loaded, integrator=prt, spp=1)
    parameters = mi.traverse(loaded)
    parameters["floor.to_world"] = mi.Transform4f().scale(2)
    parameters.update()
    with pytest.raises(SceneError, match="precompute it again"):
        mi.render(loaded, integrator=prt, spp=1)
    dark = parts()
    del dark["sky"]
    with pytest.raises(LightError, match="light"):
        mi.render(mi.load_dict(dark), integrator=prt, spp=1)


@pytest.mark.parametrize(
    ("properties", "error", "said"),
    [
        ({"filename": "none.prt"}, AssetError, "asset 'none.prt' does not exist"),
        ({}, SettingsError, "needs a filename"),
        ({"filename": "{path}", "direct": "rays"}, SettingsError, "points or pixels"),
    ],
)
def test_loading_the_plugin_raises_what_it_says(path, tmp_path, properties, error, said):
    """From a dict, a text and a file; and in a scene that this package opens."""
    mi = mitsuba()
    given = {key: value.format(path=path) for key, value in properties.items()}
    strings = "".join(f'<string name="{key}" value="{value}"/>' for key, value in given.items())
    text = f'<scene version="3.0.0"><integrator type="prt">{strings}</integrator></scene>'
    (tmp_path / "scene.xml").write_text(text)
    for load in (
        lambda: mi.load_dict({"type": "prt", **given}),
        lambda: mi.load_string(text),
        lambda: mi.load_file(str(tmp_path / "scene.xml")),
        lambda: mi_prt.precompute(tmp_path / "scene.xml"),
    ):
        with pytest.raises(error, match=said):
            load()


def test_what_is_no_error_of_ours_stays_mitsubas():
    mi = mitsuba()
    with pytest.raises(RuntimeError, match="unknown|not found|instantiate") as caught:
        mi.load_dict({"type": "no_such_plugin"})
    assert not isinstance(caught.value, InputError)


@pytest.mark.parametrize("raised", [KeyboardInterrupt, SystemExit, MemoryError])
def test_an_interrupted_image_is_interrupted(raised):
    """Ctrl-C while Mitsuba calls Python is no RuntimeError, which would end with a traceback."""
    mi = mitsuba()

    class Interrupted(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            raise raised

    with pytest.raises(raised):
        module.rendered(
            loaded := mi.load_dict(parts()),
            loaded.sensors()[0],
            Interrupted(mi.Properties()),
            1,
        )


def test_what_mitsuba_cannot_render_is_a_scene_error():
    mi = mitsuba()
    loaded = mi.load_dict(parts())

    class Failing(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            raise RuntimeError("odd\nscene")

    with pytest.raises(SceneError, match="Mitsuba cannot render the scene"):
        module.rendered(loaded, loaded.sensors()[0], Failing(mi.Properties()), 1)


def test_a_changed_scene_on_the_command_line(tmp_path, capsys):
    """One line and exit code 2, of each command that renders."""
    text = """<scene version="3.0.0"><shape type="sphere">
        <point name="center" x="0" y="{y}" z="0"/></shape>
        <emitter type="constant"/><sensor type="perspective"><transform name="to_world">
        <lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform></sensor></scene>"""
    (tmp_path / "scene.xml").write_text(text.format(y=0))
    mi_prt.precompute(tmp_path / "scene.xml", **SETTINGS).save(tmp_path / "a.prt")
    (tmp_path / "scene.xml").write_text(text.format(y=1))
    for arguments in (
        ("relight", tmp_path / "a.prt", "-o", tmp_path / "a.png"),
        ("compare", tmp_path / "a.prt", "-o", tmp_path / "report"),
    ):
        with pytest.raises(SystemExit) as exit:
            main([str(a) for a in arguments])
        err = capsys.readouterr().err
        assert exit.value.code == 2 and "Traceback" not in err
        assert "is not the scene of the asset" in err.splitlines()[-1]


def test_texts_of_mitsuba_in_one_line():
    text = (
        "[parser.cpp:1] failed: Traceback (most recent call last):\n"
        '  File "x.py", line 3, in f\n    g()\nAssetError: it is gone\nand more'
    )
    assert one_line(text) == "[parser.cpp:1] failed: AssetError: it is gone and more"
    assert one_line("a\n b\tc") == "a b c"


# --- images of any number of samples --------------------------------------------------------------


def test_passes_are_one_image(asset, monkeypatch):
    """Split over passes the image is the same: of the integrator up to its antialiasing, of the
    path tracer within its noise, and what pixels show first exactly.
    """
    mi = mitsuba()
    loaded = mi.load_dict(parts())
    camera = loaded.sensors()[0]
    seeds = []
    once = mi.render

    def counted(*arguments, **named):
        seeds.append(named["seed"])
        return once(*arguments, **named)

    results = {}
    for lanes in (1 << 26, 24 * 16 * 10):
        monkeypatch.setattr(module, "PASS_LANES", lanes)
        monkeypatch.setattr(mi, "render", counted)
        seeds.clear()
        results[lanes] = (
            render_image(asset, loaded, camera, 64, 3),
            ground_truth.image(loaded, camera, 128, 3),
            views.first_hits(loaded, camera, 64, 3).covered,
        )
    # 7 passes for each of four images, two of which are of the same seed
    assert len(seeds) == 28 and len(set(seeds)) == 21
    (image, truth, covered), (image2, truth2, covered2) = results.values()
    assert relative_l2(image2, image) < 0.02
    assert relative_l2(truth2.mean, truth.mean) < 0.1
    np.testing.assert_array_equal(covered, covered2)


SPP = "spp must be 1…1,048,576"


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"spp": 0}, SPP),
        ({"spp": -1}, SPP),
        ({"spp": 2.5}, f"{SPP}, a whole number, got 2.5"),
        ({"spp": 2147483648}, f"{SPP}, a whole number, got 2147483648: the noise"),
        ({"spp": True}, SPP),
        ({"spp": "4"}, SPP),
        ({"spp": float("nan")}, SPP),
        ({"size": (0, 4)}, "size 0x4 must be at least 1x1"),
        ({"size": (4.5, 4)}, "size 4.5x4"),
        (
            {"size": (100_000, 100_000)},
            "100000x100000 must be at least 1x1 and at most 67,108,864 pixels",
        ),
        ({"size": 5}, "size must be"),
        ({"sensor": -1}, "sensor must be 0…"),
        ({"sensor": 0.5}, "sensor must be 0…"),
    ],
)
def test_what_no_picture_can_be_of_is_refused_before_all_else(asset, tmp_path, asked, said):
    """Also where the output is no picture, and before the scene, which is not there, is opened."""
    for output in ("a.png", "a.npz"):
        with pytest.raises(SettingsError, match=said):
            mi_prt.relight_to_file(asset, tmp_path / output, "none.exr", scene="none", **asked)
    with pytest.raises(SettingsError, match=said):
        mi_prt.compare(asset, tmp_path / "r", scene="none", **asked)
    with pytest.raises(SettingsError, match=said):
        animate(asset, tmp_path / "a.gif", LightPath([[0, 0, 0], [1, 0, 0]]), scene="none", **asked)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("frames", [0, -1, 1_000_000_000, 2.5, True])
def test_numbers_of_frames_are_refused(asset, tmp_path, frames):
    with pytest.raises(SettingsError, match="frames must be 1…100,000"):
        animate(asset, tmp_path / "a.gif", LightPath([[0, 0, 0], [1, 0, 0]]), frames, scene="none")


@pytest.mark.parametrize("seed", [-1, 1 << 31, 0.5])
def test_seeds_of_a_comparison_are_refused(asset, tmp_path, seed):
    with pytest.raises(SettingsError, match="seed must be 0…"):
        mi_prt.compare(asset, tmp_path / "r", scene="none", seed=seed)


def test_the_film_of_a_scene_is_refused_too(asset, tmp_path):
    """A film of ten thousand million pixels in the scene itself; and of none."""
    with pytest.raises(SettingsError, match="at most 67,108,864 pixels: .*--size"):
        mi_prt.relight_to_file(
            asset,
            tmp_path / "a.png",
            scene=parts(width=1 << 23),
        )
    flat = parts()
    flat["camera"] = flat["camera"] | {"type": "orthographic"}
    flat["camera"].pop("fov")
    flat["camera"]["film"] = flat["camera"]["film"] | {"width": 0}
    with pytest.raises(InputError):
        mi_prt.relight_to_file(asset, tmp_path / "a.png", scene=flat)
    perspective = parts(width=0)
    perspective["camera"].pop("fov")
    with pytest.raises(SceneError, match="a film has no pixels"):
        mi_prt.precompute(perspective, **SETTINGS)


@pytest.mark.parametrize("samples", [0, 26, 1_000_000, 1 << 40, 4.0, True])
def test_samples_of_an_area_light_are_refused(samples):
    with pytest.raises(LightError, match=r"samples must be (1…10,000|a square)"):
        mi_prt.AreaLight((0, 1, 0), (1, 0, 0), (0, 0, 1), 1.0, samples)


def test_the_command_line_refuses_numbers(path, tmp_path, capsys):
    for arguments, said in (
        (["--spp", "-1", "-o", "a.npz"], "spp must be"),
        (["--spp", "2147483648", "-o", "a.png"], "spp must be"),
        (["--size", "100000x100000", "-o", "a.ply"], "at most 67,108,864 pixels"),
        (
            ["--light", "area:0,1,0:1,0,0:0,0,1:1:1000000", "-o", "a.npz"],
            "samples must be 1…10,000",
        ),
        (
            ["--light", "point:0,1,0:1", "--light-path", "0,1,0 1,1,0", "--frames", "1000000000"]
            + ["-o", "a.gif"],
            "frames must be 1…100,000",
        ),
    ):
        with pytest.raises(SystemExit) as exit:
            main(["relight", str(path), *arguments[:-1], str(tmp_path / arguments[-1])])
        err = capsys.readouterr().err
        assert exit.value.code == 2 and said in err.splitlines()[-1], err


def test_errors_are_json_where_results_would_be(tmp_path, capsys):
    """One object on one line, with the type and the text of what is said without --json."""
    missing = str(tmp_path / "a.prt")
    for arguments in ([missing], [missing, "--json"]):
        with pytest.raises(SystemExit) as exit:
            main(["relight", *arguments, "-o", str(tmp_path / "a.png")])
        assert exit.value.code == 2
    plain, told = capsys.readouterr().err.splitlines()
    told = json.loads(told)["error"]
    assert told["type"] == "AssetError" and plain == f"mi-prt: {told['message']}"
