"""Compiled wavelet filters for many signals, live or simulated, of which eight share a vector register.

Each output sums its taps in the same order, whether it is computed together with seven neighbours or alone. Blocks of
any size give identical results. As multiply-adds are fused, they agree with `details.details` up to rounding only.
"""

from __future__ import annotations

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import WIDTH, broadcast, load, store
from sealscope.signals.filters import Array

#: New samples in a level's buffer before its history is moved to the front; so small that the rows that a level's
#: filter reads stay in the first-level cache.
CHUNK = 64


@contracted
def filter_rows(
    rows: Array, first: int, stride: int, dilation: int, taps: Array, tap: int, n_taps: int, out: Array, to: int, n: int
) -> None:
    """Filter eight signals at once: ``out[to + i] = sum_k taps[tap + k] rows[first + stride i - dilation k]``.

    i runs from 0 to n - 1, and k from 0 to n_taps - 1. The indices count rows of eight numbers, one for each signal, in
    `rows`, `taps` and `out`. Successive outputs use rows that are `stride` apart. Successive taps use rows that are
    `dilation` apart, in the other direction if it is negative. Eight outputs are computed at a time, which load each
    tap once, and the rest one by one.
    """
    i = 0
    while i + 8 <= n:
        s_0, s_1, s_2, s_3 = broadcast(0.0), broadcast(0.0), broadcast(0.0), broadcast(0.0)
        s_4, s_5, s_6, s_7 = broadcast(0.0), broadcast(0.0), broadcast(0.0), broadcast(0.0)
        for k in range(n_taps):
            weight = load(taps, tap + k)
            row = first + stride * i - dilation * k
            s_0 = s_0 + weight * load(rows, row)
            s_1 = s_1 + weight * load(rows, row + stride)
            s_2 = s_2 + weight * load(rows, row + 2 * stride)
            s_3 = s_3 + weight * load(rows, row + 3 * stride)
            s_4 = s_4 + weight * load(rows, row + 4 * stride)
            s_5 = s_5 + weight * load(rows, row + 5 * stride)
            s_6 = s_6 + weight * load(rows, row + 6 * stride)
            s_7 = s_7 + weight * load(rows, row + 7 * stride)
        store(out, to + i, s_0)
        store(out, to + i + 1, s_1)
        store(out, to + i + 2, s_2)
        store(out, to + i + 3, s_3)
        store(out, to + i + 4, s_4)
        store(out, to + i + 5, s_5)
        store(out, to + i + 6, s_6)
        store(out, to + i + 7, s_7)
        i += 8
    while i < n:
        s = broadcast(0.0)
        for k in range(n_taps):
            s = s + load(taps, tap + k) * load(rows, first + stride * i - dilation * k)
        store(out, to + i, s)
        i += 1


@contracted
def split_levels(
    buffers: Array, start: int, first: int, n: int, low: Array, high: Array, levels: int, capacity: int, details: Array
) -> None:
    """Compute the wavelet details of `n` <= CHUNK new samples of one channel, such as a pressure, of eight actuators.

    `low`, `high` (taps, WIDTH): low-pass and high-pass filter, repeated for each actuator (or simulated run). A row of
    `buffers` has a number for each. Every level of the channel has a buffer of `capacity` rows, the first one from row
    `start` on; the new samples begin at row `first` of the first buffer, after the history. High-pass filtering of a
    level's buffer gives its detail, and low-pass filtering fills the same rows of the next level's buffer. The finer
    levels, whose filters are shorter, get the delay of the deepest level: row i of all levels in `details` (levels,
    CHUNK, WIDTH) belongs to one sample.
    """
    n_taps = low.shape[0]
    for level in range(levels):
        dilation = 1 << level
        row = start + level * capacity + first
        delay = n_taps // 2 * ((1 << levels) - 2 * dilation)  # (L/2)(2^levels - 2^j) for level j, as 2^j = 2 dilation
        filter_rows(buffers, row - delay, 1, dilation, high, 0, n_taps, details, level * CHUNK, n)
        if level + 1 < levels:
            filter_rows(buffers, row, 1, dilation, low, 0, n_taps, buffers, row + capacity, n)


@contracted
def move_history(buffers: Array, start: int, levels: int, capacity: int, fill: int, history: int) -> None:
    """Move the last `history` of the `fill` used rows to the front of each buffer of one channel, to make room.

    The channel has one buffer of `capacity` rows for each of `levels` levels, one after the other from row `start` on.
    """
    for level in range(levels):
        row = start + level * capacity
        for i in range(history):  # rising, as the old and the new rows may overlap
            store(buffers, row + i, load(buffers, row + fill - history + i))


@kernel
def advance_details(
    groups: tuple[int, int],
    block: Array,
    buffers: Array,
    fill: int,
    history: int,
    low: Array,
    high: Array,
    details: Array,
    out: Array,
) -> int:
    """Compute the wavelet details of the next block of samples, for some groups of eight actuators (WIDTH).

    `groups`: (first, last + 1) of the groups to filter; `block` (channels, actuators, n): samples of all actuators;
    `out` (channels, actuators, levels, n): receives the details. `buffers` (groups, channels, levels, capacity, WIDTH)
    have `fill` rows in use, the last `history` of which are needed for later outputs. `low`, `high` (taps, WIDTH):
    low-pass and high-pass filter; `details` (levels, CHUNK, WIDTH): work array. Returns the number of rows that are in
    use in each buffer afterwards.
    """
    channels, actuators, n = block.shape
    levels, capacity = buffers.shape[2], buffers.shape[3]
    flat_details, flat_buffers = details.reshape(-1), buffers.reshape(-1)
    filled = fill  # used rows of the current channel's buffers; all channels end with the same number
    for g in range(groups[0], groups[1]):
        lanes = min(WIDTH, actuators - WIDTH * g)  # actuators of the group; the last group may have fewer
        for c in range(channels):
            start = (g * channels + c) * levels * capacity
            filled, n_done = fill, 0
            while n_done < n:
                if filled == capacity:
                    move_history(buffers, start, levels, capacity, filled, history)
                    filled = history
                n_new = min(n - n_done, capacity - filled)
                for lane in range(lanes):
                    for i in range(n_new):
                        flat_buffers[(start + filled + i) * WIDTH + lane] = block[c, WIDTH * g + lane, n_done + i]
                split_levels(buffers, start, filled, n_new, low, high, levels, capacity, details)
                for lane in range(lanes):
                    for level in range(levels):
                        for i in range(n_new):
                            detail = flat_details[(level * CHUNK + i) * WIDTH + lane]
                            out[c, WIDTH * g + lane, level, n_done + i] = detail
                filled += n_new
                n_done += n_new
    return filled
