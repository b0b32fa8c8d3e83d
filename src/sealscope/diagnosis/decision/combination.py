"""Choice of one decision among those of several detectors.

If each of several detectors could raise the alarm, their false-alarm probabilities would add up. Therefore only the
first detector that decides is used. Detectors of `ORDER` come first, then a user's own detectors, and last the change
of RMS, which states no size of a leak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sealscope.diagnosis.decision.reasons import text_of
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.evidence import (
    CANNOT_TELL,
    NO_LEAK,
    PRESSURE_RESPONSE,
    RMS_CHANGE,
    VOLUME_BALANCE,
    Evidence,
)

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
