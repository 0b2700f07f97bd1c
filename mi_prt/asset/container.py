"""The file that assets are stored in: named arrays and texts in HDF5, written all or nothing, read
with typed errors.
"""

import io
import json
import os
from contextlib import contextmanager
from pathlib import Path

from ..errors import AssetError
from ..system.files import replacing

FORMAT = "mi_prt asset"
VERSIONS = {"distant": 3, "local": 4}  # format version of each kind of transport
_OVERHEAD = 1 << 20  # bytes of a file beside its arrays: structure, and texts up to that length


def write(path, transport, arrays, attributes, folder=None):
    """Write a file, all or nothing.

    Parameters
    ----------
    path : path
    transport : str
        A kind of `VERSIONS`.
    arrays : dict of str to array
        By their paths in the file.
    attributes : dict
        Path of the group ('' for the root) and name, to a text or what JSON holds.
    folder : path, optional
        Where the file is until it is whole, see `replacing`.

    Raises
    ------
    SettingsError
        If the path cannot be written, for example because the disk is full.
    """
    import h5py

    texts = {
        key: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        for key, value in attributes.items()
    }
    size = sum(a.nbytes for a in arrays.values()) + sum(map(len, texts.values())) + _OVERHEAD
    with replacing(path, folder) as temporary, _ReservedFile(temporary, size) as stream:
        with h5py.File(stream, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["format_version"] = VERSIONS[transport]
            for name, array in arrays.items():
                file[name] = array
            for (group, name), text in texts.items():
                file.require_group(group or "/").attrs[name] = text
            file.attrs["complete"] = True


@contextmanager
def opened(path):
    """Within the block, an asset's file as h5py.File, and its kind of transport; what it lacks
    raises AssetError.

    Parameters
    ----------
    path : path

    Raises
    ------
    AssetError
        If the file is missing, truncated, no asset, or of a format version this program does not
        know.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        raise AssetError(f"asset '{path}' does not exist")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise AssetError(
                    f"'{path}' is an HDF5 file but no mi_prt asset: make one with `mi-prt"
                    " precompute`"
                )
            version = int(file.attrs["format_version"])
            if version not in VERSIONS.values():
                known = " and ".join(map(str, VERSIONS.values()))
                raise AssetError(
                    f"asset '{path}' has format version {version}, this program reads {known}:"
                    " precompute it again"
                )
            if not file.attrs.get("complete"):
                raise AssetError(f"asset '{path}' is incomplete: precompute it again")
            yield file, next(kind for kind, number in VERSIONS.items() if number == version)
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        if isinstance(error, AssetError):
            raise
        reason = " ".join(str(error).split())
        raise AssetError(f"'{path}' is truncated or no mi_prt asset ({reason})") from None


class _ReservedFile(io.FileIO):
    """An empty file whose space on the disk is taken before it is written.

    HDF5 ends the process where a disk is full in the middle of a file; this raises OSError before
    HDF5 comes into it.

    Parameters
    ----------
    path : path
    size : int
        Bytes that will not be exceeded.
    """

    def __init__(self, path, size):
        super().__init__(path, "r+b")
        self._end = 0
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self.fileno(), 0, size)
            else:
                for first in range(0, size, _OVERHEAD):
                    super().write(bytes(min(_OVERHEAD, size - first)))
                super().seek(0)
        except OSError:
            super().close()
            raise

    def seek(self, offset, whence=os.SEEK_SET):
        return (
            super().seek(offset + self._end, os.SEEK_SET)
            if whence == os.SEEK_END
            else super().seek(offset, whence)
        )

    def write(self, content):
        left = memoryview(content).cast("B")
        while len(left):  # the system may take less than it is given
            left = left[super().write(left) :]
        self._end = max(self._end, self.tell())
        return len(content)

    def truncate(self, size=None):
        self._end = self.tell() if size is None else size
        return self._end

    def close(self):
        if not self.closed:
            super().truncate(self._end)
        super().close()
