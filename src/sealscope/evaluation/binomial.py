"""Exact statistics of counts: a proportion with its interval, tests of a count, and correction for several tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class IntervalEstimate:
    """A `value` estimated from `n` observations, with its confidence interval from `low` to `high`.

    An end of the interval is infinite if the observations do not bound it.
    """

    n: int
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Proportion(IntervalEstimate):
    """A proportion: `count` observations out of `n`, with its confidence interval.

    If n is 0, the value is nan and the interval is 0 to 1.
    """

    count: int


def clopper_pearson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the exact confidence interval (low, high) of a probability from `k` successes in `n` trials.

    The interval contains the true probability with at least the probability `confidence`. With B(p; a, b) the
    p-quantile of the beta distribution with parameters a and b, and alpha = 1 - confidence, ``low = B(alpha/2; k,
    n-k+1)`` and ``high = B(1-alpha/2; k+1, n-k)``; low is 0 if k = 0, and high is 1 if k = n. Source: Clopper and
    Pearson, Biometrika 26 (1934) 404-413, doi 10.1093/biomet/26.4.404.
    """
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2.0
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1.0 - tail))
    return low, high


def proportion(k: int, n: int, confidence: float = 0.95) -> Proportion:
    """Compute the proportion `k` of `n` with its Clopper-Pearson interval."""
    low, high = clopper_pearson(k, n, confidence)
    return Proportion(n=n, value=k / n if n else math.nan, low=low, high=high, count=k)


def lower_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """Compute the exact one-sided lower confidence bound of a probability from `k` successes in `n` trials.

    For example, 29 successes in 29 trials prove a probability of at least 90 % at 95 % confidence.
    """
    low, _ = clopper_pearson(k, n, 2.0 * confidence - 1.0)  # a two-sided interval with 1 - `confidence` at each end
    return low


def upper_tail(k: int, n: int, p: float = 0.5) -> float:
    """Compute the probability of `k` or more successes in `n` trials that each succeed with probability `p`."""
    from scipy.special import bdtrc

    return float(bdtrc(k - 1, n, p))


def sign_test(k: int, n: int) -> float:
    """Compute the two-sided exact p-value of `k` positive changes out of `n`, if both signs are equally likely.

    It is ``min(1, 2 P(X >= max(k, n-k)))``, where X is binomial with n trials and probability 1/2. Changes of exactly
    zero must not be counted in `n`. Source: Arbuthnot, Phil. Trans. 27 (1710) 186-190; Conover, Practical
    Nonparametric Statistics, 3rd ed. (1999), section 3.4.
    """
    return min(1.0, 2.0 * upper_tail(max(k, n - k), n))


def holm(p: Sequence[float]) -> tuple[float, ...]:
    """Correct several p-values for multiple testing by Holm's method; return them in the same order.

    With p_(j) the j-th smallest of m p-values (j from 0), p_(i) becomes ``max over j <= i of min(1, (m - j) p_(j))``.
    Source: Holm, Scand. J. Statist. 6 (1979) 65-70.
    """
    order = np.argsort(p)
    scaled = (len(p) - np.arange(len(p))) * np.asarray(p)[order]
    corrected = np.empty(len(p))
    corrected[order] = np.maximum.accumulate(np.minimum(1.0, scaled))
    return tuple(corrected.tolist())
