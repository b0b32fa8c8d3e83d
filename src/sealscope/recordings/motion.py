"""Tests whether a reading moves: constant channels, held values, and changes that are only rounding.

A transducer's noise never stops: a value that stays unchanged for long is clipped, repeated or from a dead channel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import ROUNDING, Array, chambers_of, smallest_step
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording

_HOLD = RECORDINGS.hold
#: Shortest run of equal values that can be stuck, and number of samples on either side with which it is compared.
_MIN_STUCK, _NEIGHBOURHOOD = 5, 100
_MAX_EXPECTED = 1e-6  # a run is stuck if fewer runs of its length than this are expected in the channel
_MIN_JUMP = 3.5  # smallest jump at an end of a stuck run, in quantisation steps: more than three


def is_constant(values: Array) -> bool:
    """Test whether all samples (n,), one or more, are equal; False if one is NaN or infinite."""
    return bool(np.ptp(values) == 0)


def is_moving(values: Array) -> bool:
    """Test whether a channel (n,) has no missing sample and at least two different values."""
    return values.size > 1 and bool(np.isfinite(values).all()) and not is_constant(values)


def find_holds(values: Array, rate: float) -> NDArray[np.bool_]:
    """Find the samples (n,) at which a pressure `values` repeats one value for longer than its noise allows.

    A run of equal samples is a hold if it is longer than both 1.5 s and 64 samples; a missing sample ends a run. The
    first sample of a hold is a reading and not flagged. `rate`: sampling rate [Hz].
    """
    max_length = max(round(_HOLD.seconds * rate), _HOLD.samples)
    edges = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1, [len(values)]])
    lengths = np.diff(edges)
    is_hold = lengths > max_length
    flags = np.repeat(is_hold, lengths)
    flags[edges[:-1][is_hold]] = False
    return flags


def describe_hold(recording: Recording) -> str | None:
    """Describe a chamber pressure that does not move, although its noise should move it; None if there is none.

    Such a pressure repeats one value for too long (`find_holds`), or follows a straight line throughout. A pressure
    that is constant throughout (`quality.inspect` reports it), or has at most 64 samples, is skipped. No sample may be
    missing.
    """
    for name in chambers_of(recording):
        values = recording[name]
        if len(values) <= _HOLD.samples or is_constant(values):
            continue
        if len(holds := find_runs(find_holds(values, recording.rate))):
            first, length = holds[np.argmax(holds[:, 1])]  # the longest
            # the sample before the flagged ones is the reading that they repeat
            start, stop = (float(recording.t[k]) for k in (first - 1, first + length - 1))
            return f"{name} does not move from {start:.4g} s to {stop:.4g} s"
    return describe_line(recording)


def describe_line(recording: Recording) -> str | None:
    """Describe a chamber pressure that follows a straight line throughout, without noise; None if there is none.

    A pressure that is constant or has at most 64 samples is skipped, as in `describe_hold`.
    """
    for name in chambers_of(recording):
        values = recording[name]
        if len(values) <= _HOLD.samples or is_constant(values):
            continue
        if np.abs(np.diff(values, 2)).max() <= ROUNDING * np.abs(values).max():
            return f"{name} moves along a straight line only, as if its samples were interpolated"
    return None


def find_runs(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Find the runs of True in `flags` (n,): first index and length of each (k, 2)."""
    padded = np.zeros(len(flags) + 2, dtype=bool)
    padded[1:-1] = flags
    edges = np.flatnonzero(padded[1:] != padded[:-1])  # starts and ends in turn
    return np.column_stack([edges[::2], edges[1::2] - edges[::2]])


def find_stuck(values: Array) -> NDArray[np.intp]:
    """Find runs of equal values that are too long for the signal around them: first index and length of each (k, 2).

    Let p be the fraction of samples that equal the previous one, among the 100 samples before or the 100 after the run,
    whichever is larger. By chance, a run of m equal samples begins at a given sample with the probability p^(m-1). A
    run is too long if fewer than 1e-6 such runs are expected in `values` (n,), all finite, and if the value jumps by
    more than 3.5 quantisation steps at one of its ends. The jump excludes a slow quantised signal, which changes in
    single steps. Runs of fewer than 5 samples, runs within 20 samples of an end of the channel, and runs in a channel
    of fewer than 200 samples are not found.
    """
    no_runs = np.empty((0, 2), dtype=np.intp)
    if values.size < 2 * _NEIGHBOURHOOD:
        return no_runs
    is_same = values[1:] == values[:-1]
    runs = find_runs(is_same)  # each is one shorter than the run of equal values
    runs = runs[runs[:, 1] >= _MIN_STUCK - 1]
    first, last = runs[:, 0], runs.sum(axis=1)  # the samples first..last are equal
    # runs near an end of the recording have too few neighbours
    inner = (first >= _NEIGHBOURHOOD // 5) & (last < values.size - 1 - _NEIGHBOURHOOD // 5)
    runs, first, last = runs[inner], first[inner], last[inner]
    if not runs.size:
        return no_runs
    n_unchanged = np.r_[0, np.cumsum(is_same)]

    def unchanged_fraction(begin: NDArray[Any], end: NDArray[Any]) -> Array:
        """Estimate the fraction of samples that equal the previous one in each range (k,) by the rule of succession."""
        begin, end = np.maximum(begin, 0), np.minimum(end, is_same.size)
        return np.asarray((n_unchanged[end] - n_unchanged[begin] + 1) / (end - begin + 2), dtype=np.float64)

    p_unchanged = np.maximum(
        unchanged_fraction(first - _NEIGHBOURHOOD, first), unchanged_fraction(last, last + _NEIGHBOURHOOD)
    )
    log_expected = np.log(values.size) + runs[:, 1] * np.log(p_unchanged)
    jump = np.maximum(np.abs(values[first] - values[first - 1]), np.abs(values[last + 1] - values[last]))
    is_stuck = (log_expected < np.log(_MAX_EXPECTED)) & (jump > 0.0)
    if is_stuck.any():
        is_stuck &= jump > _MIN_JUMP * smallest_step(np.unique(values))
    return np.column_stack([first[is_stuck], runs[is_stuck, 1] + 1])
