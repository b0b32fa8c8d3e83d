"""The stationary details of live channels, block by block, from one compiled filter kernel.

The sums run in one fixed order for every sample, without contraction, so any split of a signal into blocks gives the
same bits. PyWavelets, behind `details.details`, may order its sums otherwise: there the values agree to rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sealscope.compiled import kernel, law
from sealscope.errors import InputError
from sealscope.signals.filters import Array, checked_levels, decomposition_filters, reach

#: New samples that a level's buffer takes before its history moves back to the front: large enough to make that rare,
#: small enough that the four buffers of a channel stay in the processor's first cache.
_CHUNK = 512


@law
def _filter(taps: Array, source: Array, start: int, hole: int, out: Array) -> None:
    """``out[i] = sum_k taps[k] source[start + i - hole k]``, k ascending; four taps a pass, to vectorise."""
    m = out.shape[0]
    for i in range(m):
        out[i] = 0.0
    k = 0
    while k + 4 <= taps.shape[0]:
        t_0, t_1, t_2, t_3 = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        a = start - k * hole
        s_0 = source[a : a + m]
        a -= hole
        s_1 = source[a : a + m]
        a -= hole
        s_2 = source[a : a + m]
        a -= hole
        s_3 = source[a : a + m]
        for i in range(m):
            out[i] = (((out[i] + t_0 * s_0[i]) + t_1 * s_1[i]) + t_2 * s_2[i]) + t_3 * s_3[i]
        k += 4
    while k < taps.shape[0]:
        t = taps[k]
        a = start - k * hole
        s = source[a : a + m]
        for i in range(m):
            out[i] += t * s[i]
        k += 1


@kernel
def _advance(block: Array, buffers: Array, fill: int, history: int, low: Array, high: Array, out: Array) -> int:
    """Filter `block` (channels, n) into `out` (channels, levels, n); returns the buffers' new fill.

    `buffers`: (channels, levels, capacity), row j the a_j of the latest samples, of which `fill` are in use and the
    last `history` are needed again. The details of the shallower levels are read late, so that all levels of a column
    belong to one sample of the signal.
    """
    channels, n = block.shape
    levels, capacity = buffers.shape[1], buffers.shape[2]
    half = low.shape[0] // 2
    at = fill
    for c in range(channels):
        at = fill
        done = 0
        while done < n:
            if at == capacity:
                for j in range(levels):
                    row = buffers[c, j]
                    for i in range(history):
                        row[i] = row[capacity - history + i]
                at = history
            m = min(n - done, capacity - at)
            buffers[c, 0, at : at + m] = block[c, done : done + m]
            for j in range(levels):
                hole = 2**j
                late = half * (2**levels - 2 * hole)
                _filter(high, buffers[c, j], at - late, hole, out[c, j, done : done + m])
                if j + 1 < levels:
                    _filter(low, buffers[c, j], at, hole, buffers[c, j + 1, at : at + m])
            at += m
            done += m
    return at


class DetailStream:
    """The streaming twin of ``details(..., transform="stationary")`` for `channels` signals in step.

    A causal filter can give level j of a sample only ``(L/2)(2^j - 1)`` samples later (db8: 8, 24, 56, 120). All
    levels are given with the delay of the deepest one, so that a column holds the levels of one sample and d3*d4 is
    right: column i of everything given so far is the detail of sample ``i - delay``. The first `settling` columns
    still see the zeros before the beginning; the first column after them is that of sample `first`. A missing sample
    (NaN) spoils its own column and the `settling` ones after it, no more.
    """

    def __init__(self, channels: int = 1, levels: int = 4, *, wavelet: str = "db8") -> None:
        """Raises InputError for less than one channel, and for levels or a wavelet that `details` refuses."""
        if isinstance(channels, bool) or not isinstance(channels, (int, np.integer)) or channels < 1:
            raise InputError(f"channels must be a whole number >= 1, got {channels!r}")
        self.channels, self.levels, self.wavelet = int(channels), checked_levels(levels), wavelet
        self._low, self._high = decomposition_filters(wavelet)
        before, after = reach(wavelet, self.levels)[-1]
        self._first, self._delay = int(before), int(after)
        holes = 2 ** np.arange(self.levels)
        late = self._low.size // 2 * (2**self.levels - 2 * holes)
        self._history = int(np.max(late + (self._low.size - 1) * holes))
        self._buffers = np.zeros((self.channels, self.levels, self._history + max(_CHUNK, self._history)))
        self._fill = self._history
        self._samples = 0

    @property
    def delay(self) -> int:
        """By how many samples the details lag the signal; 120 for db8 to level 4."""
        return self._delay

    @property
    def first(self) -> int:
        """The first sample of the signal whose details see nothing but the signal; 105 for db8 to level 4."""
        return self._first

    @property
    def settling(self) -> int:
        """How many columns to drop at the beginning, ``first + delay``; 225 for db8 to level 4."""
        return self._first + self._delay

    @property
    def samples(self) -> int:
        """How many samples of each channel have come in."""
        return self._samples

    def update(self, block: ArrayLike, out: Array | None = None) -> Array:
        """The next block's details: (n,) gives (levels, n), (channels, n) gives (channels, levels, n); n may be 0.

        Written into `out` where one is given (C-contiguous doubles of that shape), else into a new array; nothing
        else is allocated for a block of C-contiguous doubles. Row 0 is d_1. Raises InputError for a wrong shape.
        """
        x = np.ascontiguousarray(block, dtype=np.float64)
        single = np.ndim(block) == 1
        wanted = "(n,)" if self.channels == 1 else f"({self.channels}, n)"
        if (single and self.channels != 1) or (not single and (x.ndim != 2 or x.shape[0] != self.channels)):
            raise InputError(f"block must have shape {wanted}, got {np.shape(block)}")
        x = x.reshape(self.channels, -1) if x.size else np.empty((self.channels, 0))
        n = x.shape[1]
        shape = (self.levels, n) if single else (self.channels, self.levels, n)
        if out is None:
            out = np.empty(shape)
        elif not (out.shape == shape and out.dtype == np.float64 and out.flags.c_contiguous and out.flags.writeable):
            raise InputError(
                f"out must be C-contiguous, writeable doubles of shape {shape}, got {out.dtype} {out.shape}"
            )
        if n:
            # one type for what is read, whether the caller's array may be written or not: one compilation
            x = x.view()
            x.setflags(write=False)
            levels_out = out.reshape(self.channels, self.levels, n)
            self._fill = int(_advance(x, self._buffers, self._fill, self._history, self._low, self._high, levels_out))
            self._samples += n
        return out

    def state_dict(self) -> dict[str, Any]:
        """All that the stream knows: settings, samples seen, `history` (channels, levels, h) to filter with."""
        return {
            "channels": self.channels,
            "levels": self.levels,
            "wavelet": self.wavelet,
            "samples": self._samples,
            "history": self._buffers[:, :, self._fill - self._history : self._fill].copy(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> DetailStream:
        """The stream that `state_dict` described, bit for bit; raises InputError for a state that is not one."""
        try:
            stream = cls(int(state["channels"]), int(state["levels"]), wavelet=str(state["wavelet"]))
            samples, history = int(state["samples"]), np.asarray(state["history"], dtype=np.float64)
        except KeyError as missing:
            have = ", ".join(map(str, state)) or "nothing"
            raise InputError(f"saved detail stream must have {missing}, got {have}") from None
        except InputError:
            raise
        except (TypeError, ValueError) as error:
            raise InputError(f"saved detail stream must hold numbers: {error}") from None
        wanted = (stream.channels, stream.levels, stream._history)
        if history.shape != wanted:
            raise InputError(f"saved detail stream's history must have shape {wanted}, got {history.shape}")
        stream._buffers[:, :, : stream._history] = history
        stream._samples = samples
        return stream
