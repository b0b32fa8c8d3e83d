"""What the monitor needs and does not reach, such as its database or its broker: since when, why, how often, how long.

A part of its own that raised an error, such as the decoder of messages, is an outage as well.

An outage is said once in the log when it begins and once when it ends, and stands on the page and in the metrics.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_log = logging.getLogger(__name__)
#: Parts that can be away.
DATABASE, BROKER, WEBHOOK, OPCUA = "database", "broker", "webhook", "OPC UA server"


@dataclass
class _Part:
    """How one part is: `since` is the clock of its outage [s], None while it is reached."""

    since: float | None = None
    began: float = 0.0
    reason: str = ""
    outages: int = 0
    seconds: float = 0.0


class Outages:
    """The parts of a monitor that can be away; may be used by several threads.

    `changed`: called when an outage begins or ends.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._parts: dict[str, _Part] = {}

    def expect(self, part: str) -> None:
        """State that the monitor needs a part, which is counted as reached until it is lost."""
        with self._lock:
            self._parts.setdefault(part, _Part())

    def lost(self, part: str, reason: object) -> None:
        """State that a part is not reached; the first reason of an outage is kept."""
        line = " ".join(str(reason).splitlines()[:1])[:200]
        with self._lock:
            entry = self._parts.setdefault(part, _Part())
            if entry.since is not None:
                return
            entry.since, entry.began, entry.reason = time.time(), time.monotonic(), line
            entry.outages += 1
        _log.error("the %s is not reached: %s", part, line)
        self._changed()

    def back(self, part: str) -> None:
        """State that a part is reached."""
        with self._lock:
            entry = self._parts.setdefault(part, _Part())
            if entry.since is None:
                return
            lasted = time.monotonic() - entry.began
            entry.since, entry.seconds = None, entry.seconds + lasted
        _log.warning("the %s is reached again after %.1f s", part, lasted)
        self._changed()

    def plain(self) -> list[dict[str, Any]]:
        """Return the outages that last: part, clock of its begin [s] and reason."""
        with self._lock:
            return [
                {"part": part, "since": entry.since, "reason": entry.reason}
                for part, entry in self._parts.items()
                if entry.since is not None
            ]

    def totals(self) -> dict[str, tuple[bool, int, float]]:
        """Return of each part whether it is reached, how many outages it had and how long they lasted [s]."""
        now = time.monotonic()
        with self._lock:
            return {
                part: (
                    entry.since is None,
                    entry.outages,
                    entry.seconds + (now - entry.began if entry.since is not None else 0.0),
                )
                for part, entry in self._parts.items()
            }
