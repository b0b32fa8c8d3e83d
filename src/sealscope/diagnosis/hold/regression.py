"""Regression of a held position or pressure on a steady rate, averaged over noise, settling and cooling.

Readings y at m times are a linear model with Gaussian errors,

    y = Z b + e,   cov e = s^2 (I + r K),   K(t, t') = exp(-|t - t'|/tau)  or, for a random walk,  min(t, t')/T,

whose coefficients b have normal priors. Ratio r, correlation time tau, variance s^2 and the optional columns of Z
(what settles, what cools) are alternatives on a grid. The rate's posterior is the mixture over the grid of its normal
posteriors, weighted by prior and marginal likelihood, so that its interval holds whatever the colour of the noise.

Source: C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning, 2006, sections 2.7 (explicit
basis functions) and 5.4.1 (marginal likelihood).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.hold.readings import Readings
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.recordings.recording import Array

#: Points of the grid of log s^2 about its most probable value, in standard deviations sqrt(2/m).
VARIANCE_POINTS = np.array([-1.5, -0.5, 0.5, 1.5, 2.5, 3.5])
#: Iterations that find the most probable variance.
N_ITERATIONS = 3
#: Combinations whose log likelihood, at the most probable variance, is lower than the best by more are left out.
MAX_DECREASE = 14.0
#: Smallest weight of a component of a mixture, relative to the largest.
LEAST_WEIGHT = 1e-5
#: Half of an interval's probability outside, and iterations of a bisection for a quantile.
TAIL, N_BISECTIONS = 0.025, 30
#: Number of factors into which an uncertain one is divided.
N_FACTORS = 15
#: Smallest standard deviation of the noise of a mean, in the readings' unit.
LEAST_DEVIATION = 1e-6
#: Ridge on the diagonal of the relative covariance of the noise.
RIDGE = 1e-9


class Column(NamedTuple):
    """A column of the regression: its `values` (m,), and mean and standard deviation of its coefficient's prior."""

    values: Array
    mean: float = 0.0
    deviation: float = math.inf


class Alternative(NamedTuple):
    """An alternative for a term of the regression: its prior probability, and its columns, none for its absence."""

    weight: float
    columns: tuple[Column, ...] = ()


class Noise(NamedTuple):
    """Noise of the readings: `ratio` of the wander's variance to the white noise's, and its correlation `time` [s].

    An infinite time is a random walk, whose variance at the end of the hold counts; `weight`: prior probability.
    """

    ratio: float
    time: float
    weight: float

    def covariance(self, t: Array, duration: float, white: float = 1.0) -> Array:
        """Compute the covariance (m, m) of readings at `t` [s] over s^2; `white`: variance of the white noise."""
        lags = np.abs(t[:, None] - t[None, :])
        walk = np.minimum(t[:, None], t[None, :]) / duration
        wander = walk if math.isinf(self.time) else np.exp(-lags / self.time)
        return np.asarray(self.ratio * wander + (white + RIDGE) * np.eye(len(t)))


def list_noises(duration: float) -> list[Noise]:
    """List the alternatives of `[noise]` for a hold of a `duration` [s]."""
    prior = HOLD.noise
    wandering = 1.0 - prior.white - prior.walking
    kinds = [(math.inf, prior.walks, prior.walking)]
    for time, share in zip(prior.times, (1.0 - prior.slow, prior.slow), strict=True):
        kinds.append((time * duration, prior.ratios, wandering * share))
    noises = [Noise(0.0, math.inf, prior.white)]
    for time, ratios, weight in kinds:
        noises += [Noise(ratio, time, weight / len(ratios)) for ratio in ratios]
    return noises


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of normal distributions: `weights` (k,) of sum 1, `means` (k,) and standard `deviations` (k,)."""

    weights: Array
    means: Array
    deviations: Array

    @property
    def mean(self) -> float:
        """Mean of the mixture."""
        return float(self.weights @ self.means)

    @property
    def deviation(self) -> float:
        """Standard deviation of the mixture."""
        return float(np.sqrt(self.weights @ (self.deviations**2 + (self.means - self.mean) ** 2)))

    def below(self, value: float) -> float:
        """Compute the probability of values below `value`."""
        from scipy.special import ndtr

        return float(self.weights @ ndtr((value - self.means) / self.deviations))

    def quantile(self, probability: float) -> float:
        """Compute the value below which the mixture has a `probability`."""
        reach = 40.0 * self.deviations
        low, high = float((self.means - reach).min()), float((self.means + reach).max())
        for _ in range(N_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.below(middle) < probability else (low, middle)
        return 0.5 * (low + high)

    @cached_property
    def interval(self) -> tuple[float, float]:
        """95 % interval (low, high)."""
        return self.quantile(TAIL), self.quantile(1.0 - TAIL)

    def scale(self, factor: float, deviation: float = 0.0) -> Mixture:
        """Multiply the quantity by `factor`, whose logarithm has a standard `deviation`, in quantiles."""
        if deviation == 0.0:
            return Mixture(self.weights, factor * self.means, abs(factor) * self.deviations)
        normal = NormalDist()
        factors = [factor * math.exp(deviation * normal.inv_cdf((k + 0.5) / N_FACTORS)) for k in range(N_FACTORS)]
        return pool_mixtures([self.scale(number) for number in factors], np.full(N_FACTORS, 1.0 / N_FACTORS))

    def add_error(self, deviation: float) -> Mixture:
        """Add an independent normal error to the quantity."""
        return Mixture(self.weights, self.means, np.hypot(self.deviations, deviation))


def pool_mixtures(mixtures: Sequence[Mixture], weights: Array) -> Mixture:
    """Pool mixtures (k,) with `weights` (k,) of sum 1."""
    pairs = zip(mixtures, weights, strict=True)
    return Mixture(
        np.concatenate([weight * mixture.weights for mixture, weight in pairs]),
        np.concatenate([mixture.means for mixture in mixtures]),
        np.concatenate([mixture.deviations for mixture in mixtures]),
    )


class RateFit(NamedTuple):
    """Posterior of the rate, the first coefficient, and the most probable fit of the readings."""

    rate: Mixture
    fit: Array  # (m,) readings of the most probable alternative
    band: Array  # (m,) standard deviation of the fit
    noise: Noise  # of the most probable alternative
    s: float  # standard deviation of its white part
    log_evidence: float


def pool_fits(fits: Sequence[RateFit], logs: Sequence[float]) -> RateFit:
    """Pool fits (k,) whose logarithms of probability are `logs` (k,): the most probable, with the rates of all."""
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    rate = pool_mixtures([fit.rate for fit in fits], weights)
    return fits[int(weights.argmax())]._replace(rate=rate)


def fit_rate(
    readings: Readings, base: Sequence[Column], alternatives: Sequence[Sequence[Alternative]], duration: float,
    *, from_first: bool = True,
) -> RateFit:  # fmt: skip
    """Fit the readings of a hold, and average over noise and `alternatives`.

    `base`: columns that all fits have, of which the first is that of the rate; `alternatives`: for each optional term
    its possible columns; `duration` [s]: of the hold; `from_first`: the readings count from the first.
    """
    t, y = readings.t, readings.values - (readings.values[0] if from_first else 0.0)
    columns = [*base, *(column for options in alternatives for option in options for column in option.columns)]
    choices, log_priors = _list_choices(alternatives, len(base))
    values = np.column_stack([y, *(column.values for column in columns), np.zeros(len(y))])
    # the last column is empty, with a coefficient of prior variance 1; it fills the place of an absent one
    precision = np.array([*(column.deviation**-2.0 for column in columns), 1.0])[choices]
    mean = np.array([*(column.mean for column in columns), 0.0])[choices]
    is_proper = precision > 0.0
    log_priors = log_priors + 0.5 * np.log(np.where(is_proper, precision, 1.0)).sum(axis=1)
    freedom = max(len(t) - int((~is_proper[0]).sum()), 1)
    # means tell the size of their noise; passages are too few, and readings beside them have errors of known size
    scales = [share * readings.quantum for share in HOLD.noise.steps] if readings.quantum else [1.0]
    noises = [(noise, s) for noise in list_noises(duration) for s in scales]
    grams, log_noise = [], []
    for noise, s in noises:
        covariance = s**2 * noise.covariance(t, duration) + np.diag(readings.loose**2)
        factor = np.linalg.cholesky(covariance)
        whitened = np.linalg.solve(factor, values)
        grams.append(whitened.T @ whitened)
        log_noise.append(math.log(noise.weight / len(scales)) - float(np.log(np.diag(factor)).sum()))
    gram, n_choices = np.array(grams), len(choices)
    products = gram[:, 1:, 1:][:, choices[:, :, None], choices[:, None, :]].reshape(-1, *2 * choices.shape[1:])
    system = _System(
        products,
        gram[:, 1:, 0][:, choices].reshape(len(products), -1),
        np.repeat(gram[:, 0, 0], n_choices),
        np.tile(precision, (len(noises), 1)),
        np.tile(mean, (len(noises), 1)),
    )
    prior = (np.array(log_noise)[:, None] + log_priors).ravel()
    floor, factors, log_step = LEAST_DEVIATION**2, np.ones(1), 0.0
    variance = np.ones(len(prior))
    if not readings.quantum:
        variance = np.maximum(system.square / len(t), floor)
        log_step = 0.5 * math.log(2.0 / freedom)
        factors = np.exp(math.sqrt(2.0 / freedom) * VARIANCE_POINTS)
        for _ in range(N_ITERATIONS):
            misfit, _ = system.misfit(variance)
            variance = np.maximum(variance * np.maximum(misfit, RIDGE) / freedom, floor)
    misfit, log_det = system.misfit(variance)
    profile = prior - 0.5 * (len(t) * np.log(variance) + log_det + misfit)
    kept = np.flatnonzero(profile > profile.max() - MAX_DECREASE)
    grid = np.maximum(factors[:, None] * variance[kept], floor)
    rows: NDArray[np.intp] = np.tile(kept, len(grid))
    grid = grid.ravel()
    misfit, log_det, coefficients, covariance = system.take(rows).posterior(grid)
    logs = prior[rows] - 0.5 * (len(t) * np.log(grid) + log_det + misfit) + log_step
    weights = np.exp(logs - logs.max())
    best = int(weights.argmax())
    noise, s = noises[rows[best] // n_choices]
    design = values[:, 1:][:, choices[rows[best] % n_choices]]
    band = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", design, covariance[best], design), 0.0))
    deviations = np.sqrt(np.maximum(covariance[:, 0, 0], np.finfo(float).tiny))
    usual = weights > LEAST_WEIGHT
    return RateFit(
        Mixture(*(series[usual] for series in (weights / weights.sum(), coefficients[:, 0], deviations))),
        design @ coefficients[best],
        band,
        noise,
        s * float(np.sqrt(grid[best])),
        float(logs.max() + np.log(weights.sum())),
    )


class _System(NamedTuple):
    """Normal equations of k fits of p columns.

    `products` (k, p, p), `with_y` (k, p), `square` (k,): whitened products of the columns, with y, and of y;
    `precision`, `mean` (k, p): of the coefficients' priors.
    """

    products: Array
    with_y: Array
    square: Array
    precision: Array
    mean: Array

    def take(self, rows: NDArray[np.intp]) -> _System:
        """Select fits by their indices."""
        return _System(*(values[rows] for values in self))

    def _equations(self, variance: Array) -> tuple[Array, Array]:
        """Build matrix (k, p, p) and right side (k, p) of the posterior for variances (k,) of the noise."""
        matrix = self.products / variance[:, None, None]
        diagonal = np.arange(matrix.shape[1])
        matrix[:, diagonal, diagonal] += self.precision
        return matrix, self.with_y / variance[:, None] + self.precision * self.mean

    def _misfit(self, variance: Array, right: Array, coefficients: Any) -> Array:
        """Compute the weighted squares of residuals and of deviations from the priors (k,)."""
        shift = (self.precision * self.mean**2).sum(axis=1)
        return np.asarray(self.square / variance + shift - (right * coefficients).sum(axis=1))

    def misfit(self, variance: Array) -> tuple[Array, Array]:
        """Compute the misfit (k,), and the log determinant (k,) of the posterior's matrix."""
        matrix, right = self._equations(variance)
        coefficients = np.linalg.solve(matrix, right[..., None])[..., 0]
        return self._misfit(variance, right, coefficients), np.linalg.slogdet(matrix)[1]

    def posterior(self, variance: Array) -> tuple[Array, Array, Array, Array]:
        """Compute misfit, log determinant, coefficients (k, p) and covariance (k, p, p) of the posterior."""
        matrix, right = self._equations(variance)
        covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
        coefficients: Array = np.asarray((covariance @ right[..., None])[..., 0], dtype=np.float64)
        return self._misfit(variance, right, coefficients), np.linalg.slogdet(matrix)[1], coefficients, covariance


def _list_choices(alternatives: Sequence[Sequence[Alternative]], n_base: int) -> tuple[NDArray[np.intp], Array]:
    """List the combinations of alternatives: indices (c, p) of their columns, -1 for none, and log priors (c,).

    The first `n_base` columns are in all combinations.
    """
    indices, k = list[list[tuple[tuple[int, ...], float]]](), n_base
    for options in alternatives:
        width = max(len(option.columns) for option in options)
        entries = []
        for option in options:
            used = tuple(range(k, k + len(option.columns)))
            entries.append((used + (-1,) * (width - len(used)), option.weight))
            k += len(used)
        indices.append(entries)
    combinations = list(itertools.product(*indices))
    choices = [[*range(n_base), *itertools.chain.from_iterable(used for used, _ in entry)] for entry in combinations]
    return np.array(choices), np.log([math.prod(weight for _, weight in entry) for entry in combinations])


def predict_deviation(
    t: Array, columns: Sequence[Column], noise: Noise, s: float, duration: float, white: float = 1.0
) -> float:
    """Predict the standard deviation of the rate, the first coefficient, from readings at `t` (m,) of a planned hold.

    The formula is that of `fit_rate`, without readings: the posterior covariance does not depend on them. `s`,
    `white`: standard deviation of the noise, and variance of its white part over s^2; `duration` [s]: time by which a
    random walk reaches the `noise`'s ratio.
    """
    factor = np.linalg.cholesky(noise.covariance(t, duration, white))
    whitened = np.linalg.solve(factor, np.column_stack([column.values for column in columns])) / s
    matrix = whitened.T @ whitened + np.diag([column.deviation**-2.0 for column in columns])
    return float(np.sqrt(np.linalg.inv(matrix)[0, 0]))
