"""Exact statistics of counts: a proportion with its interval, tests of a count, and a correction for several tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sealscope.errors import InputError
from sealscope.evaluation.checks import share


@dataclass(frozen=True)
class IntervalEstimate:
    """A `value` from `n` observations with its confidence interval (`low`, `high`); infinite ends bound nothing."""

    n: int
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Proportion(IntervalEstimate):
    """`count` of `n`: the proportion with its interval; the value is nan, within 0..1, where n is 0."""

    count: int


def _checked(k: int, n: int) -> None:
    if n < 1 or not 0 <= k <= n:
        raise InputError(f"a count must be 0 to n with n >= 1, got {k} of {n}")


def clopper_pearson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the exact interval (low, high) of a binomial probability after `k` of `n`.

    It covers at least as often as it says: ``low = B(alpha/2; k, n-k+1), high = B(1-alpha/2; k+1, n-k)``, B the
    quantile of the beta distribution and alpha = 1 - confidence; 0 and 1 where k is 0 or n. Raises InputError for an
    impossible count or confidence. Source: Clopper and Pearson, Biometrika 26 (1934) 404-413, doi
    10.1093/biomet/26.4.404.
    """
    from scipy.special import betaincinv

    _checked(k, n)
    tail = (1.0 - share(confidence, "confidence")) / 2.0
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1.0 - tail))
    return low, high


def proportion(k: int, n: int, confidence: float = 0.95) -> Proportion:
    """Compute the proportion `k` of `n` with its Clopper-Pearson interval; from 0 to 1 where n is 0."""
    k, n = int(k), int(n)
    share(confidence, "confidence")
    if n == 0 and k == 0:
        return Proportion(0, math.nan, 0.0, 1.0, 0)
    low, high = clopper_pearson(k, n, confidence)
    return Proportion(n, k / n, low, high, k)


def lower_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """Compute the one-sided exact lower bound of a binomial probability, ``B(1 - confidence; k, n-k+1)``.

    29 of 29 show 90 % at 95 %.
    """
    from scipy.special import betaincinv

    _checked(k, n)
    return 0.0 if k == 0 else float(betaincinv(k, n - k + 1, 1.0 - share(confidence, "confidence")))


def at_least(k: int, n: int, p: float = 0.5) -> float:
    """Compute the probability of `k` or more successes in `n` trials of probability `p`.

    ``I_p(k, n-k+1)``, 1 for k = 0.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions (1964), eq. 26.5.24.
    """
    from scipy.special import betainc

    _checked(k, n)
    if not 0.0 <= p <= 1.0:
        raise InputError(f"a probability must be within 0 to 1, got {p}")
    return 1.0 if k == 0 else float(betainc(k, n - k + 1, p))


def sign_test(k: int, n: int) -> float:
    """Compute the two-sided exact p-value of `k` changes one way out of `n` where either way is as likely.

    ``min(1, 2 P(X >= max(k, n-k)))``. Changes of exactly zero are to be left out of `n`. Source: Arbuthnot, Phil.
    Trans. 27 (1710) 186-190; Conover, Practical Nonparametric Statistics, 3rd ed. (1999), section 3.4.
    """
    _checked(k, n)
    return min(1.0, 2.0 * at_least(max(k, n - k), n))


def holm(p: Sequence[float]) -> tuple[float, ...]:
    """Correct p-values for their number, in the order given.

    The i-th smallest of m (i from 0) becomes ``max over j <= i of min(1, (m - j) p_(j))``. Raises InputError for a
    value outside 0..1. Source: Holm, Scand. J. Statist. 6 (1979) 65-70.
    """
    for value in p:
        if not 0.0 <= value <= 1.0:
            raise InputError(f"a p-value must be within 0 to 1, got {value}")
    corrected = [0.0] * len(p)
    largest = 0.0
    for i, place in enumerate(sorted(range(len(p)), key=lambda k: p[k])):
        largest = max(largest, min(1.0, (len(p) - i) * p[place]))
        corrected[place] = largest
    return tuple(corrected)
