"""Estimate the leakage of single recordings ("readings"), and sort a machine's readings for comparison."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np

from sealscope.diagnosis.assumed_rig import assumed_rig
from sealscope.diagnosis.detectors.registry import limit_threads, unusable_reason
from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.healthy import healthy_summaries
from sealscope.diagnosis.hold.hold_test import judge_held_recording
from sealscope.diagnosis.hold.recorded_holds import date_hold, held_leakage
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.comparison import RecordingSums
from sealscope.diagnosis.inference.equations.terms import Flow
from sealscope.diagnosis.inference.pressures.leak import conductance_scale_error
from sealscope.diagnosis.inference.pressures.response_detector import PressureResponse
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.diagnosis.priors.trend import TREND
from sealscope.diagnosis.rms_change.rms_detector import JUDGED, DetailSummary, RmsChange, measure_levels
from sealscope.diagnosis.trend.wear import ScatterPrior
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine
from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.parameters import Rig
from sealscope.recordings.channels import CHAMBERS, chambers_of
from sealscope.recordings.header import oil_temperature, start_seconds
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.signals.details import QUANTITIES
from sealscope.storage.folders import numeric_sort_key
from sealscope.units import DAY, LITRE_PER_MINUTE

#: Methods of estimating a leakage level, the most specific first. The level is a conductance; for "ringing" it is the
#: damping of the pressures' wavelet details.
Basis = Literal["hold test", "volume balance", "pressure response", "ringing"]
BASES: tuple[Basis, ...] = get_args(Basis)


@dataclass(frozen=True, eq=False, kw_only=True)
class LeakReading:
    """Leakage of a machine in one recording."""

    file: str  # name of the recording
    start: float | None  # time of its first sample [s since 1970]
    duration: float  # [s]
    basis: Basis | None = None  # method by which the level was estimated, None if there is no level
    problem: str = ""  # reason why there is no level
    # leakage conductance of pump and piston together [m^3/(s Pa)], or minus the mean log RMS of the pressures' wavelet
    # details ("ringing"), and its standard error; relative to the assumed machine unless `states_flow`
    level: float = np.nan
    error: float = np.nan
    states_flow: bool = False  # True if the level can be stated in L/min
    area: float | None = None  # piston area [m^2] that converts a creep speed to a flow on the level's scale
    pressure: float  # mean of abs(p_A - p_B) [Pa], nan if a chamber pressure is missing
    temperature: float | None  # temperature of the oil [deg C]
    scale: float | None = None  # measured ratio of displacement to area, relative to the assumed ratio
    machine: AssumedMachine | None  # what was assumed of the machine
    digest: str  # hash of the chamber pressures, equal for copies
    pump: float = np.nan  # mean flow of the pump [m^3/s]; by the volume balance only while the machine moves
    size_error: float = 0.0  # relative standard error of flows due to the machine's sizes (displacement, piston area)
    sums: RecordingSums | None = None  # sums of the volume balance
    terms: tuple[ColumnRoles, ...] = ()  # roles of its columns, one entry for each equation
    ringing: DetailSummary | None = None  # summary of the pressures' ringing (RMS of their wavelet details)


def estimate_reading(
    recording: Recording, rig: Rig | str | os.PathLike[str] | None = None, file: str = ""
) -> LeakReading:
    """Estimate the leakage of a recording; if that is impossible, `problem` of the result states the reason.

    `rig` states the sizes of the machine, as for `diagnose`. If it is None, a rig is assumed (`assumed_rig`), and L/min
    can be stated only for a simulation with its sizes, or with a flow meter (`LeakReading.states_flow`). `file` is the
    recording's name, by default that of its file.
    """
    used_rig, machine = assumed_rig(rig, recording)
    inspection = inspect_recording(recording)
    part = inspection.part  # corrected samples that can be used
    has_difference = len(chambers_of(part)) == len(CHAMBERS) and len(part) > 0  # p_A - p_B is known
    reading = LeakReading(
        file=file or str(recording.provenance.get("file", "recording")),
        start=start_seconds(recording, file),
        duration=recording.duration,
        pressure=float(np.mean(np.abs(part["p_A"] - part["p_B"]))) if has_difference else float("nan"),
        temperature=oil_temperature(recording),
        machine=machine,
        digest=inspection.digest,
        problem=inspection.defect or "",
    )
    if (held := _hold_fields(recording, machine)) is not None:
        return replace(reading, problem="", **held)
    if reading.problem:
        return reading
    with limit_threads(), np.errstate(all="ignore"):  # numbers of impossible readings may overflow
        reading = replace(reading, **_estimate_level(part, used_rig, machine))
    if reading.basis is not None and not np.isfinite([reading.level, reading.error]).all():
        return replace(reading, basis=None, problem=f"the {reading.basis} states no finite level")
    return reading


def _estimate_level(part: Recording, rig: Rig, machine: AssumedMachine) -> dict[str, Any]:
    """Estimate the leakage by the most specific of `BASES` that the channels of a recording's usable `part` allow.

    `rig` has the sizes of the `machine`. Returns the fields of `LeakReading` that depend on the method; only `problem`
    if no method is possible.
    """
    balance, response, details = VolumeBalance(rig), PressureResponse(rig), RmsChange()
    balance_lack, response_lack = unusable_reason(balance, part), unusable_reason(response, part)
    ringing = healthy_summaries(details, [part] if unusable_reason(details, part) is None else [])
    fields: dict[str, Any] = {"ringing": ringing[0] if ringing else None}
    solution = balance.balance(part) if balance_lack is None else None
    if solution is not None and solution.flow is not Flow.VALVE:  # several balances have no common leak
        return fields | _balance_fields(solution, machine)
    if response_lack is None and (reading := response.reading(part)) is not None:
        level, error = reading.level
        mean_pump_flow, _ = reading.pump_flow
        return fields | {
            "basis": "pressure response",
            "level": level,
            "error": error,
            "states_flow": reading.stated,
            "area": machine.area if reading.stated else None,
            "pump": mean_pump_flow,
            "size_error": conductance_scale_error(),
        }
    log_rms, _ = measure_levels(part)
    log_rms_by_chamber = log_rms.reshape(-1, len(QUANTITIES))  # a row for each chamber
    damping = float(-np.mean(log_rms_by_chamber[:, [QUANTITIES.index(name) for name in JUDGED]]))
    if np.isfinite(damping):
        return fields | {"basis": "ringing", "level": damping, "error": TREND.reading.ringing}
    reasons = dict.fromkeys(lack for lack in (balance_lack, response_lack) if lack is not None)  # each once
    return {"problem": "no detector states a level: " + "; ".join(reasons or ["the pressures do not ring"])}


def _hold_fields(recording: Recording, machine: AssumedMachine) -> dict[str, Any] | None:
    """Collect the fields of `LeakReading` that follow from a hold test; None if the recording is of no held load.

    The level is the leak of the longest hold over its pressure. Without stated areas the assumed ones give a level that
    is relative, as those of other methods.
    """
    areas = machine.areas if machine.areas is not None else (machine.area,)
    fields = _held_level(judge_held_recording(recording, areas))
    if fields is None:
        return None
    return {**fields, "states_flow": machine.area_stated, "area": areas[0] if machine.area_stated else None}


def _held_level(holds: Sequence[HoldResult]) -> dict[str, Any] | None:
    """Collect method, level, its error and pressure of the longest hold; None if its flow or pressure is unknown."""
    leakage = held_leakage(holds) if holds else None
    if leakage is None or leakage.lpm is None or leakage.interval_lpm is None or not leakage.pressure > 0.0:
        return None
    low, high = leakage.interval_lpm
    scale = LITRE_PER_MINUTE / leakage.pressure
    return {
        "basis": "hold test",
        "level": leakage.lpm * scale,
        "error": (high - low) * scale / (2.0 * WITHIN_95),
        "pressure": leakage.pressure,
    }


def hold_reading(result: HoldResult) -> LeakReading:
    """Convert the result of a hold test to a reading of a trend; `problem` says why it states no level, if so."""
    start_s = result.start_s or 0.0
    fields = _held_level([result])
    if fields is None:
        fields = {"problem": "the hold test states no leak in L/min with its pressure (--area, a chamber's pressure)"}
    return LeakReading(
        **{"pressure": math.nan, **fields},
        file=result.file,
        start=date_hold(result),
        duration=(result.end_s or start_s) - start_s,
        states_flow=True,
        area=1e-6 * result.areas_mm2[0] if result.areas_mm2 else None,
        temperature=None,
        machine=None,
        digest=f"{result.start} {result.start_s} {result.leak_lpm} {result.pressure_bar}",
    )


def _balance_fields(solution: RecordedBalance, machine: AssumedMachine) -> dict[str, Any]:
    """Collect the fields of `LeakReading` that follow from a solved volume balance, by name.

    True flows and conductances are `size.scale` (`recorded.Size`) times those of the balance with assumed sizes.
    """
    size, flow = solution.size, solution.total_flow
    level, error = solution.conductance.value, solution.conductance.deviation
    if flow is not None:  # the total of the verdict; errors that repeat in all recordings change no trend
        level, error = (number / solution.mean_pressure() for number in (flow.value, flow.noise))
    return {
        "basis": "volume balance",
        "level": level * size.scale,
        "error": error * size.scale,
        "states_flow": size.stated,
        # the area has a meaning only if it is stated, or if the position is in metres
        "area": machine.area if size.stated or solution.recording.units.get("x") == "m" else None,
        # not `size.scale`: the measured over the assumed ratio of displacement to area
        "scale": None if size.ratio is None else size.ratio.value,
        "pump": solution.blocks.moving_flow * size.scale,
        "size_error": size.deviation,
        "sums": solution.recording_sums,
        "terms": solution.columns,
    }


def scatter_prior(basis: Basis, usual: float) -> ScatterPrior:
    """Make the prior on the standard deviation of a healthy machine's leakage level between recordings.

    For the volume balance and hold tests its scale is proportional to the typical level `usual`, else constant.
    """
    between = TREND.between
    if basis == "pressure response":
        return ScatterPrior(PRESSURE.conductance.level, between.freedom)
    shares = {"volume balance": between.volume_balance, "hold test": between.hold_test}
    scale = shares[basis] * abs(usual) if basis in shares else between.ringing
    return ScatterPrior(max(scale, float(np.finfo(float).tiny)), between.freedom)  # must be above 0


@dataclass(frozen=True, kw_only=True)
class TrendPoint(LeakReading):
    """The leakage of one recording in a trend, with the time and group of the recording.

    In addition to the fields of `LeakReading`:

    Attributes
    ----------
    start, day : float
        Time of the first sample [s since 1970], and since the first recording [days].
    group : int
        Number of the group of recordings that can be compared with each other; -1 if the recording is left out.
    note : str
        Reason why the recording is left out, or a remark on its level; "" if there is none.
    value, low, high : float or None
        Leakage and the 95 % interval of its error, in the trend's unit; None if the recording is left out.
    """

    start: float
    day: float
    group: int
    note: str
    value: float | None = None
    low: float | None = None
    high: float | None = None

    def seconds_since_1970(self, day: float) -> float:
        """Convert a time of the trend, in days since its first recording, to seconds since 1970."""
        return self.start + (day - self.day) * DAY


def build_timeline(
    readings: Sequence[LeakReading], every: float | None = None
) -> tuple[list[TrendPoint], tuple[str, ...]]:
    """Sort leakage readings by time and group those that can be compared with each other.

    Only readings of the most frequent method are used. Those of a group have nearly the same measured ratio of pump
    displacement to piston area, which differs between sensors and machines. `every` is the time between readings [s],
    by which they are dated in the order of their file names; None if their times are known. Returns the readings with
    their groups, and for each group a text on its difference from the first group, "" for the first. Raises InputError
    if the time of a reading is unknown.
    """
    ordered = _sort_by_time(readings, every)
    notes = _note_problems(ordered)
    groups, scales = _group_scales([reading.scale for reading, note in zip(ordered, notes, strict=True) if not note])
    used_groups = iter(groups)
    points = []
    for reading, note in zip(ordered, notes, strict=True):
        start = reading.start or 0.0  # no start is None after sorting
        fields = vars(reading) | {"start": start, "day": (start - (ordered[0].start or 0.0)) / DAY}
        points.append(TrendPoint(**fields, group=-1 if note else next(used_groups), note=note))
    cause = "a sensor exchanged, or another machine"
    percents = (100.0 * (scale / scales[0] - 1.0) for scale in scales[1:])
    differences = (f"position or angle is scaled by {percent:+.2g} %: {cause}" for percent in percents)
    return points, ("", *differences) if groups else ()


def _group_scales(scales: Sequence[float | None]) -> tuple[list[int], list[float]]:
    """Group readings with nearly the same ratio of displacement to area.

    `scales` are the measured ratios. Sorted by size, neighbouring ratios are of one group unless their logarithms
    differ by more than a limit. Returns the group number of each reading and the first ratio of each group. Groups are
    numbered from 0 in the order of their first ratio; a reading whose ratio is unknown or not positive counts to group
    0.
    """
    known = sorted({scale for scale in scales if scale is not None and scale > 0.0})
    gaps = np.diff(np.log(known))
    prior = TREND.reading
    limit = math.log1p(prior.scale)
    # the recordings of some machines do not determine the ratio well, so that it scatters
    if len(gaps) >= prior.fewest:
        limit += prior.scatter * float(np.median(gaps))
    # by ratio, the number of its cluster, counted from the smallest ratio; not strict, for the case of no known ratio
    clusters: dict[float | None, int] = dict(zip(known, np.cumsum([0, *(gaps > limit)]).tolist(), strict=False))
    first_ratios: dict[int, float] = {}  # of each cluster, in the order of the readings
    for scale in scales:
        if scale is not None and scale in clusters:
            first_ratios.setdefault(clusters[scale], scale)
    numbers = {cluster: number for number, cluster in enumerate(first_ratios)}
    return [numbers[clusters[scale]] if scale in clusters else 0 for scale in scales], list(first_ratios.values())


def _sort_by_time(readings: Sequence[LeakReading], every: float | None) -> list[LeakReading]:
    """Sort readings by time.

    `every` [s] replaces all start times, known ones too, by 0, `every`, 2 `every` and so on in the order of the names.
    Raises InputError if a time is unknown.
    """
    ordered = sorted(readings, key=lambda reading: numeric_sort_key(reading.file))
    if every is not None:
        ordered = [replace(reading, start=k * every) for k, reading in enumerate(ordered)]
    if unknown := [reading for reading in ordered if reading.start is None]:
        raise InputError(
            f"the time of every recording must be known, got none of {_join_files(unknown)}: put the date into the "
            "names (press_20240531.csv, press_20240531_0730.csv), or give every (such as 1d) if they were made at "
            "equal intervals, in the order of their names"
        )
    return sorted(ordered, key=lambda reading: reading.start or 0.0)  # no start is None any more


def _note_problems(readings: Sequence[LeakReading]) -> list[str]:
    """List the reason why each reading is left out: no level, a copy, or a method other than that of most readings.

    The text is "" for a reading that is used. Of methods with equally many readings, the most specific one counts.
    """
    file_of_digest: dict[str, str] = {}
    notes = []
    for reading in readings:
        original = reading.file
        if reading.basis is not None:  # the first file with the same samples
            original = file_of_digest.setdefault(reading.digest, reading.file)
        copy_note = "" if original == reading.file else f"the same samples as {original}"
        notes.append(reading.problem or copy_note)
    bases = [reading.basis for reading, note in zip(readings, notes, strict=True) if not note]
    basis: Basis | None = max(BASES, key=bases.count) if bases else None  # the first of equally frequent ones
    return [
        note or ("" if reading.basis == basis else f"its channels allow the {reading.basis}, not the {basis}")
        for reading, note in zip(readings, notes, strict=True)
    ]


def list_findings(points: Sequence[TrendPoint], differences: Sequence[str]) -> list[Finding]:
    """List the findings on a trend: wrong times, recordings left out, and groups that cannot be compared.

    `points` and `differences` are those of `build_timeline`. Recordings left out for reasons that differ only in
    numbers share one finding.
    """
    findings, count = _find_clock_errors(points), len(points)
    points_by_reason: dict[str, list[TrendPoint]] = {}
    for point in points:
        if point.note:
            without_numbers = re.sub(r"\d[\d.]*", "#", point.note)
            points_by_reason.setdefault(without_numbers, []).append(point)
    for left_out in points_by_reason.values():
        text = f"{len(left_out)} of {count} left out: {left_out[0].note} ({_join_files(left_out)})"
        findings.append(Finding("left_out", "warning", channel=None, count=len(left_out), first_t=None, text=text))
    for number, difference in enumerate(differences[1:], 1):
        members = [point for point in points if point.group == number]
        text = f"{len(members)} of {count} compared among themselves only: {difference} ({_join_files(members)})"
        findings.append(Finding("not_comparable", "note", channel=None, count=len(members), first_t=None, text=text))
    return findings


def _join_files(readings: Iterable[LeakReading]) -> str:
    """Join up to three file names of recordings to a text for messages."""
    return join_names((reading.file for reading in readings), 3)


def _find_clock_errors(ordered: Sequence[TrendPoint]) -> list[Finding]:
    """Find signs that a logger's clock was set back; return one finding, or an empty list.

    The recordings are `ordered` by time. The first sign is recordings that overlap; those dated without a time of day
    have the same start and do not count. The second sign is times that fall while the numbers in the file names rise,
    if the names seem to be numbered in the order of time.
    """
    overlaps = [
        f"{early.file} was still recording when {late.file} began: a clock was set back, or they are of two machines"
        for early, late in pairwise(ordered)
        if early.digest != late.digest and 0.0 < late.start - early.start < 0.99 * early.duration  # starts are rounded
    ]
    falls = [
        f"{late.file} is numbered after {early.file} and has an earlier time: a clock was set back"
        for early, late in pairwise(sorted(ordered, key=lambda reading: numeric_sort_key(reading.file)))
        if late.start < early.start
    ]
    first_words = {re.split(r"[\d\W_]", reading.file, maxsplit=1)[0].lower() for reading in ordered}
    # with different words, or many falls, the names are not numbered in the order of time
    are_numbered = len(first_words) == 1 and len(falls) <= max(2, len(ordered) // 10)
    texts = overlaps or (falls if are_numbered else [])
    return [Finding("clock", "warning", None, count=len(texts), first_t=None, text=texts[0])] if texts else []
