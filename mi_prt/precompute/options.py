"""Kinds of options: how a value is checked, whether it comes from Python or as text."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import SettingsError


@dataclass(frozen=True)
class Option(ABC):
    """One setting of a precomputation.

    Parameters
    ----------
    name : str
        In Python; with hyphens on the command line.
    default : object
    help : str
        One line.
    metavar : str
        What stands for the value in help.
    group : str
        What it is for: 'general', a layout of points ('vertices', 'samples'), or a transport
        ('distant', 'own', 'local').
    """

    name: str
    default: Any
    help: str
    metavar: str
    group: str = "general"

    @property
    def words(self):
        """The name in messages."""
        return self.name.replace("_", " ")

    @abstractmethod
    def check(self, value):
        """A value of the option's own type.

        Raises
        ------
        SettingsError
            If it is out of range.
        """

    def _is_other(self, value, others):
        return any(value is o or (isinstance(value, str) and value == o) for o in others)


@dataclass(frozen=True)
class Integer(Option):
    """A whole number, or one of a few words."""

    least: int = 0
    most: int = 1 << 31
    others: tuple = ()

    def check(self, value):
        """See `Option.check`."""
        if self._is_other(value, self.others):
            return value
        number = value
        if isinstance(value, str):
            try:
                number = int(value)
            except ValueError:
                number = None
        words = "".join(f" or {o}" for o in self.others if o is not None)
        if isinstance(number, bool) or not isinstance(number, int | np.integer):
            raise SettingsError(f"{self.words} must be an integer{words}, got {value!r}")
        if not self.least <= number <= self.most:
            raise SettingsError(
                f"{self.words} must be {self.least:,}…{self.most:,}{words}, got {number}"
            )
        return int(number)


@dataclass(frozen=True)
class Real(Option):
    """A number, or one of a few words."""

    others: tuple = ()
    least: float = -np.inf
    below: float = np.inf

    def check(self, value):
        """See `Option.check`."""
        if self._is_other(value, self.others):
            return value
        try:
            number = float(value)
        except (TypeError, ValueError):
            words = " or ".join(repr(o) for o in self.others if o is not None)
            either = f"neither {words} nor" if words else "not"
            raise SettingsError(f"{self.words} {value!r} is {either} a number") from None
        if not self.least <= number < self.below:
            raise SettingsError(
                f"{self.words} must be at least {self.least:g} and below {self.below:g},"
                f" got {value}"
            )
        return number


@dataclass(frozen=True)
class Flag(Option):
    """True or false."""

    def check(self, value):
        """See `Option.check`."""
        if not isinstance(value, bool):
            raise SettingsError(f"{self.words} must be true or false, got {value!r}")
        return value


@dataclass(frozen=True)
class Choice(Option):
    """One of some names; a mapping or sequence of them, asked when a value is checked."""

    among: Any = ()

    def check(self, value):
        """See `Option.check`."""
        if str(value) not in self.among:
            names = ", ".join(list(self.among)[:-1]) + f" or {list(self.among)[-1]}"
            raise SettingsError(f"{self.words} '{value}' is not known: use {names}")
        return str(value)
