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
def _filter(rows: Array, source: int, hole: int, taps: Array, m: int, out: Array, to: int) -> None:
    """``out[to + i] = sum_k taps[k] rows[source + i - hole k]`` for i < m, lanes to a row, eight rows at a time."""
    i = 0
    while i + 8 <= m:
        s_0, s_1, s_2, s_3 = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
        s_4, s_5, s_6, s_7 = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
        for k in range(taps.size):
            t = taps[k]
            a = source + i - hole * k
            s_0 = s_0 + t * load(rows, a)
            s_1 = s_1 + t * load(rows, a + 1)
            s_2 = s_2 + t * load(rows, a + 2)
            s_3 = s_3 + t * load(rows, a + 3)
            s_4 = s_4 + t * load(rows, a + 4)
            s_5 = s_5 + t * load(rows, a + 5)
            s_6 = s_6 + t * load(rows, a + 6)
            s_7 = s_7 + t * load(rows, a + 7)
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
        for k in range(taps.size):
            s = s + taps[k] * load(rows, source + i - hole * k)
        store(out, to + i, s)
        i += 1


@contracted
def _take(
    samples: Array,
    done: int,
    m: int,
    buffers: Array,
    start: int,
    at: int,
    low: Array,
    high: Array,
    levels: int,
    capacity: int,
    details: Array,
) -> None:
    """Take samples[lane, done : done + m] into a channel's buffers (row `start` on); its details into `details`.

    `details`: (levels, CHUNK, WIDTH). Shallower levels are read late, so that a row belongs to one sample.
    """
    flat = buffers.reshape(-1)
    for lane in range(samples.shape[0]):
        to = (start + at) * WIDTH + lane
        for i in range(m):
            flat[to + WIDTH * i] = samples[lane, done + i]
    half = low.size // 2
    for j in range(levels):
        hole = 1 << j
        row = start + j * capacity + at
        late = half * ((1 << levels) - 2 * hole)
        _filter(buffers, row - late, hole, high, m, details, j * CHUNK)
        if j + 1 < levels:
            _filter(buffers, row, hole, low, m, buffers, row + capacity)


@contracted
def _turn_back(buffers: Array, start: int, levels: int, capacity: int, history: int) -> None:
    """Move the last `history` rows of each of a channel's buffers back to the front."""
    for j in range(levels):
        row = start + j * capacity
        for i in range(history):
            store(buffers, row + i, load(buffers, row + capacity - history + i))


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
    flat = details.reshape(-1)
    at = fill
    for g in range(groups[0], groups[1]):
        lanes = min(WIDTH, actuators - WIDTH * g)
        for c in range(channels):
            start = (g * channels + c) * levels * capacity
            at, done = fill, 0
            while done < n:
                if at == capacity:
                    _turn_back(buffers, start, levels, capacity, history)
                    at = history
                m = min(n - done, capacity - at)
                samples = block[c, WIDTH * g : WIDTH * g + lanes]
                _take(samples, done, m, buffers, start, at, low, high, levels, capacity, details)
                for lane in range(lanes):
                    for j in range(levels):
                        for i in range(m):
                            out[c, WIDTH * g + lane, j, done + i] = flat[(j * CHUNK + i) * WIDTH + lane]
                at += m
                done += m
    return at
