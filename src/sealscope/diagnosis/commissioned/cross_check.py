"""Each healthy recording judged by all others, with the decision that later recordings meet.

Called by `commission`: what the others call a leak is no healthy recording, or they are none to judge others by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from sealscope.diagnosis.learnt import Learnt
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK

#: Fewest recordings of which each is judged by the others: fewer say nothing of their scatter.
FEWEST = 4
#: What the remark on a recording that stands out says of its judges.
BY_OTHERS = "by the others"


class Outlier(NamedTuple):
    """A healthy recording that stands out of the others: its file, its verdict in short and why."""

    file: str
    summary: str
    reason: str
    is_leak: bool

    def __str__(self) -> str:
        return f"{self.file}: {self.summary} {BY_OTHERS}: {self.reason}"


def find_outliers(
    healthy: Sequence[Learnt], judge: Callable[[Learnt, tuple[Learnt, ...]], Diagnosis]
) -> tuple[Outlier, ...]:
    """Judge each healthy recording by the others.

    Parameters
    ----------
    healthy : sequence of Learnt
    judge : callable
        Diagnoses the recording of the first argument by the recordings of the second.

    Returns
    -------
    tuple of Outlier
        Those that are called leaking, or of which another event is named; empty for fewer than `FEWEST` recordings.
    """
    outliers = []
    for learnt in healthy if len(healthy) >= FEWEST else ():
        diagnosis = judge(learnt, tuple(other for other in healthy if other is not learnt))
        if diagnosis.verdict == LEAK or diagnosis.cause is not None:
            outliers.append(Outlier(learnt.file, diagnosis.summary, diagnosis.reason, diagnosis.verdict == LEAK))
    return tuple(outliers)


def without_leaks(healthy: Sequence[Learnt], outliers: Sequence[Outlier]) -> tuple[tuple[Learnt, ...], tuple[str, ...]]:
    """Return the recordings that the others do not call leaking, and why each other one is left out.

    Where half of them or more stand out, no majority says what is healthy, and all are kept.
    """
    leaking = {outlier.file: str(outlier) for outlier in outliers if outlier.is_leak}
    if 2 * len(leaking) >= len(healthy):
        return tuple(healthy), ()
    return tuple(learnt for learnt in healthy if learnt.file not in leaking), tuple(leaking.values())


def with_remarks(healthy: Sequence[Learnt], outliers: Sequence[Outlier]) -> tuple[Learnt, ...]:
    """Add the verdict by the others to the problems of each recording."""
    remarks = {outlier.file: f"{outlier.summary} {BY_OTHERS}: {outlier.reason}" for outlier in outliers}
    return tuple(
        replace(learnt, about={**learnt.about, "wrong": [*learnt.about.get("wrong", ()), remarks[learnt.file]]})
        if learnt.file in remarks
        else learnt
        for learnt in healthy
    )
