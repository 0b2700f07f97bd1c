"""Light of any kind, distant and local: what counts as light, and sums of it."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from ..errors import LightError
from .emission import Emission
from .environment import EnvironmentMap, rotation_matrix
from .local_lights import AreaLight, PointLight, SpotLight
from .values import direction, rgb

KINDS = (
    "an environment map (a path, an array (h, w, 3), a mi.Bitmap or EnvironmentMap), an AreaLight,"
    " SpotLight, DirectionalLight, PointLight or Light"
)


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Light from a single direction.

    Parameters
    ----------
    direction : (3,) array
        Direction in which the light travels (Mitsuba's `direction`), any positive length.
    irradiance : (3,) array or float
        Irradiance on a surface that faces the light, RGB in W/m²; one number is grey.

    Raises
    ------
    LightError
        If a value is not finite, the direction is zero or the irradiance negative.
    """

    direction: np.ndarray
    irradiance: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "direction", direction(self.direction))
        object.__setattr__(self, "irradiance", rgb("irradiance", self.irradiance))

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`,
        right-handed.
        """
        return DirectionalLight(rotation_matrix(axis, degrees) @ self.direction, self.irradiance)


@dataclass(frozen=True, eq=False)
class Light:
    """The sum of any number of distant lights (maps and directionals) and local lights (all
    others).

    Parameters
    ----------
    maps : tuple of EnvironmentMap
    directionals : tuple of DirectionalLight
    point_lights : tuple of PointLight
    spot_lights : tuple of SpotLight
    area_lights : tuple of AreaLight
    emissions : tuple of Emission
        What a scene's own emitters of other forms send, see `scene_light.local_scene_light`.
    """

    maps: tuple = field(default=())
    directionals: tuple = field(default=())
    point_lights: tuple = field(default=())
    spot_lights: tuple = field(default=())
    area_lights: tuple = field(default=())
    emissions: tuple = field(default=())

    @property
    def distant(self):
        """The same without its local lights."""
        return Light(self.maps, self.directionals)

    @property
    def local(self):
        """The same without its distant light."""
        return replace(self, maps=(), directionals=())

    @property
    def is_empty(self):
        """Whether it is the sum of no lights; `light.local.is_empty` tells that all of a light is
        distant.
        """
        return not any(getattr(self, part.name) for part in fields(self))

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`, right-handed.

        Distant light turns; local lights stay where they are.
        """
        return replace(
            self,
            maps=tuple(m.rotated(axis, degrees) for m in self.maps),
            directionals=tuple(d.rotated(axis, degrees) for d in self.directionals),
        )


_PARTS = {
    EnvironmentMap: "maps",
    DirectionalLight: "directionals",
    PointLight: "point_lights",
    SpotLight: "spot_lights",
    AreaLight: "area_lights",
    Emission: "emissions",
}


def as_light(light):
    """What the user passed as light, as one Light.

    Parameters
    ----------
    light : Light, or any light that it is the sum of, or path, (h, w, 3) array or mi.Bitmap
        Or a list or tuple of these. A list is the sum of its entries, which may be lists themselves.

    Raises
    ------
    LightError
        If it is none of these, the list is empty, or see EnvironmentMap.
    """
    if isinstance(light, Light):
        return light
    for kind, name in _PARTS.items():
        if isinstance(light, kind):
            return Light(**{name: (light,)})
    if isinstance(light, str | Path | np.ndarray) or type(light).__module__.startswith("mitsuba"):
        return Light(maps=(EnvironmentMap(light),))
    if not isinstance(light, list | tuple):
        raise LightError(f"light must be {KINDS}, or a list of these, got {light!r}")
    if not light:
        raise LightError("the list of lights is empty: pass one light at least")
    parts = [as_light(part) for part in light]
    return Light(
        **{name: sum((getattr(part, name) for part in parts), ()) for name in _PARTS.values()}
    )
