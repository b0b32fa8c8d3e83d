"""Calibrate the chances of all statistics by healthy recordings, as a provider's law may state too small ones.

A provider's law gives each statistic a chance P under the null; its surprisal u = -log P is then exponential. The law
fails in a fraction of machines (`priors.toml`): there u / lambda is exponential, with an exponential prior on
log lambda > 0. With the u_1 .. u_n of n healthy recordings the predictive chance is

    P(u) = sum_k w_k exp(-u / lambda_k),    w_k ~ p_k lambda_k^(-n) exp(-sum_i u_i / lambda_k),

lambda_0 = 1 for the law itself.

A rest, a ramp or a warm-up of every healthy recording is then no alarm. Without healthy recordings the law is not
changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.evaluation.scalar_search import find_root
from sealscope.recordings.recording import Array

#: Values of lambda that the predictive chance sums over, after 1.
NODES = 64


@dataclass(frozen=True, eq=False)
class HealthyNull:
    """Predictive chances of observables, from their `surprisals` -log(chance) in healthy recordings, by `null_key`."""

    surprisals: Mapping[str, Sequence[float]] = field(default_factory=dict)
    _posteriors: dict[str, tuple[Array, Array]] = field(default_factory=dict, init=False)

    def chance(self, observable: Observable) -> float:
        """Compute the predictive chance that an observable has at least this surprisal in a healthy recording."""
        weights, inflations = self._inflation(null_key(observable))
        return min(float(weights @ np.exp(-observable.surprisal / inflations)), 1.0)

    def calibrate(self, key: str, chance: float) -> float:
        """Compute the predictive chance of a statistic from its chance by the provider's law."""
        weights, inflations = self._inflation(key)
        return min(float(weights @ np.exp(np.log(max(chance, np.finfo(float).tiny)) / inflations)), 1.0)

    def uncalibrated_chance(self, key: str, chance: float) -> float:
        """Invert `calibrate`: compute the chance by the provider's law whose predictive chance is `chance`."""
        max_surprisal = -np.log(np.finfo(float).tiny)
        if self.calibrate(key, np.exp(-max_surprisal)) >= chance:
            return float(np.finfo(float).tiny)
        return float(np.exp(-find_root(lambda u: self.calibrate(key, np.exp(-u)) - chance, 0.0, max_surprisal)))

    def _inflation(self, key: str) -> tuple[Array, Array]:
        """Return the posterior weights and values of lambda, the mean of a key's surprisals in healthy recordings."""
        if key not in self._posteriors:
            self._posteriors[key] = _inflation_posterior(self.surprisals.get(key, ()))
        return self._posteriors[key]


def _inflation_posterior(surprisals: Sequence[float]) -> tuple[Array, Array]:
    """Compute the posterior weights and values (NODES + 1,) of lambda, the mean of exponential surprisals.

    The first value is 1, by the provider's law. n surprisals have the likelihood lambda^-n exp(-sum / lambda).
    """
    prior_null = DECISION.null
    if not len(surprisals):
        return np.ones(1), np.ones(1)
    logarithm = np.append(0.0, np.linspace(0.0, np.log(prior_null.largest), NODES))
    inflation = np.exp(logarithm)
    prior = np.exp(-logarithm / prior_null.inflation)
    prior[1:] *= prior_null.fails / prior[1:].sum()  # `fails`: fraction of machines in which the law is wrong
    prior[0] = 1.0 - prior_null.fails
    log_posterior = np.log(prior) - len(surprisals) * logarithm - float(np.sum(surprisals)) / inflation
    weights = np.exp(log_posterior - log_posterior.max())
    return weights / weights.sum(), inflation


def null_key(observable: Observable) -> str:
    """Return the key of an observable's null distribution: data and name, or the data alone if it is a comparison."""
    return comparison_key(observable.data) if observable.onset is None else f"{observable.data}: {observable.name}"


def comparison_key(data: str) -> str:
    """Return the key of the null distribution of comparisons with healthy recordings, of one kind of data."""
    return f"{data}: against"
