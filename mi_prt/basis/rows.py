"""A matrix of transport that is only ever seen in blocks of rows."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from ..directions.lattice import DirectionLattice
from ..system.parallel import BLOCK_ROWS, map_chunks
from ..system.runtime import thread_count

# parts that the rows are split into for the threads; fixed, so that sums do not depend on their
# number
CHUNKS = 16


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows to fit a basis to, in the √w-weighted space of a direction lattice.

    Parameters
    ----------
    read : callable(index) returning (b, s) float32
        Rows of the transport matrix; the array is the caller's to change.
    index : (n,) int array
        The rows to fit to.
    directions : DirectionLattice
        Whose solid angles are the weights w.
    """

    read: Callable
    index: np.ndarray
    directions: DirectionLattice
    sqrt_weights: np.ndarray = field(init=False, repr=False)

    def __post_init__(self):
        object.__setattr__(
            self, "sqrt_weights", np.sqrt(self.directions.solid_angles).astype(np.float32)
        )

    @property
    def shape(self):
        """(n, s)."""
        return len(self.index), len(self.sqrt_weights)

    def blocks(self, index=None):
        """Blocks of rows, not weighted, in order; of a part of the index if one is given."""
        index = self.index if index is None else index
        for first in range(0, len(index), BLOCK_ROWS):
            yield self.read(index[first : first + BLOCK_ROWS])

    def sums(self, function, index=None):
        """Sum over chunks of rows of what `function(chunk of the index)` returns, a tuple of arrays
        or numbers.

        The chunks run on all threads. They are the same for any number of threads and are summed in
        order, so that results are too.
        """
        index = self.index if index is None else index
        parts = map_chunks(function, np.array_split(index, CHUNKS), most=thread_count())
        return reduce(lambda total, part: tuple(a + b for a, b in zip(total, part)), parts)

    def moments(self):
        """Weighted mean (s,) float64 of the rows, and the sum of their weighted squares."""

        def moments(chunk):
            total = np.zeros(len(self.sqrt_weights))
            squares = 0.0
            for block in self.blocks(chunk):
                total += block.sum(axis=0)
                block *= self.sqrt_weights
                squares += float(np.vdot(block, block))
            return total, squares

        total, squares = self.sums(moments)
        return total / len(self.index) * self.sqrt_weights, squares


def encoded(encode, transport, progress=None, join=np.concatenate):
    """Coefficients of all rows of transport, block by block.

    Parameters
    ----------
    encode : callable((b, s) float32) returning coefficients of a block
    transport : DirectTransport
    progress : callable(done, total), optional
    join : callable(list of blocks)
    """
    n, _ = transport.shape
    blocks = []
    for block in map_chunks(
        lambda first: encode(transport.rows(slice(first, first + BLOCK_ROWS))),
        range(0, n, BLOCK_ROWS),
    ):
        blocks.append(block)
        if progress:
            progress(min(len(blocks) * BLOCK_ROWS, n), n)
    return join(blocks)
