"""The thesis's method as observables: changes of the RMS of the db8 details.

The thesis compares the RMS of d1..d4 and of d3*d4 before and after (its ch. 5 and Appendix C) and calls a leak where
it went down (p_A) or up (p_B). Here d2..d4 of all chambers are tested for a step of either sign within the recording
(`inference.onset`), or for a rise or fall against leak-free recordings (`inference.scatter`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.differences import difference
from sealscope.diagnosis.inference.observable import Observable, Observed, Ringing
from sealscope.diagnosis.inference.onset import step_tests
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.rms_change.blocks import (
    JUDGED,
    RmsBlocks,
    columns_of,
    cut_blocks,
    judged_chambers,
    whole_levels,
)
from sealscope.diagnosis.rms_change.ringing import information, rises
from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.hydraulics import lack_of_chambers
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, shortest

#: Name of the data that these observables describe.
DETAILS = "details"
#: Details that ringing, and no noise alone, fills.
RINGING = ("d2", "d3")


class RmsChange:
    """Change of the details' RMS, within a recording or against leak-free ones."""

    name = "rms change"
    reads = ("u", "p_A", "p_B")

    def __init__(self, rig: object = None) -> None:
        """Nothing is assumed of the machine."""

    def usable(self, recording: Recording) -> str | None:
        """Return None if the recording is long enough and its chamber pressures move, else the reason why not."""
        if lack := lack_of_chambers(recording):
            return lack
        if len(recording) < shortest():
            return f"needs {shortest()} samples or more without a gap, got {len(recording)}"
        still = next((name for name in chambers_of(recording) if constant(recording[name])), None)
        return None if still is None else f"{still} is constant"

    def learn(self, recording: Recording) -> Lesson:
        """Return the lesson of a healthy recording: log RMS and duty, their chambers, and the start."""
        levels, duty = whole_levels(recording)
        chambers, start = list(judged_chambers(recording)), start_seconds(recording)
        lesson_head = {"chambers": chambers, "recorded": list(chambers_of(recording)), "rate": recording.rate}
        return {**lesson_head, "start_s": start, "levels": levels, "duty": duty}

    def observe(self, recording: Recording, baseline: Sequence[Healthy] = ()) -> Observed:
        """Return the changes of the details' RMS, within the recording or against the healthy ones."""
        slowest: float = priors("rms_change")["rate"]["slowest"]
        if recording.rate < slowest:
            least = f"needs {slowest:g} Hz or more to see the ringing that a leak damps"
            return Observed(self.name, lack=f"{least}, got {recording.rate:g} Hz: is the unit of the time right?")
        if baseline:
            return observe_against(recording, baseline)
        blocks = cut_blocks(recording)
        if blocks.still is not None:
            return Observed(self.name, lack=f"the pressures cannot be trusted: {blocks.still}")
        if len(blocks.log_rms) < (fewest := priors("rms_change")["blocks"]["fewest"]):
            short = f"too short to be its own baseline: {len(blocks.log_rms)} blocks, {fewest} are needed"
            return Observed(self.name, lack=f"{short}; give leak-free recordings as --baseline")
        report = observe_within(blocks.without_start(), recording.rate)
        ringing = report.ringing and report.ringing._replace(unused=recording.unused)
        return replace(report, ringing=ringing)


def observe_within(blocks: RmsBlocks, rate: float) -> Observed:
    """Test every quantity of every chamber for a step within the blocks of one recording.

    The onset is that of all judged quantities that moved, which they share.
    """
    looks = 2.0 * len(JUDGED) * len(blocks.chambers)
    tests = []
    for name, quantity, weight in zip(blocks.names, *information(blocks), strict=True):
        steps = step_tests(quantity, (1.0, -1.0))
        if not steps:
            return Observed(RmsChange.name, lack=f"{name} says nothing in most blocks")
        best = min((0, 1), key=lambda k: steps[k].chance)
        bound = max(step.bound() for step in steps)
        tests.append((name, steps[best], (1.0, -1.0)[best] * weight, bound))
    judged = [row for row in tests if row[0].split()[0] in JUDGED]
    rarest = min((step for _, step, _, _ in judged), key=lambda step: step.chance)
    moved = [step.likelihood for _, step, _, _ in judged if step is rarest or step.chance < 0.5]
    likelihood = np.sum(moved, axis=0)
    onset = replace(rarest, likelihood=likelihood, best=int(likelihood.argmax())).onset()
    observables = [
        Observable(
            name=_name_of(name, sign * step.fitted[0]),
            data=DETAILS if name.split()[0] in JUDGED else "noise of details",
            score=step.score,
            chance=min(1.0, looks * step.chance),
            onset=onset,
            size=sign * step.fitted[0],
        )
        for name, step, sign, _ in tests
    ]
    bound = min(bound for _, _, _, bound in judged)
    return Observed(RmsChange.name, tuple(observables), share=blocks.share, ringing=Ringing(bound, rate, 0, True))


def observe_against(recording: Recording, baseline: Sequence[Healthy]) -> Observed:
    """Compare a recording with leak-free recordings of the machine."""
    chambers, recorded = judged_chambers(recording), list(chambers_of(recording))  # these make the duty
    lessons = [
        lesson
        for lesson in lessons_of(RmsChange(), baseline)
        if (lesson.get("recorded") or lesson["chambers"]) == recorded
        and set(chambers) <= set(lesson["chambers"])
        and abs(lesson["rate"] / recording.rate - 1.0) < 1e-3
    ]
    if not lessons:
        lack = f"no baseline recording has the same chambers at {recording.rate:g} Hz"
        return Observed(RmsChange.name, lack=lack)
    judged = RmsChange().learn(recording)
    observables, bound = compare_lessons(judged, lessons, chambers)
    is_dated = None not in [lesson.get("start_s") for lesson in (judged, *lessons)]
    return Observed(
        RmsChange.name, observables, ringing=Ringing(bound, recording.rate, len(lessons), is_dated, recording.unused)
    )


def compare_lessons(
    judged: Lesson, lessons: Sequence[Lesson], chambers: Sequence[str]
) -> tuple[tuple[Observable, ...], float]:
    """Test every quantity of every chamber for a rise or fall against leak-free recordings.

    Returns
    -------
    observables : tuple of Observable
    bound : float
        95 % bound of the size of a change that would not show, the smallest of all quantities.
    """
    starts = [*(lesson.get("start_s") for lesson in lessons), judged.get("start_s")]
    times = None if None in starts else np.array(starts, dtype=float)
    duties = np.array([lesson["duty"] for lesson in lessons], dtype=float)
    levels = np.array([_levels(lesson, chambers) for lesson in lessons])
    duty = np.asarray(judged["duty"], dtype=float)
    looks, observables, bounds = 2.0 * len(JUDGED) * len(chambers), [], []
    changes = rises(_levels(judged, chambers), duty, levels, duties, times)
    for name, rise, weight in zip(columns_of(chambers), *changes, strict=True):
        size = rise._replace(value=abs(rise.value))
        is_judged = name.split()[0] in JUDGED
        observables.append(
            Observable(
                name=_name_of(name, rise.value),
                data=DETAILS if is_judged else "noise of details",
                score=2.0 * size.log_ratio(size.value),
                chance=min(1.0, looks * size.chance),
                size=weight * rise.value,
            )
        )
        bounds += [size.bound()] if is_judged else []
    observables += _sides(judged, lessons, chambers)
    return tuple(observables), min(bounds)


def _sides(judged: Lesson, lessons: Sequence[Lesson], chambers: Sequence[str]) -> Iterator[Observable]:
    """Yield how the ringing of one chamber stands to the other's, which the machine moves alike."""
    if len(chambers) != len(CHAMBERS):
        return
    rows = [(QUANTITIES.index(name), len(QUANTITIES) + QUANTITIES.index(name)) for name in RINGING]

    def mean_difference(lesson: Lesson) -> float:
        levels = _levels(lesson, chambers)
        return float(np.mean([levels[first] - levels[second] for first, second in rows]))

    error: float = priors("rms_change")["recordings"]["error"]
    observable = difference(
        "p_A beside p_B", "sides", mean_difference(judged), [mean_difference(lesson) for lesson in lessons], error
    )
    if observable is not None:
        filtered = priors("rms_change")["filtered"]
        away = np.log(max(abs(observable.size), error) / filtered["size"]) / filtered["spread"]
        yield replace(observable, advantage=-float(min(away, 0.0) ** 2))


def _name_of(quantity: str, change: float) -> str:
    return f"{'rise' if change > 0.0 else 'fall'} of {quantity}"


def _levels(lesson: Lesson, chambers: Sequence[str]) -> Array:
    """Return the log RMS (5 per chamber,) of some of the chambers of a healthy recording."""
    levels = np.asarray(lesson["levels"], dtype=float).reshape(len(lesson["chambers"]), -1)
    return np.concatenate([levels[lesson["chambers"].index(chamber)] for chamber in chambers])
