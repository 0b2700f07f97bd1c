"""Sums of lights of any kind, and what counts as light."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LightError
from .environment import EnvironmentMap
from .parse import parse_light
from .part import LIGHTS, LightPart

_OF_SCENE = re.compile(r"scene([:*].*)?")


@dataclass(frozen=True, eq=False)
class Light:
    """The sum of any number of lights, distant and local.

    Parameters
    ----------
    parts : iterable of LightPart

    Raises
    ------
    LightError
        If something else is among them.
    """

    parts: Any = ()  # any iterable; stored as a tuple

    def __post_init__(self):
        object.__setattr__(self, "parts", tuple(self.parts))
        for part in self.parts:
            if not isinstance(part, LightPart):
                raise LightError(f"a part of a Light must be one light, got {part!r}: use a list")

    @property
    def distant(self):
        """The same without its local lights."""
        return Light(part for part in self.parts if part.is_distant)

    @property
    def local(self):
        """The same without its distant light."""
        return Light(part for part in self.parts if not part.is_distant)

    @property
    def is_empty(self):
        """Whether it is the sum of no lights; `light.local.is_empty` is true where all of a light
        is distant.
        """
        return not self.parts

    @property
    def of_scene(self):
        """Whether lights of the scene are in it that `resolve` has to look up."""
        return any(part.of_scene for part in self.parts)

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed.

        Distant light turns; local lights stay where they are.
        """
        return Light(part.rotated(axis, degrees) for part in self.parts)

    def scaled(self, factor):
        """The same light times a factor: one number or RGB, not negative."""
        return Light(part.scaled(factor) for part in self.parts)

    __array_ufunc__ = None  # so that NumPy leaves `array * light` to the light

    def __mul__(self, factor):
        return self.scaled(factor)

    __rmul__ = __mul__

    def __add__(self, other):
        return Light(self.parts + as_light(other).parts)


def as_light(light):
    """What the user passed as light, as one Light.

    Parameters
    ----------
    light : Light, or any light that it is the sum of, or path, (h, w, 3) array or mi.Bitmap
        Or the text of the scene's own light ("scene", "scene:lamp_2*0.3"), or a list or tuple of
        these. A list is the sum of its entries, which may be lists themselves.

    Raises
    ------
    LightError
        If it is none of these, the list is empty, or see EnvironmentMap.
    """
    if isinstance(light, Light):
        return light
    if isinstance(light, LightPart):
        return Light((light,))
    if isinstance(light, str) and _OF_SCENE.fullmatch(light):
        return Light((parse_light(light),))
    if isinstance(light, str | Path | np.ndarray) or type(light).__module__.startswith("mitsuba"):
        return Light((EnvironmentMap(light),))
    if not isinstance(light, list | tuple):
        kinds = ", ".join(kind.__name__ for kind in LIGHTS.values())
        raise LightError(
            "light must be an environment map (a path, an array (h, w, 3) or a mi.Bitmap), a light"
            f" ({kinds} or Light), 'scene', or a list of these, got {light!r}"
        )
    if not light:
        raise LightError("the list of lights is empty: pass one light at least")
    return Light(sum((as_light(part).parts for part in light), ()))
