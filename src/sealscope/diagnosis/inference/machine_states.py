"""States of a machine in time: at rest, in motion, holding a load, held, or lowered past the resting pump.

Every module that asks when pump or piston rest finds it here, from the increments of the pump's volume and of the
piston's position between samples. A rest is a time of at least `MIN_REST` in which the speed, averaged over
`AVERAGING_TIME`, stays below a limit (`rest_limit`); the rests of pump and piston together are the states of
`terms.Signals`:

| pump | piston | state |
| --- | --- | --- |
| turns | moves | `moving` |
| turns | rests | `holding`: the pump holds the load, or feeds a closed cylinder |
| rests | rests | at rest: the valves may be shut, and hold the load |
| rests | moves | at rest, while a leak lets the piston creep; if it is faster, `flag_lowering` |
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel
from sealscope.diagnosis.estimate.special import SD_PER_MEDIAN
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array
from sealscope.signals.smoothing import average_over, medians, quantiles

#: Averaging time of the speeds from which rests (standstills) are found, and minimum length of a rest [s].
AVERAGING_TIME, MIN_REST = INFERENCE.rest.averaging_time, INFERENCE.rest.shortest
#: Quantile of the magnitudes of speeds up to which they count in a mean: glitches are rarer than motion.
SPEED_QUANTILE = 0.999
#: Limit of a rest for a pump or piston that never counts as resting: no speed is below it.
NEVER = -1.0
#: Time over which samples tell whether an interval belongs to a motion past the resting pump (`flag_lowering`), beyond
#: that for rests [s]: a window, and twice the time by which flags are extended. A longer pause is cut at its ends.
LOWERING_MARGIN = MIN_REST + 2.0 * AVERAGING_TIME


class RestLimits(NamedTuple):
    """Largest speeds of a machine at rest: flow of the `pump` [m^3/s] and speed of the `piston` [m/s].

    With a negative limit, pump or piston never rests. `shortest`: minimum length of a rest [s].
    """

    pump: float
    piston: float
    shortest: float = MIN_REST

    def larger(self, other: RestLimits) -> RestLimits:
        """Return the larger of two limits of pump and piston."""
        return self._replace(pump=max(self.pump, other.pump), piston=max(self.piston, other.piston))


class LoweringLimits(NamedTuple):
    """Limits of flow, speed and load of a piston that moves past the resting pump (`flag_lowering`).

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


def find_rests(
    increments: Array, rate: float, limit: float | None = None, shortest: float = MIN_REST
) -> NDArray[np.bool_]:
    """Flag the sampling intervals at rest, i.e. with a speed of at most `limit` for a time of at least `shortest` [s].

    `increments` (n,): increments of the pump's volume [m^3] or of the position [m], NaN (not at rest) where missing;
    `rate`: sampling rate [Hz]; `limit` in m^3/s or m/s, by default the `rest_limit` of the increments. The speed is
    averaged over `AVERAGING_TIME`. A recording shorter than this time and `shortest` together has no rest. A rest has
    at least two intervals.
    """
    if limit is None:
        limit = rest_limit(increments, rate)
    window, min_length = max(1, round(AVERAGING_TIME * rate)), max(2, round(shortest * rate))  # [samples]
    if len(increments) < window + min_length:
        return np.zeros(len(increments), dtype=bool)
    is_slow = np.empty(len(increments) - window + 1, dtype=bool)
    sums = np.zeros(window + 1)
    _flag_slow_windows(np.asarray(increments, dtype=float), sums, limit * window / rate, is_slow)
    is_rest_start = _count_flags(extend_flags(is_slow, window), min_length)[min_length - 1 :] == min_length
    return extend_flags(is_rest_start, min_length)


def rest_limit(increments: Array, rate: float, fraction: float = INFERENCE.rest.flow_at_rest) -> float:
    """Compute the speed [m/s] or flow [m^3/s] v below which a piston or a pump counts as resting.

    It is the larger of two values: a `fraction` of the mean speed in motion, sum(v^2) / sum(abs(v)), and three standard
    deviations of the noise of a mean of v over `AVERAGING_TIME`. `increments` (n,): increments of the position [m] or
    of the pump's volume [m^3] between samples; `rate`: sampling rate [Hz]. Speeds above the quantile `SPEED_QUANTILE`,
    as of a glitch, count as that quantile.
    """
    return _limit_of_rest(*_speed_and_noise(increments, rate), rate, fraction)


def _limit_of_rest(mean_speed: float, noise: float, rate: float, fraction: float) -> float:
    """Compute the limit of `rest_limit` from the results of `_speed_and_noise`."""
    # 2: neighbouring increments may be means that share a sample, which doubles the variance of their sum
    return max(fraction * mean_speed, 3.0 * noise * math.sqrt(2.0 / max(1.0, AVERAGING_TIME * rate)))


def _speed_and_noise(increments: Array, rate: float) -> tuple[float, float]:
    """Compute the mean speed in motion, and the standard deviation of the noise of a speed (`rest_limit`)."""
    velocity = increments[np.isfinite(increments)]
    velocity *= rate
    # sixth differences of white noise have 924 times its variance; every second value only, since neighbouring
    # increments share a sample
    differences = np.abs(np.diff(velocity[::2], 6))
    noise = SD_PER_MEDIAN * float(medians(differences)) / math.sqrt(924.0) if len(differences) else 0.0
    del differences
    speed = np.abs(velocity, out=velocity)
    if speed.size:
        np.minimum(speed, quantiles(speed, SPEED_QUANTILE)[0], out=speed)
    mean_speed = float(speed @ speed) / max(float(speed.sum()), np.finfo(float).tiny)
    return mean_speed, noise


def extend_rests(rests: NDArray[np.bool_], flow: Array, rate: float) -> NDArray[np.bool_]:
    """Extend each rest of the pump back to the time at which its flow has fallen to half of its earlier level.

    Rests are found by the mean flow over the time `rest.averaging_time` (`priors.toml`), and therefore begin too late,
    by at most this time. `rests` (n,): flags of the sampling intervals in which the pump rests; `flow` (n,): flow of
    the pump without the part that moves the piston [m^3/s], since valves do not hold a moving piston, NaN counting as
    0; `rate`: sampling rate [Hz].
    """
    window = max(1, round(INFERENCE.rest.averaging_time * rate))
    magnitude, extended = np.nan_to_num(np.abs(flow)), rests.copy()
    for first, _ in find_runs(rests).tolist():
        earliest = max(first - window, 0)
        level = float(np.median(magnitude[max(earliest - window, 0) : earliest + 1]))  # before the flow falls
        is_above_half = magnitude[earliest:first] > 0.5 * level
        # samples up to the last one above half; the others are added to the rest
        n_above = int(np.flatnonzero(is_above_half)[-1]) + 1 if is_above_half.any() else 0
        extended[earliest + n_above : first] = True
    return extended


def find_lowering_limits(pump_volume: Array, x: Array, pressure_difference: Array, rate: float) -> LoweringLimits:
    """Find the limits for `flag_lowering`; the load is the median while the pump turns, 0 if it never does.

    The arguments are those of `flag_lowering`.
    """
    max_flow = rest_limit(pump_volume, rate)
    return _find_limits(max_flow, find_rests(pump_volume, rate, max_flow), x, pressure_difference, rate)


def _find_limits(
    max_flow: float, rests: NDArray[np.bool_], x: Array, pressure_difference: Array, rate: float
) -> LoweringLimits:
    """Find the limits for `flag_lowering` (`find_lowering_limits`) from the pump's limit [m^3/s] and its `rests`."""
    speed_and_noise = _speed_and_noise(np.diff(x), rate)
    load = pressure_difference[~rests]  # while the pump turns
    np.nan_to_num(np.abs(load, out=load), copy=False)
    return LoweringLimits(
        pump=max_flow,
        creep=_limit_of_rest(*speed_and_noise, rate, INFERENCE.rest.lowering_speed),
        load=float(medians(load)) if load.size else 0.0,
        noise=_limit_of_rest(*speed_and_noise, rate, fraction=0.0),
        time=len(load) / rate,
    )


def flag_lowering(
    pump_volume: Array, x: Array, pressure_difference: Array, rate: float, limits: LoweringLimits | None = None
) -> NDArray[np.bool_]:
    """Flag the sampling intervals (n,) in which the piston moves for a time although the pump rests.

    A valve then lowers a load past the pump, or connects the chambers of an actuator that is moved from outside. A leak
    is slower: it passes little of the pump's flow, and less at a smaller load. The piston must therefore be faster than
    the fraction `rest.lowering_speed` (`priors.toml`) of its mean speed in motion, on average over `MIN_REST`. The
    fraction is reduced by the root, as the flow of an orifice, of abs(p_A - p_B) over its median while the pump turns;
    abs(p_A - p_B) is the largest of the last `MIN_REST`. Pauses shorter than `rest.shortest_hold` count as motion. The
    flags reach `AVERAGING_TIME`, over which speeds are averaged, beyond either end.

    `pump_volume` (n,): increments of the pump's volume [m^3], NaN where missing; `x` (n + 1,): position [m];
    `pressure_difference` (n,): p_A - p_B [Pa] in the middle of each sampling interval, which may be
    overwritten; `rate`: sampling rate [Hz]; `limits`: by default those of the same samples.
    """
    max_flow = limits.pump if limits else rest_limit(pump_volume, rate)
    rests = find_rests(pump_volume, rate, max_flow)
    margin = math.ceil(AVERAGING_TIME * rate)

    def extend_both_ways(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Flag `margin` more samples at either end of each run of flags."""
        return extend_flags(flags, 2 * margin + 1)[margin:-margin]

    is_turning = extend_both_ways(~rests)  # averages next to motion contain some of it
    window = min(max(1, round(MIN_REST * rate)), len(rests))  # [samples]
    # windows after each sample in which the pump rests; without one nothing is lowered
    is_free = _window_sums(is_turning.view(np.int8), window) == 0
    if not is_free.any():
        return np.zeros(len(rests), dtype=bool)
    limits = limits or _find_limits(max_flow, rests, x, pressure_difference, rate)
    usual_load = max(limits.load, np.finfo(float).tiny)
    # arrays are changed in place: a long recording has few copies
    relative_load = np.abs(pressure_difference, out=pressure_difference)
    is_missing = ~np.isfinite(relative_load)
    np.minimum(relative_load, usual_load, out=relative_load)
    relative_load /= usual_load
    relative_load[is_missing] = 1.0
    # a leak may equalise the pressures: the piston that it moves is as fast as the load was just before
    limit = largest_before(relative_load, max(1, round(MIN_REST * rate)))
    del is_missing
    np.sqrt(limit, out=limit)
    limit *= limits.creep
    np.maximum(limit, limits.noise, out=limit)
    velocity = np.nan_to_num(np.diff(x), copy=False)
    velocity *= rate
    excess = average_over(AVERAGING_TIME, velocity, rate, in_place=True)
    np.abs(excess, out=excess)
    excess -= limit
    del velocity, limit
    is_free &= _window_sums(excess, window) > 0.0  # on average over the window
    is_lowering = ~is_turning & (excess > 0.0) & extend_flags(is_free, window)
    for first, length in find_runs(~is_lowering).tolist():
        if length < INFERENCE.rest.shortest_hold * rate and not is_turning[first : first + length].any():
            is_lowering[first : first + length] = True
    return extend_both_ways(is_lowering)


def find_holds(flow: Array, rate: float, min_limit: float = 0.0) -> NDArray[np.bool_]:
    """Flag the samples (n,) in which the piston is held, i.e. the flow has been near zero for the settling time.

    The flow is averaged over `held.averaging_time` (`priors.toml`). It is near zero up to the fraction
    `held.held_speed` of its largest value, or up to `min_limit` [m^3/s] if this is larger. The settling time is
    `held.settling_time`; before the first sample the piston counts as held. `flow` (n,): flow [m^3/s], infinite where
    the piston is surely not held.
    """
    window, settling = (
        max(1, round(INFERENCE.held.averaging_time * rate)),
        max(1, round(INFERENCE.held.settling_time * rate)),
    )  # [samples]
    mean_flow = np.abs(np.convolve(flow, np.full(window, 1.0 / window), "same"))
    is_finite = np.isfinite(mean_flow)
    limit = max(INFERENCE.held.held_speed * mean_flow[is_finite].max(initial=0.0), min_limit)
    is_moving = ~is_finite | (mean_flow > limit)
    n_moving = np.convolve(is_moving, np.ones(settling))[: flow.size]  # among the last `settling` samples
    return np.asarray(n_moving == 0)


def number_strokes(speed: Array, t: NDArray[Any], longest_gap: float = MIN_REST) -> NDArray[np.intp]:
    """Assign samples in motion (n,) to strokes, numbered from 0; a stroke is a motion in one direction without a rest.

    `speed`, `t` (n,): speed, in any unit, and time of the samples in motion alone; `longest_gap`: longest time between
    two samples of a stroke, in the unit of `t`.
    """
    begins_stroke = (np.diff(np.sign(speed)) != 0.0) | (np.diff(t) > longest_gap)
    return np.concatenate([[0], np.cumsum(begins_stroke)])


def time_in_motion(speeds: Array, max_speed: float, rate: float) -> Array:
    """Compute the fraction of each block's samples in which the piston moves, (K,).

    `speeds` (K, length): speeds of K blocks at the sampling `rate` [Hz], in any unit, NaN where missing. The speed,
    averaged over `AVERAGING_TIME`, must exceed the fraction `levels.slowest` (`priors.toml`) of `max_speed`.
    """
    mean_speeds = average_over(AVERAGING_TIME, speeds, rate)
    return np.asarray((np.abs(mean_speeds) > CHANGES.levels.slowest * max_speed).mean(axis=1))


def is_in_motion(fractions: Array) -> NDArray[np.bool_]:
    """Flag the blocks (K,) in motion for at least the fraction `features.busy` (`priors.toml`) of the busiest's time.

    All are flagged if none moves. `fractions` (K,): fraction of each block's samples in motion (`time_in_motion`).
    """
    return np.asarray(fractions >= CHANGES.features.busy * fractions.max(initial=0.0))


def largest_before(values: Array, length: int) -> Array:
    """Find the largest of each value (n,) and the `length` - 1 values before it; `values` then hold the result."""
    from scipy.ndimage import maximum_filter1d

    return np.asarray(maximum_filter1d(values, length, mode="nearest", origin=(length - 1) // 2, output=values))


def _window_sums(values: NDArray[Any], length: int) -> NDArray[Any]:
    """Sum each of the values (n,) and the `length` - 1 values after it, shape (n - `length` + 1,)."""
    sums: NDArray[Any] = np.cumsum(values, dtype=np.float64 if values.dtype.kind == "f" else np.int32)
    windows = sums[length - 1 :].copy()
    windows[1:] -= sums[:-length]
    return windows


def extend_flags(starts: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Flag each flagged sample of `starts` (n,) and the next `length` - 1 samples, shape (n + length - 1,)."""
    return _count_flags(np.append(starts, np.zeros(length - 1, dtype=bool)), length) > 0


def _count_flags(flags: NDArray[np.bool_], length: int) -> NDArray[np.int32]:
    """Count, for each sample, the flags of itself and of the `length` - 1 samples before it, shape (n,)."""
    counts = np.cumsum(flags, dtype=np.int32)
    counts[length:] -= counts[:-length].copy()
    return counts


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
