"""Light from text, as the command line takes it."""

import re

from ..errors import LightError, SettingsError
from .part import LIGHTS
from .rotation import parse_rotation
from .values import from_text

__all__ = ["forms", "parse_light", "parse_rotation"]
_KIND = re.compile(r"([A-Za-z][\w-]*)(?::(.+))?", re.DOTALL)
_DIMMED = re.compile(r"(.*)\*([-+.\w]+(?:,[-+.\w]+)*)", re.DOTALL)
_FACTOR = "; with a factor behind it if need be: *0.3 or *r,g,b"


def forms():
    """The forms of all kinds of light, for help and errors."""
    return "; ".join(LIGHTS[kind].FORM for kind in sorted(LIGHTS)) + _FACTOR


def parse_light(text):
    """A light from its description.

    Parameters
    ----------
    text : str
        "kind:values" with the kinds of `LIGHTS`; see each one's `FORM`, or `forms()` for all. A
        single number in the place of r,g,b is grey. A factor may follow: ``scene:lamp_2*0.3``.

    Returns
    -------
    LightPart

    Raises
    ------
    LightError
        If it is of no such form, or such a light cannot be: see the classes.
    """
    dimmed = _DIMMED.fullmatch(text)
    described, factor = dimmed.groups() if dimmed else (text, None)
    form = _KIND.fullmatch(described)
    try:
        if form and form[1] in LIGHTS:
            light = LIGHTS[form[1]].parse(form[2] or "")
            return light if factor is None else light.scaled(_factor(factor))
    except (LightError, SettingsError) as error:
        raise LightError(f"light '{text}': {error}") from None
    except ValueError:  # not numbers, or not as many parts
        pass
    if form and form[1] in LIGHTS:
        raise LightError(f"light '{text}' is not of the form {LIGHTS[form[1]].FORM}{_FACTOR}")
    raise LightError(f"light '{text}' is of no known kind: use {forms()}")


def _factor(text):
    numbers = from_text(text)
    return numbers[0] if len(numbers) == 1 else numbers
