"""Calibration on leak-free recordings, and diagnosis by the thresholds of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sealscope.diagnosis.baseline.inspection import inspected
from sealscope.diagnosis.calibration.scorers import CALIBRATED, Look, Score, scorer, split_view
from sealscope.diagnosis.calibration.thresholds import BY_STROKES, Calibration, Group, Place, calibrate
from sealscope.diagnosis.detector import unusable
from sealscope.diagnosis.registry import detectors as registered
from sealscope.diagnosis.rms_change.by_recordings import by_recordings
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.diagnosis.verdict.machine import assumed_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.evaluation.thresholds import FEWEST
from sealscope.parameters.load import load_rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Detectors that a calibration holds unless others are named; the first makes the verdict where no judge is before it.
DEFAULT_DETECTORS = ("rms change", "d3 of p_A changed", "d4 of p_A changed", "d3 of p_B changed", "d4 of p_B changed")


#: Detectors that judge before them, most telling first, where every recording has the channels that they need.
_RANKED = ("volume balance", "pressure response")


def default_detectors(parts: Sequence[Recording], rig: Rig | str = "thesis") -> tuple[str, ...]:
    """Return the detectors of a calibration by the channels that all its recordings have; the first judges."""
    made = {name: registered()[name](load_rig(rig)) for name in _RANKED}
    judges = [f"{name}{CALIBRATED}" for name in _RANKED if all(unusable(made[name], part) is None for part in parts)]
    seen = [name for name in DEFAULT_DETECTORS if all(_has_chamber(name, part) for part in parts)]
    return (*judges[:1], *seen)


def _has_chamber(name: str, part: Recording) -> bool:
    return not any(f" {chamber} " in name and chamber not in part for chamber in CHAMBERS)


def look_at(part: Recording, split_share: float, false_alarm_probability: float, rig: Rig | str = "thesis") -> Look:
    """Return the recording as scorers see it, split at that share of its length; `rig`: what detectors may assume."""
    return Look(part, float(part.t[0]) + split_share * part.duration, false_alarm_probability, rig)


def calibrate_on(
    recordings: Mapping[str, Recording],
    detectors: Sequence[str] = (),
    *,
    false_alarm_probability: float,
    split_share: float = 0.5,
    rig: Rig | str = "thesis",
    **options: Any,
) -> Calibration:
    """Calibrate detectors on leak-free recordings of one machine.

    `recordings`: name -> recording; one that cannot be judged raises InputError with its name and the reason: what is
    not leak-free data of the machine in good order has no place in a calibration. `detectors`: by default those for the
    channels that all recordings have (`default_detectors`); `rig`: what detectors may assume of
    the machine; `options` as for `calibrate`.
    """
    if not 0.0 < split_share < 1.0:
        raise InputError(f"the split must be a share of the length between 0 and 1, got {split_share}")
    detectors = detectors or default_detectors(list(recordings.values()), rig)
    scorers = [scorer(name) for name in detectors]
    places: list[Place] = []
    parts: list[Recording] = []
    scores: dict[str, list[float | None]] = {chosen.name: [] for chosen in scorers}
    for name, recording in recordings.items():
        own = inspected(recording)
        if own.defect is not None:
            raise InputError(f"a leak-free recording must be in good order, got: {own.defect} ({name})")
        places.append(Place.of(own.part))
        parts.append(own.part)
        look = look_at(own.part, split_share, false_alarm_probability, rig)
        for chosen in scorers:
            scores[chosen.name].append(chosen.score(look).value)
    return calibrate(
        places,
        scores,
        false_alarm_probability=false_alarm_probability,
        split_share=split_share,
        recordings=parts,
        **options,
    )


def diagnose_calibrated(
    recording: Recording,
    calibration: Calibration,
    *,
    file: str | None = None,
    rig: Rig | str | None = None,
    limit: str | None = None,
) -> Diagnosis:
    """Say whether oil bypasses the piston, by the thresholds of a calibration.

    The first of the calibration's detectors that judges at the recording's operating point makes the verdict, at its
    false-alarm probability; the others are stated as methods. A recording outside the calibrated operating points, or
    one the data of which cannot be trusted, is `cannot tell`, with the reason. `rig`: what detectors may assume of the
    machine, the same as for the calibration; `limit`: leak from which the machine is to be repaired (`diagnose`).
    """
    repair = RepairLimit.of(limit)
    known, machine = assumed_rig(rig, recording)
    judged = inspected(recording)
    group = judged.defect or calibration.find(Place.of(judged.part))
    probability = calibration.false_alarm_probability
    methods = []
    if isinstance(group, str):
        methods = [Evidence("cannot tell", group, detector=name) for name in calibration.detectors]
    else:
        look = look_at(judged.part, calibration.split_share, probability, known)
        for name in sorted(calibration.detectors, key=lambda name: not group.judges(name)):
            detector, view = split_view(name)
            if name == BY_STROKES and group.leak_free is not None:
                own = by_recordings(judged.part, group.leak_free, probability)
                methods.append(replace(own, parts=(), detector=name))
                continue
            seen = look.through(calibration.views[view]) if view else look
            evidence = _evidence(name, scorer(detector).score(seen), group, probability)
            if detector.endswith(CALIBRATED):
                evidence = _with_figures(evidence, seen.evidence(detector.removesuffix(CALIBRATED)))
            methods.append(evidence)
    return Diagnosis.of(
        replace(methods[0], parts=tuple(methods)),
        recording,
        machine,
        file=file,
        false_alarm_probability=probability,
        quality=judged.findings,
        limit=repair,
    )


def _with_figures(judged: Evidence, own: Evidence) -> Evidence:
    """Return the verdict by a calibrated threshold with the figures of the detector itself, which has one of its own.

    A leak that the detector's own threshold does not show has no size.
    """
    if judged.verdict == "leak" == own.verdict:
        return replace(
            own,
            reason=f"{own.reason}; {judged.reason}",
            score=judged.score,
            threshold=judged.threshold,
            detector=judged.detector,
            parts=(),
            chance=None,
        )
    return replace(
        judged,
        course=own.course if judged.verdict == own.verdict == "no leak" else None,
        passage=own.passage,
        refuses=own.refuses,
        ratio=own.ratio,
        ratio_interval=own.ratio_interval,
        share=own.share,
    )


def _evidence(name: str, score: Score, group: Group, probability: float) -> Evidence:
    threshold = group.thresholds.get(name)
    if threshold is None:
        reason = (
            f"fewer than {FEWEST} of the {group.records} leak-free recordings at this operating point have a score to "
            f"calibrate with{': ' + score.reason if score.value is None and score.reason else ''}"
        )
        return Evidence("cannot tell", reason, score.value, detector=name)
    if score.value is None or not math.isfinite(score.value):
        return Evidence("cannot tell", score.reason or "no score", None, threshold.value, detector=name)
    verdict: Verdict = "leak" if score.value > threshold.value else "no leak"
    sign = "over" if verdict == "leak" else "not over"
    tail = "" if threshold.rank else "by an extrapolated tail, "
    reason = (
        f"{name}: score {score.value:.4g} {sign} the threshold {threshold.value:.4g}, set from {threshold.n} leak-free "
        f"recordings for a false-alarm rate of {probability:g} ({tail}truly {threshold.low:.2g} to "
        f"{threshold.high:.2g} at {100 * threshold.confidence:g} % confidence)"
    )
    onset = score.onset_s if verdict == "leak" else None
    return Evidence(verdict, reason, score.value, threshold.value, onset, detector=name)
