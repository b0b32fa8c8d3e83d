"""Run detectors on a recording: observations, reasons for none, and the same for healthy recordings."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sealscope.diagnosis.decision.case import step_key
from sealscope.diagnosis.decision.null import HealthyNull, key_of
from sealscope.diagnosis.detectors.detector import Detector, checked, failure, unusable
from sealscope.diagnosis.detectors.registry import detectors
from sealscope.diagnosis.inference.changes.signals import observe_signals
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.volumes.detector import VolumeBalance
from sealscope.diagnosis.learnt import Healthy, Learnt, lessons_of
from sealscope.diagnosis.rms_change.detector import RmsChange, compare_lessons
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.motion import does_not_move
from sealscope.recordings.recording import Recording, remembered

#: Under this key a recording remembers how rare its own observables are.
RARITIES = "rarities"
#: What the keys of a balance begin with whose pump is cut off at rest.
SHUT = "shut, "
#: Fewest healthy recordings of which each can be compared with the others.
FEWEST = 2
#: Detectors that need no motion: what leaks may show at standstill.
_AT_REST = ("volume balance",)


def run_detector(
    name: str,
    recording: Recording,
    baseline: Sequence[Healthy],
    rig: Rig | str | os.PathLike[str],
    distrust: str | None = None,
) -> Observed:
    """Run a registered detector on a recording; `distrust`: why its pressures cannot be judged.

    Raises KeyError for a detector that is not registered. A detector that fails is left out with a logged line.
    """
    from threadpoolctl import threadpool_limits

    factory = detectors()[name]
    try:
        # small matrices: threads would cost more than they give, and how they share the work may not repeat to the bit
        with np.errstate(all="ignore"), threadpool_limits(limits=1):
            detector = factory(load_rig(rig))
            if detector.name != name:
                raise ValueError(f"its name must be that of its entry point, {name!r}, got {detector.name!r}")
            return _observe(detector, recording, baseline, distrust)
    except Exception as error:
        lack = failure(name, getattr(factory, "distribution", None), error)
        return Observed(name, lack=lack, has_failed=True)


def _observe(detector: Detector, recording: Recording, baseline: Sequence[Healthy], distrust: str | None) -> Observed:
    name = detector.name
    lack = unusable(detector, recording) or distrust
    if lack is None and name not in _AT_REST and not baseline:
        lack = does_not_move(recording)
    if lack is None and baseline:
        lacks = [_unusable(detector, healthy) for healthy in baseline]
        baseline = tuple(healthy for healthy, why in zip(baseline, lacks, strict=True) if why is None)
        lack = None if baseline else f"no baseline recording can be used: {lacks[0]}"
    if lack is not None:
        return Observed(name, lack=lack)
    return checked(detector.observe(recording, baseline), name)


def _unusable(detector: Detector, healthy: Healthy) -> str | None:
    if isinstance(healthy, Recording):
        return unusable(detector, healthy)
    return None if detector.name in healthy.lessons else "it has taught this method nothing"


def rarities_of(recording: Recording, rig: Rig | str | os.PathLike[str]) -> Mapping[str, float]:
    """Compute how rare each change within a healthy recording is, by the key of its observable.

    Those of a balance whose pump is cut off at rest begin with `SHUT`.
    """
    key = (RARITIES, rig if isinstance(rig, Rig) else str(rig))
    return remembered(recording, key, lambda whole: _rarities(whole, rig))


def _rarities(recording: Recording, rig: Rig | str | os.PathLike[str]) -> Mapping[str, float]:
    rarities = _rarities_in([observe_signals(recording)])
    balance, response = VolumeBalance(load_rig(rig)), "pressure response"
    reports: Mapping[bool, Observed] = {}
    if unusable(balance, recording) is None:
        try:
            with np.errstate(all="ignore"):
                reports = balance.observe_regimes(recording)
        except Exception as error:
            failure(balance.name, None, error)
    for shut, report in reports.items():
        rarities |= {f"{SHUT if shut else ''}{key}": rarity for key, rarity in _rarities_in([report]).items()}
    if reports or response not in detectors():
        return rarities
    return rarities | _rarities_in([run_detector(response, recording, (), rig)])


def _rarities_in(reports: Sequence[Observed]) -> dict[str, float]:
    rarities: dict[str, float] = {}
    for report in reports:
        for observable in report.observables:
            if observable.onset is not None and observable.rarity > rarities.get(key_of(observable), -1.0):
                rarities[key_of(observable)] = observable.rarity
        if report.leak is not None and report.leak.step is not None:
            rarities[step_key(report.provider)] = -float(np.log(max(report.leak.step.chance, 1e-300)))
    return rarities


def null_of(baseline: Sequence[Healthy], rig: Rig | str | os.PathLike[str], *, shut: bool = False) -> HealthyNull:
    """Collect the rarities of every observable in healthy recordings; `shut`: the pump is cut off at rest."""
    known = defaultdict[str, list[float]](list)
    for healthy in baseline:
        rarities = healthy.statistics if isinstance(healthy, Learnt) else rarities_of(healthy, rig)
        if shut:
            rarities = {**rarities, **{key.removeprefix(SHUT): value for key, value in rarities.items() if SHUT in key}}
        for key, rarity in rarities.items():
            known[key].append(float(rarity))
    for observables in compare_healthy(baseline):
        for data in {observable.data for observable in observables}:
            rarest = max(observable.rarity for observable in observables if observable.data == data)
            known[f"{data}: against"].append(rarest)
    return HealthyNull(known)


def compare_healthy(baseline: Sequence[Healthy]) -> Iterator[Sequence[Observable]]:
    """Yield the comparison of each healthy recording's ringing with all others."""
    detector = RmsChange()
    lessons = lessons_of(detector, [healthy for healthy in baseline if _unusable(detector, healthy) is None])
    comparable = [
        lesson
        for lesson in lessons
        if lesson["chambers"] == lessons[0]["chambers"] and lesson["rate"] == lessons[0]["rate"]
    ]
    for k, lesson in enumerate(comparable if len(comparable) > FEWEST else ()):
        yield compare_lessons(lesson, comparable[:k] + comparable[k + 1 :], lesson["chambers"])[0]
