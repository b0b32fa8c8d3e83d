"""Who may ask the page, and how much: its token, guesses slowed down, and a limit of connections."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

#: Wrong tokens of an address that cost no pause, the first pause and the longest one [s], when they are forgotten [s],
#: and of how many addresses they are known.
_FREE, _FIRST_S, _LONGEST_S, _FORGOTTEN_S, _ADDRESSES = 5, 1.0, 60.0, 3600.0, 10_000
#: Most connections, and the share of the descriptors of this process that they may take: sources, outputs and the
#: database need the others.
_MOST, _SHARE = 400, 0.4
#: How long a connection may be silent, or leave unread what it asked for [s], and how often it is looked at [s].
SILENT_S, _LOOK_S = 10.0, 1.0
#: Connections that are accepted in one go: they count when all of them are made.
BACKLOG = 64


class Admission:
    """The token of a page, and who guessed it wrong; `now` returns a clock [s].

    After five wrong ones an address waits before its next one is looked at, right or wrong: for 1 s, and twice as long
    after each further one, up to a minute. A network of IPv6 (/64) counts as one address.
    """

    def __init__(self, token: str, now: Callable[[], float] = time.monotonic) -> None:
        self._token, self._now = token, now
        self._wrong: dict[str, tuple[int, float]] = {}  # wrong tokens of an address, and the clock of the last one
        #: What a browser keeps in place of the token.
        self.session = hmac.new(token.encode(), b"sealscope session", hashlib.sha256).hexdigest()

    def pause_s(self, address: str) -> float:
        """Return the time until the next token of an address is checked [s]."""
        count, last = self._wrong.get(_network(address), (0, 0.0))
        if count < _FREE:
            return 0.0
        return max(0.0, last + min(_FIRST_S * 2.0 ** min(count - _FREE, 30), _LONGEST_S) - self._now())

    def admits(self, address: str, token: str, *, session: bool = False) -> bool:
        """Test the token, or the browser's session, of an address that need not wait."""
        known, network = self.session if session else self._token, _network(address)
        if hmac.compare_digest(token.encode("utf-8", "replace"), known.encode()):
            self._wrong.pop(network, None)
            return True
        now = self._now()
        count, last = self._wrong.pop(network, (0, now))
        self._wrong[network] = (count + 1 if now - last < _FORGOTTEN_S else 1), now
        if len(self._wrong) > _ADDRESSES:
            del self._wrong[next(iter(self._wrong))]  # the one that was wrong longest ago
        return False


def _network(address: str) -> str:
    try:
        known = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((known, 64), strict=False)) if known.version == 6 else address


def most_connections() -> int:
    """Return the largest number of connections: `_MOST`, or fewer if the system allows few descriptors."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if soft != resource.RLIM_INFINITY:
            return max(8, min(_MOST, round(_SHARE * soft)))
    return _MOST


def limited_protocol(most: int, silent_s: float = SILENT_S) -> type[asyncio.Protocol]:
    """Return uvicorn's protocol of HTTP with at most so many connections, each silent for at most so long [s].

    Of too many the one that has been silent for longest is closed, so that whoever asks something is answered; the new
    one where all others are being answered.
    """
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

    base: Any = AutoHTTPProtocol

    class LimitedProtocol(base):  # type: ignore[misc]
        """A connection; `heard` is when it last asked for something or took what it had asked for [s]."""

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self.heard = self.loop.time()
            if len(self.connections) > most:
                silent = [other for other in self.connections if other is not self and not other.is_answered()]
                closed = min(silent, key=lambda other: other.heard, default=self)
                closed.transport.abort()
                self.connections.discard(closed)  # the next one must choose another
            self.loop.call_later(_LOOK_S, self.look)

        def is_answered(self) -> bool:
            """Test whether the answer to a request is still being sent."""
            return self.cycle is not None and not self.cycle.response_complete

        def look(self) -> None:
            """Close the connection if it has been silent for too long, else check again later."""
            if self.transport.is_closing():
                return
            now = self.loop.time()
            if self.is_answered() and not self.flow.write_paused:
                self.heard = now
            if now - self.heard > silent_s:
                self.transport.abort()
            else:
                self.loop.call_later(_LOOK_S, self.look)

    return LimitedProtocol
