"""RMS over sliding windows, of a whole series and of a stream; both give the same bits.

The transform comes first and the windows are laid over its coefficients (by default 1000 samples, 500 apart:
"Understanding Effect and Diagnosis of Internal Leakage in Hydrostatic Actuation Systems", section 5.2). Squares are
summed over pieces of gcd(size, step) samples, and a window adds its pieces in their order. Nothing is subtracted
again, so a long or drifting series loses no digits as it would with a running sum.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.details import Details
from sealscope.signals.filters import (
    Array,
    IntArray,
    finite_array,
    whole_number,
)
from sealscope.storage.plain_state import count_of, numbers_of, part_of

WINDOW_SIZE = 1000
WINDOW_STEP = 500


class WindowedRms(NamedTuple):
    """RMS per window: `ends` (w,), the sample one past each window's last; `rms` (..., w), in the series' unit.

    A window of `size` covers the samples ends - size .. ends - 1; its centre is at ``(ends - size / 2) / rate``
    seconds.
    """

    ends: IntArray
    rms: Array


def rms(series: ArrayLike) -> Any:
    """Compute ``sqrt(mean(x^2))`` over the last axis [unit of x]; a float for a single series, (...,) for several.

    Raises InputError for an empty series or one that is not finite.
    """
    x = finite_array(series, "series")
    if x.shape[-1] == 0:
        raise InputError("series must have at least 1 sample, got 0")
    value = np.sqrt(np.mean(np.square(x), axis=-1))
    return float(value) if value.ndim == 0 else value


def windowed_rms(
    series: ArrayLike | Details, size: int = WINDOW_SIZE, step: int = WINDOW_STEP, *, first: int = 0
) -> WindowedRms:
    """Compute the RMS of each window of `size` samples, every `step` samples, over the last axis of (..., n).

    `first` is the sample number of the series' first value and moves `ends` alone. Of `Details` every level is taken,
    only where no level touches the padding, and `ends` counts samples of the signal. A series shorter than one window
    gives no window.

    Raises InputError for a series that is not finite, and for a size or a step below 1.
    """
    if isinstance(series, Details):
        inside = series.inside()
        return windowed_rms(series.values[:, inside], size, step, first=first + inside.start)
    return RmsStream(size, step, first=first).update(finite_array(series, "series"))


class RmsStream:
    """RMS over sliding windows of live series: the windows of `windowed_rms`, bit for bit, from blocks of any size.

    Behind a `DetailStream` take its `settling` and `first`: the windows are then those of ``windowed_rms(details)``. A
    value that is not finite spoils the windows it lies in and no other.

    Parameters
    ----------
    size, step : int
        Samples of a window, and from one window to the next.
    skip : int, default 0
        How many values at the beginning of the stream to leave out.
    first : int, default 0
        Sample number of the first value that is kept.

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
        self.size, self.step = whole_number(size, "size", " sample"), whole_number(step, "step", " sample")
        if isinstance(skip, bool) or not isinstance(skip, (int, np.integer)) or skip < 0:
            raise InputError(f"skip must be a whole number >= 0 samples, got {skip!r}")
        self._piece = math.gcd(self.size, self.step)
        self._skip, self._next_end = int(skip), int(first) + self.size
        self._rest: Array | None = None  # samples of the piece that is not full yet, (..., fewer than piece)
        self._sums: Array | None = None  # sums of squares of the pieces that later windows still need, (..., pieces)
        self._ahead = 0  # pieces that no window needs (step > size), still to be passed over

    def update(self, block: ArrayLike) -> WindowedRms:
        """Take the next block and return the windows that it completes, possibly none.

        Parameters
        ----------
        block : array_like
            Values (..., n); the leading axes are those of the first block.

        Returns
        -------
        WindowedRms
            Their `ends` (w,), the sample one past each window's last, and `rms` (..., w).

        Raises
        ------
        InputError
            When the leading axes differ from the first block's.
        """
        x = np.asarray(block, dtype=np.float64)
        if x.ndim == 0:
            raise InputError("block must be at least one-dimensional, got a single number")
        lead = x.shape[:-1]
        if self._rest is None or self._sums is None:
            self._rest = self._sums = np.empty((*lead, 0))
        if lead != self._rest.shape[:-1]:
            raise InputError(f"block must have leading axes {self._rest.shape[:-1]} as before, got {lead}")
        passed = min(self._skip, x.shape[-1])
        self._skip -= passed
        x = np.concatenate([self._rest, x[..., passed:]], axis=-1)
        full = x.shape[-1] // self._piece * self._piece
        self._rest = x[..., full:].copy()
        sums = np.concatenate([self._sums, _piece_sums(x[..., :full], self._piece)], axis=-1)
        passed = min(self._ahead, sums.shape[-1])
        self._ahead -= passed
        sums = sums[..., passed:]
        values = _rms_of_pieces(sums, self.size, self.step)
        windows = values.shape[-1]
        used = windows * (self.step // self._piece)
        self._ahead += max(0, used - sums.shape[-1])
        self._sums = sums[..., used:].copy()
        ends = self._next_end + self.step * np.arange(windows, dtype=np.int64)
        self._next_end += windows * self.step
        return WindowedRms(ends, values)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the stream as numbers and arrays; `from_state` continues from it."""
        return {
            "size": self.size,
            "step": self.step,
            "skip": self._skip,
            "next_end": self._next_end,
            "ahead": self._ahead,
            "rest": None if self._rest is None else self._rest.copy(),
            "sums": None if self._sums is None else self._sums.copy(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> RmsStream:
        """Continue the stream that `state_dict` described; raise InputError for a wrong state."""
        size, step, rest, sums = (part_of(state, name, object) for name in ("size", "step", "rest", "sums"))
        stream = cls(size, step, skip=count_of(state, "skip"))
        stream._next_end, stream._ahead = count_of(state, "next_end"), count_of(state, "ahead")
        if rest is None and sums is None:
            return stream
        lead = np.shape(rest)[:-1]
        if rest is None or sums is None or lead != np.shape(sums)[:-1]:
            raise InputError("saved state must have rest and sums of the same leading axes, got others")
        stream._rest = numbers_of(state, "rest", np.shape(rest))
        stream._sums = numbers_of(state, "sums", np.shape(sums))
        return stream


def _piece_sums(x: Array, piece: int) -> Array:
    """Compute the sum of squares of each full piece, (..., n // piece), pairwise along a contiguous row."""
    pieces = x.shape[-1] // piece
    pieces_of_x = np.ascontiguousarray(x[..., : pieces * piece])
    return np.asarray(np.add.reduce(np.square(pieces_of_x.reshape(-1, piece)), axis=-1)).reshape(*x.shape[:-1], pieces)


def _rms_of_pieces(sums: Array, size: int, step: int) -> Array:
    """Compute the RMS of each whole window from its pieces' sums of squares (..., pieces), added in their order."""
    piece = math.gcd(size, step)
    per_window, per_step = size // piece, step // piece
    windows = max(0, (sums.shape[-1] - per_window) // per_step + 1)
    total = np.zeros((*sums.shape[:-1], windows))
    if windows:
        for i in range(per_window):
            total += sums[..., i : i + (windows - 1) * per_step + 1 : per_step]
    return np.asarray(np.sqrt(total / size))
