"""The reason of a verdict as one line of text, composed from the texts of `texts.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from sealscope.diagnosis.decision.case import Case, LeakTest, OtherEvent
from sealscope.diagnosis.decision.explanations import LEAK_EVENTS
from sealscope.diagnosis.inference.observable import Observable, Ringing
from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.diagnosis.verdict.evidence import (
    AGAINST,
    CANNOT_TELL,
    NO_LEAK,
    PRESSURE_RESPONSE,
    WITHIN,
    Evidence,
)
from sealscope.diagnosis.verdict.severity import find_separation
from sealscope.paragraphs import join_names


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
    best = next((explanation for explanation in case.explanations if not explanation.has(*LEAK_EVENTS)), None)
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
