"""RMS over sliding windows, of a complete series and of a stream, with identical results.

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
from sealscope.signals.details import Details
from sealscope.signals.filters import Array, IntArray, require_finite, require_whole
from sealscope.storage.plain_state import require_count, require_numbers, require_part

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
    return RmsStream(size, step, first=first).update(require_finite(series, "series"))


class RmsStream:
    """RMS over sliding windows of live series; identical to `windowed_rms`, for blocks of any size.

    For the output of a `DetailStream`, pass its `settling` as `skip` and its `first` as `first`. The result then has
    the same windows as ``windowed_rms(details)``. A value that is not finite affects only the windows that contain it.

    Parameters
    ----------
    size, step : int
        Number of samples in a window, and from the start of one window to the start of the next.
    skip : int, default 0
        Number of values to omit at the beginning of the stream.
    first : int, default 0
        Sample number of the first value that is used.

    Raises
    ------
    InputError
        For a size or a step below 1, or a negative skip.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> stream = ss.RmsStream(100, 50)
    >>> windows = stream.update(np.ones(120))
    >>> windows.ends.tolist(), windows.rms.tolist()
    ([100], [1.0])
    """

    def __init__(self, size: int = WINDOW_SIZE, step: int = WINDOW_STEP, *, skip: int = 0, first: int = 0) -> None:
        """Begin a stream without samples; the class describes the parameters."""
        self.size = require_whole(size, "size", unit=" sample")
        self.step = require_whole(step, "step", unit=" sample")
        self._piece = math.gcd(self.size, self.step)  # samples in a piece; windows consist of whole pieces
        self._skip = require_whole(skip, "skip", 0, " samples")  # samples still to be dropped at the beginning
        self._next_end = int(first) + self.size  # sample number just after the next window
        self._rest: Array | None = None  # samples of an incomplete piece, (..., fewer than piece)
        self._sums: Array | None = None  # sums of squares of the pieces that coming windows need, (..., pieces)
        self._n_unused = 0  # number of coming pieces before the next window (if step > size)

    def update(self, block: ArrayLike) -> WindowedRms:
        """Add the next block of samples and return the RMS of the windows that it completes.

        Parameters
        ----------
        block : array_like
            Values (..., n); the leading axes must have the same lengths in all blocks.

        Returns
        -------
        WindowedRms
            `ends` (w,), the number of the sample just after each window, and `rms` (..., w); w may be 0.

        Raises
        ------
        InputError
            If the block is a single number, or its leading axes differ from those of the first block.
        """
        x = np.asarray(block, dtype=np.float64)
        if x.ndim == 0:
            raise InputError("block must be at least one-dimensional, got a single number")
        leading_axes = x.shape[:-1]
        if self._rest is None or self._sums is None:
            self._rest = self._sums = np.empty((*leading_axes, 0))
        if leading_axes != self._rest.shape[:-1]:
            raise InputError(f"block must have leading axes {self._rest.shape[:-1]} as before, got {leading_axes}")
        n_omitted = min(self._skip, x.shape[-1])
        self._skip -= n_omitted
        x = np.concatenate([self._rest, x[..., n_omitted:]], axis=-1)
        n_full = x.shape[-1] // self._piece * self._piece  # samples in whole pieces, of which windows consist
        self._rest = x[..., n_full:].copy()
        sums = np.concatenate([self._sums, _piece_sums(x[..., :n_full], self._piece)], axis=-1)
        values = _rms_of_pieces(sums[..., self._n_unused :], self.size, self.step)
        n_windows = values.shape[-1]
        n_before = self._n_unused + n_windows * (self.step // self._piece)  # pieces before the next window
        self._sums = sums[..., n_before:].copy()
        self._n_unused = max(0, n_before - sums.shape[-1])
        ends = self._next_end + self.step * np.arange(n_windows, dtype=np.int64)
        self._next_end += n_windows * self.step
        return WindowedRms(ends, values)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the stream as numbers, None, and arrays, from which `from_state` continues."""
        return {
            "size": self.size,
            "step": self.step,
            "skip": self._skip,
            "next_end": self._next_end,
            "ahead": self._n_unused,  # the name in states saved so far
            "rest": None if self._rest is None else self._rest.copy(),
            "sums": None if self._sums is None else self._sums.copy(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> RmsStream:
        """Make a stream that continues from a saved `state_dict`; raise InputError if the state is not valid."""
        size, step, rest, sums = (require_part(state, name, object) for name in ("size", "step", "rest", "sums"))
        stream = cls(size, step, skip=require_count(state, "skip"))
        stream._next_end = require_count(state, "next_end")
        stream._n_unused = require_count(state, "ahead")
        if rest is None and sums is None:  # saved before the first block
            return stream
        try:
            rest_shape, sums_shape = np.shape(rest), np.shape(sums)
        except ValueError:  # rows of different lengths
            rest_shape = sums_shape = ()
        if not rest_shape or not sums_shape or rest_shape[:-1] != sums_shape[:-1]:
            raise InputError("saved state must have rest and sums of the same leading axes, got others")
        stream._rest = require_numbers(state, "rest", rest_shape)
        stream._sums = require_numbers(state, "sums", sums_shape)
        return stream


def _piece_sums(x: Array, piece: int) -> Array:
    """Compute the sums of squares (..., n // piece) of the pieces of `piece` samples that make up `x` (..., n)."""
    # contiguous: the order of the additions, and so the rounding, must not depend on the layout of `x`
    in_pieces = np.ascontiguousarray(x).reshape(-1, piece)
    return np.asarray(np.add.reduce(np.square(in_pieces), axis=-1)).reshape(*x.shape[:-1], x.shape[-1] // piece)


def _rms_of_pieces(sums: Array, size: int, step: int) -> Array:
    """Compute the RMS (..., windows) of each complete window of `size` samples; one begins every `step` samples.

    `sums` (..., pieces): sums of squares of consecutive pieces of gcd(size, step) samples. The sums of a window are
    added in their order, so that rounding does not depend on how the series is divided into blocks.
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
