"""The one decision: from observations of a recording, and of healthy ones, to a verdict.

`leak` where a question is answered with yes at its share of the false-alarm probability, by the null that healthy
recordings calibrate, and leaks are the most probable explanation. `no leak` with the 95 % bound of a leak over all
explanations, where that is worth stating; else `cannot tell`, with the bound and what competes. Nothing else states a
verdict: `combine` chooses which provider's decision stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sealscope.diagnosis.decision.case import Case, DecisionContext, Question, step_key
from sealscope.diagnosis.decision.explanations import probability_of
from sealscope.diagnosis.decision.null import HealthyNull
from sealscope.diagnosis.decision.reasons import reason_of
from sealscope.diagnosis.decision.verdicts import bound_worth_stating, decide_verdict
from sealscope.diagnosis.inference.observable import Flow, LeakMeasure, Observed
from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK, RAREST, WITHIN, Cause, Evidence

_PRIORS = priors("decision")


def decide(judge: Observed, reports: Sequence[Observed], null: HealthyNull, context: DecisionContext) -> Evidence:
    """Decide on a recording by the report of one provider, all others' observables competing.

    Parameters
    ----------
    judge : Observed
        The provider that judges.
    reports : sequence of Observed
        All reports, that of `judge` among them or not.
    null : HealthyNull
        What healthy recordings of the machine show.
    context : DecisionContext

    Returns
    -------
    Evidence
    """
    if judge.lack:
        return Evidence(CANNOT_TELL, judge.lack, detector=judge.provider, usable=False)
    other_reports = [
        report for report in reports if report is not judge and context.is_weighed and _describes_else(report, judge)
    ]
    observables = [*judge.observables, *(observable for report in other_reports for observable in report.observables)]
    case = Case(judge, observables, null, context)
    least: float = _PRIORS["explanation"]["leak"]
    leak_alarm = next((alarm for alarm in case.alarms if case.leak_probability(alarm) > least), None)
    if leak_alarm is not None:
        return _leak_evidence(case, leak_alarm)
    alarm, leak = next(iter(case.alarms), None), case.leak
    bound = _bound(case, alarm)
    verdict = decide_verdict(False, *_bound_and_worth(case, bound))
    other = case.other_event
    questions = case.questions
    evidence = Evidence(verdict, "", cause=None if other is None else other.cause)
    evidence = _with_questions(case, evidence, questions[0] if questions else None)
    if leak is not None:
        litres = leak.litres
        findable = _findable(case)
        evidence = replace(
            evidence,
            bound_lpm=bound * litres if litres is not None and np.isfinite(bound) else None,
            total_leakage=leak.total(findable),
            course=leak.course(None),
        )
    return replace(evidence, reason=reason_of(case, evidence, alarm, bound, other))


def _describes_else(report: Observed, judge: Observed) -> bool:
    """Test whether a report rests on other data than the judge's: two leak measures share their samples."""
    return report.leak is None or judge.leak is None


def _leak_evidence(case: Case, alarm: Question) -> Evidence:
    """State a leak, with its size if the machine's size is known."""
    leak, onset = case.leak, None
    cause: Cause = "piston leak"
    if leak is None:
        rarest = min(case.judge.observables, key=lambda observable: observable.chance)
        onset, flow = rarest.onset, None
    else:
        pump = probability_of(case.explanations, "pump leak")
        tells_pump = any(observable.name == "pump leak" for observable in case.observables) and pump < RAREST
        cause = "piston leak" if tells_pump and leak.cause == "piston or pump leak" else leak.cause
        onset = leak.step.onset() if alarm.name == WITHIN and leak.step is not None else None
        flow = leak.step_flow if alarm.name == WITHIN else leak.rise_flow
    evidence = Evidence(LEAK, "", cause=cause)
    if onset is not None:
        evidence = replace(evidence, onset_s=onset.value, onset_interval_s=(onset.low, onset.high))
    if leak is not None:
        evidence = replace(
            evidence,
            total_leakage=leak.total(None),
            course=leak.course(evidence.onset_s),
            **_sizes(leak, flow),
        )
    evidence = _with_questions(case, evidence, alarm)
    return replace(evidence, reason=reason_of(case, evidence, alarm, np.inf, None))


def _sizes(leak: LeakMeasure, flow: Flow | None) -> dict[str, Any]:
    """Return the leak's figures in L/min and relative to the pump, or the reason to refuse them."""
    if flow is None:
        return {}
    sizes: dict[str, Any] = {"relative": leak.relative(flow)}
    if leak.litres is None:
        return {**sizes, "refuses": frozenset({"leak_lpm"})}
    half = WITHIN_95 * float(np.hypot(flow.deviation, flow.value * leak.size_deviation))
    low, high = max(flow.value - half, 0.0), flow.value + half
    interval = low * leak.litres, high * leak.litres
    return {**sizes, "leak_lpm": flow.value * leak.litres, "leak_interval_lpm": interval}


def _bound(case: Case, alarm: Question | None) -> float:
    """Return the 95 % upper bound [m^3/s] of a leak over all explanations; inf where it is more than the pump gives."""
    leak = case.leak
    if leak is None:
        return np.inf
    bound = leak.bound_flow
    if alarm is not None and case.leak_probability(alarm) > 1.0 - _PRIORS["explanation"]["sure"]:
        flow = leak.step_flow if alarm.name == WITHIN else leak.rise_flow
        if flow is not None:
            deviation = np.hypot(flow.deviation, flow.value * leak.size_deviation)
            bound = max(bound, flow.value + WITHIN_95 * float(deviation))
    return bound if bound < leak.pump_flow[0] or not leak.pump_flow[0] > 0.0 else np.inf


def _bound_and_worth(case: Case, bound: float) -> tuple[float, float]:
    """Return a bound and the largest one worth stating: of the leak's flow, else of the ringing's fall."""
    if case.leak is not None:
        return bound, bound_worth_stating(case.leak.pump_flow[1])
    ringing, details = case.judge.ringing, priors("rms_change")
    if ringing is None or case.alarms or ringing.rate < details["rate"]["ringing"]:
        return np.inf, 0.0
    return ringing.bound, details["recordings"]["worth"]


def _findable(case: Case) -> float | None:
    """Return the smallest step within the recording that would have been found [m^3/s]."""
    within = next((question for question in case.questions if question.name == WITHIN), None)
    if within is None or case.leak is None or case.leak.step is None:
        return None
    law = case.null.law_chance(step_key(case.leak.provider), within.probability)
    return case.leak.step.findable(law) * case.leak.step_driving


def _with_questions(case: Case, evidence: Evidence, judging: Question | None) -> Evidence:
    """Add score, threshold and chance of the judging question, and all questions if there are several."""
    evidence = replace(evidence, detector=case.judge.provider, share=case.judge.share)
    if case.leak is not None and case.leak.ratio is not None:
        ratio = case.leak.ratio
        evidence = replace(evidence, ratio=ratio.value, ratio_interval=(ratio.low, ratio.high))
    if judging is None:
        return evidence
    parts = tuple(
        Evidence(
            LEAK if evidence.verdict == LEAK and question is judging else NO_LEAK,
            question.name,
            question.score,
            question.threshold,
            detector=question.name,
            chance=max(question.chance, RAREST),
        )
        for question in case.questions
    )
    return replace(
        evidence,
        score=judging.score,
        threshold=judging.threshold,
        chance=max(judging.chance, RAREST),
        parts=parts if len(parts) > 1 else (),
    )
