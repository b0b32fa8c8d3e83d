"""Healthy recordings as draws from one population: the prediction of a value from those of healthy recordings.

The value x_i of recording i is

    x_i = mean + s z_i + d_i,

with an unknown mean, independent standard normal z_i, the unknown scatter s of single recordings, and normal deviations
d_i whose covariance is known up to a few candidates: the recording's own standard error, its session, the temperature
of its oil, the duty. The value of the next healthy recording then follows a mixture of normal distributions, over a
grid of s and over the candidates, by which a judged value is tested.

- `Population` is the model with any covariance; it predicts the leakage and the ringing of the pressures.
- `predict_estimate` has independent standard errors that may all be too small or too large by a common factor; it
  predicts friction, drifts and motion.
- Without errors and candidates the mixture is Student's t distribution with the variance of `estimate_variance`, which
  serves other terms of the volume balance and the spectra of the pressures.

Source: C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown
mean); A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 3.3 and 5.4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from sealscope.compiled import kernel
from sealscope.recordings.recording import Array
from sealscope.signals.smoothing import TINY

#: Probability with which a stated upper bound, or a stated interval, contains the true value.
BOUND_PROBABILITY = 0.95
#: Minimum number of healthy recordings for a scatter.
MIN_HEALTHY = 3
#: Maximum number of healthy recordings whose covariances are evaluated.
MAX_RECORDINGS = 60
#: Number of points of each grid, of standard deviations or of rises; and of the scatter of estimates.
NODES, ESTIMATE_NODES = 32, 64
#: Reach of the grid of the scatter of estimates: ratio of its ends to the prior's scatter, and least ratio of its upper
#: end to the values' scatter.
MAX_RATIO, MAX_RATIO_TO_VALUES = 100.0, 10.0
#: Number of grid points of the factor by which errors are too small or too large.
INFLATIONS = 9
#: Sums of squares above this, and standard deviations below its inverse, are not computed.
MAX_SQUARE = 1e100
#: Number of parts of a large mixture that give the first estimate of a quantile; maximum number of steps to it; and
#: distance [standard deviations] beyond which a normal distribution has no probability of the order of rounding.
SAMPLED, MAX_STEPS, NEGLIGIBLE_TAIL = 128, 200, 9.0
#: Width of the cells whose parts are merged, in standard deviations and in the logarithm of these.
CELL = 0.1
#: Number of factors into which an uncertain one is divided, and least weight of a part of a pooled mixture, over the
#: largest.
N_FACTORS, LEAST_WEIGHT = 15, 1e-5
ROOT_HALF, ROOT_PI = math.sqrt(0.5), math.sqrt(math.pi)


def normal_log_density(value: Any, variance: Any) -> Any:
    """Compute the log density at `value` of a normal distribution with mean 0 and a `variance`, numbers or arrays."""
    variance = np.maximum(variance, np.finfo(float).tiny)
    return -0.5 * value * value / variance - 0.5 * np.log(2.0 * np.pi * variance)


def weigh_alternatives(log_weights: Array) -> Array:
    """Compute the probabilities of alternatives, of which one is true, from log weights of any sum and shape.

    A log weight is the log prior plus the log likelihood or evidence, up to a constant that all have in common.
    """
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.sum())


class Mixture(NamedTuple):
    """Mixture of k normal distributions: their `weights`, of sum 1, standard `deviations` and `centres`, (k,) each.

    A mixture that `Population` returns has log weights and more axes; `normalise` and `rise_of_mixture` convert it.
    """

    weights: Array
    deviations: Array
    centres: Array

    def normalise(self) -> Mixture:
        """Convert a mixture with log weights of any sum and shape to one with weights of sum 1, (k,)."""
        shape = self.weights.shape
        deviations, centres = (np.broadcast_to(part, shape).ravel() for part in (self.deviations, self.centres))
        return Mixture(weigh_alternatives(self.weights).ravel(), deviations, centres)

    @property
    def mean(self) -> float:
        """Mean of the mixture."""
        return float(self.weights @ self.centres)

    @property
    def deviation(self) -> float:
        """Standard deviation of the mixture."""
        return float(np.sqrt(self.weights @ (self.deviations**2 + (self.centres - self.mean) ** 2)))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (low, high)."""
        return self.quantile(0.5 - 0.5 * BOUND_PROBABILITY), self.quantile(0.5 + 0.5 * BOUND_PROBABILITY)

    def scale(self, factor: float, deviation: float = 0.0) -> Mixture:
        """Multiply the quantity by `factor`, whose logarithm has a standard `deviation`, in quantiles."""
        if deviation == 0.0:
            return Mixture(self.weights, abs(factor) * self.deviations, factor * self.centres)
        normal = NormalDist()
        factors = [factor * math.exp(deviation * normal.inv_cdf((k + 0.5) / N_FACTORS)) for k in range(N_FACTORS)]
        return pool_mixtures([self.scale(number) for number in factors], np.full(N_FACTORS, 1.0 / N_FACTORS))

    def add_error(self, deviation: float) -> Mixture:
        """Add an independent normal error to the quantity."""
        return self._replace(deviations=np.hypot(self.deviations, deviation))

    def multiply(self, prior: Mixture) -> Mixture:
        """Compute the posterior from this mixture, under a flat prior, and another `prior`."""
        variances, totals = self.deviations[:, None] ** 2, np.hypot(self.deviations[:, None], prior.deviations)
        differences = self.centres[:, None] - prior.centres
        weights = self.weights[:, None] * prior.weights / totals * np.exp(-0.5 * (differences / totals) ** 2)
        usual = weights > LEAST_WEIGHT * weights.max()
        centres = self.centres[:, None] - differences * variances / totals**2
        deviations = self.deviations[:, None] * prior.deviations / totals
        return Mixture(weights[usual] / weights[usual].sum(), deviations[usual], centres[usual])

    def condense(self) -> Mixture:
        """Merge parts that are nearly equal, with their mean and variance: an approximation of far fewer parts."""
        width = np.round(np.log(self.deviations) / CELL)
        place = np.round(self.centres / (CELL * np.exp(CELL * width)))
        order = np.lexsort((place, width))
        is_new = (np.diff(width[order], prepend=np.nan) != 0.0) | (np.diff(place[order], prepend=np.nan) != 0.0)
        starts = np.flatnonzero(is_new)
        weights, centres = self.weights[order], self.centres[order]
        sums = np.add.reduceat(weights, starts)
        means = np.add.reduceat(weights * centres, starts) / sums
        spread = self.deviations[order] ** 2 + (centres - np.repeat(means, np.diff(starts, append=len(order)))) ** 2
        return Mixture(sums, np.sqrt(np.add.reduceat(weights * spread, starts) / sums), means)

    def below(self, value: float) -> float:
        """Compute the probability of values below `value`."""
        from scipy.special import ndtr

        return float(self.weights @ ndtr((value - self.centres) / self.deviations))

    def chance_above(self, value: float) -> float:
        """Compute the probability of values above `value`."""
        from scipy.special import ndtr

        return float(self.weights @ ndtr((self.centres - value) / self.deviations))

    def chance_beyond(self, value: float) -> float:
        """Compute the probability of values as far from the centre of their part as `value`, on either side."""
        from scipy.special import ndtr

        return float(self.weights @ (2.0 * ndtr(-np.abs(value - self.centres) / self.deviations)))

    def quantile(self, probability: float) -> float:
        """Compute the value below which the mixture lies with the given probability."""
        from scipy.special import ndtri

        # scale by the mean deviation (each counts up to 1000 times the smallest): the quantile is then of order one
        scale = max(float(self.weights @ np.minimum(self.deviations, 1e3 * self.deviations.min())), TINY)
        centres, deviations = self.centres / scale, self.deviations / scale
        return scale * float(_find_quantile(self.weights, deviations, centres, probability, float(ndtri(probability))))


@kernel
def _find_quantile(weights: Array, deviations: Array, centres: Array, probability: float, z: float) -> float:
    """Find the quantile of a `Mixture` at a `probability` by Newton's method between bounds, to 12 digits.

    `z`: the quantile of the standard normal distribution. That of the mixture lies between those of its parts. A search
    among a sample of the parts gives the first estimate.
    """
    n = weights.size
    lowest, highest, value = np.inf, -np.inf, 0.0
    for k in range(n):
        part = centres[k] + z * deviations[k]
        lowest, highest, value = min(lowest, part), max(highest, part), value + weights[k] * part
    if not math.isfinite(highest - lowest):
        return lowest
    for sample in range(2):
        stride = 1 if sample else max(1, n // SAMPLED)
        if not sample and stride == 1:
            continue
        low, high, total = lowest, highest, 0.0
        for k in range(0, n, stride):
            total += weights[k]
        for _ in range(MAX_STEPS):
            excess, density = -probability * total, 0.0
            for k in range(0, n, stride):
                u = (value - centres[k]) / deviations[k]
                if u > NEGLIGIBLE_TAIL:
                    excess += weights[k]
                elif u > -NEGLIGIBLE_TAIL:
                    excess += weights[k] * 0.5 * math.erfc(-u * ROOT_HALF)
                    density += weights[k] / deviations[k] * math.exp(-0.5 * u * u)
            if excess == 0.0:
                break
            low, high = (value, high) if excess < 0.0 else (low, value)
            step = -excess / (density * ROOT_HALF / ROOT_PI) if density > 0.0 else np.inf
            is_newton = low < value + step < high
            if not is_newton:  # Newton's step leaves the bounds
                step = 0.5 * (low + high) - value
            value += step
            # the error after a step of Newton's method is about its square
            if abs(step) <= (1e-6 if is_newton else 1e-13) * max(1.0, abs(value)):
                break
    return value


def pool_mixtures(mixtures: Sequence[Mixture], weights: Array) -> Mixture:
    """Pool mixtures (k,) with `weights` (k,) of sum 1, without parts of a negligible weight."""
    pairs = zip(mixtures, weights, strict=True)
    parts = [mixture._replace(weights=weight * mixture.weights) for mixture, weight in pairs]
    pooled = Mixture(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    is_counted = pooled.weights > LEAST_WEIGHT * pooled.weights.max()
    counted, deviations, centres = (values[is_counted] for values in pooled)
    return Mixture(counted / counted.sum(), deviations, centres)


class ScatterPrior(NamedTuple):
    """Scaled inverse chi-squared prior on the squared scatter of a quantity between recordings of one machine.

    `deviation`: expected standard deviation of the quantity; `recordings`: number of recordings that would tell as much
    about the scatter; `inflation`, `deflation`: largest common factors by which the errors of the quantity may be too
    small, and too large.
    """

    deviation: float
    recordings: float
    inflation: float = 1.0
    deflation: float = 1.0

    def log_density(self, scatter: Array) -> Array:
        """Compute the log density of log s, up to a constant, for `scatter` s of any shape.

        With m `recordings` and the `deviation` s_0 the density is s^-m exp(-m s_0^2 / (2 s^2)).
        """
        return np.asarray(-0.5 * self.recordings * (np.log(scatter**2) + self.deviation**2 / scatter**2))


class Population:
    """Joint normal distribution of n healthy values and a judged one about an unknown common mean.

    `candidates` (g, n + 1, n + 1): candidate covariances between the values, the judged one last, in addition to the
    variance sigma^2 of each value; n is at least 1. `log_priors` (g,): log prior probability of each candidate.
    """

    def __init__(self, candidates: Array, log_priors: Array) -> None:
        n = candidates.shape[1] - 1
        # only a sample of the healthy values is used, which limits the time
        self._sample = np.unique(np.linspace(0, n - 1, min(n, MAX_RECORDINGS)).astype(int))
        healthy = candidates[:, self._sample[:, None], self._sample]
        eigen, basis = np.linalg.eigh(healthy)
        # components along these eigenvectors (g, 1, n), of the covariance of each healthy value with the judged one,
        # and of a vector of ones; the second axis is for the grid of sigma
        self._eigen, self._basis = np.maximum(eigen, 0.0)[:, None], basis
        self._cross = np.einsum("gij,gi->gj", basis, candidates[:, self._sample, n])[:, None]
        self._ones = basis.sum(axis=1)[:, None]
        self._judged_variance, self._log_priors = candidates[:, n, n, None], log_priors[:, None]

    def predict_with_prior(self, healthy_values: Array, prior: ScatterPrior) -> Mixture:
        """Predict the judged value from the healthy ones, whose scatter sigma has a prior (`predict`).

        `healthy_values` (s, n): the healthy values by s alternative estimates. The centres are NaN if the squares of
        the values would overflow.
        """
        count, weight = len(self._sample), prior.recordings
        sums_of_squares = weight * prior.deviation**2 + count * healthy_values[:, self._sample].var(axis=1)
        if not 1e4 * sums_of_squares.max() < MAX_SQUARE:
            return Mixture(*np.full((3, len(healthy_values), 1, 1), np.nan))
        # limits of the grid of sigma, far below and far above the probable values, and above 0 (1 / MAX_SQUARE)
        min_sigma = np.sqrt(np.maximum(0.1 * weight * prior.deviation**2, 1e-9 * sums_of_squares) / (weight + count))
        max_sigma = np.maximum(100.0 * np.sqrt(sums_of_squares), 10.0 / MAX_SQUARE)
        sigma = np.geomspace(np.maximum(min_sigma, 1.0 / MAX_SQUARE), max_sigma, NODES, axis=1)
        return self.predict(healthy_values, sigma, prior.log_density(sigma))

    def predict(self, healthy_values: Array, sigma: Array, log_priors: Array) -> Mixture:
        """Predict the judged value from the healthy ones by kriging, as a mixture of normal distributions.

        The prediction is m + c' V^-1 (x - m) for the healthy values x: V is their covariance, c their covariance with
        the judged value, and m the generalised least-squares mean. `healthy_values` (s, n): the healthy values, by s
        alternative estimates; `sigma` (s, nodes): standard deviations of the values, a log-spaced grid for each
        estimate; `log_priors` (s, nodes or 1): log prior of the estimate and of log sigma. Returns log weights,
        standard deviations and centres of shape (s, g, nodes).
        """
        healthy = healthy_values[:, self._sample]
        variance = sigma[:, None] ** 2  # (s, 1, nodes)
        weight = 1.0 / (variance[..., None] + self._eigen)  # (s, g, nodes, n)
        weighted_ones, cross = weight * self._ones, self._cross
        precision = (weighted_ones * self._ones).sum(axis=-1)
        rotated = np.einsum("gij,si->sgj", self._basis, healthy)[:, :, None]  # along the eigenvectors
        mean = (weighted_ones * rotated).sum(axis=-1) / precision
        weighted_residual = weight * (rotated - mean[..., None] * self._ones)
        log_likelihood = 0.5 * (
            np.log(weight).sum(axis=-1) - np.log(precision) - (weighted_residual * rotated).sum(axis=-1)
        )
        # add the log of the prior density of log sigma, times the spacing of its grid
        log_spacing = np.log(np.log(sigma[:, 1:2] / sigma[:, :1]))
        log_likelihood += self._log_priors + (log_priors + log_spacing)[:, None]
        centres = mean + (weighted_residual * cross).sum(axis=-1)
        mean_deficit = 1.0 - (weighted_ones * cross).sum(axis=-1)  # weight of the estimated mean in the prediction
        variances = variance + self._judged_variance - (weight * cross**2).sum(axis=-1) + mean_deficit**2 / precision
        return Mixture(log_likelihood, np.sqrt(variances), centres)


def predict_estimate(
    values: Array, errors: Array, next_error: float, prior: ScatterPrior, further_deviation: float = 0.0
) -> Mixture:
    """Predict an estimate with the standard error `next_error` from `values` (n,) with standard `errors` (n,).

    All errors may be too small or too large by one factor k, which is 1 or has a log-uniform prior. With k > 1,
    imprecise values such as those of a day with few strokes may differ by more; with k < 1, the errors also contain
    what all recordings of the machine have in common. With the scatter s, the weights w_i = 1/(s^2 + (k e_i)^2) and
    W = sum w_i, `Population` then gives

        p(s, k | x) ~ p(s) p(k) W^(-1/2) prod_i w_i^(1/2) exp(-w_i (x_i - mean)^2 / 2),    mean = sum w_i x_i / W,

    and the next value is a mixture of N(mean, s^2 + (k `next_error`)^2 + 1/W). `further_deviation`: standard deviation
    of the next value from further causes, such as an unusual load.
    """
    max_ratio = max(MAX_RATIO, MAX_RATIO_TO_VALUES * float(values.std()) / prior.deviation)
    scatter = prior.deviation * np.geomspace(1.0 / MAX_RATIO, max_ratio, ESTIMATE_NODES)[None]
    inflations = np.geomspace(1.0 / prior.deflation, prior.inflation, INFLATIONS)
    variances = np.square(inflations[:, None] * np.append(errors, next_error))
    variances[:, -1] += further_deviation**2
    population = Population(variances[:, None] * np.eye(len(values) + 1), np.zeros(INFLATIONS))
    middle = values.mean()  # subtracted against rounding
    predicted = population.predict((values - middle)[None], scatter, prior.log_density(scatter)).normalise()
    return predicted._replace(centres=predicted.centres + middle)


def estimate_variance(squares: Any, count: int, prior: ScatterPrior | None = None) -> tuple[Any, float]:
    """Estimate the variance of single recordings from the sum of `squares` of `count` values about their mean.

    It is (m s_0^2 + squares) / (m + count - 1), where the `prior` counts as m further recordings with the scatter s_0,
    0 without a prior. The next value, over the root of this variance times 1 + 1 / `count`, follows Student's t
    distribution about the mean. Returns the variance, a number or an array, and the degrees of freedom m + count - 1.
    """
    recordings, deviation = (0.0, 0.0) if prior is None else (prior.recordings, prior.deviation)
    freedom = recordings + count - 1.0
    return (recordings * deviation**2 + squares) / freedom, freedom


def excess_error(error: float, healthy_errors: Sequence[float]) -> float:
    """Compute the part of a value's standard error `error` that must be added to the scatter of healthy values.

    The scatter already contains an error as large as the median of `healthy_errors`: the result is sqrt(`error`^2 -
    median^2), at least 0.
    """
    if not healthy_errors:
        return error
    return float(np.sqrt(max(error**2 - float(np.median(healthy_errors)) ** 2, 0.0)))


def number_sessions(starts: Sequence[float | None], pause: float) -> list[int]:
    """Assign each recording to a session; a gap above `pause` [s] between two dates begins a new session.

    `starts` (n,): dates of the recordings [s since 1970], None if unknown. Sessions are numbered from 1 on in the order
    of the dates; an undated recording has the number -1.
    """
    dates = sorted(start for start in starts if start is not None)
    session_starts = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > pause]
    return [-1 if start is None else int(np.searchsorted(session_starts, start, "right")) for start in starts]
