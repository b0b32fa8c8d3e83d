"""Inspection of recordings before any detector sees them: what of them can be analysed, trusted and compared.

The judged recording and its leak-free baselines pass the same checks. Baselines that fail them, or that hold the
samples of another recording, are left out for all detectors alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import NamedTuple

from sealscope.diagnosis.learnt import Healthy, Learnt
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.corrections.samples import correct_samples
from sealscope.recordings.formats.columns import listed
from sealscope.recordings.hydraulics import lack_of_chambers, no_readings
from sealscope.recordings.quality import SHORTEST, Finding, Severity, inspect
from sealscope.recordings.recording import Recording, remembered


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording as detectors see it.

    `part`: its samples on an even clock, from the first to the last with all chamber pressures and the command, as
    `recordings.corrections` makes them; `findings` on the whole; `distrust`: why the chamber pressures cannot be
    trusted, None where they can; `share` of the whole that the part is.
    """

    part: Recording
    findings: tuple[Finding, ...]
    distrust: str | None
    share: float

    @property
    def defect(self) -> str | None:
        """Why the recording cannot stand for a leak-free machine; None where it can."""
        if lack := lack_of_chambers(self.part):
            return lack
        if len(self.part) < SHORTEST:
            return f"needs {SHORTEST} samples or more, got {len(self.part)}"
        return self.distrust

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the part by channel."""
        return self.part.units

    @property
    def file(self) -> str | None:
        """Name of the recording's file, None where it is of none."""
        file = self.part.provenance.get("file")
        return None if file is None else str(file)

    @cached_property
    def digest(self) -> str:
        """Hash of the chamber pressures: equal for copies of a recording."""
        return sha256(b"".join(self.part[name].tobytes() for name in chambers_of(self.part))).hexdigest()


def inspected(recording: Recording, channels: Iterable[str] | None = None) -> Inspection:
    """Inspect a recording, once for all that ask; `channels`: those to look at for findings, by default all."""
    names = tuple(name for name in recording.channels if channels is None or name in channels)
    return remembered(recording, ("inspection", names), lambda whole: _inspection(whole, names))


def _inspection(recording: Recording, names: Sequence[str]) -> Inspection:
    findings = list(inspect(recording.only(names)))
    chambers = chambers_of(recording)
    part, found, stuck, share = correct_samples(recording)
    findings += found
    wrong = [finding for finding in findings if finding.channel in chambers and finding.code == "constant"]
    wrong += [finding for finding in findings if finding.channel in stuck and finding.code == "stuck"]
    lost = [
        finding
        for finding in findings
        if finding.channel in chambers and finding.code == "clipped" and finding.count > len(part) / 2
    ]
    wrong += lost if len(lost) == len(chambers) else []  # else the other one says what it says
    distrust = f"the pressures cannot be trusted: {wrong[0].text}" if wrong else None
    if distrust is None and len(part) >= SHORTEST and (reason := no_readings(part)):
        distrust = f"this is no recording of a hydraulic machine: {reason}"
    return Inspection(part, tuple(findings), distrust, share)


class Baselines(NamedTuple):
    """Leak-free recordings that a recording can be compared with.

    `parts`: what of them can be analysed; `findings`: which were left out, and why; `refusal`: why none is left, None
    where some are, or where none was given.
    """

    parts: tuple[Healthy, ...]
    findings: tuple[Finding, ...]
    refusal: str | None


def comparable(judged: Inspection, baseline: Sequence[Healthy]) -> Baselines:
    """Inspect the baselines of a judged recording and choose those that can be compared with it.

    Left out are baselines that cannot be trusted, that lack a chamber of the recording or state it in another unit, the
    recording itself, and all but one copy (that with the most channels) of the same recording. What differs in speed,
    load and temperature is for the detectors to describe.
    """
    healthy = [recording if isinstance(recording, Learnt) else inspected(recording) for recording in baseline]
    chosen: dict[str, int] = {}
    left_out: dict[tuple[Severity, str], list[int]] = {}
    for k in sorted(range(len(healthy)), key=lambda k: -len(healthy[k].units)):
        earlier = healthy[k]
        same_units = all(earlier.units.get(name) == judged.units[name] for name in chambers_of(judged.part))
        kind: tuple[Severity, str] | None = None
        if isinstance(earlier, Inspection) and earlier.defect is not None:
            kind = "warning", earlier.defect
        elif earlier.digest == judged.digest:
            kind = "warning", "the same samples as the recording itself"
        elif not same_units:
            kind = "note", "other channels or units"
        elif earlier.digest in chosen:
            kind = "note", "the same samples as another baseline recording"
        if kind is None:
            chosen[earlier.digest] = k
        else:
            left_out.setdefault(kind, []).append(k)
    findings = []
    for (severity, reason), numbers in left_out.items():
        names = [healthy[k].file or f"number {k + 1}" for k in sorted(numbers)]
        count = f"{len(names)} of {len(healthy)} baseline recordings {'is' if len(names) == 1 else 'are'}"
        text = f"{count} left out: {reason} ({listed(names, 3)})"
        findings.append(Finding("baseline_left_out", severity, None, len(numbers), None, text))
    refusal = None
    if healthy and not chosen:
        most = max(left_out, key=lambda kind: len(left_out[kind]))
        refusal = f"no baseline recording can be used: {most[1]}"
    parts = (
        earlier.part if isinstance(earlier := healthy[k], Inspection) else earlier for k in sorted(chosen.values())
    )
    return Baselines(tuple(parts), tuple(findings), refusal)
