"""Many lights at once: the same as one by one, and what they share is computed once."""

import gc
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from small_assets import opened_scene

import mi_prt
from mi_prt.lighting import environment, kept

ROOT = Path(__file__).resolve().parent.parent
DISTANT = {
    "transports": "distant",
    "edge_length": 9.0,
    "directions": "cubemap:4",
    "paths_per_point": 16,
}
BASES = {
    "joined channels": {"coefficients": 6},
    "grey": {"coefficients": 6, "bounces": 0},
    "channels apart": {"basis": "haar-shared", "coefficients": 8, "keep_direct": True},
    "harmonics": {"basis": "sh", "coefficients": 9},
    "sparse": {"basis": "haar", "coefficients": 5, "bounces": 0},
    "none": {"basis": "none", "bounces": 0},
}


def maps(count, seed=0):
    """Random maps, each an EnvironmentMap of 8 by 16 pixels."""
    rng = np.random.default_rng(seed)
    return [mi_prt.EnvironmentMap(rng.exponential(size=(8, 16, 3))) for _ in range(count)]


@pytest.fixture(scope="module", params=BASES)
def asset(request):
    return mi_prt.precompute(opened_scene(), **DISTANT, **BASES[request.param])


def test_a_batch_is_its_lights_one_by_one(asset):
    """Sums of the same products in another order: equal to float32's rounding."""
    lights = [
        *maps(3),
        maps(1, 1)[0].rotated("y", 30) * 2,
        [maps(1, 2)[0], mi_prt.DirectionalLight((1, -1, 0.3), 2)],
        asset.prepare_light(maps(1, 3)[0]).rotated("x", 20),
    ]
    for component in asset.components:
        batch = asset.irradiance(lights, component, batch=True)
        alone = np.stack([asset.irradiance(light, component) for light in lights])
        assert batch.shape == (len(lights), len(asset.points), 3)
        assert batch.dtype == np.float32
        np.testing.assert_allclose(batch, alone, atol=1e-5 * alone.max())
    radiance = asset.relight(lights[:2], batch=True)
    np.testing.assert_allclose(radiance[1], asset.relight(lights[1]), atol=1e-5 * radiance.max())


def test_transports_share_a_batch_out():
    """Lamps of the scene, a map and a lamp inside the hull, whose warning comes once."""
    asset = mi_prt.precompute(
        opened_scene(), **(DISTANT | {"transports": "distant,own"}), coefficients=4, lamp_rays=16
    )
    lamp, bulb = asset.own_lights["lamp"], mi_prt.PointLight((0.3, 1, 0.4), 2)
    lights = [lamp, [maps(1)[0], lamp * 0.3], bulb, bulb * 2]
    with pytest.warns(mi_prt.LightWarning, match="hull") as said:
        batch = asset.irradiance(lights, batch=True)
    assert len(said) == 1
    with pytest.warns(mi_prt.LightWarning, match="hull"):
        alone = np.stack([asset.irradiance(light) for light in lights])
    np.testing.assert_allclose(batch, alone, atol=1e-5 * alone.max())


def test_maps_are_averaged_once_for_each_lattice(monkeypatch):
    counted = []
    average = environment.average
    monkeypatch.setattr(
        environment, "average", lambda *args: counted.append(args[1]) or average(*args)
    )
    one = mi_prt.precompute(opened_scene(), **DISTANT, coefficients=4)
    other = mi_prt.precompute(opened_scene(), **DISTANT, basis="sh", coefficients=4)
    lights = maps(3)
    first = one.irradiance(lights, batch=True)
    one.irradiance(lights[0])
    other.irradiance(lights, batch=True)
    assert len(counted) == 3
    # a turned or dimmed map is another one, and means of those that are gone are not kept
    turned, dimmed = lights[0].rotated("y", 90), lights[0] * 0.5
    np.testing.assert_allclose(one.irradiance(dimmed), first[0] / 2, rtol=1e-4, atol=1e-5)
    assert np.abs(one.irradiance(turned) - first[0]).max() > 0.01 * first[0].max()
    assert len(counted) == 5
    held = len(kept._kept)
    del lights, turned, dimmed
    gc.collect()
    assert len(kept._kept) <= held - 5


def test_kept_means_cannot_go_stale():
    sky = maps(1)[0]
    with pytest.raises(ValueError, match="read-only"):
        sky.pixels[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        (sky * 2).pixels[0] = 1
    lattices = [mi_prt.directions.parse_directions(f"cubemap:{n}") for n in range(2, 9)]
    for lattice in lattices:
        sky.radiance(lattice, 2)
    assert len(kept._kept[sky]) == kept.LATTICES


@pytest.mark.parametrize("lights", [[], (), "sky.exr", None, np.ones((2, 4, 3)), maps(1)[0]])
def test_a_batch_is_a_sequence(lights):
    asset = mi_prt.precompute(opened_scene(), **DISTANT, coefficients=4, bounces=0)
    with pytest.raises(mi_prt.LightError, match=r"pass \[light"):
        asset.irradiance(lights, batch=True)


def test_a_stack_of_arrays_is_a_batch():
    asset = mi_prt.precompute(opened_scene(), **DISTANT, coefficients=4, bounces=0)
    stack = np.random.default_rng(0).exponential(size=(2, 4, 8, 3))
    batch = asset.irradiance(stack, batch=True)
    np.testing.assert_allclose(batch[1], asset.irradiance(stack[1]), atol=1e-5 * batch.max())


def test_the_example_and_the_benchmark_run(tmp_path, monkeypatch, capsys):
    few = ["--meshes", "1", "--maps", "3", "--size", "16x8"]
    few += ["--directions", "cubemap:8", "--edge-length", "9"]
    for script in (["examples/batch.py", str(tmp_path)], ["benchmarks/batch.py", "--single", "2"]):
        monkeypatch.setattr(sys, "argv", script + few)
        runpy.run_path(str(ROOT / script[0]), run_name="__main__")
    said = capsys.readouterr().out
    assert "3 maps on" in said and "| batches |" in said
    radiance = np.load(tmp_path / "00_lampshade.npy")
    assert radiance.dtype == np.float16 and len(radiance) == 3 and radiance.max() > 0


@pytest.mark.parametrize(("shape", "spacing"), [((9, 16), 0.1), ((64, 128), 0.1)])
def test_moments_of_groups_are_sums_of_those_of_samples(shape, spacing):
    """A coarse map, which is split, and a fine one, which is summed; turned, in random groups."""
    rng = np.random.default_rng(0)
    sky = mi_prt.EnvironmentMap(rng.exponential(size=(*shape, 3))).rotated((1, 2, 3), 40)
    samples = sky.quadrature(spacing)
    group = rng.integers(5, size=len(samples.energy))
    order, ends = np.argsort(group, kind="stable"), np.append(0, np.cumsum(np.bincount(group)))
    found = samples.moments_in(order, ends)
    for number in range(5):
        expected = samples.moments[group == number].sum(axis=0, dtype=float)
        np.testing.assert_allclose(found[number], expected, atol=1e-4 * np.abs(expected).max())
