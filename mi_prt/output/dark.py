"""Pictures of next to no light, which show noise or nothing."""

import numpy as np

from ..lighting.emission import emission_of
from ..lighting.light import Light

LEAST_SHARE = 1e-3  # of the light that would arrive if nothing were in between
PLACES = 512  # points at which that is looked at


def dark_warning(points, irradiance, light):
    """What there is to say where light gives a scene almost nothing, or None.

    Parameters
    ----------
    points : Points
    irradiance : (n, 3)
        W/m².
    light : Light
        Resolved.
    """
    if light.is_empty:
        return None
    shown = np.flatnonzero(~points.buried | points.buried.all())
    if not irradiance[shown].any():
        return "the light gives the scene nothing: the picture is black"
    local = Light(tuple(part for part in light.local.parts if not part.lacks_emitter))
    if local.is_empty or not light.distant.is_empty:
        return None
    some = np.random.default_rng(0).permutation(shown)[:PLACES]
    open_air = emission_of(local).irradiance(points.positions[some], points.normals[some])
    arrived, possible = irradiance[some].mean(), open_air.mean()
    if arrived >= LEAST_SHARE * possible:
        return None
    return (
        f"the light gives the scene almost nothing, {arrived / possible:.1g} of what would arrive"
        " if nothing were in between: is it outside a room? What an exposed picture shows is mostly"
        " error"
    )
