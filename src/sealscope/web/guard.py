"""Access control of the page: its token, delays against guessing it, and a limit of connections."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

#: Number of wrong tokens that an address may state without a pause, and time after which they are forgotten [s].
_FREE_ATTEMPTS, _FORGET_S = 5, 3600.0
#: First and longest pause after a wrong token [s].
_FIRST_PAUSE_S, _MAX_PAUSE_S = 1.0, 60.0
#: Number of addresses whose wrong tokens are remembered.
_MAX_ADDRESSES = 10_000
#: Most connections, and the largest fraction of the file descriptors of this process for them: sources, outputs and
#: the database need the others.
_MAX_CONNECTIONS, _DESCRIPTOR_FRACTION = 400, 0.4
#: How long a connection may be silent, or leave its answer unread [s], and how often this is checked [s].
SILENT_S, _CHECK_INTERVAL_S = 10.0, 1.0
#: Connections that are accepted in one step of the event loop.
BACKLOG = 64


class Admission:
    """The check of the token by which a page admits visitors; it delays a client's IP address after wrong tokens.

    After `_FREE_ATTEMPTS` wrong tokens the next token from the same address, right or wrong, must wait for a pause of
    `_FIRST_PAUSE_S` (`pause_s`). Each further wrong token doubles the pause, up to `_MAX_PAUSE_S`. An IPv6 network
    (/64) counts as one address. `token`: the valid token; `now`: function that returns a monotonic time [s].
    """

    def __init__(self, token: str, now: Callable[[], float] = time.monotonic) -> None:
        self._token, self._now = token, now
        # by network: number of wrong tokens, and time of the last one [s]
        self._failures: dict[str, tuple[int, float]] = {}
        # cookie of a browser that has stated the token
        self.session = hmac.new(token.encode(), b"sealscope session", hashlib.sha256).hexdigest()

    def pause_s(self, address: str) -> float:
        """Compute the time [s] that a client's IP address must wait until its next token is checked, 0 for no wait."""
        n_failures, last = self._failures.get(_network(address), (0, 0.0))
        if n_failures < _FREE_ATTEMPTS:
            return 0.0
        doublings = min(n_failures - _FREE_ATTEMPTS, 30)  # limited, so that the power does not overflow
        pause = min(_FIRST_PAUSE_S * 2.0**doublings, _MAX_PAUSE_S)
        return max(0.0, last + pause - self._now())

    def admits(self, address: str, token: str, *, session: bool = False) -> bool:
        """Return True if a token is right; otherwise count it as a wrong token of the client's network.

        `address`: IP address of the client; `session`: True if `token` is the cookie of a browser admitted before. The
        count of a network starts anew after a right token, or `_FORGET_S` seconds after the last wrong one.
        """
        expected, network = self.session if session else self._token, _network(address)
        if hmac.compare_digest(token.encode("utf-8", "replace"), expected.encode()):
            self._failures.pop(network, None)
            return True
        now = self._now()
        n_failures, last = self._failures.pop(network, (0, now))
        self._failures[network] = (n_failures + 1 if now - last < _FORGET_S else 1), now
        if len(self._failures) > _MAX_ADDRESSES:
            del self._failures[next(iter(self._failures))]  # the address with the oldest failure
        return False


def _network(address: str) -> str:
    """Return the /64 network of an IPv6 address, all of which one client may use; leave other addresses unchanged."""
    try:
        ip_address = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((ip_address, 64), strict=False)) if ip_address.version == 6 else address


def connection_limit() -> int:
    """Compute the largest number of connections: `_MAX_CONNECTIONS`, or fewer if the system permits few open files."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        max_descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if max_descriptors != resource.RLIM_INFINITY:
            # at least 8, as one browser alone opens up to 6
            return max(8, min(_MAX_CONNECTIONS, round(_DESCRIPTOR_FRACTION * max_descriptors)))
    return _MAX_CONNECTIONS


def limit_protocol(max_connections: int, silent_s: float = SILENT_S) -> type[asyncio.Protocol]:
    """Build a subclass of uvicorn's HTTP protocol that limits the number of connections and their idle time.

    A connection is active when it is made, while it waits for an answer, and while its client reads one. It is closed
    after `silent_s` seconds without activity. If there are more than `max_connections`, the connection that has been
    silent for longest is closed, or the new one if all others are being answered.
    """
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

    base: Any = AutoHTTPProtocol

    class LimitedProtocol(base):  # type: ignore[misc]
        """A limited connection; `last_activity` [s]: time at which it was made, or last found to be active."""

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self.last_activity = self.loop.time()
            if len(self.connections) > max_connections:
                silent = [other for other in self.connections if other is not self and not other.is_sending_answer()]
                surplus = min(silent, key=lambda other: other.last_activity, default=self)
                surplus.transport.abort()
                self.connections.discard(surplus)  # a closed connection must not be chosen again
            self.loop.call_later(_CHECK_INTERVAL_S, self.check_silence)

        def is_sending_answer(self) -> bool:  # or preparing it
            return self.cycle is not None and not self.cycle.response_complete

        def check_silence(self) -> None:
            """Close the connection if it has been silent for too long; otherwise schedule the next check."""
            if self.transport.is_closing():
                return
            now = self.loop.time()
            if self.is_sending_answer() and not self.flow.write_paused:  # paused: the client leaves the answer unread
                self.last_activity = now
            if now - self.last_activity > silent_s:
                self.transport.abort()
            else:
                self.loop.call_later(_CHECK_INTERVAL_S, self.check_silence)

    return LimitedProtocol
