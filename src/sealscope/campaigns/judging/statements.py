"""Compare what detectors state of a leak, its onset, flow and cause, with the truth."""

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
    """Errors (estimate minus true value) of one detector's estimates on the records with one size of leak.

    `leak_lpm`: size of the leak, i.e. its planned mean flow [L/min], 0 for leak-free records; `errors`: those of
    estimated onsets [s], over the records with an alarm, or those of estimated leak flows [L/min], over all records.
    """

    detector: str
    leak_lpm: float
    errors: EstimateErrors


@dataclass(frozen=True)
class NamedCauses:
    """The confusion matrix of one detector: how often it names each cause, for each true cause of a record.

    The cause of a record without leak and fault is `none`. `covered`: fraction of records in which the detector names
    the true cause, or an ambiguous cause that includes it.
    """

    detector: str
    confusion: Confusion
    covered: Proportion


def onset_errors(verdicts: Verdicts, onset_s: float, confidence: float) -> Iterator[StatedErrors]:
    """Yield the errors [s] of the estimated onsets for each detector and each planned mean flow of the leak.

    Only records with a leak and an alarm count; detectors that estimate no onset are skipped. `verdicts`: by detector,
    its verdict on each record; `onset_s` [s]: true onset of all leaks. `confidence`: that of the errors' intervals.
    """
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
    """Yield the errors of the estimated leak flows [L/min] for each detector and each planned mean flow.

    `verdicts`: by detector, its verdict on each record. Detectors that estimate no flow are skipped. `confidence`: that
    of the errors' intervals.
    """
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
    """Yield the errors of one detector's estimates on the records of one planned mean flow `leak_lpm` [L/min].

    `stated`: for each record (estimate, true value, interval), with None for a missing estimate or interval. Nothing is
    yielded if all estimates are missing. `confidence`: that of the errors' intervals.
    """
    estimates = [math.nan if value is None else value for value, _, _ in stated]
    if np.isfinite(estimates).any():
        low, high = zip(
            *((math.nan, math.nan) if interval is None else interval for _, _, interval in stated), strict=True
        )
        truth = [value for _, value, _ in stated]
        yield StatedErrors(detector, leak_lpm, estimate_errors(estimates, truth, low, high, confidence))


def iter_cause_confusions(verdicts: Verdicts, confidence: float) -> Iterator[NamedCauses]:
    """Yield the confusion matrix of true and named causes for each detector that names causes.

    `verdicts`: by detector, its verdict on each record. Nothing is yielded if no record has a fault other than a leak.
    A record with a leak and another fault has two true causes and is left out. A record without a result counts as
    `cannot tell`.
    `confidence`: that of the fractions' intervals.
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
    """Return the true cause of a record: "piston leak", else the cause to be named for its fault, else "none"."""
    if record.size > 0:
        return PISTON_LEAK
    return expected_cause(record.row.fault) if record.row.fault else NO_CAUSE
