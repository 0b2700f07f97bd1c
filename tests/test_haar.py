"""Haar wavelets on a cubemap: the transform against its definition, the best coefficients against
trying all, fits against direct sums.
"""

from itertools import combinations

import numpy as np
import pytest
import scipy.sparse
from conftest import relative_l2, uniform_directions

from mi_prt import SettingsError
from mi_prt.basis.haar import HaarBasis, SharedHaarBasis, fit_haar, fit_haar_shared, haar_transform
from mi_prt.basis.rows import Rows
from mi_prt.basis.target import Target
from mi_prt.directions import Cubemap, Halton, LatLong

LATTICE = Cubemap(8)


def shadowed(count, lattice, seed=0):
    """Transport (count, s): clamped cosines behind random half-spaces."""
    rng = np.random.default_rng(seed)
    cosines = np.maximum(uniform_directions(rng, count) @ lattice.vectors.T, 0)
    return (cosines * (uniform_directions(rng, count) @ lattice.vectors.T > -0.3)).astype(
        np.float32
    )


def rows_of(matrix, lattice):
    return Rows(lambda index: matrix[index], np.arange(len(matrix)), lattice)


def fit(function, matrix, lattice=LATTICE, **target):
    return function(rows_of(matrix, lattice), Target(**target))


def basis_of(lattice, components):
    return HaarBasis(np.sqrt(lattice.solid_angles).astype(np.float32), np.zeros(components))


def square_sum(matrix, lattice):
    return float((np.square(matrix, dtype=np.float64) @ lattice.solid_angles).sum())


def wavelets(lattice):
    """All wavelets (s, s) as weighted rows, one for each coefficient."""
    identity = np.eye(len(lattice), dtype=np.float32)
    return haar_transform(lattice.resolution).inverse(identity) * np.sqrt(lattice.solid_angles)


# --- transform ------------------------------------------------------------------------------------


def merged(a1, a2, w1, w2):
    """Detail and scale of two weighted values, with the weights of both, as the transform is
    defined.
    """
    detail = (np.sqrt(w2) * a1 - np.sqrt(w1) * a2) / np.sqrt(w1 + w2)
    scale = (np.sqrt(w1) * a1 + np.sqrt(w2) * a2) / np.sqrt(w1 + w2)
    return (detail, w1 * w2 / (w1 + w2)), (scale, w1 + w2)


def transformed_face(values, weights):
    """The transform of one face (N, N) by its definition, 2 × 2 cells at a time, each left where
    the documentation says.
    """
    result, n = values * np.sqrt(weights), len(values)
    weights, step = weights.copy(), 1
    while step < n:
        for row in range(step - 1, n, 2 * step):
            for column in range(step - 1, n, 2 * step):
                rows, columns = (row, row + step), (column, column + step)
                block, w = result[np.ix_(rows, columns)], weights[np.ix_(rows, columns)]
                top, bottom = merged(*block[0], *w[0]), merged(*block[1], *w[1])
                for j, (first, second) in enumerate(zip(top, bottom)):
                    pair = merged(first[0], second[0], first[1], second[1])
                    for i in (0, 1):
                        result[rows[i], columns[j]], weights[rows[i], columns[j]] = pair[i]
        step *= 2
    return result


@pytest.mark.parametrize("resolution", [1, 2, 8])
def test_the_transform_is_its_definition(resolution):
    """Pairs merged one by one, in float64, columns before rows."""
    lattice = Cubemap(resolution)
    rows = np.random.default_rng(0).random((3, len(lattice))).astype(np.float32)
    shape = (-1, resolution, resolution)
    weights = lattice.solid_angles.reshape(shape)
    expected = [
        transformed_face(*both)
        for row in rows
        for both in zip(row.astype(float).reshape(shape), weights)
    ]
    result = haar_transform(resolution).forward(rows.copy())
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, np.reshape(expected, rows.shape), atol=1e-6)


@pytest.mark.parametrize("resolution", [1, 2, 4, 8])
def test_wavelets_are_orthonormal(resolution):
    vectors = wavelets(Cubemap(resolution))
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(len(vectors)), atol=1e-6)


def test_energy_and_rows_are_kept():
    """Σ c² = Σ w t² (Parseval), and the inverse gives the rows back, at a usual size."""
    lattice, transform = Cubemap(32), haar_transform(32)
    rows = np.random.default_rng(0).standard_normal((20, len(lattice))).astype(np.float32)
    coefficients = transform.forward(rows.copy())
    energies = np.square(rows, dtype=np.float64) @ lattice.solid_angles
    np.testing.assert_allclose(
        np.square(coefficients, dtype=np.float64).sum(axis=1), energies, rtol=1e-6
    )
    assert relative_l2(transform.inverse(coefficients), rows) < 1e-6


@pytest.mark.parametrize("resolution", [1, 4, 32])
def test_a_constant_is_six_coefficients(resolution):
    """Differences of equal values are zero exactly; each face's mean weighs 4π/6."""
    lattice = Cubemap(resolution)
    coefficients = (
        haar_transform(resolution)
        .forward(np.full((1, len(lattice)), 0.7, np.float32))
        .reshape(6, -1)
    )
    assert not coefficients[:, :-1].any()
    np.testing.assert_allclose(coefficients[:, -1], 0.7 * np.sqrt(4 * np.pi / 6), rtol=1e-6)


def test_wavelets_are_local_and_integrate_to_zero():
    """All but the six means: three on each block of 2 × 2, of 4 × 4, … cells, constant on its
    quarters.
    """
    lattice = Cubemap(8)
    vectors = wavelets(lattice).reshape(6, 64, 6, 8, 8)
    functions = vectors / np.sqrt(lattice.solid_angles).reshape(6, 8, 8)
    integrals = (functions * lattice.solid_angles.reshape(6, 8, 8)).sum(axis=(2, 3, 4))
    np.testing.assert_allclose(integrals[:, :-1], 0, atol=1e-6)
    sizes = []
    for face in range(6):
        for function in functions[face, :-1]:
            assert not np.delete(function, face, axis=0).any()
            rows, columns = np.nonzero(function[face])
            side = max(np.ptp(rows), np.ptp(columns)) + 1
            first_row, first_column = rows.min() // side * side, columns.min() // side * side
            block = function[face, first_row : first_row + side, first_column : first_column + side]
            quarters = block.reshape(2, side // 2, 2, side // 2)
            np.testing.assert_allclose(
                quarters,
                quarters[:, :1, :, :1].repeat(side // 2, 1).repeat(side // 2, 3),
                atol=1e-6,
            )
            sizes.append(side)
    assert [sizes.count(side) for side in (2, 4, 8)] == [6 * 3 * 16, 6 * 3 * 4, 6 * 3]


# --- best coefficients of each row ----------------------------------------------------------------


@pytest.mark.parametrize("components", [1, 2, 22])
def test_no_other_choice_of_wavelets_is_better(components):
    """All choices of k of the 24 wavelets of cubemap:2 are tried for each row."""
    lattice = Cubemap(2)
    rows, root = shadowed(5, lattice), np.sqrt(lattice.solid_angles)
    basis, vectors = basis_of(lattice, components), wavelets(lattice)
    errors = np.linalg.norm((basis.reconstruct(basis.encode(rows)) - rows) * root, axis=1)
    choices = [vectors[list(chosen)] for chosen in combinations(range(24), components)]
    best = [min(np.linalg.norm(row - row @ v.T @ v) for v in choices) for row in rows * root]
    np.testing.assert_allclose(errors, best, atol=1e-6)


def test_coefficients_are_a_sparse_matrix_of_k_a_row():
    """Sorted by column, float32, k entries even where a row has fewer wavelets; the rows are left
    as they are.
    """
    rows = shadowed(30, LATTICE)
    rows[0], rows[1] = 0, 1
    before = rows.copy()
    coefficients = basis_of(LATTICE, 20).encode(rows)
    assert isinstance(coefficients, scipy.sparse.csr_array)
    assert (coefficients.shape, coefficients.dtype) == ((30, len(LATTICE)), np.float32)
    np.testing.assert_array_equal(np.diff(coefficients.indptr), 20)
    assert (np.diff(coefficients.indices.reshape(30, 20)) > 0).all()
    np.testing.assert_array_equal(
        np.count_nonzero(coefficients.data.reshape(30, 20), axis=1)[:2], [0, 6]
    )
    np.testing.assert_array_equal(rows, before)
    for other in (rows.astype(np.float64), np.asfortranarray(rows)):
        assert (basis_of(LATTICE, 20).encode(other) != coefficients).nnz == 0


def test_all_coefficients_are_the_rows():
    rows = np.random.default_rng(0).random((10, len(LATTICE))).astype(np.float32)
    basis = basis_of(LATTICE, len(LATTICE))
    assert len(basis) == len(LATTICE)
    assert relative_l2(basis.reconstruct(basis.encode(rows)), rows) < 1e-6


def test_no_rows():
    basis = basis_of(LATTICE, 9)
    coefficients = basis.encode(np.zeros((0, len(LATTICE)), np.float32))
    assert coefficients.shape == basis.reconstruct(coefficients).shape == (0, len(LATTICE))


def test_response_is_that_of_the_reconstruction():
    """The sparse coefficients times the light's are Σ w L T̂, for light of any range; there is no
    mean.
    """
    rows, basis = shadowed(40, LATTICE), basis_of(LATTICE, 30)
    light = np.random.default_rng(0).random((len(LATTICE), 3)).astype(np.float32) ** 4
    light[7] = 1e5  # a sun
    coefficients = basis.encode(rows)
    projected, mean_response = basis.project_light(light)
    assert (projected.shape, projected.dtype) == (light.shape, np.float32)
    np.testing.assert_array_equal(mean_response, np.zeros(3))
    weighted = light * LATTICE.solid_angles[:, None]
    assert relative_l2(coefficients @ projected, basis.reconstruct(coefficients) @ weighted) < 1e-5


@pytest.mark.parametrize("resolution", [1, 2, 16])
def test_single_cells(resolution):
    """`at` is the reconstruction taken at the cells, for the sparse basis and the shared one."""
    lattice = Cubemap(resolution)
    rows = shadowed(50, lattice)
    cells = np.random.default_rng(1).integers(0, len(lattice), (50, 9))
    for function in (fit_haar, fit_haar_shared):
        basis = fit(function, rows, lattice, components=min(40, len(lattice))).basis
        coefficients = basis.encode(rows)
        expected = np.take_along_axis(basis.reconstruct(coefficients), cells, axis=1)
        np.testing.assert_allclose(basis.at(coefficients, cells), expected, atol=1e-6)
        assert basis.at(coefficients[[3, 8]], cells[[3, 8], :1]).shape == (2, 1)


# --- one set for all rows -------------------------------------------------------------------------


def test_the_shared_set_carries_the_most_energy():
    """Energies of all wavelets by dense products: the set is that of the largest, in order, and
    encoding projects on it.
    """
    rows = shadowed(200, LATTICE)
    basis = fit(fit_haar_shared, rows, components=25).basis
    assert (len(basis), basis.kind, basis.vectors.dtype) == (25, "haar-shared", np.float32)
    weighted, vectors = rows * np.sqrt(LATTICE.solid_angles), wavelets(LATTICE)
    energies = np.square(weighted @ vectors.T).sum(axis=0)
    chosen = vectors[np.argsort(-energies)[:25]]
    np.testing.assert_allclose(basis.vectors, chosen, atol=1e-6)
    projection = weighted @ chosen.T @ chosen / np.sqrt(LATTICE.solid_angles)
    assert relative_l2(basis.reconstruct(basis.encode(rows)), projection) < 1e-5
    np.testing.assert_array_equal(basis.mean, 0)
    again = SharedHaarBasis(*(getattr(basis, name) for name in basis.ARRAYS))
    np.testing.assert_array_equal(again.encode(rows), basis.encode(rows))


# --- fits -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [fit_haar, fit_haar_shared])
@pytest.mark.parametrize(("components", "common"), [(30, 0), (384, 0), (1, 3)])
def test_a_fit_tells_its_error(function, components, common):
    """Captured variance and relative error are those of the residual of the reconstruction, taken
    directly, and what the components carry adds up to it. One wavelet is worse than the mean where
    rows have much in common. Rows are more than a block of each of the chunks that are summed.
    """
    rows = shadowed(16 * 128 + 500, LATTICE) + np.float32(common) * shadowed(1, LATTICE, seed=1)
    result = fit(function, rows, components=components)
    basis = result.basis
    residual = square_sum(basis.reconstruct(basis.encode(rows)) - rows, LATTICE)
    variance = square_sum(rows - rows.mean(axis=0, dtype=np.float64), LATTICE)
    energy = square_sum(rows, LATTICE)
    assert result.captured_variance == pytest.approx(1 - residual / variance, abs=1e-5, rel=1e-5)
    assert (result.captured_variance < 0) == (common > 0)
    assert result.relative_error == pytest.approx(np.sqrt(residual / energy), abs=1e-6)
    assert basis.captured_variance.shape == (len(basis),) == (components,)
    assert (np.diff(basis.captured_variance) <= 0).all()
    assert basis.captured_variance.sum() * variance == pytest.approx(energy - residual, rel=1e-5)


def test_shares_are_those_of_the_largest_the_second_and_so_on():
    rows = shadowed(100, LATTICE)
    coefficients = rows * np.sqrt(LATTICE.solid_angles) @ wavelets(LATTICE).T
    largest = np.sort(np.square(coefficients), axis=1)[:, :-11:-1].sum(axis=0)
    variance = square_sum(rows - rows.mean(axis=0, dtype=np.float64), LATTICE)
    np.testing.assert_allclose(
        fit(fit_haar, rows, components=10).basis.captured_variance, largest / variance, rtol=1e-4
    )


@pytest.mark.parametrize("function", [fit_haar, fit_haar_shared])
@pytest.mark.parametrize("share", [0.01, 0.5, 0.9, 0.999])
def test_a_share_of_the_variance_takes_the_fewest(function, share):
    """One wavelet less captures less than the share; the fit is the one for that number of
    components.
    """
    rows = shadowed(300, LATTICE)
    result = fit(function, rows, variance=share)
    count = len(result.basis)
    same = fit(function, rows, components=count)
    assert (
        result.captured_variance == pytest.approx(same.captured_variance, abs=1e-6)
        and result.captured_variance >= share
    )
    np.testing.assert_allclose(
        result.basis.captured_variance, same.basis.captured_variance, rtol=1e-6
    )
    assert count == 1 or fit(function, rows, components=count - 1).captured_variance < share


def test_each_row_with_its_own_wavelets_is_better():
    """For the same number of coefficients a row the sparse basis is the best there is, so never
    worse than a shared set.
    """
    rows = shadowed(300, LATTICE)
    own, shared = (fit(function, rows, components=40) for function in (fit_haar, fit_haar_shared))
    assert own.relative_error < 0.6 * shared.relative_error


@pytest.mark.parametrize("function", [fit_haar, fit_haar_shared])
@pytest.mark.parametrize("count", [1, 300])
def test_where_nothing_varies_all_of_it_is_captured(function, count):
    """Equal rows have no variance: a constant takes its six wavelets.

    No transport at all has no error.
    """
    constant = fit(function, np.ones((count, len(LATTICE)), np.float32), variance=0.99)
    assert (len(constant.basis), constant.captured_variance, constant.relative_error) == (
        6,
        1.0,
        0.0,
    )
    np.testing.assert_array_equal(constant.basis.captured_variance, 0)
    assert (
        fit(function, np.ones((count, len(LATTICE)), np.float32), components=5).captured_variance
        == 0
    )
    dark = fit(function, np.zeros((count, len(LATTICE)), np.float32), variance=0.99)
    assert (len(dark.basis), dark.captured_variance, dark.relative_error) == (1, 1.0, 0.0)


@pytest.mark.parametrize("function", [fit_haar, fit_haar_shared])
@pytest.mark.parametrize(
    ("directions", "remedy"),
    [
        (Cubemap(24), "cubemap:16 or cubemap:32"),
        (Cubemap(3), "cubemap:2 or cubemap:4"),
        (Cubemap(500), "cubemap:256 or cubemap:512"),
        (LatLong(32, 16), "cubemap:8 or cubemap:16"),
        (Halton(10), "cubemap:1 or cubemap:2"),
        (LatLong(2, 2), "cubemap:1 or cubemap:2"),
    ],
    ids=str,
)
def test_other_lattices_are_refused_with_the_nearest(function, directions, remedy):
    with pytest.raises(SettingsError, match=f"got {directions}: use {remedy}$"):
        function(Rows(None, np.arange(3), directions), Target(4))


@pytest.mark.parametrize("function", [fit_haar, fit_haar_shared])
@pytest.mark.parametrize("components", [0, 385, 10**9])
def test_impossible_numbers_are_refused(function, components):
    with pytest.raises(SettingsError, match="outside 1…384"):
        fit(function, shadowed(3, LATTICE), components=components)


@pytest.mark.parametrize("function", [fit_haar, fit_haar_shared])
def test_progress_ends_complete(function):
    calls = []
    function(
        rows_of(shadowed(20, LATTICE), LATTICE),
        Target(4),
        progress=lambda *done: calls.append(done),
    )
    assert calls[-1][0] == calls[-1][1]
