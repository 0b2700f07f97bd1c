"""Transport of lights that move: example light, depth buffers, transfer (Meshless PRT, section
4).
"""

import time
from contextlib import closing
from dataclasses import replace

import numpy as np

from ..basis.clustered import leading_components
from ..directions.hemisphere import Hemisphere
from ..points.clusters import make_clusters
from ..points.layout import Spacing
from ..points.particles import example_places
from ..transport.bits import LANES
from ..transport.depth import DepthBuffers, compress
from ..transport.hemispheres import NOTHING, HemisphereTracer, cluster_frames, gathered
from ..transport.local import LocalTransport
from ..transport.transfer import all_reflections
from ..transport.transfer_matrix import Transfer, within_budget
from .examples import Examples, importance
from .job import BUILDERS, Builder, wavefront_lanes
from .local_checks import quantization_errors, visibility_errors
from .reflections import GREY

RECEIVERS = 64  # most components of the indirect irradiance of a cluster
RESPONSES = 256  # examples that show which those are
LANE_BYTES = 120  # of rays that are followed to points, for each of them
FIRST_POINTS, PROBE_POINTS = 200, 3000  # of the runs that the cost is predicted from
EXPECTED_RANK = 60  # components of indirect irradiance that a cluster is expected to need


@BUILDERS.register
class LocalBuilder(Builder):
    """Builds a `LocalTransport`; see `Builder`."""

    kind = "local"
    needs_clusters = True

    def __init__(self, job):
        super().__init__(job)
        settings = job.settings
        self._clusters, self._slices = job.clusters, job.clusters.slices
        lights, seed = settings.example_lights, settings.seed
        self._places = example_places(job.scene, lights, seed, job.flights)
        grey = np.ptp(job.points.albedo, axis=1).max(initial=0) <= GREY
        self._channels = 1 if grey else 3
        self._hemisphere = Hemisphere(settings.depth_directions)
        extent = float(np.linalg.norm(np.ptp(job.points.positions, axis=0)))
        self._extent = max(extent, 1e-6 * job.scene.scale)
        self._lanes = self._lanes_within(job.limit)

    @classmethod
    def wanted(cls, scene, given):
        """See `Builder.wanted`: it is built where one of its settings is given."""
        from .settings import BY_NAME

        own = sorted(name for name in given if BY_NAME[name].group == cls.kind)
        return f"{own[0]} was given" if own else ""

    def identity(self):
        """See `Builder.identity`."""
        return {"example places": float(np.abs(self._places.astype(np.float64)).sum())}

    def _lanes_within(self, limit):
        """Rays of a wavefront that fit beside what must be held."""
        settings, n, c = self.job.settings, len(self.job.points), len(self._slices)
        columns = c * settings.transfer_coefficients * self._channels
        largest = int(np.diff(self._clusters.starts).max())
        _ = self.job.scene.occluders, self.job.scene.interaction
        directions = settings.depth_directions
        needed = (
            Examples.bytes(n, settings.example_lights)
            + largest * (directions * (24 + 4 * self._channels) + 12 * columns)
            + 8 * c * directions * (settings.depth_coefficients + 1)
            + 24 * columns * c * settings.transfer_coefficients
        )
        return wavefront_lanes(
            limit, int(needed), LANE_BYTES, "points, example lights or coefficients"
        )

    # --- building -----------------------------------------------------------------------------

    def build(self):
        """See `Builder.build`."""
        job, settings = self.job, self.job.settings
        senders = self._senders() if settings.lamp_bounces != 0 else None
        job.clock.lap("example lights")
        parts = self._cluster_parts(senders)
        job.clock.lap("clusters")
        depth = DepthBuffers(
            np.stack([part["mean"] for part in parts]),
            np.stack([part["vectors"] for part in parts]),
            np.concatenate([part["depth"] for part in parts]),
            self._extent,
        )
        transfer, report = self._transfer(senders, parts) if senders else (None, {})
        report = {
            "bounces": 0,
            "rays": len(job.points) * len(self._hemisphere),
            "channels": self._channels if transfer is not None else 1,
            **report,
        }
        exact = LocalTransport(self._clusters, depth, transfer, settings.quantize, report)
        stored = exact.as_stored()
        report |= quantization_errors(exact, stored, senders)
        report |= visibility_errors(job.scene, job.points, stored, self._places, self._lanes)
        return stored

    def _senders(self):
        """The SenderBasis."""
        examples = Examples(self.job, self._places, self._lanes)
        return examples.fit(self._clusters, importance(self.job, self._clusters, self._lanes))

    # --- what clusters see --------------------------------------------------------------------

    def _cluster_parts(self, senders):
        """For each cluster: depth buffers, and with senders receivers, transfer in their basis, and
        what falls back on the senders.
        """
        job, clusters = self.job, self._clusters
        tracer = HemisphereTracer(
            job.scene, job.points, clusters, self._hemisphere, self._channels, self._lanes
        )
        labels = clusters.labels
        count = self._flat_size(senders)
        started, traced, n = time.perf_counter(), 0, len(job.points)
        with closing(job.workspace.rows("clusters", len(self._slices), 4 * count)) as rows:
            for number, cluster in enumerate(self._slices):
                if number >= rows.filled:
                    part = self._cluster(tracer, labels, senders, number, count)
                    rows.append(part[None].view(np.uint8))
                    traced += (cluster.stop - cluster.start) * len(self._hemisphere)
                rate = traced / max(time.perf_counter() - started, 1e-9) / 1e6
                detail = f"{rate:.1f} million rays/s" if traced else ""
                job.progress("clusters", cluster.stop, n, detail)
            return [
                self._unpacked(rows[i : i + 1].view(np.float32)[0], i, senders)
                for i in range(len(self._slices))
            ]

    def _shapes(self, number, senders):
        """Names and shapes of a cluster's results, in the order in which they are stored."""
        settings = self.job.settings
        m = self._slices[number].stop - self._slices[number].start
        d, directions = settings.depth_coefficients, len(self._hemisphere)
        shapes = {"mean": (directions,), "vectors": (directions, d), "depth": (m, d)}
        if senders is not None:
            columns = len(self._slices) * settings.transfer_coefficients
            shapes |= {
                "receivers": (m, RECEIVERS),
                "transfer": (RECEIVERS, columns, self._channels),
                "back": (settings.transfer_coefficients, columns, self._channels),
                "missed": (2,),
            }
        return shapes

    def _flat_size(self, senders):
        """Numbers in the largest cluster's results."""
        largest = int(np.argmax(np.diff(self._clusters.starts)))
        return sum(int(np.prod(shape)) for shape in self._shapes(largest, senders).values())

    def _cluster(self, tracer, labels, senders, number, count):
        cluster, settings = self._slices[number], self.job.settings
        normals = self.job.points.normals[self._clusters.order[cluster]]
        seen = tracer.trace(cluster, cluster_frames(normals))
        results = list(
            compress(
                seen.distance,
                self._extent,
                self._hemisphere,
                settings.depth_coefficients,
                settings.seed,
            )
        )
        if senders is not None:
            results += self._hop(seen, labels, senders, cluster)
        flat = np.zeros(count, np.float32)
        joined = np.concatenate([np.ravel(x) for x in results])
        flat[: len(joined)] = joined
        return flat

    def _hop(self, seen, labels, senders, cluster):
        """Receivers, transfer and what falls back on the senders after one hop to a cluster."""
        m = cluster.stop - cluster.start
        weights, clusters = self._hemisphere.weights, len(self._slices)
        hop = gathered(seen, weights, labels, clusters, senders.decoder)
        hop = hop.reshape(m, -1, self._channels)
        examples = senders.coefficients.reshape(hop.shape[1], -1)[:, :RESPONSES]
        responses = np.concatenate([hop[..., i] @ examples for i in range(self._channels)], axis=1)
        left, _, _ = leading_components(responses, RECEIVERS, self.job.settings.seed)
        receivers = np.zeros((m, RECEIVERS), np.float32)
        receivers[:, : left.shape[1]] = left
        buried = self.job.points.buried[self._clusters.order[cluster]]
        surface = np.isfinite(seen.distance) & ~buried[:, None]
        missed = (surface & (seen.sample == NOTHING)).sum()
        return [
            receivers,
            _product(receivers.T, hop),
            _product(senders.encoder[cluster].T, hop),
            np.array([missed, surface.sum()], np.float32),
        ]

    def _unpacked(self, flat, number, senders):
        parts, first = {}, 0
        for name, shape in self._shapes(number, senders).items():
            size = int(np.prod(shape))
            parts[name] = flat[first : first + size].reshape(shape)
            first += size
        return parts

    # --- transfer -----------------------------------------------------------------------------

    def _transfer(self, senders, parts):
        """The Transfer, or None where nothing is reflected from point to point; and its report."""
        job, settings = self.job, self.job.settings
        missed, met = np.sum([part["missed"] for part in parts], axis=0, dtype=np.float64)  # pyright: ignore[reportGeneralTypeIssues]
        back = np.concatenate([part["back"] for part in parts]).astype(np.float64)
        if not back.any():
            return None, {"bounces": 0}
        job.progress("transfer", 0, 1, "")
        bounces = settings.lamp_bounces
        reflections = all_reflections(back, None if bounces == "auto" else bounces)
        one_hop = np.stack([part["transfer"] for part in parts])
        c, q, k, channels = one_hop.shape
        matrix = np.stack(
            [
                (
                    one_hop[..., i].reshape(c * q, k) @ reflections[..., i].astype(np.float32)
                ).reshape(c, q, k)
                for i in range(channels)
            ],
            axis=-1,
        )
        examples = senders.coefficients.reshape(k, -1)
        matrix, ranks, error = within_budget(matrix, examples, settings.transfer_error)
        rank = max(int(ranks.max()), 1)
        receivers = np.concatenate([part["receivers"][:, :rank] for part in parts])
        receivers *= np.arange(rank) < ranks[self._clusters.labels][:, None]
        matrix = np.ascontiguousarray(matrix[:, :rank])
        job.progress("transfer", 1, 1, "")
        entries = max(int(ranks.sum()) * k * channels, 1)
        report = {
            "bounces": bounces,
            "captured_response": senders.captured,
            "transfer_error": error,
            "transfer_rank": float(ranks.mean()),
            "transfer_density": float((matrix != 0).sum() / entries),
            "unsampled_share": float(missed / max(met, 1)),
        }
        return Transfer(senders.encoder, receivers, matrix), report

    # --- forecast -----------------------------------------------------------------------------

    def forecast(self):
        """See `Builder.forecast`: whole runs with few points."""
        settings, n = self.job.settings, len(self.job.points)
        self._pilot(FIRST_POINTS)  # compiles the kernels
        seconds = self._pilot(PROBE_POINTS)
        width = 2 if settings.quantize == "16" else 4
        clusters = len(self._slices)
        columns = clusters * settings.transfer_coefficients * self._channels
        basis = clusters * settings.depth_directions * (settings.depth_coefficients + 1)
        stored = width * (n * settings.depth_coefficients + basis)
        if settings.lamp_bounces != 0:
            stored += width * n * (settings.transfer_coefficients + EXPECTED_RANK)
            stored += width * clusters * EXPECTED_RANK * columns // 2
        return {
            "seconds": round(seconds * n, 1),
            "bytes": int(stored),
            "memory": LANES * LANE_BYTES // 2,
            "requires": {"rays": n * settings.depth_directions},
            "chosen": {},
            "reasons": {},
        }

    def _pilot(self, count):
        """A whole run at some of the points; returns seconds for each of them."""
        from .workspace import temporary

        job = self.job
        index = np.random.default_rng(job.settings.seed).permutation(len(job.points))[:count]
        clusters = max(1, round(len(index) / job.settings.cluster_size))
        # Without their neighbours points have no patches: they are found by distance.
        farther = np.sqrt(len(job.points) / len(index))
        spacing = float(np.median(job.points.layout.spacing(job.points)))
        points = replace(job.points.at(np.sort(index)), layout=Spacing(spacing * farther))
        made = make_clusters(points, clusters, job.settings.seed)
        with temporary() as workspace:
            pilot = replace(
                job,
                points=points,
                clusters=made,
                workspace=workspace,
                progress=lambda *_: None,
                limit=1 << 62,
            )
            builder = LocalBuilder(pilot)
            started = time.perf_counter()
            builder.build()
            return (time.perf_counter() - started) / len(index)


def _product(left, hop):
    """left (k, m) · hop (m, columns, channels)."""
    return np.stack([left @ hop[..., i] for i in range(hop.shape[2])], axis=-1)
