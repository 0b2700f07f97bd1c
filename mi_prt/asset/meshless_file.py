"""The asset of local lights as one self-describing HDF5 file; docs/asset-format.md describes it
field by field.
"""

import json

import numpy as np
import scipy.sparse

from ..lighting.emission import Emission
from ..points.lattice import Patches
from ..points.points import POINT_FIELDS, Points
from ..points.samples import Samples
from ..transport.depth import DepthBuffers
from ..transport.transfer_matrix import Transfer
from . import container
from .quantize import Quantized, cluster_scales, quantized, quantized_by_cluster

UNITS = {
    "points/positions": "m",
    "points/areas": "m^2",
    "points/albedo": "1, linear RGB reflectance",
    "depth/means": "log m",
    "irradiance": "W/m^2",
    "outgoing radiance": "W/(m^2 sr)",
}
_TEXTS = ("scene", "settings", "versions", "report")
_STORED_POINTS = tuple(name for name in POINT_FIELDS if name != "insets")  # samples have none
_EMISSION = ("positions", "axes", "intensity", "cosine", "cutoff", "beam")
# share of entries that are not zero, below which 16-bit columns beside 16-bit values are less than
# all values
_SPARSE_BELOW = 0.5


def write(asset, path, folder=None):
    """Write a `MeshlessAsset` to one file, all or nothing; parameters and errors as of
    `asset_file.write`.
    """
    points, samples = asset.points, asset.samples
    arrays = {
        **{f"points/{name}": getattr(points, name) for name in _STORED_POINTS},
        "clusters/starts": samples.starts,
        "clusters/roots": samples.roots,
        **{f"lights/{name}": getattr(asset.own_light, name) for name in _EMISSION},
        **compressed(asset),
    }
    attributes = {("", name): getattr(asset, name) for name in _TEXTS} | {
        ("", "units"): UNITS,
        ("points", "report"): points.report,
        ("points", "surfaces"): points.surfaces,
    }
    container.write(path, "local", arrays, attributes, folder)


def compressed(asset):
    """Depth buffers and transfer as they are stored, arrays by their paths in the file."""
    bits = asset.settings["quantize"]
    starts, depth, transfer = asset.samples.starts, asset.depth, asset.transfer
    arrays = {"depth/extent": np.float64(depth.extent)}
    arrays |= _stored("depth/means", depth.means, bits, 1)
    arrays |= _stored("depth/vectors", depth.vectors, bits, 1)
    arrays |= _stored_by_cluster("depth/coefficients", depth.coefficients, bits, starts)
    if transfer is not None:
        arrays |= _stored_by_cluster("transfer/encoder", transfer.encoder, bits, starts)
        arrays |= _stored_by_cluster("transfer/receivers", transfer.receivers, bits, starts)
        arrays |= _stored_matrix(transfer.matrix, bits)
    return arrays


def as_stored(depth, transfer, starts, bits):
    """Depth buffers and transfer (or None) with the values that a file gives back.

    Returns
    -------
    depth : DepthBuffers
    transfer : Transfer or None
    """
    if bits == "none":
        return depth, transfer
    depth = DepthBuffers(
        quantized(depth.means, 1).values,
        quantized(depth.vectors, 1).values,
        quantized_by_cluster(depth.coefficients, starts).values,
        depth.extent,
    )
    if transfer is not None:
        rows = _by_row(transfer.matrix)
        transfer = Transfer(
            quantized_by_cluster(transfer.encoder, starts).values,
            quantized_by_cluster(transfer.receivers, starts).values,
            quantized(rows, 1).values.reshape(transfer.matrix.shape),
        )
    return depth, transfer


def _by_row(matrix):
    c, q, k, channels = matrix.shape
    return matrix.reshape(c * q, k * channels)


def _stored(name, values, bits, axis):
    if bits == "none":
        return {name: values}
    q = quantized(values, axis)
    return {name: q.integers, f"{name}_scale": q.scale}


def _stored_by_cluster(name, values, bits, starts):
    if bits == "none":
        return {name: values}
    q = quantized_by_cluster(values, starts)
    return {name: q.integers, f"{name}_scale": cluster_scales(q, starts)}


def _stored_matrix(matrix, bits):
    """Rows that are not zero, dense or sparse, whichever is less."""
    rows = _by_row(matrix)
    used = np.flatnonzero(rows.any(axis=1))
    arrays = {"transfer/shape": np.array(matrix.shape), "transfer/rows": used.astype(np.uint32)}
    kept = rows[used]
    stored = _stored("transfer/matrix", kept, bits, 1)
    if (kept != 0).mean() >= _SPARSE_BELOW or kept.size == 0:
        return arrays | stored
    sparse = scipy.sparse.csr_array(kept)
    column = sparse.indices.astype(np.uint16 if kept.shape[1] <= 1 << 16 else np.uint32)
    values = stored.pop("transfer/matrix")
    return (
        arrays
        | stored
        | {
            "transfer/entries": values[kept != 0],
            "transfer/columns": column,
            "transfer/ends": sparse.indptr.astype(np.int64),
        }
    )


def read(file, path):
    """Read an asset of local lights.

    Parameters
    ----------
    file : h5py.File
    path : Path
        Its own.

    Returns
    -------
    dict
        The fields of `MeshlessAsset`.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is damaged: see `container.opened`.
    """
    stored, texts = file["points"], {name: json.loads(file.attrs[name]) for name in _TEXTS}
    fields = {name: stored[name][()] for name in _STORED_POINTS}
    fields["insets"] = np.zeros_like(fields["positions"])
    points = Points(
        **fields,
        patches=Patches(np.zeros((0, 2), np.int32), *(np.zeros(0, np.int32) for _ in range(3))),
        surfaces=tuple(json.loads(stored.attrs["surfaces"])),
        report=json.loads(stored.attrs["report"]),
    )
    starts = file["clusters/starts"][()]
    samples = Samples(points, starts, file["clusters/roots"][()], points.report["radius"])
    depth = DepthBuffers(
        _restored(file, "depth/means"),
        _restored(file, "depth/vectors"),
        _restored(file, "depth/coefficients", starts),
        float(file["depth/extent"][()]),
    )
    transfer = None
    if "transfer" in file:
        encoder, receivers = (
            _restored(file, f"transfer/{name}", starts) for name in ("encoder", "receivers")
        )
        c = len(starts) - 1
        transfer = Transfer(
            encoder,
            receivers,
            _restored_matrix(file, (c, receivers.shape[1], c * encoder.shape[1])),
        )
    _check_shapes(samples, depth, transfer)
    own = Emission(**{name: file[f"lights/{name}"][()] for name in _EMISSION})
    return {
        "samples": samples,
        "depth": depth,
        "transfer": transfer,
        "own_light": own,
        "path": path.absolute(),
        **texts,
    }


def _restored(file, name, starts=None):
    """An array as float32; `starts` where there is a scale for each cluster."""
    values = file[name][()]
    if f"{name}_scale" not in file:
        if values.dtype != np.float32:
            raise ValueError(f"{name} has no scale")
        return values
    scale = file[f"{name}_scale"][()]
    return Quantized(
        values, scale if starts is None else np.repeat(scale, np.diff(starts), axis=0)
    ).values


def _restored_matrix(file, expected):
    """M, whose first three sides are as expected."""
    c, q, k, channels = file["transfer/shape"][()]
    if (c, q, k) != expected or channels not in (1, 3):
        raise ValueError(f"transfer/shape is {c, q, k, channels} where {expected} is expected")
    rows = file["transfer/rows"][()]
    if rows.size and rows.max() >= c * q:
        raise ValueError("transfer/rows are beyond the matrix")
    matrix = np.zeros((c * q, k * channels), np.float32)
    if "transfer/entries" in file:
        values, ends = file["transfer/entries"][()], file["transfer/ends"][()]
        if "transfer/matrix_scale" in file:
            values = values * np.repeat(file["transfer/matrix_scale"][()][:, 0], np.diff(ends))
        elif values.dtype != np.float32:
            raise ValueError("transfer/entries have no scale")
        columns = file["transfer/columns"][()].astype(np.int64)
        sparse = scipy.sparse.csr_array(
            (values.astype(np.float32), columns, ends), (len(rows), k * channels)
        )
        sparse.check_format(full_check=True)
        matrix[rows] = sparse.toarray()
    else:
        matrix[rows] = _restored(file, "transfer/matrix")
    return matrix.reshape(c, q, k, channels)


def _check_shapes(samples, depth, transfer):
    """Raise ValueError unless the arrays of an asset fit together."""
    n, c, d = len(samples), len(samples.roots), depth.coefficients.shape[-1]
    points = samples.points
    directions = len(depth.hemisphere)
    expected = {
        **{
            f"points/{name}": (getattr(points, name), (n, 3))
            for name in ("positions", "normals", "geometric_normals", "albedo")
        },
        "points/uv": (points.uv, (n, 2)),
        **{f"points/{name}": (getattr(points, name), (n,)) for name in ("areas", "surface")},
        "clusters/starts": (samples.starts, (c + 1,)),
        "clusters/roots": (samples.roots, (c,)),
        "depth/means": (depth.means, (c, directions)),
        "depth/vectors": (depth.vectors, (c, directions, d)),
        "depth/coefficients": (depth.coefficients, (n, d)),
    }
    if transfer is not None:
        count, rank = transfer.encoder.shape[1], transfer.receivers.shape[1]
        channels = transfer.matrix.shape[3]
        expected |= {
            "transfer/encoder": (transfer.encoder, (n, count)),
            "transfer/receivers": (transfer.receivers, (n, rank)),
            "transfer/matrix": (transfer.matrix, (c, rank, c * count, 3 if channels == 3 else 1)),
        }
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ValueError(f"{name} is of shape {array.shape} instead of {shape}")
    if samples.starts[0] != 0 or samples.starts[-1] != n or (np.diff(samples.starts) <= 0).any():
        raise ValueError("clusters/starts do not divide the points")
    if (samples.roots < 0).any() or (samples.roots >= n).any():
        raise ValueError("clusters/roots are not points")
