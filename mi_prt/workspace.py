"""Durable intermediate results: what a killed run had computed is there for the next one.

A workspace is a folder beside the output. Nothing in it is believed without proof: rows are listed in a journal with their
checksums after they are written, arrays are renamed into place when they are whole, and the folder belongs to one process,
one scene and one choice of settings. The output itself appears only when it is complete.
"""

import fcntl
import io
import json
import os
import shutil
import tempfile
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from .errors import SettingsError
from .files import check_writable

SUFFIX = ".partial"
_RUN = "run.json"


class Workspace:
    """Arrays and rows on disk, by name. Made by `durable` or `temporary`.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder):
        self.folder = folder

    def keep(self, name, compute):
        """The array that was stored by this name, or else that of `compute()`, stored."""
        path = self.folder / f"{name}.npy"
        try:
            return np.load(path)
        except (OSError, ValueError, EOFError):
            array = compute()
        content = io.BytesIO()
        np.save(content, array)
        _write_whole(path, content.getvalue())
        return array

    def rows(self, name, count, row_bytes):
        """The `RowFile` of this name, with the rows that it holds already."""
        return RowFile(self.folder / f"{name}.rows", count, row_bytes)

    def record(self, run):
        """Note which run this workspace belongs to, a dict for JSON."""
        _write_whole(self.folder / _RUN, json.dumps(run, sort_keys=True).encode())

    def remove(self):
        """Delete the folder; from the first moment on it is no run that could be continued."""
        (self.folder / _RUN).unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)


class RowFile:
    """Rows of bytes appended to a file, and read back without holding them in memory.

    Rows count once the journal beside the file lists them; a block whose checksum does not fit was cut short, and it and
    all later ones are dropped.

    Parameters
    ----------
    path : Path
    count : int
        Rows of the whole.
    row_bytes : int
    """

    def __init__(self, path, count, row_bytes):
        self.count, self.row_bytes = count, row_bytes
        self._file = open(path, "a+b")
        self._journal = open(path.with_suffix(".journal"), "a+b")
        self.filled = self._restored()

    def _restored(self):
        """Rows that were written whole; what follows them is cut off."""
        filled = listed = 0
        self._journal.seek(0)
        for line in self._journal:
            try:
                size, checksum = (int(word) for word in line.split())
                whole = line.endswith(b"\n") and 0 < size <= self.count - filled
            except ValueError:
                break
            if not whole or zlib.crc32(self._read(filled, filled + size)) != checksum:
                break
            filled, listed = filled + size, listed + len(line)
        self._file.truncate(filled * self.row_bytes)
        self._journal.truncate(listed)
        return filled

    def append(self, block):
        """Add a block (b, row_bytes) uint8 of the next rows."""
        content = block.tobytes()
        with _writing(self._file.name):
            self._file.write(content)
            self._file.flush()
            self._journal.write(b"%d %d\n" % (len(block), zlib.crc32(content)))
            self._journal.flush()
        self.filled += len(block)

    @property
    def shape(self):
        """(count, row_bytes)."""
        return self.count, self.row_bytes

    def __getitem__(self, index):
        """Rows (b, row_bytes) uint8 of a slice or an ascending index array."""
        if isinstance(index, slice):
            first, last, _ = index.indices(self.count)
            picked = slice(None)
        else:
            index = np.asarray(index)
            first, last = (int(index[0]), int(index[-1]) + 1) if len(index) else (0, 0)
            picked = index - first
        span = np.frombuffer(self._read(first, last), np.uint8)
        return span.reshape(last - first, self.row_bytes)[picked]

    def _read(self, first, last):
        # At a place of its own in every call: threads share the file.
        return os.pread(self._file.fileno(), (last - first) * self.row_bytes, first * self.row_bytes)

    def close(self):
        """Close the files; the rows stay."""
        self._file.close()
        self._journal.close()


@contextmanager
def temporary():
    """A workspace that lasts as long as the block."""
    with tempfile.TemporaryDirectory(prefix="mi_prt-") as folder:
        yield Workspace(Path(folder))


@contextmanager
def durable(output, run, resume):
    """The workspace of an output file. It stays when the block fails or the process dies, and is deleted when the block ends.

    Parameters
    ----------
    output : path
        The workspace is this path with `.partial` behind it.
    run : dict
        What results depend on: scene, settings, versions. A workspace of another run is refused.
    resume : bool
        Whether to continue what is there; if there is nothing, the run starts.

    Raises
    ------
    SettingsError
        If there is an unfinished run and `resume` is not set, or it was another run, or another process works on it.
    """
    output = Path(output)
    check_writable(output)
    folder = output.with_name(output.name + SUFFIX)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise SettingsError(f"'{folder}', for what a run can continue from, cannot be made: {error.strerror}") from None
    with _locked(folder):
        unfinished = _recorded(folder)
        if unfinished is None:
            for leftover in folder.iterdir():
                leftover.unlink()
        elif not resume:
            raise SettingsError(f"'{folder}' holds an unfinished run: continue it with resume (--resume), or delete the folder")
        else:
            _check_same(folder, unfinished, run)
        workspace = Workspace(folder)
        workspace.record(run)
        yield workspace
        workspace.remove()


@contextmanager
def _locked(folder):
    """The kernel's own lock: it ends with the process, however that ends."""
    handle = None
    try:
        handle = os.open(folder, os.O_RDONLY)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, FileNotFoundError):
        if handle is not None:
            os.close(handle)
        raise SettingsError(f"another process is at work in '{folder}': wait for it, or choose another output") from None
    try:
        yield
    finally:
        os.close(handle)


def _recorded(folder):
    """What was recorded of the run in a folder, None if nothing was."""
    try:
        return json.loads((folder / _RUN).read_bytes())
    except (FileNotFoundError, ValueError):
        return None


def _check_same(folder, unfinished, run):
    run = json.loads(json.dumps(run))
    # What the unfinished run left open (see `precompute`) may be chosen now.
    changed = [f"{key} was {unfinished[key]}, now {run.get(key)}" for key in sorted(unfinished) if unfinished[key] != run.get(key)]
    if changed:
        raise SettingsError(
            f"the unfinished run in '{folder}' cannot be continued: {'; '.join(changed)}; restore that, or delete the folder"
        )


def _write_whole(path, content):
    """Write a file so that it is there whole or not at all."""
    temporary_path = path.with_suffix(".new")
    with _writing(path):
        with open(temporary_path, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary_path, path)


@contextmanager
def _writing(path):
    try:
        yield
    except OSError as error:
        raise SettingsError(f"'{path}' cannot be written ({error.strerror}): what was computed before is kept") from None
