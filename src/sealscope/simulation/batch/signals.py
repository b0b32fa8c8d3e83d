"""Instruments and wavelets of runs side by side, block by block: from pressures to sums of squares.

The laws are those of `instruments.record` and `signals.details`, on lanes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import WIDTH, anywhere, load, nearest_whole, store
from sealscope.physics.vector.runs import CHANNELS
from sealscope.signals.kernels import CHUNK, filter_rows, split_levels, turn_back
from sealscope.simulation.batch.noise import half_turn_sine, normals

LEVELS = 4
#: Quantities of which the squares are summed: d1, d2, d3, d4 and d3 d4.
QUANTITIES = LEVELS + 1
#: Rows of a channel's instrument: gain, offset, own noise, common noise and what each grows by a sample; walk a sample,
#: hum, hum's turns a sample and at the start; least and largest pressure; volts at the least, volts per pascal, volts
#: per count, counts at most.
GAIN, OFFSET, NOISE, COMMON, GAIN_RISE, OFFSET_RISE, NOISE_RISE, COMMON_RISE = range(8)
WALK, HUM, HUM_TURNS, HUM_PHASE = range(8, 12)
LEAST, LARGEST, VOLTS, PER_PASCAL, COUNT, TOP = range(12, 18)
INSTRUMENT_ROWS = 18


@contracted
def converted(pressure: Any, sensor: np.ndarray, row: int) -> Any:
    """Compute the pressure [Pa] as read back from the converter (`instruments.convert`)."""
    least = load(sensor, row + LEAST)
    within_range = min(max(pressure, least), load(sensor, row + LARGEST))
    volts = load(sensor, row + VOLTS) + (within_range - least) * load(sensor, row + PER_PASCAL)
    top = load(sensor, row + TOP)
    codes = min(max(nearest_whole(volts / load(sensor, row + COUNT)), -top), top - 1.0)
    return least + (codes * load(sensor, row + COUNT) - load(sensor, row + VOLTS)) / load(sensor, row + PER_PASCAL)


@contracted
def _hum(sensor: np.ndarray, row: int, sample: int) -> Any:
    turns = load(sensor, row + HUM_PHASE) + load(sensor, row + HUM_TURNS) * sample
    turns = turns - nearest_whole(turns)  # -1/2 .. 1/2 of a turn
    sine = half_turn_sine(turns)
    cosine = half_turn_sine(0.5 - abs(turns))  # cos(pi turns)
    return load(sensor, row + HUM) * (2.0 * sine * cosine)


@contracted
def _read(
    true: Any, sensor: np.ndarray, row: int, noise_of_channel: Any, common: Any, walk: Any, sample: int, since: float
) -> Any:
    gain = load(sensor, row + GAIN) + since * load(sensor, row + GAIN_RISE)
    offset = load(sensor, row + OFFSET) + since * load(sensor, row + OFFSET_RISE)
    noise = load(sensor, row + NOISE) + since * load(sensor, row + NOISE_RISE)
    shared = load(sensor, row + COMMON) + since * load(sensor, row + COMMON_RISE)
    reading = gain * true + offset + walk + noise * noise_of_channel + shared * common
    if anywhere(load(sensor, row + HUM) > 0.0):
        reading = reading + _hum(sensor, row, sample)
    return converted(reading, sensor, row)


@contracted
def _add_squares(details: np.ndarray, first: int, m: int, bounds: np.ndarray, sums: np.ndarray, to: int) -> None:
    """Add the squares of m samples' details, from sample `first` on, to their segments between `bounds`.

    `details`: (LEVELS, CHUNK, WIDTH); `sums` rows to, to + QUANTITIES, .. are the segments'.
    """
    for segment in range(bounds.size - 1):
        row = to + segment * QUANTITIES
        for i in range(max(bounds[segment] - first, 0), min(bounds[segment + 1] - first, m)):
            for level in range(LEVELS):
                x = load(details, level * CHUNK + i)
                store(sums, row + level, load(sums, row + level) + x * x)
            x = load(details, 2 * CHUNK + i) * load(details, 3 * CHUNK + i)
            store(sums, row + LEVELS, load(sums, row + LEVELS) + x * x)


@contracted
def sense(
    groups: tuple[int, int],
    pressures: np.ndarray,
    begin: int,
    factor: int,
    taps: np.ndarray,
    first: int,
    last: int,
    sensors: np.ndarray,
    keys: np.ndarray,
    walks: np.ndarray,
    wavelet: tuple[np.ndarray, np.ndarray],
    buffers: np.ndarray,
    bounds: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Read samples first <= s < last of the groups' runs and add the squares of their details to `sums`.

    `pressures`: (groups, outputs, CHANNELS, WIDTH), the first tap of sample `first` on output `begin`, `factor` outputs
    a sample; `taps` (groups, CHANNELS, taps, WIDTH) of the anti-alias filter; `sensors`: (groups, CHANNELS,
    INSTRUMENT_ROWS, WIDTH), as at sample `first`; `keys`: (groups, WIDTH) of the noise; `walks`: (groups, CHANNELS,
    WIDTH) zero drift so far [Pa]; `wavelet`: taps (taps, WIDTH) of the low- and high-pass; `buffers`: (groups,
    CHANNELS, LEVELS, history + CHUNK, WIDTH) of the filters; `bounds`: (segments + 1,) samples; `sums`: (groups,
    CHANNELS, segments, QUANTITIES, WIDTH).
    """
    count, stride, rows = taps.shape[2], factor * CHANNELS, (bounds.size - 1) * QUANTITIES
    low, high = wavelet
    capacity = buffers.shape[3]
    history, delay = capacity - CHUNK, low.shape[0] // 2 * ((1 << LEVELS) - 1)
    details = np.empty((LEVELS, CHUNK, WIDTH))
    for g in range(groups[0], groups[1]):
        key = load(keys, g)
        A, B = CHANNELS * g, CHANNELS * g + 1
        walk_A, walk_B = load(walks, A), load(walks, B)
        sensor_A, sensor_B = A * INSTRUMENT_ROWS, B * INSTRUMENT_ROWS
        start_A, start_B = A * LEVELS * capacity, B * LEVELS * capacity
        for start in range(first, last, CHUNK):
            m = min(CHUNK, last - start)
            source = (g * pressures.shape[1] + begin) * CHANNELS + (start - first) * stride
            a, b = start_A + history, start_B + history
            filter_rows(pressures, source, stride, -CHANNELS, taps, A * count, count, buffers, a, m)
            filter_rows(pressures, source + 1, stride, -CHANNELS, taps, B * count, count, buffers, b, m)
            for i in range(m):
                s, since = start + i, float(start - first + i)
                own_A, own_B = normals(key, 3 * s)
                common, step_A = normals(key, 3 * s + 1)
                step_B, _ = normals(key, 3 * s + 2)
                walk_A = walk_A + load(sensors, sensor_A + WALK) * step_A
                walk_B = walk_B + load(sensors, sensor_B + WALK) * step_B
                store(buffers, a + i, _read(load(buffers, a + i), sensors, sensor_A, own_A, common, walk_A, s, since))
                store(buffers, b + i, _read(load(buffers, b + i), sensors, sensor_B, own_B, common, walk_B, s, since))
            for channel, row in ((A, start_A), (B, start_B)):
                split_levels(buffers, row, history, m, low, high, LEVELS, capacity, details)
                _add_squares(details, start - delay, m, bounds, sums, channel * rows)
                turn_back(buffers, row, LEVELS, capacity, history + m, history)
        store(walks, A, walk_A)
        store(walks, B, walk_B)


@kernel
def sense_lanes(*run: Any) -> None:
    """`sense`, compiled for lanes."""
    sense(*run)
