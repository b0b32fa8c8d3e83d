"""Scores and statements of a plan's detectors on one record."""

from __future__ import annotations

from collections.abc import Sequence

from sealscope.campaigns.cases.online import online
from sealscope.campaigns.cases.row import STATED, Scores, finite, rank_of, stated_evidence
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, DIAGNOSE, PlanDetector, Views, plan_detector
from sealscope.campaigns.plans.scorers import Sides
from sealscope.diagnosis.diagnose import Examination
from sealscope.diagnosis.verdict.evidence import Evidence


def stated(
    examination: Examination, split_s: float, names: Sequence[str], views: Views
) -> tuple[Scores, dict[str, Evidence]]:
    """Return score and onset of each detector, and what each that is no scorer states; every detector is run once.

    `split_s` [s]: the moment on the recording's time axis at which scorers split it.
    """
    detectors = [plan_detector(name) for name in names]
    seen = {view: examination.through(views.get(view, ALL_CHANNELS)) for view in {d.view: None for d in detectors}}
    rules = [detector.name for detector in detectors if detector.scorer is not None]
    scores = scored(Sides.of(examination.recording, split_s), rules, views) if rules else {}
    statements: dict[str, Evidence] = {}
    for detector in detectors:
        if detector.scorer is None:
            evidence = _evidence(detector, seen[detector.view])
            statement = stated_evidence({name: getattr(evidence, name) for name in STATED})
            statements[detector.name] = statement
            rank = _share(statement) if detector.of == DIAGNOSE else rank_of(statement)
            scores[detector.name] = (rank, statement.onset_s)
    return scores, statements


def _evidence(detector: PlanDetector, examination: Examination) -> Evidence:
    if detector.online:
        return online(examination.recording, examination.rig, examination.false_alarm_probability)
    if detector.of == DIAGNOSE:
        return examination.fused(detector.quick)
    return examination.evidence(detector.of)


def scored(sides: Sides, names: Sequence[str], views: Views) -> dict[str, tuple[float | None, float | None]]:
    """Return the scores of scorers, which find no onset."""
    scores: dict[str, tuple[float | None, float | None]] = {}
    for name in names:
        detector = plan_detector(name)
        if detector.scorer is not None:
            value = detector.scorer.score(sides.through(views.get(detector.view, ALL_CHANNELS)))
            scores[name] = (finite(value), None)
    return scores


def _share(evidence: Evidence) -> float | None:
    """Return the fused verdict's score over its threshold: the deciding detector differs between records."""
    rank, threshold = rank_of(evidence), evidence.threshold
    if rank is None or threshold is None:
        return None
    return rank / threshold if threshold > 0 else rank - threshold
