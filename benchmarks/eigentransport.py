"""The figures and claims of the Eigentransport paper, measured on real meshes and maps; writes
docs/eigentransport.md.

Usage: python benchmarks/eigentransport.py [--assets DIR] [--output docs/eigentransport.md] [--only
variance,error,…]

DIR holds meshes/*.ply and hdr/*.exr (see benchmarks/README.md). With --only the other sections of
the page stay as they are. Nothing else should run on the machine meanwhile: some sections tell
times.
"""

import json
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import matplotlib
import numpy as np
from page import ROOT, saved, write_page

import mi_prt
from mi_prt import LightWarning
from mi_prt.basis.basis import BASES
from mi_prt.basis.rows import Rows
from mi_prt.basis.target import Target
from mi_prt.directions import Cubemap
from mi_prt.evaluate import metrics
from mi_prt.evaluate.ground_truth import image, point_irradiance
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.lighting.lattice import on_lattice
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.points import sample_points
from mi_prt.render.display import display, exposure
from mi_prt.render.image import coverage, pick_sensor, render_image, resized
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import mitsuba
from mi_prt.transport.bits import sample_direct
from mi_prt.transport.distant import storage_bytes

matplotlib.use("Agg")
import matplotlib.pyplot as plt

MESHES = ("teapot", "bunny", "horse")
PAPER_MESHES = ("bunny", "horse", "dragon", "buddha", "camel", "spot", "teapot", "chinese_dragon")
DIRECTIONS = Cubemap(32)
FITTED_POINTS = 20_000  # at most, a random subset of a mesh's
MOST = 512
COUNTS = (4, 9, 16, 25, 36, 49, 64, 100, 144, 196, 256, 361, 484)
COLOURS = {"pca": "C3", "sh": "C0", "haar": "C2", "haar-shared": "C1"}
NAMES = {
    "pca": "PCA",
    "sh": "SH",
    "haar": "Haar, best of each row",
    "haar-shared": "Haar, one shared set",
}
SHADING = 12, 36, 96, 192
POINT_SAMPLES = 8192


def main():
    warnings.simplefilter("ignore", LightWarning)
    write_page(__doc__, HEAD, SECTIONS, "eigentransport.md")


HEAD = """# The Eigentransport paper, measured

Made by `benchmarks/eigentransport.py` on two CPU cores. Paper: Nowrouzezahrai, Simari,
Kalogerakis, Fiume: *Eigentransport for Efficient and Accurate All-Frequency Relighting* (2007);
figure and section numbers are the paper's. Directions are `cubemap:32` (6,144) unless said
otherwise. Errors of transport are ‖T − T̂‖/‖T‖ over the fitted rows (at most 20,000 points that
see the sky, picked at random), in the norm of the sphere: each direction weighs its solid angle.
Meshes have a largest extent of 2 m; planes are 8 m wide."""


# --- scenes and transport -------------------------------------------------------------------------


def mesh_scene(assets, mesh, plane):
    """Scene dict: a mesh, 2 m tall or long, alone or on a plane of 8 m × 8 m."""
    parts = {
        "type": "scene",
        "mesh": {"type": "ply", "filename": str(assets / "meshes" / f"{mesh}.ply")},
    }
    if plane:
        transform = mitsuba().ScalarTransform4f
        parts["plane"] = {
            "type": "rectangle",
            "to_world": transform().rotate([1, 0, 0], -90).scale(4),
        }
    return open_scene(parts)


class Sampled:
    """Transport of a mesh's points and the rows that bases are fitted to."""

    def __init__(self, assets, mesh, plane):
        self.scene = mesh_scene(assets, mesh, plane)
        self.points = sample_points(self.scene)
        self.transport = sample_direct(self.scene, self.points, DIRECTIONS)
        lit = np.flatnonzero(~self.transport.dark())
        random = np.random.default_rng(0)
        self.index = np.sort(random.choice(lit, min(FITTED_POINTS, len(lit)), replace=False))
        self.rows = Rows(self.transport.rows, self.index, DIRECTIONS)

    def fit(self, kind, components):
        return BASES[kind].fit(self.rows, Target(components))


def residuals(fit, components):
    """Relative error of the transport with the first `components` of a fit, from the energies of
    its components.
    """
    share = fit.basis.captured_variance
    # Shares are energies over the variance, so a fit tells the ratio of total energy and variance
    # itself.
    left = 1 - fit.captured_variance
    kept = share.sum() - share[:components].sum()
    return np.sqrt(max(left + kept, 0) / left) * fit.relative_error if left > 0 else 0.0


# --- sections -------------------------------------------------------------------------------------


def captured_variance(assets, pictures):
    """Figure 2."""
    yield "## Captured variance (Figure 2)\n"
    yield f"Components that capture a share of the variance of at most {FITTED_POINTS:,} points.\n"
    yield "| scene | points | 90 % | 95 % | 99 % | captured by 48 | relative error with 48 |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    figure, axes = plt.subplots(figsize=(6, 3.8))
    needed, errors = {}, {}
    for i, mesh in enumerate(MESHES):
        for plane in (False, True):
            sampled = Sampled(assets, mesh, plane)
            fit = sampled.fit("pca", MOST)
            total = np.cumsum(fit.basis.captured_variance)
            counts = [
                1 + int(np.searchsorted(total, share)) if total[-1] >= share else None
                for share in (0.9, 0.95, 0.99)
            ]
            needed[mesh, plane], errors[mesh, plane] = counts, residuals(fit, 48)
            name = f"{mesh} on a plane" if plane else mesh
            texts = [str(count) if count else f"> {MOST}" for count in counts]
            yield (
                f"| {name} | {len(sampled.points):,} | {' | '.join(texts)} | {total[47]:.2%} |"
                f" {errors[mesh, plane]:.3f} |"
            )
            axes.plot(
                np.arange(1, len(total) + 1), total, f"C{i}{'--' if plane else '-'}", label=name
            )
    axes.set(xscale="log", xlabel="components", ylabel="captured variance", ylim=(0.3, 1))
    axes.grid(alpha=0.3), axes.legend(fontsize=8)
    yield saved(figure, pictures, "variance")
    worse = [mesh for mesh in MESHES if _more(needed[mesh, True][1], needed[mesh, False][1])]
    better = [mesh for mesh in MESHES if _more(needed[mesh, False][1], needed[mesh, True][1])]
    yield (
        "The paper says that added planes make the basis less effective. By components for 95 % of"
        f" the variance a plane makes it worse for {_listed(worse)} and better for"
        f" {_listed(better)}. The share is of another whole, though: rows of a plane are brighter,"
        " so that the same share lost is less of the light. By relative error, the last column, 48"
        " components are worse with a plane for"
        f" {_listed([mesh for mesh in MESHES if errors[mesh, True] > errors[mesh, False]])}."
    )


def _more(a, b):
    return (a or np.inf) > (b or np.inf)


def transport_error(assets, pictures):
    """Figures 3 and 10."""
    yield "## Error of the transport (Figures 3 and 10)\n"
    figure, axes = plt.subplots(len(MESHES), 2, figsize=(9, 3 * len(MESHES)), sharey="row")
    crossings = []
    for row, mesh in zip(axes, MESHES):
        sampled = Sampled(assets, mesh, True)
        n, s = len(sampled.points), len(DIRECTIONS)
        fits = {kind: sampled.fit(kind, 484 if kind == "sh" else MOST) for kind in NAMES}
        errors = {kind: np.array([residuals(fit, d) for d in COUNTS]) for kind, fit in fits.items()}
        assert (errors["pca"] <= errors["sh"] + 1e-6).all() and (
            errors["pca"] <= errors["haar-shared"] + 1e-6
        ).all()
        yield f"\n{mesh} on a plane, {n:,} points: relative error of the transport\n"
        yield "| coefficients | " + " | ".join(map(str, COUNTS)) + " |"
        yield "|---|" + "---:|" * len(COUNTS)
        for kind, name in NAMES.items():
            yield f"| {name} | " + " | ".join(f"{error:.3f}" for error in errors[kind]) + " |"
            size = np.array([sum(storage_bytes(BASES[kind], n, s, d)) for d in COUNTS]) / 1e6
            row[0].plot(COUNTS, errors[kind], ".-", color=COLOURS[kind], label=name)
            row[1].plot(size, errors[kind], ".-", color=COLOURS[kind])
            if kind != "pca":
                crossings.append(_crossing(mesh, name, kind, fits, errors, n, s))
        (
            row[0].set(xscale="log", yscale="log", ylabel=f"{mesh}: relative error"),
            row[0].grid(alpha=0.3, which="both"),
        )
        row[1].set(xscale="log"), row[1].grid(alpha=0.3, which="both")
    axes[-1][0].set_xlabel("coefficients"), axes[-1][1].set_xlabel("stored MB, projection included")
    axes[0][0].legend(fontsize=7)
    yield saved(figure, pictures, "error")
    yield "Where the others pass below PCA:\n"
    yield (
        "| scene | basis | at equal count | at equal bytes (indices and projection counted)"
        " |\n|---|---|---|---|"
    )
    yield from crossings
    yield (
        "\nPCA is never above SH or shared Haar at equal count, as it must be (both are linear"
        " subspaces; asserted here and in the tests)."
    )
    yield from transport_functions(assets, pictures)


def _crossing(mesh, name, kind, fits, errors, n, s):
    counts = np.arange(1, MOST + 1)
    if kind == "sh":
        counts = np.arange(1, 23) ** 2
    other = np.array([residuals(fits[kind], d) for d in counts])
    every = np.arange(1, MOST + 1)
    pca = np.array([residuals(fits["pca"], d) for d in every])
    below = counts[_from_then_on(other < np.interp(counts, every, pca) - 1e-6)]
    by_count = f"from {below[0]} coefficients" if len(below) else f"never up to {counts[-1]}"
    sizes = [
        np.array([sum(storage_bytes(BASES[k], n, s, int(d))) for d in c]) / 1e6
        for k, c in ((kind, counts), ("pca", every))
    ]
    inside = (sizes[0] >= sizes[1][0]) & (sizes[0] <= sizes[1][-1])
    better = _from_then_on((other < np.interp(sizes[0], sizes[1], pca))[inside])
    first = np.flatnonzero(inside)[better]
    by_size = (
        f"from {sizes[0][first[0]]:.1f} MB ({counts[first[0]]} coefficients)"
        if len(first)
        else "never in this range"
    )
    return f"| {mesh} | {name} | {by_count} | {by_size} |"


def _from_then_on(is_true):
    """Where something is true and stays so up to the end."""
    return np.logical_and.accumulate(is_true[::-1])[::-1]


def transport_functions(assets, pictures):
    """Figure 3: some rows as pictures."""
    sampled = Sampled(assets, "bunny", True)
    height = sampled.points.positions[:, 1]
    distance = np.linalg.norm(sampled.points.positions[:, [0, 2]], axis=1)
    chosen = [
        int(np.argmax(height)),
        int(
            np.flatnonzero((height < 1e-4) & (distance > 0.9))[
                np.argmin(distance[(height < 1e-4) & (distance > 0.9)])
            ]
        ),
        int(np.argmin(np.abs(height - 0.5) + 10 * (distance > 0.9))),
    ]
    rows = sampled.transport.rows(np.array(sorted(chosen)))
    shown = [("sampled", rows)]
    for kind, components in (
        ("pca", 48),
        ("pca", 192),
        ("sh", 49),
        ("haar", 48),
        ("haar-shared", 48),
    ):
        basis = sampled.fit(kind, components).basis
        shown.append(
            (
                (
                    f"{NAMES[kind].split(',')[0]}"
                    f" {components}{' shared' if kind == 'haar-shared' else ''}"
                ),
                basis.reconstruct(basis.encode(rows.copy())),
            )
        )
    v, u = (np.indices((64, 128)).reshape(2, -1) + 0.5) / [[64], [128]]
    cells = DIRECTIONS.cells(
        np.stack(
            [
                np.sin(2 * np.pi * u) * np.sin(np.pi * v),
                np.cos(np.pi * v),
                -np.cos(2 * np.pi * u) * np.sin(np.pi * v),
            ],
            axis=-1,
        )
    )
    figure, axes = plt.subplots(len(rows), len(shown), figsize=(11, 3.2))
    for j, (name, reconstruction) in enumerate(shown):
        for i, row in enumerate(reconstruction):
            (
                axes[i][j].imshow(row[cells].reshape(64, 128), vmin=0, vmax=1, cmap="gray"),
                axes[i][j].set_axis_off(),
            )
        axes[0][j].set_title(name, fontsize=8)
    yield "\nTransport of three points of the bunny on a plane, latitude and longitude:\n"
    yield saved(figure, pictures, "functions")


def shading(assets, pictures):
    """Figure 8."""
    yield "## Shading (Figure 8)\n"
    yield (
        "The teapot of `scenes/` under its own sky against Mitsuba's path tracer (direct light, 512"
        " samples per pixel).\n"
    )
    path = ROOT / "scenes" / "teapot.xml"
    scene = open_scene(path)
    light = scene_light(scene)
    truth = lit_scene(scene, modelled=True)
    with resized(pick_sensor(truth, 0), (400, 300)) as camera:
        reference = image(truth, camera, 512)
        covered = coverage(truth, camera, 64) > 1 - 1e-4
        factor = exposure(reference.mean[covered])
        shown = [("Mitsuba", reference.mean)]
        yield (
            "| basis | captured variance | relative error of transport | irradiance at points: RMSE"
            " beyond noise | bias | image: RMSE beyond noise | FLIP |"
        )
        yield "|---|---:|---:|---:|---:|---:|---:|"
        at_points = None
        for kind, components in [("pca", d) for d in SHADING] + [
            ("sh", 36),
            ("haar", 36),
            ("none", None),
        ]:
            asset = mi_prt.precompute(
                path, basis=kind, coefficients=components, rays_per_direction=4, bounces=0
            )
            if at_points is None:
                chosen = np.sort(np.random.default_rng(0).permutation(len(asset.points))[:3000])
                at_points = point_irradiance(truth, asset.points.at(chosen), POINT_SAMPLES)
            irradiance = asset.irradiance(light)[chosen]
            picture = render_image(asset, truth, camera, 64)
            rmse = metrics.relative_rmse(picture[covered], reference.mean[covered])
            noise = np.linalg.norm(reference.standard_error[covered]) / np.linalg.norm(
                reference.mean[covered]
            )
            flip, _ = metrics.flip(display(picture, factor), display(reference.mean, factor))
            held = asset.transports["distant"]
            name = f"{kind} {components}" if components else "none (all directions)"
            yield (
                f"| {name} | {held.report['captured_variance']:.2%} |"
                f" {held.report['relative_error']:.3f} | {_beyond(irradiance, at_points):.2%} |"
                f" {metrics.relative_bias(irradiance, at_points.mean):+.2%} |"
                f" {np.sqrt(max(rmse**2 - noise**2, 0)):.2%} | {flip:.3f} |"
            )
            shown.append((name, picture))
    figure, axes = plt.subplots(2, 4, figsize=(12, 4.8))
    for axis, (name, picture) in zip(axes.flat, shown):
        axis.imshow(display(picture, factor)), axis.set_axis_off(), axis.set_title(name, fontsize=9)
    yield saved(figure, pictures, "shading")


def rotation(assets, pictures):
    """Figure 9."""
    yield "## Turning light (section 5, Figure 9)\n"
    yield (
        "Light turned about (1, 2, 3) by 37°. *Cells*: relative L2 difference of the cells'"
        " radiance from that of the turned map, resampled by brute force; *irradiance*: the same of"
        " the irradiance of 3,000 points of the bunny on a plane through a basis of 48. The paper's"
        " way interpolates the asset's own lattice bilinearly; ours averages a lattice that is 1, 2"
        " or 4 times finer.\n"
    )
    sampled = Sampled(assets, "bunny", True)
    basis = sampled.fit("pca", 48).basis
    chosen = np.sort(np.random.default_rng(1).choice(sampled.index, 3000, replace=False))
    coefficients = basis.encode(sampled.transport.rows(chosen))
    axis, degrees = (1, 2, 3), 37

    def irradiance(radiance):
        light, mean = basis.project_light(radiance)
        return coefficients @ light + mean

    yield (
        "| map | paper: cells | irradiance | ×1: cells | irradiance | ×2: cells | irradiance | ×4:"
        " cells | irradiance | vs Mitsuba: brute force | ×4 | noise |"
    )
    yield "|---|" + "---:|" * 11
    times, lost = {}, []
    for path in sorted((assets / "hdr").glob("*.exr")):
        environment = mi_prt.EnvironmentMap(path)
        turned = environment.rotated(axis, degrees)
        expected = _timed(times, "brute force", lambda: cell_radiance(turned, DIRECTIONS))
        # the paper keeps light sampled before it is turned
        canonical = cell_radiance(environment, DIRECTIONS)
        results = {"paper": _timed(times, "paper", lambda: bilinear(canonical, turned.rotation))}
        for refinement in (1, 2, 4):
            prepared = on_lattice(environment, DIRECTIONS, refinement)
            results[refinement] = _timed(
                times,
                refinement,
                lambda: cell_radiance(prepared.rotated(axis, degrees), DIRECTIONS),
            )
        energies = [DIRECTIONS.solid_angles @ radiance for radiance in (results["paper"], expected)]
        lost.append(abs(metrics.relative_bias(*energies)))
        figures = []
        for radiance in results.values():
            figures += [
                _difference(radiance, expected),
                metrics.relative_rmse(irradiance(radiance), irradiance(expected)),
            ]
        truth = point_irradiance(
            lit_scene(sampled.scene, turned), sampled.points.at(chosen), POINT_SAMPLES
        )
        figures += [
            metrics.relative_rmse(irradiance(r), truth.mean) for r in (expected, results[4])
        ] + [truth.noise]
        yield f"| {path.stem} | " + " | ".join(f"{figure:.2%}" for figure in figures) + " |"
    medians = {key: 1e3 * np.median(values) for key, values in times.items()}
    yield (
        f"\nMilliseconds for a turn: brute force {medians['brute force']:.0f}, paper's bilinear"
        f" {medians['paper']:.1f}, ×1 {medians[1]:.1f}, ×2 {medians[2]:.1f}, ×4 {medians[4]:.1f}"
        " (the default). The bilinear way costs about as much as ×2; it does not keep energy (the"
        f" sky's changes by up to {100 * max(lost):.0f} % here, where a sun lies between"
        " directions) and blurs anew at each turn. After projection all differences shrink, as the"
        " paper says."
    )


def bilinear(radiance, rotation):
    """The paper's rotation: turn the lattice's points back and interpolate between the four cells
    around each, within its face.
    """
    n = DIRECTIONS.resolution
    back = DIRECTIONS.vectors @ rotation
    cells = DIRECTIONS.cells(back)
    face = cells // (n * n)
    major, a, b = _face_coordinates(back, face)
    places = [
        np.clip((np.arctan(x / major) * 4 / np.pi + 1) * n / 2 - 0.5, 0, n - 1) for x in (a, b)
    ]
    first = [np.minimum(place.astype(int), n - 2) for place in places]
    (column, row), (fx, fy) = first, [(place - low)[:, None] for place, low in zip(places, first)]
    grid = radiance.reshape(6, n, n, 3)
    upper = grid[face, row, column] * (1 - fx) + grid[face, row, column + 1] * fx
    lower = grid[face, row + 1, column] * (1 - fx) + grid[face, row + 1, column + 1] * fx
    return upper * (1 - fy) + lower * fy


def _face_coordinates(vectors, face):
    """Coordinates along the axes of each vector's cube face, told from the lattice's own
    directions.
    """
    n = DIRECTIONS.resolution
    grid = DIRECTIONS.vectors.reshape(6, n, n, 3).astype(np.float64)
    corners = grid[:, 0, 0], grid[:, 0, -1], grid[:, -1, 0]
    axes = [other - corners[0] for other in corners[1:]]
    axes = [axis / np.linalg.norm(axis, axis=1, keepdims=True) for axis in axes]
    normals = np.cross(*axes)
    normals *= np.sign(np.sum(normals * grid[:, n // 2, n // 2], axis=1, keepdims=True))
    return (np.sum(vectors * frame[face], axis=1) for frame in (normals, *axes))


def memory_table(assets, pictures):
    """Section 7.1."""
    yield "## Memory (section 7.1)\n"
    yield (
        "48 coefficients: 4d(v + 1) bytes to relight, 4ds more to project light; measured are the"
        " arrays in the asset's file. v counts the mesh's vertices and those that tessellation"
        " adds; the rest of a file is positions, normals, albedo and the like.\n"
    )
    yield (
        "| mesh | points v | 4d(v + 1), MB | coefficients in the file, MB | 4ds, MB | basis in the"
        " file, MB | whole file, MB | 4d(v + 1) of it |"
    )
    yield "|---|---:|---:|---:|---:|---:|---:|---:|"
    with tempfile.TemporaryDirectory() as folder:
        for mesh in PAPER_MESHES:
            asset = mi_prt.precompute(
                {
                    "type": "scene",
                    "mesh": {"type": "ply", "filename": str(assets / "meshes" / f"{mesh}.ply")},
                },
                output=Path(folder) / f"{mesh}.prt",
            )
            file = asset.path.stat().st_size
            storage = asset.transports["distant"].summary()["storage"]
            predicted, measured = storage["predicted"], storage["measured"]
            figures = [
                predicted["relighting"],
                measured["coefficients"],
                predicted["projection"],
                measured["basis"],
                file,
            ]
            ratio = predicted["relighting"] / file
            yield (
                f"| {mesh} | {len(asset.points):,} | "
                + " | ".join(f"{x / 1e6:.2f}" for x in figures)
                + f" | {ratio:.0%} |"
            )
    yield (
        "\nThe paper: Asian Dragon (39,372 vertices) 7.2 MB, Happy Buddha (18,978) 3.4 MB, Lucy"
        " (41,293) 7.5 MB, by the same formula (its MB are 2²⁰ bytes, ours 10⁶)."
    )


def mean_compensation(assets, pictures):
    """Section 4.3, erratum 1."""
    yield "## Mean compensation (eqs. 8–10) against the exact form\n"
    yield (
        "Relative RMSE of the irradiance of the fitted points of the bunny on a plane, against the"
        " sampled transport without a basis. *paper*: eqs. 3, 8–10, which drop the part of the mean"
        " outside the basis; *exact*: c·ℓ + m.\n"
    )
    sampled = Sampled(assets, "bunny", True)
    bases = {d: sampled.fit("pca", d).basis for d in (12, 48, 192)}
    rows = sampled.transport.rows(sampled.index)
    coefficients = {d: basis.encode(rows) for d, basis in bases.items()}
    yield (
        "| map | "
        + " | ".join(f"exact, {d} | paper, {d}" for d in bases)
        + " |\n|---|"
        + "---:|" * (2 * len(bases))
    )
    for path in sorted((assets / "hdr").glob("*.exr")):
        radiance = cell_radiance(mi_prt.EnvironmentMap(path), DIRECTIONS)
        expected = rows @ (radiance * DIRECTIONS.solid_angles[:, None]).astype(np.float32)
        figures = []
        for d, basis in bases.items():
            light, mean = basis.project_light(radiance)
            figures.append(metrics.relative_rmse(coefficients[d] @ light + mean, expected))
            figures.append(
                metrics.relative_rmse(basis.paper_irradiance(coefficients[d], radiance), expected)
            )
        yield f"| {path.stem} | " + " | ".join(f"{figure:.2%}" for figure in figures) + " |"


def local_lights(assets, pictures):
    """Section 4.2.1 and 8."""
    yield "## Local lights (sections 4.2.1 and 8)\n"
    yield (
        "A point light comes down beside the bunny (2 m tall) on its plane, at x = 1.2 m, z = 0.8"
        " m; relative RMSE and bias of the irradiance against Mitsuba, with 192 coefficients and"
        " without a basis (*none*), for k nearest directions.\n"
    )
    sampled = Sampled(assets, "bunny", True)
    yield (
        "| height, m | inside the hull | pca, k = 1: RMSE | bias | k = 4: RMSE | bias | none, k ="
        " 1: RMSE | bias |\n|---:|---|" + "---:|" * 6
    )
    pca, none = (
        mi_prt.precompute(sampled.scene.mi_scene, **settings)
        for settings in (dict(coefficients=192, bounces=0), dict(basis="none"))
    )
    chosen = np.sort(np.random.default_rng(0).permutation(len(pca.points))[:4000])
    for height in (20.0, 8.0, 4.0, 2.5, 1.6, 1.1, 0.6):
        light = mi_prt.PointLight((1.2, height, 0.8), 100.0)
        truth = point_irradiance(lit_scene(sampled.scene, light), pca.points.at(chosen), 1).mean
        results = pca.irradiance(light), pca.irradiance(light, nearest=4), none.irradiance(light)
        figures = [
            f(result[chosen], truth)
            for result in results
            for f in (metrics.relative_rmse, metrics.relative_bias)
        ]
        yield (
            f"| {height} | {'yes' if pca.points.hull.contains(light.position) else 'no'} | "
            + " | ".join(f"{figure:+.1%}" for figure in figures)
            + " |"
        )


def streaming(assets, pictures):
    """Any size: memory and time per point."""
    yield "## Any size\n"
    yield (
        "The teapot of `scenes/`, tessellated to two sizes, 64 coefficients, each run in a process"
        " of its own with `--max-memory 3G`.\n"
    )
    yield (
        "| points | points × directions in float32 | peak memory | rays | basis | total | per 1,000"
        " points |\n|---:|---:|---:|---:|---:|---:|---:|"
    )
    figures, runs = [], []
    with tempfile.TemporaryDirectory() as folder:
        for edge_length in ("0.3", "0.0835"):
            command = [
                sys.executable,
                "-m",
                "mi_prt",
                "precompute",
                str(ROOT / "scenes" / "teapot.xml"),
                "-o",
                f"{folder}/{edge_length}.prt",
            ]
            command += [
                "--edge-length",
                edge_length,
                "--coefficients",
                "64",
                "--max-memory",
                "3G",
                "--json",
            ]
            cost = json.loads(
                subprocess.run(command, check=True, capture_output=True, text=True).stdout
            )
            seconds, n = cost["seconds"], cost["points"]
            figures.append(seconds["total"] / n)
            runs.append((seconds["total"], n))
            yield (
                f"| {n:,} | {4e-9 * n * cost['directions']:.2f} GB |"
                f" {cost['peak_memory_bytes'] / 2**20:.0f} MiB | {seconds['transport']:.1f} s |"
                f" {seconds['basis']:.1f} s | {seconds['total']:.1f} s | {1e6 * figures[-1]:.0f}"
                " ms |"
            )
    more = (runs[1][0] - runs[0][0]) / (runs[1][1] - runs[0][1])
    yield (
        f"\nTime per point of the larger over the smaller: {figures[1] / figures[0]:.2f} (bound"
        " 1.3; below 1 because loading, compiling and the small dense steps of the fit are spread"
        f" over more points); each point beyond the smaller run's took {1e6 * more:.0f} ms per"
        " 1,000. Bound of the peak memory: 3 GiB."
    )


def fitting(assets, pictures):
    """The fit against scikit-learn's randomized SVD and a full SVD."""
    from sklearn.utils.extmath import randomized_svd

    yield "## Fitting the basis\n"
    sampled = Sampled(assets, "bunny", True)
    n, s = sampled.rows.shape
    d = 64
    yield (
        f"{n:,} points × {s:,} directions, d = {d}, medians of three. Ours starts from visibility"
        " bits and expands the rows anew in every pass, the others are given the centred, weighted"
        " matrix in memory.\n"
    )
    mean, squares = sampled.rows.moments()
    matrix = sampled.transport.rows(sampled.index) * sampled.rows.sqrt_weights - mean.astype(
        np.float32
    )
    variance = squares - n * float(mean @ mean)

    def captured(vectors):
        return (
            sum(
                float(np.square(block @ vectors.T, dtype=np.float64).sum())
                for block in np.array_split(matrix, 20)
            )
            / variance
        )

    ours, fit = _median_of(3, lambda: sampled.fit("pca", d))
    yield "| method | seconds | captured variance |\n|---|---:|---:|"
    yield f"| ours, streaming | {ours:.2f} | {captured(fit.basis.vectors):.6f} |"
    peers = {}
    for iterations in ("auto", 4):
        peers[iterations], (_, _, vectors) = _median_of(
            3, lambda: randomized_svd(matrix, d, n_iter=iterations, random_state=0)
        )
        yield (
            f"| scikit-learn `randomized_svd`, n_iter={iterations} | {peers[iterations]:.2f} |"
            f" {captured(vectors):.6f} |"
        )
    full, (_, _, vectors) = _median_of(1, lambda: np.linalg.svd(matrix, full_matrices=False))
    yield f"| full SVD | {full:.1f} | {captured(vectors[:d]):.6f} |"
    yield (
        f"\nOurs over `randomized_svd` (default): {ours / peers['auto']:.2f} (bound 1.2); over the"
        f" full SVD: {ours / full:.4f} (bound 0.1)."
    )


SECTIONS = {
    "variance": captured_variance,
    "error": transport_error,
    "shading": shading,
    "rotation": rotation,
    "memory": memory_table,
    "mean": mean_compensation,
    "local": local_lights,
    "streaming": streaming,
    "fitting": fitting,
}


# --- helpers --------------------------------------------------------------------------------------


def _beyond(result, reference):
    return np.sqrt(max(metrics.relative_rmse(result, reference.mean) ** 2 - reference.noise**2, 0))


def _difference(radiance, expected):
    weights = np.sqrt(DIRECTIONS.solid_angles)[:, None]
    return metrics.relative_rmse(radiance * weights, expected * weights)


def _timed(times, key, run):
    started = time.perf_counter()
    result = run()
    times.setdefault(key, []).append(time.perf_counter() - started)
    return result


def _median_of(repeat, run):
    """Median seconds and a result."""
    times = {}
    for _ in range(repeat):
        result = _timed(times, "", run)
    return float(np.median(times[""])), result


def _listed(names):
    return ", ".join(names) or "none"


if __name__ == "__main__":
    main()
