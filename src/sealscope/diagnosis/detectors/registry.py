"""Find detectors by name: the built-in detectors, and those that other installed packages register as entry points.

A package registers a class, or a function that creates a detector for a Rig, in its `pyproject.toml`:

    [project.entry-points."sealscope.detectors"]
    "pressure means" = "my_package:PressureMeans"

A detector that cannot be loaded is left out, and the reason is logged. Its code runs under limits (`isolation`).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.diagnosis.detectors.detector import Detector, Factory, log_failure
from sealscope.diagnosis.detectors.isolation import call_plug_in
from sealscope.diagnosis.inference.observable import Observed
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE, RMS_CHANGE, VOLUME_BALANCE
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

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
