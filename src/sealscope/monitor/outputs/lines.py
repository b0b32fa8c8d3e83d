"""Alarms as JSON lines: every event once more after a crash rather than never."""

from __future__ import annotations

import json
from typing import Any, TextIO

from sealscope.monitor.memory.store import MonitorStore

_NAME = "lines"
#: Events that a shelved alarm keeps to itself.
_BY_ITSELF = ("raised", "error", "warning", "returned")


def announced(event: dict[str, Any]) -> bool:
    """Whether an event goes out: what happens to a shelved alarm by itself does not, what a person does always."""
    return event["event"] not in _BY_ITSELF or not event["alarm"]["shelved"]


class EventLines:
    """Writes the events of a store, in their order, to a stream of text.

    How far it is stands in the store, so that a restart goes on there; an event whose line was written just before a
    crash is written again, with the same number. What happens to a shelved alarm is left out.
    """

    def __init__(self, store: MonitorStore, stream: TextIO) -> None:
        self._store, self._stream = store, stream

    def pass_on(self) -> None:
        """Write what is new."""
        events = self._store.events_since(self._store.position(_NAME)) if self._store.sends else []
        if not events:
            return
        for _, event in events:
            if announced(event):
                self._stream.write(json.dumps(event) + "\n")
        self._stream.flush()
        self._store.keep_position(_NAME, events[-1][0])
