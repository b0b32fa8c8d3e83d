"""A campaign's result, from its folder or from measured data: rows judged, tables written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sealscope.campaigns.cases.recordings import ProgressCallback, recorded_rows
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution import store
from sealscope.campaigns.held_out.checks import HeldOutCheck, checks_of
from sealscope.campaigns.held_out.classifiers import MeasuredSamples, held_out_rows
from sealscope.campaigns.judging.judge import Judgement, judge
from sealscope.campaigns.judging.tables import PriorKnowledge, TableRow, records_table, tables_of, write_tables
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, plan_detector
from sealscope.campaigns.plans.model import AnyPlan, HeldOutPlan, RecordedPlan, SimulatedPlan
from sealscope.errors import InputError
from sealscope.storage.folders import make_folder


@dataclass(frozen=True)
class CampaignResult:
    """A campaign and what it shows.

    `missing`: records of the plan that have no row yet; `checks`: of classifiers that were held out; `mode`: how the
    rows of a simulated campaign were made, "" for another; `known`: detector -> what it was given beside the record.
    """

    plan: AnyPlan
    rows: tuple[CaseRow, ...]
    missing: int
    judgement: Judgement
    checks: tuple[HeldOutCheck, ...] = ()
    mode: str = ""
    known: Mapping[str, PriorKnowledge] = field(default_factory=dict)


def prior_knowledge(plan: SimulatedPlan | RecordedPlan) -> dict[str, PriorKnowledge]:
    """Return what a plan gives its detectors beside the recording.

    A scorer of the two sides of a split knows the true onset where the records are simulated, for they are split
    there; in recordings it is split half-way, and nothing is known. Other detectors assume the rig that the plan
    states.
    """
    simulated = isinstance(plan, SimulatedPlan)
    rig = "" if plan.assumed is None else plan.assumed.name
    known = {}
    for name in plan.detectors:
        detector = plan_detector(name)
        known[name] = PriorKnowledge(
            onset=simulated and detector.scorer is not None and detector.scorer.split,
            channels=tuple(plan.views.get(detector.view, ALL_CHANNELS)),
            rig=rig if detector.scorer is None else "",
        )
    return known


def _judged(
    plan: SimulatedPlan | RecordedPlan,
    rows: Sequence[CaseRow],
    onset_s: float | None = None,
    hours: float | None = None,
) -> Judgement:
    return judge(
        rows,
        plan.detectors,
        false_alarm=plan.false_alarm,
        promise=plan.promise,
        confidence=plan.confidence,
        onset_s=onset_s,
        hours=hours,
    )


def simulated_result(plan: SimulatedPlan, folder: Path) -> CampaignResult:
    """Return the result of a simulated campaign, complete or not; InputError where its rows do not suffice for one."""
    rows = tuple(store.rows_of(plan, folder).values())
    if not rows:
        raise InputError(f"a campaign must have rows to report on, got none; run it first ({folder})")
    head = store.head(folder) or store.made_from(plan)
    judgement = _judged(plan, rows, onset_s=plan.onset_s, hours=plan.duration_s / 3600.0)
    mode = str(head.get("mode", store.RUN_BY_RUN))
    return CampaignResult(plan, rows, plan.size - len(rows), judgement, mode=mode, known=prior_knowledge(plan))


def held_out_result(plan: HeldOutPlan, samples: MeasuredSamples) -> CampaignResult:
    """Return the result of a campaign over measured data; an alarm is log odds over 0."""
    rows = held_out_rows(plan, samples)
    names = detectors_of(plan)
    judgement = judge(rows, names, limits=dict.fromkeys(names, 0.0), confidence=plan.confidence)
    return CampaignResult(plan, tuple(rows), 0, judgement, tuple(checks_of(plan, samples)))


def recorded_result(plan: RecordedPlan, folder: Path, progress: ProgressCallback | None = None) -> CampaignResult:
    """Return the result of a campaign over the recordings in a folder."""
    rows = recorded_rows(plan, folder, progress)
    return CampaignResult(plan, tuple(rows), 0, _judged(plan, rows), known=prior_knowledge(plan))


def detectors_of(plan: AnyPlan) -> list[str]:
    """Return the names of a plan's detectors."""
    return [detector if isinstance(detector, str) else detector.name for detector in plan.detectors]


def _check_row(check: HeldOutCheck) -> TableRow:
    return {
        "detector": check.detector,
        **dict(zip(("AUC, tests held out", "tests: low", "tests: high"), check.tests, strict=True)),
        **dict(zip(("AUC, conditions held out", "conditions: low", "conditions: high"), check.conditions, strict=True)),
        "AUC that 5 % of swapped labels reach": check.chance,
        "swaps that reach the true labels' AUC": check.reached if check.swaps else None,
        "swaps": check.swaps or None,
        "chosen": "; ".join(f"{features}: {times}" for features, times in check.picks),
    }


def write_result(result: CampaignResult, folder: Path) -> list[Path]:
    """Write the tables into the folder; return the files."""
    make_folder(folder)
    unit = result.plan.unit
    tables = tables_of(result.judgement, unit, result.known, getattr(result.plan, "part", ""))
    tables["records"] = records_table(result.rows, detectors_of(result.plan), unit)
    tables["held_out"] = [_check_row(check) for check in result.checks]
    return write_tables(folder, tables)
