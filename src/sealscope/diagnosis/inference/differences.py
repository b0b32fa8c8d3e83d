"""Test whether a quantity of a recording differs from its values in healthy recordings, whose scatter is unknown.

*Without a prior on the scatter* (`compare_with_healthy`): n healthy values are normal about an unknown mean with an
unknown standard deviation (Jeffreys prior). With their mean and standard deviation s, the next value y then follows
Student's t with n - 1 degrees of freedom. The standard error e of a single value is added, since values may agree by
chance:

    t = (y - mean) / sqrt((s^2 + e^2) (1 + 1/n)).

*With a prior on the scatter* (`compare_estimates`): each value y_i has an error e_i and varies about an unknown mean mu
by the scatter s, y_i ~ N(mu, s^2 + (k e_i)^2). s^2 has a scaled inverse chi-square prior, with the weight of m
recordings whose scatter is s_0. The errors may be too small or too large by a factor k, which is 1 or has a log-uniform
prior. With k > 1, imprecise values such as those of a day with few strokes may differ by more; with k < 1, the errors
also contain what all recordings of the machine have in common. On a grid of s and k, with the weights
w_i = 1/(s^2 + (k e_i)^2) and W = sum w_i,

    p(s, k | y) ~ p(s) p(k) W^(-1/2) prod_i w_i^(1/2) exp(-w_i (y_i - mean)^2 / 2),    mean = sum w_i y_i / W,

and the next value is a mixture of N(mean, s^2 + (k e)^2 + 1/W).

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 3.3 and 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.onset import Estimate
from sealscope.signals.smoothing import TINY

#: Minimum number of healthy recordings for a scatter.
MIN_HEALTHY = 3
#: Number of grid points of the scatter.
NODES = 64
#: Reach of the grid: ratio of its ends to the prior's scatter, and least ratio of its upper end to the values' scatter.
MAX_RATIO, MAX_RATIO_TO_VALUES = 100.0, 10.0
#: Number of grid points of the factor by which errors are too small or too large.
INFLATIONS = 9


class PriorScatter(NamedTuple):
    """Prior on the scatter of a quantity between recordings of one machine.

    `deviation`: expected standard deviation of the quantity; `recordings`: number of recordings that would tell as much
    about the scatter; `inflation`, `deflation`: largest common factors by which the errors may be too small, and too
    large.
    """

    deviation: float
    recordings: float
    inflation: float = 1.0
    deflation: float = 1.0


def compare_with_healthy(
    name: str,
    data: str,
    value: float,
    healthy: Sequence[float],
    error: float = 0.0,
    *,
    above: bool = False,
    prior_change: float = np.inf,
) -> Observable | None:
    """Test a value by Student's t for a difference from the values of healthy recordings.

    - `name`, `data`: name of the quantity and its kind of data, for the result (`Observable`);
    - `error`: standard error of a single value;
    - `above`: count only a value above the healthy ones;
    - `prior_change`: standard deviation of a true change, infinite if unknown. With the Bayes factor B of such a change
      to no change, the p-value is at least 1/B, and 1 if B < 1: a true change then explains the value no better than
      scatter does.

    The observable's size is the difference from the healthy mean, its score the square of t (with `above`, 0 for a
    value below the mean), and its chance the p-value. Return None for fewer than `MIN_HEALTHY` healthy recordings, or
    if a number is not finite.
    """
    from scipy.special import stdtr

    healthy_values = np.asarray(healthy, dtype=float)
    if len(healthy_values) < MIN_HEALTHY or not np.isfinite([value, error, *healthy_values]).all():
        return None
    count = len(healthy_values)
    freedom = count - 1
    change = value - float(healthy_values.mean())
    variance = (float(healthy_values.var(ddof=1)) + error**2) * (1.0 + 1.0 / count)
    t = change / max(float(np.sqrt(variance)), TINY)
    chance = float(stdtr(freedom, -t if above else -abs(t))) * (1.0 if above else 2.0)
    score = t * t if t > 0.0 or not above else 0.0
    if not np.isfinite(score):
        return None
    if np.isfinite(prior_change):
        # Bayes factor of a true change: ratio of two densities of Student's t at the value, with the variance of such a
        # change added, and without it
        variance_ratio = 1.0 + prior_change**2 / max(variance, TINY)
        log_factor = 0.5 * (freedom + 1.0) * np.log1p(t * t / freedom)
        log_factor -= 0.5 * (freedom + 1.0) * np.log1p(t * t / variance_ratio / freedom) + 0.5 * np.log(variance_ratio)
        chance = max(chance, float(np.exp(-max(log_factor, 0.0))))
    return Observable(name=name, data=data, score=score, chance=min(1.0, chance), size=change)


def compare_estimates(
    name: str,
    data: str,
    judged: Estimate,
    healthy: Sequence[Estimate],
    prior: PriorScatter,
    *,
    above: bool = False,
    further_deviation: float = 0.0,
) -> Observable | None:
    """Test an estimate for a difference from the estimates of healthy recordings, each with a known standard error.

    - `name`, `data`: name of the quantity and its kind of data, for the result;
    - `prior`: prior on the scatter between recordings;
    - `above`: count only an estimate above the healthy ones;
    - `further_deviation`: standard deviation of the judged estimate from further causes, such as an unusual load.

    The observable's size is the difference from the weighted mean of the healthy estimates, its score the square of
    this difference over its variance (with `above`, 0 for a negative one), and its chance the p-value. Return None for
    fewer than `MIN_HEALTHY` healthy recordings, or if a number is not finite.
    """
    from scipy.special import ndtr

    if len(healthy) < MIN_HEALTHY or not np.isfinite([judged, *healthy]).all():
        return None
    values, errors = np.array(healthy, dtype=float).T
    max_ratio = max(MAX_RATIO, MAX_RATIO_TO_VALUES * float(values.std()) / prior.deviation)
    # grids of the scatter over its prior deviation, and of the factor by which the errors are too small or too large
    ratios = np.exp(np.linspace(-np.log(MAX_RATIO), np.log(max_ratio), NODES))
    inflations = np.geomspace(1.0 / prior.deflation, prior.inflation, INFLATIONS)
    ratios, inflations = (grid.ravel() for grid in np.meshgrid(ratios, inflations))
    scatter = prior.deviation * ratios  # scatter s at each point of the joint grid
    weights = 1.0 / (scatter[:, None] ** 2 + (inflations[:, None] * errors) ** 2)  # (grid points, n)
    precision = weights.sum(axis=1)
    means = weights @ values / precision
    squares = (weights * (values - means[:, None]) ** 2).sum(axis=1)
    # the prior density of log s is s^-m exp(-m s_0^2 / (2 s^2)), where m is `prior.recordings` and s / s_0 the ratio;
    # for the other factors see the module
    log_posterior = -prior.recordings * (np.log(ratios) + 0.5 / ratios**2)
    log_posterior += 0.5 * (np.log(weights).sum(axis=1) - np.log(precision) - squares)
    posterior = np.exp(log_posterior - log_posterior.max())
    posterior /= posterior.sum()
    variances = scatter**2 + (inflations * judged.deviation) ** 2 + further_deviation**2 + 1.0 / precision
    z = (judged.value - means) / np.sqrt(variances)
    chance = float(posterior @ (ndtr(-z) if above else 2.0 * ndtr(-np.abs(z))))
    change = judged.value - float(posterior @ means)
    score = change**2 / max(float(posterior @ variances), TINY) if change > 0.0 or not above else 0.0
    return Observable(name=name, data=data, score=score, chance=min(1.0, chance), size=change)


def excess_error(error: float, healthy_errors: Sequence[float]) -> float:
    """Compute the part of a value's standard error `error` that must be added to the scatter of healthy values.

    The scatter already contains an error as large as the median of `healthy_errors`: the result is sqrt(`error`^2 -
    median^2), at least 0.
    """
    if not healthy_errors:
        return error
    return float(np.sqrt(max(error**2 - float(np.median(healthy_errors)) ** 2, 0.0)))
