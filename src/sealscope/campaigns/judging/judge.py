"""Judge a campaign's rows: thresholds from its leak-free records, verdicts on all others, and what they add up to.

The verdicts give detection and false alarms by size of leak; what detectors state beyond a verdict is compared with the
truth: when the leak began, how large it is, what the fault is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

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
from sealscope.evaluation.estimates import EstimateErrors, estimate_errors
from sealscope.evaluation.pod import HitMiss, SizeDetection, by_size, fit_hit_miss, proven_size
from sealscope.evaluation.roc import Area, Roc, auc, roc_curve
from sealscope.evaluation.table import CANNOT_TELL, Confusion, confusion_matrix, events_per_hour
from sealscope.evaluation.thresholds import Promise, Threshold, quantile_threshold, records_needed

_T = TypeVar("_T")
#: (detector, duty) -> threshold from leak-free records of that duty
Thresholds = Mapping[tuple[str, str], Threshold]
#: Two detectors that do not look, beside which the others are shown.
ALWAYS, NEVER = "always fire", "never fire"
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

    @property
    def how(self) -> str:
        """How the curve was fitted, or why there is none."""
        return self.curve.estimator if self.curve else self.why


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

    `leak_lpm` (0: no leak, nan: any) and `law` of the leak, `fault` that is no leak, `family` of machines, `levels` of
    the factors: what they have in common, where it was asked for. `coverage`: how often a stated interval holds the
    flow that there was; `false_alarm` and `per_hour`: of that detector on its leak-free records, None where there are
    none, or no hours; `named`: alarms that name the fault's cause, alone or with the piston, None where the detector
    names no cause; `reachable`: records whose leak the Cramer-Rao bound of their machine allows to find, over those
    that have a bound, and `allowed`: alarms over these, both None where there is no bound; `failed`: records without a
    result, which are among those that cannot be told.
    """

    detector: str
    alarms: Proportion
    cannot_tell: Proportion
    coverage: Proportion
    false_alarm: Proportion | None = None
    per_hour: IntervalEstimate | None = None
    leak_lpm: float = 0.0
    law: str = ANY_LAW
    fault: str = ""
    family: str = ALL
    levels: Mapping[str, str | float] = field(default_factory=dict)
    named: Proportion | None = None
    reachable: Proportion | None = None
    allowed: Proportion | None = None
    failed: int = 0

    @property
    def informedness(self) -> float:
        """Share of alarms less that of false alarms, 0 for chance."""
        return self.alarms.value - self.false_alarm.value if self.false_alarm else math.nan


@dataclass(frozen=True)
class StatedErrors:
    """Errors of what one detector states at one size of leak (0: leak-free records).

    Of the onset [s] over its alarms, or of the flow over all records, alarm or not.
    """

    detector: str
    leak_lpm: float
    errors: EstimateErrors


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
    table: tuple[AlarmShares, ...]
    overall: tuple[AlarmShares, ...]
    onsets: tuple[StatedErrors, ...]
    flows: tuple[StatedErrors, ...]
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
    every = {
        name: [_Judged(row, _verdict(row, name, fixed.get(name), thresholds), _statement(row, name)) for row in judged]
        for name in detectors
    }
    these = _Judging(every, confidence, false_alarm)
    plain = [row for row in judged if not row.fault]
    return Judgement(
        thresholds=thresholds,
        leak_free=sum(row.use == "calibrate" and row.error is None for row in rows) if thresholds else 0,
        judged=sum(row.error is None for row in judged),
        failed=tuple(row for row in sorted(rows, key=lambda row: row.id) if row.error is not None),
        table=tuple(these.by_size(lambda of: of.leak, hours)),
        overall=tuple(these.by_size(lambda of: math.nan, hours)),
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


def _by(items: Iterable[_T], key: Callable[[_T], Any]) -> dict[Any, list[_T]]:
    """Return the items by what they have in common, in rising order."""
    groups: dict[Any, list[_T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return dict(sorted(groups.items(), key=lambda group: group[0]))


def _realised(rows: Sequence[CaseRow]) -> dict[float, tuple[float, float]]:
    realised = {}
    for size, own in _by((row for row in rows if row.leak_lpm > 0), lambda row: row.leak_lpm).items():
        flows = [row.flow_lpm for row in own if row.flow_lpm is not None]
        if flows:
            spread = float(np.std(flows, ddof=1)) if len(flows) > 1 else math.nan
            realised[size] = (float(np.mean(flows)), spread)
    return realised


class _Judged(NamedTuple):
    """A row, one detector's verdict on it, and what it stated."""

    row: CaseRow
    verdict: str
    stated: Statement | None

    @property
    def leak(self) -> float:
        return self.row.leak_lpm

    @property
    def alarm(self) -> bool:
        return self.verdict == "leak"


def _errors(
    detector: str,
    leak_lpm: float,
    stated: Sequence[tuple[float | None, float, tuple[float, float] | None]],
    confidence: float,
) -> Iterator[StatedErrors]:
    """Yield the errors of (estimate, truth, interval), where there is any estimate."""
    estimates, truth, intervals = zip(*stated, strict=True) if stated else ((), (), ())
    given = [math.nan if value is None else value for value in estimates]
    if np.isfinite(given).any():
        low, high = zip(*((math.nan, math.nan) if pair is None else pair for pair in intervals), strict=True)
        yield StatedErrors(detector, leak_lpm, estimate_errors(given, truth, low, high, confidence))


@dataclass(frozen=True)
class _Judging:
    """What follows from the verdicts by detector."""

    every: Mapping[str, Sequence[_Judged]]
    confidence: float
    false_alarm: float

    @property
    def plain(self) -> dict[str, list[_Judged]]:
        """Those on rows that have no fault beside the leak."""
        return {name: [of for of in own if not of.row.fault] for name, own in self.every.items()}

    @property
    def references(self) -> dict[str, list[_Judged]]:
        """Two detectors that do not look."""
        first = next(iter(self.every.values()), ())
        verdicts = {ALWAYS: "leak", NEVER: "no leak"}
        return {name: [_Judged(of.row, verdict, None) for of in first] for name, verdict in verdicts.items()}

    def by_size(self, size_of: Callable[[_Judged], float], hours: float | None) -> Iterator[AlarmShares]:
        """Yield alarms by size, and false alarms beside; those that do not look last.

        A detector without a record with a leak has one row of size 0, with no detection.
        """
        for name, every in {**self.every, **self.references}.items():
            own = [of for of in every if not of.row.fault]
            free, leaky = ([of for of in own if bool(of.leak) == leaks] for leaks in (False, True))
            groups = _by(leaky, size_of) or ({size_of(free[0]): free} if free else {})
            alarms = proportion(sum(of.alarm for of in free), len(free), self.confidence) if free else None
            hourly = events_per_hour(alarms.count, hours * alarms.n, self.confidence) if alarms and hours else None
            for size, here in groups.items():
                shares = self._shares(name, here, leak_lpm=size)
                detected = shares.alarms if leaky else proportion(0, 0, self.confidence)
                yield replace(shares, alarms=detected, false_alarm=alarms, per_hour=hourly)

    def by_cell(self) -> Iterator[AlarmShares]:
        """Yield the alarms at each size in each cell of the factors."""
        for name, own in self.plain.items():
            for (size, _), here in _by(own, lambda of: (of.leak, repr(tuple(of.row.levels.items())))).items():
                yield self._shares(name, here, leak_lpm=size, levels=dict(here[0].row.levels))

    def by_fault(self) -> Iterator[AlarmShares]:
        """Yield the alarms on records with each fault that is no piston leak."""
        for name, own in {**self.every, **self.references}.items():
            faulty = (of for of in own if of.row.fault and of.leak == 0)
            for fault, here in _by(faulty, lambda of: of.row.fault).items():
                yield self._shares(name, here, fault=fault)

    def by_family(self) -> Iterator[AlarmShares]:
        """Yield the alarms by family, size and law; all families together first, none where there are no families.

        Each size has its laws apart, and together where there are several.
        """
        for name, own in self.plain.items():
            families = _by((of for of in own if FAMILY in of.row.levels), lambda of: str(of.row.levels[FAMILY]))
            for family, members in {ALL: own, **families}.items() if families else ():
                for size, here in _by(members, lambda of: of.leak).items():
                    laws = _by(here, lambda of: of.row.law) if size else {}
                    for law, these in laws.items() if len(laws) == 1 else {ANY_LAW: here, **laws}.items():
                        yield self._shares(name, these, family=family, leak_lpm=size, law=law)

    def _shares(self, detector: str, here: Sequence[_Judged], **common: Any) -> AlarmShares:
        def share(flags: Iterable[bool]) -> Proportion:
            of = list(flags)
            return proportion(sum(of), len(of), self.confidence)

        intervals = [(_flow(row), ev.leak_interval_lpm) for row, _, ev in here if ev is not None]
        named = [
            ev is not None and alarm == "leak" and covers(named_cause(ev), cause_of(row.fault))
            for row, alarm, ev in here
        ]
        bounded = [of for of in here if of.row.bound_lpm is not None] if common.get("leak_lpm") else []
        return AlarmShares(
            detector=detector,
            alarms=share(of.alarm for of in here),
            cannot_tell=share(of.verdict == CANNOT_TELL for of in here),
            coverage=share(ends[0] <= flow <= ends[1] for flow, ends in intervals if ends is not None),
            named=share(named) if any(of.stated for of in here) else None,
            reachable=share(map(self._allowed, bounded)) if bounded else None,
            allowed=share(of.alarm for of in bounded if self._allowed(of)) if bounded else None,
            failed=sum(of.row.error is not None for of in here),
            **common,
        )

    def _allowed(self, of: _Judged) -> bool:
        """Whether the best test at this false-alarm probability finds the leak of a row nine times in ten."""
        bound = of.row.bound_lpm
        return bound is not None and smallest_detectable(bound, self.false_alarm, ALLOWED_DETECTION) <= _flow(of.row)

    def pods(self) -> Iterator[DetectorPod]:
        """Yield the probability of detection over the size, where there are leaks."""
        for name, own in self.plain.items():
            leaky = [of for of in own if of.leak > 0]
            if not leaky:
                continue
            sizes, hits = [of.leak for of in leaky], [of.alarm for of in leaky]
            detections = by_size(sizes, hits, self.confidence)
            curve, why = None, ""
            try:
                curve = fit_hit_miss(sizes, hits)
            except InputError as error:
                why = str(error)
            yield DetectorPod(name, tuple(detections), curve, why, proven_size(detections))

    def rocs(self) -> Iterator[SizeRoc]:
        """Yield curves over the scores, with no threshold; a record that cannot be judged counts as the lowest."""
        for name, own in self.plain.items():
            scored = [(of.leak, of.row.scores[name][0] if of.row.error is None else None) for of in own]
            lowest = min((score for _, score in scored if score is not None), default=None)
            if lowest is None:
                continue
            by_leak: dict[float, list[float]] = {}
            for leak, score in scored:
                by_leak.setdefault(leak, []).append(lowest - 1.0 if score is None else score)
            free = by_leak.pop(0.0, [])
            together = [score for scores in by_leak.values() for score in scores]
            for size, leaky in ((math.nan, together), *sorted(by_leak.items())):
                if min(len(free), len(leaky)) > 1:
                    curve, area = roc_curve(free, leaky, self.confidence), auc(free, leaky, self.confidence)
                    yield SizeRoc(name, size, curve, area)

    def onsets(self, onset_s: float) -> Iterator[StatedErrors]:
        """Yield, for detectors that search for the onset, its error over the alarms, by size."""
        for name, own in self.plain.items():
            for size, here in _by((of for of in own if of.leak > 0 and of.alarm), lambda of: of.leak).items():
                timed = [(of.row.scores[name][1], of.stated) for of in here if of.row.scores[name][1] is not None]
                stated = [(at, onset_s, None if ev is None else ev.onset_interval_s) for at, ev in timed]
                yield from _errors(name, size, stated, self.confidence)

    def flows(self) -> Iterator[StatedErrors]:
        """Yield, for detectors that state a flow, its errors against the flow that the record really had, by size."""
        for name, own in self.plain.items():
            for size, here in _by((of for of in own if of.stated is not None), lambda of: of.leak).items():
                stated = [(ev.leak_lpm, _flow(row), ev.leak_interval_lpm) for row, _, ev in here if ev is not None]
                yield from _errors(name, size, stated, self.confidence)

    def causes(self) -> Iterator[NamedCauses]:
        """Yield the causes that detectors name, where there are faults.

        A record with a leak and another fault is left out; one that failed is `cannot tell`.
        """
        for name, own in self.every.items():
            single = [of for of in own if not (of.leak > 0 and of.row.fault)]
            order = sorted({cause_of(of.row.fault) for of in single if of.row.fault})
            if not order or not any(name in of.row.statements for of in single):
                continue
            truth = [
                PISTON_LEAK if of.leak > 0 else cause_of(of.row.fault) if of.row.fault else NO_CAUSE for of in single
            ]
            causes = [cause for cause in (NO_CAUSE, PISTON_LEAK) if cause in truth] + order
            named = [CANNOT_TELL if of.stated is None else named_cause(of.stated) for of in single]
            others = sorted(set(named) - set(causes) - {CANNOT_TELL})
            covered = proportion(sum(map(covers, named, truth)), len(truth), self.confidence)
            yield NamedCauses(name, confusion_matrix(truth, named, [*causes, *others], self.confidence), covered)
