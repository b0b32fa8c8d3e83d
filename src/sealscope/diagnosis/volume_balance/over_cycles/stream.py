"""The cycle balance of a running machine: a window of whole cycles, looked at anew after each, in bounded memory.

The statistic and its rate are those of the volume balance's stream (`volume_balance.stream`); the position and the
shaft's angle are not needed.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.isolation import isolated, signatures
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.live import LEARN_SECONDS, BalanceState, JoinedSamples, check_stream, replaces
from sealscope.diagnosis.volume_balance.over_cycles.detector import CycleBalance
from sealscope.diagnosis.volume_balance.over_cycles.series import BLOCK
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


class SequentialCycles:
    """Cycle balance of a live machine under a load, which names onset and L/min of a leak.

    It needs both chamber pressures and the command, or the shaft's speed or angle; the position where it is recorded.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the pump's displacement and the drive's law.
    alarms_per_hour : float, default 0.01
        False alarms of a healthy machine per operating hour, at most.
    window : int, default 60
        Blocks that are searched for a rise, 16 or more.

    Attributes
    ----------
    state : BalanceState
        The state after the last update. `refused` counts the windows without a score; `total_lpm` is None, since the
        drive's zero is not known.

    Raises
    ------
    InputError
        For a rate of alarms for which no threshold can be set, or a window of under 16 blocks.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(
    ...     rig="thesis-closed-loop", command="position 40 mm sin(2t)", load="1 kN", duration="2 min",
    ...     leak="0.01 L/min from 80 s", seed=1,
    ... ).only(["u", "p_A", "p_B"])
    >>> balance = ss.SequentialCycles("thesis-closed-loop", alarms_per_hour=0.1)
    >>> for start in range(0, 120, 10):
    ...     state = balance.update(recording.between(start, start + 10))
    >>> round(state.alarm.onset_s), f"{state.alarm.leak_lpm:.2f} L/min"
    (80, '0.01 L/min')
    """

    def __init__(
        self, rig: Rig | str | os.PathLike[str] = "thesis", *, alarms_per_hour: float = 0.01, window: int = 60
    ) -> None:
        from sealscope.parameters import load_rig

        check_stream(alarms_per_hour, window, BLOCK)
        self.alarms_per_hour, self.window = alarms_per_hour, window
        self._detector = CycleBalance(load_rig(rig))
        self._samples = JoinedSamples(CycleBalance.reads)
        self._length = 0
        self._looked = float("nan")
        waiting = Evidence("cannot tell", "waits for the first cycles")
        self.state = BalanceState(float("nan"), 0, 0, waiting, None, None)

    def acknowledge(self) -> None:
        """Take the alarm back, and forget the samples before now: the machine was repaired, or the leak accepted."""
        self._samples, self._length = JoinedSamples(CycleBalance.reads), 0
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
            cycle = find_cycle(joined.samples(slice(0, round(LEARN_SECONDS * joined.rate)))) or BLOCK
            self._length = round(cycle * max(1, round(BLOCK / cycle)) * joined.rate)
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
        probability = self.alarms_per_hour * self._length / window.rate / 3600.0
        reason = self._detector.usable(window)
        evidence = Evidence("cannot tell", reason) if reason else self._detector.examine(window, (), probability)
        evidence = replace(evidence, detector=self._detector.name)
        if evidence.verdict == "leak" and (seen := signatures(window)) is not None:
            evidence = isolated(evidence, seen)
        before = self.state
        alarm = evidence if replaces(evidence, before.alarm) else before.alarm
        refused = before.refused + (evidence.score is None)
        self.state = BalanceState(self._looked, before.blocks + 1, refused, evidence, alarm, None)


def _after_gaps(joined: Recording) -> int:
    """Return the first sample after the last gap of the time base, or after the last missing value of a pressure."""
    breaks = np.flatnonzero(np.abs(np.diff(joined.t) * joined.rate - 1.0) > 0.5)
    known = np.all([np.isfinite(joined[name]) for name in ("p_A", "p_B") if name in joined], axis=0)
    missing = np.flatnonzero(~known)
    return int(max(breaks[-1] if breaks.size else -1, missing[-1] if missing.size else -1)) + 1
