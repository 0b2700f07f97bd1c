"""Direction lattices by name."""

import re
import reprlib

from ..errors import SettingsError
from .cubemap import Cubemap
from .halton import Halton
from .latlong import LatLong
from .lattice import DirectionLattice

# At most nine digits: more are out of every range, and Python refuses to convert thousands.
_FORMS = {
    "cubemap:([0-9]{1,9})": Cubemap,
    "latlong:([0-9]{1,9})x([0-9]{1,9})": LatLong,
    "halton:([0-9]{1,9})": Halton,
}


def parse_directions(text):
    """Direction lattice from its name.

    Parameters
    ----------
    text : str or DirectionLattice
        ``cubemap:N``, ``latlong:WxH`` or ``halton:N``; a lattice is returned as it is.

    Returns
    -------
    DirectionLattice

    Raises
    ------
    SettingsError
        If the name is not of one of these forms or a number is out of range.
    """
    if isinstance(text, DirectionLattice):
        return text
    for form, lattice in _FORMS.items():
        if match := re.fullmatch(form, str(text)):
            return lattice(*map(int, match.groups()))
    raise SettingsError(
        f"directions {reprlib.repr(str(text))} are not known: use cubemap:N, latlong:WxH or"
        " halton:N, for example cubemap:32, latlong:128x64 or halton:6144"
    )
