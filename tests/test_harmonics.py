"""Spherical harmonics: their values, how they turn, and the basis that they make, against closed
forms and least squares.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from conftest import random_rotation, relative_l2, uniform_directions

from mi_prt import SettingsError
from mi_prt.basis.harmonics import (
    MAX_BANDS,
    HarmonicBasis,
    HarmonicMap,
    check_harmonics,
    evaluate,
    fit_harmonics,
    most_harmonics,
    rotate,
    rotation,
)
from mi_prt.basis.rows import Rows
from mi_prt.basis.target import Fit, Target
from mi_prt.directions import Cubemap
from mi_prt.lighting.lattice import LatticeMap

LATTICE = Cubemap(8)


@dataclass(frozen=True, eq=False)
class Scattered:
    """Random directions of random solid angles: the functions are far from orthonormal over
    them.
    """

    count: int

    def __str__(self):
        return f"scattered:{self.count}"

    def __len__(self):
        return self.count

    @property
    def vectors(self):
        return uniform_directions(np.random.default_rng(3), self.count)

    @property
    def solid_angles(self):
        shares = 0.5 + np.random.default_rng(4).random(self.count)
        return shares / shares.sum() * 4 * np.pi


def shadowed(count, lattice, seed=0):
    """Transport (count, s): clamped cosines behind random half-spaces."""
    rng = np.random.default_rng(seed)
    cosines = np.maximum(uniform_directions(rng, count) @ lattice.vectors.T, 0)
    return (cosines * (uniform_directions(rng, count) @ lattice.vectors.T > -0.3)).astype(
        np.float32
    )


def rows_of(matrix, lattice):
    return Rows(lambda index: matrix[index], np.arange(len(matrix)), lattice)


def fit(matrix, lattice=LATTICE, **target):
    return fit_harmonics(rows_of(matrix, lattice), Target(**target))


def square_sum(matrix, lattice):
    return float((np.square(matrix, dtype=np.float64) @ lattice.solid_angles).sum())


# --- values ---------------------------------------------------------------------------------------


def test_the_first_four_bands_are_their_polynomials():
    """The usual real harmonics in x, y, z, written out; the length of a direction does not
    matter.
    """
    vectors = uniform_directions(np.random.default_rng(0), 100)
    x, y, z = vectors.T
    polynomials = [
        np.sqrt(1 / 4 / np.pi) * np.ones(100),
        np.sqrt(3 / 4 / np.pi) * y,
        np.sqrt(3 / 4 / np.pi) * z,
        np.sqrt(3 / 4 / np.pi) * x,
        np.sqrt(15 / 4 / np.pi) * x * y,
        np.sqrt(15 / 4 / np.pi) * y * z,
        np.sqrt(5 / 16 / np.pi) * (3 * z * z - 1),
        np.sqrt(15 / 4 / np.pi) * x * z,
        np.sqrt(15 / 16 / np.pi) * (x * x - y * y),
        np.sqrt(35 / 32 / np.pi) * y * (3 * x * x - y * y),
        np.sqrt(105 / 4 / np.pi) * x * y * z,
        np.sqrt(21 / 32 / np.pi) * y * (5 * z * z - 1),
        np.sqrt(7 / 16 / np.pi) * z * (5 * z * z - 3),
        np.sqrt(21 / 32 / np.pi) * x * (5 * z * z - 1),
        np.sqrt(105 / 16 / np.pi) * z * (x * x - y * y),
        np.sqrt(35 / 32 / np.pi) * x * (x * x - 3 * y * y),
    ]
    lengths = np.random.default_rng(1).uniform(0.1, 10, (100, 1))
    np.testing.assert_allclose(evaluate(vectors * lengths, 4), polynomials, atol=1e-14)


def test_addition_theorem():
    """Σ_m Yₗₘ(a) Yₗₘ(b) = (2l + 1)/4π Pₗ(a·b) in every band; poles, equal and opposite directions
    are among the pairs.
    """
    first = uniform_directions(np.random.default_rng(0), 200)
    second = uniform_directions(np.random.default_rng(1), 200)
    first[:4] = [[0, 0, 1], [0, 0, -1], [0, 0, 1], [1e-9, 0, -1]]
    second[:8] = [
        [0, 0, 1],
        [0, 0, 1],
        first[2],
        first[3],
        first[4],
        first[5],
        -first[6],
        -first[7],
    ]
    products = evaluate(first, MAX_BANDS) * evaluate(second, MAX_BANDS)
    cosines = (first * second).sum(axis=1)
    for band in range(MAX_BANDS):
        legendre = np.polynomial.legendre.Legendre.basis(band)(cosines)
        sums = products[band**2 : (band + 1) ** 2].sum(axis=0)
        np.testing.assert_allclose(sums, (2 * band + 1) / (4 * np.pi) * legendre, atol=1e-11)


def test_orthonormal_over_the_sphere():
    """Gauss-Legendre in cos θ times equal steps in φ integrates products of these polynomials
    exactly.
    """
    nodes, weights = np.polynomial.legendre.leggauss(MAX_BANDS)
    azimuths = 2 * np.pi * np.arange(2 * MAX_BANDS) / (2 * MAX_BANDS)
    z, azimuth = (grid.ravel() for grid in np.meshgrid(nodes, azimuths, indexing="ij"))
    sine = np.sqrt(1 - z * z)
    values = evaluate(
        np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], axis=1), MAX_BANDS
    )
    gram = values * np.repeat(weights, len(azimuths)) * (2 * np.pi / len(azimuths)) @ values.T
    np.testing.assert_allclose(gram, np.eye(MAX_BANDS**2), atol=1e-12)


def test_at_the_poles_only_zonal_functions_are_left():
    """Yₗ₀ is √((2l + 1)/4π) at +z and (−1)ˡ of it at −z; all others vanish.

    Signed zeros and tiny numbers too.
    """
    up = [[0.0, 0, 1], [-0.0, 0, 3], [1e-200, 0, 1]]
    down = [[0.0, -0.0, -1], [0, 1e-200, -2]]
    values = evaluate(np.array(up + down), MAX_BANDS)
    expected = np.zeros((MAX_BANDS**2, 5))
    bands = np.arange(MAX_BANDS)
    expected[bands * bands + bands, :3] = np.sqrt((2 * bands + 1) / (4 * np.pi))[:, None]
    expected[bands * bands + bands, 3:] = (
        np.sqrt((2 * bands + 1) / (4 * np.pi)) * (-1.0) ** bands
    )[:, None]
    np.testing.assert_allclose(values, expected, atol=1e-13)


def test_no_directions():
    assert evaluate(np.zeros((0, 3)), 5).shape == (25, 0)


# --- rotation -------------------------------------------------------------------------------------


def turn(axis, degrees):
    """Right-handed rotation about a coordinate axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = [(1, 2), (2, 0), (0, 1)]["xyz".index(axis)]
    matrix = np.eye(3)
    matrix[[i, j, i, j], [i, j, j, i]] = cosine, cosine, -sine, sine
    return matrix


MATRICES = {
    "identity": np.eye(3),
    "half turn x": turn("x", 180),
    "half turn y": turn("y", 180),
    "half turn z": turn("z", 180),
    "quarter turn x": turn("x", 90),
    "quarter turn y": turn("y", -90),
    "gimbal up": turn("z", 31) @ turn("y", 90) @ turn("z", 47),
    "gimbal down": turn("z", 31) @ turn("y", -90) @ turn("z", 47),
    "gimbal pole": turn("z", 31) @ turn("y", 180) @ turn("z", 47),
    "tiny": turn("x", 1e-7) @ turn("y", 1e-7),
    "permutation": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "random": random_rotation(np.random.default_rng(0)),
    "another": random_rotation(np.random.default_rng(1)),
    "mirror": np.diag([1.0, 1, -1]),
    "inversion": -np.eye(3),
    "exchange of axes": np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "mirrored random": random_rotation(np.random.default_rng(2)) @ np.diag([1.0, -1, 1]),
}


@pytest.mark.parametrize("bands", [1, 2, 3, 11, 21, MAX_BANDS])
@pytest.mark.parametrize("name", MATRICES)
def test_blocks_turn_the_functions(name, bands):
    """Y(R ω) = D Y(ω) to 1e-10, by functions that come from Legendre's recurrence, not from
    rotations; D is orthogonal.
    """
    matrix = MATRICES[name]
    vectors = uniform_directions(np.random.default_rng(5), 50)
    blocks = rotation(matrix, bands)
    assert [block.shape for block in blocks] == [
        (2 * band + 1, 2 * band + 1) for band in range(bands)
    ]
    turned, values = evaluate(vectors @ matrix.T, bands), evaluate(vectors, bands)
    for band, block in enumerate(blocks):
        functions = slice(band**2, (band + 1) ** 2)
        np.testing.assert_allclose(block @ values[functions], turned[functions], atol=1e-10)
        np.testing.assert_allclose(block @ block.T, np.eye(2 * band + 1), atol=1e-12)


def test_the_identity_changes_nothing_at_all():
    for block in rotation(np.eye(3), MAX_BANDS):
        np.testing.assert_allclose(block, np.eye(len(block)), atol=1e-14)


def test_a_turn_about_z_mixes_only_opposite_orders():
    """cos m(φ + α) = cos mα cos mφ − sin mα sin mφ, sin m(φ + α) = sin mα cos mφ + cos mα sin
    mφ.
    """
    alpha = np.radians(33)
    for band, block in enumerate(rotation(turn("z", 33), 21)):
        expected = np.zeros_like(block)
        m = np.arange(-band, band + 1)
        expected[m + band, m + band] = np.cos(m * alpha)
        expected[m + band, band - m] -= np.sin(m * alpha)  # at m = 0: minus zero
        np.testing.assert_allclose(block, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("random", "another"),
        ("gimbal up", "half turn x"),
        ("mirror", "random"),
        ("mirrored random", "inversion"),
    ],
)
def test_blocks_compose(a, b):
    """D(AB) = D(A) D(B), reflections included."""
    a, b = MATRICES[a], MATRICES[b]
    for both, first, second in zip(rotation(a @ b, 21), rotation(a, 21), rotation(b, 21)):
        np.testing.assert_allclose(both, first @ second, atol=1e-12)


@pytest.mark.parametrize("name", ["random", "quarter turn x", "mirrored random"])
def test_rotate_turns_light(name):
    """Light L turned by R is L(R⁻¹ω): turned coefficients give it in every direction."""
    matrix, rng = MATRICES[name], np.random.default_rng(0)
    coefficients, vectors = rng.standard_normal((100, 3)), uniform_directions(rng, 40)
    turned = rotate(coefficients, matrix)
    assert turned.shape == (100, 3)
    expected = evaluate(vectors @ matrix, 10).T @ coefficients  # rows of ω·R are R⁻¹ω
    np.testing.assert_allclose(evaluate(vectors, 10).T @ turned, expected, atol=1e-11)


@pytest.mark.parametrize(
    "matrix",
    [
        2 * np.eye(3),
        np.eye(4),
        np.zeros((3, 3)),
        np.full((3, 3), np.nan),
        [[1, 1, 0], [0, 1, 0], [0, 0, 1]],
    ],
)
def test_what_is_no_rotation_is_refused(matrix):
    with pytest.raises(SettingsError, match="without scale or shear"):
        rotation(matrix, 4)


def test_coefficients_of_a_part_of_a_band_are_refused():
    with pytest.raises(SettingsError, match="9 or 16"):
        rotate(np.zeros((10, 3)), np.eye(3))


# --- basis ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("lattice", [LATTICE, Scattered(300)], ids=str)
@pytest.mark.parametrize("bands", [1, 3, 6])
def test_encoding_is_least_squares(lattice, bands):
    """The coefficients are those of NumPy's lstsq in the √w-weighted space, and the reconstruction
    its fitted rows.
    """
    matrix = shadowed(60, lattice)
    basis = fit(matrix, lattice, components=bands**2).basis
    assert (len(basis), basis.bands, basis.kind) == (bands**2, bands, "sh")
    root = np.sqrt(lattice.solid_angles)
    functions = evaluate(lattice.vectors, bands).T
    solution = np.linalg.lstsq(functions * root[:, None], (matrix * root).T, rcond=None)[0]
    coefficients = basis.encode(matrix)
    assert coefficients.dtype == np.float32
    assert relative_l2(coefficients, solution.T) < 1e-5
    assert relative_l2(basis.reconstruct(coefficients), (functions @ solution).T) < 1e-5
    cells = np.random.default_rng(0).integers(0, len(lattice), (60, 7))
    expected = np.take_along_axis(basis.reconstruct(coefficients), cells, axis=1)
    np.testing.assert_allclose(basis.at(coefficients, cells), expected, atol=1e-5)


@pytest.mark.parametrize("lattice", [LATTICE, Scattered(300)], ids=str)
@pytest.mark.parametrize(("bands", "common"), [(1, 0), (4, 0), (1, 3)])
def test_a_fit_tells_its_error(lattice, bands, common):
    """Captured variance and relative error are those of the residual of the reconstruction, taken
    directly; energies of the functions add up to what is captured. A constant is worse than the
    mean where rows have much in common. Rows are more than a block of each of the chunks that are
    summed.
    """
    matrix = shadowed(16 * 128 + 500, lattice) + np.float32(common) * shadowed(1, lattice, seed=1)
    result = fit(matrix, lattice, components=bands**2)
    residual = square_sum(result.basis.reconstruct(result.basis.encode(matrix)) - matrix, lattice)
    variance = square_sum(matrix - matrix.mean(axis=0, dtype=np.float64), lattice)
    energy = square_sum(matrix, lattice)
    assert result.captured_variance == pytest.approx(1 - residual / variance, abs=1e-5, rel=1e-5)
    assert (result.captured_variance < 0) == (common > 0)
    assert result.relative_error == pytest.approx(np.sqrt(residual / energy), abs=1e-4)
    assert result.basis.captured_variance.shape == (bands**2,)
    assert result.basis.captured_variance.sum() * variance == pytest.approx(
        energy - residual, rel=1e-5
    )


def test_functions_in_the_span_are_kept():
    """Rows made of 25 functions are reproduced by them; a fit of sums of squares tells errors down
    to about 1e-4.
    """
    matrix = np.random.default_rng(0).standard_normal((200, 25)) @ evaluate(LATTICE.vectors, 5)
    result = fit(matrix.astype(np.float32), components=25)
    assert (
        relative_l2(
            result.basis.reconstruct(result.basis.encode(matrix.astype(np.float32))), matrix
        )
        < 1e-6
    )
    assert result.relative_error < 1e-3 and result.captured_variance > 1 - 1e-5


def test_response_is_that_of_the_reconstruction():
    """c·ℓ = Σ w L T̂ for any light, though the functions are not orthonormal over the lattice.
    Under light that the functions hold, here 1 + z, it is the response of T itself: what is left
    out of T is orthogonal to them.
    """
    lattice = Scattered(300)
    matrix = shadowed(50, lattice)
    basis = fit(matrix, lattice, components=9).basis
    coefficients = basis.encode(matrix)
    weights = lattice.solid_angles[:, None]
    light = np.random.default_rng(0).random((300, 3)).astype(np.float32) ** 4
    projected, mean_response = basis.project_light(light)
    np.testing.assert_array_equal(mean_response, 0)
    assert (
        relative_l2(coefficients @ projected, basis.reconstruct(coefficients) @ (weights * light))
        < 1e-5
    )
    smooth = np.repeat(1 + lattice.vectors[:, 2:], 3, axis=1).astype(np.float32)
    assert (
        relative_l2(coefficients @ basis.project_light(smooth)[0], matrix @ (weights * smooth))
        < 1e-5
    )


def test_clamped_cosines():
    """max(0, n·ω) = Σ Aₗ Yₗₘ(n) Yₗₘ(ω) with A = π, 2π/3, π/4, 0, −π/24, 0, π/64 (Ramamoorthi and
    Hanrahan 2001); a lattice of 32² cells a face gives them to some 1e-3.
    """
    lattice = Cubemap(32)
    normals = uniform_directions(np.random.default_rng(0), 20)
    matrix = np.maximum(normals @ lattice.vectors.T, 0).astype(np.float32)
    coefficients = fit(matrix, lattice, components=49).basis.encode(matrix)
    factors = np.repeat(
        [np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24, 0, np.pi / 64], 2 * np.arange(7) + 1
    )
    np.testing.assert_allclose(coefficients, factors * evaluate(normals, 7).T, atol=2e-3)


def test_a_basis_made_of_its_arrays_is_the_same():
    matrix = shadowed(20, LATTICE)
    basis = fit(matrix, components=16).basis
    again = HarmonicBasis(*(getattr(basis, name) for name in basis.ARRAYS))
    np.testing.assert_array_equal(again.encode(matrix), basis.encode(matrix))


@pytest.mark.parametrize(
    "matrix", [turn("z", 90), turn("x", 180), turn("y", -90), np.diag([1.0, -1, 1])]
)
def test_light_turned_in_the_basis_is_light_turned_in_the_cells(matrix):
    """Turns that take a cubemap to itself only permute its cells: equal for any light, to
    rounding.
    """
    basis = fit(shadowed(20, LATTICE), components=100).basis
    light = np.random.default_rng(0).random((len(LATTICE), 3)).astype(np.float32) ** 4
    turned = light[LATTICE.cells(LATTICE.vectors @ matrix)]  # L'(ω) = L(R⁻¹ω)
    expected = basis.project_light(turned)[0]
    result = HarmonicMap(None, (), basis.project_light(light)[0], matrix).turned()
    assert result.dtype == np.float32
    assert relative_l2(result, expected) < 1e-5
    assert relative_l2(basis.project_light(light)[0], expected) > 0.1


def test_turns_of_light_add_up():
    """The later turn is about the world's axes: turned about x, then about y.

    What is not turned is as it was.
    """
    coefficients = np.random.default_rng(0).standard_normal((49, 3)).astype(np.float32)
    moments = np.zeros((6, 3, 3), np.float32)
    environment = LatticeMap(Cubemap(1), np.ones((6, 3), np.float32), moments, np.eye(3))
    light = HarmonicMap(environment, ("cubemap:8", 49), coefficients)
    np.testing.assert_allclose(light.turned(), coefficients, atol=1e-6)
    turned = light.rotated("x", 20).rotated("y", 75)
    assert relative_l2(turned.turned(), rotate(coefficients, turn("y", 75) @ turn("x", 20))) < 1e-6
    np.testing.assert_allclose(
        turned.environment.rotation, turn("y", 75) @ turn("x", 20), atol=1e-12
    )


# --- targets --------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.5, 0.9, 0.985])  # the last takes more than FIRST_BANDS
def test_a_share_of_the_variance_takes_the_fewest_bands(share):
    """One band less captures less than the share; the fit is the one for that number of
    components.
    """
    matrix = shadowed(300, LATTICE)
    result = fit(matrix, variance=share)
    bands = result.basis.bands
    assert (
        bands > 1
        and result.captured_variance
        >= share
        > fit(matrix, components=(bands - 1) ** 2).captured_variance
    )
    same = fit(matrix, components=bands**2)
    assert result.captured_variance == pytest.approx(same.captured_variance, abs=1e-6)
    np.testing.assert_array_equal(result.basis.vectors, same.basis.vectors)


def test_more_bands_never_capture_less():
    matrix = shadowed(300, LATTICE)
    captured = [fit(matrix, components=bands**2).captured_variance for bands in range(1, 17)]
    assert all(less < more for less, more in pairwise(captured))


def test_a_share_out_of_reach_is_refused_with_what_can_be_had():
    matrix = shadowed(300, LATTICE)
    with pytest.raises(SettingsError, match="256 that cubemap:8 allows capture ") as refusal:
        fit(matrix, variance=0.9999)
    most = float(str(refusal.value).split("capture ")[-1].split(";")[0])
    assert most == pytest.approx(fit(matrix, components=256).captured_variance, abs=1e-5)


@pytest.mark.parametrize(
    ("components", "squares"),
    [(10, "9 or 16"), (0, "use 1$"), (2, "1 or 4"), (1090, "use 1,089$"), (10**9, "use 1,089$")],
)
def test_components_that_are_no_square_are_refused(components, squares):
    with pytest.raises(SettingsError, match=squares):
        fit(shadowed(5, LATTICE), components=components)


@pytest.mark.parametrize("resolution", [1, 2, 5, 16])
def test_a_cubemap_allows_twice_its_resolution_in_bands(resolution):
    """A great circle through the faces has 4N cells: it tells waves of up to 2N apart.

    One band more is refused.
    """
    lattice = Cubemap(resolution)
    bands = 2 * resolution
    assert len(fit(shadowed(5, lattice), lattice, components=bands**2).basis) == bands**2
    assert (
        most_harmonics(lattice, (bands + 1) ** 2) == most_harmonics(lattice, bands**2) == bands**2
    )
    for refused in (
        check_harmonics,
        lambda _, components: fit(shadowed(5, lattice), lattice, components=components),
    ):
        with pytest.raises(
            SettingsError, match=f"{lattice} tells apart: use at most {bands**2:,} "
        ):
            refused(lattice, (bands + 1) ** 2)


def test_functions_stay_apart_on_what_is_accepted():
    """Whatever the lattice, coefficients are at most twice as long as the functions that they make:
    eigenvalues ≥ ¼.
    """
    lattice = Scattered(300)
    with pytest.raises(SettingsError, match=r"\((\d+) bands\)") as refusal:
        fit(shadowed(5, lattice), lattice, components=MAX_BANDS**2)
    bands = int(str(refusal.value).split("(")[1].split()[0])
    functions = evaluate(lattice.vectors, bands + 1) * np.sqrt(lattice.solid_angles)
    gram = functions @ functions.T
    assert np.linalg.eigvalsh(gram[: bands**2, : bands**2])[0] >= 0.25 > np.linalg.eigvalsh(gram)[0]


# Of all targets.


@pytest.mark.parametrize("rows", [1, 300])
def test_where_nothing_varies_all_of_it_is_captured(rows):
    """Equal rows have no variance; captured is 1 if they are reproduced.

    No transport at all has no error.
    """
    constant = fit(np.ones((rows, len(LATTICE)), np.float32), variance=0.99)
    assert (len(constant.basis), constant.captured_variance) == (1, 1.0)
    assert constant.relative_error < 1e-3
    np.testing.assert_array_equal(constant.basis.captured_variance, 0)
    equal = shadowed(1, LATTICE).repeat(rows, axis=0)
    assert fit(equal, components=4).captured_variance == 0
    nine = (
        (np.arange(1, 10) @ evaluate(LATTICE.vectors, 3))[None]
        .astype(np.float32)
        .repeat(rows, axis=0)
    )
    assert (len(fit(nine, variance=0.99).basis), fit(nine, variance=0.99).captured_variance) == (
        9,
        1.0,
    )
    dark = fit(np.zeros((rows, len(LATTICE)), np.float32), variance=0.99)
    assert (len(dark.basis), dark.captured_variance, dark.relative_error) == (1, 1.0, 0.0)


def test_progress_ends_complete():
    calls = []
    fit_harmonics(
        rows_of(shadowed(20, LATTICE), LATTICE),
        Target(4),
        progress=lambda *done: calls.append(done),
    )
    assert calls[-1][0] == calls[-1][1]


@pytest.mark.parametrize(
    "target",
    [
        {},
        {"components": 4, "variance": 0.9},
        {"components": -1},
        {"components": 2.5},
        {"components": True},
        {"components": "4"},
        {"variance": 0},
        {"variance": 1},
        {"variance": -0.5},
        {"variance": 95},
        {"variance": np.nan},
        {"variance": "0.9"},
    ],
)
def test_impossible_targets_are_refused(target):
    with pytest.raises(SettingsError):
        Target(**target)


def test_a_fit_is_told_by_its_sums():
    """1 − 2/8 of the variance, and √(2/32) = ¼ of the transport's norm."""
    result = Fit("basis", 2.0, 8.0, 32.0)
    assert (result.basis, result.captured_variance, result.relative_error) == ("basis", 0.75, 0.25)
