"""What instruments and wavelets make of runs side by side, block by block: pressures in, sums of squares out.

The laws are those of `instruments.record` (filter, gain and offset, noise, hum, saturation, conversion) and of
`signals.details` (stationary db8), on lanes; memory is a few filter lengths for each group of runs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import anywhere, load, spread, store
from sealscope.physics.vector.runs import CHANNELS
from sealscope.simulation.batch.noise import half_turn_sine, normals

LEVELS = 4
#: d1, d2, d3, d4 and d3 d4.
QUANTITIES = LEVELS + 1
#: Samples that pass through the filters at a time, and the taps of db8.
BLOCK, TAPS = 64, 16
#: Samples that the anti-alias filter finds at a time.
TILE = 8
Taps = tuple[float, ...]
#: Rows of a channel's instrument: gain, offset, own noise, common noise and what each grows by a sample; walk a sample,
#: hum, hum's turns a sample and at the start; least and largest pressure; volts at the least, volts per pascal, volts
#: per count, counts at most.
GAIN, OFFSET, NOISE, COMMON, GAIN_RISE, OFFSET_RISE, NOISE_RISE, COMMON_RISE = range(8)
WALK, HUM, HUM_TURNS, HUM_PHASE = range(8, 12)
LEAST, LARGEST, VOLTS, PER_PASCAL, COUNT, TOP = range(12, 18)
INSTRUMENT_ROWS = 18
#: Rows of a channel's filters: the history and a block of a_0 .. a_3, d_3 late by 64 samples, details of a block.
HISTORIES = tuple((TAPS - 1) * 2**level for level in range(LEVELS))
STARTS = tuple(sum(HISTORIES[:level]) + level * BLOCK for level in range(LEVELS + 1))
LATE = TAPS // 2 * 2 ** (LEVELS - 1)
FILTER_ROWS = STARTS[LEVELS] + LATE + BLOCK + BLOCK
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to the nearest whole number


@contracted
def converted(pressure: Any, sensor: np.ndarray, at: int) -> Any:
    """Pressure [Pa] as read back from the converter (`instruments.convert`)."""
    least = load(sensor, at + LEAST)
    held = min(max(pressure, least), load(sensor, at + LARGEST))
    volts = load(sensor, at + VOLTS) + (held - least) * load(sensor, at + PER_PASCAL)
    top = load(sensor, at + TOP)
    codes = (volts / load(sensor, at + COUNT) + _ROUND) - _ROUND
    codes = min(max(codes, -top), top - 1.0)
    return least + (codes * load(sensor, at + COUNT) - load(sensor, at + VOLTS)) / load(sensor, at + PER_PASCAL)


@contracted
def _hum(sensor: np.ndarray, at: int, sample: int) -> Any:
    turns = load(sensor, at + HUM_PHASE) + load(sensor, at + HUM_TURNS) * sample
    turns = turns - ((turns + _ROUND) - _ROUND)  # -1/2 .. 1/2 of a turn
    sine = half_turn_sine(turns)
    cosine = half_turn_sine(0.5 - abs(turns))  # cos(pi turns)
    return load(sensor, at + HUM) * (2.0 * sine * cosine)


@contracted
def _read(true: Any, sensor: np.ndarray, at: int, own: Any, common: Any, walk: Any, sample: int, since: float) -> Any:
    gain = load(sensor, at + GAIN) + since * load(sensor, at + GAIN_RISE)
    offset = load(sensor, at + OFFSET) + since * load(sensor, at + OFFSET_RISE)
    noise = load(sensor, at + NOISE) + since * load(sensor, at + NOISE_RISE)
    shared = load(sensor, at + COMMON) + since * load(sensor, at + COMMON_RISE)
    reading = gain * true + offset + walk + noise * own + shared * common
    if anywhere(load(sensor, at + HUM) > 0.0):
        reading = reading + _hum(sensor, at, sample)
    return converted(reading, sensor, at)


@contracted
def _filtered(pressures: np.ndarray, at: int, taps: np.ndarray, first: int, count: int) -> Any:
    """Return the filtered value of one sample; `at`: row of its first tap, taps first .. first + count - 1."""
    total = spread(0.0)
    for k in range(count):
        total = total + taps[first + k] * load(pressures, at + CHANNELS * k)
    return total


@contracted
def _filter_tile(pressures: np.ndarray, at: int, taps: np.ndarray, factor: int, rows: np.ndarray, to: int) -> None:
    """Filter TILE samples, `factor` outputs apart, into rows from `to` on.

    Each output is loaded once. `taps` begin and end with (TILE - 1) factor zeros, so that all samples take the same
    outputs.
    """
    t_0, t_1, t_2, t_3 = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
    t_4, t_5, t_6, t_7 = spread(0.0), spread(0.0), spread(0.0), spread(0.0)
    zeros = (TILE - 1) * factor
    for k in range(taps.size - zeros):
        x = load(pressures, at + CHANNELS * k)
        tap = zeros + k
        t_0 = t_0 + taps[tap] * x
        t_1 = t_1 + taps[tap - factor] * x
        t_2 = t_2 + taps[tap - 2 * factor] * x
        t_3 = t_3 + taps[tap - 3 * factor] * x
        t_4 = t_4 + taps[tap - 4 * factor] * x
        t_5 = t_5 + taps[tap - 5 * factor] * x
        t_6 = t_6 + taps[tap - 6 * factor] * x
        t_7 = t_7 + taps[tap - 7 * factor] * x
    store(rows, to, t_0)
    store(rows, to + 1, t_1)
    store(rows, to + 2, t_2)
    store(rows, to + 3, t_3)
    store(rows, to + 4, t_4)
    store(rows, to + 5, t_5)
    store(rows, to + 6, t_6)
    store(rows, to + 7, t_7)


@contracted
def _filter_block(
    pressures: np.ndarray, at: int, factor: int, taps: np.ndarray, rows: np.ndarray, to: int, m: int
) -> None:
    """Filter m samples, into rows from `to` on."""
    zeros = (TILE - 1) * factor
    count = taps.size - 2 * zeros
    i = 0
    while count > 1 and i + TILE <= m:
        _filter_tile(pressures, at + i * factor * CHANNELS, taps, factor, rows, to + i)
        i += TILE
    for k in range(i, m):
        store(rows, to + k, _filtered(pressures, at + k * factor * CHANNELS, taps, zeros, count))


@contracted
def _filter_late(
    pressures: np.ndarray,
    at: int,
    factor: int,
    taps: np.ndarray,
    row: int,
    count: int,
    rows: np.ndarray,
    to: int,
    m: int,
) -> None:
    """`_filter_block` with taps of each lane's own, from row `row` of `taps` on."""
    for i in range(m):
        total = spread(0.0)
        for k in range(count):
            total = total + load(taps, row + k) * load(pressures, at + (i * factor + k) * CHANNELS)
        store(rows, to + i, total)


@contracted
def _behind(w: Any, x: Any) -> Any:
    """Return the last TAPS values with a new one before them."""
    return x, w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10], w[11], w[12], w[13], w[14]


@contracted
def _weighed(c: Any, w: Any) -> Any:
    """Return the sum of TAPS products, in their order."""
    total = c[0] * w[0] + c[1] * w[1] + c[2] * w[2] + c[3] * w[3] + c[4] * w[4] + c[5] * w[5] + c[6] * w[6]
    total = total + c[7] * w[7] + c[8] * w[8] + c[9] * w[9] + c[10] * w[10] + c[11] * w[11] + c[12] * w[12]
    return total + c[13] * w[13] + c[14] * w[14] + c[15] * w[15]


@contracted
def _split(rows: np.ndarray, source: int, hole: int, low: Taps, high: Taps, m: int, a: int, d: int) -> None:
    """Causal low- and high-pass of m samples from row `source` on, into rows from `a` and `d` on.

    Samples `hole` apart follow one another, so that each is loaded once.
    """
    for phase in range(min(hole, m)):
        x = load(rows, source + phase)
        w = (x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x)
        for k in range(1 - TAPS, 0):
            w = _behind(w, load(rows, source + phase + hole * k))
        for i in range(phase, m, hole):
            w = _behind(w, load(rows, source + i))
            store(rows, a + i, _weighed(low, w))
            store(rows, d + i, _weighed(high, w))


@contracted
def _summed(
    rows: np.ndarray,
    d: int,
    partner: int,
    product: bool,
    m: int,
    first: int,
    bounds: np.ndarray,
    sums: np.ndarray,
    at: int,
) -> None:
    """Add the squares of m details (or of their products with `partner`) to the segments that they fall into.

    The details are those of samples first, first + 1, ..; `sums` rows at, at + QUANTITIES, .. are the segments'.
    """
    segments = bounds.size - 1
    segment = 0
    while segment < segments and bounds[segment + 1] <= first:
        segment += 1
    i = max(bounds[0] - first, 0)
    while i < m and segment < segments:
        stop = min(m, bounds[segment + 1] - first)
        total = load(sums, at + segment * QUANTITIES)
        for k in range(i, stop):
            x = load(rows, d + k)
            if product:
                x = x * load(rows, partner + k)
            total = total + x * x
        store(sums, at + segment * QUANTITIES, total)
        i = stop
        segment += 1


@contracted
def _transform(
    rows: np.ndarray,
    at: int,
    m: int,
    sample: int,
    low: Taps,
    high: Taps,
    bounds: np.ndarray,
    sums: np.ndarray,
    to: int,
) -> None:
    """Take m new samples, the first of them number `sample`, through all levels, and keep the filters' history."""
    late = at + STARTS[LEVELS]
    scratch = late + LATE + BLOCK
    delay = 0
    for level in range(LEVELS):
        hole = 1 << level
        delay += TAPS // 2 * hole
        source = at + STARTS[level] + HISTORIES[level]
        below = at + STARTS[level + 1] + HISTORIES[level + 1] if level + 1 < LEVELS else scratch
        detail = late + LATE if level == LEVELS - 2 else scratch
        _split(rows, source, hole, low, high, m, below, detail)
        _summed(rows, detail, 0, False, m, sample - delay, bounds, sums, to + level)
    _summed(rows, scratch, late, True, m, sample - delay, bounds, sums, to + LEVELS)
    for level in range(LEVELS):
        for i in range(HISTORIES[level]):
            store(rows, at + STARTS[level] + i, load(rows, at + STARTS[level] + m + i))
    for i in range(LATE):
        store(rows, late + i, load(rows, late + m + i))


@contracted
def sense(
    groups: tuple[int, int],
    pressures: np.ndarray,
    begin: int,
    factor: int,
    taps: np.ndarray,
    own_taps: np.ndarray,
    first: int,
    last: int,
    sensors: np.ndarray,
    keys: np.ndarray,
    walks: np.ndarray,
    filters: np.ndarray,
    low: Taps,
    high: Taps,
    bounds: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Read samples first <= s < last of the groups' runs and add the squares of their details to `sums`.

    `pressures`: (groups, outputs, CHANNELS, WIDTH), the first tap of sample `first` on output `begin`, `factor` outputs
    a sample; `taps` of the anti-alias filter with (TILE - 1) factor zeros on both sides, or `own_taps` (groups,
    CHANNELS, taps, WIDTH) where channels are late (one row elsewhere); `sensors`: (groups, CHANNELS, INSTRUMENT_ROWS,
    WIDTH), as at sample `first`; `keys`: (groups, WIDTH) of the noise; `walks`: (groups, CHANNELS, WIDTH) zero drift so
    far [Pa]; `filters`: (groups, CHANNELS, FILTER_ROWS, WIDTH); `low`, `high`: the wavelet's taps; `bounds`:
    (segments + 1,) samples; `sums`: (groups, CHANNELS, segments, QUANTITIES, WIDTH).
    """
    segments = bounds.size - 1
    late = own_taps.shape[2]
    head = STARTS[0] + HISTORIES[0]
    for g in range(groups[0], groups[1]):
        key = load(keys, g)
        walk_A, walk_B = load(walks, CHANNELS * g), load(walks, CHANNELS * g + 1)
        sensor_A, sensor_B = CHANNELS * g * INSTRUMENT_ROWS, (CHANNELS * g + 1) * INSTRUMENT_ROWS
        a, b = CHANNELS * g * FILTER_ROWS, (CHANNELS * g + 1) * FILTER_ROWS
        for start in range(first, last, BLOCK):
            m = min(BLOCK, last - start)
            at = (g * pressures.shape[1] + begin + (start - first) * factor) * CHANNELS
            if late > 1:
                _filter_late(pressures, at, factor, own_taps, CHANNELS * g * late, late, filters, a + head, m)
                _filter_late(pressures, at + 1, factor, own_taps, (CHANNELS * g + 1) * late, late, filters, b + head, m)
            else:
                _filter_block(pressures, at, factor, taps, filters, a + head, m)
                _filter_block(pressures, at + 1, factor, taps, filters, b + head, m)
            for i in range(m):
                s = start + i
                own_A, own_B = normals(key, 3 * s)
                common, step_A = normals(key, 3 * s + 1)
                step_B, _ = normals(key, 3 * s + 2)
                walk_A = walk_A + load(sensors, sensor_A + WALK) * step_A
                walk_B = walk_B + load(sensors, sensor_B + WALK) * step_B
                since = float(s - first)
                read_A = _read(load(filters, a + head + i), sensors, sensor_A, own_A, common, walk_A, s, since)
                read_B = _read(load(filters, b + head + i), sensors, sensor_B, own_B, common, walk_B, s, since)
                store(filters, a + head + i, read_A)
                store(filters, b + head + i, read_B)
            _transform(filters, a, m, start, low, high, bounds, sums, CHANNELS * g * segments * QUANTITIES)
            _transform(filters, b, m, start, low, high, bounds, sums, (CHANNELS * g + 1) * segments * QUANTITIES)
        store(walks, CHANNELS * g, walk_A)
        store(walks, CHANNELS * g + 1, walk_B)


@kernel
def sense_lanes(*run: Any) -> None:
    """`sense`, compiled for lanes."""
    sense(*run)
