"""Assets of local lights as files, in settings, and when runs are interrupted: what is read is what
was written, or a typed error.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from conftest import cube, diffuse, rectangle, scene, uniform_sky
from mi_prt.asset.meshless_file import as_stored, compressed
from mi_prt.asset.quantize import LARGEST, cluster_scales, quantized, quantized_by_cluster

import mi_prt
from mi_prt import (
    AssetError,
    DirectionalLight,
    LightError,
    MeshlessAsset,
    PointLight,
    SettingsError,
)
from mi_prt.lighting.local_emitters import local_scene_light
from mi_prt.points.points import POINT_FIELDS
from mi_prt.precompute.settings import MeshlessSettings
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

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
    return mi_prt.precompute(parts, points="samples", **(SETTINGS | settings))


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


def arrays_of(asset):
    """All arrays of an asset, by name."""
    parts = {f"points/{name}": getattr(asset.points, name) for name in POINT_FIELDS}
    parts |= {
        "starts": asset.samples.starts,
        "roots": asset.samples.roots,
        "extent": np.array(asset.depth.extent),
    }
    parts |= {
        f"depth/{name}": getattr(asset.depth, name) for name in ("means", "vectors", "coefficients")
    }
    parts |= {
        f"lights/{name}": getattr(asset.own_light, name)
        for name in ("positions", "axes", "intensity", "cosine", "cutoff", "beam")
    }
    if asset.transfer is not None:
        parts |= {
            f"transfer/{name}": getattr(asset.transfer, name)
            for name in ("encoder", "receivers", "matrix")
        }
    return parts


def names_in(path):
    with h5py.File(path) as file:
        names = []
        file.visit(
            lambda name: names.append(name) if isinstance(file[name], h5py.Dataset) else None
        )
        return names


# --- round trips ----------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", STORAGE)
def test_round_trip(assets, files, storage):
    """Bit for bit, every array, text and irradiance: 16-bit numbers are taken when the asset is
    made, not when it is saved, and both ways to store the transfer matrix occur.
    """
    asset, loaded = assets[storage], mi_prt.load(files[storage])
    assert (
        isinstance(loaded, MeshlessAsset) and loaded.path == asset.path == files[storage].absolute()
    )
    assert ("transfer/columns" in names_in(files[storage])) == ("sparse" in storage)
    before, after = arrays_of(asset), arrays_of(loaded)
    assert before.keys() == after.keys()
    for name, array in before.items():
        assert array.dtype == after[name].dtype, name
        np.testing.assert_array_equal(array, after[name], err_msg=name)
    for name in ("scene", "settings", "versions", "report"):
        assert json.loads(json.dumps(getattr(asset, name))) == getattr(loaded, name), name
    assert (
        loaded.points.report == asset.points.report
        and loaded.samples.radius == asset.samples.radius
    )
    assert list(loaded.points.surfaces) == json.loads(json.dumps(asset.points.surfaces))
    for component in ("direct", "indirect", "total"):
        np.testing.assert_array_equal(
            loaded.irradiance(LIGHT, component), asset.irradiance(LIGHT, component)
        )
        np.testing.assert_array_equal(
            loaded.irradiance(None, component), asset.irradiance(None, component)
        )
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
    assert (
        asset.transfer is None
        and loaded.transfer is None
        and not len(loaded.own_light)
        and loaded.reference_bounces == 0
    )
    assert not any(name.startswith("transfer") for name in names_in(tmp_path / "a.prt"))
    np.testing.assert_array_equal(loaded.irradiance(LIGHT), asset.irradiance(LIGHT))
    for component in ("total", "indirect"):
        with pytest.raises(LightError, match="no local light.*--light"):
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
    for number, (first, last) in enumerate(zip(starts, starts[1:])):
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
    starts = exact.samples.starts
    np.testing.assert_array_equal(exact.points.positions, stored.points.positions)
    bounds = {
        "depth/means": quantized(exact.depth.means, 1).scale,
        "depth/vectors": quantized(exact.depth.vectors, 1).scale,
        "depth/coefficients": quantized_by_cluster(exact.depth.coefficients, starts).scale,
        "transfer/encoder": quantized_by_cluster(exact.transfer.encoder, starts).scale,
        "transfer/receivers": quantized_by_cluster(exact.transfer.receivers, starts).scale,
        "transfer/matrix": np.abs(exact.transfer.matrix).max(axis=(2, 3), keepdims=True) / LARGEST,
    }
    before, after = arrays_of(exact), arrays_of(stored)
    for name, scale in bounds.items():
        difference = np.abs(before[name] - after[name])
        assert (difference <= scale / 2 * ROUNDED).all() and difference.any(), name
    worst = max(
        np.abs(np.log(exact.depth.depth(c, i)) - np.log(stored.depth.depth(c, i))).max()
        for i, c in enumerate(exact.samples.clusters)
    )
    assert abs(stored.report["quantization"]["depth"] - worst) < 0.01 * worst < 1e-3
    assert 0 < stored.report["quantization"]["indirect"] < 1e-3 and exact.report[
        "quantization"
    ] == {"depth": 0.0, "indirect": 0.0}
    one, other = (asset.irradiance(LIGHT, "indirect") for asset in (exact, stored))
    assert 0 < np.linalg.norm(one - other) < 3e-3 * np.linalg.norm(one)


def test_as_stored_is_done_once(assets):
    """Numbers that are on the grid of 16 bits stay where they are."""
    asset = assets["16 dense"]
    depth, transfer = as_stored(asset.depth, asset.transfer, asset.samples.starts, "16")
    for name in ("means", "vectors", "coefficients"):
        np.testing.assert_array_equal(getattr(depth, name), getattr(asset.depth, name))
    for name in ("encoder", "receivers", "matrix"):
        np.testing.assert_array_equal(getattr(transfer, name), getattr(asset.transfer, name))


def test_bytes(assets, files):
    """`compressed` holds what the file holds, entry by entry; with 16 bits these take half the
    bytes and sparse ones less than dense ones.
    """
    size = {}
    for name, asset in assets.items():
        arrays = compressed(asset)
        size[name] = sum(np.asarray(array).nbytes for array in arrays.values())
        with h5py.File(files[name]) as file:
            assert {
                key for key in names_in(files[name]) if key.startswith(("depth", "transfer"))
            } == set(arrays)
            assert all(np.array_equal(file[key][()], array) for key, array in arrays.items())
        points = sum(
            array.nbytes
            for key, array in arrays_of(asset).items()
            if key.startswith(("points", "lights"))
        )
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
    assert asset.report["transfer_error"] <= asset.settings["transfer_error"]
    assert (asset.report["transfer_density"] < 0.5) == ("sparse" in storage)


def check_progress(events):
    """Every stage is told, never goes back, and comes to its total."""
    assert list(events) == ["samples", "example lights", "importance", "clusters", "reflections"]
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
    shutil.copy(path, copy)
    with h5py.File(copy, "r+") as file:
        value = change(file[name][()])
        del file[name]
        if value is not None:
            file[name] = value
    return copy


RESHAPED = {
    "removed": lambda array: None,
    "cut short": lambda array: array[:-1] if array.ndim else array[None],
    "too long": lambda array: (
        np.concatenate([array, array[-1:]]) if array.ndim else np.stack([array, array])
    ),
    "deeper": lambda array: array[..., None],
}
HARMLESS = {("transfer/matrix_scale", "deeper")}  # of entries, each row has one scale in any case


@pytest.mark.parametrize("damage", RESHAPED)
@pytest.mark.parametrize("storage", ["16 dense", "16 sparse", "float32 sparse"])
def test_damaged_arrays(files, tmp_path, storage, damage):
    """Whichever array is missing or of another shape, the file is refused in one line; not one of
    them is taken for another thing.
    """
    taken = []
    for name in names_in(files[storage]):
        path = damaged(files[storage], tmp_path / "damaged.prt", name, RESHAPED[damage])
        try:
            mi_prt.load(path)
            taken.append(name)
        except AssetError as error:
            assert "damaged.prt" in str(error) and "\n" not in str(error)
    assert not [name for name in taken if (name, damage) not in HARMLESS]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("transfer/rows", 1 << 31),
        ("transfer/columns", 65535),
        ("transfer/ends", 1 << 40),
        ("transfer/ends", -1),
        ("transfer/shape", 1000),
        ("clusters/starts", 1),
    ],
)
def test_places_beyond_the_arrays(files, tmp_path, name, value):
    """Indices that point elsewhere: an AssetError, where reading on would end the process.

    Hence a process of its own.
    """
    path = damaged(
        files["16 sparse"], tmp_path / "damaged.prt", name, lambda array: np.full_like(array, value)
    )
    program = (
        f"import mi_prt\ntry:\n    mi_prt.load({str(path)!r})\nexcept mi_prt.AssetError:\n   "
        " print('refused')"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert (run.returncode, run.stdout.strip()) == (0, "refused"), run.stderr[-500:]


@pytest.mark.parametrize(
    "name", ["scene", "settings", "versions", "report", "format", "format_version", "complete"]
)
def test_damaged_texts(files, tmp_path, name):
    """Missing, or no JSON and no number: refused."""
    for value in (None, "{", np.zeros(2)):
        path = tmp_path / "damaged.prt"
        shutil.copy(files["16 dense"], path)
        with h5py.File(path, "r+") as file:
            del file.attrs[name]
            if value is not None and not (name == "complete" and isinstance(value, str)):
                file.attrs[name] = value
        with pytest.raises(AssetError):
            mi_prt.load(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_files(files, tmp_path, share):
    content = files["16 sparse"].read_bytes()
    (tmp_path / "a.prt").write_bytes(content[: int(share * len(content))])
    with pytest.raises(AssetError, match="truncated or no mi_prt asset"):
        mi_prt.load(tmp_path / "a.prt")


def test_foreign_files(tmp_path):
    """No file, a text, and HDF5 of something else."""
    with pytest.raises(AssetError, match="does not exist"):
        mi_prt.load(tmp_path / "none.prt")
    (tmp_path / "text.prt").write_text("room")
    with pytest.raises(AssetError, match="truncated or no"):
        mi_prt.load(tmp_path / "text.prt")
    with h5py.File(tmp_path / "other.prt", "w") as file:
        file["x"] = 1
    with pytest.raises(AssetError, match="no mi_prt asset"):
        mi_prt.load(tmp_path / "other.prt")


def test_both_kinds_of_files(files, tmp_path):
    """Distant light has format version 3, as before there were others, and local light 4; `load`
    tells them apart. A file that says it is of the other kind, or of a version yet to come, is
    refused.
    """
    distant = mi_prt.precompute(
        SCENE, directions="cubemap:4", edge_length=0.5, coefficients=4, bounces=0
    )
    distant.save(tmp_path / "distant.prt")
    loaded = mi_prt.load(tmp_path / "distant.prt")
    assert isinstance(loaded, mi_prt.Asset) and isinstance(
        mi_prt.load(files["16 dense"]), MeshlessAsset
    )
    np.testing.assert_array_equal(
        loaded.irradiance(uniform_sky()), distant.irradiance(uniform_sky())
    )
    for path, version, other in ((tmp_path / "distant.prt", 3, 4), (files["16 dense"], 4, 3)):
        for wrong in (other, 2, 99):
            shutil.copy(path, tmp_path / "wrong.prt")
            with h5py.File(tmp_path / "wrong.prt", "r+") as file:
                assert file.attrs["format_version"] == version
                file.attrs["format_version"] = wrong
            with pytest.raises(
                AssetError,
                match=(
                    "truncated or no"
                    if wrong == other
                    else f"format version {wrong}, this program reads 3 and 4"
                ),
            ):
                mi_prt.load(tmp_path / "wrong.prt")


# --- light ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "light",
    [uniform_sky(), DirectionalLight((0, -1, 0), 1.0), [LIGHT, DirectionalLight((0, -1, 0), 1.0)]],
    ids=["map", "directional", "a list with one"],
)
def test_distant_light_is_refused(assets, light):
    """Visibility here ends at the lights: what to do instead is said."""
    with pytest.raises(LightError, match="points='vertices'") as caught:
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
    passed.
    """
    asset = assets["16 dense"]
    light = local_scene_light(open_scene(SCENE))
    assert len(asset.own_light) == 65
    np.testing.assert_array_equal(
        asset.irradiance(component=component), asset.irradiance(light, component)
    )
    bulb = PointLight((0.4, 0.3, 0.2), (0.5, 1.0, 2.0))
    assert (
        asset.irradiance(component="direct") >= asset.irradiance(bulb, "direct") * (1 - 1e-5)
    ).all()


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
        asset.irradiance()


# --- settings -------------------------------------------------------------------------------------

BAD = [
    dict(count=0),
    dict(count=1_000_001),
    dict(count=1.5),
    dict(count=True),
    dict(count="100"),
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
    """Each is refused by its name, in one line, before any work: precompute does not look at the
    scene, which there is none.
    """
    name = next(iter(bad))
    with pytest.raises(SettingsError) as caught:
        mi_prt.precompute("no such scene.xml", points="samples", **bad)
    assert name.split("_")[0] in str(caught.value) and "\n" not in str(caught.value)


def test_settings_are_stored_as_plain_numbers():
    """NumPy's integers, and what stands for 'any number' of bounces."""
    settings = MeshlessSettings(count=np.int64(50), transfer_error="0.5", quantize=16, bounces=None)
    assert (settings.count, settings.transfer_error, settings.quantize, settings.bounces) == (
        50,
        0.5,
        "16",
        "auto",
    )
    assert (
        type(settings.count) is int
        and MeshlessSettings(count=1, depth_directions=16, bounces=0).bounces == 0
    )


@pytest.mark.parametrize(
    ("points", "setting"),
    [
        ("samples", "edge_length"),
        ("samples", "basis"),
        ("samples", "directions"),
        ("vertices", "count"),
        ("vertices", "quantize"),
        ("samples", "colour"),
    ],
)
def test_settings_of_the_other_kind_of_points(points, setting):
    """Refused by name, with those that there are."""
    with pytest.raises(SettingsError, match=f"{setting} is no setting of points '{points}'"):
        mi_prt.precompute(SCENE, points=points, **{setting: 1})


@pytest.mark.parametrize("points", ["meshless", "", None, "Samples"])
def test_points_that_are_not_known(points):
    with pytest.raises(SettingsError, match="use vertices or samples"):
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
        len(asset.points) == len(result) == len(asset.samples.roots) == 1
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


@pytest.mark.parametrize("stage", ["example lights", "importance", "clusters", "reflections"])
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
    assert len(traced) == {"example lights": 10, "importance": 10, "clusters": 5, "reflections": 0}[
        stage
    ] or (stage == "clusters" and 0 < len(traced) < 8)
    assert ("example lights" in [at for at, *_ in events]) == (stage == "example lights")
    assert path.read_bytes() == files["16 sparse"].read_bytes() and os.listdir(tmp_path) == [
        "a.prt"
    ]


PROGRAM = """
import sys, time
sys.path.insert(0, sys.argv[1])
from test_meshless_asset import STORAGE, precompute
def progress(stage, done, total, detail):
    print(stage, done, total, sep=";", flush=True)
    time.sleep(0.03)
precompute(output=sys.argv[2], resume=True, progress=progress, **STORAGE["16 sparse"])
"""


def test_a_killed_run_ends_in_the_same_file(files, tmp_path):
    """SIGKILL while clusters are traced: no file is there, and what the next run leaves is the same
    to the byte.
    """
    path = tmp_path / "a.prt"
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, os.path.dirname(__file__), str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    line = "start"
    while line and not line.startswith("clusters"):
        line = process.stdout.readline()
    assert line, process.communicate()[1][-2000:]
    time.sleep(0.07)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert not path.exists() and (tmp_path / "a.prt.partial" / "run.json").exists()
    precompute(output=path, resume=True, **STORAGE["16 sparse"])
    assert path.read_bytes() == files["16 sparse"].read_bytes()
