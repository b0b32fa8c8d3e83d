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

The probability of the score in a healthy machine follows from geometry, without a simulation. For a known q the
whitened z is uniform on a sphere in n = K - 2 dimensions, and steps over all onsets form a curve of length L on it. The
angle between z and the best onset has the cosine c, with c^2 = 1 - exp(-score/n). The probability that z lies that
close to the curve is the probability of a tube about it, with the regularised incomplete beta function I,

    P = I_{1-c^2}((m - 1)/2, 1/2) / 2 + L / (2 pi) (1 - c^2)^((m - 2)/2),    1 - c^2 = exp(-score/m),    m = n.

q is not known, and a walk can look like a step: removing the step makes the fitted walk smaller. This has two
consequences. First, L is the largest length over the walks that the recording allows, i.e. those whose likelihood is
within `ALLOWED` of the largest, without the step or with it (R. L. Berger and D. D. Boos: the supremum over a
confidence set). L grows with q, from 26 for no walk to 88 for nothing but a walk (60 blocks). Second, the residuals
estimate two variances, of noise and walk. At worst half of the degrees of freedom go to each: m = min(n, n/2 + 2).
Random draws showed that this is enough. The table gives the percentage of healthy draws (2 800 to 12 000 for each
entry) with a probability P below 1 %, against the variance of the walk over that of the noise. The precisions of the
blocks were log-normal with a width of 0.5. In brackets: m = n and L of the fitted walks, as if q were known.

    blocks      none         0.3          1            3            10           100
    5           0.2 (0.2)    0.2 (0.2)    0.1 (0.1)    0.2 (0.2)    0.1 (0.1)    0.2 (0.2)
    8           0.2 (0.4)    0.3 (0.6)    0.4 (0.8)    0.4 (0.9)    0.7 (1.2)    0.6 (1.1)
    12          0.1 (0.3)    0.2 (0.4)    0.4 (0.8)    0.7 (1.2)    0.7 (1.5)    0.8 (1.6)
    20          0.1 (0.2)    0.1 (0.6)    0.5 (1.1)    0.8 (1.5)    0.7 (1.5)    1.0 (1.7)
    40          0.1 (0.2)    0.4 (0.8)    0.9 (1.6)    0.9 (1.7)    1.0 (1.5)    0.9 (1.4)
    60          0.0 (0.1)    0.6 (1.1)    1.2 (2.0)    0.9 (1.5)    0.8 (1.2)    0.9 (1.2)
    120         0.0 (0.1)    0.7 (1.1)    1.1 (1.6)    0.7 (1.0)    1.0 (1.4)    1.0 (1.1)

Sources: H. Hotelling, Amer. J. Math. 61 (1939) 440; M. Knowles and D. Siegmund, Int. Statist. Rev. 57 (1989) 205
(tubes); R. B. Davies, Biometrika 74 (1987) 33 (a parameter present under the alternative only); R. L. Berger and
D. D. Boos, J. Am. Statist. Assoc. 89 (1994) 1012 (supremum over a confidence set).
"""

from __future__ import annotations

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
#: Grid of the variance q of the random walk, in units of `_Whitening.unit`, from 0 (no walk).
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
        Twice the logarithm of the likelihood ratio of the best step > 0.
    chance : float
        Probability that a coefficient without a step scores as high.
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
    chance: float
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
    sign: float = 1.0

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
        return replace(self, chance=min(1.0, self.chance / share), law=self.law._replace(share=share))

    def detectable_step(self, chance: float, power: float = 0.9) -> float:
        """Compute the smallest step that is detected with the probability `power`, in the unit of the coefficient.

        `chance`: probability that the test finds a step where there is none; it sets the threshold of the score. The
        result is (sqrt(threshold) + normal quantile of `power`) times the median standard error over all onsets.
        """
        from scipy.special import ndtri

        threshold_z = np.sqrt(self.threshold(chance))  # the score is about the square of a z score
        return float((threshold_z + ndtri(power)) * np.median(self.deviation))

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
    standard error. If practically no step up is possible, the result is the largest value of size + 12 standard errors,
    but at least 0.
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

    `information`: likelihood of the coefficient in the blocks; `test`: step test of the coefficient, whose fitted
    variances of walk and noise are used. Without a test there is no walk, and the noise has the variance 1. With fewer
    than `MIN_BLOCKS` blocks there is no slope. Of the priors of `information` only that on the slope is used; the noise
    inflates its variance, too. `with_step`: add a step at the best onset of `test`, and use the variances that were
    fitted together with a step.
    """
    time = information.time
    count = len(time)
    noise, walk = 1.0, 0.0  # variances
    if test is not None:
        noise, walk = test.noise[with_step], test.walk[with_step]  # index 0: fitted without a step, 1: with a step
    columns = [np.ones(count)]  # level
    if count >= MIN_BLOCKS:  # slope
        columns.append((np.arange(count) - 0.5 * (count - 1)) / max(count, 1))
    if with_step and test is not None:  # step: fraction of each block after the onset
        block_s = float(time[1] - time[0]) if count > 1 else 1.0
        columns.append(np.clip((time - test.onsets[test.best]) / block_s + 0.5, 0.0, 1.0))
    n_fixed = len(columns)
    if walk > 0.0:  # a walk is a step of normal size in each block, of variance `walk`
        columns += list(np.sqrt(walk) * np.tril(np.ones((count, count))).T)
    basis = np.column_stack(columns)
    precision = basis.T @ information.precision @ basis / noise
    walk_index = np.arange(n_fixed, basis.shape[1])
    precision[walk_index, walk_index] += 1.0 / noise  # prior on the steps of the walk
    if count >= MIN_BLOCKS:
        precision[1, 1] += 1.0 / noise / information.slope**2  # prior on the slope
    inverse = _inverse(precision)
    mean = basis @ (inverse @ (basis.T @ information.vector / noise))
    return History(mean, basis @ inverse @ basis.T)


def _inverse(matrix: Array) -> Array:
    """Compute the pseudoinverse of a positive semidefinite matrix, scaled to a unit diagonal against rounding."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    return np.asarray(np.linalg.pinv(matrix / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale))


class NullLaw(NamedTuple):
    """Distribution of the score of a step test in a healthy machine, i.e. without a step.

    `dimensions`: degrees of freedom m; `length`: length L of the curve that the whitened steps over all onsets form on
    the unit sphere (see the module); `share`: fraction of the false alarms that this test gets among several.
    """

    dimensions: float
    length: float
    share: float = 1.0

    def chance(self, score: float) -> float:
        """Compute the probability P that a coefficient without a step has a higher score (formula: see the module).

        P is the probability that a random direction lies as close to the curve of all steps as the measured one does.
        If several tests share a false-alarm probability, P is divided by the share of this test (Bonferroni).
        """
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
    """Test a coefficient for a step of each sign, 1 up or -1 down (`step_test`).

    `shape` (K,): relative size of the step in each block, None if it is constant. The result is empty if too few blocks
    determine the coefficient. A step down is tested as a step up of the coefficient with the opposite sign.
    """
    whitened = _whiten_blocks(information)
    if whitened is None:
        return []
    whitening, z, onsets = whitened
    steps = whitening.transform_steps(whitening.positions, shape)
    fits = _fit_steps(z, steps, whitening.eigen)
    tests = [_test_step_up(whitening, onsets, steps, fits if sign > 0.0 else fits.upside_down()) for sign in signs]
    return [replace(test, sign=sign) for test, sign in zip(tests, signs, strict=True)]


def step_sizes(
    information: Information, onsets: NDArray[np.intp], shape: Array, growth: float
) -> tuple[Array, Array, Array]:
    """Estimate the size of a step up of a coefficient, for each of o possible onsets.

    The coefficient also has a level, a slope and a random walk, whose likeliest variance is used at each onset.
    `onsets` (o,): indices of the onsets in `StepTest.onsets`; `shape` (K,): change of the coefficient in each block by
    a unit step; `growth`: as in `step_shapes`. Returns the log likelihood ratio of the step to no step, its size, and
    the standard error of the size, (o,) each.
    """
    whitened = _whiten_blocks(information)
    assert whitened is not None  # else there is no step test with onsets
    whitening, z, _ = whitened
    n = len(z)
    fit = _fit_steps(z, whitening.transform_steps(whitening.positions[onsets], shape, growth), whitening.eigen)
    # log likelihood (walk, onset) with the best size of the step and the best variance of the noise
    likelihoods = (
        0.5 * np.log(fit.weight).sum(axis=1)[:, None]
        + whitening.walk_log_priors[:, None]
        - 0.5 * n * np.log(fit.residual_squares / n)
    )
    without_step = 0.5 * np.log(fit.weight).sum(axis=1) + whitening.walk_log_priors - 0.5 * n * np.log(fit.total / n)
    likelihoods -= without_step.max()
    likeliest_walk = likelihoods.argmax(axis=0), np.arange(len(onsets))  # index (walk, onset)
    sizes, variances = fit.moments / fit.energies, fit.residual_squares / n / fit.energies
    return likelihoods[likeliest_walk], sizes[likeliest_walk], np.sqrt(variances)[likeliest_walk]


class _StepFits(NamedTuple):
    """Least-squares fits of a step up to whitened values z (n,), for each of o onsets and w variances of the walk.

    The variances are those of `WALKS`. `weight` (w, n): variance of the noise over that of each z. Sums with these
    weights: `total` (w,): squares of z; `moments`, `energies` (w, o): products of the steps with z and with themselves;
    `residual_squares` (w, o): squares that remain after the fit.
    """

    weight: Array
    total: Array
    moments: Array
    energies: Array
    residual_squares: Array

    def upside_down(self) -> _StepFits:
        """Return the fits of a step down instead of a step up, i.e. those to the values -z."""
        return self._replace(
            moments=-self.moments, residual_squares=_residual_squares(self.total, -self.moments, self.energies)
        )


def _fit_steps(z: Array, steps: Array, eigen: Array) -> _StepFits:
    """Fit an upward step of a coefficient at each of o onsets, for each variance of the random walk in `WALKS`.

    `z` (n,): whitened values of the coefficient; `steps` (n, o): whitened unit steps; `eigen` (n,): eigenvalues of the
    walk's covariance (`_Whitening`). The fit is by weighted least squares. Where the best step would be down, its
    moment is negative, and the residual squares are those without a step.
    """
    weight = 1.0 / (1.0 + WALKS[:, None] * eigen)
    total = np.maximum((weight * z**2).sum(axis=1), np.finfo(float).tiny)
    moments, energies = (weight * z) @ steps, np.maximum(weight @ steps**2, np.finfo(float).tiny)
    return _StepFits(weight, total, moments, energies, _residual_squares(total, moments, energies))


def _residual_squares(total: Array, moments: Array, energies: Array) -> Array:
    """Compute the residual sums of squares (w, o) after the fit of a step up to the whitened values.

    The axes are w variances of the random walk and o onsets of the step. `total` (w,): sums of squares before the fit;
    `moments`, `energies` (w, o): products of the steps with the values and with themselves. A negative moment would
    give a step down, which is not fitted: it counts as 0. The result is at least 1e-12 of `total`, since its logarithm
    is used.
    """
    return np.asarray(np.maximum(total[:, None] - np.maximum(moments, 0.0) ** 2 / energies, 1e-12 * total[:, None]))


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


class _Whitening(NamedTuple):
    """Matrices that whiten the estimates of a coefficient in K blocks, from their precision and priors only.

    The whitened values z (n,) have independent noise of variance 1. Level, slope and a further change of known shape
    are projected out.

    - `root` (r,), `vectors` (K, r): square roots of the non-zero eigenvalues of the precision, and their eigenvectors;
    - `complement` (n, r + s): directions, as rows, that are orthogonal to these changes. Each of the s changes with a
      finite prior adds a column;
    - `basis`, `eigen` (n, n), (n,): eigenvectors of the random walk's covariance, and its eigenvalues times `unit`;
    - `transform` (n, K): matrix from the coefficient in K blocks to z;
    - `unit`: variance of the walk's steps at which it adds on average as much to z as the noise;
    - `positions` (o,): possible onsets, counted in blocks;
    - `walk_log_priors` (w,): log prior of each variance in `WALKS`.
    """

    root: Array
    vectors: Array
    complement: Array
    basis: Array
    transform: Array
    eigen: Array
    unit: float
    positions: Array
    walk_log_priors: Array

    def whiten(self, vector: Array) -> Array:
        """Transform the `vector` (K,) of `Information`, precision times estimates, to n independent values z.

        The estimates become independent, each prior of a slow change is appended as one more estimate of 0, and the
        slow changes are projected out.
        """
        independent = (self.vectors.T @ vector) / self.root
        extended = np.append(independent, np.zeros(self.complement.shape[1] - len(independent)))
        return np.asarray(self.basis.T @ (self.complement @ extended))

    def transform_steps(self, positions: Array, shape: Array | None = None, growth: float = 0.0) -> Array:
        """Compute the change of the n whitened values by a unit step at each of o onsets, shape (n, o).

        `positions`, `growth`: as in `step_shapes`; `shape`: factor on the step in each block of the recording, by
        default 1. A prior on the level is one more block, before those of the recording (`_prepend_level_prior`). It
        needs no factor, since it precedes every onset: the step is 0 in it.
        """
        count = self.transform.shape[1]
        steps = step_shapes(count, positions, growth)
        if shape is not None:
            steps[count - len(shape) :] *= shape[:, None]  # the blocks of the recording
        return np.asarray(self.transform @ steps)


def _whiten_blocks(information: Information) -> tuple[_Whitening, Array, Array] | None:
    """Transform the estimates of a coefficient in blocks to independent values of variance 1.

    Returns the matrices of this transform, the values z (n,), and the times of the possible onsets (o,) [s]. Returns
    None if too few blocks determine the coefficient, or if the precision is not finite.
    """
    time, precision, vector = _prepend_level_prior(information)
    if not np.isfinite(precision).all():
        return None
    slope, walk, shape = information.slope, information.walk, information.shape
    if shape is not None:
        shape = np.append(np.zeros(len(time) - len(shape)), shape)  # 0 in the block that a prior on the level adds
        whitening = _build_whitening(precision, slope, walk, shape, information.disturbance)
    elif np.array_equal(precision, np.eye(len(time))):  # the matrices of this frequent case are cached
        whitening = _unit_whitening(len(time), slope, walk)
    else:
        whitening = _build_whitening(precision, slope, walk)
    if whitening is None:
        return None
    return whitening, whitening.whiten(vector), _onset_times(time, whitening.positions)


@lru_cache(maxsize=16)
def _unit_whitening(count: int, slope: float, walk: float) -> _Whitening | None:
    """Build the matrices of `_build_whitening` for `count` independent estimates of variance 1, a frequent case."""
    return _build_whitening(np.eye(count), slope, walk)


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
    if count < MIN_BLOCKS or np.count_nonzero(is_informative) < MIN_BLOCKS:
        return None
    root = np.sqrt(values[is_informative])
    design = (vectors[:, is_informative] * root).T  # matrix from the coefficient in all blocks to z
    index = np.arange(count)
    changes = [np.ones(count), (index - index.mean()) / count]  # level and slope
    scales = [np.inf, slope]
    if shape is not None:
        changes.append(shape)
        scales.append(disturbance)
    fixed = design @ np.column_stack(changes)
    for k, scale in enumerate(scales):
        if np.isfinite(scale):  # a prior is one more estimate
            fixed = np.vstack([fixed, np.eye(len(scales))[k] / scale])
            design = np.vstack([design, np.zeros(count)])
    # the remaining columns of the full Q span the complement of level, slope and shape
    complement = np.linalg.qr(fixed, mode="complete")[0][:, len(scales) :].T
    transform = complement @ design
    # covariance of a walk with steps of variance 1, which is min(k, l) for blocks k and l counted from 1
    covariance = transform @ (np.minimum.outer(index, index) + 1.0) @ transform.T
    # scale of the walk's variance at which walk and noise change z equally on average
    unit = len(complement) / max(float(np.trace(covariance)), np.finfo(float).tiny)
    eigen, basis = np.linalg.eigh(unit * covariance)
    transform = basis.T @ transform
    positions = np.arange(EDGE, count - EDGE + 1e-9, 1.0 / PARTS)  # 1e-9 includes the upper end
    # before or after all blocks with information a step cannot be told from level and slope: its energy is zero
    energies = ((transform @ step_shapes(count, positions)) ** 2).sum(axis=0)
    return _Whitening(
        root=root,
        vectors=vectors[:, is_informative],
        complement=complement,
        basis=basis,
        transform=transform,
        eigen=np.maximum(eigen, 0.0),
        unit=unit,
        positions=positions[energies > RANK_TOLERANCE * energies.max()],
        # half-Cauchy prior on the standard deviation of the walk over all blocks, whose scale is `walk`
        walk_log_priors=-np.log1p(WALKS * unit * count / walk**2),
    )


def _prepend_level_prior(information: Information) -> tuple[Array, Array, Array]:
    """Return `time`, `precision` and `vector`, with a finite prior on the level added as a block before the first.

    They are returned unchanged if the prior is infinite, or if there are fewer than `MIN_BLOCKS` blocks: the added one
    must not count towards this number.
    """
    time, precision, vector, level = information[:4]
    if not np.isfinite(level) or len(time) < MIN_BLOCKS:
        return time, precision, vector
    with_prior = np.zeros((len(time) + 1, len(time) + 1))
    with_prior[0, 0] = 1.0 / level**2
    with_prior[1:, 1:] = precision
    time_before = 2.0 * time[0] - time[1]  # one block before the first
    return np.concatenate([[time_before], time]), with_prior, np.concatenate([[0.0], vector])


def _onset_times(time: Array, positions: Array) -> Array:
    """Convert `positions` (o,), counted in blocks from the start of the first block, to times [s].

    `time` (K,): middles of the blocks [s].
    """
    # edges of the blocks: half way between their middles, extrapolated at both ends
    first_edge, last_edge = 1.5 * time[0] - 0.5 * time[1], 1.5 * time[-1] - 0.5 * time[-2]
    edges = np.concatenate([[first_edge], 0.5 * (time[1:] + time[:-1]), [last_edge]])
    return np.asarray(np.interp(positions, np.arange(len(edges)), edges))


def _test_step_up(whitening: _Whitening, onsets: Array, steps: Array, fits: _StepFits) -> StepTest:
    """Test whitened values of a coefficient for a step up at any of o `onsets` [s], by the likelihood ratio to no step.

    `steps` (n, o): whitened unit steps; `fits`: their fits to the values z, for each of w candidate variances of the
    random walk (`WALKS`). Fits to -z test for a step down, which is a step up of -z. Both likelihoods are maximised
    over the variances of walk and noise, with the prior on the walk.
    """
    n, walk_log_priors, unit = len(whitening.eigen), whitening.walk_log_priors, whitening.unit
    weight, total, moments, energies, residual_squares = fits
    # for each variance of the walk, twice the log of (square root of the determinant of the weights, times the prior)
    twice_log_factor = np.log(weight).sum(axis=1) + 2.0 * walk_log_priors
    log_likelihood = 0.5 * twice_log_factor - 0.5 * n * np.log(total / n)
    log_likelihood_with_step = 0.5 * twice_log_factor[:, None] - 0.5 * n * np.log(residual_squares / n)
    walk_without_step = int(log_likelihood.argmax())
    walk, best = np.unravel_index(int(log_likelihood_with_step.argmax()), log_likelihood_with_step.shape)
    score = 2.0 * float(log_likelihood_with_step[walk, best] - log_likelihood[walk_without_step])
    # variances of the walk that the data alone, without the prior, allow: with or without a step
    data_likelihoods = np.array([log_likelihood, log_likelihood_with_step.max(axis=1)]) - walk_log_priors
    allowed = (data_likelihoods > data_likelihoods.max(axis=1, keepdims=True) - ALLOWED).any(axis=0)
    # length of the curve of whitened steps on the unit sphere, from the angles between neighbouring onsets
    norm = np.sqrt(energies[allowed])
    cosines = (weight[allowed] @ (steps[:, 1:] * steps[:, :-1])) / (norm[:, 1:] * norm[:, :-1])
    length = np.arccos(np.clip(cosines, -1.0, 1.0)).sum(axis=1).max()
    law = NullLaw(dimensions=min(n, 0.5 * n + 2.0), length=float(length))  # degrees of freedom: see the module
    noise = float(residual_squares[walk, best]) / n
    size_at_best, error_at_best = moments[walk, best] / energies[walk, best], np.sqrt(noise / energies[walk, best])
    size = moments[walk_without_step] / energies[walk_without_step]
    # residual squares of a step up or down at each onset
    squares = total[walk_without_step] - moments[walk_without_step] ** 2 / energies[walk_without_step]
    return StepTest(
        score=score,
        chance=law.chance(score),
        best=int(best),
        positions=whitening.positions,
        onsets=onsets,
        likelihood=log_likelihood_with_step.max(axis=0),
        size=size,
        deviation=np.sqrt(np.maximum(squares, 0.0) / n) / np.sqrt(energies[walk_without_step]),
        fitted=Estimate(float(size_at_best), float(error_at_best)),
        walk=(unit * float(WALKS[walk_without_step]), unit * float(WALKS[walk])),
        noise=(float(total[walk_without_step]) / n, noise),
        law=law,
    )
