"""Samples of recorded channels, and what the terms of a volume balance derive from them: speeds, loads and rests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: Minimum absolute pressure in the terms of air [Pa].
MIN_ABSOLUTE_PRESSURE: float = INFERENCE.pressure.least
#: Half the time of the central difference for speed and direction [s]: a few encoder counts at slow motion.
HALF_DIFFERENCE = 0.025
#: Averaging time of the speeds from which rests (standstills) are found, and minimum length of a rest [s].
AVERAGING_TIME, MIN_REST = INFERENCE.rest.averaged, INFERENCE.rest.least


class RestLimits(NamedTuple):
    """Largest speeds of a machine at rest: flow of the `pump` [m^3/s] and speed of the `piston` [m/s].

    With a negative limit, pump or piston never rests. `shortest`: minimum length of a rest [s].
    """

    pump: float
    piston: float
    shortest: float = MIN_REST


class LoweringLimits(NamedTuple):
    """Limits of flow, speed and load of a piston that moves past the resting pump (`balance.flag_lowering`).

    - `pump`: flow below which the pump rests [m^3/s];
    - `creep`: speed of the piston [m/s] up to which it creeps by a leak while it carries `load`, abs(p_A - p_B) [Pa];
    - `noise`: speed of the piston that its sensor may show at rest [m/s];
    - `time`: time in which the pump turned [s], by which the limits of several parts of a stream are averaged.
    """

    pump: float
    creep: float
    load: float
    noise: float
    time: float

    def average_with(self, other: LoweringLimits) -> LoweringLimits:
        """Average the limits of two parts of a stream by the times in which the pump turned (equal if never)."""
        time = self.time + other.time
        share = other.time / time if time > 0.0 else 0.5
        means = [(1.0 - share) * mine + share * theirs for mine, theirs in zip(self, other, strict=True)]
        return LoweringLimits(*means)._replace(time=time)


class Signals:
    """Samples (n,) of recorded channels by name, in SI units, and signals derived from them.

    - `rate`: sampling rate [Hz];
    - `to_absolute`: absolute minus gauge pressure [Pa] by channel, by default atmospheric pressure;
    - `offset`: sensor offset [Pa] that is subtracted from p_A - p_B;
    - `rest_limits`: speeds below which the machine rests, None to find no rests.

    `step(name)` gives the differences of neighbouring samples, and `mean(name)` their means, (n - 1,) each.
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
        self._states: tuple[Array, Array] | None = None
        self.step = cache(lambda name: np.asarray(np.diff(channels[name])))
        self.mean = cache(lambda name: interval_means(channels[name]))

    def __contains__(self, name: object) -> bool:
        return name in self._channels

    def __getitem__(self, name: str) -> Array:
        return self._channels[name]

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
        return self._find_states(pump_volume)[0]

    def holding(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which the pump turns and the piston rests, else 0.

        `pump_volume`: as in `moving`. Without `rest_limits` the piston never rests.
        """
        return self._find_states(pump_volume)[1]

    def _find_states(self, pump_volume: Callable[[Signals], Array]) -> tuple[Array, Array]:
        """Compute the results of `moving` and `holding`; later calls return those of the first, which are stored."""
        limits = self._rest_limits
        if limits is None:
            return np.ones_like(self.time_step), np.zeros_like(self.time_step)
        if self._states is None:
            pump_rests = find_rests(pump_volume(self), self.rate, limits.pump, limits.shortest)
            piston_rests = find_rests(self.step("x"), self.rate, limits.piston, limits.shortest)
            is_moving, is_holding = ~pump_rests & ~piston_rests, ~pump_rests & piston_rests
            self._states = is_moving.astype(float), is_holding.astype(float)
        return self._states


def find_rests(increments: Array, rate: float, limit: float, shortest: float = MIN_REST) -> NDArray[np.bool_]:
    """Flag the sampling intervals at rest, i.e. with a speed of at most `limit` for a time of at least `shortest` [s].

    `increments` (n,): increments of the pump's volume [m^3] or of the position [m], NaN (not at rest) where missing;
    `rate`: sampling rate [Hz]; `limit` in m^3/s or m/s. The speed is averaged over `AVERAGING_TIME`. A recording
    shorter than this time and `shortest` together has no rest. A rest has at least two intervals.
    """
    window, min_length = max(1, round(AVERAGING_TIME * rate)), max(2, round(shortest * rate))  # [samples]
    if len(increments) < window + min_length:
        return np.zeros(len(increments), dtype=bool)
    is_slow = np.empty(len(increments) - window + 1, dtype=bool)
    sums = np.zeros(window + 1)
    _flag_slow_windows(np.asarray(increments, dtype=float), sums, limit * window / rate, is_slow)
    is_rest_start = np.empty(len(increments) - min_length + 1, dtype=bool)
    _flag_runs(extend_flags(is_slow, window), min_length, is_rest_start)
    return extend_flags(is_rest_start, min_length)


@kernel
def _flag_slow_windows(increments: Any, sums: Any, limit: float, is_slow: Any) -> None:
    """Flag windows of samples, by their first sample, whose sum is at most `limit` and that miss no sample.

    `increments` (n,), NaN where missing; `sums` (length of a window + 1,), zeros: space for the last sums of the known
    increments, in a ring.
    """
    window, total, n_missing = len(sums) - 1, 0.0, 0
    place = 0  # in the ring, of the last sum; the sum before the window follows it
    for i in range(len(increments)):
        is_known = np.isfinite(increments[i])
        total += increments[i] if is_known else 0.0
        n_missing += 0 if is_known else 1
        place = place + 1 if place < window else 0
        sums[place] = total
        first = i - window + 1
        if first >= 0:
            before = place + 1 if place < window else 0
            is_slow[first] = n_missing == 0 and abs(total - sums[before]) <= limit
            n_missing -= 0 if np.isfinite(increments[first]) else 1


@kernel
def _flag_runs(flags: Any, length: int, is_start: Any) -> None:
    """Flag the samples from which on `length` successive samples are flagged."""
    run = 0
    for i in range(len(flags)):
        run = run + 1 if flags[i] else 0
        if i >= length - 1:
            is_start[i - length + 1] = run >= length


@kernel
def _extend_flags(starts: Any, length: int, flags: Any) -> None:
    """Write the flags of `extend_flags`."""
    left = 0  # number of further samples to flag
    for i in range(len(flags)):
        if i < len(starts) and starts[i]:
            left = length
        flags[i] = left > 0
        left -= 1


def central_difference(values: Array, half_width: int) -> Array:
    """Compute the difference (n,) of the values `half_width` samples after and before each of n samples.

    It is not divided by the time. Beyond the ends the first and last values are repeated.
    """
    padded = np.concatenate([np.repeat(values[:1], half_width), values, np.repeat(values[-1:], half_width)])
    return np.asarray(padded[2 * half_width :] - padded[: -2 * half_width])


def extend_flags(starts: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Flag each flagged sample of `starts` (n,) and the next `length` - 1 samples, shape (n + length - 1,)."""
    flags = np.empty(len(starts) + length - 1, dtype=bool)
    _extend_flags(np.ascontiguousarray(starts), length, flags)
    return flags


def interval_means(values: Array) -> Array:
    """Compute the means of neighbouring samples (n,), shape (n - 1,)."""
    means = values[1:] + values[:-1]
    means *= 0.5
    return means


def signed_root(values: Array) -> Array:
    """Compute sign(v) sqrt(abs(v)) of each value v."""
    return np.asarray(np.sign(values) * np.sqrt(np.abs(values)))
