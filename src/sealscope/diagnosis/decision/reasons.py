"""The reason of a verdict as one line of text, composed from the texts of `texts.toml`."""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.decision.case import Case, LeakTest, OtherEvent
from sealscope.diagnosis.decision.explanations import LEAK_EVENTS
from sealscope.diagnosis.decision.texts import text_of
from sealscope.diagnosis.inference.observable import Observable, Ringing
from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.diagnosis.verdict.evidence import (
    AGAINST,
    CANNOT_TELL,
    LEAK,
    NO_LEAK,
    PRESSURE_RESPONSE,
    WITHIN,
    Evidence,
)
from sealscope.diagnosis.verdict.states import find_separation
from sealscope.paragraphs import join_names

#: Minimum sampling rate at which the ringing can be judged [Hz].
_MIN_RINGING_RATE: float = RMS_PRIORS.rate.ringing


def reason_of(case: Case, evidence: Evidence, alarm: LeakTest | None, bound: float, other: OtherEvent | None) -> str:
    """Compose the reason of a verdict in words: the leak or its bound, then another explanation, then remarks.

    `alarm`: test that raised the alarm, None if none did; `bound`: 95 % upper bound of the leak's flow [m^3/s];
    `other`: event other than a leak that explains what changed, or None.
    """
    if evidence.verdict == LEAK:
        return _leak_text(case, evidence, alarm) + _remarks(case)
    text = _bound_text(case, evidence, bound)
    if other is not None:
        text += text_of(
            "doubt",
            "event",
            words=other.description,
            onset=_onset_text(other.observable),
            shown=_observable_text(other),
            sure=100.0 * other.probability,
            rarity=_rarity_text(other.chance),
        )
    elif alarm is not None and case.weigh_rivals:
        text += _rivals_text(case, alarm)
    return text + _remarks(case)


def _leak_text(case: Case, evidence: Evidence, alarm: LeakTest | None) -> str:
    """Describe the detected leak in words; `alarm`: test that detected it."""
    key = {WITHIN: "within", AGAINST: "against"}.get(alarm.name if alarm else "", "level")
    total = evidence.total_leakage
    if case.leak is None:
        rarest = case.rarest_observable
        if rarest.data == "plug-in":
            return text_of("leak", "plug_in", provider=case.judge.provider)
        percent = 100.0 * abs(np.expm1(rarest.size))
        where = _onset_text(rarest) or _against_text(case.judge.ringing)
        return text_of("leak", "details", what=f"RMS: {rarest.name}", percent=percent, where=where)
    if key == "level" and total is not None and total.lpm is not None and total.healthy_lpm is not None:
        return text_of("leak", "level_flow", lpm=total.lpm, healthy=total.healthy_lpm)
    if key != "level" and case.leak.provider == PRESSURE_RESPONSE:
        key = f"conductance_{key}"
    text = text_of("leak", key)
    return f"{text}; {text_of('leak', 'no_size')}" if "leak_lpm" in evidence.refuses else text


def _bound_text(case: Case, evidence: Evidence, bound: float) -> str:
    """Describe in words how large an undetected leak can be, and a recording that would bound it more closely.

    `bound`: 95 % upper bound of its flow [m^3/s].
    """
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
    closer = "position" if leak.provider == PRESSURE_RESPONSE else "longer"
    return text_of("bound", "hidden", limit=limit) + text_of("doubt", closer)


def _ringing_text(evidence: Evidence, ringing: Ringing | None, provider: str) -> str:
    """State in words the 95 % upper limit [%] of a fall of the pressures' ringing that the detector has not seen.

    The ringing is an oscillation of the pressures, measured by the RMS of their wavelet details. The limit is of the
    fall of this RMS, relative to healthy recordings or, without these, to the start of the same recording. If the
    verdict is `cannot tell`, the text says that a fall by this limit would not show, otherwise that there is no larger
    fall. If the sampling rate is too low for the ringing, it also says so, or names the columns that are not assigned
    to a channel. `ringing`: facts on the comparison (`Ringing`), None if the ringing was not measured; `provider`: name
    of the detector.
    """
    if ringing is None:
        return text_of("bound", "unseen", provider=provider)
    percent = -100.0 * np.expm1(-ringing.bound)
    key = "ringing_hidden" if evidence.verdict == CANNOT_TELL else "ringing"
    text = text_of("bound", key, percent=percent, where=_against_text(ringing))
    if ringing.rate < _MIN_RINGING_RATE:
        # unused columns are named first: mapping them helps more than a higher rate
        names = {"names": join_names(ringing.unused, 4)}
        key, values = ("unused", names) if ringing.unused else ("slow", {"fast": _MIN_RINGING_RATE})
        text = f"{text_of('bound', key, rate=ringing.rate, **values)}; {text}"
    # without healthy recordings the ringing is compared with that at the start of the recording
    return text if ringing.healthy else text + text_of("bound", "start")


def _changed_ringing_text(case: Case, ringing: Ringing) -> str:
    """Describe in words the rarest change of the pressures' ringing, and the probability that a leak caused it.

    The ringing is an oscillation of the pressures, measured by the RMS of their wavelet details. The text names the
    detail, its change [%], and the onset of the change. If it has no onset, the healthy recordings are named with which
    the ringing was compared; `ringing` states their number, 0 for none.
    """
    rarest = case.rarest_observable
    percent = 100.0 * abs(np.expm1(rarest.size))
    where = _onset_text(rarest) or _against_text(ringing)
    leak = 100.0 * case.leak_probability(case.alarms[0])
    return text_of("bound", "ringing_changed", what=rarest.name, percent=percent, where=where, leak=leak)


def _against_text(ringing: Ringing | None) -> str:
    """State in words how many healthy recordings the pressures' oscillation (ringing) was compared with.

    "" if there are none, or if the ringing was not measured (`ringing` is None).
    """
    if ringing is None or not ringing.healthy:
        return ""
    text = text_of("bound", "against", count=ringing.healthy)
    return text if ringing.is_dated else text + text_of("bound", "session")


def _rivals_text(case: Case, alarm: LeakTest) -> str:
    """Describe the most probable explanation other than a leak, and how to tell it from a leak.

    `alarm`: test that raised the alarm. If the explanation is a change of the operating point, only its time is
    stated. The text is "" if there is no such explanation, or if that time is unknown.
    """
    leak_probability = case.leak_probability(alarm)
    best = next((explanation for explanation in case.explanations if not explanation.has(*LEAK_EVENTS)), None)
    if best is None:
        return ""
    event = best.events[0]
    if event.cause is None:  # a change of the operating point, not a fault: no cause to name
        onset = None if case.leak is None or case.leak.step is None else case.leak.step.onset()
        return "" if onset is None else text_of("doubt", "regime", seconds=onset.value)
    clearest = max(
        (observable for observable in case.observables if event.affects(observable)),
        key=lambda observable: observable.score,
        default=None,
    )
    separates = find_separation(event.cause) or text_of("separates", "default")
    onset_text = "" if clearest is None else _onset_text(clearest)
    return text_of(
        "doubt",
        "rivals",
        words=event.description,
        onset=onset_text,
        share=100.0 * (1.0 - leak_probability),
        leak=100.0 * leak_probability,
        separates=separates,
    )


def _onset_text(observable: Observable) -> str:
    """State the onset of an observable's change in words; "" if it has none."""
    return "" if observable.onset is None else text_of("doubt", "onset", seconds=observable.onset.value)


def _observable_text(other: OtherEvent) -> str:
    """Name the observable that shows an event; "" if the event's description already contains its name."""
    name = other.observable.name
    return "" if name in other.description else text_of("doubt", "shown", name=name)


def _rarity_text(chance: float) -> str:
    """State the p-value `chance` of a change in words, as 1 in so many healthy recordings, at most 10 000."""
    count = f"{float(f'{1.0 / max(chance, 1e-4):.2g}'):,.0f}".replace(",", " ")
    return text_of("doubt", "rarity", count=count)


def _remarks(case: Case) -> str:
    """Return the texts of all remarks on the measured leakage, joined; "" if there are none."""
    leak = case.leak
    return "" if leak is None else "".join(text_of("remark", remark.key, **remark.values) for remark in leak.remarks)
