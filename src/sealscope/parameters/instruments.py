"""Parameters of the sensors and of the data acquisition."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from sealscope.parameters.fields import Part, quantity, with_unit


class PressureTransducer(Part):
    """A pressure transducer with the errors of its reading: noise, offset, drift, mains hum, delay and failures.

    Its white noise `noise` is independent of that of other channels; `sensors.common_noise` is equal in all of them.
    """

    range_lo: float = quantity("lower end of the range", "Pa", ge=-1e9, le=1e9)
    range_hi: float = quantity("upper end of the range", "Pa", gt=0, le=1e9)
    noise: float = quantity("own white noise, standard deviation of a sample", "Pa", ge=0, le=1e8)
    offset: float = quantity("zero offset", "Pa", ge=-1e8, le=1e8)
    gain_error: float = quantity("relative gain error", "1", gt=-1, le=1)
    drift: float = quantity("random walk of the zero, deviation per root second", "Pa/s^0.5", ge=0, le=1e8)
    hum: float = quantity("amplitude of mains hum", "Pa", ge=0, le=1e8)
    hum_frequency: float = quantity("frequency of mains hum", "Hz", gt=0, le=1e3)
    stuck_rate: float = quantity("rate at which the reading gets stuck", "1/s", ge=0, le=1e3)
    drop_rate: float = quantity("rate of lost samples", "1/s", ge=0, le=1e6)
    delay: float = quantity("delay: the reading is the pressure of this time before", "s", ge=0, le=1)
    lag: float = quantity("time constant of the transducer, first order", "s", absent=0, ge=0, le=10)
    hum_harmonics: float = quantity(
        "amplitude of each harmonic of the hum over the one before it", "1", absent=0, ge=0, le=1
    )

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        """Raise ValueError, as pydantic requires, unless range_lo < range_hi."""
        if self.range_lo >= self.range_hi:
            raise ValueError(f"range_lo must be < range_hi = {with_unit(self.range_hi, 'Pa')}, got {self.range_lo}")
        return self


class PositionEncoder(Part):
    """Encoder of the piston's position, with its resolution, noise and scale error."""

    resolution: float = quantity("length of one count (0: no quantisation)", "m", ge=0, le=0.1)
    noise: float = quantity("white noise before counting, standard deviation", "m", ge=0, le=0.1)
    scale_error: float = quantity("relative error of the scale", "1", gt=-1, le=1)


class AngleEncoder(Part):
    """Encoder of the motor's angle."""

    counts: int = quantity("counts per revolution", "count/rev", gt=0, le=100_000_000)


class FlowMeter(Part):
    """Flow meter in the bypass across the piston; it reads both directions."""

    range_hi: float = quantity("largest flow read, either way", "m^3/s", gt=0, le=1)
    resolution: float = quantity("smallest step of the reading (0: none)", "m^3/s", ge=0, le=1)
    noise: float = quantity("white noise, standard deviation of a sample", "m^3/s", ge=0, le=1)


class Sensors(Part):
    """All sensors, by the names of their channels, and the noise that is common to the pressure channels."""

    common_noise: float = quantity("white noise common to the pressure channels", "Pa", ge=0, le=1e8)
    p_1: PressureTransducer
    p_2: PressureTransducer
    p_A: PressureTransducer
    p_B: PressureTransducer
    x: PositionEncoder
    theta: AngleEncoder
    q_leak: FlowMeter


class Daq(Part):
    """Data acquisition board; its inputs read `sensor_volts_lo` to `sensor_volts_hi` over a transducer's range."""

    bits: int = quantity("resolution of the conversion", "bit", ge=2, le=32)
    range: float = quantity("input range: plus and minus this voltage", "V", gt=0, le=1e3)
    sample_rate: float = quantity("sampling rate", "Hz", gt=0, le=1e6)
    jitter: float = quantity("jitter of the clock, standard deviation", "s", absent=0, ge=0, le=1e-3)
    sensor_volts_lo: float = quantity("transducer output at range_lo", "V", ge=-1e3, le=1e3)
    sensor_volts_hi: float = quantity("transducer output at range_hi", "V", ge=-1e3, le=1e3)
    u_max: float = quantity("largest command: plus and minus this voltage", "V", gt=0, le=1e3)

    @model_validator(mode="after")
    def _check_output_volts(self) -> Self:
        """Raise ValueError, as pydantic requires, unless -range <= sensor_volts_lo < sensor_volts_hi <= range."""
        lo, hi = self.sensor_volts_lo, self.sensor_volts_hi
        if lo >= hi:
            raise ValueError(f"sensor_volts_lo must be < sensor_volts_hi = {with_unit(hi, 'V')}, got {lo}")
        if hi > self.range:
            raise ValueError(f"sensor_volts_hi must be <= range = {with_unit(self.range, 'V')}, got {hi}")
        if lo < -self.range:
            raise ValueError(f"sensor_volts_lo must be >= -range = {with_unit(-self.range, 'V')}, got {lo}")
        return self

    @property
    def step(self) -> float:
        """Voltage [V] of one step of the analog-digital conversion: 2 range / 2^bits."""
        return 2.0 * self.range / 2.0**self.bits
