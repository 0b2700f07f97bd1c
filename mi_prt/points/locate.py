"""From a hit on a scene's surface to the three points around it, in closed form."""

import numpy as np

from ..errors import SceneError
from ..scene.mesh import mesh_arrays
from ..scene.surface_table import SurfaceTable
from ..system.arrays import indices, packets
from ..system.runtime import mitsuba
from .layout import Locator
from .tessellate import TESSELLATED_SHAPES

NO_PATCH = 0xFFFFFFFF
_BEHIND = 0.1  # of the points' spacing, by which a point may lie behind a place that sees it
_LEAST_KEPT = 1e-4  # weight of the points around a hit that are not buried, below which all count


class PatchLocator(Locator):
    """Finds the points around surface hits of one Mitsuba scene.

    The scene may be organised otherwise than the one the points were made from: Mitsuba's loader
    merges meshes that share a material by default. Mesh faces are therefore matched by the
    positions of their corners, analytic shapes by their place in the world, once, when the locator
    is made.

    Parameters
    ----------
    scene : Scene
        The scene in which hits occur.
    points : Points

    Raises
    ------
    SceneError
        If a surface of the scene is not among the points' surfaces.
    """

    def __init__(self, scene, points):
        import drjit as dr

        mi = mitsuba()
        patches = points.layout
        self._keep = packets(np.where(points.buried, 0.0, 1.0).astype(np.float32))
        self._positions = packets(points.positions)
        self._behind = dr.opaque(mi.Float, _BEHIND * float(np.median(patches.spacing(points))))
        self._match(scene, points)
        self._levels = indices(patches.levels.ravel())
        self._offsets = indices(patches.offsets)
        self._nodes = indices(patches.nodes)
        self._back = indices(patches.back)
        self._children = indices(patches.children)
        self._is_cut = bool(patches.children.any())

    def interpolated(self, values, pi, si, ray, active):
        """See `Locator.interpolated`; where all points around a hit are buried, all count."""
        import drjit as dr

        mi = mitsuba()
        points, weights, found = self.locate(pi, si, active)
        kept = [w * dr.gather(mi.Float, self._keep, p, found) for p, w in zip(points, weights)]
        sum_kept = sum(kept)
        usable = sum_kept > _LEAST_KEPT
        shares = [dr.select(usable, k / sum_kept, w) for k, w in zip(kept, weights)]
        value = sum(w * dr.gather(mi.Color3f, values, p, found) for p, w in zip(points, shares))
        return value, found

    def picked(self, pi, si, ray, active, random):
        """See `Locator.picked`: interpolation in the mean, with a third of the entries."""
        import drjit as dr

        points, kept, found = self._kept(pi, si, active)
        total = kept[0] + kept[1] + kept[2]
        place = random * total
        index = dr.select(
            place < kept[0],
            points[0],
            dr.select(place < kept[0] + kept[1], points[1], points[2]),
        )
        return index, found & (total > _LEAST_KEPT)

    def nearest(self, pi, si, ray, active, seen_from=None):
        """See `Locator.nearest`: the one of the three with the largest weight."""
        import drjit as dr

        points, kept, found = self._kept(pi, si, active)
        if seen_from is not None:
            kept = [w * self._ahead(p, seen_from, found) for p, w in zip(points, kept)]
        second = kept[1] > kept[0]
        index, weight = dr.select(second, points[1], points[0]), dr.maximum(kept[0], kept[1])
        index = dr.select(kept[2] > weight, points[2], index)
        return index, found & (dr.maximum(weight, kept[2]) > _LEAST_KEPT)

    def _ahead(self, point, seen_from, active):
        """1 where points are in front of the places that see them, else 0."""
        import drjit as dr

        origin, up = seen_from
        position = dr.gather(mitsuba().Point3f, self._positions, point, active)
        return dr.select(dr.dot(position - origin, up) > -self._behind, 1.0, 0.0)

    def _kept(self, pi, si, active):
        """The points around hits, their weights without buried ones, and whether there are any."""
        import drjit as dr

        points, weights, found = self.locate(pi, si, active)
        keep = [dr.gather(mitsuba().Float, self._keep, p, found) for p in points]
        return points, [w * k for w, k in zip(weights, keep)], found

    def _match(self, scene, points):
        """Fill the tables that lead from (surface, primitive) to patches."""
        faces = _FaceIndex(points)
        analytic = {s["signature"]: s["first_patch"] for s in points.surfaces if s["patches"] > 0}
        tables, starts, total = [np.empty(0, np.int64)], [], 0
        for surface in scene.surfaces:
            if surface.kind not in TESSELLATED_SHAPES:
                starts.append(NO_PATCH)
                continue
            known = surface.kind != "mesh"
            patch = (
                np.array([analytic.get(surface.signature, NO_PATCH)])
                if known
                else faces.take(surface)
            )
            missing = int((patch == NO_PATCH).sum())
            if missing == len(patch) and surface.shape.is_emitter():
                starts.append(NO_PATCH)  # a light that was added: it reflects nothing
                continue
            if missing:
                raise SceneError(
                    f"shape '{surface.name}' has {missing} faces that the asset does not know: "
                    "the scene's geometry changed since it was precomputed; precompute it again"
                )
            starts.append(total)
            tables.append(patch)
            total += len(patch)
        self._surfaces = SurfaceTable(scene.surfaces)
        self._starts = indices(np.array(starts, np.uint32))
        self._patch = indices(np.concatenate(tables))

    def locate(self, pi, si, active):
        """The points around hits.

        Parameters
        ----------
        pi : mi.PreliminaryIntersection3f
        si : mi.SurfaceInteraction3f
        active : mi.Bool

        Returns
        -------
        points : tuple of three mi.UInt32
            Indices of points; on the side of the surface that `si.wi` is on.
        weights : tuple of three mi.Float
            Barycentric weights, sum 1.
        found : mi.Bool
            Whether the hit lies on a surface that has points on that side.
        """
        import drjit as dr

        mi = mitsuba()
        start = dr.gather(mi.UInt32, self._starts, self._surfaces.index(si, active), active)
        found = active & (start != NO_PATCH)
        patch = dr.gather(mi.UInt32, self._patch, start + pi.prim_index, found)
        found &= patch != NO_PATCH

        # --- position on the patch: barycentric for triangles, (u, v) for analytic shapes
        triangle = dr.gather(mi.UInt32, self._levels, 2 * patch + 1, found) == 0
        back = dr.gather(mi.UInt32, self._back, patch, found)
        uv = dr.select(triangle, pi.prim_uv, si.uv)
        uv = mi.Point2f(dr.clip(uv.x, 0, 1), dr.clip(uv.y, 0, 1))
        if self._is_cut:
            patch, uv = self._descend(patch, uv, triangle, found)
        level_u = dr.gather(mi.UInt32, self._levels, 2 * patch, found)
        level_v = dr.gather(mi.UInt32, self._levels, 2 * patch + 1, found)
        rows = dr.select(triangle, level_u, level_v)
        x, y = uv.x * mi.Float(level_u), uv.y * mi.Float(rows)
        j = dr.minimum(mi.UInt32(y), dr.maximum(rows, 1) - 1)
        columns = dr.maximum(dr.select(triangle, level_u - j, level_u), 1)
        i = dr.minimum(mi.UInt32(x), columns - 1)
        fx, fy = dr.clip(x - mi.Float(i), 0, 1), dr.clip(y - mi.Float(j), 0, 1)
        # In the last small triangle of a row there is no upper half; rounding can put a hit just
        # across.
        upper = (fx + fy > 1) & ~(triangle & (i + 1 == columns))
        outside = dr.maximum(fx + fy, 1)
        fx, fy = dr.select(upper, fx, fx / outside), dr.select(upper, fy, fy / outside)

        # --- the three nodes around it and their points
        def node(i, j):
            in_triangle = j * (level_u + 1) - dr.select(j > 0, j * (j - 1) // 2, 0) + i
            return dr.select(triangle, in_triangle, j * (level_u + 1) + i)

        behind = si.wi.z < 0
        found &= ~behind | (back > 0)
        first = dr.gather(mi.UInt32, self._offsets, patch, found)
        numbers = (
            dr.select(upper, node(i + 1, j + 1), node(i, j)),
            dr.select(upper, node(i, j + 1), node(i + 1, j)),
            dr.select(upper, node(i + 1, j), node(i, j + 1)),
        )
        shift = dr.select(behind, back, 0)
        points = tuple(dr.gather(mi.UInt32, self._nodes, first + n, found) + shift for n in numbers)
        weights = (
            dr.select(upper, fx + fy - 1, 1 - fx - fy),
            dr.select(upper, 1 - fx, fx),
            dr.select(upper, 1 - fy, fy),
        )
        return points, weights, found

    def _descend(self, patch, uv, triangle, found):
        """The patches that are not cut around hits, and the place (u, v) there; see `QuadTree`."""
        import drjit as dr

        mi = mitsuba()
        patch, uv, active = mi.UInt32(patch), mi.Point2f(uv), mi.Bool(found)
        child = dr.gather(mi.UInt32, self._children, patch, active)

        def step(patch, child, uv):
            x, y = 2 * uv.x, 2 * uv.y
            i = dr.select(x < 1, mi.UInt32(0), 1)
            j = dr.select((y < 1) | (triangle & (i > 0)), mi.UInt32(0), 1)
            fx, fy = x - mi.Float(i), y - mi.Float(j)
            # of a triangle: at the corner where i or j is 1, else at the first or in the middle
            middle = triangle & (i + j == 0) & (fx + fy > 1)
            number = dr.select(triangle, 2 * i + 3 * j, 2 * j + i) + dr.select(middle, 1, 0)
            patch = child + number
            uv = dr.select(middle, mi.Point2f(1 - fx, 1 - fy), mi.Point2f(fx, fy))
            return patch, dr.gather(mi.UInt32, self._children, patch), uv

        patch, _, uv = dr.while_loop(
            (patch, child, uv),
            lambda patch, child, uv: child > 0,
            step,
            labels=("patch", "child", "uv"),
        )
        return patch, uv


class _FaceIndex:
    """Patches of mesh faces, found by the positions of their three corners."""

    def __init__(self, points):
        patches = points.layout
        roots = np.arange(sum(s["patches"] for s in points.surfaces))
        is_triangle = roots[patches.levels[roots, 1] == 0]
        # the corners of a patch that is cut are those of its children there
        corner = np.stack([is_triangle] * 3, axis=-1)
        while (child := patches.children[corner]).any():
            corner = np.where(child > 0, child + np.array([0, 2, 3]), corner)
        k = patches.levels[corner, 0].astype(np.int64)
        last = np.stack([0 * k[:, 0], k[:, 1], (k[:, 2] + 1) * (k[:, 2] + 2) // 2 - 1], axis=-1)
        corners = patches.offsets[corner] + last
        keys = _corner_keys(points.positions[patches.nodes[corners]])
        order = np.argsort(keys)
        self._keys, self._patches = keys[order], is_triangle[order]
        # at the first of equal keys: how many were given out
        self._taken = np.zeros(len(keys), np.int64)
        self._flipped = np.repeat(
            [s["flipped"] for s in points.surfaces], [s["patches"] for s in points.surfaces]
        )

    def take(self, surface):
        """Patch (f,) of each face of a mesh; NO_PATCH where there is none. Faces of zero area match
        anything.

        Coincident faces have equal keys: the k-th of them in the scene takes the k-th of the
        points'.
        """
        positions, faces, _, _ = mesh_arrays(surface.shape)
        world = (
            positions.astype(np.float64) @ surface.to_world[:3, :3].T + surface.to_world[:3, 3]
        ).astype(np.float32)
        corners = world[faces]
        keys = _corner_keys(corners)
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
        repeat = np.empty(len(keys), np.int64)
        repeat[order] = np.arange(len(keys)) - np.searchsorted(ordered, ordered)
        low, high = (
            np.searchsorted(self._keys, keys),
            np.searchsorted(self._keys, keys, side="right"),
        )
        known = high > low
        patch = np.full(len(keys), NO_PATCH)
        place = low[known] + repeat[known] + self._taken[low[known]]
        patch[known] = self._patches[np.minimum(place, high[known] - 1)]
        np.add.at(self._taken, low[known], 1)
        patch[known] = np.where(
            self._flipped[patch[known]] == surface.shape.has_flipped_normals(),
            patch[known],
            NO_PATCH,
        )
        doubled = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        return np.where(
            ~known & (doubled <= 1e-10 * max(doubled.max(initial=0.0), 1e-300)), 0, patch
        )


def _corner_keys(corners):
    """One comparable key (f,) for the exact float32 positions (f, 3, 3) of each face's corners."""
    exact = np.ascontiguousarray(corners.reshape(-1, 9) + np.float32(0))  # −0 becomes +0
    return exact.view(np.dtype((np.void, 36))).ravel()
