"""Sequential tests on many series of many actuators: each against a reference it learns itself.

Model of a healthy machine: each series (a log RMS, one value a decision) is a level plus an AR(1) process with normal
innovations, ``y_k = c + phi y_(k-1) + e_k``. phi is learned from the pairs of neighbours so far, its bias taken out and
one standard error added on the cautious side; the innovations are then turned into

    z_k = N^-1(T_(n-1)((e_k - mean) / (sd sqrt(1 + 1/n)))),

mean and sd from the n pairs before, T Student's distribution. But for phi they are independent and standard normal
however short the learning was, so thresholds for known parameters hold (`run_length`). z is held at +-CLIP: one wild
value raises no alarm. The reference goes on learning, from values some decisions old, until an alarm: a sudden change
is found before it is learned, one that takes days is learned with the rest.
Source: D. M. Hawkins, Self-starting CUSUM charts, The Statistician 36 (1987) 299-315.
"""

from __future__ import annotations

import math

import numpy as np

from sealscope.compiled import kernel, law
from sealscope.signals.filters import Array, IntArray

#: Rows of a series' numbers: its first value, the last one (NaN: none), pairs of neighbours and the sums of their
#: values and squares and product; phi, the innovations' mean and sum of squared deviations; the CUSUMs.
ORIGIN, LAST, PAIRS, NOW, BEFORE, NOW2, BEFORE2, CROSS = range(8)
PHI, MEAN, SQUARES, UP, DOWN = range(8, 13)
NUMBERS = 13
#: Largest |z| that counts, and the smallest standard deviation of an innovation (of a log RMS).
CLIP, LEAST_DEVIATION = 4.0, 1e-6
_LARGEST_PHI = 0.95
#: Detectors by number.
CUSUM, GLR = 0, 1


@law
def standard_normal(t: float, freedom: float) -> float:
    """Return z with the probability of Student's t: ``sign(t) (8 f + 1)/(8 f + 3) sqrt(f ln(1 + t^2/f))``.

    Within 0.02 for f >= 8 and |z| <= 5. Source: D. L. Wallace, Bounds on normal approximations to Student's and the
    chi-square distributions, Annals of Mathematical Statistics 30 (1959) 1121-1130.
    """
    z = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0) * math.sqrt(freedom * math.log1p(t * t / freedom))
    return math.copysign(z, t)


@law
def _learn(numbers: Array, s: int, a: int, now: float, before: float) -> None:
    """Add a pair of neighbours; phi, and the innovations' mean and sum of squared deviations, over all pairs so far."""
    numbers[PAIRS, s, a] += 1.0
    numbers[NOW, s, a] += now
    numbers[BEFORE, s, a] += before
    numbers[NOW2, s, a] += now * now
    numbers[BEFORE2, s, a] += before * before
    numbers[CROSS, s, a] += now * before
    n, mean_now, mean_before = numbers[PAIRS, s, a], numbers[NOW, s, a], numbers[BEFORE, s, a]
    mean_now, mean_before = mean_now / n, mean_before / n
    now2 = max(0.0, numbers[NOW2, s, a] - n * mean_now * mean_now)
    before2 = max(0.0, numbers[BEFORE2, s, a] - n * mean_before * mean_before)
    cross = numbers[CROSS, s, a] - n * mean_now * mean_before
    phi = 0.0
    if now2 * before2 > 0.0:
        phi = cross / math.sqrt(now2 * before2)
        phi += (1.0 + 3.0 * phi) / n + math.sqrt(max(0.0, 1.0 - phi * phi) / n)
    phi = min(max(phi, 0.0), _LARGEST_PHI)
    numbers[PHI, s, a], numbers[MEAN, s, a] = phi, mean_now - phi * mean_before
    numbers[SQUARES, s, a] = max(now2 - 2.0 * phi * cross + phi * phi * before2, n * LEAST_DEVIATION**2)


@law
def _learn_held(numbers: Array, s: int, a: int, now: float, before: float) -> None:
    """Add a pair of neighbours, the later one held within CLIP deviations of what was to be expected."""
    expected = numbers[MEAN, s, a] + numbers[PHI, s, a] * before
    most = CLIP * math.sqrt(numbers[SQUARES, s, a] / (numbers[PAIRS, s, a] - 1.0))
    _learn(numbers, s, a, min(max(now, expected - most), expected + most), before)


@law
def _standard(numbers: Array, s: int, a: int, now: float, before: float) -> float:
    """Return z of a value after `before`, against the reference so far."""
    n = numbers[PAIRS, s, a]
    e = now - numbers[MEAN, s, a] - numbers[PHI, s, a] * before
    t = e / math.sqrt(numbers[SQUARES, s, a] / (n - 1.0) * (1.0 + 1.0 / n))
    return min(max(standard_normal(t, n - 2.0), -CLIP), CLIP)


@kernel
def judge(
    y: Array,
    decision: int,
    learn: int,
    limits: tuple[float, float, float],
    numbers: Array,
    began: IntArray,
    past: Array,
    paths: Array,
    steps: IntArray,
    scores: Array,
    alarms: IntArray,
) -> int:
    """Take one value of each series, y (series, actuators), NaN where there is none; returns how many new alarms.

    `limits`: h and k of the CUSUM, b of the likelihood ratio; `numbers`: (NUMBERS, series, actuators); `began`:
    (2, series, actuators) decision before which each CUSUM left zero; `past`: (late + 2, series, actuators) values
    that the reference has yet to learn, NaN where there is none; `paths`: (W + 1, series, actuators) sums of z;
    `steps`: (series, actuators) z so far; `scores`: (2, series, actuators) statistic over threshold; `alarms`:
    (5, actuators) decision of the alarm (-1: none), decision after which the change began, series, direction, detector.
    """
    h, k, b = limits
    series, actuators = y.shape
    turn, late = paths.shape[0], past.shape[0]
    new = 0
    for a in range(actuators):
        quiet = alarms[0, a] < 0
        for s in range(series):
            value = y[s, a]
            if not math.isfinite(value):
                numbers[LAST, s, a] = math.nan
                past[decision % late, s, a] = math.nan
                continue
            if math.isnan(numbers[ORIGIN, s, a]):
                numbers[ORIGIN, s, a] = value
            value -= numbers[ORIGIN, s, a]
            last = numbers[LAST, s, a]
            numbers[LAST, s, a] = value
            if math.isnan(last):
                past[decision % late, s, a] = value
                continue
            if numbers[PAIRS, s, a] < learn:
                _learn(numbers, s, a, value, last)
                continue
            z = _standard(numbers, s, a, value, last)
            past[decision % late, s, a] = value
            older, old = past[(decision + 1) % late, s, a], past[(decision + 2) % late, s, a]
            if quiet and not (math.isnan(old) or math.isnan(older)):
                _learn_held(numbers, s, a, old, older)
            for side in range(2):
                before = numbers[UP + side, s, a]
                if before == 0.0:
                    began[side, s, a] = decision
                numbers[UP + side, s, a] = max(0.0, before + (z if side == 0 else -z) - k)
            n = steps[s, a]
            path = paths[n % turn, s, a] + z
            steps[s, a] = n + 1
            paths[(n + 1) % turn, s, a] = path
            best, length, sign = 0.0, 0, 1
            for m in range(1, min(turn - 1, n + 1) + 1):
                rise = path - paths[(n + 1 - m) % turn, s, a]
                ratio = rise * rise / m
                if ratio > best:
                    best, length, sign = ratio, m, 1 if rise > 0 else -1
            side = 0 if numbers[UP, s, a] >= numbers[DOWN, s, a] else 1
            scores[CUSUM, s, a] = numbers[UP + side, s, a] / h
            scores[GLR, s, a] = math.sqrt(best) / b
            if quiet and max(scores[CUSUM, s, a], scores[GLR, s, a]) >= 1.0:
                quiet = False
                new += 1
                first = scores[CUSUM, s, a] >= 1.0
                alarms[0, a] = decision
                alarms[1, a] = began[side, s, a] - 1 if first else decision - length
                alarms[2, a] = s
                alarms[3, a] = (1 - 2 * side) if first else sign
                alarms[4, a] = CUSUM if first else GLR
    return new


@kernel
def forget(
    chosen: IntArray,
    numbers: Array,
    began: IntArray,
    past: Array,
    paths: Array,
    steps: IntArray,
    scores: Array,
    alarms: IntArray,
) -> None:
    """Set the chosen actuators' tests back to their beginning."""
    for a in chosen:
        numbers[:, :, a] = 0.0
        numbers[ORIGIN, :, a] = np.nan
        numbers[LAST, :, a] = np.nan
        began[:, :, a] = 0
        past[:, :, a] = np.nan
        paths[:, :, a] = 0.0
        steps[:, a] = 0
        scores[:, :, a] = 0.0
        alarms[:, a] = -1
