"""JSON without surprises: what is written reads back, and a hostile text ends in ValueError.

Python's own reader takes repeated keys, NaN, 1e999, integers of any size and half characters.
"""

import json
import math

MAX_DEPTH = 32
MAX_DIGITS = 20  # of an integer: what 64 bits hold


def loads(text):
    """The value of a JSON text.

    Parameters
    ----------
    text : str or bytes
        Bytes are UTF-8.

    Raises
    ------
    ValueError
        If it is no JSON, repeats a key, is nested deeper than `MAX_DEPTH`, or has a number that is
        not finite or an integer of more than 64 bits, or half a character.
    """
    try:
        if not isinstance(text, str):
            text = text.decode("utf-8")
        value = json.loads(
            text,
            object_pairs_hook=_distinct,
            parse_int=_integer,
            parse_float=_finite,
            parse_constant=_refuse,
        )
    except RecursionError:
        raise ValueError(f"JSON is nested deeper than {MAX_DEPTH}") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"no JSON: {error.msg} at character {error.pos}") from None
    _check(value, MAX_DEPTH)
    return value


def dumps(value):
    """The shortest JSON text of a value, its keys sorted: ASCII, and one that `loads` reads.

    Raises
    ------
    ValueError, TypeError
        If `loads` would refuse it, or JSON does not hold it.
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    loads(text)
    return text


def _distinct(pairs):
    value = dict(pairs)
    if len(value) < len(pairs):
        raise ValueError("JSON repeats a key")
    return value


def _integer(digits):
    if len(digits) > MAX_DIGITS or not -(2**63) <= (value := int(digits)) < 2**64:
        raise ValueError(f"integer {digits[:MAX_DIGITS]}… has more than 64 bits")
    return value


def _finite(digits):
    if not math.isfinite(value := float(digits)):
        raise ValueError(f"number {digits[:MAX_DIGITS]} is not finite")
    return value


def _refuse(token):
    raise ValueError(f"{token} is no JSON")


def _check(value, depth):
    """Raise ValueError if a value is nested deeper than `depth` or has half a character."""
    if isinstance(value, str):
        value.encode("utf-8")  # UnicodeEncodeError is a ValueError
    elif isinstance(value, dict | list):
        if not depth:
            raise ValueError(f"JSON is nested deeper than {MAX_DEPTH}")
        for part in value:
            _check(part, depth - 1)
        if isinstance(value, dict):
            for part in value.values():
                _check(part, depth - 1)
