"""Many lights at once."""

import warnings

import numpy as np

from ..errors import LightError
from ..lighting.environment import LightWarning
from ..lighting.light import Light
from ..transport.transport import Question


def batch_irradiance(asset, lights, component="total", nearest=None):
    """Irradiance at the points under each of several lights; see `Asset.irradiance`.

    All distant light is projected, then one matrix product gives its irradiance. Means of a map
    over cells are computed once and serve all assets of one direction lattice, as long as the map
    lives: pass the same `EnvironmentMap` again, not its path.

    Parameters
    ----------
    asset : Asset
    lights : sequence of m lights
        Each what `as_light` accepts.
    component, nearest :
        As of `Asset.irradiance`.

    Returns
    -------
    (m, n, 3) float32
        W/m².

    Raises
    ------
    LightError
        If there is no light, or they are no sequence.
    """
    Question(Light(()), component, nearest)
    if not _is_sequence(lights):
        raise LightError(
            f"a batch is a list of lights, one or more, got {lights!r:.80}: pass [light, …]"
        )
    shared = [asset.shared_out(light) for light in asset.resolved_all(lights)]
    said = {warning: None for shares in shared for warning in asset.warnings(shares)}
    for warning in said:
        warnings.warn(warning, LightWarning, stacklevel=3)
    total = np.zeros((len(shared), len(asset.points), 3), np.float32)
    for kind, transport in asset.transports.items():
        asked = [number for number, shares in enumerate(shared) if kind in shares]
        questions = [Question(shared[number][kind], component, nearest) for number in asked]
        if len(asked) == len(total):
            total += transport.respond_all(asset.points, questions)
        elif asked:
            total[asked] += transport.respond_all(asset.points, questions)
    return total


def _is_sequence(lights):
    """Whether there are lights, one after the other; an array of four axes is a stack of maps."""
    if isinstance(lights, np.ndarray):
        return lights.ndim == 4 and len(lights) > 0
    return isinstance(lights, list | tuple) and len(lights) > 0
