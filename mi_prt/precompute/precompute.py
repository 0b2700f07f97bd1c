"""From a scene to an asset: points, transport, basis, coefficients."""

import hashlib
import time
from collections.abc import Callable
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy.sparse

from ..asset.asset import Asset
from ..asset.provenance import describe_scene
from ..basis.bases import fit_basis
from ..basis.none import NoBasis
from ..basis.rows import Rows
from ..basis.target import Fit, Target, check_room
from ..basis.total import carrier, fit_total
from ..directions import parse_directions
from ..errors import SettingsError
from ..points.points import POINT_FIELDS, sample_points
from ..scene.scene import open_scene
from ..system.memory import free_bytes, parse_bytes, resident_bytes
from ..system.parallel import BLOCK_ROWS, map_chunks
from ..system.runtime import count_kernels, peak_memory_bytes, versions
from ..transport.direct import DirectSampler, find_buried
from ..transport.hops import blocked_share
from .budget import INDIRECT_LANE_BYTES, LANE_BYTES, Room, held_coefficient_bytes
from .meshless import MeshlessPrecomputation
from .reflections import IndirectTransport, direct_report, surface_shares
from .settings import MeshlessSettings, Settings, names_of
from .workspace import durable, temporary

STRICTER = 0.99  # margin of a second fit, for what is lost beside direct transport
# what may be chosen anew when the fit could not give what was asked for
OPEN_KEYS = ("coefficients", "variance")


def precompute(
    scene,
    parameters=None,
    progress=None,
    output=None,
    resume=False,
    max_memory=None,
    points="vertices",
    **settings,
):
    """Precompute a scene's transport.

    Parameters
    ----------
    scene : path, dict or mi.Scene
    parameters : dict, optional
        Values for an XML file's `<default>` parameters.
    progress : callable(stage, done, total, detail), optional
        Called as work advances. With points='vertices' the stages are 'transport' and 'indirect'
        (in points, whose rays are traced block by block; the detail is rays per second), 'basis'
        (in passes over the rows), 'coefficients' (in points) and 'reflections' (in coefficients);
        with points='samples' they are 'samples', 'example lights', 'importance', 'clusters' (in
        points) and 'reflections'.
    output : path, optional
        File to save the asset to. What is computed on the way is kept beside it, in a folder with
        `.partial` behind the name, until the file is whole: a run that was interrupted or killed
        can be continued.
    resume : bool
        Continue the unfinished run of `output`, if there is one. The file is the same as that of an
        undisturbed run.
    max_memory : int or str, optional
        Bytes, or such as '3G', that this process may have resident. By default what it has now and
        half of what is free.
    points : 'vertices' or 'samples'
        Vertices of the (tessellated) surfaces, for distant light; or meshless samples, for lights
        that move inside the scene.
    **settings
        Fields of `Settings` (directions, basis, coefficients, variance, edge_length,
        rays_per_direction, bounces, indirect, paths_per_point, denoise, seed), or of
        `MeshlessSettings` (count, cluster_size, depth_directions, depth_coefficients,
        example_lights, transfer_coefficients, transfer_error, quantize, bounces, seed).

    Returns
    -------
    Asset or MeshlessAsset
        Its `report` holds counts, and what compression loses.

    Raises
    ------
    SceneError, SettingsError
        See `open_scene`, `sample_points`, `scatter_samples`, `Settings`, `MeshlessSettings`,
        `workspace.durable`.
    """
    return measure(scene, parameters, progress, output, resume, max_memory, points, **settings)[0]


def measure(
    scene,
    parameters=None,
    progress=None,
    output=None,
    resume=False,
    max_memory=None,
    points="vertices",
    **settings,
):
    """`precompute`, and what it cost.

    Returns
    -------
    asset : Asset or MeshlessAsset
    cost : dict
        rays, kernels (compiled), peak_memory_bytes, seconds of the stages of this run alone.
    """
    if points not in POINTS:
        raise SettingsError(f"points '{points}' are not known: use {' or '.join(POINTS)}")
    kind, run = POINTS[points]
    known = names_of(kind)
    foreign = [name for name in settings if name not in known]
    if foreign:
        raise SettingsError(
            f"{foreign[0]} is no setting of points '{points}', which has {', '.join(known)}"
        )
    settings = kind(**settings)
    if output is not None:
        output = Path(output).resolve()
    elif resume:
        raise SettingsError("resume needs the output of the run to continue")
    limit = (
        parse_bytes(max_memory) if max_memory is not None else resident_bytes() + free_bytes() // 2
    )
    progress = progress or (lambda stage, done, total, detail="": None)
    clock = _Clock()
    with count_kernels() as kernels:
        scene = open_scene(scene, parameters)
        description = describe_scene(scene, local_lights=points == "samples")
        if output is not None and scene.source.path and output == Path(scene.source.path).resolve():
            raise SettingsError(f"output '{output}' is the scene itself: give another name")
        clock.lap("scene")
        asset = run(scene, description, settings, progress, output, resume, limit, clock)
    cost = {
        "rays": asset.report["rays"],
        "kernels": kernels.compiled,
        "peak_memory_bytes": peak_memory_bytes(),
        "seconds": clock.seconds,
    }
    return asset, cost


@contextmanager
def _workspace(output, identity, resume, open_keys=()):
    """Where intermediate results are; the caller saves the asset within the block."""
    with (
        temporary() if output is None else durable(output, identity, resume, open_keys)
    ) as workspace:
        yield workspace


def _for_local_lights(scene, description, settings, progress, output, resume, limit, clock):
    job = MeshlessPrecomputation(scene, settings, progress, limit)
    clock.lap("samples")
    with _workspace(output, job.identity(), resume) as workspace:
        asset = job.run(workspace, description, clock.lap)
        if output is not None:
            asset.save(output, workspace.folder)
            clock.lap("write")
    return asset


def _for_distant_light(scene, description, settings, progress, output, resume, limit, clock):
    points = sample_points(scene, settings.edge_length)
    directions = parse_directions(settings.directions)
    target = settings.target(len(points))
    room = Room(limit, scene, points, directions, settings, target)
    clock.lap("points")
    run = _identity(settings, scene, points)
    with _workspace(output, run, resume, OPEN_KEYS) as workspace:
        sampler = DirectSampler(scene, points, directions, settings.rays_per_direction, room.lanes)
        with closing(workspace.rows("visibility", len(points), sampler.row_bytes)) as bits:
            _trace("transport", sampler, bits, progress)
            transport = sampler.transport(bits)
            dark = transport.dark()
            buried = find_buried(scene, points, dark, room.lanes)
            clock.lap("transport")
            job = _Compression(
                scene, points, directions, settings, target, room, workspace, run, progress
            )
            fit, coefficients, reflections = job.run(transport, buried, clock)
        asset = Asset(
            points,
            buried,
            directions,
            fit.basis,
            coefficients,
            scene=description,
            settings=asdict(settings)
            | {
                "coefficients": len(fit.basis),
                "edge_length": points.report["edge_length"],
            },
            versions=versions(),
            report={
                "rays": transport.rays,
                "dark_points": int(dark.sum()),
                "buried_points": int(buried.sum()),
                "captured_variance": fit.captured_variance,
                "relative_error": fit.relative_error,
                **reflections,
            },
        )
        if output is not None:
            asset.save(output, workspace.folder)
            clock.lap("write")
    return asset


POINTS = {
    "vertices": (Settings, _for_distant_light),
    "samples": (MeshlessSettings, _for_local_lights),
}


def _identity(settings, scene, points):
    """All that the result depends on: what must not change between a run and its continuation."""
    digest = hashlib.sha256((scene.hash + scene.appearance).encode())
    for name in POINT_FIELDS:
        digest.update(np.ascontiguousarray(getattr(points, name)).tobytes())
    return {
        "scene": digest.hexdigest()[:16],
        "points": len(points),
        **asdict(settings),
        "versions": versions(),
    }


def _trace(stage, sampler, rows, progress):
    """Trace what of a sampler's rows is not there yet."""
    started, traced = time.perf_counter(), 0
    progress(stage, rows.filled, rows.count, "")
    for block in sampler.blocks(rows.filled):
        rows.append(block)
        traced += len(block) * sampler.rays_per_point
        rate = traced / max(time.perf_counter() - started, 1e-9)
        progress(stage, rows.filled, rows.count, f"{rate / 1e6:.1f} million rays/s")


@dataclass(frozen=True, eq=False)
class _Compression:
    """From sampled transport to a basis and coefficients."""

    scene: object
    points: object
    directions: object
    settings: Settings
    target: object
    room: Room
    workspace: object
    identity: dict
    progress: Callable

    def run(self, transport, buried, clock):
        """Fit, coefficients and what is told of reflections."""
        settings = self.settings
        # buried points would only pull the basis
        kept = ~buried if not buried.all() else ~np.zeros_like(buried)
        blocked = blocked_share(transport, self.directions.solid_angles)
        report = direct_report(float((1 - blocked) @ surface_shares(self.points, buried)))
        if settings.basis == "none":
            basis = NoBasis(self.directions.solid_angles.astype(np.float32))
            return Fit(basis, 0.0, 1.0, 1.0), transport.in_memory(), report
        fit = self._fit(transport, kept, self.target)
        clock.lap("basis")
        if settings.bounces != 0 and (blocked[~buried] > 0).any():
            total = self._with_reflections(fit, transport, buried, blocked, kept)
            clock.lap("indirect")
            if total is not None:
                return total
        coefficients = self._encode(fit.basis, transport)
        clock.lap("coefficients")
        return fit, coefficients, report

    def _with_reflections(self, fit, transport, buried, blocked, kept):
        """Fit, coefficients and report of total transport; None where no light is reflected to any
        point.
        """
        while True:
            carried = carrier(fit.basis)
            direct = self._encode(carried, transport)
            lanes = max(1, self.room.lanes * LANE_BYTES // INDIRECT_LANE_BYTES)
            indirect = IndirectTransport(
                self.scene,
                self.points,
                buried,
                transport,
                self.directions,
                self.settings,
                carried,
                direct,
                blocked,
                lanes,
            )
            coefficients, growth, report = indirect.coefficients(
                self.workspace, lambda *job: _trace(*job, self.progress), self.progress
            )
            if coefficients is None:
                return None
            direct = direct[:, : len(carried.span)]
            total, coefficients = fit_total(
                fit, self.target, carried.span, direct, coefficients, growth, kept
            )
            wanted = self.target.variance
            if wanted is None or total.captured_variance >= wanted:
                return total, coefficients, report
            # Reflections make transport vary less: direct transport has to be compressed with less
            # loss.
            before, share = (
                fit,
                1 - STRICTER * (1 - wanted) * total.variance / max(growth * fit.variance, 1e-300),
            )
            fit = self._fit(transport, kept, Target(variance=share))
            if len(fit.basis) <= len(before.basis):
                with self._open_to_choice():
                    raise SettingsError(
                        f"no number of coefficients captures {wanted} of the variance of total"
                        " transport: ask for less"
                    )

    def _fit(self, transport, kept, target):
        """The basis of direct transport."""
        settings = self.settings
        with self._open_to_choice():
            fit = fit_basis(
                settings.basis,
                Rows(transport.rows, np.flatnonzero(kept), self.directions),
                target,
                settings.seed,
                lambda *done: self.progress("basis", *done, ""),
                self.room.basis,
                self.workspace.keep,
            )
            if (
                settings.coefficients not in (None, "auto")
                and len(fit.basis) < settings.coefficients
            ):
                raise SettingsError(
                    f"{settings.coefficients} coefficients are above the rank of the transport: at"
                    f" most {len(fit.basis)}"
                )
            if target.components is None:
                size = held_coefficient_bytes(
                    settings, *transport.shape, len(fit.basis), self.room.channels
                )
                check_room(
                    f"keeping {len(fit.basis):,} coefficients of {len(kept):,} points",
                    size,
                    self.room.basis,
                )
        return fit

    @contextmanager
    def _open_to_choice(self):
        """Within the block, an error of what only a fit can tell leaves the run open to another
        choice of coefficients, or more memory.
        """
        try:
            yield
        except SettingsError as error:
            if not self.workspace.lasting:
                raise
            # The rays are kept; the passes of this fit are not, because another one may start
            # elsewhere.
            self.workspace.forget_arrays()
            self.workspace.record(
                {key: value for key, value in self.identity.items() if key not in OPEN_KEYS}
            )
            raise SettingsError(
                f"all rays are traced and kept, resume (--resume) goes on from them, but {error}"
            ) from None

    def _encode(self, basis, transport):
        """Coefficients of all points, block by block."""
        n, _ = transport.shape
        starts = range(0, n, BLOCK_ROWS)
        blocks = []
        for block in map_chunks(
            lambda first: basis.encode(transport.rows(slice(first, first + BLOCK_ROWS))), starts
        ):
            blocks.append(block)
            self.progress("coefficients", min(len(blocks) * BLOCK_ROWS, n), n, "")
        return (
            scipy.sparse.vstack(blocks, format="csr")
            if scipy.sparse.issparse(blocks[0])
            else np.concatenate(blocks)
        )


class _Clock:
    def __init__(self):
        self.seconds = {}
        self._last = time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.seconds[name] = round(now - self._last, 4)
        self._last = now
