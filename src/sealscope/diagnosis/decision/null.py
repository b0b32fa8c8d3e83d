"""Calibration of the chances that detectors state, by those that they stated for healthy recordings.

A detector states for each statistic a chance (p-value) P, the probability that a healthy recording scores as high. If
that is right, the surprisal u = -log P of a healthy recording is exponentially distributed. In a fraction of machines
(`priors.toml`) the stated chances are too small: there u / lambda is exponential, with an exponential prior on log
lambda > 0. With the u_1 .. u_n of n healthy recordings, and prior probabilities p_k of values lambda_k, the calibrated
(predictive) chance is

    P(u) = sum_k w_k exp(-u / lambda_k),    w_k ~ p_k lambda_k^(-n) exp(-sum_i u_i / lambda_k),

where lambda_0 = 1 leaves the stated chance as it is.

Thus a rest, a ramp or a warm-up that every healthy recording has raises no alarm. Without healthy recordings the
stated chances are not changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.evaluation.scalar_search import find_root
from sealscope.recordings.recording import Array

#: Number of values of lambda that the calibrated chance sums over, in addition to 1.
NODES = 64


@dataclass(frozen=True, eq=False)
class HealthyNull:
    """Distribution of p-values in healthy recordings of a machine, by which the p-values of detectors are calibrated.

    `surprisals`: -log(chance) of each test in each healthy recording, by the test's key (`null_key`, `case.step_key`).
    """

    surprisals: Mapping[str, Sequence[float]] = field(default_factory=dict)
    _posteriors: dict[str, tuple[Array, Array]] = field(default_factory=dict, init=False)

    def chance(self, observable: Observable) -> float:
        """Compute the p-value of an observable, corrected by those of healthy recordings as in `calibrate`."""
        return self.calibrate(null_key(observable), observable.chance)

    def calibrate(self, key: str, chance: float) -> float:
        """Correct a detector's p-value `chance` by the p-values that it stated for healthy recordings (`key`).

        The result is the predictive chance P(u) of the module's docstring.
        """
        if key not in self._posteriors:
            self._posteriors[key] = _inflation_posterior(self.surprisals.get(key, ()))
        weights, inflations = self._posteriors[key]
        log_chance = np.log(max(chance, np.finfo(float).tiny))
        return min(float(weights @ np.exp(log_chance / inflations)), 1.0)

    def uncalibrated_chance(self, key: str, chance: float) -> float:
        """Invert `calibrate`: compute the p-value that a detector must state so that the calibrated one is `chance`.

        If no p-value is small enough, the smallest normal float is returned.
        """
        max_surprisal = -np.log(np.finfo(float).tiny)
        if self.calibrate(key, np.exp(-max_surprisal)) >= chance:
            return float(np.finfo(float).tiny)
        surprisal = find_root(lambda u: self.calibrate(key, np.exp(-u)) - chance, 0.0, max_surprisal)
        return float(np.exp(-surprisal))


def _inflation_posterior(surprisals: Sequence[float]) -> tuple[Array, Array]:
    """Compute the posterior weights w_k and the values lambda_k (NODES + 1,); without surprisals both are [1]."""
    priors = DECISION.null
    if not len(surprisals):
        return np.ones(1), np.ones(1)
    log_inflation = np.append(0.0, np.linspace(0.0, np.log(priors.largest), NODES))
    inflation = np.exp(log_inflation)
    prior = np.exp(-log_inflation / priors.inflation)
    prior[1:] *= priors.fails / prior[1:].sum()  # `fails`: fraction of machines with wrong p-values
    prior[0] = 1.0 - priors.fails
    log_posterior = np.log(prior) - len(surprisals) * log_inflation - float(np.sum(surprisals)) / inflation
    return weigh_alternatives(log_posterior), inflation


def null_key(observable: Observable) -> str:
    """Return the key of an observable in `HealthyNull.surprisals`, such as "noise: noise of the pressures".

    Observables without an onset are comparisons with healthy recordings, and share one key for their kind of data.
    """
    return comparison_key(observable.data) if observable.onset is None else f"{observable.data}: {observable.name}"


def comparison_key(data: str) -> str:
    """Return the key of comparisons of a kind of data in `HealthyNull.surprisals`, such as "details: against"."""
    return f"{data}: against"
