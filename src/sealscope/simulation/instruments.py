"""The instruments: from the truth to the readings of the rig's sensors and data acquisition (thesis, ch. 2.4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sealscope.recordings.chambers import PRESSURES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.simulation.changes import Readings

if TYPE_CHECKING:
    from sealscope.parameters import Daq, PressureTransducer, Rig

#: Half length of the anti-alias filter, in samples of the recording.
FILTER_REACH = 16
#: Highest order of a hum's harmonics.
HUM_HARMONICS = 5
_KAISER_BETA = 8.0
_PASS = 0.9  # cut-off (-6 dB) as a share of the Nyquist frequency


class Outputs(Protocol):
    """Outputs of a run by name, such as a `Trajectory`."""

    def __getitem__(self, name: str) -> Array:
        """Return an output over time."""
        ...


def anti_alias_taps(factor: int, delay: float = 0.0) -> Array:
    """Compute the taps of the zero-phase anti-alias filter at `factor` times the recording's rate.

    (2 FILTER_REACH factor + 1,): a Kaiser-windowed sinc of gain 1, late by `delay` < 1 taps; a single 1 where there is
    nothing to filter.
    """
    if factor == 1 and delay == 0.0:
        return np.ones(1)
    reach = FILTER_REACH * factor
    offsets = np.arange(-reach, reach + 1) + delay
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1.0 - (offsets / reach) ** 2))) / np.i0(_KAISER_BETA)
    taps = np.sinc((_PASS / factor if factor > 1 else 1.0) * offsets) * window
    return np.asarray(taps / taps.sum())


def decimate(values: Array, factor: int, n: int, delay: float = 0.0) -> Array:
    """Compute `n` samples of `values`, one in `factor`, after a zero-phase Kaiser-windowed sinc.

    The sinc is at -6 dB at 0.9 of the new Nyquist frequency. `values` runs FILTER_REACH new samples beyond the last
    one; before the first the signal is at rest at its first value. `delay` >= 0 in samples of `values`, whole or not:
    the samples are those of that much earlier (for a fraction the same sinc, taken between its taps).
    """
    if factor == 1 and delay == 0.0:
        return np.array(values[:n])
    reach = FILTER_REACH * factor
    whole_samples = math.floor(delay)
    taps = anti_alias_taps(factor, delay - whole_samples)
    if taps.size == 1:  # a whole delay of an unfiltered signal
        taps = np.r_[np.zeros(reach), 1.0, np.zeros(reach)]
    padded = np.concatenate([np.full(reach + whole_samples, values[0]), values])
    windows = np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::factor]
    return np.asarray(windows[:n] @ taps)


def lagging(values: Array, lag: float, rate: float) -> Array:
    """Filter a signal at `rate` [Hz] by a transducer of the first order: lag dy/dt + y = signal.

    Exact for a signal that is linear between its values, at rest before the first one; `lag` [s] of 0 leaves it as it
    is.
    """
    if lag == 0.0:
        return values
    from scipy.signal import lfilter

    decay = math.exp(-1.0 / (lag * rate))
    mean = (1.0 - decay) * lag * rate  # of the exponential over one interval
    weight_of_sample = 1.0 - mean
    filtered, _ = lfilter(
        [weight_of_sample, mean - decay], [1.0, -decay], values, zi=[(1.0 - weight_of_sample) * values[0]]
    )
    return np.asarray(filtered)


def at_jittered(sampled: Callable[[Array], Array], values: Array, late: Array | None) -> Array:
    """Compute samples of a clock that is `late` (n,) by -1 to 1 intervals of `values`; None: punctual.

    `sampled(values)` are the samples of a punctual clock; between the values a parabola is taken.
    """
    punctual = sampled(values)
    if late is None:
        return punctual
    before, after = sampled(np.r_[values[:1], values[:-1]]), sampled(np.r_[values[1:], values[-1:]])
    return np.asarray(punctual + 0.5 * late * (after - before) + 0.5 * late**2 * (after - 2.0 * punctual + before))


def convert(pressure: Array, sensor: PressureTransducer, daq: Daq) -> Array:
    """Compute the pressure [Pa] as read back from the converter.

    The transducer saturates at its range, the converter counts in steps of `daq.step` [V].
    """
    volts_per_pascal = (daq.sensor_volts_hi - daq.sensor_volts_lo) / (sensor.range_hi - sensor.range_lo)
    volts = (
        daq.sensor_volts_lo + (np.clip(pressure, sensor.range_lo, sensor.range_hi) - sensor.range_lo) * volts_per_pascal
    )
    top = 2 ** (daq.bits - 1)
    codes = np.clip(np.rint(volts / daq.step), -top, top - 1)
    return sensor.range_lo + (codes * daq.step - daq.sensor_volts_lo) / volts_per_pascal


def read_pressure(
    true: Array,
    common: Array,
    sensor: PressureTransducer,
    daq: Daq,
    rate: float,
    random: np.random.Generator,
    parameter: Callable[[str, float], Array | float],
) -> Array:
    """Compute the readings of one pressure channel [Pa].

    Gain and offset, own and common noise, drift, hum with its harmonics, saturation, conversion, stuck and lost
    samples; `parameter(symbol, value)` is a parameter of the sensor over time,
    `value` that of the rig.
    """
    t = np.arange(true.size) / rate
    walk = np.cumsum(random.standard_normal(true.size)) * sensor.drift / np.sqrt(rate)
    hum = parameter("hum", sensor.hum) * np.sin(2.0 * np.pi * (sensor.hum_frequency * t + random.random()))
    noise = parameter("noise", sensor.noise) * random.standard_normal(true.size)
    if sensor.hum_harmonics > 0:
        hum = hum + parameter("hum", sensor.hum) * _harmonics(sensor, t, random)
    gain, offset = 1.0 + parameter("gain_error", sensor.gain_error), parameter("offset", sensor.offset)
    read = convert(gain * true + offset + walk + hum + noise + common, sensor, daq)
    if sensor.stuck_rate > 0:  # a stuck reading holds for a second on average
        for start in np.flatnonzero(random.random(true.size) < sensor.stuck_rate / rate):
            read[start : start + 1 + int(random.exponential(rate))] = read[start]
    read[random.random(true.size) < sensor.drop_rate / rate] = np.nan
    return read


def _harmonics(sensor: PressureTransducer, t: Array, random: np.random.Generator) -> Array:
    """Compute the harmonics 2 to `HUM_HARMONICS` of a hum of amplitude 1, each with a phase of its own."""
    orders = np.arange(2, HUM_HARMONICS + 1)
    phases = random.random(orders.size)
    turns = sensor.hum_frequency * np.outer(orders, t) + phases[:, None]
    return np.asarray(sensor.hum_harmonics ** (orders - 1) @ np.sin(2.0 * np.pi * turns))


def _quantize(values: Array, resolution: float) -> Array:
    return values if resolution == 0 else np.floor(values / resolution) * resolution


def record(
    rig: Rig, trajectory: Outputs, u: Array, factor: int, seed: int, readings: Readings | None = None
) -> Recording:
    """Record a trajectory with the rig's instruments.

    `trajectory` is sampled `factor` times faster than the recording and runs FILTER_REACH samples longer; `u`: (n,)
    command [V] at the recording's samples. Analog channels (pressures, flow meter) pass the anti-alias filter,
    encoders are read at the instant; the clock of all but the command may jitter. The noise of each channel comes
    from a stream of its own under `seed`, so that no channel's noise depends on another's settings. `readings`: what
    changes at the instruments within the run. Of a valve-controlled rig neither angle nor speed of the motor, which
    drives its supply, are recorded.
    """
    n = u.size
    rate = rig.daq.sample_rate
    names = ("common", *PRESSURES, "x", "q_leak", "clock")
    streams = dict(zip(names, np.random.SeedSequence(seed).spawn(len(names)), strict=True))
    random = {name: np.random.default_rng(stream) for name, stream in streams.items()}
    sensors = rig.sensors
    instant = slice(0, n * factor, factor)
    t = np.arange(n) / rate
    readings = readings or Readings()

    def parameters_of(channel: str) -> Callable[[str, float], Array | float]:
        return lambda symbol, rig_value: readings.value(f"sensors.{channel}.{symbol}", rig_value, t)

    late = None
    if rig.daq.jitter > 0:
        late = np.clip(rig.daq.jitter * rate * factor * random["clock"].standard_normal(n), -1.0, 1.0)

    def read_at(values: Array) -> Array:
        return at_jittered(lambda shifted: shifted[instant], values, late)

    def filtered(values: Array, delay: float = 0.0) -> Array:
        return at_jittered(lambda shifted: decimate(shifted, factor, n, delay), values, late)

    count = 2.0 * np.pi / sensors.theta.counts
    theta = _quantize(read_at(trajectory["theta"]), count)
    of_x = parameters_of("x")
    x = (1.0 + of_x("scale_error", sensors.x.scale_error)) * read_at(trajectory["x"]) + of_x("offset", 0.0)
    x = x + of_x("noise", sensors.x.noise) * random["x"].standard_normal(n)
    common = readings.value("sensors.common_noise", sensors.common_noise, t) * random["common"].standard_normal(n)
    channels: dict[str, Array] = {
        "u": u,
        "omega": np.diff(theta, prepend=theta[:1]) * rate,
        "theta": theta,
        "x": _quantize(x, sensors.x.resolution),
    }
    for name in PRESSURES:
        sensor = getattr(sensors, name)
        true = filtered(lagging(trajectory[name], sensor.lag, rate * factor), sensor.delay * rate * factor)
        channels[name] = read_pressure(true, common, sensor, rig.daq, rate, random[name], parameters_of(name))
    flow = sensors.q_leak
    true = (1.0 + parameters_of("q_leak")("gain_error", 0.0)) * filtered(trajectory["q_leak"])
    true = true + parameters_of("q_leak")("offset", 0.0)
    read = true + parameters_of("q_leak")("noise", flow.noise) * random["q_leak"].standard_normal(n)
    read = np.clip(read, -flow.range_hi, flow.range_hi)
    channels["q_leak"] = read if flow.resolution == 0 else np.rint(read / flow.resolution) * flow.resolution
    if rig.valve.spool == "present":  # the supply's motor has no encoder
        del channels["omega"], channels["theta"]
    channels = {name: readings.hold_readings(name, values, t) for name, values in channels.items()}
    return Recording(t, channels, CHANNEL_UNITS, rate)
