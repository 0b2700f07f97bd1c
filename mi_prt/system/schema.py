"""What the arrays of a file must be: one `Array` for each name. Checked before anything is read."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Array:
    """What an array in a file must be.

    Parameters
    ----------
    dtype : str or tuple of str
        NumPy's names without byte order, such as "f4", "i4", "u1", "i2"; little endian in the file.
    shape : tuple of int or str
        A name stands for a number that is the same wherever it is used, such as "n" of points.
    least, below : int, float or str, optional
        Range of the values: least ≤ value < below. A name stands for its number. Floats are finite
        in any case.
    optional : bool
        Whether it may be missing.
    unit : str
    """

    dtype: str | tuple
    shape: tuple
    least: int | float | str | None = None
    below: int | float | str | None = None
    optional: bool = False
    unit: str = ""

    @property
    def symbols(self):
        """Names of numbers in it."""
        return [x for x in (*self.shape, self.least, self.below) if isinstance(x, str)]

    def renamed(self, names):
        """The same with other names for some numbers, {old: new}."""
        shape = tuple(_new(side, names) for side in self.shape)
        least, below = _new(self.least, names), _new(self.below, names)
        return replace(self, shape=shape, least=least, below=below)


def _new(side, names):
    return names.get(side, side) if isinstance(side, str) else side
