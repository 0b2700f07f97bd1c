"""Which surface of a scene a hit lies on, in Dr.Jit."""

# Mitsuba's stubs know nothing of what pointers and register arrays can do.
# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false
# pyright: reportCallIssue=false, reportOperatorIssue=false

import numpy as np

from ..system.arrays import indices
from ..system.runtime import mitsuba

NO_SURFACE = 0xFFFFFFFF


class SurfaceTable:
    """Leads from (shape, instance) of hits to surfaces.

    Parameters
    ----------
    surfaces : sequence of Surface
        All those of the scene in which hits occur.
    """

    def __init__(self, surfaces):
        import drjit as dr

        mi = mitsuba()
        # The surfaces of an instance follow each other, in the same order for all of a group: an
        # index is the first one of the instance, and the place of the shape in the group.
        ids, members = {}, {}
        places = [(_registry_id(s.instance, ids), _registry_id(s.shape, ids)) for s in surfaces]
        for index, (instance, shape) in enumerate(places):
            members.setdefault(instance, []).append((index, shape))
        groups = {}
        first, group = np.zeros((2, max(members) + 1), np.uint32)
        for instance, found in members.items():
            shapes = (instance == 0, *(shape for _, shape in found))
            group[instance] = groups.setdefault(shapes, len(groups))
            first[instance] = found[0][0] if instance else 0
        columns = max(shape for _, shape in places) + 1
        table = np.full((len(groups), columns), NO_SURFACE, np.uint32)
        for instance, found in members.items():
            for index, shape in found:
                table[group[instance], shape] = index - int(first[instance])
        self._first, self._group = indices(first), indices(group)
        self._columns = dr.opaque(mi.UInt32, columns)
        self._table = indices(table)
        self._shapes = indices(np.array([shape for _, shape in places], np.uint32))

    def index(self, hit, active=True):
        """Index (mi.UInt32) of the surface of each mi.SurfaceInteraction3f; NO_SURFACE where there
        is none.
        """
        import drjit as dr

        mi = mitsuba()
        shape, instance = _numbers(hit)
        row = dr.gather(mi.UInt32, self._group, instance, active) * self._columns
        place = dr.gather(mi.UInt32, self._table, row + shape, active)
        found = active & (place != NO_SURFACE)
        return dr.select(
            found, place + dr.gather(mi.UInt32, self._first, instance, found), NO_SURFACE
        )

    def met(self, pi, active=True):
        """The surfaces of preliminary hits: their index, as of `index`, and their shapes
        (mi.ShapePtr). Of an instance a preliminary hit holds the number of the member alone.
        """
        import drjit as dr

        mi = mitsuba()
        _, instance = _numbers(pi)
        within = active & (instance != 0)
        member = dr.gather(mi.UInt32, self._first, instance, within) + pi.shape_index
        surface = dr.select(within, member, self.index(pi, active & ~within))
        found = surface != NO_SURFACE
        shape = dr.gather(mi.UInt32, self._shapes, surface, found)
        return surface, dr.reinterpret_array(mi.ShapePtr, dr.select(found, shape, 0))


def _numbers(hit):
    """Mitsuba's numbers (mi.UInt32) of the shapes and instances of hits."""
    import drjit as dr

    return [
        dr.reinterpret_array(mitsuba().UInt32, pointer) for pointer in (hit.shape, hit.instance)
    ]


def _registry_id(node, known):
    """Mitsuba's number of a shape; `known` holds those that were asked for before."""
    import drjit as dr

    mi = mitsuba()
    if node is None:
        return 0
    if node not in known:
        pointer = mi.ShapePtr(node)
        known[node] = int(dr.reinterpret_array(mi.UInt32, pointer)[0])  # pyright: ignore[reportIndexIssue]
    return known[node]
