"""Evaluate the errors of estimates, such as an onset or a flow: means and quantiles with confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion

#: Largest error whose square a float holds; a stored estimate may be any number.
_MAX_ERROR = 1e150


@dataclass(frozen=True)
class EstimateErrors:
    """Errors (estimate minus truth) of an estimated quantity over many records.

    - `n`, `without`: number of records with and without an estimate
    - `bias`, `median`: mean and median of the signed error; `rmse`: root mean square error
    - `median_size`, `ninety_size`: 50 % and 90 % quantile of the absolute error
    - `coverage`: fraction of the stated intervals that contain the truth
    """

    n: int
    without: int
    bias: IntervalEstimate
    rmse: float
    median: IntervalEstimate
    median_size: IntervalEstimate
    ninety_size: IntervalEstimate
    coverage: Proportion


def order_ranks(n: int, order: float, confidence: float = 0.95) -> tuple[int, int]:
    """Compute the ranks (r, s) of the two sorted sample values that enclose a quantile of the distribution.

    The quantile of `order`, such as 0.9, lies between them with at least the probability `confidence`. Of `n` values, r
    is the largest rank with ``P(X <= r - 1) <= alpha/2`` and s the smallest with ``P(X >= s) <= alpha/2``, where X is
    binomial (n, order) and alpha = 1 - confidence. r = 0 and s = n + 1 mean no bound. Source: Conover, Practical
    Nonparametric Statistics, 3rd ed. (1999), section 3.2.
    """
    from scipy.special import betainc

    tail = (1.0 - confidence) / 2.0
    k = np.arange(1, n + 1)
    p_at_least_k = betainc(k, n + 1 - k, order)  # P(X >= k) falls with k: a count of its large values is a rank
    r = int(np.count_nonzero(1.0 - p_at_least_k <= tail))
    s = int(np.count_nonzero(p_at_least_k > tail)) + 1
    return r, s


def estimate_quantile(values: npt.ArrayLike, order: float, confidence: float = 0.95) -> IntervalEstimate:
    """Estimate a quantile of the distribution that a sample `values` (n,), n >= 1, comes from.

    The estimate is the sorted value ``x_(ceil(n order))``, with `order` such as 0.9, and the ends of its confidence
    interval are sorted values, too (`order_ranks`). The interval is valid for any distribution; an end is infinite if
    the sample is too small.
    """
    array = np.sort(np.asarray(values, dtype=np.float64))
    n = array.size
    r, s = order_ranks(n, order, confidence)
    padded = np.concatenate([[-math.inf], array, [math.inf]])  # rank k at index k; ranks 0 and n + 1 are infinite
    rank = max(1, math.ceil(n * order * (1.0 - 1e-12)))  # 1e-12: rounding of n * order
    return IntervalEstimate(n, float(padded[rank]), float(padded[r]), float(padded[s]))


def estimate_mean(values: npt.ArrayLike, confidence: float = 0.95) -> IntervalEstimate:
    """Estimate the mean of the distribution that a sample `values` (n,), n >= 1, comes from.

    Its confidence interval is Student's, ``mean -+ t s/sqrt(n)``, with the standard deviation s of the values and
    Student's quantile t for n - 1 degrees of freedom; it is infinite for a single value.
    """
    from scipy.special import stdtrit

    array = np.asarray(values, dtype=np.float64)
    n, value = array.size, float(array.mean())
    half_width = math.inf
    if n > 1:
        half_width = float(stdtrit(n - 1, 0.5 + confidence / 2.0) * array.std(ddof=1) / math.sqrt(n))
    return IntervalEstimate(n, value, value - half_width, value + half_width)


def estimate_errors(
    estimates: npt.ArrayLike, truth: npt.ArrayLike, low: npt.ArrayLike, high: npt.ArrayLike, confidence: float = 0.95
) -> EstimateErrors:
    """Compute the errors of estimates, such as leaks [L/min] or onsets [s], with confidence intervals.

    `estimates`, `truth` and the ends `low` and `high` of the stated intervals, all (n,), have the same unit. A missing
    estimate or interval is nan, and no end is infinite; at least one record has an estimate. Raises InputError for an
    error that is too large to be squared.
    """
    stated, true_values = np.asarray(estimates, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    lower, upper = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    error = (stated - true_values)[np.isfinite(stated)]
    absolute_error = np.abs(error)
    if absolute_error.max() > _MAX_ERROR:
        raise InputError(f"errors of estimates must be at most {_MAX_ERROR:g}, got {absolute_error.max():g}")
    is_covered = (lower <= true_values) & (true_values <= upper)  # False for nan
    return EstimateErrors(
        n=error.size,
        without=stated.size - error.size,
        bias=estimate_mean(error, confidence),
        rmse=math.sqrt(np.mean(error**2)),
        median=estimate_quantile(error, 0.5, confidence),
        median_size=estimate_quantile(absolute_error, 0.5, confidence),
        ninety_size=estimate_quantile(absolute_error, 0.9, confidence),
        coverage=proportion(int(is_covered.sum()), int(np.sum(np.isfinite(lower) & np.isfinite(upper))), confidence),
    )
