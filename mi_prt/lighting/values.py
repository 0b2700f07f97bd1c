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
