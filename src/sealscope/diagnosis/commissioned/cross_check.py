"""Judge each healthy recording against all others, by the same decision as later recordings.

Called by `commission`: if a recording is judged leaking, either it or the others are not healthy.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK

#: Fewest recordings that are compared with each other, as the scatter of fewer recordings is not known.
MIN_RECORDINGS = 4
#: Words in the problem of a recording that differs from the other healthy recordings; `summary` counts them.
BY_OTHERS = "by the others"


def cross_check(
    healthy: Sequence[SummarisedRecording],
    judge: Callable[[SummarisedRecording, tuple[SummarisedRecording, ...]], Diagnosis],
    keep: bool = False,
) -> tuple[tuple[SummarisedRecording, ...], tuple[str, ...]]:
    """Diagnose each healthy recording against all others, and leave out those that seem to leak.

    `judge(recording, reference)` diagnoses a recording against the healthy recordings `reference`. No recording is left
    out if `keep` is True, or if at least half of the recordings seem to leak, as there is then no healthy majority.
    Fewer than `MIN_RECORDINGS` recordings are not judged. Returns the remaining recordings, and the reason for each one
    left out. If a remaining recording shows a leak or another event, its problems (`about["wrong"]`) state it.
    """
    problems, leaking = dict[str, str](), dict[str, str]()  # texts by the name of the recording's file
    begins_within = set[str]()  # names of the files in which a leak seems to begin
    for recording in healthy if len(healthy) >= MIN_RECORDINGS else ():
        diagnosis = judge(recording, tuple(other for other in healthy if other is not recording))
        if diagnosis.verdict == LEAK or diagnosis.cause is not None:
            problems[recording.file] = f"{diagnosis.summary} {BY_OTHERS}: {diagnosis.reason}"
        if diagnosis.verdict == LEAK:
            leaking[recording.file] = f"{recording.file}: {problems[recording.file]}"
            if diagnosis.onset_s is not None:
                begins_within.add(recording.file)
    healed = [file for file in begins_within if _has_healed(file, healthy, leaking)]
    leaking = {file: text for file, text in leaking.items() if file not in healed}
    if keep or 2 * len(leaking) >= len(healthy):
        leaking = {}
    remaining = [recording for recording in healthy if recording.file not in leaking]
    for k, recording in enumerate(remaining):
        if recording.file in problems:
            wrong = [*recording.about.get("wrong", ()), problems[recording.file]]
            remaining[k] = replace(recording, about={**recording.about, "wrong": wrong})
    return tuple(remaining), tuple(leaking.values())


def _has_healed(file: str, healthy: Sequence[SummarisedRecording], leaking: Collection[str]) -> bool:
    """Return True if recordings were made after that of the `file`, and none of them is among the `leaking` files.

    As a worn seal does not heal, the leak that seemed to begin in the recording is then no leak.
    """
    start_s = next(recording.start_s for recording in healthy if recording.file == file)
    if start_s is None:
        return False
    later = [recording.file for recording in healthy if recording.start_s is not None and recording.start_s > start_s]
    return bool(later) and not any(name in leaking for name in later)
