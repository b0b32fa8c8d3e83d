"""Work that a damaged file can crash, hold for ever or fill the memory with, done in a process of its own with limits.

The C libraries of some formats do all three, and no signal reaches them. A process is started when it is first needed,
serves one request after the other, and ends with the program. It is a fresh interpreter and not a copy of the program,
so that scripts need no guard; it imports nothing from the working folder.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import BoundedSemaphore, Timer
from typing import Any, TypeVar

from sealscope.errors import SealscopeError, UnreadableFile
from sealscope.storage.unpacking import LARGEST

T = TypeVar("T")
#: Time that starting the process may take beside the work [s].
_START = 30.0
#: Memory that the process may take [bytes]: the values that a recording may have, a few times over.
MOST_MEMORY = 12 * 2**30
#: A process that keeps more after its work is not used again [bytes].
_KEPT_MEMORY = 2**30
#: Processes that work side by side at most: a file that takes long holds no other thread's files up.
_MOST_PROCESSES = 4
#: Threads of libraries take memory each, as many as the machine has cores; Arrow's own allocator reserves a gigabyte.
_LITTLE_MEMORY = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}


class CrashedApartError(RuntimeError):
    """The process ended before it had an answer."""


class _RaisedApart(Exception):  # noqa: N818 - it is raised by nobody: the cause that a traceback shows
    """The traceback of what was raised in the other process."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class _Process:
    """A process that carries out one request after the other."""

    def __init__(self) -> None:
        self._fresh = True
        self._folder = tempfile.TemporaryDirectory(prefix="sealscope-", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sealscope.recordings.apart"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_LITTLE_MEMORY, "TMPDIR": self._folder.name},  # what it leaves there is removed
        )

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def ask(self, request: bytes, limit: float) -> tuple[Any, str | None, bool]:
        """Run a request and return its result or error, the error's traceback, and True for a spent process."""
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        overdue = Timer(limit + 1.0 + _START * self._fresh, process.kill)  # it ends itself at its limit
        overdue.daemon = True
        overdue.start()
        try:
            process.stdin.write(request)
            process.stdin.flush()
            value, where = pickle.load(process.stdout)
            spent = bool(pickle.load(process.stdout))
        except (EOFError, OSError, pickle.UnpicklingError):
            late = not overdue.is_alive() or process.wait() == -getattr(signal, "SIGALRM", 0)
            what = f"took over {limit:g} s" if late else "crashed"
            raise CrashedApartError(f"the library that reads it {what}") from None
        finally:
            overdue.cancel()
        self._fresh = False
        return value, where, spent

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()
        self._folder.cleanup()


_places = BoundedSemaphore(_MOST_PROCESSES)
_idle: list[_Process] = []


def _process() -> _Process:
    """Return a process that waits for work, else a new one."""
    with suppress(IndexError):
        while True:
            process = _idle.pop()
            if process.alive:
                return process
            process.end()
    return _Process()


def run_apart(
    work: Callable[..., T], *arguments: Any, limit: float, memory: int = MOST_MEMORY, disk: int = LARGEST
) -> T:
    """Run ``work(*arguments)`` in a process of its own and return the result; arguments and result are pickled.

    `limit`: longest time that it may take [s]; `memory`: most that it may take [bytes], `MOST_MEMORY` and half the
    machine's at most; `disk`: longest file that it may write [bytes]. Raises CrashedApartError where the process
    crashed or took longer, and what the function raised: kinds that are not our own as a RuntimeError of its text.
    """
    with _places:
        process = _process()
        try:
            value, where, spent = process.ask(pickle.dumps((work, arguments, (limit, memory, disk))), limit)
        except BaseException:  # also an interrupt: the answer would come to the next request
            process.end()
            raise
        if spent:
            process.end()
        else:
            _idle.append(process)
    if where is not None:
        raise value from _RaisedApart(where)
    return value  # type: ignore[no-any-return]


def file_apart(work: Callable[..., T], file: Path, *arguments: Any, **limits: Any) -> T:
    """Run ``work(file, *arguments)`` by `run_apart`; errors name the file by the path given here."""
    place = file.absolute()  # the process may work in another folder
    try:
        return run_apart(work, place, *arguments, **limits)
    except UnreadableFile as error:
        raise UnreadableFile(str(error).replace(str(place), str(file))) from error


def _limit(seconds: float, memory: int, disk: int) -> None:
    """Limit time, memory and disk of this process, where the system can: it ends although its parent was killed."""
    with suppress(ImportError, AttributeError, OSError, ValueError):
        signal.setitimer(signal.ITIMER_REAL, seconds)
        import resource

        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        for kind, most in (
            (resource.RLIMIT_DATA, min(memory, MOST_MEMORY, machine // 2)),
            (resource.RLIMIT_FSIZE, disk),
        ):
            _, hard = resource.getrlimit(kind)
            resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _is_spent() -> bool:
    """Test whether this process holds more memory than a waiting process may."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[5])  # of data, which the limit counts
    except OSError:
        return False
    return pages * os.sysconf("SC_PAGE_SIZE") > _KEPT_MEMORY


def _serve() -> None:
    """Answer requests on standard input until it ends; what libraries print goes nowhere."""
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115 - for the life of the process
    with suppress(EOFError, KeyboardInterrupt, BrokenPipeError):
        while True:
            work, arguments, limits = pickle.load(sys.stdin.buffer)
            _limit(*limits)
            value, where = _carried_out(work, arguments)
            _limit(0.0, MOST_MEMORY, LARGEST)
            answers.write(pickle.dumps((value, where), protocol=5))
            del work, arguments, value
            pickle.dump(_is_spent(), answers)
            answers.flush()
    with suppress(OSError):  # the program may have been killed
        Path(tempfile.gettempdir()).rmdir()


def _carried_out(work: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, str | None]:
    """Run the work and return (result, None), or (error, traceback) with an error of a kind known to the program."""
    try:
        return work(*arguments), None
    except (SealscopeError, MemoryError) as error:
        return error, traceback.format_exc()
    except Exception as error:
        return RuntimeError(" ".join(str(error).split()) or type(error).__name__), traceback.format_exc()


if __name__ == "__main__":
    _serve()
