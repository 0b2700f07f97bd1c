"""Writing files all or nothing."""

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

from ..errors import SettingsError


def check_writable(path):
    """Raise SettingsError unless a file can be created at `path`."""
    path = Path(path)
    folder = path.absolute().parent
    if len(os.fsencode(path.name)) > 255:
        raise SettingsError(
            f"output name '{path.name[:40]}…' is longer than the 255 bytes that file systems take"
        )
    if path.is_dir():
        raise SettingsError(f"output '{path}' is a folder: give a file name")
    if not folder.is_dir():
        raise SettingsError(f"output folder '{folder}' does not exist: create it first")
    if path.exists() and not path.is_file():
        raise SettingsError(f"output '{path}' is no regular file: give another name")
    if not os.access(folder, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise SettingsError(f"output '{path}' cannot be written: permission denied")


@contextmanager
def replacing(path, folder=None):
    """Name of a new file, which takes the place of `path` once the block has ended without error.

    It is made in the folder of `path`, or in another one on the same file system. A path that is a
    link stays one.
    """
    path = Path(path)
    check_writable(path)
    path = path.resolve()
    handle, temporary = tempfile.mkstemp(
        dir=folder or path.parent, prefix=f".{path.name[:40]}.", suffix=".part"
    )
    os.close(handle)
    try:
        yield temporary
        os.umask(mask := os.umask(0))
        os.chmod(temporary, 0o666 & ~mask)
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # Mitsuba raises RuntimeError
        raise SettingsError(f"'{path}' cannot be written: {' '.join(str(error).split())}") from None
    finally:
        Path(temporary).unlink(missing_ok=True)
