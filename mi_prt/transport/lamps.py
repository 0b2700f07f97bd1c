"""Direct light of a scene's own lamps at its points, by shadow rays over the whole of each lamp."""

from dataclasses import dataclass

import numpy as np

from ..system.arrays import indices, packets
from ..system.runtime import mitsuba
from .bits import LANES, RAY_OFFSET
from .lamp_table import Lamps
from .sequences import scrambled_place

# Standard error that is aimed at, as a share of the irradiance. Doubling ends early where the error
# looks small by chance, so that the RMS of what is left is about that much.
TOLERANCE = 0.01
# share of a lamp's mean irradiance below which a point's error is measured against that share
DIM = 0.05
GROUPS = 8  # sequences of each point and lamp; their spread is the error
PILOT = 8  # samples of each sequence before the first look at the error
MOST_SAMPLES = 1024  # of each point and lamp, all sequences together
MEAN_POINTS = 1024  # that tell the mean irradiance of a lamp
HEMISPHERE = 0x5BD1E995  # makes of a sequence another


@dataclass(frozen=True, eq=False)
class DirectLight:
    """Direct irradiance of k lamps at n points.

    Parameters
    ----------
    irradiance : (n, k, 3) float32
        W/m².
    standard_error : (n, k) float32
        Of the irradiance, norm over the channels, from eight sequences. Doubling ends where it
        looks small, so that in the mean it is a few percent too small.
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
        `DIM` times its mean where the point receives less. Samples are doubled from 64 on until it
        is met.
    most_samples : int
        Where doubling ends; a power of two ≥ 64.
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
        self._origins = packets(points.ray_origins(RAY_OFFSET * scene.scale))
        self._normals = packets(points.normals)
        self._positions = points.positions
        self._seed = dr.opaque(mi.UInt32, seed % (1 << 32))
        self.rays = 0

    def means(self):
        """Mean norm (k,) of each lamp's irradiance over some of the points, by the pilot; 0 of
        those without extent, which need no samples.
        """
        k = len(self._lamps)
        extended = np.flatnonzero(~self._lamps.are_places)
        chosen = np.linspace(0, self._count - 1, min(MEAN_POINTS, self._count)).astype(int)
        total = np.zeros(k)
        step = max(1, self._lanes // (GROUPS * len(chosen)))
        for first in range(0, len(extended), step):
            some = extended[first : first + step]
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
        points, lamps = (indices(x) for x in (point, lamp))
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
