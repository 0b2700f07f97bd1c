"""Writing files all or nothing."""

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

from .errors import SettingsError


def check_writable(path):
    """Raise SettingsError unless a file can be created at `path`."""
    path = Path(path)
    folder = path.absolute().parent
    if len(os.fsencode(path.name)) > 255:
        raise SettingsError(f"output name '{path.name[:40]}…' is longer than the 255 bytes that file systems take")
    if path.is_dir():
        raise SettingsError(f"output '{path}' is a folder: give a file name")
    if not folder.is_dir():
        raise SettingsError(f"output folder '{folder}' does not exist: create it first")
    if not os.access(folder, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise SettingsError(f"output '{path}' cannot be written: permission denied")


@contextmanager
def replacing(path):
    """Name of a new file in the same folder, which takes the place of `path` once the block has ended without error."""
    path = Path(path)
    check_writable(path)
    handle, temporary = tempfile.mkstemp(dir=path.absolute().parent, prefix=f".{path.name[:40]}.", suffix=".part")
    os.close(handle)
    try:
        yield temporary
        os.umask(mask := os.umask(0))
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # Mitsuba raises RuntimeError
        raise SettingsError(f"'{path}' cannot be written: {' '.join(str(error).split())}") from None
    finally:
        Path(temporary).unlink(missing_ok=True)
