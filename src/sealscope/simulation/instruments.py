"""The instruments: what the rig's sensors and its data acquisition make of the truth (thesis, ch. 2.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Daq, PressureTransducer, Rig
    from sealscope.simulation.integrate import Trajectory

PRESSURES = ("p_1", "p_2", "p_A", "p_B")
#: Half length of the anti-alias filter, in samples of the recording.
FILTER_REACH = 16
_KAISER_BETA = 8.0
_PASS = 0.9  # cut-off (-6 dB) as a share of the Nyquist frequency


def decimate(values: Array, factor: int, n: int) -> Array:
    """`n` samples out of `values`, one in `factor`, after a zero-phase Kaiser-windowed sinc (-6 dB at 0.9 of the new
    Nyquist frequency).

    `values` runs FILTER_REACH new samples beyond the last one; before the first the signal is at rest at its first
    value.
    """
    if factor == 1:
        return np.array(values[:n])
    reach = FILTER_REACH * factor
    taps = np.sinc(_PASS / factor * np.arange(-reach, reach + 1)) * np.kaiser(2 * reach + 1, _KAISER_BETA)
    padded = np.concatenate([np.full(reach, values[0]), values])
    windows = np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::factor]
    return np.asarray(windows[:n] @ (taps / taps.sum()))


def convert(pressure: Array, sensor: PressureTransducer, daq: Daq) -> Array:
    """Pressure [Pa] as read back from the converter: the transducer saturates at its range, the converter counts in
    steps of `daq.step` [V]."""
    volts_per_pascal = (daq.sensor_volts_hi - daq.sensor_volts_lo) / (sensor.range_hi - sensor.range_lo)
    volts = (
        daq.sensor_volts_lo + (np.clip(pressure, sensor.range_lo, sensor.range_hi) - sensor.range_lo) * volts_per_pascal
    )
    top = 2 ** (daq.bits - 1)
    codes = np.clip(np.rint(volts / daq.step), -top, top - 1)
    return sensor.range_lo + (codes * daq.step - daq.sensor_volts_lo) / volts_per_pascal


def read_pressure(
    true: Array, common: Array, sensor: PressureTransducer, daq: Daq, rate: float, random: np.random.Generator
) -> Array:
    """What one pressure channel reads [Pa]: gain and offset, own and common noise, drift, hum, saturation,
    conversion, stuck and lost samples."""
    t = np.arange(true.size) / rate
    walk = np.cumsum(random.standard_normal(true.size)) * sensor.drift / np.sqrt(rate)
    hum = sensor.hum * np.sin(2.0 * np.pi * (sensor.hum_frequency * t + random.random()))
    own = sensor.noise * random.standard_normal(true.size)
    read = convert((1.0 + sensor.gain_error) * true + sensor.offset + walk + hum + own + common, sensor, daq)
    if sensor.stuck_rate > 0:  # a stuck reading holds for a second on average
        for start in np.flatnonzero(random.random(true.size) < sensor.stuck_rate / rate):
            read[start : start + 1 + int(random.exponential(rate))] = read[start]
    read[random.random(true.size) < sensor.drop_rate / rate] = np.nan
    return read


def _counted(values: Array, resolution: float) -> Array:
    return values if resolution == 0 else np.floor(values / resolution) * resolution


def record(rig: Rig, trajectory: Trajectory, u: Array, factor: int, seed: int) -> Recording:
    """The Recording that the rig's instruments make of a trajectory.

    `trajectory` is sampled `factor` times faster than the recording and runs FILTER_REACH samples longer; `u`: (n,)
    command [V] at the recording's samples. Analog channels (pressures, flow meter) pass the anti-alias filter,
    encoders are read at the instant. The noise of each channel comes from a stream of its own under `seed`, so that
    no channel's noise depends on another's settings.
    """
    n = u.size
    rate = rig.daq.sample_rate
    names = ("common", *PRESSURES, "x", "q_leak")
    streams = dict(zip(names, np.random.SeedSequence(seed).spawn(len(names)), strict=True))
    random = {name: np.random.default_rng(stream) for name, stream in streams.items()}
    sensors = rig.sensors
    instant = slice(0, n * factor, factor)

    count = 2.0 * np.pi / sensors.theta.counts
    theta = _counted(trajectory["theta"][instant], count)
    x = trajectory["x"][instant] + sensors.x.noise * random["x"].standard_normal(n)
    common = sensors.common_noise * random["common"].standard_normal(n)
    channels: dict[str, Array] = {
        "u": u,
        "omega": np.diff(theta, prepend=theta[:1]) * rate,
        "theta": theta,
        "x": _counted(x, sensors.x.resolution),
    }
    for name in PRESSURES:
        true = decimate(trajectory[name], factor, n)
        channels[name] = read_pressure(true, common, getattr(sensors, name), rig.daq, rate, random[name])
    flow = sensors.q_leak
    read = decimate(trajectory["q_leak"], factor, n) + flow.noise * random["q_leak"].standard_normal(n)
    read = np.clip(read, -flow.range_hi, flow.range_hi)
    channels["q_leak"] = read if flow.resolution == 0 else np.rint(read / flow.resolution) * flow.resolution
    return Recording(np.arange(n) / rate, channels, CHANNEL_UNITS, rate)
