"""Small scenes after public reports of people who do this job (tests/cases), each once wrong.

Expectations are Mitsuba's own: its path tracer on the file as written, or its surface interactions.
Refusals are one line that names what is wrong and what to do.
"""

import gc
import warnings
from pathlib import Path

import numpy as np
import pytest

import mi_prt
from mi_prt.errors import LightError, RuntimeSetupError, SceneError, SettingsError
from mi_prt.evaluate.compare import compare
from mi_prt.lighting.environment import LightWarning
from mi_prt.lighting.from_mitsuba import distant_part
from mi_prt.precompute.forecast import describe
from mi_prt.render.image import render_image
from mi_prt.scene import interactions
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

CASES = Path(__file__).resolve().parent / "cases"
TINY = {"directions": "cubemap:8", "coefficients": 16, "edge_length": 1.0}
REFUSED = {
    "robust_sphere_r_0": "no extent",
    "robust_sphere_r_empty": "no extent",
    "robust_disk0": "no extent",
    "robust_inst_singular": "no extent",
    "robust_m_oor_ply": "vertex 7, and only the 3 vertices",
    "robust_b_oor_ply": "vertex 3, and only the 3 vertices",
    "robust_shape_merge": "no surface that light could meet",
    "robust_inst_empty": "holds no shapes",
    "robust_shape_shapegroup": "holds no shapes",
}


def case(name):
    return str(CASES / f"{name}.xml")


def lit_and_ratio(name, **settings):
    """An asset of a case, and the mean of its image over that of Mitsuba's path tracer, whose own
    noise is below 1 % of it.
    """
    mi = mitsuba()
    asset = mi_prt.precompute(case(name), **{"coefficients": 48} | settings)
    scene = open_scene(case(name)).mi_scene
    camera = scene.sensors()[0]
    found = render_image(asset, scene, camera, 4)
    path = mi.load_dict({"type": "path"})
    expected = np.array(mi.render(scene, sensor=camera, integrator=path, spp=64))[..., :3]
    return asset, found.mean() / expected.mean()


# --- what cannot be done is said at once ----------------------------------------------------------


@pytest.mark.parametrize("name", REFUSED)
def test_scenes_that_no_ray_can_meet_are_refused_in_one_line(name):
    with pytest.raises(SceneError, match=REFUSED[name]) as error:
        open_scene(case(name))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("run", [describe, mi_prt.precompute])
def test_light_that_cannot_be_used_is_refused_before_any_work(run):
    """Mitsuba distorts an environment whose to_world scales (half of its energy here)."""
    with pytest.raises(LightError, match="'sky_1'.*leave the scale out"):
        run(case("env_scale10"), **TINY)


def test_a_film_without_pixels_is_refused_unless_a_size_is_given(tmp_path):
    asset = mi_prt.precompute(case("robust_film_0"), **TINY)
    with pytest.raises(SettingsError, match="0x0.*--size"):
        mi_prt.relight_to_file(asset, tmp_path / "a.png", spp=1)
    mi_prt.relight_to_file(asset, tmp_path / "a.png", spp=1, size=(8, 6))


def test_a_scene_far_away_is_warned_of_and_does_not_crash():
    with pytest.warns(UserWarning, match="from the origin.*move it"):
        open_scene(case("far_utm"))


def test_lamps_alone_with_distant_transport_say_what_to_type():
    asset = mi_prt.precompute(case("in_lamp"), transports="distant", bounces=0, **TINY)
    with pytest.raises(LightError, match=r"--envmap sky\.exr.*--transports distant,own"):
        asset.irradiance()


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral"])
def test_the_plugin_in_other_variants_names_those_to_set(variant):
    """Mitsuba shows errors of plugins as text of its own."""
    mi = mitsuba()
    if variant not in mi.variants():
        pytest.skip(f"this Mitsuba has no {variant}")
    before = mi.variant()
    try:
        mi.set_variant(variant)
        with pytest.raises(RuntimeError, match="set_variant\\('llvm_ad_rgb'\\)"):
            mi.load_dict({"type": "prt", "filename": "none.prt"})
        with pytest.raises(RuntimeSetupError, match="llvm_ad_rgb"):
            open_scene(case("window_open"))
    finally:
        mi.set_variant(before)


# --- materials and films --------------------------------------------------------------------------


def test_a_room_of_nonlinear_plastic_is_as_bright_as_it_is():
    """Its parameter 0.7 is an albedo of 0.5; taken for one, the image is 71 % too bright."""
    asset, ratio = lit_and_ratio("plastic_room", directions="cubemap:16", edge_length=0.25)
    assert ratio == pytest.approx(1, abs=0.03)
    assert all(-0.05 < entry["share"] < 0.05 for entry in asset.scene["left_out"])


@pytest.mark.parametrize("kind", ["plastic", "roughplastic"])
@pytest.mark.parametrize("wrapped", ["", "twosided", "bumpmap", "normalmap", "blendbsdf"])
def test_albedo_of_nonlinear_plastics_is_what_mitsuba_scatters(kind, wrapped):
    """Of a texture too, at light of 20° off the normal: within 0.03, which is how much a coat's
    share differs from its mean up to 45°.
    """
    import drjit as dr

    mi = mitsuba()
    checks = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": [0.2, 0.5, 0.8]},
        "color1": {"type": "rgb", "value": [0.9, 0.7, 0.4]},
    }
    plastic = {"type": kind, "diffuse_reflectance": checks, "nonlinear": True}
    flat = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, "f4"))}
    bumps = {"nested_texture": flat} if wrapped == "bumpmap" else {"normalmap": flat}
    bsdf = {
        "": plastic,
        "twosided": {"type": "twosided", "b": plastic},
        "bumpmap": {"type": "bumpmap", **bumps, "b": plastic},
        "normalmap": {"type": "normalmap", **bumps, "b": plastic},
        "blendbsdf": {"type": "blendbsdf", "weight": 0.5, "a": plastic, "b": plastic},
    }[wrapped]
    shape = {"type": "rectangle", "bsdf": bsdf}
    surface = open_scene({"type": "scene", "shape": shape}).surfaces[0]
    count = 1 << 14
    for uv in ((0.1, 0.1), (0.1, 0.7)):
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.uv, si.t = mi.Point2f(*uv), 1.0
        si.wi = dr.normalize(mi.Vector3f(0.342, 0, 0.94))
        expected = mi.load_dict(plastic)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(1, count)
        _, weight = expected.sample(
            mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True
        )
        albedo = surface.material.modelled.eval_diffuse_reflectance(si)
        found, truth = (np.array(x).reshape(3, -1).mean(axis=1) for x in (albedo, weight))
        np.testing.assert_allclose(found, truth, atol=0.03)


def test_pictures_are_right_for_films_of_any_channels(tmp_path):
    """All films see the same scene, so what they hold is one picture: in colour, or its luminance
    (the Y row of sRGB's matrix) in all channels.
    """
    mi = mitsuba()
    asset = mi_prt.precompute(case("film_rgba"), **TINY)
    shown = {}
    for kind in ("rgba", "xyz", "xyza", "luminance", "luminance_alpha"):
        for renderer in ("mitsuba", "raster"):
            path = tmp_path / f"{kind}.exr"
            scene = case(f"film_{kind}")
            mi_prt.relight_to_file(asset, path, scene=scene, spp=1, size=(40, 30))
            shown[kind] = np.array(mi.Bitmap(str(path)))
            assert shown[kind].shape == (30, 40, 3), renderer
    for kind in ("xyz", "xyza"):
        np.testing.assert_allclose(shown[kind], shown["rgba"], atol=2e-4)
    grey = shown["rgba"] @ [0.212671, 0.715160, 0.072169]
    for kind in ("luminance", "luminance_alpha"):
        np.testing.assert_allclose(shown[kind], np.repeat(grey[..., None], 3, 2), atol=2e-4)
    report = compare(asset, tmp_path, scene=case("film_luminance"), spp=2, size=(40, 30))
    assert abs(report["image"]["bias"]) < 0.05
    mi_prt.relight_to_file(asset, tmp_path / "a.png", scene=case("film_luminance"), spp=1)


# --- maps -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", sorted(p.name for p in CASES.glob("sky*") if "extra" not in p.name)
)
def test_a_map_is_the_same_light_by_itself_and_in_a_scene(name):
    path = str(CASES / name)
    scene = open_scene(
        {"type": "scene", "sky": {"type": "envmap", "filename": path}, "ball": {"type": "sphere"}}
    )
    own = distant_part(scene.own_lights[0])
    np.testing.assert_array_equal(mi_prt.EnvironmentMap(path).pixels, own.pixels)


# --- the plugin, and scenes that Mitsuba's loader merged ------------------------------------------


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("points", [{"edge_length": 1.0}, {"count": 300}])
def test_the_plugin_warns_of_other_materials(merged, points, tmp_path):
    """Once for each change: in another file, and after an edit. The same materials are no change,
    whatever shapes the loader merged.
    """
    mi = mitsuba()
    few = {"directions": "cubemap:8", "coefficients": 8}
    mi_prt.precompute(case("window_open"), **few, **points).save(tmp_path / "a.prt")
    plugin = mi.load_dict({"type": "prt", "filename": str(tmp_path / "a.prt")})

    def warned(scene):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            np.array(mi.render(scene, integrator=plugin, spp=1))
        return [w for w in found if issubclass(w.category, LightWarning)]

    scene = mi.load_file(case("window_open"), optimize=merged)
    assert not warned(scene)
    parameters = mi.traverse(scene)
    key = next(k for k in parameters.keys() if k.endswith("reflectance.value"))
    parameters[key] = mi.Color3f(0.2, 0.1, 0.9)
    parameters.update()
    assert len(warned(scene)) == 1 and not warned(scene)
    assert len(warned(mi.load_file(case("window_repainted"), optimize=merged))) == 1


def test_a_scene_whose_shapes_were_merged_can_be_precomputed():
    """Mitsuba gives merged meshes no bounding box; the vertices have one."""
    merged = open_scene(mitsuba().load_file(case("window_open")))
    written = open_scene(case("window_open"))
    assert len(merged.surfaces) < len(written.surfaces)
    np.testing.assert_allclose(merged.bounds, written.bounds)
    assert len(mi_prt.precompute(merged, bounces=0, **TINY).points) > 0


# --- ids, and many shapes -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ['Tree "oak" [v2]', "a\nb", "光 ]", "17", 'ShapeGroup[ name = "x"']
)
def test_groups_of_any_name_are_told_apart(name):
    mi = mitsuba()
    groups = {
        label: {"type": "shapegroup", "shape": {"type": kind}}
        for label, kind in (("other", "cube"), ("group", "sphere"))
    }
    scene = mi.load_dict({"type": "scene", **groups}, optimize=False)
    parts = [child for _, child in _children(scene)]
    for part, renamed in zip(parts, (name + "'", name)):
        part.set_id(renamed)
    instances = {
        f"i{k}": {"type": "instance", "group": part} for k, part in enumerate([*parts, parts[0]])
    }
    whole = mi.load_dict(
        {"type": "scene", **{f"g{k}": part for k, part in enumerate(parts)}, **instances},
        optimize=False,
    )
    for part, renamed in zip(parts, (name + "'", name)):
        part.set_id(renamed)
    kinds = [s.shape.class_name() for s in open_scene(whole).surfaces]
    assert kinds == [parts_kind(p) for p in (*parts, parts[0])]
    assert {part.id() for part in parts} == {name + "'", name}


def _children(scene):
    from mi_prt.scene.traversal import children

    return [entry for entry in children(scene) if entry[1].class_name() == "ShapeGroupPlugin"]


def parts_kind(group):
    from mi_prt.scene.traversal import children

    return children(group)[0][1].class_name()


def test_a_group_named_with_quotes_is_opened():
    assert len(open_scene(case("forest_quote")).surfaces) == 7


@pytest.mark.filterwarnings("ignore:the scene of 11.4 m")
@pytest.mark.parametrize("name", ["forest40", "forest_two", "window_open", "far_utm"])
def test_interactions_from_the_table_are_mitsubas(name, monkeypatch):
    """All that materials and points ask of a hit, in float32 (positions far off are coarser)."""
    import drjit as dr

    mi = mitsuba()
    monkeypatch.setattr(interactions, "FEW_SHAPES", 0)
    scene = open_scene(case(name))
    rng = np.random.default_rng(1)
    low, high = scene.bounds
    size = np.linalg.norm(high - low)
    origins = (low + high)[:, None] / 2 + size * mi_directions(rng, 20_000).T
    targets = low[:, None] + (high - low)[:, None] * rng.random((3, 20_000))
    toward = (targets - origins) / np.linalg.norm(targets - origins, axis=0)
    ray = mi.Ray3f(mi.Point3f(origins.astype("f4")), mi.Vector3f(toward.astype("f4")))
    pi = scene.mi_scene.ray_intersect_preliminary(ray)
    found, expected = scene.interaction(pi, ray, True), pi.compute_surface_interaction(ray)
    hit = np.array(expected.is_valid())
    assert hit.sum() > 1000
    np.testing.assert_array_equal(np.array(found.is_valid()), hit)
    for field in ("shape", "instance"):
        same = getattr(found, field) == getattr(expected, field)
        assert bool(dr.all(same | ~expected.is_valid()))
    step = 4 * float(np.spacing(np.float32(np.abs(scene.bounds).max())))

    def values(si, field):
        return np.array(si.sh_frame.n if field == "shading" else getattr(si, field))[..., hit]

    np.testing.assert_array_equal(values(found, "prim_index"), values(expected, "prim_index"))
    assert np.abs(values(found, "p") - values(expected, "p")).max() < max(step, 1e-3)
    if name != "far_utm":  # there an ulp is half a metre, and normals follow rounding
        for field in ("n", "shading", "uv"):
            assert np.abs(values(found, field) - values(expected, field)).max() < 1e-3
        z = values(found, "wi")[2] - values(expected, "wi")[2]
        assert np.abs(z).max() < 1e-3


def mi_directions(rng, count):
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_a_forest_of_instances_is_lit_as_mitsuba_lights_it():
    """40 trees of a mesh and a cylinder, some mirrored."""
    assert lit_and_ratio("forest40", **TINY | {"directions": "cubemap:16"})[1] == pytest.approx(
        1, abs=0.03
    )
    gc.collect()  # shapes that are alive cost every kernel of later tests
