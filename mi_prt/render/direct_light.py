"""Direct light of local emitters at pixels, by shadow rays to their whole surfaces."""

import numpy as np

from ..scene.materials import facing
from ..system.runtime import mitsuba

SHADOW_END = (
    1e-3  # share of the way to a light at which its shadow ray ends: lights lie on surfaces
)

SAMPLES = 4  # shadow rays from a hit to each emitter; a pixel has many hits
_STEPS = 0.7548776662466927, 0.5698402909980532  # Roberts' R2 sequence


class LocalEmitters:
    """All local emitters of a scene, sampled one after the other at each hit.

    Parameters
    ----------
    scene : Scene
        As it is seen, with the lights that shine.
    """

    def __init__(self, scene):
        import drjit as dr

        mi = mitsuba()
        self._scene = scene
        emitters = scene.mi_scene.emitters()
        local = [not mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in emitters]
        index = np.flatnonzero(local).astype(np.uint32)
        self._index = mi.UInt32(np.append(index, 0))  # one more, so that none is no special case
        self._count = dr.opaque(mi.UInt32, len(index))
        self._pointers = scene.mi_scene.emitters_dr()
        self._is_empty = not len(index)

    def irradiance(self, si, ray, sampler, active):
        """Irradiance (mi.Color3f) of hits: unbiased, `SAMPLES` shadow rays to each emitter.

        Parameters
        ----------
        si : mi.SurfaceInteraction3f
        ray : mi.Ray3f
            That met the surface: its side counts.
        sampler : mi.Sampler
        active : mi.Bool
        """
        import drjit as dr

        mi = mitsuba()
        if self._is_empty:
            return mi.Color3f(0)
        normals, _, reflects = facing(si, ray, self._scene.surfaces)
        active = active & reflects
        place = sampler.next_2d(active)

        def add(number, total):
            emitter_number = number // SAMPLES
            index = dr.gather(mi.UInt32, self._index, emitter_number, active)
            emitter = dr.gather(mi.EmitterPtr, self._pointers, index, active)
            # A low-discrepancy sequence, shifted at random for each hit.
            places = (x + mi.Float(number) * step for x, step in zip((place.x, place.y), _STEPS))
            u, v = (x - dr.floor(x) for x in places)
            sample, weight = emitter.sample_direction(si, mi.Point2f(u, v), active)
            cosine = dr.dot(sample.d, normals.shading)
            lit = active & (cosine > 0) & (sample.pdf != 0)
            shadow = si.spawn_ray_to(si.p + sample.d * sample.dist * (1 - SHADOW_END))
            lit &= ~self._scene.mi_scene.ray_test(shadow, lit)
            value = mi.Color3f(weight) * (cosine / SAMPLES)
            return number + 1, total + dr.select(lit & dr.all(dr.isfinite(value)), value, 0)

        start = (dr.opaque(mi.UInt32, 0), mi.Color3f(0))
        return dr.while_loop(start, lambda number, _: number < SAMPLES * self._count, add)[1]
