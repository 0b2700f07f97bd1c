"""Irradiance between points, at hits on surfaces, in Dr.Jit."""

import numpy as np

from ..scene.materials import facing
from ..system.runtime import mitsuba
from .locate import PatchLocator

_LEAST_KEPT = 1e-4  # weight of the points around a hit that are not buried, below which all count


class PatchInterpolator:
    """Between the three points around a hit on a patch.

    Parameters
    ----------
    scene : Scene
        The scene in which hits occur; see `PatchLocator`.
    points : Points
    buried : (n,) bool
        Points that would darken a visible hit: the others around it take their share.
    """

    def __init__(self, scene, points, buried):
        self._locator = PatchLocator(scene, points)
        self._keep = mitsuba().Float(np.where(buried, 0.0, 1.0).astype(np.float32))

    def irradiance(self, values, pi, si, ray, active):
        """Irradiance at hits.

        Parameters
        ----------
        values : mi.Float
            RGB irradiance of the points, one behind the other.
        pi : mi.PreliminaryIntersection3f
        si : mi.SurfaceInteraction3f
        ray : mi.Ray3f
        active : mi.Bool

        Returns
        -------
        irradiance : mi.Color3f
        found : mi.Bool
            Whether there are points on that side of the surface.
        """
        import drjit as dr

        mi = mitsuba()
        points, weights, found = self._locator.locate(pi, si, active)
        kept = [w * dr.gather(mi.Float, self._keep, p, found) for p, w in zip(points, weights)]
        sum_kept = sum(kept)
        usable = sum_kept > _LEAST_KEPT
        shares = [dr.select(usable, k / sum_kept, w) for k, w in zip(kept, weights)]
        return (
            sum(w * dr.gather(mi.Color3f, values, p, found) for p, w in zip(points, shares)),
            found,
        )


class SampleInterpolator:
    """Between the samples around a hit, by distance and normal (Meshless PRT, section 5).

    Parameters
    ----------
    scene : Scene
        The scene in which hits occur.
    samples : Samples
    """

    def __init__(self, scene, samples):
        self._surfaces, self._locator = scene.surfaces, samples.locator()

    def irradiance(self, values, pi, si, ray, active):
        """Irradiance at hits, see `PatchInterpolator.irradiance`."""
        normals, _, reflects = facing(si, ray, self._surfaces)
        return self._locator.interpolated(values, si.p, normals.shading, active & reflects)
