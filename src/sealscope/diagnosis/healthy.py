"""Healthy recordings, as samples or as the summaries that detectors computed when the machine was commissioned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sealscope.recordings.recording import Recording

#: A detector's summary of a healthy recording, from its method `learn`: plain values that only this detector reads.
Summary = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class SummarisedRecording:
    """A healthy recording reduced to the detectors' summaries, without its samples."""

    file: str  # name of the recording
    digest: str  # SHA-256 of its chamber pressures in hexadecimal digits, equal for copies of a recording
    units: Mapping[str, str]  # unit of each channel
    rate: float  # sampling rate [Hz]
    seconds: float  # duration [s]
    start_s: float | None  # time of its first sample [s since 1970], None if unknown
    summaries: Mapping[str, Summary]  # summary by each detector, by the detector's name
    # pressure, oil, noise and problems, for display (`commissioned.summary.describe_recording`)
    about: Mapping[str, Any] = field(default_factory=dict)
    # surprisal, -log(p-value), of each test for a change within it, by the key of the test (`healthy_surprisals`)
    statistics: Mapping[str, float] = field(default_factory=dict)


#: A healthy recording, as samples or as summaries.
Healthy = Recording | SummarisedRecording


def healthy_summaries(detector: Any, baseline: Sequence[Healthy]) -> list[Summary]:
    """Collect a detector's summaries of healthy recordings, stored or computed by its `learn`; some may have none."""
    summaries = (
        recording.summaries.get(detector.name)
        if isinstance(recording, SummarisedRecording)
        else detector.learn(recording)
        for recording in baseline
    )
    return [summary for summary in summaries if summary is not None]
