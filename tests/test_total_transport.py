"""Assets of transport with reflections: colours, bases, errors told against errors found, settings,
and pictures.
"""

import json
import warnings

import numpy as np
import pytest
from conftest import (
    NOTHING,
    bias,
    cube,
    diffuse,
    distant,
    rectangle,
    relative_l2,
    sampled,
    scene,
    sky_of,
    uniform_sky,
)

import mi_prt
from mi_prt import LightWarning, SceneError, SettingsError
from mi_prt.asset.provenance import open_scene_of
from mi_prt.precompute.settings import Settings
from mi_prt.render.integrator import integrator_for
from mi_prt.system.runtime import mitsuba

mi = mitsuba()


def corner(floor=0.8, wall=0.5, card=0.9, **rest):
    """A floor between two walls, and a card that leans between them."""
    return scene(
        floor=rectangle((0, 1, 0), (0, -1, 0), bsdf=diffuse(floor)),
        left=rectangle((1, 0, 0), (-1, 0, 0), bsdf=diffuse(wall)),
        back=rectangle((0, 0, 1), (0, 0, -1), bsdf=diffuse(wall)),
        card=rectangle((-0.5, -0.3, -0.7), (0.3, -0.3, 0.4), 0.6, bsdf=diffuse(card)),
        **rest,
    )


def quadratic_sky(d):
    """Radiance (k, 3) of harmonics up to the second band."""
    x, y, z = d.T
    return np.stack([1 + 0.5 * y + 0.3 * x, 1 - 0.4 * z + 0.3 * x * x, 0.8 + 0.4 * x * y], axis=-1)


SKY = sky_of(quadratic_sky, 64)
SMALL = dict(directions="cubemap:8", edge_length=1.0, paths_per_point=64, bounces=2, denoise=False)


def precompute(parts, **settings):
    return mi_prt.precompute(parts, **(SMALL | settings))


def lossless(parts, **settings):
    """One principal component less than there are points: with the mean, all that any transport of
    theirs can have.
    """
    return precompute(
        parts,
        coefficients=len(sampled(parts, SMALL["edge_length"], SMALL["directions"]).points) - 1,
        **settings,
    )


# --- colours --------------------------------------------------------------------------------------


@pytest.mark.parametrize("indirect", ["solve", "paths"])
def test_each_colour_is_the_grey_scene_of_its_albedos(indirect):
    """Light of one colour is reflected by the albedos of that colour alone; rays are the same, so
    it holds to rounding.

    Transport is (n, 3, s) where anything is coloured, and (n, s) where all is grey.
    """
    albedos = dict(floor=[0.8, 0.5, 0.2], wall=[0.3, 0.9, 0.6], card=[0.9, 0.05, 0.4])
    coloured = lossless(corner(**albedos), indirect=indirect)
    assert distant(coloured).channels == 3
    assert distant(coloured).total.rows(slice(0, 5)).shape == (5, 3, 384)
    result = coloured.irradiance(SKY)
    for channel in range(3):
        grey = lossless(
            corner(**{name: rgb[channel] for name, rgb in albedos.items()}), indirect=indirect
        )
        assert distant(grey).channels == 1
        assert distant(grey).total.rows(slice(0, 5)).shape == (5, 384)
        expected = grey.irradiance(SKY)[:, channel]
        assert relative_l2(result[:, channel], expected) < 3e-4
    assert relative_l2(result[:, 0], result[:, 1]) > 0.02


def test_equal_channels_are_the_grey_scene():
    """Two channels of 0.5 beside one that differs just enough to count as colour: the two are those
    of the grey scene.
    """
    grey = lossless(corner(0.5, 0.5, 0.5))
    coloured = lossless(corner([0.5, 0.5, 0.502], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]))
    assert distant(grey).channels == 1 and distant(coloured).channels == 3
    expected, result = (asset.irradiance(SKY) for asset in (grey, coloured))
    assert relative_l2(result[:, :2], expected[:, :2]) < 3e-4
    assert 1e-6 < bias(result[:, 2], expected[:, 2]) < 2e-3


# --- bases ----------------------------------------------------------------------------------------


def test_bases_that_lose_nothing_give_the_same_light():
    """All wavelets, all principal components, and harmonics beyond those of the sky: compression
    has no part in what light does.
    """
    parts = corner([0.8, 0.5, 0.2])
    reference = lossless(parts)
    assert distant(reference).report["relative_error"] < 1e-3
    expected = reference.irradiance(SKY)
    wavelets = precompute(parts, basis="haar-shared", coefficients=384)
    assert relative_l2(wavelets.irradiance(SKY), expected) < 3e-4
    harmonics = precompute(parts, basis="sh", coefficients=36)
    assert relative_l2(harmonics.irradiance(SKY), expected) < 3e-3
    # it does lose, but nothing that this sky holds
    assert distant(harmonics).report["relative_error"] > 0.05
    for found in (distant(wavelets), distant(harmonics)):
        assert found.report["bounce_energy"] == distant(reference).report["bounce_energy"]
        assert found.coefficients.shape == (len(expected), 3, len(found.basis))


@pytest.mark.parametrize("basis", ["haar", "none"])
def test_bases_of_direct_light_refuse_reflections(basis):
    """They hold direct transport only: that is their default, and anything else is refused with the
    way out.
    """
    assert Settings(basis=basis).distant_bounces == 0
    assert Settings(basis=basis, bounces=0).distant_bounces == 0
    for bounces in (1, "auto"):
        with pytest.raises(
            SettingsError, match=f"basis {basis} holds direct transport only, got bounces {bounces}"
        ):
            Settings(basis=basis, bounces=bounces)


def total_matrix(scene_, rays):
    """Transport (n, s) of a grey scene after one reflection and none, formed row by row as no
    precomputation holds it.

    The operator is dense, and the mean of those of both halves of the rays.
    """
    direct = np.asarray(scene_.transport).astype(np.float64)
    return direct + sum(dense(half) for half in scene_.hops(rays).halves()) @ direct / 2


def dense(hops):
    """The operator (n, n) of grey hops, written out."""
    rays = np.ascontiguousarray(hops.rays).view([("point", "<u4"), ("albedo", "<f4", 3)])[
        :, hops.first :: hops.stride
    ]
    operator = np.zeros((len(rays), len(rays)))
    for i, row in enumerate(rays):
        for ray in row[row["point"] != NOTHING]:
            operator[i, ray["point"]] += hops.blocked[i] * ray["albedo"][0] / len(row)
    return operator


def captured(asset, total):
    """Captured variance and relative error of an asset against the whole matrix, in the √w-weighted
    norm.
    """
    weights, kept = np.sqrt(distant(asset).directions.solid_angles), ~asset.buried
    total, result = (
        total[kept] * weights,
        distant(asset).total.rows(np.flatnonzero(kept)).astype(np.float64) * weights,
    )
    residual = np.sum((total - result) ** 2)
    return 1 - residual / np.sum((total - total.mean(axis=0)) ** 2), np.sqrt(
        residual / np.sum(total**2)
    )


@pytest.fixture(scope="module", params=[0.2, 0.95])
def boxed(request):
    """Walls of one albedo, and a cube on the floor: some points are buried.

    The scene, and its total transport.
    """
    parts = corner(
        *[request.param] * 3, box=cube((-0.5, -0.6, -0.5), 0.4, bsdf=diffuse(request.param))
    )
    scene_ = sampled(parts, 0.5, SMALL["directions"])
    assert 0 < scene_.buried.sum() < 10
    return parts, total_matrix(scene_, 64)


ONCE = dict(bounces=1, edge_length=0.5)


@pytest.mark.parametrize("basis", ["pca", "sh", "haar-shared"])
def test_reported_errors_are_those_of_the_whole_matrix(basis, boxed):
    """Captured variance and relative error, told from coefficients, against total transport formed
    as a matrix (n, s).

    What reflections do to the part that is lost is told by 16 random probes, hence 3 %; leaving it
    out errs by 9 % at albedo 0.95.
    """
    parts, total = boxed
    asset = precompute(parts, basis=basis, coefficients=16, **ONCE)
    variance, error = captured(asset, total)
    assert 0.3 < variance < 0.99
    assert distant(asset).report["captured_variance"] == pytest.approx(variance, abs=0.01)
    assert distant(asset).report["relative_error"] == pytest.approx(error, rel=0.03)


def test_share_of_the_variance_is_that_of_total_transport(boxed):
    """`coefficients='auto'` captures the share of total transport, not of direct transport; and
    without waste.
    """
    parts, total = boxed
    short = []
    for share in (0.9, 0.95, 0.99):
        asset = precompute(parts, coefficients="auto", variance=share, **ONCE)
        assert distant(asset).report["captured_variance"] >= share
        short.append(share - captured(asset, total)[0])
        fewer = precompute(parts, coefficients=int(0.9 * len(distant(asset).basis)), **ONCE)
        assert captured(fewer, total)[0] < share
    assert max(short) < 0.002


@pytest.mark.parametrize(("indirect", "tolerance"), [("paths", 0.05), ("solve", 0.25)])
def test_reported_noise_is_what_other_seeds_show(indirect, tolerance):
    """`indirect_noise`, told from two halves of the rays, against the spread of whole transport
    over four seeds.

    In a basis that loses nothing and is the same for all. Those of `solve` are stratified, so that
    their halves overstate it.
    """
    parts = corner(0.8, [0.7, 0.3, 0.3])
    settings = dict(
        indirect=indirect,
        basis="haar-shared",
        coefficients=384,
        edge_length=0.5,
        paths_per_point=128,
    )
    found = [distant(precompute(parts, seed=seed, **settings)) for seed in range(4)]
    weights = np.sqrt(found[0].directions.solid_angles)
    spread = np.sqrt(
        np.var([one.total.rows(slice(None)) * weights for one in found], axis=0, ddof=1).sum() / 3
    )
    direct = np.linalg.norm(
        np.asarray(sampled(parts, 0.5, SMALL["directions"]).transport) * weights
    )
    for one in found:
        assert one.report["indirect_noise"] == pytest.approx(spread / direct, rel=tolerance)


def test_energy_told_of_each_reflection():
    """`bounce_energy` adds up to what the asset gives under a uniform sky, and both ways tell the
    same, within 2 %.

    Its unit is the irradiance π of an open sky; the mean is over area and colours.
    """
    parts = corner(0.8, [0.7, 0.3, 0.3])
    energies = {}
    for indirect in ("solve", "paths"):
        settings = dict(
            basis="haar-shared", coefficients=384, bounces=3, paths_per_point=1024, edge_length=0.25
        )
        asset = precompute(parts, indirect=indirect, **settings)
        energy = energies[indirect] = np.array(distant(asset).report["bounce_energy"])
        assert len(energy) == 4
        mean = (
            asset.points.areas
            @ asset.irradiance(uniform_sky()).mean(axis=1)
            / asset.points.areas.sum()
        )
        assert energy.sum() == pytest.approx(mean / np.pi, rel=2e-3)
    np.testing.assert_allclose(energies["solve"], energies["paths"], rtol=0.02)
    assert (np.diff(energies["solve"]) < 0).all()


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("bounces", -1, "bounces must be 0…10,000 or auto, got -1"),
        ("bounces", 10_001, "bounces must be 0…10,000 or auto, got 10001"),
        ("bounces", 2.5, "bounces must be an integer or auto, got 2.5"),
        ("bounces", "many", "bounces must be an integer or auto, got 'many'"),
        ("bounces", True, "bounces must be an integer or auto, got True"),
        ("bounces", float("nan"), "bounces must be an integer or auto, got nan"),
        ("paths_per_point", 0, "paths per point must be 2…65,536 or auto, got 0"),
        ("paths_per_point", 3, "paths per point must be auto or an even number, got 3"),
        ("paths_per_point", 65_538, "paths per point must be 2…65,536 or auto, got 65538"),
        ("paths_per_point", None, "paths per point must be an integer or auto, got None"),
        ("denoise", "yes", "denoise must be true or false, got 'yes'"),
        ("denoise", 1, "denoise must be true or false, got 1"),
        ("indirect", "x", "indirect 'x' is not known: use solve or paths"),
        ("indirect", None, "indirect 'None' is not known: use solve or paths"),
    ],
)
def test_settings_out_of_range_are_refused(setting, value, message):
    with pytest.raises(SettingsError) as raised:
        mi_prt.precompute(corner(), **{setting: value})
    assert str(raised.value) == message


def test_smallest_settings_work():
    """Two paths from each point, one reflection, and a basis of no components (the mean) are as
    valid as any.
    """
    for indirect in ("solve", "paths"):
        asset = precompute(
            corner(), paths_per_point=2, bounces=1, coefficients=0, indirect=indirect, denoise=True
        )
        assert distant(asset).report["bounces"] == 1 and len(distant(asset).basis) == 0
        irradiance = asset.irradiance(uniform_sky())
        np.testing.assert_allclose(irradiance, irradiance[0, 0], rtol=1e-4)


# --- pictures -------------------------------------------------------------------------------------


def cornell():
    """An open box of coloured walls with two blocks in it, seen from the front."""
    two_sided = {
        name: {"type": "twosided", "nested": diffuse(rgb)}
        for name, rgb in dict(white=0.7, red=[0.6, 0.1, 0.1]).items()
    }
    return scene(
        floor=rectangle((0, 1, 0), (0, -1, 0), bsdf=two_sided["white"]),
        left=rectangle((1, 0, 0), (-1, 0, 0), bsdf=two_sided["red"]),
        right=rectangle(
            (-1, 0, 0), (1, 0, 0), bsdf={"type": "twosided", "nested": diffuse([0.2, 0.5, 0.2])}
        ),
        back=rectangle((0, 0, 1), (0, 0, -1), bsdf=two_sided["white"]),
        tall=cube((-0.35, -0.45, -0.3), 0.3, bsdf=diffuse(0.7)),
        sky={"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 0.9, 0.8]}},
        eye={
            "type": "perspective",
            "fov": 35.0,
            "to_world": mi.ScalarTransform4f().look_at([0, 0.6, 4.5], [0, -0.1, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": 40,
                "height": 30,
                "rfilter": {"type": "box"},
                "component_format": "float32",
            },
        },
    )


@pytest.fixture(scope="module")
def opened():
    return mi.load_dict(cornell())


@pytest.fixture(scope="module", params=[0, 2, "auto"])
def pictured(request):
    return mi_prt.precompute(
        cornell(),
        directions="cubemap:16",
        edge_length=0.15,
        bounces=request.param,
        paths_per_point=128,
    )


def test_compare_takes_a_reference_of_as_many_reflections(pictured, tmp_path):
    """`compare` against Mitsuba's path tracer at the matching depth: bias below 1 % at points and
    in the picture.

    Depths do not match by chance: the second reflection is 2 % of the light, the first 7 %.
    """
    report = mi_prt.compare(pictured, tmp_path, scene=cornell(), spp=64)
    bounces = pictured.settings["bounces"]
    assert report["reference_bounces"] == ("any number" if bounces == "auto" else bounces)
    assert abs(report["points"]["bias"]) < 0.01 and abs(report["image"]["bias"]) < 0.01
    energy = np.array(distant(pictured).report["bounce_energy"])
    if bounces != 0:
        assert energy[1] > 0.06 * energy.sum() and energy[2] > 0.02 * energy.sum()
    written = (tmp_path / "report.json").read_text()
    found = json.loads(written, parse_constant=pytest.fail)["transports"]["distant"]
    assert found["bounces"] == distant(pictured).report["bounces"]


def test_picture_is_that_of_the_path_tracer(pictured, opened):
    """The integrator `prt` beside `path` with max_depth two above the reflections that the asset
    holds: no more than 1 % apart in any channel of the surfaces' mean; with one reflection less it
    is more.
    """
    bounces = pictured.settings["bounces"]
    irradiance = pictured.irradiance(np.broadcast_to(np.float32([1.0, 0.9, 0.8]), (2, 4, 3)).copy())
    image = np.array(
        mi.render(opened, integrator=integrator_for(pictured, irradiance), spp=64, seed=1)
    )

    def by_path(depth):
        integrator = mi.load_dict({"type": "path", "max_depth": depth})
        return np.array(mi.render(opened, integrator=integrator, spp=1024, seed=2))

    expected = by_path(-1 if bounces == "auto" else bounces + 2)
    surface = np.abs(expected - [1.0, 0.9, 0.8]).max(axis=-1) > 0.01
    assert 0.5 < surface.mean() < 0.99
    for channel in range(3):
        assert abs(bias(image[surface, channel], expected[surface, channel])) < 0.01
    assert relative_l2(image[surface], expected[surface]) < 0.06
    if bounces != 0:
        assert bias(image[surface], by_path(2)[surface]) > 0.1


def test_repainted_scene_is_told():
    """Reflected light is that of the old paint; direct light has none, and where nothing is
    repainted there is nothing to say.
    """
    asset = precompute(corner(0.8, [0.7, 0.3, 0.3]), edge_length=0.5, bounces=1, coefficients=8)
    direct = precompute(corner(0.8, [0.7, 0.3, 0.3]), edge_length=0.5, bounces=0, coefficients=8)
    repainted = corner(0.8, [0.3, 0.3, 0.7])
    with pytest.warns(LightWarning, match="materials changed"):
        open_scene_of(asset, repainted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        open_scene_of(asset, corner(0.8, [0.7, 0.3, 0.3]))
        open_scene_of(direct, repainted)


@pytest.mark.parametrize("indirect", ["solve", "paths"])
def test_reflections_that_need_not_end_are_refused(indirect):
    """An albedo of 1.3 makes light; a number of bounces says how much."""
    bright = mitsuba().Bitmap(np.full((2, 2, 3), 1.3, np.float32))
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bright, "raw": True}}
    parts = scene(floor=rectangle(bsdf=bsdf), box=cube((0, 0.4, 0), 0.3, bsdf=bsdf))
    with pytest.raises(SceneError, match="reflects 1.3 times"):
        precompute(parts, indirect=indirect, bounces="auto", edge_length=0.5)
    asset = precompute(parts, indirect=indirect, bounces=2, edge_length=0.5)
    energy = distant(asset).report["bounce_energy"]
    assert len(energy) == 3 and np.isfinite(energy).all()
