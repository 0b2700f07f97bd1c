"""Local lights: what arrives at each point from where, and whether that can be told from distant visibility.

Eigentransport, section 4.2.1: as seen from a point x, a local light at p is light from the lattice's direction nearest to
p − x. The paper leaves its strength to a constant. Physically it is irradiance I/r² on a surface that faces the light, at
the distance r = |p − x|, so that cell j has the radiance I/(r² w_j) and the irradiance of a surface is
E = I/r² · T_j with T_j the transport of x from that cell. Transport knows what lies between x and infinity, not what lies
between x and p: that is the same only where the light is outside the convex hull of the scene.
"""

import weakref

import numpy as np
import scipy.spatial

HULL_TOLERANCE = 1e-5  # depth that is still outside, as a share of the points' extent: float32 positions and flat scenes
NAMED_LIGHTS = 3  # places that a warning names
_last_hull = lambda: None, None  # a weak reference to positions, and their hull


def arrival(light, positions, directions, nearest=1):
    """Where a local light is seen from, and how strongly it shines there.

    The irradiance of point i is E_i = irradiance_i · mean over its cells j of T_ij (Eigentransport eq. 4 with the cells'
    radiance I/(k r² w_j)).

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
        I/r² in W/m², on a surface that faces the light. Zero at a point in which the light stands: it has no direction
        there.

    Raises
    ------
    SettingsError
        If `nearest` is not in 1…s.
    """
    toward = light.position - np.asarray(positions, dtype=np.float64)
    # Scaled by the largest coordinate first: squares of far distances are beyond float64.
    largest = np.abs(toward).max(axis=1, keepdims=True)
    here = largest[:, 0] == 0
    toward[here], largest[here] = [0, 0, 1], 1
    toward /= largest
    length = np.linalg.norm(toward, axis=1, keepdims=True)
    toward /= length
    distance = length * largest
    with np.errstate(over="ignore"):
        irradiance = light.intensity / distance / distance
    irradiance[here] = 0
    cells = directions.nearest(toward, nearest)
    return cells, np.minimum(irradiance, np.finfo(np.float32).max).astype(np.float32)


def hull_warning(lights, positions):
    """What there is to say of local lights that stand inside the convex hull of a scene.

    Parameters
    ----------
    lights : sequence of PointLight
    positions : (n, 3)
        See `inside_hull`.

    Returns
    -------
    str or None
        None where all stand outside.
    """
    inside = [light.position for light in lights if inside_hull(light.position, positions)]
    if not inside:
        return None
    places = "; ".join("{:g}, {:g}, {:g}".format(*position) for position in inside[:NAMED_LIGHTS])
    places += "; …" if len(inside) > NAMED_LIGHTS else ""
    who = f"the local light at {places} lies" if len(inside) == 1 else f"{len(inside)} local lights (at {places}) lie"
    return f"{who} inside the convex hull of the scene, where visibility to infinity is not the visibility of the light"


def inside_hull(position, positions):
    """Whether a place is inside the convex hull of a scene.

    A place on the hull is outside: what hides it, hides what is behind it. The hull of points that lie in a plane has no
    inside. (The hull is that of the points, which is a little smaller than that of curved shapes.)

    Parameters
    ----------
    position : (3,)
    positions : (n, 3)
        Of the scene's points. Their hull is computed when the place is inside their bounding box, and kept until that of
        another array is asked for: 10 to 30 ms for 40,000 points, 0.3 s if they are all on the hull.

    Returns
    -------
    bool
    """
    global _last_hull
    if not ((positions.min(axis=0) < position) & (position < positions.max(axis=0))).all():
        return False
    if _last_hull[0]() is not positions:
        _last_hull = weakref.ref(positions), _hull(positions.astype(np.float64))
    planes, centre, extent = _last_hull[1]
    return bool((planes[:, :3] @ ((position - centre) / extent) + planes[:, 3]).max() < -HULL_TOLERANCE)


def _hull(positions):
    """The hull's planes (f, 4), with unit normals pointing outward, in a frame given by a centre (3,) and an extent."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    centre, extent = (low + high) / 2, (high - low).max()
    try:
        planes = scipy.spatial.ConvexHull((positions - centre) / extent).equations
    except scipy.spatial.QhullError:  # a plane or a line: everything is outside
        planes = np.array([[0.0, 0.0, 0.0, 1.0]])
    return planes, centre, extent
