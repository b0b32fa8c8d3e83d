"""The search for a rise among the conductances of a balance: which blocks are searched, and how many at once."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, MOST_BLOCKS, DriftStep, find_step, findable_step
from sealscope.diagnosis.volume_balance.fit import BalanceFit
from sealscope.recordings.recording import Array

#: Errors that the blocks share count where they differ between blocks by more than this share of a block's own error.
_DIFFERENT = 0.1
#: Blocks between the others are searched as well where all scatter by no more than so many times what these do.
_AS_WELL = 2.0
#: Order of the differences that show the scatter of a series: what drifts smoothly is none.
_ORDER = 4
#: Median of the size of a standard normal number.
_QUARTILE = 0.6745


class _Series(NamedTuple):
    """What is searched: times (n,) [s], conductances, deviations, shared errors, and whether blocks overlap by half."""

    t: Array
    g: Array
    sd: Array
    shared: Array | None
    halves: bool


def search(fit: BalanceFit, probability: float, *, sign: int = 1) -> DriftStep:
    """Return the best rise (or fall, `sign` -1) of the conductance, with `level` at every block of the fit."""
    series = _searched(fit)
    quiet = fit.keeps_slopes or series.halves
    every = -(-series.t.size // MOST_BLOCKS)
    merged = series if every == 1 else _merged(series, every)
    t, g, sd, shared, halves = merged
    coarse = find_step(t, g, sd, probability, sign=sign, shared=shared, quiet=quiet, halves=halves)
    level = np.interp(fit.blocks.t, t, coarse.level)
    coarse = replace(coarse, level=level, index=int(np.searchsorted(fit.blocks.t, coarse.onset)))
    if every == 1 or not coarse.alarm or coarse.rise > 0:
        return coarse
    index = int(np.searchsorted(series.t, coarse.onset))
    first = max(0, min(index - MOST_BLOCKS // 2, series.t.size - MOST_BLOCKS))
    near = slice(first, first + MOST_BLOCKS)
    fine = find_step(series.t[near], series.g[near], series.sd[near], probability, sign=sign, quiet=quiet)
    low, high = coarse.onset_interval
    if not (fine.alarm and fine.rise == 0 and low <= fine.onset <= high):
        return coarse
    index = int(np.searchsorted(fit.blocks.t, fine.onset))
    return replace(coarse, onset=fine.onset, onset_interval=fine.onset_interval, index=index)


def findable(fit: BalanceFit, probability: float, noise: float) -> float:
    """Return the smallest step of the conductance that would have been an alarm where `search` raised none.

    `noise`: scale of the noise that it saw over the stated one.
    """
    series = _searched(fit)
    every = -(-series.t.size // MOST_BLOCKS)
    t, g, sd, shared, halves = series if every == 1 else _merged(series, every)
    quiet = fit.keeps_slopes or halves
    return findable_step(t, g, sd, probability, noise, shared=shared, quiet=quiet, halves=halves)


def _searched(fit: BalanceFit) -> _Series:
    """Return what is searched.

    Where slopes are kept, or motion and the integral of dp go together, it is without the first block, in which a
    machine that starts has no whole cycle, and with the blocks between these, where they scatter alike: a smooth drift
    is followed twice as closely then. Either kind begins at its own part of a cycle, and has an offset and a drift of
    its own.
    """
    shared = _shared_errors(fit)
    first = 1 if (fit.keeps_slopes or fit.goes_together) and fit.count >= FEWEST + 2 else 0
    own = _Series(fit.blocks.t[first:], fit.g[first:], fit.sd[first:], None, halves=False)
    if shared is not None:
        own = own._replace(shared=shared[first:])
    if fit.between is None:
        return own
    later = fit.between.t > own.t[0]
    t = np.concatenate([own.t, fit.between.t[later]])
    order = np.argsort(t)
    t, g = t[order], np.concatenate([own.g, fit.between.g[later]])[order]
    place = np.round(2.0 * (t - t[0]) / float(np.median(np.diff(own.t))))
    alternating = (-1.0) ** place
    offsets = np.stack([alternating, alternating * place], axis=1)
    if t.size > MOST_BLOCKS or not (own.t.size < FEWEST or scatter(g, offsets) <= _AS_WELL * scatter(own.g)):
        return own

    def between(values: Array) -> Array:
        return np.asarray(np.interp(t, fit.blocks.t, values))

    common = None if shared is None else np.stack([between(column) for column in shared.T], axis=1)
    return _Series(t, g, between(fit.sd), common, halves=True)


def scatter(values: Array, beside: Array | None = None) -> float:
    """Return the scatter of a series (n,) beyond what drifts, and beyond the columns `beside` (n, m)."""
    rest = np.diff(values, _ORDER)
    if beside is not None:
        columns = np.diff(beside, _ORDER, axis=0)
        rest = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
    return float(np.median(np.abs(rest))) / (_QUARTILE * math.sqrt(math.comb(2 * _ORDER, _ORDER)))


def _merged(series: _Series, every: int) -> _Series:
    """Return times, conductances, deviations and shared errors of `every` blocks merged by their weights."""
    starts = np.arange(0, series.t.size, every)
    weight = 1.0 / series.sd**2
    total = np.add.reduceat(weight, starts)

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(weight * values, starts) / total)

    shared = series.shared
    common = None if shared is None else np.stack([mean(column) for column in shared.T], axis=1)
    return _Series(mean(series.t), mean(series.g), np.sqrt(1.0 / total), common, halves=False)


def _shared_errors(fit: BalanceFit) -> Array | None:
    """Return the errors that the blocks share where these differ enough from block to block to look like a change.

    None where they are one constant, or grow evenly, as with a duty that repeats.
    """
    shared = np.column_stack([fit.shared, fit.doubt * fit.leaning]) if fit.doubt else fit.shared
    u = fit.blocks.t - fit.blocks.t.mean()
    rest = shared - shared.mean(axis=0)
    rest = rest - np.outer(u, u @ rest) / max(float(u @ u), np.finfo(float).tiny)
    size = float(np.sqrt(np.sum(rest**2, axis=1).mean()))
    return shared if size > _DIFFERENT * float(np.median(fit.sd)) else None
