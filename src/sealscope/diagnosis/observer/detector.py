"""The model-based observer: a Kalman filter with the leak among its states, and a test for a rise of the leak.

Where angle (or speed) and position are recorded it balances volumes and needs no model of friction; else it follows the
pressures by the machine's equations, from the speed or from the command. Each block of the recording gives an estimate
of the conductance between the chambers; the test looks for a step in these beside the walk of a healthy machine. The
parameters come from the assumed rig, and the innovations show whether that rig describes the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.baseline.level import share_of_each
from sealscope.diagnosis.changepoint.random_walk import FEWEST, WalkStep, find_leak_step
from sealscope.diagnosis.observer.against_baseline import compare
from sealscope.diagnosis.observer.estimates import Estimates
from sealscope.diagnosis.observer.evidence import (
    ConductanceSeries,
    misfit,
    orifice_over_laminar,
    remains,
    states_flow,
    within,
)
from sealscope.diagnosis.observer.model import assume
from sealscope.diagnosis.observer.stream import Formulation, ObserverStream, channels_of, formulation_of, whole
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Least length of a block, its length without a cycle, and the longest cycle that makes a block [s].
BLOCK_SECONDS, BLOCK_ALONE, LONGEST_CYCLE = 3.0, 4.0, 8.0
#: Beginning that is left out, until the slow parameters have settled [s].
WARM_UP = 25.0
#: Shortest recording that can be judged [s].
LEAST_SECONDS = WARM_UP + (FEWEST + 2) * BLOCK_SECONDS
#: Walk of a block of 3 s over its noise (variances) in a healthy machine. Volumes are balanced so precisely that the
#: oil's warming shows from block to block; by the ringing a block's noise is six times the walk.
EXPECTED_WALK: dict[Formulation, float] = {"volume": 3.0, "speed": 0.03, "command": 0.03}
#: Slowest sampling [Hz]: the ringing near 70 Hz must be seen.
SLOWEST: dict[Formulation, float] = {"volume": 10.0, "speed": 250.0, "command": 250.0}
#: Most blocks that are scanned for a step; more are merged.
MOST_BLOCKS = 120


class Observer:
    """A Kalman filter with the leak as a state; `rig` is the assumed machine."""

    name = "observer"
    reads = (*CHAMBERS, "u", "theta", "omega", "x")

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None when the recording has what the observer needs, else the reason why not."""
        missing = [name for name in CHAMBERS if name not in recording]
        if missing:
            return f"needs both chamber pressures, p_A and p_B; {missing[0]} is missing"
        for name in CHAMBERS:
            if recording.units[name] != "Pa":
                return f"needs pressures in a unit of pressure, got {name} in {recording.units[name]}"
        if recording.duration < LEAST_SECONDS:
            return f"needs {LEAST_SECONDS:.0f} s or more without a gap, got {recording.duration:.3g} s"
        for name in CHAMBERS:
            if not whole(recording, name):
                return f"{name} is constant or has missing samples"
        formulation = formulation_of(recording)
        if formulation is None:
            return "needs the command (u), or the motor's angle or speed (theta, omega), in its unit and without a gap"
        if recording.rate < SLOWEST[formulation]:
            return (
                f"needs {SLOWEST[formulation]:g} Hz or more to see what a leak changes in its channels, got "
                f"{recording.rate:g} Hz"
            )
        return None

    def follow(self, recording: Recording) -> ConductanceSeries:
        """Return the conductance over a recording that is `usable`."""
        formulation = formulation_of(recording) or "command"
        block_s = block_length(find_cycle(recording))
        stream = ObserverStream(assume(self.rig), channels_of(formulation, recording), recording.rate, block_s)
        estimates = stream.update(recording)
        start = float(recording.t[0]) + stream.block_s * np.arange(estimates.G.size)
        gaps = touched(recording, stream.block * np.arange(start.size + 1))
        late = (start - float(recording.t[0]) >= WARM_UP) & ~gaps
        t = np.asarray(start[late] + 0.5 * stream.block_s, dtype=np.float64)
        G, sd, dp = (values[late] for values in (estimates.G, estimates.sd, estimates.dp))
        own = Estimates(*(values[~gaps] for values in estimates))
        orifice = orifice_over_laminar(recording["p_A"] - recording["p_B"], formulation)
        return ConductanceSeries(t, G, sd, dp, stream.block_s, formulation, own, orifice, 1.0 - float(np.mean(gaps)))

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence on a recording that is `usable`, within it or against the baseline."""
        series = self.follow(recording)
        if series.t.size < FEWEST:
            return Evidence(
                "cannot tell",
                f"too short for the observer: {series.t.size} blocks of {series.block_s:.3g} s after its warm-up, "
                f"{FEWEST} are needed",
            )
        unfit = misfit(series.estimates, series.formulation, self.rig)
        if unfit is not None and not np.isfinite([series.G, series.sd]).all():
            return Evidence("cannot tell", unfit)
        probability = share_of_each(false_alarm_probability, baseline)
        step = self._step(series, probability)
        if unfit is not None and step.alarm and remains(series, step):  # a leak that opens is no defect of the model
            opening = series.estimates.G.size - series.t.size + step.onset
            unfit = misfit(series.estimates, series.formulation, self.rig, opening)
        if unfit is not None:
            return Evidence("cannot tell", unfit)
        if not baseline:
            states = states_flow(series.formulation, self.rig)
            return replace(within(series, step, states_flow=states), share=series.share)

        def follow(other: Recording) -> ConductanceSeries:
            return remembered(other, (self.name, self.rig), self.follow)

        return replace(compare(series, baseline, follow, step, probability, self.rig), share=series.share)

    @staticmethod
    def _step(series: ConductanceSeries, probability: float) -> WalkStep:
        merge = -(-series.t.size // MOST_BLOCKS)
        n = series.t.size // merge * merge
        weight = (1.0 / series.sd[:n] ** 2).reshape(-1, merge)
        G = (series.G[:n].reshape(-1, merge) * weight).sum(axis=1) / weight.sum(axis=1)
        sd = 1.0 / np.sqrt(weight.sum(axis=1))
        if series.formulation == "volume":  # the stated deviations hold an error that all blocks share
            sd = np.ones(G.size)
        else:
            sd = np.clip(sd, np.median(sd) / 3.0, 3.0 * np.median(sd))
        expected = EXPECTED_WALK[series.formulation] * (merge * series.block_s / BLOCK_SECONDS) ** 2
        step = find_leak_step(G, sd, probability, expected, wary=series.formulation == "volume")
        return step if merge == 1 else step.spread_over(merge)


def block_length(cycle: float | None) -> float:
    """Return the length of a block [s]: whole cycles of the duty, or a fixed length where no cycle is short enough."""
    if cycle is None or cycle > LONGEST_CYCLE:
        return BLOCK_ALONE
    return cycle * max(1, int(np.ceil(BLOCK_SECONDS / cycle - 0.05)))
