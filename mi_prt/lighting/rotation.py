"""Rotations: as matrices and from text."""

import numpy as np

from ..errors import LightError, SettingsError
from .values import from_text


def rotation_matrix(axis, degrees):
    """Right-handed rotation about an axis.

    Parameters
    ----------
    axis : 'x', 'y', 'z' or sequence of 3 numbers
        Need not be of unit length.
    degrees : float

    Returns
    -------
    (3, 3) float64

    Raises
    ------
    LightError
        If the axis is unknown, zero or not finite, or the angle is not finite.
    """
    named = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    vector = np.asarray(named.get(axis, axis) if isinstance(axis, str) else axis)
    if vector.shape != (3,) or vector.dtype.kind not in "iuf":
        raise LightError(f"rotation axis must be x, y, z or three numbers, got {axis!r}")
    length = np.linalg.norm(vector)
    if not (np.isfinite(length) and length > 0 and np.isfinite(degrees)):
        raise LightError(
            f"rotation about {axis!r} by {degrees} degrees is not finite or has no axis"
        )
    x, y, z = vector / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(float(degrees))
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def orthonormal(matrix):
    """The matrix as (3, 3) float64, after checking that it keeps lengths (a rotation or a
    reflection).
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4):
        raise LightError(
            "an environment's to_world must be a rotation, or a mirror, and this one scales or"
            " shears (Mitsuba would distort the map by it): leave the scale out; brightness is the"
            " envmap's own 'scale'"
        )
    return matrix


def parse_rotation(text):
    """Axis and angle from AXIS:DEGREES, the axis being x, y, z or three numbers a,b,c.

    Parameters
    ----------
    text : str

    Returns
    -------
    axis : str or tuple of 3 float
    degrees : float

    Raises
    ------
    SettingsError
        If it is not of that form.
    """
    axis, colon, degrees = text.rpartition(":")
    try:
        named = axis in ("x", "y", "z")
        vector = axis if named else from_text(axis)
        if not colon or not (named or len(vector) == 3):
            raise ValueError
        return vector, float(degrees)
    except ValueError:
        raise SettingsError(
            f"rotation '{text}' is not of the form AXIS:DEGREES, for example y:30 or 0,1,1:30"
        ) from None
