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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel
from sealscope.diagnosis.estimate.population import LEAST_WEIGHT, Mixture, pool_mixtures
from sealscope.diagnosis.hold.readings import Readings
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.recordings.recording import Array

#: Points of the grid of log s^2 about its most probable value, in standard deviations sqrt(2/m).
VARIANCE_POINTS = np.arange(-2.0, 6.0)
#: Iterations that find the most probable variance, and the decrease of the log likelihood from the best beyond which a
#: combination is left out after them; in two stages.
STAGES = (1, 30.0), (3, 10.0)
#: Smallest standard deviation of the noise of a mean, in the readings' unit, and over their range: no model is exact.
LEAST_DEVIATION, LEAST_SHARE = 1e-6, 3e-4
#: Ridge on the diagonal of the relative covariance of the noise.
RIDGE = 1e-9
#: Least pivot of the normal equations, of a coefficient that nothing tells.
LEAST_PIVOT = 1e-30


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


def leak_prior() -> Mixture:
    """Build the prior of a leak's rate [mm/min], of a tight cylinder or of a leak of unknown size (`[tight]`)."""
    prior = HOLD.tight
    leaks, lifts = np.array(prior.leaks), np.array(prior.lifts)
    shares = (prior.present, 1), (1.0 - prior.present - prior.fed, len(leaks)), (prior.fed, len(lifts))
    weights = np.concatenate([np.full(n, share / n) for share, n in shares])
    return Mixture(weights, np.array([prior.rate, *(0.5 * leaks), *lifts]), np.array([0.0, *leaks, *(0.0 * lifts)]))


def log_overlap(rate: Mixture, prior: Mixture) -> float:
    """Compute the log evidence of a `rate`, of a fit without a prior of its own, under a `prior`."""
    totals = np.hypot(rate.deviations[:, None], prior.deviations)
    logs = -0.5 * ((rate.centres[:, None] - prior.centres) / totals) ** 2 - np.log(totals)
    largest = float(logs.max())
    return largest + math.log(float(rate.weights @ np.exp(logs - largest) @ prior.weights))


class RateFit(NamedTuple):
    """Posterior of the rate, the first coefficient, and the most probable fit of the readings."""

    rate: Mixture
    fit: Array  # (m,) readings of the most probable alternative
    band: Array  # (m,) standard deviation of the fit
    last: Array  # (m,) part of the fit that is due to the last optional term
    noise: Noise  # of the most probable alternative
    s: float  # standard deviation of its white part
    log_evidence: float
    converted: Mixture | None = None  # the rate at a reference pressure


def pool_fits(fits: Sequence[RateFit], logs: Sequence[float]) -> RateFit:
    """Pool fits (k,) whose logarithms of probability are `logs` (k,): the most probable, with the rates of all."""
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    rate = pool_mixtures([fit.rate for fit in fits], weights).condense()
    converted = [fit.converted for fit in fits if fit.converted is not None]
    pooled = pool_mixtures(converted, weights).condense() if len(converted) == len(fits) else None
    return fits[int(weights.argmax())]._replace(rate=rate, converted=pooled)


class RateRegression:
    """Regression of the `readings` of a hold of a `duration` [s], under each alternative for their noise.

    `from_first`: the readings count from the first.
    """

    def __init__(self, readings: Readings, duration: float, *, from_first: bool = True) -> None:
        """Factorise the covariances of the noise, which all fits share."""
        self.readings, self.duration = readings, duration
        self.y = readings.values - (readings.values[0] if from_first else 0.0)
        # means tell the size of their noise; passages are too few, and readings beside them have errors of known size
        scales = [share * readings.quantum for share in HOLD.noise.steps] if readings.quantum else [1.0]
        self.noises = [(noise, s) for noise in list_noises(duration) for s in scales]
        covariances = [
            s**2 * noise.covariance(readings.t, duration) + np.diag(readings.loose**2) for noise, s in self.noises
        ]
        factors = np.linalg.cholesky(np.array(covariances))
        self.whitening = np.linalg.inv(factors)
        log_det = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        self.log_noise = np.log([noise.weight / len(scales) for noise, _ in self.noises]) - log_det

    def fit_rate(self, base: Sequence[Column], alternatives: Sequence[Sequence[Alternative]]) -> RateFit:
        """Fit the readings, and average over noise and `alternatives`.

        `base`: columns that all fits have, of which the first is that of the rate; `alternatives`: for each optional
        term its possible columns.
        """
        columns = [*base, *(column for options in alternatives for option in options for column in option.columns)]
        choices, log_priors = _list_choices(alternatives, len(base))
        values = np.column_stack([self.y, *(column.values for column in columns), np.zeros(len(self.y))])
        # the last column is empty, with a coefficient of prior variance 1; it fills the place of an absent one
        precision = np.array([*(column.deviation**-2.0 for column in columns), 1.0])[choices]
        mean = np.array([*(column.mean for column in columns), 0.0])[choices]
        is_proper = precision > 0.0
        log_priors = log_priors + 0.5 * np.log(np.where(is_proper, precision, 1.0)).sum(axis=1)
        m, least = len(self.y), max(LEAST_DEVIATION, LEAST_SHARE * float(np.ptp(self.y))) ** 2
        freedom = float(max(m - int((~is_proper[0]).sum()), 1))
        whitened = self.whitening @ values
        gram = whitened.transpose(0, 2, 1) @ whitened
        n_choices, quantum = len(choices), self.readings.quantum
        rows = np.arange(len(gram) * n_choices)
        prior = (self.log_noise[:, None] + log_priors).ravel()
        variance = np.ones(len(rows))
        if not quantum:
            variance = np.maximum(np.repeat(gram[:, 0, 0], n_choices) / m, least)
        # the rate is the last coefficient, which needs no back substitution
        system = (
            gram,
            np.ascontiguousarray(choices[:, ::-1]) % (values.shape[1] - 1) + 1,
            precision[:, ::-1].copy(),
            mean[:, ::-1].copy(),
        )
        work = np.empty((choices.shape[1], choices.shape[1] + 1))
        for n_iterations, decrease in STAGES:
            solution = np.empty((len(rows), 3))
            n = 0 if quantum else n_iterations
            _solve_rates(*system, rows, variance, freedom, least, n, work, solution)
            profile = prior[rows] - 0.5 * (m * np.log(variance) + solution[:, 0])
            is_probable = profile > profile.max() - decrease
            rows, variance = rows[is_probable], variance[is_probable]
        log_step, grid = 0.0, variance
        if not quantum:
            spread = math.sqrt(2.0 / freedom)
            log_step = math.log(spread)
            grid = np.maximum(np.exp(spread * VARIANCE_POINTS)[:, None] * grid, least).ravel()
            rows = np.tile(rows, len(VARIANCE_POINTS))
        solution = np.empty((len(rows), 3))
        _solve_rates(*system, rows, grid, freedom, least, 0, work, solution)
        logs = prior[rows] - 0.5 * (m * np.log(grid) + solution[:, 0]) + log_step
        weights = np.exp(logs - logs.max())
        best = int(weights.argmax())
        noise, s = self.noises[rows[best] // n_choices]
        usual = weights > LEAST_WEIGHT
        n_last = max(len(option.columns) for option in alternatives[-1])
        design, coefficients, band = self._solve_best(
            gram, values, choices, precision, mean, int(rows[best]), float(grid[best])
        )
        return RateFit(
            Mixture(weights[usual] / weights[usual].sum(), solution[usual, 1], solution[usual, 2]).condense(),
            design @ coefficients,
            band,
            design[:, len(coefficients) - n_last :] @ coefficients[len(coefficients) - n_last :],
            noise,
            s * float(np.sqrt(grid[best])),
            float(logs.max() + np.log(weights.sum())),
        )

    def _solve_best(
        self, gram: Array, values: Array, choices: NDArray[np.intp], precision: Array, mean: Array, row: int,
        variance: float,
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Fit one combination: its columns (m, p), coefficients (p,), and the standard deviation of the fit (m,)."""
        n, c = divmod(row, len(choices))
        used = choices[c] % (values.shape[1] - 1) + 1
        matrix = gram[n][np.ix_(used, used)] / variance + np.diag(precision[c])
        right = gram[n][used, 0] / variance + precision[c] * mean[c]
        design, covariance = values[:, used], np.linalg.inv(matrix)
        band = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", design, covariance, design), 0.0))
        return design, covariance @ right, band


@kernel
def _solve_rates(
    gram: Any,
    choices: Any,
    precision: Any,
    mean: Any,
    rows: Any,
    variances: Any,
    freedom: float,
    least: float,
    n_iterations: int,
    work: Any,
    solution: Any,
) -> None:
    """Solve the normal equations of k combinations of noise and columns, and write `solution` (k, 3).

    `gram` (n, q, q): whitened products of the readings (index 0) and columns for each noise; `choices`, `precision`,
    `mean` (c, p): columns of a combination and priors of their coefficients, that of the rate the last; `rows` (k,):
    noise times c, plus combination; `variances` (k,): of the noise, replaced in `n_iterations` by the most probable,
    `least` or more. Written are the misfit with the log determinant of the matrix, and the rate's deviation and mean.
    `work` (p, p + 1) is working memory: rows of the upper triangular factor, with the right side.
    """
    n_choices, p = choices.shape
    for k in range(len(rows)):
        noise, choice = divmod(rows[k], n_choices)
        products, columns = gram[noise], choices[choice]
        for iteration in range(n_iterations + 1):
            weight, log_det, scale = 1.0 / variances[k], 0.0, 0.0
            misfit = products[0, 0] * weight
            for i in range(p):
                for j in range(i, p):
                    work[i, j] = products[columns[i], columns[j]] * weight
                expected = precision[choice, i] * mean[choice, i]
                work[i, i] += precision[choice, i]
                work[i, p] = products[columns[i], 0] * weight + expected
                misfit += expected * mean[choice, i]
            for i in range(p):
                pivot = max(work[i, i], LEAST_PIVOT)
                log_det += math.log(pivot)
                scale = 1.0 / math.sqrt(pivot)
                for j in range(i, p + 1):
                    work[i, j] *= scale
                for m in range(i + 1, p):
                    factor = work[i, m]
                    for j in range(m, p + 1):
                        work[m, j] -= factor * work[i, j]
                misfit -= work[i, p] ** 2
            if iteration < n_iterations:
                variances[k] = max(variances[k] * max(misfit, RIDGE) / freedom, least)
        solution[k, 0] = misfit + log_det
        solution[k, 1] = scale
        solution[k, 2] = work[p - 1, p] * scale


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
    t: Array,
    base: Sequence[Column],
    alternatives: Sequence[Sequence[Column]],
    noise: Noise,
    s: float,
    duration: float,
    white: float = 1.0,
) -> float:
    """Predict the standard deviation of the rate, the first coefficient, from readings at `t` (m,) of a planned hold.

    The formula is that of `fit_rate`, without readings: the posterior covariance does not depend on them. The largest
    for the `base` with each of the `alternatives` is returned. `s`, `white`: standard deviation of the noise, and
    variance of its white part over s^2; `duration` [s]: time by which a random walk reaches the `noise`'s ratio.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(noise.covariance(t, duration, white))) / s
    variances = []
    for columns in alternatives:
        whitened = inverse @ np.column_stack([column.values for column in (*base, *columns)])
        priors = np.diag([column.deviation**-2.0 for column in (*base, *columns)])
        variances.append(np.linalg.inv(whitened.T @ whitened + priors)[0, 0])
    return float(np.sqrt(max(variances)))
