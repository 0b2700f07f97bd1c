"""Light of a scene's own lamps at its points: against closed forms, and against Mitsuba."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import bias, diffuse, facing, largest_z, mesh, rectangle, relative_l2, scene, sphere

from mi_prt.errors import LightError, SettingsError
from mi_prt.evaluate import ground_truth
from mi_prt.points.points import sample_points
from mi_prt.points.samples import scatter_points
from mi_prt.precompute.workspace import RowFile
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import count_kernels, mitsuba
from mi_prt.transport.bits import find_buried
from mi_prt.transport.lamp_reflections import reflected_light
from mi_prt.transport.lamps import direct_light
from mi_prt.transport.sequences import scrambled_place, shuffled


def lamp(radiance=1.0):
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def light_bulb(position, intensity=1.0):
    return {
        "type": "point",
        "position": list(map(float, position)),
        "intensity": {"type": "rgb", "value": intensity},
    }


class Lit:
    """A scene, its points, and the light of its lamps."""

    def __init__(self, parts, edge_length):
        self.scene = open_scene(parts)
        self.emitters = self.scene.local_emitters
        self.points = sample_points(self.scene, edge_length)
        self.buried = find_buried(self.scene, self.points, np.ones(len(self.points), bool))

    def on(self, name):
        """Indices of the points of a surface that are not buried."""
        number = [s.name for s in self.scene.surfaces].index(name)
        return np.flatnonzero((self.points.surface == number) & ~self.buried)

    def direct(self, **options):
        return direct_light(self.scene, self.points, self.emitters, **options)

    def reflected(self, direct=None, **options):
        direct = self.direct() if direct is None else direct
        picker = replace(self.points, buried=self.buried).locator(self.scene)
        return reflected_light(
            self.scene,
            self.points,
            self.buried,
            self.emitters,
            direct.irradiance,
            picker,
            **options,
        )


# --- sequences ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_places_are_one_in_each_elementary_interval(seed):
    """Owen's scrambling keeps the net property of Sobol's sequence: each of the 64 intervals of any
    of the seven shapes of area 1/64 holds one of the first 64 places, and of the next 64.
    """
    import drjit as dr

    mi = mitsuba()
    for first in (0, 64):
        number = dr.arange(mi.UInt32, 64) + first
        places = np.array(scrambled_place(number, mi.UInt32(seed))).T
        assert (places >= 0).all() and (places < 1).all()
        for power in range(7):
            cells = np.floor(places * [2**power, 2 ** (6 - power)])
            assert len(np.unique(cells, axis=0)) == 64


def test_sequences_are_uniform_and_independent():
    """The first place of 2¹⁶ sequences: mean ½, variance 1/12, no correlation, within 5 standard
    errors (6e-7 of false positives each).
    """
    import drjit as dr

    mi = mitsuba()
    seeds = dr.arange(mi.UInt32, 1 << 16)
    places = np.array(scrambled_place(dr.zeros(mi.UInt32, 1 << 16), seeds)).T.astype(float)
    error = 5 / 256
    assert np.abs(places.mean(axis=0) - 0.5).max() < error * 12**-0.5
    assert np.abs(12 * places.var(axis=0) - 1).max() < error * 0.8**0.5
    assert abs(np.corrcoef(places.T)[0, 1]) < error
    order = np.array(shuffled(dr.arange(mi.UInt32, 16), mi.UInt32(3)))
    assert sorted(order % 16) == list(range(16))


# --- direct light, closed forms -------------------------------------------------------------------


def test_bulb_over_a_plane():
    """I cos θ/r², by one ray without noise: to rounding."""
    lit = Lit(
        scene(floor=rectangle(size=2, bsdf=diffuse()), bulb=light_bulb((0.3, 1, 0.2), 5)), 0.5
    )
    result = lit.direct()
    away = np.array([0.3, 1, 0.2]) - lit.points.positions
    expected = 5 / (away**2).sum(axis=1) ** 1.5
    assert result.irradiance.shape == (len(lit.points), 1, 3)
    assert np.allclose(
        result.irradiance[:, 0], expected[:, None], rtol=3e-4
    )  # 1e-4 m off the plane
    assert (result.standard_error == 0).all() and result.rays == len(lit.points)


def parallel_rectangle(x, z, height, side):
    """Form factor of a square of half side `side` at a height over a point of a parallel plane, by
    the sum over its corners (Howell, configuration B-3).
    """

    def corner(a, b):
        a, b = a / height, b / height
        p, q = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
        return (a / p * np.arctan(b / p) + b / q * np.arctan(a / q)) / (2 * np.pi)

    return sum(corner(side + i * x, side + j * z) for i in (1, -1) for j in (1, -1))


@pytest.mark.parametrize("height", [0.01, 0.1, 1.0])
def test_square_lamp_over_a_plane(height):
    """π L F, at 1/200 of the lamp's width too, where samples of the lamp alone have no bound.

    The error aimed at is 1 % at each point: the whole is below 1 %, and the mean over some hundred
    points below 0.3 %. (Beside the lamp's rim, where 1,024 samples do not suffice, it is 5 %.)
    """
    lit = Lit(
        scene(
            floor=rectangle(size=1.5, bsdf=diffuse()),
            lamp=rectangle(
                (0, -1, 0), (0, height, 0), 1.0, emitter=lamp([1, 2, 3]), bsdf=diffuse()
            ),
        ),
        0.15,
    )
    result = lit.direct()
    floor = lit.on("floor")
    x, _, z = lit.points.positions[floor].T.astype(float)
    offset = 2e-5 * lit.scene.scale  # where rays start
    factor = parallel_rectangle(x, z, height - offset, 1.0)
    expected = np.pi * factor[:, None] * [1, 2, 3]
    inside = factor > 0.02  # the error of less is measured against the mean
    assert inside.sum() > 100
    assert relative_l2(result.irradiance[floor, 0][inside], expected[inside]) < 0.01
    assert abs(bias(result.irradiance[floor, 0][inside], expected[inside])) < 0.003
    # a flat lamp does not light itself, on either side
    assert (result.irradiance[lit.on("lamp")] == 0).all()
    assert result.noise(lit.points.areas)[0] < 0.015


def test_ball_lamp():
    """π L (R/d)² cos θ wherever the whole ball is above the horizon; Mitsuba samples its cone
    evenly, so that only the cosine has noise.
    """
    lit = Lit(
        scene(
            floor=rectangle(size=2, bsdf=diffuse()),
            ball=sphere((0, 1, 0), 0.5, emitter=lamp(2), bsdf=diffuse()),
        ),
        0.4,
    )
    floor = lit.on("floor")
    away = np.array([0, 1, 0]) - lit.points.positions[floor]
    distance = np.linalg.norm(away, axis=1)
    expected = 2 * np.pi * 0.25 / distance**3
    result = lit.direct(tolerance=1e-3)
    assert np.allclose(result.irradiance[floor, 0, 0], expected, rtol=0.01)
    assert abs(bias(result.irradiance[floor, 0, 0], expected)) < 0.002
    # a ball is convex: no point of it sees another
    assert (result.irradiance[lit.on("ball")] == 0).all()


def test_shadow_is_where_it_must_be():
    """A disk over a plane under a bulb: points inside the cone are dark, those outside are not."""
    lit = Lit(
        scene(
            floor=rectangle(size=2, bsdf=diffuse()),
            blocker=rectangle((0, 1, 0), (0, 1, 0), 0.5, bsdf=diffuse()),
            bulb=light_bulb((0, 2, 0)),
        ),
        0.15,
    )
    floor = lit.on("floor")
    reach = np.abs(lit.points.positions[floor][:, ::2]).max(axis=1)
    lit_points = lit.direct().irradiance[floor, 0, 0] > 0
    assert not lit_points[reach < 0.999].any() and lit_points[reach > 1.001].all()


@pytest.mark.parametrize("kind", ["constant", "directionalarea"])
def test_lamps_that_cannot_be_sampled_are_refused(kind):
    parts = scene(floor=rectangle(bsdf=diffuse()))
    if kind == "constant":
        parts["sky"] = {"type": "constant"}
    else:
        parts["lamp"] = rectangle((0, -1, 0), (0, 1, 0), emitter={"type": kind}, bsdf=diffuse())
    lit = Lit(parts, 1.0)
    with pytest.raises(LightError, match="distant|one direction"):
        direct_light(lit.scene, lit.points, lit.scene.mi_scene.emitters())


# --- reflections, closed forms --------------------------------------------------------------------


@pytest.mark.parametrize("bounces", [0, 1, 2, None])
def test_bulb_in_a_white_ball(bounces):
    """E₀ = I/R² at every point, and the same times ρ after each reflection: nothing varies, so that
    there is no noise. Two values are not exact: light of the bulb is averaged over footprints,
    which takes away less than 1e-3, and `auto` leaves out 1e-3.
    """
    albedo, radius = 0.6, 2.0
    globe = sphere(radius=radius, flip_normals=True, bsdf=diffuse(albedo))
    lit = Lit(scene(globe=globe, bulb=light_bulb((0, 0, 0), 3)), 0.5)
    direct = lit.direct()
    assert np.allclose(direct.irradiance, 3 / radius**2, rtol=1e-3)
    result = lit.reflected(direct, rays=64, bounces=bounces)
    powers = albedo ** np.arange(1, 65 if bounces is None else bounces + 1)
    expected = 3 / radius**2 * powers.sum()
    assert np.allclose(result.irradiance, expected, rtol=4e-3, atol=0)
    assert result.bounces[0] == (bounces if bounces is not None else result.bounces[0])


def test_two_plates():
    """Wide plates that face each other, one of which shines: with the albedos a below and b above,
    E = πL/(1 − ab) below, πLa/(1 − ab) above. The edge is 50 distances away and sees 2e-4 less.
    """
    below, above, size = 0.5, 0.7, 50.0
    lit = Lit(
        scene(
            floor=rectangle(size=size, bsdf=diffuse(below)),
            lamp=rectangle((0, -1, 0), (0, 1, 0), size, emitter=lamp(1), bsdf=diffuse(above)),
        ),
        5.0,
    )
    direct = lit.direct()
    reflected = lit.reflected(direct, rays=256)
    total = (direct.irradiance + reflected.irradiance)[:, 0, 0]
    for name, expected in (("floor", np.pi), ("lamp", np.pi * below)):
        index = lit.on(name)
        middle = index[np.abs(lit.points.positions[index]).max(axis=1) < 26]
        assert len(middle) > 50
        assert abs(total[middle].mean() / (expected / (1 - below * above)) - 1) < 0.01


def test_spot_beside_a_wall_has_its_power():
    """A bulb 2 cm over a floor lights a spot that few rays from the ceiling find. Its light is
    averaged over their footprints, which keeps its power but spreads it: the ceiling receives 9 %
    less, by a sum over rings; of the noise of 49 points 7 % are left in their mean.
    """
    height, albedo, rays = 0.02, 0.8, 256
    lit = Lit(
        scene(
            floor=rectangle(size=3, bsdf=diffuse(albedo)),
            ceiling=rectangle((0, -1, 0), (0, 1, 0), 0.1, bsdf=diffuse(0.0)),
            bulb=light_bulb((0, height, 0)),
        ),
        0.025,
    )
    ceiling = lit.on("ceiling")
    points, buried = lit.points.at(ceiling), lit.buried[ceiling]
    direct = direct_light(lit.scene, points, lit.emitters)
    picker = replace(lit.points, buried=lit.buried).locator(lit.scene)
    result = reflected_light(
        lit.scene, points, buried, lit.emitters, direct.irradiance, picker, rays=rays, bounces=1
    ).irradiance[:, 0, 0]

    def received(height):
        edges = np.geomspace(1e-5, 20, 20001)
        r, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
        sent = height / (r**2 + height**2) ** 1.5 * albedo / np.pi
        return (sent / (r**2 + 1) ** 2 * 2 * np.pi * r * width).sum()

    raised = (height**4 + (np.pi / rays / 4) ** 2) ** 0.25
    assert 0.85 < received(raised) / received(height) < 0.95
    assert len(points) >= 49
    error = result.std() / len(points) ** 0.5
    assert error < 0.1 * received(height)
    assert abs(result.mean() - received(raised)) < 3.5 * error + 0.02 * received(height)


# --- against Mitsuba ------------------------------------------------------------------------------


def furnished():
    """A room open to one side with a ball of triangles that shines, a picture that does, a spot, a
    bulb and a box.
    """
    mi = mitsuba()
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    jewel = mesh(0.15 * corners + [0.5, 1.2, -0.3], faces)
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict(lamp([3, 6, 9]))
    properties["bsdf"] = mi.load_dict(diffuse(0.2))
    shining = mi.Mesh("jewel", 6, 8, props=properties)
    source, target = mi.traverse(jewel), mi.traverse(shining)
    for key in ("vertex_positions", "faces"):
        target[key] = source[key]
    target.update()
    picture = np.zeros((4, 4, 3), np.float32)
    picture[0, 0], picture[2, 3] = (40, 10, 5), (5, 20, 60)
    shown = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(picture),
        "raw": True,
        "filter_type": "nearest",
    }
    spot = mi.ScalarTransform4f().look_at([-0.5, 1.8, 0.5], [0.2, 0, 0], [0, 0, 1])
    return scene(
        floor=rectangle(size=1, bsdf=diffuse([0.7, 0.5, 0.3])),
        left=rectangle((1, 0, 0), (-1, 1, 0), 1, bsdf=diffuse([0.8, 0.2, 0.2])),
        right=rectangle((-1, 0, 0), (1, 1, 0), 1, bsdf=diffuse([0.2, 0.2, 0.8])),
        roof=rectangle((0, -1, 0), (0, 2, 0), 1, bsdf=diffuse(0.8)),
        box={
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([-0.3, 0.3, 0.2]).scale(0.25),
            "bsdf": diffuse(0.5),
        },
        jewel=shining,
        picture={
            "type": "rectangle",
            "to_world": facing((0, 0, 1), (0, 1, -0.95), 0.4),
            "emitter": {"type": "area", "radiance": shown},
            "bsdf": diffuse(0.1),
        },
        spot={
            "type": "spot",
            "to_world": spot,
            "intensity": {"type": "rgb", "value": [4, 4, 2]},
            "cutoff_angle": 30,
        },
        bulb=light_bulb((0.4, 0.6, 0.5), 0.5),
    )


@pytest.fixture(scope="module")
def room():
    return Lit(furnished(), 0.12)


@pytest.fixture(scope="module")
def compared(room):
    """Some points of the room that are not buried."""
    kept = np.flatnonzero(~room.buried)
    return np.sort(np.random.default_rng(0).permutation(kept)[:300])


def test_direct_light_is_mitsubas(room, compared):
    """A mesh, a texture, a spot and a bulb together: each channel of each point within the noise of
    both (Šidák, 1 % of false positives). Our own error, which eight sequences cannot give for a
    single point, is taken as what is aimed at.
    """
    result = room.direct(tolerance=1e-3, most_samples=1 << 14)
    truth = ground_truth.point_irradiance(
        room.scene.mi_scene, room.points.at(compared), 1 << 14, seed=1
    )
    total = result.irradiance[compared].sum(axis=1)
    own = 4e-3 * total.mean() + np.linalg.norm(result.standard_error[compared], axis=1)[:, None]
    z = (total - truth.mean) / np.hypot(truth.standard_error, own)
    assert np.abs(z).max() < largest_z(z.size)
    assert abs(bias(total, truth.mean)) < 0.003
    noise = result.noise(room.points.areas)
    assert noise.shape == (4,) and noise.max() < 0.003


@pytest.mark.parametrize("bounces", [1, None])
def test_reflected_light_is_mitsubas(room, compared, bounces):
    """After one reflection nothing is interpolated but beside lamps; after all of them the second
    and later ones are, between points 12 cm apart. Bias within 1 %, and the error beyond the noise
    of both within 3 %.
    """
    direct = room.direct()
    result = room.reflected(direct, rays=256, bounces=bounces)
    truth = ground_truth.indirect_irradiance(
        room.scene.mi_scene, room.points.at(compared), 1024, bounces, seed=2
    )
    total = result.irradiance[compared].sum(axis=1)
    own = np.linalg.norm(result.standard_error[compared], axis=1)
    noise = np.hypot(np.linalg.norm(truth.standard_error), np.linalg.norm(own))
    assert abs(bias(total, truth.mean)) < 0.01
    rmse = np.linalg.norm(total - truth.mean)
    assert rmse**2 < noise**2 + (0.03 * np.linalg.norm(truth.mean)) ** 2


def test_chosen_lamps_have_the_same_mean(room):
    """Two of four lamps at each place, against all four: the mean over the surface of each lamp
    agrees within 2 %, twice what 1 % of noise in each mean allows, and so does the total.
    """
    direct = room.direct()
    every = room.reflected(direct, rays=128, aimed=4)
    chosen = room.reflected(direct, rays=128, aimed=2, seed=5)
    weights = np.where(room.buried, 0, room.points.areas)
    one, other = (np.einsum("nkc,n->k", x.irradiance, weights) for x in (every, chosen))
    assert np.abs(other / one - 1).max() < 0.02
    assert (chosen.noise(weights) > every.noise(weights)).any()  # they are other estimates


def test_samples_serve_as_points(room):
    """Meshless samples in the place of vertices: the mean over the floor agrees within 3 %."""
    samples, _, _ = scatter_points(room.scene, 1000, 2, 0)
    buried = np.zeros(len(samples), bool)
    direct = direct_light(room.scene, samples, room.emitters)
    result = reflected_light(
        room.scene,
        samples,
        buried,
        room.emitters,
        direct.irradiance,
        samples.locator(room.scene),
        rays=128,
    )
    number = [s.name for s in room.scene.surfaces].index("floor")
    here = samples.surface == number
    there = room.on("floor")
    expected = room.reflected(rays=128).irradiance[there].sum(axis=1)
    mean = np.average(expected, axis=0, weights=room.points.areas[there])
    found = np.average(result.irradiance[here].sum(axis=1), axis=0, weights=samples.areas[here])
    assert np.abs(found / mean - 1).max() < 0.03


# --- properties -----------------------------------------------------------------------------------


def test_twice_the_light_is_twice_the_irradiance():
    """Powers of two scale without rounding, and no decision depends on the scale: bit for bit."""

    def of(factor):
        lit = Lit(
            scene(
                floor=rectangle(bsdf=diffuse(0.7)),
                wall=rectangle((1, 0, 0), (-1, 1, 0), bsdf=diffuse(0.4)),
                lamp=rectangle(
                    (0, -1, 0), (0, 1.5, 0), 0.3, emitter=lamp(1.5 * factor), bsdf=diffuse(0)
                ),
                bulb=light_bulb((0.2, 0.7, 0), 0.5 * factor),
            ),
            0.3,
        )
        direct = lit.direct()
        return direct.irradiance, lit.reflected(direct, rays=32, bounces=2).irradiance

    for one, two in zip(of(1), of(2)):
        assert one.any() and np.array_equal(2 * one, two)


@pytest.mark.parametrize("aimed", [2, 4])
def test_results_do_not_depend_on_wavefronts(room, aimed):
    """Blocks of any size, and repetition, give the same bits; another seed gives others."""
    direct = room.direct(seed=3)
    assert np.array_equal(direct.irradiance, room.direct(seed=3, lanes=1 << 14).irradiance)
    assert not np.array_equal(direct.irradiance, room.direct(seed=4).irradiance)
    options = dict(rays=8, bounces=2, aimed=aimed)
    result = room.reflected(direct, seed=3, **options).irradiance
    narrow = room.reflected(direct, seed=3, lanes=1 << 14, **options).irradiance
    assert np.array_equal(result, narrow)
    assert not np.array_equal(result, room.reflected(direct, seed=4, **options).irradiance)


def test_rays_in_a_file_give_the_same(room, tmp_path):
    """Rays kept in a file are those kept in memory."""
    direct = room.direct()
    stored = room.reflected(
        direct,
        rays=16,
        lanes=1 << 14,
        hop_rows=lambda count, size: RowFile(tmp_path / "hops", count, size),
    )
    assert np.array_equal(stored.irradiance, room.reflected(direct, rays=16).irradiance)
    assert (tmp_path / "hops").stat().st_size == len(room.points) * 16 * 16


def test_nearly_white_surfaces_are_solved_for():
    """Albedo 0.95, above which a bound by albedo says little: E₀·ρ/(1 − ρ), 19 times the direct
    light, by a Krylov method. Footprints take away 1e-3 at most.
    """
    globe = sphere(radius=2.0, flip_normals=True, bsdf=diffuse(0.95))
    lit = Lit(scene(globe=globe, bulb=light_bulb((0, 0, 0), 3)), 0.5)
    result = lit.reflected(rays=64)
    assert np.allclose(result.irradiance, 0.75 * 19, rtol=3e-3)
    assert result.bounces == (None, None)


def test_kernels_are_shared(room):
    """Kernels depend neither on the number of blocks nor of lamps: a second run compiles none."""
    direct = room.direct()
    room.reflected(direct, rays=16)
    with count_kernels() as kernels:
        some = direct_light(room.scene, room.points, room.emitters[:2], seed=9, lanes=1 << 14)
        assert some.irradiance.shape[1] == 2
        room.reflected(direct, rays=32, seed=8, lanes=1 << 14)
    assert kernels.launched > 10 and kernels.compiled == 0


def test_noise_falls_with_rays(room):
    """Four times the rays: half the noise of independent ones, less of stratified ones."""
    direct = room.direct()
    weights = np.where(room.buried, 0, room.points.areas)
    few, many = (room.reflected(direct, rays=r, bounces=1).noise(weights) for r in (32, 128))
    assert (many < few / 1.6).all() and (many > few / 8).all()
    rough, fine = (room.direct(tolerance=t).noise(weights) for t in (0.05, 0.005))
    assert fine.max() < 0.006 and rough.max() > 2 * fine.max()


def test_reflections_add_up(room):
    """More reflections, more light; without any, none."""
    direct = room.direct()
    weights = np.where(room.buried, 0, room.points.areas)
    energy = [
        np.einsum("nkc,n->k", room.reflected(direct, rays=16, bounces=b).irradiance, weights)
        for b in (0, 1, 2, 3, None)
    ]
    assert (energy[0] == 0).all()
    assert (np.diff(energy, axis=0) > 0).all()


@pytest.mark.parametrize("rays", [0, 6])
def test_rays_come_in_fours(room, rays):
    with pytest.raises(SettingsError, match="multiple of 4"):
        room.reflected(rays=rays)
