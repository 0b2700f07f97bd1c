"""Fuzz the reader of asset files.

    python tests/fuzz_assets.py --count 20000 --seed 1 FILE…

makes hostile files from good ones, loads each in a worker with limits of memory and time, relights
what loads, and prints a table of what came of it. Exit code 1 if a file ended in a traceback, a
crash, a hang, too much memory, the read of another file, or a message that is not one plain line.
"""

import argparse
import contextlib
import ctypes
import importlib
import json
import os
import re
import resource
import selectors
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from mutants import TURNS, Mutator, make_traps  # noqa: E402

LOAD, RELIGHT = "mi_prt:load", "small_assets:relight"
FINE = ("refused", "loaded", "typed error")
FAILURES = ("traceback", "crash", "hang", "memory", "foreign read", "message")
TURN = 2000  # files for a worker, so that what caches grow by does not count
PROGRAM = [sys.prefix, sys.base_prefix, str(Path(__file__).parents[1]), "/sys/fs/cgroup"]
PROGRAM += ["/sys/devices/system", "/proc/meminfo", "/proc/stat", "/proc/cpuinfo"]
IN_OPEN_OR_ACCESS = 0x20 | 0x01
EVENTS = re.compile(
    r"open$|os\.(listdir|scandir|mkdir|remove|rename|rmdir|symlink|link|chmod|chown|truncate|exec"
    r"|system|posix_spawn|spawn|fork|forkpty|startfile|putenv|kill)$|socket\.|subprocess\.|shutil\.|urllib\."
    r"|ftplib\.|http\.|smtplib\.|pickle\.find_class$|ctypes\.dlopen$|tempfile\."
)


class Watch:
    """Finds out what is opened beside the mutant itself.

    Python's own opens by an audit hook; those of libraries by the system's notices about traps.

    Parameters
    ----------
    allowed : list of str
        Folders of the program, which may be read.
    traps : list of str
        Files that nobody may open.
    """

    def __init__(self, allowed, traps):
        process = ("/proc/self/stat", "/proc/self/cgroup")
        self._allowed = tuple(os.path.realpath(name) for name in (*allowed, *process))
        self._own, self._seen = None, []
        libc = ctypes.CDLL(None, use_errno=True)
        self._notices = libc.inotify_init1(os.O_NONBLOCK)
        for trap in traps:
            libc.inotify_add_watch(self._notices, os.fsencode(trap), IN_OPEN_OR_ACCESS)
        sys.addaudithook(self._hear)

    def _hear(self, event, args):
        if self._own is None or not EVENTS.match(event):
            return
        name = args[0] if args else ""
        if isinstance(name, int) or (event == "ctypes.dlopen" and name is None):
            return  # of a file that is open
        readable = event in ("open", "os.listdir", "os.scandir", "ctypes.dlopen")
        if readable and isinstance(name, str | bytes | os.PathLike | None):
            own, self._own = self._own, None  # what follows raises events too
            real = os.path.realpath(os.fsdecode(name or "."))
            self._own = own
            written = len(args) > 2 and isinstance(args[2], int) and args[2] & 3
            if not written and (real == own or real.startswith(self._allowed)):
                return
        self._seen.append(f"{event} {name!r}"[:200])

    @contextlib.contextmanager
    def over(self, path):
        """Within the block, `path` alone may be opened; `self.seen` lists what was, beside it."""
        self._seen.clear()
        self._own = os.path.realpath(path)
        try:
            yield
        finally:
            self._own = None

    @property
    def seen(self):
        with contextlib.suppress(BlockingIOError):
            os.read(self._notices, 1 << 16)
            self._seen.append("a trap, by a library")
        return list(self._seen)


def try_one(path, load, relight, watch):
    """Outcome of one file, and what to say about it."""
    from mi_prt.errors import AssetError, PrtError

    outcome, said = "loaded", ""
    try:
        with watch.over(path), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            asset = load(path)
            if relight:
                relight(asset)
    except PrtError as error:
        outcome = "refused" if isinstance(error, AssetError) else "typed error"
        said = str(error)
        if not said.isprintable() or len(said) > 2000:
            outcome, said = "message", ascii(said[:300])
    except MemoryError:
        outcome, said = "memory", _where()
    except BaseException:
        outcome, said = "traceback", _where()
    if seen := watch.seen:
        outcome, said = "foreign read", "; ".join(seen[:3])
    return outcome, said


def _where():
    lines = traceback.format_exc(limit=-3).splitlines()
    return " | ".join(line.strip() for line in lines)[-600:]


def _found(name):
    """The function of "module:name"."""
    if name == "none":
        return None
    module, _, name = name.partition(":")
    return getattr(importlib.import_module(module), name)


def work(pipe, options, mutators, indices, folder):
    """A worker: for each index, a line when it begins and one when it is done."""
    load, relight = _found(options.load), _found(options.relight)
    path = os.path.join(folder, "mutant.prt")
    traps = make_traps(folder)
    known = [t for m in mutators for t in m.texts if "\0" not in t and os.path.isfile(t)]
    watch = Watch([*PROGRAM, *sys.path[1:]], traps + known)
    for mutator in mutators:
        mutator.traps = traps
        _put(path, mutator.content)
        for _ in range(2):  # all is imported and has its memory
            outcome, said = try_one(path, load, relight, watch)
        if outcome != "loaded":
            pipe.write(json.dumps(["broken", outcome, said]) + "\n")
            return
    largest = max(len(mutator.content) for mutator in mutators)
    memory = _address_space() + largest + (options.memory << 20)
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    for index in indices:
        local, number = divmod(index, len(mutators))
        kind, what, content = mutators[number].make(options.seed, local)
        _put(path, content)
        pipe.write(json.dumps(["start", index, kind, what[:200]]) + "\n")
        pipe.flush()
        used = resource.getrusage(resource.RUSAGE_SELF)
        seconds = int(used.ru_utime + used.ru_stime) + options.seconds + 1
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, hard))
        outcome, said = try_one(path, load, relight, watch)
        pipe.write(json.dumps(["done", index, outcome, said]) + "\n")
    pipe.write(json.dumps(["end"]) + "\n")


def _put(path, content):
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)  # a new file: to write over an old one is slow on some file systems
    with open(path, "wb") as file:
        file.write(content)


def _address_space():
    with open("/proc/self/status") as file:
        return int(re.search(r"VmSize:\s+(\d+)", file.read())[1]) << 10


class Worker:
    """A forked worker as its parent sees it."""

    def __init__(self, options, mutators, indices):
        self.indices, self.rest = indices[:TURN], indices[TURN:]
        self.folder = tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
        read, write = os.pipe()
        self.id = os.fork()
        if not self.id:
            os.close(read)
            code = 1
            try:
                sys.stdout = open(os.devnull, "w")  # noqa: SIM115
                with os.fdopen(write, "w") as pipe:
                    work(pipe, options, mutators, self.indices, self.folder)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        os.close(write)
        self.pipe, self.current, self.ended, self._rest = read, None, False, b""
        self.since = time.monotonic()

    def lines(self):
        """Records that have come in; None at the end of the worker."""
        content = os.read(self.pipe, 1 << 16)
        *lines, self._rest = (self._rest + content).split(b"\n")
        return [json.loads(line) for line in lines] if content else None

    def close(self):
        """The status with which it ended; removes its folder."""
        os.close(self.pipe)
        _, status = os.waitpid(self.id, 0)
        shutil.rmtree(self.folder, ignore_errors=True)
        return status


class Tally:
    """Outcomes of mutants by kind, and the failures among them."""

    def __init__(self):
        self.counts, self.failures = Counter(), []

    def add(self, kind, index, what, outcome, said):
        self.counts[kind, outcome] += 1
        if outcome in FAILURES:
            failure = dict(index=index, kind=kind, what=what, outcome=outcome, said=said)
            self.failures.append(failure)

    def table(self):
        """Markdown."""
        outcomes = [*FINE, *FAILURES]
        rows = [["mutation", "files", *outcomes]]
        for kind in [*dict.fromkeys(TURNS), "bomb"]:
            numbers = [self.counts[kind, outcome] for outcome in outcomes]
            rows.append([kind, sum(numbers), *numbers])
        rows.append(["all", *(sum(column) for column in zip(*(row[1:] for row in rows[1:])))])
        lines = ["| " + " | ".join(map(str, row)) + " |" for row in rows]
        return "\n".join([lines[0], "|---" + "|---:" * (len(rows[0]) - 1) + "|", *lines[1:]])


def fuzz(files, options):
    """Tally of all mutants."""
    mutators = [Mutator(Path(file).read_bytes(), (), i) for i, file in enumerate(files)]
    tally, selector = Tally(), selectors.DefaultSelector()

    def begin(indices):
        if indices:
            worker = Worker(options, mutators, indices)
            selector.register(worker.pipe, selectors.EVENT_READ, worker)

    for first in range(min(options.workers, options.count)):
        begin(range(first, options.count, options.workers))
    try:
        while selector.get_map():
            for key, _ in selector.select(timeout=0.5):
                lines = key.data.lines()
                for line in lines or ():
                    _record(key.data, line, tally)
                if lines is None:
                    selector.unregister(key.data.pipe)
                    begin(_after_end(key.data, tally))
            for key in list(selector.get_map().values()):
                if key.data.current and time.monotonic() - key.data.since > options.seconds + 1:
                    os.kill(key.data.id, signal.SIGKILL)
    finally:  # after an error workers are left
        for key in list(selector.get_map().values()):
            os.kill(key.data.id, signal.SIGKILL)
            key.data.close()
    return tally


def _record(worker, line, tally):
    if line[0] == "start":
        worker.current, worker.since = line[1:], time.monotonic()
    elif line[0] == "done":
        index, kind, what = worker.current
        tally.add(kind, index, what, *line[2:])
        worker.current = None
    elif line[0] == "broken":
        raise SystemExit(f"a file does not load as it is: {line[1]}: {line[2]}")
    else:
        worker.ended = True


def _after_end(worker, tally):
    """Indices that the worker leaves to another one."""
    status = worker.close()
    if worker.ended:
        return worker.rest
    if not worker.current:
        raise SystemExit("a worker failed before it began a file")
    index, kind, what = worker.current
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    name = signal.Signals(number).name if number else f"exit code {os.WEXITSTATUS(status)}"
    slow = number in (signal.SIGKILL, signal.SIGXCPU)
    tally.add(kind, index, what, "hang" if slow else "crash", name)
    left = worker.indices[worker.indices.index(index) + 1 :]
    return range(left.start, worker.rest.stop, left.step)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", metavar="FILE", help="good files")
    parser.add_argument("--count", type=int, default=3000, help="mutants (3000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seconds", type=int, default=20, help="limit of time for each (20)")
    parser.add_argument("--memory", type=int, default=200, help="MB beyond what the file holds")
    parser.add_argument("--load", default=LOAD, help="module:function of a path")
    parser.add_argument("--relight", default=RELIGHT, help="module:function of an asset, or none")
    parser.add_argument("--save", metavar="INDEX:FILE", help="write one mutant to a file and end")
    parser.add_argument("--json", metavar="FILE", help="write counts and failures")
    options = parser.parse_args(arguments)
    if options.save:
        index, _, target = options.save.partition(":")
        local, number = divmod(int(index), len(options.files))
        mutator = Mutator(Path(options.files[number]).read_bytes(), PLACEHOLDERS, number)
        kind, what, content = mutator.make(options.seed, local)
        Path(target).write_bytes(content)
        print(f"{kind}: {what}")
        return 0
    for name in (options.load, options.relight):
        _found(name)  # imported before workers are forked
    start = time.monotonic()
    tally = fuzz(options.files, options)
    seconds = time.monotonic() - start
    print(tally.table())
    print(f"\n{options.count / seconds:.0f} files a second, seed {options.seed}")
    for failure in tally.failures[:50]:
        print(failure)
    if options.json:
        counts = [[*key, count] for key, count in sorted(tally.counts.items())]
        Path(options.json).write_text(json.dumps({"counts": counts, "failures": tally.failures}))
    return 1 if tally.failures else 0


# In the place of a worker's traps, so that a saved mutant is the one that was tried.
PLACEHOLDERS = ["trap.txt", "trap.xml", "trap.fifo"]

if __name__ == "__main__":
    sys.exit(main())
