"""The reason of a verdict, in one line: keys and values of `decide`, filled in from `texts.toml`."""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.decision.case import Case, OtherEvent, Question
from sealscope.diagnosis.decision.explanations import LEAK_EVENTS
from sealscope.diagnosis.decision.texts import has_text, text_of
from sealscope.diagnosis.inference.observable import Observable, Ringing
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK, Evidence
from sealscope.recordings.formats.columns import listed


def reason_of(case: Case, evidence: Evidence, alarm: Question | None, bound: float, other: OtherEvent | None) -> str:
    """Return the reason of a verdict."""
    if evidence.verdict == LEAK:
        return _leak_text(case, evidence, alarm) + _remarks(case)
    text = _bound_text(case, evidence, bound)
    if other is not None:
        text += text_of(
            "doubt",
            "event",
            words=other.words,
            onset=_onset_text(other.observable),
            shown=_shown_text(other),
            sure=100.0 * other.probability,
            rarity=_rarity_text(other.chance),
        )
    elif alarm is not None and case.context.is_weighed:
        text += _rivals_text(case, alarm)
    return text + _remarks(case)


def _leak_text(case: Case, evidence: Evidence, alarm: Question | None) -> str:
    key = {"within the recording": "within", "against the baseline": "against"}.get(
        alarm.name if alarm else "", "level"
    )
    total = evidence.total_leakage
    if case.leak is None:
        rarest = min(case.judge.observables, key=lambda observable: observable.chance)
        if rarest.data == "plug-in":
            return text_of("leak", "plug_in", provider=case.judge.provider)
        percent = 100.0 * abs(np.expm1(rarest.size))
        where = _onset_text(rarest) or _against_text(case.judge.ringing)
        return text_of("leak", "details", what=f"RMS: {rarest.name}", percent=percent, where=where)
    if key == "level" and total is not None and total.lpm is not None and total.healthy_lpm is not None:
        return text_of("leak", "level_flow", lpm=total.lpm, healthy=total.healthy_lpm)
    if key != "level" and case.leak.provider == "pressure response":
        key = f"conductance_{key}"
    text = text_of("leak", key)
    return f"{text}; {text_of('leak', 'no_size')}" if "leak_lpm" in evidence.refuses else text


def _bound_text(case: Case, evidence: Evidence, bound: float) -> str:
    """Describe the bound in words, and the way to a closer one."""
    leak, ringing = case.leak, case.judge.ringing
    if leak is None:
        if case.alarms and ringing is not None:
            return _changed_ringing_text(case, ringing)
        return _ringing_text(evidence, ringing, case.judge.provider)
    average = text_of("bound", "average") if leak.rise is not None else ""
    limit, pump = text_of("bound", "any"), leak.pump_flow[0]
    if evidence.bound_lpm is not None:
        limit = text_of("bound", "flow", value=evidence.bound_lpm, average=average)
    elif pump > 0.0 and np.isfinite(bound):
        limit = text_of("bound", "share", value=100.0 * bound / pump, average=average)
    if evidence.verdict == NO_LEAK:
        return text_of("bound", "none", limit=limit)
    closer = "position" if leak.provider == "pressure response" else "longer"
    return text_of("bound", "hidden", limit=limit) + text_of("doubt", closer)


def _ringing_text(evidence: Evidence, ringing: Ringing | None, provider: str) -> str:
    if ringing is None:
        return text_of("bound", "unseen", provider=provider)
    fast: float = priors("rms_change")["rate"]["ringing"]
    percent = -100.0 * np.expm1(-ringing.bound)
    key = "ringing_hidden" if evidence.verdict == CANNOT_TELL else "ringing"
    text = text_of("bound", key, percent=percent, where=_against_text(ringing))
    if ringing.rate < fast:
        # a column that nobody mapped hides more than a slow clock does
        key, values = ("unused", {"names": listed(ringing.unused, 4)}) if ringing.unused else ("slow", {"fast": fast})
        text = f"{text_of('bound', key, rate=ringing.rate, **values)}; {text}"
    return text if ringing.healthy else text + text_of("bound", "start")


def _changed_ringing_text(case: Case, ringing: Ringing) -> str:
    """Describe the change of the ringing, and the probability of a leak behind it."""
    rarest = min(case.judge.observables, key=lambda observable: observable.chance)
    percent = 100.0 * abs(np.expm1(rarest.size))
    where = _onset_text(rarest) or _against_text(ringing)
    leak = 100.0 * case.leak_probability(case.alarms[0])
    return text_of("bound", "ringing_changed", what=rarest.name, percent=percent, where=where, leak=leak)


def _against_text(ringing: Ringing | None) -> str:
    if ringing is None or not ringing.healthy:
        return ""
    text = text_of("bound", "against", count=ringing.healthy)
    return text if ringing.is_dated else text + text_of("bound", "session")


def _rivals_text(case: Case, alarm: Question) -> str:
    """Name the explanation that competes with a leak, and the recording that would separate them."""
    leak = case.leak_probability(alarm)
    best = next((explanation for explanation in case.explanations if not explanation.has(*LEAK_EVENTS)), None)
    if best is None:
        return ""
    event = best.events[0]
    if event.cause is None:
        onset = None if case.leak is None or case.leak.step is None else case.leak.step.onset()
        return "" if onset is None else text_of("doubt", "regime", seconds=onset.value)
    highest = max(
        (observable for observable in case.observables if event.does_move(observable)),
        key=lambda observable: observable.score,
        default=None,
    )
    separates = text_of("separates", event.cause if has_text("separates", event.cause) else "default")
    onset_text = "" if highest is None else _onset_text(highest)
    share = 100.0 * (1.0 - leak)
    return text_of(
        "doubt", "rivals", words=event.words, onset=onset_text, share=share, leak=100.0 * leak, separates=separates
    )


def _onset_text(observable: Observable) -> str:
    return "" if observable.onset is None else text_of("doubt", "onset", seconds=observable.onset.value)


def _shown_text(other: OtherEvent) -> str:
    """Name the observable of an event, unless its words do."""
    name = other.observable.name
    return "" if name in other.words else text_of("doubt", "shown", name=name)


def _rarity_text(chance: float) -> str:
    count = f"{float(f'{1.0 / max(chance, 1e-4):.2g}'):,.0f}".replace(",", " ")
    return text_of("doubt", "rarity", count=count)


def _remarks(case: Case) -> str:
    leak = case.leak
    return "" if leak is None else "".join(text_of("remark", remark.key, **remark.values) for remark in leak.remarks)
