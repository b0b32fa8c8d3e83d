"""Decimation of samples for drawing, which keeps every peak, and their compact coding for the page."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

_GAP = 5.0  # a step this many times the nominal one breaks the drawn line
_MISSING = -32768


@dataclass(frozen=True)
class DrawnTimes:
    """Points of time at which all series of one recording are drawn.

    `t`: (m,) [s], never decreasing; `starts`, `stops`: (k,) first sample of each bucket and the one after its last;
    `width`: samples in a full bucket (1: every sample is drawn); `fine`: the samples drawn one by one whatever the
    width; `breaks`: points that end a stretch before a gap in time; `by_sample`: the time stamps are out of order, so t
    is the sample's number over the rate.
    """

    t: Array
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]
    width: int
    fine: slice
    breaks: NDArray[np.int64]
    by_sample: bool

    def reduce(self, values: Array) -> Array:
        """Return the least and the greatest value of each bucket, (n,) -> (m,), in the order of their samples.

        A bucket of one sample gives one point. NaN where a bucket holds no finite sample and at each gap: no line is
        drawn there.
        """
        values = np.where(np.isfinite(values), values, np.nan)
        low = np.fmin.reduceat(values, self.starts)
        high = np.fmax.reduceat(values, self.starts)
        rising = values[self.starts] <= values[self.stops - 1]
        drawn = _interleave(np.where(rising, low, high), np.where(rising, high, low), self.stops - self.starts)
        return np.insert(drawn, self.breaks, np.nan)


def _interleave(first: Array, second: Array, sizes: NDArray[np.int64]) -> Array:
    """Return both points of each bucket in turn, the second left out where the bucket is one sample."""
    both = np.stack([first, second], axis=1)
    kept = np.stack([np.ones(sizes.size, dtype=bool), sizes > 1], axis=1)
    return np.asarray(both[kept])


def ordered_time(t: Array, rate: float) -> tuple[Array, bool]:
    """Return the time stamps (n,) [s], or the samples' numbers over the rate and True where they do not increase."""
    by_sample = not (np.all(np.isfinite(t)) and np.all(np.diff(t) > 0))
    return (np.arange(t.size) / rate, True) if by_sample else (t, False)


def time_base(t: Array, rate: float, points: int, *, near: float | None = None, near_samples: int = 0) -> DrawnTimes:
    """Return the drawing base of n samples with about `points` points, and every sample near the time `near` [s].

    `t`: (n,) [s]; `rate`: nominal rate [Hz]; `near_samples`: how many samples are drawn one by one there. Buckets hold
    an equal count of samples; a drawn extreme lies at most one bucket away from its true time.
    """
    n = t.size
    t, by_sample = ordered_time(t, rate)
    width = 1 if n <= points else -(-n // (points // 2))
    centre = 0 if near is None else int(np.searchsorted(t, near))
    fine = slice(max(0, centre - near_samples // 2), min(n, centre + near_samples // 2)) if width > 1 else slice(0, n)
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > _GAP / rate) + 1
    if gaps.size > points // 20:
        gaps = np.sort(gaps[np.argsort(steps[gaps - 1])[-(points // 20) :]])
    singles = np.arange(fine.start, fine.stop + 1)
    starts = np.unique(np.concatenate([np.arange(0, n, width), gaps, singles[singles < n]])).astype(np.int64)
    stops = np.append(starts[1:], n)
    sizes = stops - starts
    before = np.append(0, np.cumsum(np.where(sizes > 1, 2, 1)))  # points drawn ahead of each bucket
    breaks = before[np.searchsorted(starts, gaps)]
    drawn = np.insert(_interleave(t[starts], t[stops - 1], sizes), breaks, t[gaps - 1])
    return DrawnTimes(drawn, starts, stops, width, fine, breaks, by_sample)


def coded(values: Array) -> dict[str, Any]:
    """Return the values on a grid of 65 534 steps between their extremes, as base64 of 16-bit integers (NaN: -32768).

    Decoded as `low + (q + 32767) * step`; the extremes themselves are exact to rounding.
    """
    finite = np.isfinite(values)
    low, high = (float(values[finite].min()), float(values[finite].max())) if finite.any() else (0.0, 0.0)
    step = (high - low) / 65534
    q = np.full(values.shape, _MISSING, dtype="<i2")
    if step > 0:
        q[finite] = np.clip(np.rint((values[finite] - low) / step) - 32767, -32767, 32767)
    else:
        q[finite] = -32767
    return {"low": low, "step": step, "q": b64encode(q.tobytes()).decode()}


def coded_times(t: Array) -> str:
    """Return the times as base64 of little-endian doubles [s]."""
    return b64encode(np.ascontiguousarray(t, dtype="<f8").tobytes()).decode()
