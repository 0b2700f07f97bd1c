"""A scene's own lights: names, dimmers, what they are in a scene, and truth under them."""

import numpy as np
import pytest
from conftest import diffuse, rectangle, relative_l2, scene, sphere

from mi_prt import DirectionalLight, LightError, PointLight, SceneError, SceneLight
from mi_prt.evaluate.ground_truth import point_irradiance
from mi_prt.lighting.emission import emission_of
from mi_prt.lighting.light import as_light
from mi_prt.lighting.local_emitters import local_scene_light
from mi_prt.lighting.own_light import Lamp, resolve
from mi_prt.lighting.parse import parse_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.points import sample_points
from mi_prt.scene.own_lights import dim
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()

XML = """<scene version="3.0.0">
<shape type="shapegroup" id="group"><shape type="sphere"/></shape>
<shape type="instance"><ref id="group"/></shape>
<emitter type="constant"/>
<shape type="sphere"><emitter type="area"/></shape>
<shape type="rectangle" id="panel"><emitter type="area"/></shape>
<shape type="instance" id="another"><ref id="group"/></shape>
<shape type="disk"><emitter type="area" id="lid"/></shape>
<emitter type="point"/> <emitter type="spot" id="lamp_6"/> <emitter type="point"/>
<emitter type="directional" id="sun"/> <emitter type="point" id="emitter"/>
</scene>"""
NAMES = ["sky_1", "lamp_1", "panel", "lid", "lamp_4", "lamp_6", "lamp_6#2", "sun", "emitter"]


def rgb(value):
    return {"type": "rgb", "value": value}


def room(**changed):
    """A floor under a sky, a textured panel, a bulb, a spot and a ball that shines."""
    picture = np.random.default_rng(1).random((4, 4, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True}
    parts = {
        "floor": rectangle(size=2, bsdf={"type": "plastic"}),
        "sky": {"type": "constant", "radiance": rgb([0.1, 0.2, 0.3])},
        "sun": {"type": "directional", "direction": [0.2, -1, 0], "irradiance": rgb([1, 0.9, 0.8])},
        "panel": rectangle(
            (0, -1, 0), (-1, 1.5, 0), 0.3, emitter={"type": "area", "radiance": texture}
        ),
        "ball": sphere((1, 1, 1), 0.2, emitter={"type": "area", "radiance": rgb([3, 2, 1])}),
        "bulb": {"type": "point", "position": [0, 1, 0], "intensity": rgb([1, 2, 3])},
        "spot": {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([0, 1.5, 1], [0, 0, 0], [1, 0, 0]),
            "intensity": rgb([5, 4, 3]),
            "cutoff_angle": 50.0,
        },
    }
    return scene(**parts | changed)


def truth(mi_scene, spp=1 << 12):
    points = sample_points(open_scene(scene(floor=rectangle(size=2))), 0.5)
    return point_irradiance(mi_scene, points, spp)


# --- names ----------------------------------------------------------------------------------------


def test_names(tmp_path):
    """Ids where the author gave one, of the shape before the emitter's; else numbers among the
    lamps or skies. A name that is taken gets a number. The same whenever it is loaded: ids that
    Mitsuba makes up hold addresses.
    """
    (tmp_path / "scene.xml").write_text(XML)
    for opened in (open_scene(tmp_path / "scene.xml") for _ in range(2)):
        found = {own.name: own for own in opened.own_lights}
        assert list(found) == NAMES
        assert [n for n, own in found.items() if own.is_distant] == ["sky_1", "sun"]
        assert found["panel"].shape.id() == "panel" and found["lamp_4"].shape is None
        assert found["lamp_6"].kind == "SpotLight" and found["lamp_6#2"].kind == "PointLight"
    keep = {name: 1 for name in NAMES if name not in ("sky_1", "sun")}
    again = open_scene(lit_scene(opened))
    assert [own.name for own in again.own_lights] == NAMES and opened.relit(keep) is opened.mi_scene


def test_names_of_dicts_are_their_keys():
    parts = room(other=mi.load_dict(sphere((0, 3, 0), 0.1, emitter={"type": "area"})))
    names = [own.name for own in open_scene(parts).own_lights]
    assert sorted(names) == ["ball", "bulb", "other", "panel", "sky", "spot", "sun"]


# --- texts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "name", "factor"),
    [
        ("scene", None, [1, 1, 1]),
        ("scene:bulb", "bulb", [1, 1, 1]),
        ("scene:bulb*0.3", "bulb", [0.3] * 3),
        ("scene*0.5,0.4,0.3", None, [0.5, 0.4, 0.3]),
        ("scene:lamp_6#2*1e-1", "lamp_6#2", [0.1] * 3),
        ("scene:a:b", "a:b", [1, 1, 1]),
    ],
)
def test_texts(text, name, factor):
    for light in (parse_light(text), *as_light(text).parts):
        assert light.name == name and light.of_scene
        np.testing.assert_allclose(light.factor, factor)


@pytest.mark.parametrize("text", ["scene:", "scene*", "scene*-1", "scene*1,2", "scene*nan", "scen"])
def test_texts_that_are_refused(text):
    with pytest.raises(LightError) as caught:
        parse_light(text)
    assert f"light '{text}'" in str(caught.value) and "\n" not in str(caught.value)


# --- in a scene -----------------------------------------------------------------------------------


def test_resolved():
    """Distant emitters become parts of their own, local ones lamps; all else stays."""
    opened = open_scene(room())
    bulb = PointLight([0, 1, 0], 1)
    light = resolve(["scene", bulb], opened)
    assert len(light.parts) == len(opened.own_lights) + 1 and light.parts[-1] is bulb
    assert sorted(p.kind for p in light.distant.parts) == ["directional", "envmap"]
    assert {p.own_name for p in light.local.parts[:-1]} == {"panel", "ball", "bulb", "spot"}
    for own in (None, "scene", SceneLight()):
        assert len(resolve(own, opened).parts) == len(opened.own_lights)
    again = resolve(light, opened)
    assert again.parts == light.parts
    for name in ("nobody", "lamp_1"):
        with pytest.raises(LightError, match=f"no light '{name}'; it has .*ball") as caught:
            resolve(SceneLight(name), opened)
        assert "\n" not in str(caught.value)
    with pytest.raises(LightError, match="no light of its own"):
        resolve(None, open_scene(scene(floor=rectangle())))


def test_turned_and_dimmed_before_it_is_known():
    """`rotated` and `scaled` of the scene's light are those of what it is."""
    opened = open_scene(room())
    light = resolve(0.5 * SceneLight("sun").rotated("x", 30).rotated("y", 20), opened)
    (sun,) = resolve("scene:sun", opened).parts
    expected = sun.rotated("x", 30).rotated("y", 20) * 0.5
    np.testing.assert_array_equal(light.parts[0].direction, expected.direction)
    np.testing.assert_array_equal(light.parts[0].irradiance, expected.irradiance)
    (lamp,) = (SceneLight("bulb").rotated("x", 30) * [1, 2, 3]).resolved(_Open(opened))
    np.testing.assert_array_equal(lamp.factor, [1, 2, 3])


class _Open:
    def __init__(self, opened):
        self.opened_scene = opened

    def named(self, name):
        return [(o.name, o.is_distant, o) for o in self.opened_scene.own_lights if o.name == name]


def test_lamps_are_known_by_name_without_the_scene():
    """The scene is opened only for distant light, and for the light that a lamp sends."""
    opened, count = open_scene(room()), [0]
    names = {own.name: own.is_distant for own in opened.own_lights}

    def opener():
        count[0] += 1
        return opened

    (lamp,) = resolve("scene:ball*0.5", opener, names).parts
    assert (lamp.own_name, lamp.own, count[0]) == ("ball", None, 0)
    with pytest.raises(LightError, match="pass the scene"):
        lamp.emission()
    (known,) = resolve(lamp, opened).parts
    assert known.own.emitter is next(o.emitter for o in opened.own_lights if o.name == "ball")
    assert len(resolve(None, opener, names).parts) == 6 and count[0] == 1
    with pytest.raises(LightError, match="nobody"):
        resolve("scene:nobody", None, names)
    for light in ("scene:sky", "scene"):
        with pytest.raises(LightError, match="pass the scene"):
            resolve(light, None, names)
    with pytest.raises(LightError, match="pass the scene"):
        resolve("scene", None)


def test_a_lamp_emits_what_its_emitter_does():
    """Bit for bit what the scene's local light is, one emitter at a time; dimmed, a multiple."""
    opened = open_scene(room())
    every = local_scene_light(opened)
    lamps = resolve(None, opened).local
    for part, lamp in zip(every.parts, lamps.parts, strict=True):
        for name, values in part.emission().exact.items():
            np.testing.assert_array_equal(lamp.emission().exact[name], values)
        np.testing.assert_allclose(
            (lamp * [0.5, 0, 2]).emission().intensity,
            part.emission().intensity * [0.5, 0, 2],
            rtol=1e-6,
        )
    np.testing.assert_array_equal(emission_of(lamps).intensity, emission_of(every).intensity)
    with pytest.raises(LightError, match="moved"):
        lamps.parts[0].moved([0, 0, 0])
    with pytest.raises(LightError, match="lit_scene"):
        Lamp("bulb").to_mitsuba()


# --- what changed ---------------------------------------------------------------------------------


def test_strength_and_digest_tell_what_was_edited():
    """Light is proportional to strength while the digest stays; all else changes the digest, but
    not that of the others. Names do not count.
    """
    before = {own.name: own for own in open_scene(room()).own_lights}
    np.testing.assert_allclose(before["bulb"].strength, [1, 2, 3])
    np.testing.assert_allclose(before["ball"].strength, [3, 2, 1])
    assert before["panel"].strength is None

    def edited(name, **changed):
        return {own.name: own for own in open_scene(room(**{name: changed})).own_lights}

    bulb = {"type": "point", "position": [0, 1, 0], "intensity": rgb([2, 2, 2])}
    same = edited("bulb", **bulb)
    assert all(own.digest() == before[name].digest() for name, own in same.items())
    np.testing.assert_allclose(same["bulb"].strength / before["bulb"].strength, [2, 1, 2 / 3])
    lamp = {"type": "area", "radiance": rgb([3, 2, 1])}
    for name, changed in {
        "bulb": bulb | {"position": [0, 1, 0.1]},
        "ball": sphere((1, 1, 1), 0.21, emitter=lamp),
        "spot": {"type": "spot", "intensity": rgb([5, 4, 3])},
        "panel": rectangle((0, -1, 0), (-1, 1.5, 0), 0.3, emitter=lamp),
    }.items():
        now = edited(name, **changed)
        assert {n for n in now if now[n].digest() != before[n].digest()} == {name}
    textures = (
        {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), x, np.float32)), "raw": True}
        for x in (1.0, 2.0)
    )
    digests = {
        edited("panel", **rectangle(emitter={"type": "area", "radiance": t}))["panel"].digest()
        for t in textures
    }
    assert len(digests) == 2


# --- truth ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("modelled", [False, True])
def test_truth_under_dimmed_lamps_is_the_sum_of_single_lamps(modelled):
    """Light is linear, by Mitsuba: each lamp alone as written, times its factor, and their sum.
    Each truth's noise is known; the sum's is at most their root mean square times the factors, and
    three times it is allowed for (a relative RMSE over 81 points beyond it has p < 1e-6).
    """
    opened = open_scene(room())
    factors = {"panel": [0.5, 1, 2], "ball": [2, 2, 2], "spot": [0, 1, 0.25], "sun": [0.5] * 3}
    alone = {name: truth(lit_scene(opened, f"scene:{name}", modelled)) for name in factors}
    expected = sum(alone[name].mean * factors[name] for name in factors)
    light = [SceneLight(name) * factor for name, factor in factors.items()]
    together = truth(lit_scene(opened, light, modelled))
    noise = np.hypot(together.noise, max(reference.noise for reference in alone.values()))
    assert noise < 0.03 and all(reference.mean.max() > 0 for reference in alone.values())
    assert relative_l2(together.mean, expected) < 3 * noise
    assert opened.own_lights[0].emitter is open_scene(opened).own_lights[0].emitter


def test_a_lamp_that_is_named_twice_shines_twice():
    opened = open_scene(room())
    once = truth(lit_scene(opened, "scene:bulb*3"), 2)
    twice = truth(lit_scene(opened, ["scene:bulb", "scene:bulb*2"]), 2)
    np.testing.assert_allclose(twice.mean, once.mean, rtol=1e-6)
    np.testing.assert_allclose(
        once.mean, 3 * truth(lit_scene(opened, "scene:bulb"), 2).mean, rtol=1e-5
    )


def test_own_sky_stays_the_same_object_where_it_is_as_written():
    """So that truth does not pass through this program's maps; turned, dimmed or beside another map
    it is replaced.
    """
    opened = open_scene(room())
    own = {o.name: o.emitter for o in opened.own_lights if o.is_distant}

    def distant(light, **rest):
        lit = open_scene(lit_scene(opened, light, **rest))
        return {o.name: o.emitter for o in lit.own_lights if o.is_distant}

    for light in (None, "scene", ["scene:sky", "scene:sun"], ["scene", PointLight([0, 1, 0], 1)]):
        assert distant(light) == own and distant(light, modelled=True) == own
    assert distant("scene:sky") == {"sky": own["sky"]}
    assert distant(["scene", DirectionalLight([0, -1, 0], 1)]).items() >= own.items()
    for light in ("scene*0.5", SceneLight().rotated("x", 1)):
        assert not set(distant(light).values()) & set(own.values())
    for light in (["scene", "scene"], ["scene", np.ones((2, 4, 3))]):
        found = distant(light)
        assert own["sky"] not in found.values() and own["sun"] in found.values()
    assert distant(PointLight([0, 1, 0], 1)) == {}


def test_an_edited_sky_is_looked_up_anew():
    """What was found of a scene's sky is not taken for what it is after an edit."""
    opened = open_scene(room())
    before = resolve("scene:sun", opened)
    sun = next(own.emitter for own in opened.own_lights if own.name == "sun")
    parameters = mi.traverse(sun)
    parameters["irradiance.value"] = mi.Color3f(4, 5, 6)
    parameters.update()
    (after,) = resolve("scene:sun", opened).parts
    np.testing.assert_allclose(after.irradiance, [4, 5, 6])
    (shown,) = (o.emitter for o in open_scene(lit_scene(opened, before)).own_lights if o.is_distant)
    np.testing.assert_allclose(
        np.array(mi.traverse(shown)["irradiance.value"]).ravel(), [1, 0.9, 0.8]
    )


def test_lamps_that_cannot_be_dimmed():
    """Refused by name with what to do: a colour on a spectrum of one number, and an emitter whose
    light is no number at all. Left out, as written or by a grey factor the grey one is no problem.
    """
    lamp = sphere((0, 1, 0), 0.1, emitter={"type": "area"})
    opened = open_scene(scene(floor=rectangle(bsdf=diffuse()), lamp=lamp))
    with pytest.raises(LightError, match="'lamp' is grey") as caught:
        lit_scene(opened, SceneLight("lamp") * [1, 0.5, 0.5])
    assert "\n" not in str(caught.value)
    assert not truth(lit_scene(opened, PointLight([0, 5, 0], 0)), 16).mean.any()
    whole, half = (truth(lit_scene(opened, f"scene:lamp*{x}"), 64) for x in (1, 0.5))
    np.testing.assert_allclose(half.mean, whole.mean / 2, rtol=1e-5)
    with pytest.raises(LightError, match="'sky' cannot be dimmed.*no number"):
        dim(mi.load_dict({"type": "sunsky"}), np.full(3, 0.5), "sky")


def test_a_grey_texture_takes_colours():
    """A picture of one channel becomes one of three."""
    grey = np.random.default_rng(2).random((4, 4, 1)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(grey), "raw": True}
    lamp = rectangle((0, -1, 0), (0, 1, 0), 0.5, emitter={"type": "area", "radiance": texture})
    opened = open_scene(scene(floor=rectangle(bsdf=diffuse()), lamp=lamp))
    white, red = (truth(lit_scene(opened, light), 256) for light in ("scene", "scene*2,0.5,0"))
    np.testing.assert_allclose(red.mean, white.mean * [2, 0.5, 0], rtol=1e-4, atol=1e-6)


def test_objects_are_not_dimmed_behind_the_users_back():
    opened = open_scene(mi.load_dict(room()))
    with pytest.raises(SceneError, match="Mitsuba objects"):
        lit_scene(opened, "scene:ball*0.5")
    np.testing.assert_allclose(
        next(own.strength for own in opened.own_lights if own.name == "ball"), [3, 2, 1]
    )


def test_dimmers_multiply():
    """Half of a half is a quarter, whether the light has been looked up in a scene or not."""
    for light in (SceneLight("lamp"), Lamp("lamp")):
        twice = (light * 0.5) * (0.5, 1, 2)
        np.testing.assert_allclose(twice.factor, [0.25, 0.5, 1.0])
