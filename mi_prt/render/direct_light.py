"""Direct light at pixels, by shadow rays."""

from ..scene.materials import facing
from ..system.runtime import mitsuba

# share of the way to a light at which its shadow ray ends: lights lie on surfaces
SHADOW_END = 1e-3


def direct_irradiance(scene, places, si, ray, active):
    """Irradiance (mi.Color3f) of hits by emitting places that they see.

    Parameters
    ----------
    scene : Scene
    places : Places
    si : mi.SurfaceInteraction3f
    ray : mi.Ray3f
        That met the surface: its side counts.
    active : mi.Bool
    """
    import drjit as dr

    mi = mitsuba()
    normals, _, reflects = facing(si, ray, scene.surfaces)
    active &= reflects

    def add(number, total):
        toward, intensity, _ = places.sent(number, si.p)
        distance = dr.norm(toward)
        cosine = dr.dot(toward, normals.shading) / distance
        lit = active & (cosine > 0) & (dr.max(intensity) > 0)
        shadow = si.spawn_ray_to(si.p + toward * (1 - SHADOW_END))
        lit &= ~scene.mi_scene.ray_test(shadow, lit)
        value = intensity * (cosine / dr.square(distance))
        return number + 1, total + dr.select(lit & dr.all(dr.isfinite(value)), value, 0)

    return dr.while_loop(
        (dr.opaque(mi.UInt32, 0), mi.Color3f(0)), lambda number, _: number < places.count, add
    )[1]
