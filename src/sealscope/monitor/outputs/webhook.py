"""Events posted to a web address: in their order, none left out, the one that was posted before a crash once more."""

from __future__ import annotations

import http.client
import json
import logging
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from functools import partial
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


class _Deadline:
    """The end of an exchange: its connection is cut, however slowly the other side goes on."""

    def __init__(self, seconds: float) -> None:
        self._ends = time.monotonic() + seconds
        self._timers: list[threading.Timer] = []
        self._lines: list[socket.socket] = []

    def connect(self, *arguments: Any, **options: Any) -> socket.socket:
        """Connect as `socket.create_connection`, and cut the connection at the deadline."""
        line = socket.create_connection(*arguments, **options)
        held = line.dup()  # TLS takes the socket over
        timer = threading.Timer(max(0.0, self._ends - time.monotonic()), _cut, (held,))
        timer.daemon = True
        self._lines.append(held)
        self._timers.append(timer)
        timer.start()
        return line

    def over(self) -> bool:
        """Return whether the deadline has passed; nothing is cut any more."""
        for timer, line in zip(self._timers, self._lines, strict=True):
            timer.cancel()
            line.close()
        return time.monotonic() >= self._ends


def _cut(line: socket.socket) -> None:
    with suppress(OSError):
        line.shutdown(socket.SHUT_RDWR)


def _limited(kind: type[http.client.HTTPConnection], deadline: _Deadline, host: str, **options: Any) -> Any:
    """Return a connection of `http.client` that ends at a deadline."""
    connection: Any = kind(host, **options)
    connection._create_connection = deadline.connect
    return connection


class _Limited(urllib.request.HTTPSHandler):
    """Opens addresses by connections that end at a deadline."""

    handler_order = 400  # before those of urllib

    def __init__(self, deadline: _Deadline) -> None:
        super().__init__()
        self._deadline = deadline

    def http_open(self, request: urllib.request.Request) -> Any:
        return self.do_open(partial(_limited, http.client.HTTPConnection, self._deadline), request)

    def https_open(self, request: urllib.request.Request) -> Any:
        return self.do_open(partial(_limited, http.client.HTTPSConnection, self._deadline), request)


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
        Longest time that the whole exchange of an event may take [s].
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
        except (http.client.HTTPException, OSError, ValueError, DBAPIError) as error:
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
        deadline = _Deadline(self._timeout)
        opener = urllib.request.build_opener(_NoRedirect, _Limited(deadline))
        try:
            with opener.open(request, timeout=self._timeout) as answer:
                answer.read(1)
        except (http.client.HTTPException, OSError) as error:
            if deadline.over() and not isinstance(error, urllib.error.HTTPError):
                raise TimeoutError(f"no answer within {self._timeout:g} s") from error
            raise
        finally:
            deadline.over()


def _reason(error: Exception) -> str:
    if isinstance(error, urllib.error.HTTPError):
        return f"status {error.code}"
    if isinstance(error, http.client.HTTPException):  # its text is what the other side sent
        return f"an answer that is no HTTP ({type(error).__name__})"
    return (str(getattr(error, "reason", None) or error).splitlines() or [type(error).__name__])[0][:200]
