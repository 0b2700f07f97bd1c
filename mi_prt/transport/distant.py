"""Transport of distant light: a basis, and the coefficients of all points (Eigentransport)."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..basis.basis import BASES
from ..basis.compressed import Compressed
from ..basis.truncated import truncated
from ..directions import parse_directions
from ..errors import SettingsError
from ..lighting.emission import emission_of
from ..lighting.local import arrival, hull_warning
from ..system.schema import Flag, ListOf, Number, Record, Text
from .ledger import Entry
from .transport import COMPONENTS, TRANSPORTS, Transport, report_spec


@TRANSPORTS.register
@dataclass(frozen=True, eq=False)
class DistantTransport(Transport):
    """Irradiance of points under light from afar.

    Parameters
    ----------
    directions : DirectionLattice
    total : Compressed
        Transport of all light, direct and reflected.
    direct : Compressed or None
        Of direct light alone, where it was asked for; None where it is the total, or not there.
    report : dict
        Counts of rays, captured variance and relative error of the transport, and how light splits
        by reflections.
    """

    directions: Any
    total: Compressed
    direct: Compressed | None
    report: dict = field(default_factory=dict)

    kind = "distant"
    takes_words = "environment maps and directional lights"

    # --- relighting ---------------------------------------------------------------------------

    @classmethod
    def is_for(cls, part):
        """All light from afar."""
        return part.is_distant

    def stands_in_for(self, part):
        """Local light, seen in the directions around its own (section 4.2.1)."""
        return not part.is_distant

    def check(self, points, light):
        """A warning where local lights stand inside the convex hull of the points."""
        places = emission_of(light.local).positions
        return hull_warning(places, points.hull) if len(places) else None

    @property
    def reflects(self):
        """Whether it holds reflected light."""
        return self.report["bounces"] != 0

    @property
    def words(self):
        """See `Transport.words`."""
        captured = self.report["captured_variance"]
        return (
            f"{len(self.basis):,} coefficients ({self.basis.kind}) on {self.directions},"
            f" {100 * captured:.1f} % of the variance"
        )

    @property
    def components(self):
        """All, or the total alone where direct light was not kept apart."""
        return COMPONENTS if self.direct is not None or not self.reflects else ("total",)

    def respond(self, points, question):
        """See `Transport.respond`."""
        return self.respond_all(points, [question])[0]

    def respond_all(self, points, questions):
        """See `Transport.respond_all`; all of one component."""
        component = questions[0].component
        if component == "total":
            return self._irradiance(self.total, points, questions)
        if not self.reflects:
            if component == "direct":
                return self._irradiance(self.total, points, questions)
            return np.zeros((len(questions), len(points), 3), np.float32)
        if self.direct is None:
            raise SettingsError(
                f"component '{component}': this asset holds direct and reflected distant"
                " light in one; precompute it with keep_direct (--keep-direct) to tell them apart"
            )
        total = self._irradiance(self.total, points, questions)
        direct = np.minimum(self._irradiance(self.direct, points, questions), total)
        return direct if component == "direct" else total - direct

    def _irradiance(self, transport, points, questions):
        """Irradiance (m, n, 3); what compression leaves below zero of the sums is zero."""
        lights = [question.light.distant for question in questions]
        irradiance = transport.respond_all(*transport.basis.project_all(lights, self.directions))
        for of_light, question in zip(irradiance, questions):
            for cells, shares, strength in arrival(
                emission_of(question.light.local),
                points.positions,
                self.directions,
                question.nearest,
            ):
                of_light += strength * transport.in_cells(cells, shares)
        return np.maximum(irradiance, 0, out=irradiance)

    def truncated(self, components, points):
        """See `Transport.truncated`; the report says what is still captured."""
        kept = ~points.buried if not points.buried.all() else points.buried
        total, quality = truncated(self.total, components, kept, self.report)
        direct = self.direct
        if direct is not None and len(direct.basis) > components:
            direct = truncated(direct, components, kept, self.report)[0]
        report = self.report | quality | {"truncated_from": len(self.basis)}
        return replace(self, total=total, direct=direct, report=report)

    def prepare(self, light):
        """Maps on a fine lattice; spherical harmonics turn them in closed form."""
        return self.total.basis.prepare(light, self.directions)

    # --- what it holds ------------------------------------------------------------------------

    @property
    def basis(self):
        """The basis of total transport."""
        return self.total.basis

    @property
    def coefficients(self):
        """The coefficients of total transport."""
        return self.total.coefficients

    def storage_bytes(self, rays_per_direction=1):
        """Bytes kept for relighting and for projecting light; see `storage_bytes`."""
        return storage_bytes(
            self.basis,
            len(self.total),
            len(self.directions),
            len(self.basis),
            rays_per_direction,
            self.channels,
        )

    def summary(self):
        """See `Transport.summary`."""
        basis = self.basis
        arrays = self.arrays()
        relighting, projection = self.storage_bytes(self.report.get("rays_per_direction", 1))
        # Without a mean the components also hold that of the transport, and their energies sum to
        # more than the variance.
        name = "captured_variance" if basis.joins_channels else "energy_over_variance"
        return {
            "directions": str(self.directions),
            "cells": len(self.directions),
            "basis": basis.kind,
            "coefficients": len(basis),
            "components": list(self.components),
            "bounces": self.report["bounces"],
            "captured_variance": self.report["captured_variance"],
            "relative_error": self.report["relative_error"],
            f"{name}_per_component": [round(float(v), 6) for v in basis.captured_variance],
            "storage": {
                "predicted": {"relighting": relighting, "projection": projection},
                "measured": {
                    "coefficients": _bytes(arrays, "total/coefficients"),
                    "basis": _bytes(arrays, "total/basis"),
                },
            },
        }

    def ledger(self):
        """See `Transport.ledger`."""
        rays = self.report.get("indirect_noise", 0.0)
        entries = [
            Entry(
                "distant: basis",
                "transport that the components do not hold",
                self.report["relative_error"],
                "transport over the sphere",
                "measured",
                "coefficients",
            )
        ]
        if rays:
            knob = "paths_per_point"
            what = "noise of reflected light"
            entries.append(Entry("distant: rays", what, rays, "transport", "measured", knob))
        left, energy = self.report.get("bounce_energy_left"), sum(self.report["bounce_energy"])
        if left and energy > 0:
            what = "reflections after the last one that counts"
            entries.append(
                Entry("distant: bounces", what, left / energy, "all light", "bound", "bounces")
            )
        return entries

    # --- in files -----------------------------------------------------------------------------

    def header(self):
        """See `Transport.header`."""
        return {
            "directions": str(self.directions),
            "basis": self.basis.kind,
            "keeps_direct": self.direct is not None,
            "report": self.report,
        }

    @classmethod
    def header_spec(cls):
        """See `Transport.header_spec`."""
        report = report_spec(
            ("captured_variance", "relative_error"), ("indirect_noise", "bounce_energy_left")
        )
        more = {
            "rays_per_direction": Number(1, 1 << 20, whole=True),
            "bounce_energy": ListOf(Number(-1e30, 1e30)),
        }
        report = Record({**report.fields, **more}, report.optional, report.others)
        fields = {"directions": Text(), "basis": Text(), "keeps_direct": Flag(), "report": report}
        return Record(fields)

    @classmethod
    def shapes(cls, header):
        """See `Transport.shapes`."""
        basis, channels = BASES[header["basis"]], header["report"].get("channels", 1)
        sets = {"total": channels} | ({"direct": 1} if header["keeps_direct"] else {})
        found = {}
        for name, count in sets.items():
            shapes = {f"basis/{key}": a for key, a in basis.shapes(count).items()}
            shapes |= basis.coefficient_shapes(count)
            # each set has components of its own; directions are shared
            found |= {f"{name}/{key}": a.within(name, ("n", "s")) for key, a in shapes.items()}
        return found

    def arrays(self):
        """See `Transport.arrays`."""
        sets = {"total": self.total} | ({"direct": self.direct} if self.direct else {})
        found = {}
        for name, part in sets.items():
            basis = part.basis
            found |= {f"{name}/basis/{key}": getattr(basis, key) for key in basis.ARRAYS}
            packed = basis.pack(part.coefficients)
            found |= {f"{name}/{key}": array for key, array in packed.items()}
        return found

    @classmethod
    def from_arrays(cls, header, arrays, points):
        """See `Transport.from_arrays`."""
        kind, directions = BASES[header["basis"]], parse_directions(header["directions"])

        def part(name):
            own = {
                key.removeprefix(f"{name}/"): array
                for key, array in arrays.items()
                if key.startswith(f"{name}/")
            }
            basis = kind(**{key: own[f"basis/{key}"] for key in kind.ARRAYS})
            basis.check_stored(directions)
            return Compressed(basis, kind.unpack(own, points.normals, len(directions)))

        direct = part("direct") if header["keeps_direct"] else None
        return cls(directions, part("total"), direct, header["report"])


def _bytes(arrays, prefix):
    return sum(array.nbytes for name, array in arrays.items() if name.startswith(prefix))


def storage_bytes(basis, points, directions, components, rays_per_direction=1, channels=1):
    """What has to be kept for relighting (Eigentransport, section 7.1).

    Parameters
    ----------
    basis : Basis or its class
    points, directions, components : int
        v, s and d of the paper.
    rays_per_direction : int
    channels : 1 or 3
        Of the transport. Where a basis joins them one set of coefficients holds all; in others
        each has coefficients of its own.

    Returns
    -------
    relighting : int
        Bytes of the coefficients of all points and of the light: 4d(v + 1), single precision.
    projection : int
        Bytes of the matrix that projects light: 4ds.
    """
    sets, functions = (1, channels) if basis.joins_channels else (channels, 1)
    stored = basis.coefficient_bytes(points, directions, components, rays_per_direction)
    relighting = sets * stored + basis.light_bytes(directions, components)
    return relighting, functions * basis.projection_bytes(directions, components)
