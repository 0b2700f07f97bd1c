"""The numbers that describe a light, checked."""

import numpy as np

from ..errors import LightError


def rgb(what, value):
    """One number or three as (3,) float64, finite and not negative."""
    colour = numbers(value)
    if colour.shape not in ((), (3,)) or not is_finite(colour) or (colour < 0).any():
        raise LightError(
            f"a light's {what} must be one or three finite float32 numbers ≥ 0, got {value}"
        )
    return np.broadcast_to(colour, 3).copy()


def vector(what, value):
    """Three finite numbers as (3,) float64."""
    components = numbers(value)
    if components.shape != (3,) or not is_finite(components):
        raise LightError(f"a light's {what} must be three finite float32 numbers, got {value}")
    return components


def direction(value):
    """Three numbers, not all zero, as (3,) float64 of length 1."""
    components = numbers(value)
    length = np.linalg.norm(components) if components.shape == (3,) else 0.0
    if not (np.isfinite(length) and length > 0):
        raise LightError(f"a light's direction must be three numbers and not zero, got {value}")
    return components / length


def is_finite(values):
    """Whether float32, which Mitsuba computes in, holds all of them."""
    with np.errstate(over="ignore"):
        return np.isfinite(values.astype(np.float32)).all()


def numbers(value):
    """As float64; an array of no entries if it is none."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


def rgb_factor(value):
    """A dimmer, one number or three, as (3,) float64, finite and not negative."""
    factor = numbers(value)
    if factor.shape not in ((), (3,)) or not is_finite(factor) or (factor < 0).any():
        raise LightError(f"a light's factor must be one or three finite numbers ≥ 0, got {value}")
    return np.broadcast_to(factor, 3).copy()


def from_text(text):
    """Numbers between commas, as a tuple of float; ValueError if they are none."""
    return tuple(float(x) for x in text.split(","))


def fields_from_text(text, vectors, options=()):
    """The values of a light from text: vectors, its strength, and what may be left out.

    Parameters
    ----------
    text : str
        Fields between colons.
    vectors : int
        Number of vectors before the strength.
    options : tuple of type
        Of the numbers that may follow the strength.

    Returns
    -------
    list
        A strength of one number is a float, of three a tuple.

    Raises
    ------
    ValueError
        If these are not numbers, or not as many fields.
    """
    parts = text.split(":")
    if not vectors < len(parts) <= vectors + 1 + len(options):
        raise ValueError(text)
    strength = from_text(parts[vectors])
    strength = strength[0] if len(strength) == 1 else strength
    rest = (number(part) for number, part in zip(options, parts[vectors + 1 :]))
    return [*map(from_text, parts[:vectors]), strength, *rest]


def rgb_spectrum(colour):
    """Plugin dict of an RGB spectrum."""
    return {"type": "rgb", "value": [float(x) for x in colour]}
