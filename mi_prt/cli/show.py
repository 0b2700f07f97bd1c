"""What the user sees: results, notes, progress."""

import json
import sys
import time
from contextlib import contextmanager, suppress

from ..evaluate.report import finite

LOG_SECONDS = 20  # between lines of progress where there is no terminal


class Said(SystemExit):
    """The end of the program, of which the user has been told why."""


def print_json(value):
    print(json.dumps(finite(value), allow_nan=False))


def note(text):
    """One line on stderr; it is not worth an error that nobody can read it."""
    with suppress(OSError):
        print(f"mi-prt: {printable(text)}", file=sys.stderr, flush=True)


def printable(text):
    """The text in one line, with escapes for what would move the cursor, colour the terminal or be
    seen as nothing: a path may hold it.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def table(rows):
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def print_nested(value, indent=""):
    for key, entry in value.items():
        if isinstance(entry, dict) and entry:
            print(f"{indent}{printable(key)}:")
            print_nested(entry, indent + "  ")
        elif isinstance(entry, list) and entry and isinstance(entry[0], dict):
            print(f"{indent}{printable(key)}:")
            for item in entry:
                print(
                    f"{indent}  - "
                    + ", ".join(f"{k} {_plain(v)}" for k, v in item.items() if v not in (None, []))
                )
        else:
            print(f"{indent}{printable(key)}: {_plain(entry)}")


def _plain(entry):
    if isinstance(entry, float):
        return f"{entry:.6g}"
    if isinstance(entry, list):
        return ", ".join(_plain(x) for x in entry) or "none"
    if isinstance(entry, int) and not isinstance(entry, bool):
        return f"{entry:,}"
    return printable(str(entry))


@contextmanager
def progress_bar(kept=None):
    """A callable(stage, done, total, detail) that draws progress with ETA on stderr, and where that
    is no terminal, prints it.

    Ctrl-C ends the program within the block, with a word on what was kept.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[detail]}"),
    )
    tasks = {}
    console = Console(stderr=True)
    printed = time.monotonic()
    with Progress(*columns, console=console) as bar:

        def progress(stage, done, total, detail=""):
            nonlocal printed
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, detail="")
            bar.update(tasks[stage], completed=done, total=total, detail=detail)
            if not console.is_terminal and time.monotonic() > printed + LOG_SECONDS:
                printed = time.monotonic()
                note(f"{stage} {done}/{total} {detail}".rstrip())

        try:
            yield progress
        except KeyboardInterrupt:
            bar.stop()
            note(
                "interrupted; nothing is left half-written"
                + (f", and --resume continues ({kept})" if kept else "")
            )
            raise Said(130) from None
