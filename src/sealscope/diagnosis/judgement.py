"""One verdict from the evidence of many detectors: that of the first which accounts for what it says.

Letting any of several raise the alarm would make the false-alarm probability the sum of theirs. So one judges: the
first of `ORDER` with a verdict, then a user's own detectors. The change of RMS states no size, and a bound of the
ringing alone; it judges only where no other detector can be used, and a leak only where nothing else stepped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sealscope.diagnosis.inference.other_steps.step import OtherStep
from sealscope.diagnosis.verdict.evidence import LEAKS, RMS_CHANGE, Evidence

#: Detectors that state a size or a bound: by every litre, then by a model of the pressures.
ORDER = ("volume balance", "pressure response")


def rank(detector: str) -> int:
    """Return when a detector is asked, 0 first; a user's own are all alike, and the least specific is the last."""
    if detector == RMS_CHANGE:
        return len(ORDER) + 1
    return ORDER.index(detector) if detector in ORDER else len(ORDER)


def deciding(evidences: Sequence[Evidence]) -> Evidence | None:
    """Return the evidence that judges, of those asked so far; None where another detector is to be asked."""
    usable = [own for own in sorted(evidences, key=lambda own: rank(own.detector)) if own.usable]
    able = [own for own in usable if own.detector != RMS_CHANGE]
    return next((own for own in able or usable if not own.abstains), None)


def combined(evidences: Sequence[Evidence], other: OtherStep | None = None, refusal: str | None = None) -> Evidence:
    """Return the verdict on a recording, from the evidence of every detector that was asked.

    `other`: what else than a leak stepped, by what a leak does not move; `refusal`: why the recording cannot be
    compared with the baseline that was given: then only a leak is stated.
    """
    ranked = sorted(evidences, key=lambda own: rank(own.detector))
    judge = deciding(ranked)
    if judge is None:
        return replace(_nobody(ranked), detector="", parts=tuple(ranked), usable=True)
    verdict, cause, reasons = judge.verdict, judge.cause, [judge.reason]
    by_change = judge.detector == RMS_CHANGE and judge.onset_s is not None
    if other is not None and (by_change or (verdict != "leak" and cause is None)):
        verdict, cause = "cannot tell" if verdict == "leak" else verdict, other.cause
        reasons.append(other.text)
    if judge.share < 1.0:
        reasons.append(f"this rests on {100.0 * judge.share:.3g} % of the recording")
    if verdict == "no leak":
        hidden = "and the rest may hide a leak (95% are needed)" if judge.share < 0.95 else None
        doubts = [doubt for doubt in (refusal, hidden) if doubt is not None]
        reasons += doubts
        verdict = "cannot tell" if doubts else verdict
    others = [own for own in ranked if own is not judge]
    reasons += [text for own in others if own.usable and (text := _difference(judge, own)) is not None]
    stated = replace(judge, verdict=verdict, cause=cause, reason="; ".join(reasons), parts=(judge, *others))
    return stated if verdict == "leak" else replace(stated, onset_s=None, onset_interval_s=None)


def _difference(judge: Evidence, other: Evidence) -> str | None:
    """Return in what another detector's verdict differs from the judge's, in words; None where it does not."""
    if other.verdict in ("cannot tell", judge.verdict) or judge.verdict == "cannot tell":
        return None
    figures = ""
    if other.score is not None and other.threshold is not None:
        figures = f" (score {other.score:.3g}, threshold {other.threshold:.3g})"
    if judge.verdict == "leak":
        named = "no leak" if other.cause is None or other.cause in LEAKS else other.cause
        return f"{other.detector}: {named}{figures}"
    return f"{other.detector}: a change like a leak's{figures}"


def _nobody(ranked: Sequence[Evidence]) -> Evidence:
    """Return why no detector has a verdict: by the first that could be used, else by the one that needs least."""
    usable = [own for own in ranked if own.usable]
    if usable:
        return usable[0]
    built_in = [own for own in ranked if own.detector in (*ORDER, RMS_CHANGE)] or ranked
    return Evidence("cannot tell", built_in[-1].reason if built_in else "there is no detector")
