"""The thesis's method as a detector with a false-alarm probability: a change of the RMS of the db8 details.

The thesis compares the RMS of d1..d4 and of d3*d4 before and after (its ch. 5 and Appendix C) and calls a leak where
it went down (p_A) or up (p_B). Here each of these changes is a part of the evidence, and d2..d4 of all chambers make
the verdict: a step of either sign within the recording (`inference.onset`), or a rise or fall against leak-free
recordings (`inference.scatter`), each at its share of the false-alarm probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.onset import Interval, step_tests
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.rms_change.blocks import JUDGED, RmsBlocks, columns_of, cut, judged_chambers, whole
from sealscope.diagnosis.rms_change.ringing import information, rises
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.formats.columns import listed
from sealscope.recordings.hydraulics import lack_of_chambers
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import shortest


class _Change(NamedTuple):
    """Change of the log RMS of a quantity, of the likelier sign, its `onset` in a recording, and its test.

    `bound`: 95 % bound of the size of the machine's own part of it.
    """

    name: str
    value: float
    score: float
    chance: float
    threshold: float
    bound: float
    onset: Interval | None = None

    @property
    def text(self) -> str:
        """The change in words."""
        percent = 100.0 * np.expm1(self.value)
        return f"RMS of {self.name} {'rose' if percent > 0 else 'fell'} by {abs(percent):.1f} %"

    def evidence(self) -> Evidence:
        """Return it as a part of the detector's evidence; noise (d1) that changed is no leak."""
        at = "" if self.onset is None else f" at {self.onset.value:.1f} s"
        changed: Verdict = "cannot tell" if self.name.startswith("d1 ") else "leak"
        verdict: Verdict = "no leak" if self.score <= self.threshold else changed
        return Evidence(verdict, self.text + at, self.score, self.threshold, detector=f"RMS of {self.name}")


class RmsChange:
    """Change of the details' RMS, within a recording or against leak-free ones."""

    name = "rms change"
    reads = ("u", "p_A", "p_B")

    def __init__(self, rig: object = None) -> None:
        """Nothing is assumed of the machine."""

    def usable(self, recording: Recording) -> str | None:
        """Return None when the recording has a chamber pressure that moves, else the reason why not."""
        if lack := lack_of_chambers(recording):
            return lack
        if len(recording) < shortest():
            return f"needs {shortest()} samples or more without a gap, got {len(recording)}"
        still = next((name for name in chambers_of(recording) if constant(recording[name])), None)
        return None if still is None else f"{still} is constant"

    def learn(self, recording: Recording) -> Lesson:
        """Return what a healthy recording teaches: its log RMS and duty, whose they are, and when."""
        levels, duty = whole(recording)
        chambers, start = list(judged_chambers(recording)), start_seconds(recording)
        known = {"chambers": chambers, "recorded": list(chambers_of(recording)), "rate": recording.rate}
        return {**known, "start_s": start, "levels": levels, "duty": duty}

    def examine(self, recording: Recording, baseline: Sequence[Healthy], false_alarm_probability: float) -> Evidence:
        """Return the evidence on a recording that is `usable`, within it or against the baseline."""
        rates = priors("rms_change")["rate"]
        if recording.rate < rates["slowest"]:
            least = f"needs {rates['slowest']:g} Hz or more to see the ringing that a leak damps"
            return Evidence("cannot tell", f"{least}, got {recording.rate:g} Hz: is the unit of the time right?")
        if baseline:
            evidence = against(recording, baseline, false_alarm_probability)
        else:
            evidence = _within(cut(recording), false_alarm_probability)
        if evidence.verdict != "no leak" or recording.rate >= rates["ringing"]:
            return evidence
        why = f"at {recording.rate:g} Hz the details hold no ringing that a leak damps ({rates['ringing']:g} Hz would)"
        if recording.unused:
            why = f"{listed(recording.unused, 4)}: recorded, and used for no channel (--map CHANNEL=COLUMN)"
        return replace(evidence, verdict="cannot tell", reason=f"{why}; {evidence.reason}")


def _within(blocks: RmsBlocks, probability: float) -> Evidence:
    if blocks.still is not None:
        return Evidence("cannot tell", f"the pressures cannot be trusted: {blocks.still}")
    if len(blocks.log_rms) < (fewest := priors("rms_change")["blocks"]["fewest"]):
        short = f"too short to be its own baseline: {len(blocks.log_rms)} blocks, {fewest} are needed"
        return Evidence("cannot tell", f"{short}; give leak-free recordings as --baseline")
    return within(blocks.settled(), probability)


def within(blocks: RmsBlocks, probability: float) -> Evidence:
    """Return the evidence of a step within the blocks of one recording.

    Its onset is that of all judged quantities that moved, which they share.
    """
    share = probability / (2 * len(JUDGED) * len(blocks.chambers))
    changes, moved = [], []
    for name, own, weight in zip(blocks.names, *information(blocks), strict=True):
        tests = step_tests(own, (1.0, -1.0))
        if not tests:
            return Evidence("cannot tell", f"{name} says nothing in most blocks")
        test = min(tests, key=lambda each: each.chance)
        size, bound = test.fitted[0] * (1.0 if test is tests[0] else -1.0), max(each.bound() for each in tests)
        figures = test.score, test.chance, test.threshold(share), bound, test.onset()
        changes.append(_Change(name, weight * size, *figures))
        if name.split()[0] in JUDGED:
            moved.append(test)
    rarest = min(moved, key=lambda test: test.chance)
    likelihood = np.sum([test.likelihood for test in moved if test is rarest or test.chance < 0.5], axis=0)
    onset = replace(rarest, likelihood=likelihood, best=int(likelihood.argmax())).onset()
    return _evidence(changes, blocks.share, "within the recording", onset)


def against(recording: Recording, baseline: Sequence[Healthy], probability: float) -> Evidence:
    """Return the evidence of a rise or fall against leak-free recordings of the machine."""
    chambers, recorded = judged_chambers(recording), list(chambers_of(recording))  # these make the duty
    alike = [own for own in lessons_of(RmsChange(), baseline) if (own.get("recorded") or own["chambers"]) == recorded]
    alike = [own for own in alike if set(chambers) <= set(own["chambers"])]
    alike = [own for own in alike if abs(own["rate"] / recording.rate - 1.0) < 1e-3]
    if not alike:
        return Evidence("cannot tell", f"no baseline recording has the same chambers at {recording.rate:g} Hz")
    starts = [*(own.get("start_s") for own in alike), start_seconds(recording)]
    times = None if None in starts else np.array(starts, dtype=float)
    duties = np.array([own["duty"] for own in alike], dtype=float)
    levels = np.array([_levels(own, chambers) for own in alike])
    share, changes = probability / (2 * len(JUDGED) * len(chambers)), []
    for name, rise, weight in zip(columns_of(chambers), *rises(*whole(recording), levels, duties, times), strict=True):
        size = rise._replace(value=abs(rise.value))
        change = (size.score, size.chance, size.threshold(share), size.bound())
        changes.append(_Change(name, weight * rise.value, *change))
    unknown = ", maybe of another session or machine" if times is None else ""
    count = f"{len(alike)} comparable leak-free recording{'s' if len(alike) > 1 else ''}{unknown}"
    return _evidence(changes, 1.0, f"against {count}", None)


def _levels(lesson: Lesson, chambers: Sequence[str]) -> Array:
    """Return the log RMS (5 per chamber,) of some of the chambers of a healthy recording."""
    levels = np.asarray(lesson["levels"], dtype=float).reshape(len(lesson["chambers"]), -1)
    return np.concatenate([levels[lesson["chambers"].index(chamber)] for chamber in chambers])


def _evidence(changes: Sequence[_Change], share: float, where: str, onset: Interval | None) -> Evidence:
    """Return the evidence of the changes of all quantities: the rarest of the judged ones decides."""
    judged = sorted((own for own in changes if own.name.split()[0] in JUDGED), key=lambda own: own.chance)
    rarest, bound = judged[0], min(own.bound for own in judged)
    figures, limit = f"score {rarest.score:.1f}, threshold {rarest.threshold:.1f}", f"{-100.0 * np.expm1(-bound):.2g} %"
    noise = any(own.score > own.threshold for own in changes if own.name.startswith("d1 "))
    note = "; the noise (d1) changed too, and was taken out of the other details" if noise else ""
    verdict: Verdict = "leak" if rarest.score > rarest.threshold else "no leak"
    if verdict == "leak":
        at = "" if onset is None else f" at {onset.value:.1f} s"
        moved = [own.text for own in judged if own.score > own.threshold][:3]
        reason = f"{', '.join(moved)}{at} {where} ({figures}){note}"
    elif bound > priors("rms_change")["recordings"]["worth"]:
        verdict = "cannot tell"
        reason = f"a fall of the ringing by {limit} {where} would not show (95 %; {figures}){note}"
    else:
        reason = f"no fall of the ringing above {limit} (95 %) {where} ({figures}){note}"
        if onset is not None:
            reason += "; a leak that was there from the start would need a --baseline to be seen"
    stated = onset if verdict == "leak" else None
    return Evidence(
        verdict,
        reason,
        rarest.score,
        rarest.threshold,
        onset_s=None if stated is None else stated.value,
        onset_interval_s=None if stated is None else (stated.low, stated.high),
        parts=tuple(own.evidence() for own in changes),
        chance=min(1.0, 2.0 * len(judged) * rarest.chance),
        share=share,
    )
