"""What light can reach: particles that bounce through a scene, and random lines that measure its
surfaces.

Particles leave the sensors and local emitters and are reflected diffusely again and again (Meshless
PRT, section 4.1). In a closed room that process ends in equal density on all surfaces, and its
flights fill the space evenly: hits are candidates for sample points, places on flights candidates
for lights. Random lines of equal density in space and direction (Cauchy and Crofton) meet any
surface in proportion to its area, whatever kind of shape it is: that gives areas without
tessellation.
"""

from dataclasses import dataclass, fields

import numpy as np

from ..errors import SceneError
from ..scene.materials import facing, reflectance_at
from ..scene.surface_table import SurfaceTable
from ..system.arrays import packets
from ..system.runtime import mitsuba
from .thinning import thin

PARTICLES = 1 << 14  # on their way at a time
STEPS = 64  # hits of each
WARM_UP = 5  # of those, that do not count yet
OUTSIDE = 0.25  # share of the scene's extent by which flights that leave it are followed
LINES = 1 << 16  # at a time
CROSSINGS = 8  # of each line with surfaces, at a time
FREE_CANDIDATES = 8  # for each place in free space that stays
FLIGHTS = 1 << 18  # that places are drawn from
_MOST_RUNS = 64
_OFFSET = 2e-5  # share of the scene's scale by which rays start off a surface


@dataclass(frozen=True, eq=False)
class Hits:
    """Places on surfaces, on the side from which they were met.

    Parameters
    ----------
    positions : (m, 3) float32
    normals, geometric_normals : (m, 3) float32
        Shading normals and those of the faces.
    albedo : (m, 3) float32
        Diffuse reflectance.
    uv : (m, 2) float32
    surface : (m,) int32
        Index into `Scene.surfaces`.
    """

    positions: np.ndarray
    normals: np.ndarray
    geometric_normals: np.ndarray
    albedo: np.ndarray
    uv: np.ndarray
    surface: np.ndarray

    def __len__(self):
        return len(self.positions)

    def at(self, index):
        """Only those of an index array."""
        return Hits(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def joined(cls, parts):
        """All hits of a sequence of Hits."""
        return cls(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(cls)
            )
        )


def trace_particles(scene, count, seed=0):
    """Trace particles until so many hits are found.

    Parameters
    ----------
    scene : Scene
    count : int
        Hits wanted.
    seed : int

    Returns
    -------
    hits : Hits
        `count` of them or a few more.
    flights : (k, 2, 3) float32
        Start and end of flights from hit to hit, or to `OUTSIDE` of the scene's box.

    Raises
    ------
    SceneError
        If particles meet no surface that reflects.
    """
    import drjit as dr

    mi = mitsuba()
    table, box = SurfaceTable(scene.surfaces), _outer_box(scene.bounds)
    offset = dr.opaque(mi.Float, _OFFSET * scene.scale)
    hits, flights, found = [], [], 0
    for run in range(_MOST_RUNS):
        random = mi.PCG32(
            size=PARTICLES, initstate=mi.UInt64(dr.opaque(mi.UInt32, seed + 7919 * run))
        )
        pool = _source_rays(scene, PARTICLES * STEPS, seed + 7919 * run)
        kept = _Kept(PARTICLES * STEPS)
        lane = dr.arange(mi.UInt32, PARTICLES)

        def step(number, origin, direction, alive, random):
            fresh = [
                dr.gather(mi.Vector3f, rays, number * PARTICLES + lane, ~alive) for rays in pool
            ]
            ray = mi.Ray3f(
                dr.select(alive, origin, fresh[0]), dr.select(alive, direction, fresh[1])
            )
            si = scene.intersect(ray)
            normals, si.wi, reflects = facing(si, ray, scene.surfaces)
            # Off an edge a ray can start beyond the other wall, and meet the outer side of that.
            met = si.is_valid() & reflects & (si.t > offset)
            end = dr.select(si.is_valid(), si.p, ray(box.leave(ray)))
            kept.write(number * PARTICLES + lane, scene, table, si, normals, met, ray.o, end)
            cosine = mi.warp.square_to_cosine_hemisphere(
                mi.Point2f(random.next_float32(), random.next_float32())
            )
            return (
                number + 1,
                mi.Point3f(si.p + offset * normals.geometric),
                mi.Frame3f(normals.geometric).to_world(cosine),
                met,
                random,
            )

        start = (
            dr.opaque(mi.UInt32, 0),
            mi.Point3f(0),
            mi.Vector3f(0, 0, 1),
            dr.opaque(mi.Bool, False),
            random,
        )
        dr.while_loop(start, lambda number, *_: number < STEPS, step)
        block, flown = kept.read(WARM_UP * PARTICLES)
        hits.append(block)
        flights.append(flown)
        found += len(block)
        if found >= count:
            return Hits.joined(hits), np.concatenate(flights)
        if not found:
            break
    raise SceneError(
        f"particles from the scene's sensors and local emitters find {found:,} places on surfaces"
        f" that reflect, too few for {count:,}"
    )


def example_places(scene, count, seed=0, flights=None):
    """Places in the space between surfaces, apart from each other: where lights may stand.

    Parameters
    ----------
    scene : Scene
    count : int
    seed : int
    flights : (k, 2, 3) float32, optional
        Of particles; they are traced where they are not given.

    Returns
    -------
    (count, 3) float32

    Raises
    ------
    SceneError
        See `trace_particles`.
    """
    if flights is None:
        flights = trace_particles(scene, FLIGHTS, seed)[1]
    places = free_places(flights, FREE_CANDIDATES * count, seed)
    return places[thin(places, None, count, seed, dimension=3)[0]]


def free_places(flights, count, seed=0):
    """Places (count, 3) float32 spread evenly over the space that flights (k, 2, 3) go through."""
    random = np.random.default_rng(seed)
    length = np.linalg.norm(flights[:, 1] - flights[:, 0], axis=1).astype(np.float64)
    length[~np.isfinite(length)] = 0
    chosen = random.choice(len(flights), count, p=length / length.sum())
    share = random.random((count, 1), dtype=np.float32)
    return flights[chosen, 0] * (1 - share) + flights[chosen, 1] * share


def cross_surfaces(scene, centre, radius, seed=0):
    """Where random lines through a ball meet surfaces that reflect: a stream of blocks.

    Parameters
    ----------
    scene : Scene
    centre : (3,)
    radius : float
        Metres.
    seed : int

    Yields
    ------
    hits : Hits
        Within the ball, on the side that the line comes from.
    area : float
        m² that each of the block's hits stands for.
    """
    import drjit as dr

    mi = mitsuba()
    sampler = mi.load_dict({"type": "independent"})
    centre, extent = mi.Point3f(np.asarray(centre, np.float32)), dr.opaque(mi.Float, radius)
    offset = dr.opaque(mi.Float, _OFFSET * scene.scale)
    table, lane, block = SurfaceTable(scene.surfaces), dr.arange(mi.UInt32, LINES), 0
    while True:
        sampler.seed(seed + 7919 * block, LINES)
        line = _lines(sampler, centre, extent)
        origin, active, parts = mi.Point3f(line.o), dr.full(mi.Bool, True, LINES), []
        dr.eval(line, origin, active)
        while dr.any(active):
            kept = _Kept(LINES * CROSSINGS)

            def step(number, origin, active):
                ray = mi.Ray3f(origin, line.d)
                si = scene.intersect(ray, active)
                normals, si.wi, reflects = facing(si, ray, scene.surfaces)
                active &= si.is_valid() & (dr.dot(si.p - centre, line.d) < extent)
                met = active & reflects & (dr.norm(si.p - centre) < extent)
                kept.write(number * LINES + lane, scene, table, si, normals, met, origin, si.p)
                return number + 1, mi.Point3f(si.p + offset * line.d), active

            state = (dr.opaque(mi.UInt32, 0), origin, active)
            _, origin, active = dr.while_loop(
                state, lambda number, origin, active: active & (number < CROSSINGS), step
            )
            parts.append(kept.read()[0])
        yield Hits.joined(parts), 4 * np.pi * radius**2 / LINES
        block += 1


def _source_rays(scene, count, seed):
    """Origins and directions (flat mi.Float) of so many rays that leave the sensors and local
    emitters of a scene, half of them each.

    Where there are none, random lines through the scene.
    """
    mi = mitsuba()
    sampler = mi.load_dict({"type": "independent"})
    kinds = [
        [s for s in kind if _sends_rays(s)]
        for kind in (scene.mi_scene.sensors(), scene.local_emitters)
    ]
    kinds = [kind for kind in kinds if kind]
    rays = []
    if not kinds:
        low, high = scene.bounds
        centre = mi.Point3f(*map(float, (low + high) / 2))
        sampler.seed(seed, count)
        rays.append(
            (_lines(sampler, centre, mi.Float(float(np.linalg.norm(high - low)) / 2)), count)
        )
    for k, kind in enumerate(kinds):
        total = _share(count, k, len(kinds))
        for i, source in enumerate(kind):
            share = _share(total, i, len(kind))
            if share:
                sampler.seed(seed + i, share)
                rays.append(
                    (
                        source.sample_ray(
                            0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
                        )[0],
                        share,
                    )
                )
    # else some lanes would start from one source only
    random = np.random.default_rng(seed).permutation(count)
    vectors = (
        np.concatenate([_rows(getattr(ray, name), n) for ray, n in rays]) for name in ("o", "d")
    )
    # `take` of rows that lie together is several times as fast as an index
    return [packets(np.ascontiguousarray(v).take(random, axis=0)) for v in vectors]


def _sends_rays(source):
    """Whether Mitsuba can sample rays of a sensor or emitter; it cannot of those that measure at a
    surface.
    """
    mi = mitsuba()
    try:
        source.sample_ray(0.0, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
    except RuntimeError:
        return False
    return True


def _share(total, number, parts):
    """How many of a total the part of a number gets, of so many equal parts."""
    return total * (number + 1) // parts - total * number // parts


def _rows(vectors, count):
    """Vectors (count, 3); those that are the same in all lanes are there only once."""
    return np.broadcast_to(np.array(vectors).reshape(3, -1), (3, count)).T


def _lines(sampler, centre, radius):
    """Rays along random lines through a ball, of equal density in space and direction."""
    mi = mitsuba()
    direction = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
    across = mi.Frame3f(direction).to_world(mi.Vector3f(disk.x, disk.y, 0))
    return mi.Ray3f(centre + radius * (across - direction), direction)


class _Box:
    def __init__(self, low, high):
        mi = mitsuba()
        self._low, self._high = mi.Point3f(low), mi.Point3f(high)

    def leave(self, ray):
        """Distance at which rays leave the box for good; 0 for those that pass it by."""
        import drjit as dr

        inverse = 1 / dr.select(dr.abs(ray.d) < 1e-12, mitsuba().Float(1e-12), ray.d)
        far = dr.maximum((self._low - ray.o) * inverse, (self._high - ray.o) * inverse)
        return dr.maximum(dr.min(far), 0)


def _outer_box(bounds):
    low, high = bounds.astype(np.float32)
    margin = OUTSIDE * (high - low).max()
    return _Box(low - margin, high + margin)


class _Kept:
    """What is kept of hits inside a loop of Dr.Jit: rows of `Hits` and flights by number."""

    _WIDTHS = (3, 3, 3, 3, 2, 1, 3, 3)  # of the fields of Hits, and of the two ends of a flight

    def __init__(self, rows):
        import drjit as dr

        mi = mitsuba()
        self._rows = rows
        self._columns = [dr.zeros(mi.Float, rows * width) for width in self._WIDTHS]
        self._met = dr.zeros(mi.Bool, rows)

    def write(self, row, scene, table, si, normals, met, start, end):
        """Keep a wavefront, `si.wi` being on the side that is met."""
        import drjit as dr

        mi = mitsuba()
        albedo = reflectance_at(si, scene.surfaces, met)
        surface = mi.Float(table.index(si, met))
        values = (si.p, normals.shading, normals.geometric, albedo, si.uv, surface, start, end)
        for column, value in zip(self._columns, values):
            dr.scatter(column, value, row)
        dr.scatter(self._met, met, row)

    def read(self, first=0):
        """Hits from a row on, and all flights (k, 2, 3) from there on."""
        met = np.flatnonzero(np.array(self._met)[first:])
        columns = [np.array(column).reshape(self._rows, -1)[first:] for column in self._columns]
        fields = [column.take(met, axis=0) for column in columns[:6]]
        return Hits(*fields[:5], fields[5][:, 0].astype(np.int32)), np.stack(columns[6:], axis=1)  # pyright: ignore[reportCallIssue]
