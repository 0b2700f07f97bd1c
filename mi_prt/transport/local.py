"""Transport of lights that move inside the scene: depth buffers, and direct-to-indirect transfer
between clusters (Meshless PRT, sections 4 and 5).
"""

from dataclasses import dataclass, field

import numpy as np

from ..directions.hemisphere import Hemisphere
from ..lighting.emission import emission_of
from ..points.clusters import Clusters
from ..system.parallel import one_blas_thread
from ..system.schema import Flag, Number, Record, Text
from .depth import DepthBuffers
from .ledger import Entry
from .local_direct import LocalDirect
from .local_storage import DEPTH_SHAPES, pack_depth, pack_transfer, transfer_shapes, unpack
from .transfer_matrix import Transfer
from .transport import CHANNELS, TRANSPORTS, Transport, report_spec


@TRANSPORTS.register
@dataclass(frozen=True, eq=False)
class LocalTransport(Transport):
    """Irradiance of points by point, spot and area lights anywhere.

    Parameters
    ----------
    clusters : Clusters
    depth : DepthBuffers
        In the order of the clusters.
    transfer : Transfer or None
        In the order of the clusters; None where no light is reflected from one point to another,
        or none was asked for.
    quantize : '16' or 'none'
        Numbers in files.
    report : dict
    """

    clusters: Clusters
    depth: DepthBuffers
    transfer: Transfer | None
    quantize: str = "16"
    report: dict = field(default_factory=dict)
    _direct: dict = field(default_factory=dict, repr=False)

    kind = "local"
    takes_words = "point, spot and area lights that move"

    # --- relighting ---------------------------------------------------------------------------

    @classmethod
    def is_for(cls, part):
        """Local lights that are not the scene's own."""
        return not part.is_distant and part.own_name is None

    def stands_in_for(self, part):
        """Lamps of the scene, as places that emit."""
        return part.own_name is not None

    @property
    def reflects(self):
        """Whether it holds reflected light."""
        return self.transfer is not None

    def respond(self, points, question):
        """See `Transport.respond`."""
        direct, averaged = self._direct_light(points).irradiance(emission_of(question.light))
        if question.component == "direct":
            return direct
        indirect = self._indirect(averaged)
        return indirect if question.component == "indirect" else direct + indirect

    def _direct_light(self, points):
        """The LocalDirect of the points; what it holds in Dr.Jit is made once."""
        if self._direct.get("points") is not points:
            made = LocalDirect(points, self.clusters, self.depth)
            self._direct.update(points=points, kernel=made)
        return self._direct["kernel"]

    def _indirect(self, averaged):
        """Indirect irradiance (n, 3); what compression leaves of it below zero is zero."""
        if self.transfer is None:
            return np.zeros_like(averaged)
        with one_blas_thread():
            ordered = self.transfer.indirect(averaged[self.clusters.order], self.clusters.slices)
        indirect = np.empty_like(ordered)
        indirect[self.clusters.order] = np.maximum(ordered, 0)
        return indirect

    # --- what it holds ------------------------------------------------------------------------

    def summary(self):
        """See `Transport.summary`."""
        arrays = self.arrays()
        storage = {
            group: sum(a.nbytes for name, a in arrays.items() if name.startswith(group))
            for group in ("depth", "transfer")
        }
        return {
            "clusters": len(self.clusters.roots),
            "directions": self.depth.means.shape[1],
            "depth_coefficients": self.depth.coefficients.shape[1],
            "transfer": None if self.transfer is None else list(self.transfer.matrix.shape),
            "components": list(self.components),
            "bounces": self.report["bounces"],
            "misclassified_visibility": self.report["misclassified_visibility"],
            "storage": {"measured": storage},
        }

    def ledger(self):
        """See `Transport.ledger`."""
        known = (
            ("visibility", "direct_error", "direct light of examples", "depth_coefficients"),
            ("transfer", "transfer_error", "indirect light under examples", "transfer_error"),
        )
        return [
            Entry(f"local: {stage}", f"error of {norm}", self.report[key], norm, "measured", knob)
            for stage, key, norm, knob in known
            if key in self.report
        ]

    # --- in files -----------------------------------------------------------------------------

    def header(self):
        """See `Transport.header`."""
        return {
            "quantize": self.quantize,
            "extent": float(self.depth.extent),
            "reflects": self.reflects,
            "channels": self.transfer.matrix.shape[3] if self.reflects else 1,  # pyright: ignore[reportOptionalMemberAccess]
            "sparse": "transfer/columns" in self.arrays(),
            "report": self.report,
        }

    @classmethod
    def header_spec(cls):
        """See `Transport.header_spec`."""
        return Record(
            {
                "quantize": Text("16", "none"),
                "extent": Number(1e-30, 1e30),
                "reflects": Flag(),
                "channels": CHANNELS,
                "sparse": Flag(),
                "report": report_spec(
                    ("misclassified_visibility",), ("direct_error", "transfer_error")
                ),
            }
        )

    @classmethod
    def shapes(cls, header):
        """See `Transport.shapes`."""
        found = {f"clusters/{name}": array for name, array in Clusters.SHAPES.items()}
        found |= DEPTH_SHAPES[header["quantize"]]
        if header["reflects"]:
            found |= transfer_shapes(header["quantize"], header["channels"], header["sparse"])
        return found

    def arrays(self):
        """See `Transport.arrays`."""
        clusters = {f"clusters/{name}": getattr(self.clusters, name) for name in Clusters.SHAPES}
        found = clusters | pack_depth(self.depth, self.clusters.starts, self.quantize)
        if self.transfer is not None:
            found |= pack_transfer(self.transfer, self.clusters.starts, self.quantize)
        return found

    @classmethod
    def from_arrays(cls, header, arrays, points):
        """See `Transport.from_arrays`."""
        clusters = Clusters(**{name: arrays[f"clusters/{name}"] for name in Clusters.SHAPES})
        clusters.check(len(points))
        depth, transfer = unpack(arrays, clusters, header)
        Hemisphere(depth.means.shape[1])
        return cls(clusters, depth, transfer, header["quantize"], header["report"])

    def as_stored(self):
        """The same with the values that a file gives back."""
        depth, transfer = unpack(self.arrays(), self.clusters, self.header())
        return LocalTransport(self.clusters, depth, transfer, self.quantize, self.report)
