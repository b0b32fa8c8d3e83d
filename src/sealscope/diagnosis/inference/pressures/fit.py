"""Joint fit of all blocks of a recording to a model whose parameters vary from block to block.

With the output y(theta) of a model and the parameters theta_k of block k, the model of each block is linearised about
some theta_k^0,

    y_k(theta_k) = y_k(theta_k^0) + J_k (theta_k - theta_k^0),

with the Jacobian J_k. Of each block only products of residual and Jacobian are kept (`Block`). The likelihood is
Gaussian in all theta_k together (`Joint`), so that the covariance of one parameter over all blocks, with all others
eliminated, is a part of the inverse of the joint precision. Parameters are counted in units that are fractions of the
widths of their priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from sealscope.diagnosis.estimate.change import Information
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.recordings.recording import Array

#: Step of numerical differences over the width of a parameter's prior.
_DIFFERENCE = 0.05


class Normal(NamedTuple):
    """Normal prior on p parameters: `mean` (p,), and `precision` (p, p) of the parameters divided by `unit` (p,)."""

    mean: Array
    precision: Array
    unit: Array

    def deviations(self, theta: Array) -> Array:
        """Compute the differences of parameters `theta` (..., p) from the prior mean, in multiples of `unit`."""
        return (theta - self.mean) / self.unit


@dataclass(frozen=True, eq=False)
class Priors:
    """Prior on p parameters that vary during a recording.

    - `centre` (p,): prior mean of each parameter's average over the recording;
    - `covariance` (p, p): prior covariance of these averages, in units of `unit`;
    - `wander` (p,): standard deviation that the parameter's random walk reaches within the time `blocks.wander` of
      `priors.toml`, 90 s;
    - `between` (p,): standard deviation of the difference between recordings of one machine;
    - `unit` (p,): units in which the parameters are counted, small enough for finite differences.
    """

    centre: Array
    covariance: Array
    wander: Array
    between: Array
    unit: Array

    @staticmethod
    def independent(centre: Array, width: Array, wander: Array, between: Array) -> Priors:
        """Make the prior of independent parameters (p,) whose averages have the standard deviations `width` (p,)."""
        unit = _DIFFERENCE * np.minimum(width, wander)
        return Priors(centre, np.diag((width / unit) ** 2), wander, between, unit)

    @property
    def width(self) -> Array:
        """Prior standard deviations (p,) of the parameters' averages over the recording."""
        return np.asarray(np.sqrt(self.variance) * self.unit)

    @cached_property
    def normal(self) -> Normal:
        """Normal prior of the parameters' averages over the recording."""
        return Normal(self.centre, np.asarray(np.linalg.inv(self.covariance)), self.unit)

    @property
    def variance(self) -> Array:
        """Prior variances (p,) of the parameters' averages, in squares of `unit`."""
        return np.diag(self.covariance)

    @property
    def sums(self) -> Array:
        """The prior as the Gram matrix (p + 1, p + 1) of a recording (`Joint.sums`)."""
        return _gram_of_normal(self.normal.precision, self.normal.precision @ (self.centre / self.unit), self.unit)

    def machine_likelihood(self, sums: Array, tested: int) -> Array:
        """Return the likelihood of a machine's parameters given one recording, as a Gram matrix (p + 1, p + 1).

        `sums` (p + 1, p + 1): likelihood of the recording's parameters (`Joint.sums`), which differ from those of the
        machine by `between`, but for that with the index `tested`.
        """
        differing = np.flatnonzero(np.arange(len(self.centre)) != tested)
        rows = sums[differing] * self.between[differing, None]  # of differences in units of `between`
        matrix = rows[:, differing] * self.between[differing] + np.eye(len(differing))
        return np.asarray(sums - rows.T @ np.linalg.solve(matrix, rows))

    def condition_on(self, recordings: Sequence[Array], tested: int) -> Priors:
        """Return the prior of a further recording of a machine, of which healthy `recordings` are known.

        `recordings`: their likelihoods (`Joint.sums`), (p + 1, p + 1) each. The parameters of the further recording
        differ from those of the machine with the standard deviations `between`, but that with the index `tested` with
        its `wander`.
        """
        units = np.append(self.unit, 1.0)
        likelihoods = [self.machine_likelihood(sums, tested) for sums in recordings]
        gram = (np.sum(likelihoods, axis=0) + self.sums) * units * units[:, None]
        covariance = np.asarray(np.linalg.inv(gram[:-1, :-1]))
        centre = covariance @ gram[:-1, -1] * self.unit
        differences = np.where(np.arange(len(centre)) == tested, self.wander, self.between) / self.unit
        return replace(self, centre=centre, covariance=covariance + np.diag(differences**2))

    def wander_variance(self, seconds: float) -> Array:
        """Compute the variances (p,) that the random walks add within a time [s], in squares of `unit`."""
        return np.asarray((self.wander / self.unit) ** 2 * (seconds / PRESSURE.blocks.wander))


class Linearisation(NamedTuple):
    """Linearisation of the model's output over n samples about p parameters `theta` (p,).

    `rows` (1 + p, n): residual [Pa], and derivative of the output by each parameter [Pa per unit]; `amplitudes` (1 + p,
    m): the waves of the mains hum in each of them; `gram` (1 + p, 1 + p): sums over the samples of their products with
    each other, without the hum; `ends` (8, 12): simulated states at the last sample, as in `response.Segment`;
    `squares` (m,): residual sums of squares [Pa^2] of `theta` and of the further parameter sets that were simulated
    with it.
    """

    theta: Array
    gram: Array
    rows: Array
    amplitudes: Array
    ends: Array
    squares: Array

    def cost(self, variance: float, prior: Normal) -> float:
        """Compute -2 log posterior of the parameters `theta`, up to a constant, for a noise `variance` [Pa^2]."""
        deviations = prior.deviations(self.theta)
        # gram[0, 0] is the residual sum of squares
        return float(self.gram[0, 0] / variance + deviations @ prior.precision @ deviations)

    def newton_terms(self, variance: float, prior: Normal) -> tuple[Array, Array]:
        """Compute Hessian (p, p) and negative gradient (p,) of `cost` / 2 by the parameters, per `prior.unit`."""
        # row and column 0 of the Gram matrix belong to the residual
        gradient = self.gram[0, 1:] / variance - prior.precision @ prior.deviations(self.theta)
        return self.gram[1:, 1:] / variance + prior.precision, gradient


class Block(NamedTuple):
    """Sums over a block of samples, from the linearisation about the block's parameters `theta` (p,).

    `gram` (1 + p, 1 + p): products of the residual and of the derivatives by each parameter with each other; `samples`:
    number of known samples; `scores` (s, 1 + p): products of residual and derivatives with the derivative by the tested
    parameter, summed over each of s pieces of the block; their scatter shows the autocorrelation of the residual.
    """

    theta: Array
    gram: Array
    samples: float
    scores: Array

    @property
    def square(self) -> float:
        """Sum of squares of the residual [Pa^2]."""
        return float(self.gram[0, 0])


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint fit of the parameters in all K blocks of a recording.

    `theta` (K, p): parameters about which the blocks were linearised; `mean` (K p,): fitted deviations from these, in
    units of `priors.unit`, block after block; `factor`: Cholesky factor of their precision, as by `cho_factor`;
    `prior_precision` (K p, K p): prior precision of the same deviations; `variance`: variance of the residual [Pa^2];
    `noise`: the variance inflated by the correlation of the residual, as in `factor`.
    """

    priors: Priors
    theta: Array
    mean: Array
    factor: tuple[Array, bool]
    prior_precision: Array
    variance: float
    noise: float

    @property
    def fitted(self) -> Array:
        """Fitted parameters in all blocks, (K, p)."""
        return self.theta + self.mean.reshape(self.theta.shape) * self.priors.unit

    @cached_property
    def covariance(self) -> Array:
        """Covariance (K p, K p) of the fitted deviations from `theta`."""
        return np.asarray(cho_solve(self.factor, np.eye(self.theta.size), check_finite=False))

    @staticmethod
    def fit(blocks: Sequence[Block], priors: Priors, prior_precision: Array, parameter: int) -> Joint:
        """Fit the parameters of all blocks together, with the `prior_precision` of all deviations.

        `parameter`: index of the tested parameter, whose scores (`Block`) show the correlation of the noise.
        """
        theta, gram, gradient, prior_gradient = _newton_terms(blocks, priors, prior_precision)
        # variance of the residual at the parameters about which the blocks are linearised (deviations of zero)
        variance, _ = _estimate_noise(blocks, np.zeros(theta.size), parameter)
        inflation = 1.0  # white noise at first
        for _ in range(2):  # the fit changes the variance of the noise, which weights the prior
            factor = cho_factor(gram / (variance * inflation) + prior_precision, check_finite=False)
            vector = gradient / (variance * inflation) - prior_gradient
            mean = cho_solve(factor, vector, check_finite=False)
            variance, inflation = _estimate_noise(blocks, mean, parameter)
        return Joint(priors, theta, mean, factor, prior_precision, variance, variance * inflation)

    def sums(self, parameter: int, step: float) -> Array:
        """Compute the likelihood of the parameters' averages over the recording, as a Gram matrix (p + 1, p + 1).

        It is that of a regression with a column for each parameter, in the parameter's unit, and the left side: the
        precision of the averages, and its products with them. The prior of the fit is removed. `parameter`: index of
        the tested parameter, which in place of the prior's random walk has one with the standard deviation `step` from
        block to block, so that it is nearly constant.
        """
        normal, unit, (n_blocks, n_parameters) = self.priors.normal, self.priors.unit, self.theta.shape
        indices = slice(parameter, None, n_parameters)  # the tested parameter in all blocks
        precision = np.linalg.inv(self.covariance)
        vector = precision @ self.mean  # of the deviations from `theta`
        differences = np.diff(np.eye(n_blocks), axis=0)
        usual_walk = self.prior_precision[indices, indices] - normal.precision[parameter, parameter] / n_blocks**2
        change = differences.T @ differences * (unit[parameter] / step) ** 2 - usual_walk
        precision[indices, indices] += change
        vector[indices] -= change @ self.theta[:, parameter] / unit[parameter]
        covariance = np.linalg.inv(precision)
        average = np.kron(np.full(n_blocks, 1.0 / n_blocks), np.eye(n_parameters))  # (p, K p)
        averages = self.theta.mean(axis=0) / unit + average @ covariance @ vector
        posterior = np.linalg.inv(average @ covariance @ average.T)
        moments = posterior @ averages - normal.precision @ (normal.mean / unit)
        return _gram_of_normal(posterior - normal.precision, moments, unit)

    def information(self, parameter: int, time: Array, wander: float) -> Information:
        """Compute the likelihood of the parameter with the index `parameter` in K blocks, all others eliminated.

        It is the fitted posterior without the prior of the fit. The result has another prior: on a linear change and on
        a random walk, both with the scale `wander` over all blocks, in the unit of the parameter. `time` (K,): middles
        of the blocks [s].
        """
        indices = slice(parameter, None, self.theta.shape[1])  # the parameter in all blocks
        unit = self.priors.unit[parameter]
        # posterior and prior precision of the deviations from `linearised_at`, which are in units of `unit`
        posterior = np.linalg.inv(self.covariance[indices, indices])
        prior = self.prior_precision[indices, indices]
        precision = posterior - prior
        linearised_at = self.theta[:, parameter] / unit
        prior_gradient = prior @ (linearised_at - self.priors.centre[parameter] / unit)
        # posterior vector minus prior vector gives the likelihood of the deviations (first two terms); the third term
        # converts it to the likelihood of the parameter itself
        vector = posterior @ self.mean[indices] + prior_gradient + precision @ linearised_at
        precision = 0.5 * (precision + precision.T) / unit**2
        return Information(time, precision, vector / unit, slope=wander, walk=wander)


def _gram_of_normal(precision: Array, moments: Array, unit: Array) -> Array:
    """Return the Gram matrix (p + 1, p + 1) of a regression whose coefficients have a normal distribution.

    `precision` (p, p) and `moments` (p,), the precision times the mean, are those of the coefficients over `unit` (p,).
    """
    gram = np.block([[precision, moments[:, None]], [moments, np.ones(1)]])
    units = np.append(unit, 1.0)
    return np.asarray(0.5 * (gram + gram.T) / units / units[:, None])


def _newton_terms(blocks: Sequence[Block], priors: Priors, prior_precision: Array) -> tuple[Array, Array, Array, Array]:
    """Collect the parameters (K, p) of K blocks and the terms of a Newton step from them, in units of `priors.unit`.

    These are the blocks' Gram matrices of the derivatives (K p, K p), the products of the derivatives with the residual
    (K p,), and the gradient (K p,) of half of -2 log prior density (`prior_cost`).
    """
    theta = np.array([block.theta for block in blocks])
    # row and column 0 of a block's Gram matrix belong to the residual, the others to its derivatives
    gram = block_diag(*(block.gram[1:, 1:] for block in blocks))
    gradient = np.concatenate([block.gram[0, 1:] for block in blocks])
    return theta, gram, gradient, prior_precision @ ((theta - priors.centre) / priors.unit).ravel()


def newton_step(
    blocks: Sequence[Block], priors: Priors, prior_precision: Array, noise: float, damping: Array
) -> tuple[Array, float]:
    """Compute a Newton step of the parameters of K blocks to the minimum of -2 log posterior, (K, p) in `priors.unit`.

    `noise`: variance of the noise [Pa^2]; `damping` (K,): increase of the curvature of each block's residual squares by
    each parameter, relative to it. Also returns the decrease of -2 log posterior in the linearised model.
    """
    theta, gram, gradient, prior_gradient = _newton_terms(blocks, priors, prior_precision)
    vector = gradient / noise - prior_gradient
    curvature = gram / noise + prior_precision
    curvature.flat[:: len(curvature) + 1] += np.repeat(damping, theta.shape[1]) * np.diag(gram) / noise
    step = cho_solve(cho_factor(curvature, check_finite=False), vector, check_finite=False)
    return step.reshape(theta.shape), float(vector @ step)


def residual_squares(blocks: Sequence[Block], deviations: Array) -> Array:
    """Compute the residual's sum of squares (K,) [Pa^2] in K blocks by the linearised model.

    `deviations` (K, p): deviations from the parameters of the blocks, in units of `Priors.unit`.
    """
    # residual at these deviations: (1, -deviations) times the rows of residual and Jacobian
    directions = np.insert(-deviations, 0, 1.0, axis=1)
    return np.asarray(np.einsum("ki,kij,kj->k", directions, np.array([block.gram for block in blocks]), directions))


def prior_cost(theta: Array, priors: Priors, prior_precision: Array) -> float:
    """Compute -2 log prior density of the parameters `theta` (K, p) of all blocks, up to a constant."""
    deviations = ((theta - priors.centre) / priors.unit).ravel()
    return float(deviations @ prior_precision @ deviations)


def joint_prior_precision(n_blocks: int, priors: Priors, block_s: float) -> Array:
    """Compute the joint prior precision of p parameters in K blocks, each `block_s` [s] long, shape (K p, K p).

    The parameters are in units of `priors.unit`. Each is a random walk whose mean has the prior `priors.normal`.
    """
    differences = np.diff(np.eye(n_blocks), axis=0)  # matrix (K - 1, K) of the changes from block to block
    walks = np.kron(differences.T @ differences, np.diag(1.0 / priors.wander_variance(block_s)))
    # the square of the mean of x (K,) over the blocks is x' W x with every entry of W = 1 / K^2
    mean_weights = np.full((n_blocks, n_blocks), 1.0 / n_blocks**2)
    return np.asarray(walks + np.kron(mean_weights, priors.normal.precision))


def _estimate_noise(blocks: Sequence[Block], deviations: Array, parameter: int) -> tuple[float, float]:
    """Compute the variance of the residual [Pa^2], and the factor by which its correlation inflates that of parameters.

    The factor is the variance of the scores (`Block`) over their variance under white noise, at least 1. `deviations`
    (K p,): deviations of the parameters from each block's `theta`, in `Priors.unit`; `parameter`: index of the tested
    parameter.
    """
    deviations = deviations.reshape(len(blocks), -1)
    # a sum of squares of at least 1 Pa^2, since the variance is a divisor
    variance = max(float(residual_squares(blocks, deviations).sum()), 1.0) / sum(block.samples for block in blocks)
    scores = np.concatenate(
        [
            block.scores[:, 0] - block.scores[:, 1:] @ deviation
            for block, deviation in zip(blocks, deviations, strict=True)
        ]
    )
    white_variance = variance * sum(float(block.gram[1 + parameter, 1 + parameter]) for block in blocks)
    return variance, max(1.0, float(scores @ scores) / max(white_variance, np.finfo(float).tiny))
