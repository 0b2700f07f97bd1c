"""Transport of the scene's own lamps: a column for each, by shadow rays and gathering."""

import time

import numpy as np

from ..transport.bits import LANES
from ..transport.lamp_reflections import reflected_light
from ..transport.lamps import direct_light
from ..transport.own import OwnTransport
from .job import BUILDERS, Builder, wavefront_lanes
from .reflections import surface_shares

LANE_BYTES = 400  # of rays that are followed to surfaces and from there to lamps
COLUMN_BYTES = 100  # of a point and lamp, while columns are put together
PROBE_POINTS = 512, 4096  # points of two probes: their difference is free of what each call takes
PROBE_RAYS = 16
ALL = 1 << 20  # in the place of a number of reflections: any number


@BUILDERS.register
class OwnBuilder(Builder):
    """Builds an `OwnTransport`; see `Builder`."""

    kind = "own"

    def __init__(self, job):
        super().__init__(job)
        self._lights = [light for light in job.scene.own_lights if not light.is_distant]
        self._emitters = [light.emitter for light in self._lights]
        self._lanes = self._lanes_within(job.limit)

    @classmethod
    def wanted(cls, scene, given):
        """See `Builder.wanted`."""
        count = len(scene.local_emitters)
        return f"the scene has {count} lamp{'s' if count > 1 else ''} of its own" if count else ""

    def identity(self):
        """See `Builder.identity`."""
        return {"lamps": [light.digest() + str(light.strength) for light in self._lights]}

    def _lanes_within(self, limit):
        """Lanes of a wavefront that fit beside what must be held."""
        _ = self.job.scene.occluders, self.job.scene.interaction
        needed = COLUMN_BYTES * len(self.job.points) * len(self._lights)
        return wavefront_lanes(limit, int(needed), LANE_BYTES, "points")

    # --- building -----------------------------------------------------------------------------

    def build(self):
        """See `Builder.build`."""
        job, settings = self.job, self.job.settings
        found = job.workspace.keep("lamps", lambda: self._direct(job.points))
        direct, noise, found_rays = found[:-1], found[-1, :, 0], float(found[-1, 0, 1])
        job.clock.lap("lamps")
        reflected, gathered, rays = np.zeros_like(direct), {"bounces": 0}, 0
        if settings.lamp_bounces != 0:
            found = job.workspace.keep("lamp reflections", lambda: self._reflected(direct))
            reflected, gathered = found[:-1], _gathered(found[-1])
            rays = settings.lamp_rays
        job.clock.lap("lamp reflections")
        report = {
            "rays": int(found_rays + len(job.points) * rays),
            "channels": 3,
            "direct_noise": float(noise.max(initial=0)),
            **gathered,
        }
        lamps = tuple(_lamp(light) for light in self._lights)
        exact = OwnTransport(
            lamps, _columns(direct), _columns(reflected), settings.quantize, report
        )
        # the values that a file gives back
        return OwnTransport.from_arrays(exact.header(), exact.arrays(), job.points)

    def _direct(self, points):
        """Direct irradiance (n, k, 3) of the lamps, and in one more row its noise and rays."""
        job, settings = self.job, self.job.settings
        found = direct_light(
            job.scene,
            points,
            self._emitters,
            settings.lamp_tolerance,
            seed=settings.seed,
            lanes=self._lanes,
            progress=lambda done, total: job.progress("lamps", done, total, ""),
        )
        row = _row(found.noise(surface_shares(points, points.buried)))
        row[0, :, 1] = found.rays
        return np.concatenate([found.irradiance, row])

    def _reflected(self, direct, rays=None):
        """Reflected irradiance (n, k, 3) of the lamps, and in one more row what is reported; by so
        many rays from each point, or as many as the settings say.
        """
        job, settings = self.job, self.job.settings
        bounces = settings.lamp_bounces
        found = reflected_light(
            job.scene,
            job.points,
            job.points.buried,
            self._emitters,
            direct,
            job.points.locator(job.scene),
            rays or settings.lamp_rays,
            None if bounces == "auto" else bounces,
            seed=settings.seed,
            lanes=self._lanes,
            progress=lambda done, total: job.progress("lamp reflections", done, total, ""),
        )
        noise = found.noise(surface_shares(job.points, job.points.buried))
        row = _row(noise)
        row[0, :, 1] = max(ALL if count is None else count for count in found.bounces)
        return np.concatenate([found.irradiance, row])

    # --- forecast -----------------------------------------------------------------------------

    def forecast(self):
        """See `Builder.forecast`: some of the points are lit, and all of them by few rays."""
        settings, n, k = self.job.settings, len(self.job.points), len(self._lights)
        width = 12 if settings.quantize == "16" else 24
        return {
            "seconds": round(self._direct_seconds() + self._reflected_seconds(), 1),
            "bytes": width * n * k,
            "memory": LANES * LANE_BYTES // 4 + COLUMN_BYTES * n * k,
            "requires": {},
            "chosen": {},
            "reasons": {"lamp_tolerance": "shadow rays go on until their noise is below it"},
        }

    def _direct_seconds(self):
        points = self.job.points
        order = np.random.default_rng(self.job.settings.seed).permutation(len(points))
        few, more = (points.at(np.sort(order[:count])) for count in PROBE_POINTS)
        self._direct(few)  # compiles the kernels
        fewer, seconds = (_seconds(lambda part=part: self._direct(part)) for part in (few, more))
        if len(more) == len(points):
            return seconds
        each = max(seconds - fewer, 0) / (len(more) - len(few))
        return seconds + each * (len(points) - len(more))

    def _reflected_seconds(self):
        settings = self.job.settings
        if settings.lamp_bounces == 0:
            return 0.0
        rays = min(PROBE_RAYS, settings.lamp_rays)
        lit = np.ones((len(self.job.points), len(self._lights), 3), np.float32)
        self._reflected(lit, 4)  # compiles the kernels
        return _seconds(lambda: self._reflected(lit, rays)) * settings.lamp_rays / rays


def _seconds(run):
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


def _lamp(light):
    """What is recorded of a lamp."""
    return {
        "name": light.name,
        "kind": light.kind,
        "digest": light.digest(),
        "strength": None if light.strength is None else [float(x) for x in light.strength],
    }


def _row(values):
    """Values (k,) as a row (1, k, 3) behind columns."""
    return np.repeat(np.asarray(values, np.float32)[None, :, None], 3, axis=2)


def _gathered(row):
    bounces = int(row[0, 1])
    return {
        "bounces": "auto" if bounces == ALL else bounces,
        "indirect_noise": float(row[:, 0].max(initial=0)),
    }


def _columns(irradiance):
    """Irradiance (n, k, 3) as columns (3, n, k)."""
    return np.ascontiguousarray(np.moveaxis(irradiance, 2, 0))
