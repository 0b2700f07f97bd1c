"""What a scene requires, what would be precomputed for it and why, and what that will cost."""

import time
from dataclasses import asdict

import numpy as np

from ..asset.provenance import emitter_records, left_out
from ..points.resolution import POINT_BUDGET
from ..scene.scene import open_scene
from ..system.memory import free_bytes, resident_bytes
from .plan import make_plan
from .precompute import begin
from .reflections import GREY
from .settings import BY_NAME

POINT_FILE_BYTES = 77  # of a point in the file, beside what transports hold of it
LOADING = 0.5  # seconds that a run takes beside its stages


def describe(source, parameters=None, **settings):
    """What precomputing a scene requires, would use, leaves out and costs.

    The cost is predicted from probes: some of the scene's points are traced and compressed.

    Parameters
    ----------
    source : path, dict, mi.Scene
    parameters : dict, optional
    **settings
        Fields of `Settings`.

    Returns
    -------
    dict
        requires{…}, lights[name, kind, distant], settings{… each with value and reason},
        left_out[…], predicted{seconds, peak_memory_bytes, bytes, transports{…}}.
    """
    started = time.perf_counter()
    scene = open_scene(source, parameters)
    plan = make_plan(scene, settings)
    limit = resident_bytes() + free_bytes()
    job, builders = begin(scene, plan, lambda *_: None, limit)
    beginning = time.perf_counter() - started
    held = resident_bytes()
    costs = {builder.kind: builder.forecast() for builder in builders}
    reasons = plan.reasons | {
        name: reason for cost in costs.values() for name, reason in cost.pop("reasons").items()
    }
    requires = _requirements(scene, job.points)
    for cost in costs.values():
        requires |= cost.pop("requires")
    seconds = beginning + sum(cost["seconds"] for cost in costs.values()) + LOADING
    stored = POINT_FILE_BYTES * len(job.points) + sum(cost["bytes"] for cost in costs.values())
    layout = sum(array.nbytes for array in job.points.layout.arrays().values())
    memory = held + max(cost.pop("memory") for cost in costs.values())
    return {
        "requires": requires,
        "lights": emitter_records(scene),
        "settings": _settings(plan, job.points, reasons, costs),
        "left_out": left_out(scene, job.points, plan.transports),
        "predicted": {
            "seconds": round(seconds, 1),
            "peak_memory_bytes": int(memory),
            "bytes": int(stored + layout),
            "transports": costs,
        },
    }


def _requirements(scene, points):
    materials = {s.material for s in scene.surfaces}
    albedo = points.albedo
    return {
        **scene.statistics(),
        "textured_materials": sum(m.textured for m in materials),
        "two_sided_materials": sum(m.two_sided for m in materials),
        "materials": len(materials),
        "albedo": {
            "mean": [round(float(x), 4) for x in albedo.mean(axis=0)],
            "largest": round(float(albedo.max()), 4),
            "grey": bool(np.ptp(albedo, axis=1).max() <= GREY),
        },
        "distant_emitters": [e.class_name() for e in scene.distant_emitters],
        "local_emitters": [e.class_name() for e in scene.local_emitters],
        "sensors": len(scene.mi_scene.sensors()),
        "points": len(points),
        "irregular": {k: v for k, v in points.report.items() if k != "edge_length"},
    }


def _settings(plan, points, reasons, costs):
    """The settings that would be used, each with its reason; those of points and transports that
    will not be there are left out.
    """
    settings = plan.settings
    chosen = asdict(settings)
    only_distant = plan.transports == ("distant",)
    chosen["bounces"] = settings.distant_bounces if only_distant else settings.lamp_bounces
    groups = {"general", chosen["points"], *plan.transports}
    if chosen["edge_length"] == "auto" and "edge_length" in points.report:
        reasons["edge_length"] = (
            f"the shortest that keeps it near {POINT_BUDGET:,} points beyond its vertices; longer"
            " on wide faces far from objects"
        )
    if "edge_length" in points.report:
        chosen["edge_length"] = round(points.report["edge_length"], 6)
    for cost in costs.values():
        chosen |= cost.pop("chosen")
    found = {}
    for name, value in chosen.items():
        option = BY_NAME[name]
        if option.group in groups and value is not None:
            as_default = "default" if value == option.default else "as asked"
            found[name] = {"value": value, "reason": reasons.get(name, as_default)}
    return found
