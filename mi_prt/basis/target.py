"""What a basis is asked for, and what a fit tells of itself."""

from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from ..errors import SettingsError

# share of Σ‖T‖² below which a difference of sums of squares of float32 rows is their rounding
ROUNDING = 1e-6


@dataclass(frozen=True)
class Target:
    """How many components are wanted; exactly one of the two is set.

    Parameters
    ----------
    components : int, optional
        Number of components.
    variance : float, optional
        As few components as capture this share of the variance, above 0 and below 1.

    Raises
    ------
    SettingsError
        If both or none are set, or one is out of range.
    """

    components: int | None = None
    variance: float | None = None

    def __post_init__(self):
        if (self.components is None) == (self.variance is None):
            raise SettingsError(
                "a basis takes either a number of components or a share of the variance, got"
                f" components {self.components!r} and variance {self.variance!r}: set exactly one"
            )
        components, variance = self.components, self.variance
        if variance is None and (
            isinstance(components, bool) or not isinstance(components, Integral) or components < 0
        ):
            raise SettingsError(f"components must be an integer ≥ 0, got {components!r}")
        if components is None and not (isinstance(variance, Real) and 0 < variance < 1):
            raise SettingsError(
                f"the share of the variance must be above 0 and below 1, got {variance!r}: try 0.99"
            )

    def allowed_residual(self, variance, energy):
        """Largest Σ‖T − T̂‖² that captures the share of the variance; where nothing varies, what
        rounding leaves.
        """
        assert self.variance is not None, "asked of a target by components"
        return (1 - self.variance) * variance if variance > ROUNDING * energy else ROUNDING * energy


@dataclass(frozen=True, eq=False)
class Fit:
    """A basis and how well it represents the rows that it was fitted to, in the √w-weighted norm.

    Parameters
    ----------
    basis : a basis of `basis.bases.BASES`
    residual : float
        Σ‖T − T̂‖², T̂ the reconstruction.
    variance : float
        Σ‖T − mean‖², see `centred`.
    energy : float
        Σ‖T‖².
    """

    basis: Any
    residual: float
    variance: float
    energy: float

    @property
    def captured_variance(self):
        """1 − Σ‖T − T̂‖²/Σ‖T − mean‖². Negative where a basis without a mean does worse than the
        mean alone. Where nothing varies: 1 if nothing is lost, else 0.
        """
        if self.variance > ROUNDING * self.energy:
            return float(1 - self.residual / self.variance)
        return float(self.residual <= ROUNDING * self.energy)

    @property
    def relative_error(self):
        """‖T − T̂‖/‖T‖ over all rows; 0 where all are zero."""
        return float(np.sqrt(self.residual / self.energy)) if self.energy else 0.0


def centred(energy, total, count):
    """Σ‖T − mean‖² from Σ‖T‖² and ΣT (s,), both weighted, of some rows; 0 where it is no more than
    rounding.
    """
    variance = energy - float(total @ total) / max(count, 1)
    return variance if variance > ROUNDING * energy else 0.0


def shares(energies, variance):
    """Energies (d,) over the variance; 0 where nothing varies."""
    return energies / variance if variance > 0 else np.zeros(len(energies))


def check_room(what, needed, room):
    """Raise SettingsError where something needs more bytes than there is room for."""
    if needed > room:
        raise SettingsError(
            f"{what} needs {needed / 1e6:,.0f} MB, and of max_memory (--max-memory)"
            f" {max(room, 0) / 1e6:,.0f} MB are left: raise it, or use fewer coefficients or"
            " directions"
        )
