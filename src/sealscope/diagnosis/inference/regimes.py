"""Two hypotheses on the valves while the pump rests: they connect it to the cylinder (open), or cut it off (shut).

With open valves, pump and piston leak at rest and in motion, and one coefficient describes both. With shut valves only
the piston leaks at rest. The pump's leakage while it moves the piston then has a second coefficient, and the pump's
flow offset counts in motion only. A pump may also turn slowly to hold the load for seconds, and is then connected. The
leakage of all these holds has a third coefficient within a recording; otherwise a drive that is switched off would look
like a leak that ends. Between recordings one coefficient is compared for all rests, since many machines show the
piston's leak only in such holds. If a flow meter measures the flow to the cylinder, only its flow tells motion from
rest. Both balances select from the same columns, so one set of Gram matrices serves both.

Let g be the leakage coefficient (of p_A - p_B) in motion and r the coefficient at rest, given the compliances in
motion; their covariance allows for errors that differ from block to block. With open valves r scatters about g; with
shut valves and a healthy piston, about zero:

    log odds = log N(r; 0, V_r + (s g)^2) - log N(r - g; 0, V_(r - g) + (w g)^2),

where V are the variances of the estimates, and s and w the prior scatters of r over g (`shut` and `open` of `[rest]` in
`priors.toml`). The odds of the recordings of one machine multiply. Since a leaking piston moves r towards g, the
healthy recordings decide (`volumes.detector`).

Source: H. White, Econometrica 48 (1980) 817 (covariance where the errors differ).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sealscope.diagnosis.estimate.linear import Gaussian, solve
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.terms import BIAS, HOLDING, LEAK, MOVING_BIAS, STATES, TURNING
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Fraction of the sum of squares of p_A - p_B below which a state of the machine does not occur, but for rounding.
NEGLIGIBLE = 1e-6
#: Least number of blocks with motion, and without, for an estimate of the leakage of either state.
MIN_STATE_BLOCKS = 2


def apply_regime(blocks: Blocks, roles: ColumnRoles, valves: Valves, *, has_holds: bool) -> Blocks:
    """Convert blocks to the volume balance for `valves` that are open, or shut, while the pump rests.

    `roles` includes the columns `STATES` that `balances.with_rests` adds.

    - Open valves: the columns `STATES` are dropped from the Gram matrices.
    - Shut valves: the column of the flow offset in motion (`MOVING_BIAS`) replaces that of the flow offset at all times
      (`BIAS`). The column `HOLDING`, the leakage of a pump that turns only to hold the load, remains if some hold lasts
      for seconds (`has_holds`) and the pump is off at other times. Otherwise it is set to zero, and the leak's
      coefficient describes the holds as well.

    If all holds are short and the pump is off at other times, the machine is a press, whose pump builds up the pressure
    through open valves in these holds. If its valves are certainly shut at rest (`Valves.SURELY_SHUT`), holds count as
    motion: the column `HOLDING` is added to the column `TURNING` before it is set to zero.
    """
    names = (*roles.names, "left")  # the last column is the left side of the balance
    if valves is Valves.OPEN:
        columns = [k for k, name in enumerate(names) if name not in STATES]
        return replace(blocks, gram=np.asarray(blocks.gram[..., columns, :][..., columns]))
    moving_bias, turning, holding = (names.index(name) for name in (MOVING_BIAS, TURNING, HOLDING))
    columns = [moving_bias if name == BIAS else k for k, name in enumerate(names) if name != MOVING_BIAS]
    gram = blocks.gram.copy()
    is_always_on = _rest_share(blocks, roles, TURNING, HOLDING) < NEGLIGIBLE  # the pump moves or holds the load
    if valves is Valves.SURELY_SHUT and not is_always_on and not has_holds:
        gram[..., turning, :] += gram[..., holding, :]
        gram[..., turning] += gram[..., holding]
    if not has_holds or is_always_on:
        gram[..., holding, :] = gram[..., holding] = 0.0
    return replace(blocks, gram=np.asarray(gram[..., columns, :][..., columns]))


def add_pump_columns(gram: Array, names: Sequence[str]) -> Array:
    """Add the columns of a pump that is cut off at rest to Gram matrices (E, m, m) of a recording without rests.

    The two new columns precede the column of the leak: `TURNING`, the leakage of the turning pump, and `HOLDING`, that
    of a pump that only holds the load. Without rests the first equals the column of the leak, and the second is zero.
    `names` (m - 1,): names of the old columns without the left side. The result has the shape (E, m + 2, m + 2).
    """
    leak = names.index(LEAK)
    index = [*range(len(names) + 1)]
    index[leak:leak] = [leak, leak]  # two copies of the leak's column in front of it
    expanded = np.asarray(gram[:, index][:, :, index])
    holding = leak + 1
    expanded[:, holding] = expanded[:, :, holding] = 0.0
    return expanded


def has_rests(blocks: Blocks, roles: ColumnRoles) -> bool:
    """Return True if pump or piston rest under pressure at times; `roles` include those of `balances.with_rests`."""
    return _rest_share(blocks, roles, TURNING) > NEGLIGIBLE


def _rest_share(blocks: Blocks, roles: ColumnRoles, *states: str) -> float:
    """Compute the fraction of the sum of squares of p_A - p_B outside the given states of the machine.

    `states`: names of columns that equal p_A - p_B in one state and 0 otherwise, such as `TURNING` (pump in motion).
    """
    leak, *columns = (roles.names.index(name) for name in (LEAK, *states))
    energies = np.diagonal(blocks.gram[:, 0], axis1=1, axis2=2).sum(axis=0)
    return float(1.0 - energies[columns].sum() / max(energies[leak], np.finfo(float).tiny))


def shut_odds(blocks: Blocks, roles: ColumnRoles) -> float:
    """Compute the log odds that valves cut the pump off from the cylinder while the pump rests (`rest_log_odds`).

    `roles` includes the columns of `balances.with_rests`. All coefficients are estimated from blocks with motion; then
    leakage and flow offset at rest are estimated from the other blocks, given all other coefficients. A single
    regression could make both leakage and compliance zero at rest, since the rate at which the pressures relax shows
    only their ratio. With the columns X of leakage and flow offset at rest, the left side y, the other columns Z and
    their coefficients b in motion, the leakage r at rest is the first of

        (X'X)^-1 X'(y - Z b),    variance = White's variance + J cov(b) J' + k^2 sum (J_c b_c)^2,

    where J = d r/db is the first row of -(X'X)^-1 X'Z, and the sum is over the compliances c. This sum allows for a
    relative error k = `rest.compliance` (`priors.toml`) of each compliance, which air in the oil makes larger at low
    pressures. It vanishes if the pressures stay the same at rest, for example because a pump replaces the leaking oil.
    The result is 0 if fewer than `MIN_STATE_BLOCKS` blocks are in motion or at rest, or if a variance is not positive.
    """
    gram, left = blocks.gram[:, 0], roles.left
    turning, holding, moving_bias = (roles.names.index(name) for name in (TURNING, HOLDING, MOVING_BIAS))
    energies = np.diagonal(gram, axis1=1, axis2=2)
    is_rest = energies[:, turning] + energies[:, holding] <= NEGLIGIBLE * energies[:, roles.leak]
    if min(np.count_nonzero(is_rest), np.count_nonzero(~is_rest)) < MIN_STATE_BLOCKS:
        return 0.0
    columns = [*roles.nuisance, turning, holding, moving_bias]
    coefficients, covariance = fit_with_robust_covariance(gram[~is_rest], columns, left)
    # in motion the leakage is the sum of the leak's coefficient and that of the turning pump
    in_motion = [columns.index(roles.leak), columns.index(turning)]
    # leakage and flow offset, which are fitted to the rests alone
    rest_columns = [column for column in (roles.leak, roles.bias) if column is not None]
    shared = [k for k, column in enumerate(columns) if column not in (*rest_columns, turning, holding, moving_bias)]
    shared_columns = [columns[k] for k in shared]
    # transform that subtracts the shared columns, times their coefficients, from the left side
    residual = np.eye(left + 1)
    residual[shared_columns, left] = -coefficients[shared]
    rest_gram = residual.T @ gram[is_rest] @ residual
    rest, rest_covariance = fit_with_robust_covariance(rest_gram, rest_columns, left)
    total = rest_gram.sum(axis=0)
    normal, coupling = total[np.ix_(rest_columns, rest_columns)], total[np.ix_(rest_columns, shared_columns)]
    sensitivity = -solve(normal, coupling)[0]  # derivatives of the leakage at rest by the shared coefficients
    by_compliance = (sensitivity * coefficients[shared])[np.isin(shared_columns, roles.compliance)]
    rest_variance = float(rest_covariance[0, 0] + INFERENCE.rest.compliance**2 * (by_compliance @ by_compliance))
    rest_variance += float(sensitivity @ covariance[np.ix_(shared, shared)] @ sensitivity)
    motion_variance = float(covariance[np.ix_(in_motion, in_motion)].sum())
    common = float(sensitivity @ covariance[np.ix_(shared, in_motion)].sum(axis=1))  # covariance of r and g
    motion = float(coefficients[in_motion].sum())
    difference_variance = rest_variance + motion_variance - 2.0 * common
    if not (rest_variance > 0.0 and difference_variance > 0.0):
        return 0.0
    return rest_log_odds(float(rest[0]), motion, rest_variance=rest_variance, difference_variance=difference_variance)


def rest_log_odds(rest: float, motion: float, *, rest_variance: float, difference_variance: float) -> float:
    """Compute the log odds that the leakage at rest is about zero rather than about equal to the leakage in motion.

    With the leakage r = `rest` at rest, the leakage g = `motion` in motion, and the normal density N(x; variance),

        log odds = log N(r; rest_variance + (s g)^2) - log N(r - g; difference_variance + (w g)^2),

    limited to +-`rest.most` (`priors.toml`). The variances are those of the errors of r and of r - g; s and w are the
    prior scatters of r relative to g (`rest.shut` and `rest.open`). All leakages are conductances [m^3/(s Pa)], or all
    are flows [m^3/s].
    """
    prior = INFERENCE.rest
    if_shut = normal_log_density(rest, rest_variance + (prior.shut * motion) ** 2)
    if_open = normal_log_density(rest - motion, difference_variance + (prior.open * motion) ** 2)
    return float(np.clip(if_shut - if_open, -prior.most, prior.most))


def fit_with_robust_covariance(gram: Array, columns: list[int], left: int) -> tuple[Array, Array]:
    """Fit coefficients (c,) by least squares, with White's covariance (c, c) for errors that differ between K blocks.

    `gram` (K, m, m): Gram matrix of each of K > 1 blocks; `columns`, `left`: indices of the columns to fit and of the
    left side.
    """
    grams, moments = gram[:, columns][:, :, columns], gram[:, columns, left]
    fit = Gaussian(grams.sum(axis=0), moments.sum(axis=0))
    coefficients = fit.mean
    scores = moments - grams @ coefficients  # (K, c), products of the residual with the columns
    return coefficients, fit.robust_covariance(scores.T @ scores * (len(grams) / (len(grams) - 1.0)))


def normal_log_density(value: Any, variance: Any) -> Any:
    """Compute the log density at `value` of a normal distribution with mean 0 and a `variance`, numbers or arrays."""
    variance = np.maximum(variance, np.finfo(float).tiny)
    return -0.5 * value * value / variance - 0.5 * np.log(2.0 * np.pi * variance)
