"""Events posted to a web address: in their order, none left out, the one that was posted before a crash once more."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from typing import Any

import httpx
from sqlalchemy.exc import DBAPIError

from sealscope.monitor.memory.store import MonitorStore
from sealscope.monitor.outputs.lines import announced
from sealscope.monitor.supervisor import WEBHOOK, Outages

_log = logging.getLogger(__name__)
logging.getLogger("httpx").setLevel(logging.WARNING)  # which tells each request
_NAME = "webhook"
#: The first pause after a failure [s], doubled up to the longest.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 300.0
_LOOK_S = 0.3


class Webhook:
    """Posts the events of a store, each as the JSON object of its line, to an address.

    An answer of 200 to 299 means that it has arrived; else it is posted again after a pause that doubles up to 5
    minutes. `Idempotency-Key` is the event's number, by which a receiver knows one that it has. The token, sent as
    `Authorization: Bearer`, stands in no log, and no redirect is followed with it. `timeout`: of the whole exchange of
    an event [s]; `outages`: told when the address does not take an event, and when it does again.
    """

    def __init__(
        self,
        store: MonitorStore,
        url: str,
        token: str | None = None,
        timeout: float = 10.0,
        outages: Outages | None = None,
    ) -> None:
        self._store, self._url, self._timeout = store, url, timeout
        self._outages = outages or Outages(lambda: None)
        self._headers = {"Content-Type": "application/json", "User-Agent": "sealscope"}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"
        self._pause, self._next = 0.0, 0.0

    def run(self, stopping: threading.Event) -> None:
        """Post what is new until `stopping` is set, then what is left, once."""
        while not stopping.wait(_LOOK_S):
            self.pass_on()
        self._next = 0.0
        self.pass_on()

    def pass_on(self) -> None:
        """Post what is new, unless a failure asks for a pause."""
        if time.monotonic() < self._next:
            return
        try:
            self._store.pass_on(_NAME, self._posted)
        except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError, DBAPIError) as error:
            self._pause = min(max(2.0 * self._pause, FIRST_PAUSE_S), LONGEST_PAUSE_S)
            self._next = time.monotonic() + self._pause
            reason = self._reason(error)
            if not isinstance(error, DBAPIError):
                self._outages.lost(WEBHOOK, reason)
            _log.warning("the webhook does not take an event, tried again in %.0f s: %s", self._pause, reason)

    def _posted(self, event: dict[str, Any]) -> bool:
        """Post an event that is announced; raises an error where it does not arrive."""
        if announced(event):
            asyncio.run(self._post(event))
            self._outages.back(WEBHOOK)
        self._pause = 0.0
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

    def _reason(self, error: Exception) -> str:
        if isinstance(error, TimeoutError):
            return f"no answer within {self._timeout:g} s"
        if isinstance(error, httpx.RemoteProtocolError):  # its text is what the other side sent
            return "an answer that is no HTTP"
        return (str(error).splitlines() or [""])[0][:200] or type(error).__name__
