"""Which surface of a scene a hit lies on, in Dr.Jit."""

import numpy as np

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
        ids = np.array([(_registry_id(s.instance), _registry_id(s.shape)) for s in surfaces])
        instances, shapes = ids.max(axis=0) + 1
        table = np.full(instances * shapes, NO_SURFACE)
        table[ids[:, 0] * shapes + ids[:, 1]] = np.arange(len(ids))
        self._shapes = dr.opaque(mi.UInt32, int(shapes))
        self._table = mi.UInt32(table.astype(np.uint32))

    def index(self, si, active=True):
        """Index (mi.UInt32) of the surface of each hit; NO_SURFACE where there is none."""
        import drjit as dr

        mi = mitsuba()
        shape, instance = (
            dr.reinterpret_array(mi.UInt32, pointer) for pointer in (si.shape, si.instance)
        )
        return dr.select(
            active,
            dr.gather(mi.UInt32, self._table, instance * self._shapes + shape, active),
            NO_SURFACE,
        )


def _registry_id(node):
    import drjit as dr

    mi = mitsuba()
    return 0 if node is None else int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(node))[0])  # pyright: ignore[reportIndexIssue]
