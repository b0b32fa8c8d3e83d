"""The supervisor runs every part of a monitor (sources, decoders and outputs) and restarts it after an error.

An error of a part, or of a service that it needs, begins an outage. It is logged once when it begins and once when it
ends; meanwhile the page and the metrics show it. A part restarts after a pause that doubles each time. An error of
the database counts as an outage of the part `DATABASE`.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sealscope.errors import printable

_log = logging.getLogger(__name__)
#: Parts that stand for external services.
DATABASE, BROKER, OPCUA = "database", "broker", "OPC UA server"
#: Pauses after errors [s]: the first one, the longest one, and the longest one in an outage of the database.
FIRST_PAUSE_S, MAX_PAUSE_S, DATABASE_PAUSE_S = 0.2, 60.0, 5.0
#: A restarted part counts as reached after running for this long [s].
_WORKING_S = 2.0
#: Most log lines per minute from one place in the code of this package, and of a library; a minute [s].
_PACKAGE_LINES, _LIBRARY_LINES, _MINUTE_S = 300, 10, 60.0
#: Most places in the code whose log lines are counted.
_MAX_PLACES = 1000
_PACKAGE = Path(__file__).resolve().parents[1]
_Work = Callable[[], object]


class PartAway(Exception):  # noqa: N818 (says what happened)
    """Raised by a part of the monitor that lacks something it needs; its text alone is the reason of the outage."""


class SupervisedPart:
    """A part of a monitor, or a service that it uses, with its outages and the pause after an error.

    `name`: name in the log, on the page and in metrics. Only one thread at a time may call `attempt`.
    """

    def __init__(self, name: str, supervisor: Supervisor) -> None:
        self.name, self._supervisor = name, supervisor
        self.since: float | None = None  # start of the present outage [s since 1970]
        self.reason = ""  # of the present outage
        self.count, self.seconds = 0, 0.0  # number of outages so far, and length of those that have ended [s]
        self._began = 0.0  # monotonic time at which the present outage began [s]
        self._pause = self._due = 0.0  # length of the last pause [s], and the monotonic time at which it ends
        self._lock = threading.Lock()

    def begin_outage(self, reason: object) -> None:
        """Begin an outage of the part and log it; an outage that has begun before continues with its first reason."""
        with self._lock:
            if self.since is not None:
                return
            self.since, self._began, self.count = time.time(), time.monotonic(), self.count + 1
            self.reason = " ".join(str(reason).splitlines()[:1])[:200]
        _log.error("the %s is not reached: %s", self.name, self.reason)
        self._supervisor.on_change()

    def end_outage(self) -> None:
        """End the outage of the part, if there is one, and log this; the next pause is the shortest again."""
        with self._lock:
            self._pause = 0.0
            if self.since is None:
                return
            duration = self.outage_s
            self.since, self.seconds = None, self.seconds + duration
        _log.warning("the %s is reached again after %.1f s", self.name, duration)
        self._supervisor.on_change()

    @property
    def outage_s(self) -> float:
        """Length of the present outage so far [s], 0 if there is none."""
        return 0.0 if self.since is None else time.monotonic() - self._began

    @property
    def pause_s(self) -> float:
        """Time that remains until the next attempt is allowed [s], 0 if it is allowed now."""
        return max(0.0, self._due - time.monotonic())

    def attempt(self, work: _Work, *, at_once: bool = False) -> bool:
        """Run the function `work` unless the part pauses after an error; return True if it ran without an error.

        An error begins an outage of the part, or of the database if the error comes from the database. It also begins a
        pause, twice as long as the last one up to a limit. Success ends the outage of the part. `at_once`: True to
        ignore a pause. The reason of an outage also states the place in the code, except for PartAway and the database.
        """
        if self.pause_s and not at_once:
            return False
        try:
            work()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # panics of Rust extensions and exits of uvicorn do not derive from Exception
            reason = self._supervisor.outage_reason(error)
            max_pause = MAX_PAUSE_S if reason is None else DATABASE_PAUSE_S
            self._pause = min(max(2.0 * self._pause, FIRST_PAUSE_S), max_pause)
            self._due = time.monotonic() + self._pause
            if reason is not None:
                self._supervisor.part(DATABASE).begin_outage(reason)
            else:
                self.begin_outage(error if isinstance(error, PartAway) else describe_error(error))
                _log.debug("the %s raised an error", self.name, exc_info=error)
            return False
        self.end_outage()
        return True


class Supervisor:
    """The parts of a monitor and their threads, which run until the event `stopping` is set.

    `outage_reason`: function that returns the reason of an outage for an error of the database, None for other errors;
    `on_change`: function called when an outage begins or ends.
    """

    def __init__(
        self,
        outage_reason: Callable[[BaseException], str | None] = lambda error: None,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self.outage_reason, self.on_change, self.stopping = outage_reason, on_change, threading.Event()
        self._parts: dict[str, SupervisedPart] = {}
        self._lock = threading.Lock()

    def part(self, name: str) -> SupervisedPart:
        """Return the part of the monitor called `name`, such as "database"; create it if it does not exist."""
        with self._lock:
            if name not in self._parts:
                self._parts[name] = SupervisedPart(name, self)
            return self._parts[name]

    def outages(self) -> list[dict[str, Any]]:
        """List the present outages, each with the name of the part, its start [s since 1970] and its reason."""
        parts = [*self._parts.values()]  # a copy, as other threads may add parts
        return [{"part": part.name, "since": part.since, "reason": part.reason} for part in parts if part.since]

    def outage_totals(self) -> dict[str, tuple[bool, int, float]]:
        """Summarise the outages of each part by its name.

        A summary is a tuple: True if the part has no outage now, number of its outages, and their total length [s].
        """
        parts = [*self._parts.values()]
        return {part.name: (part.since is None, part.count, part.seconds + part.outage_s) for part in parts}

    def start(self, name: str, work: _Work, *, restart: bool = True, on_end: _Work = lambda: None) -> threading.Thread:
        """Start a thread that runs `work` as the part `name`, and calls `on_end` when it has ended.

        `restart`: True to run `work` again after an error, until it ends without an error or the monitor stops.
        """
        part = self.part(name)

        def work_with_timer() -> None:
            # `work` may run as long as the monitor: the outage ends before `work` does
            timer = threading.Timer(_WORKING_S, part.end_outage)
            timer.daemon = True
            timer.start()
            try:
                work()
            finally:
                timer.cancel()

        def run_until_success() -> None:
            while not part.attempt(work_with_timer) and restart and not self.stopping.wait(part.pause_s):
                pass
            on_end()

        return _start_thread(run_until_success, name)

    def repeat(self, name: str, step: _Work, every_s: float, *, last: _Work) -> threading.Thread:
        """Start a thread that runs `step` every `every_s` [s] as the part `name`, and `last` when the monitor stops.

        After an error, `step` runs again when the pause of the part has ended.
        """
        part = self.part(name)

        def run_steps() -> None:
            while not self.stopping.wait(max(every_s, part.pause_s)):
                part.attempt(step)
            part.attempt(last, at_once=True)

        return _start_thread(run_steps, name)


class LimitedLines(logging.Filter):
    """A log filter that limits the number of lines per minute from one place in the code, and makes each printable."""

    def __init__(self) -> None:
        super().__init__()
        # by place (logger, file, line): start of the minute [s], and number of records since then
        self._places: dict[tuple[str, str, int], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if a log record is within the limit for its place in the code; make it one printable line.

        The first record after a minute also states how many lines were left out during that minute.
        """
        place = (record.name, record.pathname, record.lineno)
        max_lines = _PACKAGE_LINES if record.name.startswith("sealscope") else _LIBRARY_LINES
        now = time.monotonic()
        minute_start, n_records = self._places.get(place, (now, 0))
        if now - minute_start >= _MINUTE_S:
            if n_records > max_lines:
                left_out = f"({n_records - max_lines} lines like it were left out)"
                record.msg, record.args = f"{record.getMessage()} {left_out}", None
            minute_start, n_records = now, 0
        if len(self._places) >= _MAX_PLACES and place not in self._places:
            self._places.clear()  # bounds the memory; all places are counted anew
        self._places[place] = minute_start, n_records + 1
        if not (text := record.getMessage()).isprintable():
            record.msg, record.args = printable(text), None
        return n_records < max_lines


def describe_error(error: BaseException) -> str:
    """Describe an error in one line, with the innermost line of this package in its traceback."""
    message = "".join(traceback.format_exception_only(error)[-1:]).strip()  # the last line has type and text
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = Path(frame.f_code.co_filename)
        if file.is_relative_to(_PACKAGE):  # the last such frame is the innermost
            place = f" ({file.relative_to(_PACKAGE).as_posix()}, line {line})"
    return f"{' '.join(message.split())[:120]}{place}"


def _start_thread(work: Callable[[], None], name: str) -> threading.Thread:
    thread = threading.Thread(target=work, name=name, daemon=True)
    thread.start()
    return thread
