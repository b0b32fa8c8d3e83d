"""Evaluate the errors of estimates, such as an onset or a flow: means and quantiles with confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.checks import Array, as_numbers, as_probability


@dataclass(frozen=True)
class EstimateErrors:
    """Errors (estimate minus truth) of an estimated quantity over many records, each with a confidence interval.

    Attributes
    ----------
    n, without : int
        Number of records with and without an estimate.
    bias, rmse, median : IntervalEstimate
        Mean error, root mean square error, and median of the signed error.
    median_size, ninety_size : IntervalEstimate
        50 % and 90 % quantile of the absolute error.
    coverage : Proportion
        Fraction of the stated intervals that contain the truth.
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
    """Compute the ranks (r, s) of the two sorted sample values that enclose a quantile of the distribution.

    The quantile of `order`, such as 0.9, lies between them with at least the probability `confidence`. Of `n` values, r
    is the largest rank with ``P(X <= r - 1) <= alpha/2`` and s the smallest with ``P(X >= s) <= alpha/2``, where X is
    binomial (n, order) and alpha = 1 - confidence. r = 0 and s = n + 1 mean no bound. Raises InputError for an
    impossible order or confidence. Source: Conover, Practical Nonparametric Statistics, 3rd ed. (1999), section 3.2.
    """
    from scipy.special import betainc

    as_probability(order, "the order of a quantile")
    tail = (1.0 - as_probability(confidence, "confidence")) / 2.0
    k = np.arange(1, n + 1)
    p_at_least_k = betainc(k, n + 1 - k, order)  # P(X >= k) falls with k: a count of its large values is a rank
    r = int(np.count_nonzero(1.0 - p_at_least_k <= tail))
    s = int(np.count_nonzero(p_at_least_k > tail)) + 1
    return r, s


def estimate_quantile(values: npt.ArrayLike, order: float, confidence: float = 0.95) -> IntervalEstimate:
    """Estimate a quantile of the distribution that a sample `values` (n,) comes from, with a confidence interval.

    The estimate is the sorted value ``x_(ceil(n order))``, with `order` such as 0.9, and the ends of the interval are
    sorted values, too (`order_ranks`). The interval is valid for any distribution; an end is infinite if the sample is
    too small. `values` may contain inf for values beyond all others. Raises InputError for an empty sample or nan.
    """
    array = np.sort(np.asarray(values, dtype=np.float64).ravel())
    if array.size == 0 or np.isnan(array).any():
        raise InputError("values for a quantile must be at least 1 and none of them nan")
    n = array.size
    r, s = order_ranks(n, order, confidence)
    padded = np.concatenate([[-math.inf], array, [math.inf]])  # rank k at index k; ranks 0 and n + 1 are infinite
    rank = min(n, max(1, math.ceil(n * order * (1.0 - 1e-12))))  # 1e-12: rounding of n * order
    return IntervalEstimate(n, float(padded[rank]), float(padded[r]), float(padded[s]))


def estimate_mean(values: npt.ArrayLike, confidence: float = 0.95) -> IntervalEstimate:
    """Estimate the mean of the distribution that a sample `values` comes from, with Student's confidence interval.

    The interval is ``mean -+ t s/sqrt(n)``, with the standard deviation s of the n values and Student's quantile t for
    n - 1 degrees of freedom. It is infinite for a single value; without values all results are nan. Raises InputError
    for a value that is not finite.
    """
    from scipy.special import stdtrit

    as_probability(confidence, "confidence")
    array = np.asarray(values, dtype=np.float64).ravel()
    if array.size == 0:
        return IntervalEstimate(0, math.nan, math.nan, math.nan)
    array = as_numbers(array, "values")
    n, value = array.size, float(array.mean())
    if n == 1:
        return IntervalEstimate(1, value, -math.inf, math.inf)
    half_width = float(stdtrit(n - 1, 0.5 + confidence / 2.0) * array.std(ddof=1) / math.sqrt(n))
    return IntervalEstimate(n, value, value - half_width, value + half_width)


def _as_matching(values: npt.ArrayLike | None, n: int, what: str) -> Array:
    """Convert `values` to an array (n,), filled with nan if they are None; raise InputError for another shape.

    `what`: name of the values in messages.
    """
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
    """Compute the errors of estimates, such as leaks [L/min] or onsets [s], with confidence intervals.

    `estimates`, `truth` and the ends `low` and `high` of the stated intervals, all (n,), have the same unit. A missing
    estimate or interval is nan; without `low` or `high` there are no intervals, and the coverage is nan. The confidence
    interval of the rmse is the square root of Student's interval of the mean square error, cut off at 0. Raises
    InputError if no record has an estimate.
    """
    true_values = as_numbers(truth, "true values")
    n_records = true_values.size
    values = _as_matching(estimates, n_records, "estimates")
    has_estimate = np.isfinite(values)
    if not has_estimate.any():
        raise InputError(f"errors need at least one estimate, got none in {n_records} records")
    error = values[has_estimate] - true_values[has_estimate]
    absolute_error = np.abs(error)
    mean_square = estimate_mean(error**2, confidence)
    rmse, low_rmse, high_rmse = (math.sqrt(max(x, 0.0)) for x in (mean_square.value, mean_square.low, mean_square.high))
    low, high = _as_matching(low, n_records, "lower limits"), _as_matching(high, n_records, "upper limits")
    has_interval = ~(np.isnan(low) | np.isnan(high))
    covered = (low <= true_values) & (true_values <= high) & has_interval
    return EstimateErrors(
        n=error.size,
        without=n_records - error.size,
        bias=estimate_mean(error, confidence),
        rmse=IntervalEstimate(mean_square.n, rmse, low_rmse, high_rmse),
        median=estimate_quantile(error, 0.5, confidence),
        median_size=estimate_quantile(absolute_error, 0.5, confidence),
        ninety_size=estimate_quantile(absolute_error, 0.9, confidence),
        coverage=proportion(int(np.count_nonzero(covered)), int(has_interval.sum()), confidence),
    )
