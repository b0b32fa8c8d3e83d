"""Test for a step of a coefficient within a recording: likelihood ratio over all onsets, against a random walk.

A step is a sudden, lasting change, as by a leak that begins within the recording. The likelihood of one coefficient g
in K blocks of time is `Information`(Lambda, eta). In a healthy machine g has a level and a slope, F a, and a random
walk w. With a leak it also has a step of size delta, whose shape s is 0 before the onset and 1 after it. z are the
whitened estimates:

    g = F a + w + delta s(onset),    z = Lambda^(-1/2) eta ~ N(Lambda^(1/2) g, kappa I),    cov w = kappa q min(k, l),

where kappa is the inflation of the noise by the correlation of the rows, and kappa q the variance of the walk in a
block. F is projected out, and so is a further change of known shape, if a healthy machine may show one. (q, kappa) are
estimated with the step and without it; one eigenproblem serves all onsets and all q. The score is twice the logarithm
of the likelihood ratio, for steps > 0. If the onset lies within a block, that block shows a fraction of the step.

The probability of the score in a healthy machine follows from geometry. For a known q the whitened z is uniform on a
sphere in n = K - 2 dimensions, and steps over all onsets form a curve of length L on it. The angle between z and the
best onset has the cosine c, with c^2 = 1 - exp(-score/n). The probability that z lies that close to the curve is the
probability of a tube about it, with the regularised incomplete beta function I,

    P = I_{1-c^2}((m - 1)/2, 1/2) / 2 + L / (2 pi) (1 - c^2)^((m - 2)/2),    1 - c^2 = exp(-score/m),    m = n.

q is not known, and a walk can look like a step: removing the step makes the fitted walk smaller. This has two
consequences. First, L is the largest length over the walks that the recording allows, i.e. those whose likelihood is
within `ALLOWED` of the largest, without the step or with it (the supremum over a confidence set). L grows with q, from
26 for no walk to 88 for nothing but a walk (60 blocks). Second, the residuals estimate two variances, of noise and
walk. At worst half of the degrees of freedom go to each: m = min(n, n/2 + 2). Of random healthy draws (2 800 to 12 000
for each of 5 to 120 blocks, and for walks of 0 to 100 times the variance of the noise), 0.0 to 1.2 % then have P below
1 %; with m = n and L of the fitted walks it would be 0.1 to 2.0 %.

Sources: H. Hotelling, Amer. J. Math. 61 (1939) 440; M. Knowles and D. Siegmund, Int. Statist. Rev. 57 (1989) 205
(tubes); R. B. Davies, Biometrika 74 (1987) 33 (a parameter present under the alternative only); R. L. Berger and
D. D. Boos, J. Am. Statist. Assoc. 89 (1994) 1012 (supremum over a confidence set).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.evaluation.scalar_search import find_root
from sealscope.recordings.recording import Array

#: Probability with which a stated upper bound, or a stated interval, contains the true value.
BOUND_PROBABILITY = 0.95
#: Quantiles of the standard normal distribution for such an interval and such an upper bound: 1.96 and 1.645.
WITHIN_95 = round(NormalDist().inv_cdf(0.5 + 0.5 * BOUND_PROBABILITY), 2)
UPPER_95 = round(NormalDist().inv_cdf(BOUND_PROBABILITY), 3)
#: Minimum number of blocks, for a level, a slope, a step and its standard error.
MIN_BLOCKS = 5
#: Number of possible onsets per block, and number of blocks at either end of a recording without a possible onset.
PARTS, EDGE = 5, 2
#: Grid of the variance q of the random walk, in units of `_Whitening.unit`; 0: no walk.
WALKS = np.concatenate([[0.0], 10.0 ** np.linspace(-4.0, 3.0, 29)])
#: Log likelihood by which an allowed walk may be less likely than the best one: 99.7 % of chi square(1).
ALLOWED = 4.5
#: Eigenvalues below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-9


class Information(NamedTuple):
    """Likelihood of one coefficient g (K,) in K blocks of a recording: exp(vector g - g precision g / 2).

    `time` (K,): middles of the blocks [s]; `precision` (K, K): inverse covariance of the estimates of g; `vector` (K,):
    precision times these estimates. Scales of priors, in the unit of g, infinite without a prior:

    - `level`: standard deviation of the coefficient before the first block;
    - `slope`: standard deviation of a linear change over all blocks;
    - `walk`: scale of a half-Cauchy prior on the standard deviation that a random walk reaches over all blocks;
    - `disturbance`: standard deviation of the factor of `shape` (K,), a further change that a healthy machine shows.
    """

    time: Array
    precision: Array
    vector: Array
    level: float = float("inf")
    slope: float = float("inf")
    walk: float = float("inf")
    disturbance: float = float("inf")
    shape: Array | None = None

    def fraction_after(self, onset: float) -> float:
        """Compute the fraction of the coefficient's information that lies in the blocks after `onset` [s], 0 to 1."""
        weights = self.precision.sum(axis=0)
        after = weights[self.time >= onset].sum()
        return float(np.clip(after / max(weights.sum(), np.finfo(float).tiny), 0.0, 1.0))


class Estimate(NamedTuple):
    """An estimate `value` and its standard error `deviation`."""

    value: float
    deviation: float

    def nonnegative_interval(self) -> Interval:
        """Compute the 95 % interval of a quantity that is never below 0, such as a flow down a pressure difference.

        Where the interval of the normal distribution begins below 0, it is that from 0 to the 95 % quantile of the
        distribution truncated at 0, and the value is at least 0.
        """
        half_width = WITHIN_95 * self.deviation
        if self.value >= half_width:
            return Interval(self.value, self.value - half_width, self.value + half_width)
        from scipy.special import log_ndtr, ndtri_exp

        log_tail = math.log(1.0 - BOUND_PROBABILITY) + float(log_ndtr(self.value / self.deviation))
        high = self.value - self.deviation * float(ndtri_exp(log_tail))
        return Interval(max(self.value, 0.0), 0.0, high)


class Interval(NamedTuple):
    """An estimate `value` with its 95 % interval from `low` to `high`."""

    value: float
    low: float
    high: float

    @property
    def deviation(self) -> float:
        """Standard deviation of a normal distribution with a 95 % interval of this width."""
        return (self.high - self.low) / (2.0 * WITHIN_95)


@dataclass(frozen=True, eq=False)
class StepTest:
    """Result of the test for a step, a sudden lasting change, of one coefficient at an unknown onset (`step_test`).

    Parameters
    ----------
    score : float
        Twice the logarithm of the likelihood ratio of the best step.
    best : int
        Index of the most likely onset.
    positions, onsets : array of float, shape (o,)
        Onsets that were tried, counted in blocks, and as times [s]. A prior on the level counts as one block before the
        first.
    likelihood : array of float, shape (o,)
        Log likelihood of a step at each onset, with fitted size and random walk.
    size, deviation : array of float, shape (o,)
        Step at each onset and its standard error, with the walk's variance as fitted without a step.
    fitted : Estimate
        Step at the best onset and its standard error, with the walk's variance as fitted together with it.
    walk, noise : tuple of two floats
        Variance q of the walk over that of the noise, and the latter, kappa, each without a step and with the best one.
    law : NullLaw
        Distribution of the score under the null.
    sign : float
        1 for a step up; -1 for a step down, whose sizes are stated as positive.
    """

    score: float
    best: int
    positions: Array
    onsets: Array
    likelihood: Array
    size: Array
    deviation: Array
    fitted: Estimate
    walk: tuple[float, float]
    noise: tuple[float, float]
    law: NullLaw
    sign: float

    @cached_property
    def chance(self) -> float:
        """Probability that a coefficient without a step scores as high."""
        return self.law.chance(self.score)

    @cached_property
    def weights(self) -> Array:
        """Probability of each tried onset (o,), given that there is a step; a priori all are equally probable."""
        weights = np.exp(self.likelihood - self.likelihood.max())
        return np.asarray(weights / weights.sum())

    def onset(self) -> Interval:
        """Return the most likely onset of the step [s] with its 95 % interval.

        The interval is widened at both ends by half a block, i.e. by `PARTS` / 2 times the spacing of the onsets: the
        rows in the block of the onset are weighted as if the leak were there in the whole block or not at all.
        """
        tail = 0.5 - 0.5 * BOUND_PROBABILITY  # on either side of the interval
        low, high = np.interp([tail, 1.0 - tail], np.cumsum(self.weights), self.onsets)
        best = float(self.onsets[self.best])
        spacing = float(self.onsets[1] - self.onsets[0]) if len(self.onsets) > 1 else 0.0
        half_block = 0.5 * PARTS * spacing
        return Interval(best, min(float(low), best) - half_block, max(float(high), best) + half_block)

    def bound(self) -> float:
        """Compute the 95 % upper bound of the step, in the unit of the coefficient (`bound_steps`)."""
        return bound_steps(self.weights, self.size, self.deviation, BOUND_PROBABILITY)

    def share_alarms(self, share: float) -> StepTest:
        """Return this test with its p-value divided by `share`, its fraction of a joint false-alarm probability."""
        return replace(self, law=self.law._replace(share=share))

    def detectable_step(self, chance: float, power: float = 0.9) -> float:
        """Compute the smallest step that is detected with the probability `power`, in the unit of the coefficient.

        It is for an onset with the median standard error. `chance`: probability that the test finds a step where there
        is none; it sets the threshold of the score.
        """
        threshold_z = np.sqrt(self.threshold(chance))  # the score is about the square of a z score
        return float((threshold_z + NormalDist().inv_cdf(power)) * np.median(self.deviation))

    def threshold(self, chance: float) -> float:
        """Compute the score that a coefficient without a step exceeds with the probability `chance`, at most 10 000."""
        max_score = 1e4  # upper end of the search; such a score has practically no probability
        if self.law.chance(0.0) <= chance:
            return 0.0
        if not chance > self.law.chance(max_score):
            return max_score
        return find_root(lambda score: self.law.chance(score) - chance, 0.0, max_score)


def bound_steps(weights: Array, size: Array, deviation: Array, probability: float) -> float:
    """Compute the upper bound of a step: the quantile of its size at `probability`, given that the size is > 0.

    `weights`, `size`, `deviation` (k,): for each of k onsets its probability, and the size of the step there with its
    standard error. If a step up has the probability 0 by rounding, or all sizes are below 0 by 12 standard errors, the
    result is the largest conceivable size, but at least 0.
    """
    from scipy.special import ndtr

    deviation = np.maximum(deviation, np.finfo(float).tiny)
    probability_up = float(weights @ ndtr(size / deviation))
    max_step = float(np.max(size + 12.0 * deviation))  # larger steps have practically no probability
    if not probability_up > 0.0 or not max_step > 0.0:
        return max(max_step, 0.0)

    def excess_chance(fraction: float) -> float:
        """Compute P(step > `fraction` * `max_step`) - (1 - `probability`) P(step > 0), whose root is the bound."""
        return float(weights @ ndtr((size - fraction * max_step) / deviation)) - (1.0 - probability) * probability_up

    return max_step * find_root(excess_chance, 0.0, 1.0) if excess_chance(1.0) < 0.0 else max_step


class History(NamedTuple):
    """Estimate of a coefficient in each of K blocks: `mean` (K,) and `covariance` (K, K)."""

    mean: Array
    covariance: Array

    def average(self, weights: Array) -> Interval:
        """Compute the weighted mean of the coefficient and its 95 % interval; the `weights` (K,) have the sum 1."""
        value = float(weights @ self.mean)
        half_width = WITHIN_95 * float(np.sqrt(np.maximum(weights @ self.covariance @ weights, 0.0)))
        return Interval(value, value - half_width, value + half_width)

    def relative_to(self, before: NDArray[np.bool_]) -> History:
        """Return the history minus its mean over the blocks flagged in `before` (K,); unchanged if there are none."""
        # subtracts the mean over the flagged blocks from the coefficient in each block
        transform = np.eye(len(before)) - before / max(int(np.count_nonzero(before)), 1)
        return History(transform @ self.mean, transform @ self.covariance @ transform.T)


def fit_history(information: Information, test: StepTest | None, *, with_step: bool) -> History:
    """Estimate a coefficient in each block of a recording, as the sum of a level, a slope and a random walk.

    `information`: likelihood of the coefficient in the blocks; `test`: its step test, whose fitted variances of walk
    and noise are used. Without a test there is no walk, and the noise has the variance 1. With fewer than `MIN_BLOCKS`
    blocks there is no slope. Of the priors of `information` only that on the slope is used; the noise inflates its
    variance, too. `with_step`: add a step at the best onset of `test`, and use the variances that were fitted together
    with it.
    """
    time, count = information.time, len(information.time)
    noise, walk = 1.0, 0.0  # variances
    if test is not None:
        noise, walk = test.noise[with_step], test.walk[with_step]  # index 0: fitted without a step, 1: with a step
    columns = [np.ones(count)]  # level
    prior = [0.0]  # precision of each column's coefficient
    if count >= MIN_BLOCKS:
        columns.append((np.arange(count) - 0.5 * (count - 1)) / count)  # slope
        prior.append(information.slope**-2)
    if with_step and test is not None:  # fraction of each block after the onset
        columns.append(np.clip((time - test.onsets[test.best]) / (time[1] - time[0]) + 0.5, 0.0, 1.0))
        prior.append(0.0)
    if walk > 0.0:  # a step of normal size in each block
        columns.append(np.sqrt(walk) * np.tril(np.ones((count, count))))
        prior += [1.0] * count
    basis = np.column_stack(columns)
    precision = (basis.T @ information.precision @ basis + np.diag(prior)) / noise
    scale = np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))  # to a unit diagonal, against rounding
    inverse = np.linalg.pinv(precision / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    mean = basis @ (inverse @ (basis.T @ information.vector / noise))
    return History(mean, basis @ inverse @ basis.T)


class NullLaw(NamedTuple):
    """Distribution of the score of a step test in a healthy machine (formula: see the module).

    `dimensions`: degrees of freedom m; `length`: length L of the curve of all steps on the unit sphere; `share`:
    fraction of the false alarms that this test gets among several.
    """

    dimensions: float
    length: float
    share: float = 1.0

    def chance(self, score: float) -> float:
        """Compute the probability P of a higher score without a step, divided by `share`; at most 1."""
        from scipy.special import betainc

        m = self.dimensions
        sine_squared = float(np.exp(-max(score, 0.0) / m))  # 1 - c^2 of the module
        tube = self.length / (2.0 * np.pi) * float(sine_squared ** (0.5 * (m - 2)))
        return min(1.0, (0.5 * float(betainc(0.5 * (m - 1), 0.5, sine_squared)) + tube) / self.share)


def step_test(information: Information, signs: Sequence[float] = (1.0,), shape: Array | None = None) -> StepTest | None:
    """Test a coefficient for a step, a sudden lasting change, at an unknown onset.

    `signs`: 1 to test for a step up, -1 for a step down; `shape` (K,): change of the coefficient in each block by a
    unit step, by default 1. Of two signs the test with the higher score is returned, and the probability of a false
    alarm is twice its `chance`. Return None if too few blocks have information.
    """
    return max(step_tests(information, signs, shape), key=lambda test: test.score, default=None)


def step_tests(information: Information, signs: Sequence[float], shape: Array | None = None) -> list[StepTest]:
    """Test a coefficient for a step of each sign, 1 up or -1 down (`step_test`); empty with too few blocks."""
    whitened = _whiten_blocks(information)
    if whitened is None:
        return []
    whitening, z, onsets = whitened
    steps = whitening.unit_steps if shape is None else whitening.transform_steps(whitening.positions, shape)
    fits = whitening.fit_steps(z, steps)
    return [_test_step(whitening, onsets, steps, fits, sign) for sign in signs]


def step_sizes(
    information: Information, onsets: NDArray[np.intp], shape: Array, growth: float
) -> tuple[Array, Array, Array]:
    """Estimate the size of a step up of a coefficient, for each of o possible onsets.

    The coefficient also has a level, a slope and a random walk, whose likeliest variance is used at each onset.
    `onsets` (o,): indices of the onsets in `StepTest.onsets`; `shape` (K,): change of the coefficient in each block by
    a unit step; `growth`: as in `step_shapes`. Returns the log likelihood ratio of the step to no step, its size
    (negative where only a step down would fit), and the standard error of the size, (o,) each.
    """
    whitened = _whiten_blocks(information)
    assert whitened is not None  # else there is no step test with onsets
    whitening, z, _ = whitened
    fits = whitening.fit_steps(z, whitening.transform_steps(whitening.positions[onsets], shape, growth))
    squares = fits.residual_squares()
    log_ratios = fits.log_likelihood(squares) - fits.log_likelihood(fits.total).max()  # (walk, onset)
    likeliest_walk = log_ratios.argmax(axis=0), np.arange(len(onsets))
    sizes, variances = fits.moments / fits.energies, squares / len(z) / fits.energies
    return log_ratios[likeliest_walk], sizes[likeliest_walk], np.sqrt(variances)[likeliest_walk]


class _StepFits(NamedTuple):
    """Least-squares fits of a step to n whitened values z, for each of w walks (`WALKS`) and of o onsets.

    `weight` (w, n): variance of the noise over that of each z; `log_factor` (w,): half the log determinant of the
    weights, plus the log prior of the walk. Sums with these weights: `total` (w,): squares of z; `moments`, `energies`
    (w, o): products of the steps with z and with themselves.
    """

    weight: Array
    log_factor: Array
    total: Array
    moments: Array
    energies: Array

    def residual_squares(self) -> Array:
        """Compute the sums of squares (w, o) that remain after the fit of a step up; a step down is not fitted."""
        total = self.total[:, None]
        # positive, since the logarithm is used
        return np.asarray(np.maximum(total - np.maximum(self.moments, 0.0) ** 2 / self.energies, 1e-12 * total))

    def log_likelihood(self, squares: Array) -> Array:
        """Compute the log likelihood, with the prior on the walk, from the remaining `squares` (w,) or (w, o) of z.

        The variance of the noise is the likeliest one.
        """
        n = self.weight.shape[1]
        return np.asarray(
            (self.log_factor - 0.5 * n * np.log(squares.T / n)).T
        )  # transposed: the walk is the last axis


def step_shapes(count: int, positions: Array, growth: float = 0.0) -> Array:
    """Compute the mean of a unit step in each of `count` = K blocks, for each of o onsets, shape (K, o).

    `positions` (o,): onsets, counted in blocks from the start. From its onset within a block on, the step grows
    linearly from 1 to 1 + `growth` at the end of the last block. If `growth` is infinite, it grows from 0 to 1. The
    growth within a block is that in its middle.
    """
    end_since_onset = np.arange(count)[:, None] + 1.0 - positions  # end of each block minus onset, (K, o)
    steps, middle_since_onset = np.clip(end_since_onset, 0.0, 1.0), end_since_onset - 0.5
    # 1.0: no division by zero for an onset at the end
    grown_fraction = np.clip(middle_since_onset / np.maximum(count - positions, 1.0), 0.0, 1.0)
    growing = grown_fraction if np.isinf(growth) else 1.0 + growth * grown_fraction
    return np.asarray(steps * growing)


class _WhitenedSteps:
    """Unit steps at each of o onsets, transformed to n whitened values, with what does not depend on these values.

    `steps` (n, o): changes of the values; `weight` (w, n): as in `_StepFits`.
    """

    def __init__(self, steps: Array, weight: Array) -> None:
        self.steps, self.weight = steps, weight

    @cached_property
    def energies(self) -> Array:
        """Weighted sums of squares of each step, for each walk, (w, o)."""
        return np.maximum(self.weight @ self.steps**2, np.finfo(float).tiny)

    @cached_property
    def lengths(self) -> Array:
        """Length of the curve of all steps on the unit sphere, for each walk, (w,).

        It is the sum of the angles between the steps at neighbouring onsets.
        """
        norm = np.sqrt(self.energies)
        cosines = (self.weight @ (self.steps[:, 1:] * self.steps[:, :-1])) / (norm[:, 1:] * norm[:, :-1])
        return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)).sum(axis=1))


@dataclass(frozen=True, eq=False)
class _Whitening:
    """Matrices that whiten the estimates of a coefficient in K blocks, from their precision and priors only.

    The whitened values z (n,) have independent noise of variance 1. Level, slope and a further change of known shape
    are projected out.

    - `transform` (n, K): matrix from the coefficient to z; `from_vector` (n, K): from the `vector` of `Information`;
    - `eigen` (n,): variances of z by a random walk, whose steps have the variance `unit`;
    - `unit`: variance of the walk's steps at which it adds on average as much to z as the noise;
    - `positions` (o,): possible onsets, counted in blocks;
    - `walk_log_priors` (w,): log prior of each variance in `WALKS`.
    """

    transform: Array
    from_vector: Array
    eigen: Array
    unit: float
    positions: Array
    walk_log_priors: Array

    @cached_property
    def weight(self) -> Array:
        """Variance of the noise over that of each whitened value, for each walk, (w, n)."""
        return np.asarray(1.0 / (1.0 + WALKS[:, None] * self.eigen))

    @cached_property
    def log_factor(self) -> Array:
        """Half the log determinant of the weights, plus the log prior of the walk, (w,)."""
        return np.asarray(0.5 * np.log(self.weight).sum(axis=1) + self.walk_log_priors)

    @cached_property
    def unit_steps(self) -> _WhitenedSteps:
        """Unit steps of the coefficient itself at all possible onsets."""
        return self.transform_steps(self.positions)

    def transform_steps(self, positions: Array, shape: Array | None = None, growth: float = 0.0) -> _WhitenedSteps:
        """Compute the change of the n whitened values by a unit step at each of o onsets.

        `positions`, `growth`: as in `step_shapes`; `shape`: factor on the step in each block of the recording, by
        default 1. The block that a prior on the level adds needs no factor: it precedes every onset.
        """
        count = self.transform.shape[1]
        steps = step_shapes(count, positions, growth)
        if shape is not None:
            steps[count - len(shape) :] *= shape[:, None]  # the blocks of the recording
        return _WhitenedSteps(np.asarray(self.transform @ steps), self.weight)

    def fit_steps(self, z: Array, steps: _WhitenedSteps) -> _StepFits:
        """Fit a step to whitened values `z` (n,) by weighted least squares, at each onset of the unit `steps`."""
        total = np.maximum((self.weight * z**2).sum(axis=1), np.finfo(float).tiny)
        return _StepFits(self.weight, self.log_factor, total, (self.weight * z) @ steps.steps, steps.energies)


def _whiten_blocks(information: Information) -> tuple[_Whitening, Array, Array] | None:
    """Transform the estimates of a coefficient in blocks to independent values of variance 1.

    Returns the matrices of this transform, the values z (n,), and the times of the possible onsets (o,) [s]. A finite
    prior on the level counts as one more block before the first. Returns None if too few blocks determine the
    coefficient, or if the precision is not finite.
    """
    time, precision, vector, level, slope, walk, disturbance, shape = information
    if np.isfinite(level) and len(time) >= MIN_BLOCKS:  # the added block must not count towards this number
        time, vector = np.append(2.0 * time[0] - time[1], time), np.append(0.0, vector)
        precision = np.pad(precision, (1, 0))
        precision[0, 0] = 1.0 / level**2
    if not np.isfinite(precision).all():
        return None
    if shape is not None:
        shape = np.pad(shape, (len(time) - len(shape), 0))
    whitening = _find_whitening(
        precision.tobytes(), len(time), slope, walk, None if shape is None else shape.tobytes(), disturbance
    )
    if whitening is None:
        return None
    # edges of the blocks: half way between their middles, extrapolated at both ends
    first_edge, last_edge = 1.5 * time[0] - 0.5 * time[1], 1.5 * time[-1] - 0.5 * time[-2]
    edges = np.concatenate([[first_edge], 0.5 * (time[1:] + time[:-1]), [last_edge]])
    onsets = np.interp(whitening.positions, np.arange(len(edges)), edges)
    return whitening, whitening.from_vector @ vector, onsets


@lru_cache(maxsize=16)
def _find_whitening(
    precision: bytes, count: int, slope: float, walk: float, shape: bytes | None, disturbance: float
) -> _Whitening | None:
    """Build the matrices of `_build_whitening`, once for the tests of all laws, growths and shapes of a coefficient.

    `precision`, `shape`: bytes of the arrays of doubles, `precision` with `count` rows.
    """
    shape_values = None if shape is None else np.frombuffer(shape)
    return _build_whitening(np.frombuffer(precision).reshape(count, count), slope, walk, shape_values, disturbance)


def _build_whitening(
    precision: Array, slope: float, walk: float, shape: Array | None = None, disturbance: float = float("inf")
) -> _Whitening | None:
    """Build the matrices that turn the estimates of a coefficient in K blocks into independent values.

    The values do not depend on level and slope of the coefficient, nor on a multiple of `shape` (K,), if it is given.
    `precision` (K, K): inverse covariance of the estimates; `slope`, `walk`, `disturbance`: scales of the priors on the
    slope, on the random walk over all blocks, and on the multiple (`Information`). Return None if too few blocks have
    information.
    """
    count = len(precision)
    # z = Lambda^(-1/2) eta of the module, restricted to the eigenvectors of the precision Lambda with information
    values, vectors = np.linalg.eigh(precision)
    is_informative = values > RANK_TOLERANCE * max(float(values[-1]), 0.0)
    n_informative = np.count_nonzero(is_informative)
    if count < MIN_BLOCKS or n_informative < MIN_BLOCKS:
        return None
    root, vectors = np.sqrt(values[is_informative]), vectors[:, is_informative]
    index = np.arange(count)
    changes = [np.ones(count), (index - index.mean()) / count]  # level and slope
    scales = [np.inf, slope]
    if shape is not None:
        changes.append(shape)
        scales.append(disturbance)
    design = (vectors * root).T  # matrix from the coefficient in all blocks to z
    priors = np.diag(1.0 / np.array(scales))[np.isfinite(scales)]  # each is one more estimate, of 0
    fixed = np.vstack([design @ np.column_stack(changes), priors])
    # the remaining columns of the full Q span the complement of level, slope and shape; the priors' rows multiply 0
    complement = np.linalg.qr(fixed, mode="complete")[0][:n_informative, len(scales) :].T
    transform = complement @ design
    # covariance of a walk with steps of variance 1, which is min(k, l) for blocks k and l counted from 1
    covariance = transform @ (np.minimum.outer(index, index) + 1.0) @ transform.T
    unit = len(complement) / max(float(np.trace(covariance)), np.finfo(float).tiny)
    eigen, basis = np.linalg.eigh(unit * covariance)
    transform = basis.T @ transform
    positions = np.arange(EDGE, count - EDGE + 1e-9, 1.0 / PARTS)  # 1e-9 includes the upper end
    # before or after all blocks with information a step cannot be told from level and slope: its energy is zero
    energies = ((transform @ step_shapes(count, positions)) ** 2).sum(axis=0)
    return _Whitening(
        transform=transform,
        from_vector=(basis.T @ complement) @ (vectors / root).T,
        eigen=np.maximum(eigen, 0.0),
        unit=unit,
        positions=positions[energies > RANK_TOLERANCE * energies.max()],
        # half-Cauchy prior on the standard deviation of the walk over all blocks, whose scale is `walk`
        walk_log_priors=-np.log1p(WALKS * unit * count / walk**2),
    )


def _test_step(whitening: _Whitening, onsets: Array, steps: _WhitenedSteps, fits: _StepFits, sign: float) -> StepTest:
    """Test whitened values of a coefficient for a step at any of o `onsets` [s], by the likelihood ratio to no step.

    `steps`: whitened unit steps; `fits`: their fits to the values; `sign`: 1 for a step up, -1 for a step down,
    which is a step up of the values with the opposite sign. Both likelihoods are maximised over the variances of walk
    and noise, with the prior on the walk.
    """
    fits = fits._replace(moments=sign * fits.moments)
    weight, log_factor, total, moments, energies = fits
    n, unit = weight.shape[1], whitening.unit
    residual_squares = fits.residual_squares()
    log_likelihood = fits.log_likelihood(total)
    walk_without_step = int(log_likelihood.argmax())
    # at each onset the likeliest walk is that with the least squares times exp(-2 log_factor / n): one logarithm each
    largest_factor = log_factor.max()
    scaled_squares = residual_squares * np.exp(2.0 / n * (largest_factor - log_factor))[:, None]
    walk, best = np.unravel_index(int(scaled_squares.argmin()), scaled_squares.shape)
    likelihood = largest_factor - 0.5 * n * np.log(scaled_squares.min(axis=0) / n)  # of a step at each onset
    score = 2.0 * float(likelihood[best] - log_likelihood[walk_without_step])
    # variances of the walk that the data alone, without the prior, allow: with or without a step
    with_step = fits.log_likelihood(residual_squares.min(axis=1))  # at the best onset for each walk
    data_likelihoods = np.array([log_likelihood, with_step]) - whitening.walk_log_priors
    allowed = (data_likelihoods > data_likelihoods.max(axis=1, keepdims=True) - ALLOWED).any(axis=0)
    length = steps.lengths[allowed].max()
    noise = float(residual_squares[walk, best]) / n
    size_at_best, error_at_best = moments[walk, best] / energies[walk, best], np.sqrt(noise / energies[walk, best])
    size = moments[walk_without_step] / energies[walk_without_step]
    # residual squares of a step up or down at each onset
    squares = total[walk_without_step] - moments[walk_without_step] ** 2 / energies[walk_without_step]
    return StepTest(
        score=score,
        best=int(best),
        positions=whitening.positions,
        onsets=onsets,
        likelihood=likelihood,
        size=size,
        deviation=np.sqrt(np.maximum(squares, 0.0) / n) / np.sqrt(energies[walk_without_step]),
        fitted=Estimate(float(size_at_best), float(error_at_best)),
        walk=(unit * float(WALKS[walk_without_step]), unit * float(WALKS[walk])),
        noise=(float(total[walk_without_step]) / n, noise),
        law=NullLaw(dimensions=min(n, 0.5 * n + 2.0), length=float(length)),  # degrees of freedom: see the module
        sign=sign,
    )
