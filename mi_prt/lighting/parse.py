"""Light and rotations from text, as the command line takes them."""

import re

from ..errors import LightError, SettingsError
from .environment import EnvironmentMap
from .light import DirectionalLight
from .local_lights import AreaLight, PointLight, SpotLight

FORMS = (
    "scene (its own), point:x,y,z:r,g,b, spot:x,y,z:dx,dy,dz:r,g,b[:cutoff[:beam]] (direction of"
    " travel, degrees), area:x,y,z:ux,uy,uz:vx,vy,vz:r,g,b[:samples] (centre, edges),"
    " directional:dx,dy,dz:r,g,b (direction of travel), envmap:FILE or envmap:FILE:AXIS:DEGREES"
)
# Class, number of vectors before the strength, and the types of what may follow it.
_NUMERIC = {
    "point": (PointLight, 1, ()),
    "spot": (SpotLight, 2, (float, float)),
    "area": (AreaLight, 3, (int,)),
    "directional": (DirectionalLight, 1, ()),
}
_TURNED_FILE = re.compile(r"(.+?):([xyz]|[^:,]+,[^:,]+,[^:,]+):([^:]+)")


def parse_light(text):
    """A light from its description.

    Parameters
    ----------
    text : str
        - ``scene``: the scene's own light
        - ``point:x,y,z:r,g,b`` with the intensity in W/sr
        - ``spot:x,y,z:dx,dy,dz:r,g,b``, then ``:cutoff`` and ``:beam`` in degrees if need be, with
          the direction in which the
          light travels and the intensity in W/sr
        - ``area:x,y,z:ux,uy,uz:vx,vy,vz:r,g,b``, then ``:samples`` if need be, with the centre,
          both edges, and the radiance in
          W/(m² sr)
        - ``directional:dx,dy,dz:r,g,b`` with the direction in which the light travels and the
          irradiance in W/m²
        - ``envmap:FILE`` or ``envmap:FILE:AXIS:DEGREES``

        A single number in the place of r,g,b is grey.

    Returns
    -------
    PointLight, SpotLight, AreaLight, DirectionalLight, EnvironmentMap or 'scene'

    Raises
    ------
    LightError
        If it is of no such form, or such a light cannot be: see the classes.
    """
    if text == "scene":
        return text
    kind, _, rest = text.partition(":")
    try:
        if kind == "envmap" and rest:
            return _environment(rest)
        if kind in _NUMERIC:
            return _numeric(*_NUMERIC[kind], rest.split(":"))
    except (LightError, SettingsError) as error:
        raise LightError(f"light '{text}': {error}") from None
    except ValueError:  # not numbers, or not as many parts
        pass
    raise LightError(f"light '{text}' is not of the form {FORMS}")


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
        vector = axis if named else _numbers(axis)
        if not colon or not (named or len(vector) == 3):
            raise ValueError
        return vector, float(degrees)
    except ValueError:
        raise SettingsError(
            f"rotation '{text}' is not of the form AXIS:DEGREES, for example y:30 or 0,1,1:30"
        ) from None


def _numeric(light, vectors, options, parts):
    """A light of some vectors, its strength, and numbers that may be left out at the end."""
    if not vectors < len(parts) <= vectors + 1 + len(options):
        raise ValueError
    strength = _numbers(parts[vectors])
    strength = strength[0] if len(strength) == 1 else strength
    rest = (number(part) for number, part in zip(options, parts[vectors + 1 :]))
    return light(*map(_numbers, parts[:vectors]), strength, *rest)


def _environment(text):
    turned = _TURNED_FILE.fullmatch(text)
    if not turned:
        return EnvironmentMap(text)
    file, axis, degrees = turned.groups()
    return EnvironmentMap(file).rotated(*parse_rotation(f"{axis}:{degrees}"))


def _numbers(text):
    return tuple(float(x) for x in text.split(","))
