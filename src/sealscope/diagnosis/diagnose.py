"""Diagnose a recording: look at the data first, run every detector its channels allow, state one verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.examination import Examination
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.quality import Finding, inspect, uniform_segments
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Probability of `leak` on a leak-free recording, unless the caller asks for another.
FALSE_ALARM_PROBABILITY = 0.01
_PROBABILITIES = (1e-4, 0.2)
#: Findings on a chamber pressure that leave no trust in its details ...
_SPOILING = ("constant", "stuck")
#: ... and clipping, when it takes more than this share of the samples; a chamber that empties into the tank rests at
#: the rail for a while in any stroke.
_MOST_CLIPPED = 0.5


def analysable(recording: Recording) -> tuple[Recording, Finding | None]:
    """The longest stretch that is uniformly sampled with no chamber pressure missing, and a finding that says so
    where it is not all."""
    chambers = chambers_of(recording)
    if "u" in recording and not np.any(np.isfinite(recording["u"])):  # `inspect` names it; the pressures can do without
        recording = recording.only(name for name in recording.channels if name != "u")
    stretches = uniform_segments(recording, (*chambers, "u") if "u" in recording else chambers)
    if not stretches:
        return recording.between(math.inf, math.inf), None
    longest = max(stretches, key=lambda one: one.stop - one.start)
    if longest.start == 0 and longest.stop == len(recording):
        return recording, None
    part = recording.samples(longest)
    text = (
        f"only the longest whole stretch was analysed: {part.t[0]:.4g} s to {part.t[-1]:.4g} s, {len(part)} of "
        f"{len(recording)} samples"
    )
    return part, Finding("part_analysed", "warning", None, len(recording) - len(part), float(part.t[0]), text)


def check_probability(probability: float) -> None:
    """Raise InputError for a false-alarm probability that no threshold can be set for."""
    low, high = _PROBABILITIES
    if not low <= probability <= high:
        raise InputError(f"false-alarm probability must be {low:g} to {high:g}, got {probability}")


def diagnose(
    recording: Recording,
    baseline: Sequence[Recording] = (),
    *,
    false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    file: str | None = None,
    rig: Rig | None = None,
) -> Diagnosis:
    """Say whether oil bypasses the piston in this recording.

    `baseline`: leak-free recordings of the same machine; without any, the recording's own beginning is the baseline
    and the onset is looked for. Baseline recordings that cannot be compared (other direction, command, pressure
    level) are left out. `rig`: what the detectors may assume of the machine, the thesis's by default. Every detector
    that the channels allow is run, the most specific of them judges (`fusion.ORDER`), the others are told beside it.
    The verdict is `cannot tell` where the data do not allow one.

    Raises InputError for a false-alarm probability outside 1e-4 to 0.2.
    """
    check_probability(false_alarm_probability)
    quality = list(inspect(recording))
    part, cut_down = analysable(recording)
    if cut_down is not None:
        quality.append(cut_down)
    whole = [analysable(one)[0] for one in baseline]
    fused = Examination(
        part,
        whole,
        false_alarm_probability=false_alarm_probability,
        rig=rig,
        untrusted=why_untrusted(part, quality),
    ).fused()
    return Diagnosis(
        **vars(fused),
        file=file or str(recording.provenance.get("file", "recording")),
        false_alarm_probability=false_alarm_probability,
        quality=tuple(quality),
    )


def why_untrusted(part: Recording, quality: Sequence[Finding]) -> str | None:
    """Why the chamber pressures of a recording with these findings cannot be trusted; None where they can."""
    for finding in quality:
        if finding.channel in chambers_of(part) and spoils(finding, len(part)):
            return f"the pressures cannot be trusted: {finding.text}"
    return None


def spoils(finding: Finding, samples: int) -> bool:
    """Whether a finding on a chamber pressure of so many samples leaves no trust in its details."""
    return finding.code in _SPOILING or (finding.code == "clipped" and finding.count > _MOST_CLIPPED * samples)
