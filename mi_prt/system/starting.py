"""Ctrl-C while the program starts or ends: one line in place of a traceback.

Importing Mitsuba, Dr.Jit and SciPy takes a second, in which there is nothing to tidy up, so the
process ends at once. That is done for the program only: a Python session that imports mi_prt keeps
its own handling.
"""

import os
import signal
import sys
import threading

INTERRUPTED = 130


def is_program():
    """Whether this process is `mi-prt` or `python -m mi_prt`."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if name == "-m":  # while Python looks for the module
        after = sys.orig_argv[sys.orig_argv.index("-m") + 1 :] if "-m" in sys.orig_argv else []
        return after[:1] == ["mi_prt"]
    is_module = os.path.basename(os.path.dirname(sys.argv[0] if sys.argv else "")) == "mi_prt"
    return name.removesuffix(".exe") == "mi-prt" or (name == "__main__.py" and is_module)


def end_quietly_when_interrupted():
    """From now on Ctrl-C ends the process at once, with a line and the exit code 130; in the
    program alone, and unless it is ignored.
    """
    own = signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _end)
    if is_program() and own and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _end)


def interrupt_as_exception():
    """From now on Ctrl-C raises KeyboardInterrupt again, so that nothing is left half-written."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(number, frame):
    try:
        os.write(2, b"mi-prt: interrupted\n")
    finally:
        os._exit(INTERRUPTED)
