"""Cycle balance: what the pump must deliver so that a loaded piston comes back, or stays, has leaked.

A position loop hides a leak in its command, and there it shows: under a load that stands on one side the command's mean
over a cycle is what pump and piston pass (`series`). Position and angle are not needed; friction, stiffness and mass
are in no mean. Without such a load it counts while the piston is held at rest (`holds`), or while one side of a single
rod carries (`stretches`). What limits the search is the drift of the pump's own leakage, so that a leak is a step, or a
growth, that no smooth drift explains (`changepoint.smooth_drift`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.changepoint.even_drift import step_near
from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, DriftStep, find_step, findable_step
from sealscope.diagnosis.inference.cycle_balance.holds import hold_flows
from sealscope.diagnosis.inference.cycle_balance.series import BLOCK, CycleFlows, cycle_flows
from sealscope.diagnosis.inference.cycle_balance.shaft import shaft_shown
from sealscope.diagnosis.inference.cycle_balance.stretches import stretch_flows
from sealscope.diagnosis.verdict.evidence import (
    LEAK_WORTH_FINDING,
    NO_RIG,
    Cause,
    Evidence,
    LeakCourse,
    Passage,
    without_flow,
)
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: How far flows are known, as a share: displacement; a drive's speed for its command besides.
_SCALE, _DRIVE_SCALE = 0.03, 0.05
#: Deviation of a step's size as a share of the whole leakage: the pump's own may drift so about the onset.
_DRIFTS = 0.01
#: Least mean flow of a pump that makes good its own leakage, as a share of the flow to and fro: 0 in an open loop.
_DELIVERED = 2e-4
#: Blocks count by the pressure difference that stands in them, as a share of all at least.
_LEAST_PRESSURE = 0.05
#: Blocks on either side from which the size of a step is read once more, and fewest of them.
_BESIDE, _FEWEST_BESIDE = 4, 3
#: A transducer's zero drifts by up to 0.5 psi within a recording [Pa].
_ZERO_DRIFT = 3.5e3
#: ... and the mean of both pressures moves with a load that changes, by so many times its deviation at most.
_SURE = 3.0
#: What goes to the outside, as a share of a leak, over which it is external, and under which it is not.
_LOST = 0.5
_DURING = {
    "cycles": "over a cycle under the load",
    "holds": "to hold the piston at rest",
    "stretches": "while one side carries the load",
}
#: What no mean over a cycle shows; nor is another duty seen by what is balanced without the strokes.
_WEIGHED: frozenset[Cause] = frozenset({"friction change"})
_ANY_DUTY: frozenset[Cause] = _WEIGHED | {"changed duty"}


class CycleBalance:
    """Leakage under a load or at rest, from the command (or the shaft) and both chamber pressures."""

    name = "cycle balance"
    reads = ("u", "theta", "omega", "x", *CHAMBERS)

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the balance needs, else the reason why not."""
        if self.rig.valve.spool == "present":
            return "is of a pump whose speed is commanded; a servo valve meters the flow here"
        missing = [name for name in CHAMBERS if name not in recording or recording.units[name] != "Pa"]
        if missing:
            return f"needs p_A and p_B in a unit of pressure, got no such {' and no such '.join(missing)}"
        if recording.duration < FEWEST * BLOCK:
            return f"needs {FEWEST * BLOCK:g} s or more, got {recording.duration:.4g} s"
        still = [name for name in CHAMBERS if not moves(recording[name])]
        if still:
            return f"{' and '.join(still)} must move"
        if shaft_shown(recording) is None:
            return "needs the command u [V], the shaft's speed omega or its angle theta, got none that moves"
        return None

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a rise of what passes pump and piston within the recording; a baseline adds nothing.

        The level is the pump's own, of which each has its own.
        """
        flows = self.flows(recording)
        if isinstance(flows, str):
            return Evidence("cannot tell", flows)
        dp, level, size = flows.dp, flows.level, float(np.mean(flows.size))
        known = np.maximum(np.abs(dp), _LEAST_PRESSURE * float(np.sqrt(np.mean(dp**2))))
        weak = np.median(known) / known if flows.by_orifice is not None else np.ones(dp.size)
        G, unit = flows.flow / np.copysign(known, dp), 1e-3 * level * weak
        shared = None if flows.shared is None else flows.shared / np.copysign(known, dp)[:, None]
        probability, halves = false_alarm_probability, flows.halves
        step = find_step(flows.t, G, unit, probability, shared=shared, quiet=True, halves=halves)
        figures = f"score {step.score:.1f}, threshold {step.threshold:.1f}"
        if step.alarm:
            return self._leak(flows, step, level, figures)
        smallest = findable_step(flows.t, G, unit, probability, step.noise, shared=shared, quiet=True, halves=halves)
        return _no_step(flows, step, smallest * size, figures)

    def flows(self, recording: Recording) -> CycleFlows | str:
        """Return the balance over cycles, over holds of a piston, or over stretches, or why there is none of them."""
        refused = []
        for balanced in (cycle_flows, hold_flows, *([stretch_flows] if self.rig.cylinder.single_rod else [])):
            flows = balanced(recording, self.rig)
            if isinstance(flows, str):
                refused.append(flows)
            elif flows.level * float(np.sqrt(np.mean(flows.dp**2))) > _DELIVERED * flows.pumped:
                return flows
            else:
                refused.append(
                    f"what the pump delivers {_DURING[flows.over]} does not make good what leaks: no controller brings "
                    "the piston back, or the circuit changes over between its sides"
                )
        return "; ".join(refused)

    def _leak(self, flows: CycleFlows, step: DriftStep, level: float, figures: str) -> Evidence:
        late = flows.t > step.onset
        dp = float(np.mean(flows.size[late]))
        lpm, limits = _flow(flows, step, dp, level)
        scale = math.hypot(_SCALE, _DRIVE_SCALE if flows.counted == "u" else 0.0, flows.zero)
        limits = max(0.0, limits[0] - 1.96 * scale * lpm), limits[1] + 1.96 * scale * lpm
        lines = [np.where(late, value, 0.0) for value in (lpm, *limits)]
        lost, remark = self._outside(flows, step, lpm * LITRE_PER_MINUTE)
        leak = Evidence(
            "leak",
            f"what the pump delivers {_DURING[flows.over]} rose by {lpm:.4f} L/min at {step.onset:.1f} s "
            f"({figures}){remark}",
            step.score,
            step.threshold,
            step.onset,
            step.onset_interval,
            lpm,
            limits,
            cause="piston or pump leak",
            course=LeakCourse(flows.t, lines[0], lines[1], lines[2]),
            chance=step.chance,
            share=flows.share,
            weighed=_WEIGHED if flows.over == "cycles" else _ANY_DUTY,
        )
        if lost:
            return replace(
                leak, verdict="cannot tell", cause="external leak", leak_lpm=None, leak_interval_lpm=None, course=None
            )
        return leak if self.rig.states("pump.q_b") else without_flow(leak, NO_RIG)

    def _outside(self, flows: CycleFlows, step: DriftStep, flow: float) -> tuple[bool, str]:
        """Return whether a leak [m^3/s] leaves the circuit by the side that carries the load, and words on that.

        What leaves is missing in the accumulator, whose gas expands: dp/dt = -n p Q/V_gas.
        """
        makeup = self.rig.makeup
        if makeup.check_valves == "absent" or flow <= 0.0:
            return False, ""
        before = flows.t < step.onset - 0.5 * flows.seconds
        first = np.flatnonzero(before)[-_BESIDE:]
        fallen = float(np.mean(flows.filled[first]) - np.mean(flows.filled[-_BESIDE:]))
        seconds = float(np.mean(flows.t[-_BESIDE:])) - step.onset
        whole = makeup.n_gas * float(np.mean(flows.filled[first])) * flow * seconds / makeup.V_gas
        drift = _ZERO_DRIFT
        if flows.by_orifice is not None:
            drift += _SURE * float(np.std(flows.filled[before]))
        if fallen > max(_LOST * whole, drift):
            return True, (
                f"; but the circuit's pressure falls by {fallen:.3g} Pa until the end, where that flow to the "
                f"outside would take {whole:.3g} Pa: external leak"
            )
        if _LOST * whole > drift:
            return False, ""
        return False, "; oil that leaves past a seal of the side that carries the load would look alike"


def _flow(flows: CycleFlows, step: DriftStep, dp: float, level: float) -> tuple[float, tuple[float, float]]:
    """Return the flow of a step [L/min] and its 95 % interval, which holds what the blocks beside it say, too."""
    unit = dp / LITRE_PER_MINUTE
    half = step.quantile * step.size_sd + 1.96 * _DRIFTS * level
    if flows.by_orifice is not None:
        low, high = sorted((1.0, flows.by_orifice))
        return 0.5 * (low + high) * step.size * unit, (
            (step.size - half) * low * unit,
            (step.size + half) * high * unit,
        )
    beside, ratio = step_near(
        flows.t,
        flows.flow / flows.dp,
        0.5 * flows.seconds,
        step.onset,
        near=0.0,
        reach=(_BESIDE + 0.2) * flows.seconds,
        fewest=_FEWEST_BESIDE,
    )
    ends = (step.size, step.size if ratio == 0.0 else max(beside, 0.0))
    return float(np.mean(ends)) * unit, ((min(ends) - half) * unit, (max(ends) + half) * unit)


def _no_step(flows: CycleFlows, step: DriftStep, smallest: float, figures: str) -> Evidence:
    """Return the evidence where nothing stepped; `smallest` [m^3/s]: the step that would have shown."""
    share = smallest / flows.pumped
    reason = (
        f"what the pump delivers {_DURING[flows.over]} did not rise within the recording ({figures}); a leak "
        "from the start would be hidden, the smallest step that would have shown is "
        f"{smallest / LITRE_PER_MINUTE:.2g} L/min"
    )
    known = share <= LEAK_WORTH_FINDING
    if not known:
        reason += f", more than {LEAK_WORTH_FINDING:.0%} of the pump's flow, the smallest leak worth finding"
    return Evidence(
        "no leak" if known else "cannot tell",
        reason,
        step.score,
        step.threshold,
        chance=step.chance,
        passage=Passage(None, None, float(np.mean(flows.size)), smallest / LITRE_PER_MINUTE, None, None, share),
        share=flows.share,
    )
