"""Depth buffers and transfer as arrays of files, in 16-bit integers with scales or in float32."""

import numpy as np
import scipy.sparse

from ..system.schema import Array
from .depth import DepthBuffers
from .quantize import Quantized, cluster_scales, quantized, quantized_by_cluster
from .transfer_matrix import Transfer

# share of entries that are not zero, below which 16-bit columns beside 16-bit values are less than
# all values
_SPARSE_BELOW = 0.5
# Memory of a matrix that a file may ask for: so many bytes, and so many times what it holds itself.
MOST_BYTES, MOST_SPARSE = 40_000_000, 50


def _shapes(name, shape, bits, scale):
    """What `_packed` gives: an array, and its scales if it has 16 bits."""
    if bits == "none":
        return {name: Array("f4", shape)}
    return {name: Array("i2", shape), f"{name}_scale": Array("f4", scale, least=0)}


DEPTH_SHAPES = {
    bits: _shapes("depth/means", ("c", "directions"), bits, ("c", 1))
    | _shapes("depth/vectors", ("c", "directions", "d"), bits, ("c", 1, "d"))
    | _shapes("depth/coefficients", ("n", "d"), bits, ("c", "d"))
    for bits in ("16", "none")
}


def transfer_shapes(bits, channels, sparse):
    """What `pack_transfer` gives, {name: Array}.

    Parameters
    ----------
    bits : '16' or 'none'
    channels : int
    sparse : bool
    """
    shapes = _shapes("transfer/encoder", ("n", "k"), bits, ("c", "k"))
    shapes |= _shapes("transfer/receivers", ("n", "q"), bits, ("c", "q"))
    shapes |= {"transfer/rows": Array("u4", ("rows",), least=0)}
    kind = "f4" if bits == "none" else "i2"
    if sparse:
        shapes |= {
            "transfer/entries": Array(kind, ("entries",)),
            "transfer/columns": Array(("u2", "u4"), ("entries",), least=0),
            "transfer/ends": Array("i8", ("rows+1",), least=0),
        }
    else:
        shapes |= {"transfer/matrix": Array(kind, ("rows", "columns"))}
    if bits == "16":
        shapes |= {"transfer/matrix_scale": Array("f4", ("rows", 1), least=0)}
    return shapes


# --- to arrays ------------------------------------------------------------------------------------


def pack_depth(depth, starts, bits):
    """Depth buffers as arrays by name.

    Parameters
    ----------
    depth : DepthBuffers
    starts : (c + 1,) int
    bits : '16' or 'none'
    """
    return (
        _packed("depth/means", depth.means, bits, 1)
        | _packed("depth/vectors", depth.vectors, bits, 1)
        | _packed_by_cluster("depth/coefficients", depth.coefficients, bits, starts)
    )


def pack_transfer(transfer, starts, bits):
    """A transfer as arrays by name: of its matrix the rows that are not zero, dense or sparse,
    whichever is less.
    """
    arrays = _packed_by_cluster("transfer/encoder", transfer.encoder, bits, starts)
    arrays |= _packed_by_cluster("transfer/receivers", transfer.receivers, bits, starts)
    c, q, k, channels = transfer.matrix.shape
    rows = transfer.matrix.reshape(c * q, k * channels)
    used = np.flatnonzero(rows.any(axis=1))
    arrays["transfer/rows"] = used.astype(np.uint32)
    kept = rows[used]
    packed = _packed("transfer/matrix", kept, bits, 1)
    if kept.size == 0 or (kept != 0).mean() >= _SPARSE_BELOW:
        return arrays | packed
    sparse = scipy.sparse.csr_array(kept)
    column = sparse.indices.astype(np.uint16 if kept.shape[1] <= 1 << 16 else np.uint32)
    values = packed.pop("transfer/matrix")
    sparse_arrays = {
        "transfer/entries": values[kept != 0],
        "transfer/columns": column,
        "transfer/ends": sparse.indptr.astype(np.int64),
    }
    return arrays | packed | sparse_arrays


def _packed(name, values, bits, axis):
    if bits == "none":
        return {name: values}
    q = quantized(values, axis)
    return {name: q.integers, f"{name}_scale": q.scale}


def _packed_by_cluster(name, values, bits, starts):
    if bits == "none":
        return {name: values}
    q = quantized_by_cluster(values, starts)
    return {name: q.integers, f"{name}_scale": cluster_scales(q, starts)}


# --- from arrays ----------------------------------------------------------------------------------


def unpack(arrays, clusters, header):
    """Depth buffers and transfer (or None) from arrays of the right shapes.

    Parameters
    ----------
    arrays : dict
    clusters : Clusters
    header : dict
        As of `LocalTransport.header`.

    Raises
    ------
    ValueError
        If they do not fit together.
    """
    starts, bits = clusters.starts, header["quantize"]
    depth = DepthBuffers(
        _unpacked(arrays, "depth/means", bits),
        _unpacked(arrays, "depth/vectors", bits),
        _unpacked(arrays, "depth/coefficients", bits, starts),
        header["extent"],
    )
    if not header["reflects"]:
        return depth, None
    encoder, receivers = (
        _unpacked(arrays, f"transfer/{name}", bits, starts) for name in ("encoder", "receivers")
    )
    c = len(starts) - 1
    shape = (c, receivers.shape[1], c * encoder.shape[1], header["channels"])
    matrix = _unpacked_matrix(arrays, bits, shape)
    return depth, Transfer(encoder, receivers, matrix)


def _unpacked(arrays, name, bits, starts=None):
    """An array as float32; `starts` where there is a scale for each cluster."""
    values = arrays[name]
    if bits == "none":
        return np.asarray(values, np.float32)
    scale = arrays[f"{name}_scale"]
    return Quantized(
        values, scale if starts is None else np.repeat(scale, np.diff(starts), axis=0)
    ).values


def _unpacked_matrix(arrays, bits, shape):
    """M (c, q, c·d, channels) float32."""
    c, q, k, channels = shape
    rows = arrays["transfer/rows"]
    if rows.size and (rows.max() >= c * q or (np.diff(rows.astype(np.int64)) <= 0).any()):
        raise ValueError("transfer/rows are not ascending rows of the matrix")
    held = sum(array.nbytes for name, array in arrays.items() if name.startswith("transfer/"))
    if 4 * c * q * k * channels > MOST_BYTES + MOST_SPARSE * held:
        raise ValueError(f"a transfer matrix of shape {shape} in {held:,} bytes")
    matrix = np.zeros((c * q, k * channels), np.float32)
    if "transfer/entries" in arrays:
        values, ends = arrays["transfer/entries"], arrays["transfer/ends"]
        columns = arrays["transfer/columns"].astype(np.int64)
        if ends[0] != 0 or ends[-1] != len(values) or (np.diff(ends) < 0).any():
            raise ValueError("transfer/ends do not divide the entries")
        if columns.size and columns.max() >= k * channels:
            raise ValueError("transfer/columns are beyond the matrix")
        if bits == "16":
            values = values * np.repeat(arrays["transfer/matrix_scale"][:, 0], np.diff(ends))
        entries = (values.astype(np.float32), columns, ends)
        matrix[rows] = scipy.sparse.csr_array(entries, (len(rows), k * channels)).toarray()
    else:
        kept = _unpacked(arrays, "transfer/matrix", bits)
        if kept.shape[1] != k * channels:
            raise ValueError(f"transfer/matrix has {kept.shape[1]} columns, not {k * channels}")
        matrix[rows] = kept
    return matrix.reshape(shape)
