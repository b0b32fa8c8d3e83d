"""Events posted to a web address: in their order, none left out, the one that was posted before a crash once more."""

from __future__ import annotations

import asyncio
import json
import logging
from typing import Any

import httpx

from sealscope.monitor.memory.store import MonitorStore
from sealscope.monitor.outputs.lines import announced
from sealscope.monitor.supervisor import PartAway

logging.getLogger("httpx").setLevel(logging.WARNING)  # which tells each request


class Webhook:
    """Posts the events of a store, each as the JSON object of its line, to an address.

    An answer of 200 to 299 means that it has arrived. `Idempotency-Key` is the event's number, by which a receiver
    knows one that it has. The token, sent as `Authorization: Bearer`, stands in no log, and no redirect is followed
    with it. `timeout`: of the whole exchange of an event [s].
    """

    def __init__(self, store: MonitorStore, url: str, token: str | None = None, timeout: float = 10.0) -> None:
        self._store, self._url, self._timeout = store, url, timeout
        self._headers = {"Content-Type": "application/json", "User-Agent": "sealscope"}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"

    def pass_on(self) -> None:
        """Post what is new; raises PartAway where an event does not arrive."""
        self._store.pass_on("webhook", self._posted)

    def _posted(self, event: dict[str, Any]) -> bool:
        """Post an event that is announced; raises an error where it does not arrive."""
        if announced(event):
            try:
                asyncio.run(self._post(event))
            except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
                raise PartAway(self._reason(error)) from None
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
