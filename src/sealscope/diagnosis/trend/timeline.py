"""Readings of a machine in the order of their times, and which of them can be compared."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.trend.reading import BASES, Basis, LeakReading
from sealscope.errors import InputError
from sealscope.recordings.quality import Finding
from sealscope.units import DAY


@dataclass(frozen=True, kw_only=True)
class TrendPoint(LeakReading):
    """The reading of a recording in a trend.

    `day` since the first one; `group` of comparable readings, -1 where it is left out, for the reason `note`; `value`
    and 95 % interval of its own error in the trend's unit, None where it is left out.
    """

    start: float
    day: float
    group: int
    note: str
    value: float | None = None
    low: float | None = None
    high: float | None = None


def timeline(readings: Sequence[LeakReading], every: float | None = None) -> tuple[list[TrendPoint], tuple[str, ...]]:
    """Return readings in the order of their times, and what sets each group of comparable ones apart from the first.

    `every`: time between them [s], in the order of their names. Raises InputError where the time of one is not known.
    """
    ordered = sorted(readings, key=lambda reading: _natural(reading.file))
    if every is not None:
        ordered = [replace(reading, start=k * every) for k, reading in enumerate(ordered)]
    if unknown := [reading for reading in ordered if reading.start is None]:
        raise InputError(
            f"the time of every recording must be known, got none of {_names(unknown)}: put the date into the names "
            "(press_20240531.csv, press_20240531_0730.csv), or give every (such as 1d) where they were made at equal "
            "intervals, in the order of their names"
        )
    ordered.sort(key=lambda reading: reading.start or 0.0)
    first: dict[str, str] = {}
    notes = []
    for reading in ordered:
        copy = first.setdefault(reading.digest, reading.file) if reading.basis is not None else reading.file
        notes.append(reading.problem or ("" if copy == reading.file else f"the same samples as {copy}"))
    kept = [reading.basis for reading, note in zip(ordered, notes, strict=True) if not note]
    basis: Basis | None = max(BASES, key=kept.count) if kept else None
    points, scales = [], list[float | None]()
    for reading, problem in zip(ordered, notes, strict=True):
        other = "" if reading.basis == basis else f"its channels allow the {reading.basis}, not the {basis}"
        note = problem or other
        alike = (n for n, scale in enumerate(scales) if _alike(reading.scale, scale))
        group = -1 if note else next(alike, len(scales))
        if group == len(scales):
            scales.append(reading.scale)
        start = reading.start or 0.0
        day = (start - (ordered[0].start or 0.0)) / DAY
        points.append(TrendPoint(**vars(reading) | {"start": start}, day=day, group=group, note=note))
    apart = [
        f"position or angle is scaled by {100.0 * _change(scale, scales[0]):+.2g} %: a sensor exchanged, or another "
        "machine"
        for scale in scales
    ]
    return points, ("", *apart[1:]) if scales else ()


def findings_of(points: Sequence[TrendPoint], apart: Sequence[str]) -> list[Finding]:
    """Return findings on the clock, on what is left out, one for each reason, and on what is compared apart."""
    findings, count = _clock(points), len(points)
    reasons: dict[str, list[TrendPoint]] = {}
    for point in points:
        if point.note:
            reasons.setdefault(re.sub(r"\d[\d.]*", "#", point.note), []).append(point)  # alike but for its numbers
    for own in reasons.values():
        text = f"{len(own)} of {count} left out: {own[0].note} ({_names(own)})"
        findings.append(Finding("left_out", "warning", None, len(own), None, text))
    for number, difference in enumerate(apart[1:], 1):
        own = [point for point in points if point.group == number]
        text = f"{len(own)} of {count} compared among themselves only: {difference} ({_names(own)})"
        findings.append(Finding("not_comparable", "note", None, len(own), None, text))
    return findings


def _names(readings: Sequence[LeakReading]) -> str:
    return ", ".join(reading.file for reading in readings[:3]) + (", ..." if len(readings) > 3 else "")


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Return what orders names with numbers as people do: day_2 before day_10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def _change(scale: float | None, other: float | None) -> float:
    return 0.0 if scale is None or other is None else scale / other - 1.0


def _alike(scale: float | None, other: float | None) -> bool:
    return bool(abs(_change(scale, other)) <= beliefs("trend")["own"]["scale"])


def _clock(ordered: Sequence[TrendPoint]) -> list[Finding]:
    """Return what shows that a clock was set back: recordings that overlap, or numbered names against the times.

    Recordings of one date without times of day have the same start.
    """
    overlaps = [
        f"{early.file} was still recording when {late.file} began: a clock was set back, or they are of two machines"
        for early, late in pairwise(ordered)
        if early.digest != late.digest and 0.0 < late.start - early.start < 0.99 * early.duration
    ]
    back = [
        f"{late.file} is numbered after {early.file} and has an earlier time: a clock was set back"
        for early, late in pairwise(sorted(ordered, key=lambda reading: _natural(reading.file)))
        if late.start < early.start
    ]
    alike = len({re.split(r"[\d\W_]", reading.file, maxsplit=1)[0].lower() for reading in ordered}) == 1
    # numbers that fall more often are no order
    texts = overlaps or (back if alike and len(back) <= max(2, len(ordered) // 10) else [])
    return [Finding("clock", "warning", None, len(texts), None, texts[0])] if texts else []
