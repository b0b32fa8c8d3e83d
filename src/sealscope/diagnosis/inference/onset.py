"""Did a coefficient step within a recording? The likelihood ratio over all onsets, beside a random walk.

Of one coefficient g, a number for each of K blocks, the blocks say `Information`(Lambda, eta). In any healthy machine g
has a level, a slope and a random walk; with a leak also a step from its onset on:

    g = F a + w + delta s(onset),    z = Lambda^(-1/2) eta ~ N(Lambda^(1/2) g, kappa I),    cov w = kappa q min(k, l),

kappa the inflation of the noise for what the rows' correlation adds. F is projected out; (q, kappa) are estimated with
the step and without it; one eigenproblem serves all onsets and all q. The score is twice the logarithm of the ratio of
the likelihoods, for steps > 0. An onset within a block is a part of a step there.

Its chance under the null follows from geometry, without a simulation: for a known q the whitened z is uniform on a
sphere in n = K - 2 dimensions, steps over all onsets form a curve of length L on it, and the chance that z lies within
the angle of its best onset, cos^2 = 1 - exp(-score/n), of that curve is that of a tube about it,

    P = I_{1-c^2}((m - 1)/2, 1/2) / 2 + L / (2 pi) (1 - c^2)^((m - 2)/2),    1 - c^2 = exp(-score/m),    m = n.

q is not known, and a walk can pass for a step: taking the step out makes the fitted walk smaller. Two things follow.
L is the largest over the walks that the recording allows, those within `ALLOWED` of the largest likelihood, without the
step or with it (R. L. Berger and D. D. Boos: the supremum over a confidence set): it grows with q, from 26 for no walk
to 88 for nothing but a walk (60 blocks). And the residuals estimate two variances, noise and walk: half of the degrees
of freedom at worst go to each, m = min(n, n/2 + 2). That this is enough was found by drawing. Chances below 1 %, in
percent of 2 800 to 12 000 healthy draws a cell, block precisions log-normal of width 0.5, over the walk's variance per
noise's (in brackets m = n and L of the fitted walks, as if q were known):

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
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: Standard deviations of a normal law within which 95 % lies, and below which 95 % lies.
WITHIN_95, BELOW_95 = 1.96, 1.645
#: Fewest blocks: a level, a slope, a step and its deviation leave nothing below.
FEWEST = 5
#: Parts of a block in which an onset is looked for, and blocks at either end in which none is.
PARTS, EDGE = 5, 2
#: Sizes of the random walk that are tried: q over the noise, and none.
WALKS = np.concatenate([[0.0], 10.0 ** np.linspace(-4.0, 3.0, 29)])
#: How far below the largest a walk's log-likelihood may be for the null law to count with it: 99.7 % of chi square(1).
ALLOWED = 4.5
#: Directions that carry less of what the largest carries carry nothing.
RANK = 1e-9


class Information(NamedTuple):
    """Likelihood of one coefficient in K blocks, one number g_k a block: exp(vector g - g precision g / 2).

    `time` (K,) [s], `precision` (K, K), `vector` (K,). What is believed of the coefficient, infinite where nothing is:
    `level`, its standard deviation before the first block; `slope`, that of an even change over all blocks; `walk`,
    the scale of a half-Cauchy distribution of the deviation that a random walk reaches over all blocks.
    """

    time: Array
    precision: Array
    vector: Array
    level: float = float("inf")
    slope: float = float("inf")
    walk: float = float("inf")


class Interval(NamedTuple):
    """An estimate with its interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class StepTest:
    """The test of a step of one coefficient over all onsets; made by `step_test`.

    Parameters
    ----------
    score : float
        Twice the logarithm of the likelihood ratio of the best step > 0.
    chance : float
        Probability that a coefficient without a step scores as high.
    best : int
        Index of the most likely onset.
    onsets : array of float, shape (o,)
        Onsets that were tried [s].
    likelihood : array of float, shape (o,)
        Log-likelihood of a step at each, its size and the walk's fitted.
    size, deviation : array of float, shape (o,)
        Step at each onset and its standard deviation, for the walk without a step.
    fitted : tuple of two floats
        Step at the best onset and its standard deviation, for the walk beside it.
    walk, noise : tuple of two floats
        q and kappa without a step and with the best one.
    law : NullLaw
        Distribution of the score under the null.
    """

    score: float
    chance: float
    best: int
    onsets: Array
    likelihood: Array
    size: Array
    deviation: Array
    fitted: tuple[float, float]
    walk: tuple[float, float]
    noise: tuple[float, float]
    law: NullLaw

    @cached_property
    def weights(self) -> Array:
        """Probability of each onset, given that there is a step."""
        weights = np.exp(self.likelihood - self.likelihood.max())
        return np.asarray(weights / weights.sum())

    def onset(self, probability: float = 0.95) -> Interval:
        """Return the most likely onset [s] and the interval that holds it with a probability.

        Rows of the block in which the leak begins are weighed as if it leaked throughout or not at all, so that an
        onset is known to half a block at best.
        """
        ends = np.interp([0.5 - 0.5 * probability, 0.5 + 0.5 * probability], np.cumsum(self.weights), self.onsets)
        best = float(self.onsets[self.best])
        step = float(self.onsets[1] - self.onsets[0]) if len(self.onsets) > 1 else 0.0
        half = 0.5 * PARTS * step
        return Interval(best, min(float(ends[0]), best) - half, max(float(ends[1]), best) + half)

    def bound(self, probability: float = 0.95) -> float:
        """Return the step that is exceeded with probability 1 - `probability`, given that there is a step > 0."""
        from scipy.optimize import brentq
        from scipy.special import ndtr

        deviation = np.maximum(self.deviation, np.finfo(float).tiny)
        above = float(self.weights @ ndtr(self.size / deviation))
        high = float(np.max(self.size + 12.0 * deviation))
        if not above > 0.0 or not high > 0.0:
            return max(high, 0.0)

        def excess_chance(share: float) -> float:
            return float(self.weights @ ndtr((self.size - share * high) / deviation)) - (1.0 - probability) * above

        return high * float(brentq(excess_chance, 0.0, 1.0)) if excess_chance(1.0) < 0.0 else high

    def findable(self, chance: float, power: float = 0.9) -> float:
        """Return the step that is found with probability `power` at a false-alarm probability, at the median onset."""
        from scipy.special import ndtri

        return float((np.sqrt(self.threshold(chance)) + ndtri(power)) * np.median(self.deviation))

    def threshold(self, chance: float) -> float:
        """Return the score that a coefficient without a step exceeds with a probability."""
        from scipy.optimize import brentq

        most = 1e4
        if not self.law.chance(0.0) > chance > self.law.chance(most):
            return 0.0 if self.law.chance(0.0) <= chance else most
        return float(brentq(lambda score: self.law.chance(score) - chance, 0.0, most))


class Course(NamedTuple):
    """A coefficient over the blocks, given the blocks and the model of the test: `mean` (K,), `covariance` (K, K)."""

    mean: Array
    covariance: Array

    def over(self, weights: Array) -> Interval:
        """Return the weighted mean of the coefficient with its 95 % interval, weights (K,) of sum 1."""
        value = float(weights @ self.mean)
        half = WITHIN_95 * float(np.sqrt(np.maximum(weights @ self.covariance @ weights, 0.0)))
        return Interval(value, value - half, value + half)

    def relative_to(self, before: NDArray[np.bool_]) -> Course:
        """Return the coefficient beyond its mean over some blocks (K,)."""
        turn = np.eye(len(before)) - before / max(int(np.count_nonzero(before)), 1)
        return Course(turn @ self.mean, turn @ self.covariance @ turn.T)


def course(information: Information, test: StepTest | None, step: bool) -> Course:
    """Return the coefficient over the blocks: level, slope and random walk, with the best step or without one."""
    count = len(information.time)
    index = np.arange(count) - 0.5 * (count - 1)
    noise = 1.0 if test is None else test.noise[step]
    design = [np.ones(count)]
    if count >= FEWEST:
        design.append(index / max(count, 1))
    if step and test is not None:
        design.append(np.clip((information.time - test.onsets[test.best]) / _spacing(information.time) + 0.5, 0.0, 1.0))
    fixed = len(design)
    walk = 0.0 if test is None else test.walk[step]
    if walk > 0.0:
        design += list(np.sqrt(walk) * np.tril(np.ones((count, count))).T)
    basis = np.column_stack(design)
    precision = basis.T @ information.precision @ basis / noise
    precision[np.arange(fixed, basis.shape[1]), np.arange(fixed, basis.shape[1])] += 1.0 / noise
    if count >= FEWEST:
        precision[1, 1] += 1.0 / noise / information.slope**2
    inverse = _inverse(precision)
    mean = basis @ (inverse @ (basis.T @ information.vector / noise))
    return Course(mean, basis @ inverse @ basis.T)


def _spacing(time: Array) -> float:
    return float(time[1] - time[0]) if len(time) > 1 else 1.0


def _inverse(matrix: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    return np.asarray(np.linalg.pinv(matrix / np.outer(size, size), hermitian=True) / np.outer(size, size))


class NullLaw(NamedTuple):
    """The null distribution of the score: degrees of freedom m and the curve's length."""

    dimensions: float
    length: float

    def chance(self, score: float) -> float:
        """Return the probability of a higher score."""
        from scipy.special import betainc

        n = self.dimensions
        away = float(np.exp(-max(score, 0.0) / n))  # 1 - cos^2
        tube = self.length / (2.0 * np.pi) * float(away ** (0.5 * (n - 2)))
        return min(1.0, 0.5 * float(betainc(0.5 * (n - 1), 0.5, away)) + tube)


def step_test(information: Information, signs: Sequence[float] = (1.0,), shape: Array | None = None) -> StepTest | None:
    """Return the likeliest test of a step of one of the `signs`; None where too few blocks say anything.

    The chance of one of two is twice that stated.
    """
    return max(step_tests(information, signs, shape), key=lambda test: test.score, default=None)


def step_tests(information: Information, signs: Sequence[float], shape: Array | None = None) -> list[StepTest]:
    """Return the tests of a step of each of the `signs`; none where too few blocks say anything.

    Parameters
    ----------
    information : Information
    signs : sequence of float
        1 for steps up, -1 for steps down.
    shape : array of float, shape (K,), optional
        What a step of one adds to the coefficient in each block while it lasts, by default one.
    """
    readings = _whiten(information)
    if readings is None:
        return []
    steps = readings.turn @ readings.step_shapes(readings.positions, shape)
    return [
        _scan(sign * readings.z, steps, readings.eigen, readings.onsets, readings.unit, readings.believed)
        for sign in signs
    ]


class StepSizes(NamedTuple):
    """Steps at given onsets (o,): log-likelihood of each, its size and the size's standard deviation."""

    likelihood: Array
    size: Array
    deviation: Array


def step_sizes(information: Information, onsets: NDArray[np.intp], shape: Array, growth: float) -> StepSizes:
    """Fit steps up at some of the onsets that a test tried, each with the walk that is likeliest beside it.

    Parameters
    ----------
    information : Information
    onsets : array of int, shape (o,)
        Indices of `StepTest.onsets`.
    shape : array of float, shape (K,)
        What a step of one adds to the coefficient in each block while it lasts.
    growth : float
        How much larger, as a share, the step is at the end than at its onset.
    """
    readings = _whiten(information)
    assert readings is not None
    z, n = readings.z, len(readings.z)
    steps = readings.turn @ readings.step_shapes(readings.positions[onsets], shape, growth)
    weight = 1.0 / (1.0 + WALKS[:, None] * readings.eigen)
    total = np.maximum((weight * z**2).sum(axis=1), np.finfo(float).tiny)
    lead, square = (weight * z) @ steps, np.maximum(weight @ steps**2, np.finfo(float).tiny)
    rest = np.maximum(total[:, None] - np.maximum(lead, 0.0) ** 2 / square, 1e-12 * total[:, None])
    likelihoods = 0.5 * np.log(weight).sum(axis=1)[:, None] + readings.believed[:, None] - 0.5 * n * np.log(rest / n)
    chosen = likelihoods.argmax(axis=0), np.arange(len(onsets))
    return StepSizes(likelihoods[chosen], (lead / square)[chosen], np.sqrt(rest / n / square)[chosen])


class _Whitened(NamedTuple):
    """Readings z (n,) of a coefficient, its level and slope set aside, in the walk's eigenvectors.

    `turn` (n, K) makes of a coefficient's blocks what it adds to z; `eigen` (n,) of the walk, times `unit`;
    `positions` (o,) of onsets in blocks, at times `onsets` (o,); `believed`: logarithm of the density of each of
    `WALKS`.
    """

    z: Array
    turn: Array
    eigen: Array
    unit: float
    positions: Array
    onsets: Array
    believed: Array

    def step_shapes(self, positions: Array, shape: Array | None = None, growth: float = 0.0) -> Array:
        """Compute steps at positions (o,) over the blocks, (K, o), times a `shape` (K,)."""
        count = self.turn.shape[1]
        steps = step_shapes(count, positions, growth)
        if shape is not None:
            steps[count - len(shape) :] *= shape[:, None]
        return steps


def step_shapes(count: int, positions: Array, growth: float = 0.0) -> Array:
    """Compute steps of one at positions (o,) over K blocks, (K, o), that grow evenly by a share up to the end.

    An onset within a block is a part of a step there.
    """
    since = np.arange(count)[:, None] + 1.0 - positions
    steps = np.clip(since, 0.0, 1.0)
    return np.asarray(steps * (1.0 + growth * np.clip((since - 0.5) / np.maximum(count - positions, 1.0), 0.0, 1.0)))


def _whiten(information: Information) -> _Whitened | None:
    """Return readings of a coefficient with its level and slope set aside; None where too few blocks say anything."""
    time, precision, vector = _with_level(information)
    count = len(time)
    values, vectors = np.linalg.eigh(precision)
    kept = values > RANK * max(float(values[-1]), 0.0)
    if count < FEWEST or np.count_nonzero(kept) < FEWEST:
        return None
    root = np.sqrt(values[kept])
    design = (vectors[:, kept] * root).T
    z = (vectors[:, kept].T @ vector) / root
    index = np.arange(count)
    fixed = design @ np.column_stack([np.ones(count), (index - index.mean()) / count])
    if np.isfinite(information.slope):  # what is believed of the slope is a reading of it
        fixed = np.vstack([fixed, [0.0, 1.0 / information.slope]])
        design, z = np.vstack([design, np.zeros(count)]), np.append(z, 0.0)
    free = np.linalg.qr(fixed, mode="complete")[0][:, 2:].T
    inner, outer = free @ design, np.minimum.outer(index, index) + 1.0
    covariance = inner @ outer @ inner.T
    unit = len(free) / max(float(np.trace(covariance)), np.finfo(float).tiny)
    eigen, basis = np.linalg.eigh(unit * covariance)
    positions = np.arange(EDGE, count - EDGE + 1e-9, 1.0 / PARTS)
    believed = -np.log1p(WALKS * unit * count / information.walk**2)
    return _Whitened(
        basis.T @ (free @ z),
        basis.T @ inner,
        np.maximum(eigen, 0.0),
        unit,
        positions,
        _onset_times(time, positions),
        believed,
    )


def two_sided(information: Information) -> StepTest | None:
    """Return the likelier test of a step up or down (`step_test`)."""
    return step_test(information, (1.0, -1.0))


def _with_level(information: Information) -> tuple[Array, Array, Array]:
    """Return time, precision and vector with what is believed of the level as a block before the first."""
    time, precision, vector, level = information[:4]
    if not np.isfinite(level) or len(time) < FEWEST:
        return time, precision, vector
    before = np.zeros((len(time) + 1, len(time) + 1))
    before[0, 0], before[1:, 1:] = 1.0 / level**2, precision
    return np.concatenate([[2.0 * time[0] - time[1]], time]), before, np.concatenate([[0.0], vector])


def _onset_times(time: Array, positions: Array) -> Array:
    """Return the times of onsets given in blocks from the beginning of the first."""
    edges = np.concatenate(
        [[1.5 * time[0] - 0.5 * time[1]], 0.5 * (time[1:] + time[:-1]), [1.5 * time[-1] - 0.5 * time[-2]]]
    )
    return np.asarray(np.interp(positions, np.arange(len(edges)), edges))


def _scan(z: Array, steps: Array, eigen: Array, onsets: Array, unit: float, believed: Array) -> StepTest:
    """Return the test from z (n,), steps (n, o) and the walk's eigenvalues (n,), times `unit`, in its eigenvectors.

    `believed`: logarithm of the density of each of `WALKS`.
    """
    n = len(z)
    weight = 1.0 / (1.0 + WALKS[:, None] * eigen)
    total = np.maximum((weight * z**2).sum(axis=1), np.finfo(float).tiny)
    lead, square = (weight * z) @ steps, np.maximum(weight @ steps**2, np.finfo(float).tiny)
    determinant = np.log(weight).sum(axis=1) + 2.0 * believed
    without = 0.5 * determinant - 0.5 * n * np.log(total / n)
    rest = np.maximum(total[:, None] - np.maximum(lead, 0.0) ** 2 / square, 1e-12 * total[:, None])
    with_step = 0.5 * determinant[:, None] - 0.5 * n * np.log(rest / n)
    plain = int(without.argmax())
    walk, best = np.unravel_index(int(with_step.argmax()), with_step.shape)
    score = 2.0 * float(with_step[walk, best] - without[plain])
    likeliest = with_step.max(axis=1)
    plainly, stepped = without - believed, likeliest - believed  # the recording alone says how large a walk may be
    allowed = (plainly > plainly.max() - ALLOWED) | (stepped > stepped.max() - ALLOWED)
    norm = np.sqrt(square[allowed])
    cosines = (weight[allowed] @ (steps[:, 1:] * steps[:, :-1])) / (norm[:, 1:] * norm[:, :-1])
    # of the curve of whitened steps on the unit sphere
    length = np.arccos(np.clip(cosines, -1.0, 1.0)).sum(axis=1).max()
    law = NullLaw(min(n, 0.5 * n + 2.0), float(length))
    noise = float(rest[walk, best]) / n
    fitted = float(lead[walk, best] / square[walk, best]), float(np.sqrt(noise / square[walk, best]))
    size = lead[plain] / square[plain]
    return StepTest(
        score=score,
        chance=law.chance(score),
        best=int(best),
        onsets=onsets,
        likelihood=with_step.max(axis=0),
        size=size,
        deviation=np.sqrt(np.maximum(total[plain] - lead[plain] ** 2 / square[plain], 0.0) / n / square[plain]),
        fitted=fitted,
        walk=(unit * float(WALKS[plain]), unit * float(WALKS[walk])),
        noise=(float(total[plain]) / n, noise),
        law=law,
    )
