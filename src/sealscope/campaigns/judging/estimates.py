"""What detectors state beyond a verdict, against the truth: when the leak began, how large it is, what the fault is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.campaigns.cases.row import NO_CAUSE, PISTON_LEAK, CaseRow, Statement, cause_of
from sealscope.campaigns.plans.detectors import plan_detector
from sealscope.evaluation.confusion import CANNOT_TELL, Confusion, confusion_matrix
from sealscope.evaluation.quantiles import Quantile, quantile_of
from sealscope.evaluation.rates import EstimateError, OnsetErrors, estimate_error, onset_errors

Said = Mapping[tuple[str, str], str]


@dataclass(frozen=True)
class Onset:
    """Errors [s] of the onsets that one detector found in its alarms at one size of leak."""

    detector: str
    leak_lpm: float
    errors: OnsetErrors


@dataclass(frozen=True)
class Estimate:
    """Errors of the flow that one detector states at one size of leak (0: leak-free records), over all records with an
    estimate, alarm or not: `errors` (mean, coverage of the stated interval), `median` (signed) and `median_size`."""

    detector: str
    leak_lpm: float
    errors: EstimateError
    median: Quantile
    median_size: Quantile


@dataclass(frozen=True)
class Named:
    """Which cause one detector names for which there is; `none` where nothing leaks and no fault is put in."""

    detector: str
    confusion: Confusion


def statement(row: CaseRow, detector: str) -> Statement | None:
    """What a detector stated on a row; None where it states nothing, or the record failed."""
    return row.statements.get(plan_detector(detector).key) if row.statements and row.error is None else None


def _pairs(pairs: Sequence[tuple[float, float] | None]) -> tuple[list[float], list[float]]:
    ends = [(math.nan, math.nan) if pair is None else pair for pair in pairs]
    return [low for low, _ in ends], [high for _, high in ends]


def onsets_of(
    rows: Sequence[CaseRow], detectors: Sequence[str], said: Said, onset_s: float | None, confidence: float
) -> list[Onset]:
    """For detectors that search for the onset: its error over the alarms, by size."""
    found = []
    for name in detectors if onset_s is not None else ():
        for size in sorted({row.leak_lpm for row in rows if row.leak_lpm > 0}):
            alarmed = [row for row in rows if row.leak_lpm == size and said[name, row.id] == "leak"]
            timed = [(at, row) for row in alarmed if (at := row.scores[name][1]) is not None]
            if not timed or onset_s is None:
                continue
            stated = [statement(row, name) for _, row in timed]
            low, high = _pairs([None if one is None else one.onset_interval_s for one in stated])
            errors = onset_errors([at for at, _ in timed], [onset_s] * len(timed), low, high, confidence)
            found.append(Onset(name, size, errors))
    return found


def estimates_of(rows: Sequence[CaseRow], detectors: Sequence[str], confidence: float) -> list[Estimate]:
    """For detectors that state a flow: its errors against the flow that the record really had, by size."""
    found = []
    for name in _stating(rows, detectors):
        for size in sorted({row.leak_lpm for row in rows}):
            own = [(row, one) for row in rows if row.leak_lpm == size and (one := statement(row, name)) is not None]
            truth = [row.leak_lpm if row.flow_lpm is None else row.flow_lpm for row, _ in own]
            given = [math.nan if one.leak_lpm is None else one.leak_lpm for _, one in own]
            if not np.isfinite(given).any():
                continue
            low, high = _pairs([one.leak_interval_lpm for _, one in own])
            error = np.array(given) - np.array(truth)
            error = error[np.isfinite(error)]
            found.append(
                Estimate(
                    name,
                    size,
                    estimate_error(given, truth, low, high, confidence),
                    quantile_of(error, 0.5, confidence),
                    quantile_of(np.abs(error), 0.5, confidence),
                )
            )
    return found


def named_of(rows: Sequence[CaseRow], detectors: Sequence[str], confidence: float) -> list[Named]:
    """For detectors judged by their own verdict, where there are faults: the causes they name. A record with a leak and
    another fault is left out; one that failed is `cannot tell`."""
    mine = [row for row in rows if not (row.leak_lpm > 0 and row.fault)]
    if not any(row.fault for row in mine):
        return []
    order = sorted({cause_of(row.fault) for row in mine if row.fault})
    truth = [PISTON_LEAK if row.leak_lpm > 0 else cause_of(row.fault) if row.fault else NO_CAUSE for row in mine]
    faults = [one for one in (NO_CAUSE, PISTON_LEAK) if one in truth] + order
    found = []
    for name in _stating(rows, detectors):
        if not plan_detector(name).own:
            continue
        stated = [statement(row, name) for row in mine]
        verdicts = [CANNOT_TELL if one is None else one.named for one in stated]
        others = sorted(set(verdicts) - set(faults) - {CANNOT_TELL})
        found.append(Named(name, confusion_matrix(truth, verdicts, [*faults, *others], confidence)))
    return found


def _stating(rows: Sequence[CaseRow], detectors: Sequence[str]) -> list[str]:
    """The detectors that state evidence, each once under whichever threshold; a calibrated one states the same."""
    keys = {key for row in rows for key in row.statements}
    found: dict[str, str] = {}
    for name in detectors if keys else ():
        one = plan_detector(name)
        if one.key in keys and (one.own or one.key not in found):
            found[one.key] = name
    return list(found.values())
