"""When recordings were made, and those of one run, as loggers cut them into files, joined in that order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sealscope.calls import checked_call
from sealscope.errors import InputError
from sealscope.recordings.formats.timebase import seconds_of
from sealscope.recordings.recording import Recording

#: Files of the same start [s] have a clock that goes on from file to file.
_SAME_START = 1e-6
_YEAR_FIRST = re.compile(
    r"(?<!\d)(?P<year>(?:19|20)\d\d)[-_.]?(?P<month>\d\d)[-_.]?(?P<day>\d\d)[-_ T.]?"
    r"(?:(?P<hour>[01]\d|2[0-3])[-_.h:]?(?P<minute>[0-5]\d)(?:[-_.m:]?(?P<second>[0-5]\d))?)?(?!\d)"
)
#: Twelve hours, which loggers write with the month first.
_TWELVE_HOURS = re.compile(
    r"(?<!\d)(?P<month>\d{1,2})[-_.](?P<day>\d{1,2})[-_.](?P<year>(?:19|20)\d\d)[-_ .]"
    r"(?P<hour>\d{1,2})[-_.:](?P<minute>[0-5]\d)[-_.:](?P<second>[0-5]\d)[-_ ]?(?P<half>[AP])M",
    re.IGNORECASE,
)


def start_seconds(recording: Recording, file: str = "") -> float | None:
    """Return when the recording's first sample was taken [s since 1970], None where it is not known.

    By its provenance, else by the name of its file; of one with a date and no time of day: the beginning of the day.
    """
    start = seconds_of(str(recording.provenance.get("start", "")))
    if start is None:
        start = _stamp_in_name(str(recording.provenance.get("file") or file))
    return None if start is None else start + (float(recording.t[0]) if len(recording) else 0.0)


def file_seconds(recording: Recording, path: Path) -> float:
    """Return when the first sample of a file's recording was taken [s since 1970], by the one clock of all commands.

    By the time in the file, else in its name, else that of its last change, when the last sample was taken.
    """
    start = start_seconds(recording, path.name)
    if start is not None:
        return start
    times = recording.t[np.isfinite(recording.t)]
    return path.stat().st_mtime - (float(times[-1] - times[0]) if times.size else 0.0)


def _stamp_in_name(name: str) -> float | None:
    match = _TWELVE_HOURS.search(name) or _YEAR_FIRST.search(name)
    if match is None:
        return None
    fields = match.groupdict()
    hour = int(fields["hour"] or 0)
    if fields.get("half"):
        hour = hour % 12 + (12 if fields["half"].upper() == "P" else 0)
    return seconds_of(
        f"{fields['year']}-{int(fields['month']):02d}-{int(fields['day']):02d}"
        f"T{hour:02d}:{fields['minute'] or '00'}:{fields['second'] or '00'}"
    )


def _start(recording: Recording) -> float | None:
    """Return the moment t = 0 in seconds of some clock of the day; None where it is not known."""
    epoch = recording.provenance.get("start_epoch_s")
    return seconds_of(str(recording.provenance.get("start", ""))) if epoch is None else float(epoch)


@checked_call
def join(recordings: Sequence[Recording], *, names: Sequence[str] | None = None) -> Recording:
    """Join recordings of one run to one.

    The clocks must fit: each recording begins after the one before has ended, by the moments of their files or, where
    none is known, by times that go on. What was not recorded in between stays a gap of the time, which `inspect` names.

    Parameters
    ----------
    recordings : sequence of Recording
        Two or more, in any order, with the same channels, units and sampling rate.
    names : sequence of str, optional
        What messages and the history call them; by default the files of their provenance.

    Returns
    -------
    Recording
        Its time begins with that of the first; its provenance is that of the first, with the names of all files.

    Raises
    ------
    InputError
        If channels, units or rates differ, or the clocks do not fit.

    Examples
    --------
    >>> import sealscope as ss
    >>> from sealscope.recordings import join
    >>> t = [k / 500 for k in range(2000)]
    >>> whole = ss.Recording(t, {"p_A": t}, {"p_A": "Pa"}, rate=500.0)
    >>> join([whole.between(2.0, 4.0), whole.between(0.0, 2.0)])
    Recording(p_A [Pa]; 2000 samples, 500 Hz, 4 s)
    """
    if len(recordings) < 2:
        raise InputError(f"recordings to join must be two or more, got {len(recordings)}")
    first = recordings[0]
    names = names or [
        str(recording.provenance.get("file", f"recording {k}")) for k, recording in enumerate(recordings, 1)
    ]
    for name, other in zip(names, recordings, strict=True):
        if len(other) == 0:
            raise InputError(f"a recording to join must have samples, got none ({name})")
        if dict(other.units) != dict(first.units):
            both = f"{', '.join(first.units)} and {', '.join(other.units)}"
            raise InputError(f"recordings to join must have the same channels and units, got {both} ({name})")
        if other.rate != first.rate:
            both = f"{first.rate:g} and {other.rate:g} Hz"
            raise InputError(f"recordings to join must have the same rate, got {both} ({name})")
    starts = [_start(recording) for recording in recordings]
    known = [start for start in starts if start is not None]
    dated = len(known) == len(starts) and max(known) - min(known) > _SAME_START
    offsets = [start - min(known) for start in known] if dated else [0.0] * len(recordings)
    times = [recording.t + offset for recording, offset in zip(recordings, offsets, strict=True)]
    order = sorted(range(len(recordings)), key=lambda number: float(np.nanmin(times[number])))
    for before, after in pairwise(order):
        begin, end = float(np.nanmin(times[after])), float(np.nanmax(times[before]))
        if begin <= end:
            clocks = "the moments of the files" if dated else "their times, as no moment of the files is known"
            raise InputError(
                f"the clocks of recordings to join must go on from file to file, got {end:g} s at the end of "
                f"{names[before]} and {begin:g} s at the beginning of {names[after]}, by {clocks}"
            )
    parts = [recordings[number] for number in order]
    files = [names[number] for number in order]
    bridged = [np.zeros(len(part), dtype=bool) if part.bridged is None else part.bridged for part in parts]
    history = tuple(dict.fromkeys(line for part in parts for line in part.history))
    return replace(
        parts[0],
        t=np.concatenate([times[number] for number in order]),
        channels={name: np.concatenate([part[name] for part in parts]) for name in parts[0].channels},
        provenance={**parts[0].provenance, "files": files},
        history=(*history, f"joined from {len(parts)} files: {', '.join(files)}"),
        bridged=np.concatenate(bridged),
    )
