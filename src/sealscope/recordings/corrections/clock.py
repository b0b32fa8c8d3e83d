"""An even clock for samples that a poll took at uneven times.

Rows of the weak form integrate over an even clock. Samples of an uneven one are brought to it, at the median rate, by
straight lines between neighbours, which is the trapezoidal rule over the recorded times. Where neighbours are far apart
samples are missing; `corrections.gaps` bridges and marks them. The inspection calls it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import SLOW, Array
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

_PRIORS = priors_of("sealscope.recordings")["clock"]
#: Neighbours up to so many of the usual intervals apart are joined by a line.
NEAR: float = _PRIORS["near"]
#: Largest share of the samples that gaps may be without cutting the recording, and that may be late.
MOST_LOST, MOST_LATE = _PRIORS["lost"], _PRIORS["late"]


def even_clock(recording: Recording) -> Recording:
    """Bring the samples to an even clock, NaN where rows were lost; return the same recording if its clock is even.

    Rows without a time, late rows and repeated times are dropped. Of recordings in one file, whose clock goes back or
    leaps, the longest is kept.
    """
    kept = _ordered_rows(recording.t)
    kept = kept[_densest_stretch(recording.t[kept], recording.rate)]
    if kept.size < 2:
        return recording.samples(slice(0, kept.size))
    t = recording.t[kept]
    steps = np.diff(t) * recording.rate
    whole = np.round(steps)
    if np.sqrt(np.mean((steps - whole) ** 2)) <= _PRIORS["scatter"] and whole.min() >= 1.0:
        if kept.size == len(recording) and whole.max() == 1.0:
            return recording
        return _with_lost_rows(recording, kept, whole.astype(np.int64))
    return _resampled(recording, kept)


def is_uneven(recording: Recording) -> bool:
    """Test whether `even_clock` would interpolate the samples of a recording."""
    kept = _ordered_rows(recording.t)
    steps = np.diff(recording.t[kept]) * recording.rate
    return bool(steps.size and np.sqrt(np.mean((steps - np.round(steps)) ** 2)) > _PRIORS["scatter"])


def _ordered_rows(t: Array) -> NDArray[np.intp]:
    """Find the rows with rising times; if many are out of order, the rows of the longest rising run."""
    timed = np.flatnonzero(np.isfinite(t))
    if timed.size < 2:
        return timed
    newest = np.maximum.accumulate(t[timed])
    late = np.r_[False, t[timed][1:] <= newest[:-1]]
    if np.mean(late) <= MOST_LATE:
        return np.asarray(timed[~late])
    runs = np.split(timed, np.flatnonzero(np.diff(t[timed]) < 0.0) + 1)
    run = max(runs, key=len)
    return np.asarray(run[np.r_[True, np.diff(t[run]) > 0.0]])


def _densest_stretch(t: Array, rate: float) -> slice:
    """Return the stretch of times (n,) with the most samples of which gaps take no more than `MOST_LOST`."""
    surplus = np.arange(t.size) - (1.0 - MOST_LOST) * rate * (t - t[:1].sum())
    best_after = np.maximum.accumulate(surplus[::-1])[::-1]
    last = np.searchsorted(-best_after, -surplus, side="right") - 1
    first = int(np.argmax(last - np.arange(t.size))) if t.size else 0
    return slice(first, int(last[first]) + 1 if t.size else 0)


def _with_lost_rows(recording: Recording, kept: NDArray[np.intp], steps: NDArray[np.int64]) -> Recording:
    """Return the kept rows with rows of NaN where intervals of several `steps` show that some were lost."""
    place = np.concatenate([[0], np.cumsum(steps)])
    count = int(place[-1]) + 1
    channels = {name: np.full(count, np.nan) for name in recording.channels}
    for name, values in channels.items():
        values[place] = recording[name][kept]
    return replace(recording, t=np.interp(np.arange(count), place, recording.t[kept]), channels=channels)


def _resampled(recording: Recording, kept: NDArray[np.intp]) -> Recording:
    """Return the kept rows on an even clock of the recording's rate."""
    t = recording.t[kept]
    even = t[0] + np.arange(int((t[-1] - t[0]) * recording.rate) + 1) / recording.rate
    channels = {}
    for name, values in recording.channels.items():
        known = np.isfinite(values[kept])
        channels[name] = _on_lines(even, t[known], values[kept][known], name in SLOW)
    note = f"uneven sampling brought to {recording.rate:g} Hz by straight lines"
    return replace(recording, t=even, channels=channels, history=(*recording.history, note))


def _on_lines(even: Array, t: Array, values: Array, slow: bool) -> Array:
    """Return values (m,) at the times `even` on lines between samples (n,), NaN where these are not near."""
    if t.size < 2:
        return np.full(even.size, np.nan)
    result = np.interp(even, t, values, left=np.nan, right=np.nan)
    if not slow:
        steps = np.diff(t)
        after = np.clip(np.searchsorted(t, even), 1, t.size - 1)
        far = steps > NEAR * float(np.median(steps))
        result[far[after - 1] & (even > t[after - 1]) & (even < t[after])] = np.nan
    return result
