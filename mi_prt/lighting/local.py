"""Local lights: what arrives at each point from where, and whether that can be told from distant
visibility.

Eigentransport, section 4.2.1: as seen from a point x, a local light at p is light from the
lattice's direction nearest to p − x. The paper leaves its strength to a constant. Physically it is
irradiance I/r² on a surface that faces the light, at the distance r = |p − x|, so that cell j has
the radiance I/(r² w_j) and the irradiance of a surface is E = I/r² · T_j with T_j the transport of
x from that cell. Transport knows what lies between x and infinity, not what lies between x and p:
that is the same only where the light is outside the convex hull of the scene.
"""

import numpy as np

from ..errors import LightError

NAMED_LIGHTS = 3  # places that a warning names


def arrival(light, positions, directions, nearest=1):
    """Where a local light is seen from, and how strongly it shines there.

    The irradiance of point i is E_i = irradiance_i · mean over its cells j of T_ij (Eigentransport
    eq. 4 with the cells' radiance I/(k r² w_j)).

    Parameters
    ----------
    light : PointLight
    positions : (n, 3)
        World space, m.
    directions : direction lattice
    nearest : int
        Number k of directions that stand for the light, those nearest to its own.

    Returns
    -------
    cells : (n, k) int64
        Indices of directions.
    irradiance : (n, 3) float32
        I/r² in W/m², on a surface that faces the light; at most the largest float32. Zero at a
        point in which the light stands: it has no direction there.

    Raises
    ------
    SettingsError
        If `nearest` is not in 1…s.
    """
    toward = light.position - np.asarray(positions, dtype=np.float64)
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    here = distance[:, 0] == 0
    toward[here], distance[here] = [0, 0, 1], 1
    with np.errstate(over="ignore"):
        irradiance = light.intensity / distance / distance
    irradiance[here] = 0
    cells = directions.nearest(toward, nearest)
    return cells, np.minimum(irradiance, np.finfo(np.float32).max).astype(np.float32)


def refuse_all_but_point_lights(light):
    """Raise a LightError if a Light holds local lights that distant transport cannot be lit by: any
    but point lights.
    """
    others = {
        "spot": light.spot_lights,
        "area": light.area_lights,
        "emission of the scene": light.emissions,
    }
    found = " and ".join(
        f"{len(lights)} {kind} light(s)" for kind, lights in others.items() if lights
    )
    if found:
        raise LightError(
            f"of local lights, transport of distant light takes point lights only, got {found}:"
            " precompute the scene with points='samples', or use point lights outside of it"
        )


def hull_warning(lights, hull):
    """What there is to say of local lights that stand inside the convex hull of a scene.

    Parameters
    ----------
    lights : sequence of PointLight
    hull : ConvexHull
        That of the scene's points, which is a little smaller than that of curved shapes.

    Returns
    -------
    str or None
        None where all stand outside.
    """
    inside = [light.position for light in lights if hull.contains(light.position)]
    if not inside:
        return None
    places = "; ".join("{:g}, {:g}, {:g}".format(*position) for position in inside[:NAMED_LIGHTS])
    places += "; …" if len(inside) > NAMED_LIGHTS else ""
    who = (
        f"the local light at {places} lies"
        if len(inside) == 1
        else f"{len(inside)} local lights (at {places}) lie"
    )
    return (
        f"{who} inside the convex hull of the scene, where visibility to infinity is not the"
        " visibility of the light"
    )
