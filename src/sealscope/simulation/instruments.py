"""The instruments: from a simulated run to readings of the rig's sensors and data acquisition (thesis, ch. 2.4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.physics.solvers.loop import quantize
from sealscope.recordings.channels import PRESSURES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.signals.recursion import filter_recursively
from sealscope.simulation.changes import apply_effects
from sealscope.simulation.experiment import FILTER_REACH, Experiment

if TYPE_CHECKING:
    from sealscope.parameters import Daq, PressureTransducer

#: Highest harmonic of the mains hum.
HUM_HARMONICS = 5
_KAISER_BETA = 8.0
_CUTOFF_FRACTION = 0.9  # cut-off (-6 dB) over the Nyquist frequency


def anti_alias_taps(factor: int, delay: float = 0.0) -> Array:
    """Compute the anti-alias filter's coefficients (2 FILTER_REACH factor + 1,), a Kaiser-windowed sinc of unit gain.

    The first coefficient multiplies the earliest value, the middle one the value at the time of the output.
    `factor`: the signal's rate over the recording's; `delay`: lag of the output behind the signal, in intervals of the
    signal, 0 to 1. For `factor` 1 without a delay there is a single coefficient, 1.
    """
    if factor == 1 and delay == 0.0:
        return np.ones(1)
    reach = FILTER_REACH * factor
    offsets = np.arange(-reach, reach + 1) + delay
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1.0 - (offsets / reach) ** 2))) / np.i0(_KAISER_BETA)
    # relative to the signal's Nyquist frequency; 1 if no values are dropped, because then nothing can alias
    cutoff = _CUTOFF_FRACTION / factor if factor > 1 else 1.0
    taps = np.sinc(cutoff * offsets) * window
    return np.asarray(taps / taps.sum())


def decimate(values: Array, factor: int, n: int, delay: float = 0.0) -> Array:
    """Filter a signal against aliasing (`anti_alias_taps`), and return `n` samples of it, one in `factor` values.

    `values` must continue for FILTER_REACH x `factor` values after the last sample. Before them the signal is taken as
    constant. `delay` >= 0: lag of the samples behind the signal, in intervals of `values`.
    """
    if factor == 1 and delay == 0.0:
        return np.array(values[:n])
    reach = FILTER_REACH * factor
    whole_delay = math.floor(delay)
    taps = anti_alias_taps(factor, delay - whole_delay)
    if taps.size == 1:  # a single coefficient 1, for a delay by whole intervals: `padded` needs the usual filter length
        taps = np.r_[np.zeros(reach), 1.0, np.zeros(reach)]
    padded = np.concatenate([np.full(reach + whole_delay, values[0]), values])
    windows = np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::factor]
    return np.asarray(windows[:n] @ taps)


def filter_first_order(values: Array, lag: float, rate: float) -> Array:
    """Compute the output y of a first-order transducer for a signal at `rate` [Hz]: lag dy/dt + y = signal.

    `lag` [s]: time constant, which may be 0. The output is exact for a signal that is linear between its values and
    constant before the first.
    """
    if lag == 0.0:
        return values
    decay = math.exp(-1.0 / (lag * rate))
    mean_decay = (1.0 - decay) * lag * rate  # mean of exp(-t/lag) over one interval
    b_0 = 1.0 - mean_decay
    # settled at the first value of the signal
    return filter_recursively(values, decay, b_0, mean_decay - decay, (1.0 - b_0) * values[0])


def sample_with_jitter(sample: Callable[[Array], Array], values: Array, lateness: Array | None) -> Array:
    """Sample the signal `values` by a clock with jitter; return the samples (n,).

    `sample(signal)`: computes the samples (n,) of a signal by a clock without jitter; `lateness` (n,): delay of each
    sample in intervals of `values`, -1 .. 1, None for no jitter. Each sample is interpolated by a parabola through the
    samples without jitter that are an interval earlier, in time and an interval later.
    """
    center = sample(values)
    if lateness is None:
        return center
    left, right = sample(np.r_[values[:1], values[:-1]]), sample(np.r_[values[1:], values[-1:]])
    return np.asarray(center + 0.5 * lateness * (right - left) + 0.5 * lateness**2 * (right - 2.0 * center + left))


def volts_per_pascal(sensor: PressureTransducer, daq: Daq) -> float:
    """Compute the sensitivity [V/Pa] of a pressure transducer: the range of its voltage over that of its pressure."""
    return (daq.sensor_volts_hi - daq.sensor_volts_lo) / (sensor.range_hi - sensor.range_lo)


def digitize(pressure: Array, sensor: PressureTransducer, daq: Daq) -> Array:
    """Compute the readings [Pa] of pressures [Pa]: the transducer saturates, the analog-digital converter rounds."""
    sensitivity = volts_per_pascal(sensor, daq)
    saturated = np.clip(pressure, sensor.range_lo, sensor.range_hi)
    volts = daq.sensor_volts_lo + (saturated - sensor.range_lo) * sensitivity
    n_positive_codes = 2 ** (daq.bits - 1)
    codes = np.clip(np.rint(volts / daq.step), -n_positive_codes, n_positive_codes - 1)
    return sensor.range_lo + (codes * daq.step - daq.sensor_volts_lo) / sensitivity


def read_pressure(
    pressure: Array,
    common_noise: Array,
    sensor: PressureTransducer,
    daq: Daq,
    rate: float,
    random: np.random.Generator,
    parameter: Callable[[str, float], Array | float],
) -> Array:
    """Compute the readings [Pa] of one pressure channel from the filtered `pressure` [Pa] at `rate` [Hz].

    The errors are, in turn: gain; offset, drift (a random walk), mains hum, noise of the channel and of all channels
    (`common_noise` [Pa]); saturation and conversion to digits (`digitize`); stuck samples, which repeat a reading; lost
    samples, NaN. `parameter(symbol, value)` computes a parameter of the sensor over time from its `value` in the rig,
    because faults and drifts may change it within the run.
    """
    n = pressure.size
    t = np.arange(n) / rate
    drift = np.cumsum(random.standard_normal(n)) * sensor.drift / np.sqrt(rate)
    hum = parameter("hum", sensor.hum) * np.sin(2.0 * np.pi * (sensor.hum_frequency * t + random.random()))
    noise = parameter("noise", sensor.noise) * random.standard_normal(n)
    if sensor.hum_harmonics > 0:  # drawn after the noise, which is thus the same without harmonics
        hum = hum + parameter("hum", sensor.hum) * _hum_harmonics(sensor, t, random)
    gain = 1.0 + parameter("gain_error", sensor.gain_error)
    offset = parameter("offset", sensor.offset)
    readings = digitize(gain * pressure + offset + drift + hum + noise + common_noise, sensor, daq)
    if sensor.stuck_rate > 0:  # a reading is stuck for a second on average
        for start in np.flatnonzero(random.random(n) < sensor.stuck_rate / rate):
            readings[start : start + 1 + int(random.exponential(rate))] = readings[start]
    readings[random.random(n) < sensor.drop_rate / rate] = np.nan
    return readings


def _hum_harmonics(sensor: PressureTransducer, t: Array, random: np.random.Generator) -> Array:
    """Compute the harmonics 2 to `HUM_HARMONICS` of a mains hum at times t [s], relative to the fundamental.

    Each harmonic has a random phase and `sensor.hum_harmonics` times the amplitude of the harmonic before it.
    """
    orders = np.arange(2, HUM_HARMONICS + 1)
    phases = random.random(orders.size)
    cycles = sensor.hum_frequency * np.outer(orders, t) + phases[:, None]
    return np.asarray(sensor.hum_harmonics ** (orders - 1) @ np.sin(2.0 * np.pi * cycles))


def record(experiment: Experiment, trajectory: Any, u: Array, factor: int) -> Recording:
    """Record a simulated run of an experiment with the rig's instruments.

    `trajectory[name]`: values of an output over time, `factor` per sample, which continue for FILTER_REACH samples
    after the end of the recording; `u` (n,): command [V] at the samples.

    The analog channels (pressures, flow meter) pass the anti-alias filter; the encoders are read without a filter. The
    clock of all channels but the command may jitter. Each channel has its own random numbers, drawn from the
    experiment's seed, so that its noise does not depend on the settings of other channels.
    """
    rig, sensors, effects = experiment.rig, experiment.rig.sensors, experiment.instrument_effects()
    n = u.size
    rate = rig.daq.sample_rate
    names = ("common", *PRESSURES, "x", "q_leak", "clock")
    streams = np.random.SeedSequence(experiment.seed).spawn(len(names))
    random = {name: np.random.default_rng(stream) for name, stream in zip(names, streams, strict=True)}
    at_samples = slice(0, n * factor, factor)
    t = np.arange(n) / rate

    def parameters_of(channel: str) -> Callable[[str, float], Array | float]:
        """Build the function that computes a parameter of the channel's sensor over time, from its symbol and value."""
        return lambda symbol, rig_value: apply_effects(rig_value, effects, f"sensors.{channel}.{symbol}", t)

    jitter_steps = None
    if rig.daq.jitter > 0:
        jitter_steps = np.clip(rig.daq.jitter * rate * factor * random["clock"].standard_normal(n), -1.0, 1.0)

    def read_instantly(values: Array) -> Array:
        """Read a signal without a filter, as an encoder does."""
        return sample_with_jitter(lambda signal: signal[at_samples], values, jitter_steps)

    def read_filtered(values: Array, delay: float = 0.0) -> Array:
        """Read a signal behind the anti-alias filter, with a lag of `delay` intervals of the signal."""
        return sample_with_jitter(lambda signal: decimate(signal, factor, n, delay), values, jitter_steps)

    angle_resolution = 2.0 * np.pi / sensors.theta.counts
    theta = quantize(read_instantly(trajectory["theta"]), angle_resolution)
    x_parameter = parameters_of("x")
    scale = 1.0 + x_parameter("scale_error", sensors.x.scale_error)
    x = scale * read_instantly(trajectory["x"]) + x_parameter("offset", 0.0)  # the rig has no such offset, a fault may
    x = x + x_parameter("noise", sensors.x.noise) * random["x"].standard_normal(n)
    common_noise_sd = apply_effects(sensors.common_noise, effects, "sensors.common_noise", t)
    common_noise = common_noise_sd * random["common"].standard_normal(n)
    channels: dict[str, Array] = {
        "u": u,
        "omega": np.diff(theta, prepend=theta[:1]) * rate,  # 0 at the first sample, which has no earlier angle
        "theta": theta,
        "x": quantize(x, sensors.x.resolution),
    }
    for name in PRESSURES:
        sensor = getattr(sensors, name)
        lagged_pressure = filter_first_order(trajectory[name], sensor.lag, rate * factor)
        pressure = read_filtered(lagged_pressure, sensor.delay * rate * factor)
        channels[name] = read_pressure(pressure, common_noise, sensor, rig.daq, rate, random[name], parameters_of(name))
    meter, q_parameter = sensors.q_leak, parameters_of("q_leak")  # only faults give it a gain error or an offset
    q = (1.0 + q_parameter("gain_error", 0.0)) * read_filtered(trajectory["q_leak"]) + q_parameter("offset", 0.0)
    q = q + q_parameter("noise", meter.noise) * random["q_leak"].standard_normal(n)
    q = np.clip(q, -meter.range_hi, meter.range_hi)
    channels["q_leak"] = q if meter.resolution == 0 else np.rint(q / meter.resolution) * meter.resolution
    if not rig.circuit.pump_is_measured:  # the supply's motor has no encoder
        del channels["omega"], channels["theta"]
    for fault in experiment.faults:
        if (span := fault.stuck_span()) is not None:
            stuck = np.flatnonzero((t >= span[0]) & (t < span[1]))
            channels[fault.at][stuck] = channels[fault.at][stuck[:1]]  # [:1]: the first reading, none in an empty span
    return Recording(t, channels, CHANNEL_UNITS, rate)
