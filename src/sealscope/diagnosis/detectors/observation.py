"""Run detectors on recordings, and collect the surprisals of the changes that they find in healthy recordings.

The surprisal of a change is -log(chance), where chance is the p-value that the detector states for the change. An
observable (`inference.observable`) is the result of one such test.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from sealscope.diagnosis.decision.case import HealthyNull, comparison_key, null_key, step_key
from sealscope.diagnosis.detectors.registry import Detector, detectors, log_failure, unusable_reason, validate_report
from sealscope.diagnosis.healthy import Healthy, healthy_summaries, keep_once, learn_once
from sealscope.diagnosis.inference.changes.features import SIGNALS, observe_signals
from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.rms_change.rms_detector import DetailSummary, RmsChange, compare_summaries, has_same_rate
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE, VOLUME_BALANCE
from sealscope.parameters import Rig
from sealscope.recordings.motion import describe_hold, describe_line
from sealscope.recordings.recording import Recording

#: Key of the surprisals of a recording's observables in its cache (`compute_once`).
SURPRISALS = "surprisals"
#: Prefix of the keys of surprisals from a volume balance that assumes that valves cut the pump off at rest.
SHUT = "shut, "
#: Minimum number of healthy recordings to compare each with all others.
MIN_COMPARED = 3
#: Lower limit of a chance, so that its logarithm is finite.
_MIN_CHANCE = 1e-300
#: Detectors that need no motion, as they measure a leak at standstill, too.
_AT_REST = (VOLUME_BALANCE,)


def limit_threads() -> AbstractContextManager[object]:
    """Limit the loaded linear-algebra libraries to one thread while the returned context is open.

    With several threads the small matrices would take three times longer, and results differ in the last bit.
    """
    return _thread_pools(len(sys.modules)).limit(limits=1)  # type: ignore[no-any-return]


@lru_cache(maxsize=1)
def _thread_pools(n_modules: int) -> Any:
    """Find the thread pools of the loaded linear-algebra libraries.

    The result is cached. A change of `n_modules`, the number of imported modules, makes the search start anew, as a
    newly imported module may have loaded another library.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def observe_rivals(recording: Recording, baseline: Sequence[Healthy], distrust: str | None = None) -> Observed:
    """Test a recording for changes that no internal leak causes, but that may be mistaken for one.

    If there is a reason to `distrust` the pressures, nothing is tested, and the report states this reason.
    """
    if distrust:
        return Observed(SIGNALS, lack=distrust)
    comparisons = tuple(HealthyLevels().compare(recording, baseline)) if baseline else ()
    report = observe_signals(recording)
    return replace(report, observables=(*report.observables, *comparisons))


def run_detector(
    name: str, recording: Recording, baseline: Sequence[Healthy], rig: Rig, distrust: str | None = None
) -> Observed:
    """Run the registered detector called `name` on a recording and return the detector's report.

    `baseline` are healthy recordings of the machine, `rig` is the assumed machine, and `distrust` the reason, if any,
    why the pressures cannot be judged. An error of the detector is logged and stated in the report.
    """
    factory = detectors()[name]
    try:
        with np.errstate(all="ignore"), limit_threads():
            detector = factory(rig)
            if detector.name != name:
                raise ValueError(f"its name must be that of its entry point, {name!r}, got {detector.name!r}")
            return _observe(detector, recording, baseline, distrust)
    except Exception as error:  # a plug-in may raise anything
        lack = log_failure(name, getattr(factory, "distribution", None), error)  # None for a built-in detector
        return Observed(name, lack=lack, has_failed=True)


def _observe(detector: Detector, recording: Recording, baseline: Sequence[Healthy], distrust: str | None) -> Observed:
    """Run a detector on a recording, compared with the baseline recordings that the detector can use.

    The report only states the reason if the recording, or all of a given baseline, cannot be used.
    """
    lack = unusable_reason(detector, recording) or distrust
    if lack is None and detector.name not in _AT_REST:
        # beside other samples of the same recording a hold looks like a change; healthy recordings may have it, too
        lack = describe_line(recording) if baseline else describe_hold(recording)
    if lack is None and baseline:
        reasons = [_unusable_baseline(detector, entry) for entry in baseline]
        baseline = tuple(entry for entry, reason in zip(baseline, reasons, strict=True) if reason is None)
        if not baseline:
            lack = f"no baseline recording can be used: {reasons[0]}"
            if detector.name == VOLUME_BALANCE:  # without a baseline it states what the recording itself lacks
                lack = detector.observe(recording).lack or lack
    if lack is not None:
        return Observed(detector.name, lack=lack)
    return validate_report(detector.observe(recording, baseline), detector.name)


def _unusable_baseline(detector: Detector, healthy: Healthy) -> str | None:
    """Return the reason why a detector cannot use a healthy recording; None if it can."""
    if isinstance(healthy, Recording):
        return unusable_reason(detector, healthy)
    has_summary = detector.name in healthy.summaries
    return None if has_summary else "its samples were not kept, and it has no summary for this method"


def healthy_surprisals(recording: Recording, rig: Rig, valves: Valves = Valves.OPEN) -> Mapping[str, float]:
    """Compute the surprisal of each change within a healthy recording, by its key (`case.null_key`); cached.

    `valves`: those that are assumed at rest, open or shut.
    """
    key = (SURPRISALS, valves.value)
    return learn_once(recording, key, lambda samples: _compute_surprisals(samples, rig, valves), rig)


def stored_surprisals(recording: Recording, rig: Rig) -> dict[str, float]:
    """Compute the surprisals of a healthy recording under both assumptions on the valves at rest.

    Those under the assumption that they cut the pump off have keys that begin with `SHUT`, where they differ.
    """
    by_open, by_shut = (healthy_surprisals(recording, rig, valves) for valves in (Valves.OPEN, Valves.SHUT))
    differing = {key: surprisal for key, surprisal in by_shut.items() if surprisal != by_open.get(key)}
    return {**by_open, **{f"{SHUT}{key}": surprisal for key, surprisal in differing.items()}}


def _compute_surprisals(recording: Recording, rig: Rig, valves: Valves) -> Mapping[str, float]:
    """Compute the surprisals of changes of the signals and of the volume balance within a recording, by their keys.

    `valves`: as in `healthy_surprisals`. Without a balance the pressure response, which then judges, is tested.
    """
    surprisals = _max_surprisals(observe_signals(recording))
    balance, report = VolumeBalance(rig), None
    if unusable_reason(balance, recording) is None:
        try:
            with np.errstate(all="ignore"):
                report = balance.observe_alone(recording, valves)
        except Exception as error:
            log_failure(balance.name, distribution=None, error=error)
    if report is None and PRESSURE_RESPONSE in detectors():
        report = run_detector(PRESSURE_RESPONSE, recording, (), rig)
    return surprisals if report is None else {**surprisals, **_max_surprisals(report)}


def _max_surprisals(report: Observed) -> dict[str, float]:
    """Collect the largest surprisal of each test for a change within a recording, also for a step of the leak."""
    surprisals: dict[str, float] = {}
    for observable in report.observables:
        if observable.onset is not None:  # otherwise a comparison with other recordings
            key = null_key(observable)
            surprisals[key] = max(observable.surprisal, surprisals.get(key, 0.0))
    if report.leak is not None and report.leak.step is not None:
        surprisals[step_key(report.provider)] = -float(np.log(max(report.leak.step.chance, _MIN_CHANCE)))
    return surprisals


def healthy_null(baseline: Sequence[Healthy], rig: Rig, valves: Valves = Valves.OPEN) -> HealthyNull:
    """Collect the surprisals of all tests in healthy recordings, as the null distributions of the tests.

    Each test for a change within a recording has a list (`null_key`) with one value from each recording. Comparisons
    with other recordings share one list for each kind of data (`comparison_key`): each recording is compared with all
    others, and the largest surprisal counts. `valves`: those that the volume balance assumes at rest, open or shut.
    """
    surprisals_by_key = defaultdict[str, list[float]](list)
    for healthy in baseline:
        if isinstance(healthy, Recording):
            surprisals = healthy_surprisals(healthy, rig, valves)
        else:
            surprisals = healthy.statistics
            shut_keys = [key for key in surprisals if valves is Valves.SHUT and key.startswith(SHUT)]
            surprisals = {**surprisals, **{key.removeprefix(SHUT): surprisals[key] for key in shut_keys}}
        for key, surprisal in surprisals.items():
            surprisals_by_key[key].append(surprisal)
    summaries = comparable_summaries(baseline)
    content = ("healthy comparisons", [summary.table() for summary in summaries])
    comparisons = keep_once(content, lambda: list(map(_rarest, compare_healthy(summaries))))
    for rarest in comparisons:
        for data, surprisal in rarest.items():
            surprisals_by_key[comparison_key(data)].append(surprisal)
    return HealthyNull(surprisals_by_key)


def _rarest(observables: Sequence[Observable]) -> dict[str, float]:
    """Collect the largest surprisal of test results by the kind of their data."""
    ascending = sorted(observables, key=lambda observable: observable.surprisal)
    return {observable.data: observable.surprisal for observable in ascending}


def comparable_summaries(baseline: Sequence[Healthy]) -> list[DetailSummary]:
    """Collect the summaries of the ringing of healthy recordings that can be compared with each other.

    Recordings with other chambers or another sampling rate than the first usable one are left out.
    """
    detector = RmsChange()
    usable_entries = [entry for entry in baseline if _unusable_baseline(detector, entry) is None]
    summaries = healthy_summaries(detector, usable_entries)
    return [
        summary
        for summary in summaries
        if summary.chambers == summaries[0].chambers and has_same_rate(summary.rate, summaries[0].rate)
    ]


def compare_healthy(summaries: Sequence[DetailSummary]) -> Iterator[Sequence[Observable]]:
    """Compare the ringing of each healthy recording with that of all others, and yield the test results of each.

    `summaries`: those of recordings that can be compared; with fewer than `MIN_COMPARED` nothing is yielded.
    """
    if len(summaries) < MIN_COMPARED:
        return
    for k, summary in enumerate(summaries):
        observables, _ = compare_summaries(summary, [*summaries[:k], *summaries[k + 1 :]], summary.chambers)
        yield observables
