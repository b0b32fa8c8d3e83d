"""The detectors: their protocol and runs, the built-in ones and those of other packages, and what healthy ones show.

A package registers a class, or a function that creates a detector for a Rig, in its `pyproject.toml`:

    [project.entry-points."sealscope.detectors"]
    "pressure means" = "my_package:PressureMeans"

A detector that cannot be loaded is left out, and the reason is logged. Its code runs under limits (`isolation`).

The surprisal of a change is -log(chance), where chance is the p-value that the detector states for the change. An
observable (`inference.observable`) is the result of one such test. The surprisals of changes in healthy recordings are
the null distributions of the tests (`healthy_null`).
"""

from __future__ import annotations

import logging
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sealscope.diagnosis.decision.case import STEP_KEY, HealthyNull
from sealscope.diagnosis.detectors.isolation import call_plug_in
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.healthy import Healthy, healthy_summaries, keep_once, learn_once
from sealscope.diagnosis.inference.changes.features import SIGNALS, observe_signals
from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.inference.observable import COMPARISON_KEY, Observable, Observed
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.rms_change.rms_detector import DetailSummary, RmsChange, compare_summaries, has_same_rate
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE, RMS_CHANGE, VOLUME_BALANCE
from sealscope.parameters import Rig
from sealscope.recordings.motion import describe_hold, describe_line
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


_log = logging.getLogger(__name__)
#: Kind of data (`Observable.data`) of a user's own detector, as in `decision/events.toml`.
PLUG_IN = "plug-in"
#: Most observables of a report, and most letters of their names and of the reason why there are none.
MAX_OBSERVABLES, _MAX_NAME, _MAX_LACK = 1000, 200, 2000


class Detector(Protocol):
    """A detector, which estimates quantities over a recording and tests them for changes, without a verdict.

    Recordings are uniformly sampled. Missing samples of the chamber pressures and the command are interpolated and
    marked in `Recording.bridged`. Any other channel may be absent or contain NaN.

    A method `learn(recording)` may return the detector's summary of a healthy recording as plain values, or None. A
    detector with this method also receives stored summaries (`healthy.SummarisedRecording`) as baselines, and reads
    both kinds with `healthy_summaries`.
    """

    name: str

    def usable(self, recording: Recording) -> str | None:
        """Return the reason, in one line, why the detector cannot use the recording; None if it can."""
        ...

    def observe(self, recording: Recording, baseline: Sequence[Any] = ()) -> Observed:
        """Estimate the detector's quantities in a `usable` recording, test each for a change, and report both.

        Without a `baseline` of leak-free recordings of the machine, only changes within the recording are tested.
        """
        ...


#: Creates a detector for a rig, from which the detector takes its assumptions on the machine.
Factory = Callable[["Rig"], Detector]


def unusable_reason(detector: Detector, recording: Recording) -> str | None:
    """Ask a detector for the reason, in one line, why it cannot use a recording; None if it can.

    Raises TypeError if `usable` returns neither a text, which may be empty, nor None.
    """
    reason: Any = detector.usable(recording)
    if reason is None:
        return None
    if not isinstance(reason, str):
        raise TypeError(f"usable must return None or a reason, got {reason!r}")
    return " ".join(reason[:_MAX_LACK].split()) or "the recording cannot be used"


def make_observable(
    name: str, chance: float, *, size: float = 0.0, onset: tuple[float, float, float] | None = None
) -> Observable:
    """Make an observable for a user's own detector from a p-value; the change counts as an effect of a piston leak.

    Parameters
    ----------
    name : str
        Name of the change, in plain words.
    chance : float
        Probability that a healthy recording changes as much. If several changes are tested, state the smallest of
        their probabilities times their number.
    size : float
        The change, in the detector's own unit; negative for a fall.
    onset : tuple of float, optional
        Time of the change with its 95 % interval [s]: (value, low, high).
    """
    # scores are twice a log likelihood ratio; the lower limit of the p-value makes the score finite
    score = -2.0 * float(np.log(max(chance, np.finfo(float).tiny)))
    interval = None if onset is None else Interval(*onset)
    return Observable(name=name, data=PLUG_IN, score=score, chance=float(chance), onset=interval, size=float(size))


def validate_report(report: Any, name: str) -> Observed:
    """Check the report, an `Observed` or a single `Observable`, of the detector called `name`; mark it with this name.

    Raises TypeError or ValueError if it does not fit, and ArithmeticError for a score that is not finite.
    """
    if isinstance(report, Observable):
        report = Observed(name, (report,))
    if not isinstance(report, Observed):
        raise TypeError(f"observe must return an Observed, got {type(report).__name__}")
    if not isinstance(report.observables, tuple | list):
        raise TypeError(f"the observables must be a tuple, got {type(report.observables).__name__}")
    if len(report.observables) > MAX_OBSERVABLES:
        raise ValueError(f"a report must have at most {MAX_OBSERVABLES} observables, got {len(report.observables)}")
    for observable in report.observables:
        if not isinstance(observable, Observable):
            raise TypeError(f"each of the observables must be an Observable, got {type(observable).__name__}")
        if not isinstance(observable.name, str) or len(observable.name) > _MAX_NAME:
            raise ValueError(f"the name of an observable must be a text of at most {_MAX_NAME} letters")
        if not 0.0 <= observable.chance <= 1.0:
            raise ValueError(f"a chance must be 0 to 1, got {observable.chance!r} ({observable.name})")
        if not np.isfinite(observable.score):
            raise ArithmeticError(f"a score must be finite, got {observable.score!r} ({observable.name})")
    if "\n" in report.lack or len(report.lack) > _MAX_LACK:
        raise ValueError(f"the `lack` of a report must be one line of at most {_MAX_LACK} letters")
    return replace(report, provider=name)


def log_failure(name: str, distribution: str | None, error: Exception) -> str:
    """Describe the error of the detector `name` in one line, and log it with the traceback, each line once per process.

    `distribution` is the package of a plug-in, None for a built-in detector, whose arithmetic errors are due to
    impossible readings, not to a defect: they are logged at the debug level, each time.
    """
    if distribution is None and isinstance(error, ArithmeticError | np.linalg.LinAlgError):
        _log.debug("%s cannot be computed", name, exc_info=True)
        return f"{name} cannot be computed on this recording: {' '.join(str(error).split()).lower()}"
    source = f" of {distribution}" if distribution else ""
    reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    line = f"detector {name!r}{source} is left out: {reason}"
    _log_once(line)
    return line


@cache
def _log_once(line: str) -> None:
    """Log a line with the traceback of the present exception; the cache suppresses further calls with this line."""
    _log.exception("%s", line)


#: Group of the entry points.
GROUP = "sealscope.detectors"
#: Names that no detector may have, as they mean something else in lists of detectors.
_RESERVED = ("diagnose", "always fire", "never fire")


#: Names of plug-ins that did not end in time: they are not called again in this process.
_TIMED_OUT = set[str]()


class IsolatedDetector:
    """The detector of a plug-in, each call of which runs under the limits of `isolation`."""

    def __init__(self, plug_in: PlugIn, rig: Rig) -> None:
        self._plug_in = plug_in
        self._detector: Any = self._call(plug_in.make, rig)
        self.name: str = self._call(getattr, self._detector, "name")
        if hasattr(self._detector, "learn"):
            self.learn = self._learn

    def usable(self, recording: Recording) -> str | None:
        """Return the reason why the detector cannot use the recording; None if it can."""
        reason: str | None = self._call(self._detector.usable, recording, n_samples=len(recording))
        return reason

    def observe(self, recording: Recording, baseline: Sequence[Any] = ()) -> Observed:
        """Test the detector's quantities in a recording, compared with those of a baseline."""
        n_samples = len(recording) + sum(len(healthy) for healthy in baseline if isinstance(healthy, Recording))
        report: Observed = self._call(self._detector.observe, recording, baseline, n_samples=n_samples)
        return report

    def _learn(self, recording: Recording) -> Any:
        """Return the detector's summary of a healthy recording."""
        return self._call(self._detector.learn, recording, n_samples=len(recording))

    def _call(self, function: Any, *arguments: Any, n_samples: int = 0) -> Any:
        """Call a function of the plug-in, unless one of its calls has not ended in time."""
        name = self._plug_in.name
        if name in _TIMED_OUT:
            raise TimeoutError("it did not end in time before")
        try:
            return call_plug_in(function, *arguments, n_samples=n_samples)
        except TimeoutError:
            _TIMED_OUT.add(name)
            raise


@dataclass(frozen=True)
class PlugIn:
    """Factory `make` of the detector called `name`, from the package `distribution`; it is called with a rig."""

    name: str
    distribution: str
    make: Factory

    def __call__(self, rig: Rig) -> Detector:
        """Create the plug-in's detector for a rig, whose calls have limits."""
        return IsolatedDetector(self, rig)

    @property
    def fingerprint(self) -> str:
        """First 16 digits of the SHA-256 of the file that defines `make`, to tell versions apart, or "unknown"."""
        source = getattr(sys.modules.get(getattr(self.make, "__module__", "")), "__file__", None)
        try:
            return sha256(Path(source).read_bytes()).hexdigest()[:16] if source else "unknown"
        except OSError:
            return "unknown"


def _make_detector(module: str, name: str, rig: Rig) -> Detector:
    """Create a built-in detector for a rig, from the class `name` in a module of `sealscope.diagnosis`."""
    detector_class = getattr(import_module(f"sealscope.diagnosis.{module}"), name)
    detector: Detector = detector_class(rig)
    return detector


#: Factories of the built-in detectors by name; a module is imported when its detector is first created.
DETECTORS: dict[str, Factory] = {
    VOLUME_BALANCE: partial(_make_detector, "inference.volumes.volume_detector", "VolumeBalance"),
    PRESSURE_RESPONSE: partial(_make_detector, "inference.pressures.response_detector", "PressureResponse"),
    RMS_CHANGE: partial(_make_detector, "rms_change.rms_detector", "RmsChange"),
}


def detectors() -> Mapping[str, Factory]:
    """Return the factories of all detectors by name: the built-in ones, then those of other installed packages."""
    return {**DETECTORS, **plug_ins(frozenset(DETECTORS))}


@cache
def plug_ins(built_in_names: frozenset[str]) -> Mapping[str, PlugIn]:
    """Find the detectors of other installed packages, in the order of their names; the result is cached."""
    plug_in_of: dict[str, PlugIn] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda point: (point.name, point.value)):
        distribution = point.dist.name if point.dist is not None else point.value
        try:
            if point.name in plug_in_of:
                raise ValueError(f"its name is that of a detector of {plug_in_of[point.name].distribution}")
            if point.name in built_in_names or point.name in _RESERVED:
                raise ValueError("its name is taken by Sealscope itself")
            if any(mark in point.name for mark in (" @ ", ",", "\n")) or not point.name.strip():
                raise ValueError("its name must be plain words without a comma, ' @ ' or a line break")
            make = call_plug_in(point.load)
            if not callable(make):
                raise TypeError(f"{point.value} must be callable with a rig, got {type(make).__name__}")
        except Exception as error:
            log_failure(point.name, distribution, error)
            continue
        plug_in_of[point.name] = PlugIn(point.name, distribution, make)
    return plug_in_of


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
    """Compute the surprisal of each change within a healthy recording, by its key (`Observable.key`); cached.

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
            key = observable.key
            surprisals[key] = max(observable.surprisal, surprisals.get(key, 0.0))
    if report.leak is not None and report.leak.step is not None:
        surprisals[STEP_KEY.format(report.provider)] = -float(np.log(max(report.leak.step.chance, _MIN_CHANCE)))
    return surprisals


def healthy_null(baseline: Sequence[Healthy], rig: Rig, valves: Valves = Valves.OPEN) -> HealthyNull:
    """Collect the surprisals of all tests in healthy recordings, as the null distributions of the tests.

    Each test for a change within a recording has a list (`Observable.key`) with one value from each recording.
    Comparisons with other recordings share one list for each kind of data (`COMPARISON_KEY`): each recording is
    compared with all others, and the largest surprisal counts. `valves`: those that the volume balance assumes at rest,
    open or shut.
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
            surprisals_by_key[COMPARISON_KEY.format(data)].append(surprisal)
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
