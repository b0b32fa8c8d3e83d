"""Who may see the page: whoever has its token, or what a browser keeps in its place; guesses are slowed down."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import time
from collections.abc import Callable

#: Wrong tokens of an address that cost no pause, the first pause and the longest one [s], when they are forgotten [s],
#: and of how many addresses they are known.
_FREE, _FIRST_S, _LONGEST_S, _FORGOTTEN_S, _ADDRESSES = 5, 1.0, 60.0, 3600.0, 10_000


class Admission:
    """The token of a page, and who guessed it wrong; `now` returns a clock [s].

    After five wrong ones an address waits before its next one is looked at, right or wrong: for 1 s, and twice as long
    after each further one, up to a minute. A network of IPv6 (/64) counts as one address.
    """

    def __init__(self, token: str, now: Callable[[], float] = time.monotonic) -> None:
        self._token, self._now = token, now
        self._wrong: dict[str, tuple[int, float]] = {}  # wrong tokens of an address, and the clock of the last one

    @property
    def session(self) -> str:
        """What a browser keeps in place of the token."""
        return hmac.new(self._token.encode(), b"sealscope session", hashlib.sha256).hexdigest()

    def pause_s(self, address: str) -> float:
        """Return how long an address has to wait until a token of it is looked at [s]."""
        count, last = self._wrong.get(_network(address), (0, 0.0))
        if count < _FREE:
            return 0.0
        return max(0.0, last + min(_FIRST_S * 2.0 ** min(count - _FREE, 30), _LONGEST_S) - self._now())

    def admits(self, address: str, given: str, *, session: bool = False) -> bool:
        """Return whether an address that does not wait gives the token, or the session of a browser."""
        known, of = self.session if session else self._token, _network(address)
        if hmac.compare_digest(given.encode("utf-8", "replace"), known.encode()):
            self._wrong.pop(of, None)
            return True
        now = self._now()
        count, last = self._wrong.pop(of, (0, now))
        self._wrong[of] = (count + 1 if now - last < _FORGOTTEN_S else 1), now
        if len(self._wrong) > _ADDRESSES:
            del self._wrong[next(iter(self._wrong))]  # the one that was wrong longest ago
        return False


def _network(address: str) -> str:
    try:
        known = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((known, 64), strict=False)) if known.version == 6 else address
