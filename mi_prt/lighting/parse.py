"""Light and rotations from text, as the command line takes them."""

import re

from ..errors import LightError, SettingsError
from .environment import EnvironmentMap
from .light import DirectionalLight, PointLight

FORMS = "scene (its own), point:x,y,z:r,g,b, directional:dx,dy,dz:r,g,b (direction of travel), envmap:FILE or envmap:FILE:AXIS:DEGREES"
_TURNED_FILE = re.compile(r"(.+?):([xyz]|[^:,]+,[^:,]+,[^:,]+):([^:]+)")


def parse_light(text):
    """A light from its description.

    Parameters
    ----------
    text : str
        ``scene`` (the scene's own distant light), ``point:x,y,z:r,g,b`` with the intensity in W/sr, ``directional:dx,dy,dz:r,g,b`` with the direction in which the
        light travels and the irradiance in W/m², ``envmap:FILE`` or ``envmap:FILE:AXIS:DEGREES``. A single number in the
        place of r,g,b is grey.

    Returns
    -------
    PointLight, DirectionalLight, EnvironmentMap or 'scene'

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
        if kind in ("point", "directional"):
            vector, strength = (_numbers(part) for part in rest.split(":"))
            strength = strength[0] if len(strength) == 1 else strength
            return PointLight(vector, strength) if kind == "point" else DirectionalLight(vector, strength)
    except (LightError, SettingsError) as error:
        raise LightError(f"light '{text}': {error}") from None
    except ValueError:  # not numbers, or not two parts
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
        raise SettingsError(f"rotation '{text}' is not of the form AXIS:DEGREES, for example y:30 or 0,1,1:30") from None


def _environment(text):
    turned = _TURNED_FILE.fullmatch(text)
    if not turned:
        return EnvironmentMap(text)
    file, axis, degrees = turned.groups()
    return EnvironmentMap(file).rotated(*parse_rotation(f"{axis}:{degrees}"))


def _numbers(text):
    return tuple(float(x) for x in text.split(","))
