"""The judged verdicts: a detector's own on each record, or its score's against a threshold."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeVar

from sealscope.campaigns.cases.row import CaseRow, Statement, duty_of
from sealscope.campaigns.plans.detectors import plan_detector
from sealscope.errors import InputError
from sealscope.evaluation.table import CANNOT_TELL
from sealscope.evaluation.thresholds import Promise, Threshold, quantile_threshold, records_needed

_T = TypeVar("_T")
#: (detector, duty) -> threshold from leak-free records of that duty
Thresholds = Mapping[tuple[str, str], Threshold]


class JudgedRow(NamedTuple):
    """A row, one detector's verdict on it, and its statement; None where there is none or the record failed."""

    row: CaseRow
    verdict: str
    statement: Statement | None

    @property
    def size(self) -> float:
        """Size of the true leak, 0 for none."""
        return self.row.leak_lpm

    @property
    def flow_lpm(self) -> float:
        """Flow [L/min] of the true leak, where it is known."""
        return self.size if self.row.flow_lpm is None else self.row.flow_lpm

    @property
    def alarm(self) -> bool:
        """True for the verdict `leak`."""
        return self.verdict == "leak"


#: detector -> its verdict on each record to judge
Verdicts: TypeAlias = Mapping[str, Sequence[JudgedRow]]


def thresholds_of(
    rows: Iterable[CaseRow],
    detectors: Sequence[str],
    false_alarm: float,
    promise: Promise = "average",
    confidence: float = 0.95,
) -> Thresholds:
    """Compute the thresholds of the scorers that need one, from the leak-free rows of each duty.

    A row without a score raises no alarm and counts as the lowest. Raises InputError where no duty has enough rows,
    saying how many it takes.
    """
    needing = [name for name in detectors if plan_detector(name).needs_threshold]
    leak_free: dict[str, list[CaseRow]] = {}
    for row in rows:
        if row.use == "calibrate" and row.error is None:
            leak_free.setdefault(duty_of(row.levels), []).append(row)
    needed = records_needed(false_alarm, confidence if promise == "bound" else None)
    most = max(map(len, leak_free.values()), default=0)
    if needing and most < needed:
        raise InputError(f"leak-free records must be at least {needed} of a duty, got at most {most}")
    thresholds = {}
    for name in needing:
        for duty, group in leak_free.items():
            scores_of_group = [score for row in group if (score := row.scores[name][0]) is not None]
            if scores_of_group and len(group) >= needed:
                scores = scores_of_group + [min(scores_of_group)] * (len(group) - len(scores_of_group))
                thresholds[name, duty] = quantile_threshold(scores, false_alarm, confidence, promise)
    return thresholds


def verdicts_of(
    rows: Sequence[CaseRow], detectors: Sequence[str], limits: Mapping[str, float], thresholds: Thresholds
) -> dict[str, list[JudgedRow]]:
    """Collect each detector's verdicts: its own, or its score's against its limit or the duty's threshold."""

    def judge_row(row: CaseRow, detector: str) -> JudgedRow:
        if row.error is not None:
            return JudgedRow(row, CANNOT_TELL, None)
        if (statement := row.statements.get(detector)) is not None:
            return JudgedRow(row, statement.verdict, statement)
        score, limit = row.scores[detector][0], limits.get(detector)
        if limit is None and (threshold := thresholds.get((detector, duty_of(row.levels)))) is not None:
            limit = threshold.value
        if score is None or limit is None:
            return JudgedRow(row, CANNOT_TELL, None)
        return JudgedRow(row, "leak" if score > limit else "no leak", None)

    return {detector: [judge_row(row, detector) for row in rows] for detector in detectors}


def without_fault(verdicts: Verdicts) -> Verdicts:
    """Select the verdicts on records without another fault."""
    return {name: [record for record in records if not record.row.fault] for name, records in verdicts.items()}


def grouped(items: Iterable[_T], key: Callable[[_T], Any]) -> dict[Any, list[_T]]:
    """Group the items by a key, in rising order."""
    groups: dict[Any, list[_T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return dict(sorted(groups.items(), key=lambda group: group[0]))
