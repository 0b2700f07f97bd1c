"""From a hit on a surface to the sample points around it, in Dr.Jit."""

import numpy as np

from ..errors import SceneError
from ..scene.materials import facing
from ..system.arrays import packets
from ..system.runtime import mitsuba
from .layout import Locator

REACH = 2.5  # radii up to which a sample is found
VOXEL = 1.5  # radii along the edge of a voxel
MOST_VOXELS = 1 << 24
VOXELS_A_SAMPLE = 512  # at most: far more than samples on surfaces ask for
BEHIND = 0.1  # radii behind a place from which on samples are not seen from there
SHARPNESS = 4  # power of the interpolation's weights in distance: they fall to a half at 1 radius
ALIGNMENT = 8  # power of their cosine between normals: surfaces at right angles do not mix
_BELOW_ONE = 1 - 2**-24  # the largest float32 below 1


class SampleLocator:
    """Finds samples near places on surfaces, in the metric of `thinning`.

    Each voxel of a regular grid lists all samples that can be within reach of a place in it, so
    that a look-up reads one list.

    Parameters
    ----------
    positions, normals : (n, 3) float32
    radius : float
        Metres that samples keep from each other.
    buried : (n,) bool, optional
        Samples that are not found.

    Raises
    ------
    SceneError
        If there are no samples.
    """

    def __init__(self, positions, normals, radius, buried=None):
        import drjit as dr

        mi = mitsuba()
        if not len(positions):
            raise SceneError("there are no samples to look up")
        reach = REACH * radius
        low, high = positions.min(axis=0) - reach, positions.max(axis=0) + reach
        edge = max(
            VOXEL * radius,
            float((np.prod((high - low).astype(np.float64)) / MOST_VOXELS) ** (1 / 3)),
        )
        size = _grid(high - low, edge)
        while np.prod(size.astype(float)) > min(MOST_VOXELS, VOXELS_A_SAMPLE * len(positions)):
            edge *= 1.25  # long and thin, or with samples far off
            size = _grid(high - low, edge)
        shown = np.arange(len(positions)) if buried is None else np.flatnonzero(~buried)
        starts, listed = _lists(positions[shown], low, edge, size, reach)
        # Dr.Jit refuses to gather from an array of no elements.
        samples = shown[listed].astype(np.uint32) if len(listed) else np.zeros(1, np.uint32)
        self._starts, self._samples = mi.UInt32(starts), mi.UInt32(samples)
        # 4 floats each: gathered in one load
        self._positions, self._normals = (
            packets(np.pad(x, ((0, 0), (0, 1)))) for x in (positions, normals)
        )
        self._low, self._size = mi.Point3f(*map(float, low)), mi.Vector3i(*map(int, size))
        dr.make_opaque(self._low, self._size)
        self._inverse_edge = dr.opaque(mi.Float, 1 / edge)
        self._radius, self._reach = dr.opaque(mi.Float, radius), dr.opaque(mi.Float, reach)

    def nearest(self, position, normal, active=True, seen_from=None):
        """The nearest sample.

        Parameters
        ----------
        position : mi.Point3f
        normal : mi.Normal3f
        active : mi.Bool
        seen_from : (mi.Point3f, mi.Vector3f), optional
            A place and its normal: samples behind it do not count. Beside a thin wall they are
            nearest on its other side.

        Returns
        -------
        index : mi.UInt32
        distance : mi.Float
            In the metric, metres; infinite where there is none within reach.
        """
        import drjit as dr

        mi = mitsuba()

        def visit(state, sample, place, distance, cosine):
            nearest, least = state
            closer = distance < least
            if seen_from is not None:
                origin, up = seen_from
                closer &= dr.dot(place - origin, up) > -BEHIND * self._radius
            return dr.select(closer, sample, nearest), dr.select(closer, distance, least)

        index, squared = self._visit(
            position, normal, active, (mi.UInt32(0), mi.Float(dr.square(self._reach))), visit
        )
        return index, dr.select(squared < dr.square(self._reach), dr.sqrt(squared), dr.inf)

    def interpolated(self, values, position, normal, active=True):
        """Values interpolated between the samples around places, by distance and normal.

        Parameters
        ----------
        values : mi.Float
            Three for each sample, one behind the other.
        position, normal, active :
            As for `nearest`.

        Returns
        -------
        mi.Color3f
            0 where no sample is within reach.
        found : mi.Bool
        """
        import drjit as dr

        mi = mitsuba()

        def visit(state, sample, place, distance, cosine):
            total, weights = state
            weight = self._weight(distance, cosine)
            return (
                total + weight * dr.gather(mi.Color3f, values, sample, weight > 0),
                weights + weight,
            )

        total, weights = self._visit(position, normal, active, (mi.Color3f(0), mi.Float(0)), visit)
        found = weights > 1e-12
        return dr.select(found, total / weights, 0), found

    def picked(self, position, normal, active, random):
        """One of the samples around places, chosen by the weights of `interpolated`.

        Parameters
        ----------
        position, normal, active :
            As for `nearest`.
        random : mi.Float
            Uniform in 0…1.

        Returns
        -------
        index : mi.UInt32
        found : mi.Bool
        """
        import drjit as dr

        mi = mitsuba()

        def visit(state, sample, place, distance, cosine):
            chosen, weights, left = state
            weight = self._weight(distance, cosine)
            weights += weight
            # Reservoir sampling: each sample replaces the chosen one with its share of the weights
            # so far. What is left of the random number within the share, or beside it, is uniform
            # again. (Numbers hashed from sample and seed, by four rounds of TEA, depend on each
            # other: weights came out wrong by up to 13 %.)
            share = dr.select(weight > 0, weight / weights, 0)
            taken = left < share
            left = dr.select(taken, left / share, (left - share) / (1 - share))
            return dr.select(taken, sample, chosen), weights, dr.minimum(left, _BELOW_ONE)

        start = (mi.UInt32(0), mi.Float(0), dr.minimum(random, _BELOW_ONE))
        index, weights, _ = self._visit(position, normal, active, start, visit)
        return index, weights > 1e-12

    def _weight(self, distance, cosine):
        """Weight of a sample at a squared distance, its normal at an angle."""
        import drjit as dr

        near = dr.maximum(1 - distance / dr.square(self._reach), 0) ** SHARPNESS
        return near * dr.maximum(cosine, 0) ** ALIGNMENT

    def _visit(self, position, normal, active, state, visit):
        """Fold `visit(state, sample, its place, squared distance, cosine between normals)` over the
        samples of each place's voxel.
        """
        import drjit as dr

        mi = mitsuba()
        voxel = mi.Vector3i(dr.floor((position - self._low) * self._inverse_edge))
        active = mi.Bool(active) & dr.all((voxel >= 0) & (voxel < self._size))
        place = mi.UInt32((voxel.z * self._size.y + voxel.y) * self._size.x + voxel.x)
        first = dr.gather(mi.UInt32, self._starts, place, active)
        last = dr.gather(mi.UInt32, self._starts, place + 1, active)

        def step(entry, *state):
            sample = dr.gather(mi.UInt32, self._samples, entry)
            p, n = (
                dr.gather(mi.Vector4f, self._positions, sample),
                dr.gather(mi.Vector4f, self._normals, sample),
            )
            place = mi.Point3f(p.x, p.y, p.z)
            turned = mi.Vector3f(normal.x - n.x, normal.y - n.y, normal.z - n.z)
            angle = dr.squared_norm(turned)
            distance = dr.squared_norm(position - place) + dr.square(self._radius) * angle
            return entry + 1, *visit(state, sample, place, distance, 1 - angle / 2)

        _, *state = dr.while_loop((first, *state), lambda entry, *_: entry < last, step)
        return state


class SpacedLocator(Locator):
    """Finds the samples around hits by distance and normal (Meshless PRT, section 5).

    Parameters
    ----------
    scene : Scene
        The scene in which hits occur.
    points : Points
        Buried ones are not found.
    radius : float
        Metres that they keep from each other.
    """

    def __init__(self, scene, points, radius):
        self._surfaces = scene.surfaces
        self._samples = SampleLocator(points.positions, points.normals, radius, points.buried)

    def interpolated(self, values, pi, si, ray, active):
        """See `Locator.interpolated`."""
        normals, _, reflects = facing(si, ray, self._surfaces)
        return self._samples.interpolated(values, si.p, normals.shading, active & reflects)

    def picked(self, pi, si, ray, active, random):
        """See `Locator.picked`."""
        normals, _, reflects = facing(si, ray, self._surfaces)
        return self._samples.picked(si.p, normals.shading, active & reflects, random)

    def nearest(self, pi, si, ray, active, seen_from=None):
        """See `Locator.nearest`."""
        import drjit as dr

        normals, _, reflects = facing(si, ray, self._surfaces)
        index, distance = self._samples.nearest(si.p, normals.shading, active & reflects, seen_from)
        return index, active & reflects & dr.isfinite(distance)


def _grid(extent, edge):
    """Voxels (3,) along each axis of an extent in metres."""
    return np.clip(np.ceil(extent / edge), 1, 1e15).astype(np.int64)


def _lists(positions, low, edge, size, reach):
    """For each voxel where its list starts (v + 1,), and the lists one behind the other, both
    uint32.
    """
    first = np.floor((positions - reach - low) / edge).astype(np.int64)
    spans = int(np.ceil(2 * reach / edge)) + 1
    voxels, samples = [], []
    index = np.arange(len(positions))
    for offset in np.ndindex(spans, spans, spans):
        voxel = first + offset
        corner = low + voxel * edge
        gap = np.maximum(np.maximum(corner - positions, positions - corner - edge), 0)
        touched = (
            (np.einsum("ij,ij->i", gap, gap) < reach**2)
            & (voxel >= 0).all(axis=1)
            & (voxel < size).all(axis=1)
        )
        x, y, z = voxel[touched].T
        voxels.append((z * size[1] + y) * size[0] + x)
        samples.append(index[touched])
    voxels, samples = np.concatenate(voxels), np.concatenate(samples)
    starts = np.concatenate([[0], np.cumsum(np.bincount(voxels, minlength=int(np.prod(size))))])
    return starts.astype(np.uint32), samples[np.argsort(voxels, kind="stable")].astype(np.uint32)
