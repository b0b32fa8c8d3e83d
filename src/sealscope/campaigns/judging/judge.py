"""Judge a campaign: thresholds from its leak-free records, verdicts on all other records, and their statistics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.judging.alarms import (
    AlarmFractions,
    add_references,
    alarms_by_cell,
    alarms_by_family,
    alarms_by_fault,
    alarms_by_size,
)
from sealscope.campaigns.judging.curves import DetectorPod, SizeRoc, iter_pods, iter_rocs
from sealscope.campaigns.judging.statements import (
    NamedCauses,
    StatedErrors,
    flow_errors,
    iter_cause_confusions,
    onset_errors,
)
from sealscope.campaigns.judging.verdicts import (
    Thresholds,
    collect_verdicts,
    compute_thresholds,
    drop_other_faults,
    group_by,
)
from sealscope.errors import InputError
from sealscope.evaluation.thresholds import Promise


@dataclass(frozen=True)
class Judgement:
    """The statistics of a campaign's verdicts.

    - `leak_free`: number of leak-free records from which the `thresholds` of scorers are set, 0 if none is set
    - `judged`: number of judged records that have a result
    - `failed`: all rows with an error; on those to judge the verdict of every detector is `cannot tell`
    - `table`, `overall`: fractions of alarms for each size of the leak, and for all sizes together
    - `onsets`, `flows`: errors of the onsets and leak flows that detectors state
    - `causes`: confusion matrices of the causes that detectors name
    - `pods`, `rocs`: probability of detection over the size of the leak, and ROC curves
    - `cells`, `faults`, `families`: fractions of alarms for each combination of the factors' levels, for each fault
      other than a leak, and for each family of machines
    - `achieved_flows`: by planned size of the leak, mean and standard deviation of the simulated leak flow [L/min]
    """

    thresholds: Thresholds
    leak_free: int
    judged: int
    failed: tuple[CaseRow, ...]
    table: tuple[AlarmFractions, ...]
    overall: tuple[AlarmFractions, ...]
    onsets: tuple[StatedErrors, ...]
    flows: tuple[StatedErrors, ...]
    causes: tuple[NamedCauses, ...]
    pods: tuple[DetectorPod, ...]
    rocs: tuple[SizeRoc, ...]
    cells: tuple[AlarmFractions, ...]
    faults: tuple[AlarmFractions, ...]
    families: tuple[AlarmFractions, ...]
    achieved_flows: Mapping[float, tuple[float, float]]


def judge(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    *,
    false_alarm: float = 0.01,
    promise: Promise = "average",
    confidence: float = 0.95,
    onset_s: float | None = None,
    hours: float | None = None,
) -> Judgement:
    """Collect all detectors' verdicts on the rows (results of records) with `use` "judge", and compute statistics.

    Scorers without a fixed threshold get one from the leak-free rows of the same duty (`compute_thresholds`). Records
    with a fault other than a leak count only in `judged`, `failed`, `causes` and `faults`. In `table`, `overall` and
    `faults` the detectors are followed by two references, which always or never raise an alarm. Raises InputError if
    there is no row to judge, or too few leak-free rows to set a threshold.

    - `false_alarm`, `promise`: wanted false-alarm probability, and how the thresholds keep it (`Promise`)
    - `confidence`: probability for the promise "bound", and confidence level of all intervals
    - `onset_s` [s]: true onset of the leaks, None to compute no errors of onsets
    - `hours`: operating time of a record [h], None to compute no false alarms per hour
    """
    judged = sorted((row for row in rows if row.use == "judge"), key=lambda row: row.id)
    if not judged:
        raise InputError("a campaign needs at least one record to judge, got none")
    thresholds = compute_thresholds(rows, detectors, false_alarm, promise, confidence)
    verdicts = collect_verdicts(judged, detectors, thresholds)
    leak_verdicts = drop_other_faults(verdicts)
    compared_verdicts = add_references(leak_verdicts)
    return Judgement(
        thresholds=thresholds,
        leak_free=sum(row.use == "calibrate" and row.error is None for row in rows) if thresholds else 0,
        judged=sum(row.error is None for row in judged),
        failed=tuple(row for row in sorted(rows, key=lambda row: row.id) if row.error is not None),
        table=tuple(alarms_by_size(compared_verdicts, confidence, hours)),
        overall=tuple(alarms_by_size(compared_verdicts, confidence, hours, pooled=True)),
        onsets=() if onset_s is None else tuple(onset_errors(leak_verdicts, onset_s, confidence)),
        flows=tuple(flow_errors(leak_verdicts, confidence)),
        causes=tuple(iter_cause_confusions(verdicts, confidence)),
        pods=tuple(iter_pods(leak_verdicts, confidence)),
        rocs=tuple(iter_rocs(leak_verdicts, confidence)),
        cells=tuple(alarms_by_cell(leak_verdicts, confidence)),
        faults=tuple(alarms_by_fault(add_references(verdicts), confidence)),
        families=tuple(alarms_by_family(leak_verdicts, confidence)),
        achieved_flows=_achieved_flows([row for row in judged if not row.fault]),
    )


def _achieved_flows(rows: Sequence[CaseRow]) -> dict[float, tuple[float, float]]:
    """Compute mean and standard deviation of the simulated leak flows [L/min] for each planned flow.

    The standard deviation is nan for a single record.
    """
    achieved = {}
    for size, group in group_by((row for row in rows if row.leak_lpm > 0), lambda row: row.leak_lpm).items():
        flows = [row.flow_lpm for row in group if row.flow_lpm is not None]
        if flows:
            standard_deviation = float(np.std(flows, ddof=1)) if len(flows) > 1 else math.nan
            achieved[size] = (float(np.mean(flows)), standard_deviation)
    return achieved
