"""The model-based observer: a Kalman filter with the leak among its states, and a test of whether the leak rose.

Where angle (or speed) and position are recorded it balances volumes and needs no model of friction; else it follows the
pressures by the machine's equations, from the speed or from the command. Each block of the recording gives an estimate
of the conductance between the chambers; a step in them is looked for against the drift that the observer allows the
machine. Its parameters come from the rig it is told, and its innovations say whether that rig describes the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.changepoint.step_in_walk import FEWEST, Step, find_leak_step
from sealscope.diagnosis.observer.accumulator import Estimates
from sealscope.diagnosis.observer.against_baseline import compare
from sealscope.diagnosis.observer.fit import misfit
from sealscope.diagnosis.observer.model import G_UNIT
from sealscope.diagnosis.observer.stream import (
    Formulation,
    ObserverStream,
    channels_of,
    formulation_of,
    whole,
)
from sealscope.diagnosis.verdict.evidence import Evidence, LeakCourse
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

LPM = 6.0e4  # L/min in one m^3/s
#: Length a block should have at least, and without a cycle, and the longest cycle it takes whole [s].
BLOCK_SECONDS, BLOCK_ALONE, LONGEST_CYCLE = 3.0, 4.0, 8.0
#: Beginning that is left out, until the slow parameters have settled [s].
WARM_UP = 25.0
#: Shortest recording that can be judged [s].
LEAST_SECONDS = WARM_UP + (FEWEST + 2) * BLOCK_SECONDS
#: Walk of a block of 3 s over its noise (variances) that a healthy machine is expected to show. Volumes are balanced so
#: sharply that the oil's warming is seen from block to block; by the ringing a block's noise is six times the walk.
EXPECTED_WALK: dict[Formulation, float] = {"volume": 3.0, "speed": 0.03, "command": 0.03}
#: Error of the size itself, as a share: scales of the transducers; the model of friction and ringing.
SIZE_ERROR: dict[Formulation, float] = {"volume": 0.01, "speed": 0.15, "command": 0.15}
#: Slowest sampling [Hz]: the ringing near 70 Hz must be seen.
SLOWEST: dict[Formulation, float] = {"volume": 10.0, "speed": 250.0, "command": 250.0}
#: Most blocks that are scanned for a step; more are merged.
MOST_BLOCKS = 120


@dataclass(frozen=True, eq=False)
class Series:
    """The conductance over a recording, the warm-up left out: middles `t` (k,) [s], `G`, `sd` (k,) in `G_UNIT`, mean
    `dp` (k,) [Pa], length of a block [s]; `estimates` are those of all blocks."""

    t: Array
    G: Array
    sd: Array
    dp: Array
    block_s: float
    formulation: Formulation
    estimates: Estimates


class Observer:
    """A Kalman filter with the leak as a state; `rig` is what it may assume of the machine."""

    name = "observer"
    reads = (*CHAMBERS, "u", "theta", "omega", "x")

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
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

    def follow(self, recording: Recording) -> Series:
        """The conductance over a recording that is `usable`."""
        formulation = formulation_of(recording) or "command"
        block_s = block_length(find_cycle(recording))
        stream = ObserverStream(self.rig, channels_of(formulation, recording), recording.rate, block_s)
        found = stream.update(recording)
        start = float(recording.t[0]) + stream.block_s * np.arange(found.G.size)
        late = start - float(recording.t[0]) >= WARM_UP
        t = np.asarray(start[late] + 0.5 * stream.block_s, dtype=np.float64)
        return Series(t, found.G[late], found.sd[late], found.dp[late], stream.block_s, formulation, found)

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        series = self.follow(recording)
        if series.t.size < FEWEST:
            return Evidence(
                "cannot tell",
                f"too short for the observer: {series.t.size} blocks of {series.block_s:.3g} s after its warm-up, "
                f"{FEWEST} are needed",
            )
        wrong = misfit(series.estimates, series.formulation, self.rig)
        if wrong is not None:
            return Evidence("cannot tell", wrong)
        step = self._step(series, false_alarm_probability)
        if baseline:
            alike = [one for one in baseline if formulation_of(one) == series.formulation]
            others = [remembered(one, (self.name, self.rig), self.follow) for one in alike]
            return compare(recording, series, baseline, others, step, false_alarm_probability)
        return within(series, step)

    @staticmethod
    def _step(series: Series, probability: float) -> Step:
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
        found = find_leak_step(G, sd, probability, expected, wary=series.formulation == "volume")
        return found if merge == 1 else found.spread_over(merge)


def block_length(cycle: float | None) -> float:
    """Length of a block [s]: whole cycles of the duty, or a fixed length where it has none that is short enough."""
    if cycle is None or cycle > LONGEST_CYCLE:
        return BLOCK_ALONE
    return cycle * max(1, int(np.ceil(BLOCK_SECONDS / cycle - 0.05)))


def within(series: Series, step: Step) -> Evidence:
    """What the step within a recording says."""
    edges = np.array([step.onset, *step.onset_interval]) * series.block_s + series.t[0] - 0.5 * series.block_s
    onset, interval = float(edges[0]), (float(edges[1]), float(edges[2]))
    after = series.t > onset
    dp = float(np.mean(series.dp[after])) if np.any(after) else float(np.mean(series.dp))
    lpm = step.size * G_UNIT * dp * LPM
    half = _t_quantile(step.freedom) * float(
        np.hypot(step.size_sd * G_UNIT * dp * LPM, SIZE_ERROR[series.formulation] * lpm)
    )
    told = f"score {step.score:.2f}, threshold {step.threshold:.2f}; {MEANS[series.formulation]}"
    before = series.t < onset - series.block_s
    if not step.found:
        if step.score > step.threshold:
            return Evidence(
                "cannot tell",
                f"what passes between the chambers rose evenly from the beginning on, as in a warm-up ({told})",
                step.score,
                step.threshold,
                course=course(series, step, None),
            )
        total = float(np.median(series.G)) * G_UNIT * dp * LPM
        reason = f"what passes between the chambers did not rise within the recording ({told})"
        if series.formulation == "volume":
            reason += f"; pump and piston together let {total:.4f} L/min pass"
        return Evidence("no leak", reason, step.score, step.threshold, course=course(series, step, None))
    level = float(np.mean(series.G[before])) if np.any(before) else 0.0
    return Evidence(
        "leak",
        f"what passes between the chambers rose by {lpm:.4f} L/min at {onset:.1f} s ({told}), past the piston or in "
        "the pump",
        step.score,
        step.threshold,
        onset,
        interval,
        lpm,
        (max(0.0, lpm - half), lpm + half),
        cause="piston or pump leak",
        course=course(series, step, level),
    )


#: What each formulation rests on, in words.
MEANS: dict[Formulation, str] = {
    "volume": "volume balance of angle and position",
    "speed": "ringing and mean of the pressures, with the speed",
    "command": "ringing and mean of the pressures, with the command",
}


def course(series: Series, step: Step, level: float | None) -> LeakCourse:
    """The leak over the recording, beyond the `level` before the onset, or beyond the recording's median.

    Deviations are the filter's, scaled to the scatter that its estimates show.
    """
    factor = G_UNIT * series.dp * LPM
    base = float(np.median(series.G)) if level is None else level
    stated = np.ones(series.t.size) if series.formulation == "volume" else series.sd
    half = 1.96 * step.scale * stated * factor
    lpm = (series.G - base) * factor
    return LeakCourse(series.t, lpm, lpm - half, lpm + half)


def _t_quantile(freedom: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975))
