"""A campaign's result from its folder or from measured data: rows judged, calibration and tables written beside
them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sealscope.campaigns.cases.recordings import ProgressCallback, recorded_rows
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.execution import store
from sealscope.campaigns.held_out.checks import HeldOutCheck, check_sheet, checks_of
from sealscope.campaigns.held_out.classifiers import Samples, held_out_rows
from sealscope.campaigns.judging.judge import Judgement, calibration_of, judge
from sealscope.campaigns.judging.tables import rows_sheet, sheets, write_sheets
from sealscope.campaigns.plans.model import AnyPlan, HeldOutPlan, RecordedPlan, SimulatedPlan
from sealscope.diagnosis.calibration.thresholds import save
from sealscope.errors import InputError

CALIBRATION = "calibration.json"


@dataclass(frozen=True)
class Result:
    """A campaign and what it shows; `missing`: records of the plan that have no row yet; `checks`: of classifiers that
    were held out; `mode`: how the rows of a simulated one were made, "" for another."""

    plan: AnyPlan
    rows: tuple[CaseRow, ...]
    missing: int
    judgement: Judgement
    checks: tuple[HeldOutCheck, ...] = ()
    mode: str = ""


def simulated_result(plan: SimulatedPlan, folder: Path) -> Result:
    """The result of a simulated campaign, complete or not; raises InputError where its rows do not suffice for one."""
    rows = store.rows_of(plan, folder)
    if not rows:
        raise InputError(f"a campaign must have rows to report on, got none; run it first ({folder})")
    head = store.head(folder) or store.made_from(plan)
    calibration = calibration_of(
        list(rows.values()),
        plan.detectors,
        rate=plan.false_alarm,
        promise=plan.promise,
        confidence=plan.confidence,
        split_share=plan.onset_s / plan.duration_s,
        made_from={"campaign": head},
        views=plan.views,
    )
    judgement = judge(
        list(rows.values()),
        plan.detectors,
        calibration,
        onset_s=plan.onset_s,
        hours=plan.duration_s / 3600.0,
        confidence=plan.confidence,
    )
    return Result(
        plan, tuple(rows.values()), plan.size - len(rows), judgement, mode=str(head.get("mode", store.RUN_BY_RUN))
    )


def held_out_result(plan: HeldOutPlan, samples: Samples) -> Result:
    """The result of a campaign over measured data; an alarm is log odds over 0."""
    rows = held_out_rows(plan, samples)
    names = [one.name for one in plan.detectors]
    judgement = judge(rows, names, None, thresholds=dict.fromkeys(names, 0.0), confidence=plan.confidence)
    return Result(plan, tuple(rows), 0, judgement, tuple(checks_of(plan, samples)))


def recorded_result(plan: RecordedPlan, folder: Path, progress: ProgressCallback | None = None) -> Result:
    """The result of a campaign over the recordings in a folder."""
    rows = recorded_rows(plan, folder, progress)
    calibration = calibration_of(
        rows,
        plan.detectors,
        rate=plan.false_alarm,
        promise=plan.promise,
        confidence=plan.confidence,
        made_from={"campaign": {"name": plan.name, "title": plan.title, "recordings": len(rows)}},
        views=plan.views,
    )
    return Result(plan, tuple(rows), 0, judge(rows, plan.detectors, calibration, confidence=plan.confidence))


def detectors_of(plan: AnyPlan) -> list[str]:
    """Names of a plan's detectors."""
    return [one if isinstance(one, str) else one.name for one in plan.detectors]


def write_result(result: Result, folder: Path) -> list[Path]:
    """Write tables (and the calibration, where there is one) into the folder; gives the files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"a campaign's folder must be one or become one, got: {error.strerror} ({folder})") from None
    files = write_sheets(
        folder,
        [
            *sheets(result.judgement, result.plan.unit),
            rows_sheet(result.rows, detectors_of(result.plan), result.plan.unit),
            check_sheet(result.checks),
        ],
    )
    if result.judgement.calibration is not None:
        save(result.judgement.calibration, folder / CALIBRATION)
        files.append(folder / CALIBRATION)
    return files
