"""Statistics of long arrays, stretch by stretch: no copy of a whole channel, and each stretch stays in the cache.

Called by the reader of times, the inspection of a recording and its overview, which must not need more memory than the
recording itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_STRETCH = 2**16  # samples of a stretch: half a MiB of doubles


def iter_stretches(count: int, overlap: int = 0) -> Iterator[slice]:
    """Yield the slices of `count` samples in stretches; each ends `overlap` samples after the next one's beginning."""
    for first in range(0, count - overlap, _STRETCH):
        yield slice(first, min(first + _STRETCH, count - overlap) + overlap)


class Intervals(NamedTuple):
    """Intervals between successive times [s]; 0 and 0 s without any."""

    number: int
    n_changes: int  # number of intervals other than 0
    shortest: float  # NaN if a time is missing
    longest: float


def summarize_intervals(t: NDArray[np.float64]) -> Intervals:
    """Summarize the intervals between successive times `t` (n,) [s]."""
    n_changes, extremes = 0, list[tuple[float, float]]()
    for stretch in iter_stretches(t.size, overlap=1):
        steps = np.diff(t[stretch])
        n_changes += int(np.count_nonzero(steps))
        extremes.append((float(steps.min()), float(steps.max())))
    shortest, longest = np.array(extremes).T if extremes else (np.zeros(1), np.zeros(1))
    return Intervals(max(0, t.size - 1), n_changes, float(shortest.min()), float(longest.max()))


def finite_range(values: NDArray[np.float64]) -> tuple[float, float] | None:
    """Find the smallest and the largest finite one of values (n,); None if none is finite."""
    extremes = []
    for stretch in iter_stretches(values.size):
        part = values[stretch]
        lowest, highest = float(part.min()), float(part.max())
        if not np.isfinite(highest - lowest):
            part = part[np.isfinite(part)]
            if not part.size:
                continue
            lowest, highest = float(part.min()), float(part.max())
        extremes.append((lowest, highest))
    return (min(lowest for lowest, _ in extremes), max(highest for _, highest in extremes)) if extremes else None


def take_finite(values: NDArray[Any]) -> NDArray[Any]:
    """Take the finite ones of values (n,), which are the array itself if all are."""
    is_finite = np.isfinite(values)
    return values if is_finite.all() else values[is_finite]


def largest_steps(values: NDArray[np.float64], count: int) -> list[int]:
    """Find the indices of the `count` largest steps from sample to sample of finite values (n,), the largest last."""
    candidates: list[tuple[float, int]] = []
    for stretch in iter_stretches(values.size, overlap=1):
        sizes = np.abs(np.diff(values[stretch]))
        largest = np.argpartition(sizes, -count)[-count:] if sizes.size > count else np.arange(sizes.size)
        candidates += [(float(sizes[index]), stretch.start + int(index)) for index in largest]
    return [index for _, index in sorted(candidates)[-count:]]
