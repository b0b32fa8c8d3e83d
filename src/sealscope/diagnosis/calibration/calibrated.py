"""Calibrate on recordings, and diagnose with a calibration: thresholds from leak-free recordings, not from within."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sealscope.diagnosis.baseline.inspection import inspected
from sealscope.diagnosis.baseline.operating_point import operating_point
from sealscope.diagnosis.calibration.scorers import Look, Score, scorer, split_view
from sealscope.diagnosis.calibration.thresholds import Calibration, Group, Place, calibrate
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Detectors that a calibration holds unless others are named; the first makes the verdict.
DEFAULT_DETECTORS = ("rms change", "d3 of p_A changed", "d4 of p_A changed", "d3 of p_B changed", "d4 of p_B changed")


def place_of(part: Recording) -> Place:
    """Where a recording without missing samples was made."""
    return Place(operating_point(part), part.duration)


def look_at(part: Recording, split_share: float, rate: float, rig: Rig | str = "thesis") -> Look:
    """The recording as scorers see it, split at that share of its length; `rig`: what detectors may assume."""
    return Look(part, float(part.t[0]) + split_share * part.duration, rate, rig)


def calibrate_on(
    recordings: Mapping[str, Recording],
    detectors: Sequence[str] = DEFAULT_DETECTORS,
    *,
    false_alarm_probability: float,
    split_share: float = 0.5,
    rig: Rig | str = "thesis",
    **options: Any,
) -> Calibration:
    """Calibrate detectors on leak-free recordings of one machine.

    `recordings`: name -> recording; one that cannot be judged raises InputError with its name and the reason: what is
    not leak-free data of the machine in good order has no place in a calibration. `rig`: what detectors may assume of
    the machine; `options` as for `calibrate`.
    """
    if not 0.0 < split_share < 1.0:
        raise InputError(f"the split must be a share of the length between 0 and 1, got {split_share}")
    chosen = [scorer(name) for name in detectors]
    places: list[Place] = []
    scores: dict[str, list[float | None]] = {one.name: [] for one in chosen}
    for name, recording in recordings.items():
        own = inspected(recording)
        part, defect = own.part, own.defect
        if defect is not None:
            raise InputError(f"a leak-free recording must be in good order, got: {defect} ({name})")
        places.append(place_of(part))
        look = look_at(part, split_share, false_alarm_probability, rig)
        for one in chosen:
            scores[one.name].append(one.score(look).value)
    return calibrate(places, scores, rate=false_alarm_probability, split_share=split_share, **options)


def diagnose_calibrated(
    recording: Recording, calibration: Calibration, *, file: str | None = None, rig: Rig | str = "thesis"
) -> Diagnosis:
    """Say whether oil bypasses the piston, by the thresholds of a calibration.

    The first of the calibration's detectors makes the verdict, at its false-alarm rate; the others are told as
    methods. A recording outside the calibrated operating points, or one the data of which cannot be trusted, is
    `cannot tell`, with the reason. `rig`: what detectors may assume of the machine, the same as for the calibration.
    """
    judged = inspected(recording)
    part, reason = judged.part, judged.defect
    found: Group | str = reason if reason is not None else calibration.find(place_of(part))
    look = look_at(part, calibration.split_share, calibration.rate, rig) if isinstance(found, Group) else None
    methods = []
    for name in calibration.detectors:
        if look is None or not isinstance(found, Group):
            methods.append(Evidence("cannot tell", str(found), detector=name))
            continue
        detector, view = split_view(name)
        score = scorer(detector).score(look.through(calibration.views[view]) if view else look)
        methods.append(_result(name, score, found, calibration))
    judge = methods[0]
    return Diagnosis(
        **vars(replace(judge, parts=tuple(methods))),
        file=file or str(recording.provenance.get("file", "recording")),
        false_alarm_probability=calibration.rate,
        quality=judged.findings,
    )


def _result(name: str, score: Score, group: Group, calibration: Calibration) -> Evidence:
    threshold = group.thresholds.get(name)
    if threshold is None:
        reason = (
            f"calibrated with {group.records} leak-free recordings at this operating point, too few for a false-alarm "
            f"rate of {calibration.rate:g}"
        )
        return Evidence("cannot tell", reason, score.value, detector=name)
    if score.value is None or not math.isfinite(score.value):
        return Evidence("cannot tell", score.reason or "no score", None, threshold.value, detector=name)
    verdict: Verdict = "leak" if score.value > threshold.value else "no leak"
    sign = "over" if verdict == "leak" else "not over"
    reason = (
        f"{name}: score {score.value:.4g} {sign} the threshold {threshold.value:.4g}, set from {threshold.n} leak-free "
        f"recordings for a false-alarm rate of {calibration.rate:g} (truly {threshold.low:.2g} to {threshold.high:.2g} "
        f"at {100 * threshold.confidence:g} % confidence)"
    )
    onset = score.onset_s if verdict == "leak" else None
    return Evidence(verdict, reason, score.value, threshold.value, onset, detector=name)
