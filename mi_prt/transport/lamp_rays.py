"""Rays from points to places that reflect, and the direct light of lamps at those places."""

import numpy as np

from ..scene.materials import facing, reflectance_at
from ..system.arrays import packets
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET
from .hops import HOP, NOTHING
from .lamp_table import averaging
from .sequences import scrambled_place, shuffled

AIMED = 4  # most shadow rays from each place that a ray meets
# share of all lamps alike in the chance by which one is chosen at a place; the rest goes by their
# direct light at a point beside it
ALIKE = 0.4
# squared distance to a lamp, over its area, below which its light is taken from the points around
BESIDE_LAMP = 0.1
LEAST_COSINE = 0.05  # to which footprints grow at grazing incidence
_PLACES = 0x3C6EF372  # makes of a number that of another sequence


class LampRays:
    """Traces rays of a scene's points, block by block.

    Parameters
    ----------
    scene : Scene
    points : Points
    lamps : Lamps
    direct : (n, k, 3) float32
        Direct irradiance of the lamps at the points.
    locator : Locator
    rays : int
        K, of each point. Ray 2i belongs to the first half and 2i + 1 to the second; each half is
        a sequence of its own.
    aimed : int
        Most shadow rays from each place that is met.
    seed : int
    lanes : int
        Most lanes of one wavefront. Results do not depend on it.
    """

    def __init__(
        self, scene, points, lamps, direct, locator, rays, aimed=AIMED, seed=0, lanes=LANES
    ):
        import drjit as dr

        mi = mitsuba()
        self._scene, self._lamps, self._locator = scene, lamps, locator
        self._count, self._k, self._rays = len(points), len(lamps), rays
        inset = np.float32(RAY_OFFSET * scene.scale) * points.insets
        self._positions = packets(points.positions + inset)
        self._geometric = packets(points.geometric_normals)
        self._normals = packets(points.normals)
        self._direct = packets(np.ascontiguousarray(direct, np.float32))
        self._offset = dr.opaque(mi.Float, RAY_OFFSET * scene.scale)
        self._seed = dr.opaque(mi.UInt32, seed % (1 << 32))
        self._aimed = aimed if self._k > aimed else 0  # 0: all of them
        if self._aimed:
            self._chances = packets(_chances(direct))
        # of one wavefront each: rays, and the sums of lamps
        widest = max(rays, 6 * self._k * aimed if self._aimed else 2 * self._k)
        self._step = max(1, lanes // widest)

    def blocks(self, kept):
        """Blocks of all points, in order.

        Parameters
        ----------
        kept : int
            Of the first rays of each point, that are handed out.

        Yields
        ------
        block : slice
            Of points.
        hops : (b, 16·kept) uint8
            `HOP` of the first `kept` rays.
        gather : (2, 3, b, k) float32
            Irradiance after one reflection by either half of the rays, W/m².
        """
        for first in range(0, self._count, self._step):
            size = min(self._step, self._count - first)
            met = self._met(first, size)
            gather = self._gather(met, first, size)
            yield slice(first, first + size), self._hops(met, size, kept), gather

    def _met(self, first, size):
        """Flat arrays of what the rays of some points meet."""
        import drjit as dr

        mi = mitsuba()
        rays = dr.opaque(mi.UInt32, self._rays)
        lane = dr.arange(mi.UInt32, size * self._rays)
        local = lane // rays
        ray_number = lane - local * rays
        point = local + dr.opaque(mi.UInt32, first)
        half = ray_number & 1
        sequence = mi.sample_tea_32(point, self._seed * 0x9E3779B9 + half)[0]
        place = scrambled_place(ray_number >> 1, sequence)
        normal = dr.gather(mi.Normal3f, self._normals, point)
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(place))
        # A ray that dips below the faces around its point (the hemisphere of a smooth normal can)
        # starts behind them, as it does in Mitsuba's own rendering.
        geometric = dr.gather(mi.Normal3f, self._geometric, point)
        away = dr.mulsign(geometric, dr.dot(geometric, direction)) * self._offset
        ray = mi.Ray3f(dr.gather(mi.Point3f, self._positions, point) + away, direction)
        surfaces = self._scene.surfaces
        pi = self._scene.occluders.ray_intersect_preliminary(ray)
        si = self._scene.interaction(pi, ray, True)
        normals, si.wi, reflects = facing(si, ray, surfaces)
        reflects &= si.is_valid()
        albedo = reflectance_at(si, surfaces, reflects)
        reflects &= dr.max(albedo) > 0
        albedo = dr.select(reflects, albedo, 0)
        random = mi.sample_tea_float32(sequence, ray_number)
        index, found = self._locator.picked(pi, si, ray, reflects, random)
        index = dr.select(found, index, NOTHING)
        cosine = dr.maximum(dr.abs(dr.dot(normals.geometric, ray.d)), LEAST_COSINE)
        footprint = dr.pi * dr.square(si.t) / (cosine * mi.Float(rays))
        position = si.p + self._offset * normals.geometric
        dr.eval(index, albedo, position, normals.shading, footprint)
        return index, albedo, position, normals.shading, footprint

    def _hops(self, met, size, kept):
        index, albedo, *_ = met
        hops = np.empty((size, kept), HOP)
        hops["point"] = np.array(index).reshape(size, -1)[:, :kept]
        for channel, values in enumerate(albedo):
            hops["albedo"][..., channel] = np.array(values).reshape(size, -1)[:, :kept]
        return hops.view(np.uint8)

    def _gather(self, met, first, size):
        """Irradiance (2, 3, b, k) after one reflection, by either half of the rays."""
        sums = (
            self._of_each(met, first, size)
            if not self._aimed
            else self._of_chosen(met, first, size)
        )
        return sums * np.float32(2 / self._rays)

    def _of_each(self, met, first, size):
        """Sums over rays, of all lamps at each place."""
        import drjit as dr

        mi = mitsuba()
        lane = dr.arange(mi.UInt32, self._k * 2 * size)
        size_ = dr.opaque(mi.UInt32, size)
        column = lane // size_  # lamp by lamp, half by half
        local, lamp, half = lane - column * size_, column >> 1, column & 1

        def add(number, total):
            value = self._reflected(met, local, number, lamp, first)
            return number + 2, total + value

        state = half, dr.zeros(mi.Color3f, dr.width(lane))
        rays = dr.opaque(mi.UInt32, self._rays)
        _, total = dr.while_loop(state, lambda number, _: number < rays, add)
        dr.eval(total)
        sums = np.stack([np.array(x) for x in total]).reshape(3, self._k, 2, size)
        return sums.transpose(2, 0, 3, 1)

    def _of_chosen(self, met, first, size):
        """The same of some lamps at each place, chosen by chance."""
        import drjit as dr

        mi = mitsuba()
        index = met[0]
        lane = dr.arange(mi.UInt32, self._aimed * 2 * size)
        size_ = dr.opaque(mi.UInt32, size)
        k, slots = dr.opaque(mi.UInt32, self._k), dr.opaque(mi.UInt32, self._aimed)
        column = lane // size_  # half by half, slot by slot
        local, slot = lane - column * size_, column >> 1
        rays = dr.opaque(mi.UInt32, self._rays)
        # Each lane has sums of its own, so that the order in which they are made is fixed.
        sums = dr.zeros(mi.Float, dr.width(lane) * self._k * 3)
        dr.make_opaque(sums)

        def add(number):
            entry = local * rays + number
            beside = dr.gather(mi.UInt32, index, entry)
            row = dr.select(beside == NOTHING, mi.UInt32(self._count), beside) * k
            draw = mi.sample_tea_float32(entry + dr.opaque(mi.UInt32, first) * rays, self._seed)
            draw = (mi.Float(slot) + draw) / mi.Float(slots)
            lamp = self._lamp_at(row, draw)
            below = dr.gather(mi.Float, self._chances, row + lamp - 1, lamp > 0)
            chance = dr.gather(mi.Float, self._chances, row + lamp) - below
            value = self._reflected(met, local, number, lamp, first) / (chance * mi.Float(slots))
            for channel in range(3):
                cell = (lane * k + lamp) * 3 + channel
                dr.scatter_reduce(
                    dr.ReduceOp.Add, sums, value[channel], cell, mode=dr.ReduceMode.NoConflicts
                )
            return (number + 2,)

        dr.while_loop((column & 1,), lambda number: number < rays, add)
        dr.eval(sums)
        sums = np.array(sums).reshape(self._aimed, 2, size, self._k, 3)
        return sums.sum(axis=0).transpose(0, 3, 1, 2)

    def _lamp_at(self, row, draw):
        """The first lamp up to which the chances of a row add up to more than a number in 0…1."""
        import drjit as dr

        mi = mitsuba()

        def halve(low, high):
            middle = (low + high) >> 1
            beyond = dr.gather(mi.Float, self._chances, row + middle) <= draw
            return dr.select(beyond, middle + 1, low), dr.select(beyond, high, middle)

        last = dr.opaque(mi.UInt32, self._k - 1) + dr.zeros(mi.UInt32, dr.width(draw))
        state = dr.zeros(mi.UInt32, dr.width(draw)), last
        return dr.while_loop(state, lambda low, high: low < high, halve)[0]

    def _reflected(self, met, local, number, lamp, first):
        """Direct light of a lamp that the place met by a ray reflects, times π: W/m²."""
        import drjit as dr

        mi = mitsuba()
        index, albedo, position, normal, footprint = met
        entry = local * dr.opaque(mi.UInt32, self._rays) + number
        index = dr.gather(mi.UInt32, index, entry)
        albedo, position, normal = (
            kind(*(dr.gather(mi.Float, x, entry) for x in values))
            for kind, values in (
                (mi.Color3f, albedo),
                (mi.Point3f, position),
                (mi.Normal3f, normal),
            )
        )
        reflects = dr.max(albedo) > 0
        # Aimed at alone, a lamp that is nearer than it is large gives samples without a bound.
        beside = reflects & (index != NOTHING) & self._lamps.near_at(lamp, position, BESIDE_LAMP)
        known = dr.gather(mi.Color3f, self._direct, index * self._k_opaque() + lamp, beside)
        point = local + dr.opaque(mi.UInt32, first)
        sequence = mi.sample_tea_32(point, self._seed * 0x9E3779B9 + _PLACES + 2 * lamp)[0]
        sequence += number & 1
        place = scrambled_place(shuffled(number >> 1, sequence), sequence ^ _PLACES)
        sample, weight, cosine = self._lamps.aimed(
            lamp, position, normal, place, reflects & ~beside
        )
        lit = self._lamps.visible(position, sample, dr.max(weight) > 0)
        spread = averaging(cosine, sample.dist, dr.gather(mi.Float, footprint, entry))
        value = weight * cosine * dr.select(sample.delta, spread, 1)
        return albedo * (dr.select(lit, value, 0) + known)

    def _k_opaque(self):
        import drjit as dr

        return dr.opaque(mitsuba().UInt32, self._k)


def _chances(direct):
    """Chances by which lamps are chosen beside each point, summed up from the first lamp on:
    (n + 1, k) float32, the last row for places without a point beside them.
    """
    power = direct.mean(axis=2, dtype=np.float64)
    k = power.shape[1]
    means = power.mean(axis=0)
    # Lamps are dimmed one by one: a weak one counts as much as a strong one.
    power = power / np.where(means > 0, means, 1)
    overall = np.full(k, 1 / k)
    sums = power.sum(axis=1, keepdims=True)
    beside = np.where(sums > 0, power / np.where(sums > 0, sums, 1), overall)
    beside = np.concatenate([beside, overall[None]])
    chances = np.cumsum((1 - ALIKE) * beside + ALIKE * overall, axis=1)
    chances = chances.astype(np.float32)
    chances[:, -1] = 1
    return chances
