"""Send the events of alarms as JSON lines to a stream and as POST requests to a web address, in order.

The database stores how far each output has come. After a crash, or an answer that is lost, an event is sent again, with
the same number.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from collections.abc import Callable
from typing import Any, TextIO

import httpx

from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.supervisor import PartAway

logging.getLogger("httpx").setLevel(logging.WARNING)  # it logs every request
#: Events that the detector causes; they are not announced while an alarm is shelved.
_DETECTOR_EVENTS = ("raised", "error", "warning", "updated", "returned")


def _deliver(store: MonitorStore, output: str, send: Callable[[dict[str, Any]], None]) -> None:
    """Send the events that an `output` has not sent yet, but of a shelved alarm only those that persons cause."""

    def send_announced(event: dict[str, Any]) -> bool:
        if event["event"] not in _DETECTOR_EVENTS or not event["alarm"]["shelved"]:
            send(event)
        return True  # an event that is not announced counts as sent, too

    store.deliver(output, send_announced)


class EventLines:
    """Writes the events in the database `store` to a text stream (None if it is closed), each as one line of JSON.

    After an error the rest of a line is written, so that no line is cut off or repeated.
    """

    def __init__(self, store: MonitorStore, stream: TextIO | None) -> None:
        self._store, self._stream = store, stream
        self._unwritten, self._number = b"", 0  # part of the last line still to be written, and number of its event

    def deliver(self) -> None:
        """Write the new alarm events as lines of JSON; raise PartAway if the stream is closed or refuses them."""
        _deliver(self._store, "lines", self._write_line)

    def _write_line(self, event: dict[str, Any]) -> None:
        """Write an event as one line of JSON; raise PartAway if the stream refuses the line or a part of it.

        The next call, for the same event, writes the rest. The line is not buffered, because a buffer would keep lines
        that a full disk refuses.
        """
        if event["number"] != self._number:
            self._unwritten, self._number = (json.dumps(event) + "\n").encode(), event["number"]
        try:
            if self._stream is None:
                raise OSError("it is closed")
            try:
                file = self._stream.fileno()
            except (OSError, ValueError):  # a stream in memory
                self._stream.write(self._unwritten.decode())
                self._unwritten = b""
                return
            self._stream.flush()
            while self._unwritten:  # `os.write` returns how many bytes it has written
                self._unwritten = self._unwritten[os.write(file, self._unwritten) :]
        except (OSError, ValueError) as error:
            raise PartAway(getattr(error, "strerror", None) or error) from None


class Webhook:
    """Posts the events in the database `store` to a web address, each as a JSON object.

    A status of 200 to 299 confirms an event. The header `Idempotency-Key` has its number. The token, if any, is sent as
    `Authorization: Bearer`; it is never logged. Redirects are not followed. `timeout` [s]: limit of a request.
    """

    part = "webhook"

    def __init__(self, store: MonitorStore, url: str, token: str | None = None, timeout: float = 10.0) -> None:
        self._store, self._url, self._timeout = store, url, timeout
        self._headers = {"Content-Type": "application/json", "User-Agent": "sealscope"}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"

    def deliver(self) -> None:
        """Post the new alarm events to the web address; raise PartAway if one is not confirmed."""
        _deliver(self._store, "webhook", self._send_post)

    end = deliver

    def _send_post(self, event: dict[str, Any]) -> None:
        """Post an event; raise PartAway if the server does not confirm it."""
        try:
            asyncio.run(self._post(event))
        except TimeoutError:
            raise PartAway(f"no answer within {self._timeout:g} s") from None
        except httpx.RemoteProtocolError:  # the text of the error quotes the server: it is not passed on
            raise PartAway("the answer is not valid HTTP") from None
        except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
            raise PartAway((str(error).splitlines() or [""])[0][:200] or type(error).__name__) from None

    async def _post(self, event: dict[str, Any]) -> None:
        """Send one event in a request; raise OSError if the status of the answer is not 200 to 299."""
        headers = {**self._headers, "Idempotency-Key": str(event["number"])}
        client = httpx.AsyncClient(timeout=None)  # `asyncio.timeout` limits the whole request instead
        async with (
            asyncio.timeout(self._timeout),
            client,
            client.stream("POST", self._url, content=json.dumps(event), headers=headers) as answer,
        ):
            if not answer.is_success:
                raise OSError(f"status {answer.status_code}")
