"""The volume balance of a running machine, block by block, in bounded memory, with alarms of a stated rate.

After each block of a few seconds the balance is fitted to the last ones (`window`), and the conductance is searched
for a rise by the same statistic as a whole recording (`fit.search`): the generalised likelihood ratio over a moving
window (Lai, Sequential changepoint detection in quality control and dynamical systems, JRSS B 57 (1995) 613-658). The
threshold is that of the probability per window

    p = alarms_per_hour * block_seconds / 3600,

so a healthy machine alarms at that rate at most, and its average run length is at least 1/alarms_per_hour: windows
overlap, so false alarms come in clusters, which leaves the true rate some 2 to 5 times below the stated one.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.verdict.evidence import Cause, Evidence
from sealscope.diagnosis.volume_balance.blocks import (
    BLOCK_SECONDS,
    BalanceBlocks,
    balance_channels,
    block_samples,
    channels_needed,
)
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.evidence import judge, total_lpm, trouble
from sealscope.diagnosis.volume_balance.fit import fit_balance
from sealscope.errors import InputError
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: The duty's cycle is looked for in the first part of a stream [s].
_LEARN_SECONDS = 60.0
_CHANNELS = ("u", "x", "theta", "omega", "p_A", "p_B", "p_1", "p_2")
#: What an alarm may turn out to be.
_OUTSIDE: Cause = "external leak"
#: Probability per window for which a threshold can be set.
_PROBABILITIES = (1e-7, 0.05)


@dataclass(frozen=True)
class BalanceState:
    """State of a `SequentialBalance`.

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


class SequentialBalance:
    """Volume balance of a live machine, which names onset and L/min of a leak.

    It needs both chamber pressures, the piston's position and the pump's angle or speed.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the piston's area and the pump's displacement.
    alarms_per_hour : float, default 0.01
        False alarms of a healthy machine per operating hour, at most.
    window : int, default 60
        Blocks that are searched for a rise, 16 or more.
    block_seconds : float, default 3
        About how long a block is [s]: whole cycles of the duty.

    Attributes
    ----------
    state : BalanceState
        The state after the last update.

    Raises
    ------
    InputError
        For a rate of alarms for which no threshold can be set, or a window of under 16 blocks.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", duration="2 min", leak="0.0042 L/min from 80 s", seed=1)
    >>> balance = ss.SequentialBalance("thesis", alarms_per_hour=0.1)
    >>> for start in range(0, 120, 10):
    ...     state = balance.update(recording.between(start, start + 10))
    ...     if state.alarm is not None:
    ...         break
    >>> round(state.alarm.onset_s), f"{state.alarm.leak_lpm:.3f} L/min"
    (80, '0.004 L/min')
    """

    def __init__(
        self,
        rig: Rig | str | os.PathLike[str] = "thesis",
        *,
        alarms_per_hour: float = 0.01,
        window: int = 60,
        block_seconds: float = BLOCK_SECONDS,
    ) -> None:
        from sealscope.parameters import load_rig

        if window < FEWEST:
            raise InputError(f"window must be {FEWEST} blocks or more, got {window}")
        if not block_seconds > 0:
            raise InputError(f"block_seconds must be > 0 s, got {block_seconds}")
        low, high = (probability * 3600.0 / block_seconds for probability in _PROBABILITIES)
        if not low <= alarms_per_hour <= high:
            raise InputError(f"alarms_per_hour must be {low:.2g} to {high:.3g}, got {alarms_per_hour}")
        self.alarms_per_hour, self.window, self.block_seconds = alarms_per_hour, window, block_seconds
        self._detector = VolumeBalance(load_rig(rig))
        self._t: Array = np.empty(0)
        self._channels: dict[str, Array] = {}
        self._units: dict[str, str] = {}
        self._rate = 0.0
        self._length = 0
        self._names: tuple[str, ...] = ()
        self._used: tuple[str, ...] = ()
        self._window: BalanceBlocks | None = None
        waiting = Evidence("cannot tell", "waits for the first blocks")
        self.state = BalanceState(float("nan"), 0, 0, waiting, None, None)

    def acknowledge(self) -> None:
        """Take the alarm back, and forget the blocks before now: the machine was repaired, or the leak accepted."""
        self._window = None
        waiting = Evidence("cannot tell", "waits for blocks after the alarm was acknowledged")
        self.state = BalanceState(self.state.t, self.state.blocks, self.state.refused, waiting, None, None)

    def update(self, samples: Recording) -> BalanceState:
        """Take the next samples; every whole block is judged in its turn.

        Parameters
        ----------
        samples : Recording
            The next samples, of any number, in order.

        Returns
        -------
        BalanceState
            The state after these samples.

        Raises
        ------
        InputError
            Where channels, units or rate are not those of the stream's beginning.
        """
        joined = self._join(samples)
        if self._length == 0:
            if joined.duration < _LEARN_SECONDS:
                self._keep(joined, 0)
                return self.state
            first = joined.samples(slice(0, round(_LEARN_SECONDS * joined.rate)))
            self._length = block_samples(first, self.block_seconds)
            self._used = balance_channels(first)
        count = len(joined) // self._length
        for number in range(count):
            self._take(joined.samples(slice(number * self._length, (number + 1) * self._length)))
        self._keep(joined, count * self._length)
        return self.state

    def _keep(self, joined: Recording, first: int) -> None:
        self._t = joined.t[first:].copy()
        self._channels = {name: joined[name][first:].copy() for name in self._names}

    def _join(self, samples: Recording) -> Recording:
        if not self._names:
            missing = channels_needed(samples)
            if missing is not None:
                raise InputError(f"a stream for the volume balance {missing}")
            self._names = tuple(name for name in _CHANNELS if name in samples)
            self._channels = {name: np.empty(0) for name in self._names}
            self._units, self._rate = {name: samples.units[name] for name in self._names}, samples.rate
        chosen = samples.only(self._names)
        if samples.rate != self._rate or dict(chosen.units) != self._units:
            raise InputError(
                f"samples must have the rate ({self._rate:g} Hz) and units of the stream's beginning, got "
                f"{samples.rate:g} Hz and {', '.join(f'{name} [{unit}]' for name, unit in chosen.units.items())}"
            )
        channels = {name: np.concatenate([self._channels[name], chosen[name]]) for name in self._names}
        return Recording(np.concatenate([self._t, chosen.t]), channels, self._units, self._rate)

    def _take(self, block: Recording) -> None:
        cut = self._detector.blocks(block, self._length, self._used)
        end = float(block.t[-1]) + 1.0 / block.rate
        before = self.state
        evidence, alarm, total = before.evidence, before.alarm, before.total_lpm
        usable = len(cut) > 0 and bool(np.all(np.isfinite(cut.gram)))
        if usable:
            window = cut if self._window is None else BalanceBlocks.joined([self._window, cut])
            self._window = window.chosen(np.arange(max(0, len(window) - self.window), len(window)))
            if len(self._window) >= FEWEST:
                evidence, total = self._judge(self._window, block.units["x"] == "m")
        if _replaces(evidence, alarm):
            alarm = evidence
        self.state = BalanceState(end, before.blocks + 1, before.refused + (not usable), evidence, alarm, total)

    def _judge(self, blocks: BalanceBlocks, metres: bool) -> tuple[Evidence, float | None]:
        fit = fit_balance(blocks, metres=metres, geometry=self._detector.geometry)
        problem = trouble(fit)
        if problem is not None:
            return Evidence("cannot tell", problem), None
        return judge(fit, self.alarms_per_hour * blocks.seconds / 3600.0, window=True), total_lpm(fit)


def _replaces(evidence: Evidence, alarm: Evidence | None) -> bool:
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
