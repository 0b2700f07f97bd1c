"""What a precomputation is asked to do."""

from dataclasses import dataclass, fields

import numpy as np

from ..basis.bases import check_basis, check_components, default_components, most_components
from ..basis.target import Target
from ..directions import parse_directions
from ..directions.hemisphere import Hemisphere
from ..errors import SettingsError

DEFAULT_VARIANCE = 0.95
MAX_RAYS_PER_DIRECTION = 64
MAX_BOUNCES = 10_000
MAX_PATHS = 1 << 16
INDIRECT = ("solve", "paths")
# bases whose coefficients are picked from, or are, rows of direct transport
DIRECT_ONLY = ("haar", "none")
_INTEGERS = {  # settings that are integers, and what else they may be
    "coefficients": (None, "auto"),
    "rays_per_direction": (),
    "bounces": (None, "auto"),
    "paths_per_point": ("auto",),
    "seed": (),
}


@dataclass(frozen=True)
class Settings:
    """What a precomputation is asked to do; stored with the asset.

    Parameters
    ----------
    directions : str
        Direction lattice: ``cubemap:N``, ``latlong:WxH`` or ``halton:N``.
    basis : str
        ``pca``, ``sh`` (spherical harmonics), ``haar`` (the best wavelets of each point),
        ``haar-shared`` (the same for all points) or ``none`` (transport as it was sampled).
    coefficients : int, 'auto' or None
        Components of the basis. None takes 48 (49 harmonics), or the rank of the transport where
        that is lower; an explicit number above the rank is refused; 'auto' takes as few as capture
        `variance`.
    variance : float or None
        Share of the transport's variance that 'auto' captures, 0.95 by default.
    edge_length : 'auto' or float
        Metres to which coarse faces and analytic shapes are tessellated.
    rays_per_direction : int
        Rays in each cell of the lattice, 1…64.
    bounces : int, 'auto' or None
        Most reflections of light on its way to a point: 0 is direct light alone, 'auto' as many as
        it takes until less than 0.1 % of the light is left (none where no point sees another). None
        is 'auto', and 0 for the bases `haar` and `none`, which hold direct transport only.
    indirect : str
        How reflections are computed: ``solve`` (one traced hop between points, and a series in
        coefficient space) or ``paths`` (path tracing from each point: unbiased, and noisier).
    paths_per_point : int or 'auto'
        Rays (`solve`) or paths (`paths`) from each point; 'auto' takes so many, 64…1024, that their
        noise is about 1 % of the transport, as a pilot tells.
    denoise : bool
        Whether components of indirect transport are scaled by the share of their variance that is
        signal.
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
    bounces: int | str | None = None
    indirect: str = "solve"
    paths_per_point: int | str = "auto"
    denoise: bool = True
    seed: int = 0

    def __post_init__(self):
        lattice = parse_directions(self.directions)
        plain = {"directions": str(lattice)}
        check_basis(self.basis)
        for name, others in _INTEGERS.items():
            value = getattr(self, name)
            if any(
                value is other or (isinstance(value, str) and value == other) for other in others
            ):
                continue
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise SettingsError(
                    f"{name} must be an integer{' or auto' if others else ''}, got {value!r}"
                )
            plain[name] = int(value)
        for name in ("variance", "edge_length"):
            value = getattr(self, name)
            if value is not None and not (
                name == "edge_length" and isinstance(value, str) and value == "auto"
            ):
                plain[name] = _number(name, value)
        # Plain values of one type each: they are stored, and compared when a run is continued.
        for name, value in plain.items():
            object.__setattr__(self, name, value)
        if not 1 <= self.rays_per_direction <= MAX_RAYS_PER_DIRECTION:
            raise SettingsError(
                f"rays per direction must be 1…{MAX_RAYS_PER_DIRECTION}, got"
                f" {self.rays_per_direction}"
            )
        if self.seed < 0:
            raise SettingsError(f"seed must be ≥ 0, got {self.seed}")
        self._check_coefficients(lattice)
        self._check_bounces()

    def _check_bounces(self):
        if self.bounces is None:
            object.__setattr__(self, "bounces", 0 if self.basis in DIRECT_ONLY else "auto")
        if self.bounces != "auto" and not 0 <= self.bounces <= MAX_BOUNCES:
            raise SettingsError(f"bounces must be auto or 0…{MAX_BOUNCES}, got {self.bounces}")
        if self.bounces != 0 and self.basis in DIRECT_ONLY:
            raise SettingsError(
                f"the basis {self.basis} holds direct transport only, got bounces {self.bounces}:"
                " use bounces 0, or the basis pca, sh or haar-shared"
            )
        if self.indirect not in INDIRECT:
            raise SettingsError(
                f"indirect '{self.indirect}' is not known: use {' or '.join(INDIRECT)}"
            )
        if not isinstance(self.denoise, bool):
            raise SettingsError(f"denoise must be true or false, got {self.denoise!r}")
        paths = self.paths_per_point
        if paths != "auto" and (not 2 <= paths <= MAX_PATHS or paths % 2):
            raise SettingsError(
                f"paths per point must be auto or an even number 2…{MAX_PATHS:,}, got {paths}"
            )

    def _check_coefficients(self, lattice):
        if self.basis == "none" and self.coefficients is not None:
            raise SettingsError(
                f"the basis none keeps all directions, so coefficients {self.coefficients} mean"
                " nothing: leave them out"
            )
        if self.coefficients == "auto":
            if self.variance is None:
                object.__setattr__(self, "variance", DEFAULT_VARIANCE)
            Target(variance=self.variance)
        elif self.variance is not None:
            raise SettingsError(
                f"variance {self.variance:g} needs coefficients auto, got"
                f" {self.coefficients or 'the default'}"
            )
        elif self.coefficients is not None and self.coefficients < 0:
            raise SettingsError(f"coefficients must be ≥ 0, got {self.coefficients}")
        check_components(
            self.basis, lattice, None if self.coefficients == "auto" else self.coefficients
        )

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
                f"{self.coefficients} coefficients are above the rank of the transport: {points:,}"
                f" points and {len(directions):,} directions allow at most {largest}"
            )
        return Target(int(self.coefficients))


def _number(name, value):
    try:
        return float(value)
    except (TypeError, ValueError):
        auto = "neither 'auto' nor" if name == "edge_length" else "not"
        raise SettingsError(f"{name} {value!r} is {auto} a number") from None


QUANTIZATIONS = ("16", "none")


@dataclass(frozen=True)
class MeshlessSettings:
    """What a precomputation for local lights is asked to do (Meshless PRT); stored with the asset.

    Parameters
    ----------
    count : int
        Sample points, 1…1,000,000.
    cluster_size : int
        Samples in a cluster, on average.
    depth_directions : int
        Of each sample's depth buffer: a product of two numbers that differ by half at most.
    depth_coefficients : int
        Components of the depth buffers of each cluster.
    example_lights : int
        Point lights that the basis of direct light is made from.
    transfer_coefficients : int
        Components of direct light on each cluster.
    transfer_error : float
        Relative RMS error of indirect irradiance that may be made by dropping small parts of the
        transfer matrices; 0 drops none.
    quantize : '16' or 'none'
        Bits of an integer in the place of float32.
    bounces : int or 'auto'
        Most reflections of light on its way to a point; 0 is direct light alone, 'auto' any number.
    seed : int

    Raises
    ------
    SettingsError
        If a value is out of range.
    """

    count: int = 45_000
    cluster_size: int = 1000
    depth_directions: int = 2016
    depth_coefficients: int = 50
    example_lights: int = 1000
    transfer_coefficients: int = 32
    transfer_error: float = 0.02
    quantize: str = "16"
    bounces: int | str = "auto"
    seed: int = 0

    def __post_init__(self):
        most = {
            "count": (1, 1_000_000),
            "cluster_size": (1, 1_000_000),
            "depth_directions": (16, 1 << 16),
            "depth_coefficients": (1, 1 << 12),
            "example_lights": (1, 100_000),
            "transfer_coefficients": (1, 1 << 10),
            "bounces": (0, MAX_BOUNCES),
            "seed": (0, (1 << 31) - 1),
        }
        for name, (low, high) in most.items():
            value = getattr(self, name)
            words = name.replace("_", " ")
            if name == "bounces" and value in (None, "auto"):
                object.__setattr__(self, name, "auto")
                continue
            if (
                isinstance(value, bool)
                or not isinstance(value, int | np.integer)
                or not low <= value <= high
            ):
                raise SettingsError(
                    f"{words} must be an integer"
                    f" {low}…{high:,}{' or auto' if name == 'bounces' else ''}, got {value!r}"
                )
            object.__setattr__(self, name, int(value))
        Hemisphere(self.depth_directions)
        error = _number("transfer_error", self.transfer_error)
        if not 0 <= error < 1:
            raise SettingsError(
                f"transfer error must be at least 0 and below 1, got {self.transfer_error}"
            )
        object.__setattr__(self, "transfer_error", error)
        object.__setattr__(self, "quantize", str(self.quantize))
        if self.quantize not in QUANTIZATIONS:
            raise SettingsError(
                f"quantize '{self.quantize}' is not known: use {' or '.join(QUANTIZATIONS)}"
            )


def names_of(settings):
    """Names of the fields of a class of settings."""
    return [field.name for field in fields(settings)]
