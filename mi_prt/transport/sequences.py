"""Low-discrepancy places in the unit square, scrambled anew for each sequence, in Dr.Jit.

The first two dimensions of Sobol's sequence with Owen's scrambling: the first 2ᵐ places of every
sequence are one in each elementary interval of area 2⁻ᵐ, so that a sequence can be stopped at any
power of two and continued later. Scrambled sequences are independent of each other and unbiased,
and their spread measures the error.

References
----------
Burley, Practical Hash-based Owen Scrambling (JCGT 2020); Laine and Karras, Stratified Sampling for
Stochastic Transparency (EGSR 2011), with Vegdahl's constants.
"""

from ..system.runtime import mitsuba

INDEX_BITS = 16  # of the number of a place within its sequence: 65,536 places
_TO_UNIT = 1 / (1 << 24)


def scrambled_place(number, seed):
    """Place `number` of the sequence `seed`.

    Parameters
    ----------
    number : mi.UInt32
        Below 65,536.
    seed : mi.UInt32
        Sequences of different seeds are independent.

    Returns
    -------
    mi.Point2f
        In [0, 1)².
    """
    mi = mitsuba()
    x, y = _sobol(number)
    first, second = mi.sample_tea_32(seed, 0x68BC21EB)
    return mi.Point2f(_unit(_scrambled(x, first)), _unit(_scrambled(y, second)))


def shuffled(number, seed):
    """Number of a place, in an order of its own for each seed: pairs a second sequence with a first
    without a pattern between the two. Each aligned run of 2ᵐ numbers stays such a run.

    Parameters
    ----------
    number, seed : mi.UInt32

    Returns
    -------
    mi.UInt32
    """
    import drjit as dr

    mi = mitsuba()
    return dr.brev(_permuted(dr.brev(number), mi.sample_tea_32(seed, 0x02E5BE93)[0]))


def _sobol(number):
    """The first two dimensions, as bit-reversed fractions: the lowest bit is the half."""
    import drjit as dr

    mi = mitsuba()
    y, column = mi.UInt32(0), 1 << 31
    for bit in range(INDEX_BITS):
        y = y ^ dr.select((number & (1 << bit)) != 0, mi.UInt32(column), 0)
        column ^= column >> 1
    return number, dr.brev(y)


def _scrambled(reversed_fraction, seed):
    import drjit as dr

    return dr.brev(_permuted(reversed_fraction, seed))


def _permuted(x, seed):
    """Laine and Karras' hash, in which a bit depends on lower bits alone."""
    x = x ^ (x * 0x3D20ADEA)
    x = (x + seed) * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def _unit(bits):
    return mitsuba().Float(bits >> 8) * _TO_UNIT
