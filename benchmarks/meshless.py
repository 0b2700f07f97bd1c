"""Light that moves inside a scene, measured: samples, accuracy, encodings, extremes, the trade and
speed; writes docs/meshless.md.

Usage: python benchmarks/meshless.py [--assets DIR] [--output docs/meshless.md] [--only
samples,accuracy,…] [--quick]
                                     [--trade-scenes cornell-box,veach-ajar]

DIR holds scenes/*/scene.xml (see benchmarks/README.md). With --only the other sections of the page
stay as they are. --quick takes few samples and lights, to try the script: its numbers mean nothing.
The trade is on the Cornell box unless other scenes are named. Nothing else should run on the
machine meanwhile: some sections tell times.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
from page import plt, saved, write_page
from scipy.spatial import cKDTree

import mi_prt
from mi_prt.basis.clustered import leading_components
from mi_prt.evaluate import ground_truth, metrics
from mi_prt.evaluate.ground_truth import Reference
from mi_prt.lighting.emission import emission_of
from mi_prt.lighting.light import as_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.particles import cross_surfaces, free_places, trace_particles
from mi_prt.points.points import sample_points
from mi_prt.points.sample_locator import SampleLocator
from mi_prt.points.samples import COVERED
from mi_prt.points.thinning import embedded
from mi_prt.precompute import examples as example_lights
from mi_prt.precompute.precompute import measure
from mi_prt.precompute.settings import Settings
from mi_prt.scene.scene import mesh_arrays, open_scene
from mi_prt.system.runtime import count_kernels, mitsuba
from mi_prt.transport import local_direct
from mi_prt.transport.depth import GRAZING, NEAREST
from mi_prt.transport.hemispheres import HemisphereTracer, cluster_frames
from mi_prt.transport.local_direct import LocalDirect
from mi_prt.transport.transfer import fit_senders

SCENES = ("cornell-box", "veach-ajar", "staircase2")
LIGHT_SEED = 77  # of light positions, and of places on surfaces: precomputations have the seed 0
CHECKED = SCENES[:2]  # where the truth of reflected light is told by Mitsuba's `path` as well
MIDDLE = (0.1, 1.5, 0.3)  # of the Cornell box
BOX_FACES = 12
TOTAL_FLUX = 4 * np.pi  # W of a point light of 1 W/sr
DEFAULTS = Settings()
LOCAL = {"points": "samples", "transports": "local"}  # of all precomputations here


@dataclass(frozen=True)
class Effort:
    """How much is computed."""

    # of precomputations, where they are not the defaults
    settings: dict = field(default_factory=dict)
    lights: int = 50
    compared: int = 2000  # points
    paths: int = 128  # from each of them, by which the truth is told
    encoded_clusters: int = 8  # of each scene
    encoded_lights: int = 24
    furnace: dict = field(default_factory=lambda: {"count": 5000, "cluster_size": 500})
    # as many clusters as with the defaults
    trade: dict = field(default_factory=lambda: {"count": 5000, "cluster_size": 111})
    trade_counts: tuple = (2500, 5000, 10_000, 20_000)
    trade_lights: int = 8
    repeat: int = 50  # of what is timed


_FEW = {"count": 2000, "cluster_size": 200, "depth_directions": 576, "example_lights": 200}
QUICK = Effort(_FEW, 3, 200, 32, 2, 3, _FEW, _FEW, (1000, 2000), 2, 5)
effort = Effort()


def main():
    global effort
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--trade-scenes", default=SCENES[0])
    own, others = parser.parse_known_args()
    sys.argv[1:] = others  # what the page's own parser knows
    effort = QUICK if own.quick else effort

    def trade_of_scenes(assets, pictures):
        yield from trade(assets, pictures, own.trade_scenes.split(","))

    write_page(__doc__, HEAD, SECTIONS | {"trade": trade_of_scenes}, "meshless.md")


HEAD = """# Light that moves inside a scene, measured

Made by `benchmarks/meshless.py` on two CPU cores. Settings are the defaults of `mi-prt precompute
--points samples` unless said otherwise. Errors are relative RMSE over points, ‖result − truth‖ /
‖truth‖; the truth's own noise is taken out. Direct light is compared with Mitsuba's shadow rays,
which have no noise. For reflected light Mitsuba's `path` is too noisy: where a path happens to
come near a lamp that stands by a wall it brings back a spike. The truth here is a bidirectional
estimate with Mitsuba's intersections and BSDFs: wherever light was reflected last but one is told
both by rays from the receiver and by rays from the lamp, weighted by the balance heuristic, so
that no sample is large; [accuracy](#accuracy) has it next to `path`."""


# --- sections -------------------------------------------------------------------------------------


def samples(assets, pictures):
    """Blue noise, coverage, areas and clusters."""
    yield "## Samples\n"
    yield (
        "Asked: blue noise, told by radial distribution and coverage, and area weights whose sum is"
        " the reachable area within 1 %. *Covered* is the share of surface within a radius of a"
        " sample: of all surface by the asset's own report, and of fresh places that particles of"
        " another seed reach. *Area of all sides* is that of the tessellated shapes, an upper"
        " bound: it has outer, inner and buried sides. That of the Cornell box is known: walls from"
        " inside, both sides of the lamp, boxes without bottoms, floor without what they stand on."
        " *Widest* is the largest angle between the normal of a sample and that of its cluster's"
        " root.\n"
    )
    yield (
        "| scene | samples | radius, m | covered (report) | covered (particles) | sum of areas, m²"
        " | reachable, exact | difference | area of all sides | clusters | sizes: least / median /"
        " greatest | widest |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
    )
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
    views, panels = plt.subplots(1, len(SCENES), figsize=(12, 4.2))
    for name, panel in zip(SCENES, panels):
        path = _path(assets, name)
        (asset, _), scene = _precomputed(path), _scene(path)
        points, clusters = asset.points, asset.transports["local"].clusters
        radii, correlation = _pair_correlation(scene, points)
        axes[0].plot(radii, correlation, label=name)
        found = trace_particles(scene, 1, LIGHT_SEED)[0]
        found = found.at(np.random.default_rng(0).permutation(len(found))[: len(points)])
        distance = np.sort(_distances(points, found))
        axes[1].plot(distance, np.arange(1, len(distance) + 1) / len(distance), label=name)
        report, sizes = points.report, np.diff(clusters.starts)
        exact = _cornell_area(scene) if name == "cornell-box" else None
        roots = np.repeat(clusters.roots, sizes)
        widest = np.degrees(
            np.arccos(np.clip((points.normals * points.normals[roots]).sum(axis=1), -1, 1))
        ).max()
        yield (
            f"| {name} | {len(points):,} | {points.layout.radius:.4f} | {report['coverage']:.1%} |"
            f" {(distance < 1).mean():.1%} | {report['reachable_area']:.2f} | "
            + (f"{exact:.2f} | {report['reachable_area'] / exact - 1:+.2%}" if exact else " | ")
            + f" | {sample_points(scene).areas.sum(dtype=np.float64):.2f} | {len(sizes)} |"
            f" {sizes.min()} / {np.median(sizes):.0f} / {sizes.max()} | {widest:.0f}° |"
        )
        _draw_clusters(panel, points, clusters, name)
    axes[0].axhline(1, color="grey", lw=0.8)
    axes[0].set(
        xlabel="distance / radius",
        ylabel="pairs / pairs of random points",
        title="radial distribution",
    )
    axes[1].axvline(1, color="grey", lw=0.8)
    axes[1].set(
        xlabel="distance / radius",
        ylabel="share of surface nearer to a sample",
        title="coverage",
        xlim=(0, 2),
    )
    for axis in axes:
        axis.grid(alpha=0.3), axis.legend(fontsize=8)
    yield saved(figure, pictures, "samples")
    yield (
        "The radial distribution counts pairs whose normals are within 60°, against places of equal"
        " density per area that random lines find.\n"
    )
    yield saved(views, pictures, "clusters")
    yield (
        "Samples that face the viewer, coloured by cluster, with the roots in black; surfaces seen"
        " from behind are left out."
    )


def accuracy(assets, pictures):
    """Lights that were no examples, against Mitsuba."""
    yield "## Accuracy\n"
    yield (
        "Asked: for 50 light positions that were not examples, misclassified visibility ≤ 3 %,"
        f" indirect ≤ 5 %, total ≤ 8 %. Measured: {effort.lights} places of a point light, spread"
        f" over the space that particles of another seed fly through, at {effort.compared:,} random"
        " samples. *Misclassified* is the share of points facing the light whose visibility"
        " (direct irradiance over that without occluders) is on the wrong side of one half; truth"
        f" of reflected light has {effort.paths} paths from each point and any number of"
        " reflections. *Noise* is the truth's own, *bias* the median of signed biases.\n"
    )
    yield (
        "| scene | | median | mean | 90 % of lights | bias | noise | asked"
        " |\n|---|---|---:|---:|---:|---:|---:|---:|"
    )
    figure, axes = plt.subplots(1, len(SCENES), figsize=(11, 3.5), sharey=True)
    checks = []
    for axis, name in zip(axes, SCENES):
        path = _path(assets, name)
        asset, _ = _precomputed(path)
        lights = _lights(path, effort.lights)
        judged, dark = _judged(path, asset, lights)
        for quantity, asked in (
            ("misclassified", 3),
            ("direct", None),
            ("indirect", 5),
            ("total", 8),
        ):
            errors = np.array([light[quantity] for light in judged])
            bias = (
                f"{np.median([light[f'{quantity}_bias'] for light in judged]):+.1%}"
                if quantity != "misclassified"
                else ""
            )
            noise = (
                f"{np.median([light[f'{quantity}_noise'] for light in judged]):.1%}"
                if quantity in ("indirect", "total")
                else ""
            )
            met = f"≤ {asked} %" if asked else ""
            yield (
                f"| {name} | {quantity} | {np.median(errors):.1%} | {errors.mean():.1%} |"
                f" {np.quantile(errors, 0.9):.1%} | {bias} | {noise} | {met} |"
            )
            axis.plot(np.sort(errors), np.arange(1, len(errors) + 1) / len(errors), label=quantity)
        axis.set_xscale("symlog", linthresh=0.1)
        axis.set(title=name, xlabel="error", xlim=(0, 2)), axis.grid(alpha=0.3)
        if name in CHECKED:
            checks.append(_against_path(path, asset, name, lights))
        if dark:
            checks.append(
                f"In {name} {dark} of the lights reach none of the compared points; they are left"
                " out.\n"
            )
    axes[0].set_ylabel("share of lights"), axes[0].legend(fontsize=8)
    yield saved(figure, pictures, "accuracy")
    yield from checks


def encodings(assets, pictures):
    """What is compressed of depth, and how a light is tested against it."""
    yield "## Encodings of depth, and the test\n"
    count, test = DEFAULTS.depth_coefficients, local_direct
    yield (
        "Asked: encoding and test chosen by misclassified visibility against ray casts (erratum"
        f" 8). {effort.encoded_clusters} clusters of each scene and {effort.encoded_lights} lights;"
        " depths that went through each encoding take the place of the program's own. All"
        f" encodings have {count} coefficients for each point and are clamped to {NEAREST:g}…1 of"
        " the samples' extent, but *depth*, in which escaping rays are 100 extents long. *Cosine*:"
        " directions weighted by it in the fit. Direct error is the median over lights at the"
        " points of these clusters.\n"
    )
    tallies = {name: _encoding_tallies(_path(assets, name)) for name in SCENES}
    yield from _tally_table(tallies, "encoding")
    yield (
        "\nThe test, with the program's own depth buffers. A light at the distance r is compared"
        f" with the four depths d around its direction, each by a ramp over {test.SOFTNESS:.0%} of"
        f" r. *Tolerance* lets it lie {test.TOLERANCE:.0%} of r behind what the buffer shows"
        f" ({test.BEHIND:.0%} for points behind the surface that it stands over); *clearance* takes"
        f" it to stand up to {test.CLEARANCE:.0%} of r off that surface, on its side, and to be"
        f" seen {test.CELLS:g} cell of the buffer off it. *Hard* compares d > r. That the first row"
        " is that of *logarithm, cosine* above, but for 16-bit numbers, shows that the two tables"
        " measure the same.\n"
    )
    yield from _tally_table(tallies, "test")


def extremes(assets, pictures):
    """Lights where they should not stand, thin walls, and energy."""
    yield "## Extremes\n"
    yield (
        "Asked: finite and of the right sign, no leak through walls, dark where the light is"
        " outside. The Cornell box and point lights of 1 W/sr unless said otherwise. Flux is Σ area"
        " · irradiance as a share of the 4π W that the light sends (close to a surface few samples"
        " see most of it, so that the sum tells little); *leak* is that of direct light at points"
        " where there should be none. Mitsuba's own shadow rays end 9·10⁻⁴ of the distance short of"
        " the light, so that 10⁻³ m behind a wall it leaks itself.\n"
    )
    path = _path(assets, "cornell-box")
    (asset, _), scene = _precomputed(path), _scene(path)
    yield (
        "| light | finite, none negative | greatest direct, W/m² | direct flux | by Mitsuba | leak"
        " | indirect flux |\n|---|---|---:|---:|---:|---:|---:|"
    )
    for label, place, intensity in _odd_places(asset):
        yield (
            f"| {label} | {_flux_row(scene, asset, place, intensity, outside='outside' in label)} |"
        )
    one, many = (
        asset.irradiance(mi_prt.PointLight(MIDDLE, i)).astype(np.float64) for i in (1.0, 1e6)
    )
    yield (
        "\nA light of 10⁶ W/sr gives 10⁶ times the irradiance of one of 1 W/sr within"
        f" {np.abs(many / 1e6 - one).max() / one.max():.0e} of the greatest.\n"
    )
    yield (
        "\nA room of 2 m divided by a wall of 1 cm, albedo 0.7: light on one side, flux on the"
        " other, where there should be none.\n\n| distance from the wall, m | direct flux in its"
        " own half | leak, direct | leak, indirect |\n|---:|---:|---:|---:|"
    )
    room = mi_prt.precompute(_divided_room(), **LOCAL, **effort.settings)
    beyond = room.points.positions[:, 0] < 0
    for distance in (0.5, 0.1, 0.01, 1e-3, 0.0):
        light = mi_prt.PointLight((0.005 + distance, 0.1, 0.2), 1.0)
        direct, indirect = (
            _flux(room, room.irradiance(light, component)) for component in ("direct", "indirect")
        )
        yield (
            f"| {distance:g} | {direct[~beyond].sum():.1%} | {direct[beyond].sum():.2%} |"
            f" {indirect[beyond].sum():.2%} |"
        )
    yield from _furnace()


def trade(assets, pictures, names=SCENES[:1]):
    """Error, bytes and seconds over each setting."""
    yield "## The trade\n"
    yield (
        'The paper leaves open: "Evaluations regarding cluster size and number of basis functions'
        ' have to be accomplished". One setting at a time around the defaults '
        f"({', '.join(f'{key} {value:,}' for key, value in effort.trade.items())} here, so that"
        " there are as many clusters as with the defaults; bold is what stays while another"
        " setting changes). With another count clusters grow in proportion. Errors are medians"
        f" over {effort.trade_lights} lights at {effort.compared:,} samples; *anywhere* is that "
        "of total light interpolated at places between them. MB are those of depth buffers and"
        " transfer. *pca* in the place of a number: the "
        "paper's basis, principal components of the examples, where the default weighs them by what"
        " receivers get of them.\n"
    )
    for name in names:
        yield f"\n{name}\n"
        yield (
            "| setting | value | misclassified | direct | indirect | total | anywhere | MB |"
            " precompute, s | relight, ms |\n|---|---|---:|---:|---:|---:|---:|---:|---:|---:|"
        )
        path, curves = _path(assets, name), {}
        # compiles
        measure(path, **LOCAL, **effort.trade | {"count": 1000, "cluster_size": 200})
        for setting, values in _trade_values().items():
            for value in values:
                row = _trade_row(path, _variant(setting, value))
                curves.setdefault(setting, []).append((value, row))
                shown = f"{value:,}" if isinstance(value, int) else str(value)
                shown = f"**{shown}**" if value == _base(setting) else shown
                errors = " | ".join(
                    f"{row[key]:.1%}"
                    for key in ("misclassified", "direct", "indirect", "total", "anywhere")
                )
                yield (
                    f"| {setting} | {shown} | {errors} | {row['bytes'] / 1e6:.1f} |"
                    f" {row['seconds']:.1f} | {row['relight'] * 1e3:.1f} |"
                )
        yield _draw_trade(curves, pictures, f"trade-{name}")


def speed(assets, pictures):
    """Seconds and bytes of the default precomputation, and of relighting."""
    yield "## Speed\n"
    path = _path(assets, "cornell-box")
    _precomputed.cache_clear()
    asset, cost = _precomputed(path)
    seconds = cost["seconds"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "asset.prt"
        asset.save(file)
        size = file.stat().st_size
        loaded = mi_prt.load(file)
    yield (
        f"Cornell box, {len(asset.points):,} samples in"
        f" {len(asset.transports['local'].clusters)} clusters, precomputed in"
        f" **{sum(seconds.values()):.0f} s** (asked: ≤ 120 s; the paper: 4 hours):"
        f" {', '.join(f'{stage} {value:.1f}' for stage, value in seconds.items())}."
        f" {cost['rays'] / 1e6:.0f} million rays fill the depth buffers;"
        f" {cost['peak_memory_bytes'] / 1e9:.1f} GB of memory at most. File: **{size / 1e6:.1f}"
        " MB** (asked: ≤ 30 MB).\n"
    )
    yield "| stored | MB | share |\n|---|---:|---:|"
    stored = {name: array.nbytes for name, array in _stored(asset).items()}
    for group in sorted(
        {name.split("_scale")[0] for name in stored}, key=lambda g: -_group_bytes(stored, g)
    ):
        if (bytes_ := _group_bytes(stored, group)) > 1e-3 * size:
            yield f"| {group} | {bytes_ / 1e6:.2f} | {bytes_ / size:.0%} |"
    yield (
        "| points, clusters and what is less than 0.1 % |"
        f" {(size - sum(stored.values())) / 1e6:.2f} | {1 - sum(stored.values()) / size:.0%} |"
    )
    yield from _relighting(path, loaded)
    yield from _brute_force(path, loaded)


SECTIONS = {
    "samples": samples,
    "accuracy": accuracy,
    "encodings": encodings,
    "extremes": extremes,
    "trade": trade,
    "speed": speed,
}


# --- scenes, lights and truth ---------------------------------------------------------------------


def _path(assets, name):
    return assets / "scenes" / name / "scene.xml"


@cache
def _scene(path):
    return open_scene(path)


@cache
def _precomputed(path):
    """The asset with the default settings, and its cost."""
    return measure(path, **LOCAL, **effort.settings)


@cache
def _lights(path, count):
    """Places (count, 3) in free space that are no examples."""
    flights = trace_particles(_scene(path), 1, LIGHT_SEED)[1]
    return free_places(flights, count, LIGHT_SEED)


@cache
def _shapes(path):
    """The scene as modelled, without any light."""
    return lit_scene(_scene(path), mi_prt.PointLight((0, 0, 0), 0.0), modelled=True)


_TRUTHS = {}


def _truth(path, points, place):
    """Direct and reflected irradiance (Reference) of points under a point light of 1 W/sr; told
    once for the same points and place.
    """
    key = path, points.positions.tobytes(), place.tobytes()
    if key not in _TRUTHS:
        direct = ground_truth.local_irradiance(
            _scene(path).occluders, points, [mi_prt.PointLight(place, 1.0)]
        )
        _TRUTHS[key] = (
            direct,
            _reflected_irradiance(_shapes(path), points, place, effort.paths, LIGHT_SEED),
        )
    return _TRUTHS[key]


LANES = 1 << 19
LEAST_BOUNCES = 3  # before Russian roulette
MOST_STAYING = 0.95


def _reflected_irradiance(mi_scene, points, place, paths, seed):
    """Irradiance at points by all reflected light of a point light of 1 W/sr, by bidirectional
    paths.

    Light that was reflected in y before it came to x is told by two estimators: y is hit by a ray
    from x, of density p₁ per area, or by a ray from the lamp, of density p₂. The balance heuristic
    makes either f/(p₁ + p₂), which is bounded where y is near the lamp, unlike the f/p₁ of
    Mitsuba's `path`. From y hit by x the path goes on.

    Parameters
    ----------
    mi_scene : mi.Scene
        Diffuse.
    points : Points
    place : (3,)
    paths : int
        From each point.
    seed : int

    Returns
    -------
    Reference
        (n, 3) in W/m².
    """
    import drjit as dr

    mi = mitsuba()
    context = mi.BSDFContext()
    lamp = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in place))

    def brought(eye, normal, y):
        """f/(p₁ + p₂) of light from the lamp by y to x, as irradiance there."""
        away, out = eye.p - y.p, lamp - y.p
        across, along = dr.squared_norm(away), dr.squared_norm(out)
        away, out = away * dr.rsqrt(across), out * dr.rsqrt(along)
        y.wi = y.to_local(away)
        geometry = dr.maximum(-dr.dot(normal, away), 0) * dr.abs(dr.dot(y.n, away)) / across
        density = geometry / dr.pi + dr.abs(dr.dot(y.n, out)) / (4 * dr.pi * along)
        value = y.bsdf().eval(context, y, y.to_local(out)) * (geometry / (along * density))
        return dr.select(dr.all(dr.isfinite(value)), value, 0)

    def square(random):
        return mi.Point2f(random.next_float32(), random.next_float32())

    def bounce(number, position, geometric, normal, weight, total, active, random):
        eye = dr.zeros(mi.SurfaceInteraction3f)
        eye.p, eye.n = position, geometric
        y = mi_scene.ray_intersect(
            mi.Ray3f(lamp, mi.warp.square_to_uniform_sphere(square(random))), active
        )
        lit = active & y.is_valid()
        lit &= ~mi_scene.ray_test(eye.spawn_ray_to(y.p), lit)
        total += dr.select(lit, weight * brought(eye, normal, y), 0)
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(square(random)))
        y = mi_scene.ray_intersect(eye.spawn_ray(direction), active)
        active &= y.is_valid()
        side = dr.sign(y.wi.z)
        reflectance = y.bsdf().eval(context, y, mi.Vector3f(0, 0, side), active) * dr.pi
        lit = active & ~mi_scene.ray_test(y.spawn_ray_to(lamp), active)
        total += dr.select(lit, weight * brought(eye, normal, y), 0)
        weight = weight * reflectance
        stays = dr.select(number < LEAST_BOUNCES, 1, dr.minimum(dr.max(weight), MOST_STAYING))
        active &= (random.next_float32() < stays) & (dr.max(weight) > 0)
        return (
            number + 1,
            y.p,
            y.n,
            mi.Normal3f(side * y.sh_frame.n),
            weight / stays,
            total,
            active,
            random,
        )

    stored = [
        mi.Float(np.ascontiguousarray(x).ravel())
        for x in (points.positions, points.geometric_normals, points.normals)
    ]
    per_point = dr.opaque(mi.UInt32, paths)
    means, squares = np.empty((len(points), 3)), np.empty((len(points), 3))
    step = max(1, LANES // paths)
    for block, first in enumerate(range(0, len(points), step)):
        size = min(step, len(points) - first)
        random = mi.PCG32(
            size=size * paths, initstate=mi.UInt64(dr.opaque(mi.UInt32, seed + 7919 * block))
        )
        index = dr.arange(mi.UInt32, size * paths) // per_point + dr.opaque(mi.UInt32, first)
        start = [
            dr.gather(kind, values, index)
            for kind, values in zip((mi.Point3f, mi.Normal3f, mi.Normal3f), stored)
        ]
        state = (mi.UInt32(0), *start, mi.Color3f(1), mi.Color3f(0), mi.Bool(True), random)
        total = dr.while_loop(state, lambda *state: state[6], bounce)[5]
        sums = [[dr.block_sum(x, paths) for x in values] for values in (total, total * total)]
        dr.eval(sums)
        for to, values in zip((means, squares), sums):
            to[first : first + size] = (
                np.stack([np.array(x, np.float64) for x in values], axis=-1) / paths
            )
    return Reference(means, np.sqrt(np.maximum(squares - means**2, 0) / (paths - 1)))


# --- errors ---------------------------------------------------------------------------------------


def _judged(path, asset, lights):
    """For each light errors, biases and noise at compared points, a dict; and how many lights reach
    none of them, which are left out.
    """
    chosen, judged = _compared(asset), []
    points = asset.points.at(chosen)
    for place in lights:
        direct, reflected = _truth(path, points, place)
        if not direct.any() or not reflected.mean.any():
            continue
        light = mi_prt.PointLight(place, 1.0)
        ours = {
            component: asset.irradiance(light, component)[chosen]
            for component in ("direct", "indirect", "total")
        }
        unblocked = emission_of(as_light(light)).irradiance(points.positions, points.normals)[:, 0]
        above = unblocked > 0
        row = {
            "misclassified": (
                ((ours["direct"][:, 0] > unblocked / 2) != (direct[:, 0] > unblocked / 2))[
                    above
                ].mean()
            )
        }
        total = Reference(direct + reflected.mean, reflected.standard_error)
        for component, truth in (
            ("direct", Reference(direct, np.zeros_like(direct))),
            ("indirect", reflected),
            ("total", total),
        ):
            row |= {
                component: _beyond_noise(ours[component], truth),
                f"{component}_bias": metrics.relative_bias(ours[component], truth.mean),
                f"{component}_noise": truth.noise,
            }
        judged.append(row)
    return judged, len(lights) - len(judged)


def _compared(asset):
    """Indices of random samples; the same points wherever assets have the same samples, in whatever
    order.
    """
    order = np.lexsort(asset.points.positions.T)
    return order[np.random.default_rng(0).permutation(len(order))[: effort.compared]]


def _beyond_noise(result, truth):
    """Relative RMSE with the reference's noise taken out."""
    return float(np.sqrt(max(metrics.relative_rmse(result, truth.mean) ** 2 - truth.noise**2, 0)))


def _against_path(path, asset, name, lights):
    """The bidirectional truth next to Mitsuba's `path`."""
    points = asset.points.at(_compared(asset))
    lines = []
    for place in lights[:3]:
        _, reflected = _truth(path, points, place)
        lit = lit_scene(_scene(path), mi_prt.PointLight(place, 1.0), modelled=True)
        other = ground_truth.indirect_irradiance(lit, points, 2 * effort.paths, None, LIGHT_SEED)
        lines.append(
            f"{other.mean.sum() / max(reflected.mean.sum(), 1e-30) - 1:+.1%} with {other.noise:.0%}"
            f" noise (here {reflected.noise:.0%})"
        )
    return (
        "Sum of irradiance by `path` with twice the paths, against the truth here, three lights in"
        f" {name}: {'; '.join(lines)}.\n"
    )


# --- samples --------------------------------------------------------------------------------------


def _distances(points, places):
    """Of places from the nearest sample, in radii and in the metric of thinning."""
    radius = points.layout.radius
    tree = cKDTree(embedded(points.positions, points.normals, radius))
    return tree.query(embedded(places.positions, places.normals, radius), workers=-1)[0] / radius


def _pair_correlation(scene, points):
    """Pairs of samples over pairs of random places on the same surface, by distance in radii."""
    radius, edges = points.layout.radius, np.linspace(0, 4, 61)
    low, high = points.positions.min(axis=0), points.positions.max(axis=0)
    positions, normals, count = [], [], 0
    for crossings, _ in cross_surfaces(
        scene, (low + high) / 2, np.linalg.norm(high - low) / 2, LIGHT_SEED
    ):
        reachable = crossings.at(_distances(points, crossings) < COVERED)
        positions.append(reachable.positions), normals.append(reachable.normals)
        count += len(reachable)
        if count >= len(points):
            break
    pairs = []
    for where, facing in (
        (points.positions, points.normals),
        (np.concatenate(positions), np.concatenate(normals)),
    ):
        first, second = cKDTree(where).query_pairs(edges[-1] * radius, output_type="ndarray").T
        alike = (facing[first] * facing[second]).sum(axis=1) > 0.5
        distance = np.linalg.norm(where[first] - where[second], axis=1)[alike] / radius
        pairs.append(np.histogram(distance, edges)[0] / len(where) ** 2)
    return (edges[1:] + edges[:-1]) / 2, pairs[0] / np.maximum(pairs[1], 1e-30)


def _cornell_area(scene):
    """m² of the Cornell box that light inside can reach, by its construction."""
    total = 0.0
    for surface in scene.surfaces:
        area = float(np.array(surface.shape.surface_area()).ravel()[0])
        positions, faces, *_ = mesh_arrays(surface.shape)
        if len(faces) == BOX_FACES:
            corners = positions[faces].astype(np.float64)
            areas = (
                np.linalg.norm(
                    np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
                )
                / 2
            )
            bottom = areas[(np.abs(corners[..., 1]) < 1e-4).all(axis=1)].sum()
            area -= 2 * bottom  # and the floor below it
        total += 2 * area if surface.shape.is_emitter() else area
    return total


def _draw_clusters(axis, points, clusters, title):
    """Samples that face the viewer, in parallel projection, far ones first."""
    sizes = np.diff(clusters.starts)
    toward = np.array([0.45, 0.5, 0.75])
    toward /= np.linalg.norm(toward)
    right = np.cross([0, 1, 0], toward)
    right /= np.linalg.norm(right)
    up = np.cross(toward, right)
    shown = np.flatnonzero(points.normals @ toward > 0)
    shown = shown[np.argsort(points.positions[shown] @ toward, kind="stable")]
    hues = plt.get_cmap("hsv")(np.random.default_rng(0).permutation(len(sizes)) / len(sizes))
    colours = np.repeat(hues, sizes, axis=0)
    axis.scatter(
        points.positions[shown] @ right,
        points.positions[shown] @ up,
        s=60_000 / len(points),
        c=colours[shown],
        lw=0,
    )
    roots = np.intersect1d(clusters.roots, shown)
    axis.scatter(
        points.positions[roots] @ right, points.positions[roots] @ up, s=8, c="black", lw=0
    )
    axis.set(title=title, aspect="equal"), axis.axis("off")


# --- encodings ------------------------------------------------------------------------------------


class _Tally:
    """What direct light gets wrong, over lights."""

    def __init__(self):
        self._wrong = self._facing = 0
        self._errors = []

    def add(self, result, truth, unblocked):
        above = unblocked > 0
        self._wrong += int(((result > unblocked / 2) != (truth > unblocked / 2))[above].sum())
        self._facing += int(above.sum())
        if truth.any():
            self._errors.append(metrics.relative_rmse(result, truth))

    @property
    def misclassified(self):
        return self._wrong / max(self._facing, 1)

    @property
    def direct_error(self):
        return float(np.median(self._errors)) if self._errors else 0.0


class _TableDirect(LocalDirect):
    """Direct light at some points, whose depths are read from a table instead of a basis.

    Parameters
    ----------
    asset : Asset
    chosen : (m,) int
        Points; irradiance of others means nothing.
    """

    def __init__(self, asset, chosen):
        local = asset.transports["local"]
        super().__init__(asset.points, local.clusters, local.depth)
        rows = np.zeros(len(asset.points), np.uint32)
        rows[chosen] = np.arange(len(chosen))
        self._rows = mitsuba().UInt32(rows)

    def show(self, depth):
        """Take other depths (m, N) in metres."""
        self._table = mitsuba().Float(np.ascontiguousarray(depth, np.float32).ravel())

    def _visibility(self, point, local, compared):
        import drjit as dr

        mi = mitsuba()
        row, visible = dr.gather(mi.UInt32, self._rows, point) * self._directions, mi.Float(0)
        for index, share in zip(*self._hemisphere.around(local)):
            depth = dr.gather(mi.Float, self._table, row + index)
            visible += share * dr.clip((depth / compared - 1) / local_direct.SOFTNESS + 0.5, 0, 1)
        return visible


_NO_CLEARANCE, _NO_TOLERANCE, _HARD = (
    {"CLEARANCE": 0.0, "CELLS": 0.0},
    {"TOLERANCE": 0.0, "BEHIND": 0.0},
    {"SOFTNESS": 1e-6},
)
TESTS = {
    "the program's": {},
    "without clearance": _NO_CLEARANCE,
    "without tolerance": _NO_TOLERANCE,
    "with neither": _NO_CLEARANCE | _NO_TOLERANCE,
    "hard": _HARD,
    "hard, with neither (the paper's)": _HARD | _NO_CLEARANCE | _NO_TOLERANCE,
}


def _encoding_tallies(path):
    (asset, _), scene = _precomputed(path), _scene(path)
    local = asset.transports["local"]
    hemisphere, extent, slices = local.depth.hemisphere, local.depth.extent, local.clusters.slices
    clusters = [
        slices[i] for i in np.linspace(0, len(slices) - 1, effort.encoded_clusters).astype(int)
    ]
    chosen = np.concatenate([np.arange(cluster.start, cluster.stop) for cluster in clusters])
    # Samples are in the order of their clusters.
    normals = asset.points.normals
    tracer = HemisphereTracer(scene, asset.points, local.clusters, hemisphere, 1)
    distances = [
        tracer.trace(cluster, cluster_frames(normals[cluster])).distance for cluster in clusters
    ]
    points = asset.points.at(chosen)
    emissions, truths = [], []
    for place in _lights(path, effort.encoded_lights):
        light = mi_prt.PointLight(place, 1.0)
        emissions.append(emission_of(as_light(light)))
        truth = ground_truth.local_irradiance(scene.occluders, points, [light])[:, 0]
        truths.append((truth, emissions[-1].irradiance(points.positions, points.normals)[:, 0]))
    tallies = {}

    def count(kind, label, direct):
        tallies[kind, label] = tally = _Tally()
        for emission, (truth, unblocked) in zip(emissions, truths):
            tally.add(next(iter(direct.irradiance(emission)))[chosen, 0], truth, unblocked)

    table = _TableDirect(asset, chosen)
    for encoding, (encode, decode) in _encodings(extent).items():
        for weighted in (True, False):
            table.show(
                np.concatenate(
                    [decode(_reconstructed(encode(d), hemisphere, weighted)) for d in distances]
                )
            )
            count("encoding", f"{encoding}{', cosine' if weighted else ''}", table)
    table.show(np.clip(np.concatenate(distances), 0, extent))
    count("encoding", f"none: all {len(hemisphere):,} distances", table)
    for test, constants in TESTS.items():
        with mock.patch.multiple(local_direct, **{"SOFTNESS": local_direct.SOFTNESS} | constants):
            count("test", test, LocalDirect(asset.points, local.clusters, local.depth))
    return tallies


def _encodings(extent):
    """Pairs of functions: from distance to what is compressed, and back."""
    near = NEAREST * extent
    return {
        "depth": (lambda d: np.minimum(d, 100 * extent), lambda e: e),
        "clamped depth": (lambda d: np.clip(d, near, extent), lambda e: e),
        "disparity": (
            lambda d: 1 / np.clip(d, near, extent),
            lambda e: 1 / np.maximum(e, 1 / (2 * extent)),
        ),
        "logarithm": (lambda d: np.log(np.clip(d, near, extent)), np.exp),
        "square root": (
            lambda d: np.sqrt(np.clip(d, near, extent)),
            lambda e: np.maximum(e, 0) ** 2,
        ),
    }


def _reconstructed(values, hemisphere, weighted):
    """Values (m, N) after compression to the default number of coefficients."""
    mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
    weights = (
        np.sqrt(hemisphere.vectors[:, 2] + np.float32(GRAZING))
        if weighted
        else np.ones(len(hemisphere), np.float32)
    )
    left, sizes, right = leading_components((values - mean) * weights, DEFAULTS.depth_coefficients)
    return mean + (left * sizes.astype(np.float32)) @ right / weights


def _tally_table(tallies, kind):
    head = " | ".join(f"{name}: misclassified | direct error" for name in tallies)
    yield f"| {kind} | {head} |\n|---|{'---:|' * 2 * len(tallies)}"
    for label in (label for of, label in next(iter(tallies.values())) if of == kind):
        cells = " | ".join(
            f"{t[kind, label].misclassified:.2%} | {t[kind, label].direct_error:.1%}"
            for t in tallies.values()
        )
        yield f"| {label} | {cells} |"


# --- extremes -------------------------------------------------------------------------------------


def _odd_places(asset):
    """Labels, places and intensities in the Cornell box, whose walls are at x = ±1, y = 0 and 2, z
    = −1.
    """
    points = asset.points
    floor = int(np.argmin(np.linalg.norm(points.positions - [0.3, 0, -0.6], axis=1)))
    position, normal = points.positions[floor].astype(np.float64), points.normals[floor]
    return [
        ("in free space", MIDDLE, 1.0),
        ("in a sample point", position, 1.0),
        ("10⁻³ m over it", position + 1e-3 * normal, 1.0),
        ("10⁻³ m under it, outside", position - 1e-3 * normal, 1.0),
        ("in a corner", (-1, 0, -1), 1.0),
        ("10⁻³ m from it", (-0.999, 0.001, -0.999), 1.0),
        ("10⁻³ m behind the back wall, outside", (0.2, 1, -1.001), 1.0),
        ("1 m behind the back wall, outside", (0.2, 1, -2), 1.0),
        ("1 km behind the back wall, outside", (0.2, 1, -1000), 1.0),
        ("in the closed box", (-0.335, 0.6, -0.291), 1.0),
        ("there, of 0 W/sr", MIDDLE, 0.0),
        ("there, of 10⁶ W/sr", MIDDLE, 1e6),
    ]


def _flux(asset, irradiance):
    """Share (n,) of 4π W that arrives at each point."""
    return irradiance.mean(axis=1, dtype=np.float64) * asset.points.areas / TOTAL_FLUX


def _flux_row(scene, asset, place, intensity, outside):
    light = mi_prt.PointLight(place, intensity)
    direct, indirect = (asset.irradiance(light, component) for component in ("direct", "indirect"))
    truth = ground_truth.local_irradiance(scene.occluders, asset.points, [light])
    sound = all(np.isfinite(x).all() and (x >= 0).all() for x in (direct, indirect))
    scale = 1 / intensity if intensity else 1.0
    ours, theirs, reflected = (_flux(asset, x) * scale for x in (direct, truth, indirect))
    dark = np.full(len(truth), True) if outside else truth[:, 0] == 0
    return (
        f"{'yes' if sound else '**no**'} | {direct.max():.3g} | {ours.sum():.1%} |"
        f" {theirs.sum():.1%} | {ours[dark].sum():.2%} | {reflected.sum():.1%}"
    )


def _diffuse(albedo):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}


def _viewer(place):
    mi = mitsuba()
    return {
        "type": "perspective",
        "to_world": (
            mi.ScalarTransform4f().look_at(
                place, [p + d for p, d in zip(place, (0.3, 0.1, 1))], [0, 1, 0]
            )
        ),
    }


def _divided_room():
    mi = mitsuba()
    return {
        "type": "scene",
        "one": _viewer([0.5, 0, 0]),
        "other": _viewer([-0.5, 0, 0]),
        "room": {"type": "cube", "flip_normals": True, "bsdf": _diffuse(0.7)},
        "wall": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().scale([0.005, 1.01, 1.01]),
            "bsdf": _diffuse(0.7),
        },
    }


def _furnace():
    """Energy in closed rooms: closed forms."""
    yield (
        "\nWhite furnace. In a sphere all reflected light is uniform, wherever the light stands: E"
        " = Φ/A · ρ/(1 − ρ). In any closed room what walls absorb is what the light sends: Σ area"
        f" · E · (1 − ρ) = Φ. {effort.furnace['count']:,} samples; values are relative to these and"
        " should be 1.\n\n| albedo ρ | sphere, light in the middle: mean (least … greatest) |"
        " light at 0.9 of the radius | 3 × 2 × 1 room with a box: absorbed"
        " |\n|---:|---:|---:|---:|"
    )
    mi = mitsuba()
    for albedo in (0.5, 0.8, 0.95):
        viewer = _viewer([0, 0.5, 0])
        sphere = {
            "type": "scene",
            "viewer": viewer,
            "room": {"type": "sphere", "flip_normals": True, "bsdf": _diffuse(albedo)},
        }
        room = {
            "type": "cube",
            "flip_normals": True,
            "to_world": mi.ScalarTransform4f().scale([1.5, 1, 0.5]),
            "bsdf": _diffuse(albedo),
        }
        box = {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([0.5, -0.8, 0]).scale(0.2),
            "bsdf": _diffuse(albedo),
        }
        round_room, square_room = (
            mi_prt.precompute(content, **LOCAL, **effort.furnace)
            for content in (sphere, {"type": "scene", "viewer": viewer, "room": room, "box": box})
        )
        cells = []
        for place in ((0, 0, 0), (0.9, 0, 0)):
            relative = round_room.irradiance(mi_prt.PointLight(place, 1.0), "indirect") / (
                albedo / (1 - albedo)
            )
            cells.append(f"{relative.mean():.4f} ({relative.min():.4f} … {relative.max():.4f})")
        absorbed = _flux(
            square_room, square_room.irradiance(mi_prt.PointLight((-1, 0.6, 0.2), 1.0))
        ).sum() * (1 - albedo)
        yield f"| {albedo} | {cells[0]} | {cells[1]} | {absorbed:.4f} |"


# --- trade ----------------------------------------------------------------------------------------


def _trade_values():
    """Values of each setting; the default among them."""
    if effort is QUICK:
        return {
            "depth_coefficients": (10, 50),
            "transfer_coefficients": (5, 20),
            "pca basis": (5, 20),
            "count": effort.trade_counts,
            "quantize": ("none", "16"),
        }
    return {
        "depth_coefficients": (10, 50, 200),
        "depth_directions": (504, 2016),
        "transfer_coefficients": (5, 10, 20, 32),
        "pca basis": (10, 32),
        "cluster_size": (28, 111, 444),  # 250, 1000, 4000 of 45,000
        "count": effort.trade_counts,
        "transfer_error": (0.0, 0.02, 0.1),
        "quantize": ("none", "16"),
    }


def _variant(setting, value):
    """Settings of a precomputation with one that is another, but for those that are as they are."""
    if setting == "pca basis":
        return {"transfer_coefficients": value, "pca": True}
    if value == _base(setting):
        return {}
    if setting == "count":  # with as many clusters
        return {
            "count": value,
            "cluster_size": round(value * _base("cluster_size") / _base("count")),
        }
    return {setting: value}


def _base(setting):
    """The value of a setting while another one changes."""
    return effort.trade.get(setting, getattr(DEFAULTS, setting, None))


_ROWS = {}


def _trade_row(path, changed):
    """Errors, bytes and seconds with some settings changed, a dict; measured once."""
    key = path, *sorted(changed.items())
    if key not in _ROWS:
        _ROWS[key] = _measured_trade(path, changed)
    return _ROWS[key]


def _measured_trade(path, changed):
    settings = effort.trade | changed
    pca = settings.pop("pca", False)
    with mock.patch.object(example_lights, "fit_senders", _paper_senders if pca else fit_senders):
        asset, cost = measure(path, **LOCAL, **settings)
    lights = _lights(path, effort.trade_lights)
    judged, _ = _judged(path, asset, lights)
    row = {
        key: float(np.median([light[key] for light in judged]))
        for key in ("misclassified", "direct", "indirect", "total")
    }
    row |= {
        "anywhere": float(np.median([_anywhere(path, asset, place) for place in lights])),
        "bytes": sum(array.nbytes for array in _stored(asset).values()),
        "seconds": sum(cost["seconds"].values()),
        "relight": _relit_seconds(asset, [mi_prt.PointLight(place, 1.0) for place in lights]),
    }
    return row


class _IdentityOfClusters:
    """The identity, one block of columns at a time."""

    def __getitem__(self, index):
        _, cluster = index
        return np.eye(cluster.stop - cluster.start, dtype=np.float32)


def _paper_senders(examples, importance, clusters, count, seed=0):
    """The paper's basis: principal components of the examples, however much of them arrives
    anywhere.
    """
    return fit_senders(examples, _IdentityOfClusters(), clusters, count, seed)


@cache
def _places(path):
    """Random places on surfaces that particles reach, Points."""
    hits = trace_particles(_scene(path), 1, LIGHT_SEED)[0]
    hits = hits.at(np.random.default_rng(0).permutation(len(hits))[: effort.compared])
    some = sample_points(_scene(path)).at(np.zeros(len(hits), int))
    return replace(
        some,
        positions=hits.positions,
        normals=hits.normals,
        geometric_normals=hits.geometric_normals,
        insets=np.zeros_like(hits.positions),
    )


def _locator(asset):
    points = asset.points
    return SampleLocator(points.positions, points.normals, points.layout.radius)


def _anywhere(path, asset, place):
    """Error of total light interpolated at places that are no samples."""
    mi = mitsuba()
    places = _places(path)
    direct, reflected = _truth(path, places, place)
    values = mi.Float(asset.irradiance(mi_prt.PointLight(place, 1.0)).ravel())
    where = mi.Point3f(places.positions.T), mi.Normal3f(places.normals.T)
    result = np.array(_locator(asset).interpolated(values, *where)[0]).T
    return _beyond_noise(result, Reference(direct + reflected.mean, reflected.standard_error))


def _draw_trade(curves, pictures, name):
    plotted = [setting for setting in curves if setting not in ("quantize", "pca basis")]
    figure, axes = plt.subplots(
        2, -(-len(plotted) // 2), figsize=(11, 6.4), sharey=True, squeeze=False
    )
    for axis, setting in zip(axes.flat, plotted):
        values = [value for value, _ in curves[setting]]
        for colour, key in enumerate(("direct", "indirect", "total", "anywhere")):
            axis.plot(
                values, [row[key] for _, row in curves[setting]], f"C{colour}o-", ms=4, label=key
            )
        if setting == "transfer_coefficients":
            axis.plot(
                *zip(*((value, row["indirect"]) for value, row in curves["pca basis"])),
                "C1x:",
                label="indirect, pca",
            )
        axis.set_xscale("symlog", linthresh=values[1] if values[0] == 0 else values[0])
        (
            axis.set_xticks(values, [f"{value:g}" for value in values], minor=False),
            axis.set_xticks([], minor=True),
        )
        axis.set(yscale="log", xlabel=setting.replace("_", " ")), axis.grid(alpha=0.3, which="both")
    for axis in axes[:, 0]:
        axis.set_ylabel("error")
    for axis in list(axes.flat)[len(plotted) :]:
        axis.axis("off")
    next(
        axis for axis, setting in zip(axes.flat, plotted) if setting == "transfer_coefficients"
    ).legend(fontsize=7)
    return saved(figure, pictures, name)


# --- speed ----------------------------------------------------------------------------------------


def _stored(asset):
    """Arrays of depth buffers and transfer as files have them."""
    arrays = asset.transports["local"].arrays()
    return {name: array for name, array in arrays.items() if not name.startswith("clusters")}


def _group_bytes(stored, group):
    return sum(size for name, size in stored.items() if name.split("_scale")[0] == group)


def _median_seconds(run):
    """Median time of `run(i)`, i = 0, 1, …; the first two do not count."""
    times = []
    for i in range(effort.repeat + 2):
        started = time.perf_counter()
        run(i)
        times.append(time.perf_counter() - started)
    return float(np.median(times[2:]))


def _relit_seconds(asset, lights, component="total"):
    return _median_seconds(lambda i: asset.irradiance(lights[i % len(lights)], component))


def _relighting(path, asset):
    places = _lights(path, 20)
    points = [mi_prt.PointLight(place, 1.0) for place in places]
    areas = [mi_prt.AreaLight(place, (0.3, 0, 0), (0, 0, 0.3), 1.0) for place in places]
    yield (
        "\nRelighting, the light somewhere else each time; medians.\n\n| light | component | ms |"
        " times/s | asked | kernels compiled |\n|---|---|---:|---:|---:|---:|"
    )
    for label, lights, asked in (
        ("point", points, 30),
        (f"area of {areas[0].samples} samples", areas, 10),
    ):
        for component in ("total", "direct", "indirect"):
            asset.irradiance(lights[0], component)
            with count_kernels() as counted:
                seconds = _relit_seconds(asset, lights, component)
            bound = f"≥ {asked}" if component == "total" else ""
            yield (
                f"| {label} | {component} | {1e3 * seconds:.1f} | {1 / seconds:.0f} | {bound} |"
                f" {counted.compiled} |"
            )


def _brute_force(path, asset):
    """What the same irradiance takes without precomputation."""
    scene, n = _scene(path), len(asset.points)
    places = _lights(path, effort.lights)[:5]
    chosen = _compared(asset)
    points = asset.points.at(chosen)
    lights = [mi_prt.PointLight(place, 1.0) for place in places]
    relit = _relit_seconds(asset, lights)
    shadow = _median_seconds(
        lambda i: ground_truth.local_irradiance(
            scene.occluders, asset.points, [lights[i % len(lights)]]
        )
    )
    needed = {}
    for i, (place, light) in enumerate(zip(places, lights)):
        _, truth = _truth(path, points, place)
        error = _beyond_noise(asset.irradiance(light, "indirect")[chosen], truth)
        lit = lit_scene(scene, light, modelled=True)
        for way, run, where in (
            ("Mitsuba's `path`", ground_truth.indirect_irradiance, (effort.paths, None)),
            ("the bidirectional estimate", _reflected_irradiance, (place, effort.paths)),
        ):
            if i == 0:
                run(lit, points, *where, LIGHT_SEED + 1)  # compiles
            started = time.perf_counter()
            noise = run(lit, points, *where, LIGHT_SEED + 1).noise
            needed.setdefault(way, []).append(
                (time.perf_counter() - started) * n / len(points) * (noise / max(error, 1e-9)) ** 2
            )
    shown = "; ".join(
        f"by {way} {np.median(s):.0f} s, in all {(shadow + np.median(s)) / relit:,.0f} times as"
        " long as relighting"
        for way, s in needed.items()
    )
    yield (
        f"\nBrute force, the same {n:,} points and {len(places)} lights: shadow rays for direct"
        f" light {1e3 * shadow:.1f} ms ({shadow / relit:.2f} times all of relighting, which takes"
        f" {1e3 * relit:.1f} ms); paths for reflected light until their noise is the error of"
        f" relighting, extrapolated from {effort.paths} paths at {len(points):,} points (median):"
        f" {shown}."
    )


if __name__ == "__main__":
    main()
