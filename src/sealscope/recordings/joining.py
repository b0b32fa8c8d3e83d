"""Join the files into which a logger cut one run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from sealscope.calls import checked_call
from sealscope.errors import InputError
from sealscope.recordings.header import time_zero
from sealscope.recordings.recording import Recording

_SAME_START = 1e-6  # starts that differ by less [s] are equal: the times then continue from file to file


def _check_compatible(recordings: Sequence[Recording], names: Sequence[str]) -> None:
    """Raise InputError unless recordings, called `names`, have samples and the same channels, units and rate."""
    first = recordings[0]
    for name, recording in zip(names, recordings, strict=True):
        if len(recording) == 0:
            raise InputError(f"a recording to join must have samples, got none ({name})")
        if dict(recording.units) != dict(first.units):
            both = f"{', '.join(first.units)} and {', '.join(recording.units)}"
            raise InputError(f"recordings to join must have the same channels and units, got {both} ({name})")
        if recording.rate != first.rate:
            both = f"{first.rate:g} and {recording.rate:g} Hz"
            raise InputError(f"recordings to join must have the same rate, got {both} ({name})")


@checked_call
def join(recordings: Sequence[Recording], *, names: Sequence[str] | None = None) -> Recording:
    """Join the recordings of one run to a single recording.

    Each recording must begin after the previous one has ended. Their order follows from the start times in their files
    or, if these are not all known or are all equal, from the times `t`. Time between recordings stays a gap.

    Parameters
    ----------
    recordings : sequence of Recording
        Two or more, in any order, with the same channels, units and sampling rate.
    names : sequence of str, optional
        Names for messages and the history; by default the files of their provenance.

    Returns
    -------
    Recording
        Its provenance and its origin of time are those of the earliest recording; the entry `files` of the provenance
        lists the names of all.

    Raises
    ------
    InputError
        If channels, units or rates differ, or two recordings overlap in time.

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
    names = names or [
        str(recording.provenance.get("file", f"recording {k}")) for k, recording in enumerate(recordings, 1)
    ]
    _check_compatible(recordings, names)
    starts = [time_zero(recording) for recording in recordings]
    known_starts = [start for start in starts if start is not None]
    is_dated = len(known_starts) == len(starts) and max(known_starts) - min(known_starts) > _SAME_START
    # all times relative to the earliest start
    offsets = [start - min(known_starts) for start in known_starts] if is_dated else [0.0] * len(recordings)
    times = [recording.t + offset for recording, offset in zip(recordings, offsets, strict=True)]
    order = sorted(range(len(recordings)), key=lambda number: float(np.nanmin(times[number])))
    for earlier, later in pairwise(order):
        begin, end = float(np.nanmin(times[later])), float(np.nanmax(times[earlier]))
        if begin <= end:
            clock = "the start times in the files" if is_dated else "their time columns"
            raise InputError(
                f"recordings to join must not overlap in time, got {end:g} s at the end of {names[earlier]} and "
                f"{begin:g} s at the beginning of {names[later]}, according to {clock}"
            )
    parts = [recordings[number] for number in order]
    files = [names[number] for number in order]
    bridged = [np.zeros(len(part), dtype=bool) if part.bridged is None else part.bridged for part in parts]
    history = tuple(dict.fromkeys(line for part in parts for line in part.history))
    return replace(
        parts[0],
        t=np.concatenate([times[number] for number in order]) - offsets[order[0]],  # t = 0 is the first part's
        channels={name: np.concatenate([part[name] for part in parts]) for name in parts[0].channels},
        provenance={**parts[0].provenance, "files": files},
        history=(*history, f"joined from {len(parts)} files: {', '.join(files)}"),
        bridged=np.concatenate(bridged),
    )
