"""What a precomputation is asked to do: one table of options, from which checks, command line and
documentation are made.
"""

from dataclasses import make_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..basis.basis import BASES
from ..basis.target import Target
from ..directions import parse_directions
from ..directions.hemisphere import Hemisphere
from ..errors import SettingsError
from ..points.resolution import parse_edge_length
from .options import Choice, Flag, Integer, Option, Real

DEFAULT_VARIANCE = 0.95
MAX_BOUNCES = 10_000
MAX_PATHS = 1 << 16
MAX_POINTS = 1_000_000
TRANSPORTS = ("distant", "own", "local")
POINTS = ("vertices", "samples")
QUANTIZATIONS = ("16", "none")


class _Lattice(Option):
    """A direction lattice."""

    def check(self, value):
        """See `Option.check`."""
        return str(parse_directions(value))


class _Transports(Option):
    """`auto`, or names with commas between them."""

    def check(self, value):
        """See `Option.check`."""
        if value == "auto":
            return value
        is_text = isinstance(value, str)
        names = value.split(",") if is_text else list(value) if np.iterable(value) else []
        unknown = [name for name in names if name not in TRANSPORTS]
        if unknown or not names or len(set(names)) < len(names):
            raise SettingsError(
                f"transports '{value}' must be auto, or some of {', '.join(TRANSPORTS)}, each once"
            )
        return ",".join(name for name in TRANSPORTS if name in names)


class _EdgeLength(Option):
    """`auto` or metres, and metres of shapes by name, with commas between them."""

    def check(self, value):
        """See `Option.check`."""
        base, named = parse_edge_length(value)
        lengths = [f"{name}={length!r}" for name, length in named.items()]
        return ",".join([str(base), *lengths]) if named else base


AUTO = ("auto",)
OPTIONS = (
    _Transports(
        "transports",
        "auto",
        "What to precompute: distant (sky, sun, maps), own (the scene's lamps, exact), local (lamps"
        " that move), with commas; auto: distant and own, as the scene's emitters call for.",
        "auto|LIST",
    ),
    Choice(
        "points",
        "auto",
        "Where: vertices of tessellated surfaces, or meshless samples.",
        "auto|vertices|samples",
        among=("auto", *POINTS),
    ),
    Integer(
        "bounces",
        None,
        "Reflections of light [auto: until 0.1 % is left; with the bases haar and none: 0].",
        "B|auto",
        most=MAX_BOUNCES,
        others=(None, "auto"),
    ),
    Integer("seed", 0, "Same seed, same result.", "N", most=(1 << 31) - 1),
    Choice(
        "quantize",
        "16",
        "Numbers of 16 bits, or float32, of lamps and of light that moves.",
        "16|none",
        among=QUANTIZATIONS,
    ),
    # --- points
    _EdgeLength(
        "edge_length",
        "auto",
        "Coarse faces are tessellated down to this; auto: finely near objects, coarsely far from"
        " them; of shapes by name: 0.1,ground=5.",
        "auto|METRES|METRES,NAME=METRES",
        "vertices",
    ),
    Integer("count", 45_000, "Samples.", "N", "samples", least=1, most=MAX_POINTS),
    # --- light from afar
    _Lattice(
        "directions",
        "cubemap:32",
        "cubemap:N (6·N·N directions), latlong:WxH or halton:N.",
        "LATTICE",
        "distant",
    ),
    Choice(
        "basis",
        "pca",
        "pca, sh, haar (best wavelets of each point), haar-shared or none.",
        "KIND",
        "distant",
        among=BASES,
    ),
    Integer(
        "coefficients",
        None,
        "Components of the basis [96 (sh: 49), or the rank if lower].",
        "D|auto",
        "distant",
        others=(None, "auto"),
    ),
    Real(
        "variance",
        None,
        f"Share of the transport that --coefficients auto captures [{DEFAULT_VARIANCE}].",
        "SHARE",
        "distant",
        others=(None,),
    ),
    Integer(
        "rays_per_direction",
        1,
        "Rays in each cell; 4 antialias shadows.",
        "R",
        "distant",
        least=1,
        most=64,
    ),
    Choice(
        "indirect",
        "solve",
        "Reflections from point to point, or by unbiased path tracing.",
        "solve|paths",
        "distant",
        among=("solve", "paths"),
    ),
    Integer(
        "paths_per_point",
        "auto",
        "Rays for reflections of distant light; auto: noise of about 1 % of the transport.",
        "N|auto",
        "distant",
        least=2,
        most=MAX_PATHS,
        others=AUTO,
    ),
    Flag(
        "denoise",
        True,
        "Scale components of reflected light by the share of their variance that is signal.",
        "",
        "distant",
    ),
    Flag(
        "keep_direct",
        False,
        "Keep direct distant light apart from total light, for --component.",
        "",
        "distant",
    ),
    # --- the scene's own lamps
    Real(
        "lamp_tolerance",
        0.01,
        "Noise of direct light of lamps that shadow rays stop at, relative.",
        "SHARE",
        "own",
        least=1e-4,
        below=1,
    ),
    Integer(
        "lamp_rays",
        256,
        "Rays from each point for reflections of lamps: a multiple of 4.",
        "N",
        "own",
        least=4,
        most=MAX_PATHS,
    ),
    # --- lamps that move
    Integer(
        "cluster_size",
        1000,
        "Points in a cluster, on average.",
        "N",
        "local",
        least=1,
        most=MAX_POINTS,
    ),
    Integer(
        "depth_directions",
        2016,
        "Of each point's depth buffer: a product of two numbers that differ by half at most.",
        "N",
        "local",
        least=16,
        most=1 << 16,
    ),
    Integer(
        "depth_coefficients",
        50,
        "Components of depth buffers on a cluster.",
        "D",
        "local",
        least=1,
        most=1 << 12,
    ),
    Integer(
        "example_lights",
        1000,
        "Lights that the basis of direct light is made from.",
        "N",
        "local",
        least=1,
        most=100_000,
    ),
    Integer(
        "transfer_coefficients",
        32,
        "Components of direct light on a cluster.",
        "D",
        "local",
        least=1,
        most=1 << 10,
    ),
    Real(
        "transfer_error",
        0.02,
        "Share of indirect light that may be lost by leaving small parts of the transfer out.",
        "SHARE",
        "local",
        least=0,
        below=1,
    ),
)
BY_NAME = {option.name: option for option in OPTIONS}


class _Settings:
    """What all settings do; the fields are those of `OPTIONS`."""

    if TYPE_CHECKING:  # the fields are made from a table, which a type checker does not see

        def __getattr__(self, name) -> Any: ...

    def __post_init__(self):
        for option in OPTIONS:
            object.__setattr__(self, option.name, option.check(getattr(self, option.name)))
        if self.paths_per_point != "auto" and self.paths_per_point % 2:
            raise SettingsError(
                f"paths per point must be auto or an even number, got {self.paths_per_point}"
            )
        if self.lamp_rays % 4:
            raise SettingsError(f"lamp rays must be a multiple of 4, got {self.lamp_rays}")
        Hemisphere(self.depth_directions)
        self._check_coefficients()
        if not BASES[self.basis].holds_reflections and self.bounces not in (None, 0):
            raise SettingsError(
                f"the basis {self.basis} holds direct transport only, got bounces {self.bounces}:"
                " use bounces 0, or the basis pca, sh or haar-shared"
            )

    def _check_coefficients(self):
        if self.coefficients == "auto":
            if self.variance is None:
                object.__setattr__(self, "variance", DEFAULT_VARIANCE)
            Target(variance=self.variance)
        elif self.variance is not None:
            raise SettingsError(
                f"variance {self.variance:g} needs coefficients auto, got"
                f" {self.coefficients or 'the default'}"
            )
        BASES[self.basis].check(parse_directions(self.directions), self.coefficients)

    @property
    def distant_bounces(self):
        """Most reflections of distant light: a number or 'auto'."""
        if self.bounces is None:
            return "auto" if BASES[self.basis].holds_reflections else 0
        return self.bounces

    @property
    def lamp_bounces(self):
        """Most reflections of light of lamps: a number or 'auto'."""
        return "auto" if self.bounces is None else self.bounces

    def target(self, points):
        """What the basis of so many points is asked for, a Target."""
        if self.variance is not None:
            return Target(variance=self.variance)
        basis, directions = BASES[self.basis], parse_directions(self.directions)
        if self.coefficients is None:
            return Target(basis.default_components(directions, points))
        largest = basis.most_components(directions, points)
        if self.coefficients > largest:
            raise SettingsError(
                f"{self.coefficients} coefficients are above the rank of the transport:"
                f" {points:,} points and {len(directions):,} directions allow at most {largest}"
            )
        return Target(self.coefficients)


Settings = make_dataclass(
    "Settings",
    [(option.name, object, option.default) for option in OPTIONS],
    bases=(_Settings,),
    frozen=True,
    namespace={
        "__doc__": "What a precomputation is asked to do; stored with the asset.\n\n"
        "Parameters\n----------\n"
        + "\n".join(f"{o.name} : {o.metavar or 'bool'}\n    {o.help}" for o in OPTIONS)
        + "\n\nRaises\n------\nSettingsError\n    If a value is out of range or values contradict"
        " each other.",
        "__module__": __name__,
    },
)
