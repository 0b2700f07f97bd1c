"""What a sensor sees: which pixels show an emitter, and which points its picture is made of."""

from dataclasses import dataclass

import numpy as np

from ..errors import SettingsError
from ..render.rendered import rendered
from ..system.runtime import mitsuba

LANES = 1 << 21
WHOLLY_COVERED = 1 - 1e-4  # of a pixel; what is missing is rounding


@dataclass(frozen=True, eq=False)
class FirstHits:
    """What the pixels of a sensor show first.

    Parameters
    ----------
    coverage : (h, w) float32
        Share of each pixel that geometry covers: 1 inside silhouettes, 0 on the background.
    emits : (h, w) bool
        Pixels to which a ray adds that meets an emitting side of a surface.
    """

    coverage: np.ndarray
    emits: np.ndarray

    @property
    def covered(self):
        """Pixels (h, w) bool that geometry covers wholly."""
        return self.coverage > WHOLLY_COVERED


def first_hits(mi_scene, sensor, spp, seed=0):
    """What the pixels of a sensor show first, by camera rays through the film's own filter.

    Parameters
    ----------
    mi_scene : mi.Scene
        An emitter that is dark, seen from behind, or black at the place that is hit does not emit.
    sensor : mi.Sensor
    spp : int
        Rays per pixel. They can miss a sliver of an emitter; take as many as of the image.
    seed : int

    Returns
    -------
    FirstHits
    """
    mi = mitsuba()

    class Seen(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(ray, active)
            hit, emits = mi.Float(si.is_valid()), mi.Float(_emits(scene, si))
            return mi.Color3f(hit), active, [hit, emits]

        def aov_names(self):
            # Beside the colour, which the film may convert to another format.
            return ["hit", "emits"]

    seen = rendered(mi_scene, sensor, Seen(mi.Properties()), spp, seed)
    return FirstHits(seen[..., -2], np.abs(seen[..., -1]) > 0)


def visible_weights(mi_scene, locator, count, sensor, spp=16, seed=0):
    """Share of each point in what a sensor sees: the number of pixels whose visible irradiance it
    determines, over that of all points.

    Camera rays are spread evenly over the film, and each counts for one of the points around its
    first hit, picked with the probability of its weight in the interpolation. Hits that emit do not
    count.

    Parameters
    ----------
    mi_scene : mi.Scene
    locator : Locator
        Of the points, made for this scene: `picked(pi, si, ray, active, random)`, with `random` in
        [0, 1), gives the index of a point and whether there is one.
    count : int
        Number of points, n.
    sensor : mi.Sensor
    spp : int
        Rays per pixel.
    seed : int

    Returns
    -------
    (n,) float64
        Sum 1.

    Raises
    ------
    SettingsError
        If the sensor sees no surface that has points.
    """
    import drjit as dr

    mi = mitsuba()
    width, height = (int(x) for x in sensor.film().crop_size())
    size = dr.opaque(mi.UInt32, width), dr.opaque(mi.Float, width), dr.opaque(mi.Float, height)
    sampler = mi.load_dict({"type": "independent"})
    total, counts = width * height * spp, np.zeros(count, np.int64)
    for block, first in enumerate(range(0, total, LANES)):
        lanes = min(LANES, total - first)
        sampler.seed(seed + block * 7919, lanes)
        # Rays of a block spread over the film: neighbours in memory are neighbours in the picture.
        pixel = (dr.arange(mi.UInt32, lanes) + dr.opaque(mi.UInt32, first)) // dr.opaque(
            mi.UInt32, spp
        )
        ray, active = _camera_rays(sensor, pixel, size, sampler)
        pi = mi_scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        active &= si.is_valid() & ~_emits(mi_scene, si)
        index, found = locator.picked(pi, si, ray, active, sampler.next_1d())
        hits = dr.zeros(mi.UInt32, count)
        dr.scatter_add(hits, mi.UInt32(1), index, active & found)
        counts += np.array(hits, dtype=np.int64)
    if not counts.any():
        raise SettingsError(
            "the sensor sees no surface that has points: choose another sensor, or none"
        )
    return counts / counts.sum()


def _camera_rays(sensor, pixel, size, sampler):
    """One ray through a random place of each pixel, and whether it sees anything."""
    import drjit as dr

    mi = mitsuba()
    columns, width, height = size
    row = pixel // columns
    place = mi.Point2f(mi.Float(pixel - row * columns), mi.Float(row)) + sampler.next_2d()
    opened, duration = (
        dr.opaque(mi.Float, x) for x in (sensor.shutter_open(), sensor.shutter_open_time())
    )
    ray, weight = sensor.sample_ray(
        opened + duration * sampler.next_1d(),
        sampler.next_1d(),
        place / mi.Vector2f(width, height),
        sampler.next_2d(),
    )
    return ray, dr.max(mi.Color3f(weight)) > 0


def _emits(mi_scene, si):
    """Whether what a hit shows emits toward the ray; False where there is no hit."""
    import drjit as dr

    mi = mitsuba()
    hit = si.is_valid()
    return hit & (dr.max(mi.Color3f(si.emitter(mi_scene).eval(si, hit))) > 0)


def compared_points(buried, areas, visible, most, seed=0):
    """Draw the points at which an asset is compared with the truth: half of them in proportion to
    area and half to what a sensor sees of them.

    A point is drawn with probability π = min(1, c·p), where p is the mean of its shares in both
    and c makes the sum `most`; none is drawn twice (systematic sampling in random order). Sums over
    the drawn points weighted by 1/π are unbiased estimates of sums over all (Horvitz and Thompson
    1952).

    Parameters
    ----------
    buried : (n,) bool
        Points that nothing shows; not drawn unless all are.
    areas : (n,)
        m².
    visible : (n,) or None
        Shares of what is seen, see `visible_weights`; None without a sensor.
    most : int
    seed : int

    Returns
    -------
    index : (m,) int64
        Ascending; `most` points, or all that have an area or are seen.
    weights : (m,) float64
        1/π, at least 1.

    Raises
    ------
    SettingsError
        If `most` is below 1, or no point has an area or is seen.
    """
    if most < 1:
        raise SettingsError(f"{most} points cannot be compared: take at least 1")
    usable = ~np.asarray(buried, bool)
    usable |= not usable.any()
    shares = [np.where(usable, x, 0).astype(np.float64) for x in (areas, visible) if x is not None]
    shares = [share / share.sum() for share in shares if share.any()]
    if not shares:
        raise SettingsError("no point has an area or is seen: there is nothing to compare")
    chance = _inclusion(np.mean(shares, axis=0), most)
    rng = np.random.default_rng(seed)
    order = rng.permutation(np.flatnonzero(chance))
    # Certain ones apart: the sum of the others is a whole number up to rounding.
    certain = chance[order] >= 1
    others = order[~certain]
    steps = np.floor(np.cumsum(chance[others]) + rng.random()).astype(np.int64)
    drawn = others[np.diff(steps, prepend=0) > 0]
    index = np.sort(np.concatenate([order[certain], drawn]))
    return index, 1 / chance[index]


def _inclusion(share, most):
    """Probabilities min(1, c · share) whose sum is `most`, or 1 where too few have a share."""
    order = np.argsort(-share, kind="stable")
    ordered = share[order]
    positive = int((share > 0).sum())
    if positive <= most:
        return (share > 0).astype(np.float64)
    # With the k largest certain, c = (most − k) / (sum of the rest); the least k for which the next
    # is not above 1.
    rest = np.cumsum(ordered[::-1])[::-1]
    k = np.arange(most)
    first = int(np.argmax((most - k) * ordered[:most] <= rest[:most]))
    if (most - first) * ordered[first] > rest[first]:
        first = most
    result = np.ones(len(share))
    result[order[first:]] = (most - first) * ordered[first:] / rest[first]
    return np.minimum(result, 1)
