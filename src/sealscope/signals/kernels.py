"""Compiled a trous filters over many signals: eight side by side in a vector register, in one fixed order of sums.

An output's sum runs through its taps in the same order whether it is computed with seven neighbours or alone, so blocks
of any size give the same bits. Products and sums may be contracted (see `physics.lanes`): the values agree with those
of PyWavelets, behind `details.details`, to rounding.
"""

from __future__ import annotations

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import WIDTH, load, spread, store
from sealscope.signals.filters import Array

#: New samples that a level's buffer takes before its history moves back to the front: with it the rows that a level's
#: filter reads stay in the processor's first cache.
CHUNK = 64


@contracted
def filter_rows(
    rows: Array, source: int, stride: int, hole: int, taps: Array, tap: int, count: int, out: Array, to: int, m: int
) -> None:
    """Filter eight signals: ``out[to + i] = sum_k taps[tap + k] rows[source + stride i - hole k]``, i < m, k < count.

    Rows and taps hold a number for each lane; eight rows are filtered at a time.
    """
    i = 0
    while i + 8 <= m:
        s_0, s_1, s_2, s_3 = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
        s_4, s_5, s_6, s_7 = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
        for k in range(count):
            t = load(taps, tap + k)
            a = source + stride * i - hole * k
            s_0 = s_0 + t * load(rows, a)
            s_1 = s_1 + t * load(rows, a + stride)
            s_2 = s_2 + t * load(rows, a + 2 * stride)
            s_3 = s_3 + t * load(rows, a + 3 * stride)
            s_4 = s_4 + t * load(rows, a + 4 * stride)
            s_5 = s_5 + t * load(rows, a + 5 * stride)
            s_6 = s_6 + t * load(rows, a + 6 * stride)
            s_7 = s_7 + t * load(rows, a + 7 * stride)
        b = to + i
        store(out, b, s_0)
        store(out, b + 1, s_1)
        store(out, b + 2, s_2)
        store(out, b + 3, s_3)
        store(out, b + 4, s_4)
        store(out, b + 5, s_5)
        store(out, b + 6, s_6)
        store(out, b + 7, s_7)
        i += 8
    while i < m:
        s = spread(0.0)
        for k in range(count):
            s = s + load(taps, tap + k) * load(rows, source + stride * i - hole * k)
        store(out, to + i, s)
        i += 1


@contracted
def split_levels(
    buffers: Array, start: int, row_in: int, m: int, low: Array, high: Array, levels: int, capacity: int, details: Array
) -> None:
    """Filter m new rows of a channel's first buffer, from row start + row_in on, through all levels into `details`.

    `details`: (levels, CHUNK, WIDTH). Shallower levels are read late, so that a row belongs to one sample.
    """
    count = low.shape[0]
    for j in range(levels):
        hole = 1 << j
        row = start + j * capacity + row_in
        late = count // 2 * ((1 << levels) - 2 * hole)
        filter_rows(buffers, row - late, 1, hole, high, 0, count, details, j * CHUNK, m)
        if j + 1 < levels:
            filter_rows(buffers, row, 1, hole, low, 0, count, buffers, row + capacity, m)


@contracted
def turn_back(buffers: Array, start: int, levels: int, capacity: int, fill: int, history: int) -> None:
    """Move the last `history` of the `fill` rows of each buffer of a channel to the front."""
    for j in range(levels):
        row = start + j * capacity
        for i in range(history):
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
    """Filter `block` (channels, actuators, n) into `out` (channels, actuators, levels, n); returns the new fill.

    `buffers`: (groups, channels, levels, capacity, WIDTH), of whose rows `fill` are in use and the last `history` are
    needed again; `details`: (levels, CHUNK, WIDTH), to work in.
    """
    channels, actuators, n = block.shape
    levels, capacity = buffers.shape[2], buffers.shape[3]
    flat, flat_buffers = details.reshape(-1), buffers.reshape(-1)
    filled = fill
    for g in range(groups[0], groups[1]):
        lanes = min(WIDTH, actuators - WIDTH * g)
        for c in range(channels):
            start = (g * channels + c) * levels * capacity
            filled, done = fill, 0
            while done < n:
                if filled == capacity:
                    turn_back(buffers, start, levels, capacity, filled, history)
                    filled = history
                m = min(n - done, capacity - filled)
                for lane in range(lanes):
                    for i in range(m):
                        flat_buffers[(start + filled + i) * WIDTH + lane] = block[c, WIDTH * g + lane, done + i]
                split_levels(buffers, start, filled, m, low, high, levels, capacity, details)
                for lane in range(lanes):
                    for j in range(levels):
                        for i in range(m):
                            out[c, WIDTH * g + lane, j, done + i] = flat[(j * CHUNK + i) * WIDTH + lane]
                filled += m
                done += m
    return filled
