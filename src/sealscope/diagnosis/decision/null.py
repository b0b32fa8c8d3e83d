"""Healthy recordings as the null of every statistic: how much rarer than it is a law calls a healthy recording.

A provider's law gives each statistic a chance P under the null; u = -log P is then exponential. The law may fail, in a
share of machines (`priors.toml`): then u of healthy recordings is larger, u / lambda exponential, and log lambda
exponential beforehand. With the u_1 .. u_n of n healthy recordings the predictive chance is

    P(u) = sum_k w_k exp(-u / lambda_k),    w_k ~ p_k lambda_k^(-n) exp(-sum_i u_i / lambda_k),

lambda_0 = 1 for the law as it stands.

What every healthy recording shows, a rest, a ramp or a warm-up, is then no alarm. Without healthy recordings the law
stands as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Nodes of the inflation.
NODES = 64


@dataclass(frozen=True, eq=False)
class HealthyNull:
    """The rarities of each observable, by its key, in healthy recordings of the machine."""

    rarities: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def chance(self, observable: Observable) -> float:
        """Compute the predictive probability of an observable at least as rare in a healthy recording."""
        weights, inflations = self._inflation(key_of(observable))
        return min(float(weights @ np.exp(-observable.rarity / inflations)), 1.0)

    def inflate(self, key: str, chance: float) -> float:
        """Compute the predictive probability of an event from its chance by the law."""
        weights, inflations = self._inflation(key)
        return min(float(weights @ np.exp(np.log(max(chance, np.finfo(float).tiny)) / inflations)), 1.0)

    def law_chance(self, key: str, chance: float) -> float:
        """Compute the chance by the law whose predictive probability is `chance`."""
        from scipy.optimize import brentq

        low = -np.log(np.finfo(float).tiny)
        if self.inflate(key, np.exp(-low)) >= chance:
            return float(np.finfo(float).tiny)
        return float(np.exp(-brentq(lambda u: self.inflate(key, np.exp(-u)) - chance, 0.0, low)))

    def _inflation(self, key: str) -> tuple[Array, Array]:
        if key not in self._posteriors:
            self._posteriors[key] = _posterior(self.rarities.get(key, ()))
        return self._posteriors[key]

    @cached_property
    def _posteriors(self) -> dict[str, tuple[Array, Array]]:
        return {}


def _posterior(rarities: Sequence[float]) -> tuple[Array, Array]:
    """Compute weights and values (NODES + 1,) of the inflation, first that of the unchanged law."""
    believed = priors("decision")["null"]
    if not len(rarities):
        return np.ones(1), np.ones(1)
    logarithm = np.append(0.0, np.linspace(0.0, np.log(believed["largest"]), NODES))
    inflation = np.exp(logarithm)
    prior = np.exp(-logarithm / believed["inflation"])
    prior[1:] *= believed["fails"] / prior[1:].sum()
    prior[0] = 1.0 - believed["fails"]
    likelihood = np.log(prior) - len(rarities) * logarithm - float(np.sum(rarities)) / inflation
    weights = np.exp(likelihood - likelihood.max())
    return weights / weights.sum(), inflation


def key_of(observable: Observable) -> str:
    """Return the name that stores an observable's rarities; comparisons with other recordings share one."""
    return f"{observable.data}: {observable.name}" if observable.onset is not None else f"{observable.data}: against"
