"""What precomputing a scene for local lights requires and costs, and what an asset of them
holds.
"""

import time
from dataclasses import asdict, replace

from ..asset.meshless_file import compressed
from ..asset.provenance import left_out
from .meshless import MeshlessPrecomputation
from .workspace import temporary

FIRST_COUNT, PROBE_COUNT = 200, 3000  # samples of the runs that the cost is told from
NO_LIMIT = 1 << 62  # bytes
GROUPS = ("depth", "transfer")  # of arrays in the file
POINT_BYTES = 68  # of a sample in the file, beside depth and transfer
EXPECTED_RANK = 60  # components of indirect irradiance that a cluster is expected to need


def describe_meshless(scene, settings):
    """What `info.describe` says of samples.

    Parameters
    ----------
    scene : Scene
    settings : MeshlessSettings

    Returns
    -------
    dict
        requires{…}, settings{…}, left_out[…], predicted{seconds, bytes}.
    """
    _probe(scene, settings, FIRST_COUNT)  # compiles the kernels
    started = time.perf_counter()
    probe = _probe(scene, settings, PROBE_COUNT)
    seconds = (time.perf_counter() - started) / len(probe.points)
    n, width = settings.count, 2 if settings.quantize == "16" else 4
    clusters = max(1, round(n / settings.cluster_size))
    columns = clusters * settings.transfer_coefficients * probe.channels
    depth = width * (
        n * settings.depth_coefficients
        + clusters * settings.depth_directions * (settings.depth_coefficients + 1)
    )
    reflected = settings.bounces != 0
    transfer = (
        width
        * (
            n * (settings.transfer_coefficients + EXPECTED_RANK)
            + clusters * EXPECTED_RANK * columns // 2
        )
        if reflected
        else 0
    )
    report = probe.points.report
    return {
        "requires": {
            **scene.statistics(),
            "samples": n,
            "reachable_area": report["reachable_area"],
            "colour": probe.channels == 3,
            "own_lights": len(probe.own_light) or probe.no_own_light,
            "rays": n * settings.depth_directions,
        },
        "settings": asdict(settings),
        "left_out": left_out(scene, local_lights=True),
        "predicted": {
            "seconds": round(seconds * n, 1),
            "bytes": int(POINT_BYTES * n + depth + transfer),
        },
    }


def _probe(scene, settings, count):
    """A whole run with fewer samples."""
    job = MeshlessPrecomputation(
        scene, replace(settings, count=min(count, settings.count)), lambda *_: None, NO_LIMIT
    )
    with temporary() as workspace:
        job.run(workspace, {}, lambda name: None)
    return job


def describe_meshless_asset(asset):
    """What `info.describe_asset` says of an asset of local lights; `storage` in bytes as in the
    file.
    """
    arrays = compressed(asset)
    storage = {
        group: sum(a.nbytes for name, a in arrays.items() if name.startswith(group))
        for group in GROUPS
    }
    return {
        "points": len(asset.points),
        "clusters": len(asset.samples.roots),
        "directions": asset.settings["depth_directions"],
        "transfer": None if asset.transfer is None else list(asset.transfer.matrix.shape),
        "own_lights": len(asset.own_light) or asset.report["no_own_light"],
        "report": asset.report | asset.points.report,
        "storage": storage | {"file": asset.path.stat().st_size if asset.path else None},
        "settings": asset.settings,
        "scene": asset.scene,
        "versions": asset.versions,
    }
