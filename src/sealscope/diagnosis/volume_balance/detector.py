"""Volume balance: what the pump delivers and the piston does not displace has leaked, or is stored in the oil.

Both encoders are so fine that a few seconds tell the leakage conductance of pump and piston together to some
hundredths of what a pump leaks when it is sound (`balance_fit`). What limits the search for a leak is the pump's own
leakage, which drifts with the oil's temperature; so a leak is a step, or a growth, of the conductance that no smooth
drift explains (`step_in_drift`). Nothing is assumed of friction, bulk modulus or the pump's leakage; the piston's area
turns the result into L/min, and displacement over area shows whether the assumed geometry fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.changepoint.step_in_drift import FEWEST
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.against_baseline import against_baseline
from sealscope.diagnosis.volume_balance.blocks import (
    BalanceBlocks,
    block_samples,
    channels_needed,
    cut_blocks,
    samples_of,
)
from sealscope.diagnosis.volume_balance.evidence import describe_leak, no_step, trouble
from sealscope.diagnosis.volume_balance.fit import BalanceFit, fit_balance
from sealscope.diagnosis.volume_balance.search import search
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording, remembered
from sealscope.recordings.symptoms import clipped

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Share of the samples that a pressure may be cut off.
_CLIPPED = 0.005
STEP = "step of the conductance"


class VolumeBalance:
    """Leakage from the balance of volumes: needs both chamber pressures, the piston's position and the pump's angle (or
    speed); the pressures at the pump's ports, where there are any, tell the pump's leakage from the piston's."""

    name = "volume balance"
    reads = ("u", "theta", "omega", "x", "p_1", "p_2", *CHAMBERS)

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.area = float(0.5 * (rig.cylinder.A_A + rig.cylinder.A_B))
        self.displacement = float(rig.pump.q_b / (2.0 * np.pi))

    def usable(self, recording: Recording) -> str | None:
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
        fit, problem = self.fit(recording)
        if fit is None:
            return Evidence("cannot tell", problem)
        probability = false_alarm_probability / (2.0 if baseline else 1.0)
        metres = recording.units["x"] == "m"
        within = self._within(fit, probability, metres)
        if not baseline:
            return within
        fits = (remembered(other, (self.name, self.rig), self.fit) for other in baseline)
        others = [one for one, _ in fits if one is not None]
        return against_baseline(fit, others, within, probability, metres=metres)

    def blocks(self, recording: Recording, length: int | None = None) -> BalanceBlocks:
        """The blocks of a recording, of `length` samples or as its duty suggests."""
        samples = samples_of(recording)
        return cut_blocks(
            recording.t,
            samples,
            block_samples(recording) if length is None else length,
            recording.rate,
            area=self.area,
            displacement=self.displacement,
            pump="p_1" in samples,
        )

    def fit(self, recording: Recording) -> tuple[BalanceFit | None, str]:
        """The balance of a recording, or None and the reason why there is none."""
        rail = _at_the_rail(recording)
        if rail is not None:
            return None, rail
        blocks = self.blocks(recording)
        if len(blocks) < FEWEST:
            return None, (
                f"too short for a balance: {len(blocks)} whole blocks of {blocks.seconds:.3g} s, {FEWEST} are needed"
            )
        if not np.all(np.isfinite(blocks.gram)):
            return None, "the balance cannot be computed: values are beyond floating point"
        fit = fit_balance(blocks)
        problem = trouble(fit)
        return (fit, "") if problem is None else (None, problem)

    @staticmethod
    def _within(fit: BalanceFit, probability: float, metres: bool) -> Evidence:
        found = search(fit, probability)
        part = Evidence("leak" if found.found else "no leak", "", found.score, found.threshold, detector=STEP)
        if found.found:
            return describe_leak(fit, found, part, metres=metres)
        return no_step(fit, found, search(fit, probability, sign=-1), part, metres=metres)


def _at_the_rail(recording: Recording) -> str | None:
    """Which chamber pressure is cut off for so long that its integral is not known, in one line, or None."""
    for name in CHAMBERS:
        values = recording[name]
        values = values[np.isfinite(values)]
        for rail in clipped(values, np.empty((0, 2), dtype=np.intp)):
            if rail.samples > _CLIPPED * values.size:
                return f"{name} is cut off at {rail.value:.4g} for {rail.samples / values.size:.1%} of the time"
    return None
