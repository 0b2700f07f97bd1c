"""The one door to Mitsuba: variant, threads, kernel counts, versions, memory.

Mitsuba and Dr.Jit are imported inside these functions and nowhere at import time, so that `mi-prt
--help` answers at once and a machine without a usable LLVM gets a typed error instead of an ended
process.
"""

import ctypes
import importlib
import importlib.metadata
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from ..errors import RuntimeSetupError, SettingsError
from .llvm import install_command, require_llvm, select_llvm

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Mitsuba variants that mi_prt works in, the default first; see docs/cuda.md for the other."""

THREADS_PER_CORE = 8
"""Most threads per core that `set_threads` accepts: more only costs memory."""

PACKAGES = ("mi_prt", "mitsuba", "drjit", "numpy", "scipy")
"""Distributions whose versions are stored with every result."""

_LIBATOMIC = {
    "apt-get": "libatomic1",
    "dnf": "libatomic",
    "zypper": "libatomic1",
    "pacman": "gcc-libs",
}


def mitsuba() -> ModuleType:
    """The `mitsuba` module with a usable variant set.

    A variant of `VARIANTS` that is already set is kept; without one `llvm_ad_rgb` is set, also
    where there is a GPU.

    Raises
    ------
    RuntimeSetupError
        If Mitsuba cannot be imported, if another variant is set, or if the LLVM variant is the one
        to use and there is no usable LLVM.
    """
    mi = _load("mitsuba")
    variant = mi.variant()
    if variant is None:
        variant = VARIANTS[0]
    if variant not in VARIANTS:
        raise RuntimeSetupError(
            f"the Mitsuba variant {variant} is set, but mi_prt works in {' or '.join(VARIANTS)}; "
            "call mitsuba.set_variant('llvm_ad_rgb') instead, or leave the choice to mi_prt"
        )
    if variant.startswith("llvm"):
        require_llvm()
    if mi.variant() is None:
        mi.set_variant(variant)
    return mi


def set_variant(variant: str) -> None:
    """Set the variant that Mitsuba works in from here on.

    Raises
    ------
    SettingsError
        If it is not one of `VARIANTS`.
    RuntimeSetupError
        If this machine lacks what it needs.
    """
    if variant not in VARIANTS:
        raise SettingsError(f"variant '{variant}' is not known: use {' or '.join(VARIANTS)}")
    if variant.startswith("cuda") and not cuda_usable():
        raise RuntimeSetupError(
            f"the variant {variant} needs a GPU of NVIDIA, its driver and OptiX, one of which is"
            f" not found here: install them, or use {VARIANTS[0]}"
        )
    if variant.startswith("llvm"):
        require_llvm()
    _load("mitsuba").set_variant(variant)


def cuda_usable() -> bool:
    """Whether Dr.Jit finds a GPU and, to trace rays on it, OptiX: containers often pass on one
    without the other.
    """
    dr, mi = _load("drjit"), _load("mitsuba")
    return (
        "cuda_ad_rgb" in mi.variants()
        and bool(dr.has_backend(dr.JitBackend.CUDA))
        and _optix_loadable()
    )


def quiet_mitsuba() -> None:
    """Send Mitsuba's messages of level Warn and above to stderr, and drop the rest and its progress
    bars.

    Mitsuba logs to stdout, which belongs to the results of a program. Messages may come from its
    worker threads.
    """
    mi = _load("mitsuba")

    class StderrAppender(mi.Appender):
        def append(self, level, text):
            print(text, file=sys.stderr)

        def log_progress(self, progress, name, formatted, eta, ptr=None):
            pass

    logger = mi.logger()
    logger.clear_appenders()
    logger.add_appender(StderrAppender())
    logger.set_log_level(mi.LogLevel.Warn)


def set_threads(count: int) -> None:
    """Set how many CPU threads Mitsuba and Dr.Jit use, the calling thread included.

    Parameters
    ----------
    count : int
        Between 1 and `THREADS_PER_CORE` times the number of cores.

    Raises
    ------
    SettingsError
        If `count` is not an integer in this range.
    """
    most = THREADS_PER_CORE * (os.cpu_count() or 1)
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= most:
        raise SettingsError(
            f"threads must be an integer from 1 to {most} ({THREADS_PER_CORE} per core), got"
            f" {count!r}"
        )
    set_thread_count(count)


def set_thread_count(count: int) -> None:
    """`set_threads`, unchecked."""
    drjit = _load("drjit")
    if drjit.thread_count() != count:
        drjit.set_thread_count(count)


def thread_count() -> int:
    """How many CPU threads Mitsuba and Dr.Jit use, the calling thread included."""
    return _load("drjit").thread_count()


class KernelCount:
    """Kernels of Dr.Jit since this object was made, until `stop`.

    Dr.Jit's own running totals are compared, so nothing is recorded and memory stays constant over
    long runs.
    """

    def __init__(self):
        self._start = _launch_totals()
        self._end = None

    @property
    def launched(self) -> int:
        """Kernels launched."""
        return self._since_start(0)

    @property
    def compiled(self) -> int:
        """Kernels new to this process: compiled, or loaded from Dr.Jit's cache on disk.

        Repeating one adds nothing.
        """
        return self._since_start(1) + self._since_start(2)

    @property
    def from_disk(self) -> int:
        """How many of `compiled` came from the cache on disk."""
        return self._since_start(1)

    def stop(self) -> None:
        """Keep the present counts for good."""
        self._end = _launch_totals()

    def _since_start(self, total: int) -> int:
        return (self._end or _launch_totals())[total] - self._start[total]


@contextmanager
def count_kernels() -> Iterator[KernelCount]:
    """Count the kernels of Dr.Jit within a ``with`` block; blocks may be nested, and counts be read
    inside and after.

    Only what is evaluated within the block counts: end it with `drjit.eval`. A function that
    compiles at each call has a literal in it that should be `drjit.opaque`.

    Examples
    --------
    >>> with count_kernels() as kernels:
    ...     drjit.eval(drjit.arange(mi.Float, 8) + 1)
    >>> kernels.launched, kernels.compiled
    (1, 1)
    """
    count = KernelCount()
    try:
        yield count
    finally:
        count.stop()


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far, in bytes."""
    try:
        with open("/proc/self/status") as file:
            # getrusage would also count the parent's memory at the time it started this process.
            return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


def versions() -> dict[str, str]:
    """Versions of `PACKAGES`, Python, and the LLVM that Dr.Jit runs with ("none" where something is
    absent).
    """
    found = {package: package_version(package) for package in PACKAGES}
    return found | {"python": platform.python_version(), "llvm": _llvm_version()}


def package_version(package: str) -> str:
    """Version of an installed distribution, "none" if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _load(module: str) -> ModuleType:
    """Import drjit or mitsuba after the choice of an LLVM; whatever prevents that becomes a typed
    error.
    """
    select_llvm()
    try:
        return importlib.import_module(module)
    # NameError: Dr.Jit's own handling of an ImportError fails
    except (ImportError, NameError) as error:
        cause = error.__context__ or error
        reinstall = f"{sys.executable} -m pip install --force-reinstall mitsuba drjit"
        remedy = install_command(_LIBATOMIC) if "libatomic" in str(cause) else reinstall
        raise RuntimeSetupError(
            f"{module} cannot be imported ({cause}); type `{remedy}`"
        ) from error


def _optix_loadable() -> bool:
    """Whether the driver's OptiX library can be loaded; only Linux splits it from the rest of the
    driver.
    """
    if sys.platform != "linux":
        return True
    try:
        ctypes.CDLL("libnvoptix.so.1")
    except OSError:
        return False
    return True


def _launch_totals() -> tuple[int, int, int]:
    """Kernels launched, loaded from disk, and compiled since Dr.Jit was imported."""
    return _load("drjit").detail.launch_stats()


def _llvm_version() -> str:
    version = _load("drjit").detail.llvm_version()
    return ".".join(map(str, version)) if version[0] > 0 else "none"
