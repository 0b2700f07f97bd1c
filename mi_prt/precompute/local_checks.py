"""What compression loses of transport for lights that move, measured under some examples."""

import numpy as np

from ..lighting.emission import emission_of
from ..lighting.light import as_light
from ..lighting.point import PointLight
from ..transport.examples import RAISE, trace_examples
from ..transport.local_direct import LocalDirect

VISIBILITY_LIGHTS = 16  # examples that visibility is checked with, by ray casts


def quantization_errors(exact, stored, senders):
    """What 16-bit numbers change.

    Parameters
    ----------
    exact, stored : LocalTransport
    senders : SenderBasis or None

    Returns
    -------
    dict
        quantization{depth: the largest relative error, indirect: relative RMSE of indirect
        irradiance under an example}.
    """
    if exact.quantize == "none":
        return {"quantization": {"depth": 0.0, "indirect": 0.0}}
    slices, worst = exact.clusters.slices, 0.0
    for number, cluster in enumerate(slices):
        before, after = (np.log(t.depth.depth(cluster, number)) for t in (exact, stored))
        worst = max(worst, float(np.abs(before - after).max()))
    indirect = 0.0
    if exact.transfer is not None:
        examples = senders.decoder[:, 0:1] * np.ones((1, 3), np.float32)
        before, after = (t.transfer.indirect(examples, slices) for t in (exact, stored))
        indirect = float(np.linalg.norm(after - before) / max(np.linalg.norm(before), 1e-30))
    return {"quantization": {"depth": worst, "indirect": indirect}}


def visibility_errors(scene, points, transport, places, lanes):
    """How often depth buffers are wrong of whether a light is visible, and how far direct
    irradiance is off, under some examples.

    Parameters
    ----------
    scene : Scene
    points : Points
    transport : LocalTransport
    places : (e, 3) float32
    lanes : int

    Returns
    -------
    dict
        misclassified_visibility, direct_error (relative RMSE).
    """
    direct = LocalDirect(points, transport.clusters, transport.depth)
    places = places[:: max(1, len(places) // VISIBILITY_LIGHTS)][:VISIBILITY_LIGHTS]
    traced = trace_examples(scene, points, places, lanes)
    truth = np.concatenate([values for _, values in traced])
    shown = ~points.buried
    wrong = facing = 0
    squares = []
    for place, expected in zip(places, truth.T):
        emission = emission_of(as_light(PointLight(place, np.ones(3))))
        _, averaged = direct.irradiance(emission)
        found, open_air = averaged[:, 0], _unblocked(points, place)
        above = (open_air > 0) & shown
        wrong += int(((found > open_air / 2) != (expected > open_air / 2))[above].sum())
        facing += int(above.sum())
        norm = np.linalg.norm(expected[shown])
        if norm > 0:
            squares.append((np.linalg.norm((found - expected)[shown]) / norm) ** 2)
    return {
        "misclassified_visibility": wrong / max(facing, 1),
        "direct_error": float(np.sqrt(np.mean(squares))) if squares else 0.0,
    }


def _unblocked(points, place):
    """Irradiance (n,) of points by a point light of unit intensity that nothing hides, averaged
    over their areas.
    """
    toward = place - points.positions
    height = np.einsum("ij,ij->i", toward, points.normals)
    across = np.einsum("ij,ij->i", toward, toward) - height**2
    raised = np.sqrt(height**2 + RAISE * points.areas)
    return np.where(height > 0, raised * (across + raised**2) ** -1.5, 0)
