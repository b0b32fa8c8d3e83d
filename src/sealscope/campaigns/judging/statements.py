"""Compare the onset, flow and cause of a leak that detectors state with the true ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sealscope.campaigns.cases.row import NO_CAUSE, PISTON_LEAK, Statement, expected_cause, matches_cause
from sealscope.campaigns.judging.verdicts import JudgedRow, Verdicts, group_by
from sealscope.evaluation.binomial import Proportion, proportion
from sealscope.evaluation.estimates import EstimateErrors, estimate_errors
from sealscope.evaluation.table import CANNOT_TELL, Confusion, confusion_matrix


@dataclass(frozen=True)
class StatedErrors:
    """Errors (estimate minus true value) of one detector's estimates on the records with one size of leak.

    `leak_lpm`: planned mean flow [L/min], 0 for leak-free records; `errors`: of the estimated onsets [s] on records
    with an alarm, or of the estimated leak flows [L/min] on all records.
    """

    detector: str
    leak_lpm: float
    errors: EstimateErrors


@dataclass(frozen=True)
class NamedCauses:
    """The confusion matrix of one detector: how often it names each cause, for each true cause of a record.

    `covered`: fraction of records for which the detector names the true cause, or an ambiguous cause that includes the
    true one.
    """

    detector: str
    confusion: Confusion
    covered: Proportion


def onset_errors(verdicts: Verdicts, onset_s: float, confidence: float) -> Iterator[StatedErrors]:
    """Yield the errors [s] of the estimated onsets for each detector and each planned mean flow of the leak.

    Only records with a leak, an alarm and an estimated onset count. `onset_s` [s]: true onset of all leaks.
    """
    for name, size, group in _iter_stating(verdicts):
        estimates = [
            (statement.onset_s, onset_s, statement.onset_interval_s)
            for record, statement in group
            if record.alarm and statement.onset_s is not None
        ]
        if size > 0 and estimates:
            yield StatedErrors(name, size, _errors(estimates, confidence))


def flow_errors(verdicts: Verdicts, confidence: float) -> Iterator[StatedErrors]:
    """Yield the errors of the leak flows [L/min] that detectors state, by detector and planned mean flow (`size`)."""
    for name, size, group in _iter_stating(verdicts):
        estimates = [(statement.leak_lpm, record.flow_lpm, statement.leak_interval_lpm) for record, statement in group]
        if any(flow is not None for flow, _, _ in estimates):
            yield StatedErrors(name, size, _errors(estimates, confidence))


def _iter_stating(verdicts: Verdicts) -> Iterator[tuple[str, float, list[tuple[JudgedRow, Statement]]]]:
    """Yield each detector, each size of leak, and the records of this size on which the detector makes a statement."""
    for name, records in verdicts.items():
        stating = [(record, record.statement) for record in records if record.statement is not None]
        for size, group in group_by(stating, lambda pair: pair[0].size).items():
            yield name, size, group


def _errors(
    estimates: Sequence[tuple[float | None, float, tuple[float, float] | None]], confidence: float
) -> EstimateErrors:
    """Compute the errors of one estimate or more, given as (estimate or None, true value, interval or None) each."""
    numbers = [
        (math.nan if value is None else value, true_value, *(interval or (math.nan, math.nan)))
        for value, true_value, interval in estimates
    ]
    values, true_values, low, high = zip(*numbers, strict=True)
    return estimate_errors(values, true_values, low, high, confidence)


def iter_cause_confusions(verdicts: Verdicts, confidence: float) -> Iterator[NamedCauses]:
    """Yield the confusion matrix of true and named causes for each detector that names causes.

    A record with a leak and another fault has two true causes and is left out. A record without a result counts as
    `cannot tell`. Nothing is yielded if no record has a fault other than a leak.
    """
    for name, records in verdicts.items():
        single_cause_records = [record for record in records if not (record.size > 0 and record.row.fault)]
        other_causes = sorted({expected_cause(record.row.fault) for record in single_cause_records if record.row.fault})
        if not other_causes or not any(name in record.row.statements for record in single_cause_records):
            continue
        truth = [_true_cause(record) for record in single_cause_records]
        # rows of the matrix: the true causes, then causes that are only named; `cannot tell` has a column, but no row
        causes = [cause for cause in (NO_CAUSE, PISTON_LEAK) if cause in truth] + other_causes
        named_causes = [record.named_cause for record in single_cause_records]
        causes += sorted(set(named_causes) - set(causes) - {CANNOT_TELL})
        covered = proportion(sum(map(matches_cause, named_causes, truth)), len(truth), confidence)
        yield NamedCauses(name, confusion_matrix(truth, named_causes, causes, confidence), covered)


def _true_cause(record: JudgedRow) -> str:
    """Return the true cause of a record: "piston leak", the cause of another fault, or "none" without either."""
    if record.size > 0:
        return PISTON_LEAK
    return expected_cause(record.row.fault) if record.row.fault else NO_CAUSE
