"""Selection of the LLVM library that Dr.Jit compiles with.

Dr.Jit loads one libLLVM while it is being imported and never another: the file that
`DRJIT_LIBLLVM_PATH` names, else the first that its own search meets. On many machines that is LLVM
14 to 16. Dr.Jit itself accepts 15 and 16, but Mitsuba's path integrator then ends the whole process
("Cannot select ... fminimum"), which Python cannot catch. So the library is chosen here before
Dr.Jit is imported, and by names alone: loading one to ask for its version takes up to 0.2 s, and
this code runs each time mi_prt is imported.
"""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from glob import glob

from ..errors import RuntimeSetupError

VARIABLE = "DRJIT_LIBLLVM_PATH"

OLDEST_VERSION = 17
"""Oldest usable major version: 14 is refused by Dr.Jit, 15 and 16 end the process inside the path
integrator.
"""

NEWEST_TRIED = 22
"""Newest major version that Mitsuba was run with; later ones are taken only where there is no
other.
"""

DIRECTORIES = (
    "/usr/lib/llvm-*/lib",  # Debian, Ubuntu, apt.llvm.org
    f"/usr/lib/{getattr(sys.implementation, '_multiarch', 'multiarch')}",
    "/usr/lib64",  # Fedora, openSUSE
    "/usr/lib64/llvm*/lib64",
    "/usr/lib",  # Arch
    "/usr/lib/llvm*/lib",
    "/usr/lib/llvm/*/lib64",  # Gentoo
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
    "/home/linuxbrew/.linuxbrew/opt/llvm*/lib",
)
"""Where packages put libLLVM, as glob patterns."""

_LIBRARY_NAME = re.compile(r"libLLVM(-\d+(\.\d+)*)?(\.\d+(\.\d+)*)?\.(dylib|so(\.\d+)*)")
# but libLLVM.so.1 tells nothing
_VERSION_IN_NAME = re.compile(r"libLLVM(?:-|\.(?:so\.)?(?=\d\d))(\d+)")
_VERSION_IN_FOLDER = re.compile(r"/llvm[-@/]?(\d+)")

_PACKAGES = {
    "apt-get": "libllvm19",  # or another of libllvm17 to libllvm22
    "dnf": "llvm-libs",
    "zypper": "libLLVM19",
    "pacman": "llvm-libs",
    "brew": "llvm",
}


@dataclass(frozen=True)
class Library:
    """A libLLVM on disk.

    Parameters
    ----------
    path : str
        The file itself, symbolic links resolved.
    version : int or None
        Major version as told by the names of the file and its folder; None if they do not tell.
    """

    path: str
    version: int | None

    @property
    def usable(self) -> bool:
        """Whether Mitsuba can run with it; an unknown version counts as unusable."""
        return self.version is not None and self.version >= OLDEST_VERSION


def select_llvm() -> str | None:
    """Choose the libLLVM for this process by setting `DRJIT_LIBLLVM_PATH`; call it before Dr.Jit is
    imported.

    A variable that is already set is left alone, and nothing happens once Dr.Jit is imported,
    because its choice is then final. Nothing is raised: a machine without any usable LLVM may still
    have CUDA. `require_llvm` checks.

    Returns
    -------
    str or None
        The value of `DRJIT_LIBLLVM_PATH`, or None if there is nothing to set it to.
    """
    if not os.environ.get(VARIABLE) and "drjit" not in sys.modules:
        best = next(
            (library for library in find_libraries() if library.usable or library.version is None),
            None,
        )
        if best is not None:
            os.environ[VARIABLE] = best.path
    return os.environ.get(VARIABLE)


def require_llvm() -> None:
    """Make sure that Dr.Jit runs with a usable LLVM, so that no kernel is compiled with one that
    ends the process.

    Raises
    ------
    RuntimeSetupError
        If `DRJIT_LIBLLVM_PATH` names a missing, unloadable or too old library, if no usable library
        is found, or if Dr.Jit was imported before mi_prt and took another one.
    """
    chosen = select_llvm()
    if chosen:
        _check_chosen(chosen)
    import drjit  # only now: importing it loads the library

    loaded = drjit.detail.llvm_version()[0]
    if loaded < OLDEST_VERSION:
        raise RuntimeSetupError(_reason(chosen, loaded))


def find_libraries(directories: list[str] | None = None) -> list[Library]:
    """All LLVM libraries of this machine's architecture, the best first.

    Parameters
    ----------
    directories : list of str, optional
        Folders or glob patterns to search. By default `LD_LIBRARY_PATH`, the active conda
        environment and `DIRECTORIES`; only if these hold no usable library, the linker's cache is
        asked too, which costs a process.

    Returns
    -------
    list of Library
        Usable ones first (newest first up to `NEWEST_TRIED`, then later ones), then those of
        unknown version, then too old ones.
    """
    if directories is not None:
        return _ranked(_in_directories(directories))
    found = _in_directories(_usual_directories())
    if not any(library.usable for library in found):
        found += _in_linker_cache()
    return _ranked(found)


@cache
def library_version(path: str) -> int | None:
    """Major version of a libLLVM as told by its name, the name behind its symbolic link, or its
    folder (`llvm-19`).
    """
    real = os.path.realpath(path)
    for name in (os.path.basename(real), os.path.basename(path)):
        if match := _VERSION_IN_NAME.match(name):
            return int(match[1])
    match = _VERSION_IN_FOLDER.search(real)
    return int(match[1]) if match else None


def install_command(packages: dict[str, str]) -> str:
    """What to type to install something with this machine's package manager.

    Parameters
    ----------
    packages : dict of str to str
        Package names by package manager (`apt-get`, `dnf`, `zypper`, `pacman`, `brew`).

    Returns
    -------
    str
        A command such as ``sudo apt-get install libllvm19``, or a list of the names if no manager
        is found.
    """
    manager = next((manager for manager in packages if shutil.which(manager)), None)
    if manager is None:
        return "your package manager: " + ", ".join(dict.fromkeys(packages.values()))
    prefix = "" if manager == "brew" or os.geteuid() == 0 else "sudo "
    verb = "-S" if manager == "pacman" else "install"
    return f"{prefix}{manager} {verb} {packages[manager]}"


def remedy() -> str:
    """What to do about a missing or unusable LLVM, for error messages."""
    usable = next((library.path for library in find_libraries() if library.usable), None)
    if usable is not None:
        return f"{usable} is usable: unset {VARIABLE}, or set it to that"
    return (
        f"install LLVM {OLDEST_VERSION} to {NEWEST_TRIED} with `{install_command(_PACKAGES)}`, or"
        f" set {VARIABLE} to the path of its libLLVM"
    )


def _check_chosen(path: str) -> None:
    """Refuse a path that cannot work before Dr.Jit tries it; a name without a folder is left to the
    linker.
    """
    if os.sep in path and not os.path.isfile(path):
        raise RuntimeSetupError(
            f"{VARIABLE} is {path}, but no such file exists (it must be libLLVM itself, not its "
            f"folder); {remedy()}"
        )
    version = library_version(path)
    if version is not None and version < OLDEST_VERSION:
        raise RuntimeSetupError(_too_old(path, version))


def _too_old(path: str, version: int) -> str:
    return (
        f"{VARIABLE} is {path}, which is LLVM {version}, but {OLDEST_VERSION} or newer is needed;"
        f" {remedy()}"
    )


def _reason(chosen: str | None, loaded: int) -> str:
    """Why Dr.Jit has no usable LLVM: `loaded` is the major version that it took, -1 if it took
    none.
    """
    if chosen and loaded < 0:
        return (
            f"Dr.Jit could not load {chosen} (from {VARIABLE}): it is damaged, older than LLVM 15,"
            f" or made for another architecture; {remedy()}"
        )
    if chosen and library_version(chosen) is None:
        return _too_old(chosen, loaded)
    found = find_libraries()
    usable = chosen or next((library.path for library in found if library.usable), None)
    if usable is not None:
        took = f"LLVM {loaded}" if loaded > 0 else "no LLVM"
        return (
            f"Dr.Jit was imported before mi_prt and took {took}, but {OLDEST_VERSION} or newer is"
            f" needed; import mi_prt before drjit and mitsuba, or start with {VARIABLE}={usable}"
        )
    versions = sorted({library.version for library in found if library.version is not None})
    only = f"only LLVM {', '.join(map(str, versions))} is" if versions else "no LLVM is"
    return f"{only} installed, but {OLDEST_VERSION} or newer is needed; {remedy()}"


def _usual_directories() -> list[str]:
    """Folders the user points at, then those of packages."""
    own = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    if "CONDA_PREFIX" in os.environ:
        own.append(os.path.join(os.environ["CONDA_PREFIX"], "lib"))
    return [directory for directory in own if directory] + list(DIRECTORIES)


def _in_directories(patterns: list[str]) -> list[Library]:
    """Libraries in the folders that the glob patterns match."""
    found = []
    for pattern in patterns:
        for path in glob(os.path.join(pattern, "libLLVM*")):
            if _LIBRARY_NAME.fullmatch(os.path.basename(path)) and _of_this_machine(path):
                found.append(Library(os.path.realpath(path), library_version(path)))
    return found


def _in_linker_cache() -> list[Library]:
    """Libraries that the dynamic linker's cache lists (Linux)."""
    program = shutil.which("ldconfig", path=os.environ.get("PATH", "") + ":/sbin:/usr/sbin")
    if program is None or sys.platform != "linux":
        return []
    listing = subprocess.run([program, "-p"], capture_output=True, text=True, timeout=10).stdout
    paths = re.findall(r"=> (\S*/libLLVM\S*)$", listing, flags=re.MULTILINE)
    return _in_directories(sorted({os.path.dirname(path) for path in paths}))


def _ranked(libraries: list[Library]) -> list[Library]:
    """Each file once, the best first."""

    def rank(library: Library) -> tuple:
        version = library.version or 0
        return not library.usable, library.version is not None, version > NEWEST_TRIED, -version

    return sorted(dict.fromkeys(libraries), key=rank)


def _of_this_machine(path: str) -> bool:
    """Whether a file is a library for the running interpreter's architecture: Debian keeps several
    side by side.
    """
    if sys.platform != "linux":
        return os.path.isfile(path)
    machine = _elf_machine(path)
    return machine is not None and machine == _elf_machine("/proc/self/exe")


def _elf_machine(path: str) -> bytes | None:
    """Word size, byte order and machine number in the header of an ELF file; None if it is not
    one.
    """
    try:
        with open(path, "rb") as file:
            header = file.read(20)
    except OSError:
        return None
    return header[4:6] + header[18:20] if header[:4] == b"\x7fELF" else None
