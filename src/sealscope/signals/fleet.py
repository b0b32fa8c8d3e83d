"""Details and windowed RMS of many actuators in step, block by block, in bounded memory.

The fleet's twins of `streaming.DetailStream` and `windows.RmsStream`: a block is (channels, actuators, samples), one
call takes it, and nothing is allocated for it but views. Eight actuators share a vector register (`fleet_lanes`), so
that small blocks cost little more than large ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.filters import Array, IntArray, checked_levels, decomposition_filters, reach
from sealscope.signals.windows import WINDOW_SIZE, WINDOW_STEP, WindowedRms

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor


class FleetDetails:
    """The stationary details of `channels` channels of `actuators` actuators, block by block.

    Column i of everything given so far is the detail of sample ``i - delay`` on every level; the first `settling`
    columns still see the zeros before the beginning (as `streaming.DetailStream`, with which the values agree to
    rounding). A missing sample (NaN) spoils its own actuator and channel alone, for `settling` columns after it.
    `threads`: groups of eight actuators are shared out over so many threads; no bit depends on it.
    """

    def __init__(
        self, actuators: int, channels: int = 2, levels: int = 4, *, wavelet: str = "db8", threads: int = 1
    ) -> None:
        """Raises InputError for a count below 1, and for levels or a wavelet that `details` refuses."""
        from sealscope.physics.lanes import WIDTH
        from sealscope.signals.fleet_lanes import CHUNK

        self.actuators, self.channels = _count(actuators, "actuators"), _count(channels, "channels")
        self.levels, self.wavelet, self.threads = checked_levels(levels), wavelet, _count(threads, "threads")
        self._low, self._high = decomposition_filters(wavelet)
        before, after = (int(one) for one in reach(wavelet, self.levels)[-1])
        self.first, self.delay, self.settling = before, after, before + after
        holes = 2 ** np.arange(self.levels)
        late = self._low.size // 2 * (2**self.levels - 2 * holes)
        self._history = max(after, int(np.max(late + (self._low.size - 1) * holes)))
        groups = -(-self.actuators // WIDTH)
        self._buffers = _aligned((groups, self.channels, self.levels, self._history + CHUNK, WIDTH))
        self._fill, self.samples = self._history, 0
        shares = min(self.threads, groups)
        edges = [groups * i // shares for i in range(shares + 1)]
        self._shares = list(pairwise(edges))
        self._work = [_aligned((self.levels, CHUNK, WIDTH)) for _ in self._shares]

    def update(self, block: ArrayLike, out: Array | None = None) -> Array:
        """The next block's details: (channels, actuators, n) gives (channels, actuators, levels, n); n may be 0.

        Written into `out` where one is given (C-contiguous doubles of that shape), else into a new array. Raises
        InputError for a wrong shape.
        """
        from sealscope.signals.fleet_lanes import advance_details

        x = self.checked(block)
        shape = (self.channels, self.actuators, self.levels, x.shape[-1])
        out = np.empty(shape) if out is None else checked_out(out, shape)
        settings = (x, self._buffers, self._fill, self._history, self._low, self._high)
        self.run(x, lambda share, work: advance_details(share, *settings, work, out))
        return out

    def checked(self, block: ArrayLike) -> Array:
        """A block as C-contiguous doubles that are only read; raises InputError for a wrong shape."""
        x = np.ascontiguousarray(block, dtype=np.float64)
        if x.ndim != 3 or x.shape[:2] != (self.channels, self.actuators):
            raise InputError(f"block must have shape ({self.channels}, {self.actuators}, n), got {np.shape(block)}")
        x = x.view()
        x.setflags(write=False)
        return x

    def run(self, x: Array, call: Callable[[tuple[int, int], Array], int]) -> None:
        """Make `call(groups, work)` for every share of the groups, and count the samples of `x` as taken."""
        if x.shape[-1] == 0:
            return
        if len(self._shares) == 1:
            fill = call(self._shares[0], self._work[0])
        else:
            fill = max(self._pool.map(call, self._shares, self._work))
        self._fill = int(fill)
        self.samples += x.shape[-1]

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        from concurrent.futures import ThreadPoolExecutor

        return ThreadPoolExecutor(len(self._shares))

    def state_dict(self) -> dict[str, Any]:
        """Settings, samples seen, and `history` (channels, levels, h, actuators) to filter with."""
        kept = self._buffers[:, :, :, self._fill - self._history : self._fill]
        return {
            "actuators": self.actuators,
            "channels": self.channels,
            "levels": self.levels,
            "wavelet": self.wavelet,
            "samples": self.samples,
            "history": _unpacked(kept, self.actuators),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` of a stream with the same settings said, bit for bit; raises InputError."""
        for name in ("actuators", "channels", "levels", "wavelet"):
            if _part(state, name) != getattr(self, name):
                raise InputError(f"saved fleet's {name} must be {getattr(self, name)}, got {state[name]}")
        shape = (self.channels, self.levels, self._history, self.actuators)
        history = saved_array(state, "history", shape)
        self._fill, self.samples = self._history, int(_part(state, "samples"))
        _pack(history, self._buffers[:, :, :, : self._history])


class FleetRms:
    """RMS over sliding windows of every detail, of the product of the deepest two, and of the signal, of a fleet.

    The windows are those of ``windowed_rms(details(signal), size, step)``: the first covers samples
    ``first .. first + size - 1``. `quantities`: names of the rows, such as d1, d2, d3, d4, d3d4, signal. A missing
    sample spoils the windows of its own actuator and channel in which its details lie, and no other.
    """

    def __init__(
        self,
        actuators: int,
        channels: int = 2,
        levels: int = 4,
        *,
        size: int = WINDOW_SIZE,
        step: int = WINDOW_STEP,
        wavelet: str = "db8",
        threads: int = 1,
    ) -> None:
        """Raises InputError for a count below 1, fewer than two levels, or a wavelet that `details` refuses."""
        if checked_levels(levels) < 2:
            raise InputError(f"levels must be 2 or more for windows over a fleet, got {levels}")
        self._details = FleetDetails(actuators, channels, levels, wavelet=wavelet, threads=threads)
        self.actuators, self.channels, self.levels = self._details.actuators, self._details.channels, levels
        self.size, self.step = _count(size, "size"), _count(step, "step")
        names = [f"d{j}" for j in range(1, levels + 1)]
        self.quantities = (*names, names[-2] + names[-1], "signal")
        piece = math.gcd(self.size, self.step)
        self._windows = np.array([piece, self.size // piece, self.step // piece], dtype=np.int64)
        groups, _, _, _, width = self._details._buffers.shape
        rows = len(self.quantities)
        self._opened = _aligned((groups, channels, rows, width))
        self._pieces = _aligned((groups, channels, self.size // piece, rows, width))

    @property
    def samples(self) -> int:
        """How many samples of each channel have come in."""
        return self._details.samples

    def _windows_at(self, samples: int) -> int:
        columns = samples - self._details.settling
        return 0 if columns < self.size else (columns - self.size) // self.step + 1

    def windows(self, samples: int) -> int:
        """How many windows the next `samples` samples complete."""
        return self._windows_at(self.samples + samples) - self._windows_at(self.samples)

    def ends(self, samples: int) -> IntArray:
        """Of those windows, the sample one past each one's last."""
        before = self._windows_at(self.samples)
        count = self.windows(samples)
        return self._details.first + self.size + self.step * np.arange(before, before + count, dtype=np.int64)

    def update(self, block: ArrayLike, out: Array | None = None) -> WindowedRms:
        """The windows that `block` (channels, actuators, n) completes: rms (w, channels, quantities, actuators).

        Written into `out` where one is given: C-contiguous doubles of shape (at least w, channels, quantities,
        actuators), of which the first w are returned. Raises InputError for a wrong shape.
        """
        from sealscope.signals.fleet_lanes import advance_rms

        inner = self._details
        x = inner.checked(block)
        n = x.shape[-1]
        count = self.windows(n)
        shape = (count, self.channels, len(self.quantities), self.actuators)
        out = np.empty(shape) if out is None else checked_out(out, shape, at_least=True)
        found = WindowedRms(self.ends(n), out[:count])
        settings = (x, inner._buffers, inner._fill, inner._history, inner._low, inner._high)
        counts = (inner.delay, inner.samples - inner.settling, self._windows, self._opened, self._pieces)
        inner.run(x, lambda share, work: advance_rms(share, *settings, work, *counts, out))
        return found

    def state_dict(self) -> dict[str, Any]:
        """The details' state with `size`, `step`, `opened` and `pieces`: sums of squares so far, actuators last."""
        return {
            **self._details.state_dict(),
            "size": self.size,
            "step": self.step,
            "opened": _unpacked(self._opened, self.actuators),
            "pieces": _unpacked(self._pieces, self.actuators),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` of a stream with the same settings said, bit for bit; raises InputError."""
        for name in ("size", "step"):
            if _part(state, name) != getattr(self, name):
                raise InputError(f"saved fleet's {name} must be {getattr(self, name)}, got {state[name]}")
        parts = {}
        for name, own in (("opened", self._opened), ("pieces", self._pieces)):
            parts[name] = saved_array(state, name, (*own.shape[1:-1], self.actuators))
        self._details.load_state(state)
        _pack(parts["opened"], self._opened)
        _pack(parts["pieces"], self._pieces)


def _aligned(shape: tuple[int, ...]) -> Array:
    """Zeros that begin at a cache line, so that no row of lanes lies on two."""
    values = np.zeros(math.prod(shape) + 8)
    skip = -(values.ctypes.data // 8) % 8
    return values[skip : skip + math.prod(shape)].reshape(shape)


def _count(value: int, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{name} must be a whole number >= 1, got {value!r}")
    return int(value)


def checked_out(out: Array, shape: tuple[int, ...], *, at_least: bool = False) -> Array:
    """`out` itself where it can be written to; raises InputError. `at_least`: its first axis may be longer."""
    given = (shape[0], *out.shape[1:]) if at_least and out.ndim and out.shape[0] >= shape[0] else out.shape
    if not (given == shape and out.dtype == np.float64 and out.flags.c_contiguous and out.flags.writeable):
        raise InputError(f"out must be C-contiguous, writeable doubles of shape {shape}, got {out.dtype} {out.shape}")
    return out


def _part(state: dict[str, Any], name: str) -> Any:
    try:
        return state[name]
    except (KeyError, TypeError):
        raise InputError(f"saved fleet must have {name!r}, got {', '.join(map(str, state)) or 'nothing'}") from None


def saved_array(state: dict[str, Any], name: str, shape: tuple[int, ...], kind: Any = np.float64) -> Any:
    """A part of a saved state as an array of that shape and kind; raises InputError."""
    try:
        found = np.asarray(_part(state, name), dtype=kind)
    except (TypeError, ValueError) as error:
        raise InputError(f"saved fleet's {name} must hold numbers: {error}") from None
    if found.shape != shape:
        raise InputError(f"saved fleet's {name} must have shape {shape}, got {found.shape}")
    return found


def _unpacked(lanes: Array, actuators: int) -> Array:
    """(groups, ..., WIDTH) to (..., actuators)."""
    last = np.moveaxis(lanes, 0, -2)
    return last.reshape(*last.shape[:-2], -1)[..., :actuators].copy()


def _pack(values: Array, lanes: Array) -> None:
    """(..., actuators) into (groups, ..., WIDTH)."""
    groups, width = lanes.shape[0], lanes.shape[-1]
    whole = np.zeros((*values.shape[:-1], groups * width))
    whole[..., : values.shape[-1]] = values
    lanes[...] = np.moveaxis(whole.reshape(*values.shape[:-1], groups, width), -2, 0)
