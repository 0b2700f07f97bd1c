"""What all transports offer, and all transports by their names.

A transport answers one question: what do the points receive under this light, of this component?
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..errors import SettingsError
from ..system.registry import Registry
from ..system.schema import Anything, Number, OneOf, Record, Text

TRANSPORTS = Registry("transport", "mi_prt.transport")
COMPONENTS = ("total", "direct", "indirect")
CHANNELS = OneOf(Number(1, 1, whole=True), Number(3, 3, whole=True))
BOUNCES = OneOf(Number(0, 1 << 31, whole=True), Text("auto"))


def report_spec(required=(), optional=()):
    """What the report of a transport must be in files.

    Parameters
    ----------
    required, optional : tuple of str
        Names of numbers that are computed with. All else is shown only.

    Returns
    -------
    Record
    """
    number = Number(-1e30, 1e30)
    fields = dict.fromkeys((*required, *optional), number)
    fields |= {"bounces": BOUNCES, "channels": CHANNELS}
    return Record(fields, ("channels", *optional), Anything())


@dataclass(frozen=True)
class Question:
    """What is asked of a transport.

    Parameters
    ----------
    light : Light
        Resolved: of parts that the transport takes.
    component : str
        One of `COMPONENTS`.
    nearest : int, optional
        Directions that stand for a local light in transport that knows directions only
        (Eigentransport, section 4.2.1); by default the three around its own, see `arrival`.

    Raises
    ------
    SettingsError
        If the component is another, or `nearest` below 1.
    """

    light: Any
    component: str = "total"
    nearest: int | None = None

    def __post_init__(self):
        if self.component not in COMPONENTS:
            raise SettingsError(
                f"component '{self.component}' is not known: use {', '.join(COMPONENTS)}"
            )
        is_count = isinstance(self.nearest, int | np.integer) and not isinstance(self.nearest, bool)
        if self.nearest is not None and (not is_count or self.nearest < 1):
            raise SettingsError(
                f"the number of nearest directions must be an integer ≥ 1, got {self.nearest!r}"
            )


class Transport(ABC):
    """Transport of light of some kinds to the points of an asset.

    Attributes
    ----------
    kind : str
        Its name.
    takes_words : str
        What light it takes, in words.
    report : dict
        What was measured while it was computed; plain data.
    """

    kind: ClassVar[str]
    takes_words: ClassVar[str]
    report: dict

    # --- relighting ---------------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def is_for(cls, part):
        """Whether transport of this kind is made for a part of light (LightPart)."""

    def takes(self, part):
        """Whether it answers for a part of light."""
        return self.is_for(part)

    def stands_in_for(self, part):
        """Whether it can answer for a part where no other transport takes it, as well as it
        can.
        """
        return False

    def check(self, points, light):
        """What there is to say of light that it takes before it answers: a warning or None."""
        return None

    @abstractmethod
    def respond(self, points, question) -> np.ndarray:
        """Irradiance at the points.

        Parameters
        ----------
        points : Points
            Those of the asset.
        question : Question

        Returns
        -------
        (n, 3) float32
            W/m², not negative.

        Raises
        ------
        SettingsError
            If it does not hold the component.
        """

    def respond_all(self, points, questions):
        """Irradiance (m, n, 3) float32, the answers to m questions; see `respond`."""
        return np.stack([self.respond(points, question) for question in questions])

    def truncated(self, components, points):
        """The transport with fewer components, where it has a number of them that can be chosen.

        Raises
        ------
        SettingsError
            If it cannot be had in that number.
        """
        return self

    def prepare(self, light):
        """Light in a form that turns, and is projected, in milliseconds; a Light."""
        return light

    @property
    def words(self):
        """What it holds, in a few words."""
        return self.takes_words

    @property
    def channels(self):
        """Colour channels of the transport: 3 where reflections colour the light, else 1."""
        return self.report.get("channels", 1)

    @property
    def components(self):
        """Components that it tells apart."""
        return COMPONENTS

    @property
    @abstractmethod
    def reflects(self):
        """Whether it holds reflected light."""

    # --- what it holds ------------------------------------------------------------------------

    @abstractmethod
    def summary(self):
        """What it holds, as plain data for `info`; with `storage` in bytes."""

    @abstractmethod
    def ledger(self):
        """What is known of its errors, a list of `Entry`."""

    # --- in files -----------------------------------------------------------------------------

    @abstractmethod
    def header(self):
        """Plain data that, with the arrays, makes it again."""

    @classmethod
    @abstractmethod
    def header_spec(cls):
        """What its header must be, see `system.schema`."""

    @classmethod
    @abstractmethod
    def shapes(cls, header):
        """What its arrays must be, {name: Array}; n is the number of points."""

    @abstractmethod
    def arrays(self):
        """Its arrays by name."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, header, arrays, points):
        """The transport from what `header` and `arrays` gave, of the right shapes.

        Raises
        ------
        ValueError
            If they do not fit together.
        """
