"""Run risky work in subprocesses with limited time, memory and disk space.

A damaged file makes the C libraries of some formats crash, hang or fill the memory, and they do not react to signals.
A subprocess is started when it is first needed, serves one request after the other, and ends with the program. It is
a fresh interpreter, not a fork, so that scripts need no `__main__` guard; it imports nothing from the working folder.
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
from sealscope.storage.opening import MAX_UNPACKED

T = TypeVar("T")
_MAX_START_TIME = 30.0  # time that starting a process may take in addition to the work [s]
MAX_MEMORY = 12 * 2**30  # most memory of a process [bytes]: a few copies of the largest recording
_MAX_IDLE_MEMORY = 2**30  # a process that occupies more memory than this after a request is not used again [bytes]
_MAX_PROCESSES = 4  # most processes at a time: with several, a slow file does not delay the files of other threads
#: Environment that saves memory: libraries start a thread for each core, and Arrow's allocator reserves a gigabyte.
_LOW_MEMORY_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}


class CrashedSubprocessError(RuntimeError):
    """The subprocess ended before it returned a result."""


class _RemoteTraceback(Exception):  # noqa: N818 - never raised itself
    """The traceback of an error in the subprocess, shown as the cause of the error raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class _Process:
    """A subprocess that serves one request after the other."""

    def __init__(self) -> None:
        """Start a new Python interpreter, with a temporary folder of its own."""
        self._is_fresh = True
        self._folder = tempfile.TemporaryDirectory(prefix="sealscope-", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sealscope.recordings.subprocesses"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_LOW_MEMORY_ENVIRONMENT, "TMPDIR": self._folder.name},  # removed with the process
        )

    @property
    def is_alive(self) -> bool:
        """True while the subprocess is running."""
        return self._process.poll() is None

    def send(self, request: bytes, limit: float) -> tuple[Any, str | None, bool]:
        """Run a pickled request in the subprocess; return (result or error, traceback, is_spent).

        `request`: function, arguments and limits; `limit`: longest time of the work [s]. The traceback is that of the
        error as text, None for a result. `is_spent`: the process occupies too much memory to be used again. Raises
        CrashedSubprocessError if the process ends without an answer, or takes too long.
        """
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        # kills the process if the alarm of `_set_limits` is over 1 s late; a fresh process also needs time to start
        killer = Timer(limit + 1.0 + _MAX_START_TIME * self._is_fresh, process.kill)
        killer.daemon = True
        killer.start()
        try:
            process.stdin.write(request)
            process.stdin.flush()
            value, remote_traceback = pickle.load(process.stdout)
            is_spent = bool(pickle.load(process.stdout))
        except (EOFError, OSError, pickle.UnpicklingError):
            # the timer has fired; or the alarm's signal, whose negative number is returned, has ended the process
            timed_out = not killer.is_alive() or process.wait() == -getattr(signal, "SIGALRM", 0)
            failure = f"took more than {limit:g} s" if timed_out else "crashed"
            raise CrashedSubprocessError(f"the library that reads it {failure}") from None
        finally:
            killer.cancel()
        self._is_fresh = False
        return value, remote_traceback, is_spent

    def end(self) -> None:
        """Kill the subprocess and remove its temporary folder."""
        self._process.kill()
        self._process.communicate()
        self._folder.cleanup()


_slots = BoundedSemaphore(_MAX_PROCESSES)
_idle: list[_Process] = []


def _take_process() -> _Process:
    """Take an idle subprocess that is still alive, or start a new one."""
    with suppress(IndexError):  # none is idle
        while not (process := _idle.pop()).is_alive:
            process.end()
        return process
    return _Process()


def run_in_subprocess(
    work: Callable[..., T], *arguments: Any, limit: float, memory: int = MAX_MEMORY, disk: int = MAX_UNPACKED
) -> T:
    """Run ``work(*arguments)`` in a subprocess and return its result; arguments and result are pickled.

    `limit`: longest time [s]; `memory`: most memory [bytes], at most `MAX_MEMORY` and half the machine's; `disk`:
    largest file that it may write [bytes]. Raises CrashedSubprocessError if the process crashes or exceeds `limit`.
    SealscopeError and MemoryError of `work` are raised as they are, other errors as a RuntimeError with the same text.
    """
    with _slots:
        process = _take_process()
        try:
            value, remote_traceback, is_spent = process.send(
                pickle.dumps((work, arguments, (limit, memory, disk))), limit
            )
        except BaseException:  # after an interrupt, too: the next request would read this one's result
            process.end()
            raise
        if is_spent:
            process.end()
        else:
            _idle.append(process)
    if remote_traceback is not None:
        raise value from _RemoteTraceback(remote_traceback)
    return value  # type: ignore[no-any-return]


def run_on_file(work: Callable[..., T], file: Path, *arguments: Any, **limits: Any) -> T:
    """Run ``work(file, *arguments)`` in a subprocess by `run_in_subprocess`, whose keyword arguments are `limits`.

    The work gets the absolute path, as the subprocess may run in another folder. If it raises UnreadableFile, the
    message names the path as it was given.
    """
    place = file.absolute()
    try:
        return run_in_subprocess(work, place, *arguments, **limits)
    except UnreadableFile as error:
        raise UnreadableFile(str(error).replace(str(place), str(file))) from error


def _set_limits(seconds: float, memory: int, disk: int) -> None:
    """Limit this process to `seconds` [s], `memory` [bytes] and written files of up to `disk` [bytes] each.

    The memory is limited to `MAX_MEMORY` and half the machine's, too. The system's timer ends the process even if its
    parent is dead; 0 s is no limit. Only Unix has these limits.
    """
    with suppress(ImportError, AttributeError, OSError, ValueError):
        signal.setitimer(signal.ITIMER_REAL, seconds)
        import resource

        machine_memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        for resource_kind, limit in (
            (resource.RLIMIT_DATA, min(memory, MAX_MEMORY, machine_memory // 2)),
            (resource.RLIMIT_FSIZE, disk),
        ):
            _, hard = resource.getrlimit(resource_kind)
            resource.setrlimit(resource_kind, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _is_spent() -> bool:
    """Test whether this process occupies more memory than `_MAX_IDLE_MEMORY`; False if the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[5])  # data pages, which RLIMIT_DATA limits
    except OSError:
        return False
    return pages * os.sysconf("SC_PAGE_SIZE") > _MAX_IDLE_MEMORY


def _serve() -> None:
    """Run requests from standard input, one after the other, and answer to standard output until the input ends."""
    # answers go to a copy of standard output; standard output itself then discards the output of libraries
    responses = os.fdopen(os.dup(1), "wb")
    discard = os.open(os.devnull, os.O_WRONLY)
    os.dup2(discard, 1)
    sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115 - for the life of the process
    with suppress(EOFError, KeyboardInterrupt, BrokenPipeError):
        while True:
            work, arguments, limits = pickle.load(sys.stdin.buffer)
            _set_limits(*limits)
            value, error_traceback = _run_work(work, arguments)
            _set_limits(seconds=0.0, memory=MAX_MEMORY, disk=MAX_UNPACKED)  # until the next request
            responses.write(pickle.dumps((value, error_traceback), protocol=5))
            del work, arguments, value  # so that `_is_spent` does not count them
            pickle.dump(_is_spent(), responses)
            responses.flush()
    with suppress(OSError):  # nobody else removes the temporary folder if the program was killed
        Path(tempfile.gettempdir()).rmdir()


def _run_work(work: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, str | None]:
    """Call `work`; return (result, None), or (error that the program can unpickle, traceback as text)."""
    try:
        return work(*arguments), None
    except (SealscopeError, MemoryError) as error:
        return error, traceback.format_exc()
    except Exception as error:
        return RuntimeError(" ".join(str(error).split()) or type(error).__name__), traceback.format_exc()


if __name__ == "__main__":
    _serve()
