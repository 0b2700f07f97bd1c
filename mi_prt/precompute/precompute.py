"""From a scene to an asset: points, then one transport after the other."""

import hashlib
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from ..asset.asset import Asset
from ..asset.container import is_own
from ..asset.provenance import describe_scene, emitter_records
from ..errors import SettingsError
from ..points.clusters import make_clusters
from ..points.points import Points
from ..points.samples import scatter_points
from ..scene.scene import open_scene
from ..system.files import check_own, check_writable
from ..system.memory import free_bytes, parse_bytes, resident_bytes
from ..system.runtime import count_kernels, peak_memory_bytes, versions
from .exposed import exposed_points
from .job import BUILDERS, Clock, Job
from .plan import make_plan
from .workspace import durable, temporary


def precompute(
    scene,
    parameters=None,
    progress=None,
    output=None,
    resume=False,
    max_memory=None,
    force=False,
    **settings,
):
    """Precompute a scene's transport.

    Parameters
    ----------
    scene : path, dict or mi.Scene
    parameters : dict, optional
        Values for an XML file's `<default>` parameters.
    progress : callable(stage, done, total, detail), optional
        Called as work advances. The stages of distant transport are 'transport' and 'indirect' (in
        points, whose rays are traced block by block; the detail is rays per second), 'basis' (in
        passes over the rows), 'coefficients' (in points) and 'reflections' (in coefficients); of
        own lamps 'lamps' and 'lamp reflections'; of local light 'example lights', 'importance',
        'clusters' (in points) and 'transfer'; samples begin with 'samples'.
    output : path, optional
        File to save the asset to. What is computed on the way is kept beside it, in a folder with
        `.partial` behind the name, until the file is whole: a run that was interrupted or killed
        can be continued.
    resume : bool
        Continue the unfinished run of `output`, if there is one. The file is the same as that of an
        undisturbed run.
    max_memory : int or str, optional
        Bytes, or text such as '3G', that this process may have resident. By default what it has now
        and half of what is free.
    force : bool
        Whether to replace a file at `output` that is no asset.
    **settings
        Fields of `Settings`. `transports` and `points` are chosen for the scene unless they are
        given; a setting that would mean nothing is refused.

    Returns
    -------
    Asset

    Raises
    ------
    SceneError, SettingsError
        See `open_scene`, `sample_points`, `scatter_points`, `Settings`, `make_plan`,
        `workspace.durable`.
    """
    return measure(scene, parameters, progress, output, resume, max_memory, force, **settings)[0]


def measure(
    scene,
    parameters=None,
    progress=None,
    output=None,
    resume=False,
    max_memory=None,
    force=False,
    **settings,
):
    """`precompute`, and what it cost.

    Returns
    -------
    asset : Asset
    cost : dict
        rays, kernels (compiled), peak_memory_bytes, seconds of the stages of this run alone.
    """
    if output is not None:
        check_writable(output)
        check_own(output, is_own, force)
        output = Path(output).resolve()
    elif resume:
        raise SettingsError("resume needs the output of the run to continue")
    limit = _limit(max_memory)
    progress = progress or (lambda stage, done, total, detail="": None)
    clock = Clock()
    with count_kernels() as kernels:
        opened = open_scene(scene, parameters)
        if output is not None and output == _path_of(opened):
            raise SettingsError(f"output '{output}' is the scene itself: give another name")
        plan = make_plan(opened, settings)
        job, builders = begin(opened, plan, progress, limit, clock)
        with _workspace(output, job, builders, resume) as job.workspace:
            asset = _built(job, plan, builders)
            if output is not None:
                asset.save(output, job.workspace.folder, force)
                job.clock.lap("write")
    cost = {
        "rays": sum(t.report["rays"] for t in asset.transports.values()),
        "kernels": kernels.compiled,
        "peak_memory_bytes": peak_memory_bytes(),
        "seconds": job.clock.seconds,
    }
    return asset, cost


def _limit(max_memory):
    """Bytes that the process may have resident."""
    if max_memory is not None:
        return parse_bytes(max_memory)
    return resident_bytes() + free_bytes() // 2


def _path_of(scene):
    return Path(scene.source.path).resolve() if scene.source.path else None


def begin(scene, plan, progress, limit, clock=None):
    """Points, and what will build the transports of a plan.

    Returns
    -------
    job : Job
    builders : list of Builder

    Raises
    ------
    SettingsError
        If memory is too little, or a setting cannot be had for these points.
    """
    settings = plan.settings
    kinds = [BUILDERS[kind] for kind in plan.transports]
    job = Job(scene, settings, None, None, None, progress, limit, clock or Clock())
    job.clock.lap("scene")
    job.points, job.clusters, job.flights = make_points(
        scene, settings, any(kind.needs_clusters for kind in kinds), progress
    )
    job.clock.lap("points")
    builders = [kind(job) for kind in kinds]
    job.identity = _identity(job)
    for builder in builders:
        job.identity |= builder.identity()
    return job, builders


def make_points(scene, settings, clustered, progress):
    """Points of a scene.

    Parameters
    ----------
    scene : Scene
    settings : Settings
        With the kind of points chosen.
    clustered : bool
        Whether clusters are asked for.
    progress : callable(stage, done, total, detail)

    Returns
    -------
    points : Points
    clusters : Clusters or None
    flights : (k, 2, 3) float32 or None
        Of particles that were traced on the way.
    """
    return POINT_KINDS[settings.points](scene, settings, clustered, progress)


def _vertices(scene, settings, clustered, progress):
    points = exposed_points(scene, settings.edge_length)
    count = _cluster_count(len(points), settings)
    clusters = make_clusters(points, count, settings.seed) if clustered else None
    return points, clusters, None


def _samples(scene, settings, clustered, progress):
    progress("samples", 0, settings.count, "")
    clusters = _cluster_count(settings.count, settings)
    found = scatter_points(scene, settings.count, clusters, settings.seed)
    progress("samples", settings.count, settings.count, "")
    return found


def _cluster_count(points, settings):
    return max(1, round(points / settings.cluster_size))


POINT_KINDS = {"vertices": _vertices, "samples": _samples}


def _identity(job):
    """All that results depend on: what must not change between a run and its continuation."""
    digest = hashlib.sha256((job.scene.hash + job.scene.appearance).encode())
    for name in Points.SHAPES:
        if name != "buried":  # known only once the run has begun
            digest.update(np.ascontiguousarray(getattr(job.points, name)).tobytes())
    return {
        "scene": digest.hexdigest()[:16],
        "number of points": len(job.points),
        **asdict(job.settings),
        "versions": versions(),
    }


@contextmanager
def _workspace(output, job, builders, resume):
    """Where intermediate results are; the caller saves the asset within the block."""
    open_keys = sum((builder.open_keys for builder in builders), ())
    context = temporary() if output is None else durable(output, job.identity, resume, open_keys)
    with context as workspace:
        yield workspace


def _built(job, plan, builders):
    job.points = replace(job.points, buried=builders[0].buried())
    transports = {}
    for builder in builders:
        transports[builder.kind] = builder.build()
        job.clock.lap(builder.kind)
    scene, settings = job.scene, job.settings
    used = asdict(settings)
    if "distant" in transports and settings.coefficients is None:
        with suppress(SettingsError):  # the basis none takes no number
            used["coefficients"] = replace(
                settings, coefficients=len(transports["distant"].basis)
            ).coefficients
    if "edge_length" in job.points.report:
        used["edge_length"] = job.points.report["edge_length"]
    return Asset(
        job.points,
        transports,
        tuple(emitter_records(scene)),
        scene=describe_scene(scene, job.points, transports),
        settings=used,
        versions=versions(),
        report={"buried_points": int(job.points.buried.sum()), "reasons": plan.reasons},
    )
