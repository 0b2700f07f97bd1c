"""Direction lattices and distant light: partitions of the sphere, exact energy, Mitsuba's
conventions, bad input.
"""

import warnings

import numpy as np
import OpenEXR
import pytest
from conftest import (
    bias,
    emitted,
    matrix_transform,
    random_rotation,
    relative_l2,
    scene,
    sky_of,
    sphere,
    uniform_directions,
    uniform_sky,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import mi_prt
from mi_prt import DirectionalLight, EnvironmentMap, Light, LightError, LightWarning, SettingsError
from mi_prt.directions import Cubemap, parse_directions
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.lighting.lattice import on_lattice
from mi_prt.lighting.light import as_light
from mi_prt.lighting.rotation import rotation_matrix
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba

mi = mitsuba()

LATTICE = Cubemap(16)


def energy_of(light, lattice=LATTICE):
    return (cell_radiance(light, lattice) * lattice.solid_angles[:, None]).sum(axis=0)


def exact_energy(pixels):
    """∫ L dω of Mitsuba's bilinear map, in closed form.

    Across, the mean of a row counts. Along θ each row is a hat over [θ−Δ, θ+Δ], Δ = π/(h−1), times
    sin θ: it integrates to 2 sin θ (1 − cos Δ)/Δ, and at the poles, where half a hat is left, to 1
    − sin Δ/Δ.
    """
    height = len(pixels)
    step = np.pi / (height - 1)
    rows = 2 * np.sin(np.arange(height) * step) * (1 - np.cos(step)) / step
    rows[[0, -1]] = 1 - np.sin(step) / step
    return 2 * np.pi * rows @ pixels.astype(np.float64).mean(axis=1)


# --- lattices -------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [1, 2, 5, 32, 64])
def test_cells_partition_the_sphere(resolution):
    """Solid angles sum to 4π, vectors are unit, distinct, and the first moment ∫ ω dω is zero by
    symmetry.
    """
    lattice = Cubemap(resolution)
    assert len(lattice) == len(lattice.vectors) == len(lattice.solid_angles) == 6 * resolution**2
    assert lattice.solid_angles.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    assert lattice.solid_angles.max() / lattice.solid_angles.min() < 2**0.5 + 1e-9
    np.testing.assert_allclose(np.linalg.norm(lattice.vectors, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(lattice.solid_angles @ lattice.vectors, 0, atol=1e-5)
    np.testing.assert_array_equal(lattice.cells(lattice.vectors), np.arange(len(lattice)))


@pytest.mark.parametrize("resolution", [1, 2, 7])
@pytest.mark.parametrize("rays", [1, 6])
def test_the_lattice_is_symmetric_about_the_origin(resolution, rays):
    """Cell j + s/2 is the antipode of cell j, ray by ray: tracing only one of each pair relies on
    it.
    """
    vectors, fractions = Cubemap(resolution).subdivided(rays)
    half = len(vectors) // 2
    np.testing.assert_allclose(vectors[half:], -vectors[:half], atol=1e-7)
    np.testing.assert_allclose(fractions[half:], fractions[:half], rtol=1e-6)


@pytest.mark.parametrize("resolution", [1, 3, 8])
def test_solid_angles_are_the_share_of_random_directions(resolution):
    """Uniform directions fall into cells in proportion to their solid angles: χ² test, 1e-6 false
    positives, fixed seed.
    """
    import scipy.stats

    lattice, count = Cubemap(resolution), 400_000
    cells = lattice.cells(uniform_directions(np.random.default_rng(1), count))
    expected = lattice.solid_angles / (4 * np.pi) * count
    chi2 = ((np.bincount(cells, minlength=len(lattice)) - expected) ** 2 / expected).sum()
    assert chi2 < scipy.stats.chi2.isf(1e-6, len(lattice) - 1)


def test_second_moment_of_the_lattice():
    """∫ ωωᵀ dω = 4π/3 · 1: what a lattice that uses n of n² directions fails.

    Midpoint error ~ (cell/2)².
    """
    lattice = Cubemap(32)
    moment = np.einsum("s,si,sj->ij", lattice.solid_angles, lattice.vectors, lattice.vectors)
    np.testing.assert_allclose(moment, 4 * np.pi / 3 * np.eye(3), atol=2e-3)


def test_cells_of_axes_edges_corners_and_any_length():
    """Directions on the borders of faces belong to a cell that touches them; length does not
    matter, signed zero neither.
    """
    lattice = Cubemap(4)
    signs = np.stack(np.meshgrid(*[[-1.0, 0.0, -0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    vectors = signs[np.abs(signs).any(axis=1)]
    for length in (1e-20, 1.0, 1e20):
        cells = lattice.cells(length * vectors)
        assert cells.min() >= 0 and cells.max() < len(lattice)
        cosine = (lattice.vectors[cells] * vectors).sum(axis=1) / np.linalg.norm(vectors, axis=1)
        assert cosine.min() > np.cos(np.pi / 4 / 4 * (8 / 3) ** 0.5)


@given(st.integers(1, 24), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_direction_is_never_farther_from_its_cells_centre_than_the_cells_radius(resolution, seed):
    """Cells are h = π/(4N) wide on either side of their centre; at a corner of the cube, where they
    are sheared most, the metric makes the diagonal √(8/3) h long, and less elsewhere.
    """
    vectors = uniform_directions(np.random.default_rng(seed), 200)
    lattice = Cubemap(resolution)
    cosine = (lattice.vectors[lattice.cells(vectors)] * vectors).sum(axis=1)
    assert np.arccos(np.clip(cosine, -1, 1)).max() <= np.pi / 4 / resolution * (8 / 3) ** 0.5 + 1e-3


@pytest.mark.parametrize("rays", [1, 2, 3, 4, 7, 12, 16, 64])
def test_subdivision(rays):
    """Sub-cells partition their cell: shares sum to 1, vectors are distinct and in the cell, and
    the first moment of a cell is the share-weighted mean of theirs, which converges to the exact
    one.
    """
    lattice = Cubemap(4)
    vectors, fractions = lattice.subdivided(rays)
    assert vectors.shape == (96, rays, 3) and fractions.shape == (96, rays)
    np.testing.assert_allclose(fractions.sum(axis=1), 1, atol=1e-6)
    assert fractions.min() > 0
    np.testing.assert_array_equal(
        lattice.cells(vectors.reshape(-1, 3)), np.repeat(np.arange(96), rays)
    )
    assert len(np.unique(vectors.reshape(-1, 3), axis=0)) == 96 * rays
    # Exact: ∫_cube-face-cell ω dω by 64 × 64 midpoints of the plane, dω = 1/(1 + a² + b²)^{3/2} da
    # db.
    if rays == 64:
        edges = np.tan(np.pi / 4 * np.linspace(-1, 1, 5))
        a = np.concatenate(
            [np.linspace(l, h, 129)[1::2] for l, h in zip(edges, edges[1:])]
        ).reshape(4, 64)
        widths = np.diff(edges) / 64
        aa, bb = a[1][None, :], a[0][:, None]
        density = widths[1] * widths[0] / (1 + aa**2 + bb**2) ** 1.5
        mean = np.array(
            [
                (aa * density / np.sqrt(1 + aa**2 + bb**2)).sum(),
                (bb * density / np.sqrt(1 + aa**2 + bb**2)).sum(),
            ]
        )
        (cell,) = lattice.cells(
            np.array([[np.tan(np.pi / 4 * -0.25), np.tan(np.pi / 4 * -0.75), 1.0]])
        )
        ours = (fractions[cell, :, None] * vectors[cell]).sum(axis=0)[:2] * lattice.solid_angles[
            cell
        ]
        np.testing.assert_allclose(ours, mean, rtol=1e-3)


@pytest.mark.parametrize(
    "text",
    [
        "cubemap",
        "cubemap:",
        "cubemap:0",
        "cubemap:-4",
        "cubemap:513",
        "cubemap:3.5",
        "cubemap:²",
        "sphere:32",
        "32",
        "",
        None,
    ],
)
def test_bad_lattice_names(text):
    with pytest.raises(SettingsError) as caught:
        parse_directions(text)
    assert "\n" not in str(caught.value)


# --- energy ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(2, 4), (3, 5), (9, 16), (17, 34), (64, 128), (512, 1024)])
@pytest.mark.parametrize("resolution", [4, 32])
def test_energy_of_a_map_is_exact(shape, resolution):
    """Σ_j w_j L_j = ∫ L dω of the bilinear map, in closed form, to 1e-4: noise of all sizes, turned
    by a random angle.
    """
    rng = np.random.default_rng(shape)
    pixels = rng.exponential(size=(*shape, 3)).astype(np.float32) * [1, 1e-3, 1e3]
    light = EnvironmentMap(pixels, rotation=random_rotation(rng))
    np.testing.assert_allclose(
        energy_of(light, Cubemap(resolution)), exact_energy(light.pixels), rtol=1e-4
    )


@pytest.mark.parametrize(
    ("shape", "row"),
    [((9, 16), 3), ((17, 34), 5), ((64, 128), 0), ((64, 128), 63), ((512, 1024), 200)],
)
@pytest.mark.parametrize("resolution", [4, 32])
def test_energy_of_a_sun_of_a_single_pixel_is_exact(shape, row, resolution):
    """A pixel of 1e5 in a sky of 1 is neither missed nor counted at its peak: 1e-4 as above, also
    at the poles.
    """
    pixels = np.ones((*shape, 3), np.float32)
    pixels[row, shape[1] // 3] = [1e5, 3e4, 1.0]
    light = EnvironmentMap(pixels, rotation=random_rotation(np.random.default_rng(row)))
    np.testing.assert_allclose(
        energy_of(light, Cubemap(resolution)), exact_energy(pixels), rtol=1e-4
    )


def test_a_sun_lands_in_its_cells_and_leaves_the_others():
    """Only the cells that the pixel's hat reaches (one pixel around it) may differ from the sky
    around.
    """
    pixels = np.ones((64, 128, 3), np.float32)
    pixels[20, 40] = 1e5
    rotation = random_rotation(np.random.default_rng(2))
    radiance = cell_radiance(EnvironmentMap(pixels, rotation=rotation), LATTICE)
    u, v = (40 + 0.5) / 128 * 2 * np.pi, 20 / 63 * np.pi
    centre = rotation @ [np.sin(u) * np.sin(v), np.cos(v), -np.cos(u) * np.sin(v)]
    reach = np.hypot(2 * np.pi / 128, np.pi / 63) + np.pi / 4 / 16 * (8 / 3) ** 0.5
    far = LATTICE.vectors @ centre < np.cos(reach)
    np.testing.assert_allclose(radiance[far], 1, rtol=2e-3)
    assert radiance[LATTICE.cells(centre[None])[0]].min() > 100


@pytest.mark.parametrize("shape", [(2, 4), (1, 1), (7, 3), (100, 200)])
@pytest.mark.parametrize("resolution", [1, 5, 32])
def test_a_constant_map_is_constant_in_each_cell(shape, resolution):
    """The mean of a constant is the constant, under any rotation; the correction may cost no more
    than float32.
    """
    light = EnvironmentMap(
        np.full((*shape, 3), [0.1, 1.0, 1e4]), rotation=random_rotation(np.random.default_rng(4))
    )
    np.testing.assert_allclose(
        cell_radiance(light, Cubemap(resolution)) / [0.1, 1.0, 1e4], 1, rtol=1e-5
    )


def test_cells_hold_the_mean_over_their_solid_angle():
    """A smooth map: each cell's mean is its function's at 256 sub-cells, but for the light that its
    centroid shares with the neighbours: of the order of the cell's side squared.
    """
    for resolution, limit in ((8, 1e-2), (16, 4e-3), (32, 1e-3)):
        lattice = Cubemap(resolution)
        function = lambda d: np.stack([1 + d[:, 0], 1 + d[:, 1] ** 2, np.exp(d[:, 2])], axis=-1)
        vectors, fractions = lattice.subdivided(64)
        expected = np.einsum(
            "sr,src->sc", fractions, function(vectors.reshape(-1, 3)).reshape(len(lattice), 64, 3)
        )
        result = cell_radiance(sky_of(function, 256), lattice)
        assert relative_l2(result, expected) < limit
        assert np.abs(bias(result, expected)) < 1e-4


def moment_of(radiance, lattice):
    """First moment (c, 3) of cells' radiance, Σ w L ω."""
    return np.einsum(
        "sc,sx->cx", radiance * lattice.solid_angles[:, None], lattice.vectors.astype(float)
    )


@pytest.mark.parametrize("name", ["cubemap:16", "cubemap:32", "halton:6144", "latlong:96x64"])
def test_a_sun_keeps_its_energy_and_its_first_moment(name):
    """A sun of parallel rays, of one pixel, and turned: the energy to 1e-4, the moment's direction
    to 0.02° and its length to half the square of the cells' diagonal. In channels of their own: a
    red sun beside a blue one, in one cell.
    """
    lattice = parse_directions(name)
    rng = np.random.default_rng(3)
    side = np.sqrt(4 * np.pi / len(lattice))
    for _ in range(2):
        pixels = np.zeros((128, 256, 3), np.float32)
        row, column = rng.integers(8, 120), rng.integers(256)
        pixels[row, column] = [1e5, 5e4, 0]
        pixels[row + 1, (column + 1) % 256] = [0, 0, 1e4]
        light = EnvironmentMap(pixels, rotation=random_rotation(rng))
        turned = on_lattice(light, lattice).rotated("x", 33).parts[0]
        exact = light.quadrature(6e-3)
        energy, moment = exact.energy.sum(axis=0, dtype=float), exact.moments.sum(0, dtype=float)
        turn = rotation_matrix("x", 33)
        sun = DirectionalLight(-moment[0], energy)
        for part, expected in (
            (light, moment),
            (turned, moment @ turn.T),
            (sun, energy[:, None] * moment[0] / np.linalg.norm(moment[0])),
        ):
            radiance = part.radiance(lattice, 8)
            assert radiance.min() >= 0
            np.testing.assert_allclose(
                (radiance * lattice.solid_angles[:, None]).sum(axis=0), energy, rtol=1e-4
            )
            found = moment_of(radiance, lattice)
            length = np.linalg.norm(found, axis=1) / np.linalg.norm(expected, axis=1)
            assert np.all((length < 1 + 1e-4) & (length > 1 - 2 * side**2))
            across = np.cross(found, expected) / np.linalg.norm(expected, axis=1, keepdims=True)
            assert np.all(
                np.linalg.norm(across, axis=1) < np.radians(0.02) * np.linalg.norm(found, axis=1)
            )


@pytest.mark.parametrize("turned", [False, True])
def test_a_low_sun_on_an_open_plane(turned):
    """E sin(elevation) on a plane that sees all, as its transport is sampled (cubemap:32, one ray
    for each cell): within 1 % from 12° up, 2 % at 8°, 3 % at 5°, at any azimuth and turned. The
    middle of the sun's cell alone is up to 19 % off at 5°.
    """
    lattice = parse_directions("cubemap:32")
    cosine = np.maximum(lattice.vectors[:, 1].astype(float), 0) * lattice.solid_angles
    for elevation, limit in ((60, 0.01), (20, 0.01), (12, 0.01), (8, 0.02), (5, 0.03)):
        for azimuth in np.arange(0, 360, 23.7):
            up, around = np.radians(elevation), np.radians(azimuth)
            toward = np.array(
                [np.cos(up) * np.cos(around), np.sin(up), np.cos(up) * np.sin(around)]
            )
            sun = DirectionalLight(-toward, 1.0)
            if turned:
                sun = sun.rotated("y", 90).rotated("y", -50)
            found = cosine @ cell_radiance(sun, lattice)[:, 0]
            assert found == pytest.approx(np.sin(up), rel=limit)


def test_a_directional_light_shines_from_the_three_directions_around():
    """Σ_j w_j L_j = E; all three are within a cell's diagonal."""
    toward = np.array([0.3, -0.5, 0.7])
    radiance = cell_radiance(DirectionalLight(-5 * toward, [1.0, 2.0, 3.0]), LATTICE)
    lit = np.flatnonzero(radiance.any(axis=1))
    assert 1 <= len(lit) <= 3 and LATTICE.cells(toward[None])[0] in lit
    np.testing.assert_allclose(
        (radiance * LATTICE.solid_angles[:, None]).sum(axis=0), [1, 2, 3], rtol=1e-6
    )


# --- Mitsuba's convention -------------------------------------------------------------------------


def interpolated(light, directions):
    """Radiance of an EnvironmentMap at directions, from the quadrature's nearest sample; error ~
    gradient × spacing.
    """
    import scipy.spatial

    samples = light.quadrature(0.004)
    return samples.radiance[scipy.spatial.cKDTree(samples.vectors).query(directions)[1]]


@pytest.mark.parametrize("seed", [0, 1])
def test_quadrature_equals_mitsubas_envmap(seed):
    """At each sample's own direction Mitsuba's emitter shows the same radiance, under a random
    to_world and scale.

    Equal up to float32 in the directions: 1e-6 rad of a gradient of at most a pixel's step per
    pixel.
    """
    rng = np.random.default_rng(seed)
    pixels = rng.random((12, 24, 3)).astype(np.float32)
    rotation = random_rotation(rng)
    emitter = mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(pixels),
            "to_world": matrix_transform(rotation),
            "scale": 0.7,
        }
    )
    for light in (
        EnvironmentMap(pixels, rotation, scale=0.7),
        scene_light(open_scene(scene(s=sphere(), e=emitter))).parts[0],
    ):
        samples = light.quadrature(0.05)
        error = np.abs(samples.radiance - emitted(emitter, samples.vectors))
        assert np.quantile(error, 0.999) < 2e-5 and error.max() < 1e-3
        assert samples.solid_angles.sum(dtype=float) == pytest.approx(4 * np.pi, rel=1e-6)


def test_a_map_of_one_column_or_row_works_as_in_mitsuba():
    """Degenerate sizes interpolate with themselves."""
    for shape in [(6, 1), (2, 2)]:
        pixels = np.random.default_rng(0).random((*shape, 3)).astype(np.float32)
        np.testing.assert_allclose(energy_of(pixels), exact_energy(pixels), rtol=1e-4)
    np.testing.assert_allclose(energy_of(np.full((1, 6, 3), 2.0)), 8 * np.pi, rtol=1e-5)


@pytest.mark.parametrize("axis", ["x", "y", "z", (1, -2, 0.5)])
def test_rotated_light_equals_mitsubas_rotated_emitter(axis):
    """`rotated` turns light as Mitsuba's to_world = rotate(axis, angle) @ to_world does, in world
    space.
    """
    rng = np.random.default_rng(8)
    pixels = sky_of(lambda d: np.exp(d @ rng.standard_normal((3, 3))), 32)
    start, degrees = random_rotation(rng), 77.0
    vector = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}.get(axis, axis)
    unit = np.array(vector) / np.linalg.norm(vector)  # Mitsuba takes unit axes only
    turned = mi.ScalarTransform4f().rotate(list(unit), degrees) @ matrix_transform(start)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": turned})
    light = EnvironmentMap(pixels, start).rotated(axis, degrees)
    directions = uniform_directions(rng, 500)
    assert relative_l2(interpolated(light, directions), emitted(emitter, directions)) < 5e-3


def test_rotating_light_of_all_kinds_together():
    """A Light turns all its parts; a directional light turned by `rotated` comes from the turned
    direction.
    """
    sun = DirectionalLight([0, 0, -1.0], [1, 1, 1])  # from +z
    both = Light((EnvironmentMap(uniform_sky()), sun)).rotated("y", 90)  # +z to +x
    np.testing.assert_allclose(both.parts[1].direction, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(both.parts[0].rotation @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_rotations_compose_and_keep_the_map():
    """Turning by a then b is one rotation matrix; 360° is none; pixels and the original are
    untouched.
    """
    light = EnvironmentMap(np.random.default_rng(0).random((4, 8, 3)), scale=2.0)
    turned = light.rotated("x", 30).rotated("z", -50)
    np.testing.assert_allclose(
        turned.rotation, rotation_matrix("z", -50) @ rotation_matrix("x", 30), atol=1e-12
    )
    np.testing.assert_array_equal(turned.pixels, light.pixels)
    np.testing.assert_array_equal(light.rotation, np.eye(3))
    np.testing.assert_allclose(light.rotated("y", 360).rotation, np.eye(3), atol=1e-12)


def test_prepared_light_turns_like_the_map():
    """Light on a fine lattice has the map's energy whatever the angle, keeps a constant, and stays
    near the exact rotation.

    A direction moves by at most the radius of a fine cell, a third of a coarse one's, so that a
    smooth sky hardly changes.
    """
    asset = mi_prt.precompute(scene(ball=sphere()), directions="cubemap:16", edge_length=1.0)
    pixels = sky_of(
        lambda d: np.exp(2 * d @ np.array([[0.5, 1, 0], [0.5, 0, 1], [0.7, 0, 0.1]])), 64
    )
    sun = DirectionalLight([0, -1, 0.2], [1, 1, 1])
    exact = Light((EnvironmentMap(pixels), sun))
    prepared = asset.prepare_light(exact)
    flat = asset.prepare_light(uniform_sky([1.0, 2.0, 3.0]))
    for axis, degrees in [("y", 0), ("y", 33), ((1, 2, 3), 120), ("z", -7)]:
        now, then = prepared.rotated(axis, degrees), exact.rotated(axis, degrees)
        np.testing.assert_allclose(energy_of(now), energy_of(then), rtol=1e-4)
        without = [cell_radiance(light.parts[0], LATTICE) for light in (now, then)]
        assert relative_l2(*without) < 0.02
        np.testing.assert_allclose(
            cell_radiance(flat.rotated(axis, degrees), LATTICE) / [1, 2, 3], 1, rtol=1e-3
        )
        assert relative_l2(asset.irradiance(now), asset.irradiance(then)) < 5e-3


def test_lit_scene_gives_mitsuba_the_same_light():
    """What `lit_scene` hands to Mitsuba shows the light's radiance in all directions, and its
    directional lights.
    """
    rng = np.random.default_rng(6)
    light = Light(
        (
            EnvironmentMap(rng.random((8, 16, 3)), random_rotation(rng)),
            DirectionalLight([1, -2, 0.5], [3, 2, 1]),
        )
    )
    lit = lit_scene(mi.load_dict(scene(s=sphere(), old={"type": "constant"})), light)
    again = scene_light(open_scene(lit))
    np.testing.assert_allclose(
        cell_radiance(again, LATTICE), cell_radiance(light, LATTICE), rtol=1e-4, atol=1e-5
    )


# --- rotation_matrix ------------------------------------------------------------------------------

axes = st.one_of(
    st.sampled_from(["x", "y", "z"]),
    st.tuples(*[st.floats(-10, 10)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3),
)
angles = st.floats(-1e4, 1e4)


@given(axes, angles)
@settings(max_examples=100, deadline=None)
def test_rotation_matrices_are_rotations(axis, degrees):
    """Orthonormal, of determinant 1, with the axis fixed and the angle in the trace: tr R = 1 + 2
    cos α.
    """
    matrix = rotation_matrix(axis, degrees)
    vector = (
        {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}.get(axis, axis)
        if isinstance(axis, str)
        else axis
    )
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(matrix @ vector, vector, atol=1e-8)
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(np.radians(degrees)), abs=1e-8)


@given(axes, angles, angles)
@settings(max_examples=100, deadline=None)
def test_rotations_about_one_axis_add_up_and_can_be_undone(axis, one, two):
    """R(a) R(b) = R(a + b), R(a)ᵀ = R(−a)."""
    np.testing.assert_allclose(
        rotation_matrix(axis, one) @ rotation_matrix(axis, two),
        rotation_matrix(axis, one + two),
        atol=1e-7,
    )
    np.testing.assert_allclose(rotation_matrix(axis, one).T, rotation_matrix(axis, -one), atol=1e-9)


def test_rotation_is_right_handed():
    """About +z a quarter turn takes x to y; and cyclically."""
    for axis, start, end in [("z", 0, 1), ("x", 1, 2), ("y", 2, 0)]:
        np.testing.assert_allclose(
            rotation_matrix(axis, 90) @ np.eye(3)[start], np.eye(3)[end], atol=1e-12
        )


@pytest.mark.parametrize(
    ("axis", "degrees"),
    [
        ((0, 0, 0), 10),
        ("w", 10),
        ((1, 0), 10),
        ((np.nan, 0, 1), 10),
        ("x", np.inf),
        ("x", np.nan),
        (("a", "b", "c"), 1),
        (None, 1),
        ("xy", 1),
    ],
)
def test_bad_rotations(axis, degrees):
    with pytest.raises(LightError) as caught:
        EnvironmentMap(uniform_sky()).rotated(axis, degrees)
    assert "\n" not in str(caught.value)


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_refused_and_counted(bad):
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[2, 3, 1] = pixels[5, 5] = bad
    with pytest.raises(LightError, match=r"\b2 pixels"):
        EnvironmentMap(pixels)


def test_a_scale_that_overflows_is_refused():
    """1e38 · 100 is no float32."""
    with pytest.raises(LightError):
        EnvironmentMap(np.full((2, 4, 3), 1e38), scale=100.0)


@pytest.mark.parametrize("scale", [np.nan, np.inf, -1.0])
def test_a_scale_that_is_no_factor_is_refused(scale):
    with pytest.raises(LightError):
        EnvironmentMap(uniform_sky(), scale=scale)


def test_small_negative_pixels_are_zeroed_counted_and_warned_of():
    """Compression noise: 3 pixels of −1e-4 among ones carry far less than 1e-3 of the energy."""
    pixels = np.ones((16, 32, 3), np.float32)
    pixels[4, 5] = pixels[9, 0, 2] = pixels[11, 7, 0] = -1e-4
    with pytest.warns(LightWarning, match=r"\b3 negative pixels"):
        light = EnvironmentMap(pixels)
    assert light.negative_pixels == 3 and light.pixels.min() == 0
    np.testing.assert_array_equal(light.pixels, np.maximum(pixels, 0))
    assert pixels.min() < 0  # the caller's array is not touched
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert light.rotated("y", 10).negative_pixels == 3  # still known, and not warned of again


def test_large_negative_pixels_are_refused():
    """One pixel of −5 among 512 ones is about 1 % of the energy."""
    pixels = np.ones((16, 32, 3), np.float32)
    pixels[8, 5] = -5
    with pytest.raises(LightError, match="negative"):
        EnvironmentMap(pixels)
    with pytest.raises(LightError, match="negative"):
        EnvironmentMap(-np.ones((2, 4, 3)))


@pytest.mark.parametrize("shape", [(4, 8), (4, 8, 1), (4, 8, 4), (0, 8, 3), (4, 0, 3), (3,), ()])
def test_arrays_of_the_wrong_shape(shape):
    with pytest.raises(LightError, match=r"\(h, w, 3\)"):
        EnvironmentMap(np.ones(shape))


@pytest.mark.parametrize(
    "source",
    [None, 5, [["a"]], {"a": 1}, np.array([[["x"] * 3]]), np.ones((2, 4, 3), complex), object()],
)
def test_things_that_are_no_light(source):
    with pytest.raises(LightError) as caught:
        as_light(source)
    assert "\n" not in str(caught.value)


def write_exr(path, channels):
    with OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels
    ) as file:
        file.write(str(path))


def test_exr_files(tmp_path):
    """float32 and float16, alpha and other channels, upper-case suffix: the pixels come back as
    written.
    """
    pixels = np.random.default_rng(0).random((6, 12, 3)).astype(np.float32)
    write_exr(tmp_path / "rgb.exr", {"RGB": pixels})
    write_exr(
        tmp_path / "half.EXR",
        {name: pixels[..., i].astype(np.float16).copy() for i, name in enumerate("RGB")},
    )
    write_exr(
        tmp_path / "more.exr",
        {
            "RGBA": np.dstack([pixels, np.ones((6, 12), np.float32)]),
            "depth.Z": pixels[..., 0].copy(),
        },
    )
    np.testing.assert_array_equal(EnvironmentMap(tmp_path / "rgb.exr").pixels, pixels)
    np.testing.assert_array_equal(
        EnvironmentMap(str(tmp_path / "half.EXR")).pixels, pixels.astype(np.float16)
    )
    np.testing.assert_array_equal(EnvironmentMap(tmp_path / "more.exr").pixels, pixels)
    np.testing.assert_array_equal(
        EnvironmentMap(mi.Bitmap(str(tmp_path / "rgb.exr"))).pixels, pixels
    )


def test_other_image_formats(tmp_path):
    """Radiance HDR holds 8 bits of mantissa for all channels; PNG is sRGB-encoded and becomes
    linear.
    """
    pixels = np.random.default_rng(0).random((6, 12, 3)).astype(np.float32) + 0.5
    mi.Bitmap(pixels).write(str(tmp_path / "map.hdr"))
    np.testing.assert_allclose(EnvironmentMap(tmp_path / "map.hdr").pixels, pixels, rtol=0.02)
    mi.Bitmap(np.full((4, 8, 3), 188, np.uint8)).write(str(tmp_path / "map.png"))
    np.testing.assert_allclose(
        EnvironmentMap(tmp_path / "map.png").pixels, ((188 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-3
    )


def test_exr_without_a_channel_names_it(tmp_path):
    plane = np.ones((4, 8), np.float32)
    write_exr(tmp_path / "rg.exr", {"R": plane, "G": plane})
    with pytest.raises(LightError, match="lacks B"):
        EnvironmentMap(tmp_path / "rg.exr")
    write_exr(tmp_path / "depth.exr", {"Z": plane})
    with pytest.raises(LightError, match="lacks R, G, B"):
        EnvironmentMap(tmp_path / "depth.exr")


def test_files_that_cannot_be_read(tmp_path):
    """Each with a typed error in one line: missing, a folder, text, empty, truncated, and an
    unknown format.
    """
    write_exr(
        tmp_path / "good.exr",
        {"RGB": np.random.default_rng(0).random((64, 128, 3)).astype(np.float32)},
    )
    whole = (tmp_path / "good.exr").read_bytes()
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "text.exr").write_text("not an image")
    (tmp_path / "text.hdr").write_text("not an image")
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "text.xyz").write_text("not an image")
    (tmp_path / "empty.exr").write_bytes(b"")
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "head.exr").write_bytes(whole[:40])
    names = [
        "missing.exr",
        "missing.hdr",
        "folder.exr",
        "text.exr",
        "text.hdr",
        "text.png",
        "text.xyz",
        "empty.exr",
        "cut.exr",
        "head.exr",
    ]
    for name in names:
        with pytest.raises(LightError, match=name) as caught:
            EnvironmentMap(tmp_path / name)
        assert "\n" not in str(caught.value), name


@pytest.mark.parametrize(
    ("direction", "irradiance"),
    [
        ([0, 0, 0], [1, 1, 1]),
        ([np.nan, 0, 1], [1, 1, 1]),
        ([0, 1], [1, 1, 1]),
        ([0, 1, 0], [1, -1, 1]),
        ([0, 1, 0], [1, np.inf, 1]),
        ([0, 1, 0], [1, 1]),
        ([0, 1, 0], "bright"),
        ("down", 1.0),
    ],
)
def test_bad_directional_lights(direction, irradiance):
    with pytest.raises(LightError):
        DirectionalLight(direction, irradiance)


def test_to_world_with_scale_or_shear_is_refused():
    """A map cannot be stretched; Mitsuba would show something, but its solid angles would lie."""
    with pytest.raises(LightError):
        EnvironmentMap(uniform_sky(), rotation=2 * np.eye(3))
    with pytest.raises(LightError):
        EnvironmentMap(uniform_sky(), rotation=np.eye(4))


def test_a_mirrored_envmap_follows_mitsuba():
    """A reflection in to_world keeps lengths and is honoured."""
    rng = np.random.default_rng(9)
    pixels = sky_of(lambda d: np.exp(d @ rng.standard_normal((3, 3))), 32)
    mirror = np.diag([-1.0, 1, 1])
    emitter = mi.load_dict(
        {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": matrix_transform(mirror)}
    )
    directions = uniform_directions(rng, 300)
    assert (
        relative_l2(
            interpolated(EnvironmentMap(pixels, mirror), directions), emitted(emitter, directions)
        )
        < 5e-3
    )


@pytest.mark.parametrize("pixel_format", ["RGB", "RGBA", "Y"])
def test_a_mitsuba_bitmap_is_a_map(pixel_format):
    """Its colour is taken as it is (linear), alpha left out, grey spread over the channels."""
    rng = np.random.default_rng(1)
    channels = {"RGB": 3, "RGBA": 4, "Y": 1}[pixel_format]
    pixels = rng.random((4, 8, channels)).astype(np.float32)
    light = EnvironmentMap(mi.Bitmap(pixels))
    np.testing.assert_allclose(light.pixels, np.broadcast_to(pixels[..., :3], (4, 8, 3)), rtol=1e-6)
