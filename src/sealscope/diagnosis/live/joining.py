"""Join incoming samples in the order of their clock, and count gaps, late samples and changes of the clock.

The result depends on the samples and their order, not on how they are divided into messages.

A motor angle that begins anew after a turn is unwrapped: a step of more than half a turn and more than half the angle's
range so far is a wrap, if the angle stays within whole turns and these explain the step. Over missing samples the step
counts beside that of the speed before them. Files are unwrapped by `recordings.formats.wrapped_angle`, which sees the
whole angle first.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import SavedAttributes

_TURN = 2.0 * math.pi  # [rad]
#: Largest part of a wrap's step that remains without whole turns.
_MAX_REMAINDER = 0.25
#: Largest step or range [rad] of a wrapped angle: 2^32 counts of 4096 a turn.
_MAX_ANGLE = _TURN * 2.0**20
#: Largest excess of the angle's range over its period, by rounding, relative.
_TOLERANCE = 1e-3


@dataclass
class AngleUnwrapper(SavedAttributes):
    """Remove the wraps of an angle [rad] that arrives in pieces."""

    SAVED: ClassVar = ("low", "high", "last", "missing", "step", "turns")

    low: float = math.inf  # range of the recorded angle so far [rad]
    high: float = -math.inf
    last: float = math.nan  # last recorded angle [rad]
    missing: int = 0  # number of missing samples since
    step: float = 0.0  # last step from sample to sample, without wraps [rad]
    turns: int = 0  # sum of the wraps so far

    def interrupt(self) -> None:
        """Forget the last angle, as after a gap in time over which the shaft may have turned by any angle."""
        self.last, self.missing, self.step = math.nan, 0, 0.0

    def unwrap(self, values: Array) -> tuple[Array, int]:
        """Return the next angles (n,) [rad] without wraps, and the number of wraps; missing values (NaN) stay so."""
        steps = np.diff(values)
        first_step = 0.0 if math.isnan(self.last) else float(values[0]) - self.last
        # the usual case: no step may be a wrap (False with a missing value)
        if abs(first_step) <= 0.5 * _TURN and np.abs(steps).max(initial=0.0) <= 0.5 * _TURN and not self.missing:
            self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
            self.last, self.step = float(values[-1]), float(steps[-1]) if len(steps) else first_step
            return (values + _TURN * self.turns if self.turns else values), 0
        rows = np.flatnonzero(np.isfinite(values))
        if not rows.size:
            self.missing += values.size
            return values, 0
        known = values[rows]
        first = known[0] if math.isnan(self.last) else self.last
        steps = np.diff(known, prepend=first)
        counts = np.diff(rows, prepend=-1 - self.missing)  # intervals from one to the next
        low = np.minimum(np.minimum.accumulate(known), self.low)
        high = np.maximum(np.maximum.accumulate(known), self.high)
        self.missing = values.size - 1 - int(rows[-1])
        self.last, self.low, self.high = float(known[-1]), float(low[-1]), float(high[-1])
        span = high - low
        turns = np.zeros(known.size, dtype=np.int64)
        for row in np.flatnonzero((np.abs(steps) > np.maximum(0.5 * _TURN, 0.5 * span)) | (counts > 1)).tolist():
            before = self.step if row == 0 else (steps[row - 1] + _TURN * turns[row - 1]) / counts[row - 1]
            predicted = counts[row] * before if counts[row] > 1 else 0.0
            turns[row] = _find_wrap(float(steps[row]), float(predicted), float(span[row]))
        self.step = float((steps[-1] + _TURN * turns[-1]) / counts[-1])
        if turns.any() or self.turns:
            total = self.turns + np.cumsum(turns)
            values = values.copy()
            values[rows] = known + _TURN * total
            self.turns = int(total[-1])
        return values, int(np.count_nonzero(turns))


def _find_wrap(step: float, predicted: float, span: float) -> int:
    """Find the number of turns to add to a `step` [rad] that a wrap has changed; 0 without a wrap.

    `predicted`: step over missing samples at the speed before it [rad], else 0; `span`: range of the recorded angle,
    which fills the period at most. In a range of one turn the shaft may turn by half a turn from sample to sample.
    """
    excess = step - predicted
    if not max(abs(excess), span) < _MAX_ANGLE:  # True for NaN, too
        return 0
    turns = max(1, round(span / _TURN), round(abs(excess) / _TURN))
    period = _TURN * turns
    is_far = abs(excess) > 0.5 * _TURN and abs(excess) > 0.5 * span and span <= (1.0 + _TOLERANCE) * period
    is_explained = turns == 1 or abs(abs(excess) - period) <= _MAX_REMAINDER * abs(excess)
    return (-turns if excess > 0.0 else turns) if is_far and is_explained else 0


#: Channels of an actuator to store: those by which its blocks or recordings are judged, and the oil temperature.
CHANNELS = ("x", "theta", "omega", "q_pump", "p_A", "p_B", "p_1", "p_2", "u", "T_oil")
_PRIORS = LIVE.samples
#: Limits of the step between successive samples, in sampling intervals.
_MIN_STEP, _MAX_STEP = _PRIORS.follows
#: Largest age of a late or repeated sample [s]; an older one means that the clock was set back.
_MAX_LATE_S = 60.0


def find_way(ways: Sequence[tuple[str, ...]], channels: Collection[str]) -> tuple[str, ...]:
    """Return the first of the sets of channels, `ways` to watch a machine, that the `channels` contain, or ()."""
    return next((way for way in ways if {*channels} >= {*way}), ())


def format_ways(ways: Sequence[Sequence[str]]) -> str:
    """Format alternative sets of channels, the `ways` to watch a machine, as a text such as "p_A, p_B and u"."""
    return ", or ".join(f"{', '.join(way[:-1])} and {way[-1]}" for way in ways)


def are_successive(steps: Any, rate: float) -> Any:
    """Return True for each sample that directly follows the sample before it; False for a gap and for a copy.

    `steps` are the times between neighbouring samples [s], a number or an array, and `rate` is the sampling rate [Hz].
    """
    return (steps * rate > _MIN_STEP) & (steps * rate < _MAX_STEP)


def is_same_rate(rate: float, rate_before: float) -> bool:
    """Return True if two sampling rates [Hz] are equal to within 1 %, the usual error of a logger's stated rate."""
    return abs(rate / rate_before - 1.0) < _PRIORS.rate


class SampleRun(NamedTuple):
    """Samples without a gap between them."""

    t: Array  # (n,): times [s]
    channels: Mapping[str, Array]
    rate: float  # sampling rate [Hz]
    follows: bool  # True if there is no gap, nor a change of the rate, between these samples and those before them


@dataclass
class SampleJoiner(SavedAttributes):
    """Divide the samples of an actuator into runs without a gap."""

    SAVED: ClassVar = ("names", "rate", "newest", "changed", "counters", "angle")
    SAVED_TYPES: ClassVar = {"names": tuple[str, ...], "counters": dict[str, int]}

    ways: tuple[tuple[str, ...], ...]  # sets of channels from which the actuator can be watched, the best first
    names: tuple[str, ...] = ()  # set of channels in use, empty before the first samples
    rate: float = 0.0  # sampling rate [Hz]
    newest: float = -math.inf  # time of the newest sample [s]
    changed: bool = False  # True if `rate` differs from the rate of the last run
    counters: dict[str, int] = field(default_factory=dict)  # numbers of dropped samples and of interruptions, by reason
    angle: AngleUnwrapper = field(default_factory=AngleUnwrapper)  # for the pump's angle theta

    def count(self, reason: str, number: int = 1) -> None:
        """Add `number` to the counter called `reason`."""
        self.counters[reason] = self.counters.get(reason, 0) + number

    def restart(self, reason: str) -> None:
        """Accept any time for the next sample, as after a restart of the recorder; add 1 to the counter `reason`."""
        self.count(reason)
        self.newest = -math.inf

    def runs(self, samples: Recording) -> Iterator[SampleRun]:
        """Yield the runs of samples without a gap; count dropped samples, gaps, and changes of the rate.

        The set of channels is the first of `ways` that the first samples have.
        """
        names = self.names or find_way(self.ways, samples.channels)
        if reason := _find_lack(samples, names) if names else f"samples without {format_ways(self.ways)}":
            self.count(reason, len(samples))
            return
        if not self.names:
            self.names, self.rate = names, samples.rate
        if not is_same_rate(samples.rate, self.rate):
            self.count("rate changed")
            self.rate, self.changed = samples.rate, True
        for first, stop in self._iter_runs(samples.t):
            has_no_gap = bool(are_successive(float(samples.t[first]) - self.newest, self.rate))
            if not has_no_gap:
                self.angle.interrupt()
                if math.isfinite(self.newest):
                    self.count("gap")
            self.newest = float(samples.t[stop - 1])
            channels = {name: samples[name][first:stop] for name in self.names}
            if "theta" in channels:
                channels["theta"], n_wraps = self.angle.unwrap(channels["theta"])
                if n_wraps:
                    self.count("wraps of the motor angle, undone", n_wraps)
            yield SampleRun(samples.t[first:stop], channels, self.rate, has_no_gap and not self.changed)
            self.changed = False

    def _iter_runs(self, t: Array) -> Iterator[tuple[int, int]]:
        """Yield the index range (first, last + 1) of each run of times `t` (n,) [s] without a gap.

        Times that are missing, late or repeated are dropped and counted; clocks set back are counted. The caller must
        set `newest` to the last time of each run before asking for the next run.
        """
        with np.errstate(all="ignore"):  # comparisons with NaN are False, which leads to the search below
            is_one_run = t.size > 1 and t[0] > self.newest and bool(are_successive(np.diff(t), self.rate).all())
        if is_one_run:  # the usual case needs no search
            yield 0, t.size
            return
        indices: NDArray[np.intp] = np.flatnonzero(np.isfinite(t))
        if indices.size < t.size:
            self.count("samples without a time", t.size - indices.size)
        while indices.size:
            first, times = int(indices[0]), t[indices]
            if self.newest - times[0] > _MAX_LATE_S:
                self.restart("clock set back")
            elif times[0] > self.newest:
                n_samples = _count_leading(are_successive(np.diff(times), self.rate) & (np.diff(indices) == 1)) + 1
                yield first, first + n_samples
                indices = indices[n_samples:]
            else:
                n_samples = _count_leading((times <= self.newest) & (times >= self.newest - _MAX_LATE_S))
                self.count("late or repeated samples", n_samples)
                indices = indices[n_samples:]

    def load_state(self, state: Any) -> None:
        """Restore the values saved by `state`; raise InputError if the channels are not one of the sets `ways`."""
        super().load_state(state)
        if self.names not in ((), *self.ways):
            raise InputError(f"saved state's names must be {format_ways(self.ways)}, got {', '.join(self.names)}")


def _find_lack(samples: Recording, names: Sequence[str]) -> str:
    """Describe why samples do not suffice to watch an actuator by the channels `names`; "" if they suffice."""
    for name in names:
        if name not in samples:
            return f"samples without {name}"
        if samples.units[name] != CHANNEL_UNITS[name]:
            return f"samples of {name} not in {CHANNEL_UNITS[name]}"
    # at slower rates a reversal is not resolved, at faster ones a block has too many samples
    return "" if 10.0 <= samples.rate <= 1e5 else "samples at a rate outside 10 to 100000 Hz"


def _count_leading(flags: NDArray[np.bool_]) -> int:
    """Count the True values at the beginning of an array (n,), before the first False."""
    return int(np.argmin(flags)) if not flags.all() else flags.size  # argmin: index of the first False
