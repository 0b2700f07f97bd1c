"""Indirect transport: whether a scene calls for it, how many rays it takes, and what it adds to
direct transport's coefficients.
"""

import zlib
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..transport.hops import NOTHING, Hops, HopSampler
from ..transport.interreflection import (
    MOST_SUMMED_BOUNCES,
    BounceSplit,
    check_ending,
    combined,
    solve,
    split_by_bounces,
)
from ..transport.paths import ENERGY_BINS, PathSampler

PILOT_POINTS = 256
PILOT_RAYS = 64
# noise of indirect transport that `auto` aims at, as a share of the norm of direct transport
NOISE_TOLERANCE = 0.01
LEAST_RAYS, MOST_RAYS = 64, 1024  # of `auto`, from each point
GREY = 1e-3  # difference between the channels of an albedo that is taken for grey


@dataclass(frozen=True, eq=False)
class Demand:
    """What a scene calls for beyond direct transport.

    Parameters
    ----------
    rays : int
        Rays or paths from each point.
    channels : 1 or 3
        1 where all that reflects is grey.
    """

    rays: int
    channels: int


@dataclass(frozen=True, eq=False)
class IndirectTransport:
    """Indirect transport of a scene's points, in the span of their direct transport.

    Parameters
    ----------
    job : Job
    transport : DirectTransport
    directions : DirectionLattice
    carrier : Carrier
    direct : (n, m + p) float32
        Direct transport in it.
    blocked : (n,) float32
        Share of each point's cosine-weighted hemisphere in which it sees a surface.
    lanes : int
        Most rays of one wavefront.
    """

    job: Any
    transport: Any
    directions: Any
    carrier: Any
    direct: np.ndarray
    blocked: np.ndarray
    lanes: int

    @property
    def _points(self):
        return self.job.points

    @property
    def _settings(self):
        return self.job.settings

    def _demand(self):
        """Find out what the scene calls for, by a few rays from some of its points; a Demand."""
        settings = self._settings
        seeing = np.flatnonzero((self.blocked > 0) & ~self._points.buried)
        few = np.sort(np.random.default_rng(settings.seed).permutation(seeing)[:PILOT_POINTS])
        hops = self._hop_sampler(PILOT_RAYS).rows(few)
        seen = hops["point"] != NOTHING
        coloured = any(
            np.ptp(x, axis=-1).max(initial=0) > GREY
            for x in (self._points.albedo, hops["albedo"][seen])
        )
        if settings.distant_bounces == "auto":
            check_ending(
                max(float(x.max(initial=0.0)) for x in (self._points.albedo, hops["albedo"][seen]))
            )
        rays = settings.paths_per_point
        if rays == "auto":
            first, second = (
                self._hop_halves(few, hops, seen)
                if settings.indirect == "solve"
                else self._path_halves(few)
            )
            # With a single ray from each point; strata make it less. Points that see nothing have
            # none.
            m = len(self.carrier.span)
            noise = (
                PILOT_RAYS
                / 4
                * float(np.sum(np.square(first - second)[:, :m]))
                / len(few)
                * len(seeing)
            )
            wanted = noise / max(
                NOISE_TOLERANCE**2
                * float(np.sum(np.square(self.direct[~self._points.buried, :m]))),
                1e-300,
            )
            rays = 1 << int(np.ceil(np.log2(np.clip(wanted, LEAST_RAYS, MOST_RAYS))))
        return Demand(rays, 3 if coloured else 1)

    def _hop_halves(self, few, hops, seen):
        """What is carried (few, m + p) of light after one reflection, by every other ray and by the
        rest.
        """
        arriving = np.zeros((*hops.shape, self.direct.shape[1]), np.float32)
        arriving[seen] = self.direct[hops["point"][seen]] * hops["albedo"][seen].mean(
            axis=-1, keepdims=True
        )
        return [self.blocked[few, None] * arriving[:, first::2].mean(axis=1) for first in (0, 1)]

    def _path_halves(self, few):
        """The same of light after all reflections, by paths."""
        sampler = self._path_sampler(Demand(PILOT_RAYS, 1), self._points.at(few))
        halves, _ = _unpacked(np.concatenate(list(sampler.blocks())), 1, self.direct.shape[1])
        return halves[:, 0]

    def coefficients(self):
        """Coefficients of indirect transport; the job's workspace keeps the rays.

        Returns
        -------
        coefficients : (c, n, m) float32 or None
            None where no light is reflected to any point.
        growth : float
            See `basis.total.fit_total`.
        report : dict

        Raises
        ------
        SceneError
            If any number of reflections is wanted and they do not end.
        """
        demand = self._demand()
        estimate = {"solve": self._solved, "paths": self._traced}[self._settings.indirect]
        halves, split = estimate(demand)
        if split.bounces == 0:
            return None, 0.0, direct_report(split.energy[0])
        m, kept = len(self.carrier.span), ~self._points.buried
        growth = self._growth([half[..., m:] for half in halves], kept)
        coefficients, noise, passed = combined(
            [half[..., :m] for half in halves], kept, self._settings.denoise
        )
        total = float(np.linalg.norm(self.direct[kept, :m])) * demand.channels**0.5
        return (
            coefficients,
            growth,
            {
                "bounces": split.bounces,
                "bounce_energy": [float(f"{x:.6g}") for x in split.energy],
                # between white walls there is no bound
                **({"bounce_energy_left": split.left} if np.isfinite(split.left) else {}),
                "channels": demand.channels,
                "paths_per_point": demand.rays,
                "indirect_noise": noise / max(total, 1e-300),
                "indirect_noise_passed": passed**0.5,
            },
        )

    def _growth(self, halves, kept):
        """Of what the coefficients leave out: squared norm after reflections, summed over channels,
        over that before, by the probes.
        """
        lost = self.direct[kept, len(self.carrier.span) :]
        # Noise of the two halves is independent, and so has no part in the mean of their product.
        after = sum(float(np.vdot(lost + a[kept], lost + b[kept])) for a, b in zip(*halves))
        return max(after, 0.0) / max(float(np.vdot(lost, lost)), 1e-300)

    def _solved(self, demand):
        """Two independent estimates (c, n, m + p) by a series of hops, None where there is no
        light; and the BounceSplit.
        """
        sampler = self._hop_sampler(demand.rays)
        m, channels = self.direct.shape[1], demand.channels
        with closing(self._rows("hops", sampler.row_bytes)) as rays:
            self.job.trace("indirect", sampler, rays)
            hops = Hops(rays, self.blocked)
            weights = surface_shares(self._points, self._points.buried)
            split = split_by_bounces(hops, 1 - self.blocked, weights, channels, self._most)
            if split.bounces == 0:
                return None, split
            summed = None if self._most is None and split.bounces > MOST_SUMMED_BOUNCES else split
            halves = [
                solve(
                    half,
                    self.direct,
                    channels,
                    summed,
                    lambda done: self.job.progress("reflections", i * m + done, 2 * m, ""),
                )
                for i, half in enumerate(hops.halves())
            ]
        return halves, split if summed else replace(split, left=0.0)

    def _traced(self, demand):
        """The same by paths."""
        sampler = self._path_sampler(demand, self._points)
        m = self.direct.shape[1]
        # What is kept are coefficients, which mean nothing in another span.
        name = f"paths-{zlib.crc32(np.ascontiguousarray(self.carrier.span.vectors).data):08x}"
        with closing(self._rows(name, sampler.row_bytes(m))) as rows:
            self.job.trace("indirect", sampler, rows)
            halves, energies = _unpacked(rows[:], demand.channels, m)
        weights = surface_shares(self._points, self._points.buried)
        reflected = (weights @ energies).tolist()
        while reflected and reflected[-1] == 0:
            reflected.pop()
        return halves, BounceSplit((float((1 - self.blocked) @ weights), *reflected), 0.0)

    def _rows(self, name, row_bytes):
        return self.job.workspace.rows(name, len(self._points), row_bytes)

    @property
    def _most(self):
        return None if self._settings.distant_bounces == "auto" else self._settings.distant_bounces

    def _hop_sampler(self, rays):
        seed = self._settings.seed
        return HopSampler(
            self.job.scene,
            self._points,
            self.transport,
            self.directions,
            rays,
            seed,
            self.lanes,
        )

    def _path_sampler(self, demand, points):
        seed, encode = self._settings.seed, self.carrier.encode
        return PathSampler(
            self.job.scene,
            points,
            self.directions,
            demand.rays,
            self._most,
            demand.channels,
            encode,
            seed,
            self.lanes,
        )


def direct_report(energy):
    """What an asset reports of reflections where there are none, given the energy of direct light
    (see `BounceSplit`).
    """
    return {"bounces": 0, "bounce_energy": [float(f"{energy:.6g}")], "channels": 1}


def surface_shares(points, buried):
    """The points' shares (n,) in a mean over the surface; buried points have none."""
    weights = np.where(buried & ~buried.all(), 0, points.areas).astype(np.float64)
    return weights / max(weights.sum(), 1e-300)


def _unpacked(rows, channels, m):
    """Coefficients (2, c, n, m) of both halves of the paths, and energies (n, 64), from the rows of
    `PathSampler`.
    """
    rows = np.ascontiguousarray(rows).view(np.float32)
    halves = rows[:, :-ENERGY_BINS].reshape(len(rows), 2, channels, m)
    return np.ascontiguousarray(halves.transpose(1, 2, 0, 3)), rows[:, -ENERGY_BINS:]
