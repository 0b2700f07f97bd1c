"""Scenes: what is refused and how, what of a material is modelled and what is named as left out,
and what stays untouched.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import bias, cube, diffuse, disk, rectangle, relative_l2, scene, sphere, uniform_sky

import mi_prt
from mi_prt import LightError, SceneError
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()

XML = """<scene version="3.0.0">
    <default name="side" value="1"/> <default name="grey" value="0.5"/>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="$side"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="$grey"/></bsdf>
    </shape>
</scene>"""


def refused(source, **parameters):
    """The message of the SceneError that opening raises; one line."""
    with pytest.raises(SceneError) as caught:
        open_scene(source, **parameters)
    message = str(caught.value)
    assert "\n" not in message and len(message) > 10
    return message


# --- what is refused ------------------------------------------------------------------------------


def test_files_that_are_no_scene(tmp_path):
    """Missing, a folder, empty, text, broken XML, XML that is no scene, a file that it names is
    missing.
    """
    files = {
        "empty.xml": "",
        "text.xml": "hello",
        "broken.xml": XML[:-20],
        "bracket.xml": XML.replace("<shape", "<<shape"),
        "other.xml": "<html><body/></html>",
        "plugin.xml": XML.replace('type="rectangle"', 'type="nonsense"'),
        "property.xml": XML.replace('name="to_world"', 'name="nonsense"'),
        "ply.xml": XML.replace('type="rectangle"', 'type="ply"'),
        "mesh.xml": (
            '<scene version="3.0.0"><shape type="ply"><string name="filename"'
            ' value="none.ply"/></shape></scene>'
        ),
        "undefined.xml": XML.replace('<default name="side" value="1"/>', ""),
        "no_shapes.xml": '<scene version="3.0.0"><emitter type="constant"/></scene>',
        "none.xml": '<scene version="3.0.0"/>',
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        message = refused(tmp_path / name)
        assert name in message or "no shapes" in message, message
    assert "does not exist" in refused(tmp_path / "missing.xml")
    refused(tmp_path)
    (tmp_path / "bytes.xml").write_bytes(bytes(range(256)))
    refused(str(tmp_path / "bytes.xml"))


@pytest.mark.parametrize(
    "source",
    [
        {},
        {"type": "sphere"},
        {"type": "scene"},
        {"type": "scene", "e": {"type": "constant"}},
        {"type": "scene", "a": {"type": "nonsense"}},
        {"type": "scene", "a": {"type": "sphere", "radius": "wide"}},
        {"type": "scene", "a": {"type": "sphere", "unknown": 1.0}},
        {"type": "scene", "a": {"type": "sphere", "bsdf": {"type": "ref", "id": "none"}}},
        {"type": 5},
    ],
    ids=str,
)
def test_dicts_that_are_no_scene(source):
    refused(source)


@pytest.mark.parametrize(
    "source", [None, 5, 1.5, [1], b"scene.xml", object()], ids=lambda s: type(s).__name__
)
def test_things_that_are_no_scene(source):
    """Neither a path, nor a dict, nor a scene: typed, and in one line."""
    refused(source)


def curve(path):
    """A shape that the points do not cover."""
    path.write_text("".join(f"0 {i} 0 0.1\n" for i in range(5)))
    return {"type": "bsplinecurve", "filename": str(path)}


def test_a_scene_of_shapes_that_cannot_be_sampled(tmp_path):
    """They cast shadows, but nothing is left to light; the message names their kind and what to
    use.
    """
    with pytest.raises(SceneError, match="BSplineCurve"):
        mi_prt.precompute(scene(hair=curve(tmp_path / "curve.txt")), directions="cubemap:4")


# --- parameters -----------------------------------------------------------------------------------


def test_parameters_of_a_file(tmp_path):
    """Values for <default> reach the scene as numbers or text; one that the file does not have is
    refused.
    """
    (tmp_path / "scene.xml").write_text(XML)
    for parameters, side, grey in [
        (None, 1, 0.5),
        ({"side": 3, "grey": "0.25"}, 3, 0.25),
        ({"side": 0.5}, 0.5, 0.5),
    ]:
        asset = mi_prt.precompute(
            tmp_path / "scene.xml", parameters, directions="cubemap:4", edge_length=10.0
        )
        assert np.abs(asset.points.positions).max() == pytest.approx(side)
        np.testing.assert_allclose(asset.points.albedo, grey, rtol=1e-5)
        assert asset.scene["parameters"] == {k: str(v) for k, v in (parameters or {}).items()}
        assert asset.scene["path"] == str(tmp_path / "scene.xml")
    refused(tmp_path / "scene.xml", parameters={"nonsense": 1})
    refused(tmp_path / "scene.xml", parameters={"side": "wide"})


def test_relative_paths_and_files_beside_the_scene(tmp_path, monkeypatch):
    """Meshes and textures are found next to the XML file, whatever the working folder."""
    folder = tmp_path / "a"
    folder.mkdir()
    mi.Bitmap(np.full((2, 2, 3), 0.25, np.float32)).write(str(folder / "grey.exr"))
    (folder / "mesh.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )
    (folder / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="obj"><string name="filename" value="mesh.obj"/><bsdf'
        ' type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename"'
        ' value="grey.exr"/></texture></bsdf></shape></scene>'
    )
    monkeypatch.chdir(tmp_path)
    asset = mi_prt.precompute("a/scene.xml", directions="cubemap:4", edge_length=10.0)
    np.testing.assert_allclose(asset.points.albedo, 0.25, rtol=1e-3)
    assert asset.scene["path"] == str(folder / "scene.xml")


# --- what is modelled -----------------------------------------------------------------------------

GREY = diffuse([0.2, 0.4, 0.6])
BUMPS = {
    "type": "bitmap",
    "bitmap": np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3),
    "raw": True,
}


def bumps():
    return BUMPS | {"bitmap": mi.Bitmap(BUMPS["bitmap"])}


# name: (material, words in what is left out, diffuse albedo of the front, two-sided)
MATERIALS = {
    "diffuse": (lambda: GREY, [], [0.2, 0.4, 0.6], False),
    "two-sided": (lambda: {"type": "twosided", "b": GREY}, [], [0.2, 0.4, 0.6], True),
    "rough conductor": (lambda: {"type": "roughconductor"}, ["RoughConductor"], [0, 0, 0], False),
    "dielectric": (lambda: {"type": "dielectric"}, ["Dielectric"], [0, 0, 0], False),
    "plastic": (
        lambda: {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.3}},
        ["SmoothPlastic"],
        [0.3] * 3,
        False,
    ),
    "rough plastic": (
        lambda: {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": 0.3}},
        ["RoughPlastic"],
        [0.3] * 3,
        False,
    ),
    "principled": (
        lambda: {"type": "principled", "base_color": {"type": "rgb", "value": [0.2, 0.4, 0.6]}},
        ["Principled"],
        [0.2, 0.4, 0.6],
        False,
    ),
    "principled, half metal": (
        lambda: {
            "type": "principled",
            "base_color": {"type": "rgb", "value": 0.8},
            "metallic": 0.5,
        },
        ["Principled"],
        [0.4] * 3,
        False,
    ),
    "principled, metal": (
        lambda: {"type": "principled", "metallic": 1.0},
        ["Principled"],
        [0] * 3,
        False,
    ),
    "bump map": (
        lambda: {"type": "bumpmap", "t": bumps(), "b": GREY},
        ["BumpMap"],
        [0.2, 0.4, 0.6],
        False,
    ),
    "normal map": (
        lambda: {
            "type": "normalmap",
            "normalmap": bumps(),
            "b": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.3}},
        },
        ["NormalMap", "SmoothPlastic"],
        [0.3] * 3,
        False,
    ),
    "mask": (
        lambda: {"type": "mask", "opacity": 0.5, "b": {"type": "twosided", "b": GREY}},
        ["Mask"],
        [0.2, 0.4, 0.6],
        True,
    ),
    "blend of diffuse": (
        lambda: {"type": "blendbsdf", "weight": 0.25, "a": GREY, "b": diffuse(1.0)},
        [],
        [0.4, 0.55, 0.7],
        False,
    ),
    "blend with metal": (
        lambda: {"type": "blendbsdf", "weight": 0.25, "a": GREY, "b": {"type": "conductor"}},
        ["Conductor"],
        [0.15, 0.3, 0.45],
        False,
    ),
    "two-sided plastic": (
        lambda: {
            "type": "twosided",
            "b": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.3}},
        },
        ["SmoothPlastic"],
        [0.3] * 3,
        True,
    ),
    "two-sided bump map": (
        lambda: {"type": "twosided", "b": {"type": "bumpmap", "t": bumps(), "b": GREY}},
        ["BumpMap"],
        [0.2, 0.4, 0.6],
        True,
    ),
    "front and metal back": (
        lambda: {"type": "twosided", "a": GREY, "b": {"type": "roughconductor"}},
        ["RoughConductor"],
        [0.2, 0.4, 0.6],
        True,
    ),
    "null": (lambda: {"type": "null"}, ["Null"], [0, 0, 0], False),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_materials(name):
    """The diffuse part that a plugin's manual names is modelled, the rest is named, with the shape
    and a share in 0…1.
    """
    material, words, albedo, two_sided = MATERIALS[name]
    asset = mi_prt.precompute(
        scene(thing=rectangle(bsdf=material(), id="thing"), other=disk(position=(0, 5, 0))),
        directions="cubemap:4",
        edge_length=1.0,
    )
    on_thing = asset.points.surface == 0
    front = np.flatnonzero(on_thing)[: on_thing.sum() // (2 if two_sided else 1)]
    np.testing.assert_allclose(
        asset.points.albedo[front], np.broadcast_to(albedo, (len(front), 3)), atol=1e-5
    )
    assert (asset.points.report["back_points"] > 0) == two_sided
    entries = asset.scene["left_out"]
    assert len(entries) == len(words)
    for word, entry in zip(
        words, sorted(entries, key=lambda e: [w in e["what"] for w in words].index(True))
    ):
        assert word in entry["what"] and entry["shapes"] == ["thing"] and -1 <= entry["share"] <= 1


def test_the_share_that_is_left_out_is_that_of_the_light():
    """At 45° over uv: all of a perfect mirror, none of a diffuse one behind a mask of opacity 1, a
    quarter of a blend.

    4,096 samples; a mirror's weight and a blend's stochastic choice give a standard error below
    0.01.
    """
    mirror = {"type": "conductor", "material": "none"}
    materials = {
        "mirror": (mirror, 1.0),
        "blend": ({"type": "blendbsdf", "weight": 0.25, "a": diffuse(0.5), "b": mirror}, 0.25),
        "opaque": ({"type": "mask", "opacity": 1.0, "b": diffuse(0.5)}, 0.0),
        "clear": (
            {"type": "mask", "opacity": 0.0, "b": diffuse(0.5)},
            0.5,
        ),  # all passes; half of it is modelled as reflected
    }
    for name, (material, share) in materials.items():
        asset = mi_prt.precompute(
            scene(a=rectangle(bsdf=material)), directions="cubemap:4", edge_length=1.0
        )
        assert asset.scene["left_out"][0]["share"] == pytest.approx(share, abs=0.05), name


def test_local_lights_are_listed_and_distant_ones_are_not():
    """Point, spot and area lights are not in the transport and said so; the shape of an area light
    is still a shape.
    """
    parts = scene(
        floor=rectangle(),
        lamp=rectangle(
            (0, -1, 0),
            (0, 2, 0),
            0.2,
            emitter={"type": "area", "radiance": {"type": "rgb", "value": 5.0}},
        ),
        bulb={"type": "point", "position": [0, 1, 0]},
        spot={"type": "spot"},
        sky={"type": "constant"},
        sun={"type": "directional", "direction": [0, -1, 0]},
    )
    opened = open_scene(parts)
    assert sorted(e.class_name() for e in opened.local_emitters) == [
        "AreaLight",
        "PointLight",
        "SpotLight",
    ]
    assert sorted(e.class_name() for e in opened.distant_emitters) == [
        "ConstantBackgroundEmitter",
        "DirectionalEmitter",
    ]
    asset = mi_prt.precompute(parts, transports="distant", directions="cubemap:4", edge_length=0.5)
    whats = " ".join(e["what"] for e in asset.scene["left_out"])
    assert (
        all(kind in whats for kind in ("AreaLight", "PointLight", "SpotLight"))
        and "Constant" not in whats
    )
    assert {s["name"] for s in asset.points.surfaces} == {"floor", "lamp"}


def test_shapes_without_points_are_named_and_cast_shadows(tmp_path):
    """A curve is not sampled: it is named among what is left out, and it takes light from the
    floor.
    """
    parts = dict(floor=rectangle(position=(0, -0.2, 0)))
    plain = mi_prt.precompute(scene(**parts), directions="cubemap:16", edge_length=0.5)
    asset = mi_prt.precompute(
        scene(**parts, hair=curve(tmp_path / "curve.txt")), directions="cubemap:16", edge_length=0.5
    )
    assert ["hair"] in [e["shapes"] for e in asset.scene["left_out"]]
    assert len(asset.points) == len(plain.points)
    assert asset.irradiance(uniform_sky()).min() < 0.995 * plain.irradiance(uniform_sky()).min()


# --- the modelled scene ---------------------------------------------------------------------------


def rendered(mi_scene, spp=64, seed=0):
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 40,
            "to_world": mi.ScalarTransform4f().look_at([0, 3, 4], [0, 0.3, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}},
        }
    )
    return np.array(
        mi.render(
            mi_scene,
            sensor=sensor,
            integrator=mi.load_dict({"type": "path", "max_depth": 2}),
            spp=spp,
            seed=seed,
        )
    )


def stage(coat, **lights):
    return scene(
        floor=rectangle(
            size=2,
            bsdf=(
                {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": 0.4}}
                if coat
                else diffuse(0.4)
            ),
        ),
        ball=sphere((0, 0.5, 0), 0.5, bsdf={"type": "roughconductor"} if coat else diffuse(0.0)),
        sky={"type": "constant", "radiance": 0.7},
        **lights,
    )


def test_the_modelled_scene_is_diffuse_and_without_local_light():
    """It renders as the scene written with diffuse materials and no lamps: equal but for noise, and
    without bias (1 %).
    """
    lamps = dict(
        bulb={"type": "point", "position": [0, 2, 0], "intensity": {"type": "rgb", "value": 20.0}},
        lamp=rectangle(
            (0, -1, 0),
            (1, 1, 1),
            0.3,
            emitter={"type": "area", "radiance": {"type": "rgb", "value": 9.0}},
            bsdf=diffuse(0.0),
        ),
    )
    dark_lamp = {"lamp": lamps["lamp"].copy()}
    del dark_lamp["lamp"]["emitter"]
    original = open_scene(stage(True, **lamps))
    modelled, expected = (
        rendered(original.relit({}, modelled=True)),
        rendered(mi.load_dict(stage(False, **dark_lamp), optimize=False)),
    )
    assert relative_l2(modelled, expected) < 0.03
    assert abs(bias(modelled, expected)) < 0.01
    # as written it is far brighter, before and after
    assert bias(rendered(original.mi_scene), expected) > 0.5


def test_the_modelled_scene_without_sky_is_black():
    """Only local emitters: with them dark nothing is left, and Mitsuba does not mind."""
    parts = scene(floor=rectangle(), bulb={"type": "point", "position": [0, 2, 0]})
    assert not rendered(open_scene(parts).relit({}, modelled=True), spp=4).any()


def test_a_scene_that_is_modelled_as_written_is_not_copied():
    opened = open_scene(stage(False))
    assert opened.relit({}, modelled=True) is opened.mi_scene


def test_a_loaded_scene_that_would_have_to_change_is_refused():
    """An mi.Scene cannot be opened again: refused with the remedy, and not changed behind the
    user's back.
    """
    with pytest.raises(SceneError, match="path or dict"):
        open_scene(mi.load_dict(stage(True))).relit({}, modelled=True)


def test_objects_inside_of_a_scene_dict_stay_as_they_are():
    """A dict may hold loaded objects; the modelled scene must not change them."""
    plastic = {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": 0.4}}
    shape = mi.load_dict(rectangle(bsdf=plastic))
    lamp = mi.load_dict(
        {"type": "point", "position": [0, 2, 0], "intensity": {"type": "rgb", "value": 20.0}}
    )
    parts = scene(floor=shape, lamp=lamp, sky={"type": "constant"})
    before = shape.bsdf().class_name(), np.array(mi.traverse(lamp)["intensity.value"])
    try:
        open_scene(parts).relit({}, modelled=True)
    except SceneError:
        pass  # to refuse is fine
    assert shape.bsdf().class_name() == before[0]
    np.testing.assert_array_equal(np.array(mi.traverse(lamp)["intensity.value"]), before[1])


def values_of(mi_scene):
    parameters = mi.traverse(mi_scene)
    return {
        key: np.array(
            parameters[key].matrix if hasattr(parameters[key], "matrix") else parameters[key]
        )
        for key in parameters.keys()
    }


def test_a_loaded_scene_is_untouched_by_precompute():
    """Every parameter is what it was, and the image too."""
    mi_scene = mi.load_dict(
        stage(True, bulb={"type": "point", "position": [0, 2, 0]}), optimize=False, parallel=False
    )
    before, image = values_of(mi_scene), rendered(mi_scene, spp=4)
    mi_prt.precompute(mi_scene, directions="cubemap:4", edge_length=1.0)
    after = values_of(mi_scene)
    assert before.keys() == after.keys()
    for key, value in before.items():
        np.testing.assert_array_equal(after[key], value, err_msg=key)
    np.testing.assert_array_equal(rendered(mi_scene, spp=4), image)


def test_a_scene_dict_is_untouched_by_precompute():
    parts = stage(True)
    copy = repr(parts)
    mi_prt.precompute(parts, directions="cubemap:4", edge_length=1.0)
    assert repr(parts) == copy


def test_a_loaded_merged_scene_gives_the_same_light():
    """mi.load_dict merges meshes by default; irradiance does not depend on it."""
    parts = scene(a=rectangle(bsdf=diffuse(), size=2), b=cube((0, 0.5, 0), 0.5, bsdf=diffuse()))
    settings = dict(directions="cubemap:8", edge_length=0.5)
    one, two = (
        mi_prt.precompute(parts, **settings),
        mi_prt.precompute(mi.load_dict(parts), **settings),
    )

    def summary(asset):
        order = np.lexsort(np.round(np.hstack([asset.points.positions, asset.points.normals]), 4).T)
        return asset.irradiance(uniform_sky())[order]

    np.testing.assert_allclose(summary(one), summary(two), rtol=0.02, atol=0.02)


# --- lights of a scene ----------------------------------------------------------------------------


def test_a_scene_without_distant_light_says_what_to_do():
    for lights in ({}, {"bulb": {"type": "point"}}):
        with pytest.raises(LightError, match="pass a light"):
            scene_light(open_scene(scene(floor=rectangle(), **lights)))


# --- hash -----------------------------------------------------------------------------------------


def test_the_hash_follows_geometry_and_sides_and_nothing_else():
    """What transport depends on changes it; light, colour, sensors, names and the kind of source do
    not.
    """
    base = dict(
        floor=rectangle(bsdf=diffuse(0.5)), ball=sphere((0, 1, 0), 0.5), box=cube((2, 0.5, 0), 0.5)
    )

    def hash_of(**changes):
        return open_scene(scene(**base | changes)).hash

    same = hash_of()
    assert hash_of() == same == open_scene(mi.load_dict(scene(**base), optimize=False)).hash
    assert hash_of(sky={"type": "constant"}) == same
    assert (
        hash_of(sky={"type": "envmap", "bitmap": mi.Bitmap(uniform_sky())}, lamp={"type": "point"})
        == same
    )
    assert hash_of(floor=rectangle(bsdf=diffuse(0.9))) == same
    assert hash_of(camera={"type": "perspective"}) == same
    different = [
        hash_of(floor=rectangle(position=(0, 1e-4, 0), bsdf=diffuse(0.5))),
        hash_of(floor=rectangle(flip_normals=True, bsdf=diffuse(0.5))),
        hash_of(floor=rectangle(bsdf={"type": "twosided", "b": diffuse(0.5)})),
        hash_of(ball=sphere((0, 1, 0), 0.501)),
        hash_of(ball=sphere((0, 1, 0), 0.5, flip_normals=True)),
        hash_of(box=cube((2, 0.5, 0), 0.5, flip_normals=True)),
        hash_of(more=disk()),
    ]
    assert len({same, *different}) == 1 + len(different)


def test_the_appearance_follows_every_channel_of_a_colour():
    """Reflected light depends on each of them."""
    colours = ([0.2, 0.4, 0.6], [0.3, 0.4, 0.6], [0.2, 0.5, 0.6], [0.2, 0.4, 0.7])
    assert len({open_scene(scene(a=rectangle(bsdf=diffuse(c)))).appearance for c in colours}) == 4


def test_the_hash_of_faceted_and_instanced_shapes(tmp_path):
    """A faceted mesh has no stored normals whose sign could tell that it was flipped; an instance
    may move.
    """
    (tmp_path / "mesh.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh = {"type": "obj", "filename": str(tmp_path / "mesh.obj"), "face_normals": True}
    hashes = [open_scene(scene(a=mesh | {"flip_normals": flip})).hash for flip in (False, True)]
    smooth = open_scene(scene(a=mesh | {"face_normals": False})).hash
    assert len({*hashes, smooth}) == 3
    moved = []
    for x in (0, 1):
        instance = {
            "type": "instance",
            "to_world": mi.ScalarTransform4f().translate([x, 0, 0]),
            "g": {"type": "ref", "id": "g"},
        }
        moved.append(open_scene(scene(g={"type": "shapegroup", "s": sphere()}, i=instance)).hash)
    assert moved[0] != moved[1]


def test_images_load_with_a_single_thread(tmp_path):
    """Mitsuba hands them to a worker of Dr.Jit, and without one waited forever: in a process of its
    own, which would hang.
    """
    root = Path(__file__).resolve().parent.parent
    program = (
        "import sys; from mi_prt.system.runtime import set_threads, thread_count; from"
        " mi_prt.scene.scene import open_scene; set_threads(1); open_scene(sys.argv[1]);"
        " print(thread_count())"
    )
    command = [sys.executable, "-c", program, str(root / "scenes" / "cornell_sky.xml")]
    assert subprocess.run(command, capture_output=True, text=True, timeout=120).stdout == "1\n"
