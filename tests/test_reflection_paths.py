"""Rays of reflections: bias against Mitsuba's path tracer, how noise falls with their number, and
noise taken out.
"""

import numpy as np
import pytest
import scipy.stats
from conftest import (
    FALSE_POSITIVES,
    bias,
    cosine_directions,
    cube,
    diffuse,
    disk,
    largest_z,
    rectangle,
    relative_l2,
    sampled,
    scene,
    sky_of,
    sphere,
)

from mi_prt.system.runtime import count_kernels, mitsuba
from mi_prt.transport.interreflection import combined

mi = mitsuba()


def two_sided(front, back=None):
    return {"type": "twosided", "front": front} | ({"back": back} if back else {})


def checkers(one, other, count):
    colours = {f"color{i}": {"type": "rgb", "value": value} for i, value in enumerate((one, other))}
    texture = {
        "type": "checkerboard",
        "to_uv": mi.ScalarTransform3f().scale([count, count]),
        **colours,
    }
    return {"type": "diffuse", "reflectance": texture}


def bitmap(seed):
    """A material of 6 × 5 random colours."""
    pixels = np.random.default_rng(seed).uniform(0.1, 0.95, (6, 5, 3)).astype(np.float32)
    return {
        "type": "diffuse",
        "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True},
    }


def room():
    return dict(
        floor=rectangle((0, 1, 0), (0, -1, 0), bsdf=checkers([0.9, 0.8, 0.7], [0.1, 0.2, 0.4], 3)),
        left=rectangle((1, 0, 0), (-1, 0, 0), bsdf=diffuse([0.9, 0.1, 0.1])),
        right=rectangle((-1, 0, 0), (1, 0, 0), bsdf=bitmap(1)),
        back=rectangle((0, 0, 1), (0, 0, -1), bsdf=diffuse([0.8, 0.8, 0.9])),
    )


def balls():
    return dict(
        floor=rectangle(size=2, bsdf=bitmap(2)),
        ball=sphere((0, 0.55, 0), 0.5, bsdf=checkers([0.95, 0.9, 0.2], [0.2, 0.3, 0.9], 4)),
        roof=disk(
            (0.2, -1, 0),
            (0, 1.6, 0),
            1.0,
            bsdf=two_sided(diffuse([0.9, 0.5, 0.5]), diffuse([0.2, 0.9, 0.3])),
        ),
    )


def blocks(box=diffuse([0.9, 0.4, 0.2]), post=diffuse(0.0)):
    blend = {
        "type": "blendbsdf",
        "weight": {"type": "checkerboard", "to_uv": mi.ScalarTransform3f().scale([4, 4])},
    }
    return dict(
        floor=rectangle(
            size=2,
            bsdf=blend | {"one": diffuse([0.9, 0.7, 0.3]), "other": diffuse([0.2, 0.5, 0.9])},
        ),
        box=cube((-0.5, 0.5, 0), 0.5, bsdf=box),
        post=cube((0.5, 0.3, 0.8), 0.3, bsdf=post),
        wall=rectangle((-1, 0, 0), (1, 1, 0), bsdf=two_sided(bitmap(3))),
    )


def glossy_blocks():
    """Plastic, of which only the diffuse colour is modelled, and metal, which is modelled as black:
    as bright as `blocks`.
    """
    plastic = {
        "type": "roughplastic",
        "diffuse_reflectance": {"type": "rgb", "value": [0.9, 0.4, 0.2]},
    }
    return blocks(plastic, {"type": "roughconductor", "alpha": 0.5})


def smooth_sky(d):
    """Radiance (k, 3) that no lattice can miss."""
    x, y, z = d.T
    return np.stack([1 + 0.5 * y + 0.3 * x, 1 - 0.4 * z, 0.5 + 0.4 * x * y], axis=-1)


def by_mitsuba(parts, points, bounces, paths, seed):
    """Reflected irradiance (n, 3) at points under the smooth sky, and its standard error, by
    Mitsuba's path tracer.
    """
    sky = {"type": "envmap", "bitmap": mi.Bitmap(sky_of(smooth_sky))}
    traced = mi.load_dict(
        scene(**parts, sky=sky, embree_use_robust_intersections=True),
        optimize=False,
        parallel=False,
    )
    # the ray that leaves the point is the first edge of a path of depth 1
    depth = -1 if bounces is None else bounces + 1
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
    directions = cosine_directions(
        np.random.default_rng(seed), np.repeat(points.normals.astype(float), paths, axis=0)
    )
    ray = mi.Ray3f(
        mi.Point3f(np.repeat(points.ray_origins(1e-4), paths, axis=0).T),
        mi.Vector3f(directions.T.astype(np.float32)),
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(directions))
    radiance = mi.Color3f(integrator.sample(traced, sampler, mi.RayDifferential3f(ray))[0])
    samples = np.pi * np.array(radiance).T.reshape(-1, paths, 3)
    return samples.mean(axis=1), samples.std(axis=1) / paths**0.5


# --- bias -----------------------------------------------------------------------------------------

TEXTURED = {
    "room": (room, room, 0.15, None),
    "balls": (balls, balls, 0.15, 3),
    "blocks": (glossy_blocks, blocks, 0.1, 1),
}


@pytest.mark.parametrize("name", TEXTURED)
def test_reflected_light_is_mitsubas(name):
    """At 500 points of flat and analytic shapes, where Mitsuba's smooth normals play no part, with
    textures of every kind.

    `paths` are unbiased: z-tests at 1 % of every point and channel (Šidák), and of the means.
    `solve` interpolates between points: its bias is below 0.5 %, the reference's mean being known
    to 0.25 %. Points that see less than 5 % of other surfaces have too few paths for a Gaussian.
    """
    ours, theirs, edge_length, bounces = TEXTURED[name]
    count = 2048
    scene_ = sampled(scene(**ours()), edge_length, "cubemap:32")
    usable = np.flatnonzero(scene_.kept & (scene_.blocked > 0.05))
    index = np.sort(np.random.default_rng(0).permutation(usable)[:500])
    expected, error = by_mitsuba(theirs(), scene_.points.at(index), bounces, count, seed=1)

    samples = scene_.samples_of_paths(count, bounces, index, smooth_sky, seed=2)
    result, spread = samples.mean(axis=1), samples.std(axis=1) / count**0.5
    z = (result - expected) / np.hypot(spread, error)
    assert np.abs(z).max() < largest_z(z.size)
    assert 0.4 < np.square(z).mean() < 1.1  # below 1: the first directions are stratified
    pooled = (result - expected).sum(axis=0) / np.sqrt((spread**2 + error**2).sum(axis=0))
    assert np.abs(pooled).max() < largest_z(3)

    solved = scene_.reflected(128, bounces, smooth_sky)[index]
    assert np.linalg.norm(error.mean(axis=1)) / expected.mean(axis=1).sum() < 2.5e-3
    assert abs(bias(solved, expected)) < 5e-3
    assert relative_l2(solved, expected) < 0.08


def test_rows_of_transport_hold_what_the_paths_bring():
    """Σ_j w_j L_j T_ij over the cells of a row is the mean of what the paths bring from those
    cells; rows are linear in light.
    """
    scene_ = sampled(scene(**room()), 0.5)
    index = np.arange(0, len(scene_.points), 3)
    sampler = scene_.paths(64, None, 3, seed=4)
    rows = sampler.transport(sampler.escapes(index))
    light = (
        smooth_sky(scene_.directions.vectors.astype(float))
        * scene_.directions.solid_angles[:, None]
    )
    received = np.stack([row @ light[:, channel] for channel, row in enumerate(rows)], axis=-1)
    expected = scene_.samples_of_paths(64, None, index, smooth_sky, seed=4).mean(axis=1)
    np.testing.assert_allclose(received, expected, rtol=1e-5, atol=1e-6)
    assert all(row.data.min() >= 0 for row in rows)


# --- convergence ----------------------------------------------------------------------------------


def slope(counts, errors):
    """Of a straight line through log error over log count."""
    return np.polyfit(np.log(counts), np.log(errors), 1)[0]


def test_noise_falls_with_the_number_of_rays():
    """N^(−1/2) for the rows of `paths`, whose directions of escape nothing stratifies; irradiance
    and `solve` fall no slower.

    The error is the spread over four seeds, so it needs no reference; from 64 to 4,096 paths. Over
    hundreds of points and cells the spread is known to about 1 %, the slope to 0.005. The first
    directions of paths are stratified, which helps irradiance a little, and those of hops wholly.
    """
    scene_ = sampled(scene(**room()), 0.5)
    index = np.arange(len(scene_.points))
    lattice, direct = scene_.directions, scene_.direct(smooth_sky)
    sky = smooth_sky(lattice.vectors.astype(float))
    counts = (64, 256, 1024, 4096)
    spreads = {"rows": [], "irradiance": [], "solve": []}
    for count in counts:
        estimates = {kind: [] for kind in spreads}
        for seed in range(4):
            sampler = scene_.paths(count, None, 3, seed)
            rows = [row.toarray() for row in sampler.transport(sampler.escapes(index))]
            estimates["rows"].append(rows[0] * np.sqrt(lattice.solid_angles))
            estimates["irradiance"].append(
                np.stack([row @ (lattice.solid_angles * sky[:, c]) for c, row in enumerate(rows)])
            )
            estimates["solve"].append(scene_.reflections(scene_.hops(count, seed), direct, 3, 3))
        for kind, values in estimates.items():
            spreads[kind].append(np.sqrt(np.var(values, axis=0, ddof=1).mean()))
    slopes = {kind: slope(counts, spread) for kind, spread in spreads.items()}
    assert slopes["rows"] == pytest.approx(-0.5, abs=0.01)
    assert slopes["irradiance"] == pytest.approx(-0.5, abs=0.05)
    assert slopes["solve"] < -0.5
    assert spreads["solve"][0] < spreads["irradiance"][0]


# --- what results must not depend on --------------------------------------------------------------


def test_blocks_of_any_size_take_the_same_kernel_and_give_the_same_rows():
    """After the first block, others of any number of points compile nothing; and how they are cut
    changes no bit.

    Only a block of a single point may compile one: Dr.Jit treats arrays of one entry as constants.
    """
    scene_ = sampled(scene(**balls()), 0.4, "cubemap:8")
    basis = np.random.default_rng(0).standard_normal((len(scene_.directions), 5)).astype(np.float32)

    def hops(points):
        return scene_.hops(32, lanes=32 * points).rays

    def paths(points, seed=0):
        encode = lambda rows: (rows @ basis).astype(np.float32)
        return np.concatenate(
            list(scene_.paths(32, 3, 3, seed, encode, lanes=32 * points).blocks())
        )

    whole = hops(10_000), paths(10_000)
    with count_kernels() as kernels:
        parts = [hops(500), hops(77)], [paths(500), paths(77), paths(5)]
        others = scene_.hops(32, seed=1).rays, paths(10_000, seed=1)
    assert kernels.launched > 100 and kernels.compiled == 0
    for rows, of_blocks, other in zip(whole, parts, others):
        for part in of_blocks:
            np.testing.assert_array_equal(part, rows)
        assert (other != rows).any()


@pytest.mark.parametrize("indirect", ["solve", "paths"])
def test_points_and_seeds_have_rays_of_their_own(indirect):
    """No two points of a wall share the random numbers of their rays, and no two seeds do, however
    large.
    """
    scene_ = sampled(scene(**room()), 0.5)

    def traced(seed):
        if indirect == "solve":
            return scene_.hops(64, seed).rays
        return scene_.paths(64, seed=seed).escapes(np.arange(len(scene_.points)))[0]

    one, two, three = (traced(seed) for seed in (0, 1, 2**70 + 5))
    assert (one != two).any(axis=1).all() and (one != three).any(axis=1).all()
    assert len(np.unique(one, axis=0)) == len(one)


def test_errors_of_neighbours_are_independent():
    """The mean of n independent estimates has an n-th of their variance: χ² test at 1 % over 24
    seeds, on one wall.

    First directions that are stratified alike at all points pass every test of single points, and
    fail this one.
    """
    scene_ = sampled(scene(**room()), 0.25)
    wall = np.flatnonzero(scene_.points.surface == 1)
    estimates = np.array(
        [scene_.samples_of_paths(64, 3, wall, seed=seed)[..., 0].mean(axis=1) for seed in range(24)]
    )
    ratio = estimates.mean(axis=1).var(ddof=1) / (estimates.var(axis=0, ddof=1).mean() / len(wall))
    low, high = scipy.stats.chi2.interval(1 - FALSE_POSITIVES, 23)
    assert low < 23 * ratio < high


# --- noise taken out ------------------------------------------------------------------------------


def halves_of(signal, noise, seed):
    """Two estimates (1, n, m) of a signal (n, m) with white noise of their own."""
    rng = np.random.default_rng(seed)
    return [
        (signal + noise * rng.standard_normal(signal.shape)).astype(np.float32)[None]
        for _ in range(2)
    ]


def low_rank(points, components, seed):
    """A signal (points, components) of rank 4 in no basis in particular, with singular values 8, 4,
    2, 1 for each point.
    """
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.standard_normal((components, 4)))[0].T
    return rng.standard_normal((points, 4)) * [
        8.0,
        4.0,
        2.0,
        1.0,
    ] @ directions + rng.standard_normal(components)


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_filter_comes_near_to_the_best_linear_one(noise):
    """Of a signal with variances λ and noise of variance ν in the mean, no linear filter errs less
    than Σ λν/(λ + ν) (Wiener).

    Unfiltered the error is mν. The filter must learn both variances from 4,000 points, of which it
    needs 16²: 10 % are allowed. It tells the noise it found and let through; those are known within
    a few per cent.
    """
    n, m = 4000, 16
    signal = low_rank(n, m, seed=0)
    nu = noise**2 / 2
    variances = np.array([64.0, 16, 4, 1])
    best = np.sum(variances * nu / (variances + nu))
    plain, size, passed = combined(halves_of(signal, noise, 1), np.ones(n, bool), denoise=False)
    assert passed == 1 and size == pytest.approx(np.sqrt(n * m * nu), rel=0.02)
    filtered, same_size, passed = combined(halves_of(signal, noise, 1), np.ones(n, bool))
    errors = [np.mean(np.sum((x[0] - signal) ** 2, axis=1)) for x in (plain, filtered)]
    assert errors[0] == pytest.approx(m * nu, rel=0.03)
    assert 0.95 * best < errors[1] < 1.1 * best and errors[1] < 0.5 * errors[0]
    assert same_size == size
    assert passed == pytest.approx(np.sum((variances / (variances + nu)) ** 2) / m, rel=0.1)


def test_filter_leaves_alone_what_has_no_noise():
    """Equal halves come out bit for bit; and so, to rounding, does a quantity on which halves with
    noise elsewhere agree.
    """
    signal = low_rank(500, 12, seed=3)
    (half, _), kept = halves_of(signal, 0.0, 4), np.ones(500, bool)
    mean, size, passed = combined([half.copy(), half.copy()], kept)
    np.testing.assert_array_equal(mean, half)
    assert size == 0 and passed == 1

    rng = np.random.default_rng(5)
    agreed = rng.standard_normal(12)
    agreed /= np.linalg.norm(agreed)
    halves = halves_of(signal, 3.0, 6)
    for half in halves:
        half[0] += np.outer((signal - half[0]) @ agreed, agreed).astype(np.float32)
    filtered, *_ = combined(halves, kept)
    np.testing.assert_allclose(filtered[0] @ agreed, signal @ agreed, atol=2e-4)
    assert np.mean(np.square(filtered[0] - signal)) < 0.5 * 3.0**2 / 2


def test_points_left_out_do_not_teach_the_filter():
    """Buried points of any content change nothing for the others."""
    signal = low_rank(500, 12, seed=3)
    kept = np.arange(500) < 400
    clean = combined(halves_of(signal, 1.0, 7), kept)[0]
    halves = halves_of(signal, 1.0, 7)
    for half in halves:
        half[0, ~kept] = 1e4
    np.testing.assert_array_equal(combined(halves, kept)[0][:, kept], clean[:, kept])
