"""What streams of a balance share: samples joined across portions, the state that they show, when alarms change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.verdict.evidence import Cause, Evidence
from sealscope.errors import InputError
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
