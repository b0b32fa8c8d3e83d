"""Changes of friction, load and sensors, from the levels of the chamber pressures in either direction of motion.

Four numbers are estimated in each block, during motion: of each chamber's pressure the level, and half its change from
motion with v < 0 to motion with v > 0. The force of the piston also depends on speed, acceleration and position, in the
same way throughout a recording,

    p_i = level_i + half_i sign(v) + b_i v + c_i dv/dt + d_i x,    i = A, B.

A leak between the chambers changes none of the four: the force that the piston needs determines the difference of the
pressures, the enclosed oil their mean. Another cause changes some of the four at one instant in a known pattern, a
subspace of the four dimensions. Each pattern is a hypothesis. Let S be the scatter of the differences between
neighbouring blocks, which contain little of slow drifts. Multiplied by S^(-1/2), the four numbers have white noise, and
each pattern has an orthonormal basis of m directions. In n blocks, score_j is twice the log likelihood ratio of a step
in direction j, without steps in the other directions. F_j is the ratio of the residual sums of squares without and with
that step, minus 1:

    F_j = exp(score_j / n) - 1,    score = max over onsets of n log(1 + sum_j F_j).

A pattern explains nothing of the other directions. Patterns are therefore compared by the likelihood of all c numbers
together, with one variance v: the sum over directions of the residual variance, with the step in those of the pattern
only. In c n numbers, with the largest log likelihood ratio L = c n / 2 log(v without a step / v) over all onsets and
the relative misfit e of a pattern (`tempering.pattern` in `priors.toml`),

    rank = 2 L / (1 + 2 e L) - (m - 1) log n.

Each further coefficient costs log n (G. Schwarz, Ann. Statist. 6 (1978) 461).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from sealscope.diagnosis.estimate.change import MIN_BLOCKS, RANK_TOLERANCE, Information, step_tests_of_columns
from sealscope.diagnosis.estimate.interval import Estimate, Interval
from sealscope.diagnosis.inference.equations.terms import HALF_DIFFERENCE, central_difference
from sealscope.diagnosis.inference.hypotheses import temper
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.motion import find_cycle
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.smoothing import TINY, quantiles

_PRIORS = CHANGES.levels
#: Most samples whose rows are computed together.
_STRETCH = 2**18
#: Iterations of the scatter of differences between blocks.
_SCATTER_ITERATIONS = 20
#: Channels that show a motion, in the order of preference.
MOTIONS = ("x", "theta", "omega", "u")
#: Unit changes of the four numbers of a block, level_A, level_B, half_A and half_B.
A, B, HALF_A, HALF_B = np.eye(4)
#: Names of a fall of both levels, by a loss of oil, and of a rise, which has many causes.
CHARGE, SUPPLY = "a loss of oil", "what feeds both chambers"
#: Name of a change of the friction, which changes with the direction of motion.
FRICTION = "friction"
#: Name of each pattern, and bases of its subspace: the load has three, each of which begins with a simpler pattern.
#: Friction has three patterns: both half changes, with the mean level, alone and oppositely, or with any levels.
PATTERNS: tuple[tuple[str, list[list[Array]]], ...] = (
    (CHARGE, [[A + B]]),
    (FRICTION, [[A + B, HALF_A, HALF_B]]),
    (FRICTION, [[HALF_A - HALF_B]]),
    (FRICTION, [[A, B, HALF_A, HALF_B]]),
    (SUPPLY, [[A + B, HALF_A + HALF_B]]),
    ("load", [[A, B], [B, A], [A + B, A]]),
    ("zero of p_A", [[A]]),
    ("zero of p_B", [[B]]),
)


def find_motion_channel(channels: Collection[str]) -> str | None:
    """Return the name of the channel that shows the motion best; None if none is recorded."""
    return next((name for name in MOTIONS if name in channels), None)


def motion_speed(channels: Mapping[str, Array], rate: float) -> Array | None:
    """Compute the speed of a motion (n,): the difference of x or theta over a fixed time, or else omega or u itself.

    `rate`: sampling rate [Hz]. Missing values are NaN. Return None if none of these channels is recorded.
    """
    name = find_motion_channel(channels)
    if name is None:
        return None
    values = channels[name]
    return central_difference(values, _half_length(rate)) if name in ("x", "theta") else values


def motion_columns(channels: Mapping[str, Array], rate: float, mean_position: float | None = None) -> Array | None:
    """Compute the columns that describe a motion (n, 2 or 3): speed, acceleration and, if recorded, position.

    The speed is that of `motion_speed`; the acceleration is its difference over the same time; the position is relative
    to its mean, or to `mean_position`. Return None without a speed.
    """
    speed = motion_speed(channels, rate)
    if speed is None:
        return None
    motion = [speed, central_difference(speed, _half_length(rate))]
    if find_motion_channel(channels) == "x":
        motion.append(channels["x"] - (np.nanmean(channels["x"]) if mean_position is None else mean_position))
    return np.column_stack(motion)


def _half_length(rate: float) -> int:
    """Compute half the time of the differences that are speeds [samples], at the sampling `rate` [Hz]."""
    return max(1, round(HALF_DIFFERENCE * rate))


def top_speed(speed: Array) -> float:
    """Compute the 99 % quantile of the magnitude of a speed (n,), NaN where missing."""
    magnitudes = np.abs(speed)
    return max(float(quantiles(magnitudes[~np.isnan(magnitudes)], 0.99)[0]), TINY)


def estimate_levels(recording: Recording) -> tuple[Array, Array] | None:
    """Estimate the levels of both pressures and their half changes with the direction of motion, in K blocks.

    Returns the middles of the blocks (K,) [s], and level_A, level_B, half_A and half_B of each, (K, 4) [Pa]. The slopes
    b, c and d of the module are common to the recording. Without a recorded motion the levels are means and the half
    changes zero. Several block lengths are tried, whole cycles first; the first with enough samples of both directions
    in every block is used. Return None if there is no such length, or if a pressure is not recorded.
    """
    if not {"p_A", "p_B"} <= set(recording.channels):
        return None
    means = np.array([recording["p_A"].mean(), recording["p_B"].mean()])
    measure = _LevelGrams(recording, means)
    lengths = [len(recording) // count for count in _PRIORS.blocks]  # block lengths [samples], the shortest first
    cycle = find_cycle(recording)
    if cycle is not None:  # try blocks of whole cycles first
        cycle_samples = cycle * recording.rate
        lengths.insert(0, round(math.ceil(lengths[0] / cycle_samples) * cycle_samples))
    min_count = _PRIORS.blocks[-1]  # long cycles may leave fewer blocks
    for length in lengths:
        count = len(recording) // max(length, 1)
        if length < 2 or count < min_count:  # a block needs both directions of motion
            continue
        values = fit_pressure_levels(measure.blocks(count, length), length, means)
        if values is not None:
            return recording.t[0] + (np.arange(count) + 0.5) * length / recording.rate, values
    return None


class _LevelGrams:
    """Gram matrices of the `pressure_level_rows` of a recording; many rows are computed some blocks at a time.

    `means` (2,) [Pa]: means of the pressures.
    """

    def __init__(self, recording: Recording, means: Array) -> None:
        needed = {"p_A", "p_B", find_motion_channel(recording.channels)}
        self._channels = {name: values for name, values in recording.channels.items() if name in needed}
        self._rate, self._means = recording.rate, means
        self._margin = 2 * _half_length(recording.rate)  # samples on which speed and acceleration depend
        self._max_speed = 0.0
        self._mean_position: float | None = None
        speed = motion_speed(self._channels, recording.rate)
        if speed is None:
            return
        is_known = np.isfinite(speed) & np.isfinite(central_difference(speed, _half_length(recording.rate)))
        if "x" in self._channels:
            is_known &= np.isfinite(self._channels["x"])
            self._mean_position = float(np.nanmean(self._channels["x"]))
        self._max_speed = top_speed(np.where(is_known, speed, 0.0))

    def blocks(self, count: int, length: int) -> Array:
        """Compute the Gram matrices (count, m, m) of the first `count` blocks of `length` samples."""
        if self._all_rows is not None:
            rows = self._all_rows[: count * length].reshape(count, length, -1)
            return np.asarray(rows.transpose(0, 2, 1) @ rows)
        size, grams = max(1, _STRETCH // length), list[Array]()
        for first in range(0, count, size):
            last = min(first + size, count)
            begin = max(0, first * length - self._margin)
            part = {name: values[begin : last * length + self._margin] for name, values in self._channels.items()}
            rows = self._compute_rows(part)
            blocks = rows[first * length - begin :][: (last - first) * length].reshape(last - first, length, -1)
            grams.append(blocks.transpose(0, 2, 1) @ blocks)
        return np.concatenate(grams)

    @cached_property
    def _all_rows(self) -> Array | None:
        """Rows of all samples, on which several lengths of blocks are tried; None for a long recording."""
        return self._compute_rows(self._channels) if len(self._channels["p_A"]) <= _STRETCH else None

    def _compute_rows(self, channels: Mapping[str, Array]) -> Array:
        """Compute the rows of samples, arrays by channel name."""
        return pressure_level_rows(channels, self._rate, self._means, self._max_speed, self._mean_position)


def pressure_level_rows(
    channels: Mapping[str, Array], rate: float, means: Array, max_speed: float, mean_position: float | None = None
) -> Array:
    """Build the rows (n, m) of the fit of pressure levels: 1, sign of the speed, motion (`motion_columns`), p_A, p_B.

    The rows of samples at rest or without a known motion are zero. If no motion is recorded, the rows are 1, p_A, p_B.
    `rate`: sampling rate [Hz]; `means` (2,) [Pa]: subtracted from the pressures, against rounding; `max_speed`: highest
    speed: a sample is at rest below the fraction `levels.slowest` (`priors.toml`) of it; `mean_position`: as in
    `motion_columns`.
    """
    motion = motion_columns(channels, rate, mean_position)
    n_motion = 0 if motion is None else 1 + motion.shape[1]
    rows = np.empty((len(channels["p_A"]), 3 + n_motion))
    rows[:, 0] = 1.0
    for place, (name, mean) in enumerate(zip(("p_A", "p_B"), means, strict=True)):
        np.subtract(channels[name], mean, out=rows[:, 1 + n_motion + place])
    if motion is None:
        return rows
    is_moving = np.abs(motion[:, 0]) > _PRIORS.slowest * max_speed
    if not np.isfinite(motion).all():
        is_known = np.isfinite(motion).all(axis=1)
        motion[~is_known] = 0.0
        is_moving &= is_known
    np.sign(motion[:, 0], out=rows[:, 1])
    rows[:, 2 : 1 + n_motion] = motion
    rows *= is_moving[:, None]
    return rows


def fit_pressure_levels(gram: Array, length: float, means: Array) -> Array | None:
    """Fit level_A, level_B, half_A and half_B in K blocks, (K, 4) [Pa]; None if a block has too few of one direction.

    Too few are less than `levels.least` (`priors.toml`) times `length`. `gram` (K, m, m): Gram matrices of
    `pressure_level_rows`; `length`: samples in a block; `means` (2,): means of the pressures that were subtracted in
    these rows [Pa].
    """
    # free in each block: the constant and, if a motion is recorded, sign(v); the last two columns are p_A and p_B
    n_free = min(2, gram.shape[1] - 2)
    if n_free == 2:
        # numbers of samples with v > 0 and with v < 0: (number of moving samples +- sum of sign(v)) / 2
        samples_each_way = 0.5 * (gram[:, 0, :1] + np.multiply.outer(gram[:, 0, 1], [1.0, -1.0]))
        if samples_each_way.min() < _PRIORS.least * length:
            return None
    free = np.linalg.solve(gram[:, :n_free, :n_free], gram[:, :n_free, n_free:])
    # eliminate the free coefficients of each block, then fit the motion's slopes to all blocks together
    reduced = (gram[:, n_free:, n_free:] - gram[:, n_free:, :n_free] @ free).sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(reduced)[:-2], TINY))[:, None]  # to a unit diagonal, against rounding
    normalised, right_sides = reduced[:-2, :-2] / scale / scale.T, reduced[:-2, -2:] / scale
    slopes = np.linalg.lstsq(normalised, right_sides, rcond=None)[0] / scale
    # level and half change of p_A and p_B, the free coefficients; half changes stay 0 without a recorded motion
    values = np.zeros((len(gram), 4))
    values[:, : 2 * n_free] = (free[:, :, -2:] - free[:, :, :-2] @ slopes).reshape(len(gram), -1)
    values[:, :2] += means
    return values


def level_tests(recording: Recording) -> tuple[Observable, ...]:
    """Test a recording for a step in each pattern of its pressure levels (`pattern_tests`)."""
    levels = estimate_levels(recording)
    return () if levels is None else pattern_tests(*levels)


def pattern_tests(time: Array, values: Array) -> tuple[Observable, ...]:
    """Test pressure levels for a step in each of several patterns; the most likely one (highest rank) comes first.

    A pattern (`PATTERNS`) is the combination of levels that one cause changes, such as friction or a sensor's offset.
    Those that cannot be tested are left out. `time` (K,), `values` (K, 4): as from `estimate_levels`.

    A step takes time, so that the block in which it begins shows neither the old nor the new levels. The tests are
    therefore repeated without the two blocks nearest to the most likely onset, and the order follows the ranks of this
    second pass. All else, such as the p-values, is from the first pass, with all blocks. With fewer than `MIN_BLOCKS` +
    2 blocks there is no second pass.

    The score of a result is its rank (see the module). The first is the best of n patterns, so that its p-value is n
    chance_1 (Bonferroni). That of pattern k is min(1, n chance_1 exp(rank_1 - rank_k)). The Bayes factor of pattern 1
    over pattern k (Schwarz's approximation) counts twice, once as evidence and once as a prior, because a pattern that
    explains only part of the change needs a second cause.
    """
    tests = _test_patterns(time, values)
    changes = [test for test in tests if test is not None]
    if changes and len(time) >= MIN_BLOCKS + 2:
        onset = max(changes, key=lambda change: change.score).onset
        assert onset is not None  # each of these results has one
        near_onset = np.argsort(np.abs(time - onset.value), kind="stable")[:2]
        reduced_tests = _test_patterns(np.delete(time, near_onset), np.delete(values, near_onset, axis=0))
        changes = [
            replace(test, score=reduced_test.score)
            for test, reduced_test in zip(tests, reduced_tests, strict=True)
            if test is not None and reduced_test is not None
        ]
    changes.sort(key=lambda change: -change.score)
    # 700: the largest exponent whose exponential is finite
    factors = [float(np.exp(min(changes[0].score - change.score, 700.0))) for change in changes]
    return tuple(
        replace(change, chance=min(1.0, len(changes) * changes[0].chance * factor))
        for change, factor in zip(changes, factors, strict=True)
    )


def _test_patterns(time: Array, values: Array) -> list[Observable | None]:
    """Test pressure levels for a step in each pattern (`pattern_tests`); None for a pattern that cannot be tested.

    The results are in the order of `PATTERNS`, followed by those for the scales of p_A and p_B.
    """
    mean = values.mean(axis=0)
    sum_of_levels = values[:, :2].sum(axis=1)
    # a step of a sensor's scale changes level and half change of that pressure in proportion to their means
    scales = (("scale of p_A", [[mean * (A + HALF_A)]]), ("scale of p_B", [[mean * (B + HALF_B)]]))
    if not np.ptp(values, axis=0).any():  # constant pressures have no errors by which steps are tested
        return [None] * (len(PATTERNS) + len(scales))
    whitening = _whitening_matrix(values)
    changes = list[Observable | None]()
    for name, bases in (*PATTERNS, *scales):
        tests = [_test_pattern(name, np.array(basis) @ whitening.T, values @ whitening.T, time) for basis in bases]
        # the rank depends on the basis, as each direction has a random walk of its own: a pattern must be supported by
        # each of its bases, so that the lowest rank counts
        change = min((test for test in tests if test is not None), key=lambda test: test.score, default=None)
        if change is not None and change.onset is not None:
            # a loss of oil (CHARGE) lowers the sum of both levels; if it does not fall, the supply feeds both chambers
            after = time > change.onset.value
            is_falling = after.any() and not after.all() and sum_of_levels[after].mean() <= sum_of_levels[~after].mean()
            if name == CHARGE and not is_falling:
                change = replace(change, name=SUPPLY)
            if name == FRICTION:
                change = replace(change, pressure_scale=_pressure_scale(values[~after], values[after]))
        changes.append(change)
    return changes


def _pressure_scale(before: Array, after: Array) -> Estimate | None:
    """Compute the logarithm of the factor on both pressures that would explain a change of the friction.

    `before`, `after` (k, 4) [Pa]: level_A, level_B, half_A and half_B of the blocks before and after the change. Only
    the half changes are used: half_A - half_B is the friction. Return None if there are fewer than two blocks before or
    after, or if a mean friction is not positive.
    """
    if min(len(before), len(after)) < 2:
        return None
    frictions = [values @ (HALF_A - HALF_B) for values in (before, after)]
    means = [float(friction.mean()) for friction in frictions]
    if not min(means) > 0.0:
        return None
    errors = [friction.std(ddof=1) / math.sqrt(len(friction)) for friction in frictions]
    return Estimate(math.log(means[1] / means[0]), math.hypot(errors[0] / means[0], errors[1] / means[1]))


def _whitening_matrix(values: Array) -> Array:
    """Compute the matrix (c, 4) that transforms pressure levels to c numbers with independent errors of equal variance.

    The matrix W is a root of the inverse of S, W' W = S^-1. S is the maximum-likelihood estimate of the scatter matrix
    of the differences between neighbouring blocks, under a multivariate t distribution, so that the large differences
    at a step have little weight (K. L. Lange et al., J. Am. Statist. Assoc. 84 (1989) 881). `values` (K, 4): levels of
    the blocks; c: number of its columns that are not constant.
    """
    varying = np.flatnonzero(np.ptp(values, axis=0) > 0.0)  # a machine that never moves has constant levels
    differences = np.diff(values[:, varying], axis=0)
    deviations = np.sqrt((differences**2).mean(axis=0))
    differences = differences / deviations
    scatter = differences.T @ differences / len(differences)
    for _ in range(_SCATTER_ITERATIONS):
        eigen, basis = np.linalg.eigh(scatter)
        is_known = eigen > np.finfo(float).eps * eigen[-1]
        squares = ((differences @ basis[:, is_known]) ** 2 / eigen[is_known]).sum(axis=1)
        weights = (_PRIORS.freedom + len(varying)) / (_PRIORS.freedom + squares)
        scatter = (differences * weights[:, None]).T @ differences / len(differences)
    eigen, basis = np.linalg.eigh(scatter)
    matrix = np.zeros((len(varying), 4))
    matrix[:, varying] = (basis / np.sqrt(np.maximum(eigen, RANK_TOLERANCE * eigen[-1]))) @ basis.T / deviations
    return matrix


def _test_pattern(name: str, rows: Array, whitened: Array, time: Array) -> Observable | None:
    """Test the pressure levels for a step in one pattern, i.e. within a subspace of their possible changes.

    `rows` (m, c): vectors that span the subspace; `whitened` (K, c): levels in K blocks, both multiplied by the
    `_whitening_matrix`; `time` (K,): times of the blocks [s]. Return None if the vectors are zero, or if a direction
    cannot be tested. The score of the result is the rank, for which all directions have one variance in common. For the
    p-value only the directions of the pattern count, each with its own variance (formulas: see the module).
    """
    # orthonormal directions: those of the pattern, without vectors that depend on earlier ones, and the others, which
    # it does not change
    directions, triangle = np.linalg.qr(rows.T, mode="complete")
    sizes = np.abs(np.diag(triangle))
    is_changed = np.zeros(len(directions), dtype=bool)
    is_changed[: len(sizes)] = sizes > RANK_TOLERANCE * np.abs(triangle).max()
    n_blocks, n_directions = len(time), int(np.count_nonzero(is_changed))
    if not n_directions:
        return None
    directions = np.column_stack([directions[:, is_changed], directions[:, ~is_changed]])
    tested = step_tests_of_columns(Information(time, np.eye(n_blocks), whitened @ directions), n_directions)
    if tested is None:
        return None
    tests, likelihood_without = tested
    # variance of each direction without a step, and with a step at each onset, which is at most as large: v for the log
    # likelihood -n log(v) / 2
    likelihood = np.array([test.likelihood for test in tests])
    variance_without = np.exp(-2.0 / n_blocks * likelihood_without)
    variance = np.minimum(np.exp(-2.0 / n_blocks * likelihood), variance_without[:n_directions, None])
    unexplained = variance_without[n_directions:].sum()
    n_values = len(directions) * n_blocks
    log_ratios = 0.5 * n_values * np.log(variance_without.sum() / (variance.sum(axis=0) + unexplained))
    best = int(np.argmax(log_ratios))
    log_ratio = float(log_ratios[best])
    # a pattern describes the levels only approximately
    rank = 2.0 * temper(log_ratio, log_ratio, INFERENCE.tempering.pattern) - (n_directions - 1) * math.log(n_blocks)
    # sum over the pattern's directions of F = variance without a step / variance with it - 1
    gains = np.log1p((variance_without[:n_directions, None] / variance - 1.0).sum(axis=0))
    score = n_blocks * float(gains.max())
    # up or down in each direction, by the law under which the score is the most probable
    chance = 2.0 * n_directions * max(test.law.chance(score) for test in tests)
    onset, block = float(tests[0].onsets[best]), float(time[1] - time[0])  # onsets are the same in all directions
    interval = Interval(onset, onset - block, onset + block)
    return Observable(name=name, data="levels", score=rank, chance=min(1.0, chance), onset=interval)
