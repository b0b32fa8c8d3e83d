"""A queue between threads, bounded by its number of items and their bytes."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, NamedTuple, TypeVar

_Item = TypeVar("_Item")


class QueueLoad(NamedTuple):
    """Load of a monitor's queue: blocks and bytes that wait to be stored, and how often a source waited for room."""

    n_blocks: int = 0
    n_bytes: int = 0
    n_waits: int = 0


class BoundedQueue(Generic[_Item]):
    """A queue between threads of at most `max_items` items and `max_bytes` bytes; if empty, it takes any item."""

    def __init__(self, max_items: int, max_bytes: int) -> None:
        self._max_items, self._max_bytes = max_items, max_bytes
        self._items: deque[tuple[_Item, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()

    def size(self) -> tuple[int, int]:
        """Return the number of queued items, and the sum of their sizes [bytes]."""
        with self._changed:
            return len(self._items), self._bytes

    def put(self, item: _Item, size: int, timeout: float = 0.0, *, always: bool = False) -> bool:
        """Append an item of `size` bytes; return False if the queue stays full for `timeout` [s].

        `always`: True to append the item even if the queue is full.
        """

        def has_room() -> bool:
            fits = len(self._items) < self._max_items and self._bytes + size <= self._max_bytes
            return always or not self._items or fits

        with self._changed:
            if not self._changed.wait_for(has_room, timeout):
                return False
            self._items.append((item, size))
            self._bytes += size
            self._changed.notify_all()
            return True

    def pop(self, max_items: int, timeout: float) -> list[_Item]:
        """Remove and return at most `max_items` items, waiting up to `timeout` [s] for the first; [] if none comes."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items), timeout)
            items = [self._items.popleft() for _ in range(min(max_items, len(self._items)))]
            self._bytes -= sum(size for _, size in items)
            self._changed.notify_all()
            return [item for item, _ in items]
