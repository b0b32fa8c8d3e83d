"""Which detector's decision stands: the first that measures the leak and can tell.

Letting any of several raise the alarm would make the false-alarm probability the sum of theirs. So one judges: the
first of `ORDER` that decides, then a user's own detectors, last the change of RMS, which states no size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sealscope.diagnosis.decision.case import DecisionContext
from sealscope.diagnosis.decision.texts import text_of
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK, RMS_CHANGE, Evidence

#: Detectors that measure the leak: by every litre, then by a model of the pressures.
ORDER = ("volume balance", "pressure response")
#: Share of a recording that must be whole for `no leak`.
WHOLE = 0.95


def rank(detector: str) -> int:
    """Return when a detector is asked, 0 first; a user's own are all alike, and the least specific is the last."""
    if detector == RMS_CHANGE:
        return len(ORDER) + 1
    return ORDER.index(detector) if detector in ORDER else len(ORDER)


def is_decided(evidence: Evidence) -> bool:
    """Test whether evidence stands: a verdict, or an unexplained change."""
    return evidence.usable and not evidence.abstains


def combine(decisions: Sequence[Evidence], context: DecisionContext) -> Evidence:
    """Choose the decision that stands, with all decisions as its `parts`.

    A recording that cannot be compared with the healthy ones it was given, or of which a part is missing, is not
    without a leak.
    """
    ranked = sorted(decisions, key=lambda decision: rank(decision.detector))
    usable = [decision for decision in ranked if decision.usable]
    measuring = any(decision.detector in ORDER for decision in usable)
    candidates = [decision for decision in usable if not (measuring and decision.detector == RMS_CHANGE)]
    judge = next((decision for decision in candidates if not decision.abstains), None)
    if judge is None:
        return _undecided(ranked, usable)
    reasons, doubts = [judge.reason], []
    if judge.share < 1.0:
        reasons.append(text_of("doubt", "share", percent=100.0 * judge.share))
    if judge.verdict == NO_LEAK:
        if context.refusal is not None:
            doubts.append(f"; {context.refusal}")
        if judge.share < WHOLE:
            doubts.append(text_of("doubt", "rest"))
    verdict = CANNOT_TELL if doubts else judge.verdict
    other_parts = [decision for decision in ranked if decision is not judge]
    decision_made = replace(judge, verdict=verdict, reason="".join([*reasons, *doubts]), parts=(judge, *other_parts))
    return decision_made if verdict == LEAK else replace(decision_made, onset_s=None, onset_interval_s=None)


def _undecided(ranked: Sequence[Evidence], usable: Sequence[Evidence]) -> Evidence:
    """State why no detector has a verdict: by the first usable one, else by the one that needs least."""
    if usable:
        decision_made = usable[0]
    else:
        built_in = [decision for decision in ranked if decision.detector in (*ORDER, RMS_CHANGE)] or list(ranked)
        decision_made = Evidence(CANNOT_TELL, built_in[-1].reason if built_in else "there is no detector")
    return replace(decision_made, detector="", parts=tuple(ranked), usable=True)
