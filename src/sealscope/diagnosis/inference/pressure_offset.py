"""Sensor offset (constant error) of the recorded p_A - p_B, estimated from a change of the leakage and removed.

With a sensor offset z, the flow of a leak with the coefficient g is g (d - z), where d is the recorded difference p_A -
p_B. A change of g then also changes the constant flow (the flow offset of the balance), by -g z. A small z is a term of
every fit (`blocks`). Here z is estimated even if it is larger than the pressure difference itself. In block k the Gram
matrix determines two values: g_k, from the dependence of the flow on d within the block, and the flow o_k at the
block's mean difference d_k. The leak's coefficient has a slow change F a (level and slope), a random walk w, and a step
delta whose shape s is 0 before the onset and 1 after it. The constant flow has a slow change B b (level, slope and
curvature). With the variance kappa of the noise and q kappa of the walk in a block,

    g_k = F_k a + w_k + delta s_k,    o_k = (d_k - z) g_k + B_k b,    cov(w_k, w_l) = kappa q min(k, l);

F and B are projected out. z maximises its prior times the restricted likelihood, over onsets and (q, kappa). The prior
is a normal density for good sensors, with small odds of a wide density. The walk may be no larger than the one fitted
without z; otherwise z and a free walk would describe changes that no leak explains. The residual of the volume balance
repeats from cycle to cycle, so no more than `tempering.readings` residuals count as independent. If the leak does not
change, there is no information on z. It then stays near zero, and no result depends on it. Behind a servo valve both
chambers have the same leak, step and z, so their whitened rows are stacked.

z also decides which side carries the load. A large z therefore has to explain the areas of the piston, too: the blocks
are computed again with it, and it is kept only if the areas that they then show are no more improbable than z makes the
course of the leakage more probable (`area_mismatch`).

Source: D. A. Harville, J. Am. Statist. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.change import MIN_BLOCKS, RANK_TOLERANCE, WALKS, largest_step_likelihood
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, estimate_leak_and_bias, offset_cost, sum_blocks
from sealscope.diagnosis.inference.equations.balances import motions_of_side
from sealscope.diagnosis.inference.equations.terms import Equation
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.evaluation.scalar_search import find_minimum
from sealscope.recordings.recording import Array

#: Number of offsets on the first grid, which reaches to three standard deviations of the wide prior on either side.
N_GRID = 21


class OffsetFit(NamedTuple):
    """Blocks after subtracting the most probable sensor offset of p_A - p_B, and the log posterior density of it.

    The density is relative to that of no offset; it contains the prior (`offset_cost`).
    """

    blocks: Blocks
    log_posterior: float


def remove_pressure_offset(blocks: Blocks, columns: Sequence[ColumnRoles]) -> Blocks:
    """Estimate the sensor offset of p_A - p_B in a recording, and return the blocks after subtracting it."""
    return fit_pressure_offset(blocks, columns).blocks


def fit_pressure_offset(blocks: Blocks, columns: Sequence[ColumnRoles], max_offset: float = np.inf) -> OffsetFit:
    """Estimate the sensor offset of p_A - p_B in a recording, of a magnitude up to `max_offset` [Pa], and subtract it.

    The most probable offset is subtracted in the Gram matrices and added to `Blocks.zero` [Pa]. The blocks are returned
    unchanged if too few of them determine the leak, or if an equation has no column for a constant flow.
    """
    if len(blocks) < MIN_BLOCKS or any(roles.bias is None for roles in columns):
        return OffsetFit(blocks, 0.0)
    coarse = blocks.merge(INFERENCE.blocks.coarse)  # fewer blocks: the time of the leak's onset need not be exact
    equations = [
        whitened
        for k, roles in enumerate(columns)
        if (whitened := _whiten_steps(replace(coarse, gram=coarse.gram[:, k : k + 1]), roles)) is not None
    ]
    if not equations:
        return OffsetFit(blocks, 0.0)
    leak_steps, flow_offset_steps, residuals = (np.concatenate(parts) for parts in zip(*equations, strict=True))
    # prior standard deviation of the offset of good sensors [Pa], smaller for pressures in counts
    unit = columns[0].offset_deviation(columns[0].leak, blocks)
    relative_offset, log_posterior = _find_relative_offset(
        leak_steps, unit * flow_offset_steps, residuals, max_offset / INFERENCE.zero.pressure
    )
    offset = unit * relative_offset
    gram = blocks.gram.copy()
    for k, roles in enumerate(columns):
        assert roles.bias is not None
        # (p_A - p_B) dt minus offset dt, in the rows and in the columns of the Gram matrices
        gram[:, k, roles.leak] -= offset * gram[:, k, roles.bias]
        gram[:, k, :, roles.leak] -= offset * gram[:, k, :, roles.bias]
    return OffsetFit(replace(blocks, gram=gram, zero=blocks.zero + offset), log_posterior)


def _find_relative_offset(
    leak_steps: Array, flow_offset_steps: Array, residuals: Array, max_offset: float
) -> tuple[float, float]:
    """Find the most probable sensor offset of p_A - p_B, in units of its prior standard deviation.

    The magnitude is at most `max_offset`. Also returns the log posterior density relative to that of no offset.

    `residuals` (n,): whitened residuals of leak and constant flow in K blocks. Column k of `leak_steps` (n, K) is their
    change by a unit step of the leak's coefficient from block k on. Such a step also lowers the constant flow, in
    proportion to the offset: column k of `flow_offset_steps` (n, K) is the effect of this change for an offset of -1.
    With S = leak_steps - offset flow_offset_steps, and a leak that steps up by `size` in block k,

        residuals = size S[:, k] + noise,    cov noise = kappa (I + q S S'),

    where q S S' is the random walk of the leak's coefficient, kappa the variance of the noise, and I the identity. The
    likelihood is maximised over size > 0, k, kappa and q; `offset_cost` states the prior on the offset. The search is
    over asinh(offset), which covers small and large offsets alike.
    """
    usual, far = INFERENCE.zero.pressure, INFERENCE.zero.far  # standard deviations of the prior [Pa]
    # no walk larger than the best one without an offset: otherwise an offset could explain changes that no leak causes
    walks = WALKS[largest_step_likelihood(leak_steps, residuals)[1] >= WALKS]

    # the residual of the balance repeats from cycle to cycle, so not all residuals are independent
    independent_fraction = min(1.0, INFERENCE.tempering.readings / len(residuals))

    def log_likelihood(positions: Array | float) -> Array:
        """Compute the log likelihoods at asinh(offset) = `positions`, scaled to the number of independent residuals."""
        steps = leak_steps - np.sinh(positions)[..., None, None] * flow_offset_steps
        return independent_fraction * largest_step_likelihood(steps, residuals, walks)[0]

    def cost(position: float) -> float:
        """Compute minus the log posterior density at asinh(offset) = `position`, up to a constant."""
        # in the prior, a relative offset of 1 is `usual` [Pa], also for pressures in counts
        return 0.5 * float(offset_cost(usual * float(np.sinh(position)))) - float(log_likelihood(position))

    positions = np.arcsinh(min(3.0 * far / usual, max_offset)) * np.linspace(-1.0, 1.0, N_GRID)
    # search about offset 0, where the prior has its maximum, and about the maximum of the likelihood
    starts = {N_GRID // 2, int(np.argmax(log_likelihood(positions)))}
    minima = []
    for start in starts:
        low, high = positions[max(start - 1, 0)], positions[min(start + 1, N_GRID - 1)]  # neighbours on the grid
        minima.append(find_minimum(cost, low, high, tolerance=1e-3))
    position, lowest_cost = min(minima, key=lambda minimum: minimum[1])
    return float(np.sinh(position)), cost(0.0) - lowest_cost


def area_mismatch(blocks: Blocks, columns: Sequence[ColumnRoles], equation: Equation, ratio_deviation: float) -> float:
    """Compute how much the fitted areas of the piston contradict each other: -2 log of their likelihood.

    A wrong offset attributes motion to the wrong side of the load. The coefficients a_j of the motion, in up to two
    directions for each side, should be the side's area times a common factor, to within `between.motion`
    (`priors.toml`) and the errors e_j of the fit. These variances are divided by the column's share of the motion, as
    much of a small share belongs to the other side. The log ratio of the areas of B and A is normal about that of the
    `equation`, with the standard deviation `ratio_deviation`. The result is the smallest sum of squares over the common
    factor and the ratio; 0 without a motion of the piston.
    """
    roles, total = columns[0], sum_blocks(blocks, columns)[0]
    if not roles.piston:
        return 0.0
    nuisance = list(roles.nuisance)
    fit = Gaussian.from_gram(total).among(nuisance)
    coefficients, variances = fit.mean, np.diag(fit.covariance)
    places = [nuisance.index(column) for column in roles.piston if total[column, column] > 0.0]
    areas, names = coefficients[places], [roles.names[nuisance[place]] for place in places]
    # a coefficient that is not known to its order of magnitude tells nothing
    relative_errors = np.sqrt(np.maximum(variances[places], 0.0)) / np.maximum(np.abs(areas), np.finfo(float).tiny)
    is_known = relative_errors < 1.0
    is_side_B = np.array([name in motions_of_side(equation, "B") for name in names], dtype=float)[is_known]
    logarithms = np.log(np.abs(areas[is_known])) - is_side_B * np.log(equation.area_ratio)
    energies = np.diag(total)[[nuisance[place] for place in places]][is_known]
    shares = energies / max(float(energies.max(initial=0.0)), np.finfo(float).tiny)
    covariance = np.diag((INFERENCE.between.motion**2 + relative_errors[is_known] ** 2) / shares)
    covariance += ratio_deviation**2 * np.outer(is_side_B, is_side_B)
    weights = np.linalg.inv(covariance)
    deviations = logarithms - weights.sum(axis=0) @ logarithms / max(float(weights.sum()), np.finfo(float).tiny)
    return float(deviations @ weights @ deviations)


def _whiten_steps(blocks: Blocks, roles: ColumnRoles) -> tuple[Array, Array, Array] | None:
    """Convert the estimates of leak and constant flow in K blocks to residuals with independent unit noise.

    The 2 K estimates by the first equation (K leaks, K constant flows) have the inverse covariance P. With R such that
    P = R' R, the residuals are R times the estimates. Slow changes are then projected out: level and slope of the leak,
    and a quadratic drift of the constant flow. Returns the arguments of `_find_relative_offset`, for unit steps of
    1 m^3/(s Pa) and 1 m^3/s; None if too few blocks determine the estimates.
    """
    count = len(blocks)
    # the constant flow is stated at each block's mean pressure difference `pressure`; a leak g adds g `pressure` to it
    precision, vector, pressure = estimate_leak_and_bias(blocks, roles)
    energies = np.diag(precision).reshape(2, count)  # rows: leak and constant flow; zero in some blocks at rest
    floors = np.maximum(np.finfo(float).eps * energies.max(axis=1), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(energies, floors[:, None])).ravel()
    eigenvalues, eigenvectors = np.linalg.eigh(precision / np.outer(scale, scale))
    is_informative = eigenvalues > RANK_TOLERANCE * max(float(eigenvalues[-1]), 0.0)
    position = np.linspace(-1.0, 1.0, count)  # from the first block to the last
    trend, drift = (np.polynomial.legendre.legvander(position, degree) for degree in (1, 2))
    trend_and_drift = np.block([[trend, np.zeros_like(drift)], [pressure[:, None] * trend, drift]])
    # `MIN_BLOCKS` already includes level and slope, two of the columns of trend and drift
    if np.count_nonzero(is_informative) < trend_and_drift.shape[1] + MIN_BLOCKS - 2:
        return None
    root_eigenvalues = np.sqrt(eigenvalues[is_informative])
    whitening = (eigenvectors[:, is_informative] * root_eigenvalues).T * scale  # R, informative directions only
    slow_changes = whitening @ trend_and_drift
    slow_changes /= np.maximum(np.linalg.norm(slow_changes, axis=0), np.finfo(float).tiny)
    complement = np.linalg.qr(slow_changes, mode="complete")[0][:, slow_changes.shape[1] :].T  # orthogonal to these
    # R times the estimates, which are P^-1 vector
    residuals = complement @ ((eigenvectors[:, is_informative].T @ (vector / scale)) / root_eigenvalues)
    unit_steps = np.tril(np.ones((count, count)))  # column k: 1 from block k on
    flow_offset = complement @ whitening[:, count:]
    leak = complement @ whitening[:, :count] + flow_offset * pressure
    return leak @ unit_steps, flow_offset @ unit_steps, residuals
