"""From a scene to an asset: points, transport, basis, coefficients."""

import time
from dataclasses import asdict, dataclass

import numpy as np

from .asset import Asset
from .basis.pca import BLOCK_ROWS, fit_pca
from .directions import parse_directions
from .errors import SettingsError
from .parallel import map_chunks
from .points.points import sample_points
from .provenance import describe_scene
from .runtime import count_kernels, peak_memory_bytes, versions
from .scene.scene import open_scene
from .transport.direct import find_buried, sample_direct

DEFAULT_COEFFICIENTS = 48
MAX_RAYS_PER_DIRECTION = 64


@dataclass(frozen=True)
class Settings:
    """What a precomputation is asked to do; stored with the asset.

    Parameters
    ----------
    directions : str
        Direction lattice, ``cubemap:N``.
    coefficients : int or None
        Components of the basis. None takes 48, or the rank of the transport where that is lower; an explicit number
        above the rank is refused.
    edge_length : 'auto' or float
        Metres to which coarse faces and analytic shapes are tessellated.
    rays_per_direction : int
        Rays in each cell of the lattice, 1…64.
    seed : int

    Raises
    ------
    SettingsError
        If a value is out of range.
    """

    directions: str = "cubemap:32"
    coefficients: int | None = None
    edge_length: str | float = "auto"
    rays_per_direction: int = 1
    seed: int = 0

    def __post_init__(self):
        object.__setattr__(self, "directions", str(parse_directions(self.directions)))
        for name in ("coefficients", "rays_per_direction", "seed"):
            value = getattr(self, name)
            if isinstance(value, bool) or not (isinstance(value, int | np.integer) or (name == "coefficients" and value is None)):
                raise SettingsError(f"{name} must be an integer, got {value!r}")
        if self.coefficients is not None and self.coefficients < 0:
            raise SettingsError(f"coefficients must be ≥ 0, got {self.coefficients}")
        if not 1 <= self.rays_per_direction <= MAX_RAYS_PER_DIRECTION:
            raise SettingsError(f"rays per direction must be 1…{MAX_RAYS_PER_DIRECTION}, got {self.rays_per_direction}")
        if self.seed < 0:
            raise SettingsError(f"seed must be ≥ 0, got {self.seed}")


def precompute(scene, parameters=None, progress=None, **settings):
    """Precompute a scene's transport.

    Parameters
    ----------
    scene : path, dict or mi.Scene
    parameters : dict, optional
        Values for an XML file's `<default>` parameters.
    progress : callable(stage, done, total), optional
        Called as work advances; stages are 'transport', 'basis' and 'coefficients'.
    **settings
        Fields of `Settings`: directions, coefficients, edge_length, rays_per_direction, seed.

    Returns
    -------
    Asset
        Its `report` holds counts and the captured variance.

    Raises
    ------
    SceneError, SettingsError
        See `open_scene`, `sample_points`, `Settings`.
    """
    return measure(scene, parameters, progress, **settings)[0]


def measure(scene, parameters=None, progress=None, **settings):
    """`precompute`, and what it cost.

    Returns
    -------
    asset : Asset
    cost : dict
        rays, kernels (compiled), peak_memory_bytes, seconds{scene, points, transport, basis}.
    """
    settings = Settings(**settings)
    progress = progress or (lambda stage, done, total: None)
    clock = _Clock()
    with count_kernels() as kernels:
        scene = open_scene(scene, parameters)
        description = describe_scene(scene)
        clock.lap("scene")
        points = sample_points(scene, settings.edge_length)
        directions = parse_directions(settings.directions)
        _check_coefficients(settings.coefficients, len(points), len(directions))
        clock.lap("points")
        transport = sample_direct(
            scene, points, directions, settings.rays_per_direction, lambda *done: progress("transport", *done)
        )
        dark = ~transport.bits.any(axis=1)
        buried = find_buried(scene, points, dark)
        clock.lap("transport")
        basis, coefficients = _compress(transport, directions, buried, settings, progress)
        clock.lap("basis")
    report = {
        "rays": transport.rays,
        "dark_points": int(dark.sum()),
        "buried_points": int(buried.sum()),
        "captured_variance": float(basis.captured_variance.sum()),
    }
    asset = Asset(
        points,
        buried,
        directions,
        basis,
        coefficients,
        scene=description,
        settings=asdict(settings) | {"coefficients": len(basis.vectors), "edge_length": points.report["edge_length"]},
        versions=versions(),
        report=report,
    )
    cost = {
        "rays": transport.rays,
        "kernels": kernels.compiled,
        "peak_memory_bytes": peak_memory_bytes(),
        "seconds": clock.seconds,
    }
    return asset, cost


def _check_coefficients(wanted, points, directions):
    largest = min(points - 1, directions)
    if wanted is not None and wanted > largest:
        raise SettingsError(
            f"{wanted} coefficients are above the rank of the transport: {points:,} points and {directions:,} directions "
            f"allow at most {largest}"
        )


def _compress(transport, directions, buried, settings, progress):
    """Fit the basis to the points that are not buried (they would only pull it), then encode all points."""
    n = len(transport.bits)
    kept = np.flatnonzero(~buried) if not buried.all() else np.arange(n)
    wanted = DEFAULT_COEFFICIENTS if settings.coefficients is None else settings.coefficients
    basis = fit_pca(
        transport.rows, kept, directions.solid_angles, wanted, settings.seed, lambda *done: progress("basis", *done)
    )
    if settings.coefficients is not None and len(basis.vectors) < settings.coefficients:
        raise SettingsError(
            f"{settings.coefficients} coefficients are above the rank of the transport: at most {len(basis.vectors)}"
        )
    coefficients = np.empty((n, len(basis.vectors)), np.float32)

    def encode(first):
        block = slice(first, first + BLOCK_ROWS)
        coefficients[block] = basis.encode(transport.rows(block))
        return min(first + BLOCK_ROWS, n)

    for done in map_chunks(encode, range(0, n, BLOCK_ROWS)):
        progress("coefficients", done, n)
    return basis, coefficients


class _Clock:
    def __init__(self):
        self.seconds = {}
        self._last = time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.seconds[name] = round(now - self._last, 4)
        self._last = now
