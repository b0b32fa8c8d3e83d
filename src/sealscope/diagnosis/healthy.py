"""Healthy recordings, as samples or as the summaries that detectors computed when the machine was commissioned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sealscope.recordings.recording import Array, Recording

#: A detector's summary of a healthy recording, from its method `learn`: plain values that only this detector reads.
Summary = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class SummarisedRecording:
    """A healthy recording reduced to the detectors' summaries, without its samples.

    Attributes
    ----------
    file : str
        Name of the recording.
    digest : str
        SHA-256 of its chamber pressures in hexadecimal digits, equal for copies of a recording.
    units : mapping of str to str
        Unit of each channel.
    rate : float
        Sampling rate [Hz].
    seconds : float
        Duration [s].
    start_s : float or None
        Time of its first sample [s since 1970], None if unknown.
    summaries : mapping of str to mapping
        Summary by each detector, by the detector's name.
    about : mapping
        Pressure, oil temperature, noise and problems of the recording, for display.
    statistics : mapping of str to float or ndarray
        Surprisals, -log(p-value), of the changes within the recording, by the key of the change
        (`observation.healthy_surprisals`).
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
    """Collect one detector's summaries of healthy recordings, either stored or computed now.

    `detector` has a `name` and a method `learn`, which summarises a recording or returns None. Recordings without a
    summary are skipped.
    """
    summaries = (
        recording.summaries.get(detector.name)
        if isinstance(recording, SummarisedRecording)
        else detector.learn(recording)
        for recording in baseline
    )
    return [summary for summary in summaries if summary is not None]
