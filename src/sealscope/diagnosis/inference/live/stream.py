"""The volume balance of a running machine with alarms of a stated rate: `SequentialBalance`.

The conductance of each block (`live`) goes through an e-detector of steps (`sequential`). An alarm is raised where

    M_k > 1/alpha,    alpha = alarms_per_hour * block_seconds / 3600,

so that a healthy machine runs for 1/alarms_per_hour on average before a false one, or longer.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.live.balance import BLOCK_SECONDS, BlockConductance, LiveBalance, NotJudged, Shown
from sealscope.diagnosis.inference.live.sequential import StepDetector, probability_of
from sealscope.diagnosis.verdict.evidence import NO_RIG, Cause, Evidence, without_flow
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig


@dataclass(frozen=True)
class BalanceState:
    """State of a `SequentialBalance`.

    `t`: end of the last whole block [s]; `blocks`, `refused`: whole blocks so far, and those of them that say nothing:
    at standstill, or with missing values throughout; `evidence`: as of the last block, with the 95 % bound of a leak
    where none is shown; `alarm`: the evidence with the highest score since the alarm was raised, until it is
    acknowledged; `total_lpm`: leakage of pump and piston together [L/min], None where L/min cannot be stated.
    """

    t: float
    blocks: int
    refused: int
    evidence: Evidence
    alarm: Evidence | None
    total_lpm: float | None


class SequentialBalance:
    """Volume balance of a live machine, which names onset and L/min of a leak.

    It needs both chamber pressures, the piston's position and the pump's angle or speed; behind a servo valve position,
    command, and the pressures of both chambers, supply and return.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the circuit and the pump's displacement.
    alarms_per_hour : float, default 0.01
        False alarms of a healthy machine per operating hour, at most.

    Attributes
    ----------
    state : BalanceState
        The state after the last update.

    Raises
    ------
    InputError
        For a rate of alarms that cannot be set.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", duration="2 min", leak="0.0042 L/min from 80 s", seed=1)
    >>> balance = ss.SequentialBalance("thesis", alarms_per_hour=0.1)
    >>> for start in range(0, 120, 10):
    ...     state = balance.update(recording.between(start, start + 10))
    >>> abs(state.alarm.onset_s - 80) < 1, f"{state.alarm.leak_lpm:.3f} L/min"
    (True, '0.004 L/min')
    """

    def __init__(self, rig: Rig | str | os.PathLike[str] = "thesis", *, alarms_per_hour: float = 0.01) -> None:
        from sealscope.parameters import load_rig

        self.alarms_per_hour = alarms_per_hour
        self._threshold = -math.log(probability_of(alarms_per_hour, 1.0, BLOCK_SECONDS, "alarms_per_hour"))
        self._rig = load_rig(rig)
        self._live: LiveBalance | None = None
        self._detector = StepDetector()
        self._units: dict[str, str] = {}
        self._rate = 0.0
        self.state = BalanceState(float("nan"), 0, 0, _waits("for the first blocks"), None, None)

    def acknowledge(self) -> None:
        """Take the alarm back, and compare with nothing before now: the machine was repaired, or the leak accepted."""
        self._detector.forget()
        self.state = replace(self.state, evidence=_waits("for blocks after the alarm was acknowledged"), alarm=None)

    def update(self, samples: Recording) -> BalanceState:
        """Take the next samples; every whole block is judged in its turn.

        Parameters
        ----------
        samples : Recording
            The next samples, of any number, in order. After a gap the balance goes on with what it knew.

        Returns
        -------
        BalanceState
            The state after these samples.

        Raises
        ------
        InputError
            Where channels, units or rate are not those of the stream's beginning.
        """
        if self._live is None:
            read = ("u", "x", "theta", "omega", "p_A", "p_B", "p_1", "p_2")
            self._live = LiveBalance(self._rig, tuple(name for name in read if name in samples))
            self._units, self._rate = {name: samples.units[name] for name in self._live.names}, samples.rate
        chosen, live = samples.only(self._live.names), self._live
        if samples.rate != self._rate or dict(chosen.units) != self._units:
            raise InputError(
                f"samples must have the rate ({self._rate:g} Hz) and units of the stream's beginning, got "
                f"{samples.rate:g} Hz and {', '.join(f'{name} [{unit}]' for name, unit in chosen.units.items())}"
            )
        if len(chosen):
            last = None
            with np.errstate(all="ignore"):  # a block whose sums overflow says nothing
                for shown in live.take(chosen.t, chosen.channels, chosen.rate):
                    last = self._taken(live, shown)
            if last is not None:
                total = last.total * last.flow if live.litres else None
                self.state = replace(self.state, evidence=self._evidence(live, last), total_lpm=total)
        return self.state

    def _taken(self, live: LiveBalance, shown: Shown) -> BlockConductance | None:
        """Take what a block shows, raise or sharpen the alarm; return the block, None where it says nothing."""
        before = self.state
        if isinstance(shown, NotJudged):
            refused = before.refused + bool(shown.counted)
            self.state = replace(before, t=shown.end, blocks=before.blocks + 1, refused=refused)
            return None
        alarm = before.alarm
        for block in shown:
            self._detector.take(block.begin, block.end, block.g, block.sd)
            least = self._threshold if alarm is None else 0.5 * (alarm.score or 0.0)
            if self._detector.log_e(least) > least:
                alarm = self._leak(live, block)
        self.state = replace(before, t=block.end, blocks=before.blocks + 1, alarm=alarm)
        return block

    def _leak(self, live: LiveBalance, block: BlockConductance) -> Evidence:
        rise, unit = self._detector.rise(), block.flow
        onset, low, high = rise.onset
        half = 1.96 * math.hypot(rise.deviation, rise.size * live.size_error)
        cause: Cause = "piston leak" if self._rig.valve.spool == "present" else "piston or pump leak"
        evidence = Evidence(
            "leak",
            "the leakage conductance steps up beyond its random walk",
            score=rise.score,
            threshold=2.0 * self._threshold,
            onset_s=onset,
            onset_interval_s=(low, high),
            leak_lpm=rise.size * unit,
            leak_interval_lpm=(max(rise.size - half, 0.0) * unit, (rise.size + half) * unit),
            cause=cause,
            detector="volume balance",
        )
        return evidence if live.litres else without_flow(evidence, NO_RIG)

    def _evidence(self, live: LiveBalance, block: BlockConductance) -> Evidence:
        """Return the evidence as of the last block."""
        log_e = self._detector.log_e()
        if log_e > self._threshold:
            return self._leak(live, block)
        bound, pump = self._detector.bound() * block.flow, math.exp(block.duty[1]) / LITRE_PER_MINUTE
        if not math.isfinite(bound):
            return _waits("for the next blocks")
        limit = f"{bound:.2g} L/min" if live.litres else f"{100.0 * bound / pump:.2g} % of the pump's flow"
        enough = bound <= beliefs("inference")["worth"]["share"] * pump
        return Evidence(
            "no leak" if enough else "cannot tell",
            f"no leak above {limit} (95 %)" if enough else f"a leak of up to {limit} would not show (95 %)",
            score=max(2.0 * log_e, 0.0),
            threshold=2.0 * self._threshold,
            detector="volume balance",
            bound_lpm=bound if live.litres else None,
        )


def _waits(what: str) -> Evidence:
    return Evidence("cannot tell", f"waits {what}")
