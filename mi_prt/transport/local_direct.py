"""Direct light of local emission at sample points, in one kernel of Dr.Jit (Meshless PRT, section
5).

For each point and each emitting place: the four directions of the depth buffer around the way to
it, their depths from the coefficients of the point, and a soft comparison with the distance, four
times. What changes from call to call is read from memory, so that lights move, change and multiply
without a new kernel.
"""

import numpy as np
from scipy.spatial import cKDTree

from ..lighting.places import Places
from ..system.arrays import indices, packets
from ..system.runtime import mitsuba
from .examples import raised_height
from .hemispheres import cluster_frames

TOLERANCE = 0.1  # share of its distance by which a light may lie behind what the depth buffer shows
# the same for points behind the surface that is nearest to the light, so that none leaks through it
BEHIND = 0.03
# share of its distance by which a light is taken to lie off the nearest surface, on its own side of
# it
CLEARANCE = 0.25
SOFTNESS = 0.15  # share of the distance over which the comparison goes from dark to lit
FAR = 0.8  # share of the extent from which on all light is equally far
# of the depth buffer, in which a light is seen off the nearest surface at least, so that its
# neighbours see past that
CELLS = 1.0
NEIGHBOURS = 256  # samples around a place that tell what it stands over
UNDER = 2.0  # of a point's spacing, that it may lie beside a place which stands over it
# share of the way to the nearest surface ahead by which a place may be moved, and as much be
# tolerated
ROOM = 0.5
AHEAD = 0.2  # cosine to the normal of that, from which on other samples are ahead of a place
ON_SURFACE = 1e-3  # of a point's spacing, below which a place is on its surface


class LocalDirect:
    """Irradiance at sample points by local emission.

    Parameters
    ----------
    points : Points
    clusters : Clusters
    depth : DepthBuffers
    """

    def __init__(self, points, clusters, depth):
        import drjit as dr

        mi = mitsuba()
        self._order = clusters.order
        points = points.at(clusters.order)
        self._count = len(points)
        # A place stands over surfaces that are seen: the floor below a box is not one of them.
        shown = points.at(~points.buried | points.buried.all())
        self._tree, self._normals = cKDTree(shown.positions), shown.normals
        self._spacing = np.full(len(shown), shown.layout.spacing(shown), np.float64)
        self._hemisphere, self._directions = depth.hemisphere, depth.means.shape[1]
        # of four components: gathered in one load
        self._groups = -(-depth.coefficients.shape[1] // 4)
        extra = 4 * self._groups - depth.coefficients.shape[1]
        self._means = packets(depth.means)
        self._vectors = packets(np.pad(depth.vectors, ((0, 0), (0, 0), (0, extra))))
        self._coefficients = packets(np.pad(depth.coefficients, ((0, 0), (0, extra))))
        self._labels = indices(clusters.labels)
        rotations = np.concatenate(
            [cluster_frames(points.normals[cluster]) for cluster in clusters.slices]
        )
        axes = (
            np.pad(axis, ((0, 0), (0, 1)))
            for axis in np.moveaxis(rotations.astype(np.float32), 2, 0)
        )
        self._points = packets(np.hstack([points.positions, points.areas[:, None], *axes]))
        self._far = dr.opaque(mi.Float, FAR * depth.extent)
        self._cell = dr.opaque(mi.Float, CELLS * (2 * np.pi / self._directions) ** 0.5)

    def irradiance(self, emission):
        """Irradiance at the points, and the same averaged over their areas.

        Parameters
        ----------
        emission : Emission

        Returns
        -------
        irradiance, averaged : (n, 3) float32
            W/m². The second is what is reflected: finite wherever a light stands, see
            `raised_height`.
        """
        import drjit as dr

        if not len(emission):
            return [np.zeros((self._count, 3), np.float32) for _ in range(2)]
        mi = mitsuba()
        places = Places(emission, self._sides(emission))
        point = dr.arange(mi.UInt32, self._count)
        own, *axes = (dr.gather(mi.Vector4f, self._points, 4 * point + i) for i in range(4))
        position, area = mi.Point3f(own.x, own.y, own.z), own.w
        axes = [mi.Vector3f(axis.x, axis.y, axis.z) for axis in axes]

        def add(number, at_point, averaged):
            toward, intensity, (side, room) = places.sent(number, position)
            distance, height = dr.norm(toward), dr.dot(toward, axes[2])
            lit = (height > 0) & (dr.max(intensity) > 0)
            # A light near a surface is taken farther off it, on the side where it stands: depth is
            # not as exact as to tell them apart.
            normal = mi.Vector3f(side.x, side.y, side.z)
            in_front = dr.dot(toward, normal) < 0
            free = dr.select(in_front, room.x, dr.inf)
            pushed = toward + normal * dr.maximum(
                dr.minimum(CLEARANCE * distance, free) - side.w, 0
            )
            tolerated = dr.minimum(
                dr.select(in_front, mi.Float(TOLERANCE), BEHIND) * distance, free
            )
            compared = dr.minimum(dr.norm(pushed) - tolerated, self._far)
            seen_in = toward + normal * dr.maximum(
                dr.minimum(self._cell * distance, free) - side.w, 0
            )
            local = dr.normalize(mi.Vector3f(*(dr.dot(seen_in, x) for x in axes)))
            visible = dr.if_stmt(
                (point, local, compared), lit, self._visibility, lambda *_: mi.Float(0)
            )
            squared = dr.square(distance)
            raised = raised_height(height, area)
            spread = raised * (squared - dr.square(height) + dr.square(raised)) ** -1.5
            here = height / (squared * distance)
            here = dr.select(dr.isfinite(here), here, 0)
            factor = dr.select(lit, visible, 0)
            return (
                number + 1,
                at_point + intensity * (factor * here),
                averaged + intensity * (factor * spread),
            )

        state = (mi.UInt32(0), mi.Color3f(0), mi.Color3f(0))
        _, *sums = dr.while_loop(state, lambda number, *_: number < places.count, add)
        dr.eval(sums)
        largest = np.finfo(np.float32).max
        results = []
        for values in sums:
            in_order = np.empty((self._count, 3), np.float32)
            in_order[self._order] = np.minimum(np.array(values).T, largest)
            results.append(in_order)
        return results

    def _sides(self, emission):
        """For each place (k, 8): the normal of the surface that it stands over, on its side; how
        far from that it is; and how far it may be moved.
        """
        k = min(NEIGHBOURS, self._tree.n)
        distance, near = (
            x.reshape(len(emission), -1)
            for x in self._tree.query(emission.positions, k, workers=-1)
        )
        normals = self._normals[near]
        height = np.einsum(
            "ijk,ijk->ij", emission.positions[:, None] - self._tree.data[near], normals
        )
        beside = np.sqrt(np.maximum(distance**2 - height**2, 0))
        # Not just the nearest sample: outside an edge of a room that is one of a wall that the
        # place does not stand over.
        spacing = self._spacing[near]
        under = np.argmin(np.where(beside < UNDER * spacing, distance, np.inf), axis=1)
        row = np.arange(len(emission))
        normal, height, spacing = normals[row, under], height[row, under], spacing[row, under]
        # A place on a surface that shines to one side stands on that side.
        on_surface = (np.abs(height) < ON_SURFACE * spacing) & (emission.cosine > 0)
        side = np.where(on_surface, np.einsum("ij,ij->i", emission.axes, normal), height)
        away = np.where(side < 0, -1, 1)[:, None] * normal
        ahead = (
            np.einsum("ijk,ik->ij", self._tree.data[near] - emission.positions[:, None], away)
            > AHEAD * distance
        )
        room = np.where(ahead, distance, distance[:, -1:]).min(axis=1) * ROOM
        columns = (away, np.abs(height)[:, None], room[:, None], np.zeros((len(emission), 3)))
        return np.hstack(columns)

    def _visibility(self, point, local, compared):
        """Share of a light that is visible from points, in local directions and at a distance."""
        import drjit as dr

        mi = mitsuba()
        own = [
            dr.gather(mi.Vector4f, self._coefficients, point * self._groups + i)
            for i in range(self._groups)
        ]
        cluster = dr.gather(mi.UInt32, self._labels, point)
        cluster *= dr.opaque(mi.UInt32, self._directions)
        visible = mi.Float(0)
        for index, share in zip(*self._hemisphere.around(local)):
            entry = cluster + index
            depth = dr.gather(mi.Float, self._means, entry)
            for i, coefficients in enumerate(own):
                depth += dr.dot(
                    coefficients, dr.gather(mi.Vector4f, self._vectors, entry * self._groups + i)
                )
            visible += share * dr.clip((dr.exp(depth) / compared - 1) / SOFTNESS + 0.5, 0, 1)
        return visible
