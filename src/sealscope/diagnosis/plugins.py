"""Detectors that other distributions bring, found by entry point; a broken one costs one line and nothing else.

A distribution names a class, or any function of a Rig that gives a detector, in its `pyproject.toml`:

    [project.entry-points."sealscope.detectors"]
    "pressure means" = "my_package:PressureMeans"
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from sealscope.diagnosis.verdict.evidence import Cause, Evidence, Verdict
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.diagnosis.detector import Detector
    from sealscope.parameters import Rig

GROUP = "sealscope.detectors"
#: Names that mean something else wherever detectors are named.
RESERVED = ("diagnose", "always fire", "never fire")
_log = logging.getLogger("sealscope")


def _words(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")


@cache
def _told(line: str) -> None:
    """Say it once in a process; where nobody has set up logging, Python prints it on standard error."""
    _log.warning("%s", line)


@dataclass(frozen=True)
class PlugIn:
    """A detector of another distribution: called with a rig it gives the detector made for it."""

    name: str
    distribution: str
    make: Callable[[Rig], Any]

    def __call__(self, rig: Rig) -> Detector:
        return Guarded(self, rig)

    @property
    def fingerprint(self) -> str:
        """A hash of the source file that it comes from, so that its results are not taken for another version's."""
        source = getattr(sys.modules.get(getattr(self.make, "__module__", "")), "__file__", None)
        try:
            return sha256(Path(source).read_bytes()).hexdigest()[:16] if source else "unknown"
        except OSError:
            return "unknown"


class Guarded:
    """A plug-in's detector: whatever goes wrong in it is told once, in a line that names the distribution, and is
    `cannot tell` to those who asked."""

    def __init__(self, of: PlugIn, rig: Rig) -> None:
        self.name = of.name
        self._of = of
        self._detector: Any = None
        self._broken: str | None = None
        try:
            self._detector = of.make(rig)
            named = self._detector.name
            if named != of.name:
                raise ValueError(f"its name must be that of its entry point, {of.name!r}, got {named!r}")
        except Exception as error:
            self._broken = self._fault(error)

    def _fault(self, error: BaseException) -> str:
        line = f"detector {self.name!r} of {self._of.distribution} is left out: {_words(error)}"
        _told(line)
        return line

    def usable(self, recording: Recording) -> str | None:
        """Why the recording cannot be examined, a fault of the plug-in among the reasons."""
        if self._broken is not None:
            return self._broken
        try:
            reason = self._detector.usable(recording)
            if reason is None:
                return None
            if not isinstance(reason, str):
                raise TypeError(f"usable must give None or a reason, got {reason!r}")
            return " ".join(reason.split()) or "the recording cannot be used"
        except Exception as error:
            return self._fault(error)

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """The plug-in's evidence, if it is one."""
        try:
            found = self._detector.examine(recording, baseline, false_alarm_probability)
            self._check(found)
        except Exception as error:
            return Evidence("cannot tell", self._fault(error))
        return found  # type: ignore[no-any-return]

    @staticmethod
    def _check(found: Any) -> None:
        if not isinstance(found, Evidence):
            raise TypeError(f"examine must give Evidence, got {type(found).__name__}")
        if found.verdict not in get_args(Verdict):
            raise ValueError(f"a verdict must be one of {', '.join(get_args(Verdict))}, got {found.verdict!r}")
        if found.cause is not None and found.cause not in get_args(Cause):
            raise ValueError(f"a cause must be one of {', '.join(get_args(Cause))}, got {found.cause!r}")
        if not isinstance(found.reason, str) or "\n" in found.reason:
            raise ValueError("a reason must be one line")
        if found.verdict != "cannot tell" and (found.score is None or found.threshold is None):
            raise ValueError("a verdict must come with its score and threshold")


def _found() -> Sequence[EntryPoint]:
    return tuple(entry_points(group=GROUP))


@cache
def plug_ins(taken: frozenset[str] = frozenset()) -> tuple[PlugIn, ...]:
    """The detectors of installed distributions, in the order of their names.

    One that cannot be loaded, or whose name is `taken` by a built-in one, by another plug-in or by a word that means
    something else, is left out with one line that names its distribution. Looked for once in a process.
    """
    found: dict[str, PlugIn] = {}
    for point in sorted(_found(), key=lambda one: (one.name, one.value)):
        distribution = point.dist.name if point.dist is not None else point.value
        try:
            if point.name in found:
                raise ValueError(f"its name is that of a detector of {found[point.name].distribution}")
            if point.name in taken or point.name in RESERVED:
                raise ValueError("its name is taken by Sealscope itself")
            if any(mark in point.name for mark in (" @ ", ",", "\n")) or not point.name.strip():
                raise ValueError("its name must be plain words without ',' and '@'")
            made = point.load()
            if not callable(made):
                raise TypeError(f"{point.value} must be callable with a rig, got {type(made).__name__}")
        except Exception as error:
            _told(f"detector {point.name!r} of {distribution} is left out: {_words(error)}")
            continue
        found[point.name] = PlugIn(point.name, distribution, made)
    return tuple(found.values())
