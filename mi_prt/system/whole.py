"""Whole numbers that a user passes, checked before anything is computed with them."""

import numpy as np

from ..errors import InputError, SettingsError


def check_whole(words, value, least, most, remedy="", error: type[InputError] = SettingsError):
    """The value as int.

    Parameters
    ----------
    words : str
        What it is, in messages.
    value : int
        Booleans and floats are none.
    least, most : int
    remedy : str
        What to do where more is wanted.
    error : type of InputError

    Raises
    ------
    SettingsError
        Or the `error`: if it is no integer from `least` to `most`.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if whole and least <= value <= most:
        return int(value)
    shown = value if whole else repr(value)
    rest = f": {remedy}" if remedy else ""
    raise error(f"{words} must be {least:,}…{most:,}, a whole number, got {shown}{rest}")
