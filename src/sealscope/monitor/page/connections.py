"""Connections to the page: how many there may be, and how long one may stay silent.

The page must not take the descriptors that sources, outputs and the database need. Of too many connections the one
that has been silent for longest is closed, so that whoever asks something is answered.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

#: Most connections, and the share of the descriptors of this process that they may take.
_MOST, _SHARE = 400, 0.4
#: How long a connection may be silent, or leave unread what it asked for [s], and how often it is looked at [s].
SILENT_S, _LOOK_S = 10.0, 1.0
#: Connections that are accepted in one go: they count when all of them are made.
BACKLOG = 64


def most_connections() -> int:
    """Return how many connections the page may have: `_MOST`, or fewer where the system allows few descriptors."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if soft != resource.RLIM_INFINITY:
            return max(8, min(_MOST, round(_SHARE * soft)))
    return _MOST


def limited_protocol(most: int, silent_s: float = SILENT_S) -> type[asyncio.Protocol]:
    """Return uvicorn's protocol of HTTP with at most so many connections, each silent for at most so long [s]."""
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

    base: Any = AutoHTTPProtocol

    class LimitedProtocol(base):  # type: ignore[misc]
        """A connection; `heard` is when it last asked for something or took what it had asked for [s]."""

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self.heard = self.loop.time()
            if len(self.connections) > most:
                closed = _longest_silent(self.connections, self)
                closed.transport.abort()
                self.connections.discard(closed)  # the next one must choose another
            self.loop.call_later(_LOOK_S, self.look)

        def is_answered(self) -> bool:
            """Return whether it has asked for something that it is being sent."""
            return self.cycle is not None and not self.cycle.response_complete

        def look(self) -> None:
            """Close it where it has been silent for too long, else look again later."""
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


def _longest_silent(connections: Iterable[Any], new: Any) -> Any:
    """Return which of too many connections to close: the new one where all others are being answered."""
    silent = [other for other in connections if other is not new and not other.is_answered()]
    return min(silent, key=lambda other: other.heard, default=new)
