"""Excess of a leak coefficient over that of healthy recordings, and its distribution without a leak."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, NODES, Mixture
from sealscope.recordings.recording import Array
from sealscope.signals.smoothing import TINY

#: `Observable.data` of the leakage against healthy recordings.
RISE = "rise"
#: Reach of a grid of rises [standard deviations].
MAX_LOG = 4.0
#: Parts of a mixture are omitted if their log weight is lower than the largest by more than this.
NEGLIGIBLE = 16.0


class Rise(NamedTuple):
    """Amount by which a recording's leak coefficient exceeds that of healthy recordings, with its distribution.

    - `value`, `deviation`: estimate and standard deviation, in the unit of the coefficient;
    - `mixture`: distribution of `value` in a healthy recording. If None, `value` / `deviation` is Student's t with
      `degrees_of_freedom`;
    - `share`: fraction of the allowed false alarms that is left to this rise, by which its p-value is divided. It must
      be 1 for `bound`, `interval` and `log_ratio_within`.
    """

    value: float
    deviation: float
    degrees_of_freedom: float
    mixture: Mixture | None = None
    share: float = 1.0

    def share_alarms(self, share: float) -> Rise:
        """Return a copy that gets only the fraction `share` of the allowed false alarms, as one of several tests."""
        return self._replace(share=share)

    def widen(self, variance: float) -> Rise:
        """Add an error with the given `variance` to the rise; unchanged for a variance <= 0 or without a mixture."""
        if self.mixture is None or not variance > 0.0:
            return self
        mixture = self.mixture._replace(deviations=np.sqrt(self.mixture.deviations**2 + variance))
        return self._replace(deviation=float(np.sqrt(self.deviation**2 + variance)), mixture=mixture)

    @property
    def score(self) -> float:
        """The estimated rise divided by its standard deviation."""
        return self.value / self.deviation

    @property
    def chance(self) -> float:
        """Probability that a healthy recording scores higher (one-sided p-value), divided by `share`; at most 1."""
        from scipy.special import ndtr, stdtr

        if self.mixture is None:
            chance = float(stdtr(self.degrees_of_freedom, -self.score))
        else:
            weights, deviations, centres = self.mixture
            chance = float(weights @ ndtr((centres - self.score * self.deviation) / deviations))
        return min(chance / max(self.share, TINY), 1.0)

    def threshold(self, chance: float) -> float:
        """Compute the score whose p-value (the property `chance`) is the argument `chance`, between 0 and 1."""
        from scipy.special import stdtrit

        probability = 1.0 - chance * self.share
        if self.mixture is None:
            return float(stdtrit(self.degrees_of_freedom, probability))
        return self.mixture.quantile(probability) / self.deviation

    def log_ratio(self, rise: float, log_deviation: float = 0.0) -> float:
        """Compute the log likelihood ratio of two hypotheses: the leak's coefficient rose by `rise`, and it did not.

        `log_deviation`: standard deviation of the logarithm of the true rise about log(`rise`); the true rise is
        exactly `rise`, in the unit of `value`, if it is 0 or if `rise` has no logarithm.
        """
        if log_deviation > 0.0 and rise > 0.0:
            return self._log_ratio_lognormal(rise, log_deviation)
        return self._log_density(self.value - rise) - self._log_density(self.value)

    def log_ratio_within(self, rise: float, tail: float) -> float:
        """Compute the log likelihood ratio of a rise by `rise` to no rise, robust to an outlying estimate `value`.

        Both densities of `value` are at least the smaller of those of a healthy recording at its quantiles `tail` and
        1 - `tail`: an estimate that is improbable with the rise and without it is evidence for neither.
        """
        tail_values = [self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail)]
        min_log_density = min(self._log_density(value) for value in tail_values)
        with_rise = max(self._log_density(self.value - rise), min_log_density)
        return with_rise - max(self._log_density(self.value), min_log_density)

    def _log_ratio_lognormal(self, rise: float, log_deviation: float) -> float:
        """Compute the log likelihood ratio of a true rise with a log-normal prior (`log_ratio`) to no rise.

        The integral over the prior uses a grid that resolves both the prior and the likelihood.
        """
        grid_deviations = np.linspace(-MAX_LOG, MAX_LOG, NODES)
        grid = np.concatenate(
            [rise * np.exp(log_deviation * grid_deviations), self.value + self.deviation * grid_deviations]
        )
        grid = np.unique(grid[grid > TINY])
        z = np.log(grid / rise) / log_deviation
        log_prior = -0.5 * z**2 - np.log(grid * log_deviation * np.sqrt(2.0 * np.pi))
        log_densities = [self._log_density(self.value - true_rise) for true_rise in grid]
        log_integrand = log_prior + log_densities - self._log_density(self.value)
        log_max = float(log_integrand.max())
        return log_max + float(np.log(max(np.trapezoid(np.exp(log_integrand - log_max), grid), TINY)))

    def _log_density(self, value: float) -> float:
        """Compute the log probability density of the estimate `value` in a healthy recording, up to a constant."""
        if self.mixture is None:
            z = value / self.deviation
            if np.isinf(self.degrees_of_freedom):  # Student's t is then normal
                return -0.5 * z * z
            return float(-0.5 * (self.degrees_of_freedom + 1.0) * np.log1p(z * z / self.degrees_of_freedom))
        weights, deviations, centres = self.mixture
        log_weights = np.log(np.maximum(weights, np.finfo(float).tiny)) - np.log(deviations)
        return float(np.logaddexp.reduce(log_weights - 0.5 * ((value - centres) / deviations) ** 2))

    def bound(self) -> float:
        """Compute the 95 % upper bound of the true rise, in the unit of `value`; a negative `value` counts as zero."""
        # the score that a healthy recording exceeds with a probability of 95 % is negative
        return max(self.value, 0.0) - self.threshold(BOUND_PROBABILITY) * self.deviation

    def interval(self, probability: float = BOUND_PROBABILITY) -> tuple[float, float]:
        """Compute the central interval (low, high) that contains the true rise with the given `probability`."""
        tail = 0.5 - 0.5 * probability  # on either side of the interval
        max_error, min_error = (self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail))
        return self.value - max_error, self.value - min_error

    @property
    def normal_deviation(self) -> float:
        """Standard error of the rise: that of a normal distribution whose 95 % interval has the width of `interval`."""
        return Interval(self.value, *self.interval()).deviation


def rise_of_mixture(predicted: Mixture, values: Array) -> Rise:
    """Estimate the rise of a judged value over the value that healthy recordings predict for it.

    `values` (s,): the judged value by s alternative estimates; `predicted`: mixture of predicted values of shape (s,
    ...), with log weights. The rise is the median of judged minus predicted value over all estimates, and its standard
    deviation is half the width of the central 68 % interval, infinite if no part has finite numbers.
    """
    judged = np.reshape(values, (-1, *[1] * (predicted.centres.ndim - 1)))  # (s, 1, ..., 1)
    log_weights, deviations = predicted.weights.ravel(), predicted.deviations.ravel()
    centres = (predicted.centres - judged).ravel()
    max_log_weight = float(np.max(log_weights, initial=-np.inf, where=np.isfinite(log_weights + centres)))
    is_counted = (log_weights > max_log_weight - NEGLIGIBLE) & np.isfinite(centres)
    if not is_counted.any():  # impossible readings, of which nothing can be predicted
        return Rise(float(values.mean()), deviation=np.inf, degrees_of_freedom=1.0)
    weights = np.exp(log_weights[is_counted] - max_log_weight)
    mixture = Mixture(weights / weights.sum(), deviations[is_counted], centres[is_counted])  # predicted minus judged
    low, median, high = (mixture.quantile(probability) for probability in (0.16, 0.5, 0.84))
    errors = mixture._replace(centres=mixture.centres - median)
    return Rise(value=-median, deviation=0.5 * (high - low), degrees_of_freedom=np.inf, mixture=errors)
