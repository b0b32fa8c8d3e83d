"""Leakage from both chamber pressures and the command, without a position: the whole response, judged.

The questions are those of `inference.decision`: did the conductance step within the recording, beside what else may
have stepped, and is its level above that of healthy recordings?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.decision.questions import WITHIN, Question, answer, asked, bound_text, questions
from sealscope.diagnosis.inference.onset import WITHIN_95, StepTest, course, two_sided
from sealscope.diagnosis.inference.other_steps.causes import StepHypothesis, probabilities
from sealscope.diagnosis.inference.other_steps.causes import stepped as stepped_cause
from sealscope.diagnosis.inference.other_steps.step import OtherStep, other_step
from sealscope.diagnosis.inference.pressures import response
from sealscope.diagnosis.inference.pressures.evidence import PRIORS, PressureEvidence, flow_scale, unusable
from sealscope.diagnosis.inference.scatter import Rise, student
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.verdict.evidence import LEAKS, NO_RIG, RAREST, Cause, Evidence, LeakCourse, TotalLeakage
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


class PressureResponse:
    """Leakage from both chamber pressures and the command, by how p_A - p_B responds to the command."""

    name = "pressure response"

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the response needs, else the reason why not."""
        return unusable(recording, self.rig)

    def reading(self, recording: Recording) -> PressureEvidence | None:
        """Return what a recording says of the conductance; None where it says nothing."""
        return response.evidence(recording, self.rig)

    def learn(self, recording: Recording) -> Lesson | None:
        """Return what a healthy recording teaches: the level of the conductance."""
        own = self.reading(recording)
        return None if own is None else {"level": own.level[0]}

    def examine(self, recording: Recording, baseline: Sequence[Healthy], false_alarm_probability: float) -> Evidence:
        """Return the evidence of a step of the conductance, and of its rise against the baseline."""
        own = self.reading(recording)
        if own is None:
            why = "no response to the command that a pump-driven piston would give"
            return Evidence("cannot tell", why, usable=False)
        levels = [lesson["level"] for lesson in lessons_of(self, baseline)]
        whole = 1.0 if recording.bridged is None else float(np.mean(~recording.bridged))
        beside = other_step(recording, RAREST)  # it takes a leak away
        return replace(judge(own, false_alarm_probability, levels, beside), share=whole)


def hypotheses(own: PressureEvidence) -> tuple[StepHypothesis, ...]:
    """Return tests of all that may have stepped, the most likely first."""
    if own.test is None:
        return ()
    tests: dict[str, StepTest | None] = {"G": own.test}
    tests |= {name: two_sided(information) for name, information in own.others.items()}
    tested = (StepHypothesis(name, CAUSES[name], test) for name, test in tests.items() if test is not None)
    return tuple(sorted(tested, key=lambda each: -each.score))


def judge(
    own: PressureEvidence, probability: float, levels: Sequence[float] = (), beside: OtherStep | None = None
) -> Evidence:
    """Return the evidence of a reading at a false-alarm probability, against the levels of healthy recordings.

    `beside`: what stepped of what a leak does not move.
    """
    test, against = own.test, _rise(own, levels) if levels else None
    if test is None and against is None:
        return Evidence("cannot tell", "too little moves: no leak would show")
    possible, tested = questions(test, against, probability), hypotheses(own)
    bound = against.bound() if against is not None else (test.bound() if test is not None else 0.0)
    flow = bound * float(own.pressure.mean())
    verdict, judging, _ = answer(possible, lambda: probabilities(tested, beside), flow, own.pump)
    if verdict != "leak":
        cause = stepped_cause(tested, RAREST)
        evidence = Evidence(verdict, "", cause=None if cause in LEAKS else cause)
    elif judging.name == WITHIN and test is not None:
        evidence = _begun(own, test)
    else:
        evidence = Evidence("leak", "", cause="piston leak")  # levels of g lean on the friction: they state no L/min
    return _with_figures(own, evidence, possible, judging, bound)


def _rise(own: PressureEvidence, levels: Sequence[float]) -> Rise:
    """Return how far the level of g is above those of healthy recordings."""
    total, count = sum(levels), len(levels)
    apart = [level - (total - level) / (count - 1) for level in levels] if count > 1 else [0.0]
    return student(own.level[0] - total / count, apart, PRIORS["conductance"]["level"])


def _begun(own: PressureEvidence, test: StepTest) -> Evidence:
    """Return the evidence of a leak that began within the recording, in L/min where the machine's size is stated."""
    onset = test.onset()
    evidence = Evidence("leak", "", cause="piston leak", onset_s=onset.value, onset_interval_s=onset[1:])
    if not own.stated:
        return replace(evidence, refuses=frozenset({"leak_lpm"}))
    lpm, interval = own.flow(*test.fitted)
    time = own.information.time
    beyond = course(own.information, test, step=True).beyond(time < onset.value)
    unit = own.pressure * 0.5 * (1.0 + own.orifice) / LITRE_PER_MINUTE
    value, half = beyond.mean * unit, WITHIN_95 * np.sqrt(np.maximum(np.diag(beyond.covariance), 0.0)) * unit
    leak = LeakCourse(time, value, value - half, value + half)
    return replace(evidence, leak_lpm=max(lpm, 0.0), leak_interval_lpm=interval, course=leak)


def _with_figures(
    own: PressureEvidence, evidence: Evidence, possible: Sequence[Question], judging: Question, bound: float
) -> Evidence:
    """Return the evidence with scores, thresholds, the bound, the smallest step that shows, and the reason in words."""
    pressure = float(own.pressure.mean())
    flow = own.orifice * bound * (1.0 + WITHIN_95 * flow_scale()) * pressure
    lpm = flow / LITRE_PER_MINUTE
    limit = f"{lpm:.2g} L/min" if own.stated else f"{100.0 * flow / own.pump:.2g} % of the pump's flow"
    begins = "steps up within the recording, beyond the drift of this machine"
    above = "is above that of the healthy recordings by more than they scatter"
    reason = bound_text(evidence.verdict, limit, possible)
    if evidence.verdict == "leak":
        reason = f"the conductance past piston or pump {begins if judging.name == WITHIN else above}"
    elif evidence.verdict == "cannot tell":
        reason += "; with the piston's position it does"
    if "leak_lpm" in evidence.refuses:
        reason += f"; {NO_RIG}"
    evidence = replace(asked(evidence, possible, judging, "conductance"), reason=reason)
    if evidence.verdict == "leak":
        return evidence
    if evidence.cause is not None:
        reason += f"; what stepped is rather {evidence.cause}"
    share = next((each.probability for each in possible if each.name == WITHIN), None)
    step = None if own.test is None or share is None else own.test.findable(share) * pressure
    total_leakage = TotalLeakage(  # what passes in all is not known from pressures
        lpm=None,
        interval_lpm=None,
        pressure=pressure,
        findable_lpm=None if step is None or not own.stated else step / LITRE_PER_MINUTE,
        findable_share=None if step is None or not own.pump > 0.0 else step / own.pump,
    )
    return replace(evidence, reason=reason, bound_lpm=lpm if own.stated else None, total_leakage=total_leakage)
