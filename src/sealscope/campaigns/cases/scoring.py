"""Scores and statements of a plan's detectors on one record."""

from __future__ import annotations

from collections.abc import Sequence

from sealscope.campaigns.cases.online import online
from sealscope.campaigns.cases.row import STATED, Scores, finite, rank_of, stated_evidence
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, DIAGNOSE, Views, plan_detector
from sealscope.diagnosis.calibration.scorers import Look, Sides, scorer, split_view
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.errors import InputError


def stated(look: Look, names: Sequence[str], views: Views) -> tuple[Scores, dict[str, Evidence]]:
    """Return score and onset of each detector, and its statement under its key; every detector is run once."""
    detectors = [plan_detector(name) for name in names]
    looks = {view: look.through(views.get(view, ALL_CHANNELS)) for view in {d.view: None for d in detectors}}
    scores: dict[str, tuple[float | None, float | None]] = {}
    statements: dict[str, Evidence] = {}
    for detector in detectors:
        seen = looks[detector.view]
        if detector.detector and detector.key not in statements:
            examination = seen.examination
            if detector.online:
                evidence = online(seen.recording, examination.rig, examination.false_alarm_probability)
            elif detector.of == DIAGNOSE:
                evidence = examination.fused(detector.quick)
            else:
                evidence = examination.evidence(detector.of)
            statements[detector.key] = stated_evidence({name: getattr(evidence, name) for name in STATED})
        if detector.own:
            statement = statements[detector.key]
            score = _share(statement) if detector.of == DIAGNOSE else rank_of(statement)
            scores[detector.name] = (score, statement.onset_s)
        else:
            scored = scorer(split_view(detector.name)[0]).score(seen)
            scores[detector.name] = (finite(scored.value), finite(scored.onset_s))
    return scores, statements


def scored(sides: Sides, names: Sequence[str], views: Views) -> Scores:
    """Return the same scores as `stated`, of detectors that need only the RMS on both sides; none has an onset."""
    scores: dict[str, tuple[float | None, float | None]] = {}
    for name in names:
        detector = plan_detector(name)
        of_sides = scorer(detector.of).of_sides
        if detector.detector or of_sides is None:
            raise InputError(f"a detector scored from the RMS on both sides must need no more, got {name!r}")
        seen = sides.through(views.get(detector.view, ALL_CHANNELS))
        scores[name] = (finite(of_sides(seen).value), None)
    return scores


def _share(evidence: Evidence) -> float | None:
    """Return the fused verdict's score over its threshold: the deciding detector differs between records."""
    rank, threshold = rank_of(evidence), evidence.threshold
    if rank is None or threshold is None:
        return None
    return rank / threshold if threshold > 0 else rank - threshold
