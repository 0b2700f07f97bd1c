"""Durable intermediate results: what a killed run had computed is there for the next one.

A workspace is a folder beside the output. Nothing in it is believed without proof: rows are listed
in a journal with their checksums after they are written, arrays carry theirs and are renamed into
place when they are whole, and the folder belongs to one process, one scene and one choice of
settings. The output itself appears only when it is complete.
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

from ..errors import SettingsError
from ..system.files import check_writable

SUFFIX = ".partial"
_RUN = "run.json"
_OURS = (".rows", ".journal", ".array", ".new", ".part")
_CHECKSUM_BYTES = 4


class Workspace:
    """Arrays and rows on disk, by name. Made by `durable` or `temporary`.

    Parameters
    ----------
    folder : Path
    lasting : bool
        Whether it stays when the run fails.
    """

    def __init__(self, folder, lasting):
        self.folder, self.lasting = folder, lasting

    def keep(self, name, compute):
        """The array that was stored by this name, or else that of `compute()`, stored."""
        path = self.folder / f"{name}.array"
        array = _stored(path)
        if array is None:
            array = compute()
            content = io.BytesIO()
            np.save(content, array)
            _write_whole(path, content.getvalue() + _checksum(content.getvalue()))
        return array

    def rows(self, name, count, row_bytes):
        """The `RowFile` of this name, with the rows that it holds already."""
        return RowFile(self.folder / f"{name}.rows", count, row_bytes)

    def record(self, run):
        """Note which run this workspace belongs to, a dict for JSON."""
        _write_whole(self.folder / _RUN, json.dumps(run, sort_keys=True).encode())

    def forget_arrays(self):
        """Delete all arrays; the rows stay."""
        for path in self.folder.glob("*.array"):
            path.unlink()

    def remove(self):
        """Delete the folder; from the first moment on it is no run that could be continued."""
        (self.folder / _RUN).unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)


class RowFile:
    """Rows of bytes appended to a file, and read back without holding them in memory.

    Rows count once the journal beside the file lists them; a block whose checksum does not fit was
    cut short, and it and all later ones are dropped.

    Parameters
    ----------
    path : Path
    count : int
        Rows of the whole.
    row_bytes : int
    """

    def __init__(self, path, count, row_bytes):
        self.count, self.row_bytes = count, row_bytes
        with _typed(path):
            # both stay open as long as this object: `close` closes them
            self._file = path.open("a+b", buffering=0)
            self._journal = path.with_suffix(".journal").open("a+b", buffering=0)
            self.filled = self._restored()

    def _restored(self):
        """Rows that were written whole; what follows them is cut off."""
        filled = listed = 0
        self._journal.seek(0)
        for line in self._journal.read().splitlines(keepends=True):
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
        with _typed(self._file.name):
            _write_all(self._file, content)
            _write_all(self._journal, b"%d %d\n" % (len(block), zlib.crc32(content)))
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
        """Bytes of rows first…last, or fewer where the file ends."""
        start, wanted = first * self.row_bytes, (last - first) * self.row_bytes
        parts = []
        while wanted > 0:
            # At a place of its own in every call: threads share the file. The system may give less
            # than it is asked for.
            part = os.pread(self._file.fileno(), wanted, start)
            if not part:
                break
            parts.append(part)
            start, wanted = start + len(part), wanted - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def close(self):
        """Close the files; the rows stay."""
        self._file.close()
        self._journal.close()


@contextmanager
def temporary():
    """A workspace that lasts as long as the block."""
    with tempfile.TemporaryDirectory(prefix="mi_prt-") as folder:
        yield Workspace(Path(folder), lasting=False)


@contextmanager
def durable(output, run, resume, open_keys=()):
    """The workspace of an output file. It stays when the block fails or the process dies, and is
    deleted when the block ends.

    Parameters
    ----------
    output : path
        The workspace is this path with `.partial` behind it.
    run : dict
        What results depend on: scene, settings, versions. A workspace of another run is refused.
    resume : bool
        Whether to continue what is there; if there is nothing, the run starts.
    open_keys : sequence of str
        Keys of `run` that an unfinished run may have left open (see `Workspace.record`): they may
        be chosen anew.

    Raises
    ------
    SettingsError
        If there is an unfinished run and `resume` is not set, or it was another run, or another
        process works on it; or if the folder holds anything that is not ours.
    """
    output = Path(output)
    check_writable(output)
    folder = output.with_name(output.name + SUFFIX)
    with _typed(folder):
        lock = _lock(folder)
    try:
        workspace = Workspace(folder, lasting=True)
        with _typed(folder):
            _begin(workspace, run, resume, open_keys)
        yield workspace
        workspace.remove()
    finally:
        os.close(lock)


def _lock(folder):
    """The kernel's own lock on a folder, made if need be, as a file handle: it ends with the
    process, however that ends.
    """
    while True:
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():
            raise SettingsError(
                f"'{folder}', for what a run can continue from, is a link: delete it"
            )
        try:
            handle = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:  # another process ended and removed it just now
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise SettingsError(
                f"another process is at work in '{folder}': wait for it, or choose another output"
            ) from None
        if folder.exists() and os.path.samestat(os.fstat(handle), os.stat(folder)):
            return handle
        # of a folder that another process has removed: what has that name by now is another one
        os.close(handle)


def _begin(workspace, run, resume, open_keys):
    """Find what is there to continue, and record the run."""
    unfinished = _recorded(workspace.folder)
    if unfinished is None:
        for leftover in workspace.folder.iterdir():
            leftover.unlink()
    elif not resume:
        raise SettingsError(
            f"'{workspace.folder}' holds an unfinished run: continue it with resume (--resume), or"
            " delete the folder"
        )
    else:
        _check_same(workspace.folder, unfinished, run, open_keys)
    workspace.record(run)


def _recorded(folder):
    """What was recorded of the run in a folder, None if it holds no run."""
    names = [path.name for path in folder.iterdir()]
    foreign = [name for name in names if name != _RUN and not name.endswith(_OURS)]
    if foreign:
        raise SettingsError(
            f"'{folder}', for what a run can continue from, holds other files ('{foreign[0]}'):"
            " move them away"
        )
    if _RUN not in names:
        return None
    try:
        run = json.loads((folder / _RUN).read_bytes())
        if isinstance(run, dict):
            return run
    except ValueError:
        pass
    raise SettingsError(
        f"'{folder / _RUN}' is damaged, so what it belongs to cannot be told: delete the folder to"
        " start anew"
    )


def _check_same(folder, unfinished, run, open_keys):
    run = json.loads(json.dumps(run))
    left_open = set(open_keys) - set(unfinished)
    changed = [
        f"{key} was {unfinished.get(key, 'not recorded')}, now {run.get(key, 'not set')}"
        for key in sorted((set(unfinished) | set(run)) - left_open)
        if key not in unfinished or unfinished[key] != run.get(key)
    ]
    if changed:
        raise SettingsError(
            f"the unfinished run in '{folder}' cannot be continued: {'; '.join(changed)}; restore"
            " that, or delete the folder"
        )


def _stored(path):
    """The array in a file, None if it is not there or damaged."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    array, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
    return np.load(io.BytesIO(array)) if array and _checksum(array) == checksum else None


def _checksum(content):
    return zlib.crc32(content).to_bytes(_CHECKSUM_BYTES, "little")


def _write_whole(path, content):
    """Write a file so that it is there whole or not at all."""
    temporary_path = path.with_suffix(".new")
    with _typed(path):
        with open(temporary_path, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary_path, path)


def _write_all(file, content):
    """Write to a file without a buffer: what fails, fails here and not when the file is closed."""
    left = memoryview(content)
    while len(left):
        left = left[file.write(left) :]


@contextmanager
def _typed(path):
    """Within the block an OSError becomes a SettingsError that names the path."""
    try:
        yield
    except OSError as error:
        raise SettingsError(
            f"'{path}', for what a run can continue from, cannot be used: {error.strerror or error}"
        ) from None
