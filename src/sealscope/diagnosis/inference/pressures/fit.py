"""Fit of parameters that wander from block to block: all blocks of a recording together.

With y(theta) the output of a model and theta_k the parameters of block k, each block is linear about its theta_k^0,

    y_k(theta_k) = y_k(theta_k^0) + J_k (theta_k - theta_k^0),

and stores sums only. Their likelihood is Gaussian in all theta_k together (`Joint`), so that the covariance of one
parameter in all blocks, all others eliminated, is a block of its inverse. Units are fractions of the priors' widths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.recordings.recording import Array

#: Step of numerical differences over the width of a parameter's prior.
_DIFFERENCE = 0.05


class Normal(NamedTuple):
    """Normal prior on the parameters: `mean` (p,), and `precision` (p, p) in units of `unit` (p,)."""

    mean: Array
    precision: Array
    unit: Array

    def deviations(self, theta: Array) -> Array:
        """Compute the differences of parameters (..., p) from the prior mean, in multiples of `unit`."""
        return (theta - self.mean) / self.unit


class Priors(NamedTuple):
    """Prior on parameters (p,): `centre` and `width` of their mean, deviation `wander` of a random walk in 90 s."""

    centre: Array
    width: Array
    wander: Array

    @property
    def unit(self) -> Array:
        """Units of the parameters (p,), small enough for finite differences."""
        return np.asarray(_DIFFERENCE * np.minimum(self.width, self.wander))

    @property
    def normal(self) -> Normal:
        """Normal prior on the parameters before the first block."""
        return Normal(self.centre, np.diag(1.0 / self.variance), self.unit)

    @property
    def variance(self) -> Array:
        """Prior variances (p,) of the parameters before the first block, in squares of `unit`."""
        return np.asarray((self.width / self.unit) ** 2)

    def wander_variance(self, seconds: float) -> Array:
        """Return the variances (p,) that random walks add in a time [s], in squares of `unit`."""
        return np.asarray((self.wander / self.unit) ** 2 * (seconds / PRESSURE.blocks.wander))


class Linearisation(NamedTuple):
    """Linearisation of the model about parameters `theta` (p,).

    `rows` (1 + p, n): residual [Pa] and Jacobian [Pa per unit], and `gram` (1 + p, 1 + p) of these; `ends`: states
    at the last sample; `squares`: residual sums of squares [Pa^2] of all simulated parameter sets, that of `theta`
    first.
    """

    theta: Array
    gram: Array
    rows: Array
    ends: Array
    squares: Array

    def cost(self, variance: float, prior: Normal) -> float:
        """Compute -2 log posterior, for a noise variance [Pa^2]."""
        deviations = prior.deviations(self.theta)
        return float(self.gram[0, 0] / variance + deviations @ prior.precision @ deviations)


class Block(NamedTuple):
    """Sums of a block about its parameters `theta` (p,).

    `gram` (1 + p, 1 + p) of residual and Jacobian over `samples`; `scores` (s, 1 + p): products of these with the
    tested parameter's column in each of s pieces, whose scatter shows the autocorrelation of the residual.
    """

    theta: Array
    gram: Array
    samples: float
    scores: Array


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint fit of all K blocks of a recording.

    Deviations from `theta` (K, p), in units, block after block: `mean` (K p,), `covariance` and `prior_precision` (K p,
    K p); `variance` of the residual [Pa^2].
    """

    priors: Priors
    theta: Array
    mean: Array
    covariance: Array
    prior_precision: Array
    variance: float

    @staticmethod
    def fit(blocks: Sequence[Block], priors: Priors, block_s: float, parameter: int) -> Joint:
        """Fit blocks of `block_s` [s] jointly; the scores of `parameter` give the long-run variance of the noise."""
        theta = np.array([block.theta for block in blocks])
        prior_precision = _prior_precision(len(blocks), priors, block_s)
        prior_gradient = prior_precision @ ((theta - priors.centre) / priors.unit).ravel()
        gram = block_diag(*(block.gram[1:, 1:] for block in blocks))
        gradient = np.concatenate([block.gram[0, 1:] for block in blocks])
        variance, inflation = _estimate_noise(blocks, np.zeros(theta.size), parameter)[0], 1.0  # white at first
        for _ in range(2):  # the noise's variance is one of the unknowns
            factor = cho_factor(gram / (variance * inflation) + prior_precision, check_finite=False)
            mean = cho_solve(factor, gradient / (variance * inflation) - prior_gradient, check_finite=False)
            variance, inflation = _estimate_noise(blocks, mean, parameter)
        covariance = cho_solve(factor, np.eye(theta.size), check_finite=False)
        return Joint(priors, theta, mean, covariance, prior_precision, variance)

    def information(self, parameter: int, time: Array, wander: float) -> Information:
        """Compute the likelihood of a parameter in the blocks at `time` (K,) [s], with all others eliminated.

        The fit's prior on this parameter is removed. In its place the result has the prior standard deviation `wander`
        of a slope and of a random walk, each over all blocks.
        """
        indices = slice(parameter, None, self.theta.shape[1])
        # precision with the prior, of deviations from theta
        posterior = np.linalg.inv(self.covariance[indices, indices])
        prior, unit = self.prior_precision[indices, indices], self.priors.unit[parameter]
        # likelihood = posterior - prior, and from deviations to the parameter itself
        value, precision = self.theta[:, parameter] / unit, posterior - prior
        prior_gradient = prior @ (value - self.priors.centre[parameter] / unit)
        vector = posterior @ self.mean[indices] + prior_gradient + precision @ value
        precision = 0.5 * (precision + precision.T) / unit**2
        return Information(time, precision, vector / unit, slope=wander, walk=wander)


def _prior_precision(n_blocks: int, priors: Priors, block_s: float) -> Array:
    """Compute the prior precision (K p, K p), in units, of the parameters of K blocks of `block_s` [s].

    Each parameter is a random walk from block to block, and its mean over the blocks has the prior of the machine.
    """
    steps = np.diff(np.eye(n_blocks), axis=0)
    walks = np.kron(steps.T @ steps, np.diag(1.0 / priors.wander_variance(block_s)))
    mean_weights = np.full((n_blocks, n_blocks), 1.0 / n_blocks**2)
    return np.asarray(walks + np.kron(mean_weights, priors.normal.precision))


def _estimate_noise(blocks: Sequence[Block], deviations: Array, parameter: int) -> tuple[float, float]:
    """Compute the variance of the residual [Pa^2], and its inflation by the correlation of the noise.

    `deviations` (K p,): of the parameters from those of the blocks, in units. The inflation is the variance of the
    scores of one `parameter`, relative to that under white noise, at least 1.
    """
    # (1, -deviation) times residual and Jacobian is the residual at these deviations
    directions = [np.append(1.0, -deviation) for deviation in deviations.reshape(len(blocks), -1)]
    pairs = list(zip(blocks, directions, strict=True))
    squares = sum(float(direction @ block.gram @ direction) for block, direction in pairs)
    variance = max(squares, 1.0) / sum(block.samples for block in blocks)
    scores = np.concatenate([block.scores @ direction for block, direction in pairs])
    white_variance = variance * sum(float(block.gram[1 + parameter, 1 + parameter]) for block in blocks)
    return variance, max(1.0, float(scores @ scores) / max(white_variance, np.finfo(float).tiny))
