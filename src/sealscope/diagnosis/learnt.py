"""What a healthy recording teaches the detectors, in place of its samples: so a machine is commissioned once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sealscope.recordings.recording import Array, Recording

#: What a detector has learnt of a healthy recording, as plain values; the detector alone reads it.
Lesson = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Learnt:
    """Lessons of the healthy recording of a `file`.

    `digest`: hash of its chamber pressures in hexadecimal digits, by which copies are known; `units` by channel; `rate`
    [Hz]; `seconds` long; `start_s`: when its first sample was taken [s since 1970], None where not known; `lessons` by
    the names of the detectors that could use it; `about`: what people read of it, pressure, oil, noise; `statistics`:
    finite numbers by name, of any shape, kept with the machine.
    """

    file: str
    digest: str
    units: Mapping[str, str]
    rate: float
    seconds: float
    start_s: float | None
    lessons: Mapping[str, Lesson]
    about: Mapping[str, Any] = field(default_factory=dict)
    statistics: Mapping[str, float | Array] = field(default_factory=dict)


#: A healthy recording, or what it taught.
Healthy = Recording | Learnt


def lessons_of(detector: Any, baseline: Sequence[Healthy]) -> list[Lesson]:
    """Return a detector's lesson of each healthy recording, from its samples or as written down."""
    known = (
        recording.lessons.get(detector.name) if isinstance(recording, Learnt) else detector.learn(recording)
        for recording in baseline
    )
    return [lesson for lesson in known if lesson is not None]
