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

from sealscope.diagnosis.inference.onset import Interval, step_test
from sealscope.diagnosis.inference.scatter import Rise
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.diagnosis.rms_change.blocks import JUDGED, QUANTITIES, RmsBlocks, cut, whole
from sealscope.diagnosis.rms_change.ringing import information, priors, rises
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.hydraulics import lack_of_chambers
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Recording
from sealscope.signals.details import shortest

#: Fewest blocks in which a change is looked for.
FEWEST_BLOCKS = 12
#: Chance below which a quantity has a say in the onset.
MOVED = 0.5
#: Lowest rate [Hz] at which the ringing of the piston on its oil, 70 Hz on the packaged rigs, reaches into the judged
#: details: d2 ends at a quarter of the rate, and d1 is noise. Below, leaks of up to 0.5 L/min changed nothing in them.
RINGING_RATE = 250.0
#: Lowest rate [Hz]: the ringing of a hydraulic line of some metres lies over 4 Hz.
SLOWEST_RATE = 8.0


class _Change(NamedTuple):
    """Change g of a quantity, of the likelier sign, with the 95 % bound of its size, and its `onset` in a recording.

    `weight` times g is the change of its log RMS.
    """

    name: str
    value: float
    score: float
    chance: float
    threshold: float
    bound: float
    weight: float
    onset: Interval | None = None

    @property
    def text(self) -> str:
        percent = 100.0 * np.expm1(self.weight * self.value)
        return f"RMS of {self.name} {'rose' if percent > 0 else 'fell'} by {abs(percent):.1f} %"


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
        for chamber in chambers_of(recording):
            if constant(recording[chamber]):
                return f"{chamber} is constant"
        return None

    def learn(self, recording: Recording) -> Lesson:
        """Return what a healthy recording teaches: its log RMS and duty, whose they are, and when."""
        levels, duty = whole(recording)
        return {
            "chambers": list(chambers_of(recording)),
            "rate": recording.rate,
            "start_s": start_seconds(recording),
            "levels": levels,
            "duty": duty,
        }

    def examine(self, recording: Recording, baseline: Sequence[Healthy], false_alarm_probability: float) -> Evidence:
        """Return the evidence on a recording that is `usable`, within it or against the baseline."""
        evidence = _examine(recording, baseline, false_alarm_probability)
        if evidence.verdict != "no leak" or recording.rate >= RINGING_RATE:
            return evidence
        seen = f"at {recording.rate:g} Hz the details hold no ringing that a leak damps ({RINGING_RATE:g} Hz would)"
        return replace(evidence, verdict="cannot tell", reason=f"{seen}; {evidence.reason}")


def _examine(recording: Recording, baseline: Sequence[Healthy], probability: float) -> Evidence:
    """Return the evidence on a recording, by what its details show."""
    if recording.rate < SLOWEST_RATE:
        reason = f"needs {SLOWEST_RATE:g} Hz or more to see the ringing that a leak damps, got {recording.rate:g} Hz"
        return Evidence("cannot tell", f"{reason}: is the unit of the time right?")
    if baseline:
        return against(recording, baseline, probability)
    blocks = cut(recording)
    if blocks.still is not None:
        return Evidence("cannot tell", f"the pressures cannot be trusted: {blocks.still}")
    if len(blocks.log_rms) < FEWEST_BLOCKS:
        return Evidence(
            "cannot tell",
            f"too short to be its own baseline: {len(blocks.log_rms)} blocks, {FEWEST_BLOCKS} are needed; give "
            "leak-free recordings as --baseline",
        )
    return within(blocks.settled(), probability)


def within(blocks: RmsBlocks, probability: float) -> Evidence:
    """Return the evidence of a step within the blocks of one recording.

    Its onset is that of all judged quantities that moved, which they share.
    """
    share = probability / (2 * len(JUDGED) * len(blocks.chambers))
    changes, moved = [], []
    for name, own, weight in zip(blocks.names, *information(blocks), strict=True):
        tests = [(sign, step_test(own, (sign,))) for sign in (1.0, -1.0)]
        stepped = [(sign, test) for sign, test in tests if test is not None]
        if not stepped:
            return Evidence("cannot tell", f"{name} says nothing in most blocks")
        sign, test = min(stepped, key=lambda own: own[1].chance)
        size, bound = sign * test.fitted[0], max(test.bound() for _, test in stepped)
        changes.append(_Change(name, size, test.score, test.chance, test.threshold(share), bound, weight, test.onset()))
        if name.split()[0] in JUDGED:
            moved.append(test)
    rarest = min(moved, key=lambda test: test.chance)
    likelihood = np.sum([test.likelihood for test in moved if test is rarest or test.chance < MOVED], axis=0)
    onset = replace(rarest, likelihood=likelihood, best=int(likelihood.argmax())).onset()
    return _evidence(changes, blocks.share, "within the recording", onset)


def against(recording: Recording, baseline: Sequence[Healthy], probability: float) -> Evidence:
    """Return the evidence of a rise or fall against leak-free recordings of the machine."""
    alike = [own for own in lessons_of(RmsChange(), baseline) if own["chambers"] == list(chambers_of(recording))]
    alike = [own for own in alike if abs(own["rate"] / recording.rate - 1.0) < 1e-3]
    if not alike:
        return Evidence("cannot tell", f"no baseline recording has the same chambers at {recording.rate:g} Hz")
    apart = _apart(recording, alike)
    levels, duties = (np.stack([np.asarray(own[name], dtype=float) for own in alike]) for name in ("levels", "duty"))
    stated, weights = rises(*whole(recording), levels, duties, bool(apart))
    names = [f"{quantity} of {chamber}" for chamber in chambers_of(recording) for quantity in QUANTITIES]
    share = probability / (2 * len(JUDGED) * len(chambers_of(recording)))
    changes = [_of_rise(name, own, w, share) for name, own, w in zip(names, stated, weights, strict=True)]
    count = f"{len(alike)} comparable leak-free recording{'s' if len(alike) > 1 else ''}"
    count += {True: " of another session", False: "", None: ", maybe of another session or machine"}[apart]
    return _evidence(changes, 1.0, f"against {count}", None)


def _apart(recording: Recording, baseline: Sequence[Lesson]) -> bool | None:
    """Whether a recording is of another session than all of the baseline's; None where no times tell."""
    start, pause = start_seconds(recording), priors()["recordings"]["pause"].value
    others = [other for own in baseline if (other := own.get("start_s")) is not None]
    return None if start is None or not others else all(abs(start - other) > pause for other in others)


def _of_rise(name: str, rise: Rise, weight: float, share: float) -> _Change:
    size = Rise(abs(rise.value), rise.deviation, rise.freedom)
    bound = size.value + size.threshold(0.05) * size.deviation
    return _Change(name, rise.value, size.score, size.chance, size.threshold(share), bound, weight)


def _evidence(changes: Sequence[_Change], share: float, where: str, onset: Interval | None) -> Evidence:
    """Return the evidence of the changes of all quantities: the rarest of the judged ones decides."""
    judged = [own for own in changes if own.name.split()[0] in JUDGED]
    rarest = min(judged, key=lambda own: own.chance)
    chance = min(1.0, 2.0 * len(judged) * rarest.chance)
    figures = f"score {rarest.score:.1f}, threshold {rarest.threshold:.1f}"
    noise = any(own.score > own.threshold for own in changes if own.name.startswith("d1 "))
    note = "; the noise (d1) changed too, and was taken out of the other details" if noise else ""
    bound = min(own.bound for own in judged)
    limit = f"{-100.0 * np.expm1(-bound):.2g} %"
    verdict: Verdict = "leak" if rarest.score > rarest.threshold else "no leak"
    if verdict == "leak":
        at = "" if onset is None else f" at {onset.value:.1f} s"
        moved = sorted((own for own in judged if own.score > own.threshold), key=lambda own: own.chance)[:3]
        reason = f"{', '.join(own.text for own in moved)}{at} {where} ({figures}){note}"
    elif bound > priors()["recordings"]["worth"].value:
        verdict = "cannot tell"
        reason = f"a fall of the ringing by {limit} {where} would not show (95 %; {figures}){note}"
    else:
        reason = f"no fall of the ringing above {limit} (95 %) {where} ({figures}){note}"
        if onset is not None:
            reason += "; a leak that was there from the start would need a --baseline to be seen"
    parts = tuple(
        Evidence(
            "no leak" if own.score <= own.threshold else "cannot tell" if own.name.startswith("d1 ") else "leak",
            own.text if own.onset is None else f"{own.text} at {own.onset.value:.1f} s",
            own.score,
            own.threshold,
            detector=f"RMS of {own.name}",
        )
        for own in changes
    )
    onset = onset if verdict == "leak" else None
    return Evidence(
        verdict,
        reason,
        rarest.score,
        rarest.threshold,
        onset_s=None if onset is None else onset.value,
        onset_interval_s=None if onset is None else (onset.low, onset.high),
        parts=parts,
        chance=chance,
        share=share,
    )
