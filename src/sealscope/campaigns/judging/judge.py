"""Judge a campaign's rows: thresholds from its leak-free records, verdicts on all others, and their statistics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.judging.alarms import Alarms, AlarmShares
from sealscope.campaigns.judging.curves import DetectorPod, SizeRoc, pods_of, rocs_of
from sealscope.campaigns.judging.statements import NamedCauses, StatedErrors, causes_of, flow_errors, onset_errors
from sealscope.campaigns.judging.verdicts import Thresholds, grouped, thresholds_of, verdicts_of, without_fault
from sealscope.campaigns.plans.detectors import plan_detector
from sealscope.errors import InputError
from sealscope.evaluation.thresholds import Promise


@dataclass(frozen=True)
class Judgement:
    """The statistics of a campaign's verdicts.

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


def judge(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    *,
    false_alarm: float = 0.01,
    promise: Promise = "average",
    confidence: float = 0.95,
    limits: Mapping[str, float] | None = None,
    onset_s: float | None = None,
    hours: float | None = None,
) -> Judgement:
    """Compute verdicts and figures of all rows to judge.

    A detector's verdict is its own, or its score's against a threshold. The threshold is the one in `limits`, else the
    scorer's, else that of the leak-free rows of the same duty (`thresholds_of`), which `limits` turn off. `onset_s`
    [s]: true onset in leaky records, `hours`: operating time of a record; without them there are no errors of onsets
    and no alarms per hour. Raises InputError where there is no row to judge.
    """
    judged = sorted((row for row in rows if row.use == "judge"), key=lambda row: row.id)
    if not judged:
        raise InputError("a campaign needs at least one record to judge, got none")
    thresholds = {} if limits is not None else thresholds_of(rows, detectors, false_alarm, promise, confidence)
    if limits is None:
        scorers = {name: plan_detector(name).scorer for name in detectors}
        limits = {
            name: scorer.threshold
            for name, scorer in scorers.items()
            if scorer is not None and scorer.threshold is not None
        }
    verdicts = verdicts_of(judged, detectors, limits, thresholds)
    of_leaks = without_fault(verdicts)
    alarms = Alarms(verdicts, confidence)
    return Judgement(
        thresholds=thresholds,
        leak_free=sum(row.use == "calibrate" and row.error is None for row in rows) if thresholds else 0,
        judged=sum(row.error is None for row in judged),
        failed=tuple(row for row in sorted(rows, key=lambda row: row.id) if row.error is not None),
        table=tuple(alarms.by_size(hours)),
        overall=tuple(alarms.by_size(hours, together=True)),
        onsets=() if onset_s is None else tuple(onset_errors(of_leaks, onset_s, confidence)),
        flows=tuple(flow_errors(of_leaks, confidence)),
        causes=tuple(causes_of(verdicts, confidence)),
        pods=tuple(pods_of(of_leaks, confidence)),
        rocs=tuple(rocs_of(of_leaks, confidence)),
        cells=tuple(alarms.by_cell()),
        faults=tuple(alarms.by_fault()),
        families=tuple(alarms.by_family()),
        realised=_realised([row for row in judged if not row.fault]),
    )


def _realised(rows: Sequence[CaseRow]) -> dict[float, tuple[float, float]]:
    realised = {}
    for size, group in grouped((row for row in rows if row.leak_lpm > 0), lambda row: row.leak_lpm).items():
        flows = [row.flow_lpm for row in group if row.flow_lpm is not None]
        if flows:
            spread = float(np.std(flows, ddof=1)) if len(flows) > 1 else math.nan
            realised[size] = (float(np.mean(flows)), spread)
    return realised
