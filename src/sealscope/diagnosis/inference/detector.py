"""The volume balance as a detector: blocks of a recording, and of the healthy ones it is compared with, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.balance import blocks_of, shortest
from sealscope.diagnosis.inference.blocks import Columns
from sealscope.diagnosis.inference.circuit.store import lost_beside
from sealscope.diagnosis.inference.circuit.without_position import circulations
from sealscope.diagnosis.inference.decision.judge import bound_of, judge
from sealscope.diagnosis.inference.decision.recorded import RecordedBalance
from sealscope.diagnosis.inference.scatter import RecordingSums, Rise, motion_change, rise
from sealscope.diagnosis.inference.terms import CYLINDER, LOCKED, circulation, equations, locked
from sealscope.diagnosis.inference.weak_form import STRIDE, stride_samples
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording, remembered

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Why a recording has no balance, with its position and without.
_NO_BALANCE = {
    True: "too short for a balance, or the piston is not held: {:.3g} s",
    False: "no loop brings the piston back or holds it under a pressure difference, for long enough in {:.3g} s, so "
    "that what leaks moves it: record its position x",
}
_AGES = 1e11  # seconds
#: Fewest samples between neighbouring test functions.
RESOLVED = 2


def made_good(balance: RecordedBalance) -> bool:
    """Whether the pump surely delivers what any pump loses: a loop brings the piston back, or holds it."""
    least: float = priors("inference")["held"]["share"]
    return balance.level.low * balance.mean_pressure() > least * balance.mean_flow


#: Channels that balances read.
_READ = ("u", "theta", "omega", "q_pump", "x", "p_1", "p_2", *CHAMBERS)


class VolumeBalance:
    """Leakage from the balance of volumes: what the pump delivers and the piston does not displace.

    It needs both chamber pressures, and the pump's angle, its speed, a flow meter or the command; the piston's
    position, or a loop that brings the piston back or holds it (`without_position`). Behind a servo valve it needs
    position, command, both chambers, supply and return. Without the latter it sees what holds lose.
    """

    name = "volume balance"

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the balance needs, else the reason why not."""
        channels = frozenset(recording.channels)
        if not (equations(self.rig, channels) or circulation(self.rig, channels) or locked(self.rig, channels)):
            if self.rig.valve.spool == "present":
                return "needs x, u, p_A, p_B; for more than holds the pressures of supply and return, p_1 and p_2"
            return "needs p_A, p_B and the pump's theta or omega, a flow meter q_pump or the command u"
        if stride_samples(recording.rate) < RESOLVED:
            return f"needs {RESOLVED / STRIDE:g} Hz or more, got {recording.rate:g} Hz: is the unit of the time right?"
        fewest = shortest(recording.rate)
        if len(recording) < fewest:
            return f"needs {fewest} samples or more at {recording.rate:g} Hz, got {len(recording)}"
        for name in ("x", *CHAMBERS):
            if name not in recording:
                continue
            values = recording[name][np.isfinite(recording[name])]
            if not values.size or values.min() == values.max():
                return f"{name} is constant or missing"
        return None

    def balance(self, recording: Recording) -> RecordedBalance | None:
        """Return the recording's balance, that of the smallest bound where it has several; None where it has none.

        Where the position is not recorded a balance says nothing unless the pump makes good what a pump loses.
        """
        balances = equations(self.rig, frozenset(recording.channels))
        if not balances:
            made = remembered(recording, (self.name, self.rig), lambda own: circulations(own, self.rig), _READ)
            recorded = [
                RecordedBalance(own.blocks, (own.equation,), (own.columns,), self.rig, recording, own.lost)
                for own in made
            ]
            answering = [own for own in recorded if own.equations[0].name == LOCKED or made_good(own)]
            return min(answering, key=lambda own: bound_of(own, None), default=None)
        blocks = remembered(recording, (self.name, self.rig), lambda own: blocks_of(own, self.rig), _READ)
        if blocks is None:
            return None
        zero = float(blocks[0].zero[0])
        lost = remembered(recording, ("lost oil", self.rig), lambda own: lost_beside(own, self.rig, zero), _READ)
        return RecordedBalance(blocks[0], balances, blocks[2], self.rig, recording, lost, blocks[1])

    def learn(self, recording: Recording) -> Lesson | None:
        """Return what a healthy recording teaches (`scatter.RecordingSums`), by the terms of its balance.

        `scale` makes flows by the rig's displacement the machine's, 0 where its size is not stated.
        """
        own = self.balance(recording)
        if own is None:
            return None
        scale = own.size.scale if own.size.stated else 0.0
        known = {name: value for name, value in own.recording_sums._asdict().items() if value is not None}
        return {"terms": list(own.columns[0].names), "scale": scale, **known}

    def rises(self, lessons: Sequence[Lesson], channels: frozenset[str]) -> list[Rise]:
        """Return how far each of several healthy recordings of the same channels is above the others."""
        columns, healthy = self._columns(channels), [_sums_of(lesson) for lesson in lessons]
        return [rise(own, healthy[:k] + healthy[k + 1 :], columns) for k, own in enumerate(healthy)]

    def next_rise(self, lessons: Sequence[Lesson], channels: frozenset[str], repeated: int = 1) -> Rise:
        """Return the rise of a healthy recording like these on a later day, as after `repeated` times as many days."""
        healthy = [_sums_of(lesson) for lesson in lessons]
        later = [own._replace(start_s=_later(own, k)) for k in range(repeated) for own in healthy]
        flow, pressure = (float(np.median([lesson[of] for lesson in lessons])) for of in ("flow", "pressure"))
        middle = RecordingSums(healthy[0].sums, flow, pressure, oil_degC=healthy[0].oil_degC)
        dated = next((own for own in healthy if own.start_s is not None), middle)
        return rise(middle._replace(start_s=_later(dated, repeated)), later, self._columns(channels))

    def _columns(self, channels: frozenset[str]) -> list[Columns]:
        return [Columns(equation) for equation in equations(self.rig, channels)]

    def examine(self, recording: Recording, baseline: Sequence[Healthy], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a step of the leakage, and of its rise against the baseline."""
        own = self.balance(recording)
        if own is None:
            return Evidence("cannot tell", _NO_BALANCE["x" in recording].format(recording.duration), usable=False)
        names = list(own.columns[0].names)
        lessons = [lesson for lesson in lessons_of(self, baseline) if lesson["terms"] == names]
        healthy = [_sums_of(lesson) for lesson in lessons]
        evidence, rows = judge(own, false_alarm_probability, healthy), own.blocks.rows
        if own.equations[0].name != CYLINDER and len(own.columns) == 1:
            return evidence
        if healthy and len(own.columns) == 1:
            evidence = replace(
                evidence, reason=evidence.reason + _of_another_machine(own, healthy, false_alarm_probability)
            )
        return replace(evidence, share=float(rows.mean() / max(rows.max(), 1.0)))


def _later(recorded: RecordingSums, times: int) -> float | None:
    """Return the date of a recording as many times later as no recordings of one machine are apart."""
    return None if recorded.start_s is None else recorded.start_s + times * _AGES


def _sums_of(lesson: Lesson) -> RecordingSums:
    sums = np.asarray(lesson["sums"], dtype=float)
    return RecordingSums(sums, lesson["flow"], lesson["pressure"], lesson.get("start_s"), lesson.get("oil_degC"))


def _of_another_machine(own: RecordedBalance, healthy: Sequence[RecordingSums], probability: float) -> str:
    """Return in words that motion takes another flow than in the healthy recordings, empty where it does not."""
    change = motion_change(own.recording_sums.sums[0], [of.sums[0] for of in healthy], own.columns[0])
    if not abs(change.score) > change.threshold(0.5 * probability):
        return ""
    return (
        f"; motion takes {np.exp(change.value):.3g} times the flow that it does in the healthy recordings: another "
        "machine, or another scale of its sensors?"
    )
