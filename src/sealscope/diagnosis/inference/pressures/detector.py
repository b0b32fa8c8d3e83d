"""Leakage from both chamber pressures and the command, without a position: the response or the ring, judged.

The response is the hypothesis of the machine with the laws of the rig (`response`); where no parameters of it simulate
the recording, the ring alone is asked (`ring_down`), which knows no laws but a damped oscillation's. The questions are
those of `inference.decision`: did the conductance step within the recording, beside what else may have stepped, and is
its level above that of healthy recordings?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.causes import StepHypothesis, probabilities
from sealscope.diagnosis.inference.causes import stepped as stepped_cause
from sealscope.diagnosis.inference.decision import AGAINST, SECOND, WITHIN, Question, asked, is_leak
from sealscope.diagnosis.inference.onset import StepTest, course, step_test
from sealscope.diagnosis.inference.pressures import response, ring_down
from sealscope.diagnosis.inference.pressures.evidence import PressureEvidence, priors, states_flow, unusable
from sealscope.diagnosis.inference.scatter import Rise, student
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.verdict.evidence import LEAKS, NO_RIG, RAREST, Cause, Evidence, LeakCourse, Passage
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What a step of a parameter of the response comes from.
CAUSES: dict[str, Cause] = {
    "G": "piston leak",
    "K": "air in the oil",
    **dict.fromkeys(("gain", "lead", "bias", "spring"), "changed duty"),
    **dict.fromkeys(("F_C", "F_v", "K_brk", "C_c", "side", "give"), "friction change"),
    **dict.fromkeys(("lag", "scale", "offset"), "sensor fault"),
}
_95, _SURE = 1.96, 0.95


@dataclass(frozen=True, eq=False)
class PressureReading:
    """What a recording says of the conductance g past the piston, by the response or by the ring.

    `flow` of the pump, the mean of its size [m^3/s]; `stated`: whether the rig states what makes g a flow.
    """

    evidence: PressureEvidence
    response: response.Response | None
    flow: float
    stated: bool

    @staticmethod
    def of(recording: Recording, rig: Rig) -> PressureReading | None:
        """Return that of a recording; None where neither response nor ring says anything."""
        own = response.response(recording, rig)
        evidence = ring_down.evidence(recording, rig) if own is None else response.evidence(recording, rig)
        if evidence is None:
            return None
        speed = rig.motor.omega_per_volt * float(np.mean(np.abs(recording["u"])))
        return PressureReading(evidence, own, speed * rig.pump.q_b / (2.0 * np.pi), states_flow(rig))

    @property
    def by(self) -> str:
        """The provider."""
        return "ring" if self.response is None else "response"

    @cached_property
    def test(self) -> StepTest | None:
        """Test of a step of g."""
        return step_test(self.evidence.information)

    @cached_property
    def hypotheses(self) -> tuple[StepHypothesis, ...]:
        """Tests of all that may have stepped, the most likely first; the ring tells no leak from friction."""
        if self.test is None:
            return ()
        if self.response is None:
            return tuple(StepHypothesis(name, CAUSES[name], self.test) for name in ("G", "F_v"))
        tests = {
            name: self.test if name == "G" else step_test(self.response.information(index), (1.0, -1.0))
            for index, name in enumerate(response.PARAMETERS)
        }
        tested = (StepHypothesis(name, CAUSES[name], test) for name, test in tests.items() if test is not None)
        return tuple(sorted(tested, key=lambda own: -own.score))

    @cached_property
    def level(self) -> tuple[float, float]:
        """Level of g over the recording and its standard deviation [m^3/(s Pa)]."""
        own = self.evidence.information
        precision = max(float(own.precision.sum()), np.finfo(float).tiny)
        return float(own.vector.sum()) / precision, precision**-0.5


class PressureResponse:
    """Leakage from both chamber pressures and the command, by how p_A - p_B responds to the command."""

    name = "pressure response"
    reads = ("u", "p_A", "p_B")

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the response needs, else the reason why not."""
        return unusable(recording, self.rig)

    def reading(self, recording: Recording) -> PressureReading | None:
        """Return what a usable recording says of the conductance; None where it says nothing."""
        return PressureReading.of(recording, self.rig)

    def learn(self, recording: Recording) -> Lesson | None:
        """Return what a healthy recording teaches: the level of the conductance, and by which provider."""
        own = None if unusable(recording, self.rig) else self.reading(recording)
        return None if own is None else {"by": own.by, "level": own.level[0]}

    def examine(self, recording: Recording, baseline: Sequence[Healthy], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a step of the conductance, and of its rise against the baseline."""
        own = self.reading(recording)
        if own is None:
            return Evidence("cannot tell", "no response to the command that a pump-driven piston would give")
        levels = [lesson["level"] for lesson in lessons_of(self, baseline) if lesson["by"] == own.by]
        evidence = judge(own, false_alarm_probability, levels)
        whole = 1.0 if recording.bridged is None else float(np.mean(~recording.bridged))
        return replace(evidence, share=whole)


def judge(own: PressureReading, probability: float, levels: Sequence[float] = ()) -> Evidence:
    """Return the evidence of a reading at a false-alarm probability, against the levels of healthy recordings."""
    test, against = own.test, _rise(own, levels) if levels else None
    if test is None and against is None:
        return Evidence("cannot tell", "too little moves: no leak would show")
    questions = _questions(test, against, probability)
    answered = next((asked for asked in questions if asked.chance < asked.probability), None)
    causes = probabilities(own.hypotheses) if answered is not None and answered.name == WITHIN else {}
    if causes and not is_leak(causes):
        answered = None
    judging = answered or questions[0]
    bound = max(against.interval(0.9)[1], 0.0) if against is not None else (test.bound() if test is not None else 0.0)
    if answered is None:
        worth = bound * float(own.evidence.pressure.mean()) <= beliefs("inference")["worth"]["share"] * own.flow
        enough = worth and sum(causes.get(cause, 0.0) for cause in LEAKS) < 1.0 - _SURE
        cause = stepped_cause(own.hypotheses, RAREST)
        evidence = Evidence("no leak" if enough else "cannot tell", "", cause=None if cause in LEAKS else cause)
    elif answered.name == WITHIN:
        evidence = _begun(own)
    else:
        evidence = Evidence("leak", "", cause="piston leak")  # levels of g lean on the friction: they state no L/min
    return _with_figures(own, evidence, questions, judging, bound)


def _questions(test: StepTest | None, against: Rise | None, probability: float) -> list[Question]:
    """Return the questions that can be asked, each with its share of the false-alarm probability."""
    questions = []
    second = SECOND * probability if test is not None and against is not None else 0.0
    if test is not None:
        share = second or probability
        questions.append(Question(WITHIN, test.score, test.threshold(share), test.chance, share))
    if against is not None:
        share = probability - second
        questions.append(Question(AGAINST, against.score, against.threshold(share), against.chance, share))
    return questions


def _rise(own: PressureReading, levels: Sequence[float]) -> Rise:
    """Return how far the level of g is above those of healthy recordings by the same provider."""
    total, count = sum(levels), len(levels)
    apart = [level - (total - level) / (count - 1) for level in levels] if count > 1 else [0.0]
    return student(own.level[0] - total / count, apart, priors("response")["G_level"].width)


def _begun(own: PressureReading) -> Evidence:
    """Return the evidence of a leak that began within the recording, in L/min where the machine's size is stated."""
    assert own.test is not None
    onset = own.test.onset()
    evidence = Evidence("leak", "", cause="piston leak", onset_s=onset.value, onset_interval_s=onset[1:])
    if not own.stated:
        return replace(evidence, refuses=frozenset({"leak_lpm"}))
    lpm, interval = own.evidence.flow(*own.test.fitted)
    return replace(evidence, leak_lpm=max(lpm, 0.0), leak_interval_lpm=interval, course=_course(own, onset.value))


def _course(own: PressureReading, onset: float) -> LeakCourse:
    """Return the leak block by block, beyond the mean before its onset."""
    time = own.evidence.information.time
    g = course(own.evidence.information, own.test, step=True)
    before = (time < onset).astype(float)
    weights = np.eye(len(time)) - before / max(float(before.sum()), 1.0)
    value = weights @ g.mean
    half = _95 * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", weights, g.covariance, weights), 0.0))
    unit = own.evidence.pressure * np.mean(own.evidence.laws) / LITRE_PER_MINUTE
    return LeakCourse(time, value * unit, (value - half) * unit, (value + half) * unit)


def _with_figures(
    own: PressureReading, evidence: Evidence, questions: Sequence[Question], judging: Question, bound: float
) -> Evidence:
    """Return the evidence with scores, thresholds, the bound and the reason in words."""
    pressure = float(own.evidence.pressure.mean())
    flow = own.evidence.laws[1] * bound * (1.0 + _95 * own.evidence.scale) * pressure
    stated = own.stated and evidence.verdict != "leak"
    limit = (
        f"{flow / LITRE_PER_MINUTE:.2g} L/min" if own.stated else f"{100.0 * flow / own.flow:.2g} % of the pump's flow"
    )
    reason = {
        "leak": "the conductance past piston or pump "
        + (
            "steps up within the recording, beyond the drift of this machine"
            if judging.name == WITHIN
            else "is above that of the healthy recordings by more than they scatter"
        ),
        "no leak": f"no leak above {limit} (95 %)",
        "cannot tell": f"a leak of up to {limit} would not show (95 %); with the piston's position it does",
    }[evidence.verdict]
    if "leak_lpm" in evidence.refuses:
        reason += f"; {NO_RIG}"
    if evidence.verdict != "leak" and evidence.cause is not None:
        reason += f"; what stepped is rather {evidence.cause}"
    return replace(
        asked(evidence, questions, judging, "conductance"),
        reason=reason,
        bound_lpm=flow / LITRE_PER_MINUTE if stated else None,
        passage=_passage(own, questions, pressure) if evidence.verdict != "leak" else None,
    )


def _passage(own: PressureReading, questions: Sequence[Question], pressure: float) -> Passage:
    """Return the smallest step that would have been found; what passes in all is not known from pressures."""
    share = next((asked.probability for asked in questions if asked.name == WITHIN), None)
    step = None if own.test is None or share is None else own.test.findable(share) * pressure
    return Passage(
        lpm=None,
        interval_lpm=None,
        pressure=pressure,
        findable_lpm=None if step is None or not own.stated else step / LITRE_PER_MINUTE,
        findable_share=None if step is None or not own.flow > 0.0 else step / own.flow,
    )
