"""Whether a reading moves: constant channels, held values and changes that are mere rounding.

The noise of a transducer never stops. A value that stays the same to the last digit for longer than the noise allows
is a rail, a held value or a dead channel.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.channels import Array
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

#: A change of at most this share of a reading's largest value is rounding of the arithmetic: the reading does not move.
ROUNDING = 1e-9
_HOLD = priors_of("sealscope.recordings")["hold"]
_SHORTEST_STUCK = 5
_NEIGHBOURHOOD = 100
_STUCK_CHANCE = 1e-6
_LEVELS = 2**15


def constant(values: Array) -> bool:
    """Test whether all samples (n,) have one value; NaN equals nothing."""
    return bool(np.ptp(values) == 0)


def moves(values: Array) -> bool:
    """Test whether a reading (n,) has no missing sample and at least two values."""
    return values.size > 1 and bool(np.isfinite(values).all()) and not constant(values)


class Holds(NamedTuple):
    """Which samples of a pressure are held, and from which sample on its end leaves that open."""

    flags: NDArray[np.bool_]
    open: int


def find_holds(values: Array, rate: float, before: float = math.nan) -> Holds:
    """Find the samples (n,) of a pressure that stay the same to the last digit for longer than its noise allows.

    That is longer than 1.5 s, and 64 samples; the first of them is a reading. `before`: value that was held up to the
    first sample, NaN for none.
    """
    longest = max(round(_HOLD["seconds"] * rate), _HOLD["samples"])
    ends = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1, [len(values)]])
    lengths = np.diff(ends)
    held = lengths > longest
    goes_on = bool(len(values)) and bool(values[0] == before)
    held[0] |= goes_on
    flags = np.repeat(held, lengths)
    flags[ends[:-1][held][goes_on:]] = False
    return Holds(flags, len(values) if held[-1] else min(int(ends[-2]) + 1, len(values)))


def does_not_move(recording: Recording) -> str | None:
    """Describe a chamber pressure that stays constant in a recording without missing samples, and when; None for none.

    A pressure is constant where it is held (`find_holds`), or where it is a straight line to within `ROUNDING`
    throughout. A recording too short to tell and a constant channel, which `inspect` reports, give None.
    """
    for name in chambers_of(recording):
        values = recording[name]
        if len(values) <= _HOLD["samples"] or constant(values):
            continue
        if len(holds := runs_of(find_holds(values, recording.rate).flags)):
            first, length = holds[np.argmax(holds[:, 1])]
            start, stop = (float(recording.t[k]) for k in (first - 1, first + length - 1))
            return f"{name} does not move from {start:.4g} s to {stop:.4g} s"
        if np.abs(np.diff(values, 2)).max() <= ROUNDING * np.abs(values).max():
            return f"{name} does not move but along a straight line"
    return None


def runs_of(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the first index and the length (k, 2) of each run of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    return np.column_stack([edges[::2], edges[1::2] - edges[::2]])


def spacing(levels: Array) -> float:
    """Return the finest step between the sorted values that a channel takes; rounding of a conversion is no step."""
    steps = np.diff(levels)
    steps = steps[steps > ROUNDING * (levels[-1] - levels[0])]
    return float(steps.min()) if steps.size else 0.0


def quantum(values: Array) -> float:
    """Estimate the finest step of a channel (n,) from at most `_LEVELS` of its samples."""
    return spacing(np.unique(values[:: max(1, values.size // _LEVELS)]))


def stuck(values: Array) -> NDArray[np.intp]:
    """Return first index and length (k, 2) of the runs of equal values that the signal around them makes incredible.

    With p the share of unchanged samples in the 100 samples on either side (the larger of both), a run of length m has
    the chance p^(m-1) to begin at a given sample; it is stuck where fewer than 1e-6 such runs are expected in the whole
    channel, and where the value jumps by more than three quantisation steps when it begins or ends: a slow quantised
    signal at a turning point does not move either, but leaves in single steps.
    """
    nothing = np.empty((0, 2), dtype=np.intp)
    if values.size < 2 * _NEIGHBOURHOOD:
        return nothing
    same = np.diff(values) == 0
    runs = runs_of(same)
    runs = runs[runs[:, 1] >= _SHORTEST_STUCK - 1]
    first, last = runs[:, 0], runs.sum(axis=1)  # the samples first..last are equal
    inner = (first >= _NEIGHBOURHOOD // 5) & (last < values.size - 1 - _NEIGHBOURHOOD // 5)
    runs, first, last = runs[inner], first[inner], last[inner]
    if not runs.size:
        return nothing
    fine = spacing(np.unique(values))
    unchanged = np.r_[0, np.cumsum(same)]

    def share(begin: NDArray[Any], end: NDArray[Any]) -> Array:
        begin, end = np.maximum(begin, 0), np.minimum(end, same.size)
        return np.asarray((unchanged[end] - unchanged[begin] + 1) / (end - begin + 2), dtype=np.float64)

    likely = np.maximum(share(first - _NEIGHBOURHOOD, first), share(last, last + _NEIGHBOURHOOD))
    expected = np.log(values.size) + (runs[:, 1]) * np.log(likely)
    jump = np.maximum(np.abs(values[first] - values[first - 1]), np.abs(values[last + 1] - values[last]))
    chosen = (expected < np.log(_STUCK_CHANCE)) & (jump > 3.5 * fine)
    return np.column_stack([first[chosen], runs[chosen, 1] + 1])
