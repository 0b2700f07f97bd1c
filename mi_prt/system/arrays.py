"""Arrays of NumPy for Dr.Jit."""

import numpy as np

from .runtime import mitsuba

ALIGNMENT = 64  # bytes; what Dr.Jit allocates itself has it


def packets(array):
    """Numbers as mi.Float, for gathers of four at a time too.

    Dr.Jit takes over the memory of NumPy's arrays. Where that is not aligned, it gathers one by
    one, and a kernel that is compiled for one address does not serve another.

    Parameters
    ----------
    array : array of numbers
        Taken flat.
    """
    return mitsuba().Float(_aligned(array, np.float32))


def indices(array):
    """Whole numbers from 0 on as mi.UInt32; see `packets`."""
    return mitsuba().UInt32(_aligned(array, np.uint32))


def _aligned(array, dtype):
    values = np.asarray(array)
    memory = np.empty(values.size * 4 + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    aligned = memory[first : first + values.size * 4].view(dtype)
    aligned[:] = values.ravel()
    return aligned
