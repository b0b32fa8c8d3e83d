"""A campaign's result, from its folder or from recordings: rows judged, tables written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sealscope.campaigns.cases.recordings import ProgressCallback, recorded_rows
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution import store
from sealscope.campaigns.judging.judge import Judgement, judge
from sealscope.campaigns.judging.tables import PriorKnowledge, records_table, tables_of, write_tables
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, plan_detector
from sealscope.campaigns.plans.model import AnyPlan, RecordedPlan, SimulatedPlan
from sealscope.errors import InputError
from sealscope.storage.folders import make_folder


@dataclass(frozen=True)
class CampaignResult:
    """A campaign and its results.

    `missing`: records of the plan that have no row yet; `mode`: how the rows of a simulated campaign were
    made, "" for another; `known`: detector -> what it was given beside the record.
    """

    plan: AnyPlan
    rows: tuple[CaseRow, ...]
    missing: int
    judgement: Judgement
    mode: str = ""
    known: Mapping[str, PriorKnowledge] = field(default_factory=dict)


def prior_knowledge(plan: SimulatedPlan | RecordedPlan) -> dict[str, PriorKnowledge]:
    """Collect the knowledge that a plan's detectors have besides the recording.

    A scorer of the two sides of a split knows the true onset where the records are simulated, for they are split
    there; in recordings it is split half-way, and nothing is known. Other detectors assume the rig that the plan
    states.
    """
    simulated = isinstance(plan, SimulatedPlan)
    rig = "" if plan.assumed is None else plan.assumed.name
    knowledge = {}
    for name in plan.detectors:
        detector = plan_detector(name)
        knowledge[name] = PriorKnowledge(
            onset=simulated and detector.scorer is not None and detector.scorer.split,
            channels=tuple(plan.views.get(detector.view, ALL_CHANNELS)),
            rig=rig if detector.scorer is None else "",
        )
    return knowledge


def _judge(
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
    """Judge a simulated campaign, complete or not; raise InputError where its rows do not suffice."""
    rows = tuple(store.rows_of(plan, folder).values())
    if not rows:
        raise InputError(f"a campaign must have rows to report on, got none; run it first ({folder})")
    head = store.head(folder) or store.made_from(plan)
    judgement = _judge(plan, rows, onset_s=plan.onset_s, hours=plan.duration_s / 3600.0)
    mode = str(head.get("mode", store.RUN_BY_RUN))
    return CampaignResult(plan, rows, plan.size - len(rows), judgement, mode=mode, known=prior_knowledge(plan))


def recorded_result(plan: RecordedPlan, folder: Path, progress: ProgressCallback | None = None) -> CampaignResult:
    """Judge a campaign over the recordings in a folder."""
    rows = recorded_rows(plan, folder, progress)
    return CampaignResult(plan, tuple(rows), 0, _judge(plan, rows), known=prior_knowledge(plan))


def write_result(result: CampaignResult, folder: Path) -> list[Path]:
    """Write the tables into the folder; return the files."""
    make_folder(folder)
    unit = result.plan.unit
    tables = tables_of(result.judgement, unit, result.known, getattr(result.plan, "part", ""))
    tables["records"] = records_table(result.rows, result.plan.detectors, unit)
    return write_tables(folder, tables)
