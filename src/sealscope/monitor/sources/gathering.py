"""Single values, each with its own clock, gathered into blocks on one time axis.

A source that sends what changes (OPC UA) says nothing of a channel that stays as it is: a sample that is missing has
the value before it. A block ends where every channel is known; one that says nothing for `SILENT_S` stays as it is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sealscope.monitor.sources.message_limits import MOST_SAMPLES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

#: How long a channel may say nothing before it counts as unchanged [s].
SILENT_S = 3.0
#: Values that lie further from the newest one than this [s] begin a new block: after a pause, or with a clock set back.
_AHEAD_S = 60.0
LATE = "values that came after their block"


@dataclass
class _Channel:
    """One channel: `values` by their number on the time axis, and `held`, the one before them.

    `heard`: when a value came last [s]; `newest`: number of the newest value since the beginning.
    """

    values: dict[int, float] = field(default_factory=dict)
    held: float | None = None
    heard: float = -math.inf
    newest: int | None = None

    def last(self) -> float | None:
        return self.values[max(self.values)] if self.values else self.held

    def pop_values(self, first: int, stop: int) -> Array:
        """Remove and return the values from `first` to `stop`; a missing one repeats the value before it."""
        known = sorted(k for k in self.values if k < stop)
        places = np.searchsorted(known, np.arange(first, stop), side="right")
        held = math.nan if self.held is None else self.held
        samples = np.array([held, *(self.values.pop(k) for k in known)])[places]
        self.held = float(samples[-1])
        return samples


class ValueGatherer:
    """The values of one actuator at a rate [Hz], gathered into blocks of `block_s` [s].

    `count`: counts what was dropped, by a reason; `now`: returns a clock [s] that is never set.
    """

    def __init__(
        self,
        channels: Sequence[str],
        rate: float,
        block_s: float,
        count: Callable[[str], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.rate, self._length = rate, max(1, round(block_s * rate))
        self._ahead, self._count, self._now = math.ceil(_AHEAD_S * rate), count, now
        self._channels = {name: _Channel() for name in channels}
        self._start: int | None = None
        self._newest: int | None = None

    def take(self, channel: str, t: float, values: Sequence[float]) -> list[Recording]:
        """Take samples of a channel in SI units, the first one at the clock `t` [s]; return the blocks they complete.

        NaN is a value that is not known.
        """
        if not math.isfinite(t) or abs(t * self.rate) > 2**52 or not 0 < len(values) <= MOST_SAMPLES:
            self._count("values without a clock, or too many")
            return []
        first, target = round(t * self.rate), self._channels[channel]
        lead = 0 if self._newest is None else first - self._newest
        if lead > self._ahead:  # after a pause, with the values as they are
            held = {
                name: _Channel(held=gathered.last(), heard=gathered.heard) for name, gathered in self._channels.items()
            }
            self.interrupted()
            self._channels = held
        elif lead < -self._ahead:
            if target.last() is None:  # it has not changed for long
                target.held, target.heard = values[-1], self._now()
                return self._whole_blocks()
            self.interrupted()  # the clock was set back
        target = self._channels[channel]
        for k, value in enumerate(values, first):
            if self._start is not None and k < self._start:
                self._count(LATE)
            else:
                target.values[k] = value
        while self._start is None and len(target.values) > self._ahead:  # another channel has never come
            target.held = target.values.pop(next(iter(target.values)))
        last = first + len(values) - 1
        self._newest = last if self._newest is None else max(self._newest, last)
        target.heard, target.newest = self._now(), last if target.newest is None else max(last, target.newest)
        return self._whole_blocks()

    def interrupted(self) -> None:
        """Discard the waiting samples, for example after a lost connection with unknown samples in between."""
        self._channels = {name: _Channel() for name in self._channels}
        self._start = self._newest = None

    def _whole_blocks(self) -> list[Recording]:
        channels = self._channels.values()
        if self._start is None:
            if any(channel.last() is None for channel in channels) or not any(channel.values for channel in channels):
                return []
            # every channel has a value from there on
            unknown = [min(channel.values) for channel in channels if channel.held is None]
            self._start = (
                max(unknown) if unknown else min(min(channel.values) for channel in channels if channel.values)
            )
        newest = [channel.newest for channel in channels if channel.heard >= self._now() - SILENT_S]
        if not newest or None in newest:
            return []
        blocks: list[Recording] = []
        known = min(last for last in newest if last is not None) + 1
        while known - self._start >= self._length:
            clock = np.arange(self._start, self._start + self._length)
            samples = {name: values.pop_values(clock[0], clock[-1] + 1) for name, values in self._channels.items()}
            units = {name: CHANNEL_UNITS[name] for name in samples}
            blocks.append(Recording(clock / self.rate, samples, units, self.rate))
            self._start += self._length
        return blocks
