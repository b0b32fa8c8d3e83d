"""Live signals block by block, in bounded memory: their stationary details, and the windowed RMS of a fleet's.

One call takes a block of all signals, and nothing is allocated for it but views. Eight signals share a vector register
(`kernels`), so that small blocks cost little more than large ones. Results depend on the samples alone, never on how
they were cut into blocks.
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.filters import (
    Array,
    checked_levels,
    decomposition_filters,
    reach,
    whole_number,
)
from sealscope.storage.plain_state import count_of, numbers_of, part_of

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor


class DetailStream:
    """Stationary wavelet details of live signals, block by block.

    The streaming counterpart of ``details(..., transform="stationary")``, with which the values agree to rounding. A
    causal filter can give level j of a sample only ``(L/2)(2^j - 1)`` samples later (db8: 8, 24, 56, 120). All levels
    are given with the delay of the deepest one, so that a column holds the levels of one sample: column i of everything
    given so far is the detail of sample ``i - delay``. The first `settling` columns still see the zeros before the
    beginning; the first column after them is that of sample `first`.

    Parameters
    ----------
    channels : int or tuple of int, default 1
        Number of signals, or rows and columns of a table of signals, such as ``(2, 100)`` for the two chambers of 100
        actuators.
    levels : int, default 4
        Number of levels.
    wavelet : str, default "db8"
        A discrete wavelet of PyWavelets.
    threads : int, default 1
        Groups of eight signals are shared out over so many threads; no bit depends on it.

    Attributes
    ----------
    delay, first, settling : int
        By how many samples the details lag the signal (db8 to level 4: 120), the first sample whose details see nothing
        but the signal (105), and how many columns to drop at the beginning, ``first + delay`` (225).
    samples : int
        How many samples of each signal have come in.

    Raises
    ------
    InputError
        For less than one signal, and for levels or a wavelet that `details` refuses.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> signal = np.sin(np.arange(1000) / 5.0)
    >>> stream = ss.DetailStream()
    >>> blocks = [stream.update(signal[start : start + 250]) for start in range(0, 1000, 250)]
    >>> d = np.concatenate(blocks, axis=-1)[:, stream.settling :]
    >>> d.shape
    (4, 775)
    """

    def __init__(
        self, channels: int | tuple[int, int] = 1, levels: int = 4, *, wavelet: str = "db8", threads: int = 1
    ) -> None:
        from sealscope.physics.lanes import WIDTH
        from sealscope.signals.kernels import CHUNK

        table = channels if isinstance(channels, tuple) else (1, channels)
        if len(table) != 2:
            raise InputError(f"channels must be a number or rows and columns of a table, got {channels}")
        self._table = whole_number(table[0], "channels"), whole_number(table[1], "channels")
        self.channels = self._table if isinstance(channels, tuple) else self._table[1]
        self.levels, self.wavelet, self.threads = checked_levels(levels), wavelet, whole_number(threads, "threads")
        low, high = (np.repeat(taps[:, None], WIDTH, axis=1) for taps in decomposition_filters(wavelet))
        self.first, self.delay = (int(samples) for samples in reach(wavelet, self.levels)[-1])
        self.settling = self.first + self.delay
        holes = 2 ** np.arange(self.levels)
        late = len(low) // 2 * (2**self.levels - 2 * holes)
        self._history = max(self.delay, int(np.max(late + (len(low) - 1) * holes)))
        groups = -(-self._table[1] // WIDTH)
        # the kernels take taps (taps, WIDTH) of low- and high-pass, and the levels' buffers (groups, rows of the table,
        # levels, history and CHUNK, WIDTH)
        self.taps = low, high
        self.buffers = aligned_zeros((groups, self._table[0], self.levels, self._history + CHUNK, WIDTH))
        self._fill, self.samples = self._history, 0
        shares = min(self.threads, groups)
        self._shares = list(pairwise(groups * i // shares for i in range(shares + 1)))
        self._work = [aligned_zeros((self.levels, CHUNK, WIDTH)) for _ in self._shares]

    def update(self, block: ArrayLike, out: Array | None = None) -> Array:
        """Take the next block and return its details.

        Parameters
        ----------
        block : array_like
            Samples (channels, n), or (n,) of a single signal; n may be 0. A missing sample (NaN) affects its own signal
            alone, for `settling` columns after it.
        out : ndarray, optional
            C-contiguous doubles to write into, in the shape of what is returned. For a block of C-contiguous doubles
            nothing else is allocated.

        Returns
        -------
        ndarray
            Details (channels, levels, n), or (levels, n) for a block (n,); row 0 is d_1.

        Raises
        ------
        InputError
            For a block or an `out` of a wrong shape.
        """
        from sealscope.signals.kernels import advance_details

        shape = self.channels if isinstance(self.channels, tuple) else (self.channels,)
        single = shape == (1,) and np.ndim(block) == 1
        if not single and (np.ndim(block) == 0 or np.shape(block)[:-1] != shape):
            sizes = "" if shape == (1,) else "".join(f"{size}, " for size in shape)
            raise InputError(f"block must have shape ({sizes or 'n,'}{'n' if sizes else ''}), got {np.shape(block)}")
        n = np.shape(block)[-1]
        x = np.ascontiguousarray(block, dtype=np.float64).reshape(*self._table, n).view()
        x.setflags(write=False)  # one type for what is read, whether the caller's array may be written or not
        out_shape = (*np.shape(block)[:-1], self.levels, n)
        if out is None:
            out = np.empty(out_shape)
        elif not (
            out.shape == out_shape and out.dtype == np.float64 and out.flags.c_contiguous and out.flags.writeable
        ):
            raise InputError(
                f"out must be C-contiguous, writeable doubles of shape {out_shape}, got {out.dtype} {out.shape}"
            )
        if n == 0:
            return out
        target = out.reshape(*self._table, self.levels, n)

        def advance(share: tuple[int, int], work: Array) -> int:
            return advance_details(share, x, self.buffers, self._fill, self._history, *self.taps, work, target)

        run = map if len(self._shares) == 1 else self._pool.map
        self._fill = max(run(advance, self._shares, self._work))
        self.samples += n
        return out

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        from concurrent.futures import ThreadPoolExecutor

        return ThreadPoolExecutor(len(self._shares))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the stream: settings, number of samples, and the `history` to filter with."""
        history = np.moveaxis(self.buffers[:, :, :, self._fill - self._history : self._fill], 0, -2)
        return {
            "channels": self.channels,
            "levels": self.levels,
            "wavelet": self.wavelet,
            "samples": self.samples,
            "history": history.reshape(*history.shape[:-2], -1)[..., : self._table[1]].copy(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], *, threads: int = 1) -> DetailStream:
        """Continue the stream that `state_dict` described, bit for bit; raise InputError for a wrong state."""
        channels, levels, wavelet = (part_of(state, name, object) for name in ("channels", "levels", "wavelet"))
        table = tuple(channels) if isinstance(channels, list) else channels
        stream = cls(table, levels, wavelet=wavelet, threads=threads)
        shape = (stream._table[0], stream.levels, stream._history, stream._table[1])
        history = numbers_of(state, "history", shape)
        stream.samples = count_of(state, "samples")
        groups, width = stream.buffers.shape[0], stream.buffers.shape[-1]
        lanes = np.pad(history, [(0, 0)] * 3 + [(0, groups * width - shape[-1])]).reshape(*shape[:3], groups, width)
        stream.buffers[:, :, :, : stream._history] = np.moveaxis(lanes, -2, 0)
        return stream


def aligned_zeros(shape: tuple[int, ...]) -> Array:
    """Make an array of zeros that begins at a cache line, so that no row of lanes lies on two."""
    values = np.zeros(math.prod(shape) + 8)
    skip = -(values.ctypes.data // 8) % 8
    return values[skip : skip + math.prod(shape)].reshape(shape)
