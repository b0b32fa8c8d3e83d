"""Samples in the order of their clock: gaps, repeated and late samples, clocks set back, other rates, all counted.

The result depends on the samples and their order alone, never on how they were cut into pieces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.live.balance import FOLLOWS
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import recall, saved

#: Channels by which an actuator is watched, and with those that are kept beside the estimates.
_WATCHED = ("x", "theta", "omega", "p_A", "p_B", "p_1", "p_2", "u")
CHANNELS = (*_WATCHED, "T_oil")


@cache
def channels_to_watch(names: frozenset[str], valved: bool = False) -> tuple[str, ...]:
    """Return the channels by which an actuator is watched, of those of its samples; () where they do not suffice.

    The balance of volumes reads position, angle or speed, and the chambers' pressures, or, behind a servo valve
    (`valved`), the command and all pressures; without a position the chamber pressures and what moves the machine
    suffice.
    """
    if not {"p_A", "p_B"} <= names:
        return ()
    if valved and {"x", "u", "p_1", "p_2"} <= names:
        apart = {"theta", "omega"}
    elif not valved and "x" in names and {"theta", "omega"} & names:
        apart = {"u", "p_1", "p_2"}
    elif {"u", "theta", "omega"} & names:
        apart = {"x", "p_1", "p_2"}
    else:
        return ()
    return tuple(name for name in _WATCHED if name in names - apart)


#: Samples that follow each other: their times [s], and the channels.
Run = tuple[Array, dict[str, Array]]


@dataclass
class SampleJoiner:
    """Which samples of one actuator follow each other.

    `late_s`: samples up to this much older than the newest are late or repeated, and dropped; older ones show that the
    clock was set back. `valved`: the machine moves by a servo valve. `settled`: a position that is recorded later is
    left out. `counters`: samples that were dropped and interruptions, by reason.
    """

    late_s: float = 60.0
    valved: bool = False
    settled: bool = False
    names: tuple[str, ...] = ()
    rate: float = 0.0
    newest: float = -math.inf
    counters: dict[str, int] = field(default_factory=dict)

    def count(self, reason: str, number: int = 1) -> None:
        """Add to a counter."""
        self.counters[reason] = self.counters.get(reason, 0) + number

    def restart(self, reason: str) -> None:
        """Take the next sample whatever its time is: the recorder or its clock was set anew."""
        self.count(reason)
        self.newest = -math.inf

    def runs(self, samples: Recording) -> Iterator[Run]:
        """Yield the samples in runs without a hole; each follows the one before, unless a gap is counted."""
        if not self._fits(samples):
            return
        if abs(samples.rate / self.rate - 1.0) > 0.01:
            self.count("rate changed")
            self.rate = samples.rate
        for first, last in self._in_order(samples.t):
            step = float(samples.t[first]) - self.newest
            if math.isfinite(self.newest) and not self._follows(step, step):
                self.count("gap")
            self.newest = float(samples.t[last - 1])
            yield samples.t[first:last], {name: samples[name][first:last] for name in self.names}

    def _follows(self, least: float, most: float) -> bool:
        """Return whether samples follow each other that are so far apart, at least and at most [s]."""
        return least * self.rate > FOLLOWS[0] and most * self.rate < FOLLOWS[1]

    def _fits(self, samples: Recording) -> bool:
        """Return whether the samples have the stream's channels and SI units; count them where they do not."""
        names, offered = self.names, channels_to_watch(frozenset(samples.channels), self.valved)
        if not names or ("x" in offered and "x" not in names and not self.settled):
            names = offered
        wrong = [name for name in names if name not in samples or samples.units[name] != CHANNEL_UNITS[name]]
        if not names:
            reason = "samples without p_A, p_B and x with theta or omega, or u, theta or omega"
        elif wrong:
            missing = [name for name in wrong if name not in samples]
            of = f" of {wrong[0]} not in {CHANNEL_UNITS[wrong[0]]}"
            reason = f"samples without {missing[0]}" if missing else f"samples{of}"
        elif not 10.0 <= samples.rate <= 1e5:  # a reversal is not resolved, or a block holds too many samples
            reason = "samples at a rate outside 10 to 100000 Hz"
        else:
            if names != self.names:
                if self.names:
                    self.count("began anew: a position is recorded, too")
                self.names, self.rate = names, samples.rate
            return True
        self.count(reason, len(samples))
        return False

    def _in_order(self, t: Array) -> Iterator[tuple[int, int]]:
        """Yield first and one past the last index of runs of samples that follow each other."""
        with np.errstate(all="ignore"):  # NaN and infinity follow nothing
            steps = np.diff(t)
            whole = t.size > 1 and t[0] > self.newest and self._follows(float(steps.min()), float(steps.max()))
        if whole:  # as nearly always
            yield 0, t.size
            return
        known: NDArray[np.intp] = np.flatnonzero(np.isfinite(t))
        if known.size < t.size:
            self.count("samples without a time", t.size - known.size)
        while known.size:
            first, times = int(known[0]), t[known]
            if times[0] > self.newest:
                steps = np.diff(times) * self.rate
                follows = (steps > FOLLOWS[0]) & (steps < FOLLOWS[1]) & (np.diff(known) == 1)
                run = _length(follows) + 1
                yield first, first + run
            elif self.newest - times[0] > self.late_s:
                self.restart("clock set back")
                continue
            else:
                run = _length((times <= self.newest) & (times >= self.newest - self.late_s))
                self.count("late or repeated samples", run)
            known = known[run:]

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return saved(self, vars(self))

    def recall(self, state: Any) -> None:
        """Continue from a `state`; raises InputError where it does not fit."""
        recall(self, [*vars(self)], state, {"names": tuple[str, ...], "counters": dict[str, int]})
        if not {*self.names} <= {*CHANNELS}:
            raise InputError(f"saved state's samples must be of channels that are known, got {', '.join(self.names)}")


def _length(true: NDArray[np.bool_]) -> int:
    """Return how many of the first values are true."""
    return int(np.argmin(true)) if not true.all() else true.size
