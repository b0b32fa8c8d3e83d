"""Things that wait for another thread: at most so many, and so many bytes."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

_Item = TypeVar("_Item")


class Waiting(Generic[_Item]):
    """A queue between threads, of at most `most` things and `most_bytes` as `put` states them.

    Something larger than all bytes fits alone.
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._items: deque[tuple[_Item, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()

    def waiting(self) -> tuple[int, int]:
        """Return the number of things that wait, and their bytes."""
        with self._changed:
            return len(self._items), self._bytes

    def put(self, item: _Item, size: int, timeout: float = 0.0, *, always: bool = False) -> bool:
        """Append something of `size` bytes; return False where there was no room for `timeout` [s].

        `always`: beyond the bounds, for what somebody else bounds.
        """

        def has_room() -> bool:
            fits = len(self._items) < self._most and self._bytes + size <= self._most_bytes
            return always or not self._items or fits

        with self._changed:
            if not self._changed.wait_for(has_room, timeout):
                return False
            self._items.append((item, size))
            self._bytes += size
            self._changed.notify_all()
            return True

    def take(self, most: int, timeout: float) -> list[_Item]:
        """Remove and return up to `most` items: those present, or the first to come within `timeout` [s]."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items), timeout)
            items = [self._items.popleft() for _ in range(min(most, len(self._items)))]
            self._bytes -= sum(size for _, size in items)
            self._changed.notify_all()
            return [item for item, _ in items]
