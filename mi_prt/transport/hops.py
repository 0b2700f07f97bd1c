"""One hop of light between points: what the blocked part of each point's hemisphere looks at.

Light reaches a point x after a reflection from the directions in which x sees a surface, E(x) =
E_direct(x) + ∫ ρ(y) E(y)/π cos θ dω, y being what is seen there. The integral is a linear operator
that takes the irradiance of all points to irradiance after one more reflection: the paper's first
extension (Eigentransport, section 8), as a sparse matrix. Its rows are sampled by rays into just
those directions that the direct transport found blocked, so that what escapes and what is seen add
up to the whole hemisphere: a white furnace is white without noise.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ..scene.materials import facing, reflectance_at
from ..system.arrays import indices, packets
from ..system.parallel import BLOCK_ROWS, map_chunks
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET

# in the place of a point: what is seen reflects nothing, or nothing that is known
NOTHING = 0xFFFFFFFF
HOP = np.dtype([("point", "<u4"), ("albedo", "<f4", 3)])
# of rays that a thread reads at a time; what it makes of them takes three times that
_READ_BYTES = 1 << 22


@dataclass(frozen=True, eq=False)
class Hops:
    """The sampled operator, for n points and K rays of each.

    Parameters
    ----------
    rays : (n, 16·K) uint8, array or RowFile
        `HOP` of each ray: the point seen, picked among the three around the hit by their weights,
        and the albedo of the hit.
    blocked : (n,) float32
        Share of each point's cosine-weighted hemisphere in which it sees a surface.
    first, stride : int
        Which of the rays of each point are used.
    """

    rays: Any
    blocked: np.ndarray
    first: int = 0
    stride: int = 1

    def halves(self):
        """Two operators of every other ray, independent of each other."""
        return Hops(self.rays, self.blocked, 0, 2), Hops(self.rays, self.blocked, 1, 2)

    @property
    def count(self):
        """Rays of each point."""
        return len(range(self.first, self.rays.shape[1] // HOP.itemsize, self.stride))

    def thinned(self, factor):
        """The same operator by every `factor`-th ray: noisier, and as many times faster."""
        return Hops(self.rays, self.blocked, self.first, self.stride * factor)

    def largest_albedo(self):
        """The largest albedo, in any channel, of what is seen."""

        def largest(first):
            rays = self._read(first)
            return (
                rays["albedo"]
                .max(axis=-1, where=(rays["point"] != NOTHING)[..., None], initial=0.0)
                .max(initial=0.0)
            )

        return float(max(map_chunks(largest, self._starts())))

    def _starts(self):
        """The first points of the blocks that are worked on at a time; results do not depend on
        their size.
        """
        return range(0, len(self.blocked), max(1, _READ_BYTES // self.rays.shape[1]))

    def _read(self, first):
        rows = np.ascontiguousarray(
            self.rays[first : min(first + self._starts().step, len(self.blocked))]
        )
        return rows.view(HOP)[:, self.first :: self.stride]

    def apply(self, irradiance):
        """Irradiance after one more reflection.

        Parameters
        ----------
        irradiance : (c, n, m) float32
            For each colour channel; of what linear quantity its m numbers are does not matter.

        Returns
        -------
        (c, n, m) float32
        """
        result = np.empty_like(irradiance)

        def product(first):
            rays = self._read(first)
            seen = rays["point"] != NOTHING
            ends = np.concatenate([[0], np.cumsum(seen.sum(axis=1))]).astype(np.int32)
            columns = rays["point"][seen].astype(np.int32)
            share = self.blocked[first : first + len(rays), None] / np.float32(rays.shape[1])
            for channel, arriving in enumerate(irradiance):
                weights = (_channel(rays["albedo"], channel, len(irradiance)) * share)[seen]
                matrix = scipy.sparse.csr_array(
                    (weights, columns, ends), (len(rays), len(self.blocked))
                )
                result[channel, first : first + len(rays)] = matrix @ arriving

        for _ in map_chunks(product, self._starts()):
            pass
        return result


def _channel(albedo, channel, channels):
    """Albedo of one of three channels, or of the only one."""
    return albedo[..., channel] if channels == 3 else albedo.mean(axis=-1)


class HopSampler:
    """Traces the hops of a scene's points, block by block; see `Hops`.

    Parameters
    ----------
    scene : Scene
    points : Points
        Buried ones reflect nothing; the others around a hit take their share.
    transport : DirectTransport
    directions : DirectionLattice
    rays : int
        K, for each point.
    seed : int
    lanes : int
        Most rays of one wavefront. Results do not depend on it.
    """

    def __init__(self, scene, points, transport, directions, rays, seed=0, lanes=LANES):
        self._scene, self._points, self._transport, self._seed = scene, points, transport, seed
        self._locator = points.locator(scene)
        self._origins = packets(points.ray_origins(RAY_OFFSET * scene.scale))
        # Cell by cell: a sweep over all directions for each of a cell's rays would meet the strata
        # in the same places again and again.
        vectors = transport.vectors.swapaxes(0, 1).reshape(-1, 3)
        lengths = np.linalg.norm(vectors, axis=1)  # the share of its cell that each ray stands for
        self._vectors = vectors / lengths[:, None]
        half = len(directions) // 2
        self._solid_angles = (
            np.repeat(directions.solid_angles[:half], len(transport.vectors)) * lengths
        ).astype(np.float32)
        self._rays = rays
        self._offsets = np.random.default_rng(seed).random((len(points), 1), dtype=np.float32)
        self._lanes = lanes
        self._step = max(1, lanes // (rays * BLOCK_ROWS)) * BLOCK_ROWS
        self.rays_per_point = rays
        self.row_bytes = rays * HOP.itemsize

    def blocks(self, first=0):
        """Rows (b, row_bytes) uint8 of all points from `first` on, in order."""
        for start in range(first, len(self._points), self._step):
            yield self.rows(np.arange(start, min(start + self._step, len(self._points)))).view(
                np.uint8
            )

    def rows(self, index):
        """Hops (b, K) of some points."""
        # Chunks begin at the same points whatever the blocks are: how a matrix product rounds
        # depends on its shape.
        parts = map_chunks(
            self._blocked_directions,
            [index[i : i + BLOCK_ROWS] for i in range(0, len(index), BLOCK_ROWS)],
        )
        directions, active = (np.concatenate(part) for part in zip(*parts))
        hops = np.empty((len(index), self._rays), HOP)
        step = max(1, self._lanes // self._rays)
        for first in range(0, len(index), step):
            part = slice(first, first + step)
            hops[part] = self._traced(index[part], directions[part], active[part])
        return hops

    def _blocked_directions(self, index):
        """K blocked directions of some points (b, K, 3), stratified, in proportion to cosine times
        solid angle; and if there are any.
        """
        cosines = self._points.normals[index] @ self._vectors.T
        weights = np.abs(cosines) * self._solid_angles
        bits = np.unpackbits(self._transport.bits[index], axis=1, count=cosines.shape[1])
        weights *= (
            bits.reshape(len(index), len(self._transport.vectors), -1)
            .swapaxes(1, 2)
            .reshape(weights.shape)
            == 0
        )
        total = np.cumsum(weights, axis=1, dtype=np.float64)
        # Shifted round by any part of the whole: rays that are left out (see `thinned`) are then
        # missed in other places at each point.
        wanted = (np.arange(self._rays) / self._rays + self._offsets[index]) % 1 * total[:, -1:]
        # Rows one behind the other make a single ascending sequence to search in.
        before = np.cumsum(np.append(0, total[:-1, -1]))[:, None]
        ray = np.searchsorted(
            (total + before).ravel(), (wanted + before).ravel(), side="right"
        ).reshape(wanted.shape)
        ray = np.clip(ray - np.arange(len(index))[:, None] * total.shape[1], 0, total.shape[1] - 1)
        sign = np.where(np.take_along_axis(cosines, ray, axis=1) < 0, np.float32(-1), np.float32(1))
        return self._vectors[ray] * sign[..., None], total[:, -1] > 0

    def _traced(self, index, directions, active):
        import drjit as dr

        mi = mitsuba()
        lanes = len(index) * self._rays
        # Arrays go over flat and come back by component: those of other shapes compile a kernel for
        # each size. And they are gathered from: those that are read lane by lane compile another
        # kernel where their memory is aligned otherwise.
        lane = dr.arange(mi.UInt32, lanes)
        rays = dr.opaque(mi.UInt32, self._rays)
        local = lane // rays
        owner = dr.gather(mi.UInt32, indices(index), local)
        origin = dr.gather(mi.Point3f, self._origins, owner)
        ray = mi.Ray3f(origin, dr.gather(mi.Vector3f, packets(directions), lane))
        active = dr.gather(mi.UInt32, indices(active), local) > 0
        pi = self._scene.occluders.ray_intersect_preliminary(ray, active=active)
        si = self._scene.interaction(pi, ray, active)
        _, si.wi, reflects = facing(si, ray, self._scene.surfaces)
        # The number is hashed from point and ray, so that it depends on nothing else.
        number = lane - local * rays + dr.opaque(mi.UInt32, self._seed * self._rays % (1 << 32))
        random = mi.sample_tea_float32(owner, number)
        active &= si.is_valid() & reflects
        point, found = self._locator.picked(pi, si, ray, active, random)
        albedo = reflectance_at(si, self._scene.surfaces, found)
        point = dr.select(found & (dr.max(albedo) > 0), point, NOTHING)
        hops = np.empty(lanes, HOP)
        dr.eval(point, albedo)
        hops["point"] = np.array(point)
        for channel, values in enumerate(albedo):
            hops["albedo"][:, channel] = np.array(values)
        return hops.reshape(len(index), self._rays)


def blocked_share(transport, solid_angles):
    """Share (n,) float32 of each point's cosine-weighted hemisphere in which it sees a surface.

    It is what the visible part leaves of π, so that no energy comes from the quadrature; where
    every ray escapes it is zero.
    """
    weights = (solid_angles / np.pi).astype(np.float32)[:, None]
    visible = (transport @ weights)[:, 0]
    return np.where(transport.open(), 0, np.maximum(1 - visible, 0)).astype(np.float32)
