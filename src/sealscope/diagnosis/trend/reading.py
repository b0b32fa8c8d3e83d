"""Readings: the leakage of a single recording, and the order to compare a machine's readings in."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.detectors.detector import unusable
from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.inference.pressures.detector import PressureResponse
from sealscope.diagnosis.inference.volumes.detector import VolumeBalance
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.rms_change.blocks import JUDGED, whole_levels
from sealscope.diagnosis.trend.wear import DayToDay
from sealscope.diagnosis.verdict.machine import AssumedMachine, assumed_rig
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.formats.columns import listed
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.oil import oil_temperature
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.signals.details import QUANTITIES
from sealscope.storage.folders import by_numbers
from sealscope.units import DAY

#: What a level rests on, the most specific first: a conductance, but for `ringing`, the damping of the pressures'
#: details.
Basis = Literal["volume balance", "pressure response", "ringing"]
BASES: tuple[Basis, ...] = ("volume balance", "pressure response", "ringing")


@dataclass(frozen=True, eq=False, kw_only=True)
class LeakReading:
    """Level of leakage of one recording.

    `start`: of its first sample [s since 1970], None where not known, and `duration` [s]; `basis`, None where nothing
    can be stated, and `problem`: why; `level`: conductance of pump and piston together [m^3/(s Pa)], or a relative
    index, with its standard `error`; `states_flow`: whether L/min can be stated of it, and `area` [m^2] of the piston
    by which a speed of creep is a flow in the level's unit, None where it is in none; `pressure`: mean |p_A - p_B|;
    `temperature` of the oil [deg C], None where the file does not say; `scale`: displacement over area, over the
    assumed one; `machine`: what was assumed; `digest`: equal for copies.
    """

    file: str
    start: float | None
    duration: float
    basis: Basis | None = None
    level: float = np.nan
    error: float = np.nan
    states_flow: bool = False
    area: float | None = None
    pressure: float
    temperature: float | None
    scale: float | None = None
    machine: AssumedMachine | None
    digest: str
    problem: str = ""


def reading_of(recording: Recording, rig: Rig | str | os.PathLike[str] | None = None, file: str = "") -> LeakReading:
    """Estimate the level of leakage of a recording.

    `rig`: what may be assumed of the machine; None: as for `diagnose`, L/min only where the machine is known.
    """
    known, machine = assumed_rig(rig, recording)
    inspection = inspected(recording)
    part = inspection.part
    both = len(chambers_of(part)) == len(CHAMBERS) and len(part) > 0
    reading = LeakReading(
        file=file or str(recording.provenance.get("file", "recording")),
        start=start_seconds(recording, file),
        duration=recording.duration,
        pressure=float(np.mean(np.abs(part["p_A"] - part["p_B"]))) if both else float("nan"),
        temperature=oil_temperature(recording),
        machine=machine,
        digest=inspection.digest,
        problem=inspection.defect or "",
    )
    if reading.problem:
        return reading
    with np.errstate(all="ignore"):
        return replace(reading, **_estimate_level(part, known, machine))


def _estimate_level(part: Recording, rig: Rig, machine: AssumedMachine) -> dict[str, Any]:
    """Return the most specific level that a recording without a defect allows, or the problem."""
    balance, response = VolumeBalance(rig), PressureResponse(rig)
    lack, lacks = unusable(balance, part), unusable(response, part)
    solution = balance.balance(part) if lack is None else None
    if solution is not None and len(solution.columns) == 1:
        size, total = solution.size, solution.level
        area = machine.area if size.stated or ("x", "m") in solution.units else None
        return {
            "basis": BASES[0],
            "level": total.value * size.scale,
            "error": (total.high - total.low) * size.scale / (2.0 * WITHIN_95),
            "states_flow": size.stated,
            "area": area,
            "scale": None if size.ratio is None else size.ratio.value,
        }
    if lacks is None and (reading := response.reading(part)) is not None:
        area = machine.area if reading.stated else None
        level, error = reading.level
        return {"basis": BASES[1], "level": level, "error": error, "states_flow": reading.stated, "area": area}
    log_rms = whole_levels(part)[0].reshape(-1, len(QUANTITIES))
    ringing = float(-np.mean(log_rms[:, [QUANTITIES.index(name) for name in JUDGED]]))
    if np.isfinite(ringing):
        return {"basis": BASES[2], "level": ringing, "error": priors("trend")["own"]["ringing"]}
    why = dict.fromkeys(reason for reason in (lack, lacks) if reason) or ["the pressures do not ring"]
    return {"problem": "no detector states a level: " + "; ".join(why)}


def scatter_of(basis: Basis, usual: float) -> DayToDay:
    """Return the prior on the scatter of a level between recordings, for a machine of that usual level."""
    believed = priors("trend")["between"]
    if basis == "pressure response":
        return DayToDay(priors("inference.pressures")["conductance"]["level"], believed["freedom"])
    size = abs(usual) if basis == "volume balance" else 1.0
    return DayToDay(max(believed[basis] * size, float(np.finfo(float).tiny)), believed["freedom"])


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
    """Sort readings by time; return them and the difference of each comparable group from the first.

    `every`: time between them [s], in the order of their names. Raises InputError where the time of one is not known.
    """
    ordered = sorted(readings, key=lambda reading: by_numbers(reading.file))
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
    points, scales, most = [], list[float | None](), priors("trend")["own"]["scale"]
    for reading, problem in zip(ordered, notes, strict=True):
        other = "" if reading.basis == basis else f"its channels allow the {reading.basis}, not the {basis}"
        note = problem or other
        matching = (n for n, scale in enumerate(scales) if abs(_change(reading.scale, scale)) <= most)
        group = -1 if note else next(matching, len(scales))
        if group == len(scales):
            scales.append(reading.scale)
        start = reading.start or 0.0
        day = (start - (ordered[0].start or 0.0)) / DAY
        points.append(TrendPoint(**vars(reading) | {"start": start}, day=day, group=group, note=note))
    differences = [
        f"position or angle is scaled by {100.0 * _change(scale, scales[0]):+.2g} %: a sensor exchanged, or another "
        "machine"
        for scale in scales
    ]
    return points, ("", *differences[1:]) if scales else ()


def findings_of(points: Sequence[TrendPoint], differences: Sequence[str]) -> list[Finding]:
    """Return findings on the clock, on readings left out, one a reason, and on separate groups."""
    findings, count = _clock(points), len(points)
    reasons: dict[str, list[TrendPoint]] = {}
    for point in points:
        if point.note:
            reasons.setdefault(re.sub(r"\d[\d.]*", "#", point.note), []).append(point)  # alike but for its numbers
    for left_out in reasons.values():
        text = f"{len(left_out)} of {count} left out: {left_out[0].note} ({_names(left_out)})"
        findings.append(Finding("left_out", "warning", None, len(left_out), None, text))
    for number, difference in enumerate(differences[1:], 1):
        members = [point for point in points if point.group == number]
        text = f"{len(members)} of {count} compared among themselves only: {difference} ({_names(members)})"
        findings.append(Finding("not_comparable", "note", None, len(members), None, text))
    return findings


def _names(readings: Iterable[LeakReading]) -> str:
    return listed((reading.file for reading in readings), 3)


def _change(scale: float | None, other: float | None) -> float:
    return 0.0 if scale is None or other is None else scale / other - 1.0


def _clock(ordered: Sequence[TrendPoint]) -> list[Finding]:
    """Find signs of a clock set back: overlapping recordings, or numbered names against the times.

    Recordings of one date without times of day have the same start.
    """
    overlaps = [
        f"{early.file} was still recording when {late.file} began: a clock was set back, or they are of two machines"
        for early, late in pairwise(ordered)
        if early.digest != late.digest and 0.0 < late.start - early.start < 0.99 * early.duration
    ]
    back = [
        f"{late.file} is numbered after {early.file} and has an earlier time: a clock was set back"
        for early, late in pairwise(sorted(ordered, key=lambda reading: by_numbers(reading.file)))
        if late.start < early.start
    ]
    same_stem = len({re.split(r"[\d\W_]", reading.file, maxsplit=1)[0].lower() for reading in ordered}) == 1
    # numbers that fall more often are no order
    texts = overlaps or (back if same_stem and len(back) <= max(2, len(ordered) // 10) else [])
    return [Finding("clock", "warning", None, len(texts), None, texts[0])] if texts else []
