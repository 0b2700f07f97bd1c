"""From irradiance at a hit to the radiance that leaves it: the one place of ρ/π·E in pictures."""

from ..scene.materials import reflectance_at


def reflected_radiance(irradiance, si, surfaces, active):
    """Radiance (mi.Color3f) that diffuse surfaces reflect, B = ρ/π·E.

    Parameters
    ----------
    irradiance : mi.Color3f
        W/m² at the hits.
    si : mi.SurfaceInteraction3f
    surfaces : sequence of Surface
        Of the scene that was hit.
    active : mi.Bool
    """
    import drjit as dr

    albedo = reflectance_at(si, surfaces, active)
    return dr.select(active, albedo * irradiance / dr.pi, 0)
