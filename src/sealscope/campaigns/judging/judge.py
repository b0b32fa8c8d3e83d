"""Judge a campaign's rows: thresholds from its leak-free records, verdicts on all the others, and what they add up to.

The verdicts give detection and false alarms by size of leak; what detectors state beyond a verdict is compared with the
truth: when the leak began, how large it is, what the fault is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sealscope.campaigns.cases.row import NO_CAUSE, PISTON_LEAK, CaseRow, cause_of, covers, named_cause
from sealscope.campaigns.judging.families import FamilyFinding, family_findings
from sealscope.campaigns.plans.detectors import Views, plan_detector
from sealscope.diagnosis.calibration.scorers import scorer
from sealscope.diagnosis.calibration.thresholds import Calibration, Place, calibrate
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.confusion import CANNOT_TELL, Confusion, confusion_matrix
from sealscope.evaluation.estimates import (
    EstimateError,
    OnsetErrors,
    estimate_error,
    onset_errors,
    quantile_of,
)
from sealscope.evaluation.pod import HitMiss, SizeDetection, by_size, fit_hit_miss, proven_size
from sealscope.evaluation.roc import Area, Roc, auc, roc_curve
from sealscope.evaluation.table import ALWAYS, NEVER, JudgedRecord, SummaryRow, summary
from sealscope.storage.plain_values import as_type

#: (detector, row id) -> verdict
Verdicts = Mapping[tuple[str, str], str]


@dataclass(frozen=True)
class DetectorPod:
    """One detector's probability of detection over the size of the leak.

    `sizes`: the detection at each size; `curve`: the logistic curve through hits and misses, None where there is none,
    for the reason `why`; `proven`: the smallest size found nine times in ten without a curve.
    """

    detector: str
    sizes: tuple[SizeDetection, ...]
    curve: HitMiss | None
    why: str
    proven: float


@dataclass(frozen=True)
class SizeRoc:
    """One detector's ROC at one size of leak (nan: all sizes), against the leak-free records to judge."""

    detector: str
    leak_lpm: float
    curve: Roc
    area: Area


@dataclass(frozen=True)
class CellAlarms:
    """Alarms of one detector at one size of leak (0: none) in one cell of the factors."""

    detector: str
    leak_lpm: float
    levels: Mapping[str, str | float]
    alarms: Proportion


@dataclass(frozen=True)
class FaultAlarms:
    """Alarms of one detector on records with a fault that is no piston leak.

    `named`: alarms that name the fault's cause, alone or with the piston (`piston or pump leak` of a pump leak); None
    where the detector names no cause.
    """

    detector: str
    fault: str
    alarms: Proportion
    cannot_tell: Proportion
    named: Proportion | None = None


@dataclass(frozen=True)
class OnsetAccuracy:
    """Errors [s] of the onsets that one detector stated in its alarms at one size of leak."""

    detector: str
    leak_lpm: float
    errors: OnsetErrors


@dataclass(frozen=True)
class FlowAccuracy:
    """Errors of the flow that one detector states at one size of leak (0: leak-free records), alarm or not.

    `errors`: mean, and coverage of the stated interval; `median` (signed) and `median_size` of the error.
    """

    detector: str
    leak_lpm: float
    errors: EstimateError
    median: IntervalEstimate
    median_size: IntervalEstimate


@dataclass(frozen=True)
class NamedCauses:
    """Which cause one detector names for which there is; `none` where nothing leaks and no fault is put in.

    `covered`: records for which it names the true cause, alone or with the one that no channel tells from it.
    """

    detector: str
    confusion: Confusion
    covered: Proportion


@dataclass(frozen=True)
class Judgement:
    """What a campaign shows.

    `table` by size, `overall` with all leaks together; `onsets`, `flows` and `causes`: of detectors that state them;
    `calibration`: None where every detector has a threshold of its own; `calibrated_on`, `judged`: records that had a
    result; `failed`: rows that had none (they are `cannot tell` for every detector); `realised`: size -> mean and
    standard deviation of the flow the leaks really had [L/min]; `families`: what is found in each family of machines.
    """

    calibration: Calibration | None
    calibrated_on: int
    judged: int
    failed: tuple[CaseRow, ...]
    table: tuple[SummaryRow, ...]
    overall: tuple[SummaryRow, ...]
    onsets: tuple[OnsetAccuracy, ...]
    flows: tuple[FlowAccuracy, ...]
    causes: tuple[NamedCauses, ...]
    pods: tuple[DetectorPod, ...]
    rocs: tuple[SizeRoc, ...]
    cells: tuple[CellAlarms, ...]
    faults: tuple[FaultAlarms, ...]
    realised: Mapping[float, tuple[float, float]]
    families: tuple[FamilyFinding, ...] = ()


def place_from(tree: Mapping[str, Any]) -> Place:
    """Return the place of a row from its plain values; ValueError where they are none."""
    return as_type(Place, dict(tree))


def calibration_of(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    *,
    false_alarm: float,
    promise: Any = "average",
    confidence: float = 0.95,
    split_share: float = 0.5,
    made_from: Mapping[str, Any] | None = None,
    views: Views | None = None,
) -> Calibration | None:
    """Return thresholds of the detectors that need them, from the rows to calibrate; None where none needs any."""
    wanted = [name for name in detectors if plan_detector(name).needs_calibration]
    leak_free = [row for row in rows if row.use == "calibrate" and row.error is None]
    if not wanted:
        return None
    return calibrate(
        [place_from(row.place) for row in leak_free],
        {name: [row.scores[name][0] for row in leak_free] for name in wanted},
        false_alarm_probability=false_alarm,
        promise=promise,
        confidence=confidence,
        split_share=split_share,
        made_from={**(made_from or {}), "records": len(leak_free)},
        views=views,
    )


def own_threshold(name: str) -> float | None:
    """Return a scorer's own threshold; None where records must set it, or a detector's verdict counts."""
    detector = plan_detector(name)
    return None if detector.detector else scorer(detector.of).threshold


def verdict_on(row: CaseRow, detector: str, calibration: Calibration | None, own: float | None) -> str:
    """Return a detector's verdict on a row.

    It is the one it stated, or by its own threshold, else by the calibration's at the row's operating point.
    """
    if row.error is not None:
        return CANNOT_TELL
    if row.statements and plan_detector(detector).own:
        return row.statements[plan_detector(detector).key].verdict
    value, threshold = row.scores[detector][0], own
    if threshold is None and calibration is not None:
        group = calibration.find(place_from(row.place))
        if isinstance(group, str) or detector not in group.thresholds:
            return CANNOT_TELL
        threshold = group.thresholds[detector].value
    if value is None or threshold is None:
        return CANNOT_TELL
    return "leak" if value > threshold else "no leak"


def judge(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    calibration: Calibration | None,
    *,
    thresholds: Mapping[str, float | None] | None = None,
    onset_s: float | None = None,
    hours: float | None = None,
    confidence: float = 0.95,
    false_alarm: float = 0.01,
) -> Judgement:
    """Return verdicts and figures of all rows to judge.

    `thresholds`: the detectors' own, by default those of their scorers; `onset_s` [s]: true onset in leaky records,
    `hours`: operating time of a record; without them no errors of onsets or alarms per hour are given.
    `false_alarm`: the probability at which the bound's best test is taken. Raises InputError where there is no row to
    judge.
    """
    own = {name: own_threshold(name) for name in detectors} if thresholds is None else thresholds
    judged = sorted((row for row in rows if row.use == "judge"), key=lambda row: row.id)
    if not judged:
        raise InputError("a campaign needs at least one record to judge, got none")
    verdicts = {(name, row.id): verdict_on(row, name, calibration, own[name]) for name in detectors for row in judged}
    plain = [row for row in judged if not row.fault]
    records = [
        JudgedRecord(name, row.id, row.leak_lpm, verdicts[name, row.id], hours) for name in detectors for row in plain
    ]
    return Judgement(
        calibration=calibration,
        calibrated_on=sum(row.use == "calibrate" and row.error is None for row in rows),
        judged=sum(row.error is None for row in judged),
        failed=tuple(row for row in sorted(rows, key=lambda row: row.id) if row.error is not None),
        table=tuple(summary(records, confidence)) if plain else (),
        overall=tuple(_any_size(records, confidence)) if plain else (),
        onsets=tuple(_onsets(plain, detectors, verdicts, onset_s, confidence)),
        flows=tuple(_flows(plain, detectors, confidence)),
        causes=tuple(_causes(judged, detectors, confidence)),
        pods=tuple(_pods(plain, detectors, verdicts, confidence)),
        rocs=tuple(_rocs(plain, detectors, confidence)),
        cells=tuple(_cells(plain, detectors, verdicts, confidence)),
        faults=tuple(_faults(judged, detectors, verdicts, confidence)),
        realised=_realised(plain),
        families=tuple(family_findings(plain, detectors, verdicts, false_alarm=false_alarm, confidence=confidence)),
    )


def _leak_sizes(rows: Sequence[CaseRow]) -> list[float]:
    return sorted({row.leak_lpm for row in rows if row.leak_lpm > 0})


def _any_size(records: Sequence[JudgedRecord], confidence: float) -> list[SummaryRow]:
    """Return the table with all leaks in one row."""
    together = [replace(record, leak_lpm=1.0 if record.leak_lpm else 0.0) for record in records]
    return [replace(row, leak_lpm=math.nan) for row in summary(together, confidence)]


def _pods(
    rows: Sequence[CaseRow], detectors: Sequence[str], verdicts: Verdicts, confidence: float
) -> list[DetectorPod]:
    leaky = [row for row in rows if row.leak_lpm > 0]
    pods = []
    for name in detectors if leaky else ():
        sizes = [row.leak_lpm for row in leaky]
        hits = [verdicts[name, row.id] == "leak" for row in leaky]
        detections = by_size(sizes, hits, confidence)
        curve, why = None, ""
        try:
            curve = fit_hit_miss(sizes, hits)
        except InputError as error:
            why = str(error)
        pods.append(DetectorPod(name, tuple(detections), curve, why, proven_size(detections)))
    return pods


def _rocs(rows: Sequence[CaseRow], detectors: Sequence[str], confidence: float) -> list[SizeRoc]:
    """Return curves over the scores, with no threshold; a record that cannot be judged counts as the lowest score."""
    rocs = []
    sizes = _leak_sizes(rows)
    for name in detectors:
        known = [value for row in rows if row.error is None and (value := row.scores[name][0]) is not None]
        if not known:
            continue
        lowest = min(known) - 1.0

        def scores(size: float, name: str = name, lowest: float = lowest) -> list[float]:
            chosen = [row for row in rows if (row.leak_lpm > 0 if math.isnan(size) else row.leak_lpm == size)]
            values = [row.scores[name][0] if row.error is None else None for row in chosen]
            return [lowest if value is None else value for value in values]

        free = scores(0.0)
        for size in (math.nan, *sizes) if len(free) > 1 and sizes else ():
            leaky = scores(size)
            if len(leaky) > 1:
                rocs.append(SizeRoc(name, size, roc_curve(free, leaky, confidence), auc(free, leaky, confidence)))
    return rocs


def _cells(
    rows: Sequence[CaseRow], detectors: Sequence[str], verdicts: Verdicts, confidence: float
) -> list[CellAlarms]:
    groups: dict[tuple[float, tuple[tuple[str, str | float], ...]], list[CaseRow]] = {}
    for row in rows:
        groups.setdefault((row.leak_lpm, tuple(row.levels.items())), []).append(row)
    cells = []
    for name in detectors:
        for size, levels in sorted(groups, key=lambda key: (key[0], repr(key[1]))):
            here = groups[size, levels]
            count = sum(verdicts[name, row.id] == "leak" for row in here)
            cells.append(CellAlarms(name, size, dict(levels), proportion(count, len(here), confidence)))
    return cells


def _faults(
    rows: Sequence[CaseRow], detectors: Sequence[str], verdicts: Verdicts, confidence: float
) -> list[FaultAlarms]:
    faults = []
    by_fault: dict[str, list[CaseRow]] = {}
    for row in sorted(rows, key=lambda row: row.fault):
        if row.fault and row.leak_lpm == 0:
            by_fault.setdefault(row.fault, []).append(row)
    for name in (*detectors, ALWAYS, NEVER) if by_fault else ():
        for fault, here in by_fault.items():
            given = [{ALWAYS: "leak", NEVER: "no leak"}.get(name) or verdicts[name, row.id] for row in here]
            alarms, unsure = (proportion(given.count(word), len(here), confidence) for word in ("leak", CANNOT_TELL))
            faults.append(FaultAlarms(name, fault, alarms, unsure, _naming(name, here, given, confidence)))
    return faults


def _naming(name: str, rows: Sequence[CaseRow], verdicts: Sequence[str], confidence: float) -> Proportion | None:
    """Return how many alarms on records of a fault name its cause; None where the detector states no cause."""
    if name in (ALWAYS, NEVER):
        return None
    statements = [_statement(row, name) for row in rows]
    if not any(statements):
        return None
    named = [
        stated is not None and verdict == "leak" and covers(named_cause(stated), cause_of(row.fault))
        for row, stated, verdict in zip(rows, statements, verdicts, strict=True)
    ]
    return proportion(sum(named), len(named), confidence)


def _realised(rows: Sequence[CaseRow]) -> dict[float, tuple[float, float]]:
    realised = {}
    for size in _leak_sizes(rows):
        flows = [row.flow_lpm for row in rows if row.leak_lpm == size and row.flow_lpm is not None]
        if flows:
            spread = float(np.std(flows, ddof=1)) if len(flows) > 1 else math.nan
            realised[size] = (float(np.mean(flows)), spread)
    return realised


def _statement(row: CaseRow, detector: str) -> Evidence | None:
    """Return what a detector stated on a row; None where it states nothing, or the record failed."""
    return row.statements.get(plan_detector(detector).key) if row.statements and row.error is None else None


def _ends(pairs: Sequence[tuple[float, float] | None]) -> tuple[list[float], list[float]]:
    ends = [(math.nan, math.nan) if pair is None else pair for pair in pairs]
    return [low for low, _ in ends], [high for _, high in ends]


def _onsets(
    rows: Sequence[CaseRow], detectors: Sequence[str], verdicts: Verdicts, onset_s: float | None, confidence: float
) -> list[OnsetAccuracy]:
    """Return, for detectors that search for the onset, its error over the alarms, by size."""
    onsets = []
    for name in detectors if onset_s is not None else ():
        for size in _leak_sizes(rows):
            alarmed = [row for row in rows if row.leak_lpm == size and verdicts[name, row.id] == "leak"]
            timed = [(at, row) for row in alarmed if (at := row.scores[name][1]) is not None]
            if not timed or onset_s is None:
                continue
            statements = [_statement(row, name) for _, row in timed]
            low, high = _ends([None if stated is None else stated.onset_interval_s for stated in statements])
            errors = onset_errors([at for at, _ in timed], [onset_s] * len(timed), low, high, confidence)
            onsets.append(OnsetAccuracy(name, size, errors))
    return onsets


def _flows(rows: Sequence[CaseRow], detectors: Sequence[str], confidence: float) -> list[FlowAccuracy]:
    """Return, for detectors that state a flow, its errors against the flow that the record really had, by size."""
    flows = []
    for name in _stating(rows, detectors):
        for size in sorted({row.leak_lpm for row in rows}):
            own = [(row, ev) for row in rows if row.leak_lpm == size and (ev := _statement(row, name)) is not None]
            truth = [row.leak_lpm if row.flow_lpm is None else row.flow_lpm for row, _ in own]
            given = [math.nan if ev.leak_lpm is None else ev.leak_lpm for _, ev in own]
            if not np.isfinite(given).any():
                continue
            low, high = _ends([ev.leak_interval_lpm for _, ev in own])
            error = np.array(given) - np.array(truth)
            error = error[np.isfinite(error)]
            flows.append(
                FlowAccuracy(
                    name,
                    size,
                    estimate_error(given, truth, low, high, confidence),
                    quantile_of(error, 0.5, confidence),
                    quantile_of(np.abs(error), 0.5, confidence),
                )
            )
    return flows


def _causes(rows: Sequence[CaseRow], detectors: Sequence[str], confidence: float) -> list[NamedCauses]:
    """Return, for detectors judged by their own verdict, the causes they name, where there are faults.

    A record with a leak and another fault is left out; one that failed is `cannot tell`.
    """
    single = [row for row in rows if not (row.leak_lpm > 0 and row.fault)]
    if not any(row.fault for row in single):
        return []
    order = sorted({cause_of(row.fault) for row in single if row.fault})
    truth = [PISTON_LEAK if row.leak_lpm > 0 else cause_of(row.fault) if row.fault else NO_CAUSE for row in single]
    causes = [cause for cause in (NO_CAUSE, PISTON_LEAK) if cause in truth] + order
    tables = []
    for name in _stating(rows, detectors):
        if not plan_detector(name).own:
            continue
        statements = [_statement(row, name) for row in single]
        named = [CANNOT_TELL if stated is None else named_cause(stated) for stated in statements]
        others = sorted(set(named) - set(causes) - {CANNOT_TELL})
        covered = proportion(sum(map(covers, named, truth)), len(truth), confidence)
        tables.append(NamedCauses(name, confusion_matrix(truth, named, [*causes, *others], confidence), covered))
    return tables


def _stating(rows: Sequence[CaseRow], detectors: Sequence[str]) -> list[str]:
    """Return the detectors that state evidence, each once: by a calibrated threshold it states the same."""
    keys = {key for row in rows for key in row.statements}
    by_key: dict[str, str] = {}
    for name in detectors if keys else ():
        detector = plan_detector(name)
        if detector.key in keys and (detector.own or detector.key not in by_key):
            by_key[detector.key] = name
    return list(by_key.values())
