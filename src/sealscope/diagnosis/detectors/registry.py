"""The protocol of a detector, checks of the reports, and the detectors by name: built in, or of other packages.

A package registers a class, or a function that creates a detector for a Rig, in its `pyproject.toml`:

    [project.entry-points."sealscope.detectors"]
    "pressure means" = "my_package:PressureMeans"

A detector that cannot be loaded is left out, and the reason is logged. Its code runs under limits (`isolation`).
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sealscope.diagnosis.detectors.isolation import call_plug_in
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE, RMS_CHANGE, VOLUME_BALANCE
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
