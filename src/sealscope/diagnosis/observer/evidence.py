"""The observer's evidence from a series of conductances: whether they can be trusted, and a step in L/min."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.observer.estimates import Estimates
from sealscope.diagnosis.observer.model import G_UNIT, PARAMETERS, STIFFNESS
from sealscope.diagnosis.observer.stream import Formulation
from sealscope.diagnosis.observer.volume_filter import VOLUME_STATES
from sealscope.diagnosis.verdict.evidence import NO_RIG, Evidence, LeakCourse, without_flow
from sealscope.recordings.recording import Array
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.diagnosis.changepoint.random_walk import WalkStep
    from sealscope.parameters import Rig

#: Error of the size itself, as a share: scales of the transducers; the model of friction and ringing.
SIZE_ERROR: dict[Formulation, float] = {"volume": 0.01, "speed": 0.15, "command": 0.15}
#: What each formulation rests on, in words.
MEANS: dict[Formulation, str] = {
    "volume": "volume balance of angle and position",
    "speed": "ringing and mean of the pressures, with the speed",
    "command": "ringing and mean of the pressures, with the command",
}
#: Mean square of the normalised innovations, and correlation of successive ones, within which the model describes the
#: recording. Encoders that count seldom make those of the volume large for a while.
_SQUARE: dict[Formulation, tuple[float, float]] = {"volume": (0.1, 8.0), "speed": (0.7, 1.4), "command": (0.7, 1.4)}
_CORRELATION = 0.25
#: Mean square in a single block: a slipping encoder, a stuck reading.
_WORST: dict[Formulation, float] = {"volume": 400.0, "speed": 4.0, "command": 4.0}
#: Blocks about the one in which a leak opens that tell nothing of the model.
_LEARNS = 1.5
#: Largest deviation of a block's conductance at which a leak can be seen at all, in units of `G_UNIT`.
BLIND = 12.0
#: Range of the factors that a machine of the rig's kind may have.
_FACTORS = {"coulomb": (0.3, 3.0), "viscous": (0.0, 4.0), "gain": (0.6, 1.6), "breakaway": (0.0, 3.0)}
_SCALE = 0.5


@dataclass(frozen=True, eq=False)
class ConductanceSeries:
    """The conductance over a recording, without the warm-up.

    `t` (k,): middles of the blocks [s]; `G`, `sd` (k,) in `G_UNIT`; `dp` (k,): mean |p_A - p_B| [Pa]; `block_s`: length
    of a block [s]; `estimates`: those of all blocks, warm-up included; blocks with missing samples are left out of
    both, `share`: that of all blocks which are left; `orifice`: mean flow of an orifice over that of a laminar leak
    which shows as the same conductance.
    """

    t: Array
    G: Array
    sd: Array
    dp: Array
    block_s: float
    formulation: Formulation
    estimates: Estimates
    orifice: float
    share: float = 1.0

    def instants(self, blocks: Sequence[float]) -> Array:
        """Return where blocks begin [s], by their numbers (k,), which may lie between two."""
        starts = self.t - 0.5 * self.block_s
        ends = np.append(starts, starts[-1] + self.block_s)
        return np.asarray(np.interp(blocks, np.arange(ends.size), ends))


def orifice_over_laminar(dp: Array, formulation: Formulation) -> float:
    """Return the mean flow of an orifice over that of a laminar leak which shows as the same conductance [1].

    `dp` (n,): p_A - p_B [Pa]. Volumes show the flow ``C sign(dp) sqrt(abs(dp))`` as the conductance of its regression
    on dp, ``C <abs(dp)^1.5> / <dp^2>``. The ringing is small beside the pressure difference it rings about, so that it
    is damped by the slope of the flow there: half of the flow over dp.
    """
    if formulation != "volume":
        return 2.0
    size = np.abs(dp)
    return float(np.mean(size**0.5) * np.mean(size**2) / (np.mean(size**1.5) * np.mean(size)))


def described(estimates: Estimates, formulation: Formulation) -> NDArray[np.bool_]:
    """Return the blocks (k,) that the model describes, by their innovations."""
    low, high = _SQUARE[formulation]
    finite = np.isfinite(estimates.parameters).all(axis=1) & np.isfinite(estimates.G) & np.isfinite(estimates.sd)
    fits = (estimates.square >= low) & (estimates.square <= high)
    return np.asarray(finite & fits & ((formulation == "volume") | (np.abs(estimates.correlation) <= _CORRELATION)))


def misfit(estimates: Estimates, formulation: Formulation, rig: Rig, opening: float = np.inf) -> str | None:
    """Return why the estimates cannot be trusted, in one line, by innovations and parameters; None where they can.

    `opening`: the block in which a leak opens, which the filter has to learn: it and its neighbours are not asked.
    """
    if not all(np.all(np.isfinite(values)) for values in (estimates.G, estimates.sd, estimates.parameters)):
        return "the observer lost the recording: its model does not describe it"
    if float(np.median(estimates.sd)) > BLIND:
        return "the piston hardly moves or carries no pressure: a leak cannot be seen by the observer"
    blocks = np.arange(estimates.G.size)
    asked = blocks[(blocks >= blocks.size // 5) & (np.abs(blocks - opening) > _LEARNS)]
    square, correlation = (float(np.mean(values[asked])) for values in (estimates.square, estimates.correlation))
    low, high = _SQUARE[formulation]
    if not low <= square <= high:
        return (
            f"the model ({rig.name}) does not describe the recording: mean square of its innovations {square:.3g}, "
            f"{low:g} to {high:g} expected"
        )
    if formulation != "volume" and abs(correlation) > _CORRELATION:
        return (
            f"the model ({rig.name}) does not describe the recording: successive innovations are correlated by "
            f"{correlation:.2f}"
        )
    worst = int(asked[np.argmax(estimates.square[asked])])
    if estimates.square[worst] > _WORST[formulation]:
        return f"the model ({rig.name}) loses the recording in block {worst + 1}: a channel jumps or sticks there"
    if formulation == "volume":
        scale = float(estimates.parameters[-1, VOLUME_STATES.index("scale")])
        if abs(scale) <= _SCALE:
            return None
        return f"angle and position do not fit the rig: pump and piston move volumes that differ by {100 * scale:.0f} %"
    last = dict(zip(PARAMETERS, estimates.parameters[-1], strict=True))
    ranges = {**_FACTORS, "stiffness": (0.9 * STIFFNESS[0], 1.1 * STIFFNESS[1])}
    for name, (low, high) in ranges.items():
        if not low <= last[name] <= high:
            return f"the rig does not fit the recording: {name} would have to be {last[name]:.2g} times what is assumed"
    return None


def remains(series: ConductanceSeries, step: WalkStep) -> bool:
    """Return whether a step is there without the block in which it begins, as that of a slipping encoder is not."""
    away = np.arange(series.G.size) - step.onset
    before, after = series.G[away < -_LEARNS], series.G[away > _LEARNS]
    return min(before.size, after.size) > 0 and float(np.median(after) - np.median(before)) > 0.5 * step.size


def states_flow(formulation: Formulation, rig: Rig) -> bool:
    """Return whether the rig states what turns a conductance into L/min; the ringing needs the moving mass, too.

    By pressures and speed small leaks are overstated (1.3 times in the median), so that no L/min is stated.
    """
    geometry = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
    return rig.states(*geometry) and (
        formulation == "volume" or (formulation == "command" and rig.states("cylinder.M_eq"))
    )


def no_flow(formulation: Formulation) -> str:
    """Return why L/min is not stated, in words."""
    return "L/min is not stated: by the speed small leaks are overstated" if formulation == "speed" else NO_RIG


def within(series: ConductanceSeries, step: WalkStep, *, states_flow: bool = True) -> Evidence:
    """Return the evidence from the step within a recording; `states_flow`: whether L/min may be stated."""
    from scipy.special import stdtrit

    edges = series.instants([step.onset, *step.onset_interval])
    onset, interval = float(edges[0]), (float(edges[1]), float(edges[2]))
    after = series.t > onset
    dp = float(np.mean(series.dp[after])) if np.any(after) else float(np.mean(series.dp))
    unit = G_UNIT * dp / LITRE_PER_MINUTE
    # either law: volumes show both nearly alike, and what is stated lies between; the ringing does not
    laminar = step.size * unit
    lpm = 0.5 * (1.0 + series.orifice) * laminar if series.formulation == "volume" else laminar
    half = float(stdtrit(step.freedom, 0.975)) * float(
        np.hypot(step.size_sd * unit, SIZE_ERROR[series.formulation] * laminar)
    )
    figures = f"score {step.score:.2f}, threshold {step.threshold:.2f}; {MEANS[series.formulation]}"
    if step.alarm:
        before = series.t < onset - series.block_s
        by = f" by {lpm:.4f} L/min" if states_flow else ""
        leak = Evidence(
            "leak",
            f"what passes between the chambers rose{by} at {onset:.1f} s ({figures}), past the piston or in the pump",
            step.score,
            step.threshold,
            onset,
            interval,
            lpm,
            (max(0.0, laminar - half) * min(1.0, series.orifice), (laminar + half) * max(1.0, series.orifice)),
            cause="piston or pump leak",
            course=course(series, step, float(np.mean(series.G[before])) if np.any(before) else 0.0),
            chance=step.chance,
        )
        return leak if states_flow else without_flow(leak, no_flow(series.formulation))
    drawn = course(series, step, None) if states_flow else None
    if step.score > step.threshold:
        reason = f"what passes between the chambers rose evenly from the beginning on, as in a warm-up ({figures})"
        return Evidence("cannot tell", reason, step.score, step.threshold, course=drawn, chance=step.chance)
    reason = f"what passes between the chambers did not rise within the recording ({figures})"
    if series.formulation == "volume" and states_flow:
        reason += f"; pump and piston together let {float(np.median(series.G)) * unit:.4f} L/min pass"
    return Evidence("no leak", reason, step.score, step.threshold, course=drawn, chance=step.chance)


def course(series: ConductanceSeries, step: WalkStep, level: float | None) -> LeakCourse:
    """Return the leak over the recording beyond a `level` of the conductance, by default the recording's median.

    Deviations are the filter's, scaled to the scatter of its estimates.
    """
    factor = G_UNIT * series.dp / LITRE_PER_MINUTE
    base = float(np.median(series.G)) if level is None else level
    stated = np.ones(series.t.size) if series.formulation == "volume" else series.sd
    half = 1.96 * step.scale * stated * factor
    lpm = (series.G - base) * factor
    return LeakCourse(series.t, lpm, lpm - half, lpm + half)
