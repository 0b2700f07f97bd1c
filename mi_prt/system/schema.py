"""What the arrays and the JSON of a file must be, as tables. Checked before anything is read.

Arrays: one `Array` for each name. JSON: a specification made of `Text`, `Number`, `Flag`,
`Nothing`, `Anything`, `ListOf`, `MapOf`, `Record` and `OneOf`, for `check`::

    check(header, Record({"kind": Text("pca", "sh"), "count": Number(0, whole=True)}), "basis")
"""

import math
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Array:
    """What an array in a file must be.

    Parameters
    ----------
    dtype : str or tuple of str
        NumPy's names without byte order, such as "f4", "i4", "u1", "i2", "?"; little endian in the
        file.
    shape : tuple of int or str
        A name stands for a number that is the same wherever it is used, such as "n" of points;
        "c+1" for one more than that of "c".
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

    def within(self, prefix, shared=()):
        """The same with a prefix before the names of numbers, those that are shared excepted."""

        def new(side):
            own = isinstance(side, str) and _symbol(side)[0] not in shared
            return f"{prefix} {side}" if own else side

        shape = tuple(map(new, self.shape))
        return replace(self, shape=shape, least=new(self.least), below=new(self.below))

    def check_form(self, name, dtype, shape, sizes):
        """Raise ValueError unless dtype and shape of array `name` are right.

        Names of the shape that `sizes` (dict) lacks get their number there.
        """
        known = (self.dtype,) if isinstance(self.dtype, str) else self.dtype
        if dtype not in [np.dtype(code).newbyteorder("<") for code in known]:
            raise ValueError(f"{name} is of dtype {dtype} instead of {' or '.join(known)}")
        wanted = f"{name} is of shape {shape} instead of ({', '.join(map(str, self.shape))})"
        if len(shape) != len(self.shape):
            raise ValueError(wanted)
        for length, expected in zip(shape, self.shape):
            if isinstance(expected, str):
                symbol, more = _symbol(expected)
                expected = max(0, sizes.setdefault(symbol, length - more)) + more
            if length != expected:
                raise ValueError(f"{wanted}, with {_listed(sizes)}")

    def limits(self, name, sizes):
        """`least` and `below` as numbers or None; ValueError if their names stand for nothing."""
        return tuple(_number(limit, name, sizes) for limit in (self.least, self.below))

    def check_values(self, name, values, sizes):
        """Raise ValueError unless some values of array `name` are finite and in their range."""
        least, below = self.limits(name, sizes)
        if not values.size:
            return
        if not is_finite(values):
            raise ValueError(f"{name} holds NaN or infinity")
        if values.dtype.kind == "b":
            values, below = values.view("u1"), 2
        if least is not None and (low := values.min().item()) < least:
            raise ValueError(f"{name} holds {low}, less than {least}")
        if below is not None and (high := values.max().item()) >= below:
            raise ValueError(f"{name} holds {high}, not below {below}")


def is_finite(array):
    """Whether an array has no NaN and no infinity; without a temporary array."""
    if array.dtype.kind != "f" or not array.size:
        return True
    with np.errstate(invalid="ignore"):
        return bool(np.isfinite(array.min()) and np.isfinite(array.max()))


def _symbol(text):
    """Name and summand of "c+1"."""
    symbol, _, more = text.partition("+")
    return symbol, int(more or 0)


def _number(limit, name, sizes):
    if not isinstance(limit, str):
        return limit
    symbol, more = _symbol(limit)
    if symbol not in sizes:
        raise ValueError(f"nothing says how large {symbol} is, the limit of {name}")
    return sizes[symbol] + more


def _listed(sizes):
    return ", ".join(f"{symbol} = {size}" for symbol, size in sizes.items())


# --- JSON -----------------------------------------------------------------------------------------


def check(value, spec, where="header"):
    """Raise ValueError unless a value that JSON holds is what a specification says.

    Parameters
    ----------
    value : object
    spec : Text, Number, Flag, Nothing, Anything, ListOf, MapOf, Record or OneOf
    where : str
        Path of the value in the message; parts get theirs, such as ``scene.parameters.x``.

    Returns
    -------
    object
        The value.
    """
    spec.check(value, where)
    return value


def _refuse(where, value, wanted):
    raise ValueError(f"{where} is {ascii(value)[:60]} instead of {wanted}")


class Anything:
    """Any JSON: for records that are shown but not used."""

    def check(self, value, where):
        pass


class Nothing:
    """null."""

    def check(self, value, where):
        if value is not None:
            _refuse(where, value, "null")


class Flag:
    """true or false."""

    def check(self, value, where):
        if not isinstance(value, bool):
            _refuse(where, value, "true or false")


class Text:
    """A text, or one of `choices`."""

    def __init__(self, *choices):
        self.choices = choices

    def check(self, value, where):
        if not isinstance(value, str) or (self.choices and value not in self.choices):
            _refuse(where, value, f"one of {', '.join(self.choices)}" if self.choices else "a text")


@dataclass(frozen=True)
class Number:
    """A finite number, least ≤ number ≤ most; an integer if `whole`."""

    least: float = -math.inf
    most: float = math.inf
    whole: bool = False

    def check(self, value, where):
        kinds = (int,) if self.whole else (int, float)
        if (
            type(value) not in kinds
            or not self.least <= value <= self.most
            or abs(value) == math.inf
        ):
            kind = "a whole number" if self.whole else "a number"
            _refuse(where, value, f"{kind} from {self.least} to {self.most}")


class ListOf:
    """A list whose items are as `spec` says, `length` of them if given."""

    def __init__(self, spec, length=None):
        self.spec, self.length = spec, length

    def check(self, value, where):
        if not isinstance(value, list) or self.length not in (None, len(value)):
            _refuse(where, value, "a list" + (f" of {self.length}" if self.length else ""))
        for index, item in enumerate(value):
            self.spec.check(item, f"{where}[{index}]")


class MapOf:
    """An object of any keys, whose values are as `spec` says."""

    def __init__(self, spec):
        self.spec = spec

    def check(self, value, where):
        if not isinstance(value, dict):
            _refuse(where, value, "an object")
        for key, item in value.items():
            self.spec.check(item, f"{where}.{ascii(key)[1:-1][:60]}")


class Record:
    """An object of these `fields` (dict of specifications).

    Those named in `optional` may be missing. Other fields are refused, unless `others` says what
    they must be.
    """

    def __init__(self, fields, optional=(), others=None):
        self.fields, self.optional, self.others = fields, optional, others

    def check(self, value, where):
        if not isinstance(value, dict):
            _refuse(where, value, "an object")
        for key, item in value.items():
            if key in self.fields:
                continue
            if self.others is None:
                raise ValueError(f"{where} has the unknown field {ascii(key)[:60]}")
            self.others.check(item, f"{where}.{ascii(key)[1:-1][:60]}")
        for key, spec in self.fields.items():
            if key in value:
                spec.check(value[key], f"{where}.{key}")
            elif key not in self.optional:
                raise ValueError(f"{where}.{key} is missing")


class OneOf:
    """What any of `specs` allows, such as ``OneOf(Nothing(), Text())``."""

    def __init__(self, *specs):
        self.specs = specs

    def check(self, value, where):
        reasons = []
        for spec in self.specs:
            try:
                return spec.check(value, where)
            except ValueError as error:
                reasons.append(str(error))
        raise ValueError("; or ".join(reasons))
