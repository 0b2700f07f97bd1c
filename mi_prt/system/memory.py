"""How much memory there is, and how much a run may take."""

from pathlib import Path

import psutil

from ..errors import SettingsError

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
# Where a control group says its limit, what it uses and what of that is cache, of version 2 and of
# version 1.
_CONTROL_GROUPS = {
    "": (
        "/sys/fs/cgroup{group}/",
        ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ),
    "memory": (
        "/sys/fs/cgroup/memory{group}/",
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat", "total_inactive_file"),
    ),
}


def parse_bytes(text):
    """Bytes of a number with K, M, G or T behind it, in powers of 1024.

    Raises
    ------
    SettingsError
        If it is no such number or not positive.
    """
    if isinstance(text, int) and not isinstance(text, bool) and text > 0:
        return text
    digits = str(text).strip().upper().removesuffix("B").removesuffix("I")
    number, unit = (digits[:-1], digits[-1]) if digits and digits[-1] in _UNITS else (digits, "")
    try:
        size = float(number) * _UNITS[unit]
        if not 0 < size < float("inf"):
            raise ValueError
    except ValueError:
        raise SettingsError(
            f"memory '{text}' is not a positive number of bytes, such as 3G or 800M"
        ) from None
    return int(size)


def resident_bytes():
    """Memory that this process has now."""
    return psutil.Process().memory_info().rss


def free_bytes():
    """Memory that this process could still get, its container's limits included."""
    free = psutil.virtual_memory().available
    for folder, names in _control_groups():
        try:
            limit, used, statistics = (
                Path(folder + name).read_text().split() for name in names[:3]
            )
        except OSError:
            continue
        if limit != ["max"]:
            # Pages of files that nobody has open count as used and are given back when memory is
            # asked for.
            cached = dict(zip(statistics[::2], statistics[1::2])).get(names[3], 0)
            free = min(free, int(limit[0]) - int(used[0]) + int(cached))
    return max(free, 0)


def _control_groups():
    """Folders of the memory control groups that this process may be in: its own, and the root as a
    container sees it.
    """
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for _, controllers, group in (line.split(":", 2) for line in lines):
        for controller in controllers.split(","):
            if controller in _CONTROL_GROUPS:
                folder, names = _CONTROL_GROUPS[controller]
                for place in dict.fromkeys((group.rstrip("/"), "")):
                    yield folder.format(group=place), names
