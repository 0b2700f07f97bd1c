"""Emitting places in Dr.Jit: what each sends to where, read from memory, so that lights change
without a new kernel.
"""

import numpy as np

from ..system.arrays import packets
from ..system.runtime import mitsuba

_OWN = 12  # floats of a place


class Places:
    """The places of an Emission, for use inside kernels.

    Parameters
    ----------
    emission : Emission
    extra : (k, 4·m), optional
        Numbers beside each place that its user reads again.
    """

    def __init__(self, emission, extra=None):
        import drjit as dr

        mi = mitsuba()
        columns = (
            emission.positions,
            emission.axes,
            emission.intensity,
            *(getattr(emission, x)[:, None] for x in ("cosine", "cutoff", "beam")),
        )
        extra = np.empty((len(emission), 0)) if extra is None else extra
        self._loads = (_OWN + extra.shape[1]) // 4
        self._floats = packets(np.hstack([*columns, extra]))
        # Gathered, like all else: a number by itself compiles another kernel where its memory is
        # aligned otherwise.
        self.count = dr.gather(mi.UInt32, mi.UInt32([len(emission), 0]), mi.UInt32(0))

    def sent(self, number, position):
        """What a place sends to positions.

        Parameters
        ----------
        number : mi.UInt32
        position : mi.Point3f

        Returns
        -------
        toward : mi.Vector3f
            From the position to the place, metres.
        intensity : mi.Color3f
            W/sr in the direction of the position.
        extra : list of mi.Vector4f
        """
        import drjit as dr

        mi = mitsuba()
        a, b, c, *extra = (
            dr.gather(mi.Vector4f, self._floats, self._loads * number + i)
            for i in range(self._loads)
        )
        toward = mi.Point3f(a.x, a.y, a.z) - position
        distance = dr.norm(toward)
        cosine = dr.select(distance > 0, -dr.dot(toward, mi.Vector3f(a.w, b.x, b.y)) / distance, 0)
        angle = dr.acos(dr.clip(cosine, -1, 1))
        # Full intensity in the beam, then a fall that is linear in the angle; where beam and cutoff
        # are equal there is no fall.
        cone = dr.select(
            angle <= c.w, 1, dr.clip((c.z - angle) / dr.maximum(c.z - c.w, 1e-30), 0, 1)
        )
        shape = cone * dr.select(c.y > 0, dr.maximum(cosine, 0), 1)
        return toward, mi.Color3f(b.z, b.w, c.x) * shape, extra
