"""The decision on a recording: from the reports of detectors to a verdict.

The verdict is `leak` if both conditions hold for one test of the leakage:

- An alarm: `chance` < `probability` (`Case.alarms`). `chance` is the probability that a healthy recording scores as
  high, calibrated by healthy recordings. `probability` is the test's share (`case._leak_tests`) of the allowed
  probability of a false alarm, by default 0.01. The test for a change within the recording gets a quarter, and the
  comparison with healthy recordings the rest. Without them, the former gets three quarters if there is a limit in the
  rig's file to test, which gets the rest, else all. Score and threshold are the same comparison, for display.
- No better explanation: the probability that a leak caused the alarm (`Case.leak_probability`) is above 0.5, or the
  recording tells only that oil leaks, inside or outside (`Case.shows_leak`). An alarm by the limit in the rig's file is
  judged by the alarm for a change within the recording; without one it is a leak.

A detector that measures no leakage has a single test, with the whole probability of a false alarm.

0.01, a quarter and 0.5 are `[false_alarm] probability`, `[questions] within` and `[explanation] leak` in `priors.toml`.

Otherwise the verdict is `no leak` if the 95 % upper bound of a leak is small enough, i.e. at most the fraction `[worth]
share` of the pump's flow (`_bound_and_limit`). It is `cannot tell` if the bound is larger, and the reason states the
bound and the most probable other explanation.

If each of several detectors could raise the alarm, their false-alarm probabilities would add up. Therefore `combine`
takes the decision of the first detector that decides: those of `ORDER` come first, then a user's own detectors, and
last the change of RMS, which states no size of a leak. It may replace `no leak` by `cannot tell`.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from sealscope.diagnosis.decision.case import STEP_KEY, Case, HealthyNull, LeakTest, OtherEvent
from sealscope.diagnosis.decision.explanations import LEAK_EVENTS, probability_of
from sealscope.diagnosis.estimate.interval import WITHIN_95, Estimate
from sealscope.diagnosis.inference.observable import LeakMeasure, Observable, Observed, Ringing
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.diagnosis.verdict.evidence import (
    AGAINST,
    CANNOT_TELL,
    LEAK,
    NO_LEAK,
    PRESSURE_RESPONSE,
    RAREST,
    RMS_CHANGE,
    VOLUME_BALANCE,
    WITHIN,
    Cause,
    Evidence,
    Verdict,
)
from sealscope.diagnosis.verdict.severity import find_separation
from sealscope.paragraphs import join_names

#: Cause of a leak -> the cause that also names the outside.
_WITH_OUTSIDE: Mapping[Cause, Cause] = {
    "piston leak": "piston or external leak",
    "piston or pump leak": "piston, pump or external leak",
}


def decide(
    judge: Observed,
    reports: Sequence[Observed],
    null: HealthyNull,
    false_alarm_probability: float,
    weigh_rivals: bool = True,
) -> Evidence:
    """Decide on a recording by the report `judge` of one detector: leak, no leak, or cannot tell.

    The test results (observables) in `reports`, which may contain `judge`, may show other causes, which compete with a
    leak unless `weigh_rivals` is False. For the other arguments see `Case`.
    """
    if judge.lack:
        return Evidence(CANNOT_TELL, judge.lack, detector=judge.provider, usable=False)
    # reports that measure the leak use the same samples as the judge's measurement, and do not compete with it
    rivals = [report for report in reports if report is not judge and (report.leak is None or judge.leak is None)]
    observables = [*judge.observables]
    if weigh_rivals:
        observables += [observable for report in rivals for observable in report.observables]
    case = Case(judge, observables, null, false_alarm_probability, weigh_rivals)
    alarm = next((alarm for alarm in case.alarms if case.shows_leak(alarm)), None)
    evidence = _decide_without_leak(case) if alarm is None else _leak_evidence(case, alarm)
    remarks = [] if case.leak is None else [text_of("remark", note.key, **note.values) for note in case.leak.remarks]
    return replace(evidence, reason="".join([evidence.reason, *remarks]))


def _decide_without_leak(case: Case) -> Evidence:
    """Decide between `no leak` and `cannot tell`, given that no test has found a leak.

    The verdict is `no leak` if an undetected leak can only be small (`_bound_and_limit`). Score and threshold are those
    of the test with an alarm, else of the first one.
    """
    alarm = next(iter(case.alarms), None)  # an alarm that has a better explanation than a leak
    leak, other = case.leak, case.other_event
    bound = _leak_bound(case, alarm)
    judged_bound, max_bound = _bound_and_limit(case, bound)
    verdict: Verdict = NO_LEAK if math.isfinite(judged_bound) and judged_bound <= max_bound else CANNOT_TELL
    fields: dict[str, Any] = {"cause": None if other is None else other.cause}
    fields["rarest_chance"], fields["rarest_change"] = case.find_rarest()
    if leak is not None:
        fields |= {
            "bound_lpm": bound * leak.lpm_per_flow if leak.lpm_per_flow is not None and np.isfinite(bound) else None,
            "total_leakage": leak.total(detectable_flow=_findable_step(case)),
            "course": leak.history(onset_s=None),
        }
    evidence = _add_tests(case, Evidence(verdict, reason="", **fields), alarm or next(iter(case.tests), None))
    return replace(evidence, reason=no_leak_text(case, evidence, alarm, bound, other))


def _leak_evidence(case: Case, alarm: LeakTest) -> Evidence:
    """Make the verdict `leak`, detected by the test `alarm`, with cause, onset and, if measured, flow of the leak.

    No onset is stated after an alarm by the limit in the rig's file, or of a leak that seems older than the recording.
    """
    leak = case.leak
    if leak is None:
        fields: dict[str, Any] = {"cause": "piston leak"}  # the only leak that `case._change_tests` tests for
        onset = None if case.tested_observable is None else case.tested_observable.onset
    else:
        if not case.has_onset_within:
            onset = None
        elif alarm.name == WITHIN and leak.step is not None:
            onset = leak.step.onset()
        else:
            onset = leak.rise_onset if alarm.name == AGAINST else None
        fields = {
            "cause": _leak_cause(case, leak, alarm),
            "total_leakage": leak.total(detectable_flow=None),  # no detectable flow is stated beside a leak
            "course": leak.history(None if onset is None else onset.value),
            **_size_fields(leak, case.leak_flow(alarm)),
        }
    if onset is not None:
        fields |= {"onset_s": onset.value, "onset_interval_s": (onset.low, onset.high)}
    evidence = _add_tests(case, Evidence(LEAK, reason="", **fields), alarm)
    return replace(evidence, reason=leak_text(case, evidence, alarm))


def _leak_cause(case: Case, leak: LeakMeasure, alarm: LeakTest) -> Cause:
    """Return the cause of a leak that the test `alarm` detected, such as "piston or pump leak".

    The detector's cause names the parts that its data cannot tell apart. The pump is left out if it was tested by
    itself, and its leak has a probability below `RAREST`. The outside is added if an external leak is possible.
    """
    # this observable needs the pressures at the pump's ports (`terms.PUMP_TERM`), which separate pump and piston
    is_pump_observed = any(observable.name == "pump leak" for observable in case.observables)
    is_pump_excluded = is_pump_observed and probability_of(case.explanations, "pump leak") < RAREST
    cause: Cause = "piston leak" if is_pump_excluded and leak.cause == "piston or pump leak" else leak.cause
    if case.external_probability(alarm) > 1.0 - DECISION.explanation.sure or case.resembles_external(alarm):
        return _WITH_OUTSIDE.get(cause, cause)
    return cause


def _size_fields(leak: LeakMeasure, flow: Estimate | None) -> dict[str, Any]:
    """Compute the fields of `Evidence` on the size of a leak with the mean `flow`; none if it is unknown."""
    if flow is None:
        return {}
    fields: dict[str, Any] = {"relative": leak.relative(flow)}
    if leak.lpm_per_flow is None:
        return {**fields, "refuses": frozenset({"leak_lpm"})}
    # errors of the estimate, and of the displacement or piston area that scales all flows
    half_width = WITHIN_95 * float(np.hypot(flow.deviation, flow.value * leak.size_deviation))
    min_factor, max_factor = leak.flow_factors
    low, high = min_factor * max(flow.value - half_width, 0.0), max_factor * (flow.value + half_width)
    interval = low * leak.lpm_per_flow, high * leak.lpm_per_flow
    # noise may make the estimate negative, but a leak flows towards the lower pressure only
    return {**fields, "leak_lpm": max(flow.value, 0.0) * leak.lpm_per_flow, "leak_interval_lpm": interval}


def _leak_bound(case: Case, alarm: LeakTest | None) -> float:
    """Compute the 95 % upper bound of a leak's mean flow [m^3/s]; infinite if the recording excludes no size of a leak.

    If a leak may have caused the `alarm`, the bound is at least the upper end of this leak's 95 % interval. It is
    infinite without measured leakage, and if it is not below the pump's mean flow, unless that is 0 or unknown.
    """
    leak = case.leak
    if leak is None:
        return np.inf
    bound = leak.bound_flow
    mean_pump_flow, _ = leak.pump_flow  # mean over the whole recording
    if alarm is not None and case.leak_probability(alarm) > 1.0 - DECISION.explanation.sure:
        flow = case.leak_flow(alarm)
        if flow is not None:
            deviation = np.hypot(flow.deviation, flow.value * leak.size_deviation)
            bound = max(bound, flow.value + WITHIN_95 * float(deviation))
    return np.inf if mean_pump_flow > 0.0 and not bound < mean_pump_flow else bound


def _bound_and_limit(case: Case, bound: float) -> tuple[float, float]:
    """Return the 95 % upper bound of a leak, and the largest bound that still allows the verdict `no leak`.

    If leakage is measured, both are flows [m^3/s], the first being the argument `bound`; the second is 0 if the pump's
    flow is 0 or unknown, as no bound > 0 is then small enough. Otherwise both are changes of the logarithm of the
    pressures' ringing (RMS of their wavelet details); the bound is then infinite if the ringing was not measured, if a
    test raised an alarm, or if the sampling rate is too low.
    """
    if case.leak is not None:
        _, delivered_flow = case.leak.pump_flow  # mean over the time in which the pump delivers
        return bound, float(DECISION.worth.share) * delivered_flow if delivered_flow > 0.0 else 0.0
    ringing = case.judge.ringing
    if ringing is None or case.alarms or ringing.rate < RMS_PRIORS.rate.ringing:
        return np.inf, 0.0
    return ringing.bound, RMS_PRIORS.recordings.worth


def _findable_step(case: Case) -> float | None:
    """Compute the mean flow [m^3/s] of the smallest leak that the test for a step would detect with a high probability.

    The result is None if no step is tested.
    """
    test = next((test for test in case.tests if test.name == WITHIN), None)
    if test is None or case.leak is None or case.leak.step is None:
        return None
    chance = case.null.uncalibrated_chance(STEP_KEY.format(case.leak.provider), test.probability)
    return case.leak.step.detectable_step(chance) * case.leak.flow_per_conductance


def _add_tests(case: Case, evidence: Evidence, judging: LeakTest | None) -> Evidence:
    """Add to `evidence` fields of the judging detector's report, and the results of its tests, if it made any.

    Score, threshold and p-value are those of the test `judging`. If there are several tests, `parts` has an entry for
    each.
    """
    judge = case.judge
    evidence = replace(evidence, detector=judge.provider, share=judge.share, judged_until=judge.judged_until)
    if case.leak is not None and case.leak.ratio is not None:
        ratio = case.leak.ratio
        evidence = replace(evidence, ratio=ratio.value, ratio_interval=(ratio.low, ratio.high))
    if judging is None:
        return evidence
    parts = []
    if len(case.tests) > 1:
        for test in case.tests:
            # an alarm without the verdict `leak` has a better explanation
            has_alarm = evidence.verdict == LEAK and test.chance < test.probability
            part = Evidence(LEAK if has_alarm else NO_LEAK, reason=test.name, detector=test.name)
            parts.append(_with_result(part, test))
    return replace(_with_result(evidence, judging), parts=tuple(parts))


def _with_result(evidence: Evidence, test: LeakTest) -> Evidence:
    """Return the evidence with score, threshold and p-value of a test."""
    return replace(evidence, score=test.score, threshold=test.threshold, chance=max(test.chance, RAREST))


#: Detectors that measure the leak, the most accurate first.
ORDER = (VOLUME_BALANCE, PRESSURE_RESPONSE)


def rank(detector: str) -> int:
    """Return the rank of a detector by its name; of the detectors that decide, the lowest rank gives the verdict."""
    if detector == RMS_CHANGE:
        return len(ORDER) + 1
    return ORDER.index(detector) if detector in ORDER else len(ORDER)


def is_decided(evidence: Evidence) -> bool:
    """Return True if a detector could use the recording and states leak, no leak, an alarm or the cause of a change."""
    return evidence.usable and not evidence.abstains


def combine(decisions: Sequence[Evidence], refusal: str | None) -> Evidence:
    """Combine the decisions of several detectors into the decision of the first one, by rank, that decides.

    All decisions become the `parts` of the result. The change of RMS decides only if no detector that measures the leak
    can use the recording. If no detector decides, the verdict is `cannot tell`. This verdict also replaces `no leak` if
    more than the last 5 % of the recording (`worth.unjudged` of `priors.toml`) are not judged, or if there is a
    `refusal`: the reason why a measuring detector failed, or why no baseline recording is comparable.
    """
    ranked = sorted(decisions, key=lambda decision: rank(decision.detector))
    usable = [decision for decision in ranked if decision.usable]
    is_measured = any(decision.detector in ORDER for decision in usable)
    candidates = [decision for decision in usable if not (is_measured and decision.detector == RMS_CHANGE)]
    judge = next((decision for decision in candidates if not decision.abstains), None)
    if judge is None:
        return _explain_undecided(ranked, usable)
    reasons = [judge.reason]
    doubts = []  # reasons not to state `no leak`
    if judge.share < 1.0:
        reasons.append(text_of("doubt", "share", percent=100.0 * judge.share))
    if judge.verdict == NO_LEAK:
        if refusal is not None:
            doubts.append(f"; {refusal}")
        if 1.0 - judge.judged_until > DECISION.worth.unjudged:
            doubts.append(text_of("doubt", "rest"))
    verdict = CANNOT_TELL if doubts else judge.verdict
    other_parts = [decision for decision in ranked if decision is not judge]
    return replace(judge, verdict=verdict, reason="".join([*reasons, *doubts]), parts=(judge, *other_parts))


def _explain_undecided(ranked: Sequence[Evidence], usable: Sequence[Evidence]) -> Evidence:
    """Make the verdict `cannot tell` with a reason, for a recording on which no detector decides.

    The first `usable` detector gives the reason; without one, the last built-in detector by rank, because it needs the
    fewest channels.
    """
    if usable:
        undecided = usable[0]
        balance_reason = next((decision.reason for decision in ranked if decision.detector == VOLUME_BALANCE), "")
        if undecided.detector == RMS_CHANGE and balance_reason:  # no other detector could use the recording
            # the balance may name a missing channel, RMS_CHANGE a higher sampling rate: the channel would help more
            undecided = replace(undecided, reason=f"the {VOLUME_BALANCE} {balance_reason}; {undecided.reason}")
    else:
        built_in = [decision for decision in ranked if decision.detector in (*ORDER, RMS_CHANGE)] or list(ranked)
        undecided = Evidence(CANNOT_TELL, built_in[-1].reason if built_in else "there is no detector")
    return replace(undecided, detector="", parts=tuple(ranked))  # "": no single detector has decided


@cache
def _texts() -> Mapping[str, Mapping[str, str]]:
    """Read the tables of `texts.toml` by name, each a mapping from key to text; the result is cached."""
    return tomllib.loads((files("sealscope.diagnosis.decision") / "texts.toml").read_text("utf-8"))


def text_of(table: str, key: str, **values: Any) -> str:
    """Return the text with a given `key` in a `table` of `texts.toml`, with `values` filled in for its fields."""
    return _texts()[table][key].format(**values)


def no_leak_text(case: Case, evidence: Evidence, alarm: LeakTest | None, bound: float, other: OtherEvent | None) -> str:
    """Compose the reason why no leak is stated.

    The text states the 95 % upper `bound` of an undetected leak [m^3/s], or of a change of the ringing. The cause of a
    change follows: the event `other` or else, after an `alarm`, the most probable of the causes that are weighed.
    """
    text = _bound_text(case, evidence, bound)
    if other is not None:
        name = other.observable.name
        count = float(f"{1.0 / max(other.chance, 1e-4):.2g}")  # rounded to two digits, up to 10 000
        text += text_of(
            "doubt",
            "event",
            words=other.description,
            onset=_onset_text(other.observable),
            # the description may contain the name of the observable already
            shown="" if name in other.description else text_of("doubt", "shown", name=name),
            sure=100.0 * other.probability,
            rarity=text_of("doubt", "rarity", count=f"{count:,.0f}".replace(",", " ")),
        )
    elif alarm is not None and case.weigh_rivals:
        text += _rivals_text(case, alarm)
    return text


def leak_text(case: Case, evidence: Evidence, alarm: LeakTest) -> str:
    """Describe in words a leak that the test `alarm` detected, or without measured leakage the change that it makes."""
    if case.leak is None:
        if case.tested_observable is not None and case.tested_observable.data == "plug-in":
            return text_of("alarm", "plug_in", provider=case.judge.provider)
        return text_of("alarm", "details", **_change_values(case))
    key = {WITHIN: "within", AGAINST: "against"}.get(alarm.name, "level")
    if key == "within" and not case.has_onset_within:
        key = "older"
    total = evidence.total_leakage
    if key == "level" and total is not None and total.lpm is not None and total.healthy_lpm is not None:
        return text_of("alarm", "level_flow", lpm=total.lpm, healthy=total.healthy_lpm)
    if key in ("within", "against") and case.leak.provider == PRESSURE_RESPONSE:
        key = f"conductance_{key}"
    text = text_of("alarm", key)
    return f"{text}; {text_of('alarm', 'no_size')}" if "leak_lpm" in evidence.refuses else text


def _bound_text(case: Case, evidence: Evidence, bound: float) -> str:
    """State in words the largest leak that may have remained undetected.

    `bound` is the upper bound of the mean flow [m^3/s], infinite if unknown. With the verdict `cannot tell`, the text
    also says how to record better. If leakage is not measured, it describes the pressures' ringing: its change if there
    is an alarm, else the limit of an undetected fall.
    """
    leak, ringing = case.leak, case.judge.ringing
    if leak is None:
        if case.alarms and ringing is not None:
            leak_percent = 100.0 * case.leak_probability(case.alarms[0])
            return text_of("bound", "ringing_changed", leak=leak_percent, **_change_values(case))
        return _ringing_text(evidence, ringing, case.judge.provider)
    mean_pump_flow, _ = leak.pump_flow
    # a comparison with healthy recordings bounds the mean flow over the recording, and not that since an onset
    average = text_of("bound", "average") if leak.rise is not None else ""
    if evidence.bound_lpm is not None:
        limit = text_of("bound", "flow", value=evidence.bound_lpm, average=average)
    elif mean_pump_flow > 0.0 and np.isfinite(bound):
        limit = text_of("bound", "share", value=100.0 * bound / mean_pump_flow, average=average)
    else:
        limit = text_of("bound", "any")
    if evidence.verdict == NO_LEAK:
        return text_of("bound", "none", limit=limit)
    advice = text_of("doubt", "position" if leak.provider == PRESSURE_RESPONSE else "longer")
    return text_of("bound", "hidden", limit=limit) + advice


def _ringing_text(evidence: Evidence, ringing: Ringing | None, provider: str) -> str:
    """State in words the 95 % upper limit [%] of an undetected fall of the ringing (RMS of the pressures' details).

    If the sampling rate is too low, the text begins with the names of unused columns or, if there are none, with the
    rate. If the ringing was not measured (None), the text is that the detector `provider` sees no change.
    """
    if ringing is None:
        return text_of("bound", "unseen", provider=provider)
    percent = -100.0 * np.expm1(-ringing.bound)  # for a fall of the logarithm of the RMS by `bound`
    key = "ringing_hidden" if evidence.verdict == CANNOT_TELL else "ringing"
    text = text_of("bound", key, percent=percent, where=_against_text(ringing))
    min_rate = RMS_PRIORS.rate.ringing  # at which the ringing can be judged [Hz]
    if ringing.rate < min_rate:
        # unused columns are named first: mapping them helps more than a higher rate
        names = {"names": join_names(ringing.unused, most=4)}
        key, values = ("unused", names) if ringing.unused else ("slow", {"fast": min_rate})
        text = f"{text_of('bound', key, rate=ringing.rate, **values)}; {text}"
    # without healthy recordings the ringing is compared with that at the start of the recording
    return text if ringing.healthy else text + text_of("bound", "start")


def _change_values(case: Case) -> dict[str, Any]:
    """Compute the values for a text on the change of the ringing that raised an alarm."""
    rarest = case.tested_observable
    assert rarest is not None
    percent = 100.0 * abs(np.expm1(rarest.size))  # `size`: change of the logarithm of the RMS
    where = _onset_text(rarest) or _against_text(case.judge.ringing)
    return {"what": rarest.name, "percent": percent, "where": where}


def _against_text(ringing: Ringing | None) -> str:
    """State the number of healthy recordings with which the ringing was compared; "" if there was no comparison."""
    if ringing is None or not ringing.healthy:
        return ""
    text = text_of("bound", "against", count=ringing.healthy)
    return text if ringing.is_dated else text + text_of("bound", "session")


def _rivals_text(case: Case, alarm: LeakTest) -> str:
    """Describe the most probable explanation of an `alarm` other than a leak, and the way to tell it from a leak.

    The stated probability is that of all explanations without a leak. Of several events, only the first one in
    `events.toml` is described; of an event without a cause only its time, if known.
    """
    leak_probability = case.leak_probability(alarm)
    best = next((explanation for explanation in case.explanations if not explanation.has(LEAK_EVENTS)), None)
    if best is None:
        return ""
    event = best.events[0]
    if event.cause is None:  # mostly a change of the operating point, not a fault
        onset = None if case.leak is None or case.leak.step is None else case.leak.step.onset()
        return "" if onset is None else text_of("doubt", "regime", seconds=onset.value)
    clearest = max(
        (observable for observable in case.observables if event.changes(observable)),
        key=lambda observable: observable.score,
        default=None,
    )
    onset_text = "" if clearest is None else _onset_text(clearest)
    separation = find_separation(event.cause) or text_of("separates", "default")
    return text_of(
        "doubt",
        "rivals",
        words=event.description,
        onset=onset_text,
        share=100.0 * (1.0 - leak_probability),
        leak=100.0 * leak_probability,
        separates=separation,
    )


def _onset_text(observable: Observable) -> str:
    """State the time [s] at which the change of an observable began; "" for an observable without an onset."""
    return "" if observable.onset is None else text_of("doubt", "onset", seconds=observable.onset.value)
