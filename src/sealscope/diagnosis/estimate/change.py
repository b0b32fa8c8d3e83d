"""Test whether a quantity changes at an unknown time: one model, for a file, a folder of recordings and a stream.

In a healthy machine the quantity g has a level, perhaps a slope, F a, and a random walk w. With a leak it also has a
change of size delta, whose shape s is 0 before its onset, and 1 after it (a step) or growing. A step within a block is
a part of it there. Readings of g have the variance kappa V. Divided by their standard deviations, readings without
drift become z, and the change's effects on them G. Each test is by energy = sum G^2, moment = sum G z and square =
sum z^2, over all onsets: the likelihood ratio of a change to none is exp(moment delta - energy delta^2 / 2).

- A *stream* and a *folder* filter: z are the prediction errors of each reading by the earlier ones (`filter_changes`;
  in bounded memory the Kalman filter of `live.sequential`). A *file* smooths: all readings are whitened together
  (`step_test`). After the last reading both have the same sums; a test checks it.
- The size has a half-normal prior in folders and streams (`log_size_mixture`); in a file it is the most likely one.

The threshold has one of three meanings:

- *fixed length*, a file: the probability that healthy blocks score as high (`NullLaw`, derived below);
- *mean time*, a folder: the statistic R_n = sum_(j <= n) w_j LR_j(n), over changes j with the likelihood ratios LR_j
  after n readings, and weights w_j whose sum is the time so far. Without a change R_n minus that time is a martingale,
  so that R exceeds A after a mean time of at least A (`score_in_time`);
- *any time*, a stream: an e-detector, which exceeds 1/alpha once in 1/alpha blocks at most (`live.sequential`).

In a file the likelihood of a coefficient g in K blocks of time is `Information`(Lambda, eta), and the model

    g = F a + w + delta s(onset),    z = Lambda^(-1/2) eta ~ N(Lambda^(1/2) g, kappa I),    cov w = kappa q min(k, l),

where kappa is the inflation of the noise by the correlation of the rows, and kappa q the variance of the walk in a
block. F is projected out, and so is a further change of known shape, if a healthy machine may show one. (q, kappa) are
estimated with the step and without it; one eigenproblem serves all onsets and all q. The score is twice the logarithm
of the likelihood ratio, for steps > 0.

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
D. D. Boos, J. Am. Statist. Assoc. 89 (1994) 1012 (supremum over a confidence set); M. Pollak, Annals of Statistics 13
(1985) 206, doi 10.1214/aos/1176346587 (Shiryaev-Roberts and its mean time); J. Shin, A. Ramdas, A. Rinaldo, New England
Journal of Statistics in Data Science 2 (2024) 229, doi 10.51387/23-NEJSDS51 (mixtures over sizes).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel, law
from sealscope.diagnosis.estimate.interval import WITHIN_95, Estimate, Interval
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, weigh_alternatives
from sealscope.diagnosis.estimate.special import find_root, log_scaled_tail
from sealscope.recordings.recording import Array

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
#: Smallest fraction of the squares that remains beside a step, whose logarithm is used.
MIN_RESIDUAL = 1e-12
#: Largest error of a fraction by rounding, the smallest positive number, and the smallest one that has a square.
ROUNDING, TINY, SMALLEST = 1e-12, float(np.finfo(float).tiny), 1e-150


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
        return weigh_alternatives(self.likelihood)

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
        """Compute the threshold of the score that is exceeded with the probability `chance` if there is no step.

        It is at most 10 000.
        """
        max_score = 1e4  # upper end of the search; such a score has practically no probability
        if self.law.chance(0.0) <= chance:
            return 0.0
        if not chance > self.law.chance(max_score):
            return max_score
        return find_root(lambda score: self.law.chance(score) - chance, 0.0, max_score)


class ChangeSums(NamedTuple):
    """Sums over readings, by which a change of an unknown size delta is tested; arrays of one shape for many changes.

    With readings z of independent errors of variance 1, which a change of size 1 alters by G, `energy` is the sum of
    G^2 and `moment` that of G z. The likelihood ratio of the change to none is exp(moment delta - energy delta^2 / 2).
    """

    energy: Array
    moment: Array

    def select(self, index: Any) -> ChangeSums:
        """Return the sums at an index of their arrays."""
        return ChangeSums(self.energy[index], self.moment[index])

    def size(self, scale: Array) -> tuple[Array, Array]:
        """Compute mean and variance of the size, whose prior is normal about 0 with the standard deviation `scale`."""
        variance = 1.0 / (self.energy + scale**-2)
        return self.moment * variance, variance

    def log_mean_ratio(self, scale: Array, *, signed: bool = False) -> Array:
        """Compute the log of the mean likelihood ratio over sizes, whose prior is half-normal, or normal if `signed`.

        `scale` k: standard deviation of the prior, or of the normal one whose half it is. With the `mean` m of `size`
        the result is -log(1 + energy k^2)/2 + moment m/2 for a normal prior, and that of `log_size_mixture` for half.
        """
        gain, mean = self.energy * scale**2, self.size(scale)[0]
        score = self.moment * mean
        if signed:
            return np.asarray(0.5 * (score - np.log1p(gain)))
        roots = np.sqrt(score) * np.sign(mean)
        log_ratios = np.empty(roots.size)
        _mix_sizes(gain.ravel(), roots.ravel(), log_ratios)
        return log_ratios.reshape(roots.shape)


@law
def log_size_mixture(gain: float, root: float) -> float:
    """Compute the log of the mean likelihood ratio of a change, over sizes with a half-normal prior.

    With g, the `gain`, = energy times the prior's variance, and r, the `root`, = the most probable size over its error,
    it is 2 (1 + g)^(-1/2) exp(r^2/2) Phi(r) with the normal distribution function Phi. For noise of an unknown scale r
    is the signed root of n log(1 + t^2/n), by which Student's t of the change in n readings is nearly normal.
    """
    return -0.5 * math.log1p(gain) + log_scaled_tail(root)


@kernel
def _mix_sizes(gains: Array, roots: Array, log_ratios: Array) -> None:
    """Write the `log_size_mixture` of each of n changes to `log_ratios` (n,)."""
    for i in range(gains.size):
        log_ratios[i] = log_size_mixture(gains[i], roots[i])


def filter_changes(values: Array, effects: Array, last_values: Array) -> ChangeSums:
    """Compute the sums of m changes after each of n readings, from the earlier readings alone.

    `values` (n, 1), `effects` (n, m): innovations of the readings, and of the changes, over their standard deviations,
    as by the Cholesky factor L of their covariance: L^-1 y. `last_values` (n, 1): those of the readings while each is
    the last one, if its value counts otherwise then.
    """
    moment = np.cumsum(effects * values, axis=0) - effects * (values - last_values)
    return ChangeSums(np.cumsum(effects**2, axis=0), moment)


class ChangeScores(NamedTuple):
    """Result of a sequential test for a change after each of n readings."""

    log_R: Array  # (n,): logarithm of the test statistic R, in the unit of the mean time to a false alarm
    begin: NDArray[np.int64]  # (n,): index of the first reading after the most probable change

    def find_alarm(self, time: float) -> int | None:
        """Return the index of the first reading with R > `time`, the mean time to a false alarm; None if none has."""
        alarms = np.flatnonzero(self.log_R > math.log(time))
        return int(alarms[0]) if alarms.size else None


def score_in_time(log_ratios: Array, log_weights: Array, begin: NDArray[np.int64]) -> ChangeScores:
    """Compute Shiryaev's and Roberts's statistic of changes after each of n readings.

    `log_ratios` (n, c): log likelihood ratio of each of c changes to none, by the readings so far; `log_weights`,
    `begin` (c,): logarithm of each change's weight w, a time, and index of the first reading after it. See the module.
    """
    n = len(log_ratios)
    if not begin.size:  # no change can begin: R = 0
        return ChangeScores(np.full(n, -np.inf), np.zeros(n, dtype=np.int64))
    log_terms = np.where(np.arange(n)[:, None] < begin, -np.inf, log_ratios + log_weights)
    return ChangeScores(np.logaddexp.reduce(log_terms, axis=1), begin[np.argmax(log_terms, axis=1)])


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
    steps = whitening.unit_steps if shape is None else _Steps(whitening, shape)
    return _test_steps(whitening, onsets, steps, z, signs)


def step_tests_of_columns(information: Information, n_tested: int) -> tuple[list[StepTest], Array] | None:
    """Test the first `n_tested` of c coefficients of one precision for a step up or down (`step_test`).

    `information`: as for one coefficient, but `vector` is (K, c). Also returns the log likelihood of each coefficient
    without a step, with a fitted random walk, (c,). None if too few blocks have information.
    """
    whitened = _whiten_blocks(information)
    if whitened is None:
        return None
    whitening, values, onsets = whitened
    tests = [_test_steps(whitening, onsets, whitening.unit_steps, z, (1.0, -1.0)) for z in values.T[:n_tested]]
    squares, n = np.maximum(whitening.weight @ values**2, TINY), len(values)
    without = (whitening.log_factor[:, None] - 0.5 * n * np.log(squares / n)).max(axis=0)
    return [max(both, key=lambda test: test.score) for both in tests], without


def largest_step_likelihood(effects: Array, values: Array, walks: Array = WALKS) -> tuple[Array, Array]:
    """Compute the largest log likelihood of whitened values (n,) with a step up of a quantity, over onsets and walks.

    The values have independent noise of one variance. A unit step from block k on changes them by column k of the
    `effects` (..., n, K), of which there may be several cases. A random walk of the quantity changes them as steps in
    all blocks do: with S the `effects`, their covariance is kappa (I + q S S'). `walks`: variances q that are tried, in
    units of the one for which walk and noise have the same mean variance. Also returns the likeliest walk of each case.
    """
    transposed = np.swapaxes(effects, -1, -2)
    eigen, vectors = np.linalg.eigh(transposed @ effects)
    is_informative = eigen > RANK_TOLERANCE * np.maximum(eigen[..., -1:], TINY)
    eigen = np.where(is_informative, eigen, 0.0)
    roots = np.sqrt(eigen)
    # coefficients of the values on the directions in which steps change them, 0 in those without information
    z = ((transposed @ values)[..., None, :] @ vectors)[..., 0, :] / np.where(is_informative, roots, np.inf)
    n = len(values)
    mean_one = n / np.maximum(eigen.sum(axis=-1, keepdims=True), TINY) * eigen
    weight = 1.0 / (1.0 + walks[:, None] * mean_one[..., None, :])  # (..., w, K)
    steps = roots[..., None] * np.swapaxes(vectors, -1, -2)  # change of z by a step in each block
    rest = np.maximum(values @ values - (z**2).sum(axis=-1), 0.0)  # squares of what no step changes
    total = np.maximum((weight @ z[..., None] ** 2)[..., 0] + rest[..., None], TINY)
    moments, energies = (weight * z[..., None, :]) @ steps, np.maximum(weight @ steps**2, TINY)
    gains = (np.maximum(moments, 0.0) ** 2 / energies).max(axis=-1)  # a step down is not fitted
    squares = np.maximum(total - gains, MIN_RESIDUAL * total)
    likelihoods = 0.5 * np.log(weight).sum(axis=-1) - 0.5 * n * np.log(squares / n)
    return likelihoods.max(axis=-1), walks[likelihoods.argmax(axis=-1)]


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
    # the block that a prior on the level adds needs no factor of the shape: it precedes every onset
    padding = (whitening.transform.shape[1] - len(shape), 0)
    courses = step_shapes(whitening.transform.shape[1], whitening.positions[onsets], growth)
    steps = whitening.transform @ (np.pad(shape, padding)[:, None] * courses)
    weight, n = whitening.weight, len(z)
    total = np.maximum((weight * z) @ z, np.finfo(float).tiny)
    moments, energies = (weight * z) @ steps, np.maximum(weight @ steps**2, np.finfo(float).tiny)
    # residual squares after the fit of a step up; a step down is not fitted
    squares = np.maximum(total[:, None] - np.maximum(moments, 0.0) ** 2 / energies, MIN_RESIDUAL * total[:, None])
    likelihood_without = float((whitening.log_factor - 0.5 * n * np.log(total / n)).max())
    log_likelihoods = whitening.log_factor[:, None] - 0.5 * n * np.log(squares / n)  # (walk, onset)
    likeliest = log_likelihoods.argmax(axis=0), np.arange(len(onsets))
    variances = squares / n / energies
    sizes = moments[likeliest] / energies[likeliest]
    return log_likelihoods[likeliest] - likelihood_without, sizes, np.sqrt(variances[likeliest])


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


@dataclass(frozen=True, eq=False)
class _Whitening:
    """Matrices that whiten the estimates of a coefficient in K blocks, from their precision and priors only.

    The whitened values z (n,) have independent noise of variance 1. Level, slope and a further change of known shape
    are projected out. A step at the beginning of block k is an increment of the coefficient there, like one of the
    walk. With the increments' precision R = L' Lambda L, where L sums them up, and its eigenvalues and eigenvectors
    R = V diag(eigen) V', z = eigen^(-1/2) V' L' eta, and a unit increment in block k changes z by eigen^(1/2) V'[:, k].

    - `increments` (n, K): change of z by a unit increment in each block;
    - `eigen` (n,): variances of z by a random walk, whose steps have the variance `unit`;
    - `unit`: variance of the walk's steps at which it adds on average as much to z as the noise;
    - `positions` (o,): possible onsets, counted in blocks; `block`, `after` (o,): index of the block in which each
      lies, and fraction of the block before it;
    - `walks`, `walk_log_priors` (w,): variances of the walk, in units of `unit`, and log prior of each.
    """

    increments: Array
    eigen: Array
    unit: float
    positions: Array
    block: NDArray[np.int64]
    after: Array
    walks: Array
    walk_log_priors: Array

    @cached_property
    def weight(self) -> Array:
        """Variance of the noise over that of each whitened value, for each walk, (w, n)."""
        return np.asarray(1.0 / (1.0 + self.walks[:, None] * self.eigen))

    @cached_property
    def log_factor(self) -> Array:
        """Half the log determinant of the weights, plus the log prior of the walk, (w,)."""
        return np.asarray(0.5 * np.log(self.weight).sum(axis=1) + self.walk_log_priors)

    @cached_property
    def transform(self) -> Array:
        """Matrix (n, K) that gives z from the coefficients of K blocks, free of level, slope and nuisances."""
        return -np.diff(self.increments, axis=1, append=0.0)

    @cached_property
    def unit_steps(self) -> _Steps:
        """Unit steps of the coefficient itself at all possible onsets."""
        return _Steps(self, None)


class _Steps:
    """Unit steps at each of o onsets, changed by a factor on each block, as changes of n whitened values.

    A step within a block is the mean of one at the block's beginning and one at its end, weighted by the block's parts
    before and after the onset. Sums of products are therefore formed for steps at the K + 1 beginnings and ends only.

    - `whole` (n, K + 1): changes of z by a step at each beginning of a block, and at the last end, where it is zero;
    - `inverse_energies` (w, o): 1 over the weighted sum of squares of each step, for each walk;
    - `lengths` (w,): length of the curve of all steps on the unit sphere, the sum of the angles between neighbours.
    """

    def __init__(self, whitening: _Whitening, shape: Array | None) -> None:
        whole = whitening.increments
        if shape is not None:
            factor = np.pad(shape, (whole.shape[1] - len(shape), 0), constant_values=1.0)
            whole = np.cumsum((whitening.transform * factor)[:, ::-1], axis=1)[:, ::-1]
        self.whole = np.append(whole, np.zeros((len(whole), 1)), axis=1)
        products = np.column_stack([self.whole**2, self.whole[:, 1:] * self.whole[:, :-1]])
        n_walks, n_onsets = len(whitening.weight), len(whitening.positions)
        self.inverse_energies, self.lengths = np.empty((n_walks, n_onsets)), np.zeros(n_walks)
        sums = whitening.weight @ products
        _sum_steps(sums, whitening.block, whitening.after, self.inverse_energies, self.lengths)


@kernel
def _sum_steps(sums: Array, block: NDArray[np.int64], after: Array, inverse_energies: Array, lengths: Array) -> None:
    """Write `inverse_energies` (w, o) and `lengths` (w,) of `_Steps`; the lengths are 0 before.

    `sums` (w, 2 K + 1): weighted squares of the K + 1 whole steps, and products of each with the next one; `block`,
    `after` (o,): as in `_Whitening`.
    """
    n_walks, n_onsets, n_whole = sums.shape[0], block.size, (sums.shape[1] + 1) // 2
    for walk in range(n_walks):
        for onset in range(n_onsets):
            place, end = block[onset], after[onset]
            begin = 1.0 - end
            first, last, product = sums[walk, place], sums[walk, place + 1], sums[walk, n_whole + place]
            energy = max(begin * begin * first + 2.0 * begin * end * product + end * end * last, TINY)
            inverse_energies[walk, onset] = 1.0 / energy
            if onset + 1 < n_onsets:  # the angle to the next onset, which lies in this block or at its end
                next_end = after[onset + 1] + (block[onset + 1] - place)
                next_begin = 1.0 - next_end
                next_energy = next_begin * next_begin * first + 2.0 * next_begin * next_end * product
                next_energy = max(next_energy + next_end * next_end * last, TINY)
                inner = begin * next_begin * first + (begin * next_end + end * next_begin) * product
                cosine = (inner + end * next_end * last) / math.sqrt(energy * next_energy)
                lengths[walk] += math.acos(min(max(cosine, -1.0), 1.0))


def _whiten_blocks(information: Information) -> tuple[_Whitening, Array, Array] | None:
    """Transform the estimates of a coefficient in blocks to independent values of variance 1.

    Returns the matrices of this transform, the values z (n,), and the times of the possible onsets (o,) [s]. A finite
    prior on the level counts as one more block before the first. Returns None if too few blocks determine the
    coefficient, or if the precision is not finite.
    """
    time, precision, vector, level, slope, walk, disturbance, shape = information
    n_prior = int(
        math.isfinite(level) and len(time) >= MIN_BLOCKS
    )  # the added block must not count towards this number
    if n_prior:
        time, vector = np.append(2.0 * time[0] - time[1], time), np.append(0.0, vector)
        with_prior = np.zeros((len(time), len(time)))
        with_prior[0, 0], with_prior[1:, 1:] = 1.0 / level**2, precision
        precision, shape = with_prior, None if shape is None else np.append(0.0, shape)
    if len(time) < MIN_BLOCKS:
        return None
    matrices = _find_whitening(
        precision.tobytes(), len(time), n_prior, slope, walk, None if shape is None else shape.tobytes(), disturbance
    )
    if matrices is None:
        return None
    whitening, to_z = matrices
    # edges of the blocks: half way between their middles, extrapolated at both ends
    first_edge, last_edge = 1.5 * time[0] - 0.5 * time[1], 1.5 * time[-1] - 0.5 * time[-2]
    edges = np.concatenate([[first_edge], 0.5 * (time[1:] + time[:-1]), [last_edge]])
    onsets = np.interp(whitening.positions, np.arange(len(edges)), edges)
    return whitening, to_z @ vector, onsets


@lru_cache(maxsize=64)
def _find_whitening(
    precision: bytes, count: int, n_prior: int, slope: float, walk: float, shape: bytes | None, disturbance: float
) -> tuple[_Whitening, Array] | None:
    """Build the matrices of `_build_whitening`, once for the tests of all laws, growths and shapes of a coefficient.

    `precision`, `shape`: bytes of the arrays of doubles, `precision` with `count` rows.
    """
    shape_values = None if shape is None else np.frombuffer(shape)
    matrix = np.frombuffer(precision).reshape(count, count)
    return _build_whitening(matrix, n_prior, slope, walk, shape_values, disturbance)


def _build_whitening(
    precision: Array, n_prior: int, slope: float, walk: float, shape: Array | None, disturbance: float
) -> tuple[_Whitening, Array] | None:
    """Build the matrices that turn the estimates of a coefficient in K blocks into independent values.

    The values do not depend on level and slope of the coefficient, nor on a multiple of `shape` (K,), if it is given.
    `precision` (K, K): inverse covariance of the estimates, of which the first `n_prior` are a prior's; `slope`,
    `walk`, `disturbance`: scales of the priors on the slope, on the random walk over all blocks, and on the multiple
    (`Information`). A block counts by its information beside that of other blocks, not beside a prior's. Returns them,
    and the matrix (n, K) from the `vector` of `Information` to z; None if too few blocks have information.
    """
    count = len(precision)
    if not np.isfinite(precision).all():
        return None
    strengths = np.linalg.eigvalsh(precision[n_prior:, n_prior:])
    floor = RANK_TOLERANCE * max(float(strengths[-1]), 0.0)
    n_informative = n_prior + int(np.count_nonzero(strengths > floor))
    if n_informative < MIN_BLOCKS:
        return None
    changes = np.ones((2 if shape is None else 3, count))
    priors = np.array([0.0, max(slope, SMALLEST) ** -2, max(disturbance, SMALLEST) ** -2])
    changes[1] = (np.arange(count) - 0.5 * (count - 1)) / count
    if shape is not None:
        changes[2] = shape
    sums, gains = np.zeros_like(precision), np.zeros_like(changes)
    n_removed = _project_out(precision, changes, priors, floor, np.empty(count), sums, gains)
    eigen, vectors = np.linalg.eigh(sums)
    n = min(n_informative - n_removed, int(np.count_nonzero(eigen > ROUNDING * max(float(eigen[-1]), 0.0))))
    if n < 1:
        return None
    eigen, increments, to_z = eigen[count - n :], np.empty((n, count)), np.empty((n, count))
    _transform_blocks(eigen, vectors, changes, gains, increments, to_z)
    unit = n / float(eigen.sum())
    positions = np.arange(EDGE, count - EDGE + ROUNDING, 1.0 / PARTS)
    # before or after all blocks with information a step cannot be told from level and slope: its energy is zero
    block = (positions + ROUNDING).astype(np.int64)
    energies = (increments**2).sum(axis=0)
    energies = energies[block] + (positions - block) * energies[block + 1]
    positions, block = (values[energies > RANK_TOLERANCE * energies.max()] for values in (positions, block))
    whitening = _Whitening(
        increments=increments,
        eigen=unit * eigen,
        unit=unit,
        positions=positions,
        block=block,
        after=positions - block,
        walks=WALKS,
        # half-Cauchy prior on the standard deviation of the walk over all blocks, whose scale is `walk`
        walk_log_priors=-np.log1p(WALKS * unit * count / walk**2),
    )
    return whitening, to_z


@kernel
def _project_out(
    precision: Array, changes: Array, priors: Array, floor: float, products: Array, sums: Array, gains: Array
) -> int:
    """Eliminate m nuisance `changes` (m, K) from the `precision` (K, K) of a coefficient in K blocks, one by one.

    `priors` (m,): prior precisions of their sizes. A change x that the data cannot show, with x' Lambda x at most
    `floor` x' x beside the earlier ones, stays. Writes L' Lambda L of the remaining precision to `sums` (K, K), where L
    sums up the increments of the coefficient, and to `gains` (m, K) that of each change, with which its elimination
    subtracts gain x' vector from the vector of the likelihood. `products` (K,) is scratch. Returns the number of values
    that are lost.
    """
    n_changes, count = changes.shape
    n_removed = 0
    for i in range(count):
        for j in range(count):
            sums[i, j] = precision[i, j]
    for m in range(n_changes):
        energy, square = 0.0, 0.0
        for i in range(count):
            product = 0.0
            for j in range(count):
                product += sums[i, j] * changes[m, j]
            products[i] = product
            energy += changes[m, i] * product
            square += changes[m, i] * changes[m, i]
        if energy > floor * square:
            n_removed += priors[m] == 0.0
            for i in range(count):
                gains[m, i] = products[i] / (energy + priors[m])
                for j in range(count):
                    sums[i, j] -= gains[m, i] * products[j]
    for i in range(count - 1, -1, -1):
        along_row = 0.0
        for j in range(count - 1, -1, -1):
            along_row += sums[i, j]
            sums[i, j] = along_row + (sums[i + 1, j] if i + 1 < count else 0.0)
    return n_removed


@kernel
def _transform_blocks(
    eigen: Array, vectors: Array, changes: Array, gains: Array, increments: Array, to_z: Array
) -> None:
    """Write `increments` (n, K) of `_Whitening`, and `to_z` (n, K) of `_build_whitening`.

    `eigen` (n,): largest eigenvalues of the increments' precision; `vectors` (K, K): its eigenvectors as columns, those
    of `eigen` last; `changes`, `gains` (m, K): as in `_project_out`.
    """
    n, count = increments.shape
    for i in range(n):
        root, total = math.sqrt(eigen[i]), 0.0
        for k in range(count):
            element = vectors[k, count - n + i]
            increments[i, k] = root * element
            total += element / root
            to_z[i, k] = total
        for m in range(changes.shape[0] - 1, -1, -1):
            product = 0.0
            for k in range(count):
                product += to_z[i, k] * gains[m, k]
            for k in range(count):
                to_z[i, k] -= product * changes[m, k]


def _test_steps(
    whitening: _Whitening, onsets: Array, steps: _Steps, z: Array, signs: Sequence[float]
) -> list[StepTest]:
    """Test whitened values z (n,) of a coefficient for a step at any of o `onsets` [s], by the likelihood ratio.

    `signs`: 1 for a step up, -1 for a step down, with a test each.
    """
    n, unit = len(z), whitening.unit
    weighted = whitening.weight * z
    total = np.maximum(weighted @ z, TINY)  # weighted sum of the values' squares, for each walk
    moments, tests = weighted @ steps.whole, list[StepTest]()
    for sign in signs:
        courses, by_walk, numbers = np.empty((4, len(onsets))), np.empty((2, len(weighted))), np.empty(9)
        _score_step(
            whitening.log_factor,
            whitening.walks,
            whitening.walk_log_priors,
            whitening.block,
            whitening.after,
            steps.inverse_energies,
            steps.lengths,
            moments,
            total,
            sign,
            n,
            courses,
            by_walk,
            numbers,
        )
        score, best, *fitted, noise_without, noise_with, walk_without, walk_with, length = numbers.tolist()
        test = StepTest(
            score=score,
            best=int(best),
            positions=whitening.positions,
            onsets=onsets,
            likelihood=courses[0],
            size=courses[1],
            deviation=courses[2],
            fitted=Estimate(*fitted),
            walk=(unit * walk_without, unit * walk_with),
            noise=(noise_without, noise_with),
            law=NullLaw(dimensions=min(n, 0.5 * n + 2.0), length=length),  # degrees of freedom: see the module
            sign=sign,
        )
        tests.append(test)
    return tests


@kernel
def _score_step(
    log_factor: Array,
    walks: Array,
    walk_log_priors: Array,
    block: NDArray[np.int64],
    after: Array,
    inverse_energies: Array,
    lengths: Array,
    moments: Array,
    total: Array,
    sign: float,
    n: int,
    courses: Array,
    by_walk: Array,
    numbers: Array,
) -> None:
    """Maximise the likelihoods of a step and of no step over the variances of walk and noise, for `_test_steps`.

    A step down is a step up of the values with the opposite sign. `moments` (w, K + 1): weighted products of the
    `_Steps.whole` with the values, for each walk; `total` (w,): those of the values with themselves. Writes to
    `courses` (4, o) the log likelihood of a step at each onset, and its size, up or down, with its error for the
    likeliest walk without a step; to `numbers` (9,) score, index of the best onset, size and error of the step there,
    variances of the noise and of the walk (one of `walks`), each without a step and with the best one, and the largest
    length of the curve of the steps over the walks that the data allow. The last row of `courses`, and `by_walk` (2, w)
    are scratch.
    """
    n_walks, n_onsets = inverse_energies.shape
    half = 0.5 * n
    likelihood, size, deviation, gains = courses
    without_likelihoods, with_likelihoods = by_walk
    without, largest_factor = 0, log_factor[0]
    for walk in range(n_walks):
        without_likelihoods[walk] = log_factor[walk] - half * math.log(total[walk] / n)
        if without_likelihoods[walk] > without_likelihoods[without]:
            without = walk
        largest_factor = max(largest_factor, log_factor[walk])
    # at each onset the likeliest walk is that with the least squares times exp(-2 log_factor / n): one logarithm each
    for onset in range(n_onsets):
        likelihood[onset] = np.inf
        moment = sign * ((1.0 - after[onset]) * moments[without, block[onset]])
        moment += sign * after[onset] * moments[without, block[onset] + 1]
        inverse = inverse_energies[without, onset]
        size[onset] = moment * inverse
        deviation[onset] = math.sqrt(max(total[without] - moment * moment * inverse, 0.0) / n * inverse)
    smallest, best_walk, best = np.inf, 0, 0
    for walk in range(n_walks):
        scale, largest_gain = math.exp(2.0 / n * (largest_factor - log_factor[walk])), 0.0
        for onset in range(n_onsets):
            moment = (1.0 - after[onset]) * moments[walk, block[onset]] + after[onset] * moments[walk, block[onset] + 1]
            moment = max(sign * moment, 0.0)  # a step down is not fitted
            gains[onset] = moment * moment * inverse_energies[walk, onset]
        least = MIN_RESIDUAL * total[walk]  # positive, since the logarithm is used
        for onset in range(n_onsets):
            largest_gain = max(largest_gain, gains[onset])
            likelihood[onset] = min(likelihood[onset], scale * max(total[walk] - gains[onset], least))
        least = max(total[walk] - largest_gain, least)
        with_likelihoods[walk] = log_factor[walk] - half * math.log(least / n)
        if scale * least < smallest:
            smallest, best_walk = scale * least, walk
            for onset in range(n_onsets):
                if gains[onset] == largest_gain:
                    best = onset
                    break
    for onset in range(n_onsets):
        likelihood[onset] = largest_factor - half * math.log(likelihood[onset] / n)
    # variances of the walk that the data alone, without the prior, allow: with or without a step
    highest_without, highest_with, length = -np.inf, -np.inf, 0.0
    for walk in range(n_walks):
        highest_without = max(highest_without, without_likelihoods[walk] - walk_log_priors[walk])
        highest_with = max(highest_with, with_likelihoods[walk] - walk_log_priors[walk])
    for walk in range(n_walks):
        below_without = highest_without - without_likelihoods[walk] + walk_log_priors[walk]
        below_with = highest_with - with_likelihoods[walk] + walk_log_priors[walk]
        if below_without < ALLOWED or below_with < ALLOWED:
            length = max(length, lengths[walk])
    noise = smallest / math.exp(2.0 / n * (largest_factor - log_factor[best_walk])) / n
    moment = (1.0 - after[best]) * moments[best_walk, block[best]] + after[best] * moments[best_walk, block[best] + 1]
    inverse = inverse_energies[best_walk, best]
    numbers[0], numbers[1] = 2.0 * (likelihood[best] - without_likelihoods[without]), best
    numbers[2], numbers[3] = sign * moment * inverse, math.sqrt(noise * inverse)
    numbers[4], numbers[5] = total[without] / n, noise
    numbers[6], numbers[7], numbers[8] = walks[without], walks[best_walk], length
