"""The order of readings: their times, what of them is left out, and which can be compared with which."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sealscope.diagnosis.trend.reading import BASES, Basis, LeakReading
from sealscope.errors import InputError
from sealscope.recordings.quality import Finding, Severity
from sealscope.signals.filters import IntArray

#: Readings whose displacement over area differs by more were not taken by the same sensors, or of another machine.
SAME_SENSORS = 0.01
DAY = 86_400.0
#: Most names that a finding lists, and most times that a clock is set back: numbers that fall more often are no order.
_MOST_NAMES, _FEW_BACK = 3, 2


@dataclass(frozen=True, eq=False)
class Timeline:
    """Readings in the order of their times.

    `group` (n,): number of the group of each, within which they can be compared, -1 where it is left out, for the
    reason `notes`; `groups`: what each group is, in words; `findings`: on the whole; `basis` of those that take part.
    """

    readings: tuple[LeakReading, ...]
    group: IntArray
    notes: tuple[str, ...]
    groups: tuple[str, ...]
    findings: tuple[Finding, ...]
    basis: Basis | None


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return what orders names with numbers as people do: day_2 before day_10."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts)


def spaced(readings: Sequence[LeakReading], every: float) -> list[LeakReading]:
    """Return readings as if they began `every` seconds apart, in the order of their names."""
    ordered = sorted(readings, key=lambda reading: natural(reading.file))
    return [replace(reading, start=k * every) for k, reading in enumerate(ordered)]


def timeline(readings: Sequence[LeakReading]) -> Timeline:
    """Order readings by their times, and sort out what cannot be compared.

    Raises InputError where the time of a reading is not known.
    """
    unknown = [reading.file for reading in readings if reading.start is None]
    if unknown:
        raise InputError(
            f"the time of every recording must be known, got none of {_names(unknown)}: put the date into the names "
            "(press_20240531.csv, press_20240531_0730.csv), or give every (such as 1d) where they were made at equal "
            "intervals, in the order of their names"
        )
    ordered = sorted(readings, key=lambda reading: (reading.start or 0.0, natural(reading.file)))
    first: dict[str, str] = {}
    notes = []
    for reading in ordered:
        copy = first.setdefault(reading.digest, reading.file) if reading.basis is not None else reading.file
        notes.append(reading.problem or ("" if copy == reading.file else f"the same samples as {copy}"))
    kept = [reading.basis for reading, note in zip(ordered, notes, strict=True) if not note]
    basis: Basis | None = max(BASES, key=kept.count) if kept else None
    for k, reading in enumerate(ordered):
        if not notes[k] and reading.basis != basis:
            notes[k] = f"its channels allow the {reading.basis}, not the {basis}"
    group, groups = _groups(ordered, notes)
    findings = [*_clock(ordered), *_named(ordered, notes, group, groups)]
    return Timeline(tuple(ordered), group, tuple(notes), groups, tuple(findings), basis)


def _groups(readings: Sequence[LeakReading], notes: Sequence[str]) -> tuple[IntArray, tuple[str, ...]]:
    """Return the group of each reading, and what each group is: of one scale, in words against the first reading."""
    scales: list[float | None] = []
    numbers = np.full(len(readings), -1)
    for k, (reading, note) in enumerate(zip(readings, notes, strict=True)):
        if not note:
            alike = [
                number for number, scale in enumerate(scales) if abs(_change(reading.scale, scale)) <= SAME_SENSORS
            ]
            numbers[k] = alike[0] if alike else len(scales)
            scales += [] if alike else [reading.scale]
    texts = [
        f"position or angle is scaled by {100.0 * _change(scale, scales[0]):+.2g} %: a sensor exchanged, or another "
        "machine"
        for scale in scales[1:]
    ]
    return numbers, ("", *texts) if scales else ()


def _change(scale: float | None, other: float | None) -> float:
    return 0.0 if scale is None or other is None else scale / other - 1.0


def _clock(ordered: Sequence[LeakReading]) -> list[Finding]:
    """Return what shows that a clock was set back: recordings that overlap, or numbered names against the times.

    Recordings of one date without times of day have the same start.
    """
    timed = [(reading.start or 0.0, reading) for reading in ordered]
    overlaps = [
        f"{early.file} was still recording when {late.file} began: a clock was set back, or they are of two machines"
        for (begin, early), (start, late) in pairwise(timed)
        if early.digest != late.digest and begin < start < begin + 0.99 * early.duration
    ]
    numbered = sorted(timed, key=lambda own: natural(own[1].file))
    back = [
        f"{late.file} is numbered after {early.file} and has an earlier time: a clock was set back"
        for (begin, early), (start, late) in pairwise(numbered)
        if start < begin
    ]
    alike = len({re.split(r"[\d\W_]", reading.file, maxsplit=1)[0].lower() for reading in ordered}) == 1
    texts = overlaps or (back if alike and len(back) <= max(_FEW_BACK, len(ordered) // 10) else [])
    return [_finding("clock", "warning", len(texts), texts[0])] if texts else []


def _named(
    readings: Sequence[LeakReading], notes: Sequence[str], group: IntArray, groups: Sequence[str]
) -> list[Finding]:
    """Return findings on what is left out, one for each reason, and on what is compared among itself only."""
    reasons: dict[str, list[int]] = {}
    for k, note in enumerate(notes):
        if note:
            reasons.setdefault(re.sub(r"\d[\d.]*", "#", note), []).append(k)  # alike but for its numbers
    total, findings = len(readings), []
    for rows in reasons.values():
        text = f"{len(rows)} of {total} left out: {notes[rows[0]]} ({_names([readings[k].file for k in rows])})"
        findings.append(_finding("left_out", "warning", len(rows), text))
    for number in range(1, len(groups)):
        files = [reading.file for reading, own in zip(readings, group, strict=True) if own == number]
        text = f"{len(files)} of {total} compared among themselves only: {groups[number]} ({_names(files)})"
        findings.append(_finding("not_comparable", "note", len(files), text))
    return findings


def _finding(code: str, severity: Severity, count: int, text: str) -> Finding:
    return Finding(code, severity, None, count, None, text)


def _names(files: Sequence[str]) -> str:
    return ", ".join(files[:_MOST_NAMES]) + (", ..." if len(files) > _MOST_NAMES else "")
