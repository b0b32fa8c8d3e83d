"""Judge a campaign's rows: thresholds from its leak-free records, verdicts on all the others, and what they add up
to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.judging.estimates import Estimate, Named, Onset, estimates_of, named_of, onsets_of
from sealscope.campaigns.plans.detectors import Views, plan_detector
from sealscope.diagnosis.baseline.operating_point import OperatingPoint
from sealscope.diagnosis.calibration.scorers import scorer
from sealscope.diagnosis.calibration.thresholds import Calibration, Place, calibrate
from sealscope.errors import InputError
from sealscope.evaluation.auc import Area, auc
from sealscope.evaluation.binomial import Rate, rate_of
from sealscope.evaluation.confusion import CANNOT_TELL
from sealscope.evaluation.hit_miss import HitMiss, fit_hit_miss
from sealscope.evaluation.pod import SizeRate, by_size, proven_size
from sealscope.evaluation.roc import Roc, roc_curve
from sealscope.evaluation.table import ALWAYS, NEVER, Outcome, SummaryRow, summary


@dataclass(frozen=True)
class Pod:
    """One detector over the size of the leak: the rate at each size, the logistic curve through hits and misses
    (None where there is none, `why`), and the smallest size `proven` without a curve to be found nine times in ten."""

    detector: str
    rates: tuple[SizeRate, ...]
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
class Cell:
    """Alarms of one detector at one size of leak (0: none) in one cell of the factors."""

    detector: str
    leak_lpm: float
    levels: Mapping[str, str | float]
    alarms: Rate


@dataclass(frozen=True)
class FaultAlarms:
    """Alarms of one detector on records with a fault that is no piston leak."""

    detector: str
    fault: str
    alarms: Rate
    cannot_tell: Rate


@dataclass(frozen=True)
class Judgement:
    """What a campaign shows.

    `table` by size, `overall` with all leaks together; `estimates` of the flow, `named` causes: of detectors that state
    them; `calibration`: None where every detector has a threshold of its own; `calibrated_on`, `judged`: records that
    had a result; `failed`: rows that had none (they are `cannot tell` for every detector); `realised`: size -> mean and
    standard deviation of the flow the leaks really had [L/min].
    """

    calibration: Calibration | None
    calibrated_on: int
    judged: int
    failed: tuple[CaseRow, ...]
    table: tuple[SummaryRow, ...]
    overall: tuple[SummaryRow, ...]
    onsets: tuple[Onset, ...]
    estimates: tuple[Estimate, ...]
    named: tuple[Named, ...]
    pods: tuple[Pod, ...]
    rocs: tuple[SizeRoc, ...]
    cells: tuple[Cell, ...]
    faults: tuple[FaultAlarms, ...]
    realised: Mapping[float, tuple[float, float]]


def place_from(tree: Mapping[str, Any]) -> Place:
    """The place of a row, from its plain values."""
    point = dict(tree["point"])
    return Place(
        OperatingPoint(**{**point, **{name: tuple(point[name]) for name in ("units", "chambers")}}),
        float(tree["duration_s"]),
    )


def calibration_of(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    *,
    rate: float,
    promise: Any = "average",
    confidence: float = 0.95,
    split_share: float = 0.5,
    made_from: Mapping[str, Any] | None = None,
    views: Views | None = None,
) -> Calibration | None:
    """Thresholds of the detectors that need them, from the rows that are there to calibrate; None where none needs
    any."""
    wanted = [name for name in detectors if plan_detector(name).needs_calibration]
    known = [row for row in rows if row.use == "calibrate" and row.error is None]
    if not wanted:
        return None
    return calibrate(
        [place_from(row.place) for row in known],
        {name: [row.scores[name][0] for row in known] for name in wanted},
        rate=rate,
        promise=promise,
        confidence=confidence,
        split_share=split_share,
        made_from={**(made_from or {}), "records": len(known)},
        views=views,
    )


def own_threshold(name: str) -> float | None:
    """The threshold that a scorer has of its own; None where records must set it, or a detector's verdict counts."""
    found = plan_detector(name)
    return None if found.detector else scorer(found.of).threshold


def verdict_on(row: CaseRow, detector: str, calibration: Calibration | None, own: float | None) -> str:
    """What a detector says of a row: its own verdict, or by its own threshold, else by the calibration's at the row's
    operating point."""
    if row.error is not None:
        return CANNOT_TELL
    if row.statements and plan_detector(detector).own:
        return row.statements[plan_detector(detector).key].verdict
    value = row.scores[detector][0]
    threshold = own
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
) -> Judgement:
    """Verdicts and figures of all rows to judge.

    `thresholds`: the detectors' own, by default those of their scorers; `onset_s` [s]: true onset in leaky records,
    `hours`: operating time of a record; without them no delays or hourly rates are given. Raises InputError where
    there is no row to judge.
    """
    own = {name: own_threshold(name) for name in detectors} if thresholds is None else thresholds
    mine = sorted((row for row in rows if row.use == "judge"), key=lambda row: row.id)
    if not mine:
        raise InputError("a campaign needs at least one record to judge, got none")
    said = {(name, row.id): verdict_on(row, name, calibration, own[name]) for name in detectors for row in mine}
    plain = [row for row in mine if not row.fault]
    outcomes = _outcomes(plain, detectors, said, hours)
    return Judgement(
        calibration=calibration,
        calibrated_on=sum(row.use == "calibrate" and row.error is None for row in rows),
        judged=sum(row.error is None for row in mine),
        failed=tuple(row for row in sorted(rows, key=lambda row: row.id) if row.error is not None),
        table=tuple(summary(outcomes, confidence)) if plain else (),
        overall=tuple(_any_size(outcomes, confidence)) if plain else (),
        onsets=tuple(onsets_of(plain, detectors, said, onset_s, confidence)),
        estimates=tuple(estimates_of(plain, detectors, confidence)),
        named=tuple(named_of(mine, detectors, confidence)),
        pods=tuple(_pods(plain, detectors, said, confidence)),
        rocs=tuple(_rocs(plain, detectors, confidence)),
        cells=tuple(_cells(plain, detectors, said, confidence)),
        faults=tuple(_faults(mine, detectors, said, confidence)),
        realised=_realised(plain),
    )


def _outcomes(
    rows: Sequence[CaseRow], detectors: Sequence[str], said: Mapping[tuple[str, str], str], hours: float | None
) -> list[Outcome]:
    return [Outcome(name, row.id, row.leak_lpm, said[name, row.id], hours) for name in detectors for row in rows]


def _any_size(outcomes: Sequence[Outcome], confidence: float) -> list[SummaryRow]:
    """The table with all leaks in one row."""
    found = summary([replace(one, leak_lpm=1.0 if one.leak_lpm else 0.0) for one in outcomes], confidence)
    return [replace(row, leak_lpm=math.nan) for row in found]


def _pods(
    rows: Sequence[CaseRow], detectors: Sequence[str], said: Mapping[tuple[str, str], str], confidence: float
) -> list[Pod]:
    leaky = [row for row in rows if row.leak_lpm > 0]
    found = []
    for name in detectors if leaky else ():
        sizes = [row.leak_lpm for row in leaky]
        hits = [said[name, row.id] == "leak" for row in leaky]
        rates = tuple(by_size(sizes, hits, confidence))
        curve, why = None, ""
        try:
            curve = fit_hit_miss(sizes, hits)
        except InputError as error:
            why = str(error)
        found.append(Pod(name, rates, curve, why, proven_size(list(rates))))
    return found


def _rocs(rows: Sequence[CaseRow], detectors: Sequence[str], confidence: float) -> list[SizeRoc]:
    """Over the scores, so that no threshold comes in; a record that cannot be told counts as the lowest score."""
    found = []
    sizes = sorted({row.leak_lpm for row in rows if row.leak_lpm > 0})
    for name in detectors:
        known = [value for row in rows if row.error is None and (value := row.scores[name][0]) is not None]
        if not known:
            continue
        lowest = min(known) - 1.0

        def scores(size: float, name: str = name, lowest: float = lowest) -> list[float]:
            chosen = [row for row in rows if (row.leak_lpm > 0 if math.isnan(size) else row.leak_lpm == size)]
            here = [row.scores[name][0] if row.error is None else None for row in chosen]
            return [lowest if value is None else value for value in here]

        free = scores(0.0)
        for size in (math.nan, *sizes) if len(free) > 1 and sizes else ():
            leaky = scores(size)
            if len(leaky) > 1:
                found.append(SizeRoc(name, size, roc_curve(free, leaky, confidence), auc(free, leaky, confidence)))
    return found


def _cells(
    rows: Sequence[CaseRow], detectors: Sequence[str], said: Mapping[tuple[str, str], str], confidence: float
) -> list[Cell]:
    groups: dict[tuple[float, tuple[tuple[str, str | float], ...]], list[CaseRow]] = {}
    for row in rows:
        groups.setdefault((row.leak_lpm, tuple(row.levels.items())), []).append(row)
    order = sorted(groups, key=lambda key: (key[0], repr(key[1])))
    return [
        Cell(
            name, size, dict(levels), rate_of(sum(said[name, row.id] == "leak" for row in here), len(here), confidence)
        )
        for name in detectors
        for size, levels in order
        for here in (groups[size, levels],)
    ]


def _faults(
    rows: Sequence[CaseRow], detectors: Sequence[str], said: Mapping[tuple[str, str], str], confidence: float
) -> list[FaultAlarms]:
    found = []
    by_fault: dict[str, list[CaseRow]] = {}
    for row in sorted(rows, key=lambda row: row.fault):
        if row.fault and row.leak_lpm == 0:
            by_fault.setdefault(row.fault, []).append(row)
    for name in (*detectors, ALWAYS, NEVER) if by_fault else ():
        for fault, here in by_fault.items():
            n = len(here)
            verdicts = [{ALWAYS: "leak", NEVER: "no leak"}.get(name) or said[name, row.id] for row in here]
            alarms = rate_of(verdicts.count("leak"), n, confidence)
            found.append(FaultAlarms(name, fault, alarms, rate_of(verdicts.count(CANNOT_TELL), n, confidence)))
    return found


def _realised(rows: Sequence[CaseRow]) -> dict[float, tuple[float, float]]:
    found = {}
    for size in sorted({row.leak_lpm for row in rows if row.leak_lpm > 0}):
        flows = [row.flow_lpm for row in rows if row.leak_lpm == size and row.flow_lpm is not None]
        if flows:
            spread = float(np.std(flows, ddof=1)) if len(flows) > 1 else math.nan
            found[size] = (float(np.mean(flows)), spread)
    return found
