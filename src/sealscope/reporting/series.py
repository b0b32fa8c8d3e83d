"""Decimate samples for drawing, preserving all peaks, and encode them compactly for the page."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

_GAP_RATIO = 5.0  # the drawn line is broken if a time step exceeds this multiple of the nominal one
_MISSING = -32768


@dataclass(frozen=True)
class DrawnTimes:
    """The times at which the channels of a recording are drawn.

    Samples are divided into buckets, groups of successive samples of which only the minimum and the maximum are drawn.
    `t` (m,) [s]: times of the drawn points; `starts`, `stops` (k,): samples [start, stop) of each bucket; `width`:
    number of samples in a full bucket, 1 if all are drawn; `fine`: range of samples that are all drawn; `breaks` (g,):
    points before which a NaN interrupts the line, as for `np.insert`; `by_sample`: True if the time stamps do not
    increase, so that `t` is the number of the sample over the sampling rate.
    """

    t: Array
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]
    width: int
    fine: slice
    breaks: NDArray[np.int64]
    by_sample: bool

    def reduce(self, values: Array) -> Array:
        """Reduce the values (n,) of a channel to the points (m,) that are drawn at the times `t`.

        Each bucket gives minimum and maximum of its finite values, NaN without any. The minimum comes first if the
        bucket's first and last value are finite and the last is not below the first.
        """
        values = np.where(np.isfinite(values), values, np.nan)
        low = np.fmin.reduceat(values, self.starts)
        high = np.fmax.reduceat(values, self.starts)
        is_rising = values[self.starts] <= values[self.stops - 1]
        points = _interleave(np.where(is_rising, low, high), np.where(is_rising, high, low), self.stops - self.starts)
        return np.insert(points, self.breaks, np.nan)


def _interleave(first: Array, second: Array, sizes: NDArray[np.int64]) -> Array:
    """Arrange the first and second points (k,) of buckets in order; a bucket of size 1 has no second point."""
    pairs = np.stack([first, second], axis=1)
    is_point = np.stack([np.ones(sizes.size, dtype=bool), sizes > 1], axis=1)
    return np.asarray(pairs[is_point])  # row by row


def ordered_time(t: Array, rate: float) -> tuple[Array, bool]:
    """Return the time stamps `t` [s] and False, or sample number / `rate` and True if not all are finite and rising."""
    by_sample = not (np.all(np.isfinite(t)) and np.all(np.diff(t) > 0))
    return (np.arange(t.size) / rate, True) if by_sample else (t, False)


def choose_drawn_times(
    t: Array, rate: float, points: int, *, near: float | None = None, near_samples: int = 0
) -> DrawnTimes:
    """Choose the times at which a chart draws a recording: about `points`, and all samples around the time `near`.

    Minimum and maximum of a bucket (`DrawnTimes`) are drawn at the times of its first and last sample, so a drawn peak
    is at most one bucket away from its true time. At the longest gaps in time, at most `points` / 20, a new bucket
    starts, and a NaN interrupts the line. `t` (n,) [s]: times of at least one sample; `points` >= 20; `near` [s]: time
    around which `near_samples` samples, by default none, are all drawn, each in a bucket of its own; None for the start
    of the recording.
    """
    n = t.size
    t, by_sample = ordered_time(t, rate)
    width = 1 if n <= points else -(-n // (points // 2))  # samples of a bucket, which has two points; rounded up
    centre = 0 if near is None else int(np.searchsorted(t, near))
    fine = slice(max(0, centre - near_samples // 2), min(n, centre + near_samples // 2)) if width > 1 else slice(0, n)
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > _GAP_RATIO / rate) + 1  # indices of the samples after the gaps
    max_gaps = points // 20
    if gaps.size > max_gaps:  # keep the longest; the time step before sample k is `steps[k - 1]`
        gaps = np.sort(gaps[np.argsort(steps[gaps - 1])[-max_gaps:]])
    # each sample of `fine` has a bucket to itself; the sample after them starts the next bucket
    single_samples = np.arange(fine.start, min(fine.stop + 1, n))
    starts = np.unique(np.concatenate([np.arange(0, n, width), gaps, single_samples])).astype(np.int64)
    stops = np.append(starts[1:], n)
    sizes = stops - starts
    first_points = np.append(0, np.cumsum(np.where(sizes > 1, 2, 1)))  # index of each bucket's first point
    # a bucket starts at each of `gaps`; `breaks` are indices of points before the insertion
    breaks = first_points[np.searchsorted(starts, gaps)]
    # the point that interrupts the line has the time of the last sample before the gap
    times = np.insert(_interleave(t[starts], t[stops - 1], sizes), breaks, t[gaps - 1])
    return DrawnTimes(times, starts, stops, width, fine, breaks, by_sample)


def encode_values(values: Array) -> dict[str, Any]:
    """Encode values as base64 text of little-endian 16-bit integers, for the script of the page.

    An integer q of the text `q` stands for the value ``low + (q + 32767) * step``, and -32768 for a value that is not
    finite.
    """
    is_finite = np.isfinite(values)
    finite = values[is_finite]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    step = (high - low) / 65534
    codes = np.full(values.shape, _MISSING, dtype="<i2")
    # a step of 0: all values are `low`
    codes[is_finite] = np.clip(np.rint((finite - low) / (step or 1.0)) - 32767, -32767, 32767)
    return {"low": low, "step": step, "q": b64encode(codes.tobytes()).decode()}


def encode_times(t: Array) -> str:
    """Encode times [s] as base64 text of little-endian doubles, for the script of the page."""
    return b64encode(np.ascontiguousarray(t, dtype="<f8").tobytes()).decode()
