"""The protocol of a detector, and checks of the reports that detectors return."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.inference.observable import Observable, Observed
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
