"""Work that a damaged file can crash or hold for ever, done in a process of its own with a time limit.

The C libraries of some formats do both, and no signal reaches them. The process is started when it is first needed,
serves one request after the other, and ends with the program. It is a fresh interpreter and not a copy of the program,
so that scripts need no guard.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from threading import Lock, Timer
from typing import Any, TypeVar

from sealscope.errors import SealscopeError

T = TypeVar("T")
#: Time that starting the process may take beside the work [s].
_START = 30.0
#: Memory that the process may take [bytes]: the values that a recording may have, a few times over.
MOST_MEMORY = 12 * 2**30


class CrashedApartError(RuntimeError):
    """The process ended before it had an answer."""


class _RaisedApart(Exception):  # noqa: N818 - it is raised by nobody: the cause that a traceback shows
    """The traceback of what was raised in the other process."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class _Server:
    """The process, and the lock that gives it one request at a time."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.process: subprocess.Popen[bytes] | None = None

    def ask(self, request: bytes, limit: float) -> Any:
        with self.lock:
            fresh = self.process is None or self.process.poll() is not None
            if fresh:
                self.process = subprocess.Popen(
                    [sys.executable, "-m", "sealscope.recordings.apart"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                )
            process = self.process
            assert process is not None and process.stdin is not None and process.stdout is not None
            overdue = Timer(limit + _START * fresh, process.kill)
            overdue.daemon = True
            overdue.start()
            try:
                process.stdin.write(request)
                process.stdin.flush()
                return pickle.load(process.stdout)
            except (EOFError, OSError, pickle.UnpicklingError):
                what = "crashed" if overdue.is_alive() else f"took over {limit:g} s"
                self._end()
                raise CrashedApartError(f"the library that reads it {what}") from None
            except BaseException:  # an interrupt: the answer would come to the next request
                self._end()
                raise
            finally:
                overdue.cancel()

    def _end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None


_server = _Server()


def apart(work: Callable[..., T], *arguments: Any, limit: float) -> T:
    """Return ``work(*arguments)``, carried out in a process of its own.

    Parameters
    ----------
    work : callable
        A function of a module, with arguments and a result that can be pickled.
    *arguments
        What it is called with.
    limit : float
        Longest time that it may take [s].

    Raises
    ------
    CrashedApartError
        The process crashed or took longer.
    SealscopeError, RuntimeError
        What the function raised; other kinds are a RuntimeError of the same text.
    """
    value, where = _server.ask(pickle.dumps((work, arguments)), limit)
    if where is not None:
        raise value from _RaisedApart(where)
    return value  # type: ignore[no-any-return]


def _limit_memory() -> None:
    """Let this process take `MOST_MEMORY` at most, where the system can: a tiny file may ask for any amount."""
    with suppress(ImportError, AttributeError, OSError, ValueError):
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = MOST_MEMORY if hard == resource.RLIM_INFINITY else min(MOST_MEMORY, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def _serve() -> None:
    """Answer requests on standard input until it ends; what libraries print goes nowhere."""
    _limit_memory()
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115 - for the life of the process
    with suppress(EOFError, KeyboardInterrupt, BrokenPipeError):
        while True:
            work, arguments = pickle.load(sys.stdin.buffer)
            try:
                answer: tuple[Any, str | None] = (work(*arguments), None)
            except SealscopeError as error:
                answer = (error, traceback.format_exc())
            except Exception as error:
                answer = (RuntimeError(" ".join(str(error).split()) or type(error).__name__), traceback.format_exc())
            answers.write(pickle.dumps(answer, protocol=5))
            answers.flush()


if __name__ == "__main__":
    _serve()
