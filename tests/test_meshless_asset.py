"""Assets of local lights as files, in settings, and when runs are interrupted: what is read is what
was written, or a typed error.
"""

import dataclasses
import importlib
import itertools
import json
import os
import signal
import time

import numpy as np
import pytest
from conftest import arrays_of, cube, diffuse, rectangle, rewritten, scene, uniform_sky
from forked import Starter

import mi_prt
from mi_prt import (
    AssetError,
    DirectionalLight,
    LightError,
    PointLight,
    SettingsError,
)
from mi_prt.lighting.emission import emission_of
from mi_prt.lighting.own_light import SceneLight, resolve
from mi_prt.points.clusters import Clusters
from mi_prt.points.points import Points
from mi_prt.precompute.forecast import describe
from mi_prt.precompute.settings import Settings
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.system.schema import check
from mi_prt.transport.depth import DepthBuffers
from mi_prt.transport.local import LocalTransport
from mi_prt.transport.quantize import LARGEST, cluster_scales, quantized, quantized_by_cluster
from mi_prt.transport.transfer_matrix import Transfer

mi = mitsuba()

LAMP = {"type": "area", "radiance": {"type": "rgb", "value": [10, 8, 5]}}
SCENE = scene(
    floor=rectangle((0, 1, 0), (0, -1, 0), bsdf=diffuse(0.7)),
    back=rectangle((0, 0, 1), (0, 0, -1), bsdf=diffuse(0.7)),
    red=rectangle((1, 0, 0), (-1, 0, 0), bsdf=diffuse([0.7, 0.1, 0.1])),
    green=rectangle((-1, 0, 0), (1, 0, 0), bsdf=diffuse([0.1, 0.7, 0.1])),
    block=cube((-0.3, -0.7, -0.2), 0.3, bsdf=diffuse(0.6)),
    lamp=rectangle((0, -1, 0), (-0.5, 0.95, 0), 0.15, bsdf=diffuse(0.0), emitter=LAMP),
    bulb={
        "type": "point",
        "position": [0.4, 0.3, 0.2],
        "intensity": {"type": "rgb", "value": [0.5, 1.0, 2.0]},
    },
)
SETTINGS = dict(
    count=600,
    cluster_size=60,
    depth_directions=144,
    depth_coefficients=8,
    example_lights=60,
    transfer_coefficients=6,
)
ASKED = dict(points="samples", transports="local")
STORAGE = {  # quantization, and a budget of which the transfer matrix is dense or sparse
    "16 dense": dict(quantize="16", transfer_error=0.0),
    "16 sparse": dict(quantize="16", transfer_error=0.15),
    "float32 dense": dict(quantize="none", transfer_error=0.0),
    "float32 sparse": dict(quantize="none", transfer_error=0.15),
}
# times half a scale: float32 adds 2⁻²⁴ of up to 32767 scales, in the quotient and in the product
ROUNDED = 1.01
LIGHT = PointLight((0.3, 0.2, 0.4), (1.0, 2.0, 3.0))


def precompute(parts=SCENE, **settings):
    return mi_prt.precompute(parts, **(ASKED | SETTINGS | settings))


def local(asset):
    """The transport of lights that move."""
    return asset.transports["local"]


@pytest.fixture(scope="module")
def assets():
    """One for each way to store it."""
    return {name: precompute(**settings) for name, settings in STORAGE.items()}


@pytest.fixture(scope="module")
def files(assets, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    paths = {name: folder / f"{name}.prt" for name in STORAGE}
    for name, asset in assets.items():
        asset.save(paths[name])
    return paths


@pytest.fixture(scope="module")
def starter():
    with Starter("test_meshless_asset") as starter:
        yield starter


def values_of(asset):
    """All that an asset computes with, by name."""
    transport = local(asset)
    parts = {f"points/{name}": getattr(asset.points, name) for name in Points.SHAPES}
    parts |= {f"clusters/{n}": getattr(transport.clusters, n) for n in ("order", "starts", "roots")}
    parts |= {
        f"depth/{name}": getattr(transport.depth, name)
        for name in ("means", "vectors", "coefficients")
    }
    if transport.transfer is not None:
        parts |= {
            f"transfer/{name}": getattr(transport.transfer, name)
            for name in ("encoder", "receivers", "matrix")
        }
    return parts


def stored_in(path):
    """What a file holds of the transport, by name."""
    prefix = "transports/local/"
    arrays = arrays_of(path).items()
    return {name.removeprefix(prefix): a for name, a in arrays if name.startswith(prefix)}


# --- round trips ----------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", STORAGE)
def test_round_trip(assets, files, storage):
    """Bit for bit, every array, text and irradiance: 16-bit numbers are taken when the asset is
    made, not when it is saved, and both ways to store the transfer matrix occur.
    """
    asset, loaded = assets[storage], mi_prt.load(files[storage])
    assert list(loaded.transports) == ["local"]
    assert loaded.path == asset.path == files[storage].absolute()
    assert ("transfer/columns" in stored_in(files[storage])) == ("sparse" in storage)
    before, after = values_of(asset), values_of(loaded)
    assert before.keys() == after.keys()
    for name, array in before.items():
        assert array.dtype == after[name].dtype, name
        np.testing.assert_array_equal(array, after[name], err_msg=name)
    for name in ("scene", "settings", "versions", "report"):
        assert json.loads(json.dumps(getattr(asset, name))) == getattr(loaded, name), name
    assert loaded.emitters == asset.emitters and loaded.points.report == asset.points.report
    assert loaded.points.layout.radius == asset.points.layout.radius
    assert json.loads(json.dumps(local(asset).report)) == local(loaded).report
    assert local(loaded).depth.extent == local(asset).depth.extent
    assert local(loaded).quantize == local(asset).quantize == STORAGE[storage]["quantize"]
    assert list(loaded.points.surfaces) == json.loads(json.dumps(asset.points.surfaces))
    for component in ("direct", "indirect", "total"):
        np.testing.assert_array_equal(
            loaded.irradiance(LIGHT, component), asset.irradiance(LIGHT, component)
        )
        own = [a.irradiance(a.resolved(scene=SCENE), component) for a in (loaded, asset)]
        np.testing.assert_array_equal(*own)
    assert asset.irradiance(LIGHT, "indirect").any() and not loaded.buried.any()


@pytest.mark.parametrize("storage", STORAGE)
def test_saving_again_gives_the_same_file(files, tmp_path, storage):
    """What a file gives back is what would be stored again."""
    mi_prt.load(files[storage]).save(tmp_path / "again.prt")
    assert (tmp_path / "again.prt").read_bytes() == files[storage].read_bytes()


def test_round_trip_without_transfer_or_lights(tmp_path):
    """A run for direct light alone, of a scene whose only emitter is distant: no transfer and no
    own light, before and after.
    """
    parts = scene(
        floor=rectangle(bsdf=diffuse(0.5)),
        wall=rectangle((1, 0, 0), (-1, 1, 0), bsdf=diffuse(0.5)),
        sky={"type": "constant"},
    )
    asset = precompute(parts, bounces=0)
    asset.save(tmp_path / "a.prt")
    loaded = mi_prt.load(tmp_path / "a.prt")
    assert local(asset).transfer is None and local(loaded).transfer is None
    assert not loaded.reflects and loaded.reference_bounces == 0
    assert not any(name.startswith("transfer") for name in stored_in(tmp_path / "a.prt"))
    np.testing.assert_array_equal(loaded.irradiance(LIGHT), asset.irradiance(LIGHT))
    for component in ("total", "indirect"):
        with pytest.raises(LightError, match="holds none: pass a light.*--light.*--transports"):
            loaded.irradiance(component=component)


# --- quantization ---------------------------------------------------------------------------------


def test_quantized_numbers_are_within_half_a_scale():
    """Integers of 16 bits, scales of the largest along an axis over 32767: that one is exact, zeros
    stay zeros, and none is off by more than half.
    """
    random = np.random.default_rng(0)
    values = (
        random.standard_normal((5, 200, 3)) * 10.0 ** random.integers(-20, 20, (5, 1, 3))
    ).astype(np.float32)
    values[2, :, 1] = 0
    values[:, 7] = 0
    result = quantized(values, 1)
    assert (
        result.integers.dtype == np.int16
        and result.scale.shape == (5, 1, 3)
        and result.values.dtype == np.float32
    )
    assert (
        np.abs(result.values.astype(float) - values) <= result.scale.astype(float) / 2 * ROUNDED
    ).all()
    assert np.abs(result.values - values).max() <= result.bound * ROUNDED
    assert (
        np.abs(result.integers).max() == LARGEST
        and not result.values[:, 7].any()
        and not result.values[2, :, 1].any()
    )
    np.testing.assert_allclose(
        np.abs(result.values).max(axis=1), np.abs(values).max(axis=1), rtol=1e-6
    )


def test_quantized_by_cluster_has_a_scale_for_each_column_of_each():
    """Large numbers of one cluster cost those of another nothing."""
    random, starts = np.random.default_rng(0), np.array([0, 1, 4, 10])
    values = (
        random.standard_normal((10, 4)) * np.repeat([1e6, 1, 1e-6], np.diff(starts))[:, None]
    ).astype(np.float32)
    result = quantized_by_cluster(values, starts)
    scales = cluster_scales(result, starts)
    assert scales.shape == (3, 4)
    for number, (first, last) in enumerate(itertools.pairwise(starts)):
        np.testing.assert_allclose(
            scales[number], np.abs(values[first:last]).max(axis=0) / LARGEST, rtol=1e-6
        )
        assert (
            np.abs(result.values[first:last] - values[first:last]) <= scales[number] / 2 * ROUNDED
        ).all()
    np.testing.assert_array_equal(
        quantized_by_cluster(np.zeros((10, 4), np.float32), starts).values, np.zeros((10, 4))
    )


@pytest.mark.parametrize("budget", ["dense", "sparse"])
def test_what_quantization_changes(assets, budget):
    """The two runs differ by it alone: each array within half its scale; and the report tells what
    it makes of depth and indirect irradiance.
    """
    exact, stored = assets[f"float32 {budget}"], assets[f"16 {budget}"]
    clusters, depth, transfer = local(exact).clusters, local(exact).depth, local(exact).transfer
    starts = clusters.starts
    np.testing.assert_array_equal(exact.points.positions, stored.points.positions)
    bounds = {
        "depth/means": quantized(depth.means, 1).scale,
        "depth/vectors": quantized(depth.vectors, 1).scale,
        "depth/coefficients": quantized_by_cluster(depth.coefficients, starts).scale,
        "transfer/encoder": quantized_by_cluster(transfer.encoder, starts).scale,
        "transfer/receivers": quantized_by_cluster(transfer.receivers, starts).scale,
        "transfer/matrix": np.abs(transfer.matrix).max(axis=(2, 3), keepdims=True) / LARGEST,
    }
    before, after = values_of(exact), values_of(stored)
    for name, scale in bounds.items():
        difference = np.abs(before[name] - after[name])
        assert (difference <= scale / 2 * ROUNDED).all() and difference.any(), name
    worst = max(
        np.abs(np.log(depth.depth(c, i)) - np.log(local(stored).depth.depth(c, i))).max()
        for i, c in enumerate(clusters.slices)
    )
    changed = local(stored).report["quantization"]
    assert abs(changed["depth"] - worst) < 0.01 * worst < 1e-3
    assert 0 < changed["indirect"] < 1e-3
    assert local(exact).report["quantization"] == {"depth": 0.0, "indirect": 0.0}
    one, other = (asset.irradiance(LIGHT, "indirect") for asset in (exact, stored))
    assert 0 < np.linalg.norm(one - other) < 3e-3 * np.linalg.norm(one)


@pytest.mark.parametrize("storage", STORAGE)
def test_as_stored_is_what_a_file_gives_back(assets, files, storage):
    """And it is done once: numbers that are on the grid of 16 bits stay where they are."""
    transport = local(assets[storage])
    again = transport.as_stored()
    assert (again.quantize, again.report) == (transport.quantize, transport.report)
    made = dataclasses.replace(assets[storage], transports={"local": again})
    for name, array in values_of(mi_prt.load(files[storage])).items():
        np.testing.assert_array_equal(values_of(made)[name], array, err_msg=name)


@pytest.mark.parametrize("quantize", ["16", "none"])
@pytest.mark.parametrize("share", [0.2, 1.0], ids=["sparse", "dense"])
@pytest.mark.parametrize("channels", [1, 3])
def test_any_numbers_are_stored(assets, quantize, share, channels):
    """Random numbers of all sizes, with clusters and rows of zeros among them, and an order of
    points of its own: float32 comes back exactly, 16 bits within half a scale, zeros as zeros.
    """
    random = np.random.default_rng(1)
    starts = np.array([0, 1, 4, 10])
    c, n, q, d, size = 3, 10, 4, 2, 16
    clusters = Clusters(random.permutation(n), starts, starts[:-1].copy())

    def numbers(*shape):
        sizes = 10.0 ** random.uniform(-6, 6, shape)
        return (random.standard_normal(shape) * sizes).astype(np.float32)

    matrix = numbers(c, q, c * d, channels) * (random.random((c, q, c * d, channels)) < share)
    matrix[1, 2:] = 0
    encoder = numbers(n, d)
    encoder[1:4] = 0
    depth = DepthBuffers(numbers(c, size), numbers(c, size, 5), numbers(n, 5), 7.5)
    transfer = Transfer(encoder, numbers(n, q), matrix)
    report = local(assets["16 dense"]).report
    exact = LocalTransport(clusters, depth, transfer, quantize, report)
    header = json.loads(json.dumps(exact.header()))
    check(header, LocalTransport.header_spec())
    arrays, sizes = exact.arrays(), {"n": n}
    assert header["sparse"] == (share < 1) and arrays.keys() == exact.shapes(header).keys()
    for name, array in exact.shapes(header).items():
        array.check_form(name, arrays[name].dtype, arrays[name].shape, sizes)
        array.check_values(name, arrays[name], sizes)
    stored = LocalTransport.from_arrays(header, arrays, assets["16 dense"].points.at(np.arange(n)))
    np.testing.assert_array_equal(stored.clusters.order, clusters.order)
    assert stored.depth.extent == 7.5 and stored.transfer.matrix.shape == matrix.shape
    largest = {
        "means": np.abs(depth.means).max(axis=1, keepdims=True),
        "vectors": np.abs(depth.vectors).max(axis=1, keepdims=True),
        "coefficients": by_cluster(depth.coefficients, starts),
        "encoder": by_cluster(encoder, starts),
        "receivers": by_cluster(transfer.receivers, starts),
        "matrix": np.abs(matrix).max(axis=(2, 3), keepdims=True),
    }
    for name, most in largest.items():
        before, after = (
            getattr(t.depth if hasattr(t.depth, name) else t.transfer, name)
            for t in (exact, stored)
        )
        bound = 0 if quantize == "none" else most / LARGEST / 2 * ROUNDED
        assert (np.abs(before - after) <= bound).all(), name
        assert not after[before == 0].any(), name


def by_cluster(values, starts):
    """The largest number of each column of each cluster, at each of its points."""
    parts = [values[a:b] for a, b in itertools.pairwise(starts)]
    return np.concatenate([np.broadcast_to(np.abs(p).max(axis=0), p.shape) for p in parts])


def test_bytes(assets, files):
    """`arrays` gives what the file holds, entry by entry; with 16 bits these take half the bytes
    and sparse ones less than dense ones; and what `info` says of storage is their sum.
    """
    size = {}
    for name, asset in assets.items():
        held, arrays = stored_in(files[name]), local(asset).arrays()
        assert held.keys() == arrays.keys()
        assert all(np.array_equal(held[key], array) for key, array in arrays.items())
        size[name] = sum(
            array.nbytes for key, array in arrays.items() if not key.startswith("clusters/")
        )
        assert size[name] == sum(local(asset).summary()["storage"]["measured"].values())
        points = sum(a.nbytes for k, a in values_of(asset).items() if k[:5] in ("point", "clust"))
        assert size[name] < files[name].stat().st_size < size[name] + points + 40_000
    assert (
        size["16 dense"] < 0.55 * size["float32 dense"]
        and size["16 sparse"] < 0.6 * size["float32 sparse"]
    )
    assert size["16 sparse"] < size["16 dense"] and size["float32 sparse"] < size["float32 dense"]


@pytest.mark.parametrize("storage", STORAGE)
def test_the_budget_is_kept(assets, storage):
    """The error that dropping made, as the report tells it, is within what the settings allow."""
    asset = assets[storage]
    assert local(asset).report["transfer_error"] <= asset.settings["transfer_error"]
    assert (local(asset).report["transfer_density"] < 0.5) == ("sparse" in storage)


def check_progress(events):
    """Every stage is told, never goes back, and comes to its total."""
    assert list(events) == ["samples", "example lights", "importance", "clusters", "transfer"]
    for stage, told in events.items():
        done = [d for d, _ in told]
        assert done == sorted(done) and told[-1][0] == told[-1][1], stage


# --- seeds ----------------------------------------------------------------------------------------


def test_seeds(files, tmp_path):
    """The same seed gives the same bytes, whatever ran before; another one other samples and other
    bytes. On the way progress is told.
    """
    events = {}

    def watch(stage, done, total, detail):
        events.setdefault(stage, []).append((done, total))

    precompute(output=tmp_path / "same.prt", progress=watch, **STORAGE["16 sparse"])
    check_progress(events)
    assert (tmp_path / "same.prt").read_bytes() == files["16 sparse"].read_bytes()
    other = precompute(seed=1, **STORAGE["16 sparse"])
    other.save(tmp_path / "other.prt")
    assert (tmp_path / "other.prt").read_bytes() != files["16 sparse"].read_bytes()
    assert not np.array_equal(
        other.points.positions, mi_prt.load(files["16 sparse"]).points.positions
    )


# --- damaged and foreign files --------------------------------------------------------------------


def damaged(path, copy, name, change):
    """A copy of a file in which an array is replaced by `change(array)`, or left out where that is
    None.
    """

    def replace(header, arrays):
        arrays[name] = change(arrays[name])
        if arrays[name] is None:
            del arrays[name]

    return rewritten(path, copy, replace)


RESHAPED = {
    "removed": lambda array: None,
    "cut short": lambda array: array[:-1],
    "too long": lambda array: np.concatenate([array, array[-1:]]),
    "deeper": lambda array: array[..., None],
}


@pytest.mark.parametrize("damage", RESHAPED)
@pytest.mark.parametrize("storage", ["16 dense", "16 sparse", "float32 sparse"])
def test_damaged_arrays(files, tmp_path, storage, damage):
    """Whichever array is missing or of another shape, the file is refused in one line; not one of
    them is taken for another thing.
    """
    names, taken = list(arrays_of(files[storage])), []
    assert len(names) > 15
    for name in names:
        path = damaged(files[storage], tmp_path / "damaged.prt", name, RESHAPED[damage])
        try:
            mi_prt.load(path)
            taken.append(name)
        except AssetError as error:
            assert "damaged.prt" in str(error) and "\n" not in str(error)
    assert not taken


BEYOND = [
    ("transfer/rows", 1 << 31),
    ("transfer/rows", 0),
    ("transfer/columns", 65535),
    ("transfer/ends", 1 << 40),
    ("transfer/ends", -1),
    ("clusters/starts", 1),
    ("clusters/order", 0),
    ("clusters/order", 600),
    ("clusters/roots", 0),
    ("clusters/roots", 600),
]


def load(path):
    """Loads a file that is to be refused. In a process of its own."""
    try:
        mi_prt.load(path)
    except AssetError:
        print("refused")


@pytest.mark.parametrize(("name", "value"), BEYOND)
def test_places_beyond_the_arrays(files, starter, tmp_path, name, value):
    """Indices that point elsewhere, or all to one place: an AssetError, where reading on would end
    the process. Hence a process of its own.
    """
    path = damaged(
        files["16 sparse"],
        tmp_path / "damaged.prt",
        f"transports/local/{name}",
        lambda array: np.full_like(array, value),
    )
    process = starter.start("load", str(path))
    output, errors = process.communicate()
    assert (process.returncode, output.strip()) == (0, "refused"), errors[-500:]


# --- light ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "light",
    [uniform_sky(), DirectionalLight((0, -1, 0), 1.0), [LIGHT, DirectionalLight((0, -1, 0), 1.0)]],
    ids=["map", "directional", "a list with one"],
)
def test_distant_light_is_refused(assets, light):
    """Visibility here ends at the lights: what to do instead is said."""
    with pytest.raises(LightError, match="holds local .*transports local,distant") as caught:
        assets["16 dense"].irradiance(light)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("light", [[], "point", 3, [LIGHT, None]], ids=str)
def test_what_is_no_light_is_refused(assets, light):
    with pytest.raises(LightError):
        assets["16 dense"].irradiance(light)


@pytest.mark.parametrize("component", ["diffuse", "", None, "Direct"])
def test_components(assets, component):
    with pytest.raises(SettingsError, match="use total, direct, indirect"):
        assets["16 dense"].irradiance(LIGHT, component)


@pytest.mark.parametrize("component", ["total", "direct", "indirect"])
def test_own_emitters_by_default(assets, component):
    """No light given: the lamp (64 places) and the bulb of the scene, exactly as if they were
    passed; of the bulb exactly that of a point light in its place.
    """
    asset, opened = assets["16 dense"], open_scene(SCENE)
    own = asset.resolved(scene=opened)
    assert len(emission_of(own)) == 65
    lamps = resolve(SceneLight(), opened)
    np.testing.assert_array_equal(
        asset.irradiance(own, component), asset.irradiance(lamps, component)
    )
    bulb = PointLight((0.4, 0.3, 0.2), (0.5, 1.0, 2.0))
    np.testing.assert_array_equal(
        asset.irradiance(asset.resolved("scene:bulb", scene=opened), component),
        asset.irradiance(bulb, component),
    )
    assert (asset.irradiance(own, "direct") >= asset.irradiance(bulb, "direct") * (1 - 1e-5)).all()


def test_emitters_that_cannot_be_taken(tmp_path):
    """A projector is local and not supported: the run goes through, and says so only when that
    light is asked for.
    """
    projector = {
        "type": "projector",
        "irradiance": {"type": "rgb", "value": 1.0},
        "to_world": mi.ScalarTransform4f().translate([0, 0, 2]),
    }
    asset = precompute(SCENE | dict(projector=projector), count=200, bounces=0)
    asset.irradiance(LIGHT)
    with pytest.raises(LightError, match="pass a light instead"):
        asset.irradiance(asset.resolved(scene=SCENE | dict(projector=projector)))


# --- settings -------------------------------------------------------------------------------------

BAD = [
    dict(count=0),
    dict(count=1_000_001),
    dict(count=1.5),
    dict(count=True),
    dict(count="many"),
    dict(count=None),
    dict(count=float("nan")),
    dict(cluster_size=0),
    dict(cluster_size=-5),
    dict(depth_directions=15),
    dict(depth_directions=17),
    dict(depth_directions=1 << 17),
    dict(depth_coefficients=0),
    dict(depth_coefficients=5000),
    dict(example_lights=0),
    dict(example_lights=1_000_000),
    dict(transfer_coefficients=0),
    dict(transfer_coefficients=2000),
    dict(transfer_error=-0.1),
    dict(transfer_error=1),
    dict(transfer_error=float("nan")),
    dict(transfer_error=float("inf")),
    dict(transfer_error="much"),
    dict(transfer_error=None),
    dict(quantize="8"),
    dict(quantize=None),
    dict(bounces=-1),
    dict(bounces=1.0),
    dict(bounces="all"),
    dict(bounces=10_001),
    dict(bounces=True),
    dict(seed=-1),
    dict(seed=1 << 31),
    dict(seed="x"),
]


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: "=".join(map(str, *bad.items())))
def test_bad_settings(bad):
    """Each is refused by its name, in one line."""
    name = next(iter(bad))
    with pytest.raises(SettingsError) as caught:
        Settings(**(ASKED | bad))
    assert name.split("_")[0] in str(caught.value) and "\n" not in str(caught.value)


def test_settings_are_stored_as_plain_numbers():
    """NumPy's integers, and what stands for 'any number' of bounces."""
    settings = Settings(count=np.int64(50), transfer_error="0.5", quantize=16, bounces=None)
    stored = (settings.count, settings.transfer_error, settings.quantize, settings.lamp_bounces)
    assert stored == (50, 0.5, "16", "auto")
    assert type(settings.count) is int
    assert Settings(count=1, depth_directions=16, bounces=0).lamp_bounces == 0


@pytest.mark.parametrize(
    ("asked", "foreign", "match"),
    [
        (ASKED, dict(edge_length=0.5), "edge_length .*setting of points vertices"),
        (ASKED, dict(basis="sh"), "basis .*setting of the transport distant"),
        (ASKED, dict(directions="cubemap:8"), "directions .*setting of the transport distant"),
        (ASKED, dict(lamp_rays=64), "lamp_rays .*setting of the transport own"),
        (dict(points="vertices"), dict(count=100), "count .*setting of points samples"),
        (dict(transports="own"), dict(cluster_size=9), "cluster_size .*setting of the transport l"),
        (ASKED, dict(colour=1), "'colour' is no setting"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_settings_of_what_is_not_built(asked, foreign, match):
    """Refused by name, with what they are for."""
    with pytest.raises(SettingsError, match=match):
        mi_prt.precompute(SCENE, **asked, **foreign)


@pytest.mark.parametrize("points", ["meshless", "", None, "Samples"])
def test_points_that_are_not_known(points):
    with pytest.raises(SettingsError, match="use auto, vertices or samples"):
        mi_prt.precompute(SCENE, points=points)


def test_fewer_samples_than_anything_else(tmp_path):
    """One sample, one cluster, more components and examples than there are samples: small, but
    whole and finite, and it is read again.
    """
    asset = precompute(
        count=1,
        cluster_size=1000,
        depth_coefficients=50,
        transfer_coefficients=20,
        example_lights=3,
    )
    asset.save(tmp_path / "a.prt")
    result = mi_prt.load(tmp_path / "a.prt").irradiance(LIGHT)
    assert (
        len(asset.points) == len(result) == len(local(asset).clusters) == 1
        and np.isfinite(result).all()
    )


# --- memory and interruptions ---------------------------------------------------------------------


def test_too_little_memory_is_refused_before_the_work(tmp_path):
    """No more than the samples were found: no ray is traced for depth or light, and nothing is left
    behind.
    """
    stages = set()
    with pytest.raises(SettingsError, match=r"max_memory \(--max-memory\)") as caught:
        precompute(
            max_memory="50M",
            output=tmp_path / "a.prt",
            progress=lambda stage, *_: stages.add(stage),
        )
    assert stages <= {"samples"} and os.listdir(tmp_path) == [] and "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["example lights", "importance", "clusters", "transfer"])
def test_interrupts_keep_what_was_computed(files, tmp_path, stage):
    """Ctrl-C in each stage: no file; then the run goes on, clusters that are there are not traced
    again, and the file is the same to the byte.
    """
    path, events = tmp_path / "a.prt", []

    def interrupt(at, done, total, detail):
        if at == stage and done >= total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        precompute(output=path, progress=interrupt, **STORAGE["16 sparse"])
    assert os.listdir(tmp_path) == ["a.prt.partial"]
    if stage == "clusters":  # what may not be continued is left as it is
        with pytest.raises(SettingsError, match="--resume"):
            precompute(output=path, **STORAGE["16 sparse"])
        with pytest.raises(SettingsError, match="depth_coefficients was 8, now 9"):
            precompute(
                output=path, resume=True, **STORAGE["16 sparse"] | dict(depth_coefficients=9)
            )
    precompute(
        output=path,
        resume=True,
        progress=lambda *event: events.append(event),
        **STORAGE["16 sparse"],
    )
    traced = [detail for at, _, _, detail in events if at == "clusters" and detail]
    assert len(traced) == {"example lights": 10, "importance": 10, "clusters": 5, "transfer": 0}[
        stage
    ] or (stage == "clusters" and 0 < len(traced) < 8)
    assert ("example lights" in [at for at, *_ in events]) == (stage == "example lights")
    assert path.read_bytes() == files["16 sparse"].read_bytes() and os.listdir(tmp_path) == [
        "a.prt"
    ]


def run_slowly(path):
    """Goes on where a run was left. In a process of its own."""

    def progress(stage, done, total, detail):
        print(stage, done, total, sep=";", flush=True)
        time.sleep(0.03)

    precompute(output=path, resume=True, progress=progress, **STORAGE["16 sparse"])


def test_a_killed_run_ends_in_the_same_file(files, starter, tmp_path):
    """SIGKILL while clusters are traced: no file is there, and what the next run leaves is the same
    to the byte.
    """
    path = tmp_path / "a.prt"
    process = starter.start("run_slowly", str(path))
    line = "start"
    while line and not line.startswith("clusters"):
        line = process.stdout.readline()
    assert line, process.communicate()[1][-2000:]
    time.sleep(0.07)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not path.exists() and (tmp_path / "a.prt.partial" / "run.json").exists()
    precompute(output=path, resume=True, **STORAGE["16 sparse"])
    assert path.read_bytes() == files["16 sparse"].read_bytes()


# --- forecasts ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "points", [dict(points="samples", count=1600), dict(points="vertices", edge_length=0.08)]
)
def test_the_cost_is_predicted_from_some_of_the_points(monkeypatch, points):
    """A run with fewer points than there are, also where those are nodes of patches: what is left
    of them has no patches. The size of the file comes out within a factor of two.
    """
    pilot = importlib.import_module("mi_prt.precompute.local")
    monkeypatch.setattr(pilot, "PROBE_POINTS", 1200)
    settings = SETTINGS | points | dict(transports="local", cluster_size=160)
    if points["points"] == "vertices":
        del settings["count"]
    found = describe(SCENE, **settings)
    assert found["requires"]["points"] > 1.3 * pilot.PROBE_POINTS
    assert found["predicted"]["seconds"] > 0
    asset = mi_prt.precompute(SCENE, **settings)
    stored = sum(array.nbytes for array in local(asset).arrays().values())
    assert 0.5 < found["predicted"]["transports"]["local"]["bytes"] / stored < 2
