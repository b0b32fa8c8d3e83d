"""Quantiles of a sample with intervals that hold for any distribution; a value that was never reached counts as
infinite."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import share


@dataclass(frozen=True)
class Quantile:
    """The `order` quantile of `n` values and its interval (`low`, `high`) at `confidence`; infinite where the sample
    is too small to bound it, or where that many values are infinite."""

    order: float
    n: int
    value: float
    low: float
    high: float
    confidence: float


def order_ranks(n: int, order: float, confidence: float = 0.95) -> tuple[int, int]:
    """Ranks (r, s) of the order statistics between which the `order` quantile lies with at least `confidence`.

    r is the largest with ``P(X <= r - 1) <= alpha/2``, s the smallest with ``P(X >= s) <= alpha/2``, X binomial (n,
    order); r = 0 and s = n + 1 stand for no bound. Raises InputError for an impossible order or confidence. Source:
    Conover, Practical Nonparametric Statistics, 3rd ed. (1999), section 3.2.
    """
    from scipy.special import betainc

    share(order, "the order of a quantile")
    tail = (1.0 - share(confidence, "confidence")) / 2.0
    k = np.arange(1, n + 1)
    reach = betainc(k, n + 1 - k, order)  # P(X >= k), falling in k
    return int(np.count_nonzero(1.0 - reach <= tail)), int(np.count_nonzero(reach > tail)) + 1


def quantile_of(values: npt.ArrayLike, order: float, confidence: float = 0.95) -> Quantile:
    """The `order` quantile of a sample, ``x_(ceil(n order))``, and its order-statistic interval.

    `values` (n,) may hold inf for what was not reached in time; nan is refused. Raises InputError for an empty
    sample. Source: as `order_ranks`.
    """
    array = np.sort(np.asarray(values, dtype=np.float64).ravel())
    if array.size == 0 or np.isnan(array).any():
        raise InputError("values for a quantile must be at least 1 and none of them nan")
    n = array.size
    r, s = order_ranks(n, order, confidence)
    padded = np.concatenate([[-math.inf], array, [math.inf]])
    middle = min(n, max(1, math.ceil(n * order * (1.0 - 1e-12))))
    return Quantile(order, n, float(padded[middle]), float(padded[r]), float(padded[s]), confidence)
