"""Scores and statements of a plan's detectors on one record."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace

from sealscope.campaigns.cases.row import Scores, Statement, finite, rank_of
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, DIAGNOSE, WATCH, PlanDetector, Views, plan_detector
from sealscope.campaigns.plans.model import RecordedPlan, SimulatedPlan
from sealscope.campaigns.plans.scorers import Sides
from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.live.watch import Watch
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording

#: Channels that are inspected for findings: those that can spoil a verdict.
INSPECTED = ("u", "x", "p_A", "p_B")
#: Samples of a stream arrive in portions of this length [s].
_PORTION = 1.0


def judge_record(
    recording: Recording, split_s: float | None, plan: SimulatedPlan | RecordedPlan, rig: Rig
) -> tuple[Scores, dict[str, Statement]]:
    """Run each detector of a plan once; return scores with onsets, and the statements of those that are no scorers.

    `split_s` [s]: the moment on the recording's time axis at which scorers split it, None for its middle; `rig`: what
    detectors may assume. Raises InputError for a recording that none of them can judge.
    """
    record = inspected(recording, INSPECTED)
    if record.defect is not None:
        raise InputError(f"the record cannot be judged: {record.defect}" + (f" ({record.file})" if record.file else ""))
    examination = Examination(record.part, false_alarm_probability=plan.false_alarm, rig=rig, share=record.share)
    detectors = [plan_detector(name) for name in plan.detectors]
    examinations = {
        view: examination.through(plan.views.get(view, ALL_CHANNELS)) for view in {d.view: None for d in detectors}
    }
    scores: dict[str, tuple[float | None, float | None]] = {}
    if any(detector.scorer is not None for detector in detectors):
        split_s = float(record.part.t[0]) + record.part.duration / 2 if split_s is None else split_s
        scores = score_sides(Sides.from_recording(record.part, split_s), plan.detectors, plan.views)
    statements: dict[str, Statement] = {}
    for detector in detectors:
        if detector.scorer is None:
            statement = Statement.from_evidence(_evidence(detector, examinations[detector.view]))
            statements[detector.name] = statement
            rank = _share(statement) if detector.base == DIAGNOSE else rank_of(statement)
            scores[detector.name] = (rank, statement.onset_s)
    return scores, statements


def _evidence(detector: PlanDetector, examination: Examination) -> Evidence:
    if detector.base == WATCH:
        return run_watch(examination.recording, examination.rig, examination.false_alarm_probability)
    if detector.base == DIAGNOSE:
        return examination.fused()
    return examination.evidence(detector.base)


def score_sides(sides: Sides, names: Sequence[str], views: Views) -> dict[str, tuple[float | None, float | None]]:
    """Compute the scores of scorers, which find no onset."""
    scores: dict[str, tuple[float | None, float | None]] = {}
    for name in names:
        detector = plan_detector(name)
        if detector.scorer is not None:
            value = detector.scorer.score(sides.through(views.get(detector.view, ALL_CHANNELS)))
            scores[name] = (finite(value), None)
    return scores


def _share(evidence: Statement) -> float | None:
    """Compute the fused verdict's score over its threshold: the deciding detector differs between records."""
    rank, threshold = rank_of(evidence), evidence.threshold
    if rank is None or threshold is None:
        return None
    return rank / threshold if threshold > 0 else rank - threshold


def run_watch(recording: Recording, rig: Rig | str | os.PathLike[str], false_alarm: float) -> Evidence:
    """Run the watch of a machine; return its evidence at the record's end, where a raised alarm stays.

    Its rate of alarms is the one at which a healthy machine alarms within the record with the probability
    `false_alarm` at most.
    """
    watch = Watch(load_rig(rig), false_alarm * 3.6e6 / recording.duration, learn_hours=1000.0)
    begin = float(recording.t[0])
    for second in range(math.ceil(recording.duration / _PORTION)):
        watch.update(recording.between(begin + second * _PORTION, begin + (second + 1) * _PORTION))
    return replace(watch.evidence, detector=WATCH)
