"""Errors of stated values: quantiles and means with intervals, errors of an onset and of a flow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.checks import Array, numbers, share


@dataclass(frozen=True)
class EstimateErrors:
    """Errors, estimate less truth, over the `n` records that state an estimate; `without` had none.

    `bias`: their mean; `rmse`: root mean square; `median` (signed), `median_size` and `ninety_size` of their size;
    `coverage`: how often the estimate's own interval held the truth.
    """

    n: int
    without: int
    bias: IntervalEstimate
    rmse: IntervalEstimate
    median: IntervalEstimate
    median_size: IntervalEstimate
    ninety_size: IntervalEstimate
    coverage: Proportion


def order_ranks(n: int, order: float, confidence: float = 0.95) -> tuple[int, int]:
    """Find the ranks (r, s) of the order statistics that hold the `order` quantile with at least `confidence`.

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


def quantile_of(values: npt.ArrayLike, order: float, confidence: float = 0.95) -> IntervalEstimate:
    """Compute the `order` quantile of a sample, ``x_(ceil(n order))``, and its order-statistic interval.

    The interval holds for any distribution; it is infinite where the sample is too small to bound the quantile.
    `values` (n,) may hold inf for what was not reached; nan is refused. Raises InputError for an empty sample. Source:
    as `order_ranks`.
    """
    array = np.sort(np.asarray(values, dtype=np.float64).ravel())
    if array.size == 0 or np.isnan(array).any():
        raise InputError("values for a quantile must be at least 1 and none of them nan")
    n = array.size
    r, s = order_ranks(n, order, confidence)
    padded = np.concatenate([[-math.inf], array, [math.inf]])
    middle = min(n, max(1, math.ceil(n * order * (1.0 - 1e-12))))
    return IntervalEstimate(n, float(padded[middle]), float(padded[r]), float(padded[s]))


def mean_of(values: npt.ArrayLike, confidence: float = 0.95) -> IntervalEstimate:
    """Compute the mean and its Student interval ``mean -+ t s/sqrt(n)``; infinite from one value, nan from none."""
    from scipy.special import stdtrit

    share(confidence, "confidence")
    array = np.asarray(values, dtype=np.float64).ravel()
    if array.size == 0:
        return IntervalEstimate(0, math.nan, math.nan, math.nan)
    array = numbers(array, "values")
    n, value = array.size, float(array.mean())
    if n == 1:
        return IntervalEstimate(1, value, -math.inf, math.inf)
    half = float(stdtrit(n - 1, 0.5 + confidence / 2.0) * array.std(ddof=1) / math.sqrt(n))
    return IntervalEstimate(n, value, value - half, value + half)


def _coverage(low: npt.ArrayLike | None, high: npt.ArrayLike | None, truth: Array, confidence: float) -> Proportion:
    """Compute the proportion of stated intervals that hold the truth."""
    low, high = _as_many(low, truth.size, "lower limits"), _as_many(high, truth.size, "upper limits")
    has_interval = ~(np.isnan(low) | np.isnan(high))
    covered = (low <= truth) & (truth <= high) & has_interval
    return proportion(int(np.count_nonzero(covered)), int(has_interval.sum()), confidence)


def _as_many(values: npt.ArrayLike | None, n: int, what: str) -> Array:
    array = np.full(n, math.nan) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape != (n,):
        raise InputError(f"{what} must be as many as the true values, got {array.shape} for {n}")
    return array


def estimate_errors(
    estimates: npt.ArrayLike,
    truth: npt.ArrayLike,
    low: npt.ArrayLike | None = None,
    high: npt.ArrayLike | None = None,
    confidence: float = 0.95,
) -> EstimateErrors:
    """Compute the errors of an estimate (a leak in L/min, an onset in s) with intervals.

    All (n,) in one unit; nan where a record has no estimate or no interval. The interval of the rmse is the square
    root of the Student interval of the mean square error, cut at 0; those of the quantiles are of order statistics.
    Coverage is over the records with an interval. Raises InputError where no record has an estimate.
    """
    true = numbers(truth, "true values")
    stated = _as_many(estimates, true.size, "estimates")
    has_estimate = np.isfinite(stated)
    if not has_estimate.any():
        raise InputError(f"errors need at least one estimate, got none in {true.size} records")
    error = stated[has_estimate] - true[has_estimate]
    square, size = mean_of(error**2, confidence), np.abs(error)
    roots = [math.sqrt(max(x, 0.0)) for x in (square.value, square.low, square.high)]
    return EstimateErrors(
        n=error.size,
        without=true.size - error.size,
        bias=mean_of(error, confidence),
        rmse=IntervalEstimate(square.n, *roots),
        median=quantile_of(error, 0.5, confidence),
        median_size=quantile_of(size, 0.5, confidence),
        ninety_size=quantile_of(size, 0.9, confidence),
        coverage=_coverage(low, high, true, confidence),
    )
