"""Processes that start at once, for tests that kill them: forks of one that has imported a module
of tests, and with it Mitsuba, but has run no kernel and so has none of Dr.Jit's threads.

    python tests/forked.py MODULE

serves them: each line of its stdin is a function of that module with its arguments.
"""

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from pathlib import Path

from mi_prt.system.runtime import mitsuba


class Starter:
    """Starts functions of a module in processes of their own, one after the other.

    A context: it ends the process that is forked. CUDA does not go through a fork; with it each
    function gets a new process.
    """

    def __init__(self, module):
        self._module, self._folder = module, tempfile.TemporaryDirectory()
        self._server = None if mitsuba().variant().startswith("cuda") else self._serve()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._server:
            _end(self._server)
        self._folder.cleanup()

    def _serve(self):
        return subprocess.Popen(
            [sys.executable, __file__, self._module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def start(self, function, *arguments):
        """The running Forked of a function by name, with arguments that JSON can hold."""
        server = self._server or self._serve()
        return Forked(server, not self._server, Path(self._folder.name), function, arguments)


class Forked:
    """A process, used as one of `subprocess`: `stdout` has its lines, `returncode` is there after
    `communicate`.
    """

    def __init__(self, server, alone, folder, function, arguments):
        self._server, self._alone = server, alone
        self._errors, lines = folder / "errors", folder / "lines"
        lines.unlink(missing_ok=True)
        os.mkfifo(lines)
        command = [str(lines), str(self._errors), function, *arguments]
        print(json.dumps(command), file=server.stdin, flush=True)
        # a server that could not import the module ends, and nobody would ever open the pipe
        started = server.stdout.readline()
        assert started, f"{function} could not be started"
        self.pid, self.returncode = int(started), None
        self.stdout = open(lines)  # noqa: SIM115

    def send_signal(self, number):
        """Also to one that has come to its end: nothing reuses its number before the server asks
        for its status, which it does only once it is read here.
        """
        os.kill(self.pid, number)

    def communicate(self, timeout=60):
        """The rest of stdout, and stderr, at its end; after so many seconds it is killed."""
        watch = threading.Timer(timeout, self.send_signal, [signal.SIGKILL])
        watch.start()
        with self.stdout as file:
            output = file.read()
        watch.cancel()
        watch.join()
        print(file=self._server.stdin, flush=True)
        self.returncode = int(self._server.stdout.readline())
        if self._alone:
            _end(self._server)
        return output, self._errors.read_text()


def _end(server):
    server.stdin.close()
    server.wait(60)
    server.stdout.close()


def _serve(module):
    module = importlib.import_module(module)
    for line in sys.stdin:
        command = json.loads(line)
        if not (child := os.fork()):
            _run(module, *command)
        print(child, flush=True)
        sys.stdin.readline()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(status, flush=True)


def _run(module, lines, errors, function, *arguments):
    """In the child, which never comes back from here."""
    status = 1
    try:
        for path, stream in ((errors, sys.stderr), (lines, sys.stdout)):
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(handle, stream.fileno())
            os.close(handle)
        getattr(module, function)(*arguments)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one of the tests ends this by its pipe
    _serve(sys.argv[1])
