"""Indirect transport by paths: unbiased, and slower than `hops` for the same noise.

A path starts at a point, is reflected from surface to surface, and counts in the direction in which
it leaves the scene; its cost does not depend on the number of directions. The light is not known
when transport is computed, every direction shines alike, and so there is no emitter to aim at:
leaving in a direction of the reflection's own cosine distribution is the best estimate of a single
path. (Aiming at what the points at the next hit see of the sky is what `hops` do.)
"""

import numpy as np
import scipy.sparse

from ..scene.materials import facing, reflectance_at
from ..system.arrays import indices, packets
from ..system.parallel import BLOCK_ROWS, map_chunks
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET
from .hops import NOTHING

ROULETTE_FROM = 3  # reflections after which a path may end by chance
MOST_LIKELY = 0.95  # probability of going on: below 1, so that paths end between white walls too
# of the numbers of reflections that energy is told for; the last one holds all higher ones
ENERGY_BINS = 64
# Roberts' R2 sequence: the powers of the inverse plastic number
_PLASTIC = 0.7548776662466927, 0.5698402909980532


class PathSampler:
    """Traces indirect transport of a scene's points, block by block.

    Parameters
    ----------
    scene : Scene
    points : Points
    directions : DirectionLattice
    paths : int
        N, from each point; even.
    bounces : int or None
        Most reflections of a path; None for any number.
    channels : 1 or 3
    encode : callable(sparse (b, s)) returning (b, m) float32
        Coefficients of transport rows.
    seed : int
    lanes : int
        Most paths of one wavefront. Results do not depend on it.
    """

    def __init__(
        self, scene, points, directions, paths, bounces, channels, encode, seed=0, lanes=LANES
    ):
        import drjit as dr

        mi = mitsuba()
        self._scene, self._count, self._directions = scene, len(points), directions
        self._paths, self._channels, self._encode = paths, channels, encode
        self._bounces = dr.opaque(mi.UInt32, NOTHING if bounces is None else bounces)
        self._offset = dr.opaque(mi.Float, RAY_OFFSET * scene.scale)
        self._origins = packets(points.ray_origins(RAY_OFFSET * scene.scale))
        self._normals = packets(points.normals)
        self._seed = dr.opaque(mi.UInt32, seed % (1 << 32))
        self._step = max(1, lanes // paths)
        self.rays_per_point = paths

    def row_bytes(self, components):
        """Bytes of a row of `blocks` with so many coefficients m."""
        return 4 * (2 * self._channels * components + ENERGY_BINS)

    def blocks(self, first=0):
        """Rows (b, row_bytes(m)) uint8 of all points from `first` on, in order: float32
        coefficients (2, c, m) of the paths with an even and an odd number, and the energy of 1…64
        reflections (see `energies`).
        """
        for start in range(first, self._count, self._step):
            index = np.arange(start, min(start + self._step, self._count))
            escapes = self.escapes(index)
            chunks = np.array_split(np.arange(len(index)), -(-len(index) // BLOCK_ROWS))
            rows = np.concatenate(
                list(map_chunks(lambda chunk: self._row([x[chunk] for x in escapes]), chunks))
            )
            yield np.ascontiguousarray(rows).view(np.uint8)

    def _row(self, escapes):
        halves = [
            self._encode(rows)
            for first in (0, 1)
            for rows in self.transport([x[:, first::2] for x in escapes])
        ]
        return np.concatenate([*halves, energies(escapes, self._paths)], axis=1, dtype=np.float32)

    def transport(self, escapes):
        """Rows of indirect transport, a sparse (b, s) for each channel, of paths (cell, throughput,
        reflections) (b, k).
        """
        cell, throughput, _ = escapes
        b, k = cell.shape
        seen = cell != NOTHING
        ends = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
        columns = cell[seen].astype(np.int32)
        scale = (np.pi / k / self._directions.solid_angles[columns]).astype(np.float32)
        carried = throughput[seen]
        carried = carried.T if self._channels == 3 else carried.mean(axis=1)[None]
        return [
            scipy.sparse.csr_array((c * scale, columns, ends), (b, len(self._directions)))
            for c in carried
        ]

    def escapes(self, index):
        """Where the paths of some points leave.

        Parameters
        ----------
        index : (b,) int array

        Returns
        -------
        cell : (b, N) uint32
            Of the direction lattice; NOTHING where a path met no surface, or never left.
        throughput : (b, N, 3) float32
            Product of the albedos on the way, over the probability of not having been ended.
        reflections : (b, N) uint32
        """
        vectors, throughput, reflections = self._traced(index)
        shape = len(index), self._paths
        cell = np.full(len(vectors), NOTHING, np.uint32)
        left = np.flatnonzero(reflections)
        chunks = np.array_split(left, -(-len(left) // 100_000) or 1)
        for chunk, cells in zip(
            chunks, map_chunks(lambda chunk: self._directions.cells(vectors[chunk]), chunks)
        ):
            cell[chunk] = cells
        return cell.reshape(shape), throughput.reshape(*shape, 3), reflections.reshape(shape)

    def _traced(self, index):
        """Direction (k, 3), throughput (k, 3) and number of reflections (k,) of escaped paths; 0
        reflections for all others.
        """
        import drjit as dr

        mi = mitsuba()
        width = len(index) * self._paths
        lane = dr.arange(mi.UInt32, width)
        paths = dr.opaque(mi.UInt32, self._paths)
        local = lane // paths
        owner = dr.gather(mi.UInt32, indices(index), local)
        number = lane - local * paths
        state = mi.sample_tea_32(owner, number + self._seed * 0x9E3779B9)
        random = mi.PCG32(initstate=mi.UInt64(state[0]), initseq=mi.UInt64(state[1]))
        # First directions of a point are stratified: a low-discrepancy sequence, shifted at random
        # for each point.
        shift = [mi.sample_tea_float32(owner, self._seed * 2 + axis + 0x51ED27) for axis in (0, 1)]
        place = [s + (n := mi.Float64(number) * r) - dr.floor(n) for s, r in zip(shift, _PLASTIC)]
        place = mi.Point2f([mi.Float(x - dr.floor(x)) for x in place])
        normal = dr.gather(mi.Normal3f, self._normals, owner)
        origin = dr.gather(mi.Point3f, self._origins, owner)
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(place))
        scene, offset, most = self._scene, self._offset, self._bounces

        def step(origin, direction, throughput, reflections, active, random):
            ray = mi.Ray3f(origin, direction)
            si = scene.intersect(ray, active)
            hit = active & si.is_valid()
            escaped = active & ~hit
            normal, si.wi, reflects = facing(si, ray, scene.surfaces)
            albedo = reflectance_at(si, scene.surfaces, hit)
            going = hit & reflects & (reflections < most)
            throughput = dr.select(going, throughput * albedo, throughput)
            reflections = dr.select(going, reflections + 1, reflections)
            likely = dr.select(
                reflections < ROULETTE_FROM, 1, dr.minimum(dr.max(throughput), MOST_LIKELY)
            )
            going &= (random.next_float32(going) < likely) & (dr.max(throughput) > 0)
            throughput = dr.select(going, throughput / likely, throughput)
            place = mi.Point2f(random.next_float32(going), random.next_float32(going))
            onward = mi.Frame3f(normal.shading).to_world(mi.warp.square_to_cosine_hemisphere(place))
            origin = dr.select(going, si.p + offset * normal.geometric, origin)
            direction = dr.select(going, onward, direction)
            # what ends inside counts nothing
            reflections = dr.select(active & ~going & ~escaped, 0, reflections)
            return origin, direction, throughput, reflections, going, random

        state = (
            origin,
            direction,
            dr.full(mi.Color3f, 1, width),
            dr.zeros(mi.UInt32, width),
            dr.full(mi.Bool, True, width),
            random,
        )
        names = ("origin", "direction", "throughput", "reflections", "active", "random")
        state = dr.while_loop(state, lambda *s: s[4], step, labels=names)
        _, direction, throughput, reflections, _, _ = state
        dr.eval(direction, throughput, reflections)
        direction, throughput = (
            np.stack([np.array(x) for x in values], axis=-1) for values in (direction, throughput)
        )
        return direction, throughput, np.array(reflections)


def energies(escapes, paths):
    """Irradiance (b, 64) in units of π under a uniform sky of radiance 1 after 1…64 reflections,
    mean of the channels.
    """
    cell, throughput, reflections = escapes
    row, path = np.nonzero(cell != NOTHING)
    bin_ = np.minimum(reflections[row, path], ENERGY_BINS) - 1
    carried = throughput[row, path].mean(axis=1) / paths
    return np.bincount(row * ENERGY_BINS + bin_, carried, len(cell) * ENERGY_BINS).reshape(
        len(cell), ENERGY_BINS
    )
