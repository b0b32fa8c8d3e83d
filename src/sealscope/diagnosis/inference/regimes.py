"""Is the pump in the circuit at rest? Two hypotheses of a machine: its valves stay open, or shut.

Open, what passes pump and piston moves the balance at rest as in motion. Shut, leakage and zero of the pump count in
motion, and rests tell of the piston alone. Both balances are linear in the same columns, so that one set of sums serves
both. Let g be what leaks in motion and r at rest, each by its own coefficient of p_A - p_B, with the covariance of
blocks whose errors differ. Open, r lies about g; shut and healthy, about zero,

    log odds = log N(r; 0, V_r + (s g)^2) - log N(r - g; 0, V_(r - g) + (w g)^2),

and the odds of the recordings of one machine multiply. A leaking piston moves r towards g: healthy recordings tell.

Source: H. White, Econometrica 48 (1980) 817 (covariance where the errors differ).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve
from sealscope.diagnosis.inference.terms import BIAS, LEAK, REST_BIAS, REST_LEAK, RESTS
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array


def apply_regime(blocks: Blocks, columns: Columns, shut: bool) -> Blocks:
    """Return blocks that hold the columns at rest as those of one hypothesis."""
    if shut:
        turn = turn_to_shut(columns.names)
        return replace(blocks, gram=np.asarray(turn.T @ blocks.gram @ turn))
    kept = [k for k, name in enumerate((*columns.names, "left")) if name not in RESTS]
    return replace(blocks, gram=np.asarray(blocks.gram[..., kept, :][..., kept]))


def turn_to_shut(names: Sequence[str]) -> Array:
    """Build the matrix (m, n) that turns columns with those at rest, the left side last, into `shut_at_rest`'s."""
    turned = []
    for k, name in enumerate((*names, "left")):
        column = np.zeros(len(names) + 1)
        column[k] = 1.0
        if name == BIAS:
            column[names.index(REST_BIAS)] = -1.0
        elif name == REST_LEAK:
            column[names.index(LEAK)], column[k] = 1.0, -1.0
        elif name == REST_BIAS:
            continue
        turned.append(column)
    return np.column_stack(turned)


def shut_without_rests(sums: Array, names: Sequence[str]) -> Array:
    """Return the sums (E, m + 1, m + 1) of a shut machine from those (E, m, m) of an open one, without rests."""
    index = [*range(len(names) + 1)]
    index.insert(names.index(LEAK), names.index(LEAK))
    return np.asarray(sums[:, index][:, :, index])


def has_rests(blocks: Blocks, columns: Columns) -> bool:
    """Tell whether anything stands still within blocks that hold the columns at rest."""
    bias = columns.names.index(REST_BIAS)
    return bool(blocks.gram[:, 0, bias, bias].sum() > 0.0)


def shut_odds(blocks: Blocks, columns: Columns) -> float:
    """Compute the log odds that the pump is cut off at rest; 0 where nothing tells."""
    gram, believed = blocks.gram[:, 0], priors("inference")["rest"]
    at_rest, bias = (columns.names.index(name) for name in RESTS)
    if not has_rests(blocks, columns) or len(blocks) < 2:
        return 0.0
    chosen = [*columns.nuisance, at_rest, bias]
    grams, left = gram[:, chosen][:, :, chosen], gram[:, chosen, columns.left]
    coefficients, covariance = _sandwich(grams, left)
    both = [chosen.index(columns.leak), chosen.index(at_rest)]
    motion, more = coefficients[both]
    resting, differing = float(covariance[np.ix_(both, both)].sum()), float(covariance[both[1], both[1]])
    if not (resting > 0.0 and differing > 0.0):
        return 0.0
    shut = _log_normal(motion + more, resting + (believed["shut"] * motion) ** 2)
    open_ = _log_normal(more, differing + (believed["open"] * motion) ** 2)
    most: float = believed["most"]
    return float(np.clip(shut - open_, -most, most))


def _sandwich(grams: Array, left: Array) -> tuple[Array, Array]:
    """Return coefficients (c,) of sums (K, c, c) and (K, c), and their covariance where the blocks' errors differ."""
    total = grams.sum(axis=0)
    coefficients = solve(total, left.sum(axis=0))
    scores = left - grams @ coefficients
    inverse = solve(total, np.eye(len(total)))
    return coefficients, inverse @ (scores.T @ scores) @ inverse * (len(grams) / (len(grams) - 1.0))


def _log_normal(value: float, variance: float) -> float:
    return -0.5 * value * value / variance - 0.5 * float(np.log(variance))
