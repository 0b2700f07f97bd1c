"""Direct transport T_ij = V·max(0, n·ω) (Eigentransport, eq.

1), sampled by ray queries and kept as visibility bits.
"""

import numpy as np

from ..basis.transport_rows import DirectTransport
from ..system.arrays import packets
from ..system.runtime import mitsuba

LANES = 1 << 22  # rays of a wavefront: a few million keep both cores busy in a few hundred MB
RAY_OFFSET = 2e-5  # share of the scene's scale by which rays start off the surface
BURIED_RAYS, FIRST_RAYS = 64, 8


class DirectSampler:
    """Traces the direct transport of a scene's points, block by block.

    Parameters
    ----------
    scene : Scene
    points : Points
    directions : DirectionLattice
    rays_per_direction : int
        Rays in each cell; more of them antialias visibility.
    lanes : int
        Most rays of one wavefront. Results do not depend on it.
    """

    def __init__(self, scene, points, directions, rays_per_direction=1, lanes=LANES):
        vectors, fractions = directions.subdivided(rays_per_direction)
        half = len(directions) // 2
        vectors, fractions = vectors[:half].swapaxes(0, 1), fractions[:half].T
        self._normals = points.normals
        self._vectors = vectors * fractions[..., None]
        self._tracer = VisibilityTracer(scene, points, vectors.reshape(-1, 3))
        self._step = max(1, lanes // self._tracer.lanes_per_point)
        self.rays_per_point = self._tracer.lanes_per_point
        self.row_bytes = -(-self.rays_per_point // 8)

    def blocks(self, first=0):
        """Visibility bits (b, row_bytes) uint8 of all points from `first` on, in order."""
        count = len(self._normals)
        return self._tracer.stream(
            (i, min(self._step, count - i)) for i in range(first, count, self._step)
        )

    def transport(self, bits):
        """The transport matrix of the bits of all points: an array, or what gives arrays when it is
        indexed.
        """
        return DirectTransport(
            self._normals, self._vectors, bits, len(self._normals) * self.rays_per_point
        )


def sample_direct(scene, points, directions, rays_per_direction=1):
    """Trace the direct transport of all points into memory; see `DirectSampler`.

    Returns
    -------
    DirectTransport
    """
    sampler = DirectSampler(scene, points, directions, rays_per_direction)
    return sampler.transport(np.concatenate(list(sampler.blocks())))


class VisibilityTracer:
    """Occlusion rays from points into fixed directions, in blocks that share one kernel.

    Of two opposite directions one lies above the horizon of any point: each lane traces that one,
    and none is idle. What changes from block to block is opaque to the compiler; literals would
    compile a kernel each.

    Parameters
    ----------
    scene : Scene
    points : Points
    vectors : (k, 3) float32
        One of each pair of opposite directions.
    """

    def __init__(self, scene, points, vectors):
        self.occluders = scene.occluders
        self.lanes_per_point = len(vectors)
        # Rays start on the side of the surface that reflects, and off its rim. One that dips below
        # the faces around its vertex (the hemisphere of a smooth normal can) runs into them and is
        # blocked, as it is in Mitsuba's own rendering.
        origins = points.ray_origins(RAY_OFFSET * scene.scale)
        self._vectors, self._origins, self._normals = (
            packets(np.pad(x, ((0, 0), (0, 1))))  # 4 floats each: gathered in one load
            for x in (vectors, origins, points.normals)
        )

    def rays(self, first, size):
        """The rays above the horizon of points first…first+size, point by point."""
        import drjit as dr

        mi = mitsuba()

        def vectors(source, index):
            v = dr.gather(mi.Vector4f, source, index)
            return mi.Vector3f(v.x, v.y, v.z)

        lane = dr.arange(mi.UInt32, size * self.lanes_per_point)
        per_point = dr.opaque(mi.UInt32, self.lanes_per_point)
        local = lane // per_point
        point = local + dr.opaque(mi.UInt32, first)
        direction = vectors(self._vectors, lane - local * per_point)
        above = dr.mulsign(direction, dr.dot(vectors(self._normals, point), direction))
        return mi.Ray3f(vectors(self._origins, point), above)

    def stream(self, blocks):
        """Packed visibility (size, ceil(k/8)) uint8 of each block (first, size).

        Each block is started before the one before it is read, so that rays are traced while bits
        are packed.
        """
        waiting = None
        for first, size in blocks:
            started = self._start(first, size)
            if waiting is not None:
                yield self._packed(waiting)
            waiting = started
        if waiting is not None:
            yield self._packed(waiting)

    def _start(self, first, size):
        import drjit as dr

        visible = ~self.occluders.ray_test(self.rays(first, size))
        dr.eval(visible)  # returns at once; reading the array waits
        return visible

    def _packed(self, visible):
        return np.packbits(np.array(visible).reshape(-1, self.lanes_per_point), axis=1)


def find_buried(scene, points, dark=None, lanes=LANES):
    """Which points without any sky lie inside or against other geometry.

    A point is buried when every ray of its hemisphere ends on the back of a face, or nearer than
    1e-3 of the scene's scale and a tenth of the distance between points there: feet below the
    ground, a floor under a box. A dark corner, which other light may reach, is not.

    Parameters
    ----------
    scene : Scene
    points : Points
    dark : (n,) bool, optional
        Points that see no direction of the sky, the only ones that can be buried; where that is not
        known, all are tried.
    lanes : int
        Most rays of one wavefront.

    Returns
    -------
    (n,) bool
    """
    buried = np.zeros(len(points), bool)
    index = np.arange(len(points)) if dark is None else np.flatnonzero(dark)
    # A fixed spherical Fibonacci set, flipped into each hemisphere.
    z = 1 - (np.arange(BURIED_RAYS) + 0.5) * 2 / BURIED_RAYS
    phi = np.arange(BURIED_RAYS) * np.pi * (3 - 5**0.5)
    vectors = np.stack(
        [np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1
    ).astype(np.float32)
    first = np.zeros(BURIED_RAYS, bool)
    first[:: BURIED_RAYS // FIRST_RAYS] = True
    # Most points are told free by a few rays; the others need them all.
    for some in (vectors[first], vectors[~first]):
        step = max(1, lanes // len(some))
        blocks = np.split(index, range(step, len(index), step)) if len(index) else []
        inside = [_all_inside(scene, points.at(block), some) for block in blocks]
        index = index[np.concatenate(inside)] if inside else index
    buried[index] = True
    return buried


def _all_inside(scene, points, vectors):
    """Whether rays from points along all vectors (r, 3), flipped into their hemispheres, end inside
    of or against geometry.
    """
    import drjit as dr

    mi = mitsuba()
    count = len(vectors)
    normals = np.repeat(points.normals, count, axis=0)
    toward = np.tile(vectors, (len(points), 1))
    toward *= np.where(np.sum(toward * normals, axis=1) < 0, -1, 1)[:, None].astype(np.float32)
    origins = points.ray_origins(RAY_OFFSET * scene.scale)
    lane = dr.arange(mi.UInt32, len(toward))  # gathered: arrays read lane by lane compile anew
    point = lane // dr.opaque(mi.UInt32, count)
    ray = mi.Ray3f(
        dr.gather(mi.Point3f, packets(origins), point),
        dr.gather(mi.Vector3f, packets(toward), lane),
    )
    hit = scene.intersect(ray)
    near = np.minimum(1e-3 * scene.scale, 0.1 * np.sqrt(points.areas)).astype(np.float32)
    # one more: what has a single entry is not gathered but compiled in another way
    near = dr.gather(mi.Float, packets(np.append(near, 0)), point)
    inside = hit.is_valid() & ((dr.dot(hit.n, ray.d) > 0) | (hit.t < near))
    return np.array(inside).reshape(-1, count).all(axis=1)
