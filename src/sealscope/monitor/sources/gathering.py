"""Gather values of single channels, each with its own time, into blocks of samples on one time axis.

A source that reports changes (OPC UA) sends nothing while a channel is constant, so a missing sample repeats the value
before it. A block is complete when every channel has values up to its end, or is silent for `SILENT_S`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sealscope.monitor.sources.message_limits import MAX_SAMPLES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

#: Silence after which a channel counts as constant [s].
SILENT_S = 3.0
#: Largest step from the newest value [s]; a larger one is a pause, or a clock set back, and starts a new block.
_AHEAD_S = 60.0
#: Counter of dropped values.
LATE = "values that came after their block"


@dataclass
class _Channel:
    """The values of one channel that are not in a block yet."""

    values: dict[int, float] = field(default_factory=dict)  # by index on the time axis: round(time [s] x rate [Hz])
    previous: float | None = None  # the last value before them
    arrival: float = -math.inf  # time at which the last value arrived [s]
    newest: int | None = None  # largest index of any value so far

    def last_value(self) -> float | None:
        """Return the latest value on the time axis, or None if there is none."""
        return self.values[max(self.values)] if self.values else self.previous

    def pop_values(self, first: int, stop: int) -> Array:
        """Remove the values before index `stop`, and return the samples (stop - first,) from index `first` on.

        A missing sample repeats the value before it, NaN if there is none.
        """
        known_indices = sorted(k for k in self.values if k < stop)
        n_known = np.searchsorted(known_indices, np.arange(first, stop), side="right")  # known values up to each sample
        previous = math.nan if self.previous is None else self.previous
        known_values = np.array([previous, *(self.values.pop(k) for k in known_indices)])
        samples = known_values[n_known]  # the last known value, or `previous` if none is known yet
        self.previous = float(samples[-1])
        return samples


class ValueGatherer:
    """Gathers the values of one actuator's `channels` into blocks of `block_s` seconds at `rate` [Hz].

    `count`: function called with the reason when values are dropped; `now`: returns a monotonic time [s].
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
        self._max_lead, self._count, self._now = math.ceil(_AHEAD_S * rate), count, now
        self._channels = {name: _Channel() for name in channels}
        self._start: int | None = None

    def push(self, channel: str, t: float, values: Sequence[float]) -> list[Recording]:
        """Add successive samples of a channel, in SI units; return the blocks of all channels that are then complete.

        `t` [s]: time of the first sample, rounded to the sampling interval; the others follow at the sampling rate. NaN
        is an unknown value. No values, too many, or values without a finite time are dropped and counted. If the time
        jumps forward by more than `_AHEAD_S`, the blocks continue after the pause with each channel's last value. If it
        jumps back by as much, the clock was set, and all earlier values are discarded. Only the first value of a
        channel may be so old, dated by its last change; it counts as the present value.
        """
        # sample numbers up to 2^52 are exact as doubles
        if not math.isfinite(t) or abs(t * self.rate) > 2**52 or not 0 < len(values) <= MAX_SAMPLES:
            self._count("values without a clock, or too many")
            return []
        first = round(t * self.rate)
        newest_indices = (state.newest for state in self._channels.values() if state.newest is not None)
        lead = first - max(newest_indices, default=first)  # [samples], of the first new one over the newest
        target = self._channels[channel]
        if lead < -self._max_lead and target.last_value() is None:
            target.previous, target.arrival = values[-1], self._now()
        else:
            old_channels = self._channels
            if abs(lead) > self._max_lead:  # a pause, or the clock was set back: start again
                self.discard_values()
            if lead > self._max_lead:  # after a pause each channel starts from its last value
                for name, old_channel in old_channels.items():
                    self._channels[name] = _Channel(previous=old_channel.last_value(), arrival=old_channel.arrival)
            self._add_values(self._channels[channel], first, values)
        return self._pop_blocks()

    def _add_values(self, target: _Channel, first: int, values: Sequence[float]) -> None:
        """Add values to the channel `target` from index `first` of the time axis on; drop those before the next block.

        Before the first block, which waits for a value of every channel, only the newest `_max_lead` values are kept.
        """
        for k, value in enumerate(values, first):
            if self._start is not None and k < self._start:
                self._count(LATE)
            else:
                target.values[k] = value
        while self._start is None and len(target.values) > self._max_lead:
            target.previous = target.values.pop(next(iter(target.values)))  # the one added first
        last = first + len(values) - 1
        target.newest = last if target.newest is None else max(last, target.newest)
        target.arrival = self._now()

    def discard_values(self) -> None:
        """Discard all values that are in no block yet; the time axis begins anew, as after a lost connection."""
        self._channels = {name: _Channel() for name in self._channels}
        self._start = None

    def _pop_blocks(self) -> list[Recording]:
        """Remove and return the complete blocks, up to whose end every channel has values or is silent.

        The first block waits until every channel has a value and one of them a new one. A channel with a `previous`
        value has a sample at every index, so that the block begins at the first index at which the others have theirs,
        too; if there are no others, at the first new value.
        """
        channels = self._channels.values()
        if self._start is None:
            has_new_values = any(channel.values for channel in channels)
            if not has_new_values or any(channel.last_value() is None for channel in channels):
                return []
            first_indices = [min(channel.values) for channel in channels if channel.previous is None]
            if not first_indices:
                first_indices = [min(min(channel.values) for channel in channels if channel.values)]
            self._start = max(first_indices)
        newest_indices = [channel.newest for channel in channels if channel.arrival >= self._now() - SILENT_S]
        if not newest_indices or None in newest_indices:  # all are silent, or one that is not has no value on this axis
            return []
        blocks: list[Recording] = []
        known_stop = min(index for index in newest_indices if index is not None) + 1
        while known_stop - self._start >= self._length:
            stop = self._start + self._length
            samples = {name: channel.pop_values(self._start, stop) for name, channel in self._channels.items()}
            units = {name: CHANNEL_UNITS[name] for name in samples}
            blocks.append(Recording(np.arange(self._start, stop) / self.rate, samples, units, self.rate))
            self._start = stop
        return blocks
