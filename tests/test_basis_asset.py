"""The basis against NumPy's SVD, and the asset file: what it holds, that it can be trusted, and how
it fails.
"""

import hashlib
import json
import os
import subprocess
import sys
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
import threadpoolctl
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
    sphere,
    uniform_sky,
)
from mutants import Mutator

import mi_prt
import mi_prt.transport.bits
from mi_prt import AssetError, SettingsError
from mi_prt.asset import container
from mi_prt.basis import pca
from mi_prt.basis.pca import fit_pca
from mi_prt.basis.rows import Rows
from mi_prt.basis.target import Target
from mi_prt.directions import Cubemap
from mi_prt.lighting.cells import cell_radiance
from mi_prt.precompute import budget as room
from mi_prt.precompute.precompute import measure
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import sample_direct

mi = mitsuba()

SMALL = dict(
    floor=rectangle(size=2, bsdf=diffuse(0.6)),
    box=cube((0.2, 0.4, 0), 0.4),
    ball=disk((0, 1, 0.1), (0.3, 1.5, 0), 0.6),
)


COLOURED = SMALL | dict(floor=rectangle(size=2, bsdf=diffuse([0.7, 0.5, 0.2])))
TOTAL = "transports/distant/total/"  # arrays in files
# The forms of what is stored: one channel; three channels of the components, or of the
# coefficients, where reflections colour the light.
ASSETS = {
    "direct": {},
    "reflected": dict(parts=COLOURED, bounces=2, paths_per_point=32),
    "reflected, sh": dict(
        parts=COLOURED, bounces=2, paths_per_point=32, basis="sh", coefficients=49
    ),
}


def precompute(parts=SMALL, directions="cubemap:8", edge_length=0.8, bounces=0, **settings):
    """Of direct light, unless bounces are asked for."""
    return mi_prt.precompute(
        scene(**parts), directions=directions, edge_length=edge_length, bounces=bounces, **settings
    )


@pytest.fixture(scope="module", params=ASSETS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def asset(kind):
    return precompute(**ASSETS[kind])


@pytest.fixture(scope="module")
def saved(asset, tmp_path_factory):
    path = tmp_path_factory.mktemp("asset") / "small.prt"
    asset.save(path)
    return path


# --- PCA ------------------------------------------------------------------------------------------


def random_matrix(n, s, rank=None, decay=6.0, seed=0):
    """(n, s) float32 with a mean far from zero: of a rank with exponentially decaying singular
    values, or of full rank with values that fall as slowly as 1/k.
    """
    rng = np.random.default_rng(seed)
    values = 1 / np.arange(1, min(n, s) + 1) if rank is None else np.exp(-np.arange(rank) / decay)
    left, right = rng.standard_normal((n, len(values))), rng.standard_normal((len(values), s))
    return (left * values @ right + 3 * rng.random(s)).astype(np.float32)


def fitted(matrix, weights, components=None, index=None, variance=None, **options):
    index = np.arange(len(matrix)) if index is None else index
    rows = Rows(lambda rows: matrix[rows].copy(), index, SimpleNamespace(solid_angles=weights))
    return fit_pca(rows, Target(components, variance), **options)


def fit(matrix, weights, components, index=None, **options):
    return fitted(matrix, weights, components, index, **options).basis


def svd(matrix, weights):
    """Squared singular values and right vectors of the centred matrix in the √w-weighted space, in
    float64.

    One thread: a threaded BLAS stalls where other programs run.
    """
    weighted = (matrix - matrix.mean(axis=0, dtype=np.float64)) * np.sqrt(weights)
    with threadpoolctl.threadpool_limits(1, "blas"):
        if min(matrix.shape) <= 300:
            _, values, vectors = np.linalg.svd(weighted, full_matrices=False)
            return weighted, values**2, vectors
        gram = weighted.T @ weighted if len(weighted) > len(weights) else weighted @ weighted.T
        return weighted, np.linalg.eigvalsh(gram)[::-1], None  # a tenth of the time


EXACT = [(60, 40, None), (40, 60, None), (300, 900, 30), (900, 300, 30)]
ITERATED = [(2400, 900, 40), (900, 1800, 40), (3000, 800, None)]


@pytest.mark.parametrize(("n", "s", "rank"), EXACT + ITERATED)
def test_components_are_those_of_the_svd(n, s, rank, monkeypatch):
    """The decomposition is unique: exact for small shapes; iterated, captured variance is within
    1e-3 of the optimum.

    Small shapes are exact, where that is negligible; else the way that costs less is taken.
    """
    components = 16
    exact = (n, s, rank) in EXACT
    matrix, weights = random_matrix(n, s, rank), np.random.default_rng(1).random(s) + 0.2
    monkeypatch.setattr(pca, "NEGLIGIBLE", 1 if exact else 0)
    basis = fit(matrix, weights, components)
    weighted, squares, vectors = svd(matrix, weights)
    optimum = squares[:components] / squares.sum()
    assert basis.vectors.shape == (components, s)
    np.testing.assert_allclose(basis.vectors @ basis.vectors.T, np.eye(components), atol=1e-5)
    assert (np.diff(basis.captured_variance) <= 1e-9).all()
    assert abs(basis.captured_variance.sum() - optimum.sum()) < (1e-6 if exact else 1e-3)
    residual = weighted - (weighted @ basis.vectors.T) @ basis.vectors
    truly = 1 - (residual**2).sum() / squares.sum()
    assert abs(truly - basis.captured_variance.sum()) < 1e-5
    if exact:
        np.testing.assert_allclose(basis.captured_variance, optimum, rtol=1e-4)
        if rank:  # well separated: each vector is the SVD's, up to sign
            assert np.abs((basis.vectors * vectors[:components]).sum(axis=1)).min() > 1 - 1e-4


def test_encode_and_reconstruct_are_the_projection():
    """T ≈ mean + c·V/√w with c = (T − mean)√w Vᵀ: the best approximation in the weighted norm, rows
    left out included.
    """
    matrix, weights = random_matrix(200, 80, 25), np.random.default_rng(1).random(80) + 0.2
    index = np.arange(0, 200, 2)
    basis = fit(matrix, weights, 10, index)
    _, _, vectors = svd(matrix[index], weights)
    mean = matrix[index].mean(axis=0)
    projection = ((matrix - mean) * np.sqrt(weights) @ vectors[:10].T @ vectors[:10]) / np.sqrt(
        weights
    ) + mean
    coefficients = basis.encode(matrix)
    assert coefficients.shape == (200, 10)
    assert relative_l2(basis.reconstruct(coefficients), projection) < 1e-5


def test_a_fit_that_has_no_room_is_refused(monkeypatch):
    """With what is needed and what is left; also when a search for a share of the variance goes
    on.
    """
    matrix, weights = random_matrix(2400, 900), np.ones(900)
    with pytest.raises(SettingsError, match="max_memory") as caught:
        fit(matrix, weights, 16, max_bytes=1e6)
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(pca, "NEGLIGIBLE", 0)
    with pytest.raises(SettingsError, match="fitting .* components needs"):
        fitted(matrix, weights, variance=0.9999, max_bytes=8e6)


@pytest.mark.parametrize("every", [2, 4])
def test_rows_that_repeat_in_the_order_of_points_are_not_missed(every):
    """Meshes order their vertices regularly (quads: every fourth is the same corner). Clamped
    cosines behind random half-spaces, with each `every`-th row alike: the variance that 48
    components capture is within 1e-3 of the optimum.
    """
    rng, lattice = np.random.default_rng(0), Cubemap(16)
    normals, blockers = rng.standard_normal((2, 6000, 3))
    matrix = np.maximum(
        normals / np.linalg.norm(normals, axis=1, keepdims=True) @ lattice.vectors.T, 0
    )
    matrix *= blockers @ lattice.vectors.T > rng.standard_normal((6000, 1))
    matrix[::every] = matrix[0]
    basis = fit(matrix.astype(np.float32), lattice.solid_angles, 48)
    _, squares, _ = svd(matrix, lattice.solid_angles)
    assert squares[:48].sum() / squares.sum() - basis.captured_variance.sum() < 1e-3


@pytest.mark.parametrize(("n", "s", "rank"), [(40, 60, 7), (2400, 900, 7)])
def test_components_beyond_the_rank_are_left_out(n, s, rank):
    """A matrix of a rank has that many components and no noise beside them."""
    matrix, weights = random_matrix(n, s, rank, decay=10.0), np.full(s, 4 * np.pi / s)
    basis = fit(matrix, weights, 16)
    assert len(basis.vectors) == rank
    assert basis.captured_variance.sum() == pytest.approx(1, abs=1e-5)
    assert relative_l2(basis.reconstruct(basis.encode(matrix)), matrix) < 1e-5


@pytest.mark.parametrize(("n", "s"), [(600_000, 60), (100_000, 800)])
def test_many_points_do_not_lower_the_rank(n, s):
    """Repeating every row k times multiplies all squared singular values by k and leaves their
    shares as they were.
    """
    table, weights = random_matrix(2000, s), np.ones(s)
    rows = Rows(
        lambda rows: table[rows % 2000], np.arange(n), SimpleNamespace(solid_angles=weights)
    )
    basis = fit_pca(rows, Target(16)).basis
    _, squares, _ = svd(table, weights)
    assert len(basis.vectors) == 16
    assert abs(basis.captured_variance.sum() - squares[:16].sum() / squares.sum()) < 1e-3


def test_degenerate_matrices():
    """All zero, all rows alike, a single row, no components: an empty basis, and the mean is
    exact.
    """
    weights = np.ones(50)
    for matrix in [
        np.zeros((9, 50), np.float32),
        np.full((9, 50), 3.0, np.float32),
        np.arange(50, dtype=np.float32)[None],
    ]:
        basis = fit(matrix, weights, 4)
        assert basis.vectors.shape == (0, 50) and basis.captured_variance.shape == (0,)
        np.testing.assert_allclose(basis.reconstruct(basis.encode(matrix)), matrix, rtol=1e-6)
    assert fit(random_matrix(30, 50), weights, 0).vectors.shape == (0, 50)


def test_the_same_seed_gives_the_same_basis():
    """Also where the start is random; another seed gives nearly the same subspace."""
    matrix, weights = random_matrix(2400, 900, 40), np.ones(900)
    one, two, other = (fit(matrix, weights, 16, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.vectors, two.vectors)
    assert np.linalg.norm(one.vectors @ other.vectors.T) ** 2 > 15.99


# --- the mean -------------------------------------------------------------------------------------


def irradiances(matrix, weights, components, radiance):
    """Exact mean, the paper's form, and the direct sum Σ w L T."""
    basis = fit(matrix, weights, components)
    coefficients = basis.encode(matrix)
    light, response = basis.project_light(radiance)
    return (
        basis,
        coefficients @ light + response,
        basis.paper_irradiance(coefficients, radiance),
        matrix @ (weights[:, None] * radiance),
    )


def test_the_papers_mean_compensation_agrees_where_the_mean_lies_in_the_span():
    """Non-negative mixtures of five rows: centred, they still span all five, and with them the
    mean.
    """
    rng = np.random.default_rng(2)
    matrix = (rng.random((100, 5)) @ rng.random((5, 70))).astype(np.float32)
    weights, radiance = (
        rng.random(70).astype(np.float32) + 0.1,
        rng.random((70, 3)).astype(np.float32),
    )
    _, exact, paper, direct = irradiances(matrix, weights, 5, radiance)
    assert relative_l2(exact, direct) < 1e-5 and relative_l2(paper, direct) < 1e-5


def test_the_papers_mean_compensation_drops_the_mean_outside_of_the_span():
    """Its error is the same for all points: the response to light of the mean's part outside the
    span, predicted here.
    """
    rng = np.random.default_rng(3)
    matrix = (rng.standard_normal((100, 5)) @ rng.random((5, 70)) + 5 * rng.random(70)).astype(
        np.float32
    )
    weights, radiance = rng.random(70) + 0.1, rng.random((70, 3)).astype(np.float32)
    _, exact, paper, direct = irradiances(matrix, weights, 5, radiance)
    assert relative_l2(exact, direct) < 1e-5
    _, _, vectors = svd(matrix, weights)
    mean = matrix.mean(axis=0, dtype=np.float64) * np.sqrt(weights)
    outside = mean - vectors[:5].T @ (vectors[:5] @ mean)
    predicted = outside @ (radiance * np.sqrt(weights)[:, None])
    assert np.linalg.norm(predicted) > 1
    np.testing.assert_allclose(exact - paper, np.broadcast_to(predicted, exact.shape), rtol=2e-4)


# --- rank and coefficients of scenes --------------------------------------------------------------


def maximum_named(caught):
    message = str(caught.value)
    assert "\n" not in message
    return int(message.split()[-1].replace(",", ""))


def test_full_rank_reproduces_the_sampled_transport():
    """With all components nothing is lost: transport, and irradiance under random light, to 1e-5.

    The number of components is found from the refusals, which name the maximum.
    """
    with pytest.raises(SettingsError) as caught:
        precompute(coefficients=100_000)
    largest = maximum_named(caught)
    try:
        full = precompute(coefficients=largest)
    # points that see the same make the rank lower than the counts tell
    except SettingsError as error:
        largest = int(str(error).split()[-1])
        full = precompute(coefficients=largest)
    assert len(distant(full).basis.vectors) == largest == full.settings["coefficients"]
    lattice = Cubemap(8)
    sampled = sample_direct(open_scene(scene(**SMALL)), full.points, lattice)
    rows = np.arange(len(full.points))
    kept = ~full.buried
    assert relative_l2(distant(full).total.rows(rows)[kept], sampled.rows(rows)[kept]) < 1e-5
    light = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    expected = sampled.irradiance(cell_radiance(light, lattice), lattice.solid_angles)
    assert relative_l2(full.irradiance(light)[kept], expected[kept]) < 1e-5
    assert distant(full).report["captured_variance"] == pytest.approx(1, abs=1e-5)


def test_error_falls_with_coefficients():
    """Nested subspaces: each more component can only lower the error of the transport, down to what
    was captured.
    """
    errors = []
    for coefficients in (0, 4, 16, 48):
        fitted = precompute(coefficients=coefficients)
        rows = np.flatnonzero(~fitted.buried)
        sampled = sample_direct(open_scene(scene(**SMALL)), fitted.points, Cubemap(8)).rows(rows)
        weighted = (distant(fitted).total.rows(rows) - sampled) * np.sqrt(Cubemap(8).solid_angles)
        total = (sampled - sampled.mean(axis=0)) * np.sqrt(Cubemap(8).solid_angles)
        errors.append((weighted**2).sum() / (total**2).sum())
        assert errors[-1] == pytest.approx(
            1 - distant(fitted).report["captured_variance"], abs=1e-4
        )
    assert errors == sorted(errors, reverse=True) and errors[0] == pytest.approx(1, abs=1e-5)


def test_a_scene_of_rank_zero():
    """A single plane has one row of transport: the default takes no component and loses nothing;
    more are refused.
    """
    flat = precompute(dict(plane=rectangle()))
    assert distant(flat).coefficients.shape == (len(flat.points), 0)
    assert flat.settings["coefficients"] == 0
    np.testing.assert_allclose(flat.irradiance(uniform_sky()), np.pi, rtol=0.01)
    with pytest.raises(SettingsError) as caught:
        precompute(dict(plane=rectangle()), coefficients=5)
    assert maximum_named(caught) == 0


@pytest.mark.parametrize(
    "bad",
    [
        dict(coefficients=-1),
        dict(rays_per_direction=0),
        dict(rays_per_direction=65),
        dict(seed=-1),
        dict(directions="cubemap:0"),
        dict(coefficients="many"),
        dict(coefficients=2.5),
        dict(rays_per_direction=1.5),
        dict(seed="x"),
        dict(rays_per_direction=None),
    ],
    ids=str,
)
def test_bad_settings(bad):
    """Also of a wrong type: the caller gets a SettingsError before any work starts."""
    with pytest.raises(SettingsError) as caught:
        precompute(**bad)
    assert "\n" not in str(caught.value)


# --- the file -------------------------------------------------------------------------------------


def test_round_trip(kind, asset, saved):
    """What is loaded is what was saved, bit for bit."""
    loaded = mi_prt.load(saved)
    held, again = distant(asset), distant(loaded)
    n, d = len(asset.points), len(held.basis)
    assert again.coefficients.shape == ((n, 3, d) if kind == "reflected, sh" else (n, d))
    assert again.basis.vectors.shape == ((d, 3, 384) if kind == "reflected" else (d, 384))
    assert again.channels == (1 if kind == "direct" else 3)
    for name in asset.points.SHAPES:
        np.testing.assert_array_equal(getattr(loaded.points, name), getattr(asset.points, name))
    for name, array in asset.points.layout.arrays().items():
        np.testing.assert_array_equal(loaded.points.layout.arrays()[name], array)
    for name in held.basis.ARRAYS:
        np.testing.assert_array_equal(getattr(again.basis, name), getattr(held.basis, name))
    np.testing.assert_array_equal(again.coefficients, held.coefficients)
    for name in ("scene", "settings", "versions", "report"):
        assert getattr(loaded, name) == json.loads(json.dumps(getattr(asset, name)))
    assert again.report == json.loads(json.dumps(held.report))
    assert loaded.points.report == asset.points.report and list(loaded.points.surfaces) == list(
        asset.points.surfaces
    )
    assert again.directions == held.directions
    light = np.random.default_rng(0).random((8, 16, 3))
    np.testing.assert_array_equal(loaded.relight(light), asset.relight(light))
    assert loaded.path == saved and saved.stat().st_mode & 0o444 == 0o444 & ~umask()


def umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_saving_what_was_loaded_gives_the_same_file(saved, tmp_path):
    mi_prt.load(saved).save(tmp_path / "again.prt")
    assert (tmp_path / "again.prt").read_bytes() == saved.read_bytes()


def test_the_file_is_enough_for_numpy(asset, saved):
    """E = max(0, c·(V (L√w)) + Σ w L mean), from the file's arrays alone; where vectors and mean,
    or coefficients, are of three channels, each for its own channel of light.
    """
    stored = {name.removeprefix(TOTAL): array for name, array in arrays_of(saved).items()}
    coefficients, functions = stored["coefficients"], stored["basis/vectors"]
    w = stored["basis/sqrt_weights"].astype(float) ** 2
    radiance = np.random.default_rng(1).random((len(w), 3))  # of the cells
    light = radiance * np.sqrt(w)[:, None]
    channels = []
    for channel in range(3):
        c = coefficients[:, channel] if coefficients.ndim == 3 else coefficients
        v = functions[:, channel] if functions.ndim == 3 else functions
        m = stored["basis/mean"][channel] if functions.ndim == 3 else stored["basis/mean"]
        channels.append(c @ (v @ light[:, channel]) + (m * np.sqrt(w)) @ light[:, channel])
    irradiance = np.maximum(np.stack(channels, axis=-1), 0)
    held = distant(asset)
    expected = held.total.respond(*held.basis.project_light(radiance.astype(np.float32)))
    assert relative_l2(irradiance, np.maximum(expected, 0)) < 1e-5
    np.testing.assert_allclose(w, Cubemap(8).solid_angles, rtol=1e-5)


def test_the_same_seed_gives_the_same_file_within_a_process(kind, saved, tmp_path):
    """Nothing of time, addresses or thread order gets into the file."""
    precompute(**ASSETS[kind]).save(tmp_path / "again.prt")
    assert (tmp_path / "again.prt").read_bytes() == saved.read_bytes()


PROGRAM = """
import sys, mi_prt
red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
ball = {"type": "sphere", "center": [0, 1, 0], "bsdf": red}
parts = {"type": "scene", "ball": ball, "box": {"type": "cube"}, "extra": {"type": "disk"}}
settings = dict(directions="cubemap:8", edge_length=0.5, paths_per_point=64)
asset = mi_prt.precompute(parts, indirect=sys.argv[2], **settings)
assert asset.transports["distant"].channels == 3
asset.save(sys.argv[1])
"""


@pytest.mark.parametrize("indirect", ["solve", "paths"])
def test_the_same_seed_gives_the_same_file_in_two_processes(tmp_path, indirect):
    """Another hash seed and addresses; unnamed shapes, whose made-up ids hold an address.

    Reflections included.
    """
    running = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(tmp_path / f"{i}.prt"), indirect],
            env=os.environ | {"PYTHONHASHSEED": str(i)},
        )
        for i in (1, 2)
    ]
    assert [process.wait(120) for process in running] == [0, 0]
    one, two = (hashlib.sha256((tmp_path / f"{i}.prt").read_bytes()).hexdigest() for i in (1, 2))
    assert one == two


def refused(path, match=None):
    """One line that names the file."""
    with pytest.raises(AssetError, match=match) as caught:
        mi_prt.load(path)
    assert path.name in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_files_never_end_in_another_error(saved, tmp_path):
    """300 hostile files (see `mutants`), of bytes, header and arrays: each loads or is refused."""
    mutator = Mutator(saved.read_bytes())
    for index in range(300):
        (tmp_path / "damaged.prt").write_bytes(mutator.make(5, index)[2])
        with suppress(AssetError):
            mi_prt.load(tmp_path / "damaged.prt")


def without(name):
    def change(header, arrays):
        del arrays[name]

    return change


def with_field(path, value):
    """Sets a field of the asset's header."""

    def change(header, arrays):
        *parents, last = path.split("/")
        for key in parents:
            header = header[key]
        header[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without(TOTAL + "basis/mean"), "basis/mean is missing"),
        (without("points/buried"), "points/buried is missing"),
        (with_field("report", "{no json"), "report"),
        (with_field("scene", 5), "scene"),
        (with_field("transports", {}), "no transport"),
        (with_field("transports/mine", {}), "mine"),
        (with_field("points/layout", "grid"), "grid"),
        (with_field("transports/distant/directions", "sphere:9"), "sphere"),
        (with_field("transports/distant/directions", "cubemap:9"), "384"),
        (with_field("transports/distant/keeps_direct", True), "direct"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_incomplete_and_foreign_contents_are_refused(saved, tmp_path, change, message):
    """Files in which something is missing or unknown. `test_tensors` has those of other formats,
    other versions and no file at all.
    """
    refused(rewritten(saved, tmp_path / "odd.prt", change), message)


@pytest.mark.parametrize(
    "name",
    [
        TOTAL + "coefficients",
        TOTAL + "basis/vectors",
        TOTAL + "basis/sqrt_weights",
        "points/positions",
        "points/buried",
        "layout/nodes",
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(saved, tmp_path, name):
    """A file with one array shorter than the others would fail later, or worse, not fail."""

    def shorten(header, arrays):
        arrays[name] = arrays[name][:-1]

    refused(rewritten(saved, tmp_path / "odd.prt", shorten))


@pytest.mark.parametrize("channels", [None, 0, 1, 2, 3, -3, "3", [3], {}], ids=str)
def test_channels_that_the_arrays_do_not_have_are_refused(kind, saved, tmp_path, channels):
    """Of another number relighting would fail, or add up the wrong rows."""
    change = with_field("transports/distant/report/channels", channels)
    path = rewritten(saved, tmp_path / "odd.prt", change)
    if channels == (1 if kind == "direct" else 3):
        assert mi_prt.load(path).irradiance(uniform_sky()).any()
        return
    refused(path)


@pytest.mark.parametrize("channels", [0, 1, 2, 4])
def test_arrays_of_other_channels_are_refused(kind, saved, tmp_path, channels):
    """Also where all agree on their number: light has three."""

    def change(header, arrays):
        header["transports"]["distant"]["report"]["channels"] = channels
        for name in ["basis/vectors", "basis/mean"] if kind == "reflected" else ["coefficients"]:
            values = arrays[TOTAL + name]
            one = values.reshape(
                *values.shape[: values.ndim - 1 - (kind != "direct")], -1, values.shape[-1]
            )[..., :1, :]
            arrays[TOTAL + name] = one.repeat(channels, axis=-2)

    refused(rewritten(saved, tmp_path / "odd.prt", change))


@pytest.mark.parametrize("report", [{}, [], 3, None], ids=str)
def test_a_report_that_tells_nothing_is_refused(saved, tmp_path, report):
    change = with_field("transports/distant/report", report)
    refused(rewritten(saved, tmp_path / "odd.prt", change))


# --- saving ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=lambda e: type(e)
)
def test_a_failing_write_leaves_the_old_file(asset, tmp_path, monkeypatch, error):
    """All or nothing: what was there stays, and no temporary file is left; what a full disk raises
    is a SettingsError.
    """
    path = tmp_path / "old.prt"
    path.write_text("old")
    is_finite, blocks = container.is_finite, []

    def fail(block):
        blocks.append(block)
        if len(blocks) > 10:
            raise error
        return is_finite(block)

    monkeypatch.setattr(container, "is_finite", fail)
    with pytest.raises(SettingsError if isinstance(error, OSError) else KeyboardInterrupt):
        asset.save(path, force=True)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["old.prt"]


def test_paths_that_cannot_be_written(asset, tmp_path):
    """A folder, a folder that is missing, a file in the place of a folder, a name longer than file
    systems take.
    """
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for path in [
        tmp_path / "folder",
        tmp_path / "none" / "a.prt",
        tmp_path / "file" / "a.prt",
        tmp_path / ("x" * 300 + ".prt"),
    ]:
        with pytest.raises(SettingsError) as caught:
            asset.save(path)
        assert "\n" not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere"
)
def test_a_folder_without_permission(asset, tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(SettingsError, match="permission"):
            asset.save(tmp_path / "a.prt")
    finally:
        tmp_path.chmod(0o700)


def test_saving_over_an_asset_and_to_a_relative_path(asset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asset.save("a.prt")
    asset.save("a.prt")
    assert mi_prt.load("a.prt").path == tmp_path / "a.prt" and os.listdir(tmp_path) == ["a.prt"]


# --- kernels --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bounces", "indirect"), [(0, "solve"), (2, "solve"), (2, "paths")])
def test_blocks_share_their_kernels(monkeypatch, bounces, indirect):
    """What changes from block to block is opaque to the compiler: 80 small blocks do not need 80
    kernels.

    A few there may be: Dr.Jit compiles anew where arrays taken from NumPy happen to be aligned
    otherwise. And they give the same bits: rays do not know their block.
    """
    # inside the box: dark, so that the search for buried points runs
    parts = COLOURED | {"inner": sphere((0.2, 0.4, 0), 0.1)}
    settings, traced = (
        dict(
            directions="cubemap:8",
            edge_length=0.4,
            indirect=indirect,
            bounces=bounces,
            paths_per_point=32,
        ),
        [],
    )
    whole, _ = measure(scene(**parts), **settings)
    monkeypatch.setattr(room, "LANES", 384 * 7)
    blocked, cost = measure(
        scene(**parts), None, lambda stage, *_: traced.append(stage), **settings
    )
    assert traced.count("transport") > 20 and (bounces == 0 or traced.count("indirect") > 5)
    assert len(whole.points) > 10 * 7 and whole.buried.sum() > 7
    assert cost["kernels"] <= 4
    np.testing.assert_array_equal(blocked.buried, whole.buried)
    np.testing.assert_array_equal(distant(blocked).coefficients, distant(whole).coefficients)
    assert distant(blocked).report == distant(whole).report


def test_rays_are_counted(asset):
    """Rays are those above the horizon: of each point those cells whose centre has n·ω > 0."""
    above = (asset.points.normals @ Cubemap(8).vectors.T > 0).sum()
    assert abs(distant(asset).report["rays"] - above) <= 2e-3 * above


def test_radiance_of_the_default_basis_is_close():
    """48 components of this scene: within 3 % of the sampled transport under a smooth sky, without
    bias.
    """
    lattice, asset = Cubemap(8), precompute()
    sampled = sample_direct(open_scene(scene(**SMALL)), asset.points, lattice)
    expected = sampled.irradiance(np.ones((len(lattice), 3), np.float32), lattice.solid_angles)
    assert relative_l2(asset.irradiance(uniform_sky()), expected) < 0.03
    assert abs(bias(asset.irradiance(uniform_sky()), expected)) < 0.01
