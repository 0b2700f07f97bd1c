"""From a scene to an asset of local lights: samples, example light, depth buffers, transfer
(Meshless PRT, section 4).
"""

import hashlib
import time
from contextlib import closing
from dataclasses import asdict

import numpy as np
import scipy.sparse

from ..asset.meshless_asset import MeshlessAsset
from ..asset.meshless_file import as_stored
from ..basis.clustered import leading_components
from ..directions.hemisphere import Hemisphere
from ..errors import LightError, SettingsError
from ..lighting.emission import emission_of
from ..lighting.light import Light, as_light
from ..lighting.local_emitters import local_scene_light
from ..lighting.point import PointLight
from ..points.samples import scatter_samples
from ..system.memory import resident_bytes
from ..system.parallel import map_chunks
from ..system.runtime import versions
from ..transport.depth import DepthBuffers, compress
from ..transport.direct import LANES
from ..transport.examples import RAISE, trace_examples
from ..transport.hemispheres import NOTHING, HemisphereTracer, cluster_frames, gathered
from ..transport.local_direct import LocalDirect
from ..transport.transfer import all_reflections, fit_senders
from ..transport.transfer_matrix import Transfer, within_budget
from .reflections import GREY

FUNCTIONALS = 256  # random sums over receivers that tell how much light at a sample matters
IMPORTANCE_DIRECTIONS = 256  # rays of each receiver for that
RECEIVERS = 64  # most components of the indirect irradiance of a cluster
RESPONSES = 256  # examples that those are told from
VISIBILITY_LIGHTS = 16  # examples that visibility is checked with, by ray casts
LANE_BYTES = 120  # of rays that are followed to samples, for each of them
LEAST_LANES = 1 << 16


class MeshlessPrecomputation:
    """One run; see `precompute`.

    Parameters
    ----------
    scene : Scene
    settings : MeshlessSettings
    progress : callable(stage, done, total, detail)
    limit : int
        Bytes that the process may have resident.
    """

    def __init__(self, scene, settings, progress, limit):
        self.scene, self.settings, self.progress = scene, settings, progress
        self.progress("samples", 0, settings.count, "")
        self.samples, self.places = scatter_samples(
            scene, settings.count, settings.cluster_size, settings.example_lights, settings.seed
        )
        self.progress("samples", settings.count, settings.count, "")
        self.points, self.clusters = self.samples.points, self.samples.clusters
        self.channels = 3 if np.ptp(self.points.albedo, axis=1).max(initial=0) > GREY else 1
        self.own_light, self.no_own_light = _own_light(scene)
        self.hemisphere = Hemisphere(settings.depth_directions)
        self.extent = max(
            float(np.linalg.norm(np.ptp(self.points.positions, axis=0))), 1e-6 * scene.scale
        )
        self.lanes = self._lanes(limit)

    def _lanes(self, limit):
        """Rays of a wavefront that fit beside what must be held."""
        settings, n, c = self.settings, len(self.points), len(self.clusters)
        columns = c * settings.transfer_coefficients * self.channels
        largest = int(np.diff(self.samples.starts).max())
        _ = self.scene.occluders
        needed = (
            4 * n * (2 * settings.example_lights + 3 * FUNCTIONALS + IMPORTANCE_DIRECTIONS * 3)
            + largest * (settings.depth_directions * (24 + 4 * self.channels) + 12 * columns)
            + 4 * c * settings.depth_directions * (settings.depth_coefficients + 1) * 2
            + 24 * columns * c * settings.transfer_coefficients
        )
        held = resident_bytes()
        if limit - held < needed + LANE_BYTES * LEAST_LANES:
            raise SettingsError(
                f"memory {limit / 1e6:,.0f} MB is too little: the scene holds {held / 1e6:,.0f} MB"
                f" and the run needs {needed / 1e6:,.0f} MB more; raise max_memory (--max-memory)"
                " or use fewer samples, example lights or coefficients"
            )
        return int(min(LANES, (limit - held - needed) // LANE_BYTES))

    def identity(self):
        """All that the result depends on: what must not change between a run and its
        continuation.
        """
        digest = hashlib.sha256()
        for values in (self.points.positions, self.points.normals, self.points.areas, self.places):
            digest.update(np.ascontiguousarray(values).tobytes())
        return {
            "scene": self.scene.hash[:16],
            "appearance": self.scene.appearance[:16],
            "samples": digest.hexdigest()[:16],
            **asdict(self.settings),
            "versions": versions(),
        }

    def run(self, workspace, description, lap):
        """The asset; `lap` is called with the name of each stage at its end."""
        settings = self.settings
        senders = self._senders(workspace) if settings.bounces != 0 else None
        lap("example lights")
        parts = self._clusters(workspace, senders)
        lap("clusters")
        depth = DepthBuffers(
            np.stack([part["mean"] for part in parts]),
            np.stack([part["vectors"] for part in parts]),
            np.concatenate([part["depth"] for part in parts]),
            self.extent,
        )
        transfer, report = self._transfer(senders, parts) if senders is not None else (None, {})
        exact = depth, transfer
        depth, transfer = as_stored(depth, transfer, self.samples.starts, settings.quantize)
        report |= self._quantization(exact, (depth, transfer), senders)
        report |= self._visibility(depth)
        lap("transfer")
        return MeshlessAsset(
            self.samples,
            depth,
            transfer,
            self.own_light,
            scene=description,
            settings={"points": "samples"} | asdict(settings),
            versions=versions(),
            report={
                "bounces": 0,
                "rays": self.rays,
                "no_own_light": self.no_own_light,
                "channels": self.channels if transfer is not None else 1,
                **report,
            },
        )

    # --- direct light of examples -----------------------------------------------------------------

    def _senders(self, workspace):
        """The SenderBasis."""
        settings, n = self.settings, len(self.points)

        def examples():
            irradiance = np.empty((n, settings.example_lights), np.float32)
            for block, values in trace_examples(self.scene, self.points, self.places, self.lanes):
                irradiance[block] = values
                self.progress("example lights", block.stop, n, "")
            return irradiance

        irradiance = workspace.keep("examples", examples)
        reflected = self.points.areas * self.points.albedo.mean(axis=1)
        flux = reflected @ irradiance
        # Each example counts alike, however much of its light falls on what reflects.
        irradiance *= np.where(flux > 0, 1 / np.maximum(flux, np.float32(1e-30)), 0).astype(
            np.float32
        )
        importance = workspace.keep("importance", self._importance)
        return fit_senders(
            irradiance, importance, self.clusters, settings.transfer_coefficients, settings.seed
        )

    def _importance(self):
        """Random functionals (k, n) of irradiance: sums, with random signs, over what receivers get
        of it after one reflection.
        """
        hemisphere = Hemisphere(IMPORTANCE_DIRECTIONS)
        tracer = HemisphereTracer(self.scene, self.samples, hemisphere, 1, self.lanes)
        n = len(self.points)
        random = np.random.default_rng(self.settings.seed)
        receivers = (
            random.standard_normal((n, FUNCTIONALS), dtype=np.float32)
            * np.sqrt(self.points.areas)[:, None]
        )
        result = np.zeros((n, FUNCTIONALS), np.float32)
        for cluster in self.clusters:
            seen = tracer.trace(cluster, cluster_frames(self.points.normals[cluster]))
            found = seen.sample != NOTHING
            ends = np.concatenate([[0], np.cumsum(found.sum(axis=1))])
            hops = scipy.sparse.csr_array(
                (
                    (seen.albedo[..., 0] * hemisphere.weights)[found],
                    seen.sample[found].astype(np.int32),
                    ends,
                ),
                (len(found), n),
            ).T

            def add(columns):
                result[:, columns] += hops @ np.ascontiguousarray(receivers[cluster, columns])

            half = FUNCTIONALS // 2
            list(map_chunks(add, [slice(0, half), slice(half, None)]))
            self.progress("importance", cluster.stop, n, "")
        return np.ascontiguousarray(result.T)

    # --- what clusters see ------------------------------------------------------------------------

    def _clusters(self, workspace, senders):
        """For each cluster: depth buffers, and with senders receivers, transfer in their basis, and
        what falls back on the senders.
        """
        tracer = HemisphereTracer(
            self.scene, self.samples, self.hemisphere, self.channels, self.lanes
        )
        labels = self.samples.labels
        count = self._flat_sizes(senders)
        self.rays = len(self.points) * len(self.hemisphere)
        started, traced, parts = time.perf_counter(), 0, []
        with closing(workspace.rows("clusters", len(self.clusters), 4 * count)) as rows:
            for number, cluster in enumerate(self.clusters):
                if number >= rows.filled:
                    rows.append(
                        self._cluster(tracer, labels, senders, number, count)[None].view(np.uint8)
                    )
                    traced += (cluster.stop - cluster.start) * len(self.hemisphere)
                rate = traced / max(time.perf_counter() - started, 1e-9) / 1e6
                self.progress(
                    "clusters",
                    cluster.stop,
                    len(self.points),
                    f"{rate:.1f} million rays/s" if traced else "",
                )
            for number in range(len(self.clusters)):
                parts.append(
                    self._unpacked(rows[number : number + 1].view(np.float32)[0], number, senders)
                )
        return parts

    def _layout(self, number, senders):
        """Names and shapes of a cluster's results, in the order in which they are kept."""
        settings, m = self.settings, self.clusters[number].stop - self.clusters[number].start
        d, directions = settings.depth_coefficients, len(self.hemisphere)
        layout = {"mean": (directions,), "vectors": (directions, d), "depth": (m, d)}
        if senders is not None:
            columns = len(self.clusters) * settings.transfer_coefficients
            layout |= {
                "receivers": (m, RECEIVERS),
                "transfer": (RECEIVERS, columns, self.channels),
                "back": (settings.transfer_coefficients, columns, self.channels),
                "missed": (2,),
            }
        return layout

    def _flat_sizes(self, senders):
        """Numbers that the largest cluster's results are."""
        largest = int(np.argmax(np.diff(self.samples.starts)))
        return sum(int(np.prod(shape)) for shape in self._layout(largest, senders).values())

    def _cluster(self, tracer, labels, senders, number, count):
        cluster = self.clusters[number]
        seen = tracer.trace(cluster, cluster_frames(self.points.normals[cluster]))
        settings = self.settings
        mean, vectors, depth = compress(
            seen.distance, self.extent, self.hemisphere, settings.depth_coefficients, settings.seed
        )
        results = [mean, vectors, depth]
        if senders is not None:
            m = cluster.stop - cluster.start
            hop = gathered(
                seen, self.hemisphere.weights, labels, len(self.clusters), senders.decoder
            )
            hop = hop.reshape(m, -1, self.channels)
            examples = senders.coefficients.reshape(hop.shape[1], -1)[:, :RESPONSES]
            responses = np.concatenate(
                [hop[..., i] @ examples for i in range(self.channels)], axis=1
            )
            left, _, _ = leading_components(responses, RECEIVERS, settings.seed)
            receivers = np.zeros((m, RECEIVERS), np.float32)
            receivers[:, : left.shape[1]] = left
            surface = np.isfinite(seen.distance)
            missed = np.array(
                [(surface & (seen.sample == NOTHING)).sum(), surface.sum()], np.float32
            )
            results += [
                receivers,
                _product(receivers.T, hop),
                _product(senders.encoder[cluster].T, hop),
                missed,
            ]
        flat = np.zeros(count, np.float32)
        joined = np.concatenate([np.ravel(x) for x in results])
        flat[: len(joined)] = joined
        return flat

    def _unpacked(self, flat, number, senders):
        parts, first = {}, 0
        for name, shape in self._layout(number, senders).items():
            size = int(np.prod(shape))
            parts[name] = flat[first : first + size].reshape(shape)
            first += size
        return parts

    # --- transfer ---------------------------------------------------------------------------------

    def _transfer(self, senders, parts):
        """The Transfer, or None where nothing is reflected from point to point; and what is told of
        it.
        """
        settings = self.settings
        missed, met = np.sum([part["missed"] for part in parts], axis=0, dtype=np.float64)
        back = np.concatenate([part["back"] for part in parts]).astype(np.float64)
        if not back.any():
            return None, {"bounces": 0}
        self.progress("reflections", 0, 1, "")
        reflections = all_reflections(
            back, None if settings.bounces == "auto" else settings.bounces
        )
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
        receivers *= np.arange(rank) < ranks[self.samples.labels][:, None]
        matrix = np.ascontiguousarray(matrix[:, :rank])
        self.progress("reflections", 1, 1, "")
        report = {
            "bounces": settings.bounces,
            "captured_response": senders.captured,
            "transfer_error": error,
            "transfer_rank": float(ranks.mean()),
            "transfer_density": float(
                (matrix != 0).sum() / max(int(ranks.sum()) * k * channels, 1)
            ),
            "unsampled_share": float(missed / max(met, 1)),
        }
        return Transfer(senders.encoder, receivers, matrix), report

    # --- what was lost ----------------------------------------------------------------------------

    def _quantization(self, exact, stored, senders):
        """What 16-bit numbers change: of depth, as the largest relative error, and of indirect
        irradiance, under the examples.
        """
        if self.settings.quantize == "none":
            return {"quantization": {"depth": 0.0, "indirect": 0.0}}
        worst = 0.0
        for number, cluster in enumerate(self.clusters):
            before, after = (np.log(d.depth(cluster, number)) for d, _ in (exact, stored))
            worst = max(worst, float(np.abs(before - after).max()))
        indirect = 0.0
        if exact[1] is not None:
            examples = senders.decoder[:, 0:1] * np.ones((1, 3), np.float32)
            before, after = (t.indirect(examples, self.clusters) for _, t in (exact, stored))
            indirect = float(np.linalg.norm(after - before) / max(np.linalg.norm(before), 1e-30))
        return {"quantization": {"depth": worst, "indirect": indirect}}

    def _visibility(self, depth):
        """How often the depth buffers are wrong of whether a light is visible, and what direct
        irradiance is off, under some examples.
        """
        direct = LocalDirect(self.samples, depth)
        places = self.places[:: max(1, len(self.places) // VISIBILITY_LIGHTS)][:VISIBILITY_LIGHTS]
        truth = np.concatenate(
            [values for _, values in trace_examples(self.scene, self.points, places, self.lanes)]
        )
        wrong = facing = 0
        squares = []
        for place, expected in zip(places, truth.T):
            emission = emission_of(as_light(PointLight(place, 1.0)))
            _, averaged = direct.irradiance(emission)
            open_air = _unblocked(self.points, place)
            above = open_air > 0
            wrong += int(
                ((averaged[:, 0] > open_air / 2) != (expected > open_air / 2))[above].sum()
            )
            facing += int(above.sum())
            norm = np.linalg.norm(expected)
            if norm > 0:
                squares.append((np.linalg.norm(averaged[:, 0] - expected) / norm) ** 2)
        return {
            "misclassified_visibility": wrong / max(facing, 1),
            "direct_error": float(np.sqrt(np.mean(squares))) if squares else 0.0,
        }


def _product(left, hop):
    """left (k, m) · hop (m, columns, channels)."""
    return np.stack([left @ hop[..., i] for i in range(hop.shape[2])], axis=-1)


def _unblocked(points, place):
    """Irradiance (n,) of samples by a point light of unit intensity that nothing hides, averaged
    over their areas.
    """
    toward = place - points.positions
    height = np.einsum("ij,ij->i", toward, points.normals)
    across = np.einsum("ij,ij->i", toward, toward) - height**2
    raised = np.sqrt(height**2 + RAISE * points.areas)
    return np.where(height > 0, raised * (across + raised**2) ** -1.5, 0)


def _own_light(scene):
    """Emission of the scene's own local emitters, and why there is none, in words, where it has
    none or such as cannot be used.
    """
    try:
        return emission_of(local_scene_light(scene)), ""
    except LightError as error:
        return emission_of(Light()), str(error)
