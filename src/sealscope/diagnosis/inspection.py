"""Inspection of recordings before any detector sees them: what of them can be analysed, trusted and compared.

The judged recording and its leak-free baselines pass the same checks. Baselines that fail them, or that hold the
samples of another recording, are left out for all detectors alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.learnt import Healthy, Learnt
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.gaps import MOST_BRIDGED, bridge
from sealscope.recordings.hydraulics import lack_of_chambers, no_readings
from sealscope.recordings.motion import runs_of
from sealscope.recordings.quality import SHORTEST, Finding, Severity, inspect, uniform_segments
from sealscope.recordings.recording import Recording, remembered


@dataclass(frozen=True, eq=False)
class Inspection:
    """A recording as detectors see it.

    `part`: its longest uniformly sampled stretch with no chamber pressure and no command missing, gaps bridged where
    they can be (`recordings.gaps`); `findings` on the whole; `distrust`: why the chamber pressures cannot be trusted,
    None where they can; `share` of the whole that the stretch is.
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
            return f"needs {SHORTEST} samples or more without a gap, got {len(self.part)}"
        return self.distrust

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
    part = recording
    if "u" in part and not np.any(np.isfinite(part["u"])):  # `inspect` reports it; the pressures can do without
        part = part.only(name for name in part.channels if name != "u")
    needed = (*chambers, "u") if "u" in part else chambers
    part = bridge(part, needed)
    if part.bridged is not None:
        rows = np.flatnonzero(part.bridged)
        text = (
            f"{counted(rows.size, 'missing sample')} in {counted(len(runs_of(part.bridged)), 'gap')} bridged; blocks "
            f"with more than {MOST_BRIDGED:.0%} of them are left out"
        )
        findings.append(Finding("gaps_bridged", "note", None, rows.size, float(part.t[rows[0]]), text))
    stretches, count = uniform_segments(part, needed), len(part)
    if not stretches:
        part = part.between(math.inf, math.inf)
    else:
        longest = max(stretches, key=lambda stretch: stretch.stop - stretch.start)
        if longest.stop - longest.start < count:
            part = part.samples(longest)
            text = (
                f"only the longest whole stretch was analysed: {part.t[0]:.4g} s to {part.t[-1]:.4g} s, {len(part)} of "
                f"{count} samples"
            )
            left_out = count - len(part)
            findings.append(Finding("part_analysed", "warning", None, left_out, float(part.t[0]), text))
    spoiled = next((own for own in findings if own.channel in chambers and _spoils(own, len(part))), None)
    distrust = None if spoiled is None else f"the pressures cannot be trusted: {spoiled.text}"
    if distrust is None and len(part) >= SHORTEST and (reason := no_readings(part)):
        distrust = f"this is no recording of a hydraulic machine: {reason}"
    return Inspection(part, tuple(findings), distrust, len(part) / max(count, 1))


def _spoils(finding: Finding, samples: int) -> bool:
    """Return whether a finding on a chamber pressure of so many samples leaves no trust in its details.

    A chamber that empties into the tank stays at the rail for a while in any stroke.
    """
    return finding.code in ("constant", "stuck") or (finding.code == "clipped" and finding.count > samples / 2)


@dataclass(frozen=True, eq=False)
class Baselines:
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
    inspections = [_Healthy.of(recording) for recording in baseline]
    chosen: dict[str, int] = {}
    left_out: dict[tuple[Severity, str], list[int]] = {}
    for k in sorted(range(len(baseline)), key=lambda k: -len(inspections[k].units)):
        own = inspections[k]
        severity, reason = _refusal(judged, own)
        if reason is None and own.digest in chosen:
            severity, reason = "note", "the same samples as another baseline recording"
        if reason is None:
            chosen[own.digest] = k
        else:
            left_out.setdefault((severity, reason), []).append(k)
    findings = []
    for (severity, reason), numbers in left_out.items():
        names = [inspections[k].file or f"number {k + 1}" for k in sorted(numbers)]
        listed = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        count = f"{len(names)} of {len(baseline)} baseline recordings {'is' if len(names) == 1 else 'are'}"
        text = f"{count} left out: {reason} ({listed})"
        findings.append(Finding("baseline_left_out", severity, None, len(numbers), None, text))
    refusal = None
    if baseline and not chosen:
        most = max(left_out, key=lambda kind: len(left_out[kind]))
        refusal = f"no baseline recording can be used: {most[1]}"
    return Baselines(tuple(inspections[k].part for k in sorted(chosen.values())), tuple(findings), refusal)


class _Healthy(NamedTuple):
    """A healthy recording to compare with: itself, or what it taught; why it cannot be used, None where it can."""

    part: Healthy
    units: Mapping[str, str]
    digest: str
    defect: str | None
    file: str | None

    @classmethod
    def of(cls, healthy: Healthy) -> _Healthy:
        if isinstance(healthy, Learnt):
            return cls(healthy, healthy.units, healthy.digest, None, healthy.file)
        own, file = inspected(healthy), healthy.provenance.get("file")
        return cls(own.part, own.part.units, own.digest, own.defect, None if file is None else str(file))


def _refusal(judged: Inspection, own: _Healthy) -> tuple[Severity, str | None]:
    """Return why a baseline recording cannot be compared, None where it can, and how much that matters."""
    if own.defect is not None:
        return "warning", own.defect
    if own.digest == judged.digest:
        return "warning", "the same samples as the recording itself"
    alike = all(own.units.get(name) == judged.part.units[name] for name in chambers_of(judged.part))
    return "note", None if alike else "other channels or units"
