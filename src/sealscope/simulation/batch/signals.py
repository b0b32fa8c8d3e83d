"""Instruments and wavelet details of many runs at once: from simulated pressures to sums of squared details.

A group of runs fills a vector register, one run in each lane. The instruments and the wavelet transform are those of
`instruments.record` and `signals.details`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import WIDTH, any_lane, load, nearest_integer, store
from sealscope.physics.vector.runs import CHANNELS
from sealscope.signals.kernels import CHUNK, filter_rows, move_history, split_levels
from sealscope.simulation.batch.noise import half_turn_sine, normals

LEVELS = 4
#: Number of quantities with summed squares: d1, d2, d3, d4 and the product d3 d4.
QUANTITIES = LEVELS + 1
#: Rows that describe a channel's instrument. First gain, offset, noise of the channel, noise of all channels and
#: amplitude of the hum, and the changes of these five per sample.
GAIN, OFFSET, NOISE, COMMON, HUM, GAIN_RISE, OFFSET_RISE, NOISE_RISE, COMMON_RISE, HUM_RISE = range(10)
#: Standard deviation of the drift per sample; cycles of the hum per sample, and its phase in cycles.
DRIFT_STEP, HUM_CYCLES, HUM_PHASE = range(10, 13)
#: Range of pressure [Pa]; volts of the converter at its lower end, per pascal and per code; largest code plus 1.
RANGE_MIN, RANGE_MAX, VOLTS_AT_MIN, VOLTS_PER_PASCAL, VOLTS_PER_CODE, MAX_CODE = range(13, 19)
INSTRUMENT_ROWS = 19


@contracted
def convert_lanes(pressure: Any, sensor: np.ndarray, row: int) -> Any:
    """Compute the readings [Pa] of `pressure` [Pa] for a group of runs at once, as `instruments.digitize` does.

    `sensor`: table of the parameters of the instruments; `row`: first of the `INSTRUMENT_ROWS` rows for this channel.
    """
    range_min, max_code = load(sensor, row + RANGE_MIN), load(sensor, row + MAX_CODE)
    volts_at_min, volts_per_pascal = load(sensor, row + VOLTS_AT_MIN), load(sensor, row + VOLTS_PER_PASCAL)
    volts_per_code = load(sensor, row + VOLTS_PER_CODE)
    saturated = min(max(pressure, range_min), load(sensor, row + RANGE_MAX))
    volts = volts_at_min + (saturated - range_min) * volts_per_pascal
    code = min(max(nearest_integer(volts / volts_per_code), -max_code), max_code - 1.0)
    return range_min + (code * volts_per_code - volts_at_min) / volts_per_pascal


@contracted
def _mains_hum(sensor: np.ndarray, row: int, sample: int, amplitude: Any) -> Any:
    """Compute the mains hum [Pa] of a pressure channel at the sample number `sample`, for a group of runs at once.

    It is a sine, computed as 2 sin a cos a, where a is half its phase. `sensor`, `row`: as in `convert_lanes`.
    """
    cycles = load(sensor, row + HUM_PHASE) + load(sensor, row + HUM_CYCLES) * sample
    cycles = cycles - nearest_integer(cycles)  # -1/2 .. 1/2
    sine = half_turn_sine(cycles)
    cosine = half_turn_sine(0.5 - abs(cycles))  # cos(pi cycles)
    return amplitude * (2.0 * sine * cosine)


@contracted
def _read_pressure(
    pressure: Any,
    sensor: np.ndarray,
    row: int,
    channel_noise: Any,
    common_noise: Any,
    drift: Any,
    sample: int,
    samples_since: float,
) -> Any:
    """Compute the readings [Pa] of a pressure channel in a group of runs from the filtered `pressure` [Pa].

    `sensor`, `row`: as in `convert_lanes`; `channel_noise`, `common_noise`: standard normal numbers; `drift` [Pa]: that
    of the offset so far; `sample`: number of the sample; `samples_since`: samples since that of the values in `sensor`.
    """
    gain = load(sensor, row + GAIN) + samples_since * load(sensor, row + GAIN_RISE)
    offset = load(sensor, row + OFFSET) + samples_since * load(sensor, row + OFFSET_RISE)
    noise = load(sensor, row + NOISE) + samples_since * load(sensor, row + NOISE_RISE)
    common = load(sensor, row + COMMON) + samples_since * load(sensor, row + COMMON_RISE)
    reading = gain * pressure + offset + drift + noise * channel_noise + common * common_noise
    hum = load(sensor, row + HUM) + samples_since * load(sensor, row + HUM_RISE)
    if any_lane(hum > 0.0):
        reading = reading + _mains_hum(sensor, row, sample, hum)
    return convert_lanes(reading, sensor, row)


@contracted
def _add_squares(details: np.ndarray, first: int, n: int, bounds: np.ndarray, sums: np.ndarray, sums_row: int) -> None:
    """Add the squared wavelet details of n samples, and the squares of d3 d4, to the sums of their segments.

    `details` (LEVELS, CHUNK, WIDTH): details of the samples from `first` on; `bounds` (segments + 1,): samples at which
    the segments begin, and the end of the last. Segment k has the QUANTITIES rows of `sums` from
    `sums_row` + k QUANTITIES on.
    """
    for segment in range(bounds.size - 1):
        row = sums_row + segment * QUANTITIES
        for i in range(max(bounds[segment] - first, 0), min(bounds[segment + 1] - first, n)):
            for level in range(LEVELS):
                detail = load(details, level * CHUNK + i)
                store(sums, row + level, load(sums, row + level) + detail * detail)
            d3d4 = load(details, 2 * CHUNK + i) * load(details, 3 * CHUNK + i)  # levels 2 and 3 are d3 and d4
            store(sums, row + LEVELS, load(sums, row + LEVELS) + d3d4 * d3d4)


@contracted
def add_reading_squares(
    pressures: np.ndarray,
    first_output: int,
    factor: int,
    taps: np.ndarray,
    first: int,
    last: int,
    sensors: np.ndarray,
    keys: np.ndarray,
    drifts: np.ndarray,
    wavelet: tuple[np.ndarray, np.ndarray],
    buffers: np.ndarray,
    bounds: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Compute the readings of p_A and p_B for groups of runs, and add their squared wavelet details to `sums`.

    The samples are first <= s < last. `load` and `store` count the rows of an array over all axes but the last, the
    lanes. For each CHUNK of samples, the filtered pressures are written behind the history in the buffer of the first
    level, and there replaced by the readings. The arrays are:

    `pressures` (groups, outputs, CHANNELS, WIDTH): simulated pressures, `factor` outputs per sample. The anti-alias
    filter of sample `first` begins at output `first_output`.
    `taps` (groups, CHANNELS, taps, WIDTH): coefficients of the anti-alias filter.
    `sensors` (groups, CHANNELS, INSTRUMENT_ROWS, WIDTH): parameters of the instruments at sample `first`.
    `keys` (groups, WIDTH): keys of the runs' noise.
    `drifts` (groups, CHANNELS, WIDTH): drift of the offset so far [Pa], updated.
    `wavelet`: coefficients (taps, WIDTH) of the low-pass and of the high-pass filter.
    `buffers` (groups, CHANNELS, LEVELS, history + CHUNK, WIDTH): inputs of the wavelet's levels, updated.
    `bounds` (segments + 1,): samples at which the segments of the sums begin, and the end of the last.
    `sums` (groups, CHANNELS, segments, QUANTITIES, WIDTH): sums of the squared details, updated.
    """
    n_taps, stride, sum_rows = taps.shape[2], factor * CHANNELS, (bounds.size - 1) * QUANTITIES
    low, high = wavelet
    capacity = buffers.shape[3]
    history = capacity - CHUNK
    # the details lag the readings by half the lengths of the filters of all levels, dilated by 1, 2, 4 and 8 samples
    delay = low.shape[0] // 2 * ((1 << LEVELS) - 1)
    details = np.empty((LEVELS, CHUNK, WIDTH))
    for g in range(pressures.shape[0]):
        key = load(keys, g)
        A, B = CHANNELS * g, CHANNELS * g + 1  # numbers of both channels
        drift_A, drift_B = load(drifts, A), load(drifts, B)
        sensor_A, sensor_B = A * INSTRUMENT_ROWS, B * INSTRUMENT_ROWS
        start_A, start_B = A * LEVELS * capacity, B * LEVELS * capacity
        for start in range(first, last, CHUNK):
            n = min(CHUNK, last - start)
            source = (g * pressures.shape[1] + first_output) * CHANNELS + (start - first) * stride
            a, b = start_A + history, start_B + history  # rows of the first new sample of p_A and p_B
            # `filter_rows` takes tap k times row source - dilation k: with the dilation -CHANNELS, the k-th next output
            filter_rows(pressures, source, stride, -CHANNELS, taps, A * n_taps, n_taps, buffers, a, n)
            filter_rows(pressures, source + 1, stride, -CHANNELS, taps, B * n_taps, n_taps, buffers, b, n)
            for i in range(n):
                s, samples_since = start + i, float(start - first + i)
                # three pairs of normal numbers for each sample s, of which the last number is not used
                noise_A, noise_B = normals(key, 3 * s)
                common_noise, drift_step_A = normals(key, 3 * s + 1)
                drift_step_B, _ = normals(key, 3 * s + 2)
                drift_A = drift_A + load(sensors, sensor_A + DRIFT_STEP) * drift_step_A
                drift_B = drift_B + load(sensors, sensor_B + DRIFT_STEP) * drift_step_B
                p_A, p_B = load(buffers, a + i), load(buffers, b + i)
                reading_A = _read_pressure(p_A, sensors, sensor_A, noise_A, common_noise, drift_A, s, samples_since)
                reading_B = _read_pressure(p_B, sensors, sensor_B, noise_B, common_noise, drift_B, s, samples_since)
                store(buffers, a + i, reading_A)
                store(buffers, b + i, reading_B)
            for channel, row in ((A, start_A), (B, start_B)):
                split_levels(buffers, row, history, n, low, high, LEVELS, capacity, details)
                _add_squares(details, start - delay, n, bounds, sums, channel * sum_rows)
                move_history(buffers, row, LEVELS, capacity, history + n, history)
        store(drifts, A, drift_A)
        store(drifts, B, drift_B)


@kernel
def sense_lanes(*run: Any) -> None:
    """Run `add_reading_squares` with its arguments as compiled code."""
    add_reading_squares(*run)
