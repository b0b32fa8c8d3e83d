"""Judge a campaign's rows: thresholds from its leak-free records, verdicts on all others, and what they add up to.

The verdicts give detection and false alarms by size of leak; what detectors state beyond a verdict is compared with the
truth: when the leak began, how large it is, what the fault is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from sealscope.campaigns.cases.bound import smallest_detectable
from sealscope.campaigns.cases.case import FAMILY
from sealscope.campaigns.cases.row import (
    NO_CAUSE,
    PISTON_LEAK,
    CaseRow,
    Statement,
    cause_of,
    covers,
    duty_of,
    named_cause,
)
from sealscope.campaigns.plans.detectors import plan_detector
from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.estimates import EstimateError, OnsetErrors, estimate_error, onset_errors, quantile_of
from sealscope.evaluation.pod import HitMiss, SizeDetection, by_size, fit_hit_miss, proven_size
from sealscope.evaluation.roc import Area, Roc, auc, roc_curve
from sealscope.evaluation.table import ALWAYS, CANNOT_TELL, NEVER, Confusion, SummaryRow, confusion_matrix, summary
from sealscope.evaluation.thresholds import Promise, Threshold, quantile_threshold, records_needed

_K = TypeVar("_K")
#: (detector, row id) -> verdict
Verdicts = Mapping[tuple[str, str], str]
#: (detector, duty) -> threshold from leak-free records of that duty
Thresholds = Mapping[tuple[str, str], Threshold]
#: What stands for all families together, and for all laws of a leak.
ALL, ANY_LAW = "all", "any"
#: Probability with which the best test finds a leak that the bound allows.
ALLOWED_DETECTION = 0.9


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
class AlarmShares:
    """Alarms of one detector on records that have something in common.

    `leak_lpm` (0: no leak) and `law` of the leak, `fault` that is no leak, `family` of machines, `levels` of the
    factors: what they have in common, where it was asked for. `coverage`: how often a stated interval holds the flow
    that there was; `named`: alarms that name the fault's cause, alone or with the piston, None where the detector names
    no cause; `reachable`: records whose leak the Cramer-Rao bound of their machine allows to find, over those that have
    a bound, and `allowed`: alarms over these, both None where there is no bound; `failed`: records without a result,
    which are among those that cannot be told.
    """

    detector: str
    alarms: Proportion
    cannot_tell: Proportion
    coverage: Proportion
    leak_lpm: float = 0.0
    law: str = ANY_LAW
    fault: str = ""
    family: str = ALL
    levels: Mapping[str, str | float] = field(default_factory=dict)
    named: Proportion | None = None
    reachable: Proportion | None = None
    allowed: Proportion | None = None
    failed: int = 0


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
    `thresholds`: of scorers, from `leak_free` records; `judged`: records that had a result; `failed`: rows that had
    none (they are `cannot tell` for every detector); `cells`, `faults`, `families`: alarms by cell of the factors, by
    fault that is no leak, by family of machines; `realised`: size -> mean and standard deviation of the flow the leaks
    really had [L/min].
    """

    thresholds: Thresholds
    leak_free: int
    judged: int
    failed: tuple[CaseRow, ...]
    table: tuple[SummaryRow, ...]
    overall: tuple[SummaryRow, ...]
    onsets: tuple[OnsetAccuracy, ...]
    flows: tuple[FlowAccuracy, ...]
    causes: tuple[NamedCauses, ...]
    pods: tuple[DetectorPod, ...]
    rocs: tuple[SizeRoc, ...]
    cells: tuple[AlarmShares, ...]
    faults: tuple[AlarmShares, ...]
    families: tuple[AlarmShares, ...]
    realised: Mapping[float, tuple[float, float]]


def thresholds_of(
    rows: Iterable[CaseRow],
    detectors: Sequence[str],
    false_alarm: float,
    promise: Promise = "average",
    confidence: float = 0.95,
) -> Thresholds:
    """Return the thresholds of the scorers that need one, from the leak-free rows of each duty.

    A row without a score raises no alarm and counts as the lowest. Raises InputError where no duty has enough rows,
    saying how many it takes.
    """
    wanted = [name for name in detectors if plan_detector(name).needs_threshold]
    by_duty: dict[str, list[CaseRow]] = {}
    for row in rows:
        if row.use == "calibrate" and row.error is None:
            by_duty.setdefault(duty_of(row.levels), []).append(row)
    needed = records_needed(false_alarm, confidence if promise == "bound" else None)
    most = max(map(len, by_duty.values()), default=0)
    if wanted and most < needed:
        raise InputError(f"leak-free records must be at least {needed} of a duty, got at most {most}")
    thresholds = {}
    for name in wanted:
        for duty, own in by_duty.items():
            known = [value for row in own if (value := row.scores[name][0]) is not None]
            if known and len(own) >= needed:
                scores = known + [min(known)] * (len(own) - len(known))
                thresholds[name, duty] = quantile_threshold(scores, false_alarm, confidence, promise)
    return thresholds


def judge(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    *,
    false_alarm: float = 0.01,
    promise: Promise = "average",
    confidence: float = 0.95,
    own: Mapping[str, float] | None = None,
    onset_s: float | None = None,
    hours: float | None = None,
) -> Judgement:
    """Return verdicts and figures of all rows to judge.

    A detector's verdict is the one it stated, or its score's against a threshold: `own` ones by name, those of scorers
    that have one, else the one from the leak-free rows of the row's duty (`thresholds_of`). `onset_s` [s]: true onset
    in leaky records, `hours`: operating time of a record; without them no errors of onsets or alarms per hour are
    given. `false_alarm` is also the probability at which the bound's best test is taken. Raises InputError where there
    is no row to judge.
    """
    judged = sorted((row for row in rows if row.use == "judge"), key=lambda row: row.id)
    if not judged:
        raise InputError("a campaign needs at least one record to judge, got none")
    thresholds = {} if own is not None else thresholds_of(rows, detectors, false_alarm, promise, confidence)
    fixed = own or {
        name: rule.threshold
        for name in detectors
        if (rule := plan_detector(name).scorer) is not None and rule.threshold is not None
    }
    verdicts = {
        (name, row.id): _verdict(row, name, fixed.get(name), thresholds) for name in detectors for row in judged
    }
    plain = [row for row in judged if not row.fault]
    of_plain = {name: [verdicts[name, row.id] for row in plain] for name in detectors}
    sizes = [row.leak_lpm for row in plain]
    any_size = [1.0 if size else 0.0 for size in sizes]
    overall = [replace(row, leak_lpm=math.nan) for row in summary(any_size, of_plain, confidence, hours)]
    these = _Judging(plain, judged, detectors, verdicts, confidence, false_alarm)
    return Judgement(
        thresholds=thresholds,
        leak_free=sum(row.use == "calibrate" and row.error is None for row in rows) if thresholds else 0,
        judged=sum(row.error is None for row in judged),
        failed=tuple(row for row in sorted(rows, key=lambda row: row.id) if row.error is not None),
        table=tuple(summary(sizes, of_plain, confidence, hours)) if plain else (),
        overall=tuple(overall) if plain else (),
        onsets=() if onset_s is None else tuple(these.onsets(onset_s)),
        flows=tuple(these.flows()),
        causes=tuple(these.causes()),
        pods=tuple(these.pods()),
        rocs=tuple(these.rocs()),
        cells=tuple(these.by_cell()),
        faults=tuple(these.by_fault()),
        families=tuple(these.by_family()),
        realised=_realised(plain),
    )


def _verdict(row: CaseRow, detector: str, own: float | None, thresholds: Thresholds) -> str:
    if row.error is not None:
        return CANNOT_TELL
    if detector in row.statements:
        return row.statements[detector].verdict
    value, limit = row.scores[detector][0], own
    if limit is None and (set_by := thresholds.get((detector, duty_of(row.levels)))) is not None:
        limit = set_by.value
    if value is None or limit is None:
        return CANNOT_TELL
    return "leak" if value > limit else "no leak"


def _statement(row: CaseRow, detector: str) -> Statement | None:
    """Return what a detector stated on a row; None where it states nothing, or the record failed."""
    return row.statements.get(detector) if row.error is None else None


def _flow(row: CaseRow) -> float:
    return row.leak_lpm if row.flow_lpm is None else row.flow_lpm


def _by(rows: Iterable[CaseRow], key: Callable[[CaseRow], _K]) -> dict[_K, list[CaseRow]]:
    """Return the rows by what they have in common, in rising order."""
    groups: dict[_K, list[CaseRow]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return dict(sorted(groups.items(), key=lambda group: group[0]))  # type: ignore[arg-type, return-value]


def _realised(rows: Sequence[CaseRow]) -> dict[float, tuple[float, float]]:
    realised = {}
    for size, own in _by((row for row in rows if row.leak_lpm > 0), lambda row: row.leak_lpm).items():
        flows = [row.flow_lpm for row in own if row.flow_lpm is not None]
        if flows:
            spread = float(np.std(flows, ddof=1)) if len(flows) > 1 else math.nan
            realised[size] = (float(np.mean(flows)), spread)
    return realised


def _ends(pairs: Iterable[tuple[float, float] | None]) -> tuple[list[float], list[float]]:
    ends = [(math.nan, math.nan) if pair is None else pair for pair in pairs]
    return [low for low, _ in ends], [high for _, high in ends]


@dataclass(frozen=True)
class _Judging:
    """What follows from the verdicts: `plain` rows have no fault beside the leak, `rows` are all."""

    plain: Sequence[CaseRow]
    rows: Sequence[CaseRow]
    detectors: Sequence[str]
    verdicts: Verdicts
    confidence: float
    false_alarm: float

    def by_cell(self) -> Iterator[AlarmShares]:
        """Yield the alarms at each size in each cell of the factors."""
        groups = _by(self.plain, lambda row: (row.leak_lpm, repr(tuple(row.levels.items()))))
        for name in self.detectors:
            for (size, _), here in groups.items():
                yield self._shares(name, here, leak_lpm=size, levels=dict(here[0].levels))

    def by_fault(self) -> Iterator[AlarmShares]:
        """Yield the alarms on records with each fault that is no piston leak."""
        groups = _by((row for row in self.rows if row.fault and row.leak_lpm == 0), lambda row: row.fault)
        for name in (*self.detectors, ALWAYS, NEVER):
            for fault, here in groups.items():
                yield self._shares(name, here, fault=fault)

    def by_family(self) -> Iterator[AlarmShares]:
        """Yield the alarms by family, size and law; all families together first, none where there are no families.

        Each size has its laws apart, and together where there are several.
        """
        own = _by((row for row in self.plain if FAMILY in row.levels), lambda row: str(row.levels[FAMILY]))
        for name in self.detectors if own else ():
            for family, rows in {ALL: self.plain, **own}.items():
                for size, here in _by(rows, lambda row: row.leak_lpm).items():
                    laws = _by(here, lambda row: row.law) if size else {}
                    for law, these in laws.items() if len(laws) == 1 else {ANY_LAW: here, **laws}.items():
                        yield self._shares(name, these, family=family, leak_lpm=size, law=law)

    def _shares(self, detector: str, rows: Sequence[CaseRow], **common: Any) -> AlarmShares:
        given = [{ALWAYS: "leak", NEVER: "no leak"}.get(detector) or self.verdicts[detector, row.id] for row in rows]
        stated = [_statement(row, detector) for row in rows]
        held = [
            ev.leak_interval_lpm[0] <= _flow(row) <= ev.leak_interval_lpm[1]
            for row, ev in zip(rows, stated, strict=True)
            if ev is not None and ev.leak_interval_lpm is not None
        ]
        named = [
            ev is not None and verdict == "leak" and covers(named_cause(ev), cause_of(row.fault))
            for row, ev, verdict in zip(rows, stated, given, strict=True)
        ]
        bounded = sum(row.bound_lpm is not None for row in rows) if common.get("leak_lpm") else 0
        detected = [verdict == "leak" for row, verdict in zip(rows, given, strict=True) if self._allowed(row)]
        return AlarmShares(
            detector=detector,
            alarms=self._proportion(given.count("leak"), len(rows)),
            cannot_tell=self._proportion(given.count(CANNOT_TELL), len(rows)),
            coverage=self._proportion(sum(held), len(held)),
            named=self._proportion(sum(named), len(named)) if any(stated) else None,
            reachable=self._proportion(len(detected), bounded) if bounded else None,
            allowed=self._proportion(sum(detected), len(detected)) if bounded else None,
            failed=sum(row.error is not None for row in rows),
            **common,
        )

    def _proportion(self, k: int, n: int) -> Proportion:
        return proportion(k, n, self.confidence)

    def _allowed(self, row: CaseRow) -> bool:
        """Whether the best test at this false-alarm probability finds the leak of a row nine times in ten."""
        bound = row.bound_lpm
        return bound is not None and smallest_detectable(bound, self.false_alarm, ALLOWED_DETECTION) <= _flow(row)

    def _stating(self, rows: Sequence[CaseRow]) -> list[str]:
        """Return the detectors that state evidence."""
        return [name for name in self.detectors if any(name in row.statements for row in rows)]

    def pods(self) -> Iterator[DetectorPod]:
        """Yield the probability of detection over the size, where there are leaks."""
        leaky = [row for row in self.plain if row.leak_lpm > 0]
        sizes = [row.leak_lpm for row in leaky]
        for name in self.detectors if leaky else ():
            hits = [self.verdicts[name, row.id] == "leak" for row in leaky]
            detections = by_size(sizes, hits, self.confidence)
            curve, why = None, ""
            try:
                curve = fit_hit_miss(sizes, hits)
            except InputError as error:
                why = str(error)
            yield DetectorPod(name, tuple(detections), curve, why, proven_size(detections))

    def rocs(self) -> Iterator[SizeRoc]:
        """Yield curves over the scores, with no threshold; a record that cannot be judged counts as the lowest."""
        for name in self.detectors:
            value = {row.id: row.scores[name][0] if row.error is None else None for row in self.plain}
            lowest = min((score for score in value.values() if score is not None), default=None)
            if lowest is None:
                continue
            by_leak: dict[float, list[float]] = {}
            for row in self.plain:
                score = value[row.id]
                by_leak.setdefault(row.leak_lpm, []).append(lowest - 1.0 if score is None else score)
            free = by_leak.pop(0.0, [])
            together = [score for scores in by_leak.values() for score in scores]
            for size, leaky in ((math.nan, together), *sorted(by_leak.items())):
                if min(len(free), len(leaky)) > 1:
                    curve, area = (of(free, leaky, self.confidence) for of in (roc_curve, auc))
                    yield SizeRoc(name, size, curve, area)  # type: ignore[arg-type]

    def onsets(self, onset_s: float) -> Iterator[OnsetAccuracy]:
        """Yield, for detectors that search for the onset, its error over the alarms, by size."""
        groups = _by((row for row in self.plain if row.leak_lpm > 0), lambda row: row.leak_lpm)
        for name in self.detectors:
            for size, rows in groups.items():
                alarmed = [row for row in rows if self.verdicts[name, row.id] == "leak"]
                timed = [(at, row) for row in alarmed if (at := row.scores[name][1]) is not None]
                if timed:
                    stated = [_statement(row, name) for _, row in timed]
                    low, high = _ends(None if ev is None else ev.onset_interval_s for ev in stated)
                    truth = [onset_s] * len(timed)
                    errors = onset_errors([at for at, _ in timed], truth, low, high, self.confidence)
                    yield OnsetAccuracy(name, size, errors)

    def flows(self) -> Iterator[FlowAccuracy]:
        """Yield, for detectors that state a flow, its errors against the flow that the record really had, by size."""
        for name in self._stating(self.plain):
            for size, rows in _by(self.plain, lambda row: row.leak_lpm).items():
                own = [(row, ev) for row in rows if (ev := _statement(row, name)) is not None]
                truth = [_flow(row) for row, _ in own]
                given = [math.nan if ev.leak_lpm is None else ev.leak_lpm for _, ev in own]
                if not np.isfinite(given).any():
                    continue
                low, high = _ends(ev.leak_interval_lpm for _, ev in own)
                error = np.array(given) - np.array(truth)
                error = error[np.isfinite(error)]
                errors = estimate_error(given, truth, low, high, self.confidence)
                medians = (quantile_of(of, 0.5, self.confidence) for of in (error, np.abs(error)))
                yield FlowAccuracy(name, size, errors, *medians)

    def causes(self) -> Iterator[NamedCauses]:
        """Yield the causes that detectors name, where there are faults.

        A record with a leak and another fault is left out; one that failed is `cannot tell`.
        """
        single = [row for row in self.rows if not (row.leak_lpm > 0 and row.fault)]
        order = sorted({cause_of(row.fault) for row in single if row.fault})
        truth = [PISTON_LEAK if row.leak_lpm > 0 else cause_of(row.fault) if row.fault else NO_CAUSE for row in single]
        causes = [cause for cause in (NO_CAUSE, PISTON_LEAK) if cause in truth] + order
        for name in self._stating(single) if order else ():
            statements = [_statement(row, name) for row in single]
            named = [CANNOT_TELL if ev is None else named_cause(ev) for ev in statements]
            others = sorted(set(named) - set(causes) - {CANNOT_TELL})
            covered = self._proportion(sum(map(covers, named, truth)), len(truth))
            yield NamedCauses(name, confusion_matrix(truth, named, [*causes, *others], self.confidence), covered)
