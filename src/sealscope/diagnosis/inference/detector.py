"""The volume balance as a detector: blocks of a recording, and of the healthy ones it is compared with, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.balance import blocks_of, shortest
from sealscope.diagnosis.inference.blocks import Blocks
from sealscope.diagnosis.inference.decision import RecordedBalance, judge
from sealscope.diagnosis.inference.terms import equations
from sealscope.diagnosis.inference.weak_form import STRIDE, stride_samples
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Fewest samples between neighbouring test functions.
RESOLVED = 2


class VolumeBalance:
    """Leakage from the balance of volumes: what the pump delivers and the piston does not displace.

    It needs both chamber pressures, the piston's position, and the pump's angle, its speed or the command; behind a
    servo valve position, command, both chambers, supply and return.
    """

    name = "volume balance"
    reads = ("u", "theta", "omega", "x", "p_1", "p_2", *CHAMBERS)

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the balance needs, else the reason why not."""
        if not equations(self.rig, frozenset(recording.channels)):
            if self.rig.valve.spool == "present":
                return "needs x, u, p_A, p_B and the pressures of supply and return, p_1 and p_2"
            return "needs x, p_A, p_B and the pump's theta or omega, or the command u"
        if stride_samples(recording.rate) < RESOLVED:
            return f"needs {RESOLVED / STRIDE:g} Hz or more, got {recording.rate:g} Hz: is the unit of the time right?"
        fewest = shortest(recording.rate)
        if len(recording) < fewest:
            return f"needs {fewest} samples or more at {recording.rate:g} Hz, got {len(recording)}"
        for name in ("x", *CHAMBERS):
            values = recording[name][np.isfinite(recording[name])]
            if not values.size or values.min() == values.max():
                return f"{name} is constant or missing"
        return None

    def balance(self, recording: Recording) -> RecordedBalance | None:
        """Return the recording's balance; None where it is too short for any block."""
        made = remembered(recording, (self.name, self.rig), lambda own: blocks_of(own, self.rig), self.reads)
        if made is None:
            return None
        blocks, columns = made
        return RecordedBalance(
            blocks,
            equations(self.rig, frozenset(recording.channels)),
            columns,
            self.rig,
            frozenset(recording.units.items()),
            recording,
        )

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a step of the leakage, and of its rise against the baseline."""
        own = self.balance(recording)
        if own is None:
            return Evidence("cannot tell", f"too short for a balance: {recording.duration:.3g} s")
        healthy: list[Blocks] = []
        for other in baseline:
            compared = self.balance(other)
            if compared is not None and compared.columns[0].names == own.columns[0].names:
                healthy.append(compared.blocks)
        rows = own.blocks.rows
        return replace(judge(own, false_alarm_probability, healthy), share=float(rows.mean() / max(rows.max(), 1.0)))
