"""The container of an asset: named arrays and a JSON header in one file of the safetensors format.

Layout: 8 bytes, little endian, for the length of the header; the header, JSON; the arrays, one
behind the other, little endian, rows first. The header gives each array's dtype, shape and place,
and under `__metadata__` the format, its version, and the asset's own header as one JSON text.

The safetensors library opens these files. It is not used here: it takes repeated keys and unknown
fields, waits for ever on a fifo, and takes 1 GB and 16 s for a hostile header of 95 MB.
"""

import math
import mmap
import os
import re
import stat
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import AssetError, SettingsError
from ..system import plain_json
from ..system.files import reason_of, replacing
from ..system.schema import is_finite

FORMAT = "mi_prt asset"
FORMAT_VERSION = 6
ALIGNMENT = 64  # bytes: where the first array begins
MAX_HEADER = 4 << 20  # bytes: what a hostile one can make of it in memory stays below 150 MB
BLOCK = 8 << 20  # bytes of an array that are written or checked at once
MAX_RANK = 8
_HDF5 = b"\x89HDF\r\n\x1a\n"
_METADATA = {"format", "format_version", "mi_prt"}
_KINDS = {
    stat.S_ISDIR: "a folder",
    stat.S_ISFIFO: "a fifo",
    stat.S_ISSOCK: "a socket",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
}
DTYPES = {
    "BOOL": "?",
    "U8": "u1",
    "I8": "i1",
    "U16": "<u2",
    "I16": "<i2",
    "F16": "<f2",
    "U32": "<u4",
    "I32": "<i4",
    "F32": "<f4",
    "U64": "<u8",
    "I64": "<i8",
    "F64": "<f8",
}
_NAMES = {np.dtype(code): name for name, code in DTYPES.items()}


# --- writing --------------------------------------------------------------------------------------


def write(path, header, arrays, folder=None):
    """Write a file, all or nothing. The same input gives the same bytes.

    Parameters
    ----------
    path : path
    header : dict
        What JSON holds.
    arrays : dict of str to array
        By name. An array is a NumPy array or has `shape`, `dtype`, and blocks of rows by slicing,
        which are taken one after the other.
    folder : path, optional
        Where the file is until it is whole, see `replacing`.

    Raises
    ------
    SettingsError
        If the path cannot be written, for example because the disk is full, or the header exceeds
        `MAX_HEADER`.
    AssetError
        If an array holds NaN or infinity.
    """
    arrays = {name: a if hasattr(a, "dtype") else np.asarray(a) for name, a in arrays.items()}
    order = sorted(arrays, key=lambda name: (-_dtype(arrays[name]).itemsize, name))
    head = _head(path, header, {name: arrays[name] for name in order})
    with replacing(path, folder) as temporary, open(temporary, "wb") as file:
        file.write(head)
        for name in order:
            for block in _blocks(arrays[name], name):
                if not is_finite(block):
                    raise AssetError(f"'{path}' is not written: {name} holds NaN or infinity")
                file.write(block.reshape(-1).view("u1").data)


def _dtype(array):
    """Dtype of an array in the file."""
    return np.dtype(array.dtype).newbyteorder("<")


def _head(path, header, arrays):
    """Length and header in bytes, filled up with blanks."""
    end = 0
    table: dict[str, dict] = {
        "__metadata__": {
            "format": FORMAT,
            "format_version": str(FORMAT_VERSION),
            "mi_prt": plain_json.dumps(header),
        }
    }
    for name, array in arrays.items():
        start, dtype = end, _dtype(array)
        if name == "__metadata__" or dtype not in _NAMES:
            raise ValueError(f"array {name!r} of {dtype} has no place in an asset")
        shape = [int(length) for length in array.shape]
        end += math.prod(shape) * dtype.itemsize
        table[name] = {"dtype": _NAMES[dtype], "shape": shape, "data_offsets": [start, end]}
    text = plain_json.dumps(table).encode()
    text += b" " * (-(8 + len(text)) % ALIGNMENT)
    if len(text) > MAX_HEADER:
        raise SettingsError(
            f"'{path}' cannot be written: its header has {len(text):,} bytes, the limit is"
            f" {MAX_HEADER:,}: give the scene fewer shapes or parameters"
        )
    return len(text).to_bytes(8, "little") + text


def _blocks(array, name):
    """The array in contiguous blocks as they are in the file."""
    dtype, shape = _dtype(array), tuple(array.shape)
    if not shape:
        yield np.ascontiguousarray(array, dtype)
        return
    rows = max(1, BLOCK // max(1, math.prod(shape[1:]) * dtype.itemsize))
    for first in range(0, shape[0], rows):
        block = np.ascontiguousarray(array[first : first + rows], dtype)
        if block.shape != (min(rows, shape[0] - first), *shape[1:]):
            raise ValueError(f"rows of {name} are of shape {block.shape}, not {shape}")
        yield block


# --- reading --------------------------------------------------------------------------------------


def is_asset(path):
    """Whether a file looks like an asset of any version; False if it cannot be read."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            return False
        with open(path, "rb") as file:
            start = file.read(9)
    except (OSError, ValueError):
        return False
    return start[8:] == b"{" or start.startswith(_HDF5)


def is_own(path):
    """Whether a file is an asset of any version, and no safetensors file of another program."""
    if not is_asset(path):
        return False
    with open(path, "rb") as file:
        start = file.read(1 << 12)
    return start.startswith(_HDF5) or f'"{FORMAT}"'.encode() in start


@contextmanager
def opened(path):
    """Within the block, the file at `path` as `Stored`; arrays taken from it stay usable after it.

    The header is checked, no array is touched. Any ValueError of the block, such as one of
    `schema.check`, becomes an AssetError that names the file.

    Raises
    ------
    AssetError
        If it is missing, no regular file, truncated, no asset, or of another format version.
    """
    path = Path(path)
    try:
        try:
            stored = Stored(path, *_mapped(path))
        except OSError as error:
            raise AssetError(f"asset '{path}' cannot be read: {reason_of(error)}") from None
        yield stored
    except ValueError as error:
        if isinstance(error, AssetError):
            raise
        reason = " ".join(str(error).split())
        raise AssetError(
            f"'{path}' is damaged or no mi_prt asset ({reason}): precompute it again"
        ) from None


class Stored:
    """An open file: its header, and its arrays once they have been checked.

    Attributes
    ----------
    header : dict
        As `write` got it. Its parts are for the reader to check (`mi_prt.system.schema.check`).
    names : tuple of str
        Arrays, sorted.
    """

    def __init__(self, path, text, data):
        """From the header's text in bytes, and the bytes of all arrays."""
        table = plain_json.loads(text)
        if not isinstance(table, dict):
            raise ValueError("the header is no object")
        self.header = _own_header(path, table.pop("__metadata__", None))
        self._places = {name: _place(name, entry, len(data)) for name, entry in table.items()}
        self.names = tuple(sorted(self._places))
        self._data, self._schema, self._sizes = data, {}, {}
        end = 0
        for start, stop, name in sorted((*p[2], name) for name, p in self._places.items()):
            if start != end:
                raise ValueError(f"array {name!a} begins at byte {start} instead of {end}")
            end = stop
        if end != len(data):
            raise ValueError(f"arrays of {end:,} bytes in a file that holds {len(data):,}")

    def dtype(self, name):
        return self._places[name][0]

    def shape(self, name):
        return self._places[name][1]

    def check(self, schema, sizes=None):
        """Check names, dtypes and shapes of all arrays; reads none of them.

        Parameters
        ----------
        schema : dict of str to Array
        sizes : dict of str to int, optional
            Numbers that are known, by the names that shapes and ranges use.

        Returns
        -------
        dict
            `sizes`, and all that the shapes tell.

        Raises
        ------
        ValueError
            Within `opened` it becomes AssetError.
        """
        for name in self.names:
            if name not in schema:
                raise ValueError(f"unknown array {ascii(name)[:80]}")
        sizes = dict(sizes or {})
        for name, array in schema.items():
            if name in self._places:
                array.check_form(name, self.dtype(name), self.shape(name), sizes)
            elif not array.optional:
                raise ValueError(f"array {name} is missing")
        for name in self.names:
            schema[name].limits(name, sizes)
        self._schema, self._sizes = dict(schema), sizes
        return dict(sizes)

    def array(self, name, copy=False):
        """An array that `check` has passed, after its values have been checked in blocks.

        Parameters
        ----------
        name : str
        copy : bool
            Whether it is in memory and may be written to, or a read-only view of the file.

        Raises
        ------
        ValueError
            If a value is not finite or out of range. Within `opened` it becomes AssetError.
        """
        dtype, shape, (start, _) = self._places[name]
        array = np.frombuffer(self._data.buffer, dtype, math.prod(shape), self._data.first + start)
        if copy:
            array = array.copy()
        step = BLOCK // dtype.itemsize
        for first in range(0, len(array), step):
            self._schema[name].check_values(name, array[first : first + step], self._sizes)
        return array.reshape(shape)


@dataclass(frozen=True)
class _Data:
    """The bytes of all arrays: those of `buffer` from `first` on."""

    buffer: mmap.mmap
    first: int

    def __len__(self):
        return len(self.buffer) - self.first


def _mapped(path):
    """Text of the header (bytes), and the arrays' bytes as _Data."""
    try:
        _check_regular(path, os.stat(path))
    except (FileNotFoundError, NotADirectoryError):
        raise AssetError(f"asset '{path}' does not exist") from None
    # The flag: if a fifo has taken the file's place since.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with open(os.open(path, flags), "rb", buffering=0) as file:
        size = _check_regular(path, os.fstat(file.fileno())).st_size
        start = file.read(8)
        if start == _HDF5:
            raise AssetError(
                f"asset '{path}' was made by an older version of mi_prt: precompute it again"
            )
        length = int.from_bytes(start, "little")
        if len(start) < 8 or length > size - 8:
            raise ValueError(f"it has {size:,} bytes and is truncated" if size else "it is empty")
        if length > MAX_HEADER:
            raise ValueError(f"a header of {length:,} bytes, the limit is {MAX_HEADER:,}")
        text = file.read(length)
        if len(text) < length or not text.startswith(b"{"):
            raise ValueError("it has no header")
        return text, _Data(mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ), 8 + length)


def _check_regular(path, status):
    if not stat.S_ISREG(status.st_mode):
        what = next((what for test, what in _KINDS.items() if test(status.st_mode)), "no file")
        raise AssetError(f"asset '{path}' is {what}: give a file made by `mi-prt precompute`")
    return status


def _own_header(path, metadata):
    """The asset's header, of the metadata of the file."""
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise ValueError("it is another safetensors file")
    version = metadata.get("format_version")
    if not isinstance(version, str) or not re.fullmatch("[1-9][0-9]{0,8}", version):
        raise ValueError("it has no format version")
    if int(version) != FORMAT_VERSION:
        older = int(version) < FORMAT_VERSION
        raise AssetError(
            f"asset '{path}' was made by {'an older' if older else 'a newer'} version of mi_prt"
            f" (format version {version}, this program reads {FORMAT_VERSION}):"
            f" {'precompute it again' if older else 'update mi_prt'}"
        )
    header = metadata.get("mi_prt")
    if metadata.keys() != _METADATA or not isinstance(header, str):
        raise ValueError("its metadata are not those of an asset")
    header = plain_json.loads(header)
    if not isinstance(header, dict):
        raise ValueError("its header is no object")
    return header


def _place(name, entry, held):
    """dtype, shape and (start, stop) of one array, of its entry in the header."""
    where = f"array {ascii(name)[:80]}"
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise ValueError(f"{where} has no dtype, shape and place")
    code, shape, place = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(code, str) or code not in DTYPES:
        raise ValueError(f"{where} is of dtype {ascii(code)[:20]}")
    if not _are_counts(shape, held) or len(shape) > MAX_RANK:
        raise ValueError(f"{where} has no shape that the file can hold")
    if not _are_counts(place, held) or len(place) != 2:
        raise ValueError(f"{where} lies outside of the file")
    dtype, (start, stop) = np.dtype(DTYPES[code]), place
    if stop - start != math.prod(shape) * dtype.itemsize or start % dtype.itemsize:
        raise ValueError(f"{where} of shape {shape} does not fit bytes {start} to {stop}")
    return dtype, tuple(shape), (start, stop)


def _are_counts(values, most):
    return isinstance(values, list) and all(type(v) is int and 0 <= v <= most for v in values)
