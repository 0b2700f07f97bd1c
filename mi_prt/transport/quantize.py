"""16-bit integers in the place of float32 numbers (Meshless PRT, section 4.4), with the error that
they cannot exceed.
"""

from dataclasses import dataclass

import numpy as np

LARGEST = 32767


@dataclass(frozen=True, eq=False)
class Quantized:
    """Integers and what one of them is worth: values ≈ integers · scale, each within half its
    scale.

    Parameters
    ----------
    integers : int16 array
    scale : float32 array that broadcasts against it
    """

    integers: np.ndarray
    scale: np.ndarray

    @property
    def values(self):
        """float32."""
        return self.integers * self.scale

    @property
    def bound(self):
        """Most that any value is off."""
        return float(self.scale.max(initial=0) / 2)


def quantized(values, axis):
    """Values with one scale for all along an axis, such that its largest is kept exactly.

    Parameters
    ----------
    values : float32 array
    axis : int

    Returns
    -------
    Quantized
    """
    return _with_scale(values, np.abs(values).max(axis=axis, keepdims=True, initial=0))


def quantized_by_cluster(values, starts):
    """Values (n, d) with one scale for each column of each cluster.

    Parameters
    ----------
    values : (n, d) float32
    starts : (c + 1,) int

    Returns
    -------
    Quantized
        Its scale is (n, d); `cluster_scales` (c, d) has all that is in it.
    """
    return _with_scale(
        values,
        np.repeat(
            np.maximum.reduceat(np.abs(values), starts[:-1], axis=0), np.diff(starts), axis=0
        ),
    )


def cluster_scales(quantized, starts):
    """The scales (c, d) of what `quantized_by_cluster` gives."""
    return quantized.scale[starts[:-1]]


def _with_scale(values, largest):
    scale = (largest / LARGEST).astype(np.float32)
    return Quantized(np.rint(values / np.where(scale > 0, scale, 1)).astype(np.int16), scale)
