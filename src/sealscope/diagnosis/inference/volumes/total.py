"""Total leakage of a recording, pump and piston together: the mean flow over all states of the machine.

The flow that leaks depends on what the pump does. At rest, valves may cut the pump off, and only the piston leaks;
while the pump moves the piston, or turns to hold a load, pump and piston leak. Let d be abs(p_A - p_B) without the
sensor offset, and p_s the mean of d over the recording, where d counts as 0 outside state s. With the conductance G_s
in each state s, the total is

    Q = sum over s of G_s p_s.

All coefficients of the volume balance are constants of the recording here. A drift that is free would take the place of
a leakage that the machine shows at a few moments only, as a press does while it builds up its pressure. The covariance
of the fit is the larger of two: that of equal, independent errors of the rows, and that of errors which differ from
block to block and are correlated between neighbours. The conductances while the pump moves the piston and while it
holds a load differ by the relative standard deviation `rest.scatter_if_open` (`priors.toml`); a leak that begins within
the recording adds one conductance to all states. Conductances are measured at the pressures at which they show. Where
these differ from the others, the fraction `healthy.turbulent` of a leakage that flows as through an orifice makes the
total uncertain. Terms and rows leave some flow unexplained, the fraction `total.misfit` of the pump's flow.

Source: W. K. Newey, K. D. West, Econometrica 55 (1987) 703 (covariance of correlated errors).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.terms import HOLDING, TURNING
from sealscope.diagnosis.inference.rows.weak_form import OVERLAP
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Number of blocks over which errors are correlated.
N_CORRELATED = 3
_TINY = float(np.finfo(float).tiny)


class TotalFlow(NamedTuple):
    """Mean leakage of pump and piston over a recording [m^3/s], as computed with the assumed sizes.

    Its standard deviation has two parts: `noise` differs from recording to recording, while `systematic` errors, by the
    law of the leakage and by flow that no term describes, are alike in those of one machine.
    """

    value: float
    noise: float
    systematic: float

    @property
    def deviation(self) -> float:
        """Standard deviation of the flow, which does not include the uncertain scale of the flows."""
        return float(np.hypot(self.noise, self.systematic))


class StateLoad(NamedTuple):
    """Pressure that drives the leakage in one state of the machine.

    - `pressure`: mean of abs(p_A - p_B) over the recording [Pa], where it counts as 0 outside the state;
    - `turbulent_excess`: flow of an orifice over that of the laminar leak that fits it best, minus 1. It is 0 at a
      constant pressure, and grows as the pressure varies.
    """

    pressure: float
    turbulent_excess: float

    @classmethod
    def measure(cls, pressure: Array, is_counted: NDArray[np.bool_]) -> StateLoad:
        """Measure the load of a state, with abs(p_A - p_B) = `pressure` (n,) [Pa] where the state `is_counted` (n,).

        An orifice's flow p^0.5 is fitted by g p, with g = sum p^1.5 / sum p^2.
        """
        values = pressure[is_counted & np.isfinite(pressure)]
        share = len(values) / max(int(np.isfinite(pressure).sum()), 1)
        if not (values.size and values.any()):
            return cls(0.0, 0.0)
        means = [float((values**exponent).mean()) for exponent in (0.5, 1.0, 1.5, 2.0)]
        return cls(share * means[1], means[0] * means[3] / (means[2] * means[1]) - 1.0)


class StateLoads(NamedTuple):
    """Loads of the states: a `resting` pump, one that is `moving` the piston, and one that is `holding` a load."""

    resting: StateLoad
    moving: StateLoad
    holding: StateLoad


def estimate_total_flow(
    blocks: Blocks, roles: ColumnRoles, loads: StateLoads, is_after_onset: NDArray[np.bool_] | None = None
) -> TotalFlow:
    """Estimate the mean leakage of pump and piston over a recording.

    Parameters
    ----------
    blocks : Blocks
        Blocks of the volume balance. If they have the columns `TURNING` and `HOLDING`, each state has a conductance of
        its own, otherwise there is one for all states.
    roles : ColumnRoles
        Roles of the columns.
    loads : StateLoads
        Pressure in each state.
    is_after_onset : array of bool (K,), optional
        Blocks after the onset of a leak, None without one.

    Returns
    -------
    TotalFlow
        The flow, with the parts of its standard deviation.
    """
    gram, pressure = blocks.gram[:, 0], sum(load.pressure for load in loads)
    weights, excesses = {roles.leak: pressure}, {roles.leak: _mean_excess(*loads)}
    states = [roles.names.index(name) for name in (TURNING, HOLDING) if name in roles.names]
    if states:
        turning, holding = states
        is_separate = float(gram[:, holding, holding].sum()) > 0.0  # else `apply_regime` counts holds as motion
        in_motion = (loads.moving,) if is_separate else (loads.moving, loads.holding)
        for column, parts in ((roles.leak, (loads.resting,)), (turning, in_motion), (holding, (loads.holding,))):
            weights[column], excesses[column] = sum(load.pressure for load in parts), _mean_excess(*parts)
        if not is_separate:
            weights[holding] = 0.0
    if is_after_onset is not None:
        # a leak past the piston acts in all states
        gram = _append_step(gram, roles.leak, is_after_onset)
        block_pressure = blocks.mean_pressure() * blocks.pressure_weights
        share_after = float(block_pressure[is_after_onset].sum()) / max(float(block_pressure.sum()), _TINY)
        weights[gram.shape[1] - 1] = share_after * pressure
    if states:  # the leak's column is that of all states: without the others it is that of a resting pump
        gram = _subtract_columns(gram, roles.leak, states)
    coefficients, value, deviation = _weigh_coefficients(replace(blocks, gram=gram[:, None]), roles, weights, states)
    by_law = sum(abs(coefficients.get(column, 0.0) * weights[column]) * excess for column, excess in excesses.items())
    misfit = INFERENCE.total.misfit * blocks.moving_flow
    return TotalFlow(value, deviation, float(np.hypot(INFERENCE.healthy.turbulent * by_law, misfit)))


def _mean_excess(*loads: StateLoad) -> float:
    """Average `StateLoad.turbulent_excess` over several states, weighted by their pressures; 0 without pressure."""
    pressure = sum(load.pressure for load in loads)
    return sum(load.pressure * load.turbulent_excess for load in loads) / max(pressure, _TINY)


def _append_step(gram: Array, column: int, is_after: NDArray[np.bool_]) -> Array:
    """Append a copy of a `column` of Gram matrices (K, m, m), which is 0 in blocks that `is_after` (K,) does not flag.

    The new column is the last one, behind the left side.
    """
    index = [*range(gram.shape[1]), column]
    factors = np.ones((len(gram), len(index)))
    factors[:, -1] = is_after
    return np.asarray(gram[:, index][:, :, index] * factors[:, :, None] * factors[:, None, :])


def _subtract_columns(gram: Array, column: int, subtracted: list[int]) -> Array:
    """Subtract columns `subtracted` from one `column` of the regression whose Gram matrices (K, m, m) are given."""
    transform = np.eye(gram.shape[1])
    transform[subtracted, column] = -1.0
    return np.asarray(transform.T @ gram @ transform)


def _weigh_coefficients(
    blocks: Blocks, roles: ColumnRoles, weights: Mapping[int, float], states: list[int]
) -> tuple[dict[int, float], float, float]:
    """Fit constant coefficients to blocks, and compute the sum of some of them times their `weights`, with its error.

    Returns the coefficients by their columns, the sum and its standard deviation. `states`: columns of the leakage
    while the pump moves the piston, and while it holds a load; empty without them.
    """
    gram, left = blocks.gram[:, 0], roles.left
    total = gram.sum(axis=0)
    columns = [k for k in sorted({*roles.nuisance, *weights}) if total[k, k] > 0.0]
    data = Gaussian(total[np.ix_(columns, columns)], total[columns, left], float(total[left, left]))
    n_rows = max(float(blocks.rows.sum()), 1.0)
    min_variance = 1e-14 * data.square / n_rows  # rounding errors of the sums
    variance = OVERLAP * max(data.residual_square / n_rows, min_variance)
    prior = Gaussian(_prior_precision(roles, total, columns, states, variance), np.zeros(len(columns)))
    posterior = data + prior
    inverse = posterior.covariance
    coefficients = inverse @ data.moment
    scores = gram[:, columns, left] - gram[:, columns][:, :, columns] @ coefficients  # (K, c)
    spread = scores.T @ scores
    for lag in range(1, min(N_CORRELATED, len(scores))):
        product = scores[lag:].T @ scores[:-lag]
        spread += (1.0 - lag / N_CORRELATED) * (product + product.T)
    contrast = inverse @ np.array([weights.get(k, 0.0) for k in columns])
    robust = float(contrast @ spread @ contrast) * len(scores) / max(len(scores) - 1.0, 1.0)
    by_rows = float(contrast @ posterior.precision @ contrast) * variance
    fitted = dict(zip(columns, coefficients.tolist(), strict=True))
    return fitted, float(contrast @ data.moment), float(np.sqrt(max(robust, by_rows, 0.0)))


def _prior_precision(roles: ColumnRoles, total: Array, columns: list[int], states: list[int], variance: float) -> Array:
    """Compute the prior precision (c, c) of c coefficients times the variance of a row.

    Priors are those of the constant parts (`ColumnRoles.level_deviations`), and that of the difference of the leakages
    in the two `states` of a turning pump, over the leakage that both have together.
    """
    deviations = np.full(len(total), np.inf)
    deviations[: roles.left] = roles.level_deviations(total[: roles.left + 1, : roles.left + 1])
    deviations[roles.leak] = np.inf  # the total is what is estimated
    with np.errstate(over="ignore"):
        precision = np.diag(np.minimum(variance / deviations[columns] ** 2, 1e9 * np.diag(total)[columns]))
    if len(states) == 2 and all(state in columns for state in states):
        pair = [columns.index(state) for state in states]
        # one coefficient for both states: the sum of their columns takes the place of the first
        joint = np.delete(np.eye(len(columns)), pair[1], axis=1)
        joint[pair[1], pair[0] - (pair[1] < pair[0])] = 1.0
        data = Gaussian(total[np.ix_(columns, columns)], total[columns, roles.left])
        common = data.transform(joint).mean[pair[0] - (pair[1] < pair[0])]
        difference = np.zeros(len(columns))
        difference[pair] = 1.0, -1.0
        deviation = max(INFERENCE.rest.scatter_if_open * abs(float(common)), _TINY**0.25)
        precision += np.outer(difference, difference) * variance / deviation**2
    return precision
