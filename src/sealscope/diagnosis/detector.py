"""The detector protocol, and the checks of what a detector returns."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol, get_args

import numpy as np

from sealscope.diagnosis.verdict.evidence import Cause, Evidence, Verdict
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_log = logging.getLogger(__name__)


class Detector(Protocol):
    """A detector: states evidence at a false-alarm probability, and says `cannot tell` rather than guess.

    The recordings it is given are uniformly sampled, and their chamber pressures and command have no missing sample
    (what was missing is bridged, and marked in `Recording.bridged`); any other channel may be absent or hold NaN.

    A method `learn(recording)` may return what a healthy recording teaches, as plain values, or None; a detector that
    has one is also given what was written down of recordings (`learnt.Learnt`), and reads both by `learnt.lessons_of`.
    """

    name: str

    def usable(self, recording: Recording) -> str | None:
        """Return None when the recording has what the detector needs, else the reason why not, in one line."""
        ...

    def examine(self, recording: Recording, baseline: Sequence[Any], false_alarm_probability: float) -> Evidence:
        """Return the evidence on a recording that is `usable`.

        `baseline`: leak-free recordings of the same machine, at any duty, no two of them copies; where
        there is none, the recording's own beginning is the baseline.
        """
        ...


#: Makes a detector for what it may assume of the machine.
Factory = Callable[["Rig"], Detector]


def unusable(detector: Detector, recording: Recording) -> str | None:
    """Return in one line why a detector cannot use a recording, None where it can."""
    reason: Any = detector.usable(recording)
    if reason is None:
        return None
    if not isinstance(reason, str):
        raise TypeError(f"usable must give None or a reason, got {reason!r}")
    return " ".join(reason.split()) or "the recording cannot be used"


def checked(evidence: Any) -> Evidence:
    """Return what a detector's `examine` gave; raises TypeError or ValueError where it is no valid Evidence."""
    if not isinstance(evidence, Evidence):
        raise TypeError(f"examine must give Evidence, got {type(evidence).__name__}")
    if evidence.verdict not in get_args(Verdict):
        raise ValueError(f"a verdict must be one of {', '.join(get_args(Verdict))}, got {evidence.verdict!r}")
    if evidence.cause is not None and evidence.cause not in get_args(Cause):
        raise ValueError(f"a cause must be one of {', '.join(get_args(Cause))}, got {evidence.cause!r}")
    if not isinstance(evidence.reason, str) or "\n" in evidence.reason:
        raise ValueError("a reason must be one line")
    if evidence.verdict != "cannot tell" and (evidence.score is None or evidence.threshold is None):
        raise ValueError("a verdict must come with its score and threshold")
    if any(figure is not None and np.isnan(figure) for figure in (evidence.score, evidence.threshold)):
        raise ArithmeticError("a score and a threshold must be numbers, got none")
    return evidence


def failure(name: str, distribution: str | None, error: Exception) -> str:
    """Return one line on a detector that failed, and log it with the traceback, once in a process.

    `distribution`: that of a plug-in, None for a built-in detector. Numbers that a built-in detector cannot compute
    with are no machine's readings, and no defect of it: the traceback is at the level of debugging alone.
    """
    if distribution is None and isinstance(error, ArithmeticError | np.linalg.LinAlgError):
        _log.debug("%s cannot be computed", name, exc_info=True)
        return f"{name} cannot be computed on this recording: {' '.join(str(error).split()).lower()}"
    of = f" of {distribution}" if distribution else ""
    what = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    line = f"detector {name!r}{of} is left out: {what}"
    _log_once(line)
    return line


@cache
def _log_once(line: str) -> None:
    """Log a line at the level of errors, with the traceback of the exception being handled."""
    _log.exception("%s", line)
