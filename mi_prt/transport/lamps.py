"""Direct light of a scene's own lamps at its points, by shadow rays over the whole of each lamp."""

# Mitsuba's stubs know nothing of what a pointer to an emitter or a register array can do.
# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false

from dataclasses import dataclass

import numpy as np

from ..errors import LightError
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET
from .sequences import scrambled_place

TOLERANCE = 0.01  # standard error that is aimed at, as a share of the irradiance
# share of a lamp's mean irradiance below which a point's error is measured against that share
DIM = 0.05
GROUPS = 4  # sequences of each point and lamp; their spread is the error
PILOT = 8  # samples of each sequence before the first look at the error
MOST_SAMPLES = 1024  # of each point and lamp, all sequences together
MEAN_POINTS = 1024  # that tell the mean irradiance of a lamp
NEAR = 1.0  # squared distance to a lamp, over its area, below which rays of the hemisphere help
HEMISPHERE = 0x5BD1E995  # makes of a sequence another
SHADOW_END = 1e-4  # share of the way to a lamp by which shadow rays end before it


@dataclass(frozen=True, eq=False)
class DirectLight:
    """Direct irradiance of k lamps at n points.

    Parameters
    ----------
    irradiance : (n, k, 3) float32
        W/m².
    standard_error : (n, k) float32
        Of the irradiance, norm over the channels; of a point by itself uncertain, as four sequences
        tell it.
    rays : int
        Shadow rays traced.
    """

    irradiance: np.ndarray
    standard_error: np.ndarray
    rays: int

    def noise(self, weights):
        """Relative RMS noise (k,) of each lamp's irradiance; 0 for a lamp that lights no point.

        Parameters
        ----------
        weights : (n,) array
            The points' shares in the mean.
        """
        return relative_noise(self.irradiance, self.standard_error, weights)


class Lamps:
    """Local emitters of a scene by number, in Dr.Jit.

    One kernel serves all of them: which emitter a lane samples is data.

    Parameters
    ----------
    scene : Scene
        Whose shapes cast shadows.
    emitters : sequence of mi.Emitter

    Raises
    ------
    LightError
        If one is distant, or its light cannot be sampled from a point (it is named).
    """

    def __init__(self, scene, emitters):
        import drjit as dr

        mi = mitsuba()
        for emitter in emitters:
            _check(emitter)
        ids = [dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e))[0] for e in emitters]
        self._ids = mi.UInt32(np.array(ids, np.uint32))
        self._occluders = scene.occluders
        self._offset = dr.opaque(mi.Float, RAY_OFFSET * scene.scale)
        # whether a lamp is a place without extent, to which one ray is exact
        self.are_places = np.array([_is_place(e) for e in emitters], bool)

        self._boxes = np.array([_box(e) for e in emitters], np.float32).reshape(-1, 2, 3)
        self._areas = np.array([_area(e) for e in emitters], np.float32)
        self._box_of = mi.Float(self._boxes.ravel())
        self._area_of = mi.Float(self._areas)

    def __len__(self):
        return len(self.are_places)

    def near(self, lamp, positions, factor=NEAR):
        """Whether positions (p, 3) are nearer to the boxes around lamps (p,) than their size: the
        squared distance is below `factor` times the area.
        """
        low, high = self._boxes[lamp].swapaxes(0, 1)
        beside = positions - np.clip(positions, low, high)
        return np.einsum("ij,ij->i", beside, beside) < factor * self._areas[lamp]

    def near_at(self, lamp, position, factor):
        """The same in Dr.Jit."""
        import drjit as dr

        mi = mitsuba()
        low = dr.gather(mi.Point3f, self._box_of, 2 * lamp)
        high = dr.gather(mi.Point3f, self._box_of, 2 * lamp + 1)
        beside = position - dr.clip(position, low, high)
        return dr.squared_norm(beside) < factor * dr.gather(mi.Float, self._area_of, lamp)

    def aimed(self, lamp, origin, normal, place, active=True):
        """One sample of a lamp, aimed at from points: what would arrive without shadows.

        Parameters
        ----------
        lamp : mi.UInt32
        origin : mi.Point3f
            Off the surface: where the shadow ray starts.
        normal : mi.Normal3f
        place : mi.Point2f
            On the lamp, in the unit square.
        active : mi.Bool

        Returns
        -------
        sample : mi.DirectionSample3f
        weight : mi.Color3f
            Radiance over density; irradiance of a place at right angles. 0 where nothing arrives.
        cosine : mi.Float
            To the normal.
        """
        import drjit as dr

        mi = mitsuba()
        sample, weight = self.emitter(lamp, active).sample_direction(_seen(origin), place, active)
        cosine = dr.dot(normal, sample.d)
        weight = mi.Color3f(weight)
        # a lamp in the point itself has no direction
        arrives = mi.Bool(active) & (cosine > 0) & dr.isfinite(dr.sum(weight))
        return sample, dr.select(arrives, weight, 0), cosine

    def visible(self, origin, sample, active):
        """Whether nothing stands between points and a sample of a lamp."""
        import drjit as dr

        ray = mitsuba().Ray3f(origin, sample.d)
        ray.maxt = dr.maximum(sample.dist * (1 - SHADOW_END) - self._offset, 0)
        return mitsuba().Bool(active) & ~self._occluders.ray_test(ray, active)

    def met(self, lamp, origin, direction):
        """Radiance of a lamp along rays, and the density with which `aimed` takes them.

        Returns
        -------
        radiance : mi.Color3f
            0 where something else is met.
        density : mi.Float
            Per steradian.
        """
        import drjit as dr

        mi = mitsuba()
        emitter = self.emitter(lamp)
        si = self._occluders.ray_intersect(mi.Ray3f(origin, direction))
        hit = si.is_valid() & (si.shape.emitter() == emitter)
        sample = mi.DirectionSample3f(self._occluders, si, _seen(origin))
        density = emitter.pdf_direction(_seen(origin), sample, hit)
        radiance = mi.Color3f(emitter.eval(si, hit))
        return dr.select(hit & (density > 0), radiance, 0), density

    def emitter(self, lamp, active=True):
        """The emitters (mi.EmitterPtr) of these numbers."""
        import drjit as dr

        mi = mitsuba()
        return dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self._ids, lamp, active))


def _seen(origin):
    import drjit as dr

    mi = mitsuba()
    it = dr.zeros(mi.Interaction3f, dr.width(origin))
    it.p = origin
    return it


def averaging(cosine, distance, footprint):
    """Mean of the irradiance by a place over a footprint, as a multiple of that in its middle.

    A place at the height h over a plane lights it with I·h/(ρ² + h²)^(3/2) at the distance ρ beside
    it, 2πI in all for any h. Raised over the footprint as in `examples.raised_height`, it lights a
    spot of the footprint's size with the same power.
    """
    import drjit as dr

    from .examples import raised_height

    height, squared = cosine * distance, dr.square(distance)
    raised = raised_height(height, footprint)
    spread = (squared - dr.square(height) + dr.square(raised)) / squared
    return raised / height * dr.rsqrt(spread) / spread


def direct_light(
    scene,
    points,
    emitters,
    tolerance=TOLERANCE,
    most_samples=MOST_SAMPLES,
    seed=0,
    lanes=LANES,
    progress=lambda done, total: None,
):
    """Direct irradiance of each of some lamps at points.

    Parameters
    ----------
    scene : Scene
    points : Points
    emitters : sequence of mi.Emitter
        Local emitters of the scene: point, spot, projector, and area on any shape.
    tolerance : float
        Standard error that is aimed at, as a share of the irradiance of a lamp at a point, or of
        `DIM` times its mean where the point receives less. Samples are doubled from 32 on until it
        is met.
    most_samples : int
        Where doubling ends; a power of two ≥ 32.
    seed : int
    lanes : int
        Most lanes of one wavefront. Results do not depend on it.
    progress : callable(done, total)
        Pairs of point and lamp.

    Returns
    -------
    DirectLight

    Raises
    ------
    LightError
        See `Lamps`.
    """
    lamps = Lamps(scene, emitters)
    sampler = _DirectSampler(scene, points, lamps, seed, lanes)
    n, k = len(points), len(lamps)
    irradiance = np.zeros((n, k, 3), np.float32)
    error = np.zeros((n, k), np.float32)
    if not k:
        return DirectLight(irradiance, error, 0)
    least = tolerance * DIM * sampler.means()
    step = max(1, lanes // (GROUPS * k))
    for first in range(0, n, step):
        block = slice(first, min(first + step, n))
        shape = (k, block.stop - first)
        point = np.broadcast_to(np.arange(first, block.stop), shape).ravel()
        lamp = np.broadcast_to(np.arange(k)[:, None], shape).ravel()
        value, spread = sampler.refined(point, lamp, tolerance, least, most_samples)
        irradiance[block] = value.reshape(*shape, 3).swapaxes(0, 1)
        error[block] = spread.reshape(shape).T
        progress(block.stop * k, n * k)
    return DirectLight(irradiance, error, sampler.rays)


def relative_noise(irradiance, standard_error, weights):
    """Relative RMS noise (k,) of irradiance (n, k, 3) with standard errors (n, k), over points with
    weights (n,).
    """
    signal = np.einsum("nkc,nkc,n->k", irradiance, irradiance, weights, dtype=np.float64)
    noise = np.einsum("nk,nk,n->k", standard_error, standard_error, weights, dtype=np.float64)
    return np.sqrt(noise / np.where(signal > 0, signal, np.inf))


class _DirectSampler:
    """Samples pairs of points and lamps."""

    def __init__(self, scene, points, lamps, seed, lanes):
        import drjit as dr

        mi = mitsuba()
        self._lamps, self._count, self._lanes = lamps, len(points), lanes
        self._origins = mi.Float(points.ray_origins(RAY_OFFSET * scene.scale).ravel())
        self._normals = mi.Float(points.normals.ravel())
        self._positions = points.positions
        self._seed = dr.opaque(mi.UInt32, seed % (1 << 32))
        self.rays = 0

    def means(self):
        """Mean norm (k,) of each lamp's irradiance over some of the points, by the pilot."""
        k = len(self._lamps)
        chosen = np.linspace(0, self._count - 1, min(MEAN_POINTS, self._count)).astype(int)
        total = np.zeros(k)
        step = max(1, self._lanes // (GROUPS * len(chosen)))
        for first in range(0, k, step):
            some = np.arange(first, min(first + step, k))
            point, lamp = np.tile(chosen, len(some)), np.repeat(some, len(chosen))
            value = self._sums(point, lamp, 0, PILOT)[..., :3].mean(axis=1) / PILOT
            total[some] = np.linalg.norm(value, axis=1).reshape(len(some), -1).mean(axis=1)
        return total

    def refined(self, point, lamp, tolerance, least, most):
        """Irradiance (p, 3) and standard error (p,) of pairs."""
        value, error = np.zeros((len(point), 3), np.float32), np.zeros(len(point), np.float32)
        places = self._lamps.are_places[lamp]
        # Aimed at alone, a lamp that is nearer than it is large gives samples without a bound.
        near = ~places & self._lamps.near(lamp, self._positions[point])
        value[places] = self._sums(point[places], lamp[places], 0, 1, groups=1)[:, 0]
        for left, combined in ((np.flatnonzero(~places & ~near), False), (near.nonzero()[0], True)):
            sums = np.zeros((len(left), GROUPS, 3), np.float32)
            taken, wanted = 0, PILOT
            while len(left):
                sums += self._sums(point[left], lamp[left], taken, wanted - taken, combined)
                taken = wanted
                value[left], error[left] = _mean_and_error(sums / np.float32(taken))
                aim = tolerance * np.linalg.norm(value[left], axis=1)
                again = error[left] > np.maximum(aim, least[lamp[left]])
                again &= GROUPS * taken < most
                left, sums, wanted = left[again], sums[again], 2 * taken
        return value, error

    def _sums(self, point, lamp, first, count, combined=False, groups=GROUPS):
        """Sums (p, groups, 3) of so many samples, from the number `first` on, of each sequence."""
        import drjit as dr

        mi = mitsuba()
        if not len(point):
            return np.zeros((0, groups, 3), np.float32)
        self.rays += len(point) * groups * count * (2 if combined else 1)
        points, lamps = (mi.UInt32(x.astype(np.uint32)) for x in (point, lamp))
        of_each = dr.opaque(mi.UInt32, groups)
        lane = dr.arange(mi.UInt32, len(point) * groups)
        pair = lane // of_each
        point, lamp = dr.gather(mi.UInt32, points, pair), dr.gather(mi.UInt32, lamps, pair)
        group = lane - pair * of_each
        sequence = mi.sample_tea_32(point, self._seed * 0x9E3779B9 + lamp * GROUPS + group)[0]
        origin = dr.gather(mi.Point3f, self._origins, point)
        normal = dr.gather(mi.Normal3f, self._normals, point)
        last = dr.opaque(mi.UInt32, first + count)
        sample = self._combined if combined else self._aimed

        def add(number, total):
            return number + 1, total + sample(number, sequence, lamp, origin, normal)

        start = dr.opaque(mi.UInt32, first) + dr.zeros(mi.UInt32, dr.width(lane))
        state = start, dr.zeros(mi.Color3f, dr.width(lane))
        _, total = dr.while_loop(state, lambda number, _: number < last, add)
        dr.eval(total)
        return np.stack([np.array(x) for x in total], axis=-1).reshape(-1, groups, 3)

    def _aimed(self, number, sequence, lamp, origin, normal):
        """Irradiance by one sample of a lamp."""
        import drjit as dr

        place = scrambled_place(number, sequence)
        sample, weight, cosine = self._lamps.aimed(lamp, origin, normal, place)
        lit = self._lamps.visible(origin, sample, dr.max(weight) > 0)
        return dr.select(lit, weight * cosine, 0)

    def _combined(self, number, sequence, lamp, origin, normal):
        """The same by one sample of the lamp and one of the hemisphere, each weighted by its
        density over that of both (the balance heuristic of Veach and Guibas, 1995).
        """
        import drjit as dr

        mi = mitsuba()
        place = scrambled_place(number, sequence)
        sample, weight, cosine = self._lamps.aimed(lamp, origin, normal, place)
        lit = self._lamps.visible(origin, sample, dr.max(weight) > 0)
        aimed = weight * cosine * (sample.pdf / (sample.pdf + cosine / dr.pi))
        local = mi.warp.square_to_cosine_hemisphere(scrambled_place(number, sequence ^ HEMISPHERE))
        direction = mi.Frame3f(normal).to_world(local)
        radiance, density = self._lamps.met(lamp, origin, direction)
        met = radiance * local.z / (density + local.z / dr.pi)
        return dr.select(lit, aimed, 0) + dr.select(local.z > 0, met, 0)


def _mean_and_error(groups):
    """Mean (p, 3) of independent estimates (p, g, 3), and the norm (p,) of its standard error."""
    mean = groups.mean(axis=1)
    count = groups.shape[1]
    squares = np.square(groups - mean[:, None]).sum(axis=(1, 2))
    return mean, np.sqrt(squares / (count * (count - 1)))


def _box(emitter):
    """Corners (2, 3) of the box around an emitter's shape; 0 without one."""
    shape = emitter.get_shape()
    if shape is None:
        return np.zeros((2, 3))
    box = shape.bbox()
    return np.array([box.min, box.max], dtype=np.float64).reshape(2, 3)


def _area(emitter):
    """Of an emitter's shape, m²; 0 without one."""
    shape = emitter.get_shape()
    return 0.0 if shape is None else float(np.array(shape.surface_area()).ravel()[0])


def _is_place(emitter):
    mi = mitsuba()
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition)


def _check(emitter):
    mi = mitsuba()
    shape = emitter.get_shape()
    name = f"emitter '{emitter.id()}'" if shape is None else f"light of shape '{shape.id()}'"
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
        raise LightError(f"{name} ({emitter.class_name()}) is distant: its light is no lamp's")
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection):
        raise LightError(
            f"{name} ({emitter.class_name()}) shines in one direction only, which cannot be aimed"
            " at from a point: use an area light or a spot instead, or remove it"
        )
