"""Call the code of plug-ins, which may hang, end the process or print, so that the call that uses them goes on.

A plug-in is a program that the user has installed, and runs as such, in this process. Each call of its code runs in a
thread with a time limit; what it prints goes to the standard error, as the standard output has results. An exit becomes
an error like any other. Not prevented is what no process can prevent in itself: a crash of compiled code, `os._exit`,
the use of all memory, and threads and exit handlers that a plug-in leaves behind.
"""

from __future__ import annotations

import contextvars
import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from typing import Any, TypeVar

from sealscope.errors import printable

_Result = TypeVar("_Result")
#: Time limit of a call [s], and what is added to it for each sample of the recordings that it gets [s].
LIMIT_S, SAMPLE_S = 30.0, 6e-5
#: Most letters of an error's text.
_MAX_TEXT = 300


class _SharedRedirection:
    """The redirection of this process's standard output, which calls of plug-ins in several threads share."""

    def __init__(self) -> None:
        self._lock, self._depth = threading.Lock(), 0
        self._saved_descriptor: int | None = None
        self._redirection: Any = None

    def begin(self) -> None:
        """Send what is printed to the standard error, also by compiled code and processes that are started."""
        with self._lock:
            self._depth += 1
            if self._depth > 1:
                return
            self._redirection = redirect_stdout(sys.stderr)
            with suppress(OSError, ValueError, AttributeError):  # no standard output, or one without a descriptor
                sys.stdout.flush()  # what is printed before belongs there
                if sys.stdout.fileno() == 1:
                    self._saved_descriptor = os.dup(1)
                    os.dup2(2, 1)
            self._redirection.__enter__()

    def end(self) -> None:
        """Restore the standard output after the last of the calls."""
        with self._lock:
            self._depth -= 1
            if self._depth:
                return
            self._redirection.__exit__(None, None, None)
            if self._saved_descriptor is not None:
                os.dup2(self._saved_descriptor, 1)
                os.close(self._saved_descriptor)
                self._saved_descriptor = None


_redirection = _SharedRedirection()


@contextmanager
def _printing_to_standard_error() -> Iterator[None]:
    _redirection.begin()
    try:
        yield
    finally:
        _redirection.end()


def call_plug_in(function: Callable[..., _Result], *arguments: Any, n_samples: int = 0) -> _Result:
    """Call a function of a plug-in and return its result, or raise the error of the function.

    `n_samples`: number of samples that it has to work on. Raises TimeoutError if it does not end within `LIMIT_S` and
    `SAMPLE_S` for each sample; its thread is then told to end. Raises RuntimeError if it tries to end the process.
    """
    limit = LIMIT_S + SAMPLE_S * n_samples
    results: list[_Result] = []
    errors: list[BaseException] = []
    context = contextvars.copy_context()  # with NumPy's handling of arithmetic errors

    def run() -> None:
        try:
            results.append(context.run(function, *arguments))
        except BaseException as error:  # an exit, too
            errors.append(error)

    thread = threading.Thread(target=run, name="plug-in", daemon=True)
    with _printing_to_standard_error():
        thread.start()
        thread.join(limit)
        if thread.is_alive():
            _interrupt(thread)
            raise TimeoutError(f"it must end within {limit:.3g} s")
    if errors:
        raise _as_exception(errors[0])
    return results[0]


def _interrupt(thread: threading.Thread) -> None:
    """Raise SystemExit in a thread, as soon as it runs Python code; wait a little for its end."""
    if thread.ident is not None:
        _raise_in_thread(thread.ident, SystemExit)
    thread.join(0.5)
    if thread.is_alive():
        _clear_signal()


class _SignalClearedError(BaseException):
    """An exception that this thread raises in itself (`_clear_signal`)."""


def _raise_in_thread(ident: int, error: type[BaseException]) -> None:
    """Raise an exception in a thread, as soon as it runs Python code."""
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(error))


def _clear_signal() -> None:
    """Clear the interpreter's flag that an exception waits for a thread, which may wait in the system forever.

    All threads look at this flag; while it is set, they run slower, and CPython 3.11 hangs in a profiled function. It
    is cleared by any thread in which such an exception is raised.
    """
    try:
        _raise_in_thread(threading.get_ident(), _SignalClearedError)
        for _ in range(1000):  # the exception is raised within
            pass
    except _SignalClearedError:
        pass


def _as_exception(error: BaseException) -> Exception:
    """Convert an error of a plug-in to one that ends no process, and whose text is one short line."""
    if isinstance(error, SystemExit):
        return RuntimeError(f"it must not end the process, got sys.exit({_format_text(error.code)})")
    if not isinstance(error, Exception):
        return RuntimeError(f"it must raise an Exception, got {type(error).__name__}")
    try:
        is_short = len(str(error)) <= _MAX_TEXT
    except Exception:  # the text of an error is code of the plug-in, too
        return RuntimeError(f"it raised {type(error).__name__}, which has no text")
    return error if is_short else RuntimeError(f"{type(error).__name__}: {_format_text(error)}")


def _format_text(value: object) -> str:
    """Format a value of a plug-in as one short line."""
    try:
        return printable(" ".join(str(value).split())[:_MAX_TEXT])
    except Exception:
        return type(value).__name__
