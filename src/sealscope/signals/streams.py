"""Stationary wavelet details of live signals, block by block and in bounded memory.

One call filters a block of all signals and, given an array for the result, allocates nothing but views. Eight signals
share a vector register (`kernels`), so that small blocks cost little more than large ones. Results do not depend on the
division into blocks.
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.filters import Array, decomposition_filters, reach, require_levels, require_whole
from sealscope.storage.plain_state import require_count, require_numbers, require_part

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor


class DetailStream:
    """Stationary wavelet details of live signals, block by block.

    The results equal those of ``details(..., transform="stationary")`` to rounding. A causal filter with L taps knows
    level j of a sample only ``(L/2)(2^j - 1)`` samples later (db8: 8, 24, 56, 120). All levels are returned with the
    delay of the deepest one, so that a column has all levels of one sample: column i, counted from the beginning of the
    stream, is the detail of sample ``i - delay``. The first `settling` columns depend on zeros before the beginning.

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
        Number of threads for the groups of eight signals; it does not change the results.

    Attributes
    ----------
    delay : int
        Lag of the details behind the signal [samples], 120 for db8 to level 4.
    first : int
        Number of the first sample whose details depend only on the signal, 105 for db8 to level 4.
    settling : int
        Number of columns to drop at the beginning, ``first + delay``.
    samples : int
        Number of samples of each signal so far.

    Raises
    ------
    InputError
        For less than one signal, and for invalid levels or an invalid wavelet.

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
        """Prepare the filters and the buffers of all signals; the class describes the parameters."""
        from sealscope.physics.lanes import WIDTH
        from sealscope.signals.kernels import CHUNK

        table = channels if isinstance(channels, tuple) else (1, channels)
        if len(table) != 2:
            raise InputError(f"channels must be a number or rows and columns of a table, got {channels}")
        self._shape_2d = require_whole(table[0], "channels"), require_whole(table[1], "channels")
        self.channels = self._shape_2d if isinstance(channels, tuple) else self._shape_2d[1]
        self.levels = require_levels(levels)
        self.wavelet = wavelet
        self.threads = require_whole(threads, "threads")
        low, high = (np.repeat(taps[:, None], WIDTH, axis=1) for taps in decomposition_filters(wavelet))
        self.first, self.delay = (int(samples) for samples in reach(wavelet, self.levels)[-1])  # deepest level
        self.settling = self.first + self.delay
        # number of earlier samples that the filters need: most for level 1, whose L taps begin (L/2)(2^levels - 2)
        # samples back, as it waits for the deepest level
        self._history = len(low) // 2 * 2**self.levels - 1
        groups = -(-self._shape_2d[1] // WIDTH)  # rounded up
        self.taps = low, high  # each (taps, WIDTH), as the kernels take them
        # (groups, rows of the table, levels, samples, WIDTH)
        self.buffers = aligned_zeros((groups, self._shape_2d[0], self.levels, self._history + CHUNK, WIDTH))
        self._fill = self._history  # number of used rows in the buffers
        self.samples = 0
        n_parts = min(self.threads, groups)
        # (first, last + 1) of the groups of signals that each thread filters
        self._parts = list(pairwise(groups * i // n_parts for i in range(n_parts + 1)))
        self._workspaces = [aligned_zeros((self.levels, CHUNK, WIDTH)) for _ in self._parts]

    def update(self, block: ArrayLike, out: Array | None = None) -> Array:
        """Filter the next block of samples and return its wavelet details.

        Parameters
        ----------
        block : array_like
            Samples (channels, n), or (n,) of a single signal; n may be 0. A missing sample (NaN) affects only its own
            signal: its column of the result, and at most the next `settling` ones.
        out : ndarray, optional
            Array to write the result into: C-contiguous doubles in the shape of the result. If the block is of
            C-contiguous doubles, too, no other memory is allocated.

        Returns
        -------
        ndarray
            Details (channels, levels, n), or (levels, n) for a block (n,); row 0 is d_1.

        Raises
        ------
        InputError
            For a block of a wrong shape, or an unsuitable `out`.
        """
        from sealscope.signals.kernels import advance_details

        shape = self.channels if isinstance(self.channels, tuple) else (self.channels,)
        is_single_signal = shape == (1,) and np.ndim(block) == 1
        if not is_single_signal and (np.ndim(block) == 0 or np.shape(block)[:-1] != shape):
            expected = "n," if shape == (1,) else "".join(f"{size}, " for size in shape) + "n"
            raise InputError(f"block must have shape ({expected}), got {np.shape(block)}")
        n = np.shape(block)[-1]
        x = np.ascontiguousarray(block, dtype=np.float64).reshape(*self._shape_2d, n).view()
        x.setflags(write=False)  # so that the kernel is compiled for one type; a view, as the block may stay writeable
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
        target = out.reshape(*self._shape_2d, self.levels, n)

        def filter_part(part: tuple[int, int], work: Array) -> int:
            """Filter the groups of signals in `part` = (first, last + 1); return the number of buffer rows then in use.

            `work` (levels, CHUNK, WIDTH): work array, which only this part uses.
            """
            return advance_details(part, x, self.buffers, self._fill, self._history, *self.taps, work, target)

        run = map if len(self._parts) == 1 else self._pool.map
        self._fill = max(run(filter_part, self._parts, self._workspaces))  # the same number for all parts
        self.samples += n
        return out

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        """Pool of threads with which `update` filters a block, one for each part of the signals."""
        from concurrent.futures import ThreadPoolExecutor

        return ThreadPoolExecutor(len(self._parts))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the stream as plain values and arrays, from which `from_state` continues.

        Its `history` (rows, levels, samples, columns) has the last inputs of the filters of each level. Rows and
        columns are those of the table of signals (`channels`); signals that are not in a table form one row.
        """
        # the buffers hold the columns in groups (first axis) of WIDTH columns (last axis): bring both axes together
        history = np.moveaxis(self.buffers[:, :, :, self._fill - self._history : self._fill], 0, -2)
        return {
            "channels": self.channels,
            "levels": self.levels,
            "wavelet": self.wavelet,
            "samples": self.samples,
            "history": history.reshape(*history.shape[:-2], -1)[..., : self._shape_2d[1]].copy(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], *, threads: int = 1) -> DetailStream:
        """Make a stream that continues from a saved `state_dict`; raise InputError if the state is not valid.

        `threads`: number of threads, which may differ from that of the saved stream.
        """
        # `object`: of any type, as the constructor checks them
        channels, levels, wavelet = (require_part(state, name, object) for name in ("channels", "levels", "wavelet"))
        channels = tuple(channels) if isinstance(channels, list) else channels  # JSON has no tuples
        stream = cls(channels, levels, wavelet=wavelet, threads=threads)
        shape = (stream._shape_2d[0], stream.levels, stream._history, stream._shape_2d[1])
        history = require_numbers(state, "history", shape)
        stream.samples = require_count(state, "samples")
        groups, width = stream.buffers.shape[0], stream.buffers.shape[-1]
        # divide the signals of a row (last axis) into groups of `width`, after filling up the last group with zeros
        lanes = np.pad(history, [(0, 0)] * 3 + [(0, groups * width - shape[-1])]).reshape(*shape[:3], groups, width)
        # in a new stream the history is at the front
        stream.buffers[:, :, :, : stream._history] = np.moveaxis(lanes, -2, 0)
        return stream


def aligned_zeros(shape: tuple[int, ...]) -> Array:
    """Make an array of zeros that begins at a cache line (64 bytes), so that each row of 8 doubles lies in one line."""
    values = np.zeros(math.prod(shape) + 8)  # 8 doubles of 8 bytes are one cache line
    skip = -(values.ctypes.data // 8) % 8  # doubles before the next cache line
    return values[skip : skip + math.prod(shape)].reshape(shape)
