"""The supervisor: every source, decoder and output of a monitor runs under it, and starts again after an error.

What a part needs and does not reach, and an error of the part itself, are outages: said once in the log when each
begins and ends, shown on page and metrics while it lasts. A part starts again after a pause that doubles. An error of
the database is the database's outage.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from sealscope.errors import printable

_log = logging.getLogger(__name__)
#: Parts that can be away.
DATABASE, BROKER, WEBHOOK, OPCUA = "database", "broker", "webhook", "OPC UA server"
#: Pauses after errors [s]: the first one, the longest one, and the longest one where the database is away.
FIRST_PAUSE_S, LONGEST_PAUSE_S, DATABASE_PAUSE_S = 0.2, 60.0, 5.0
#: A part that has run for so long [s] since it was started again counts as reached.
_WORKING_S = 2.0
#: Lines in a minute from one place in the code: of this package, and of the libraries that it uses.
_OWN_LINES, _LIBRARY_LINES, _MINUTE_S, _MOST_PLACES = 300, 10, 60.0, 1000
_PACKAGE = Path(__file__).resolve().parents[1]


class PartAway(Exception):  # noqa: N818 (says what happened)
    """A part lacks a thing it needs, such as a folder: an outage with this reason and no traceback."""


class SupervisedPart:
    """A part that a monitor runs, or can do without for a time: its outages, and its pause after errors.

    Several threads may say how it is; one at a time attempts it. `since`: clock of its outage [s], None while it is
    reached; `count`, `seconds`: outages so far, and how long those that are over lasted.
    """

    def __init__(self, name: str, supervisor: Supervisor) -> None:
        self.name, self._supervisor = name, supervisor
        self.since: float | None = None
        self.reason, self.count, self.seconds, self._began = "", 0, 0.0, 0.0
        self._pause = self._due = 0.0
        self._lock = threading.Lock()

    def begin_outage(self, reason: object) -> None:
        """Begin an outage, or continue it with its first reason."""
        with self._lock:
            if self.since is not None:
                return
            self.since, self._began, self.count = time.time(), time.monotonic(), self.count + 1
            self.reason = " ".join(str(reason).splitlines()[:1])[:200]
        _log.error("the %s is not reached: %s", self.name, self.reason)
        self._supervisor.changed()

    def end_outage(self) -> None:
        """End the outage, if there is one."""
        with self._lock:
            self._pause = 0.0
            if self.since is None:
                return
            lasted = self.lasting_s
            self.since, self.seconds = None, self.seconds + lasted
        _log.warning("the %s is reached again after %.1f s", self.name, lasted)
        self._supervisor.changed()

    @property
    def lasting_s(self) -> float:
        """The length of the present outage so far [s]."""
        return 0.0 if self.since is None else time.monotonic() - self._began

    @property
    def pause_s(self) -> float:
        """The rest of the pause [s]."""
        return max(0.0, self._due - time.monotonic())

    def attempt(self, work: Callable[[], object], *, at_once: bool = False) -> bool:
        """Run work, unless the part pauses; return whether it ended without an error. `at_once`: without the pause."""
        if self.pause_s and not at_once:
            return False
        try:
            work()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a panic of an extension in Rust and an exit of uvicorn are no Exception
            reason = self._supervisor.outage_reason(error)
            longest = LONGEST_PAUSE_S if reason is None else DATABASE_PAUSE_S
            self._pause = min(max(2.0 * self._pause, FIRST_PAUSE_S), longest)
            self._due = time.monotonic() + self._pause
            if reason is not None:
                self._supervisor.part(DATABASE).begin_outage(reason)
            else:
                self.begin_outage(error if isinstance(error, PartAway) else place_of(error))
                _log.debug("the %s raised an error", self.name, exc_info=error)
            return False
        self.end_outage()
        return True


class Supervisor:
    """The parts of a monitor; those that run in threads of their own do so until `stopping` is set.

    `outage_reason`: why the database does not answer, None for another error; `changed`: called when
    an outage begins or ends.
    """

    def __init__(
        self,
        outage_reason: Callable[[BaseException], str | None] = lambda error: None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.outage_reason, self.changed, self.stopping = outage_reason, changed, threading.Event()
        self._parts: dict[str, SupervisedPart] = {}
        self._lock = threading.Lock()

    def part(self, name: str) -> SupervisedPart:
        """Return the part of a name, which counts as reached until it is lost."""
        with self._lock:
            if name not in self._parts:
                self._parts[name] = SupervisedPart(name, self)
            return self._parts[name]

    def outages(self) -> list[dict[str, Any]]:
        """Return the outages that last: part, clock of its begin [s] and reason."""
        known = [*self._parts.values()]
        return [
            {"part": part.name, "since": part.since, "reason": part.reason} for part in known if part.since is not None
        ]

    def totals(self) -> dict[str, tuple[bool, int, float]]:
        """Return the availability, the number of outages and their total length [s] of each part."""
        return {
            part.name: (part.since is None, part.count, part.seconds + part.lasting_s)
            for part in [*self._parts.values()]
        }

    def start(
        self, name: str, work: Callable[[], object], *, again: bool = True, ended: Callable[[], object] = lambda: None
    ) -> threading.Thread:
        """Start a thread that runs work, again after each error, until it ends without one, then `ended`.

        `again`: False where an error ends it as well.
        """
        part = self.part(name)

        def lasting() -> None:
            timer = threading.Timer(_WORKING_S, part.end_outage)
            timer.daemon = True
            timer.start()
            try:
                work()
            finally:
                timer.cancel()

        def attempts() -> None:
            while not part.attempt(lasting) and again and not self.stopping.wait(part.pause_s):
                pass
            ended()

        return _start_thread(attempts, name)

    def repeat(
        self, name: str, step: Callable[[], object], every_s: float, *, last: Callable[[], object] | None = None
    ) -> threading.Thread:
        """Start a thread that runs a step every so many seconds, and `last` when `stopping` is set."""
        part = self.part(name)

        def attempts() -> None:
            while not self.stopping.wait(max(every_s, part.pause_s)):
                part.attempt(step)
            if last is not None:
                part.attempt(last, at_once=True)

        return _start_thread(attempts, name)


class LimitedLines(logging.Filter):
    """Lets through so many lines a minute from one place in the code, and says how many it has left out.

    Each message becomes one line that can be printed: names come from outside.
    """

    def __init__(self) -> None:
        super().__init__()
        self._places: dict[tuple[str, str, int], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Test whether a record is one of the first of its place in this minute."""
        place = (record.name, record.pathname, record.lineno)
        now, most = time.monotonic(), _OWN_LINES if record.name.startswith("sealscope") else _LIBRARY_LINES
        began, count = self._places.get(place, (now, 0))
        if now - began >= _MINUTE_S:
            if count > most:
                record.msg, record.args = f"{record.getMessage()} ({count - most} lines like it were left out)", None
            began, count = now, 0
        if len(self._places) >= _MOST_PLACES and place not in self._places:
            self._places.clear()
        self._places[place] = began, count + 1
        if not (text := record.getMessage()).isprintable():
            record.msg, record.args = printable(text), None
        return count < most


def place_of(error: BaseException) -> str:
    """Describe in one line an error and the last place of this package on its way."""
    kind = "".join(traceback.format_exception_only(error)[-1:]).strip()
    where, step = "", error.__traceback__
    while isinstance(step, TracebackType):
        file = Path(step.tb_frame.f_code.co_filename)
        if file.is_relative_to(_PACKAGE):
            where = f" ({file.relative_to(_PACKAGE).as_posix()}, line {step.tb_lineno})"
        step = step.tb_next
    return f"{' '.join(kind.split())[:120]}{where}"


def _start_thread(work: Callable[[], None], name: str) -> threading.Thread:
    thread = threading.Thread(target=work, name=name, daemon=True)
    thread.start()
    return thread
