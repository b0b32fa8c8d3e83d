"""Collect the verdicts on each record, which a detector states or which follow from its score and a threshold."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeVar

from sealscope.campaigns.cases.row import CaseRow, Statement, duty_label
from sealscope.campaigns.plans.detectors import parse_detector_name
from sealscope.errors import InputError
from sealscope.evaluation.table import CANNOT_TELL
from sealscope.evaluation.thresholds import Promise, Threshold, quantile_threshold, records_needed

_T = TypeVar("_T")
#: Thresholds by (detector, duty), each set from leak-free records of that duty (`duty_label`).
Thresholds = Mapping[tuple[str, str], Threshold]


class JudgedRow(NamedTuple):
    """The result of a record (`row`) with the verdict of one detector on it.

    `statement`: verdict and estimates as the detector states them, None for a scorer and for a record without a result.
    """

    row: CaseRow
    verdict: str
    statement: Statement | None

    @property
    def size(self) -> float:
        """Planned size of the true leak, 0 for none: its mean flow [L/min], or a number in the plan's own `unit`."""
        return self.row.leak_lpm

    @property
    def flow_lpm(self) -> float:
        """Simulated mean flow [L/min] of the true leak while open, or its planned flow if no flow was simulated."""
        return self.size if self.row.flow_lpm is None else self.row.flow_lpm

    @property
    def named_cause(self) -> str:
        """Cause that the detector names (`Statement.named_cause`), "cannot tell" without a statement."""
        return CANNOT_TELL if self.statement is None else self.statement.named_cause

    @property
    def alarm(self) -> bool:
        """True if the detector's verdict on the record is `leak`."""
        return self.verdict == "leak"


#: By detector, its verdict on each record to judge.
Verdicts: TypeAlias = Mapping[str, Sequence[JudgedRow]]


def compute_thresholds(
    rows: Iterable[CaseRow], detectors: Sequence[str], false_alarm: float, promise: Promise, confidence: float
) -> Thresholds:
    """Compute the threshold of each scorer that needs one, for each duty with enough leak-free records.

    A record without a score, which raises no alarm, counts as the lowest score of its duty. The last three arguments
    are those of `judge`. Raises InputError if a scorer needs a threshold and no duty has enough records.
    """
    scorers = [name for name in detectors if parse_detector_name(name).needs_threshold]
    leak_free: dict[str, list[CaseRow]] = {}
    for row in rows:
        if row.use == "calibrate" and row.error is None:
            leak_free.setdefault(duty_label(row.levels), []).append(row)
    needed = records_needed(false_alarm, confidence, promise)
    max_rows = max(map(len, leak_free.values()), default=0)
    if scorers and max_rows < needed:
        raise InputError(f"leak-free records must be at least {needed} of a duty, got at most {max_rows}")
    thresholds = {}
    for name in scorers:
        for duty, group in leak_free.items():
            scores = [score for row in group if (score := row.score(name)) is not None]
            if scores and len(group) >= needed:  # without a threshold, the verdict is `cannot tell`
                scores += [min(scores)] * (len(group) - len(scores))  # for the records without a score
                thresholds[name, duty] = quantile_threshold(scores, false_alarm, confidence, promise)
    return thresholds


def collect_verdicts(
    rows: Sequence[CaseRow], detectors: Sequence[str], thresholds: Thresholds
) -> dict[str, list[JudgedRow]]:
    """Collect the verdict of each detector on each row; return them by detector, in the order of `rows`.

    If a detector states a verdict, this is taken. Otherwise the verdict is `leak` if the score exceeds the scorer's
    fixed threshold, or that in `thresholds`, else `no leak`; without a result, a score or a threshold it is `cannot
    tell`.
    """

    def judge_row(row: CaseRow, detector: str) -> JudgedRow:
        """Determine the verdict of one detector on the result of one record."""
        if row.error is not None:
            return JudgedRow(row, CANNOT_TELL, None)
        if (statement := row.statements.get(detector)) is not None:
            return JudgedRow(row, statement.verdict, statement)
        score, scorer = row.score(detector), parse_detector_name(detector).scorer
        limit = None if scorer is None else scorer.threshold
        if limit is None and (threshold := thresholds.get((detector, duty_label(row.levels)))) is not None:
            limit = threshold.value
        if score is None or limit is None:
            return JudgedRow(row, CANNOT_TELL, None)
        return JudgedRow(row, "leak" if score > limit else "no leak", None)

    return {detector: [judge_row(row, detector) for row in rows] for detector in detectors}


def drop_other_faults(verdicts: Verdicts) -> Verdicts:
    """Remove the records that have a fault other than a piston leak, even if they also have a leak."""
    return {name: [record for record in records if not record.row.fault] for name, records in verdicts.items()}


def group_by(items: Iterable[_T], key: Callable[[_T], Any]) -> dict[Any, list[_T]]:
    """Group items by the key that the function `key` gives for each; the keys are in rising order."""
    groups: dict[Any, list[_T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return dict(sorted(groups.items(), key=lambda group: group[0]))
