"""What all stages of a precomputation work with, and what builds a transport."""

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..errors import SettingsError
from ..system.memory import resident_bytes
from ..system.registry import Registry
from ..transport.bits import LANES, find_buried

LEAST_LANES = 1 << 16
BUILDERS = Registry("transport", "mi_prt.precompute")


class Clock:
    """Seconds of stages, each from the end of the one before."""

    def __init__(self):
        self.seconds = {}
        self._last = time.perf_counter()

    def lap(self, name):
        """End a stage."""
        now = time.perf_counter()
        self.seconds[name] = round(self.seconds.get(name, 0.0) + now - self._last, 4)
        self._last = now


@dataclass(eq=False)
class Job:
    """One run.

    Parameters
    ----------
    scene : Scene
    settings : Settings
    points : Points
    clusters : Clusters or None
        Where a transport asks for them.
    flights : (k, 2, 3) float32 or None
        Of particles, where points were found by them.
    progress : callable(stage, done, total, detail)
    limit : int
        Bytes that the process may have resident.
    clock : Clock
    workspace : Workspace or None
        Keeps intermediate results; there once the run begins.
    identity : dict
        All that the result depends on: what must not change between a run and its continuation.
    """

    scene: Any
    settings: Any
    points: Any
    clusters: Any
    flights: Any
    progress: Any
    limit: int
    clock: Clock = field(default_factory=Clock)
    workspace: Any = None
    identity: dict = field(default_factory=dict)

    def trace(self, stage, sampler, rows):
        """Trace what of a sampler's rows is not there yet."""
        started, traced = time.perf_counter(), 0
        self.progress(stage, rows.filled, rows.count, "")
        for block in sampler.blocks(rows.filled):
            rows.append(block)
            traced += len(block) * sampler.rays_per_point
            rate = traced / max(time.perf_counter() - started, 1e-9)
            self.progress(stage, rows.filled, rows.count, f"{rate / 1e6:.1f} million rays/s")


def wavefront_lanes(limit, needed, lane_bytes, fewer):
    """Lanes of a wavefront that fit into memory beside what must be held.

    Parameters
    ----------
    limit : int
        Bytes that the process may have resident.
    needed : int
        Bytes of what must be held beside the scene.
    lane_bytes : int
    fewer : str
        What to use less of, for the error.

    Raises
    ------
    SettingsError
        If not even a small wavefront fits.
    """
    held = resident_bytes()
    if limit - held < needed + lane_bytes * LEAST_LANES:
        raise SettingsError(
            f"memory {limit / 1e6:,.0f} MB is too little: the scene holds {held / 1e6:,.0f} MB"
            f" and the run needs {needed / 1e6:,.0f} MB more; raise max_memory (--max-memory)"
            f" or use fewer {fewer}"
        )
    return int(min(LANES, (limit - held - needed) // lane_bytes))


class Builder(ABC):
    """Builds one transport of an asset.

    Made before the run begins, so that what cannot be had is refused then.

    Parameters
    ----------
    job : Job

    Attributes
    ----------
    kind : str
        Of the transport.
    needs_clusters : bool
    open_keys : tuple of str
        Settings that may be chosen anew when a run is continued, because only a fit tells whether
        they can be had.

    Raises
    ------
    SettingsError
        If the least that it needs does not fit into memory, or settings cannot be had.
    """

    kind: ClassVar[str]
    needs_clusters: ClassVar[bool] = False
    open_keys: ClassVar[tuple] = ()

    def __init__(self, job):
        self.job = job

    @classmethod
    @abstractmethod
    def wanted(cls, scene, given):
        """Why a scene calls for this transport, in words; '' where it does not.

        Parameters
        ----------
        scene : Scene
        given : set of str
            Names of the settings that were given.
        """

    def identity(self):
        """What its result depends on beside scene, points and settings; plain data."""
        return {}

    def buried(self):
        """Which points (n,) are buried, once the run has begun; asked of the first builder."""
        points = self.job.points
        if not points.layout.buries:
            return np.zeros(len(points), bool)
        return find_buried(self.job.scene, points)

    @abstractmethod
    def build(self):
        """The Transport."""

    @abstractmethod
    def forecast(self):
        """What building it will cost.

        Returns
        -------
        dict
            seconds, bytes (in the file), memory (bytes beside what is held already), and of the
            scene `requires`, of the settings `chosen` and `reasons`.
        """
