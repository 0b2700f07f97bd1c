"""Writing files all or nothing."""

import os
import stat
import tempfile
from contextlib import contextmanager
from pathlib import Path

from ..errors import SettingsError

MARK = "written by mi_prt"  # in every picture, film, mesh and archive
_MARKED = 1 << 16


def why_no_file(path):
    """Why a path leads to no regular file that can be read, in words; None if it does."""
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "does not exist"
    except (OSError, ValueError) as error:  # no permission, too long a name, a loop of links
        return f"cannot be reached: {reason_of(error)}"
    if stat.S_ISDIR(mode):
        return "is a folder"
    if not stat.S_ISREG(mode):
        return "is no regular file"
    return None if os.access(path, os.R_OK) else "cannot be read: permission denied"


def reason_of(error):
    """The reason of an OSError or another one in a few words."""
    return getattr(error, "strerror", None) or " ".join(str(error).split())


def check_writable(path):
    """Raise SettingsError unless a file can be created at `path`."""
    path = Path(path)
    folder = path.absolute().parent
    if len(os.fsencode(path.name)) > 255:
        raise SettingsError(
            f"output name '{path.name[:40]}…' is longer than the 255 bytes that file systems take"
        )
    try:
        is_folder = stat.S_ISDIR(os.stat(folder).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        is_folder = False
    except (OSError, ValueError) as error:
        raise SettingsError(
            f"output folder '{folder}' cannot be reached: {reason_of(error)}"
        ) from None
    if not is_folder:
        raise SettingsError(f"output folder '{folder}' does not exist: create it first")
    _check_replaceable(path)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise SettingsError(f"output '{path}' cannot be written: permission denied")


def _check_replaceable(path):
    """Raise SettingsError if something is at `path` that a file cannot take the place of."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise SettingsError(f"output '{path}' cannot be reached: {reason_of(error)}") from None
    if stat.S_ISDIR(mode):
        raise SettingsError(f"output '{path}' is a folder: give a file name")
    if not stat.S_ISREG(mode):
        raise SettingsError(f"output '{path}' is no regular file: give another name")
    if not os.access(path, os.W_OK):
        raise SettingsError(f"output '{path}' cannot be written: permission denied")


def check_own(path, is_own, force=False):
    """Raise SettingsError if a file is at `path` that this program has not written.

    Parameters
    ----------
    path : path
    is_own : callable(path)
        Whether a file is one that this program writes under such a name. Empty ones are free to
        take.
    force : bool
        Whether it may be replaced all the same.
    """
    if force or not os.path.exists(path) or not os.path.getsize(path) or is_own(path):
        return
    raise SettingsError(
        f"output '{path}' is there and was not written by mi_prt: give another name, or replace it"
        " (--force)"
    )


def is_marked(path):
    """Whether a file holds `MARK` in its first or last 64 KB."""
    try:
        with open(path, "rb") as file:
            start = file.read(_MARKED)
            file.seek(-min(_MARKED, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return MARK.encode() in start or MARK.encode() in file.read()
    except OSError:
        return False


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
