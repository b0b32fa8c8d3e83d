"""Exact statistics of counts: a rate with its interval, tests of a count, and the correction for testing several."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.errors import InputError
from sealscope.evaluation.checks import share


@dataclass(frozen=True)
class Rate:
    """`count` of `n`: the rate with its interval (`low`, `high`) at `confidence`; nan within 0..1 where n is 0."""

    count: int
    n: int
    rate: float
    low: float
    high: float
    confidence: float

    def __str__(self) -> str:
        return f"{self.rate:.1%} ({self.low:.1%} to {self.high:.1%}, {self.count} of {self.n})"


def _checked(k: int, n: int) -> None:
    if n < 1 or not 0 <= k <= n:
        raise InputError(f"a count must be 0 to n with n >= 1, got {k} of {n}")


def clopper_pearson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval (low, high) of a binomial rate after `k` of `n`; it covers at least as often as it says.

    ``low = B(alpha/2; k, n-k+1), high = B(1-alpha/2; k+1, n-k)``, B the quantile of the beta distribution and alpha =
    1 - confidence; 0 and 1 where k is 0 or n. Raises InputError for an impossible count or confidence. Source:
    Clopper and Pearson, Biometrika 26 (1934) 404-413, doi 10.1093/biomet/26.4.404.
    """
    from scipy.special import betaincinv

    _checked(k, n)
    tail = (1.0 - share(confidence, "confidence")) / 2.0
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1.0 - tail))
    return low, high


def wilson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Score interval (low, high) of a binomial rate: shorter than the exact one, right on average.

    ``(2k + z^2 -+ z sqrt(z^2 + 4k(1 - k/n))) / (2(n + z^2))``. Raises InputError for an impossible count or
    confidence. Source: Wilson, J. Am. Stat. Assoc. 22 (1927) 209-212, doi 10.1080/01621459.1927.10502953.
    """
    from scipy.special import ndtri

    _checked(k, n)
    z = float(ndtri(0.5 + share(confidence, "confidence") / 2.0))
    middle, half = 2.0 * k + z * z, z * math.sqrt(z * z + 4.0 * k * (1.0 - k / n))
    below = 2.0 * (n + z * z)
    low = 0.0 if k == 0 else (middle - half) / below
    high = 1.0 if k == n else (middle + half) / below
    return low, high


def rate_of(
    k: int,
    n: int,
    confidence: float = 0.95,
    interval: Callable[[int, int, float], tuple[float, float]] = clopper_pearson,
) -> Rate:
    """The rate after `k` of `n` with its `interval` (Clopper-Pearson's, or `wilson`); nothing known where n is 0."""
    k, n = int(k), int(n)
    if n == 0 and k == 0:
        return Rate(0, 0, math.nan, 0.0, 1.0, share(confidence, "confidence"))
    low, high = interval(k, n, confidence)
    return Rate(k, n, k / n, low, high, confidence)


def lower_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """One-sided exact lower bound of a binomial rate, ``B(1 - confidence; k, n-k+1)``: 29 of 29 show 90 % at 95 %."""
    from scipy.special import betaincinv

    _checked(k, n)
    return 0.0 if k == 0 else float(betaincinv(k, n - k + 1, 1.0 - share(confidence, "confidence")))


def at_least(k: int, n: int, p: float = 0.5) -> float:
    """Probability of `k` or more successes in `n` trials of probability `p`: ``I_p(k, n-k+1)``, 1 for k = 0.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions (1964), eq. 26.5.24.
    """
    from scipy.special import betainc

    _checked(k, n)
    if not 0.0 <= p <= 1.0:
        raise InputError(f"a probability must be within 0 to 1, got {p}")
    return 1.0 if k == 0 else float(betainc(k, n - k + 1, p))


def sign_test(k: int, n: int) -> float:
    """Two-sided exact p-value of `k` changes one way out of `n` when either way is as likely:
    ``min(1, 2 P(X >= max(k, n-k)))``.

    Changes of exactly zero are to be left out of `n`. Source: Arbuthnot, Phil. Trans. 27 (1710) 186-190; Conover,
    Practical Nonparametric Statistics, 3rd ed. (1999), section 3.4.
    """
    _checked(k, n)
    return min(1.0, 2.0 * at_least(max(k, n - k), n))


def binomial_test(k: int, n: int, p: float) -> float:
    """Two-sided exact p-value of `k` of `n` against the rate `p`: the probability of all counts that are no more
    likely than `k`.

    ``sum of P(X = i) over all i with P(X = i) <= P(X = k)`` (within rounding). Raises InputError for an impossible
    count or rate. Source: Sterne, Biometrika 41 (1954) 275-278, doi 10.1093/biomet/41.1-2.275.
    """
    from scipy.special import gammaln, xlog1py, xlogy

    _checked(k, n)
    if not 0.0 <= p <= 1.0:
        raise InputError(f"a probability must be within 0 to 1, got {p}")
    i = np.arange(n + 1)
    with np.errstate(divide="ignore"):
        log_p = gammaln(n + 1) - gammaln(i + 1) - gammaln(n - i + 1) + xlogy(i, p) + xlog1py(n - i, -p)
    return float(min(1.0, np.exp(log_p[log_p <= log_p[k] + 1e-7]).sum()))


def holm(p: Sequence[float]) -> tuple[float, ...]:
    """p-values corrected for having looked at all of them, in the order given.

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
