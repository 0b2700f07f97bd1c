"""Errors through Mitsuba as they were raised.

Mitsuba calls plugins written in Python from C++, and makes a RuntimeError of whatever they raise:
`mi.render` with the cause behind it, the loaders with a traceback in its text.
"""

from collections import deque
from contextlib import contextmanager
from functools import wraps

from ..errors import PrtError

FUNCTIONS = ("render", "load_dict", "load_file", "load_string")
_PASSED = (PrtError, KeyboardInterrupt, SystemExit, MemoryError, Warning)
_raised = deque(maxlen=16)  # in plugins: a loader drops them and keeps their text


def as_raised(function):
    """The function, whose RuntimeErrors of Mitsuba are replaced by what was raised within."""

    @wraps(function)
    def passing(*arguments, **named):
        try:
            return function(*arguments, **named)
        except RuntimeError as error:
            found = _passed(error)
            if found is None:
                raise
        raise found

    return passing


def pass_errors_through(mi):
    """Let the functions of Mitsuba that call plugins pass on what these raise. Repeating it adds
    nothing; a change of the variant undoes it.
    """
    for name in FUNCTIONS:
        function = getattr(mi, name)
        if not hasattr(function, "__wrapped__"):
            setattr(mi, name, as_raised(function))


@contextmanager
def remembered():
    """Within the block, the making of a plugin, errors are kept for `as_raised`."""
    try:
        yield
    except _PASSED as error:
        _raised.append(error)
        raise


def one_line(error):
    """The text of an error of Mitsuba in one line; of a traceback in it, its last line."""
    lines, inside = [], False
    for line in str(error).splitlines():
        inside = line.startswith(("Traceback ", "  ")) if inside else "Traceback (most" in line
        kept = line.split("Traceback (most")[0] if inside else line
        if not inside or "Traceback (most" in line:
            lines.append(kept)
    return " ".join(" ".join(lines).split())


def _passed(error):
    """What a RuntimeError stands for, None if it is Mitsuba's own."""
    behind = error.__cause__
    while behind is not None:
        if isinstance(behind, _PASSED):
            return behind
        behind = behind.__cause__
    text = str(error)
    return next((e for e in reversed(_raised) if str(e) and str(e) in text), None)
