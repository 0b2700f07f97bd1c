"""Assets cut to fewer components: what is left is known exactly."""

from functools import cache

import numpy as np
import pytest
from small_assets import opened_scene

import mi_prt

SETTINGS = {
    "transports": "distant,own",
    "edge_length": 9.0,
    "directions": "cubemap:8",
    "paths_per_point": 16,
    "lamp_rays": 16,
}
BASES = {
    "joined channels": ({"coefficients": 12}, 5),
    "grey": ({"coefficients": 12, "bounces": 0}, 5),
    "harmonics": ({"basis": "sh", "coefficients": 16}, 9),
    "channels apart": ({"basis": "haar-shared", "coefficients": 12, "keep_direct": True}, 5),
}


@cache
def asset(kind):
    return mi_prt.precompute(opened_scene(), **SETTINGS, **BASES[kind][0])


@pytest.mark.parametrize("kind", BASES)
def test_what_is_left_is_told_exactly(kind):
    """Rows of both assets, written out: what was dropped is orthogonal to what had been lost."""
    whole, components = asset(kind), BASES[kind][1]
    cut = whole.truncated(components)
    before, after = whole.transports["distant"], cut.transports["distant"]
    assert len(after.basis) == components and len(before.basis) > components
    kept = np.flatnonzero(~whole.buried)
    roots = after.basis.sqrt_weights
    held = before.total.rows(kept) * roots
    dropped = np.sum((held - after.total.rows(kept) * roots).astype(float) ** 2)
    energy = np.sum(held.astype(float) ** 2) / (1 - before.report["relative_error"] ** 2)
    expected = np.sqrt(before.report["relative_error"] ** 2 + dropped / energy)
    assert after.report["relative_error"] == pytest.approx(expected, rel=1e-3)
    assert after.report["truncated_from"] == len(before.basis)
    assert after.report["captured_variance"] < before.report["captured_variance"]


def test_cutting_principal_components_is_fitting_fewer():
    """Direct transport's components are nested: a fit of five is the first five of twelve."""
    five = mi_prt.precompute(opened_scene(), **SETTINGS, bounces=0, coefficients=5)
    cut = asset("grey").truncated(5)
    for name in ("captured_variance", "relative_error"):
        expected = five.transports["distant"].report[name]
        assert cut.transports["distant"].report[name] == pytest.approx(expected, rel=2e-3)
    sky = np.random.default_rng(0).exponential(size=(8, 16, 3))
    fitted, found = five.irradiance(sky), cut.irradiance(sky)
    assert np.linalg.norm(found - fitted) < 0.01 * np.linalg.norm(fitted)


@pytest.mark.parametrize("kind", BASES)
def test_a_cut_asset_is_an_asset(kind, tmp_path):
    whole, components = asset(kind), BASES[kind][1]
    cut = whole.truncated(components)
    cut.save(tmp_path / "cut.prt")
    loaded = mi_prt.load(tmp_path / "cut.prt")
    lights = [np.ones((2, 4, 3)), loaded.own_lights["lamp"]]
    for component in cut.components:
        np.testing.assert_array_equal(
            loaded.irradiance(lights[0], component), cut.irradiance(lights[0], component)
        )
    np.testing.assert_array_equal(cut.irradiance(lights[1]), whole.irradiance(lights[1]))
    report = whole.transports["distant"].report
    same = whole.truncated(len(whole.transports["distant"].basis)).transports["distant"].report
    for name in ("captured_variance", "relative_error"):
        assert same[name] == pytest.approx(report[name], rel=1e-6)


@pytest.mark.parametrize("count", [0, -1, 13, 2.5, True, "5", None])
def test_numbers_that_there_are_not(count):
    with pytest.raises(mi_prt.SettingsError, match="1…12 of them"):
        asset("grey").truncated(count)


def test_bases_that_cannot_be_cut():
    with pytest.raises(mi_prt.SettingsError, match="use 4 or 9"):
        asset("harmonics").truncated(5)
    for basis in ({"basis": "haar", "coefficients": 5}, {"basis": "none"}):
        whole = mi_prt.precompute(opened_scene(), **SETTINGS, **basis, bounces=0)
        with pytest.raises(mi_prt.SettingsError, match="--coefficients"):
            whole.truncated(3)
    lamps = mi_prt.precompute(opened_scene(), transports="own", edge_length=9.0, lamp_rays=16)
    with pytest.raises(mi_prt.SettingsError, match="--transports distant"):
        lamps.truncated(3)
