"""Events as JSON: lines on a stream, posts to a web address; in their order, after a crash once more rather than never.

How far an output is stands in the store; an event that went out just before a crash goes out again, with its number.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from typing import Any, TextIO

import httpx

from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.supervisor import PartAway

logging.getLogger("httpx").setLevel(logging.WARNING)  # which tells each request
#: Events that a shelved alarm keeps to itself.
_BY_ITSELF = ("raised", "error", "warning", "returned")


def _is_announced(event: dict[str, Any]) -> bool:
    """Test whether an event is announced: of a shelved alarm only a person's acts are."""
    return event["event"] not in _BY_ITSELF or not event["alarm"]["shelved"]


class EventLines:
    """Writes the events of a store to a stream of text, or to nowhere where there is none.

    A stream that takes no more, or a part of a line, gets the rest later: no line is cut off or written twice.
    """

    def __init__(self, store: MonitorStore, stream: TextIO | None) -> None:
        self._store, self._stream = store, stream
        self._left, self._number = b"", 0  # of the line under way, and its event

    def pass_on(self) -> None:
        """Write the new events. Raise PartAway if the stream accepts no more."""
        self._store.pass_on("lines", self._write_line)

    def _write_line(self, event: dict[str, Any]) -> bool:
        """Write a line to the stream's file, past its buffer: what a full disk refuses must not stay in there."""
        if event["number"] != self._number:
            self._left, self._number = (json.dumps(event) + "\n").encode(), event["number"]
        try:
            if not _is_announced(event):
                return True
            if self._stream is None:
                raise OSError("it is closed")
            try:
                file = self._stream.fileno()
            except (OSError, ValueError):  # a stream in memory
                self._stream.write(self._left.decode())
                return True
            self._stream.flush()
            while self._left:
                self._left = self._left[os.write(file, self._left) :]
        except (OSError, ValueError) as error:
            raise PartAway(getattr(error, "strerror", None) or error) from None
        return True


class Webhook:
    """Posts the events of a store, each as the JSON object of its line, to an address.

    An answer of 200 to 299 means that it has arrived. `Idempotency-Key` is the event's number. The token, sent as
    `Authorization: Bearer`, stands in no log, and no redirect is followed with it. `timeout`: of an exchange [s].
    """

    def __init__(self, store: MonitorStore, url: str, token: str | None = None, timeout: float = 10.0) -> None:
        self._store, self._url, self._timeout = store, url, timeout
        self._headers = {"Content-Type": "application/json", "User-Agent": "sealscope"}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"

    def pass_on(self) -> None:
        """Post the new events. Raise PartAway if one does not arrive."""
        self._store.pass_on("webhook", self._posted)

    def _posted(self, event: dict[str, Any]) -> bool:
        if not _is_announced(event):
            return True
        try:
            asyncio.run(self._post(event))
        except TimeoutError:
            raise PartAway(f"no answer within {self._timeout:g} s") from None
        except httpx.RemoteProtocolError:  # its text is what the other side sent
            raise PartAway("an answer that is no HTTP") from None
        except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
            raise PartAway((str(error).splitlines() or [""])[0][:200] or type(error).__name__) from None
        return True

    async def _post(self, event: dict[str, Any]) -> None:
        headers = {**self._headers, "Idempotency-Key": str(event["number"])}
        client = httpx.AsyncClient(timeout=None)
        async with (
            asyncio.timeout(self._timeout),
            client,
            client.stream("POST", self._url, content=json.dumps(event), headers=headers) as answer,
        ):
            if not answer.is_success:
                raise OSError(f"status {answer.status_code}")
