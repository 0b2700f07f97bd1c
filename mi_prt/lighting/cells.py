"""Distant light averaged over the cells of a direction lattice.

A cell's radiance is the mean over its solid angle, so that no source is missed, however small, and
none is counted at its peak. Energy is exact, and a constant map gives the same constant in every
cell.
"""

import numpy as np

from ..errors import LightError
from .light import as_light

SAMPLES_PER_CELL_SIDE = 16  # cell edges then cut the map to 1/16 of a cell


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
    spacing = np.sqrt(4 * np.pi / len(directions)) / samples_per_side
    for environment in light.maps:
        radiance += average(environment, spacing, directions)
    for source in light.directionals:
        cell = directions.cells(-source.direction[None])[0]
        radiance[cell] += source.irradiance / directions.solid_angles[cell]
    return radiance.astype(np.float32)


def average(environment, spacing, directions):
    """Mean radiance of each cell from samples that cover the sphere.

    Samples are given whole to the cell that holds their direction. The solid angle a cell receives
    then differs a little from its own; the difference is traded with its neighbours at the radiance
    of the cell's dimmest sample, which keeps a sun whole and a constant constant, and what
    imbalance that leaves (of the order of 1e-4) is scaled away. A cell so thin that no sample falls
    into it (at the pole of a long latitude-longitude lattice) has the radiance at its direction.

    Parameters
    ----------
    environment : EnvironmentMap or LatticeMap
    spacing : float
        Of the samples, in radians.
    directions : direction lattice

    Returns
    -------
    (s, 3) float64
    """
    count = len(directions)
    energy = np.zeros((count, 3))
    covered = np.zeros(count)
    dimmest = np.full((count, 3), np.inf, dtype=np.float32)
    for vectors, solid_angles, radiance in environment.quadrature(spacing):
        cells = directions.cells(vectors)
        covered += np.bincount(cells, solid_angles, count)
        for channel in range(3):
            energy[:, channel] += np.bincount(cells, solid_angles * radiance[:, channel], count)
            np.minimum.at(dimmest[:, channel], cells, radiance[:, channel])
    w = directions.solid_angles[:, None]
    missed = covered == 0
    if missed.any():
        dimmest[missed] = environment.at(directions.vectors[missed])
    corrected = np.maximum(energy - dimmest * (covered[:, None] - w), 0)
    total = corrected.sum(axis=0)
    return corrected / w * np.divide(energy.sum(axis=0), total, out=np.zeros(3), where=total > 0)
