"""Join samples in the order of their clock, and count gaps, repeated and late samples, clocks set back, other rates.

The result depends on the samples and their order, not on how they are divided into messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import restore_attributes, save_attributes

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Channels of an actuator to store: those that it may be watched by, and the oil temperature.
CHANNELS = ("x", "theta", "omega", "p_A", "p_B", "p_1", "p_2", "u", "T_oil")
_PRIORS = LIVE.samples
#: Limits of the step between successive samples, in sampling intervals; relative error of a stated sampling rate.
_MIN_STEP, _MAX_STEP = _PRIORS.follows
_MAX_RATE_ERROR: float = _PRIORS.rate


def ways_to_watch(rig: Rig) -> tuple[tuple[str, ...], ...]:
    """Return the sets of channels that suffice to watch an actuator, the best first.

    A balance of volumes reads the position; the response of the pressures needs none, but a cylinder of equal areas.
    """
    if rig.valve.spool == "present":
        return (("p_A", "p_B", "p_1", "p_2", "u", "x"),)
    balance_ways = tuple(("p_A", "p_B", "x", pump_channel) for pump_channel in ("theta", "omega"))
    return balance_ways if rig.cylinder.single_rod else (*balance_ways, ("p_A", "p_B", "u"))


def format_ways(ways: Sequence[Sequence[str]]) -> str:
    """Format the sets of channels of `ways_to_watch` for a message."""
    return ", or ".join(f"{', '.join(way[:-1])} and {way[-1]}" for way in ways)


def are_successive(steps: Any, rate: float) -> Any:
    """Test whether samples follow each other without a gap.

    `steps`: time between neighbours [s]; `rate`: sampling rate [Hz]. False for a gap and for a copy of the sample
    before.
    """
    return (steps * rate > _MIN_STEP) & (steps * rate < _MAX_STEP)


def is_same_rate(rate: float, rate_before: float) -> bool:
    """Test whether two sampling rates [Hz] agree within the error of clocks."""
    return abs(rate / rate_before - 1.0) < _MAX_RATE_ERROR


class SampleRun(NamedTuple):
    """Samples without a gap: times `t` [s], `channels`, sampling `rate` [Hz]; `follows`: no gap before them."""

    t: Array
    channels: Mapping[str, Array]
    rate: float
    follows: bool


@dataclass
class SampleJoiner:
    """Divide the samples of an actuator into runs without a gap.

    `ways`: sets of channels that suffice (`ways_to_watch`); `names`: set in use, replaced by a better one if a position
    is recorded later, unless `is_final`. Samples up to `late_s` [s] older than the `newest` one are late or repeated,
    and dropped; older ones show that the clock was set back. `changed`: True if the `rate` differs from that of the
    last run. `counters`: numbers of dropped samples and of interruptions, by reason.
    """

    ways: tuple[tuple[str, ...], ...]
    late_s: float = 60.0
    is_final: bool = False
    names: tuple[str, ...] = ()
    rate: float = 0.0
    newest: float = -math.inf
    changed: bool = False
    counters: dict[str, int] = field(default_factory=dict)

    def count(self, reason: str, number: int = 1) -> None:
        """Add a number to the counter of a reason."""
        self.counters[reason] = self.counters.get(reason, 0) + number

    def restart(self, reason: str) -> None:
        """Accept any time of the next sample, as the recorder or its clock was restarted; count the reason."""
        self.count(reason)
        self.newest = -math.inf

    def runs(self, samples: Recording) -> Iterator[SampleRun]:
        """Yield the samples in runs without a gap; drop and count those that cannot be used or are late."""
        names = self._choose_names(samples)
        if lack := _find_lack(samples, names):
            self.count(lack if names else f"samples without {format_ways(self.ways)}", len(samples))
            return
        if names != self.names:
            if self.names:
                self.count("began anew: a position is recorded, too")
            self.names, self.rate = names, samples.rate
        if not is_same_rate(samples.rate, self.rate):
            self.count("rate changed")
            self.rate, self.changed = samples.rate, True
        for first, stop in self._iter_runs(samples.t):
            has_no_gap = bool(are_successive(float(samples.t[first]) - self.newest, self.rate))
            if math.isfinite(self.newest) and not has_no_gap:
                self.count("gap")
            self.newest = float(samples.t[stop - 1])
            channels = {name: samples[name][first:stop] for name in self.names}
            yield SampleRun(samples.t[first:stop], channels, self.rate, has_no_gap and not self.changed)
            self.changed = False

    def _choose_names(self, samples: Recording) -> tuple[str, ...]:
        """Choose the channels to use: the best recorded set, at first or once a position appears, else `names`."""
        recorded = next((way for way in self.ways if samples.channels.keys() >= {*way}), ())
        has_new_position = "x" in recorded and "x" not in self.names and not self.is_final
        return recorded if not self.names or has_new_position else self.names

    def _iter_runs(self, t: Array) -> Iterator[tuple[int, int]]:
        """Yield first index and end (exclusive) of each run of successive times `t` [s] later than the newest sample.

        Times that are missing, late or repeated are counted; `newest` is to be updated after each run.
        """
        with np.errstate(all="ignore"):  # NaN and infinity follow nothing
            is_one_run = t.size > 1 and t[0] > self.newest and bool(are_successive(np.diff(t), self.rate).all())
        if is_one_run:  # the usual case needs no search
            yield 0, t.size
            return
        indices: NDArray[np.intp] = np.flatnonzero(np.isfinite(t))
        if indices.size < t.size:
            self.count("samples without a time", t.size - indices.size)
        while indices.size:
            first, times = int(indices[0]), t[indices]
            if self.newest - times[0] > self.late_s:
                self.restart("clock set back")
            elif times[0] > self.newest:
                n_samples = _count_leading(are_successive(np.diff(times), self.rate) & (np.diff(indices) == 1)) + 1
                yield first, first + n_samples
                indices = indices[n_samples:]
            else:
                n_samples = _count_leading((times <= self.newest) & (times >= self.newest - self.late_s))
                self.count("late or repeated samples", n_samples)
                indices = indices[n_samples:]

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        return save_attributes(self, _SAVED)

    def load_state(self, state: Any) -> None:
        """Continue from a `state`; raises InputError where it does not fit."""
        restore_attributes(self, _SAVED, state, {"names": tuple[str, ...], "counters": dict[str, int]})
        if self.names not in ((), *self.ways):
            raise InputError(f"saved state's names must be {format_ways(self.ways)}, got {', '.join(self.names)}")


_SAVED = ("is_final", "names", "rate", "newest", "changed", "counters")


def _find_lack(samples: Recording, names: Sequence[str]) -> str:
    """Return the reason why an actuator cannot be watched by these channels of the samples; "" if it can."""
    for name in names:
        if name not in samples:
            return f"samples without {name}"
        if samples.units[name] != CHANNEL_UNITS[name]:
            return f"samples of {name} not in {CHANNEL_UNITS[name]}"
    # at slower rates a reversal is not resolved, at faster ones a block has too many samples
    return "" if names and 10.0 <= samples.rate <= 1e5 else "samples at a rate outside 10 to 100000 Hz"


def _count_leading(flags: NDArray[np.bool_]) -> int:
    """Count the leading True values."""
    return int(np.argmin(flags)) if not flags.all() else flags.size
