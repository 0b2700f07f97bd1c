"""Local emitters of a scene by number, in Dr.Jit."""

# Mitsuba's stubs know nothing of what a pointer to an emitter or a register array can do.
# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false

import numpy as np

from ..errors import LightError
from ..scene.bounds import box_of
from ..system.arrays import indices, packets
from ..system.runtime import mitsuba
from .bits import RAY_OFFSET

NEAR = 1.0  # squared distance to a lamp, over its area, below which rays of the hemisphere help
SHADOW_END = 1e-4  # share of the way to a lamp by which shadow rays end before it


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
        self._ids = indices(np.array(ids, np.uint32))
        self._scene, self._occluders = scene, scene.occluders
        self._offset = dr.opaque(mi.Float, RAY_OFFSET * scene.scale)
        # whether a lamp is a place without extent, to which one ray is exact
        self.are_places = np.array([_is_place(e) for e in emitters], bool)

        self._boxes = np.array([_box(e) for e in emitters], np.float32).reshape(-1, 2, 3)
        self._areas = np.array([_area(e) for e in emitters], np.float32)
        self._box_of = packets(self._boxes)
        self._area_of = packets(self._areas)

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
        si = self._scene.intersect(mi.Ray3f(origin, direction))
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
    it, 2πI in all for any h. Raised to (h⁴ + (A/4)²)^(1/4) it lights a spot that is no smaller than
    the footprint A, with the same power, and from h = √A on it is changed by less than 3 %.
    """
    import drjit as dr

    height, squared = cosine * distance, dr.square(distance)
    raised = dr.sqrt(dr.sqrt(dr.square(dr.square(height)) + dr.square(footprint / 4)))
    spread = (squared - dr.square(height) + dr.square(raised)) / squared
    return raised / height * dr.rsqrt(spread) / spread


def _box(emitter):
    """Corners (2, 3) of the box around an emitter's shape; 0 without one."""
    shape = emitter.get_shape()
    return np.zeros((2, 3)) if shape is None else box_of(shape)


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
