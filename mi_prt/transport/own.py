"""Light of the scene's own lamps: a column for each, exact up to its sampling noise.

A lamp that does not move needs no visibility at run time: its direct light at the points is baked
by shadow rays over its whole surface, and its reflections by gathering. Dimmers and colours of
lamps are then factors of the columns, and mixing them is one small product.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..errors import LightError
from ..system.parallel import one_blas_thread
from ..system.schema import Array, ListOf, Nothing, Number, OneOf, Record, Text
from .ledger import Entry
from .transport import TRANSPORTS, Transport, report_spec

LARGEST_HALF = 3e4  # what the largest number of a column is in 16 bits


@TRANSPORTS.register
@dataclass(frozen=True, eq=False)
class OwnTransport(Transport):
    """Irradiance of points by lamps of the scene.

    Parameters
    ----------
    lamps : tuple of dict
        Of each lamp its name, and `digest` and `strength` by which an edited lamp is known (see
        `lighting.own_light`).
    direct, indirect : (3, n, k) float32
        Irradiance in W/m² by each of k lamps as the scene has it: of direct light, and of light
        that was reflected.
    quantize : '16' or 'none'
        How files keep the columns: float16 with a scale for each, or float32.
    report : dict
    """

    lamps: tuple
    direct: np.ndarray
    indirect: np.ndarray
    quantize: str = "16"
    report: dict = field(default_factory=dict)

    kind = "own"
    takes_words = "the scene's own lamps, dimmed or not"

    @property
    def names(self):
        """Names of the lamps, in the order of the columns."""
        return tuple(lamp["name"] for lamp in self.lamps)

    @property
    def words(self):
        """See `Transport.words`."""
        return f"lamps {', '.join(self.names)}"

    # --- relighting ---------------------------------------------------------------------------

    @classmethod
    def is_for(cls, part):
        """Lamps of the scene."""
        return part.own_name is not None

    def takes(self, part):
        """Lamps whose columns it holds."""
        return part.own_name in self.names

    @property
    def reflects(self):
        """Whether it holds reflected light."""
        return self.report["bounces"] != 0

    def respond(self, points, question):
        """See `Transport.respond`."""
        factors = np.zeros((len(self.lamps), 3), np.float32)
        for part in question.light.parts:
            if not self.takes(part):
                raise LightError(
                    f"lamp '{part.own_name}' is not in this asset: {', '.join(self.names)}"
                )
            factors[self.names.index(part.own_name)] += np.asarray(part.factor, np.float32)
        columns = {"direct": self.direct, "indirect": self.indirect, "total": self._total}
        with one_blas_thread():
            mixed = np.matmul(columns[question.component], factors.T[..., None])
        return np.ascontiguousarray(mixed[..., 0].T)

    def as_baked(self, lamp):
        """A lamp of an open scene as a factor of the baked one.

        Parameters
        ----------
        lamp : Lamp

        Raises
        ------
        LightError
            If more of it changed than its strength.
        """
        baked = self.lamps[self.names.index(lamp.own_name)]
        now, then = lamp.own.strength, baked["strength"]
        unlike = lamp.own.digest() != baked["digest"] or (now is None) != (then is None)
        if not unlike and now is not None:
            then = np.asarray(then)
            unlike = bool(((then == 0) & (now != 0)).any())
        if unlike:
            raise LightError(
                f"lamp '{lamp.own_name}' was moved, turned or repainted since its light was baked:"
                " precompute the scene again, or with the transport local (--transports)"
            )
        if now is None or (now == then).all():
            return lamp
        return lamp.scaled(np.divide(now, then, out=np.zeros(3), where=then != 0))

    @cached_property
    def _total(self):
        return self.direct + self.indirect

    # --- what it holds ------------------------------------------------------------------------

    def summary(self):
        """See `Transport.summary`."""
        stored = sum(array.nbytes for array in self.arrays().values())
        return {
            "lamps": [lamp["name"] for lamp in self.lamps],
            "components": ["total", "direct", "indirect"],
            "bounces": self.report["bounces"],
            "storage": {"measured": {"columns": stored}},
        }

    def ledger(self):
        """See `Transport.ledger`."""
        known = (
            ("direct_noise", "noise of shadow rays", "lamp_tolerance"),
            ("indirect_noise", "noise of reflected light", "lamp_rays"),
        )
        return [
            Entry("own: rays", what, self.report[key], "irradiance", "measured", knob)
            for key, what, knob in known
            if key in self.report
        ]

    # --- in files -----------------------------------------------------------------------------

    def header(self):
        """See `Transport.header`."""
        return {"lamps": list(self.lamps), "quantize": self.quantize, "report": self.report}

    @classmethod
    def header_spec(cls):
        """See `Transport.header_spec`."""
        strength = OneOf(Nothing(), ListOf(Number(0, 1e30), 3))
        lamp = Record({"name": Text(), "kind": Text(), "digest": Text(), "strength": strength})
        return Record(
            {
                "lamps": ListOf(lamp),
                "quantize": Text("16", "none"),
                "report": report_spec(optional=("direct_noise", "indirect_noise")),
            }
        )

    @classmethod
    def shapes(cls, header):
        """See `Transport.shapes`."""
        k = len(header["lamps"])
        names = ("direct", "indirect")
        if header["quantize"] == "none":
            return {name: Array("f4", (3, "n", k), least=0, unit="W/m^2") for name in names}
        found = {name: Array("f2", (3, "n", k), least=0) for name in names}
        scales = {f"{name}_scale": Array("f4", (3, 1, k), least=0, unit="W/m^2") for name in names}
        return found | scales

    def arrays(self):
        """See `Transport.arrays`."""
        columns = {"direct": self.direct, "indirect": self.indirect}
        if self.quantize == "none":
            return columns
        found = {}
        for name, values in columns.items():
            scale = values.max(axis=1, keepdims=True, initial=0) / np.float32(LARGEST_HALF)
            found[name] = (values / np.where(scale > 0, scale, 1)).astype(np.float16)
            found[f"{name}_scale"] = scale
        return found

    @classmethod
    def from_arrays(cls, header, arrays, points):
        """See `Transport.from_arrays`."""
        names = [lamp["name"] for lamp in header["lamps"]]
        if len(set(names)) < len(names):
            raise ValueError("transports.own.lamps repeat a name")
        columns = []
        for name in ("direct", "indirect"):
            values = np.asarray(arrays[name], np.float32)
            columns.append(
                values * arrays[f"{name}_scale"] if f"{name}_scale" in arrays else values
            )
        return cls(tuple(header["lamps"]), *columns, header["quantize"], header["report"])  # pyright: ignore[reportCallIssue]
