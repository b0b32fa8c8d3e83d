"""Alarms as JSON lines: every event once more after a crash rather than never."""

from __future__ import annotations

import json
import os
from typing import Any, TextIO

from sealscope.monitor.memory.store import MonitorStore
from sealscope.monitor.supervisor import PartAway

_NAME = "lines"
#: Events that a shelved alarm keeps to itself.
_BY_ITSELF = ("raised", "error", "warning", "returned")


def announced(event: dict[str, Any]) -> bool:
    """Whether an event goes out: what happens to a shelved alarm by itself does not, what a person does always."""
    return event["event"] not in _BY_ITSELF or not event["alarm"]["shelved"]


class EventLines:
    """Writes the events of a store, in their order, to a stream of text, or to nowhere where there is none.

    How far it is stands in the store, so that a restart goes on there; an event whose line was written just before a
    crash is written again, with the same number. What happens to a shelved alarm is left out. A stream that takes no
    more, or a part of a line, gets the rest later: no line is cut off or written twice.
    """

    def __init__(self, store: MonitorStore, stream: TextIO | None) -> None:
        self._store, self._stream = store, stream
        self._left, self._number = b"", 0

    def pass_on(self) -> None:
        """Write what is new; raises PartAway where the stream takes no more."""
        if not self._store.sends:
            return
        if not self._left:
            events = self._store.events_since(self._store.position(_NAME))
            if not events:
                return
            self._number = events[-1][0]
            self._left = "".join(json.dumps(event) + "\n" for _, event in events if announced(event)).encode()
        self._write()
        self._store.keep_position(_NAME, self._number)

    def _write(self) -> None:
        """Write what is left to the stream's file, past its buffer: what a full disk refuses must not stay in there."""
        try:
            if self._stream is None:
                raise OSError("it is closed")
            try:
                file = self._stream.fileno()
            except (OSError, ValueError):  # a stream in memory
                self._stream.write(self._left.decode())
                self._left = b""
                return
            self._stream.flush()
            while self._left:
                self._left = self._left[os.write(file, self._left) :]
        except (OSError, ValueError) as error:
            raise PartAway(getattr(error, "strerror", None) or error) from None
