"""How points lie on surfaces, and what is around a hit between them."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..system.registry import Registry
from ..system.schema import Record, Text

LAYOUTS = Registry("layout of points", "mi_prt.points")


class Locator(ABC):
    """Finds the points around hits on the surfaces of one scene, in Dr.Jit.

    Values are an `mi.Float`, RGB of all points one behind the other. `si.wi` tells the side of the
    surface.
    """

    @abstractmethod
    def interpolated(self, values, pi, si, ray, active):
        """Values between the points around hits; buried points have no share.

        Parameters
        ----------
        values : mi.Float
        pi : mi.PreliminaryIntersection3f
        si : mi.SurfaceInteraction3f
        ray : mi.Ray3f
        active : mi.Bool

        Returns
        -------
        value : mi.Color3f
        found : mi.Bool
            Whether there are points on that side of the surface.
        """

    @abstractmethod
    def picked(self, pi, si, ray, active, random):
        """One of the points around hits, chosen by the weights of interpolation.

        Parameters
        ----------
        pi, si, ray, active :
            As of `interpolated`.
        random : mi.Float
            Uniform in 0…1.

        Returns
        -------
        index : mi.UInt32
        found : mi.Bool
            Whether there is one that is not buried.
        """

    @abstractmethod
    def nearest(self, pi, si, ray, active, seen_from=None):
        """The nearest of the points around hits.

        Parameters
        ----------
        pi, si, ray, active :
            As of `interpolated`.
        seen_from : (mi.Point3f, mi.Vector3f), optional
            A place and its normal: points behind it do not count. Beside a thin wall they may be
            nearest on its other side.

        Returns
        -------
        index : mi.UInt32
        found : mi.Bool
        """


class Layout(ABC):
    """How points lie on surfaces.

    Attributes
    ----------
    kind : str
    SHAPES : dict
        What its arrays must be in files, {name: Array}; n is the number of points.
    SURFACE : Record
        What the record of each surface must be in files.
    buries : bool
        Whether points may lie where no light gets, inside or against other geometry.
    """

    kind: ClassVar[str]
    SHAPES: ClassVar[dict]
    SURFACE: ClassVar[Record]
    buries: ClassVar[bool] = True

    @abstractmethod
    def locator(self, scene, points):
        """The Locator for hits in a Scene."""

    @abstractmethod
    def triangles(self):
        """Triangles of points (m, 3) int32, fronts only; none where there are none."""

    @abstractmethod
    def spacing(self, points):
        """Typical distance of neighbouring points in metres: (n,) float32, or one number."""

    @abstractmethod
    def arrays(self):
        """Its arrays by name."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays, report):
        """The layout from its arrays and the points' report."""

    def check(self, points):
        """Raise ValueError unless its arrays fit points, beyond what `SHAPES` says."""


@LAYOUTS.register
@dataclass(frozen=True, eq=False)
class Spacing(Layout):
    """Points without connections that keep a distance from each other (Meshless PRT, section 4.1).

    Parameters
    ----------
    radius : float
        Metres that points keep from each other, less on curved surfaces.
    """

    radius: float

    kind = "spacing"
    SHAPES: ClassVar[dict] = {}
    SURFACE: ClassVar[Record] = Record({"name": Text(), "kind": Text()})
    buries = False  # particles do not get where light does not

    def locator(self, scene, points):
        """See `Layout.locator`."""
        from .sample_locator import SpacedLocator

        return SpacedLocator(scene, points, self.radius)

    def triangles(self):
        """None."""
        return np.zeros((0, 3), np.int32)

    def spacing(self, points):
        """The radius."""
        return self.radius

    def arrays(self):
        """None: the radius stands in the points' report."""
        return {}

    @classmethod
    def from_arrays(cls, arrays, report):
        """See `Layout.from_arrays`."""
        radius = report.get("radius")
        if not isinstance(radius, float) or not 1e-15 < radius < 1e15:
            raise ValueError(f"points.report.radius is {ascii(radius)[:60]}, no length in metres")
        return cls(radius)
