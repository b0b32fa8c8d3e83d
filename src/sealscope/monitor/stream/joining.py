"""Samples in the order of their clock: gaps, repeated and late samples, clocks set back, other rates, all counted.

The result depends on the samples and their order alone, never on how they were cut into pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.monitor.stream.plain_state import array_of, part_of, plain_array
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

#: Channels by which an actuator is watched, and with those that are kept beside the estimates.
_WATCHED = ("x", "theta", "omega", "p_A", "p_B", "p_1", "p_2", "u")
CHANNELS = (*_WATCHED, "T_oil")
#: Rates that differ by less than this share are one rate.
_SAME_RATE = 0.01
#: Two samples follow each other where their times differ by so many steps.
_FOLLOWS = (0.5, 1.5)
#: Rates taken [Hz]: below, a reversal is not resolved; above, a block would hold more samples than it is worth.
_RATES = (10.0, 100_000.0)


def channels_to_watch(samples: Recording) -> tuple[str, ...]:
    """Return the channels by which an actuator is watched, of those of its samples; () where they do not suffice.

    The balance of volumes reads position, angle or speed, and all pressures; without a position the chamber pressures
    and what moves the machine suffice.
    """
    there = {name for name in _WATCHED if name in samples}
    if not {"p_A", "p_B"} <= there:
        return ()
    if "x" in there and {"theta", "omega"} & there:
        return tuple(name for name in _WATCHED if name in there - {"u"})
    if {"u", "theta", "omega"} & there:
        return tuple(name for name in _WATCHED if name in there - {"x", "p_1", "p_2"})
    return ()


@dataclass
class SampleJoiner:
    """The samples of one actuator since the last whole block, without holes.

    `late_s`: samples up to this much older than the newest are late or repeated, and dropped; older ones show that the
    clock was set back. `settled`: a position that is recorded later is left out. `counters`: samples that were dropped
    and interruptions, by reason.
    """

    late_s: float = 60.0
    settled: bool = False
    names: tuple[str, ...] = ()
    rate: float = 0.0
    newest: float = float("-inf")
    t: Array = field(default_factory=lambda: np.empty(0))
    channels: dict[str, Array] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return int(self.t.size)

    def count(self, reason: str, number: int = 1) -> None:
        """Add to a counter."""
        self.counters[reason] = self.counters.get(reason, 0) + number

    def interrupt(self, reason: str) -> None:
        """Drop the samples since the last whole block, and count why."""
        self.count(reason)
        self.t, self.channels = np.empty(0), {name: np.empty(0) for name in self.names}

    def restart(self, reason: str) -> None:
        """Take the next sample whatever its time is: the recorder or its clock was set anew."""
        self.interrupt(reason)
        self.newest = float("-inf")

    def runs(self, samples: Recording) -> Iterator[None]:
        """Append the samples run by run, and yield after each run that follows without a hole."""
        if not self._fits(samples):
            return
        if abs(samples.rate / self.rate - 1.0) > _SAME_RATE:
            self.interrupt("rate changed")
            self.rate = samples.rate
        known = np.isfinite(samples.t)
        if not known.all():
            self.count("samples without a time", int(np.count_nonzero(~known)))
        for first, last in self._in_order(samples.t, np.flatnonzero(known)):
            if np.isfinite(self.newest) and not self._follows(samples.t[first] - self.newest):
                self.interrupt("gap")
            self.t = np.concatenate([self.t, samples.t[first:last]])
            self.channels = {
                name: np.concatenate([self.channels[name], samples[name][first:last]]) for name in self.names
            }
            self.newest = float(self.t[-1])
            yield

    def _follows(self, step: Any) -> Any:
        low, high = _FOLLOWS
        return (step * self.rate > low) & (step * self.rate < high)

    def _fits(self, samples: Recording) -> bool:
        """Return whether the samples have the stream's channels and SI units; count them where they do not."""
        names, offered = self.names, channels_to_watch(samples)
        if not names or ("x" in offered and "x" not in names and not self.settled):
            names = offered
        missing = [name for name in names if name not in samples]
        if not names:
            missing = ["p_A, p_B and x with theta or omega, or u, theta or omega"]
        if missing:
            self.count(f"samples without {missing[0]}", len(samples))
            return False
        for name in names:
            if samples.units[name] != CHANNEL_UNITS[name]:
                self.count(f"samples of {name} not in {CHANNEL_UNITS[name]}", len(samples))
                return False
        if not _RATES[0] <= samples.rate <= _RATES[1]:
            self.count(f"samples at a rate outside {_RATES[0]:g} to {_RATES[1]:g} Hz", len(samples))
            return False
        if names != self.names:
            if self.names:
                self.count("began anew: a position is recorded, too")
            self.names, self.rate, self.t = names, samples.rate, np.empty(0)
            self.channels = {name: np.empty(0) for name in names}
        return True

    def _in_order(self, t: Array, known: NDArray[np.intp]) -> Iterator[tuple[int, int]]:
        """Yield first and one past the last index of runs of samples that follow each other."""
        at = 0
        while at < known.size:
            first = int(known[at])
            if t[first] <= self.newest:
                if self.newest - t[first] > self.late_s:
                    self.restart("clock set back")
                    continue
                late = (t[known[at:]] <= self.newest) & (t[known[at:]] >= self.newest - self.late_s)
                run = int(np.argmin(late)) if not late.all() else late.size
                self.count("late or repeated samples", run)
                at += run
                continue
            rest = known[at:]
            breaks = ~self._follows(np.diff(t[rest])) | (np.diff(rest) != 1)
            run = int(np.argmax(breaks)) + 1 if breaks.any() else rest.size
            yield first, first + run
            at += run

    def taken(self, length: int) -> Recording:
        """Return the first `length` samples, and drop them here."""
        block = self.first(length)
        self.t = self.t[length:].copy()
        self.channels = {name: values[length:].copy() for name, values in self.channels.items()}
        return block

    def first(self, length: int) -> Recording:
        """Return the first `length` samples, which stay."""
        units = {name: CHANNEL_UNITS[name] for name in self.names}
        return Recording(self.t[:length], {name: self.channels[name][:length] for name in self.names}, units, self.rate)

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return {
            "late_s": self.late_s,
            "settled": self.settled,
            "names": list(self.names),
            "rate": self.rate,
            "newest": None if self.newest == float("-inf") else self.newest,
            "t": plain_array(self.t),
            "channels": {name: plain_array(values) for name, values in self.channels.items()},
            "counters": dict(self.counters),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> SampleJoiner:
        """Return the joiner that `state` was of; raises InputError where it does not fit."""
        newest = part_of(state, "newest", (float, int, type(None)))
        names = tuple(name for name in part_of(state, "names", list) if name in CHANNELS)
        channels = part_of(state, "channels", Mapping)
        return cls(
            float(part_of(state, "late_s", (float, int))),
            bool(part_of(state, "settled", bool)),
            names,
            float(part_of(state, "rate", (float, int))),
            float("-inf") if newest is None else float(newest),
            array_of(part_of(state, "t", Mapping), "t"),
            {name: array_of(part_of(channels, name, Mapping), name) for name in names},
            {str(reason): int(number) for reason, number in part_of(state, "counters", Mapping).items()},
        )
