"""Each healthy recording judged by all others, by the same decision as later recordings.

Called by `commission`: if the others call one leaking, either it or they are no healthy recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK

#: Fewest recordings of which each is judged by the others: the scatter of fewer is not known.
MIN_RECORDINGS = 4
#: How the text on a recording that differs from the others names its judges.
BY_OTHERS = "by the others"


def cross_check(
    healthy: Sequence[SummarisedRecording],
    judge: Callable[[SummarisedRecording, tuple[SummarisedRecording, ...]], Diagnosis],
    keep: bool = False,
) -> tuple[tuple[SummarisedRecording, ...], tuple[str, ...]]:
    """Diagnose each healthy recording against the others; return those to keep and a reason for each one left out.

    `judge(recording, reference)` diagnoses a recording against healthy ones. A recording judged leaking is left out,
    unless `keep`, or unless half or more leak, as then no majority is healthy. If a kept one shows a leak or another
    event, the verdict is added to its problems. Fewer than `MIN_RECORDINGS` are not judged.
    """
    verdicts, leaking = dict[str, str](), dict[str, str]()
    for recording in healthy if len(healthy) >= MIN_RECORDINGS else ():
        diagnosis = judge(recording, tuple(other for other in healthy if other is not recording))
        if diagnosis.verdict == LEAK or diagnosis.cause is not None:
            verdicts[recording.file] = f"{diagnosis.summary} {BY_OTHERS}: {diagnosis.reason}"
        if diagnosis.verdict == LEAK:
            leaking[recording.file] = f"{recording.file}: {verdicts[recording.file]}"
    if keep or 2 * len(leaking) >= len(healthy):
        leaking = {}
    remaining = (recording for recording in healthy if recording.file not in leaking)
    return tuple(_add_problem(recording, verdicts.get(recording.file)) for recording in remaining), (*leaking.values(),)


def _add_problem(recording: SummarisedRecording, problem: str | None) -> SummarisedRecording:
    """Add a problem, if there is one, to those of a recording."""
    if problem is None:
        return recording
    return replace(recording, about={**recording.about, "wrong": [*recording.about.get("wrong", ()), problem]})
