"""A camera that the scene does not hold."""

from dataclasses import dataclass

import numpy as np

from ..errors import SettingsError
from ..system.runtime import mitsuba

FORM = "FROM:TO[:FOV[:UP]]"
SIZE = (640, 480)  # of its image, where no other is asked for
FOV = 45.0
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
_NEAR, _FAR = 1e-2, 1e4  # what is seen, in distances from the camera to what it looks at
_HELP = f"write it as {FORM}, for example 0,2,6:0,0.5,0:45, with UP x, y, z or a,b,c"


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    >>> mi_prt.Camera((0, 2, 6), (0, 0.5, 0), fov=45)

    Parameters
    ----------
    origin, target : (3,)
        Where it stands and what is in the middle of its image, in the scene's units.
    fov : float
        Angle of view along the image's width, degrees, above 0 and below 180.
    up : 'x', 'y', 'z' or (3,), optional
        Direction that is upward in the image; by default y, or z where the camera looks along y.

    Raises
    ------
    SettingsError
        If a number is not finite, or these make no camera.
    """

    origin: tuple
    target: tuple
    fov: float = FOV
    up: tuple | str | None = None

    def __post_init__(self):
        origin, target = _vector("origin", self.origin), _vector("target", self.target)
        along = np.subtract(target, origin)
        if not along.any():
            raise SettingsError(f"a camera at {origin} cannot look at its own place: move one")
        if not (_is_number(self.fov) and 0 < self.fov < 180):
            raise SettingsError(f"a camera's fov must be between 0 and 180°, got {self.fov!r}")
        up = self.up
        if up is None:
            up = "y" if np.any(along[[0, 2]]) else "z"
        up = _vector("up", _AXES[up] if isinstance(up, str) and up in _AXES else up)
        if not np.linalg.norm(np.cross(up, along)) > 1e-9 * np.linalg.norm(along):
            raise SettingsError(f"up {up} of a camera is along its view: use another direction")
        for name, value in (("origin", origin), ("target", target), ("up", up)):
            object.__setattr__(self, name, value)

    @classmethod
    def parse(cls, text):
        """A camera from `FORM`, such as '0,2,6:0,0.5,0:45'.

        Raises
        ------
        SettingsError
            If the text is of another form, or see `Camera`.
        """
        origin, *rest = text.split(":")
        if not 1 <= len(rest) <= 3:
            raise SettingsError(f"camera '{text}' is not understood: {_HELP}")
        try:
            start, end = (tuple(map(float, part.split(","))) for part in (origin, rest[0]))
            fov = float(rest[1]) if len(rest) > 1 else FOV
            up = rest[2] if len(rest) > 2 else None
            if up is not None and up not in _AXES:
                up = tuple(map(float, up.split(",")))
        except ValueError:
            raise SettingsError(f"camera '{text}' is not understood: {_HELP}") from None
        return cls(start, end, fov, up)

    @classmethod
    def looking_at(cls, low, high, up="y"):
        """A camera that sees the whole box between two corners (3,), from above one of its edges.

        Parameters
        ----------
        low, high : (3,)
        up : 'x', 'y' or 'z'
        """
        low, high = np.asarray(low, float), np.asarray(high, float)
        middle, radius = (low + high) / 2, max(np.linalg.norm(high - low) / 2, 1e-9)
        upward = np.array(_AXES[up], float)
        across = np.roll(upward, 1) + 0.6 * np.roll(upward, 2) + 0.5 * upward
        # the smaller side of an image of 4:3 sees this share of the width's tangent
        half = np.arctan(np.tan(np.radians(FOV / 2)) * SIZE[1] / SIZE[0])
        distance = 1.05 * radius / np.sin(half)
        origin = middle + across / np.linalg.norm(across) * distance
        return cls(tuple(origin.tolist()), tuple(middle.tolist()), FOV, up)

    def to_mitsuba(self):
        """The plugin dict of a sensor whose image is of `SIZE`."""
        mi = mitsuba()
        distance = float(np.linalg.norm(np.subtract(self.target, self.origin)))
        to_world = mi.ScalarTransform4f().look_at(
            origin=list(self.origin), target=list(self.target), up=list(self.up or ())
        )
        width, height = SIZE
        return {
            "type": "perspective",
            "fov": float(self.fov),
            "to_world": to_world,
            "near_clip": _NEAR * distance,
            "far_clip": _FAR * distance,
            "film": {"type": "hdrfilm", "width": width, "height": height},
        }


def _vector(name, value):
    try:
        vector = tuple(map(float, value))
    except (TypeError, ValueError):
        vector = ()
    if len(vector) != 3 or not np.isfinite(vector).all():
        raise SettingsError(f"{name} of a camera must be three finite numbers, got {value!r:.80}")
    return vector


def _is_number(value):
    return isinstance(value, int | float | np.number) and np.isfinite(value)
