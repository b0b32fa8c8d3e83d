"""Events posted to a web address: in their order, none left out, the one that was posted before a crash once more."""

from __future__ import annotations

import json
import logging
import threading
import time
import urllib.error
import urllib.request
from typing import Any

from sealscope.monitor.memory.store import MonitorStore
from sealscope.monitor.outages import WEBHOOK, Outages
from sealscope.monitor.outputs.lines import announced

_log = logging.getLogger(__name__)
_NAME = "webhook"
#: The first pause after a failure [s], doubled up to the longest.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 300.0
_LOOK_S = 0.3


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirect is a failure: the token is for the address that the settings name."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


class Webhook:
    """Posts the events of a store, each as the JSON object of its line, to an address.

    An answer of 200 to 299 means that it has arrived; else it is posted again after a pause that doubles up to 5
    minutes. `Idempotency-Key` is the event's number, by which a receiver knows one that it has.

    Parameters
    ----------
    store : MonitorStore
    url : str
    token : str, optional
        Sent as `Authorization: Bearer`; it stands in no log.
    timeout : float
        Longest time an answer may take [s].
    outages : Outages, optional
        Is told when the address does not take an event, and when it does again.
    """

    def __init__(
        self,
        store: MonitorStore,
        url: str,
        token: str | None = None,
        timeout: float = 10.0,
        outages: Outages | None = None,
    ) -> None:
        self._store, self._url, self._token, self._timeout, self._outages = store, url, token, timeout, outages
        self._pause, self._next = 0.0, 0.0
        self._opener = urllib.request.build_opener(_NoRedirect)

    def run(self, stopping: threading.Event) -> None:
        """Post what is new until `stopping` is set, then what is left, once."""
        while not stopping.wait(_LOOK_S):
            self.pass_on()
        self._next = 0.0
        self.pass_on()

    def pass_on(self) -> None:
        """Post what is new, unless a failure asks for a pause."""
        from sqlalchemy.exc import DBAPIError

        if time.monotonic() < self._next or not self._store.sends:
            return
        try:
            for number, event in self._store.events_since(self._store.position(_NAME)):
                if announced(event):
                    self._post(number, event)
                    if self._outages is not None:
                        self._outages.back(WEBHOOK)
                self._store.keep_position(_NAME, number)
                self._pause = 0.0
        except (urllib.error.URLError, OSError, ValueError, DBAPIError) as error:
            self._pause = min(max(2.0 * self._pause, FIRST_PAUSE_S), LONGEST_PAUSE_S)
            self._next = time.monotonic() + self._pause
            if self._outages is not None and not isinstance(error, DBAPIError):
                self._outages.lost(WEBHOOK, _reason(error))
            _log.warning("the webhook does not take an event, tried again in %.0f s: %s", self._pause, _reason(error))

    def _post(self, number: int, event: dict[str, Any]) -> None:
        headers = {"Content-Type": "application/json", "Idempotency-Key": str(number), "User-Agent": "sealscope"}
        if self._token is not None:
            headers["Authorization"] = f"Bearer {self._token}"
        request = urllib.request.Request(self._url, json.dumps(event).encode(), headers, method="POST")
        with self._opener.open(request, timeout=self._timeout) as answer:
            answer.read(1)


def _reason(error: Exception) -> str:
    if isinstance(error, urllib.error.HTTPError):
        return f"status {error.code}"
    return str(getattr(error, "reason", None) or error).splitlines()[0][:200]
