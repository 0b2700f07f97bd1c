"""From a scene to an asset: points, transport, basis, coefficients."""

import time
from dataclasses import asdict, dataclass

import numpy as np

from .asset import Asset
from .basis.pca import fit_pca
from .directions import parse_directions
from .errors import SettingsError
from .points.points import sample_points
from .points.tessellate import TESSELLATED_SHAPES
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
        Called as work advances; stages are 'transport' and 'basis'.
    **settings
        Fields of `Settings`: directions, coefficients, edge_length, rays_per_direction, seed.

    Returns
    -------
    Asset
        Its `report` holds counts and captured variance; `asset.measured` is not stored, see `measure`.

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
        scene=describe_scene(scene),
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


def left_out(scene):
    """What of a scene the transport does not model, in words, one entry for each kind.

    Returns
    -------
    list of dict
        what, shapes (names), share (of the light that those materials scatter, where that can be told).
    """
    found = {}
    for surface in scene.surfaces:
        for what in surface.material.left_out:
            entry = found.setdefault((surface.material, what), {"what": what, "shapes": [], "share": None})
            entry["shapes"].append(surface.name)
            entry["share"] = round(surface.material.left_out_albedo(), 3)
    entries = list(found.values())
    for surface in scene.surfaces:
        if surface.kind not in TESSELLATED_SHAPES:
            entries.append({"what": f"{surface.kind}: casts shadows but has no points", "shapes": [surface.name], "share": None})
        if surface.shape.interior_medium() or surface.shape.exterior_medium():
            entries.append({"what": "participating medium", "shapes": [surface.name], "share": None})
    for emitter in scene.local_emitters:
        entries.append({"what": f"{emitter.class_name()}: light of a local emitter", "shapes": [emitter.id()], "share": None})
    return entries


def describe_scene(scene):
    """What an asset records of its scene, as plain data."""
    source = scene.source
    return {
        "kind": source.kind,
        "path": source.path,
        "parameters": source.parameters,
        "hash": scene.hash,
        "left_out": left_out(scene),
    }


def _check_coefficients(wanted, points, directions):
    largest = min(points - 1, directions)
    if wanted is not None and wanted > largest:
        raise SettingsError(
            f"{wanted} coefficients are above the rank of the transport: {points:,} points and {directions:,} directions "
            f"allow at most {largest}"
        )


def _compress(transport, directions, buried, settings, progress):
    """Fit the basis to the points that are not buried (they would only pull it), then encode all points."""
    n, s = transport.shape
    kept = np.flatnonzero(~buried) if not buried.all() else np.arange(n)
    wanted = DEFAULT_COEFFICIENTS if settings.coefficients is None else settings.coefficients

    def blocks():
        for chunk in np.array_split(kept, range(2048, len(kept), 2048)):
            yield transport.rows(chunk)

    basis = fit_pca(blocks, (len(kept), s), directions.solid_angles, wanted, settings.seed)
    if settings.coefficients is not None and len(basis.vectors) < settings.coefficients:
        raise SettingsError(
            f"{settings.coefficients} coefficients are above the rank of the transport: at most {len(basis.vectors)}"
        )
    coefficients = []
    for block in transport.blocks():
        coefficients.append(basis.encode(block))
        progress("basis", sum(map(len, coefficients)), n)
    return basis, np.concatenate(coefficients).astype(np.float32)


class _Clock:
    def __init__(self):
        self.seconds = {}
        self._last = time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.seconds[name] = round(now - self._last, 4)
        self._last = now
