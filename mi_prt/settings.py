"""What a precomputation is asked to do."""

from dataclasses import dataclass

import numpy as np

from .basis.bases import check_basis, check_components, default_components, most_components
from .basis.target import Target
from .directions import parse_directions
from .errors import SettingsError

DEFAULT_VARIANCE = 0.95
MAX_RAYS_PER_DIRECTION = 64


@dataclass(frozen=True)
class Settings:
    """What a precomputation is asked to do; stored with the asset.

    Parameters
    ----------
    directions : str
        Direction lattice: ``cubemap:N``, ``latlong:WxH`` or ``halton:N``.
    basis : str
        ``pca``, ``sh`` (spherical harmonics), ``haar`` (the best wavelets of each point), ``haar-shared`` (the same for all
        points) or ``none`` (transport as it was sampled).
    coefficients : int, 'auto' or None
        Components of the basis. None takes 48 (49 harmonics), or the rank of the transport where that is lower; an explicit
        number above the rank is refused; 'auto' takes as few as capture `variance`.
    variance : float or None
        Share of the transport's variance that 'auto' captures, 0.95 by default.
    edge_length : 'auto' or float
        Metres to which coarse faces and analytic shapes are tessellated.
    rays_per_direction : int
        Rays in each cell of the lattice, 1…64.
    seed : int

    Raises
    ------
    SettingsError
        If a value is out of range or values contradict each other.
    """

    directions: str = "cubemap:32"
    basis: str = "pca"
    coefficients: int | str | None = None
    variance: float | None = None
    edge_length: str | float = "auto"
    rays_per_direction: int = 1
    seed: int = 0

    def __post_init__(self):
        lattice = parse_directions(self.directions)
        plain = {"directions": str(lattice)}
        check_basis(self.basis)
        for name, others in (("coefficients", (None, "auto")), ("rays_per_direction", ()), ("seed", ())):
            value = getattr(self, name)
            if any(value is other or (isinstance(value, str) and value == other) for other in others):
                continue
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise SettingsError(f"{name} must be an integer{' or auto' if others else ''}, got {value!r}")
            plain[name] = int(value)
        for name in ("variance", "edge_length"):
            value = getattr(self, name)
            if value is not None and not (name == "edge_length" and isinstance(value, str) and value == "auto"):
                plain[name] = _number(name, value)
        # Plain values of one type each: they are stored, and compared when a run is continued.
        for name, value in plain.items():
            object.__setattr__(self, name, value)
        if not 1 <= self.rays_per_direction <= MAX_RAYS_PER_DIRECTION:
            raise SettingsError(f"rays per direction must be 1…{MAX_RAYS_PER_DIRECTION}, got {self.rays_per_direction}")
        if self.seed < 0:
            raise SettingsError(f"seed must be ≥ 0, got {self.seed}")
        self._check_coefficients(lattice)

    def _check_coefficients(self, lattice):
        if self.basis == "none" and self.coefficients is not None:
            raise SettingsError(f"the basis none keeps all directions, so coefficients {self.coefficients} mean nothing: leave them out")
        if self.coefficients == "auto":
            if self.variance is None:
                object.__setattr__(self, "variance", DEFAULT_VARIANCE)
            Target(variance=self.variance)
        elif self.variance is not None:
            raise SettingsError(f"variance {self.variance:g} needs coefficients auto, got {self.coefficients or 'the default'}")
        elif self.coefficients is not None and self.coefficients < 0:
            raise SettingsError(f"coefficients must be ≥ 0, got {self.coefficients}")
        check_components(self.basis, lattice, None if self.coefficients == "auto" else self.coefficients)

    def target(self, points):
        """What the basis of so many points is asked for, a Target."""
        if self.variance is not None:
            return Target(variance=self.variance)
        directions = parse_directions(self.directions)
        if self.coefficients is None:
            return Target(default_components(self.basis, directions, points))
        largest = most_components(self.basis, directions, points)
        if self.coefficients > largest:
            raise SettingsError(
                f"{self.coefficients} coefficients are above the rank of the transport: {points:,} points and "
                f"{len(directions):,} directions allow at most {largest}"
            )
        return Target(int(self.coefficients))


def _number(name, value):
    try:
        return float(value)
    except (TypeError, ValueError):
        auto = "neither 'auto' nor" if name == "edge_length" else "not"
        raise SettingsError(f"{name} {value!r} is {auto} a number") from None
