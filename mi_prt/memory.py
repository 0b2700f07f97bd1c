"""How much memory there is, and how much a run may take."""

import psutil

from .errors import SettingsError

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
_CONTROL_GROUP = "/sys/fs/cgroup/memory."


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
        raise SettingsError(f"memory '{text}' is not a positive number of bytes, such as 3G or 800M") from None
    return int(size)


def resident_bytes():
    """Memory that this process has now."""
    return psutil.Process().memory_info().rss


def free_bytes():
    """Memory that this process could still get, its container's limit included."""
    free = psutil.virtual_memory().available
    try:
        limit, used, statistics = (open(_CONTROL_GROUP + name).read().split() for name in ("max", "current", "stat"))
    except OSError:
        return free
    if limit == ["max"]:
        return free
    # Pages of files that nobody has open count as used and are given back when memory is asked for.
    cached = dict(zip(statistics[::2], statistics[1::2])).get("inactive_file", 0)
    return max(min(free, int(limit[0]) - int(used[0]) + int(cached)), 0)
