"""Direct light of example lights at sample points, by shadow rays (Meshless PRT, section 4.3.1)."""

import numpy as np

from ..system.arrays import packets
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET

# share of a sample's area whose square root is the least height of a light over it, see
# `point_irradiance`
RAISE = 0.25


def trace_examples(scene, points, places, lanes=LANES):
    """Irradiance of sample points under point lights of unit intensity, one block of points after
    the other.

    Parameters
    ----------
    scene : Scene
    points : Points
    places : (e, 3) float32
        Of the lights.
    lanes : int
        Most rays of one wavefront.

    Yields
    ------
    block : slice
        Of points.
    irradiance : (b, e) float32
        W/m², averaged over the samples' areas: see `raised_height`.
    """
    import drjit as dr

    mi = mitsuba()
    count = len(places)
    offset = RAY_OFFSET * scene.scale
    origins, normals = (
        packets(points.ray_origins(offset)),
        packets(points.normals),
    )
    areas, lights = packets(points.areas), packets(places)
    step = max(1, lanes // count)
    for first in range(0, len(points), step):
        size = min(step, len(points) - first)
        lane = dr.arange(mi.UInt32, size * count)
        local = lane // count
        point = local + dr.opaque(mi.UInt32, first)
        origin, normal = (
            dr.gather(mi.Point3f, origins, point),
            dr.gather(mi.Normal3f, normals, point),
        )
        toward = dr.gather(mi.Point3f, lights, lane - local * count) - origin
        height, squared = dr.dot(toward, normal), dr.squared_norm(toward)
        raised = raised_height(height, dr.gather(mi.Float, areas, point))
        distance = dr.sqrt(squared)
        facing = (height > 0) & (distance > 0)
        ray = mi.Ray3f(origin, toward / distance)
        ray.maxt = dr.maximum(distance - offset, 0)
        lit = facing & ~scene.occluders.ray_test(ray, facing)
        irradiance = dr.select(
            lit, raised * (squared - dr.square(height) + dr.square(raised)) ** -1.5, 0
        )
        dr.eval(irradiance)
        yield slice(first, first + size), np.array(irradiance).reshape(size, count)


def raised_height(height, area):
    """Height of a light over a sample, raised so that the sample's value is the mean over its area.

    A light near a surface lights a spot that is smaller than the distance of samples: one that it
    happens to hit would stand for more light than was sent, up to infinity. A light at the height h
    over a plane sends I·h/(ρ² + h²)^(3/2) to the distance ρ, which sums up to 2πI over the plane
    for any h: raising it spreads the spot over the samples around and keeps its energy.
    """
    import drjit as dr

    return dr.sqrt(dr.square(height) + RAISE * area)
