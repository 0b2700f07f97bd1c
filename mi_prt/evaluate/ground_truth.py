"""Ground truth by Mitsuba, with the noise that it has itself."""

from dataclasses import dataclass

import numpy as np

from ..render.developed import developed
from ..scene.bounds import scale_of
from ..system.arrays import packets
from ..system.runtime import mitsuba

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

    def __add__(self, other):
        """The sum of two independent estimates."""
        return Reference(
            self.mean + other.mean, np.hypot(self.standard_error, other.standard_error)
        )

    @property
    def noise(self):
        """Relative RMSE that the reference has by itself: ‖standard error‖ / ‖mean‖."""
        norm = np.linalg.norm(self.mean)
        return float(np.linalg.norm(self.standard_error) / norm) if norm > 0 else 0.0


def point_irradiance(mi_scene, points, spp, seed=0):
    """Irradiance at points by Mitsuba's own sampling of its emitters and of directions, combined by
    the balance heuristic (Veach 1997, 9.2.4): no lattice, no basis, none of this program's rays.

    Samples of emitters are stratified along the number that picks the emitter, so that each gets
    its share of them. A few local and directional lights then have next to no noise. Where an
    emitter has an extent, a quarter as many cosine-distributed rays are added: beside a large lamp
    a sample of its area may count without bound, a direction may not.

    Parameters
    ----------
    mi_scene : mi.Scene
    points : Points
    spp : int
        Samples of the emitters at each point, rounded up to an even number.
    seed : int

    Returns
    -------
    Reference
        mean and standard_error (n, 3) in W/m². The error is told from neighbouring samples.
    """
    spp += spp % 2
    rays = _even(spp / 4) if _has_extended_emitters(mi_scene) else 0
    found = _by_emitters(mi_scene, points, spp, rays, seed)
    return found + _by_directions(mi_scene, points, spp, rays, seed + 1) if rays else found


def _even(number):
    return max(2, 2 * round(number / 2))


def _has_extended_emitters(mi_scene):
    """Whether a ray can meet an emitter, by chance, of any scene."""
    mi = mitsuba()
    return any(not mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in mi_scene.emitters())


def _by_emitters(mi_scene, points, spp, rays, seed):
    """The share of `point_irradiance` that `spp` samples of emitters give, beside as many rays."""
    import drjit as dr

    mi = mitsuba()
    count = dr.opaque(mi.Float, spp)
    ratio = dr.opaque(mi.Float, rays / spp)

    def value(si, sampler, number):
        place = sampler.next_2d()
        place.x = (mi.Float(number) + place.x) / count
        sample, weight = mi_scene.sample_emitter_direction(si, place, True)
        other = ratio * dr.maximum(dr.dot(si.sh_frame.n, sample.d), 0) * dr.inv_pi
        share = dr.select(sample.delta, 1, sample.pdf / (sample.pdf + other))
        # a black texture has no density
        return _received(si, sample, weight) * dr.select(sample.pdf > 0, share, 0)

    # The squared difference of samples of neighbouring strata is, in the mean, no less than the sum
    # of their variances.
    return _estimate(mi_scene, points, spp, seed, value)


def _by_directions(mi_scene, points, spp, rays, seed):
    """The share of `point_irradiance` that as many cosine-distributed `rays` give."""
    import drjit as dr

    mi = mitsuba()
    ratio = dr.opaque(mi.Float, spp / rays)

    def value(si, sampler, number):
        direction = si.sh_frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        seen = mi_scene.ray_intersect(si.spawn_ray(direction))
        emitter = seen.emitter(mi_scene)
        radiance = mi.Color3f(emitter.eval(seen))
        sample = mi.DirectionSample3f(mi_scene, seen, si)
        other = ratio * mi_scene.pdf_emitter_direction(si, sample, emitter != None)  # noqa: E711
        own = dr.maximum(dr.dot(si.sh_frame.n, direction), 0) * dr.inv_pi
        counts = (own > 0) & (dr.max(radiance) > 0)
        return radiance * dr.select(counts, dr.pi * own / (own + other), 0)

    return _estimate(mi_scene, points, rays, seed, value)


def _estimate(mi_scene, points, spp, seed, value):
    """The mean of `value(si, sampler, number)` over samples, and its error from the difference of
    neighbouring ones.
    """
    import drjit as dr

    mi = mitsuba()
    means, errors = np.empty((len(points), 3)), np.empty((len(points), 3))
    for block, sampler, si, number in _samples(mi_scene, points, spp, seed):
        values = value(si, sampler, number)
        sums = [dr.block_sum(channel, spp) for channel in values]
        pairs = dr.arange(mi.UInt32, dr.width(number) // 2) * 2
        differences = [
            dr.gather(mi.Float, x, pairs) - dr.gather(mi.Float, x, pairs + 1) for x in values
        ]
        squares = [dr.block_sum(x * x, spp // 2) for x in differences]
        dr.eval(sums, squares)
        means[block] = np.stack([np.array(x, dtype=np.float64) for x in sums], axis=-1) / spp
        errors[block] = (
            np.sqrt(np.stack([np.array(x, dtype=np.float64) for x in squares], axis=-1)) / spp
        )
    return Reference(means, errors)


def irradiance(mi_scene, points, spp, paths, bounces=None, seed=0):
    """Irradiance at points, direct and after reflections; see `point_irradiance` and
    `indirect_irradiance`.
    """
    return point_irradiance(mi_scene, points, spp, seed) + indirect_irradiance(
        mi_scene, points, paths, bounces, seed
    )


def path_depth(bounces):
    """Mitsuba's `max_depth` for images of light after so many reflections on its way to what is
    seen; None is any number.
    """
    return -1 if bounces is None else bounces + 2


def indirect_irradiance(mi_scene, points, spp, bounces=None, seed=0):
    """Irradiance at points after one reflection and more, by Mitsuba's path tracer along
    cosine-distributed rays.

    Parameters
    ----------
    mi_scene : mi.Scene
    points : Points
    spp : int
        Paths from each point, rounded up to an even number.
    bounces : int or None
        Most reflections; None for any number (with Mitsuba's own Russian roulette).
    seed : int

    Returns
    -------
    Reference
        mean and standard_error (n, 3) in W/m². The error is told from all paths of a point.
    """
    import drjit as dr

    mi = mitsuba()
    spp += spp % 2
    means, errors = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    if bounces == 0:
        return Reference(means, errors)
    # From the point on: one reflection less is on the way to what is seen from there.
    depth = path_depth(None if bounces is None else bounces - 1)
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    for block, sampler, si, _ in _samples(mi_scene, points, spp, seed):
        direction = si.sh_frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        ray = mi.RayDifferential3f(si.spawn_ray(direction))
        seen = mi_scene.ray_intersect(ray)
        radiance = integrator.sample(mi_scene, sampler, ray, active=seen.is_valid())[0]
        # Light of what is seen is direct. Mitsuba's `hide_emitters` would also leave out the shapes
        # that emit.
        value = (mi.Color3f(radiance) - seen.emitter(mi_scene).eval(seen, seen.is_valid())) * dr.pi
        sums = [dr.block_sum(channel, spp) for channel in value]
        squares = [dr.block_sum(channel * channel, spp) for channel in value]
        dr.eval(sums, squares)
        mean, square = (
            np.stack([np.array(x, dtype=np.float64) for x in y], axis=-1) / spp
            for y in (sums, squares)
        )
        means[block] = mean
        errors[block] = np.sqrt(np.maximum(square - mean**2, 0) / (spp - 1))
    return Reference(means, errors)


def local_irradiance(mi_scene, points, lights):
    """Irradiance at points under local lights by Mitsuba's emitters and shadow rays, one light at a
    time: without noise.

    Parameters
    ----------
    mi_scene : mi.Scene
        Whose shapes cast the shadows; its own emitters do not shine.
    points : Points
    lights : sequence of LightPart
        Each of one place: point and spot lights.

    Returns
    -------
    (n, 3) float64
        W/m².
    """
    import drjit as dr

    mi = mitsuba()
    si = _interactions(mi_scene, points)(dr.arange(mi.UInt32, len(points)))
    total = np.zeros((len(points), 3))
    for light in lights:
        sample, weight = mi.load_dict(light.to_mitsuba()).sample_direction(si, mi.Point2f(0.5))
        lit = ~mi_scene.ray_test(si.spawn_ray_to(sample.p))
        total += np.array(_received(si, sample, weight) & lit).T
    return total


def _samples(mi_scene, points, spp, seed):
    """Blocks of samples: the slice of points, a sampler, Mitsuba's interactions, `spp` for each
    point, and the number of each there.
    """
    import drjit as dr

    mi = mitsuba()
    step = max(1, LANES // spp)
    sampler = mi.load_dict({"type": "independent"})
    per_point = dr.opaque(mi.UInt32, spp)
    interaction = _interactions(mi_scene, points)
    for block, first in enumerate(range(0, len(points), step)):
        size = min(step, len(points) - first)
        sampler.seed(seed + block * 7919, size * spp)
        lane = dr.arange(mi.UInt32, size * spp)
        si = interaction(lane // per_point + dr.opaque(mi.UInt32, first))
        yield slice(first, first + size), sampler, si, lane % per_point


def _interactions(mi_scene, points):
    """A function of indices (mi.UInt32) that gives Mitsuba's interactions at those points."""
    import drjit as dr

    mi = mitsuba()
    # A rim may lie on another surface, where Mitsuba's own offset along the normal would leave rays
    # on either side of it.
    positions = points.positions + np.float32(RIM_INSET * scale_of(mi_scene)) * points.insets
    positions, normals = packets(positions), packets(points.normals)
    geometric = packets(points.geometric_normals)

    def interaction(index):
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        si.p = dr.gather(mi.Point3f, positions, index)
        si.n = dr.gather(mi.Normal3f, geometric, index)
        si.sh_frame = mi.Frame3f(dr.gather(mi.Normal3f, normals, index))
        return si

    return interaction


def _received(si, sample, weight):
    """Irradiance of a sample of an emitter; none from a light in the point itself, which has no
    direction.
    """
    import drjit as dr

    value = mitsuba().Color3f(weight) * dr.maximum(dr.dot(si.sh_frame.n, sample.d), 0)
    return dr.select(dr.isfinite(value), value, 0)


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
        See `path_depth`; 2 is direct light.

    Returns
    -------
    Reference
        mean and standard_error (h, w, 3).

    Raises
    ------
    SettingsError, SceneError
        See `rendered`.
    """
    integrator = mitsuba().load_dict({"type": "path", "max_depth": max_depth})
    half = max(1, (spp + 1) // 2)
    first, second = (
        developed(mi_scene, sensor, integrator, half, s) for s in (2 * seed, 2 * seed + 1)
    )
    return Reference((first + second) / 2, np.abs(first - second) / 2)
