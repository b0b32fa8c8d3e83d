"""Compare detectors' statements with the truth: onset, flow and cause of the leak."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from sealscope.campaigns.cases.row import NO_CAUSE, PISTON_LEAK, expected_cause, matches_cause, named_cause
from sealscope.campaigns.judging.verdicts import JudgedRow, Verdicts, group_by
from sealscope.evaluation.binomial import Proportion, proportion
from sealscope.evaluation.estimates import EstimateErrors, estimate_errors
from sealscope.evaluation.table import CANNOT_TELL, Confusion, confusion_matrix


@dataclass(frozen=True)
class StatedErrors:
    """Errors of one detector's estimates at one size of leak (0: leak-free records).

    The estimates are onsets [s] in its alarms, or leak flows [L/min] in all records.
    """

    detector: str
    leak_lpm: float
    errors: EstimateErrors


@dataclass(frozen=True)
class NamedCauses:
    """Confusion matrix of the true causes and the causes that one detector names; `none`: neither leak nor fault.

    `covered`: fraction of records in which it names the true cause, or an ambiguous cause that includes it.
    """

    detector: str
    confusion: Confusion
    covered: Proportion


def onset_errors(verdicts: Verdicts, onset_s: float, confidence: float) -> Iterator[StatedErrors]:
    """Yield the errors of the onset in the alarms, by detector and size of leak, for detectors that estimate it."""
    for name, records in verdicts.items():
        for size, group in group_by(
            (record for record in records if record.size > 0 and record.alarm), attrgetter("size")
        ).items():
            estimates = [
                (onset, onset_s, None if record.statement is None else record.statement.onset_interval_s)
                for record in group
                for _score, onset in [record.row.scores[name]]
                if onset is not None
            ]
            yield from _iter_errors(name, size, estimates, confidence)


def flow_errors(verdicts: Verdicts, confidence: float) -> Iterator[StatedErrors]:
    """Yield the errors of the leak flow, by detector and size of leak, for detectors that estimate it."""
    for name, records in verdicts.items():
        for size, group in group_by(records, attrgetter("size")).items():
            estimates = [
                (record.statement.leak_lpm, record.flow_lpm, record.statement.leak_interval_lpm)
                for record in group
                if record.statement is not None
            ]
            yield from _iter_errors(name, size, estimates, confidence)


def _iter_errors(
    detector: str,
    leak_lpm: float,
    stated: Sequence[tuple[float | None, float, tuple[float, float] | None]],
    confidence: float,
) -> Iterator[StatedErrors]:
    """Yield the errors of the `stated` (estimate, truth, interval), or nothing if all estimates are missing."""
    estimates = [math.nan if value is None else value for value, _, _ in stated]
    if np.isfinite(estimates).any():
        low, high = zip(
            *((math.nan, math.nan) if interval is None else interval for _, _, interval in stated), strict=True
        )
        truth = [value for _, value, _ in stated]
        yield StatedErrors(detector, leak_lpm, estimate_errors(estimates, truth, low, high, confidence))


def iter_cause_confusions(verdicts: Verdicts, confidence: float) -> Iterator[NamedCauses]:
    """Yield the confusion matrix of true and named causes of each detector with statements, if any record has a fault.

    A record with a leak and another fault has two true causes and is left out; a failed one counts as `cannot tell`.
    """
    for name, records in verdicts.items():
        single_cause_records = [record for record in records if not (record.size > 0 and record.row.fault)]
        other_causes = sorted({expected_cause(record.row.fault) for record in single_cause_records if record.row.fault})
        if not other_causes or not any(name in record.row.statements for record in single_cause_records):
            continue
        truth = [_true_cause(record) for record in single_cause_records]
        causes = [cause for cause in (NO_CAUSE, PISTON_LEAK) if cause in truth] + other_causes
        named_causes = [
            CANNOT_TELL if record.statement is None else named_cause(record.statement)
            for record in single_cause_records
        ]
        causes += sorted(set(named_causes) - set(causes) - {CANNOT_TELL})
        covered = proportion(sum(map(matches_cause, named_causes, truth)), len(truth), confidence)
        yield NamedCauses(name, confusion_matrix(truth, named_causes, causes, confidence), covered)


def _true_cause(record: JudgedRow) -> str:
    """Return the true cause of a record: piston leak, the cause of its fault, or none."""
    if record.size > 0:
        return PISTON_LEAK
    return expected_cause(record.row.fault) if record.row.fault else NO_CAUSE
