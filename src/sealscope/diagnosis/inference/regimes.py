"""Two hypotheses on the valves while the pump rests: they connect it to the cylinder (open), or cut it off (shut).

Open, leakage of pump and piston is in the balance at rest as in motion. Shut, leakage and flow offset of the pump
count in motion only: at rest only the piston leaks. Both balances are linear in the same columns, so that one set
of sums serves both. Let g be the leakage in motion and r at rest, coefficients of p_A - p_B, with the covariance of
blocks whose errors differ. Open, r lies about g; shut and healthy, about zero,

    log odds = log N(r; 0, V_r + (s g)^2) - log N(r - g; 0, V_(r - g) + (w g)^2),

and the odds of the recordings of one machine multiply. A leaking piston moves r towards g, so that the
healthy recordings decide.

Source: H. White, Econometrica 48 (1980) 817 (covariance where the errors differ).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, solve
from sealscope.diagnosis.inference.terms import BIAS, LEAK, REST_BIAS, REST_LEAK, RESTS
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array


def apply_regime(blocks: Blocks, roles: ColumnRoles, shut: bool) -> Blocks:
    """Reduce the Gram matrices of blocks to the balance for valves that are open, or `shut`, while the pump rests.

    `roles`: columns of `blocks`, with those of leak and flow offset at rest (`terms.with_rests`). Open, these two are
    dropped; shut, they are combined with the others (`shut_at_rest_matrix`).
    """
    if shut:
        transform = shut_at_rest_matrix(roles.names)
        return replace(blocks, gram=np.asarray(transform.T @ blocks.gram @ transform))
    without_rests = [k for k, name in enumerate((*roles.names, "left")) if name not in RESTS]
    return replace(blocks, gram=np.asarray(blocks.gram[..., without_rests, :][..., without_rests]))


def shut_at_rest_matrix(names: Sequence[str]) -> Array:
    """Build the matrix (m, n) from a balance's m columns to the n columns for a pump cut off at rest.

    With the pump cut off, its flow offset and its leakage count in motion only (`terms.shut_at_rest`): the column of
    the offset becomes bias - rest bias, that of the leak at rest becomes leak - rest leak, and the rest bias is left
    out. `names` (m - 1,) of the columns; the last column is the left side.
    """
    columns = []
    for k, name in enumerate((*names, "left")):
        column = np.zeros(len(names) + 1)
        column[k] = 1.0
        if name == BIAS:
            column[names.index(REST_BIAS)] = -1.0
        elif name == REST_LEAK:
            column[names.index(LEAK)], column[k] = 1.0, -1.0
        if name != REST_BIAS:
            columns.append(column)
    return np.column_stack(columns)


def duplicate_leak_column(gram: Array, names: Sequence[str]) -> Array:
    """Repeat the leak's row and column in Gram matrices (E, m, m) of a recording without rests.

    The balance with the pump cut off at rest has one more column, the leakage of the turning pump. Without rests it
    equals the leak's column. `names` (m - 1,) of the columns, without the left side; the result is (E, m + 1, m + 1).
    """
    index = [*range(len(names) + 1)]
    index.insert(names.index(LEAK), names.index(LEAK))
    return np.asarray(gram[:, index][:, :, index])


def has_rests(blocks: Blocks, roles: ColumnRoles) -> bool:
    """Test whether the pump rests in any block; `roles`: columns of `blocks`, with those at rest (`apply_regime`)."""
    bias = roles.names.index(REST_BIAS)
    return bool(blocks.gram[:, 0, bias, bias].sum() > 0.0)  # its column is zero in motion


def shut_odds(blocks: Blocks, roles: ColumnRoles) -> float:
    """Compute the log odds that valves cut the pump off at rest, from blocks as in `apply_regime`; 0 if unknown."""
    gram = blocks.gram[:, 0]
    at_rest, bias = (roles.names.index(name) for name in RESTS)
    if not has_rests(blocks, roles) or len(blocks) < 2:
        return 0.0
    columns = [*roles.nuisance, at_rest, bias]
    grams, moments = gram[:, columns][:, :, columns], gram[:, columns, roles.left]
    coefficients, covariance = _fit_with_robust_covariance(grams, moments)
    leaks = [columns.index(roles.leak), columns.index(at_rest)]
    motion, extra_at_rest = coefficients[leaks]  # the columns add up: the leak at rest is the sum of both
    rest_variance, extra_variance = float(covariance[np.ix_(leaks, leaks)].sum()), float(covariance[leaks[1], leaks[1]])
    if not (rest_variance > 0.0 and extra_variance > 0.0):
        return 0.0
    odds = rest_log_odds(motion + extra_at_rest, rest_variance, motion, extra_variance)
    max_odds: float = INFERENCE.rest.most
    return float(np.clip(odds, -max_odds, max_odds))


def rest_log_odds(value: float, variance: float, motion: float, difference_variance: float) -> float:
    """Compute the log odds that a quantity is zero at rest rather than equal to its value in `motion`.

    `value`, `variance`: the quantity at rest; `difference_variance`: that of `value` - `motion`.
    """
    prior = INFERENCE.rest
    shut = _normal_log_density(value, variance + (prior.shut * motion) ** 2)
    return shut - _normal_log_density(value - motion, difference_variance + (prior.open * motion) ** 2)


def _fit_with_robust_covariance(grams: Array, moments: Array) -> tuple[Array, Array]:
    """Fit coefficients (c,) to the normal equations of K blocks; return them with White's covariance (c, c).

    `grams` (K, c, c): products of the columns; `moments` (K, c): their products with the left side.
    """
    total = grams.sum(axis=0)
    coefficients = solve(total, moments.sum(axis=0))
    scores = moments - grams @ coefficients
    inverse = solve(total, np.eye(len(total)))
    small_sample_factor = len(grams) / (len(grams) - 1.0)
    return coefficients, inverse @ (scores.T @ scores) @ inverse * small_sample_factor


def _normal_log_density(value: float, variance: float) -> float:
    """Compute the log density of a normal law of mean zero at `value`, up to a constant."""
    return -0.5 * value * value / variance - 0.5 * float(np.log(variance))
