"""The program around the commands: whatever happens in them ends in one line and an exit code."""

import json
import os
import signal
import sys
import threading
import warnings
from contextlib import contextmanager

from ..errors import PrtError
from ..system.starting import (
    INTERRUPTED,
    end_quietly_when_interrupted,
    interrupt_as_exception,
)
from .commands import app
from .show import Said, note

_ENDING = ("SIGTERM", "SIGHUP")  # those there are


def main(arguments=None):
    """Run the program.

    Exit codes: 0 done, 2 bad usage or input, 130 interrupted, 128 and its number for another
    signal, 1 anything else.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    warnings.showwarning = lambda message, *_, **__: note(str(message))
    _take_any_text(sys.stdout)
    try:
        interrupt_as_exception()
        with _signals_unwind():
            code = _flushed(_code_of(arguments))
    except KeyboardInterrupt:  # before or after what is tried within
        note("interrupted")
        code = INTERRUPTED
    end_quietly_when_interrupted()
    sys.exit(code)


def _code_of(arguments):
    """The exit code of a command; a line on stderr where it failed."""
    try:
        if arguments and not {"-h", "--help", "--version"} & set(arguments):
            from ..system.runtime import quiet_mitsuba

            quiet_mitsuba()
        app(arguments, standalone_mode=True, prog_name="mi-prt")
    except SystemExit as exit:
        if exit.code == INTERRUPTED and not isinstance(exit, Said):  # by Typer
            note("interrupted")
        return exit.code or 0
    except PrtError as error:
        _tell(error, "--json" in arguments)
        return error.exit_code
    except MemoryError:
        note("out of memory: use fewer --directions or a longer --edge-length, or set --max-memory")
    except OSError as error:
        name = f"'{error.filename}' cannot be used" if error.filename else "output failed"
        note(f"{name}: {error.strerror or error}")
        return 2 if error.filename else 1
    return 1


def _tell(error, as_json):
    """A line on stderr: what went wrong, as JSON where results would be."""
    if as_json:
        told = {"error": {"type": type(error).__name__, "message": str(error)}}
        print(json.dumps(told), file=sys.stderr)
    else:
        note(str(error))


def _flushed(code):
    """The exit code once all output has arrived: 1 where it has not."""
    output = sys.stdout
    if output is None:
        return code
    try:
        output.flush()
    except OSError as error:
        # what is still in the buffer would fail again when Python ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
        if not isinstance(error, BrokenPipeError):
            note(f"standard output cannot be written: {error.strerror or error}")
        return code or 1
    return code


def _take_any_text(stream):
    """Let a stream of another encoding (PYTHONIOENCODING=ascii) write what it cannot encode as
    escapes.
    """
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="backslashreplace")


@contextmanager
def _signals_unwind():
    """Within the block, signals that end the process do it as an exception, so that no half-written
    file is left. The second one ends it at once.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (getattr(signal, name) for name in _ENDING if hasattr(signal, name)):
            if signal.getsignal(number) == signal.SIG_DFL:  # `nohup` ignores one
                before[number] = signal.signal(number, _unwind)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _unwind(number, frame):
    signal.signal(number, signal.SIG_DFL)
    note(f"ended by {signal.Signals(number).name}; nothing is left half-written")
    raise Said(128 + number)
