"""Assets of local lights as pictures and films: the integrator, splats, the command line,
comparison with Mitsuba, and the plugin.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import bias, diffuse, relative_l2

import mi_prt
from mi_prt import LightError, SceneError, SettingsError
from mi_prt.cli import main
from mi_prt.evaluate import ground_truth
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.output.film import light_path
from mi_prt.output.moving import animate
from mi_prt.output.relight import relight_to_file
from mi_prt.precompute.settings import BY_NAME
from mi_prt.render.image_file import to_8bit
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()
LIGHT = mi_prt.PointLight((0.3, 0.6, 0.4), (3.0, 2.5, 2.0))
SIZE = (48, 36)
ROOM = Path(__file__).resolve().parent.parent / "scenes" / "room.xml"
SETTINGS = {
    "transports": "local",
    "points": "samples",
    "count": 3000,
    "cluster_size": 150,
    "depth_directions": 576,
    "example_lights": 200,
}


def wall(x, y, z, axis, degrees, bsdf, scale=(1, 1, 1)):
    T = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": T().translate([x, y, z]).rotate(axis, degrees).scale(list(scale)),
        "bsdf": bsdf,
    }


def room():
    """A room of 2 m, open to the sensor, with a box of red sides in it and a lamp of its own."""
    two = lambda colour: {"type": "twosided", "bsdf": diffuse(colour)}
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": T().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": SIZE[0],
                "height": SIZE[1],
                "rfilter": {"type": "box"},
            },
        },
        "floor": wall(0, -1, 0, [1, 0, 0], -90, two(0.7)),
        "ceiling": wall(0, 1, 0, [1, 0, 0], 90, two(0.7)),
        "back": wall(0, 0, -1, [0, 1, 0], 0, two(0.6)),
        "left": wall(-1, 0, 0, [0, 1, 0], 90, two([0.7, 0.2, 0.1])),
        "right": wall(1, 0, 0, [0, 1, 0], -90, two([0.1, 0.6, 0.2])),
        "box": {
            "type": "cube",
            "to_world": T().translate([-0.3, -0.6, -0.2]).rotate([0, 1, 0], 25).scale(0.4),
            "bsdf": diffuse(0.5),
        },
        "lamp": {
            "type": "point",
            "position": [0.2, 0.8, 0.3],
            "intensity": {"type": "rgb", "value": [2.0, 2.0, 1.5]},
        },
    }


@pytest.fixture(scope="module")
def asset(tmp_path_factory):
    made = mi_prt.precompute(room(), **SETTINGS)
    made.save(tmp_path_factory.mktemp("asset") / "room.prt")
    return made


@pytest.fixture(scope="module")
def opened():
    return open_scene(room())


def image(path):
    return np.array(
        mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    )


def truth(opened, light, spp=1024, depth=-1):
    lit = lit_scene(opened, light)
    return ground_truth.image(lit, lit.sensors()[0], spp, max_depth=depth).mean


@pytest.fixture(scope="module")
def expected(opened):
    return truth(opened, LIGHT)


@pytest.mark.parametrize("direct, limit", [("points", 0.12), ("pixels", 0.06)])
def test_images_are_those_of_the_path_tracer(asset, expected, tmp_path, direct, limit):
    """Of all pixels, against 1,024 samples (noise about 2 %).

    Direct light at pixels has no shadow that points would have to show.
    """
    relight_to_file(asset, tmp_path / "a.exr", LIGHT, scene=room(), direct=direct, spp=64)
    found = image(tmp_path / "a.exr")
    assert relative_l2(found, expected) < limit
    assert abs(bias(found, expected)) < 0.03


def test_components_add_up(asset, tmp_path):
    """Light is a sum, and interpolation between points is linear: total = direct + indirect in each
    pixel.
    """
    parts = {}
    for component in ("total", "direct", "indirect"):
        relight_to_file(asset, tmp_path / "a.exr", LIGHT, scene=room(), component=component, spp=4)
        parts[component] = image(tmp_path / "a.exr")
    assert relative_l2(parts["direct"] + parts["indirect"], parts["total"]) < 1e-5
    assert relative_l2(parts["direct"], parts["total"]) > 0.05


def test_direct_light_at_pixels_is_mitsubas(asset, opened, tmp_path):
    """Without reflections nothing of the asset is in the image but its emission: shadow rays at the
    same kind of hits as Mitsuba's.
    """
    relight_to_file(
        asset,
        tmp_path / "a.exr",
        LIGHT,
        scene=room(),
        component="direct",
        direct="pixels",
        spp=1024,
    )
    assert relative_l2(image(tmp_path / "a.exr"), truth(opened, LIGHT, 1024, depth=2)) < 0.02


def test_an_area_light_is_seen_and_shines(asset, tmp_path):
    """It is a rectangle of its own radiance in the picture (here 5), and lights the room below it
    and not above.
    """
    light = mi_prt.AreaLight((0, 0, 0.5), (0.5, 0, 0), (0, 0.5, 0), 5.0)  # faces the sensor
    relight_to_file(asset, tmp_path / "a.exr", light, scene=room(), spp=16)
    picture = image(tmp_path / "a.exr")
    np.testing.assert_allclose(picture[SIZE[1] // 2, SIZE[0] // 2], 5.0, rtol=1e-4)


def test_splats_show_what_the_integrator_shows(asset, tmp_path):
    """Both interpolate the same irradiance between the same samples, with other weights: alike but
    for shadow edges.
    """
    relight_to_file(asset, tmp_path / "a.exr", LIGHT, scene=room(), spp=64)
    relight_to_file(asset, tmp_path / "b.exr", LIGHT, scene=room(), renderer="raster")
    assert relative_l2(image(tmp_path / "b.exr"), image(tmp_path / "a.exr")) < 0.06


def test_points_as_ply_and_npz(asset, tmp_path):
    relight_to_file(asset, tmp_path / "a.npz", LIGHT)
    found = np.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(found["irradiance"], asset.irradiance(LIGHT))
    np.testing.assert_array_equal(found["radiance"], asset.relight(LIGHT))
    relight_to_file(asset, tmp_path / "a.ply", scene=room())
    assert (tmp_path / "a.ply").read_bytes().startswith(b"ply\n")


def test_own_light_is_the_default_and_can_be_one_of_several(asset, tmp_path):
    """The lamp of the scene is a point light: naming it, leaving it out, and passing its copy are
    the same; more lights add up.
    """
    lamp = mi_prt.PointLight((0.2, 0.8, 0.3), (2.0, 2.0, 1.5))
    own = asset.irradiance(asset.resolved(scene=room()))
    with pytest.raises(SceneError, match="--scene"):  # it came from memory, and no lamp is baked
        asset.irradiance()
    np.testing.assert_allclose(asset.irradiance(lamp), own, rtol=1e-4, atol=1e-5)
    for name, light in (("a", None), ("b", "scene"), ("c", ["scene", LIGHT])):
        relight_to_file(asset, tmp_path / f"{name}.npz", light, scene=room())
    found = {name: np.load(tmp_path / f"{name}.npz")["irradiance"] for name in "abc"}
    np.testing.assert_array_equal(found["a"], own)
    np.testing.assert_array_equal(found["b"], own)
    # what is below zero is cut off in each
    assert relative_l2(found["c"], own + asset.irradiance(LIGHT)) < 0.01


def test_plugin_follows_the_scenes_own_lamps(asset):
    """A user's scene with the lamp somewhere else than when it was precomputed."""
    moved = room()
    moved["lamp"]["position"] = [-0.5, 0.2, 0.6]
    scene = mi.load_dict(moved)
    for direct, limit in (("points", 0.12), ("pixels", 0.06)):
        plugin = mi.load_dict({"type": "prt", "filename": str(asset.path), "direct": direct})
        found = np.array(mi.render(scene, integrator=plugin, spp=64))
        expected = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1024))
        assert relative_l2(found, expected) < limit
        # The lamp moves on within the same scene object.
        parameters = mi.traverse(scene)
        parameters["lamp.position"] = [0.5, 0.2, 0.6]
        parameters.update()
        found = np.array(mi.render(scene, integrator=plugin, spp=64))
        expected = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=1024))
        assert relative_l2(found, expected) < limit
        parameters["lamp.position"] = [-0.5, 0.2, 0.6]
        parameters.update()


def test_comparison_tells_components(asset, tmp_path):
    report = mi_prt.compare(asset, tmp_path / "r", LIGHT, scene=room(), spp=64)
    assert set(report["components"]) == {"direct", "indirect"}
    assert report["points"]["relative_rmse_beyond_noise"] < 0.12
    assert report["components"]["direct"]["reference_noise"] == 0
    assert "direct light of it" in (tmp_path / "r" / "index.html").read_text()
    stored = json.loads((tmp_path / "r" / "report.json").read_text())
    assert stored["transports"]["local"]["depth_coefficients"] == 50
    assert [part.split()[0] for part in stored["light"]] == ["point"]


@pytest.mark.parametrize("renderer", ["mitsuba", "raster"])
def test_film_of_a_moving_light(asset, tmp_path, renderer):
    """Each frame is the picture of its place, at the first one's exposure."""
    path = light_path("-0.5,0.5,0.4 0.5,0.5,0.4")
    told = animate(
        asset, tmp_path / "f-%d.png", path, 3, light=LIGHT, scene=room(), renderer=renderer, spp=4
    )
    assert told["frames"] == 3
    frames = [
        np.array(
            mi.Bitmap(str(tmp_path / f"f-{i}.png")).convert(
                mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True
            )
        )
        for i in range(3)
    ]
    single = mi_prt.PointLight((-0.5, 0.5, 0.4), LIGHT.intensity)
    relight_to_file(asset, tmp_path / "s.png", single, scene=room(), renderer=renderer, spp=4)
    first = np.array(
        mi.Bitmap(str(tmp_path / "s.png")).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True
        )
    )
    # splats of films have one sample a pixel, others four: outlines differ
    limit = 2 if renderer == "mitsuba" else 10
    assert np.abs(frames[0].astype(int) - first).mean() < limit
    assert np.abs(frames[2].astype(int) - frames[0]).mean() > 1.5 * limit
    # The room is not symmetric, but its middle is: the brighter side of the back wall changes.
    middle = [f[SIZE[1] // 3, :, 1].astype(int) for f in (frames[0], frames[2])]
    assert middle[0][: SIZE[0] // 2].sum() > middle[1][: SIZE[0] // 2].sum()


def test_film_moves_the_lamp_of_an_area_light(asset, tmp_path):
    """An area light is a shape: it is seen where it is in each frame."""
    light = mi_prt.AreaLight((0, 0, 0.5), (0.3, 0, 0), (0, 0.3, 0), 50.0)
    animate(
        asset,
        tmp_path / "f-%d.png",
        light_path("-0.5,0,0.5 0.5,0,0.5"),
        2,
        light=light,
        scene=room(),
    )
    frames = [image(tmp_path / f"f-{i}.png") for i in range(2)]
    places = [np.argmax(f[SIZE[1] // 2].sum(axis=-1)) for f in frames]
    assert places[0] < SIZE[0] / 2 < places[1]


@pytest.mark.parametrize(
    "arguments, error",
    [
        ({"rotate": ("y", 30)}, SettingsError),
        ({"nearest": 0}, SettingsError),
        ({"spp": 0}, SettingsError),
        ({"spp": 1 << 22}, SettingsError),
        ({"component": "glossy"}, SettingsError),
        ({"direct": "somewhere"}, SettingsError),
        ({"renderer": "raster", "direct": "pixels"}, SettingsError),
        ({"light": mi_prt.DirectionalLight((0, -1, 0), 1.0)}, LightError),
        ({"light": []}, LightError),
    ],
)
def test_what_such_assets_do_not_take_is_refused(asset, tmp_path, arguments, error):
    with pytest.raises(error):
        relight_to_file(asset, tmp_path / "a.exr", **{"light": LIGHT, "scene": room()} | arguments)
    assert not (tmp_path / "a.exr").exists()


def test_nearest_directions_stand_in_only_where_no_transport_is(asset, tmp_path):
    """Transport of local light is there: their number changes nothing."""
    relight_to_file(asset, tmp_path / "a.npz", LIGHT, nearest=4)
    np.testing.assert_array_equal(
        np.load(tmp_path / "a.npz")["irradiance"], asset.irradiance(LIGHT)
    )


def test_distant_assets_tell_no_components_apart_unless_asked(tmp_path):
    flat = {
        "type": "scene",
        "floor": wall(0, 0, 0, [1, 0, 0], -90, diffuse(0.5)),
        "sky": {"type": "constant"},
    }
    flat["wall"] = wall(0, 0.5, -1, [0, 1, 0], 0, diffuse(0.5))
    settings = {"directions": "cubemap:4", "coefficients": 4, "edge_length": 0.5}
    distant = mi_prt.precompute(flat, **settings)
    with pytest.raises(SettingsError, match="keep_direct"):
        relight_to_file(distant, tmp_path / "a.npz", component="indirect", scene=flat)
    apart = mi_prt.precompute(flat, keep_direct=True, **settings)
    found = {}
    for component in ("total", "direct", "indirect"):
        relight_to_file(apart, tmp_path / "a.npz", component=component, scene=flat)
        found[component] = np.load(tmp_path / "a.npz")["irradiance"]
    assert relative_l2(found["direct"] + found["indirect"], found["total"]) < 1e-6
    assert found["indirect"].any() and found["direct"].any()
    assert distant.irradiance(mi_prt.SpotLight((0, 1, 0), (0, -1, 0), 1.0)).any()


def test_films_without_a_light_to_move_are_refused(asset, tmp_path):
    with pytest.raises(LightError, match="--light"):
        animate(asset, tmp_path / "f.gif", light_path("0,0,0 1,0,0"), 2, scene=room())


# --- the command line -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def from_file(tmp_path_factory):
    """An asset of the scene of two rooms, made by the command line."""
    made = tmp_path_factory.mktemp("cli") / "room.prt"
    options = [
        "--points",
        "samples",
        "--transports",
        "own,local",
        "--count",
        "1500",
        "--cluster-size",
        "150",
        "--depth-directions",
        "256",
        "--example-lights",
        "100",
    ]
    with pytest.raises(SystemExit) as end:
        main(["precompute", str(ROOM), "-o", str(made), *options, "--json"])
    assert end.value.code == 0
    return made


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    out = capsys.readouterr()
    return end.value.code, out.out, out.err


def test_command_line(from_file, tmp_path, capsys):
    code, out, _ = run(
        capsys,
        "relight",
        from_file,
        "-o",
        tmp_path / "a.png",
        "--light",
        "point:0,1.5,1:2,2,2",
        "--component",
        "indirect",
        "--size",
        "64x40",
        "--json",
    )
    assert code == 0 and json.loads(out)["points"] == 1500
    film = (
        "--size",
        "64x40",
        "--light",
        "point:0,1.5,1:2",
        "--light-path",
        "-0.5,1.5,1 0.5,1.5,1",
        "--frames",
        "2",
        "--renderer",
        "raster",
        "--json",
    )
    code, out, _ = run(capsys, "relight", from_file, "-o", tmp_path / "a.gif", *film)
    assert (
        code == 0 and json.loads(out)["frames"] == 2 and (tmp_path / "a.gif").stat().st_size > 500
    )
    code, out, _ = run(capsys, "info", from_file, "--json")
    told = json.loads(out)
    assert told["points"] == 1500 and told["bytes"] == from_file.stat().st_size
    stored = [t["storage"]["measured"] for t in told["transports"].values()]
    assert set().union(*stored) == {"columns", "depth", "transfer"}
    assert sum(sum(sizes.values()) for sizes in stored) < told["bytes"]
    # each known error names the setting that lowers it
    assert {entry["knob"] for entry in told["ledger"]} <= set(BY_NAME)
    stages = {entry["stage"].split(":")[0] for entry in told["ledger"]}
    assert stages == {"own", "local", "points"}
    code, out, _ = run(
        capsys,
        "compare",
        from_file,
        "-o",
        tmp_path / "r",
        "--light",
        "point:0,1.5,1:2",
        "--size",
        "64x40",
        "--spp",
        "4",
        "--json",
    )
    assert code == 0 and json.loads(out)["components"]["indirect"]["bias"] < 1


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--basis", "sh"], "--basis"),
        (["--coefficients", "8"], "--coefficients"),
        (["--depth-directions", "2017"], "2016"),
        (["--quantize", "8"], "quantize"),
        (["--count", "0"], "count"),
        (["--transfer-error", "1"], "transfer error"),
    ],
)
def test_command_line_refuses(capsys, tmp_path, arguments, word):
    code, _, error = run(
        capsys, "precompute", ROOM, "-o", tmp_path / "x.prt", "--points", "samples", *arguments
    )
    assert code == 2 and word in error and error.count("\n") <= 3
    assert not list(tmp_path.iterdir())


def test_options_of_samples_need_samples(capsys, tmp_path):
    """Where points are left to the program, a setting of samples asks for samples."""
    options = ["-o", tmp_path / "x.prt", "--count", "100", "--points", "vertices"]
    code, _, error = run(capsys, "precompute", ROOM, *options)
    assert code == 2 and "--count" in error and "vertices" in error
    code, out, _ = run(capsys, "info", ROOM, "--count", "100", "--lamp-rays", "4", "--json")
    chosen = json.loads(out)["settings"]
    assert code == 0 and chosen["points"]["value"] == "samples"
    assert "count" in chosen["points"]["reason"] and "edge_length" not in chosen


def test_info_of_a_scene_predicts(capsys):
    settings = ["--points", "samples", "--count", "3000", "--transports", "local"]
    code, out, _ = run(capsys, "info", ROOM, *settings, "--json")
    told = json.loads(out)
    assert code == 0 and told["requires"]["points"] == 3000
    assert not told["requires"]["albedo"]["grey"]
    assert [light["name"] for light in told["lights"]] == ["lamp_1"]
    assert told["predicted"]["seconds"] > 0 and told["predicted"]["bytes"] > 1e5


def test_frames_are_displayed_values(asset, tmp_path):
    """8 bits of the film are those of `to_8bit`: what is written is not exposed twice."""
    assert to_8bit(np.array([0.0, 1.0, 0.5])).tolist() == [0, 255, 128]
