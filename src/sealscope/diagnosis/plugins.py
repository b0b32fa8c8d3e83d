"""Detectors of other distributions, found by entry point; a broken one is left out with a logged line.

A distribution names a class, or any function of a Rig that gives a detector, in its `pyproject.toml`:

    [project.entry-points."sealscope.detectors"]
    "pressure means" = "my_package:PressureMeans"
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from sealscope.diagnosis.detector import failure

if TYPE_CHECKING:
    from sealscope.diagnosis.detector import Detector
    from sealscope.parameters import Rig

GROUP = "sealscope.detectors"
#: Names that mean something else wherever detectors are named.
RESERVED = ("diagnose", "always fire", "never fire")


@dataclass(frozen=True)
class PlugIn:
    """A detector of another distribution: called with a rig it gives the detector made for it."""

    name: str
    distribution: str
    make: Callable[[Rig], Detector]

    def __call__(self, rig: Rig) -> Detector:
        """Make the detector."""
        return self.make(rig)

    @property
    def fingerprint(self) -> str:
        """A hash of the source file that it comes from, so that its results are not taken for another version's."""
        source = getattr(sys.modules.get(getattr(self.make, "__module__", "")), "__file__", None)
        try:
            return sha256(Path(source).read_bytes()).hexdigest()[:16] if source else "unknown"
        except OSError:
            return "unknown"


@cache
def plug_ins(taken: frozenset[str] = frozenset()) -> tuple[PlugIn, ...]:
    """Return the detectors of installed distributions, in the order of their names.

    One that cannot be loaded, or whose name is `taken` by a built-in detector, by another plug-in or by a reserved
    word, is left out with one line that names its distribution. Looked for once in a process.
    """
    known: dict[str, PlugIn] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda point: (point.name, point.value)):
        distribution = point.dist.name if point.dist is not None else point.value
        try:
            if point.name in known:
                raise ValueError(f"its name is that of a detector of {known[point.name].distribution}")
            if point.name in taken or point.name in RESERVED:
                raise ValueError("its name is taken by Sealscope itself")
            if any(mark in point.name for mark in (" @ ", ",", "\n")) or not point.name.strip():
                raise ValueError("its name must be plain words without ',' and '@'")
            make = point.load()
            if not callable(make):
                raise TypeError(f"{point.value} must be callable with a rig, got {type(make).__name__}")
        except Exception as error:
            failure(point.name, distribution, error)
            continue
        known[point.name] = PlugIn(point.name, distribution, make)
    return tuple(known.values())
