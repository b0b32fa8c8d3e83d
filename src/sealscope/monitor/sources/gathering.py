"""Gather values of single channels, each with its own time, into blocks of samples on one time axis.

A source that reports changes (OPC UA) sends nothing while a channel is constant, so a missing sample repeats the value
before it. A block is complete when every channel has values up to its end, or is silent for `SILENT_S`. Values that are
known to be lost, or whose clock disagrees with the other channels', are missing (NaN), and counted.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sealscope.monitor.logged_counts import LoggedCounts
from sealscope.monitor.sources.message_limits import MAX_SAMPLES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

#: Silence after which a channel counts as constant [s].
SILENT_S = 3.0
#: Largest step from the newest value [s]; a larger one is a pause, or a clock set back, and starts a new block.
_AHEAD_S = 60.0
#: Samples of a block at which it ends, if several seconds are complete at once.
_LONG_BLOCK = 100_000
#: Counters of dropped values, and of changes of a clock.
LATE = "values that came after their block"
NO_CLOCK = "values without a clock, or too many"
CLOCK_OFF = f"values whose clock is off by more than {_AHEAD_S:g} s from that of another channel"
CLOCK_SET = f"clocks that were set by more than {_AHEAD_S:g} s"


@dataclass
class _Channel:
    """The values of one channel that are not in a block yet."""

    # pieces (index of the first value, values) in the order of arrival; an index is round(time [s] x rate [Hz])
    pieces: deque[tuple[int, Array]] = field(default_factory=deque)
    size: int = 0  # number of values in the pieces
    last_index: int | None = None  # largest index in the pieces, None without any
    last: float = math.nan  # value at this index
    previous: float | None = None  # the last value before the pieces
    newest: int | None = None  # largest index of any value so far
    stamp: int | None = None  # index of the first of the values that arrived last
    arrival: float = -math.inf  # time at which they arrived [s]
    is_off: bool = False  # True if they were dropped, as their clock disagrees with the other channels'

    def last_value(self) -> float | None:
        """Return the latest value on the time axis, or None if there is none."""
        return self.previous if self.last_index is None else self.last

    def add(self, first: int, values: Array) -> None:
        """Add values from the index `first` on; they replace earlier ones with the same indices."""
        self.pieces.append((first, values))
        self.size += values.size
        last_index = first + values.size - 1
        if self.last_index is None or last_index >= self.last_index:
            self.last_index, self.last = last_index, float(values[-1])
        self.newest = last_index if self.newest is None else max(last_index, self.newest)

    def limit(self, max_size: int) -> None:
        """Drop the values that arrived first, until at most `max_size` remain."""
        while self.size > max_size:
            first, values = self.pieces.popleft()
            n_dropped = min(values.size, self.size - max_size)
            self.previous = float(values[n_dropped - 1])
            self.size -= n_dropped
            if n_dropped < values.size:
                self.pieces.appendleft((first + n_dropped, values[n_dropped:]))

    def pop_values(self, first: int, stop: int) -> Array:
        """Remove the values before index `stop`, and return the samples (stop - first,) from index `first` on.

        A missing sample repeats the value before it, NaN if there is none.
        """
        samples, is_known = np.full(1 + stop - first, math.nan), np.zeros(1 + stop - first, dtype=bool)
        # index 0 of both arrays stands for the value before `first`
        samples[0], is_known[0] = math.nan if self.previous is None else self.previous, True
        later_pieces: deque[tuple[int, Array]] = deque()
        for index, values in self.pieces:
            n_popped = min(max(stop - index, 0), values.size)
            n_before = min(max(first - index, 0), n_popped)
            if n_before:
                samples[0] = values[n_before - 1]
            begin = index + n_before - first + 1
            samples[begin : begin + n_popped - n_before] = values[n_before:n_popped]
            is_known[begin : begin + n_popped - n_before] = True
            if n_popped < values.size:
                later_pieces.append((index + n_popped, values[n_popped:]))
        self.pieces, self.size = later_pieces, sum(values.size for _, values in later_pieces)
        if self.last_index is not None and self.last_index < stop:
            self.last_index = None
        samples = samples[np.maximum.accumulate(np.where(is_known, np.arange(is_known.size), 0))]
        self.previous = float(samples[-1])
        return samples[1:]


class ValueGatherer:
    """Gathers the values of one actuator's `channels` into blocks at `rate` [Hz], of whole multiples of `block_s` [s].

    `count`: function called with the reason when values are dropped, and with their number if it is not one; `now`:
    returns a monotonic time [s]; `name`: name of the actuator in the log.
    """

    def __init__(
        self,
        channels: Sequence[str],
        rate: float,
        block_s: float,
        count: Callable[..., object],
        now: Callable[[], float] = time.monotonic,
        name: str = "",
    ) -> None:
        self.rate, self._length = rate, max(1, round(block_s * rate))
        self._max_lead, self._counts, self._now = math.ceil(_AHEAD_S * rate), LoggedCounts(count), now
        self._name, self._channels = name, {channel: _Channel() for channel in channels}
        self._start: int | None = None

    def push(
        self, channel: str, t: float, values: Sequence[float] | Array, lost_since: float | None = None
    ) -> list[Recording]:
        """Add successive samples of a channel, in SI units; return the blocks of all channels that are then complete.

        `t` [s]: time of the first sample, rounded to the sampling interval; the others follow at the sampling rate. NaN
        is an unknown value. `lost_since` [s]: values from this time on were lost, so that the samples until `t` are
        missing; None if they repeat the value before, which has not changed.

        No values, too many, or values without a finite time are dropped and counted. If the time jumps forward by more
        than `_AHEAD_S`, the blocks continue after the pause with each channel's last value. If it jumps back by as
        much, the clock was set, and all earlier values are discarded. If a channel keeps its pace and only disagrees
        with the others by as much, its values are dropped, and its samples missing. Only the first value of a channel
        may be so old, dated by its last change; it counts as the present value.
        """
        samples, target, now = np.asarray(values, dtype=np.float64), self._channels[channel], self._now()
        n_waiting = target.size + samples.size
        # sample numbers up to 2^52 are exact as doubles
        if not math.isfinite(t) or abs(t * self.rate) > 2**52 or not 0 < samples.size <= n_waiting <= MAX_SAMPLES:
            self._counts.add(NO_CLOCK, f"{self._name}, {channel}", max(1, samples.size))
            return []
        first = round(t * self.rate)
        ends = [state.newest for state in self._channels.values() if state.newest is not None]
        on_axis = (state.stamp for state in self._channels.values() if state.newest is not None)
        stamps = [stamp for stamp in on_axis if stamp is not None]
        is_ahead = first - max(ends, default=first) > self._max_lead
        is_behind = first - max(stamps, default=first) < -self._max_lead
        if (is_ahead or is_behind) and self._disagrees(channel, first):
            self._counts.add(CLOCK_OFF, f"{self._name}, {channel}", samples.size, self._format_lead(first, stamps))
            # its samples are missing, as their times are not known
            self._channels[channel] = _Channel(previous=math.nan, stamp=first, arrival=now, is_off=True)
        elif is_behind and target.last_value() is None:
            target.previous, target.stamp, target.arrival = float(samples[-1]), first, now
        else:
            if is_ahead or is_behind:
                if is_behind or self._has_jumped(target, first):
                    self._counts.add(CLOCK_SET, f"{self._name}, {channel}", detail=self._format_lead(first, stamps))
                self._start_again(keep_values=is_ahead)
                target = self._channels[channel]
            if lost_since is not None and target.newest is not None:
                first_lost = max(round(max(lost_since, t - _AHEAD_S) * self.rate), self._start or 0)
                if first_lost < first:
                    self._add_values(channel, first_lost, np.array([math.nan]))
            self._add_values(channel, first, samples)
            target.stamp, target.arrival, target.is_off = first, now, False
        return self._pop_blocks()

    def _has_jumped(self, target: _Channel, first: int) -> bool:
        """Return True if the clock of a channel has moved on by much more or less than the time since its last value.

        `first`: index of its new value. Without an earlier value the result is False.
        """
        if target.stamp is None:
            return False
        return abs((first - target.stamp) / self.rate - (self._now() - target.arrival)) > _AHEAD_S

    def _disagrees(self, channel: str, first: int) -> bool:
        """Return True if a channel whose new value lies far from the others keeps its own pace, while others arrive."""
        target, now = self._channels[channel], self._now()
        has_company = any(
            state.newest is not None and state.arrival >= now - SILENT_S
            for name, state in self._channels.items()
            if name != channel
        )
        return has_company and target.stamp is not None and not self._has_jumped(target, first)

    def _format_lead(self, first: int, stamps: Sequence[int]) -> str:
        """Format how far a new value with the index `first` lies before or after the newest time, `stamps`."""
        lead_s = (first - max(stamps, default=first)) / self.rate
        return f"{abs(lead_s):.0f} s {'after' if lead_s > 0.0 else 'before'} the newest value"

    def _add_values(self, channel: str, first: int, values: Array) -> None:
        """Add values to a channel from index `first` of the time axis on; drop those before the next block.

        Before the first block, which waits for a value of every channel, only the newest `_max_lead` values are kept,
        or the last array.
        """
        target = self._channels[channel]
        if self._start is not None and first < self._start:
            n_late = min(self._start - first, values.size)
            self._counts.add(LATE, f"{self._name}, {channel}", n_late)
            first, values = first + n_late, values[n_late:]
        if values.size:
            target.add(first, values)
        if self._start is None:
            target.limit(max(self._max_lead, values.size))

    def discard_values(self) -> None:
        """Discard all values that are in no block yet; the time axis begins anew, as after a lost connection."""
        self._channels = {name: _Channel() for name in self._channels}
        self._start = None

    def _start_again(self, *, keep_values: bool) -> None:
        """Begin the time axis anew; with `keep_values`, after a pause, each channel starts from its last value.

        The stamps are kept: they tell a clock that was set from one that disagrees with the others.
        """
        old_channels = self._channels
        self.discard_values()
        for name, old_channel in old_channels.items():
            previous = old_channel.last_value() if keep_values else None
            self._channels[name] = _Channel(previous=previous, stamp=old_channel.stamp, arrival=old_channel.arrival)

    def _pop_blocks(self) -> list[Recording]:
        """Remove and return the complete blocks, up to whose end every channel has values or is silent.

        The first block waits until every channel has a value and one of them a new one. A channel with a `previous`
        value has a sample at every index, so that the block begins at the first index at which the others have theirs,
        too; if there are no others, at the first new value.
        """
        channels = self._channels.values()
        if self._start is None:
            has_new_values = any(channel.pieces for channel in channels)
            if not has_new_values or any(channel.last_value() is None for channel in channels):
                return []
            first_of = [(channel, min(first for first, _ in channel.pieces)) for channel in channels if channel.pieces]
            first_indices = [first for channel, first in first_of if channel.previous is None]
            self._start = max(first_indices) if first_indices else min(first for _, first in first_of)
        arriving_channels = (channel for channel in channels if channel.arrival >= self._now() - SILENT_S)
        newest_indices = [channel.newest for channel in arriving_channels if not channel.is_off]
        if not newest_indices or None in newest_indices:  # all are silent, or one that is not has no value on this axis
            return []
        blocks: list[Recording] = []
        known_stop = min(index for index in newest_indices if index is not None) + 1
        max_length = max(1, _LONG_BLOCK // self._length) * self._length
        while (n_known := known_stop - self._start) >= self._length:
            stop = self._start + min(n_known - n_known % self._length, max_length)
            samples = {name: channel.pop_values(self._start, stop) for name, channel in self._channels.items()}
            units = {name: CHANNEL_UNITS[name] for name in samples}
            blocks.append(Recording(np.arange(self._start, stop) / self.rate, samples, units, self.rate))
            self._start = stop
        return blocks
