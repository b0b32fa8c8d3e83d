"""RMS over sliding windows of a series.

The windows lie over the coefficients of the transformed signal (by default 1000 samples, 500 apart: "Understanding
Effect and Diagnosis of Internal Leakage in Hydrostatic Actuation Systems", section 5.2). Squares are summed over pieces
of gcd(size, step) samples, and each window adds its pieces in order. Unlike a running sum, this loses no precision.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.details import Array, Details, IntArray, require_finite, require_whole

WINDOW_SIZE = 1000
WINDOW_STEP = 500


class WindowedRms(NamedTuple):
    """RMS of sliding windows over a series.

    `ends` (w,): number of the sample just after each window; `rms` (..., w): RMS of each window, in the series' unit.
    At the sampling rate `rate` [Hz], a window of `size` samples is centred at ``(ends - size / 2) / rate`` seconds.
    """

    ends: IntArray
    rms: Array


def rms(series: ArrayLike) -> Any:
    """Compute the root mean square ``sqrt(mean(x^2))`` over the last axis of an array (..., n), in its unit.

    Returns a float for a single series. Raises InputError for an empty series or one that is not finite.
    """
    x = require_finite(series, "series")
    if x.shape[-1] == 0:
        raise InputError("series must have at least 1 sample, got 0")
    value = np.sqrt(np.mean(np.square(x), axis=-1))
    return float(value) if value.ndim == 0 else value


def windowed_rms(
    series: ArrayLike | Details, size: int = WINDOW_SIZE, step: int = WINDOW_STEP, *, first: int = 0
) -> WindowedRms:
    """Compute the RMS of a series (..., n) in windows of `size` samples that begin every `step` samples.

    `first` is the number of the first sample, which is added to `ends` of the result. For `Details`, all levels are
    used, samples that depend on padding are left out, and `ends` are sample numbers of the signal. Raises InputError
    for a series that is not finite, and for a size or a step below 1.
    """
    if isinstance(series, Details):
        inside = series.inside()
        return windowed_rms(series.values[:, inside], size, step, first=first + inside.start)
    x = require_finite(series, "series")
    size, step = require_whole(size, "size", unit=" sample"), require_whole(step, "step", unit=" sample")
    piece = math.gcd(size, step)
    values = _rms_of_pieces(_piece_sums(x[..., : x.shape[-1] // piece * piece], piece), size, step)
    return WindowedRms(first + size + step * np.arange(values.shape[-1], dtype=np.int64), values)


def _piece_sums(x: Array, piece: int) -> Array:
    """Compute the sums of squares (..., n // piece) of the pieces of `piece` samples that make up `x` (..., n)."""
    # contiguous: the order of the additions, and so the rounding, must not depend on the layout of `x`
    in_pieces = np.ascontiguousarray(x).reshape(-1, piece)
    return np.asarray(np.add.reduce(np.square(in_pieces), axis=-1)).reshape(*x.shape[:-1], x.shape[-1] // piece)


def _rms_of_pieces(sums: Array, size: int, step: int) -> Array:
    """Compute the RMS (..., windows) of each complete window of `size` samples; one begins every `step` samples.

    `sums` (..., pieces): sums of squares of consecutive pieces of gcd(size, step) samples. The sums of a window are
    added in their order.
    """
    piece = math.gcd(size, step)
    pieces_per_window, pieces_per_step = size // piece, step // piece
    n_windows = max(0, (sums.shape[-1] - pieces_per_window) // pieces_per_step + 1)
    squares = np.zeros((*sums.shape[:-1], n_windows))
    if n_windows:  # the slices below need a window
        for i in range(pieces_per_window):  # add piece i of all windows
            last = i + (n_windows - 1) * pieces_per_step  # index of piece i of the last window
            squares += sums[..., i : last + 1 : pieces_per_step]
    return np.asarray(np.sqrt(squares / size))
