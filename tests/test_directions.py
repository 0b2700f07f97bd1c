"""Direction lattices of all kinds: exact partitions, antipodes, sub-cells, quadrature, nearest
directions, names.
"""

import numpy as np
import pytest
import scipy.spatial
import scipy.stats
from conftest import (
    diffuse,
    emitted,
    random_rotation,
    rectangle,
    relative_l2,
    scene,
    sky_of,
    uniform_directions,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import mi_prt
from mi_prt import EnvironmentMap, SettingsError
from mi_prt.directions import Cubemap, Halton, LatLong, parse_directions
from mi_prt.lighting.cells import cell_radiance
from mi_prt.system.runtime import mitsuba

LATTICES = [
    Cubemap(1),
    Cubemap(7),
    Cubemap(16),
    LatLong(2, 2),
    LatLong(2, 20),
    LatLong(30, 2),
    LatLong(6, 10),
    LatLong(64, 32),
    Halton(6),
    Halton(8),
    Halton(98),
    Halton(1536),
]
every_lattice = pytest.mark.parametrize("lattice", LATTICES, ids=str)


def latlong_direction(u, v):
    """Mitsuba's manual on `envmap`, written anew: u and v in 0…1 as directions (…, 3)."""
    u, v = np.broadcast_arrays(2 * np.pi * np.asarray(u), np.pi * np.asarray(v))
    return np.stack([np.sin(u) * np.sin(v), np.cos(v), -np.cos(u) * np.sin(v)], axis=-1)


# --- partitions of the sphere ---------------------------------------------------------------------


@every_lattice
def test_cells_partition_the_sphere(lattice):
    """Solid angles are positive and sum to 4π, vectors are unit and distinct, and each lies in its
    own cell.
    """
    count = len(lattice)
    assert lattice.vectors.shape == (count, 3) and lattice.vectors.dtype == np.float32
    assert lattice.solid_angles.shape == (count,) and lattice.solid_angles.dtype == np.float64
    assert lattice.solid_angles.min() > 0
    assert lattice.solid_angles.sum() == pytest.approx(4 * np.pi, rel=1e-14)
    np.testing.assert_allclose(np.linalg.norm(lattice.vectors.astype(float), axis=1), 1, atol=1e-7)
    assert len(np.unique(lattice.vectors, axis=0)) == count
    cells = lattice.cells(lattice.vectors)
    assert cells.dtype == np.int64
    np.testing.assert_array_equal(cells, np.arange(count))


@every_lattice
@pytest.mark.parametrize("rays", [1, 6, 7])
def test_lattices_are_exactly_symmetric_about_the_origin(lattice, rays):
    """Cell j + s/2 is the antipode of cell j to the last bit, ray by ray: transport keeps one bit
    for the two.
    """
    half = len(lattice) // 2
    vectors, fractions = lattice.subdivided(rays)
    np.testing.assert_array_equal(vectors[half:], -vectors[:half])
    np.testing.assert_array_equal(fractions[half:], fractions[:half])
    np.testing.assert_array_equal(lattice.vectors[half:], -lattice.vectors[:half])
    np.testing.assert_array_equal(lattice.solid_angles[half:], lattice.solid_angles[:half])


@every_lattice
def test_opposite_directions_lie_in_opposite_cells(lattice):
    """Off the borders, where random directions are."""
    vectors = uniform_directions(np.random.default_rng(0), 20_000)
    opposite = (lattice.cells(vectors) + len(lattice) // 2) % len(lattice)
    np.testing.assert_array_equal(lattice.cells(-vectors), opposite)


@every_lattice
def test_solid_angles_are_the_share_of_random_directions(lattice):
    """Uniform directions fall into cells in proportion to their solid angles: χ² test, 1e-6 false
    positives each, fixed seed.
    """
    count = 400_000
    cells = lattice.cells(uniform_directions(np.random.default_rng(1), count))
    expected = lattice.solid_angles / (4 * np.pi) * count
    assert expected.min() > 5
    chi2 = ((np.bincount(cells, minlength=len(lattice)) - expected) ** 2 / expected).sum()
    assert chi2 < scipy.stats.chi2.isf(1e-6, len(lattice) - 1)


@pytest.mark.parametrize("lattice", [Cubemap(16), LatLong(64, 32), Halton(1536)], ids=str)
def test_each_solid_angle_is_the_share_of_random_directions_near_it(lattice):
    """Within a cap of 0.15 about it, where there are enough directions for a z-test of every 40th
    cell: |z| < 5.4, a false positive in 1.5e7 cells. It notices 5 % in one cell, where the χ² test
    over all of them may not.
    """
    rng = np.random.default_rng(2)
    count, cap = 100_000, 0.15
    for cell in range(0, len(lattice), 40):
        cosine = rng.uniform(np.cos(cap), 1, count)
        phi, sine = rng.uniform(0, 2 * np.pi, count), np.sqrt(1 - cosine**2)
        centre = lattice.vectors[cell].astype(float)
        frame = np.linalg.svd(centre[None])[2]  # rows: ± the direction, and two orthogonal to it
        vectors = (
            np.outer(cosine, centre)
            + np.outer(sine * np.cos(phi), frame[1])
            + np.outer(sine * np.sin(phi), frame[2])
        )
        share = lattice.solid_angles[cell] / (2 * np.pi * (1 - np.cos(cap)))
        found = (lattice.cells(vectors) == cell).sum()
        assert abs(found - count * share) < 5.4 * np.sqrt(count * share * (1 - share)), (
            cell,
            found,
            count * share,
        )


@every_lattice
def test_cells_of_axes_diagonals_and_any_length(lattice):
    """On borders a direction belongs to a cell that touches it; neither its length, float32 or not,
    nor the sign of a zero matters. The lattices' cells are no wider than from their direction to
    the farthest of 20,000 random ones in them.
    """
    signs = np.stack(np.meshgrid(*[[-1.0, 0.0, -0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    vectors = signs[np.abs(signs).any(axis=1)]
    spread = uniform_directions(np.random.default_rng(3), 20_000)
    own = lattice.cells(spread)
    radius = np.full(len(lattice), 0.0)
    np.maximum.at(
        radius, own, np.arccos(np.clip((lattice.vectors[own] * spread).sum(axis=1), -1, 1))
    )
    for length in (1e-20, 1.0, 1e20):
        for dtype in (np.float32, np.float64):
            cells = lattice.cells((length * vectors).astype(dtype))
            assert cells.min() >= 0 and cells.max() < len(lattice)
            cosine = (lattice.vectors[cells] * vectors).sum(axis=1) / np.linalg.norm(
                vectors, axis=1
            )
            assert np.arccos(np.clip(cosine, -1, 1)).max() < 1.1 * radius.max() + 0.02


@every_lattice
def test_no_directions_are_in_no_cells(lattice):
    assert lattice.cells(np.empty((0, 3), np.float32)).shape == (0,)
    assert lattice.nearest(np.empty((0, 3)), 3).shape == (0, 3)


@given(st.integers(3, 300), st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_halton_lattices_of_any_size(half, seed):
    """Voronoi cells of every size sum to 4π, and hold what is nearest to their direction."""
    lattice = Halton(2 * half)
    vectors = uniform_directions(np.random.default_rng(seed), 300)
    assert lattice.solid_angles.sum() == pytest.approx(4 * np.pi, rel=1e-14)
    cosines = vectors @ lattice.vectors.T.astype(float)
    angle = np.arccos(cosines[np.arange(300), lattice.cells(vectors)])
    np.testing.assert_allclose(angle, np.arccos(cosines.max(axis=1)), atol=1e-6)


# --- where the directions are ---------------------------------------------------------------------


def test_latlong_layout():
    """The documented index order: rows of the upper hemisphere, then their antipodes; centres of
    Mitsuba's (u, v).
    """
    width, height = 6, 8
    lattice = LatLong(width, height)
    for row in range(height):
        for column in range(width):
            if row < height // 2:
                index = row * width + column
            else:
                index = 24 + (height - 1 - row) * width + (column + width // 2) % width
            centre = latlong_direction((column + 0.5) / width, (row + 0.5) / height)
            np.testing.assert_allclose(lattice.vectors[index], centre, atol=1e-6)
            # ∫ sin θ dθ dφ between the borders of row and column.
            first, last = np.cos(np.pi * row / height), np.cos(np.pi * (row + 1) / height)
            assert lattice.solid_angles[index] == pytest.approx(
                (first - last) * 2 * np.pi / width, rel=1e-12
            )
            # Just inside the four corners.
            u = (column + np.array([0.001, 0.999, 0.001, 0.999])) / width
            v = (row + np.array([0.001, 0.001, 0.999, 0.999])) / height
            np.testing.assert_array_equal(lattice.cells(latlong_direction(u, v)), index)


def test_latlong_columns_and_rows_are_those_of_mitsubas_envmap():
    """A map whose radiance is its column, and one whose radiance is its latitude: Mitsuba's emitter
    shows each direction of the lattice the column's and row's own value, exactly but for float32
    (columns share their centres with the pixels).
    """
    mi, width, height = mitsuba(), 16, 8
    lattice = LatLong(width, height)
    column, latitude = np.broadcast_arrays(np.arange(width), np.linspace(0, 1, height + 1)[:, None])
    pixels = np.stack([column, latitude, 0 * latitude], axis=-1).astype(np.float32)
    seen = emitted(mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(pixels)}), lattice.vectors)
    index = np.arange(len(lattice) // 2)
    np.testing.assert_allclose(seen[index, 0], index % width, atol=1e-4)
    np.testing.assert_allclose(seen[index, 1], (index // width + 0.5) / height, atol=1e-5)
    np.testing.assert_allclose(
        seen[index + len(index), 0], (index % width + width // 2) % width, atol=1e-4
    )
    np.testing.assert_allclose(
        seen[index + len(index), 1], 1 - (index // width + 0.5) / height, atol=1e-5
    )


def test_halton_points_are_scipys():
    """The first half are the points 1… of the unscrambled sequence, by equal areas on the upper
    hemisphere.
    """
    lattice = Halton(1000)
    points = scipy.stats.qmc.Halton(2, scramble=False).random(501)[1:]
    y, phi = points[:, 0], 2 * np.pi * points[:, 1]
    radius = np.sqrt(1 - y**2)
    expected = np.stack([radius * np.sin(phi), y, -radius * np.cos(phi)], axis=-1)
    np.testing.assert_allclose(lattice.vectors[:500], expected, atol=1e-7)


@pytest.mark.parametrize("count", [6, 10, 500, 6144])
def test_halton_cells_are_voronoi_cells(count):
    """Solid angles are those that SciPy computes for the spherical Voronoi diagram of the
    directions.
    """
    lattice = Halton(count)
    areas = scipy.spatial.SphericalVoronoi(
        mi_prt.directions.lattice.unit(lattice.vectors)
    ).calculate_areas()
    # float32 vectors move the borders by 1e-7
    np.testing.assert_allclose(lattice.solid_angles, areas, rtol=1e-4)
    assert relative_l2(lattice.solid_angles, areas) < 2e-6


# --- sub-cells ------------------------------------------------------------------------------------


@pytest.mark.parametrize("rays", [1, 2, 3, 4, 7, 12, 16, 64])
@pytest.mark.parametrize(
    "lattice", [Cubemap(4), LatLong(2, 2), LatLong(16, 8), Halton(6), Halton(98)], ids=str
)
def test_sub_cells(lattice, rays):
    """Rays are unit, distinct and in their own cell; their shares are positive and sum to 1; one
    ray is the direction.
    """
    vectors, fractions = lattice.subdivided(rays)
    count = len(lattice)
    assert vectors.shape == (count, rays, 3) and vectors.dtype == np.float32
    assert fractions.shape == (count, rays) and fractions.dtype == np.float32
    assert fractions.min() > 0
    np.testing.assert_allclose(fractions.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), 1, atol=1e-6)
    np.testing.assert_array_equal(
        lattice.cells(vectors.reshape(-1, 3)), np.repeat(np.arange(count), rays)
    )
    assert len(np.unique(vectors.reshape(-1, 3), axis=0)) == count * rays
    if rays == 1:
        np.testing.assert_array_equal(vectors[:, 0], lattice.vectors)


@pytest.mark.parametrize("count", [6, 98])
def test_sub_cells_of_halton_share_a_cell_equally(count):
    """The mean of many rays is the cell's ∫ ω dω / w, in closed form over a spherical polygon
    (Lambert 1760): half of the sum over the edges of their arc times their normal. Were shares of
    area not kept, it would miss by percents of the radius.
    """
    lattice = Halton(count)
    voronoi = scipy.spatial.SphericalVoronoi(mi_prt.directions.lattice.unit(lattice.vectors))
    voronoi.sort_vertices_of_regions()
    vectors, fractions = lattice.subdivided(32 * 32)
    means = np.einsum("sr,sri->si", fractions, vectors)
    for cell, region in enumerate(voronoi.regions):
        corners = voronoi.vertices[region]
        a, b = corners, np.roll(corners, -1, axis=0)
        normal = np.cross(a, b)
        sine = np.linalg.norm(normal, axis=1, keepdims=True)
        moment = (np.arctan2(sine[:, 0], (a * b).sum(axis=1))[:, None] * normal / sine).sum(
            axis=0
        ) / 2
        # the corners' sense of rotation is not given
        moment *= np.sign(moment @ lattice.vectors[cell])
        radius = np.sqrt(lattice.solid_angles[cell] / np.pi)
        assert np.abs(means[cell] - moment / lattice.solid_angles[cell]).max() < 2e-3 * radius


@pytest.mark.parametrize("lattice", [Cubemap(2), LatLong(8, 4), Halton(24)], ids=str)
def test_more_rays_integrate_more_exactly(lattice):
    """∫ max(0, n·ω) dω = π over 50 normals: its RMS error falls at least with the distance of the
    rays, that is by 4 from 1 ray to 16 and from 4 to 64, and to less than 1 %.
    """
    normals = uniform_directions(np.random.default_rng(4), 50)

    def error(rays):
        vectors, fractions = lattice.subdivided(rays)
        w = (fractions * lattice.solid_angles[:, None]).ravel()
        return np.sqrt(
            np.mean((w @ np.maximum(vectors.reshape(-1, 3) @ normals.T, 0) / np.pi - 1) ** 2)
        )

    one, four, sixteen, many = map(error, (1, 4, 16, 64))
    assert sixteen < one / 4 and many < four / 4 and many < 0.01


def test_a_latlong_cell_is_split_along_its_meridian_first():
    """Towards the poles cells are narrow: 3 rays stand above one another, which makes ∫ max(0, n·ω)
    dω four times as exact.
    """
    vectors, _ = LatLong(64, 32).subdivided(3)
    longitude = np.arctan2(vectors[..., 0], vectors[..., 2])
    np.testing.assert_allclose(
        longitude, np.broadcast_to(longitude[:, :1], longitude.shape), atol=1e-5
    )


@every_lattice
@pytest.mark.parametrize("rays", [0, -1, 1.5, True, None, "4"])
def test_bad_numbers_of_rays(lattice, rays):
    with pytest.raises(SettingsError, match="rays of a cell"):
        lattice.subdivided(rays)


# --- quadrature -----------------------------------------------------------------------------------

FAMILIES = {
    "cubemap": lambda n: Cubemap(n),
    "latlong": lambda n: LatLong(4 * n, 2 * n),
    "halton": lambda n: Halton(6 * n * n),
}


def rms_error(vectors, solid_angles, function, exact, normals):
    """RMS over normals of the relative error of Σ_j w_j f(n·ω_j)."""
    return np.sqrt(
        np.mean((solid_angles @ function(vectors.astype(float) @ normals.T) / exact - 1) ** 2)
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_clamped_cosine_integrates_to_pi(family):
    """Σ w_j max(0, n·ω_j) → π as 1/s: the midpoint rule's h² within cells; along the kink, √s cells
    of errors of h³ with random signs, less. Also half the sphere's directions would leave a
    constant error, and random ones fall as 1/√s.
    """
    normals = uniform_directions(np.random.default_rng(5), 100)
    lattices = [FAMILIES[family](n) for n in (4, 32)]
    coarse, fine = (
        rms_error(x.vectors, x.solid_angles, lambda c: np.maximum(c, 0), np.pi, normals)
        for x in lattices
    )
    slope = np.log(fine / coarse) / np.log(len(lattices[1]) / len(lattices[0]))
    assert -1.6 < slope < -0.9
    assert fine < 1e-4


@pytest.mark.parametrize("family", FAMILIES)
def test_caps_converge_faster_than_random_points(family):
    """The share of a cap, f = [n·ω > 0.6], as visibility is: of √s border cells each errs by a cell
    at random, which makes s^−¾; random points err by s^−½.
    """
    normals = uniform_directions(np.random.default_rng(6), 400)
    lattices = [FAMILIES[family](n) for n in (4, 32)]
    exact = 2 * np.pi * 0.4
    coarse, fine = (
        rms_error(x.vectors, x.solid_angles, lambda c: c > 0.6, exact, normals) for x in lattices
    )
    slope = np.log(fine / coarse) / np.log(len(lattices[1]) / len(lattices[0]))
    assert -0.9 < slope < -0.6


@pytest.mark.parametrize("family", FAMILIES)
def test_moments(family):
    """∫ ω dω = 0 by symmetry, and ∫ ω ωᵀ dω = 4π/3 · 1: what a lattice that uses n of n² directions
    fails. The midpoint rule errs by about (cell/2)² = 1.2e-3 of it.
    """
    lattice = FAMILIES[family](32)
    vectors = lattice.vectors.astype(float)
    np.testing.assert_allclose(lattice.solid_angles @ vectors, 0, atol=1e-12)
    moment = np.einsum("s,si,sj->ij", lattice.solid_angles, vectors, vectors)
    np.testing.assert_allclose(moment, 4 * np.pi / 3 * np.eye(3), atol=1.2e-3 * 4 * np.pi / 3)


def test_halton_is_of_lower_discrepancy_than_random_points():
    """Against the median of 20 sets of random points, which fall as 1/√s: the points' L2 star
    discrepancy in the square, where Halton's theory holds, and on the sphere, with the weights 4π/s
    for all, the error of cosine and caps.
    """
    rng = np.random.default_rng(7)
    count = 1536
    vectors = Halton(count).vectors.astype(float)
    square = np.stack(
        [vectors[:, 1], np.arctan2(vectors[:, 0], -vectors[:, 2]) / (2 * np.pi) % 1], axis=-1
    )[: count // 2]
    random = np.median(
        [scipy.stats.qmc.discrepancy(rng.random(square.shape), method="L2-star") for _ in range(20)]
    )
    assert scipy.stats.qmc.discrepancy(square, method="L2-star") < random / 5
    normals = uniform_directions(rng, 100)
    w = np.full(count, 4 * np.pi / count)
    sets = [uniform_directions(rng, count) for _ in range(20)]
    for function, exact, gain in (
        (lambda c: np.maximum(c, 0), np.pi, 10),
        (lambda c: c > 0.6, 0.8 * np.pi, 3),
    ):
        random = np.median([rms_error(x, w, function, exact, normals) for x in sets])
        ours = rms_error(vectors, w, function, exact, normals)
        assert ours < random / gain
        # exact weights: better still
        assert rms_error(vectors, Halton(count).solid_angles, function, exact, normals) < ours


# --- nearest directions ---------------------------------------------------------------------------


@every_lattice
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nearest_directions(lattice, dtype):
    """k = 1 is the cell; k > 1 are the k largest cosines in order, by brute force, whatever the
    length; k = s is all.
    """
    vectors = (
        uniform_directions(np.random.default_rng(8), 200)
        * 10.0 ** np.linspace(-20, 20, 200)[:, None]
    ).astype(dtype)
    np.testing.assert_array_equal(lattice.nearest(vectors, 1), lattice.cells(vectors)[:, None])
    units = mi_prt.directions.lattice.unit(vectors)
    angles = np.arccos(np.clip(units @ lattice.vectors.T.astype(float), -1, 1))
    for k in sorted({2, 4, len(lattice)} - set(range(len(lattice) + 1, 5))):
        nearest = lattice.nearest(vectors, k)
        assert nearest.shape == (200, k) and nearest.dtype == np.int64
        # Angles instead of indices: ties may come in any order.
        np.testing.assert_allclose(
            np.take_along_axis(angles, nearest, 1), np.sort(angles, axis=1)[:, :k], atol=1e-6
        )
        assert all(len(set(row)) == k for row in nearest.tolist())


@pytest.mark.parametrize(
    ("lattice", "share"),
    [(Cubemap(16), 0.06), (LatLong(64, 32), 0.003), (Halton(1536), 1e-4)],
    ids=str,
)
def test_the_cell_is_almost_always_that_of_the_nearest_direction(lattice, share):
    """Always in Halton's Voronoi cells but for float32. A cubemap's are sheared near the cube's
    corners, a map's are curved: there another direction may be nearer, by far less than the cell's
    size.
    """
    vectors = uniform_directions(np.random.default_rng(9), 20_000)
    cells, nearest = lattice.cells(vectors), lattice.nearest(vectors, 2)[:, 0]
    assert (cells != nearest).mean() < share
    angles = [
        np.arccos(np.clip((vectors * lattice.vectors[x]).sum(axis=1), -1, 1))
        for x in (cells, nearest)
    ]
    assert (angles[0] - angles[1]).max() < 0.35 * np.sqrt(4 * np.pi / len(lattice))


@every_lattice
@pytest.mark.parametrize("k", [0, -1, 10**9, 1.5, 2.0, True, None, "2", np.nan])
def test_bad_numbers_of_nearest_directions(lattice, k):
    with pytest.raises(SettingsError, match="nearest") as caught:
        lattice.nearest(np.ones((1, 3)), k)
    assert "\n" not in str(caught.value) and str(len(lattice)) in str(caught.value)


# --- refinement -----------------------------------------------------------------------------------


@every_lattice
@pytest.mark.parametrize("factor", [1, 4])
def test_refined(lattice, factor):
    """At least `factor`² times as many cells, and less than what one more cell along a face's edge
    would add.
    """
    fine = lattice.refined(factor)
    assert isinstance(fine, Cubemap)
    assert fine.resolution % factor == 0
    assert 6 * (fine.resolution - factor) ** 2 < factor**2 * len(lattice) <= len(fine)
    if isinstance(lattice, Cubemap):
        assert fine == Cubemap(lattice.resolution * factor)


def test_refinement_ends_at_the_finest_cubemap():
    assert Cubemap(200).refined(4) == Cubemap(512)
    assert LatLong(1024, 1024).refined(4) == Halton(98304).refined(16) == Cubemap(512)


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "lattice"),
    [
        ("cubemap:1", Cubemap(1)),
        ("cubemap:512", Cubemap(512)),
        ("latlong:128x64", LatLong(128, 64)),
        ("latlong:2x786432", LatLong(2, 786432)),
        ("halton:6", Halton(6)),
        ("halton:98304", Halton(98304)),
    ],
)
def test_names_and_lattices_are_one_to_one(text, lattice):
    """Also as keys, from integers of NumPy, and for a lattice in the place of its name; the largest
    cost nothing yet.
    """
    parsed = parse_directions(text)
    assert parsed == lattice and hash(parsed) == hash(lattice) and str(lattice) == text
    assert parse_directions(lattice) is lattice
    assert parse_directions(np.str_(text)) == lattice
    fields = [np.int64(value) for value in vars(type(lattice)(**vars(lattice))).values()]
    assert type(lattice)(*fields) == lattice and str(type(lattice)(*fields)) == text


def test_lattices_of_different_kinds_or_sizes_differ():
    """Even where the number is the same: 6 is a resolution, a width and a count."""
    lattices = [Cubemap(6), Cubemap(8), LatLong(6, 8), LatLong(8, 6), Halton(6), Halton(8)]
    assert len(set(lattices)) == len({str(x) for x in lattices}) == len(lattices)


def test_lattices_are_frozen():
    for lattice in (Cubemap(2), LatLong(4, 2), Halton(6)):
        with pytest.raises(AttributeError):
            setattr(lattice, next(iter(vars(lattice))), 4)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "32",
        "cubemap",
        "cubemap:",
        "cubemap:0",
        "cubemap:-4",
        "cubemap:513",
        "cubemap:3.5",
        "cubemap:²",
        "cubemap:٣٢",
        "cubemap:1_0",
        "cubemap: 8",
        "cubemap:8\n",
        "cubemap:8x8",
        "cubemap:" + "9" * 5000,
        "Cubemap:8",
        "latlong",
        "latlong:",
        "latlong:64",
        "latlong:64x",
        "latlong:x32",
        "latlong:63x32",
        "latlong:64x31",
        "latlong:0x0",
        "latlong:0x2",
        "latlong:-2x2",
        "latlong:64x32x2",
        "latlong:64X32",
        "latlong:64×32",
        "latlong:²x²",
        "latlong:2x786434",
        "latlong:1256x1254",
        "latlong:999999998x999999998",
        "latlong:" + "8" * 5000 + "x2",
        "halton:",
        "halton:0",
        "halton:2",
        "halton:4",
        "halton:7",
        "halton:-6",
        "halton:98306",
        "halton:1e4",
        "halton:٦",
        "halton:" + "2" * 5000,
        "sphere:32",
        None,
        32,
        b"cubemap:8",
        ("cubemap", 8),
        "line\nbreak" * 100,
    ],
)
def test_bad_names(text):
    """One short line that gives a remedy which itself works."""
    with pytest.raises(SettingsError) as caught:
        parse_directions(text)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 250
    remedies = [
        word.strip(",")
        for word in message.split()
        if word.startswith(("cubemap:", "latlong:", "halton:"))
    ]
    assert len(parse_directions(remedies[-1])) > 0


def test_an_unknown_name_is_told_all_forms():
    with pytest.raises(SettingsError) as caught:
        parse_directions("sphere:32")
    for word in (
        "sphere:32",
        "cubemap:N",
        "latlong:WxH",
        "halton:N",
        "cubemap:32",
        "latlong:128x64",
        "halton:6144",
    ):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    "number", [0, 3, -2, 8.0, 8.5, "8", True, None, np.nan, np.inf, 10**30, np.array([8, 8])]
)
def test_bad_settings_of_lattices(number):
    """As of names, where a lattice is made from numbers; 3 is a resolution, but neither a width nor
    a count.
    """
    if not (isinstance(number, int) and number == 3):
        with pytest.raises(SettingsError):
            Cubemap(number)
    for make in (lambda n: LatLong(n, 8), lambda n: LatLong(8, n), Halton):
        with pytest.raises(SettingsError):
            make(number)


# --- in the program -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lattice", [Cubemap(8), LatLong(32, 16), LatLong(2, 4), Halton(384)], ids=str
)
def test_energy_of_light_on_any_lattice(lattice):
    """Σ_j w_j L_j = ∫ L dω of a smooth sky, 1 + y over the sphere in closed form (4π), whatever the
    lattice and rotation; and a constant stays one in each cell.
    """
    rotation = random_rotation(np.random.default_rng(10))
    radiance = cell_radiance(EnvironmentMap(sky_of(lambda d: 1 + d[:, 1]), rotation), lattice)
    np.testing.assert_allclose(lattice.solid_angles @ radiance, 4 * np.pi, rtol=1e-4)
    constant = cell_radiance(EnvironmentMap(np.full((4, 8, 3), 2.0), rotation), lattice)
    np.testing.assert_allclose(constant, 2, rtol=1e-5)


@pytest.mark.parametrize("directions", ["cubemap:8", "latlong:32x16", "halton:384"])
@pytest.mark.parametrize("rays", [1, 4])
def test_irradiance_of_an_open_plane(directions, rays):
    """Nothing but a plane that faces a tilted direction: E = π under a sky of 1, to 1 % from these
    coarse lattices.
    """
    plane = rectangle(normal=(0.3, 0.8, -0.4), bsdf=diffuse())
    asset = mi_prt.precompute(
        scene(p=plane), directions=directions, coefficients=0, rays_per_direction=rays
    )
    irradiance = asset.irradiance(np.ones((2, 4, 3), np.float32))
    np.testing.assert_allclose(irradiance, np.pi, rtol=0.01)
