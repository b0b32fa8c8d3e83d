"""Inspection of recordings before any detector sees them: what of them can be analysed, trusted and compared.

The judged recording and its leak-free baselines pass the same checks. Baselines that fail them, or that hold the
samples of another recording, are left out for all detectors alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.learnt import Healthy, Learnt
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.corrections.clock import even_clock
from sealscope.recordings.corrections.gaps import bridge, filled
from sealscope.recordings.corrections.spikes import without_spikes
from sealscope.recordings.corrections.stale import MOST_STUCK, stuck_rows, without_stale_samples
from sealscope.recordings.corrections.unsigned import with_signed_speed
from sealscope.recordings.formats.columns import counted, listed
from sealscope.recordings.hydraulics import lack_of_chambers, no_readings
from sealscope.recordings.motion import runs_of
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
    part = recording
    if "u" in part and not np.any(np.isfinite(part["u"])):  # `inspect` reports it; the pressures can do without
        part = part.only(name for name in part.channels if name != "u")
    needed = (*chambers, "u") if "u" in part else chambers
    stuck = {name: rows for name in chambers if (rows := stuck_rows(part, name)).any()}
    held = [name for name, rows in stuck.items() if np.mean(rows) > MOST_STUCK]
    missing = {name: np.where(rows, np.nan, part[name]) for name, rows in stuck.items() if name not in held}
    part = replace(part, channels={**part.channels, **missing}) if missing else part
    for correct in (without_spikes, without_stale_samples):
        part, found = correct(part)
        findings += found
    count = len(part)
    part = even_clock(part)
    dropped = max(0, count - len(part))
    part, found = with_signed_speed(part)
    findings += found
    part = filled(bridge(part, needed), needed)
    if part.bridged is not None:
        rows = np.flatnonzero(part.bridged)
        text = (
            f"{counted(rows.size, 'missing sample')} in {counted(len(runs_of(part.bridged)), 'gap')} bridged: what a "
            "long one touches counts less"
        )
        findings.append(Finding("gaps_bridged", "note", None, rows.size, float(part.t[rows[0]]), text))
    known = np.flatnonzero(np.all([np.isfinite(part[name]) for name in needed], axis=0)) if needed else np.empty(0)
    count = len(part) + dropped
    if known.size < len(part) or dropped:
        part = part.samples(slice(int(known[0]), int(known[-1]) + 1) if known.size else slice(0, 0))
        if known.size:
            text = f"analysed from {part.t[0]:.4g} s to {part.t[-1]:.4g} s: {len(part)} of {count} samples"
            findings.append(Finding("part_analysed", "warning", None, count - len(part), float(part.t[0]), text))
    wrong = [own for own in findings if own.channel in chambers and own.code == "constant"]
    wrong += [own for own in findings if own.channel in held and own.code == "stuck"]
    lost = [own for own in findings if own.channel in chambers and own.code == "clipped" and own.count > len(part) / 2]
    wrong += lost if len(lost) == len(chambers) else []  # else the other one says what it says
    distrust = f"the pressures cannot be trusted: {wrong[0].text}" if wrong else None
    if distrust is None and len(part) >= SHORTEST and (reason := no_readings(part)):
        distrust = f"this is no recording of a hydraulic machine: {reason}"
    return Inspection(part, tuple(findings), distrust, len(part) / max(count, 1))


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
    healthy = [own if isinstance(own, Learnt) else inspected(own) for own in baseline]
    chosen: dict[str, int] = {}
    left_out: dict[tuple[Severity, str], list[int]] = {}
    for k in sorted(range(len(healthy)), key=lambda k: -len(healthy[k].units)):
        own = healthy[k]
        alike = all(own.units.get(name) == judged.units[name] for name in chambers_of(judged.part))
        kind: tuple[Severity, str] | None = None
        if isinstance(own, Inspection) and own.defect is not None:
            kind = "warning", own.defect
        elif own.digest == judged.digest:
            kind = "warning", "the same samples as the recording itself"
        elif not alike:
            kind = "note", "other channels or units"
        elif own.digest in chosen:
            kind = "note", "the same samples as another baseline recording"
        if kind is None:
            chosen[own.digest] = k
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
    parts = (own.part if isinstance(own := healthy[k], Inspection) else own for k in sorted(chosen.values()))
    return Baselines(tuple(parts), tuple(findings), refusal)
