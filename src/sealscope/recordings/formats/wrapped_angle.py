"""Unwrap angles that begin anew after a turn, or after as many turns or counts as an encoder has.

An angle of 0 to 360 degrees (or -180 to 180 degrees, 0 to 2 pi, 0 to 1 rev) leaps by its period P where it begins anew,
and so does an encoder of 0 to 4095 counts. The true step from sample to sample is the recorded one plus n P. While the
shaft turns by less than half a period from sample to sample, n belongs to the smallest step. Near and beyond half a
period it belongs to the step nearest to that of a recorded speed, or of a signal in proportion to the speed: the speed
of the piston, or the command. Called by `corrections.samples` and, before angles of another rate are resampled, by
`formats.table`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import COUNTS, Array, estimate_quantum
from sealscope.recordings.priors import RECORDINGS

_PRIORS = RECORDINGS.angle
_TURN = 2.0 * math.pi  # [rad]
_MIN_SAMPLES = 10  # fewest samples of an angle that is examined
_MIN_LEAPS = 3  # fewest leaps by which a period is measured that is no whole number of turns or usual number of counts
#: Periods of encoders: powers of two, and lines of incremental encoders with one, two or four edges each.
_COUNTS = np.unique(
    [2.0**bits for bits in range(6, 33)]
    + [lines * 10.0**power for lines in (1.0, 2.0, 2.5, 3.6, 4.0, 5.0, 7.2, 8.0) for power in range(2, 7)]
)
_MAX_RESETS = 100  # most resets of an encoder in a recording
_MAX_PERIODS = 20.0  # most periods from sample to sample that are looked for
_MAX_STEPS = 4_000  # most steps to which the gain of a signal is fitted, or up to twice as many


class Unwrapped(NamedTuple):
    """An angle without leaps."""

    values: Array | None  # (n,); None if the shaft may turn by half a period or more from sample to sample
    period: float  # in the unit of the angle
    leaps: NDArray[np.intp]  # indices of the first samples after each leap


class _Period(NamedTuple):
    """The period of an angle, and the largest step from sample to sample if all steps are under half a period."""

    value: float
    largest_step: float


def unwrap_angle(values: Array, unit: str, t: Array, signals: Mapping[str, Array] | None = None) -> Unwrapped | None:
    """Unwrap an angle (n,) in `unit`, rad or counts; return None if it does not wrap.

    `t` (n,): times [s]; `signals`: channels (n,) that tell steps of half a period and more: the speed "omega" [rad/s],
    the position "x" and the command "u".
    """
    rows = np.flatnonzero(np.isfinite(values) & np.isfinite(t))
    if rows.size < _MIN_SAMPLES:
        return None
    known, intervals = values[rows], np.diff(t[rows])
    steps = np.diff(known)
    span = float(known.max() - known.min())
    leaps = np.flatnonzero(np.abs(steps) > 0.5 * span)
    if not (span > 0.0 and leaps.size) or (period := _find_period(known, steps, leaps, unit)) is None:
        return None
    turns = _nearest_turns(steps, intervals, period.value)
    fast_step = _PRIORS.fast * period.value
    is_fast = period.largest_step > fast_step
    predictions = _predict_steps(steps, rows, t, period.value, unit, signals or {})
    if predictions is not None and (is_fast or np.quantile(np.abs(predictions), _PRIORS.most) > fast_step):
        turns, is_fast = np.round((predictions - steps) / period.value), False
    if not turns.any():
        return None
    result = values.copy()
    result[rows[1:]] += period.value * np.cumsum(turns)
    return Unwrapped(None if is_fast else result, period.value, rows[np.flatnonzero(turns) + 1])


def continue_resets(values: Array, position: Array | None) -> tuple[Array, NDArray[np.intp]]:
    """Let an angle (n,) continue where its encoder begins again from its first value, as after a loss of its supply.

    All steps over `angle.reset` times the usual largest step (`priors.toml`) must be such resets. The angle then goes
    on by as much as the `position` (n,) tells, if there is one. Also return the rows of these; empty, and the same
    values, without any.
    """
    rows = np.flatnonzero(np.isfinite(values) if position is None else np.isfinite(values) & np.isfinite(position))
    known = values[rows]
    steps = np.diff(known)
    if rows.size < _MIN_SAMPLES:
        return values, rows[:0]
    usual = float(np.quantile(np.abs(steps), 1.0 - _PRIORS.spoilt))
    leaps = np.flatnonzero(np.abs(steps) > _PRIORS.reset * usual)
    is_reset = np.abs(known[leaps + 1] - known[0]) <= 2.0 * usual
    if not (usual > 0.0 and leaps.size and is_reset.all()) or leaps.size > _MAX_RESETS:
        return values, rows[:0]
    shifts = np.zeros(known.size)
    shifts[leaps + 1] = -steps[leaps]
    if position is not None:
        strokes = np.diff(position[rows])
        turning = np.delete(steps, leaps)
        moves = np.delete(strokes, leaps)
        energy = float(moves @ moves)
        shifts[leaps + 1] += strokes[leaps] * (float(turning @ moves) / energy if energy > 0.0 else 0.0)
    place = np.clip(np.searchsorted(rows, np.arange(values.size), side="right") - 1, 0, None)
    return values + np.cumsum(shifts)[place], rows[leaps + 1]


def _find_period(values: Array, steps: Array, leaps: NDArray[np.intp], unit: str) -> _Period | None:
    """Find the period of an angle (n,) from its `steps` (n - 1,) and their `leaps` over half its range, or None.

    The leaps measure it by the steps beside them. A whole number of turns, or a usual number of counts, is preferred.
    The angle must fill the period, and leap from one end to the other. Steps over `angle.slow` (`priors.toml`) of a
    period could be those of an angle that does not wrap, unless it is of one turn or a usual number of counts.
    """
    low, high, quantum = float(values.min()), float(values.max()), estimate_quantum(values)
    span = high - low
    quantum = quantum if math.isfinite(quantum) else 0.0
    wrapped = _wrap(steps, span + quantum)
    padded = np.concatenate([wrapped[1:2], wrapped, wrapped[-2:-1]])
    neighbour_steps = 0.5 * (padded[leaps] + padded[leaps + 2])  # means of the steps before and after each leap
    estimates = np.abs(neighbour_steps - steps[leaps])
    estimate = float(np.median(estimates))
    scatter = max(float(np.median(np.abs(estimates - estimate))), quantum, _PRIORS.period * estimate)
    if unit == COUNTS:
        near = _COUNTS[(np.abs(_COUNTS - estimate) <= 3.0 * scatter) & (span <= _COUNTS)]
        filled = near[near <= (1.0 + _PRIORS.measured) * span]
        near = filled if filled.size else near
        is_binary = np.log2(near) % 1.0 == 0.0
        near = near[is_binary] if is_binary.any() else near
        is_usual = near.size > 0
        period = float(near[np.argmin(np.abs(near - estimate))]) if is_usual else span + quantum
    else:
        period = _TURN * max(1.0, round(estimate / _TURN))
        is_usual = span <= period * (1.0 + _PRIORS.period)
    if not is_usual:
        is_measured = leaps.size >= _MIN_LEAPS and scatter <= _PRIORS.measured * estimate and span > 100.0 * quantum
        if not is_measured:
            return None
        period = estimate
    sizes = np.abs(_wrap(steps, period))
    largest = float(np.quantile(sizes, _PRIORS.most))
    is_slow = largest <= _PRIORS.slow * period
    unfilled = 2.0 * (largest + quantum) + _PRIORS.period * period if is_slow else _PRIORS.spoilt * period
    fills = -_PRIORS.period * period <= period - span <= unfilled
    zone = 1.5 * largest + quantum + _PRIORS.period * period
    before, after = values[leaps], values[leaps + 1]
    at_ends = (np.maximum(before, after) >= high - zone) & (np.minimum(before, after) <= low + zone)
    is_single = is_usual and (unit == COUNTS or period == _TURN)
    if not fills or np.mean(at_ends) < 1.0 - _PRIORS.spoilt or not (is_slow or is_single):
        return None
    return _Period(period, largest)


def _wrap(steps: Array, period: float) -> Array:
    """Subtract whole periods from steps (n,), which are then at most half a period."""
    return np.asarray(steps - period * np.round(steps / period))


def _nearest_turns(steps: Array, intervals: Array, period: float) -> Array:
    """Count the periods to add to each of the `steps` (n,) that take the times `intervals` (n,) [s].

    The step is then the smallest, or over missing samples that nearest to the speed beside them.
    """
    turns = -np.round(steps / period)
    usual = float(np.median(intervals))
    gaps = np.flatnonzero(intervals > 1.5 * usual)
    if gaps.size and usual > 0.0:
        speeds = (steps + period * turns) / intervals
        speeds[gaps] = np.nan
        known = np.flatnonzero(np.isfinite(speeds))
        if known.size:
            place = np.clip(np.searchsorted(known, gaps), 1, max(1, known.size - 1))
            neighbour_speeds = 0.5 * (speeds[known[place - 1]] + speeds[known[place % known.size]])
            turns[gaps] = np.round((neighbour_speeds * intervals[gaps] - steps[gaps]) / period)
    return turns


def _predict_steps(
    steps: Array, rows: NDArray[np.intp], t: Array, period: float, unit: str, signals: Mapping[str, Array]
) -> Array | None:
    """Predict the steps (n,) of an angle from the first of the `signals` that tells them, or None.

    A signal tells them if its predictions, a gain times the signal, one gain for each sign, agree with nearly all steps
    but for whole periods, to a quarter of a period.
    """
    intervals = np.diff(t[rows])
    for name in ("omega", "x", "u"):
        if name not in signals:
            continue
        samples = signals[name][rows]
        changes = np.diff(samples) if name == "x" else 0.5 * (samples[1:] + samples[:-1]) * intervals
        if not np.isfinite(changes).all() or not changes.any():
            continue
        predictions = np.zeros(steps.size)
        for part in (changes > 0.0, changes < 0.0):
            if part.any():
                is_known = name == "omega" and unit != COUNTS
                gain = 1.0 if is_known else _fit_gain(steps[part], changes[part], period)
                predictions[part] = gain * changes[part]
        misfits = np.abs(_wrap(steps - predictions, period))
        if np.quantile(misfits, _PRIORS.most) < 0.25 * period:
            return predictions
    return None


def _fit_gain(steps: Array, changes: Array, period: float) -> float:
    """Fit the gain g for which the `steps` (n,) are g times the `changes` (n,), but for whole periods.

    It maximises |sum exp(2 pi i (steps - g changes) / period)| on a grid up to `_MAX_PERIODS` periods a sample.
    """
    thinned = slice(None, None, max(1, steps.size // _MAX_STEPS))
    phases, rates = _TURN * steps[thinned] / period, _TURN * changes[thinned] / period
    largest = float(np.quantile(np.abs(rates), _PRIORS.most))
    gains = np.arange(-_MAX_PERIODS, _MAX_PERIODS, 0.05) * _TURN / largest
    for _ in range(3):  # the grid, and two refinements
        coherence = [abs(complex(np.exp(1j * (phases - gain * rates)).mean())) for gain in gains.tolist()]
        best = int(np.argmax(coherence))
        width = gains[1] - gains[0]
        gain = float(gains[best])
        gains = np.linspace(gain - width, gain + width, 21)
    return gain
