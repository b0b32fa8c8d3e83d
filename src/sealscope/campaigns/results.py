"""Judge a campaign, from the stored rows of its simulated records or from recordings, and write its result tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sealscope.campaigns.cases.recordings import ProgressCallback, judge_recordings
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution import store
from sealscope.campaigns.judging.judge import Judgement, judge
from sealscope.campaigns.judging.tables import PriorKnowledge, build_tables, records_table, write_tables
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, parse_detector_name
from sealscope.campaigns.plans.model import AnyPlan, RecordedPlan, SimulatedPlan
from sealscope.errors import InputError
from sealscope.storage.folders import make_folder


@dataclass(frozen=True)
class CampaignResult:
    """A campaign and its results.

    `missing`: number of the plan's records without a row; `judgement`: statistics of the verdicts; `known`: by
    detector, the information that it was given.
    """

    plan: AnyPlan
    rows: tuple[CaseRow, ...]
    missing: int
    judgement: Judgement
    known: Mapping[str, PriorKnowledge]


def prior_knowledge(plan: AnyPlan) -> dict[str, PriorKnowledge]:
    """Collect the information that a plan gives to each of its detectors, by the detector's name.

    A scorer that compares two parts of a record knows the true onset of simulated records, because they are split
    there. Detectors that are not scorers assume the plan's rig, if it states one.
    """
    knowledge = {}
    for name in plan.detectors:
        detector = parse_detector_name(name)
        knows_onset = isinstance(plan, SimulatedPlan) and detector.scorer is not None and detector.scorer.compares_parts
        rig = plan.assumed if detector.scorer is None else None
        channels = plan.views.get(detector.view, ALL_CHANNELS)
        knowledge[name] = PriorKnowledge(knows_onset, channels, "" if rig is None else rig.name)
    return knowledge


def judge_simulated_campaign(plan: SimulatedPlan, folder: Path) -> CampaignResult:
    """Judge a simulated campaign from the rows, the stored results of its records, in its folder.

    Raises InputError if there are too few rows to judge or to set thresholds.
    """
    rows = tuple(store.read_plan_rows(plan, folder).values())
    if not rows:
        raise InputError(f"a campaign must have rows to report on, got none; run it first ({folder})")
    judgement = judge(
        rows, plan.detectors, false_alarm=plan.false_alarm, promise=plan.promise, confidence=plan.confidence,
        onset_s=plan.onset_s, hours=plan.duration_s / 3600.0,
    )  # fmt: skip
    return CampaignResult(plan, rows, plan.size - len(rows), judgement, prior_knowledge(plan))


def judge_recorded_campaign(
    plan: RecordedPlan, folder: Path, progress: ProgressCallback | None = None
) -> CampaignResult:
    """Judge the recordings in a folder with the detectors of a plan; `progress` is called after each recording."""
    rows = judge_recordings(plan, folder, progress)
    judgement = judge(
        rows, plan.detectors, false_alarm=plan.false_alarm, promise=plan.promise, confidence=plan.confidence
    )
    return CampaignResult(plan, tuple(rows), missing=0, judgement=judgement, known=prior_knowledge(plan))


def write_result(result: CampaignResult, folder: Path) -> list[Path]:
    """Write the tables of a campaign's result as CSV files into a folder; return the paths of the files."""
    make_folder(folder)
    unit = result.plan.unit
    tables = build_tables(result.judgement, unit, result.known, getattr(result.plan, "part", ""))
    tables["records"] = records_table(result.rows, result.plan.detectors, unit)
    return write_tables(folder, tables)
