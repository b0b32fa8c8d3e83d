"""Compute the receiver operating characteristic (ROC) of a score with a confidence band, and the area under it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.recordings.channels import Array


@dataclass(frozen=True)
class Roc:
    """The ROC curve, from (0, 0) to (1, 1) in the order of falling thresholds, with a confidence band.

    At each of the k thresholds, `false_alarm` and `detection` (k,) are the fractions of the leak-free and of the leaky
    scores that reach it and raise an alarm; `low` and `high` (k,) are the ends of the band, which is simultaneous.
    """

    false_alarm: Array
    detection: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Area:
    """Area under the ROC curve, P(leaky score > leak-free score) + P(equal)/2, with its confidence interval."""

    value: float
    low: float
    high: float


def _alarm_fractions(scores: Array, thresholds: Array) -> Array:
    """Compute for each of `thresholds` (k,) the fraction of `scores` (n,) that reach or exceed it."""
    return np.asarray((scores.size - np.searchsorted(np.sort(scores), thresholds)) / scores.size)


def kolmogorov_margin(n: int, confidence: float) -> float:
    """Compute the half width of a confidence band around the empirical distribution of `n` samples.

    It is ``sqrt(ln(2/alpha) / (2n))`` with alpha = 1 - confidence. The band contains the whole true distribution with
    at least the probability `confidence`. Source: Massart, Ann. Probab. 18 (1990) 1269-1283, doi
    10.1214/aop/1176990746.
    """
    return math.sqrt(math.log(2.0 / (1.0 - confidence)) / (2.0 * n))


def roc_curve(leak_free: npt.ArrayLike, leaky: npt.ArrayLike, confidence: float = 0.95) -> Roc:
    """Compute the ROC curve of a score that is high for leaks, from the scores of leak-free and of leaky records.

    If scores of both groups are equal, the curve has a slanted step there. The confidence band contains the whole true
    curve with at least the probability `confidence`: at each point it reaches from the lowest detection minus e to the
    highest detection plus e among the points of the curve whose false alarms differ by at most d. Here d and e are the
    `kolmogorov_margin` of the leak-free and of the leaky scores at the confidence sqrt(`confidence`). Source: Campbell,
    Stat. Med. 13 (1994) 499-508, doi 10.1002/sim.4780130512.
    """
    a, b = np.asarray(leak_free, dtype=np.float64), np.asarray(leaky, dtype=np.float64)
    falling_scores = np.unique(np.concatenate([a, b]))[::-1]
    thresholds = np.concatenate([[np.inf], falling_scores])  # inf: no alarms, the point (0, 0)
    false_alarm, detection = _alarm_fractions(a, thresholds), _alarm_fractions(b, thresholds)
    d, e = (kolmogorov_margin(scores.size, math.sqrt(confidence)) for scores in (a, b))
    # first and last point of the curve whose false-alarm fraction is within d of the point's own
    first = np.searchsorted(false_alarm, false_alarm - d, side="left")
    last = np.searchsorted(false_alarm, false_alarm + d, side="right") - 1
    low, high = np.maximum(detection[first] - e, 0.0), np.minimum(detection[last] + e, 1.0)
    return Roc(false_alarm, detection, low, high)


def placements(leak_free: Array, leaky: Array) -> tuple[Array, Array]:
    """Compute for each score the fraction of correctly ordered pairs that it forms with the other group's scores.

    The leaky score of a pair should be the higher one; equal scores count half. Returns the fractions for the leak-free
    scores (n,) and for the leaky scores (m,).
    """
    a, b = np.sort(leak_free), np.sort(leaky)
    # "left" counts smaller scores, "right" smaller and equal ones: their mean counts equal scores half
    a_below = (np.searchsorted(a, leaky, "left") + np.searchsorted(a, leaky, "right")) / (2.0 * a.size)
    b_above = 1.0 - (np.searchsorted(b, leak_free, "left") + np.searchsorted(b, leak_free, "right")) / (2.0 * b.size)
    return np.asarray(b_above, dtype=np.float64), np.asarray(a_below, dtype=np.float64)


def _newcombe_interval(value: float, n: int, m: int, z: float) -> tuple[float, float]:
    """Compute Newcombe's confidence interval (low, high) of an area A = `value` under the ROC curve.

    Its ends are the solutions t of ``|t - A| = z SE(t)``, with Hanley and McNeil's standard error ``SE(t)^2 = t (1 - t)
    (1 + (N - 1) q)/(n m)``, where ``q = (1 - t)/(2 - t) + t/(1 + t)`` and N is the mean of the numbers n and m of
    leak-free and of leaky scores; `z`: normal quantile of the confidence. The interval has a width even if A is 0 or 1.
    Source: Newcombe, Stat. Med. 25 (2006) 559-573, doi 10.1002/sim.2324, method 5.
    """
    from scipy.optimize import brentq

    mean_number = (n + m) / 2.0

    def excess(t: float) -> float:
        """Compute (t - A)^2 - (z SE(t))^2 for an area t, which is 0 at the ends of the interval."""
        q = (1.0 - t) / (2.0 - t) + t / (1.0 + t)
        return (t - value) ** 2 - z * z * t * (1.0 - t) * (1.0 + (mean_number - 1.0) * q) / (n * m)

    # each search ends 1e-9 short of A, where the excess is negative; at A itself it is 0 if A is 0 or 1
    low = brentq(excess, 0.0, value * (1.0 - 1e-9)) if value > 0.0 else 0.0
    high = brentq(excess, value + (1.0 - value) * 1e-9, 1.0) if value < 1.0 else 1.0
    return float(low), float(high)


def auc(leak_free: npt.ArrayLike, leaky: npt.ArrayLike, confidence: float = 0.95) -> Area:
    """Compute the area under the ROC curve with a confidence interval.

    With scores a (n,) of leak-free and b (m,) of leaky records, high for leaks, the area is ``sum of (b > a) + (b =
    a)/2`` over all pairs, divided by n m; n and m are at least 2. The interval is DeLong's normal approximation, cut
    off at 0 and 1, or Newcombe's if DeLong's has no width (scores completely separated or all equal). Source: DeLong,
    DeLong and Clarke-Pearson, Biometrics 44 (1988) 837-845, doi 10.2307/2531595, eq. (5)-(8).
    """
    from scipy.special import ndtri

    leak_free_fractions, leaky_fractions = placements(np.asarray(leak_free), np.asarray(leaky))
    z = float(ndtri(0.5 + confidence / 2.0))
    value = float(leaky_fractions.mean())
    variances = (fractions.var(ddof=1) / fractions.size for fractions in (leak_free_fractions, leaky_fractions))
    standard_error = math.sqrt(sum(variances))
    if standard_error < 1e-12:  # 0 up to rounding
        return Area(value, *_newcombe_interval(value, leak_free_fractions.size, leaky_fractions.size, z))
    return Area(value, max(0.0, value - z * standard_error), min(1.0, value + z * standard_error))
