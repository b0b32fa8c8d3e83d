"""Look for a rise of the leakage conductance over the blocks of a balance, however many there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealscope.diagnosis.changepoint.step_in_drift import StepFound, find_step
from sealscope.diagnosis.volume_balance.fit import BalanceFit
from sealscope.recordings.recording import Array

#: More blocks than this are put together for the search; around what it finds they are looked at one by one.
MOST_BLOCKS = 96
#: Errors that the blocks share count where they differ between blocks by more than this share of a block's own error.
_DIFFERENT = 0.1


def search(fit: BalanceFit, probability: float, *, sign: int = 1) -> StepFound:
    """The best rise (or fall, `sign` -1) of the conductance; `level` is given at every block of the fit."""
    shared = _shared_errors(fit)
    every = -(-len(fit.blocks) // MOST_BLOCKS)
    if every == 1:
        return find_step(fit.blocks.t, fit.g, fit.sd, probability, sign=sign, shared=shared)
    t, g, sd, common = _together(fit, shared, every)
    coarse = find_step(t, g, sd, probability, sign=sign, shared=common)
    level = np.interp(fit.blocks.t, t, coarse.level[:, 0])[:, None]
    coarse = replace(coarse, level=level, index=int(np.searchsorted(fit.blocks.t, coarse.onset)))
    if not coarse.found or coarse.rise > 0:
        return coarse
    first = max(0, min(coarse.index - MOST_BLOCKS // 2, len(fit.blocks) - MOST_BLOCKS))
    near = slice(first, first + MOST_BLOCKS)
    fine = find_step(fit.blocks.t[near], fit.g[near], fit.sd[near], probability, sign=sign)
    low, high = coarse.onset_interval
    if not (fine.found and fine.rise == 0 and low <= fine.onset <= high):
        return coarse
    return replace(coarse, onset=fine.onset, onset_interval=fine.onset_interval, index=first + fine.index)


def _together(fit: BalanceFit, shared: Array | None, every: int) -> tuple[Array, Array, Array, Array | None]:
    """Times, conductances, deviations and shared errors of `every` blocks put together by their weights."""
    starts = np.arange(0, len(fit.blocks), every)
    weight = 1.0 / fit.sd**2
    total = np.add.reduceat(weight, starts)

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(weight * values, starts) / total)

    common = None if shared is None else np.stack([mean(column) for column in shared.T], axis=1)
    return mean(fit.blocks.t), mean(fit.g), np.sqrt(1.0 / total), common


def _shared_errors(fit: BalanceFit) -> Array | None:
    """The errors that the blocks share, where they differ enough from block to block to look like a change; None where
    they are one constant, or grow evenly, as with a duty that repeats."""
    u = fit.blocks.t - fit.blocks.t.mean()
    rest = fit.shared - fit.shared.mean(axis=0)
    rest = rest - np.outer(u, u @ rest) / max(float(u @ u), np.finfo(float).tiny)
    size = float(np.sqrt(np.sum(rest**2, axis=1).mean()))
    return fit.shared if size > _DIFFERENT * float(np.median(fit.sd)) else None
