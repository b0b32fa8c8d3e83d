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
#: A wait longer than this many typical ones, and than a day, is a gap.
_GAP = 5.0
DAY = 86_400.0
_MOST_NAMES = 3


@dataclass(frozen=True, eq=False)
class Timeline:
    """Readings in the order of their times.

    `readings`: those that take part, `group` (n,): number of the group of each, within which they can be compared;
    `groups`: what each group is, in words; `left_out`: the others, each with the reason; `findings`: on the whole.
    """

    readings: tuple[LeakReading, ...]
    group: IntArray
    groups: tuple[str, ...]
    left_out: tuple[tuple[LeakReading, str], ...]
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
            f"the time of every recording must be known, got none of {_names(unknown)}: give --every 1d where they "
            "were made at equal intervals, in the order of their names, or put date and time into the names "
            "(press_20240531_0730.csv)"
        )
    ordered = sorted(readings, key=lambda reading: (reading.start or 0.0, natural(reading.file)))
    findings = _clock(ordered)
    left_out: list[tuple[LeakReading, str]] = []
    kept: list[LeakReading] = []
    seen: dict[str, str] = {}
    for reading in ordered:
        if reading.basis is None:
            left_out.append((reading, reading.problem))
        elif reading.digest in seen:
            left_out.append((reading, f"the same samples as {seen[reading.digest]}"))
        else:
            seen[reading.digest] = reading.file
            kept.append(reading)
    basis: Basis | None = None
    if kept:
        counts = [sum(reading.basis == own for reading in kept) for own in BASES]
        basis = BASES[int(np.argmax(counts))]
        others = [reading for reading in kept if reading.basis != basis]
        left_out += [(reading, f"its channels allow the {reading.basis}, not the {basis}") for reading in others]
        kept = [reading for reading in kept if reading.basis == basis]
    group, groups = _groups(kept)
    findings += _named(left_out, kept, group, groups)
    findings += _gaps(kept)
    return Timeline(tuple(kept), group, groups, tuple(left_out), tuple(findings), basis)


def _groups(readings: Sequence[LeakReading]) -> tuple[IntArray, tuple[str, ...]]:
    """Return the group of each reading, and what each group is, against the first reading."""
    first: list[LeakReading] = []
    texts: list[str] = []
    numbers = []
    for reading in readings:
        alike = [number for number, other in enumerate(first) if _apart(reading, other) is None]
        numbers.append(alike[0] if alike else len(first))
        if not alike:
            texts.append((_apart(reading, first[0]) or "") if first else "")
            first.append(reading)
    return np.array(numbers, dtype=np.int64), tuple(texts)


def _apart(reading: LeakReading, other: LeakReading) -> str | None:
    """Return why two readings cannot be compared, in words, None where they can."""
    if reading.scale is not None and other.scale is not None:
        change = reading.scale / other.scale - 1.0
        if abs(change) > SAME_SENSORS:
            return f"position or angle is scaled by {100.0 * change:+.2g} %: a sensor exchanged, or another machine"
    return None


#: A clock is set back a few times; numbers that fall more often do not follow the order.
_FEW_BACK = 2


def _clock(ordered: Sequence[LeakReading]) -> list[Finding]:
    """Return what shows that a clock was set back: recordings that overlap, or numbered names against the times."""
    overlaps = [
        (early, late)
        for early, late in pairwise(ordered)
        if early.digest != late.digest and (late.start or 0.0) < (early.start or 0.0) + 0.99 * early.duration
    ]
    if overlaps:
        early, late = overlaps[0]
        return [
            _finding(
                "clock",
                "warning",
                len(overlaps),
                f"{early.file} was still recording when {late.file} began: a clock was set back, or they are of two "
                "machines",
            )
        ]
    kinds = sorted({_kind(reading.file) for reading in ordered})
    if len(kinds) != 1:
        return _names_of_kinds(ordered, kinds)
    by_number = sorted(ordered, key=lambda reading: natural(reading.file))
    back = [(early, late) for early, late in pairwise(by_number) if (late.start or 0.0) < (early.start or 0.0)]
    if not back or len(back) > max(_FEW_BACK, len(ordered) // 10):  # numbers that say nothing of the order
        return []
    early, late = back[0]
    text = f"{late.file} is numbered after {early.file} and has an earlier time: a clock was set back"
    return [_finding("clock", "warning", len(back), text)]


def _kind(name: str) -> str:
    """Return the first word of a file's name, without numbers."""
    return re.split(r"[\d\W_]", name, maxsplit=1)[0].lower()


def _names_of_kinds(ordered: Sequence[LeakReading], kinds: Sequence[str]) -> list[Finding]:
    """Return that the names begin with few words, each with several recordings, as those of several machines do."""
    counts = {kind: sum(_kind(reading.file) == kind for reading in ordered) for kind in kinds}
    if len(kinds) > 3 or min(counts.values()) < 3 or "" in counts:
        return []
    listed = ", ".join(f"{count} as {kind!r}" for kind, count in counts.items())
    text = f"the names begin with {len(kinds)} words ({listed}): a trend is that of a single machine"
    return [_finding("names", "note", len(ordered), text)]


def _named(
    left_out: Sequence[tuple[LeakReading, str]], kept: Sequence[LeakReading], group: IntArray, groups: Sequence[str]
) -> list[Finding]:
    reasons: dict[str, list[str]] = {}
    texts: dict[str, str] = {}
    for reading, reason in left_out:
        alike = re.sub(r"\d[\d.]*", "#", reason)  # but for its numbers
        texts.setdefault(alike, reason)
        reasons.setdefault(alike, []).append(reading.file)
    total = len(left_out) + len(kept)
    findings = [
        _finding("left_out", "warning", len(files), f"{len(files)} of {total} left out: {texts[own]} ({_names(files)})")
        for own, files in reasons.items()
    ]
    for number in range(1, len(groups)):
        files = [reading.file for reading, own in zip(kept, group, strict=True) if own == number]
        text = f"{len(files)} of {total} compared among themselves only: {groups[number]} ({_names(files)})"
        findings.append(_finding("not_comparable", "note", len(files), text))
    return findings


def _gaps(kept: Sequence[LeakReading]) -> list[Finding]:
    starts = np.array([reading.start or 0.0 for reading in kept])
    waits = np.diff(starts)
    if waits.size < 3:
        return []
    gaps = np.flatnonzero(waits > max(_GAP * float(np.median(waits)), DAY))
    if not gaps.size:
        return []
    longest = int(gaps[int(np.argmax(waits[gaps]))])
    text = f"{gaps.size} gap{'s' if gaps.size > 1 else ''}, the longest of {waits[longest] / DAY:.3g} days after "
    return [_finding("gap", "note", int(gaps.size), text + kept[longest].file)]


def _finding(code: str, severity: Severity, count: int, text: str) -> Finding:
    return Finding(code, severity, None, count, None, text)


def _names(files: Sequence[str]) -> str:
    return ", ".join(files[:_MOST_NAMES]) + (", ..." if len(files) > _MOST_NAMES else "")
