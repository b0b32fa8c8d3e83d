"""Test of a difference between a number of a recording and those of healthy recordings of unknown scatter.

n healthy values are normal about an unknown mean with an unknown standard deviation, at least the error e of a single
value (Jeffreys prior), or with the scatter of some more recordings as a prior (inverse gamma, which adds them to the
n - 1 degrees of freedom). The next value then follows Student's law of n - 1 degrees of freedom,

    t = (y - mean) / sqrt((s^2 + e^2) (1 + 1/n)).

Five values that agree to a thousandth thus show that a sixth differs by a few thousandths; two show next to nothing.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2 and 3.3.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.inference import StepSize

#: Minimum number of healthy recordings for a scatter.
MIN_HEALTHY = 3


def compare_with_healthy(
    name: str,
    data: str,
    value: float,
    healthy: Sequence[float],
    error: float = 0.0,
    *,
    above: bool = False,
    prior_scatter: tuple[float, float] = (0.0, 0.0),
    prior_change: float = np.inf,
) -> Observable | None:
    """Compare a value with those of healthy recordings by Student's t, as an observable.

    Return None for fewer than `MIN_HEALTHY` recordings, or if a number is not finite. `name`, `data`: of the
    observable; `error`: standard error of a single value; `above`: only a value above the healthy ones counts;
    `prior_scatter`: of healthy recordings, and the number of recordings it counts as; `prior_change`: standard
    deviation of a true change. The chance is at least the inverse of the Bayes factor of such a change, so that a value
    that it explains no better than chance does counts for nothing.
    """
    from scipy.special import stdtr

    healthy_values = np.asarray(healthy, dtype=float)
    if len(healthy_values) < MIN_HEALTHY or not np.isfinite([value, error, *healthy_values]).all():
        return None
    count, change = len(healthy_values), value - float(healthy_values.mean())
    scatter, n_prior = prior_scatter
    freedom = count - 1 + n_prior
    scatter_variance = float(healthy_values.var() * count + n_prior * scatter**2) / freedom
    variance = (scatter_variance + error**2) * (1.0 + 1.0 / count)
    t = change / max(float(np.sqrt(variance)), np.finfo(float).tiny)
    chance = float(stdtr(freedom, -t if above else -abs(t))) * (1.0 if above else 2.0)
    score = t * t if t > 0.0 or not above else 0.0
    if not np.isfinite(score):
        return None
    if np.isfinite(prior_change):
        # Bayes factor: density of Student's law, its variance larger by that of a true change, over the null's density
        variance_ratio = 1.0 + prior_change**2 / max(variance, np.finfo(float).tiny)
        log_factor = 0.5 * (freedom + 1.0) * np.log1p(t * t / freedom)
        log_factor -= 0.5 * (freedom + 1.0) * np.log1p(t * t / variance_ratio / freedom) + 0.5 * np.log(variance_ratio)
        chance = max(chance, float(np.exp(-max(log_factor, 0.0))))
    return Observable(name=name, data=data, score=score, chance=min(1.0, chance), size=change)


def excess_error(error: float, healthy_errors: Sequence[float]) -> float:
    """Compute the part of a value's standard error that the scatter of the healthy values does not contain.

    `healthy_errors`: standard errors of these, whose scatter contains their median.
    """
    if not healthy_errors:
        return error
    return float(np.sqrt(max(error**2 - float(np.median(healthy_errors)) ** 2, 0.0)))


def size_penalty(prior: StepSize, step: float, above: bool = False) -> float:
    """Compute -2 log of a step's log-normal prior density over its maximum; `above`: penalise only steps above it."""
    deviation = float(np.log(max(abs(step), np.finfo(float).tiny) / prior.size)) / prior.spread
    return float(max(deviation, 0.0) ** 2 if above else deviation**2)
