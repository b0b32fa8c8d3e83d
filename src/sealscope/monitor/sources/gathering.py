"""Single values, each with its own clock, gathered into blocks on one time axis.

A source that sends what changes (OPC UA) says nothing of a channel that stays as it is: a sample that is missing has
the value before it. A block ends where every channel is known; one that says nothing for `SILENT_S` stays as it is.
So the channels may come one after the other, each with the values of some time, as they do after a delay.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from sealscope.monitor.sources.source_block import MOST_SAMPLES
from sealscope.recordings.recording import CHANNEL_UNITS, Recording

#: How long a channel may say nothing before it counts as unchanged [s].
SILENT_S = 3.0
#: Values that lie further from the newest one than this [s] begin a new block: after a pause, or with a clock set back.
_AHEAD_S = 60.0
LATE = "values that came after their block"


class ValueGatherer:
    """The values of one actuator.

    Parameters
    ----------
    channels : sequence of str
    rate : float
        Sampling rate of the blocks [Hz].
    block_s : float
        Length of a block [s].
    count : callable
        Counts what was dropped, by a reason.
    now : callable
        Returns a clock [s] that is never set.
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
        # when a channel was heard, and its newest sample since the beginning
        self._heard: dict[str, tuple[float, int | None]] = {}
        self._values: dict[str, dict[int, float]] = {channel: {} for channel in channels}
        self._held: dict[str, float] = {}
        self._start: int | None = None
        self._newest: int | None = None

    def take(self, channel: str, t: float, values: Sequence[float]) -> list[Recording]:
        """Take samples of a channel in SI units, the first one at the clock `t` [s]; return the blocks they complete.

        NaN is a value that is not known.
        """
        if not math.isfinite(t) or abs(t * self.rate) > 2**52 or not 0 < len(values) <= MOST_SAMPLES:
            self._count("values without a clock, or too many")
            return []
        first = round(t * self.rate)
        own = self._values[channel]
        if self._newest is not None and first - self._newest > self._ahead:
            self._go_on()
        elif self._newest is not None and self._newest - first > self._ahead:
            if not own and channel not in self._held:  # it has not changed for long
                self._held[channel], self._heard[channel] = values[-1], (self._now(), None)
                return self._whole_blocks()
            self._begin()  # the clock was set back
        own = self._values[channel]
        for k, value in enumerate(values, first):
            if self._start is not None and k < self._start:
                self._count(LATE)
            else:
                own[k] = value
        last = first + len(values) - 1
        self._newest = last if self._newest is None else max(self._newest, last)
        before = self._heard.get(channel, (0.0, None))[1]
        self._heard[channel] = self._now(), last if before is None else max(last, before)
        return self._whole_blocks()

    def interrupted(self) -> None:
        """Forget what waits, as after a lost connection: what was sent meanwhile is not known."""
        self._begin()

    def _begin(self) -> None:
        self._values = {channel: {} for channel in self._values}
        self._held, self._heard, self._start, self._newest = {}, {}, None, None

    def _go_on(self) -> None:
        """Begin a new block after a pause, with the values as they are."""
        held = {channel: own[max(own)] for channel, own in self._values.items() if own}
        held = {**self._held, **held}
        heard: dict[str, tuple[float, int | None]] = {channel: (at, None) for channel, (at, _) in self._heard.items()}
        self._begin()
        self._held, self._heard = held, heard

    def _whole_blocks(self) -> list[Recording]:
        if self._start is None:
            unknown = [own for channel, own in self._values.items() if channel not in self._held]
            if not all(unknown) or not any(self._values.values()):
                return []
            # every channel has a value from there on
            firsts = [min(own) for own in self._values.values() if own]
            self._start = max(min(own) for own in unknown) if unknown else min(firsts)
        blocks: list[Recording] = []
        recent = self._now() - SILENT_S
        newest = [last for heard, last in self._heard.values() if heard >= recent]
        if not newest or None in newest:
            return []
        while min(last for last in newest if last is not None) + 1 - self._start >= self._length:
            blocks.append(self._block(self._start, self._start + self._length))
            self._start += self._length
        return blocks

    def _block(self, first: int, stop: int) -> Recording:
        channels = {}
        for channel, own in self._values.items():
            samples = np.empty(stop - first)
            value = self._held.get(channel, math.nan)
            before = [k for k in own if k < first]
            if before:
                value = own[max(before)]
            for k in range(first, stop):
                value = own.get(k, value)
                samples[k - first] = value
            self._held[channel] = value
            self._values[channel] = {k: kept for k, kept in own.items() if k >= stop}
            channels[channel] = samples
        units = {channel: CHANNEL_UNITS[channel] for channel in channels}
        return Recording(np.arange(first, stop) / self.rate, channels, units, self.rate)
