"""Statements of detectors against the truth: the onset of the leak, its size, its cause."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.campaigns.cases.row import NO_CAUSE, PISTON_LEAK, cause_of, covers, named_cause
from sealscope.campaigns.judging.verdicts import JudgedRow, Verdicts, grouped
from sealscope.evaluation.binomial import Proportion, proportion
from sealscope.evaluation.estimates import EstimateErrors, estimate_errors
from sealscope.evaluation.table import CANNOT_TELL, Confusion, confusion_matrix


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
    """Counts of the causes that one detector names, by true cause; `none` without leak and fault.

    `covered`: records for which it names the true cause, alone or with the one that no channel tells from it.
    """

    detector: str
    confusion: Confusion
    covered: Proportion


def onset_errors(verdicts: Verdicts, onset_s: float, confidence: float) -> Iterator[StatedErrors]:
    """Yield, for detectors that search for the onset, its error over the alarms, by size."""
    for name, records in verdicts.items():
        for size, group in grouped((record for record in records if record.size > 0 and record.alarm), _size).items():
            estimates = [
                (onset, onset_s, None if record.statement is None else record.statement.onset_interval_s)
                for record in group
                if (onset := record.row.scores[name][1]) is not None
            ]
            yield from _errors(name, size, estimates, confidence)


def flow_errors(verdicts: Verdicts, confidence: float) -> Iterator[StatedErrors]:
    """Yield, for detectors that state a flow, its errors against the record's true flow, by size."""
    for name, records in verdicts.items():
        for size, group in grouped(records, _size).items():
            estimates = [
                (record.statement.leak_lpm, record.flow_lpm, record.statement.leak_interval_lpm)
                for record in group
                if record.statement is not None
            ]
            yield from _errors(name, size, estimates, confidence)


def _size(record: JudgedRow) -> float:
    return record.size


def _errors(
    detector: str,
    leak_lpm: float,
    stated: Sequence[tuple[float | None, float, tuple[float, float] | None]],
    confidence: float,
) -> Iterator[StatedErrors]:
    """Yield the errors of (estimate, truth, interval), where there is any estimate."""
    estimates = [math.nan if value is None else value for value, _, _ in stated]
    if np.isfinite(estimates).any():
        low, high = zip(*((math.nan, math.nan) if ends is None else ends for _, _, ends in stated), strict=True)
        truth = [value for _, value, _ in stated]
        yield StatedErrors(detector, leak_lpm, estimate_errors(estimates, truth, low, high, confidence))


def causes_of(verdicts: Verdicts, confidence: float) -> Iterator[NamedCauses]:
    """Count the causes that detectors name, where there are faults.

    A record with a leak and another fault is left out; one that failed is `cannot tell`.
    """
    for name, records in verdicts.items():
        single = [record for record in records if not (record.size > 0 and record.row.fault)]
        other_causes = sorted({cause_of(record.row.fault) for record in single if record.row.fault})
        if not other_causes or not any(name in record.row.statements for record in single):
            continue
        truth = [_true_cause(record) for record in single]
        causes = [cause for cause in (NO_CAUSE, PISTON_LEAK) if cause in truth] + other_causes
        named_causes = [CANNOT_TELL if record.statement is None else named_cause(record.statement) for record in single]
        causes += sorted(set(named_causes) - set(causes) - {CANNOT_TELL})
        covered = proportion(sum(map(covers, named_causes, truth)), len(truth), confidence)
        yield NamedCauses(name, confusion_matrix(truth, named_causes, causes, confidence), covered)


def _true_cause(record: JudgedRow) -> str:
    if record.size > 0:
        return PISTON_LEAK
    return cause_of(record.row.fault) if record.row.fault else NO_CAUSE
