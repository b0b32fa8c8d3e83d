"""Families of machines: what is found in each, by size and law of the leak, beside what can be found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from sealscope.campaigns.cases.bound import smallest_found
from sealscope.campaigns.cases.case import FAMILY
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.plans.detectors import plan_detector
from sealscope.evaluation.binomial import Proportion, proportion
from sealscope.evaluation.confusion import CANNOT_TELL

#: What stands for all families together, and for all laws of a leak.
ALL, ANY_LAW = "all", "any"
#: Probability with which the best test finds a leak that the bound allows.
ALLOWED_DETECTION = 0.9


@dataclass(frozen=True)
class FamilyFinding:
    """One detector on one family of machines at one size (0: no leak) and law of the leak.

    `alarms`, `cannot_tell` over all records; `coverage`: how often a stated interval holds the flow that there was;
    `reachable`: records whose leak the Cramer-Rao bound of their machine allows to find, over those that have a bound,
    and `allowed`: alarms over these, both None where no bound was asked for; `failed`: records without a result, among
    those that cannot be told.
    """

    family: str
    detector: str
    leak_lpm: float
    law: str
    alarms: Proportion
    cannot_tell: Proportion
    coverage: Proportion
    reachable: Proportion | None
    allowed: Proportion | None
    failed: int


def allowed(row: CaseRow, false_alarm: float) -> bool:
    """Whether the best test at this false-alarm probability finds the leak of a row nine times in ten."""
    if row.bound_lpm is None:
        return False
    flow = row.leak_lpm if row.flow_lpm is None else row.flow_lpm
    return smallest_found(row.bound_lpm, false_alarm, ALLOWED_DETECTION) <= flow


def _kinds(rows: Sequence[CaseRow]) -> Iterator[tuple[float, str, list[CaseRow]]]:
    """Yield size, law and rows: each size with its laws apart, and together where there are several."""
    for size in sorted({row.leak_lpm for row in rows}):
        here = [row for row in rows if row.leak_lpm == size]
        laws = sorted({row.law for row in here}) if size else []
        if len(laws) != 1:
            yield size, ANY_LAW, here
        for law in laws:
            yield size, law, [row for row in here if row.law == law]


def family_findings(
    rows: Sequence[CaseRow],
    detectors: Sequence[str],
    verdicts: Mapping[tuple[str, str], str],
    *,
    false_alarm: float,
    confidence: float = 0.95,
) -> list[FamilyFinding]:
    """Return the findings of each detector, all families together first; none where the rows are of no family.

    `verdicts`: (detector, row id) -> verdict; `false_alarm`: the probability at which the bound's best test is taken.
    """
    names = sorted({str(row.levels[FAMILY]) for row in rows if FAMILY in row.levels})
    findings = []
    for name in detectors if names else ():
        for family in (ALL, *names):
            own = [row for row in rows if family in (ALL, row.levels.get(FAMILY))]
            for size, law, here in _kinds(own):
                findings.append(_finding(family, name, size, law, here, verdicts, false_alarm, confidence))
    return findings


def _finding(
    family: str,
    detector: str,
    size: float,
    law: str,
    rows: Sequence[CaseRow],
    verdicts: Mapping[tuple[str, str], str],
    false_alarm: float,
    confidence: float,
) -> FamilyFinding:
    given = [verdicts[detector, row.id] for row in rows]
    intervals = []
    for row in rows:
        stated = row.statements.get(plan_detector(detector).key)
        if stated is not None and row.error is None and stated.leak_interval_lpm is not None:
            low, high = stated.leak_interval_lpm
            intervals.append(low <= (row.leak_lpm if row.flow_lpm is None else row.flow_lpm) <= high)
    reachable, within = None, None
    bounded = sum(row.bound_lpm is not None for row in rows)
    if size and bounded:
        found = [verdict == "leak" for row, verdict in zip(rows, given, strict=True) if allowed(row, false_alarm)]
        reachable = proportion(len(found), bounded, confidence)
        within = proportion(sum(found), len(found), confidence)
    return FamilyFinding(
        family=family,
        detector=detector,
        leak_lpm=size,
        law=law,
        alarms=proportion(given.count("leak"), len(rows), confidence),
        cannot_tell=proportion(given.count(CANNOT_TELL), len(rows), confidence),
        coverage=proportion(sum(intervals), len(intervals), confidence),
        reachable=reachable,
        allowed=within,
        failed=sum(row.error is not None for row in rows),
    )
