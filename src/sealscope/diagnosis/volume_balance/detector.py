"""Volume balance: what the pump delivers and the piston does not displace has leaked, or is stored in the oil.

Both encoders are so fine that a few seconds give the leakage conductance of pump and piston together to some
hundredths of what a healthy pump leaks (`fit`). What limits the search for a leak is the pump's own leakage, which
drifts with the oil's temperature; so a leak is a step, or a growth, of the conductance that no smooth drift explains
(`changepoint.smooth_drift`). Nothing is assumed of friction, bulk modulus or the pump's leakage; the piston's area
turns the result into L/min, and displacement over area shows whether the assumed geometry fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.baseline.level import share_of_each
from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, DriftStep
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.behind_valve import examined, unusable_behind_valve
from sealscope.diagnosis.volume_balance.blocks import (
    BalanceBlocks,
    Geometry,
    balance_channels,
    block_samples,
    channels_needed,
    cut_blocks,
    mean_pressures,
)
from sealscope.diagnosis.volume_balance.evidence import judge, judge_level, trouble
from sealscope.diagnosis.volume_balance.fit import BalanceFit, fit_balance, with_between
from sealscope.diagnosis.volume_balance.growth import viscous_loss
from sealscope.diagnosis.volume_balance.onset import date_step
from sealscope.diagnosis.volume_balance.over_cycles.detector import CycleBalance
from sealscope.diagnosis.volume_balance.search import scatter
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.gaps import touched
from sealscope.recordings.quality import clipped
from sealscope.recordings.recording import Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Under a load blocks are whole cycles where there are so many: those half a block later are searched as well.
FEWEST_CYCLES = 10
#: ... and stretches without the changing over tell more where their conductances scatter by under this share.
_CALMER = 0.25
_CHANGES_OVER = (
    "either side of the single rod carries in turn, and what passes as the circuit changes over is in no volume: the "
    "cycle balance leaves it out"
)
#: Share of the recording for which the machine may stand at a time.
_UNSEEN = 0.3
#: Blocks in which friction is told from speed are whole cycles of about so long [s].
_FRICTION_SECONDS = 6.0
#: Share of the samples that a pressure may be cut off.
_CLIPPED = 0.005


class VolumeBalance:
    """Leakage from the balance of volumes.

    It needs both chamber pressures, the piston's position and the pump's angle (or speed); the pressures at the pump's
    ports, where there are any, tell the pump's leakage from the piston's.
    """

    name = "volume balance"
    reads = ("u", "theta", "omega", "x", "p_1", "p_2", *CHAMBERS)

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._valved = rig.valve.spool == "present"
        areas = rig.cylinder.A_A, rig.cylinder.A_B
        self.geometry = Geometry(
            0.5 * sum(areas),
            rig.pump.q_b / (2.0 * np.pi),
            areas[0] != areas[1],
            rig.states("cylinder.A_A", "cylinder.A_B"),
            rig.states("pump.q_b"),
            (areas[0] - areas[1]) / sum(areas),
        )

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the balance needs, else the reason why not."""
        if self._valved:
            return unusable_behind_valve(recording)
        missing = channels_needed(recording)
        if missing is not None:
            return missing
        for name in (*CHAMBERS, "x", "theta" if "theta" in recording else "omega"):
            values = recording[name]
            if len(recording) < 2 * FEWEST or np.count_nonzero(np.isfinite(values)) < 2 * FEWEST:
                return f"needs {2 * FEWEST} samples or more of {name}, got {np.count_nonzero(np.isfinite(values))}"
            if np.nanmax(values) == np.nanmin(values):
                return f"{name} is constant"
        return None

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a rise of the conductance, and of its level against the baseline's."""
        if self._valved:  # the level of G is not known there, so that a baseline tells nothing
            return examined(recording, self.rig, false_alarm_probability)
        fit, problem = self.fit(recording)
        if fit is None:
            return Evidence("cannot tell", problem)
        if fit.changes_over and self._yields(fit, recording, false_alarm_probability):
            return Evidence("cannot tell", _CHANGES_OVER)
        probability = share_of_each(false_alarm_probability, baseline)
        evidence = judge(
            fit,
            probability,
            samples=_BehindTheFit(self, recording),
            healthy=self.rig.pump.G_healthy or None,
        )
        if baseline:
            fits = [remembered(other, (self.name, self.rig), self.fit)[0] for other in baseline]
            evidence = judge_level(fit, [other for other in fits if other is not None], evidence, probability)
        blocks = np.arange(0, len(recording) + 1, block_samples(recording))
        return replace(evidence, share=1.0 - float(np.mean(touched(recording, blocks))))

    def _yields(self, fit: BalanceFit, recording: Recording, probability: float) -> bool:
        """Return whether the cycle balance leaves out what the circuit of a single rod passes as it changes over."""
        other = CycleBalance(self.rig)
        flows = other.flows(recording)
        if isinstance(flows, str) or flows.over == "cycles" or other.examine(recording, (), probability).abstains:
            return False
        return fit.settles if flows.over == "holds" else scatter(flows.flow / flows.dp) < _CALMER * scatter(fit.g)

    def blocks(
        self, recording: Recording, length: int | None = None, names: Sequence[str] | None = None
    ) -> BalanceBlocks:
        """Return the blocks of a recording, of `length` samples and `names` of channels, or as its duty suggests."""
        names = balance_channels(recording) if names is None else names
        length = block_samples(recording) if length is None else length
        samples = {name: recording[name] for name in names}
        gaps = touched(recording, np.arange(0, len(recording) + 1, length))
        if gaps.any():
            rows = np.flatnonzero(gaps)[:, None] * length + np.arange(length)
            samples["x"] = samples["x"].copy()
            samples["x"][rows.ravel()] = np.nan
        return cut_blocks(
            recording.t,
            samples,
            length,
            recording.rate,
            self.geometry,
        )

    def length(
        self,
        recording: Recording,
        names: Sequence[str] | None = None,
        *,
        seconds: float | None = None,
        cycles: int = FEWEST_CYCLES,
    ) -> int:
        """Return the samples of a block of about `seconds`: whole cycles under a load, where there are `cycles`."""
        length = block_samples(recording, seconds)
        whole = block_samples(recording, seconds, cycles)
        if whole == length:
            return length
        blocks = self.blocks(recording, whole, names)
        if not len(blocks) or not np.all(np.isfinite(blocks.gram)):
            return length
        fit = fit_balance(blocks, geometry=self.geometry)
        # where rests are passed over, blocks are parts of a cycle
        return whole if fit.goes_together or (fit.keeps_slopes and blocks.samples == whole) else length

    def fit(self, recording: Recording) -> tuple[BalanceFit | None, str]:
        """Return the balance of a recording, or None and the reason why there is none."""
        rail = _at_the_rail(recording)
        if rail is not None:
            return None, rail
        length = self.length(recording)
        blocks = self.blocks(recording, length)
        if len(blocks) < (FEWEST if length == block_samples(recording) else FEWEST_CYCLES):
            return None, (
                f"too short for a balance: {len(blocks)} whole blocks of {blocks.seconds:.3g} s, {FEWEST} are needed"
            )
        if not np.all(np.isfinite(blocks.gram)):
            return None, "the balance cannot be computed: values are beyond floating point"
        fit = fit_balance(blocks, metres=recording.units["x"] == "m", geometry=self.geometry)
        # where rests are passed over and slopes are kept, what lies between is not known
        if (fit.keeps_slopes and blocks.samples == length) or fit.goes_together:
            fit = with_between(fit, self.blocks(recording.samples(slice(length // 2, None)), length))
        problem = trouble(fit) or _unseen(recording, fit)
        return (fit, "") if problem is None else (None, problem)


@dataclass(frozen=True)
class _BehindTheFit:
    """The recording behind a fit."""

    detector: VolumeBalance
    recording: Recording

    def dated(self, fit: BalanceFit, step: DriftStep) -> DriftStep:
        """Return the step with its onset from the samples about it."""
        return date_step(fit, step, self.recording, self.detector.geometry)

    def pressed(self, onset: float) -> tuple[float, float] | None:
        """Return the means of abs(p_A - p_B) [Pa] and of its root from `onset` on, end stops left out."""
        names = balance_channels(self.recording)
        return mean_pressures(
            {name: self.recording[name] for name in names}, self.recording.t >= onset, self.recording.rate
        )

    def thinned(self) -> tuple[float, float] | None:
        """Return the share of its viscous friction that the machine lost, and its deviation; None: not known."""
        rig, recording = self.detector.rig, self.recording
        if not rig.states("friction.F_v") or rig.friction.F_v <= 0.0:
            return None
        geometry = self.detector.geometry
        turning = recording["omega"] if "omega" in recording else np.gradient(recording["theta"]) * recording.rate
        speed = geometry.displacement / geometry.area * turning
        larger = 1.0 + geometry.asymmetry
        force = geometry.area * (larger * recording["p_A"] - (2.0 - larger) * recording["p_B"])
        block = block_samples(recording, _FRICTION_SECONDS)
        lost = viscous_loss(force, speed, recording.rate, block)
        return None if lost is None else (lost[0] / rig.friction.F_v, lost[1] / rig.friction.F_v)

    def levelled(self, zero: float) -> tuple[BalanceFit, _BehindTheFit] | None:
        """Return the fit of the recording with `zero` [Pa] added to p_A, and that recording."""
        channels = {**self.recording.channels, "p_A": self.recording["p_A"] + zero}
        shifted = replace(self.recording, channels=channels)
        fit, _ = self.detector.fit(shifted)
        return None if fit is None else (fit, _BehindTheFit(self.detector, shifted))


def _unseen(recording: Recording, fit: BalanceFit) -> str | None:
    """Return for how long nothing can be balanced where that is too long to miss a leak in, in one line, or None."""
    times = np.concatenate([recording.t[:1], fit.blocks.t, recording.t[-1:]])
    longest = int(np.argmax(np.diff(times)))
    first, last = float(times[longest]), float(times[longest + 1])
    if last - first <= _UNSEEN * recording.duration + fit.blocks.seconds:
        return None
    return f"the machine stands, or samples are missing, from {first:.4g} to {last:.4g} s: a leak there would not show"


def _at_the_rail(recording: Recording) -> str | None:
    """Return which chamber pressure is cut off for so long that its integral is not known, in one line, or None."""
    for name in CHAMBERS:
        values = recording[name]
        values = values[np.isfinite(values)]
        for rail in clipped(values):
            if rail.samples > _CLIPPED * values.size:
                return f"{name} is cut off at {rail.value:.4g} for {rail.samples / values.size:.1%} of the time"
    return None
