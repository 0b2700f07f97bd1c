"""The asset as one self-describing HDF5 file.

The file is read with NumPy and h5py alone; docs/asset-format.md describes it field by field.
"""

import json

import numpy as np
import scipy.sparse

from ..basis.bases import BASES
from ..basis.haar import row_ends
from ..directions import parse_directions
from ..points.lattice import Patches, node_count
from ..points.points import POINT_FIELDS, Points
from ..transport.direct import DirectTransport
from . import container

UNITS = {
    "points/positions": "m",
    "points/areas": "m^2",
    "points/albedo": "1, linear RGB reflectance",
    "directions/solid_angles": "sr",
    "basis/mean": "irradiance per unit radiance and steradian (1)",
    "coefficients": "sr^(1/2); of the basis none: 1",
    "irradiance": "W/m^2",
    "outgoing radiance": "W/(m^2 sr)",
}
_PATCH_FIELDS = ("levels", "offsets", "nodes", "back")
_TEXTS = ("scene", "settings", "versions", "report")


def write(asset, path, folder=None):
    """Write an `Asset` to one file, all or nothing.

    Parameters
    ----------
    asset : Asset
    path : path
    folder : path, optional
        Where the file is until it is whole, see `replacing`.

    Raises
    ------
    SettingsError
        If the path cannot be written, for example because the disk is full.
    """
    attributes = {("", name): getattr(asset, name) for name in _TEXTS} | {
        ("", "units"): UNITS,
        ("points", "report"): asset.points.report,
        ("points", "surfaces"): asset.points.surfaces,
        ("directions", "lattice"): str(asset.directions),
        ("basis", "kind"): asset.basis.kind,
    }
    container.write(path, "distant", _arrays(asset), attributes, folder)


def _arrays(asset):
    """All arrays of an asset by their paths in the file."""
    return {
        **{f"points/{name}": getattr(asset.points, name) for name in POINT_FIELDS},
        "points/buried": asset.buried,
        **{f"points/patches/{name}": getattr(asset.points.patches, name) for name in _PATCH_FIELDS},
        "directions/vectors": asset.directions.vectors,
        "directions/solid_angles": asset.directions.solid_angles,
        **{f"basis/{name}": getattr(asset.basis, name) for name in asset.basis.ARRAYS},
        **coefficient_arrays(asset.coefficients),
    }


def coefficient_arrays(coefficients):
    """How coefficients are stored: arrays by their paths in the file."""
    if isinstance(coefficients, DirectTransport):
        return {
            "coefficients/visibility": coefficients.bits[:],
            "coefficients/ray_vectors": coefficients.vectors,
        }
    if scipy.sparse.issparse(coefficients):
        n, s = coefficients.shape
        index = coefficients.indices.reshape(n, -1).astype(np.uint16 if s <= 1 << 16 else np.uint32)
        return {
            "coefficients/indices": index,
            "coefficients/values": coefficients.data.reshape(n, -1),
        }
    return {"coefficients": coefficients}


def read(file, path):
    """Read an asset of distant light.

    Parameters
    ----------
    file : h5py.File
    path : Path
        Its own.

    Returns
    -------
    dict
        The fields of `Asset`.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is damaged: see `container.opened`.
    """
    points = file["points"]
    basis = BASES[file["basis"].attrs["kind"]]
    basis = basis(**{name: file[f"basis/{name}"][()] for name in basis.ARRAYS})
    points = Points(
        **{name: points[name][()] for name in POINT_FIELDS},
        patches=Patches(**{name: points[f"patches/{name}"][()] for name in _PATCH_FIELDS}),
        surfaces=tuple(json.loads(points.attrs["surfaces"])),
        report=json.loads(points.attrs["report"]),
    )
    fields = {
        "points": points,
        "buried": file["points/buried"][()],
        "directions": parse_directions(file["directions"].attrs["lattice"]),
        "basis": basis,
        "coefficients": _read_coefficients(file, points, len(file["directions/vectors"])),
        "path": path.absolute(),
        **{name: json.loads(file.attrs[name]) for name in _TEXTS},
    }
    channels = fields["report"]["channels"]
    if channels not in (1, 3):
        raise ValueError(f"transport of {channels!r} channels")
    _check_shapes(
        channels,
        **{
            name: fields[name]
            for name in ("points", "buried", "directions", "basis", "coefficients")
        },
    )
    return fields


def _read_coefficients(file, points, directions):
    stored = file["coefficients"]
    if not hasattr(stored, "keys"):
        return stored[()]
    if "visibility" in stored:
        bits, vectors = stored["visibility"][()], stored["ray_vectors"][()]
        r, half, _ = vectors.shape
        if bits.shape != (len(points), -(-r * half // 8)):
            raise ValueError(f"coefficients/visibility is of shape {bits.shape}")
        return DirectTransport(points.normals, vectors, bits, len(points) * r * half)
    values, index = stored["values"][()], stored["indices"][()]
    if values.shape != index.shape or (index >= directions).any():
        raise ValueError("coefficients/values and indices do not fit together")
    n, k = values.shape
    return scipy.sparse.csr_array(
        (values.ravel(), index.ravel().astype(np.int32), row_ends(n, k)), (n, directions)
    )


def _check_shapes(channels, points, buried, directions, basis, coefficients):
    """Raise ValueError unless the arrays of an asset fit together."""
    n, s, d = len(points), len(directions), len(basis)
    patches = points.patches
    p = len(patches.levels)
    # whether one set of coefficients serves all channels
    joint = channels == 1 or basis.kind == "pca"
    row = (channels, s) if joint and channels > 1 else (s,)
    expected = {
        **{f"points/{name}": (getattr(points, name), (n, 3)) for name in POINT_FIELDS[:5]},
        "points/uv": (points.uv, (n, 2)),
        **{f"points/{name}": (getattr(points, name), (n,)) for name in ("areas", "surface")},
        "points/buried": (buried, (n,)),
        "points/patches/levels": (patches.levels, (p, 2)),
        "points/patches/offsets": (patches.offsets, (p,)),
        "points/patches/back": (patches.back, (p,)),
        "points/patches/nodes": (
            patches.nodes,
            (int(node_count(*patches.levels.T.astype(np.int64)).sum()),),
        ),
        "coefficients": (
            coefficients,
            (n, s if basis.kind == "haar" else d) if joint else (n, channels, d),
        ),
    }
    shapes = {
        "vectors": (d, *row),
        "mean": row,
        "sqrt_weights": (s,),
        "weights": (s,),
        "captured_variance": (d,),
    }
    expected |= {f"basis/{name}": (getattr(basis, name), shapes[name]) for name in basis.ARRAYS}
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ValueError(f"{name} is of shape {array.shape} instead of {shape}")
