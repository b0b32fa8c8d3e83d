"""Healthy recordings, as samples or as the summaries that detectors computed of them at commissioning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sealscope.recordings.recording import Array, Recording

#: What a detector's `learn` computed of a healthy recording: plain values that only that detector reads.
Summary = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class SummarisedRecording:
    """A healthy recording reduced to the summaries of the detectors, without its samples.

    `file`: its name; `digest`: hash of its chamber pressures in hexadecimal digits, equal for copies; `units` by
    channel; `rate` [Hz]; `seconds`: duration; `start_s`: time of its first sample [s since 1970], None if unknown;
    `summaries`: by name of the detector; `about`: pressure, oil temperature, noise and problems, for display;
    `statistics`: surprisals of its changes by name, finite numbers (`observation.healthy_surprisals`).
    """

    file: str
    digest: str
    units: Mapping[str, str]
    rate: float
    seconds: float
    start_s: float | None
    summaries: Mapping[str, Summary]
    about: Mapping[str, Any] = field(default_factory=dict)
    statistics: Mapping[str, float | Array] = field(default_factory=dict)


#: A healthy recording, as samples or as summaries.
Healthy = Recording | SummarisedRecording


def healthy_summaries(detector: Any, baseline: Sequence[Healthy]) -> list[Summary]:
    """Collect a detector's summaries of healthy recordings, stored or computed now; skip those without one."""
    summaries = (
        recording.summaries.get(detector.name)
        if isinstance(recording, SummarisedRecording)
        else detector.learn(recording)
        for recording in baseline
    )
    return [summary for summary in summaries if summary is not None]
