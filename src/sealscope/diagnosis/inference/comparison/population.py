"""Prediction of a value from healthy values that are normal about an unknown mean, with an unknown standard deviation.

Called for the leakage (`levels`) and for the ringing of the pressures (`rms_change`).

Source: C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown
mean); A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.inference.comparison.rise import NODES, Mixture, Rise, rise_of_mixture
from sealscope.diagnosis.inference.rows.weak_form import MAX_READING
from sealscope.recordings.recording import Array

#: Maximum number of healthy recordings whose covariances are evaluated.
MAX_RECORDINGS = 60


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

    def rise(self, values: Array, healthy_values: Array, prior_sigma: float, freedom: float) -> Rise:
        """Estimate by how much the judged value exceeds its prediction from healthy values of unknown scatter.

        `values` (s,): the judged value by s alternative estimates, weighted by the likelihood of the healthy values;
        `healthy_values` (s, n): the healthy values by the same estimates; `prior_sigma`, `freedom`: scale and degrees
        of freedom of the scaled inverse chi-squared prior on the variance of the values. The deviation of the result is
        infinite if the squares would overflow.
        """
        count = len(self._sample)
        healthy = healthy_values[:, self._sample]
        sums_of_squares = freedom * prior_sigma**2 + count * healthy.var(axis=1)
        if not 1e4 * sums_of_squares.max() < MAX_READING:
            return Rise(float(values.mean()), deviation=np.inf, degrees_of_freedom=freedom)
        # limits of the grid of sigma, far below and far above the probable values, and above 0 (1 / MAX_READING)
        min_sigma = np.sqrt(np.maximum(0.1 * freedom * prior_sigma**2, 1e-9 * sums_of_squares) / (freedom + count))
        max_sigma = np.maximum(100.0 * np.sqrt(sums_of_squares), 10.0 / MAX_READING)
        sigma = np.geomspace(np.maximum(min_sigma, 1.0 / MAX_READING), max_sigma, NODES, axis=1)
        log_priors = -0.5 * freedom * (np.log(sigma**2) + prior_sigma**2 / sigma**2)
        return rise_of_mixture(self.predict(healthy_values, sigma, log_priors), values)

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


def number_sessions(starts: Sequence[float | None], pause: float) -> list[int]:
    """Assign each recording to a session; a gap above `pause` [s] between two dates begins a new session.

    `starts` (n,): dates of the recordings [s since 1970], None if unknown. Sessions are numbered from 1 on in the order
    of the dates; an undated recording has the number -1.
    """
    dates = sorted(start for start in starts if start is not None)
    session_starts = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > pause]
    return [-1 if start is None else int(np.searchsorted(session_starts, start, "right")) for start in starts]
