"""Detectors by name: the built-in ones, and those of other distributions, found by entry point.

A distribution names a class, or any function of a Rig that gives a detector, in its `pyproject.toml`:

    [project.entry-points."sealscope.detectors"]
    "pressure means" = "my_package:PressureMeans"

A broken one is left out with a logged line.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from sealscope.diagnosis.detectors.detector import Detector, Factory, log_failure
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE, RMS_CHANGE, VOLUME_BALANCE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

GROUP = "sealscope.detectors"
#: Names that mean something else wherever detectors are named.
_RESERVED = ("diagnose", "always fire", "never fire")


@dataclass(frozen=True)
class PlugIn:
    """Factory of a detector of another distribution: a call with a rig makes the detector for that rig."""

    name: str
    distribution: str
    make: Factory

    def __call__(self, rig: Rig) -> Detector:
        """Make the detector."""
        return self.make(rig)

    @property
    def fingerprint(self) -> str:
        """Hash of the source file, to distinguish its results from another version's."""
        source = getattr(sys.modules.get(getattr(self.make, "__module__", "")), "__file__", None)
        try:
            return sha256(Path(source).read_bytes()).hexdigest()[:16] if source else "unknown"
        except OSError:
            return "unknown"


def _make_detector(module: str, name: str, rig: Rig) -> Detector:
    """Import the class of a built-in detector, and make it for a rig."""
    detector: Detector = getattr(import_module(f"sealscope.diagnosis.{module}"), name)(rig)
    return detector


#: The built-in detectors by name, loaded when first made; one contract test runs them all.
DETECTORS: dict[str, Factory] = {
    VOLUME_BALANCE: partial(_make_detector, "inference.volumes.detector", "VolumeBalance"),
    PRESSURE_RESPONSE: partial(_make_detector, "inference.pressures.detector", "PressureResponse"),
    RMS_CHANGE: partial(_make_detector, "rms_change.detector", "RmsChange"),
}


def detectors() -> Mapping[str, Factory]:
    """Return every detector by name: the built-in ones, then those of installed distributions."""
    return {**DETECTORS, **plug_ins(frozenset(DETECTORS))}


@cache
def plug_ins(built_in_names: frozenset[str]) -> Mapping[str, PlugIn]:
    """Return the detectors of installed distributions, in the order of their names.

    A detector that cannot be loaded, or whose name is that of a built-in detector, of another plug-in or reserved, is
    left out with one logged line that names its distribution. The search is made once in a process.
    """
    plug_in_of: dict[str, PlugIn] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda point: (point.name, point.value)):
        distribution = point.dist.name if point.dist is not None else point.value
        try:
            if point.name in plug_in_of:
                raise ValueError(f"its name is that of a detector of {plug_in_of[point.name].distribution}")
            if point.name in built_in_names or point.name in _RESERVED:
                raise ValueError("its name is taken by Sealscope itself")
            if any(mark in point.name for mark in (" @ ", ",", "\n")) or not point.name.strip():
                raise ValueError("its name must be plain words without ',' and '@'")
            make = point.load()
            if not callable(make):
                raise TypeError(f"{point.value} must be callable with a rig, got {type(make).__name__}")
        except Exception as error:
            log_failure(point.name, distribution, error)
            continue
        plug_in_of[point.name] = PlugIn(point.name, distribution, make)
    return plug_in_of
