"""The asset: everything that relighting needs, in one self-describing HDF5 file.

The file is read with NumPy and h5py alone; docs/asset-format.md describes it field by field.
"""

import io
import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from .basis.pca import PCA
from .directions import parse_directions
from .errors import AssetError
from .files import replacing
from .lighting.cells import cell_radiance
from .lighting.lattice import on_lattice
from .parallel import one_blas_thread
from .points.lattice import Patches, node_count
from .points.points import POINT_FIELDS, Points

FORMAT = "mi_prt asset"
FORMAT_VERSION = 1
UNITS = {
    "points/positions": "m",
    "points/areas": "m^2",
    "points/albedo": "1, linear RGB reflectance",
    "directions/solid_angles": "sr",
    "basis/mean": "irradiance per unit radiance and steradian (1)",
    "coefficients": "sr^(1/2)",
    "irradiance": "W/m^2",
    "outgoing radiance": "W/(m^2 sr)",
}
_PATCH_FIELDS = ("levels", "offsets", "nodes", "back")
_BASIS_FIELDS = ("vectors", "mean", "sqrt_weights", "captured_variance")


@dataclass(frozen=True, eq=False)
class Asset:
    """A scene's precomputed transport.

    Parameters
    ----------
    points : Points
    buried : (n,) bool
        Points inside or against other geometry; rendering takes their neighbours' light instead.
    directions : Cubemap
    basis : PCA
    coefficients : (n, d) float32
    scene : dict
        kind, path, parameters, hash and left_out (what of the scene is not modelled).
    settings : dict
        What the run used.
    versions : dict
    report : dict
        Counts from sampling: rays, dark and buried points, irregular geometry.
    path : Path or None
        The file it was loaded from or saved to.
    """

    points: Points
    buried: np.ndarray
    directions: object
    basis: PCA
    coefficients: np.ndarray
    scene: dict
    settings: dict
    versions: dict
    report: dict
    path: Path | None = field(default=None, compare=False)

    # --- relighting ----------------------------------------------------------------------------------------------

    def project_light(self, light):
        """Distant light in this asset's basis.

        Parameters
        ----------
        light : EnvironmentMap, DistantLight, DirectionalLight, path, array (h, w, 3), or mi.Bitmap

        Returns
        -------
        coefficients : (d, 3) float32
        mean_response : (3,) float32
        """
        with one_blas_thread():
            return self.basis.project_light(cell_radiance(light, self.directions))

    def prepare_light(self, light):
        """The same light kept on a fine lattice, so that turning and projecting it takes milliseconds.

        >>> sky = asset.prepare_light("sky.exr")
        >>> for degrees in range(360):
        ...     asset.relight(sky.rotated("y", degrees))
        """
        return on_lattice(light, self.directions)

    def irradiance(self, light):
        """Irradiance at the points under distant light, (n, 3) float32 in W/m². See `project_light` for `light`."""
        return self.irradiance_from(*self.project_light(light))

    def irradiance_from(self, coefficients, mean_response):
        """Irradiance (n, 3) from light that is projected already: c·ℓ + m (Eigentransport eq. 10, mean kept exactly).

        What compression leaves below zero is zero.
        """
        with one_blas_thread():
            irradiance = self.coefficients @ coefficients
        irradiance += mean_response
        return np.maximum(irradiance, 0, out=irradiance)

    def relight(self, light):
        """Outgoing radiance B = ρ/π · E at the points, (n, 3) float32 in W/(m²·sr). See `project_light` for `light`."""
        return self.outgoing_radiance(self.irradiance(light))

    def outgoing_radiance(self, irradiance):
        """Outgoing radiance B = ρ/π · E (n, 3) of irradiance (n, 3) at the points."""
        return irradiance * self._reflection

    @cached_property
    def _reflection(self):
        return self.points.albedo * np.float32(1 / np.pi)

    def transport(self, rows):
        """Transport (len(rows), s) float32 as the basis reconstructs it; `rows` indexes points."""
        return self.basis.reconstruct(self.coefficients[rows])

    # --- file ----------------------------------------------------------------------------------------------------

    def save(self, path):
        """Write the asset to one file, all or nothing.

        Raises
        ------
        SettingsError
            If the path cannot be written.
        """
        path = Path(path)
        # HDF5 crashes where a disk is full; plain bytes raise.
        content = io.BytesIO()
        self._write(content)
        with replacing(path) as temporary:
            Path(temporary).write_bytes(content.getbuffer())
        object.__setattr__(self, "path", path.absolute())

    def _write(self, stream):
        import h5py

        with h5py.File(stream, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["format_version"] = FORMAT_VERSION
            for name in ("scene", "settings", "versions", "report"):
                file.attrs[name] = json.dumps(getattr(self, name), sort_keys=True)
            file.attrs["units"] = json.dumps(UNITS, sort_keys=True)
            for name in POINT_FIELDS:
                file[f"points/{name}"] = getattr(self.points, name)
            file["points/buried"] = self.buried
            file["points"].attrs["report"] = json.dumps(self.points.report, sort_keys=True)
            file["points"].attrs["surfaces"] = json.dumps(self.points.surfaces, sort_keys=True)
            for name in _PATCH_FIELDS:
                file[f"points/patches/{name}"] = getattr(self.points.patches, name)
            file["directions/vectors"] = self.directions.vectors
            file["directions/solid_angles"] = self.directions.solid_angles
            file["directions"].attrs["lattice"] = str(self.directions)
            for name in _BASIS_FIELDS:
                file[f"basis/{name}"] = getattr(self.basis, name)
            file["basis"].attrs["kind"] = "pca"
            file["coefficients"] = self.coefficients
            file.attrs["complete"] = True


def load(path):
    """Open an asset.

    Parameters
    ----------
    path : path

    Returns
    -------
    Asset

    Raises
    ------
    AssetError
        If the file is missing, truncated, no asset, or of a format version this program does not know.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        raise AssetError(f"asset '{path}' does not exist")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise AssetError(f"'{path}' is an HDF5 file but no mi_prt asset: make one with `mi-prt precompute`")
            version = int(file.attrs["format_version"])
            if version != FORMAT_VERSION:
                raise AssetError(
                    f"asset '{path}' has format version {version}, this program reads {FORMAT_VERSION}: precompute it again"
                )
            if not file.attrs.get("complete"):
                raise AssetError(f"asset '{path}' is incomplete: precompute it again")
            return _read(file, path)
    except (OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, AssetError):
            raise
        reason = " ".join(str(error).split())
        raise AssetError(f"'{path}' is truncated or no mi_prt asset ({reason})") from None


def _read(file, path):
    texts = {name: json.loads(file.attrs[name]) for name in ("scene", "settings", "versions", "report")}
    points = file["points"]
    asset = Asset(
        points=Points(
            **{name: points[name][()] for name in POINT_FIELDS},
            patches=Patches(**{name: points[f"patches/{name}"][()] for name in _PATCH_FIELDS}),
            surfaces=tuple(json.loads(points.attrs["surfaces"])),
            report=json.loads(points.attrs["report"]),
        ),
        buried=points["buried"][()],
        directions=parse_directions(file["directions"].attrs["lattice"]),
        basis=PCA(**{name: file[f"basis/{name}"][()] for name in _BASIS_FIELDS}),
        coefficients=file["coefficients"][()],
        path=path.absolute(),
        **texts,
    )
    _check_shapes(asset)
    return asset


def _check_shapes(asset):
    """Raise ValueError unless the arrays of an asset fit together."""
    n, s, d = len(asset.points), len(asset.directions), len(asset.basis.vectors)
    patches = asset.points.patches
    p = len(patches.levels)
    expected = {
        **{f"points/{name}": (getattr(asset.points, name), (n, 3)) for name in POINT_FIELDS[:5]},
        "points/uv": (asset.points.uv, (n, 2)),
        **{f"points/{name}": (getattr(asset.points, name), (n,)) for name in ("areas", "surface")},
        "points/buried": (asset.buried, (n,)),
        "points/patches/levels": (patches.levels, (p, 2)),
        "points/patches/offsets": (patches.offsets, (p,)),
        "points/patches/back": (patches.back, (p,)),
        "points/patches/nodes": (patches.nodes, (int(node_count(*patches.levels.T.astype(np.int64)).sum()),)),
        "basis/vectors": (asset.basis.vectors, (d, s)),
        "basis/mean": (asset.basis.mean, (s,)),
        "basis/sqrt_weights": (asset.basis.sqrt_weights, (s,)),
        "basis/captured_variance": (asset.basis.captured_variance, (d,)),
        "coefficients": (asset.coefficients, (n, d)),
    }
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ValueError(f"{name} is of shape {array.shape} instead of {shape}")
