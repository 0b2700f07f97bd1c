"""Light that is reflected between surfaces, against answers that no code of mi_prt computes:
furnaces, closed forms, conservation.

Irradiance itself takes the place of coefficients in most tests (`conftest.SampledScene`): a basis
has no part in them.
"""

from itertools import pairwise

import numpy as np
import pytest
import scipy.stats
from conftest import (
    FALSE_POSITIVES,
    NOTHING,
    arrays_of,
    bias,
    cube,
    diffuse,
    distant,
    facing,
    largest_z,
    mesh,
    rectangle,
    relative_l2,
    sampled,
    scene,
    sphere,
    uniform_sky,
)

import mi_prt
from mi_prt.transport.interreflection import split_by_bounces

ROUNDING = 3e-5  # of irradiance: float32, and the tolerance 1e-5 of the solver


TOWARD = {
    "floor": (0, 1, 0),
    "left": (1, 0, 0),
    "right": (-1, 0, 0),
    "back": (0, 0, 1),
    "roof": (0, -1, 0),
    "front": (0, 0, -1),
}


def two_sided(bsdf):
    return {"type": "twosided", "nested": bsdf}


def walls(bsdf, names=("floor", "left", "right", "back"), size=1.0):
    """Squares around the origin that face it: a box, open to +y and +z unless `roof` and `front`
    are among the names.
    """
    return {
        name: rectangle(TOWARD[name], -size * np.array(TOWARD[name]), size, bsdf=bsdf)
        for name in names
    }


def globe(rows, opening=0.0, columns=None):
    """Vertices (v, 3) on the unit sphere in rows of latitude from `opening` (an angle from +y) to
    −y, and faces, outward.
    """
    theta, columns = np.linspace(opening, np.pi, rows + 1), columns or 2 * rows
    phi = np.arange(columns) * 2 * np.pi / columns
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    vertices = np.stack(
        [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1
    ).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rows) * columns, np.arange(columns), indexing="ij")
    across = (column + 1) % columns
    a, b, c, d = (
        x.ravel()
        for x in (row + column, row + across, row + columns + column, row + columns + across)
    )
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([b, d, c], axis=-1)])
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return vertices, faces[area > 1e-9]


def torus(rings=24, sides=12, radius=0.4):
    """Vertices, faces and normals of a torus about y whose tube is round."""
    u, v = np.meshgrid(
        np.arange(rings) * 2 * np.pi / rings, np.arange(sides) * 2 * np.pi / sides, indexing="ij"
    )
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(v), np.sin(u) * np.cos(v)], axis=-1).reshape(
        -1, 3
    )
    ring = np.stack([np.cos(u), 0 * u, np.sin(u)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b, c, d = (
        (((i + k) % rings) * sides + (j + m) % sides).ravel()
        for k, m in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([b, d, c], axis=-1)])
    return ring + radius * normals, faces, normals


def furnace(name):
    """Concave scenes of white surfaces, no face of which shows the sky its back."""
    bsdf = diffuse(1.0)
    if name == "open box":
        return scene(**walls(two_sided(bsdf))), 0.5
    if name == "cube on a floor":
        return (
            scene(floor=rectangle(size=2, bsdf=bsdf), box=cube((0, 0.5, 0), 0.5, bsdf=bsdf)),
            0.25,
        )
    if name == "smooth ball on a floor":  # eight columns: normals are up to 20° off the faces
        vertices, faces = globe(6, columns=8)
        return (
            scene(
                floor=rectangle(size=2, bsdf=bsdf),
                ball=mesh(vertices + [0, 1, 0], faces, vertices, bsdf),
            ),
            0.4,
        )
    return scene(ring=mesh(*torus(), bsdf)), 10.0


FURNACES = ("open box", "cube on a floor", "smooth ball on a floor", "torus")


@pytest.fixture(scope="module", params=FURNACES)
def white_furnace(request):
    return sampled(*furnace(request.param))


def quadrature_error(scene):
    """Largest error of Σ w max(0, n·ω)/π, which must be 1, over the normals of a scene's points."""
    cosines = np.maximum(
        scene.points.normals.astype(float) @ scene.directions.vectors.astype(float).T, 0
    )
    return np.abs(cosines @ scene.directions.solid_angles / np.pi - 1).max()


# --- white furnace --------------------------------------------------------------------------------


def test_white_surfaces_under_a_white_sky_vanish(white_furnace):
    """Albedo 1 and radiance 1 from all around: outgoing radiance is 1 everywhere, whatever the
    scene.

    What a point sees of the sky errs by the lattice's quadrature, and no average of other points
    errs more. That holds for each single set of rays, however few, so that there is no noise to
    allow for; and with less than all reflections it is the upper bound.
    """
    assert white_furnace.blocked.max() > 0.3
    bound = quadrature_error(white_furnace) + ROUNDING
    assert bound < 1e-3
    direct, hops = white_furnace.direct(), white_furnace.hops(32)
    radiance = [direct[:, 0] / np.pi]
    for bounces in (1, 2, 4, 8, 32, None):
        radiance.append(
            (direct + white_furnace.reflections(hops, direct, 1, bounces)[0])[:, 0] / np.pi
        )
    for fewer, more in pairwise(radiance[:-1]):
        assert (more >= fewer).all() and more.max() < 1 + bound
    np.testing.assert_allclose(radiance[-1][white_furnace.kept], 1, atol=bound)
    # The series has a geometric tail; after 32 reflections it is done at all points but those that
    # hardly any light reaches.
    assert np.median(np.abs(radiance[-2] - radiance[-1])[white_furnace.kept]) < ROUNDING


def test_white_surfaces_vanish_by_paths_too(white_furnace):
    """The same of path tracing, which has noise: every point's z-value and that of the mean, each
    at 1 % in all (Šidák).

    The first directions are stratified, so that the spread of single paths overstates the noise.
    Points of which less than 5 % is blocked are too few paths for a Gaussian.
    """
    index = np.flatnonzero(white_furnace.kept & (white_furnace.blocked > 0.05))
    count = 256
    samples = white_furnace.samples_of_paths(count, None, index)[..., 0] / np.pi
    radiance = white_furnace.direct()[index, 0] / np.pi + samples.mean(axis=1)
    error = np.hypot(samples.std(axis=1) / count**0.5, quadrature_error(white_furnace))
    assert np.abs((radiance - 1) / error).max() < largest_z(len(index))
    assert abs(radiance.mean() - 1) < largest_z(1) * np.linalg.norm(error) / len(
        index
    ) + quadrature_error(white_furnace)


@pytest.mark.parametrize("denoise", [True, False])
def test_asset_of_a_white_furnace(denoise):
    """With all the components there are nothing is lost: the asset itself relights to 1, and never
    to more.

    What `auto` leaves out of the series is missing in the mean, no more than it reports. The filter
    keeps what both halves of the rays agree on, and they agree on this.
    """
    parts = scene(**walls(diffuse(1.0)))
    scene_ = sampled(parts, 1.0)
    components = len(scene_.points) - 1
    asset = mi_prt.precompute(
        parts,
        directions="cubemap:16",
        edge_length=1.0,
        coefficients=components,
        paths_per_point=32,
        denoise=denoise,
    )
    bound = quadrature_error(scene_) + ROUNDING
    report = distant(asset).report
    assert report["relative_error"] < 2e-4 and 0 < report["bounce_energy_left"] < 1e-3
    radiance = asset.relight(uniform_sky())[:, 0]
    assert radiance.min() > 0.98 and radiance.max() < 1 + bound + 2e-4
    assert 1 - report["bounce_energy_left"] - bound < radiance @ scene_.shares < 1


# --- surfaces without reflection ------------------------------------------------------------------

NOTHING_REFLECTED = {
    "black surfaces": lambda: scene(**walls(two_sided(diffuse(0.0)))),
    "a plane": lambda: scene(plane=rectangle((1, 2, 0), bsdf=diffuse(0.9))),
    "a ball": lambda: scene(ball=sphere(bsdf=diffuse(0.9))),
    "backs that do not reflect": lambda: scene(
        floor=rectangle(), roof=rectangle((0, 1, 0), (0, 1, 0))
    ),
}


@pytest.mark.parametrize("name", NOTHING_REFLECTED)
def test_what_reflects_nothing_to_any_point_is_direct_light_bit_for_bit(name, tmp_path):
    """Not even rounding may tell that reflections were asked for: coefficients, basis and all
    arrays of the file are the same.
    """
    files = {}
    for indirect, bounces in (
        ("solve", 0),
        ("solve", 3),
        ("solve", "auto"),
        ("paths", 3),
        ("paths", "auto"),
    ):
        path = files[indirect, bounces] = tmp_path / f"{indirect}-{bounces}.prt"
        settings = dict(bounces=bounces, indirect=indirect, paths_per_point=64)
        asset = mi_prt.precompute(
            NOTHING_REFLECTED[name](),
            directions="cubemap:8",
            edge_length=0.5,
            output=path,
            **settings,
        )
        report = distant(asset).report
        assert report["bounces"] == 0 and report["channels"] == 1
        assert len(report["bounce_energy"]) == 1
    expected = arrays_of(files.pop(("solve", 0)))
    for path in files.values():
        found = arrays_of(path)
        assert found.keys() == expected.keys()
        for key, values in expected.items():
            np.testing.assert_array_equal(found[key], values, err_msg=f"{path.name} {key}")


@pytest.mark.parametrize("indirect", ["solve", "paths"])
def test_brighter_surfaces_reflect_more(indirect):
    """The same rays at any albedo: irradiance rises with it at every point, from almost none to
    almost white.

    Two reflections at most: the third may end paths by chance, in proportion to albedo, and would
    give them other rays.
    """
    results = []
    for albedo in (1e-6, 0.1, 0.5, 0.999):
        room = sampled(scene(**walls(diffuse(albedo))), 0.5, "cubemap:8")
        every = np.arange(len(room.points))
        if indirect == "solve":
            results.append(room.reflected(32, 2)[:, 0])
        else:
            results.append(room.samples_of_paths(64, 2, every).mean(axis=1)[:, 0])
        assert np.isfinite(results[-1]).all() and (results[-1] > 0).all()
    for darker, brighter in pairwise(results):
        assert (darker < brighter).all()
    once = results[0] / 1e-6
    assert (once < np.pi).all() and once.mean() > 0.3
    # At this albedo the second reflection is a millionth of the first, and the first is linear in
    # it.
    assert (results[1] > 0.1 * once * (1 - 1e-5)).all()


# --- closed forms ---------------------------------------------------------------------------------

OPENING = np.radians(60)  # polar angle of the cavity's mouth
SHARE = (1 - np.cos(OPENING)) / 2  # of the sphere's area


def cavity(rows, albedo):
    """A sphere with its cap cut away, smooth and facing inward, in front of a lattice that is
    refined with it.
    """
    vertices, faces = globe(rows, OPENING, 3 * rows)
    return sampled(
        scene(bowl=mesh(vertices, faces[:, ::-1], -vertices, diffuse(albedo))),
        10.0,
        f"cubemap:{2 * rows}",
    )


@pytest.mark.parametrize("albedo", [0.3, 0.9])
def test_spherical_cavity(albedo):
    """Within a sphere every part receives the same from every other: irradiance is uniform and its
    series geometric.

    Of what any point sees, the open cap is its share f of the sphere's area, the rest 1 − f
    reflects: E = π f Σ_j (ρ(1 − f))^j, in all π f/(1 − ρ(1 − f)). The second mesh and lattice are
    twice as fine. The mesh's flats err by O(h²): the error of the mean falls fourfold (at least
    threefold here), the spread, which has the lattice's staircase at the mouth in it, at least
    twice.
    """
    ratio = albedo * (1 - SHARE)
    errors = {}
    for rows in (8, 16):
        bowl = cavity(rows, albedo)
        direct, hops = bowl.direct(), bowl.hops(64)
        for bounces in (0, 1, 3, None):
            irradiance = (
                direct if bounces == 0 else direct + bowl.reflections(hops, direct, 1, bounces)[0]
            )
            expected = (
                np.pi
                * SHARE
                * ((1 - ratio ** (bounces + 1)) if bounces is not None else 1)
                / (1 - ratio)
            )
            error = irradiance[:, 0] / expected - 1
            errors[rows, bounces] = abs(error @ bowl.shares), np.sqrt(error**2 @ bowl.shares)
    for bounces in (0, 1, 3, None):
        mean, spread = errors[16, bounces]
        assert mean < 2e-3 and spread < 8e-3
        assert mean < errors[8, bounces][0] / 3 and spread < errors[8, bounces][1] / 2


def test_spherical_cavity_by_paths():
    """The same series by paths: z-tests of the means over all points after 1, 2 and 3 reflections
    and of their sum (Šidák).

    Beside 2e-3 for the mesh.
    """
    albedo, count = 0.9, 1024
    bowl = cavity(16, albedo)
    ratio = albedo * (1 - SHARE)
    limit = largest_z(4)
    cell, throughput, reflections = bowl.paths(count, seed=3).escapes(np.arange(len(bowl.points)))
    carried = np.where(cell == NOTHING, 0, throughput[..., 0])
    for which, expected in [(reflections == k, SHARE * ratio**k) for k in (1, 2, 3)] + [
        (True, SHARE * ratio / (1 - ratio))
    ]:
        samples = np.where(which, carried, 0)
        error = np.linalg.norm(samples.std(axis=1) / count**0.5 * bowl.shares)
        assert error < 5e-3 * expected
        assert abs(samples.mean(axis=1) @ bowl.shares - expected) < limit * error + 2e-3 * expected


# so that no edge runs along the lattice's
TILT = np.array([0.3, 1, 0.2]) / np.linalg.norm([0.3, 1, 0.2])


def element_to_rectangle(x, y, height):
    """View factor of a parallel rectangle [−1, 1]² from surface elements below (x, y) (Howell's
    catalogue, B-3, four corners).
    """
    total = 0.0
    for a in ((1 - x) / height, (1 + x) / height):
        for b in ((1 - y) / height, (1 + y) / height):
            one, two = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
            total = total + (a / one * np.arctan(b / one) + b / two * np.arctan(a / two)) / (
                2 * np.pi
            )
    return total


def plates_by_quadrature(places, height, own, other, bounces, nodes=20):
    """Irradiance (k,) at places (k, 2) of one of two parallel squares [−1, 1]² under a uniform sky,
    by the radiosity equation.

    Nyström's method: Gauss–Legendre nodes on both plates, E = E₀ + K E solved there, and the same
    equation as the interpolant. The kernel is analytic, so that twenty nodes a side are exact to
    1e-9.
    """
    node, weight = np.polynomial.legendre.leggauss(nodes)
    x, y = (grid.ravel() for grid in np.meshgrid(node, node))
    weights = np.outer(weight, weight).ravel()

    def kernel(at_x, at_y):
        squared = (at_x[:, None] - x) ** 2 + (at_y[:, None] - y) ** 2 + height**2
        return height**2 / (np.pi * squared**2) * weights

    def direct(at_x, at_y):
        return np.pi * (1 - element_to_rectangle(at_x, at_y, height))

    k, zero = kernel(x, y), np.zeros((len(x), len(x)))
    # this plate's irradiance, and the other one's
    operator = np.block([[zero, other * k], [own * k, zero]])
    emitted = np.tile(direct(x, y), 2)
    if bounces is None:
        irradiance = np.linalg.solve(np.eye(2 * len(x)) - operator, emitted)
    else:
        term = irradiance = emitted
        for _ in range(bounces - 1):
            term = operator @ term
            irradiance = irradiance + term
    return direct(*places.T) + other * kernel(*places.T) @ irradiance[len(x) :]


def two_plates(edge_length):
    """Two squares of albedo 0.8 and 0.5 that face each other at 1 m, and the places (n, 2) of their
    points.
    """
    parts = scene(
        floor=rectangle(TILT, bsdf=diffuse(0.8)), roof=rectangle(-TILT, TILT, bsdf=diffuse(0.5))
    )
    axes = np.array(facing(TILT).matrix)[:3, :2]
    plates = sampled(parts, edge_length, "cubemap:32", rays_per_direction=4)
    return plates, plates.points.positions.astype(float) @ axes


@pytest.fixture(scope="module")
def plates():
    return two_plates(0.25)


@pytest.mark.parametrize("bounces", [1, 2, None])
def test_two_parallel_plates(plates, bounces):
    """Radiosity between two squares, solved by another method to many digits, at each point of
    both.

    Interpolation between points 0.25 m apart is what is left in `solve` (h²/12 of the irradiance's
    curvature: some 1e-3); `paths` have noise only, a z-test at 1 % over all points (Šidák).
    """
    scene_, places = plates
    direct, indirect = scene_.direct()[:, 0], scene_.reflected(256, bounces)[:, 0]
    samples = scene_.samples_of_paths(1024, bounces, np.arange(len(places)), seed=1)[..., 0]
    for plate, (own, other) in enumerate([(0.8, 0.5), (0.5, 0.8)]):
        here = scene_.points.surface == plate
        expected = plates_by_quadrature(places[here], 1.0, own, other, bounces)
        assert (
            relative_l2(
                expected, plates_by_quadrature(places[here], 1.0, own, other, bounces, nodes=28)
            )
            < 1e-9
        )
        assert relative_l2(direct[here] + indirect[here], expected) < 2e-3
        assert abs(bias(direct[here] + indirect[here], expected)) < 1e-3
        reflected = expected - np.pi * (1 - element_to_rectangle(*places[here].T, 1.0))
        assert (
            relative_l2(indirect[here], reflected) < 0.01
            and abs(bias(indirect[here], reflected)) < 5e-3
        )
        z = (samples[here].mean(axis=1) - reflected) / (samples[here].std(axis=1) / 1024**0.5)
        assert np.abs(z).max() < largest_z(len(z))


def test_light_between_points_is_interpolated_linearly():
    """What varies linearly over a plate is gathered as it is, however few points it has: here nodes
    1 m apart, a square's half.

    The reference is the integral ∫ ρ g(y) K(x, y) dy by Gauss–Legendre quadrature. A nearest point,
    or any one corner, is off by tenths.
    """
    plates, places = two_plates(1.0)
    hops = plates.hops(1024)
    node, weight = np.polynomial.legendre.leggauss(20)
    x, y = (grid.ravel() for grid in np.meshgrid(node, node))
    kernel = (
        1
        / (np.pi * ((places[:, :1] - x) ** 2 + (places[:, 1:] - y) ** 2 + 1) ** 2)
        * np.outer(weight, weight).ravel()
    )
    albedo = np.where(plates.points.surface == 0, 0.5, 0.8)  # of the other plate
    for slope in ((1, 0), (0, 1), (-0.7, 0.4)):
        linear = (1.5 + places @ slope).astype(np.float32)
        found = hops.apply(linear[None, :, None])[0, :, 0]
        expected = albedo * (kernel @ (1.5 + slope[0] * x + slope[1] * y))
        assert relative_l2(found, expected) < 0.015 and abs(bias(found, expected)) < 5e-3


# --- conservation ---------------------------------------------------------------------------------


def test_exchange_between_a_ball_and_walls_is_reciprocal():
    """With one albedo, the flux that f receives of g's light is the flux that g receives of f's: Σ
    aᵢfᵢ(Ag)ᵢ = Σ aᵢgᵢ(Af)ᵢ.

    f lives on a ball, g on the walls around it. The ball's points are many times denser, so that
    without areas the sides differ by far. z-test at 1 % against the spread over eight seeds, beside
    0.5 % for sums over points in place of integrals.
    """
    radius = 0.3
    room = sampled(
        scene(**walls(diffuse(0.7)), ball=sphere((0.2, -0.4, 0.1), radius, bsdf=diffuse(0.7))),
        0.2,
        "cubemap:32",
    )
    points, ball = room.points, room.points.surface == 4
    f = np.where(ball, np.exp(points.positions[:, 0]), 0)
    g = np.where(ball, 0, np.exp(-2 * points.positions[:, 1]))
    areas = points.areas.astype(float)
    # the flat triangles between its points have less
    areas[ball] *= 4 * np.pi * radius**2 / areas[ball].sum()
    sides, plain = [], []
    for seed in range(8):
        hops = room.hops(256, seed)
        of_g, of_f = (hops.apply(h.astype(np.float32)[None, :, None])[0, :, 0] for h in (g, f))
        sides.append((areas * f @ of_g, areas * g @ of_f))
        plain.append((f @ of_g, g @ of_f))
    one, other = np.array(sides).T
    limit = scipy.stats.t.isf(FALSE_POSITIVES / 2, 7) * (one - other).std(ddof=1) / 8**0.5
    assert limit < 0.01 * one.mean()
    assert abs(one.mean() - other.mean()) < limit + 5e-3 * one.mean()
    assert not 0.5 < np.divide(*np.mean(plain, axis=0)) < 2


@pytest.fixture(scope="module")
def coloured_room():
    """An open box of coloured walls, and a red cube on its floor."""
    colours = dict(
        floor=[0.8, 0.8, 0.7], left=[0.7, 0.2, 0.1], right=[0.2, 0.6, 0.2], back=[0.85, 0.85, 0.85]
    )
    parts = {
        name: wall for name in colours for wall in [walls(diffuse(colours[name]), (name,))[name]]
    }
    return sampled(scene(**parts, box=cube((0, -0.7, 0), 0.3, bsdf=diffuse([0.8, 0.1, 0.1]))), 0.2)


def test_energy_falls_with_every_reflection(coloured_room):
    """Flux: what all surfaces receive after one more reflection is at most the largest albedo times
    what they received before.

    And no row of transport holds more than π: no point receives more than under an open sky, at any
    number of reflections.
    """
    hops, direct = coloured_room.hops(128), coloured_room.direct()
    assert hops.largest_albedo() == pytest.approx(0.85)
    split = split_by_bounces(hops, 1 - coloured_room.blocked, coloured_room.shares, 3)
    energy = np.array(split.energy)
    assert 3 < split.bounces < 20 and split.left < 1e-3 * energy.sum()
    assert (energy[1:] <= 0.85 * energy[:-1]).all() and (energy > 0).all()
    bound = np.pi * (1 + quadrature_error(coloured_room) + ROUNDING)
    for bounces in (1, 3, None):
        assert (direct + coloured_room.reflections(hops, direct, 3, bounces)).max() < bound
    # What `left` bounds is more than what all further reflections bring, and not hundreds of times
    # as much.
    rest = (1 - coloured_room.blocked) @ coloured_room.shares
    all_reflections = coloured_room.reflections(hops, 1 - coloured_room.blocked[:, None], 3, None)[
        ..., 0
    ]
    rest += (all_reflections @ coloured_room.shares).mean() - energy.sum()
    assert 0 < rest < split.left < 20 * rest


def test_both_ways_find_the_same_energy_after_each_reflection(coloured_room):
    """`bounce_energy` of `solve` and of `paths`: z-tests at 1 % (Šidák) of four reflections, beside
    0.5 % for interpolation.
    """
    kept = coloured_room.kept
    split = split_by_bounces(
        coloured_room.hops(256), 1 - coloured_room.blocked, coloured_room.shares, 3, 4
    )
    _, throughput, reflections = coloured_room.paths(512, 4, 3).escapes(np.flatnonzero(kept))
    limit = largest_z(4)
    for k in range(1, 5):
        samples = np.where(reflections == k, throughput.mean(axis=-1), 0)
        error = np.linalg.norm(samples.std(axis=1) / 512**0.5 * coloured_room.shares[kept])
        assert error < 0.015 * split.energy[k]
        assert (
            abs(samples.mean(axis=1) @ coloured_room.shares[kept] - split.energy[k])
            < limit * error + 5e-3 * split.energy[k]
        )


# --- walls ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("indirect", ["solve", "paths"])
def test_no_light_leaks_into_a_closed_box(indirect):
    """Six two-sided squares edge to edge: inside it is dark after any number of reflections,
    outside nothing is reflected.
    """
    parts = scene(**walls(two_sided(diffuse(0.9)), TOWARD))
    asset = mi_prt.precompute(
        parts, directions="cubemap:16", edge_length=0.4, indirect=indirect, paths_per_point=128
    )
    outward = np.sum(asset.points.positions * asset.points.normals, axis=1) > 0
    assert 0.4 < outward.mean() < 0.6 and not asset.buried.any()
    irradiance = asset.irradiance(uniform_sky())
    assert np.abs(irradiance[~outward]).max() < 1e-4
    np.testing.assert_allclose(irradiance[outward], np.pi, rtol=2e-3)
    assert distant(asset).report["bounces"] == 0


@pytest.mark.parametrize("backs_reflect", [False, True])
def test_backs_reflect_where_they_are_two_sided(backs_reflect):
    """A floor below a roof of the same size, and a wide floor far below: what the roof's back
    reflects is all there is.

    The roof faces up; only where it is two-sided does it return light to the floor. `paths` and
    `solve` agree on both.
    """
    roof = two_sided(diffuse(0.9)) if backs_reflect else diffuse(0.9)
    room = sampled(
        scene(floor=rectangle(bsdf=diffuse(0.5)), roof=rectangle((0, 1, 0), (0, 1, 0), bsdf=roof)),
        0.25,
    )
    floor = room.points.surface == 0
    solved = room.reflected(64, 1)[floor, 0]
    traced = room.samples_of_paths(256, 1, np.flatnonzero(floor))[..., 0].mean(axis=1)
    if backs_reflect:
        assert solved.min() > 0.1 and bias(solved, traced) == pytest.approx(0, abs=0.02)
    else:
        assert not solved.any() and not traced.any()
