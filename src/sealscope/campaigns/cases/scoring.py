"""Simulate a record of a plan, run the plan's detectors on it, and collect their scores and statements."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

from sealscope.campaigns.cases.case import CampaignCase
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.cases.row import CaseRow, Scores, Statement, error_text
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, DIAGNOSE, WATCH, parse_detector_name
from sealscope.campaigns.plans.model import RecordedPlan, SimulatedPlan
from sealscope.campaigns.plans.scorers import LogRms, split_log_rms
from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.diagnosis.live.watch import Watch
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate_experiment

#: Channels whose defects can invalidate a verdict; the recording is inspected for them first.
INSPECTED = ("u", "x", "p_A", "p_B")


def run_case(plan: SimulatedPlan, case: CampaignCase, folder: Path | None = None) -> CaseRow:
    """Simulate and judge one case of a campaign, and return the row with its results or any error.

    The recording is written into `folder`, or discarded if `folder` is None.
    """
    start_time = time.process_time()
    try:
        simulated = simulate_experiment(case_experiment(plan, case))
        if folder is not None:
            from sealscope.recordings import write

            write(simulated.recording, folder / f"{case.id}.nc")
        scores, statements = judge_record(simulated.recording, plan.onset_s, plan, plan.assumed)
        flow = simulated.truth.mean_leak_lpm if case.leak_lpm else 0.0
        row = CaseRow.from_case(case, flow_lpm=flow, scores=scores, statements=statements)
    except Exception as error:  # a program defect in one case must not end the campaign; its row carries the error
        row = CaseRow.from_case(case, error=error_text(error))
    return replace(row, seconds=round(time.process_time() - start_time, 4))


def judge_record(
    recording: Recording, split_s: float | None, plan: SimulatedPlan | RecordedPlan, rig: Rig
) -> tuple[Scores, dict[str, Statement]]:
    """Run each detector of a plan on a recording; return, by detector, scores and statements (stored verdicts).

    Scorers have no statement. `split_s` [s]: time at which they split the recording, None for its middle; `rig`: the
    rig that detectors may assume. Raises InputError if the recording has a defect that rules out any verdict.
    """
    record = inspect_recording(recording, INSPECTED)  # `part`: usable samples; `share`: their fraction
    if record.defect is not None:
        raise InputError(f"the record cannot be judged: {record.defect}" + (f" ({record.file})" if record.file else ""))
    examination = Examination(record.part, false_alarm_probability=plan.false_alarm, rig=rig, share=record.share)
    detectors = [parse_detector_name(name) for name in plan.detectors]
    views = dict.fromkeys(detector.view for detector in detectors)
    examinations = {view: examination.with_channels(plan.views.get(view, ALL_CHANNELS)) for view in views}
    log_rms: LogRms = {}
    if any(detector.scorer is not None for detector in detectors):
        split_s = float(record.part.t[0]) + record.part.duration / 2 if split_s is None else split_s
        log_rms = split_log_rms(record.part, split_s)
    scores = score_details(log_rms, plan)
    statements: dict[str, Statement] = {}
    for detector in detectors:
        if detector.scorer is None:
            case = examinations[detector.view]
            if detector.base == WATCH:
                evidence = run_watch(case.recording, case.rig, case.false_alarm_probability)
            elif detector.base == DIAGNOSE:
                evidence = case.decide_by_all()
            else:
                evidence = case.evidence(detector.base)
            statement = Statement.from_evidence(evidence)
            statements[detector.name] = statement
            score = _score_over_threshold(statement) if detector.base == DIAGNOSE else statement.ranking_score
            scores[detector.name] = (score, statement.onset_s)
    return scores, statements


def score_details(log_rms: LogRms, plan: SimulatedPlan | RecordedPlan) -> dict[str, tuple[float | None, float | None]]:
    """Compute the scores of those detectors of a plan that only compute a score (scorers).

    Returns (score or None, None) by detector, as scorers estimate no onset.
    """
    scores: dict[str, tuple[float | None, float | None]] = {}
    for name in plan.detectors:
        detector = parse_detector_name(name)
        if detector.scorer is not None:
            scores[name] = (detector.scorer.score(log_rms, plan.views.get(detector.view, ALL_CHANNELS)), None)
    return scores


def _score_over_threshold(statement: Statement) -> float | None:
    """Compute the score of `diagnose` relative to its threshold: their ratio, or difference for a threshold <= 0.

    For such a threshold, a ratio would not rise with the score. Records become comparable, although the verdict of each
    may come from another detector with another scale. Returns None if there is no threshold or no score for ranking.
    """
    score, threshold = statement.ranking_score, statement.threshold
    if score is None or threshold is None:
        return None
    return score / threshold if threshold > 0 else score - threshold


def run_watch(recording: Recording, rig: Rig | str | os.PathLike[str], false_alarm: float) -> Evidence:
    """Run the continuous watch of a machine (`Watch`) over a recording, and return its evidence at the end.

    `false_alarm`: bound on the probability that a healthy machine raises an alarm within the recording.
    """
    alarms_per_1000_hours = false_alarm * 3.6e6 / recording.duration  # 1000 hours are 3.6e6 s
    # learn_hours: longer than any recording, so that no part of it becomes the healthy baseline of the rest
    watch = Watch(load_rig(rig), alarms_per_1000_hours, learn_hours=1000.0)
    watch.update(recording)
    return watch.evidence
