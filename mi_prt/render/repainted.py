"""Whether a scene's materials are others than those that an asset's reflected light is of."""

import numpy as np

from ..scene.materials import facing, reflectance_at
from ..system.runtime import mitsuba

MOST_POINTS = 1 << 14  # that are looked at
_BESIDE = 1e-4  # share of the scene's scale that a ray starts off a point
_CHANGED = 5e-3  # of all reflectance: rounding and edges of textures are below


def is_repainted(asset, scene):
    """Whether a scene reflects otherwise than it did when its reflected light was computed.

    A scene of the same shapes is told by its record. Where Mitsuba has merged shapes, reflectances
    are compared at the points: what changes less than 0.5 % of all of them is not seen.

    Parameters
    ----------
    asset : Asset
    scene : Scene
        Of the asset's geometry.
    """
    if not asset.reflects:
        return False
    recorded = asset.scene
    if scene.hash == recorded["hash"]:
        return scene.appearance != recorded["appearance"]
    points = asset.points
    index = np.flatnonzero(~points.buried)
    if not len(index):
        return False
    rng = np.random.default_rng(0)
    index = rng.choice(index, min(len(index), MOST_POINTS), replace=False)
    now, met = _reflectances(points.at(index), scene)
    was = points.albedo[index]
    area = points.areas[index][met, None]
    changed = (area * np.abs(now - was)[met]).sum()
    return bool(changed > _CHANGED * (area * np.maximum(now, was)[met]).sum())


def _reflectances(points, scene):
    """Reflectance (n, 3) of a scene at points, and whether a ray met their surface (n,)."""
    import drjit as dr

    mi = mitsuba()
    step = np.float32(_BESIDE * scene.scale)
    towards = points.geometric_normals
    origins = points.positions + step * (points.insets + towards)
    lane = dr.arange(mi.UInt32, len(points.positions))
    origin, normal = (
        dr.gather(mi.Point3f, mi.Float(x.astype(np.float32).ravel()), lane)
        for x in (origins, towards)
    )
    ray = mi.Ray3f(origin, -mi.Vector3f(normal))
    si = scene.intersect(ray)
    _, si.wi, reflects = facing(si, ray, scene.surfaces)
    met = si.is_valid() & reflects & (si.t < dr.opaque(mi.Float, 2 * float(step)))
    albedo = reflectance_at(si, scene.surfaces, met)
    dr.eval(albedo, met)
    return np.array(albedo).T, np.array(met)
