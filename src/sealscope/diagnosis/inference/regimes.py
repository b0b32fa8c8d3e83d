"""Two hypotheses on the valves while the pump rests: they connect it to the cylinder (open), or cut it off (shut).

If they are open, the leakage of pump and piston is in the volume balance at rest as in motion. If they are shut,
leakage and flow offset of the pump count in motion only: at rest only the piston leaks. Both balances are linear in the
same columns, so one set of sums serves both. Let g be the leakage coefficient (of p_A - p_B) in motion and r that at
rest; their covariance allows for errors that differ from block to block. With open valves r scatters about g; with shut
valves and a healthy piston, about zero:

    log odds = log N(r; 0, V_r + (s g)^2) - log N(r - g; 0, V_(r - g) + (w g)^2),

where V are the variances of the estimates, and s and w the relative scatters of the prior. The odds of the recordings
of one machine multiply. Since a leaking piston moves r towards g, the healthy recordings decide.

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
    """Convert blocks to the volume balance for valves that are open, or `shut`, while the pump rests.

    `roles`: roles of the columns of `blocks`, which include leakage and flow offset at rest (`terms.with_rests`). For
    open valves these two columns are dropped from the Gram matrices; for shut valves they are combined with the
    others (`shut_at_rest_matrix`).
    """
    if shut:
        transform = shut_at_rest_matrix(roles.names)
        return replace(blocks, gram=np.asarray(transform.T @ blocks.gram @ transform))
    without_rests = [k for k, name in enumerate((*roles.names, "left")) if name not in RESTS]
    return replace(blocks, gram=np.asarray(blocks.gram[..., without_rests, :][..., without_rests]))


def shut_at_rest_matrix(names: Sequence[str]) -> Array:
    """Build the matrix (m, n) that converts the m columns of a volume balance to the n for a pump cut off at rest.

    With the pump cut off, its flow offset and its leakage count in motion only (`terms.shut_at_rest`). The column of
    the offset becomes the offset minus the offset at rest, that of the leak at rest becomes the leak minus the leak
    at rest, and the offset at rest is dropped: n = m - 1. `names` (m - 1,): names of the columns without the left
    side, which is the last column.
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
    """Add the column for the leakage of the turning pump to Gram matrices (E, m, m) of a recording without rests.

    The volume balance for a pump that is cut off at rest has this additional column (`terms.shut_at_rest`). In a
    recording without rests it equals the leak's column, which is therefore repeated. `names` (m - 1,): names of the
    columns without the left side. The result has the shape (E, m + 1, m + 1).
    """
    index = [*range(len(names) + 1)]
    index.insert(names.index(LEAK), names.index(LEAK))
    return np.asarray(gram[:, index][:, :, index])


def has_rests(blocks: Blocks, roles: ColumnRoles) -> bool:
    """Return True if the pump or the piston rests in any block.

    `roles`: roles of the columns of `blocks`, which include leakage and flow offset at rest (`terms.with_rests`).
    """
    bias = roles.names.index(REST_BIAS)
    return bool(blocks.gram[:, 0, bias, bias].sum() > 0.0)  # its column is zero in motion


def shut_odds(blocks: Blocks, roles: ColumnRoles) -> float:
    """Compute the log odds that valves cut the pump off from the cylinder while it rests.

    `roles`: roles of the columns of `blocks`, which include leakage and flow offset at rest (`terms.with_rests`). The
    odds are limited by `rest.most` in `priors.toml`, and 0 if the recording says nothing about the valves.
    """
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
    """Compute the log odds that the leakage at rest is about zero rather than about equal to the leakage in motion.

    `value`, `variance`: estimated leakage at rest and the variance of its error; `motion`: leakage in motion;
    `difference_variance`: variance of the error of `value` - `motion`.
    """
    prior = INFERENCE.rest
    shut = _normal_log_density(value, variance + (prior.shut * motion) ** 2)
    return shut - _normal_log_density(value - motion, difference_variance + (prior.open * motion) ** 2)


def _fit_with_robust_covariance(grams: Array, moments: Array) -> tuple[Array, Array]:
    """Fit coefficients (c,) by least squares, with White's covariance (c, c) for errors that differ between K blocks.

    `grams` (K, c, c): sums of the products of the columns in each block; `moments` (K, c): sums of their products
    with the left side.
    """
    total = grams.sum(axis=0)
    coefficients = solve(total, moments.sum(axis=0))
    scores = moments - grams @ coefficients
    inverse = solve(total, np.eye(len(total)))
    small_sample_factor = len(grams) / (len(grams) - 1.0)
    return coefficients, inverse @ (scores.T @ scores) @ inverse * small_sample_factor


def _normal_log_density(value: float, variance: float) -> float:
    """Compute the log density of a normal distribution with mean zero at `value`, up to a constant."""
    return -0.5 * value * value / variance - 0.5 * float(np.log(variance))
