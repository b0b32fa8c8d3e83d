"""Scores and statements of a plan's detectors on one record."""

from __future__ import annotations

from collections.abc import Sequence

from sealscope.campaigns.cases.row import Scores, Statement, finite
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, DIAGNOSE, Views, plan_detector
from sealscope.diagnosis.calibration.scorers import Look, Sides, scorer, split_view
from sealscope.errors import InputError


def stated(look: Look, names: Sequence[str], views: Views) -> tuple[Scores, dict[str, Statement]]:
    """Return score and onset of each detector, and its statement under its key; every detector is run once."""
    detectors = [plan_detector(name) for name in names]
    looks = {view: look.through(views.get(view, ALL_CHANNELS)) for view in {d.view: None for d in detectors}}
    scores: dict[str, tuple[float | None, float | None]] = {}
    statements: dict[str, Statement] = {}
    for detector in detectors:
        seen = looks[detector.view]
        if detector.detector and detector.key not in statements:
            examination = seen.examination
            evidence = examination.fused() if detector.of == DIAGNOSE else examination.evidence(detector.of)
            statements[detector.key] = Statement.of(evidence)
        if detector.own:
            statement = statements[detector.key]
            score = _share(statement) if detector.of == DIAGNOSE else statement.rank
            scores[detector.name] = (score, statement.onset_s)
        else:
            found = scorer(split_view(detector.name)[0]).score(seen)
            scores[detector.name] = (finite(found.value), finite(found.onset_s))
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


def _share(statement: Statement) -> float | None:
    """Return the fused verdict's score over its threshold: the deciding detector differs between records."""
    if statement.rank is None or statement.threshold is None:
        return None
    if statement.threshold > 0:
        return statement.rank / statement.threshold
    return statement.rank - statement.threshold
