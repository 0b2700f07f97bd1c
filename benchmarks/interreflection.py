"""Reflected light, measured: the two ways to it against each other and Mitsuba, noise, energy,
speed; writes docs/interreflection.md.

Usage: python benchmarks/interreflection.py [--assets DIR] [--output docs/interreflection.md]
[--only methods,bounces,…]

DIR holds meshes/*.ply, hdr/*.exr and scenes/*/scene.xml (see benchmarks/README.md). With --only the
other sections of the page stay as they are. Nothing else should run on the machine meanwhile: some
sections tell times.
"""

import time
import warnings

import numpy as np
from bunny import bunny_on_plane
from page import ROOT, plt, saved, write_page
from PIL import Image

import mi_prt
from mi_prt import LightWarning
from mi_prt.directions import parse_directions
from mi_prt.evaluate import ground_truth, metrics
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.precompute.precompute import measure
from mi_prt.render.display import display, exposure
from mi_prt.render.image import pick_sensor, render_image, resized
from mi_prt.scene.scene import open_scene

SCENES = ("cornell_sky", "still_life", "teapot")
INTERIORS = ("cornell-box", "veach-ajar")
RAYS = (16, 64, 256, 1024)
COMPARED = 500
BOUNCES = 3


def main():
    warnings.simplefilter("ignore", LightWarning)
    write_page(__doc__, HEAD, SECTIONS, "interreflection.md")


HEAD = """# Reflected light, measured

Made by `benchmarks/interreflection.py` on two CPU cores. Directions are `cubemap:32` unless said
otherwise; errors are relative RMSE at points that are not buried, with the reference's own noise
taken out. How reflections are computed, and why this way, is in [architecture](architecture.md)."""


# --- sections -------------------------------------------------------------------------------------


def methods(assets, pictures):
    """Both ways against Mitsuba, over the number of rays."""
    yield "## Two ways: `solve` and `paths`\n"
    yield (
        f"Irradiance by {BOUNCES} reflections alone (the difference of an asset with and one"
        f" without them, 64 coefficients) at {COMPARED} points under the scene's own sky, against"
        " Mitsuba's `path` (16,384 paths from each point). `solve` sends rays once and lets light"
        " go from point to point; `paths` follows it from each point until it leaves. Seconds are"
        " those of the reflections alone. *Not denoised* are the same rays with `--no-denoise`.\n"
    )
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True)
    for axis, name in zip(axes, SCENES):
        path = ROOT / "scenes" / f"{name}.xml"
        scene = open_scene(path)
        light = scene_light(scene)
        direct, _ = measure(path, coefficients=64, bounces=0)
        chosen = _some(direct)
        truth = ground_truth.indirect_irradiance(
            lit_scene(scene, light, modelled=True), direct.points.at(chosen), 16384, BOUNCES
        )
        whole = (
            ground_truth.point_irradiance(
                lit_scene(scene, light, modelled=True), direct.points.at(chosen), 8192
            ).mean
            + truth.mean
        )
        share = np.linalg.norm(truth.mean) / np.linalg.norm(whole)
        without = direct.irradiance(light)[chosen]
        yield (
            f"\n{name}, {len(direct.points):,} points; reflected light is {share:.1%} of all"
            f" (norms), the reference's noise {truth.noise:.1%} of it\n"
        )
        yield (
            "| | rays per point | seconds | error of reflected light | not denoised | bias | of all"
            " light |"
        )
        yield "|---|---:|---:|---:|---:|---:|---:|"
        for way in ("solve", "paths"):
            curve = []
            for rays in RAYS:
                settings = {
                    "coefficients": 64,
                    "bounces": BOUNCES,
                    "indirect": way,
                    "paths_per_point": rays,
                }
                asset, cost = measure(path, **settings)
                plain = mi_prt.precompute(path, denoise=False, **settings)
                errors = [
                    _error(a.irradiance(light)[chosen] - without, truth) for a in (asset, plain)
                ]
                bias = metrics.relative_bias(asset.irradiance(light)[chosen] - without, truth.mean)
                curve.append(errors)
                yield (
                    f"| `{way}` | {rays:,} | {cost['seconds']['indirect']:.1f} | {errors[0]:.1%} |"
                    f" {errors[1]:.1%} | {bias:+.1%} | {errors[0] * share:.2%} |"
                )
            colour = "C3" if way == "solve" else "C0"
            axis.loglog(RAYS, np.array(curve)[:, 0], f"{colour}o-", label=way)
            axis.loglog(RAYS, np.array(curve)[:, 1], f"{colour}x:", label=f"{way}, not denoised")
        axis.set(title=name, xlabel="rays per point"), axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("error of reflected light"), axes[0].legend(fontsize=8)
    yield saved(figure, pictures, "methods")
    yield (
        "The same number of rays takes about as long either way, and leaves `paths` with several"
        " times the noise: a path brings back one direction, a hop all that the point at its end"
        " sees. `solve` with 64 rays is as good as `paths` with 1,024 or better, and is the"
        " default. What it levels off at is the basis (6.5 % in the Cornell box) and interpolation"
        " of irradiance between points (still life, whose points are 0.23 m apart), the same for"
        " any number of rays. `paths` is the way where nothing must be taken from other points: few"
        " points on large faces, nearly closed white rooms, or a proof; its bias is that of the"
        " basis alone."
    )


def noise(assets, pictures):
    """How noise falls with rays, and what denoising takes of it."""
    yield "## Noise, and what denoising takes\n"
    yield (
        "Noise of the coefficients of reflected light (192 shared wavelets, Cornell box under a"
        " sky, points 0.1 apart), against `solve` with 8,192 rays from each point, relative to"
        " reflected light. *Estimated* is what the two halves of the rays tell of it, and the asset"
        " reports.\n"
    )
    yield (
        "| | rays per point | noise | estimated | with denoising | noise that the filter lets"
        " through |\n|---|---:|---:|---:|---:|---:|"
    )
    path = ROOT / "scenes" / "cornell_sky.xml"
    settings = {"basis": "haar-shared", "coefficients": 192, "bounces": BOUNCES, "edge_length": 0.1}
    direct = mi_prt.precompute(path, **settings | {"bounces": 0})
    kept = ~direct.buried

    def reflected(**more):
        asset = mi_prt.precompute(path, **settings | more)
        return asset, (_distant(asset).coefficients - _distant(direct).coefficients[:, None])[kept]

    _, exact = reflected(paths_per_point=8192, denoise=False)
    size = np.linalg.norm(exact)
    for way in ("solve", "paths"):
        plain = []
        for rays in (16, 64, 256, 1024):
            asset, noisy = reflected(indirect=way, paths_per_point=rays, denoise=False)
            filtered, clean = reflected(indirect=way, paths_per_point=rays)
            plain.append(np.linalg.norm(noisy - exact) / size)
            estimate = (
                _distant(asset).report["indirect_noise"]
                * np.linalg.norm(_distant(direct).coefficients[kept])
                * 3**0.5
                / size
            )
            yield (
                f"| `{way}` | {rays:,} | {plain[-1]:.2%} | {estimate:.2%} |"
                f" {np.linalg.norm(clean - exact) / size:.2%} |"
                f" {_distant(filtered).report['indirect_noise_passed']:.0%} |"
            )
        slope = np.polyfit(np.log(RAYS), np.log(plain), 1)[0]
        yield f"| `{way}` | slope | N^{slope:.2f} | | | |"
    yield (
        "\nThe rule: coefficients are taken apart into components in which signal and noise are"
        " both uncorrelated (their covariances are told by two independent halves of the rays), and"
        " each is scaled by the share of its variance that is signal. The noise of `paths` is"
        " spread evenly over all components while signal is not, so most of it goes. The noise of"
        " `solve` is made of the light of other points and lies in the same components as the"
        " signal: there is little to take, and with 256 rays nothing."
    )


def bounces(assets, pictures):
    """The energy of each reflection."""
    yield "## Energy by reflections\n"
    yield (
        "Mean irradiance under a uniform sky in units of π (an open sky gives 1), direct and after"
        " 1, 2, … reflections, as `mi-prt info` tells of an asset; and how many `--bounces auto`"
        " takes.\n"
    )
    yield (
        "| scene | points | direct | 1 | 2 | 3 | 4 | 5 | `auto` takes | left"
        " |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
    )
    paths = [ROOT / "scenes" / f"{name}.xml" for name in SCENES] + [
        assets / "scenes" / name / "scene.xml" for name in INTERIORS
    ]
    for path in paths:
        asset = mi_prt.precompute(
            path, transports="distant", directions="cubemap:16", coefficients=16
        )
        energy = [f"{x:.2g}" for x in _distant(asset).report["bounce_energy"][:6]] + [""] * 6
        name = path.stem if path.stem != "scene" else path.parent.name
        left = _distant(asset).report.get("bounce_energy_left") or 0.0
        yield (
            f"| {name} | {len(asset.points):,} | {' | '.join(energy[:6])} |"
            f" {_distant(asset).report['bounces']} | {left:.1g} |"
        )


def furnace(assets, pictures):
    """Outgoing radiance of white surfaces under a white sky."""
    yield "## White furnace\n"
    yield (
        "Albedo 1 under a sky of radiance 1: outgoing radiance is 1 at every point. Deviation of"
        " `solve` (all reflections, 64 rays from each point) at points that are not buried;"
        " *normals off their faces* are points whose smooth normal is more than 1° off the faces"
        " around it, so that its hemisphere dips below them. One spherical harmonic suffices: it"
        " holds the irradiance under a uniform sky exactly.\n"
    )
    yield (
        "| scene | points | normals off their faces | direct light alone | mean | least | greatest"
        " |\n|---|---:|---:|---:|---:|---:|---:|"
    )
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    for name in ("horse", "dragon", "spot"):
        content = bunny_on_plane(assets)
        content["bunny"]["filename"] = str(assets / "meshes" / f"{name}.ply")
        for part in ("bunny", "plane"):
            content[part]["bsdf"] = white
        asset = mi_prt.precompute(
            content,
            directions="cubemap:16",
            basis="sh",
            coefficients=1,
            paths_per_point=64,
            edge_length=0.2,
        )
        radiance = asset.relight(mi_prt.EnvironmentMap(np.ones((2, 4, 3), np.float32)))[
            ~asset.buried
        ]
        direct = _distant(asset).report["bounce_energy"][0]
        off = asset.points.report["dipping_hemispheres"]
        yield (
            f"| {name} on a plane | {len(asset.points):,} | {off:,} | {direct:.3f} |"
            f" {radiance.mean():.5f} | {radiance.min():.4f} | {radiance.max():.4f} |"
        )


def speed(assets, pictures):
    """The bunny on a plane, to an accuracy."""
    yield "## Speed: bunny on a plane\n"
    started = time.perf_counter()
    content = bunny_on_plane(assets)
    settings = {"directions": "cubemap:32", "rays_per_direction": 4, "coefficients": 512}
    asset, cost = measure(content, bounces=BOUNCES, **settings)
    seconds = time.perf_counter() - started
    started = time.perf_counter()
    measure(content, bounces=0, **settings)
    direct_seconds = time.perf_counter() - started
    stages = ", ".join(f"{name} {value:.1f}" for name, value in cost["seconds"].items())
    yield (
        f"{len(asset.points):,} points, `cubemap:32` with 4 rays in each cell, 512 coefficients,"
        f" {BOUNCES} reflections, albedo 0.5, {_distant(asset).report['paths_per_point']} rays for"
        f" reflections from each point (`auto`): **{seconds:.1f} s** ({stages}); direct light alone"
        f" {direct_seconds:.1f} s, ratio {seconds / direct_seconds:.2f}.\n"
    )
    chosen = _some(asset, 1000)
    scene = open_scene(content)
    yield "| map | reference noise | error of all light | bias |\n|---|---:|---:|---:|"
    worst = 0.0
    for path in sorted((assets / "hdr").glob("*.exr")):
        environment = mi_prt.EnvironmentMap(path)
        lit = lit_scene(scene, environment)
        truth = ground_truth.irradiance(lit, asset.points.at(chosen), 16384, 4096, BOUNCES)
        result = asset.irradiance(environment)[chosen]
        error = _error(result, truth)
        worst = max(worst, error)
        yield (
            f"| {path.stem} | {truth.noise:.2%} | {error:.2%} |"
            f" {metrics.relative_bias(result, truth.mean):+.2%} |"
        )
    yield f"\nWorst: {worst:.2%} (bound 2 %)."
    yield from _against_mitsuba(scene, asset, seconds)


def _against_mitsuba(scene, asset, seconds):
    """What Mitsuba would take for every direction, from a few of them."""
    directions = parse_directions("cubemap:32")
    few = np.random.default_rng(0).choice(len(directions), 12, replace=False)
    paths = 64
    errors, spent = [], 0.0
    for direction in directions.vectors[few]:
        lit = lit_scene(scene, mi_prt.DirectionalLight(direction=-direction, irradiance=(1, 1, 1)))
        # compiles
        ground_truth.indirect_irradiance(lit, asset.points.at(np.arange(64)), paths, BOUNCES)
        started = time.perf_counter()
        truth = ground_truth.irradiance(lit, asset.points, 2, paths, BOUNCES)
        spent += time.perf_counter() - started
        errors.append(truth.noise)
    noise = float(np.median(errors))
    wanted = _distant(asset).report["indirect_noise"]
    factor = (noise / wanted) ** 2
    total = spent / len(few) * len(directions)
    yield (
        f"\nMitsuba's `path` from the same points, one direction of light at a time ({len(few)} of"
        f" {len(directions):,} tried, {paths} paths from each point): {spent / len(few):.2f} s a"
        f" direction, {total / 3600:.1f} h for all, with {noise:.1%} noise. That is"
        f" {total / seconds:,.0f} times the precomputation; to the noise that the asset reports"
        f" ({wanted:.2%} of the transport) it would be {total * factor / seconds:,.0f} times."
    )


def cornell(assets, pictures):
    """Picture beside ground truth."""
    yield "## Cornell box open to the sky\n"
    path = ROOT / "scenes" / "cornell_sky.xml"
    asset, cost = measure(path, coefficients=256, rays_per_direction=4)
    scene = open_scene(path)
    lit = lit_scene(scene, scene_light(scene))
    with resized(pick_sensor(lit, 0), (480, 400)) as camera:
        truth = ground_truth.image(lit, camera, 2048, 0, -1).mean
        direct = ground_truth.image(lit, camera, 512, 0, 2).mean
        ours = render_image(asset, lit, camera, 64)
    factor = exposure(truth)
    shown = np.concatenate([display(x, factor) for x in (direct, ours, truth)], axis=1)
    Image.fromarray((shown * 255 + 0.5).astype("uint8")).save(pictures / "cornell.png")
    yield (
        "Left: direct light alone. Middle: mi_prt, 256 coefficients,"
        f" {_distant(asset).report['bounces']} reflections (`auto`), precomputed in"
        f" {sum(cost['seconds'].values()):.0f} s and relit in milliseconds."
        " Right: Mitsuba's `path` without a limit of depth, 2,048 samples per pixel."
        f" Relative RMSE {metrics.relative_rmse(ours, truth):.1%}, bias"
        f" {metrics.relative_bias(ours, truth):+.2%} (of direct light alone"
        f" {metrics.relative_rmse(direct, truth):.0%} and"
        f" {metrics.relative_bias(direct, truth):+.0%}).\n"
    )
    yield f"![A Cornell box open to the sky]({pictures.name}/cornell.png)"


SECTIONS = {
    "cornell": cornell,
    "methods": methods,
    "noise": noise,
    "bounces": bounces,
    "furnace": furnace,
    "speed": speed,
}


# --- helpers --------------------------------------------------------------------------------------


def _distant(asset):
    """The asset's transport of distant light."""
    return asset.transports["distant"]


def _some(asset, count=COMPARED):
    return np.sort(np.random.default_rng(0).permutation(np.flatnonzero(~asset.buried))[:count])


def _error(result, truth):
    """Relative RMSE with the reference's noise taken out."""
    return np.sqrt(max(metrics.relative_rmse(result, truth.mean) ** 2 - truth.noise**2, 0))


if __name__ == "__main__":
    main()
