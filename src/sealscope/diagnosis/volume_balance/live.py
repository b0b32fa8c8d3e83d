"""What streams of a balance share: samples joined across portions, the state that they show, when alarms change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.detector import Detector
from sealscope.diagnosis.verdict.evidence import Cause, Evidence
from sealscope.diagnosis.volume_balance.blocks import BLOCK_SECONDS
from sealscope.errors import InputError
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording

#: The duty's cycle is looked for in the first part of a stream [s].
LEARN_SECONDS = 60.0
#: What an alarm may turn out to be.
_OUTSIDE: Cause = "external leak"
#: Probability per window for which a threshold can be set.
_PROBABILITIES = (1e-7, 0.05)


@dataclass(frozen=True)
class BalanceState:
    """State of a `SequentialBalance`, or of `SequentialCycles`.

    Attributes
    ----------
    t : float
        End of the last whole block [s].
    blocks, refused : int
        Whole blocks so far, and those of them with gaps or missing values.
    evidence : Evidence
        Of the last window.
    alarm : Evidence or None
        The evidence with the highest score since the alarm was raised, until it is acknowledged. A leak to the outside
        is told from one inside by the pressures that fall, which takes its time: from then on the alarm is that
        evidence, `no leak` past the piston with the cause `external leak`.
    total_lpm : float or None
        Mean leakage of pump and piston together over the window [L/min], None where L/min cannot be stated.
    """

    t: float
    blocks: int
    refused: int
    evidence: Evidence
    alarm: Evidence | None
    total_lpm: float | None


class JoinedSamples:
    """Samples that a stream has not used up yet.

    `channels`: those that are kept of what arrives.
    """

    def __init__(self, channels: Sequence[str]) -> None:
        self._wanted = tuple(channels)
        self._t: Array = np.empty(0)
        self._channels: dict[str, Array] = {}
        self._units: dict[str, str] = {}
        self._rate = 0.0

    @property
    def begun(self) -> bool:
        """Whether samples have arrived."""
        return bool(self._channels)

    def joined(self, samples: Recording) -> Recording:
        """Return what was kept with the next samples behind it.

        Raises InputError where channels, units or rate are not those of the stream's beginning.
        """
        if not self.begun:
            self._channels = {name: np.empty(0) for name in self._wanted if name in samples}
            self._units, self._rate = {name: samples.units[name] for name in self._channels}, samples.rate
        chosen = samples.only(self._channels)
        if samples.rate != self._rate or dict(chosen.units) != self._units:
            raise InputError(
                f"samples must have the rate ({self._rate:g} Hz) and units of the stream's beginning, got "
                f"{samples.rate:g} Hz and {', '.join(f'{name} [{unit}]' for name, unit in chosen.units.items())}"
            )
        channels = {name: np.concatenate([values, chosen[name]]) for name, values in self._channels.items()}
        return Recording(np.concatenate([self._t, chosen.t]), channels, self._units, self._rate)

    def keep(self, joined: Recording, first: int) -> None:
        """Keep joined samples from that one on."""
        self._t = joined.t[first:].copy()
        self._channels = {name: joined[name][first:].copy() for name in self._channels}


def check_stream(alarms_per_hour: float, window: int, block_seconds: float) -> None:
    """Raise InputError for a window too short for a step, or a rate of alarms for which no threshold can be set."""
    if window < FEWEST:
        raise InputError(f"window must be {FEWEST} blocks or more, got {window}")
    low, high = (probability * 3600.0 / block_seconds for probability in _PROBABILITIES)
    if not low <= alarms_per_hour <= high:
        raise InputError(f"alarms_per_hour must be {low:.2g} to {high:.3g}, got {alarms_per_hour}")


def replaces(evidence: Evidence, alarm: Evidence | None) -> bool:
    """Return whether the evidence of a window is the alarm from now on."""
    outside = evidence.cause == _OUTSIDE and evidence.alarmed
    if alarm is None:
        return evidence.verdict == "leak"
    better = (evidence.score or 0.0) > (alarm.score or 0.0)
    if alarm.cause == _OUTSIDE:
        return outside and better
    return (evidence.verdict == "leak" and better) or (outside and _same_rise(evidence, alarm))


def _same_rise(one: Evidence, other: Evidence) -> bool:
    """Return whether two windows date the same rise."""
    if one.onset_interval_s is None or other.onset_interval_s is None:
        return False
    (begin, end), (first, last) = one.onset_interval_s, other.onset_interval_s
    return begin <= last and first <= end


class WindowStream:
    """A detector of a live machine that looks at a window of whole cycles anew after each.

    `reads`: the channels that are kept. `state` after the last update: its `refused` counts the windows without a
    score; its `total_lpm` is None.
    """

    def __init__(self, detector: Detector, reads: Sequence[str], alarms_per_hour: float, window: int) -> None:
        check_stream(alarms_per_hour, window, BLOCK_SECONDS)
        self.alarms_per_hour, self.window = alarms_per_hour, window
        self._detector, self._reads = detector, reads
        self._samples = JoinedSamples(reads)
        self._length = 0
        self._looked = float("nan")
        waiting = Evidence("cannot tell", "waits for the first cycles")
        self.state = BalanceState(float("nan"), 0, 0, waiting, None, None)

    def acknowledge(self) -> None:
        """Take the alarm back, and forget the samples before now: the machine was repaired, or the leak accepted."""
        self._samples, self._length = JoinedSamples(self._reads), 0
        waiting = Evidence("cannot tell", "waits for cycles after the alarm was acknowledged")
        self.state = BalanceState(self.state.t, self.state.blocks, self.state.refused, waiting, None, None)

    def update(self, samples: Recording) -> BalanceState:
        """Take the next samples; after every whole block the window up to its end is judged.

        Parameters
        ----------
        samples : Recording
            The next samples, of any number, in order. After a gap the window begins anew.

        Returns
        -------
        BalanceState
            The state after these samples.

        Raises
        ------
        InputError
            Where channels, units or rate are not those of the stream's beginning.
        """
        joined = self._samples.joined(samples)
        begin = _after_gaps(joined)
        if begin > 0:
            joined, self._length = joined.samples(slice(begin, None)), 0
        if self._length == 0:
            if joined.duration < LEARN_SECONDS:
                self._samples.keep(joined, 0)
                return self.state
            cycle = find_cycle(joined.samples(slice(0, round(LEARN_SECONDS * joined.rate)))) or BLOCK_SECONDS
            self._length = round(cycle * max(1, round(BLOCK_SECONDS / cycle)) * joined.rate)
            self._looked = float(joined.t[0])
        last = self._last(joined)
        while len(joined) - last >= self._length:
            last += self._length
            self._judge(joined.samples(slice(max(0, last - (self.window + 1) * self._length), last)))
        self._samples.keep(joined, max(0, last - (self.window + 1) * self._length))
        return self.state

    def _last(self, joined: Recording) -> int:
        """Return the first sample that no look has counted as a block's."""
        return int(np.searchsorted(joined.t, self._looked - 0.5 / joined.rate))

    def _judge(self, window: Recording) -> None:
        self._looked = float(window.t[-1]) + 1.0 / window.rate
        evidence = self._examined(window, self.alarms_per_hour * self._length / window.rate / 3600.0)
        before = self.state
        alarm = evidence if replaces(evidence, before.alarm) else before.alarm
        refused = before.refused + (evidence.score is None)
        self.state = BalanceState(self._looked, before.blocks + 1, refused, evidence, alarm, None)

    def _examined(self, window: Recording, probability: float) -> Evidence:
        reason = self._detector.usable(window)
        evidence = Evidence("cannot tell", reason) if reason else self._detector.examine(window, (), probability)
        return replace(evidence, detector=self._detector.name)


def _after_gaps(joined: Recording) -> int:
    """Return the first sample after the last gap of the time base, or after the last missing value of a pressure."""
    breaks = np.flatnonzero(np.abs(np.diff(joined.t) * joined.rate - 1.0) > 0.5)
    known = np.all([np.isfinite(joined[name]) for name in ("p_A", "p_B") if name in joined], axis=0)
    missing = np.flatnonzero(~known)
    return int(max(breaks[-1] if breaks.size else -1, missing[-1] if missing.size else -1)) + 1
