"""When recordings were made, and which of them are of one session.

A recording's start is known where its file has date stamps (`provenance["start"]`), or where the name of its file holds
date and time. Where the start of every baseline recording is known, a pause of more than `LONGEST_PAUSE` ends a
session. Where it is not, the order of the recordings stands for the time: single strokes are taken by the dozen and
count as one session, one after the other as given; recordings of a repeated duty are taken one at a time and count as
sessions of their own.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.diagnosis.baseline.mixed_model import FEWEST_SESSIONS
from sealscope.recordings.recording import Array, Recording
from sealscope.recordings.timebase import seconds_of
from sealscope.signals.filters import IntArray

#: A longer pause between two recordings [s] ends the session: a machine cools down, or is another one.
LONGEST_PAUSE = 1800.0

_YEAR_FIRST = re.compile(
    r"(?<!\d)(?P<year>(?:19|20)\d\d)[-_.]?(?P<month>\d\d)[-_.]?(?P<day>\d\d)[-_ T.]?"
    r"(?P<hour>[01]\d|2[0-3])[-_.h:]?(?P<minute>[0-5]\d)(?:[-_.m:]?(?P<second>[0-5]\d))?(?!\d)"
)
#: Twelve hours, which loggers write with the month first.
_TWELVE_HOURS = re.compile(
    r"(?<!\d)(?P<month>\d{1,2})[-_.](?P<day>\d{1,2})[-_.](?P<year>(?:19|20)\d\d)[-_ .]"
    r"(?P<hour>\d{1,2})[-_.:](?P<minute>[0-5]\d)[-_.:](?P<second>[0-5]\d)[-_ ]?(?P<half>[AP])M",
    re.IGNORECASE,
)


def start_seconds(recording: Recording) -> float | None:
    """Return when the recording's first sample was taken [s since 1970], None where it is not known."""
    start = seconds_of(str(recording.provenance.get("start", "")))
    if start is None:
        start = _stamp_in_name(str(recording.provenance.get("file", "")))
    return None if start is None else start + (float(recording.t[0]) if len(recording) else 0.0)


def _stamp_in_name(name: str) -> float | None:
    match = _YEAR_FIRST.search(name) or _TWELVE_HOURS.search(name)
    if match is None:
        return None
    fields = match.groupdict()
    hour = int(fields["hour"])
    if fields.get("half"):
        hour = hour % 12 + (12 if fields["half"].upper() == "P" else 0)
    return seconds_of(
        f"{fields['year']}-{int(fields['month']):02d}-{int(fields['day']):02d}"
        f"T{hour:02d}:{fields['minute']}:{fields['second'] or '00'}"
    )


@dataclass(frozen=True)
class Sessions:
    """Times and sessions of n baseline recordings and of the one that is judged.

    `times` (n,) [s] and `time`: None where unknown; `labels` (n,) and `label`: the session's number, None for a session
    that holds no baseline recording, or an unknown one. `exchangeable`: every recording is a session of its own, so
    that the scatter between recordings is that between sessions.
    """

    times: Array | None
    labels: IntArray | None
    time: float | None
    label: int | None
    exchangeable: bool


@dataclass(frozen=True)
class Times:
    """When n recordings were made: `starts` (n,) [s since 1970], None where not known, and `lengths` (n,) [s]."""

    starts: tuple[float | None, ...]
    lengths: tuple[float, ...]

    @classmethod
    def of(cls, recordings: Sequence[Recording]) -> Times:
        """Return the times of recordings."""
        return cls(tuple(map(start_seconds, recordings)), tuple(recording.duration for recording in recordings))


def sessions_of(own: float | None, baseline: Times, *, single_strokes: bool) -> Sessions:
    """Return the sessions of the baseline recordings and of the one that is judged, which started at `own` [s].

    `single_strokes`: whether they go one way only, as opposed to a repeated duty.
    """
    known = [start for start in baseline.starts if start is not None]
    if len(known) < len(baseline.starts):
        if not single_strokes:
            return Sessions(None, None, None, None, True)
        lengths = np.array(baseline.lengths)
        return Sessions(np.cumsum(lengths) - lengths, np.zeros(lengths.size, dtype=np.int64), None, None, False)
    together = np.array(known if own is None else [*known, own])
    order = np.argsort(together, kind="stable")
    numbers = np.empty(len(together), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(np.diff(together[order]) > LONGEST_PAUSE)])
    labels = numbers[: len(known)]
    label = int(numbers[-1]) if own is not None and numbers[-1] in labels else None
    single = len(np.unique(labels)) == len(known)
    if single and label is None and (len(known) >= FEWEST_SESSIONS or not single_strokes):
        return Sessions(None, None, None, None, True)
    origin = float(together.min())
    return Sessions(np.array(known) - origin, labels, None if own is None else own - origin, label, False)
