"""Entries of the error ledger: what each stage costs in accuracy, and the knob that lowers it."""

from dataclasses import asdict, dataclass

HOW = ("measured", "bound", "guess")


@dataclass(frozen=True)
class Entry:
    """One known error.

    Parameters
    ----------
    stage : str
        Where it is made, such as "distant: basis".
    what : str
        In words.
    value : float
        Relative.
    norm : str
        What it is relative to.
    how : str
        One of `HOW`.
    knob : str
        The setting that lowers it.
    """

    stage: str
    what: str
    value: float
    norm: str
    how: str
    knob: str

    def as_dict(self):
        """Plain data."""
        return asdict(self)
