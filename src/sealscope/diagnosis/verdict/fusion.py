"""One verdict from the evidence of many detectors, at the false-alarm probability of the one that judges.

The judge is the most specific detector that has a verdict: letting any of several raise the alarm would make the rate
the sum of theirs. `docs/decisions/0011-detectors.md` says why, and what the rate is where a detector passes the word.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from sealscope.diagnosis.verdict.evidence import LEAKS, Evidence, MethodResult

#: The most specific first: what accounts for every litre, what models the pressures, what estimates a state, what sees
#: that something changed. A user's own detectors follow in the order of their names.
ORDER = ("volume balance", "pressure model", "observer", "rms change")


@dataclass(frozen=True)
class Said:
    """What one detector said; `usable`: whether the recording had what it needs."""

    name: str
    evidence: Evidence
    usable: bool = True


@dataclass(frozen=True)
class Fused:
    """The verdict: whose it is (None where nobody had one), the evidence for it with what others add, and every
    detector's own, the judge's first."""

    judge: str | None
    evidence: Evidence
    methods: tuple[MethodResult, ...]


def alarmed(evidence: Evidence) -> bool:
    """Whether the score is over the threshold."""
    return evidence.score is not None and evidence.threshold is not None and evidence.score > evidence.threshold


def passes(evidence: Evidence) -> bool:
    """Whether a detector leaves the word to the next: it cannot tell, and not because it saw a change that it could
    not attribute."""
    return evidence.verdict == "cannot tell" and evidence.cause is None and not alarmed(evidence)


def ranked(said: Iterable[Said]) -> list[Said]:
    """The detectors, the most specific first."""
    return sorted(said, key=lambda one: ORDER.index(one.name) if one.name in ORDER else len(ORDER))


def fuse(said: Sequence[Said]) -> Fused:
    """One verdict from what all detectors said.

    The first of `ORDER` that does not pass the word judges. Of a leak, onset and L/min are the judge's, else those of
    the next detector that found a leak, too, and has them; the cause is the judge's, else the one that another detector
    names. Where others differ, the reason says so.
    """
    order = ranked(said)
    usable = [one for one in order if one.usable]
    judge = next((one for one in usable if not passes(one.evidence)), None)
    if judge is None:
        return Fused(None, _nobody(order, usable), _methods(order))
    others = [one for one in usable if one is not judge]
    found = judge.evidence
    words = [found.reason]
    if found.verdict == "leak":
        found, lent = _with_estimates(found, [one for one in others if one.evidence.verdict == "leak"])
        words += lent
    else:
        found = replace(found, onset_s=None, onset_interval_s=None)
        naming = next((one for one in others if _other_cause(one.evidence)), None)
        if found.cause is None and naming is not None:
            found = replace(found, cause=naming.evidence.cause)
    words += [text for one in others if (text := _difference(judge.evidence, one)) is not None]
    return Fused(
        judge.name,
        replace(found, reason="; ".join(words)),
        _methods([judge, *(one for one in order if one is not judge)]),
    )


def _other_cause(evidence: Evidence) -> bool:
    return evidence.cause is not None and evidence.cause not in LEAKS


def _with_estimates(found: Evidence, agreeing: Sequence[Said]) -> tuple[Evidence, list[str]]:
    """A leak's evidence with the onset and the flow that it lacks, and words that say whose they are."""
    words = []
    if found.onset_s is None:
        timed = next((one for one in agreeing if one.evidence.onset_s is not None), None)
        if timed is not None:
            own = timed.evidence
            found = replace(found, onset_s=own.onset_s, onset_interval_s=own.onset_interval_s)
            words.append(f"onset from {timed.name}")
    if found.leak_lpm is None:
        sized = next((one for one in agreeing if one.evidence.leak_lpm is not None), None)
        if sized is not None:
            own = sized.evidence
            found = replace(
                found,
                leak_lpm=own.leak_lpm,
                leak_interval_lpm=own.leak_interval_lpm,
                course=own.course if found.course is None else found.course,
            )
            words.append(f"L/min from {sized.name}")
    return found, words


def _difference(judged: Evidence, other: Said) -> str | None:
    """In what another detector differs from the judge, in words; None where it does not."""
    said = other.evidence
    figures = ""
    if said.score is not None and said.threshold is not None:
        figures = f" (score {said.score:.3g}, threshold {said.threshold:.3g})"
    if _other_cause(said) and said.cause != judged.cause:
        return f"{other.name} takes the change for {said.cause}{figures}"
    if said.verdict in ("cannot tell", judged.verdict):
        return None
    if judged.verdict == "leak":
        return f"{other.name} sees no leak{figures}"
    if said.verdict == "leak":
        return f"{other.name} sees a change like a leak's{figures}"
    return None  # the judge cannot tell, the other sees nothing


def _nobody(order: Sequence[Said], usable: Sequence[Said]) -> Evidence:
    """Where no detector has a verdict: why, by those that looked, else by the one that needs least."""
    if not usable:
        if not order:
            return Evidence("cannot tell", "there is no detector")
        known = [one for one in order if one.name in ORDER] or order
        return Evidence("cannot tell", known[-1].evidence.reason)
    if len(usable) == 1:
        return usable[0].evidence
    scored = next((one.evidence for one in usable if one.evidence.score is not None), None)
    return Evidence(
        "cannot tell",
        "; ".join(f"{one.name}: {one.evidence.reason}" for one in usable),
        None if scored is None else scored.score,
        None if scored is None else scored.threshold,
    )


def _methods(order: Sequence[Said]) -> tuple[MethodResult, ...]:
    found: list[MethodResult] = []
    for one in order:
        own = one.evidence
        found += [MethodResult(one.name, own.score, own.threshold, own.verdict, own.reason), *own.methods]
    return tuple(found)
