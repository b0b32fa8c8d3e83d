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
    """Judge each healthy recording by the others; return those that remain, and why each other one is left out.

    `judge`: diagnoses the recording of the first argument by those of the second; `keep`: leave none out. A recording
    is left out if it is called leaking, unless half of all are, as then no majority is healthy. If a leak or another
    event was found in one that remains, the verdict is added to its problems.
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
