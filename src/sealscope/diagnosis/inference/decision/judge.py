"""The only place that makes a verdict of a balance: three questions, each with an estimate, an interval and a bound.

1. Did a leak begin within the recording? (`onset.step_test`)
2. Is it more than in the baseline? (`scatter.rise`)
3. Is it more than a healthy machine passes? (the level of G against the rig's file, where it says so)

`leak` where one of them is answered with yes at its share of the false-alarm probability. Where that is the first, a
leak past piston or pump must be the most probable of all causes; where it is not, what else stepped may have raised the
level, too, and no leak is stated. `no leak` with the 95 % bound X where X is below the leak worth finding
(`priors.toml`); else `cannot tell` with X. `judgement.combined` sets it beside what the other detectors say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.decision.questions import (
    AGAINST,
    LEVEL,
    WITHIN,
    Question,
    answer,
    asked,
    bound_text,
    questions,
)
from sealscope.diagnosis.inference.decision.recorded import RecordedBalance
from sealscope.diagnosis.inference.onset import BELOW_95, WITHIN_95, Interval
from sealscope.diagnosis.inference.other_steps.causes import probabilities
from sealscope.diagnosis.inference.other_steps.causes import stepped as stepped_cause
from sealscope.diagnosis.inference.other_steps.step import other_step
from sealscope.diagnosis.inference.scatter import RecordingSums, Rise, rise
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import (
    LEAKS,
    NO_RIG,
    RAREST,
    Cause,
    Evidence,
    LeakCourse,
    RelativeLeak,
    TotalLeakage,
)
from sealscope.diagnosis.verdict.machine import healthy_leakage
from sealscope.units import LITRE_PER_MINUTE


def judge(balance: RecordedBalance, probability: float, baseline: Sequence[RecordingSums] = ()) -> Evidence:
    """Return the evidence of a balance at a false-alarm probability, against what healthy recordings say."""
    test = balance.test
    against = rise(balance.recording_sums, baseline, balance.columns) if baseline else None
    if test is None and against is None:
        return Evidence("cannot tell", "p_A and p_B hardly differ, or too few samples are whole: no leak would show")
    possible = questions_of(balance, against, probability)
    bound = bound_of(balance, against)
    verdict, judging, causes = answer(possible, lambda: _causes(balance), bound, balance.moving)
    if verdict != "leak":
        cause = stepped_cause(balance.hypotheses, probability, other_step(balance.recording, probability))
        evidence = Evidence(verdict, "", cause=None if cause in LEAKS else cause)
    elif judging.name == WITHIN:
        evidence = _step(balance, causes)
    else:
        rise_or_level = balance.level if against is None else Interval(against.value, *against.interval())
        flow, low, high = (balance.mean_pressure() * own for own in rise_or_level)
        evidence = Evidence("leak", "", cause=_together(balance))
        evidence = _flow(balance, evidence, flow, (high - low) / (2.0 * WITHIN_95))
    return _with_figures(balance, evidence, bound, possible, judging)


def _causes(balance: RecordedBalance) -> dict[Cause, float]:
    """Return the probability of each cause of a step within the recording."""
    test, pump = balance.test, balance.mean_flow
    share = test.fitted[0] * balance.mean_pressure() / pump if test is not None and pump > 0.0 else 0.0
    return probabilities(balance.hypotheses, other_step(balance.recording, RAREST), share)  # it takes a leak away


def questions_of(balance: RecordedBalance, against: Rise | None, probability: float) -> list[Question]:
    """Return the questions that can be asked of a balance."""
    healthy = healthy_leakage(balance.rig)
    # a drive's droop with the load passes for a level of the leak
    measured = len(balance.columns) == 1 and not balance.equations[0].by_command
    if not (healthy > 0.0 and against is None and balance.size.stated and measured):
        return questions(balance.test, against, probability)
    own = balance.level
    deviation = float(np.hypot((own.high - own.low) / (2 * WITHIN_95), own.value * balance.size.deviation))
    level = (own.value - healthy) / max(deviation, np.finfo(float).tiny)
    return questions(balance.test, against, probability, level)


def _together(balance: RecordedBalance) -> Cause:
    return "piston or pump leak" if len(balance.columns) == 1 else "piston leak"


def _step(balance: RecordedBalance, causes: dict[Cause, float]) -> Evidence:
    """Return the evidence of a leak that began within the recording; its law is weighed, laminar against an orifice."""
    test, orifice = balance.test, balance.through_orifice
    assert test is not None
    onset = test.onset()
    flows, deviations, scores = [], [], []
    for own, mean in ((test, balance.mean_pressure), (orifice, balance.mean_root)):
        if own is not None:
            pressure = mean(onset.value)
            flows.append(own.fitted[0] * pressure)
            deviations.append(own.fitted[1] * pressure)
            scores.append(own.score)
    weights = np.exp(0.5 * (np.array(scores) - max(scores)))
    weights /= weights.sum()
    value = float(weights @ flows)
    spread = float(np.sqrt(weights @ (np.square(deviations) + (np.array(flows) - value) ** 2)))
    pump = causes.get("pump leak", 0.0)
    cause: Cause = _together(balance)
    if "pump leak" in causes and pump < RAREST:
        cause = "piston leak"
    evidence = Evidence("leak", "", onset_s=onset.value, onset_interval_s=(onset.low, onset.high), cause=cause)
    return _flow(balance, evidence, value, spread)


def _flow(balance: RecordedBalance, evidence: Evidence, value: float, deviation: float) -> Evidence:
    """Return the evidence with the flow [m^3/s] of a leak and its deviation, as far as the machine's size is known."""
    size, pump = balance.size, balance.mean_flow
    of_law = float(np.hypot(deviation, value * priors("inference")["size"]["law"]))
    half = WITHIN_95 * float(np.hypot(of_law, value * size.deviation))
    low, high = max(value - half, 0.0), value + half
    ends = (value - WITHIN_95 * of_law, value + WITHIN_95 * of_law)  # the same displacement is in what they are over
    relative = RelativeLeak(
        pump_share=value / pump if pump > 0.0 else None,
        pump_share_interval=_over(ends, pump),
        creep=None if size.area is None else value / size.area,
        creep_interval=_over(ends, size.area),
    )
    evidence = replace(evidence, relative=relative)
    if not size.stated:
        return replace(evidence, refuses=frozenset({"leak_lpm"}))
    unit = size.scale / LITRE_PER_MINUTE
    return replace(evidence, leak_lpm=value * unit, leak_interval_lpm=(low * unit, high * unit))


def _over(interval: tuple[float, float], unit: float | None) -> tuple[float, float] | None:
    return None if unit is None or not unit > 0.0 else (max(interval[0], 0.0) / unit, interval[1] / unit)


def bound_of(balance: RecordedBalance, against: Rise | None) -> float:
    """Return the 95 % upper bound of a leak that began within the recording or came since the baseline [m^3/s]."""
    shown = balance.test if against is None else against
    if shown is None:
        return np.inf
    size = float(np.hypot(balance.size.deviation, priors("inference")["size"]["law"]))
    return shown.bound() * balance.mean_pressure() * (1.0 + BELOW_95 * size)


def _with_figures(
    balance: RecordedBalance,
    evidence: Evidence,
    bound: float,
    questions: Sequence[Question],
    judging: Question,
) -> Evidence:
    """Return the evidence with scores, thresholds, course, total, bound and the reason in words."""
    size = balance.size
    findable = None if evidence.verdict == "leak" else _findable(balance, questions)
    stated = size.stated and evidence.verdict != "leak" and np.isfinite(bound)
    evidence = replace(
        asked(evidence, questions, judging, "leakage"),
        total_leakage=_total_leakage(balance, balance.level, findable),
        ratio=None if size.ratio is None else size.ratio.value,
        ratio_interval=None if size.ratio is None else (size.ratio.low, size.ratio.high),
        bound_lpm=bound * size.scale / LITRE_PER_MINUTE if stated else None,
        course=_leak_course(balance, evidence) if size.stated else None,
    )
    return replace(evidence, reason=_reason(balance, evidence, bound, questions, judging.name))


def _findable(balance: RecordedBalance, questions: Sequence[Question]) -> float | None:
    """Return the smallest step within the recording that would have been found [m^3/s]."""
    share = next((own.probability for own in questions if own.name == WITHIN), None)
    if balance.test is None or share is None:
        return None
    return balance.test.findable(share) * balance.mean_pressure()


def _total_leakage(balance: RecordedBalance, level: Interval, findable: float | None) -> TotalLeakage:
    size, pressure, pump = balance.size, balance.mean_pressure(), balance.mean_flow
    healthy = healthy_leakage(balance.rig)
    flow = pressure * size.scale / LITRE_PER_MINUTE
    wide = 1.0 + WITHIN_95 * size.deviation
    stated = size.stated and len(balance.columns) == 1  # a valve's edges pass as well, by an amount that is not known
    low, high = (
        end * flow * (wide if (end > 0.0) == upper else 1.0 / wide)
        for end, upper in zip(level[1:], (False, True), strict=True)
    )
    return TotalLeakage(
        lpm=level.value * flow if stated else None,
        interval_lpm=(low, high) if stated else None,
        pressure=pressure,
        findable_lpm=None if findable is None or not size.stated else findable * size.scale / LITRE_PER_MINUTE,
        healthy_lpm=healthy * pressure / LITRE_PER_MINUTE if healthy > 0.0 else None,
        pump_share=max(level.value, 0.0) * pressure / pump if pump > 0.0 and len(balance.columns) == 1 else None,
        findable_share=None if findable is None or not pump > 0.0 else findable / pump,
    )


def _leak_course(balance: RecordedBalance, evidence: Evidence) -> LeakCourse:
    """Return the leak over the recording: what came with it, or what passes in all where none began."""
    whole, time = evidence.onset_s is None, balance.blocks.time
    own = balance.whole if evidence.onset_s is None else balance.course(step=True).beyond(time < evidence.onset_s)
    value, deviation = own.mean, np.sqrt(np.maximum(np.diag(own.covariance), 0.0))
    unit = balance.blocks.driving(balance.zero) * balance.size.scale / LITRE_PER_MINUTE
    half = WITHIN_95 * np.hypot(deviation, value * balance.size.deviation)
    return LeakCourse(time, value * unit, (value - half) * unit, (value + half) * unit, whole=whole)


def _level_text(total: TotalLeakage | None) -> str:
    """Return what passes in all beside what a healthy machine passes, in words."""
    if total is None or total.lpm is None or total.healthy_lpm is None:
        return "pump and piston together pass more than a healthy machine"
    return (
        f"pump and piston together pass {total.lpm:.3g} L/min, a healthy machine at most {total.healthy_lpm:.2g} "
        "L/min by the rig's file (pump.G_healthy)"
    )


def _reason(
    balance: RecordedBalance, evidence: Evidence, bound: float, possible: Sequence[Question], question: str
) -> str:
    """Return why, in one line."""
    share = f"{100.0 * bound / balance.mean_flow:.2g} % of the pump's flow" if balance.mean_flow > 0.0 else "any size"
    limit = f"{evidence.bound_lpm:.2g} L/min" if evidence.bound_lpm is not None else share
    text = bound_text(evidence.verdict, limit, possible)
    if evidence.verdict == "leak":
        text = {
            WITHIN: "leakage steps up within the recording, beyond the drift of this machine",
            AGAINST: "leakage is above that of the healthy recordings by more than they scatter",
            LEVEL: _level_text(evidence.total_leakage),
        }[question]
        if "leak_lpm" in evidence.refuses:
            text += f"; {NO_RIG}"
    elif evidence.verdict == "cannot tell":
        text += "; a longer recording, with the load or direction changing, bounds it closer"
    size = balance.size
    if size.ratio is not None and size.disagrees:
        text += f"; displacement over area is {size.ratio.value:.3g} times the assumed one: flows lie between both"
    if abs(balance.zero) > 2.0 * WITHIN_95 * priors("inference")["zero"]["pressure"]:
        text += f"; p_A - p_B reads {abs(balance.zero) / 1e5:.2g} bar too {'much' if balance.zero > 0.0 else 'little'}"
    if (late := balance.delay) is not None and abs(late[0]) > 1.0 / balance.recording.rate + WITHIN_95 * late[1]:
        text += f"; x is recorded {1e3 * abs(late[0]):.3g} ms {'later' if late[0] > 0.0 else 'earlier'} than the flow"
    if evidence.verdict != "leak" and evidence.cause is not None:
        text += f"; what stepped is rather {evidence.cause}"
    return text
