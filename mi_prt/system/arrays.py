"""Arrays of NumPy for Dr.Jit."""

import numpy as np

from .runtime import mitsuba

ALIGNMENT = 64  # bytes; what Dr.Jit allocates itself has it


def packets(array):
    """Numbers as mi.Float for gathers of four at a time.

    Dr.Jit takes over the memory of NumPy's arrays. Where that is not aligned, it gathers one by
    one, and a kernel that is compiled for one address does not serve another.

    Parameters
    ----------
    array : array of float
        Taken flat.
    """
    values = np.ascontiguousarray(array, np.float32).ravel()
    memory = np.empty(values.nbytes + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    aligned = memory[first : first + values.nbytes].view(np.float32)
    aligned[:] = values
    return mitsuba().Float(aligned)
