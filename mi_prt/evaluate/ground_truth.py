"""Ground truth by Mitsuba, with the noise that it has itself."""

from dataclasses import dataclass

import numpy as np

from ..runtime import mitsuba
from ..scene.scene import scale_of

LANES = 1 << 21
RIM_INSET = 2e-5  # share of the scene's scale by which points on the rim of a surface are moved in


@dataclass(frozen=True, eq=False)
class Reference:
    """A Monte Carlo estimate and its standard error.

    Parameters
    ----------
    mean : array
    standard_error : array of the same shape
    """

    mean: np.ndarray
    standard_error: np.ndarray

    @property
    def noise(self):
        """Relative RMSE that the reference has by itself: ‖standard error‖ / ‖mean‖."""
        norm = np.linalg.norm(self.mean)
        return float(np.linalg.norm(self.standard_error) / norm) if norm > 0 else 0.0


def point_irradiance(mi_scene, points, spp, seed=0):
    """Irradiance at points by Mitsuba's emitter sampling: no lattice, no basis, none of this program's rays.

    Parameters
    ----------
    mi_scene : mi.Scene
    points : Points
    spp : int
        Samples of the emitters at each point.
    seed : int

    Returns
    -------
    Reference
        mean and standard_error (n, 3) in W/m².
    """
    import drjit as dr

    mi = mitsuba()
    step = max(1, LANES // spp)
    count = len(points)
    means, errors = np.empty((count, 3)), np.empty((count, 3))
    sampler = mi.load_dict({"type": "independent"})
    per_point = dr.opaque(mi.UInt32, spp)
    # A rim may lie on another surface, where Mitsuba's own offset along the normal would leave rays on either side of it.
    positions = points.positions + np.float32(RIM_INSET * scale_of(mi_scene)) * points.insets
    positions, normals = mi.Float(positions.ravel()), mi.Float(points.normals.ravel())
    geometric = mi.Float(points.geometric_normals.ravel())
    for block, first in enumerate(range(0, count, step)):
        size = min(step, count - first)
        sampler.seed(seed + block * 7919, size * spp)
        index = dr.arange(mi.UInt32, size * spp) // per_point + dr.opaque(mi.UInt32, first)
        si = dr.zeros(mi.SurfaceInteraction3f, size * spp)
        si.p = dr.gather(mi.Point3f, positions, index)
        si.n = dr.gather(mi.Normal3f, geometric, index)
        normal = dr.gather(mi.Normal3f, normals, index)
        si.sh_frame = mi.Frame3f(normal)
        sample, weight = mi_scene.sample_emitter_direction(si, sampler.next_2d(), True)
        value = mi.Color3f(weight) * dr.maximum(dr.dot(normal, sample.d), 0)
        sums = [dr.block_sum(channel, spp) for channel in value]
        squares = [dr.block_sum(channel * channel, spp) for channel in value]
        dr.eval(sums, squares)
        mean = np.stack([np.array(x, dtype=np.float64) for x in sums], axis=-1) / spp
        square = np.stack([np.array(x, dtype=np.float64) for x in squares], axis=-1) / spp
        block = slice(first, first + size)
        means[block] = mean
        errors[block] = np.sqrt(np.maximum(square - mean * mean, 0) / max(spp - 1, 1))
    return Reference(means, errors)


def image(mi_scene, sensor, spp, seed=0, max_depth=2):
    """Image by Mitsuba's path tracer.

    Parameters
    ----------
    mi_scene : mi.Scene
    sensor : mi.Sensor
    spp : int
        Samples per pixel, split over two renders whose difference tells the noise.
    seed : int
    max_depth : int
        2 is direct light.

    Returns
    -------
    Reference
        mean and standard_error (h, w, 3).
    """
    mi = mitsuba()
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
    half = max(1, (spp + 1) // 2)
    first, second = (
        np.array(mi.render(mi_scene, sensor=sensor, integrator=integrator, spp=half, seed=s))[..., :3]
        for s in (2 * seed, 2 * seed + 1)
    )
    return Reference((first + second) / 2, np.abs(first - second) / 2)
