"""Count dropped values and messages by their reason, and log each reason now and then.

A line is logged for the first occurrence of a reason at one place, such as a channel, and then at each power of ten, so
that a fault that lasts neither passes in silence nor fills the log.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable

_log = logging.getLogger(__name__)
#: Most places, such as channels, whose occurrences are told apart.
_MAX_PLACES = 10_000


class LoggedCounts:
    """Counters of a source, whose first increases are logged.

    `count`: function called with the reason at each occurrence, and with their number if it is not one.
    """

    def __init__(self, count: Callable[..., object]) -> None:
        self._count = count
        self._numbers = Counter[tuple[str, str]]()

    def add(self, reason: str, place: str, number: int = 1, detail: str = "") -> None:
        """Count `number` occurrences of a `reason` at a `place`, and log them, with a `detail`, if they are due."""
        self._count(reason) if number == 1 else self._count(reason, number)
        if len(self._numbers) >= _MAX_PLACES and (reason, place) not in self._numbers:
            self._numbers.clear()  # bounds the memory; all places are counted anew
        before = self._numbers[reason, place]
        self._numbers[reason, place] = before + number
        log_growth(place, {reason: before}, {reason: before + number}, detail)


def log_growth(place: str, before: dict[str, int], after: dict[str, int], detail: str = "") -> None:
    """Log those counters of a `place` that have reached 1 or another power of ten, `before` and `after` by reason."""
    for reason, number in after.items():
        number_before = before.get(reason, 0)
        if number > number_before and (not number_before or len(str(number)) > len(str(number_before))):
            _log.warning("%s: %s%s (%d so far)", place, reason, f", {detail}" if detail else "", number)
