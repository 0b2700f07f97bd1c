"""All bases on all lattices through the whole program: fit, file, relighting, rotation, and what
`info` says of their storage.
"""

import json
from functools import cache

import numpy as np
import pytest
from conftest import (
    arrays_of,
    bias,
    cube,
    diffuse,
    disk,
    distant,
    rectangle,
    relative_l2,
    rewritten,
    scene,
    sky_of,
)

import mi_prt
from mi_prt import AssetError, SettingsError
from mi_prt.asset.describe import describe_asset
from mi_prt.basis.basis import BASES
from mi_prt.directions import parse_directions
from mi_prt.evaluate import ground_truth
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.lattice import on_lattice
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.precompute.forecast import describe
from mi_prt.scene.scene import open_scene
from mi_prt.transport.bits import sample_direct

PARTS = dict(
    floor=rectangle(size=2, bsdf=diffuse(0.6)),
    box=cube((0.2, 0.4, 0), 0.4),
    ball=disk((0, 1, 0.1), (0.3, 1.5, 0), 0.6),
)
COLOURED = PARTS | dict(floor=rectangle(size=2, bsdf=diffuse([0.7, 0.5, 0.2])))
COEFFICIENTS = {"pca": 36, "sh": 36, "haar": 36, "haar-shared": 36, "none": None}
REFLECTING = {
    "pca reflecting": "pca",
    "sh reflecting": "sh",
    "haar-shared reflecting": "haar-shared",
}
LATTICES = ("cubemap:16", "latlong:48x24", "halton:1200")
TOTAL = "transports/distant/total/"  # arrays in files


def sky():
    """A smooth sky with a bright and coloured patch about (1, 2, 1)."""
    toward = np.array([1, 2, 1]) / 6**0.5
    colour = np.array([3.0, 2.0, 1.0])
    return mi_prt.EnvironmentMap(
        sky_of(lambda d: 0.3 + np.exp(8 * (d @ toward - 1))[:, None] * colour, 64)
    )


def precompute(parts=PARTS, directions="cubemap:16", edge_length=0.3, bounces=0, **settings):
    """Of direct light, unless bounces are asked for."""
    return mi_prt.precompute(
        scene(**parts), directions=directions, edge_length=edge_length, bounces=bounces, **settings
    )


@pytest.fixture(scope="module")
def assets():
    """An asset of every basis, on the same points and the same lattice."""
    return {
        kind: precompute(basis=kind, coefficients=coefficients)
        for kind, coefficients in COEFFICIENTS.items()
    }


@pytest.fixture(scope="module")
def every(assets):
    """These, and with light that the floor colours those of the bases that hold it: principal
    components of all channels, or three rows of coefficients for each point.
    """
    settings = dict(bounces=2, paths_per_point=32, coefficients=36)
    return assets | {
        name: precompute(COLOURED, basis=kind, **settings) for name, kind in REFLECTING.items()
    }


@pytest.fixture(scope="module")
def sampled(assets):
    """The transport of those points without any basis (n, s), sampled anew."""
    points = assets["pca"].points
    transport = sample_direct(open_scene(scene(**PARTS)), points, parse_directions("cubemap:16"))
    return transport.rows(np.arange(len(points)))


def weighted_error(asset, sampled):
    rows = np.flatnonzero(~asset.buried)
    w = np.sqrt(distant(asset).directions.solid_angles)
    return relative_l2(distant(asset).total.rows(rows) * w, sampled[rows] * w)


# --- one protocol ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*BASES, *REFLECTING])
def test_irradiance_is_the_response_of_the_reconstruction(every, kind):
    """E = Σ_j w_j L_j T̂_j for any basis, channel by channel: projecting light loses nothing more
    than the transport has lost.
    """
    asset, held = every[kind], distant(every[kind])
    w, radiance = held.directions.solid_angles, cell_radiance(sky(), held.directions)
    n = len(asset.points)
    transport = held.total.rows(np.arange(n))
    if kind in REFLECTING:
        assert held.coefficients.shape == (
            (n, 36) if kind == "pca reflecting" else (n, 3, 36)
        ) and transport.shape == (n, 3, 1536)
        assert relative_l2(transport[:, 0], transport[:, 2]) > 1e-3
        expected = np.stack([transport[:, c] @ (w * radiance[:, c]) for c in range(3)], axis=-1)
    else:
        expected = transport @ (w[:, None] * radiance)
    assert relative_l2(asset.irradiance(sky()), np.maximum(expected, 0)) < 1e-5


@pytest.mark.parametrize("kind", BASES)
def test_the_reported_error_is_that_of_the_transport(assets, sampled, kind):
    """Told by the fit from sums of squares, here taken from the reconstruction itself; captured
    variance likewise.
    """
    asset, held = assets[kind], distant(assets[kind])
    assert held.report["relative_error"] == pytest.approx(
        weighted_error(asset, sampled), rel=2e-3, abs=1e-6
    )
    rows = sampled[~asset.buried] * np.sqrt(held.directions.solid_angles)
    spread = np.linalg.norm(rows - rows.mean(axis=0)) / np.linalg.norm(rows)
    captured = 1 - (weighted_error(asset, sampled) / spread) ** 2
    assert held.report["captured_variance"] == pytest.approx(captured, abs=1e-3)


def test_principal_components_are_the_best_linear_basis(assets, sampled):
    """At equal count no linear basis has a lower error (Eckart and Young); the best of each row is
    not linear, and is lower here.
    """
    errors = {kind: weighted_error(asset, sampled) for kind, asset in assets.items()}
    assert errors["pca"] < errors["sh"] and errors["pca"] < errors["haar-shared"]
    assert errors["haar"] < errors["haar-shared"]
    assert errors["none"] < 1e-6


@pytest.mark.parametrize("components", [4, 9, 25, 100, 169])
def test_the_theorem_holds_at_every_count(components):
    """PCA ≤ SH and PCA ≤ shared Haar from a few to many coefficients."""
    settings = dict(directions="cubemap:8", coefficients=components)
    errors = {
        kind: distant(precompute(basis=kind, **settings)).report["relative_error"]
        for kind in ("pca", "sh", "haar-shared")
    }
    assert errors["pca"] <= min(errors["sh"], errors["haar-shared"]) + 1e-6


@pytest.mark.parametrize("kind", [*BASES, *REFLECTING])
def test_files_of_every_basis(every, tmp_path, kind):
    """What is loaded relights as what was saved, bit for bit, and is saved again as the same
    bytes.
    """
    asset = every[kind]
    asset.save(tmp_path / "a.prt")
    loaded = mi_prt.load(tmp_path / "a.prt")
    again, held = distant(loaded), distant(asset)
    assert again.basis.kind == REFLECTING.get(kind, kind) and len(again.basis) == len(held.basis)
    assert again.channels == held.channels == (3 if kind in REFLECTING else 1)
    np.testing.assert_array_equal(loaded.irradiance(sky()), asset.irradiance(sky()))
    some = np.arange(20)
    np.testing.assert_array_equal(again.total.rows(some), held.total.rows(some))
    loaded.save(tmp_path / "b.prt")
    assert (tmp_path / "a.prt").read_bytes() == (tmp_path / "b.prt").read_bytes()


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("haar", "coefficients/indices"),
        ("haar", "coefficients/values"),
        ("none", "coefficients/visibility"),
        ("none", "basis/weights"),
        ("sh", "basis/vectors"),
        ("haar-shared", "coefficients"),
        ("sh reflecting", "coefficients"),
        ("haar-shared reflecting", "basis/vectors"),
        ("pca reflecting", "coefficients"),
        ("pca reflecting", "basis/vectors"),
        ("pca reflecting", "basis/mean"),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(every, tmp_path, kind, name):
    every[kind].save(tmp_path / "a.prt")

    def shorten(header, arrays):
        arrays[TOTAL + name] = arrays[TOTAL + name][:-1]

    with pytest.raises(AssetError, match="odd.prt"):
        mi_prt.load(rewritten(tmp_path / "a.prt", tmp_path / "odd.prt", shorten))


def test_unknown_bases_and_indices_beyond_the_lattice_are_refused(assets, tmp_path):
    def beyond(header, arrays):
        arrays[TOTAL + "coefficients/indices"][3, 3] = 1536

    def unknown(header, arrays):
        header["transports"]["distant"]["basis"] = "wavelets of my own"

    for kind, change, message in [("haar", beyond, "indices"), ("pca", unknown, "wavelets of my")]:
        assets[kind].save(tmp_path / "a.prt")
        with pytest.raises(AssetError, match=message):
            mi_prt.load(rewritten(tmp_path / "a.prt", tmp_path / "odd.prt", change))


@pytest.mark.parametrize("rays", [1, 3])
def test_single_entries_of_bits_are_those_of_the_rows(rays):
    """Read bit by bit for point lights, expanded for all else: the same numbers."""
    asset = precompute(
        directions="cubemap:8", edge_length=0.5, basis="none", rays_per_direction=rays
    )
    held = distant(asset)
    cells = np.random.default_rng(0).integers(0, 384, (len(asset.points), 40))
    expected = np.take_along_axis(held.total.rows(np.arange(len(asset.points))), cells, axis=1)
    np.testing.assert_allclose(held.basis.at(held.coefficients, cells), expected, atol=1e-6)
    part = held.coefficients[5:9]
    np.testing.assert_allclose(held.basis.at(part, cells[5:9]), expected[5:9], atol=1e-6)
    assert (expected > 0).mean() > 0.1


# --- lattices -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def truths():
    """Mitsuba's direct irradiance at points and that of one reflection, by the scene: the points
    are the same on each lattice, and their truth is found once.
    """

    @cache
    def at_same_points(name, key):
        lit = lit_scene(open_scene(scene(**{"plain": PARTS, "coloured": COLOURED}[name])), sky())
        points = known[key]
        reflected = name == "coloured" and ground_truth.indirect_irradiance(lit, points, 512, 1, 0)
        return ground_truth.point_irradiance(lit, points, 8192), reflected

    def at(name, points):
        key = points.positions.tobytes()
        known[key] = points
        return at_same_points(name, key)

    known = {}
    return at


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("kind", ["pca", "sh", "none"])
def test_every_lattice_agrees_with_mitsuba(truths, lattice, kind):
    """A smooth sky over a scene with shadows: 1,200 to 1,536 cells and 36 coefficients, within 6 %
    and 1 % of bias; 3 % without a basis.
    """
    asset = precompute(
        directions=lattice, basis=kind, coefficients=COEFFICIENTS[kind], rays_per_direction=2
    )
    seen = np.flatnonzero(~asset.buried)
    truth, _ = truths("plain", asset.points.at(seen))
    result = asset.irradiance(sky())[seen]
    assert truth.noise < 0.015
    assert relative_l2(result, truth.mean) < {"pca": 0.06, "sh": 0.10, "none": 0.03}[kind]
    assert abs(bias(result, truth.mean)) < 0.01


@pytest.mark.parametrize(
    ("lattice", "indirect"),
    [*((lattice, "solve") for lattice in LATTICES), ("halton:1200", "paths")],
)
def test_every_lattice_agrees_with_mitsuba_after_reflections(truths, lattice, indirect):
    """The same of a coloured floor and one reflection, with the limits of above: reflected light is
    smooth, and unbiased as well. Direct light alone would be darker by more than 3 %.
    """
    asset = precompute(
        COLOURED,
        lattice,
        bounces=1,
        indirect=indirect,
        paths_per_point=128,
        coefficients=36,
        rays_per_direction=2,
    )
    seen = np.flatnonzero(~asset.buried)
    direct, reflected = truths("coloured", asset.points.at(seen))
    truth = direct + reflected
    result = asset.irradiance(sky())[seen]
    assert truth.noise < 0.015
    assert relative_l2(result, truth.mean) < 0.06 and abs(bias(result, truth.mean)) < 0.01
    assert bias(direct.mean, truth.mean) < -0.03


@pytest.mark.parametrize("lattice", ["latlong:48x24", "halton:1200", "cubemap:12"])
@pytest.mark.parametrize("kind", ["haar", "haar-shared"])
def test_wavelets_need_their_cubemap(lattice, kind):
    """Refused before any work, with the nearest resolution that does."""
    with pytest.raises(SettingsError, match="cubemap:8 or cubemap:16"):
        precompute(directions=lattice, basis=kind)


# --- numbers of coefficients ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pca", "sh", "haar", "haar-shared"])
@pytest.mark.parametrize("variance", [0.5, 0.9, 0.97])
def test_as_few_coefficients_as_capture_the_variance(kind, variance):
    """And not one less: one fewer (for harmonics one band) misses the share."""
    settings = dict(edge_length=0.4, basis=kind)
    asset = precompute(coefficients="auto", variance=variance, **settings)
    count = len(distant(asset).basis)
    assert distant(asset).report["captured_variance"] >= variance
    assert (asset.settings["variance"], asset.settings["coefficients"]) == (variance, "auto")
    fewer = (int(count**0.5) - 1) ** 2 if kind == "sh" else count - 1
    if fewer > 0:
        less = distant(precompute(coefficients=fewer, **settings))
        assert less.report["captured_variance"] < variance + 1e-6


def test_a_search_beyond_the_first_components():
    """0.9995 of the variance takes more than the 64 components that the search starts from."""
    found = distant(precompute(edge_length=0.2, coefficients="auto", variance=0.9995))
    assert len(found.basis) > 64 and found.report["captured_variance"] >= 0.9995
    assert found.basis.captured_variance[:-1].sum() < 0.9995


@pytest.mark.parametrize(
    "bad",
    [
        dict(variance=0.9),
        dict(coefficients=10, variance=0.9),
        dict(coefficients="auto", variance=1.0),
        dict(coefficients="auto", variance=0),
        dict(coefficients="auto", variance=float("nan")),
        dict(coefficients="auto", variance="x"),
        dict(coefficients="all"),
        dict(basis="none", coefficients=10),
        dict(basis="none", coefficients="auto"),
        dict(basis="fourier"),
        dict(basis="sh", coefficients=10),
        dict(basis="sh", coefficients=0),
        dict(basis="sh", coefficients=900),
        dict(basis="haar", coefficients=0),
        dict(basis=None),
        dict(basis="haar", coefficients=385),
    ],
    ids=str,
)
def test_bad_settings(bad):
    """One line, before any work, that names what was asked for."""
    with pytest.raises(SettingsError) as caught:
        precompute(directions="cubemap:8", **bad)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "lattice"),
    [("pca", "cubemap:1"), ("sh", "cubemap:1"), ("haar", "cubemap:1"), ("sh", "halton:6")],
)
def test_defaults_fit_small_lattices(kind, lattice):
    """The default number falls to what there is; it never refuses."""
    asset = precompute(directions=lattice, edge_length=0.8, basis=kind, bounces=None)
    assert 0 < len(distant(asset).basis) <= 6


# --- turning light --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*BASES, *REFLECTING])
def test_prepared_light_turns_as_the_map_does(every, kind):
    """Against the turned map averaged anew; for harmonics the turn is exact but for what cell
    averages blur.
    """
    asset = every[kind]
    prepared = asset.prepare_light(sky())
    for axis, degrees in [("y", 0), ("y", 50), ((1, 2, 3), 130), ("x", 180)]:
        expected = asset.irradiance(sky().rotated(axis, degrees))
        assert relative_l2(asset.irradiance(prepared.rotated(axis, degrees)), expected) < 0.01


def test_turns_of_harmonics_compose_exactly(assets):
    """A closed form: 360 small turns are no turn, which no resampling could do."""
    asset = assets["sh"]
    prepared = asset.prepare_light(sky())
    turned = prepared
    for _ in range(360):
        turned = turned.rotated((1, 2, 3), 1)
    np.testing.assert_allclose(asset.irradiance(turned), asset.irradiance(prepared), rtol=1e-4)
    assert (
        relative_l2(asset.irradiance(prepared.rotated("x", 90)), asset.irradiance(prepared)) > 0.1
    )


def test_prepared_light_keeps_local_lights(every):
    """They stay where they are, with every basis."""
    lamp = mi_prt.PointLight((3, 4, 2), 50.0)
    for kind in ("pca", "sh", *REFLECTING):
        asset = every[kind]
        expected = asset.irradiance(sky().rotated("y", 40)) + asset.irradiance(lamp)
        result = asset.irradiance(asset.prepare_light([sky(), lamp]).rotated("y", 40))
        assert relative_l2(result, expected) < 0.01


def test_light_prepared_for_one_basis_is_light_to_all(every):
    """Harmonics prepared for an asset of harmonics are the map they came from to every other basis,
    in the integrator too.
    """
    prepared = (
        every["sh"].prepare_light([sky(), mi_prt.PointLight((3, 4, 2), 50.0)]).rotated("y", 40)
    )
    for kind, asset in every.items():
        expected = asset.irradiance([sky().rotated("y", 40), mi_prt.PointLight((3, 4, 2), 50.0)])
        assert relative_l2(asset.irradiance(prepared), expected) < 0.01, kind
        assert relative_l2(asset.irradiance([prepared, prepared]), 2 * expected) < 0.01
        assert relative_l2(asset.irradiance(asset.prepare_light(prepared)), expected) < 0.01
    fewer = precompute(basis="sh", coefficients=16)
    expected = fewer.irradiance([sky().rotated("y", 40), mi_prt.PointLight((3, 4, 2), 50.0)])
    assert relative_l2(fewer.irradiance(prepared), expected) < 0.01


@pytest.mark.parametrize("lattice", ["latlong:64x32", "latlong:4x600", "halton:1200", "cubemap:16"])
def test_constant_light_stays_constant_when_it_turns(lattice):
    """In every cell, those at the poles too, which are thinner than the fine lattice's cells."""
    directions = parse_directions(lattice)
    prepared = on_lattice(mi_prt.EnvironmentMap(np.full((8, 16, 3), 2.0)), directions).rotated(
        (1, 2, 3), 33
    )
    np.testing.assert_allclose(cell_radiance(prepared, directions), 2, rtol=1e-5)


# --- storage --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*BASES, *REFLECTING])
def test_storage_is_as_the_formula_says(every, tmp_path, kind):
    """4d(v + 1) and 4ds bytes (section 7.1), of Haar 6 bytes a coefficient and no matrix, without a
    basis a bit a ray; where reflections are coloured three times the matrix of principal
    components, and three times the coefficients in the other bases. The arrays in the file take
    just that.
    """
    asset = every[kind]
    asset.save(tmp_path / "a.prt")
    found = describe_asset(asset)
    storage = found["transports"]["distant"]["storage"]
    v, s, d = len(asset.points), 1536, 36
    light = {"haar": s, "none": s}.get(kind, d)
    sets, functions = {
        "pca reflecting": (1, 3),
        "sh reflecting": (3, 1),
        "haar-shared reflecting": (3, 1),
    }.get(kind, (1, 1))
    coefficients = {"haar": 6 * d * v, "none": s // 16 * v}.get(kind, 4 * d * v * sets)
    assert storage["predicted"]["relighting"] == coefficients + 4 * light
    assert storage["predicted"]["projection"] == {"haar": 0, "none": 4 * s}.get(
        kind, 4 * d * s * functions
    )
    stored = {name.removeprefix(TOTAL): a for name, a in arrays_of(tmp_path / "a.prt").items()}
    assert storage["measured"]["coefficients"] == sum(
        array.nbytes for name, array in stored.items() if name.startswith("coefficients")
    )
    rays = 12 * s // 2 if kind == "none" else 0  # their vectors
    assert storage["measured"]["coefficients"] == coefficients + rays
    assert found["bytes"] == (tmp_path / "a.prt").stat().st_size
    json.dumps(found)


@pytest.mark.parametrize("kind", ["pca", "haar"])
def test_storage_is_predicted_from_the_scene(assets, kind):
    """Before any work, the same figures."""
    settings = dict(
        directions="cubemap:16", edge_length=0.3, basis=kind, coefficients=36, bounces=0
    )
    predicted = describe(scene(**PARTS), **settings)["predicted"]["transports"]["distant"]
    storage = describe_asset(assets[kind])["transports"]["distant"]["storage"]["predicted"]
    assert (predicted["relighting_bytes"], predicted["projection_bytes"]) == (
        storage["relighting"],
        storage["projection"],
    )


@pytest.mark.parametrize("kind", ["pca", "sh"])
def test_reflections_are_predicted_from_the_scene(every, kind):
    """Storage of three channels, the settings, and how light splits by reflections: a probe of 256
    of the 600 points tells direct light to 1.5 % and the first reflection, in which they differ
    more, to 10 % (one standard error); three of them are allowed.
    """
    settings = dict(
        directions="cubemap:16",
        edge_length=0.3,
        basis=kind,
        coefficients=36,
        bounces=2,
        paths_per_point=32,
    )
    found = describe(scene(**COLOURED), **settings)
    held = describe_asset(every[f"{kind} reflecting"])["transports"]["distant"]
    predicted, storage = (
        found["predicted"]["transports"]["distant"],
        held["storage"]["predicted"],
    )
    assert (predicted["relighting_bytes"], predicted["projection_bytes"]) == (
        storage["relighting"],
        storage["projection"],
    )
    assert {
        name: found["settings"][name]["value"]
        for name in ("bounces", "indirect", "paths_per_point", "denoise")
    } == {"bounces": 2, "indirect": "solve", "paths_per_point": 32, "denoise": True}
    energy = held["report"]["bounce_energy"]
    assert held["bounces"] == 2 and len(energy) == len(found["requires"]["bounce_energy"]) == 3
    assert (
        np.abs(np.divide(found["requires"]["bounce_energy"][:2], energy[:2]) - 1) < [0.045, 0.3]
    ).all()


def test_info_of_automatic_coefficients():
    settings = describe(
        scene(**PARTS), directions="cubemap:4", edge_length=0.8, coefficients="auto", variance=0.9
    )["settings"]
    assert settings["coefficients"]["value"] == "auto" and settings["variance"]["value"] == 0.9
