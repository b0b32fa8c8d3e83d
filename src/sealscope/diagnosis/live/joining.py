"""Samples in the order of their clock: gaps, repeated and late samples, clocks set back, other rates, all counted.

The result depends on the samples and their order alone, never on how they were cut into pieces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.priors import priors
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import recall, saved

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Channels of an actuator that are kept: those that it may be watched by, and beside the estimates the oil's.
CHANNELS = ("x", "theta", "omega", "p_A", "p_B", "p_1", "p_2", "u", "T_oil")
_PRIORS = priors("live")["samples"]
_NEAREST, _FARTHEST = _PRIORS["follows"]
_CLOCKS: float = _PRIORS["rate"]


def ways_to_watch(rig: Rig) -> tuple[tuple[str, ...], ...]:
    """Return the sets of channels that suffice to watch an actuator, the best first.

    A balance of volumes reads the position; the response of the pressures needs none, but a cylinder of like areas.
    """
    if rig.valve.spool == "present":
        return (("p_A", "p_B", "p_1", "p_2", "u", "x"),)
    by_volumes = tuple(("p_A", "p_B", "x", flow) for flow in ("theta", "omega"))
    return by_volumes if rig.cylinder.single_rod else (*by_volumes, ("p_A", "p_B", "u"))


def in_words(ways: Sequence[Sequence[str]]) -> str:
    """Format the sets of channels of `ways_to_watch` for a message."""
    return ", or ".join(f"{', '.join(way[:-1])} and {way[-1]}" for way in ways)


def follow(steps: Any, rate: float) -> Any:
    """Test whether samples `steps` [s] apart follow each other; nearer ones are copies."""
    return (steps * rate > _NEAREST) & (steps * rate < _FARTHEST)


def same_rate(rate: float, before: float) -> bool:
    """Test whether two sampling rates [Hz] agree within the error of clocks."""
    return abs(rate / before - 1.0) < _CLOCKS


class SampleRun(NamedTuple):
    """Samples without a hole: times `t` [s], `channels`, sampling `rate` [Hz]; `follows`: no gap before them."""

    t: Array
    channels: Mapping[str, Array]
    rate: float
    follows: bool


@dataclass
class SampleJoiner:
    """Which samples of an actuator follow each other.

    `ways`: channels that it may be watched by (`ways_to_watch`). `late_s`: samples up to this much older than the
    newest are late or repeated, and dropped; older ones show that the clock was set back. `settled`: a position that
    is recorded later is left out. `changed`: the rate is another than that of the last run. `counters`: samples that
    were dropped and interruptions, by reason.
    """

    ways: tuple[tuple[str, ...], ...]
    late_s: float = 60.0
    settled: bool = False
    names: tuple[str, ...] = ()
    rate: float = 0.0
    newest: float = -math.inf
    changed: bool = False
    counters: dict[str, int] = field(default_factory=dict)

    def count(self, reason: str, number: int = 1) -> None:
        """Add to a counter."""
        self.counters[reason] = self.counters.get(reason, 0) + number

    def restart(self, reason: str) -> None:
        """Take the next sample whatever its time is: the recorder or its clock was set anew."""
        self.count(reason)
        self.newest = -math.inf

    def runs(self, samples: Recording) -> Iterator[SampleRun]:
        """Yield the samples in runs without a hole."""
        if not self._fits(samples):
            return
        if not same_rate(samples.rate, self.rate):
            self.count("rate changed")
            self.rate, self.changed = samples.rate, True
        for first, last in self._in_order(samples.t):
            joins = bool(follow(float(samples.t[first]) - self.newest, self.rate))
            if math.isfinite(self.newest) and not joins:
                self.count("gap")
            self.newest = float(samples.t[last - 1])
            channels = {name: samples[name][first:last] for name in self.names}
            yield SampleRun(samples.t[first:last], channels, self.rate, joins and not self.changed)
            self.changed = False

    def _fits(self, samples: Recording) -> bool:
        """Test whether the samples have the stream's channels and SI units; count them otherwise."""
        names, offered = self.names, next((way for way in self.ways if samples.channels.keys() >= {*way}), ())
        if not names or ("x" in offered and "x" not in names and not self.settled):
            names = offered
        wrong = [name for name in names if name not in samples or samples.units[name] != CHANNEL_UNITS[name]]
        if not names:
            reason = f"samples without {in_words(self.ways)}"
        elif wrong:
            missing = [name for name in wrong if name not in samples]
            wrong_unit = f" of {wrong[0]} not in {CHANNEL_UNITS[wrong[0]]}"
            reason = f"samples without {missing[0]}" if missing else f"samples{wrong_unit}"
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
            whole = t.size > 1 and t[0] > self.newest and bool(follow(steps, self.rate).all())
        if whole:  # as nearly always
            yield 0, t.size
            return
        known: NDArray[np.intp] = np.flatnonzero(np.isfinite(t))
        if known.size < t.size:
            self.count("samples without a time", t.size - known.size)
        while known.size:
            first, times = int(known[0]), t[known]
            if times[0] > self.newest:
                run = _length(follow(np.diff(times), self.rate) & (np.diff(known) == 1)) + 1
                yield first, first + run
            elif self.newest - times[0] > self.late_s:
                self.restart("clock set back")
                continue
            else:
                run = _length((times <= self.newest) & (times >= self.newest - self.late_s))
                self.count("late or repeated samples", run)
            known = known[run:]

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        return saved(self, _SAVED)

    def recall(self, state: Any) -> None:
        """Continue from a `state`; raises InputError where it does not fit."""
        recall(self, _SAVED, state, {"names": tuple[str, ...], "counters": dict[str, int]})
        if self.names not in ((), *self.ways):
            raise InputError(f"saved state's names must be {in_words(self.ways)}, got {', '.join(self.names)}")


_SAVED = ("settled", "names", "rate", "newest", "changed", "counters")


def _length(true: NDArray[np.bool_]) -> int:
    """Count the values before the first false one."""
    return int(np.argmin(true)) if not true.all() else true.size
