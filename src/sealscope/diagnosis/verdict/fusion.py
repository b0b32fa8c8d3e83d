"""Fusion: one verdict from the evidence of many detectors, at the false-alarm probability of the one that judges.

The judge is the most specific detector that has a verdict: letting any of several raise the alarm would make the
false-alarm probability the sum of theirs. `docs/decisions/0011-detectors.md` gives the reasons, and the probability
where a detector abstains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sealscope.diagnosis.verdict.evidence import LEAK_WORTH_FINDING, LEAKS, LEAST_SPECIFIC, Evidence, Figure

#: The most specific first: what accounts for every litre, what models the pressures, what
#: estimates a state, what sees that something changed. A user's own detectors follow in the order of their names.
ORDER = ("volume balance", "pressure model", "observer", LEAST_SPECIFIC)
#: How many times its threshold a change within a recording must be for the least specific detector to call it a leak
#: where the machine wanders more than a healthy one may. Of 38 sound loops whose friction sticks (development) the
#: largest change was 1.42 times it; 5 of 14 leaks of 0.0042 and 0.05 L/min were at 2.4 to 5.
_UNRULY = 2.0


def fuse(evidences: Sequence[Evidence]) -> Evidence:
    """Return one verdict from the evidence of all detectors.

    The first of `ORDER` that does not abstain judges. Of a leak, onset and L/min are the judge's, else those of the
    next detector that found a leak, too, and has them, unless a detector refuses the figure; the cause is the judge's,
    else the one that another detector names. Where others differ, the reason says so. `no leak` of the least specific
    detector, which states no size, becomes `cannot tell` where another one says that a leak worth finding would not
    have shown, or that something changed which it cannot name; its `leak` becomes so where another one says that the
    machine wanders more than a healthy one may and the change is small. `detector` of the result is the judge, `parts`
    are the evidences, the judge's first.
    """
    ranked = sorted(evidences, key=lambda own: rank(own.detector))
    usable = [own for own in ranked if own.usable]
    judge = next((own for own in usable if judges(own)), None)
    if judge is None:
        return replace(_no_judge(ranked, usable), detector="", parts=tuple(ranked), usable=True)
    others = [own for own in usable if own is not judge]
    if judge.detector == ORDER[0]:
        return _beside_the_balance(judge, ranked, others)
    first, judge = judge, _doubted(judge, others)
    fused, reasons = judge, [judge.reason]
    if judge.verdict == "leak":
        refused = frozenset[Figure]().union(*(own.refuses for own in usable))
        fused, lent = _with_estimates(judge, [own for own in others if own.verdict == "leak"], refused)
        fused = replace(fused, refuses=frozenset(name for name in refused if getattr(fused, name) is None))
        reasons += lent
    else:
        fused = replace(judge, onset_s=None, onset_interval_s=None)
        doubt = next((own for own in others if _doubts(own, judge)), None)
        if judge.verdict == "no leak" and doubt is not None:
            fused = replace(fused, verdict="cannot tell", cause=judge.cause)
            reasons.append(f"{doubt.detector}: {doubt.reason}")
        naming = next((own for own in others if _other_cause(own)), None)
        if judge.cause is None and naming is not None:
            fused = replace(fused, cause=naming.cause)
    reasons += [text for own in others if (text := _difference(judge, own)) is not None]
    return replace(
        fused, reason="; ".join(reasons), parts=(first, *(own for own in ranked if own is not first)), usable=True
    )


def _beside_the_balance(judge: Evidence, ranked: Sequence[Evidence], others: Sequence[Evidence]) -> Evidence:
    """Return the balance's evidence: nothing changes its verdict or its figures; others name what it cannot see."""
    naming = next((own for own in others if _other_cause(own)), None)
    cause = naming.cause if judge.cause is None and judge.verdict != "leak" and naming is not None else judge.cause
    reasons = [judge.reason, *(text for own in others if (text := _difference(judge, own)) is not None)]
    parts = (judge, *(own for own in ranked if own is not judge))
    judge = judge if judge.verdict == "leak" else replace(judge, onset_s=None, onset_interval_s=None)
    return replace(judge, cause=cause, reason="; ".join(reasons), parts=parts)


def rank(detector: str) -> int:
    """Return how specific a detector is, 0 the most; a user's own are all alike."""
    return ORDER.index(detector) if detector in ORDER else len(ORDER)


def judges(evidence: Evidence) -> bool:
    """Return whether evidence is a verdict, which less specific detectors cannot change."""
    return evidence.usable and not evidence.abstains


def _doubts(evidence: Evidence, judge: Evidence) -> bool:
    """Whether a detector that abstains saw a change without a name, or would not have seen a leak worth finding.

    The most specific doubts any judge by what it saw, the others the least specific one.
    """
    if not evidence.abstains or (judge.detector != LEAST_SPECIFIC and evidence.detector != ORDER[0]):
        return False
    saw = any(part.verdict == "cannot tell" and part.alarmed for part in evidence.parts)
    unseen = evidence.passage is not None and (evidence.passage.findable_share or 0.0) > LEAK_WORTH_FINDING
    return saw or (unseen and judge.detector == LEAST_SPECIFIC)


def _doubted(judge: Evidence, others: Sequence[Evidence]) -> Evidence:
    """Return the judge's evidence, a leak as `cannot tell` where it may be the wandering of an unruly machine."""
    if judge.detector != LEAST_SPECIFIC or judge.verdict != "leak" or judge.onset_s is None:
        return judge
    unruly = next((own for own in others if own.unruly), None)
    if unruly is None or judge.score is None or judge.threshold is None or judge.score >= _UNRULY * judge.threshold:
        return judge
    reason = f"{judge.reason}; less than {_UNRULY:g} times it may come without a leak where {unruly.reason}"
    return replace(judge, verdict="cannot tell", reason=reason)


def _other_cause(evidence: Evidence) -> bool:
    return evidence.cause is not None and evidence.cause not in LEAKS


def _with_estimates(
    judge: Evidence, agreeing: Sequence[Evidence], refused: frozenset[Figure]
) -> tuple[Evidence, list[str]]:
    """Return a leak's evidence with the onset and the flow that it lacks, and words that say whose they are."""
    fused, lent = judge, []
    timed = next((own for own in agreeing if own.onset_s is not None), None)
    if judge.onset_s is None and timed is not None and "onset_s" not in refused:
        fused = replace(fused, onset_s=timed.onset_s, onset_interval_s=timed.onset_interval_s)
        lent.append(f"onset from {timed.detector}")
    sized = next((own for own in agreeing if own.leak_lpm is not None), None)
    if judge.leak_lpm is None and sized is not None and "leak_lpm" not in refused:
        fused = replace(
            fused,
            leak_lpm=sized.leak_lpm,
            leak_interval_lpm=sized.leak_interval_lpm,
            course=sized.course if judge.course is None else judge.course,
        )
        lent.append(f"L/min from {sized.detector}")
    return fused, lent


def _difference(judge: Evidence, other: Evidence) -> str | None:
    """Return in what another detector differs from the judge, in words; None where it does not."""
    figures = ""
    if other.score is not None and other.threshold is not None:
        figures = f" (score {other.score:.3g}, threshold {other.threshold:.3g})"
    if _other_cause(other) and other.cause != judge.cause:
        return f"{other.detector} takes the change for {other.cause}{figures}"
    if other.verdict in ("cannot tell", judge.verdict):
        return None
    if judge.verdict == "leak":
        return f"{other.detector} sees no leak{figures}"
    if other.verdict == "leak":
        return f"{other.detector} sees a change like a leak's{figures}"
    return None  # the judge cannot tell, the other sees nothing


def _no_judge(ranked: Sequence[Evidence], usable: Sequence[Evidence]) -> Evidence:
    """Return why no detector has a verdict: by those that were usable, else by the one that needs least."""
    if not usable:
        if not ranked:
            return Evidence("cannot tell", "there is no detector")
        built_in = [own for own in ranked if own.detector in ORDER] or ranked
        return Evidence("cannot tell", built_in[-1].reason)
    if len(usable) == 1:
        return usable[0]
    scored = next((own for own in usable if own.score is not None), None)
    alike = all(own.reason == usable[0].reason for own in usable)
    return Evidence(
        "cannot tell",
        usable[0].reason if alike else "; ".join(f"{own.detector}: {own.reason}" for own in usable),
        None if scored is None else scored.score,
        None if scored is None else scored.threshold,
    )
