"""Radiance averaged over the cells of a direction lattice, with its energy."""

import numpy as np


def sample_spacing(directions, samples_per_side):
    """Distance of samples in radians that puts so many along the side of a cell."""
    return np.sqrt(4 * np.pi / len(directions)) / samples_per_side


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
        What has `quadrature(spacing)` and `at(vectors)`.
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
