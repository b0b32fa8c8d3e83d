"""Samples of recorded channels, and what the terms of a volume balance derive from them: speeds, loads and rests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.machine_states import MachineStates, RestLimits, find_states
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: Minimum absolute pressure in the terms of air [Pa].
MIN_ABSOLUTE_PRESSURE: float = INFERENCE.pressure.least
#: Half the time of the central difference for speed and direction [s]: a few encoder counts at slow motion.
HALF_DIFFERENCE = 0.025


class Signals:
    """Samples (n,) of recorded channels by name, in SI units, and signals derived from them.

    - `rate`: sampling rate [Hz];
    - `to_absolute`: absolute minus gauge pressure [Pa] by channel, by default atmospheric pressure;
    - `offset`: sensor offset [Pa] that is subtracted from p_A - p_B;
    - `rest_limits`: speeds below which the machine rests, None to find no rests.
    """

    def __init__(
        self,
        channels: Mapping[str, Array],
        rate: float,
        to_absolute: Mapping[str, float] | None = None,
        offset: float = 0.0,
        rest_limits: RestLimits | None = None,
    ) -> None:
        self._channels, self.rate, self._to_absolute, self._offset = channels, rate, to_absolute or {}, offset
        self._rest_limits = rest_limits
        self._states: MachineStates | None = None
        self._steps, self._means = dict[str, Array](), dict[str, Array]()

    def __contains__(self, name: object) -> bool:
        return name in self._channels

    def __getitem__(self, name: str) -> Array:
        return self._channels[name]

    def step(self, name: str) -> Array:
        """Return the differences (n - 1,) of neighbouring samples of a channel, which are kept."""
        if name not in self._steps:
            values = self._channels[name]
            self._steps[name] = values[1:] - values[:-1]
        return self._steps[name]

    def mean(self, name: str) -> Array:
        """Return the means (n - 1,) of neighbouring samples of a channel, which are kept."""
        if name not in self._means:
            self._means[name] = interval_means(self._channels[name])
        return self._means[name]

    @property
    def dt(self) -> float:
        """Sampling interval [s]."""
        return 1.0 / self.rate

    @property
    def time_step(self) -> Array:
        """Sampling interval dt [s], repeated for each interval, shape (n - 1,)."""
        return np.full(len(next(iter(self._channels.values()))) - 1, self.dt)

    @cached_property
    def pressure_difference(self) -> Array:
        """p_A - p_B [Pa] in the middle of each sampling interval, without the sensor offset, shape (n - 1,)."""
        return self.compute_pressure_difference()

    def compute_pressure_difference(self) -> Array:
        """Compute `pressure_difference` anew, which the caller may change; it is not kept."""
        difference = self._difference("p_A", "p_B")
        difference -= self._offset
        return difference

    @property
    def pressure_root(self) -> Array:
        """sign(dp) sqrt(abs(dp)) [Pa^0.5] of the pressure difference dp = p_A - p_B, shape (n - 1,)."""
        return signed_root(self.pressure_difference)

    @cached_property
    def port_difference(self) -> Array:
        """p_1 - p_2 [Pa] of the two ports of pump or valve, in the middle of each sampling interval, shape (n - 1,)."""
        return self._difference("p_1", "p_2")

    def _difference(self, name: str, other: str) -> Array:
        """Compute the difference (n - 1,) of the means of two channels, neither of which is kept."""
        difference = interval_means(self._channels[name])
        difference -= interval_means(self._channels[other])
        return difference

    @cached_property
    def absolute_pressure(self) -> Mapping[str, Array]:
        """Absolute pressure [Pa] at each sample, at least `MIN_ABSOLUTE_PRESSURE`, by the names "p_A" and "p_B"."""
        return {
            name: np.maximum(self._channels[name] + self._to_absolute.get(name, P_ATM), MIN_ABSOLUTE_PRESSURE)
            for name in ("p_A", "p_B")
        }

    @cached_property
    def speed(self) -> Array:
        """Speed of the piston [m/s] at each sample, by a central difference of x; x stays constant beyond the ends."""
        half_width = max(1, round(HALF_DIFFERENCE * self.rate))  # [samples]
        return central_difference(self._channels["x"], half_width) * (0.5 * self.rate / half_width)

    @cached_property
    def carried_by_A(self) -> Array:
        """1 for each sample (n,) in which side A carries the load, i.e. p_A - p_B exceeds the sensor offset, else 0.

        It is 0 also where a pressure is missing.
        """
        return (self._channels["p_A"] > self._channels["p_B"] + self._offset).astype(float)

    @cached_property
    def unknown_motion(self) -> NDArray[np.intp]:
        """Indices of the intervals at either end of which the speed is missing."""
        return np.flatnonzero(np.isnan(interval_means(self.speed)))

    def direction_weights(self, outward: bool, by_A: bool) -> Array:
        """Return 1 for each interval (n - 1,) of motion in a given direction while a given side carries the load.

        `outward`: motion towards B, or standstill, as opposed to motion towards A; `by_A`: side A, as opposed to B, has
        the load (`carried_by_A`). Other intervals have the weight 0, and 1/2 if direction or side change within. A
        missing speed counts as towards A.
        """
        is_counted = ((self.speed >= 0.0) == outward) & (self.carried_by_A == by_A)
        return interval_means(is_counted.astype(float))

    def moving(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which pump and piston move, else 0.

        `pump_volume` computes the left side of the volume balance [m^3] in each interval; later calls use that of the
        first one. Without `rest_limits` all intervals count as motion.
        """
        states = self._find_states(pump_volume)
        return np.ones_like(self.time_step) if states is None else states.moving.astype(float)

    def holding(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which the pump turns and the piston rests, else 0.

        `pump_volume`: as in `moving`. Without `rest_limits` the piston never rests.
        """
        states = self._find_states(pump_volume)
        return np.zeros_like(self.time_step) if states is None else states.holding.astype(float)

    def _find_states(self, pump_volume: Callable[[Signals], Array]) -> MachineStates | None:
        """Find the states of the machine once, for later calls, too; None without `rest_limits`."""
        if self._states is None and self._rest_limits is not None:
            self._states = find_states(pump_volume(self), self.step("x"), self.rate, self._rest_limits)
        return self._states


def central_difference(values: Array, half_width: int) -> Array:
    """Compute the difference (n,) of the values `half_width` samples after and before each of n samples.

    It is not divided by the time. Beyond the ends the first and last values are repeated.
    """
    padded = np.empty(len(values) + 2 * half_width)
    padded[:half_width], padded[half_width:-half_width], padded[-half_width:] = values[:1], values, values[-1:]
    return np.asarray(padded[2 * half_width :] - padded[: -2 * half_width])


def interval_means(values: Array) -> Array:
    """Compute the means of neighbouring samples (n,), shape (n - 1,)."""
    means = values[1:] + values[:-1]
    means *= 0.5
    return means


def signed_root(values: Array) -> Array:
    """Compute sign(v) sqrt(abs(v)) of each value v."""
    return np.asarray(np.sign(values) * np.sqrt(np.abs(values)))
