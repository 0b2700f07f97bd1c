"""Distant transport: visibility by rays, a basis, reflections, coefficients."""

from contextlib import closing, contextmanager

import numpy as np

from ..basis.basis import BASES
from ..basis.compressed import Compressed
from ..basis.rows import Rows, encoded
from ..basis.target import Target, check_room
from ..basis.total import carrier, fit_total
from ..directions import parse_directions
from ..errors import SettingsError
from ..transport.bits import DirectSampler, find_buried
from ..transport.distant import DistantTransport
from ..transport.hops import blocked_share
from .budget import INDIRECT_LANE_BYTES, LANE_BYTES, Budget, held_coefficient_bytes
from .distant_forecast import forecast
from .distant_pilot import check_share
from .job import BUILDERS, Builder
from .reflections import IndirectTransport, direct_report, surface_shares

STRICTER = 0.99  # safety factor: reflections lose a little more than the fit of direct light


@BUILDERS.register
class DistantBuilder(Builder):
    """Builds a `DistantTransport`; see `Builder`."""

    kind = "distant"
    open_keys = ("coefficients", "variance")

    def __init__(self, job):
        super().__init__(job)
        settings, points = job.settings, job.points
        self._directions = parse_directions(settings.directions)
        self._target = settings.target(len(points))
        self._basis = BASES[settings.basis]
        self._budget = Budget(
            job.limit, job.scene, points, self._directions, settings, self._target
        )
        if self._target.components is None:
            check_share(job, self._directions, self._target, self._budget)

    @classmethod
    def wanted(cls, scene, given):
        """See `Builder.wanted`."""
        count = len(scene.distant_emitters)
        if count:
            return f"the scene has {count} distant emitter{'s' if count > 1 else ''}"
        return "" if scene.local_emitters else "the scene has no light of its own"

    def forecast(self):
        """See `Builder.forecast`."""
        return forecast(self.job, self._directions, self._target)

    # --- visibility ---------------------------------------------------------------------------

    def buried(self):
        """Traces visibility, which tells what sees no sky; see `Builder.buried`."""
        job = self.job
        rays = job.settings.rays_per_direction
        lanes = self._budget.lanes
        sampler = DirectSampler(job.scene, job.points, self._directions, rays, lanes)
        with closing(self._rows(sampler)) as bits:
            job.trace("transport", sampler, bits)
            self._dark = sampler.transport(bits).dark()
        if not job.points.layout.buries:
            return np.zeros(len(job.points), bool)
        return find_buried(job.scene, job.points, self._dark, lanes)

    def _rows(self, sampler):
        return self.job.workspace.rows("visibility", len(self.job.points), sampler.row_bytes)

    # --- basis and coefficients ---------------------------------------------------------------

    def build(self):
        """See `Builder.build`."""
        job, settings = self.job, self.job.settings
        rays = settings.rays_per_direction
        sampler = DirectSampler(job.scene, job.points, self._directions, rays, self._budget.lanes)
        with closing(self._rows(sampler)) as bits:
            transport = sampler.transport(bits)
            if not hasattr(self, "_dark"):  # another builder told what is buried
                job.trace("transport", sampler, bits)
                self._dark = transport.dark()
            job.clock.lap("transport")
            total, direct, report = self._compressed(transport)
        counts = {
            "rays": transport.rays,
            "rays_per_direction": rays,
            "dark_points": int(self._dark.sum()),
        }
        return DistantTransport(self._directions, total, direct, counts | report)

    def _compressed(self, transport):
        """Total and direct transport (Compressed or None), and the report."""
        job, settings = self.job, self.job.settings
        buried = job.points.buried
        # buried points would only pull the basis
        fitted = ~buried if not buried.all() else ~np.zeros_like(buried)
        blocked = blocked_share(transport, self._directions.solid_angles)
        shares = surface_shares(job.points, buried)
        report = direct_report(float((1 - blocked) @ shares))
        fit = self._fit(transport, fitted, self._target)
        job.clock.lap("basis")
        if settings.distant_bounces != 0 and (blocked[~buried] > 0).any():
            found = self._with_reflections(fit, transport, blocked, fitted)
            job.clock.lap("indirect")
            if found is not None:
                direct = self._direct(fit, transport) if settings.keep_direct else None
                return found[0], direct, found[1]
        direct = self._direct(fit, transport)
        job.clock.lap("coefficients")
        return direct, None, _quality(fit) | report

    def _direct(self, fit, transport):
        """Direct transport, Compressed."""
        return Compressed(fit.basis, fit.basis.encode_all(transport, self._encoding))

    def _encoding(self, done, total):
        self.job.progress("coefficients", done, total, "")

    def _with_reflections(self, fit, transport, blocked, fitted):
        """Total transport (Compressed) and the report; None where no light is reflected to any
        point.
        """
        job, wanted = self.job, self._target.variance
        lanes = max(1, self._budget.lanes * LANE_BYTES // INDIRECT_LANE_BYTES)
        while True:
            carried = carrier(fit.basis)
            direct = encoded(carried.encode, transport, self._encoding)
            indirect = IndirectTransport(
                job, transport, self._directions, carried, direct, blocked, lanes
            )
            coefficients, growth, report = indirect.coefficients()
            if coefficients is None:
                return None
            direct = direct[:, : len(carried.span)]
            total, coefficients = fit_total(
                fit, self._target, carried.span, direct, coefficients, growth, fitted
            )
            if wanted is None or total.captured_variance >= wanted:
                return Compressed(total.basis, coefficients), _quality(total) | report
            # Reflections make transport vary less: direct transport has to lose less.
            lost = max(growth * fit.variance, 1e-300)
            share = 1 - STRICTER * (1 - wanted) * total.variance / lost
            before, fit = fit, self._fit(transport, fitted, Target(variance=share))
            if len(fit.basis) <= len(before.basis):
                with self._open_to_choice():
                    raise SettingsError(
                        f"no number of coefficients captures {wanted} of the variance of total"
                        " transport: ask for less"
                    )

    def _fit(self, transport, fitted, target):
        """The basis of direct transport, a Fit."""
        job, settings, room = self.job, self.job.settings, self._budget.basis
        with self._open_to_choice():
            fit = self._basis.fit(
                Rows(transport.rows, np.flatnonzero(fitted), self._directions),
                target,
                settings.seed,
                lambda *done: job.progress("basis", *done, ""),
                room,
                job.workspace.keep,
            )
            count = len(fit.basis)
            if settings.coefficients not in (None, "auto") and count < settings.coefficients:
                raise SettingsError(
                    f"{settings.coefficients} coefficients are above the rank of the transport: at"
                    f" most {count}"
                )
            if target.components is None:
                channels = self._budget.channels
                size = held_coefficient_bytes(settings, *transport.shape, count, channels)  # pyright: ignore[reportCallIssue]
                check_room(f"keeping {count:,} coefficients of {len(fitted):,} points", size, room)
        return fit

    @contextmanager
    def _open_to_choice(self):
        """Within the block, an error of what only a fit can tell leaves the run open to another
        choice of coefficients, or more memory.
        """
        workspace = self.job.workspace
        try:
            yield
        except SettingsError as error:
            if not workspace.lasting:
                raise
            # The rays stay; the passes of this fit do not, because another one may start elsewhere.
            workspace.forget_arrays()
            identity = self.job.identity
            workspace.record({k: v for k, v in identity.items() if k not in self.open_keys})
            raise SettingsError(
                f"all rays are traced and kept, resume (--resume) goes on from them, but {error}"
            ) from None


def _quality(fit):
    return {"captured_variance": fit.captured_variance, "relative_error": fit.relative_error}
