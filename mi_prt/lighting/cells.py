"""Distant light averaged over the cells of a direction lattice.

A cell's radiance is the mean over its solid angle, so that no source is missed, however small, and
none is counted at its peak. Energy is exact, and a constant map gives the same constant in every
cell.
"""

import numpy as np

from ..errors import LightError
from .light import as_light

SAMPLES_PER_CELL_SIDE = 8  # cell edges then cut the map to 1/8 of a cell


def cell_radiance(light, directions, samples_per_side=SAMPLES_PER_CELL_SIDE):
    """Mean radiance of each cell.

    Parameters
    ----------
    light : what `as_light` accepts
        Without local lights: those have no place on a lattice of directions, see `local.arrival`.
    directions : direction lattice
    samples_per_side : int
        Least number of samples along the side of a cell.

    Returns
    -------
    (s, 3) float32
        W/(m²·sr). Σ_j w_j L_j equals the light's energy ∫ L dω to rounding.

    Raises
    ------
    LightError
        If there are local lights.
    """
    light = as_light(light)
    if not light.local.is_empty:
        raise LightError(
            "a local light shines from another direction at each point: pass it to Asset.irradiance"
            " or relight"
        )
    radiance = np.zeros((len(directions), 3))
    for part in light.parts:
        radiance += part.radiance(directions, samples_per_side)
    return radiance.astype(np.float32)
