"""Local lights: what arrives at each point from where, and whether that can be told from distant
visibility.

Eigentransport, section 4.2.1: as seen from a point x, a local light at p is light from the
lattice's direction nearest to p − x. The paper leaves its strength to a constant. Physically it is
irradiance I/r² on a surface that faces the light, at the distance r = |p − x|, so that cell j has
the radiance I/(r² w_j) and the irradiance of a surface is E = I/r² · T_j with T_j the transport of
x from that cell. One cell has the cosine of its own direction; three around p − x together
have that of the light. Transport knows what lies between x and infinity, not what lies between x
and p: that is the same only where the light is outside the convex hull of the scene.
"""

import numpy as np

from ..directions.triangles import triangles_of

NAMED_PLACES = 3  # places that a warning names


def arrival(emission, positions, directions, nearest=None):
    """Where each place of local light is seen from, and how strongly it shines there.

    The irradiance of point i is E_i = Σ irradiance_i Σ_j share_ij T_ij, a sum over the places and
    the directions j that stand for each (Eigentransport eq. 4 with the cells' radiance
    I f(ω) share/(r² w_j)).

    Parameters
    ----------
    emission : Emission
    positions : (n, 3)
        World space, m.
    directions : direction lattice
    nearest : int, optional
        Number k of directions that stand for a place, those nearest to its own, in equal shares
        (section 4.2.1). By default the three around it, in shares that keep its direction: see
        `Triangles`.

    Yields
    ------
    cells : (n, k) int64
        Indices of directions.
    shares : (n, k) float32
        Rows sum to 1.
    irradiance : (n, 3) float32
        I f(ω)/r² in W/m², on a surface that faces the place; at most the largest float32. Zero at a
        point in which the place lies: it has no direction there.

    Raises
    ------
    SettingsError
        If `nearest` is not in 1…s.
    """
    positions = np.asarray(positions, dtype=np.float64)
    for i, (place, intensity) in enumerate(
        zip(emission.exact["positions"], emission.exact["intensity"])
    ):
        toward = place - positions
        distance = np.linalg.norm(toward, axis=1, keepdims=True)
        here = distance[:, 0] == 0
        toward[here], distance[here] = [0, 0, 1], 1
        share = emission.shape((-toward / distance)[:, None], slice(i, i + 1))
        with np.errstate(over="ignore"):
            irradiance = intensity * share / distance / distance
        irradiance[here] = 0
        irradiance = np.minimum(irradiance, np.finfo(np.float32).max).astype(np.float32)
        if nearest is None:
            cells, shares = triangles_of(directions).around(toward)
        else:
            cells = directions.nearest(toward, nearest)
            shares = np.full(cells.shape, 1 / nearest)
        yield cells, shares.astype(np.float32), irradiance


def hull_warning(positions, hull):
    """What there is to say of local light inside the convex hull of a scene.

    Parameters
    ----------
    positions : (k, 3)
        Of the places that emit it.
    hull : ConvexHull
        That of the scene's points, which is a little smaller than that of curved shapes.

    Returns
    -------
    str or None
        None where all lie outside.
    """
    inside = [place for place in np.asarray(positions, np.float64) if hull.contains(place)]
    if not inside:
        return None
    named = "; ".join("{:g}, {:g}, {:g}".format(*place) for place in inside[:NAMED_PLACES])
    named += "; …" if len(inside) > NAMED_PLACES else ""
    who = (
        f"the local light at {named} lies"
        if len(inside) == 1
        else f"local light at {len(inside)} places ({named}) lies"
    )
    return (
        f"{who} inside the convex hull of the scene, where visibility to infinity is not the"
        " visibility of the light"
    )
