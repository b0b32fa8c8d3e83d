"""Set the threshold of an alarm from leak-free scores, and state how uncertain the false-alarm probability then is.

The threshold is one of the scores, so that the results are exact for any distribution of the scores.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

#: How a false-alarm probability is kept. `average`: on average over sets of leak-free records; `bound`: with a stated
#: confidence in each set.
Promise = Literal["average", "bound"]


@dataclass(frozen=True)
class Threshold:
    """A threshold set from leak-free scores; an alarm is raised if the score exceeds `value`.

    - `false_alarm_probability`: the requested one
    - `rank`, `n`: the threshold is the `rank`-th largest of `n` leak-free scores
    - `expected`, `low`, `high`: mean of the true false-alarm probability, and its confidence interval. The true
      probability is distributed as Beta(rank, n + 1 - rank), and is smaller if scores are equal.
    """

    value: float
    false_alarm_probability: float
    rank: int
    n: int
    expected: float
    low: float
    high: float


def records_needed(false_alarm: float, confidence: float = 0.95, promise: Promise = "average") -> int:
    """Compute the smallest number of leak-free records that can set a threshold for a false-alarm probability p.

    A threshold that keeps p on average needs ``ceil(1/p) - 1`` records. One that keeps p with the probability
    `confidence` ("bound") needs n with ``1 - (1 - p)^n >= confidence``, for example 299 for 1 % at 95 %. Source: Wilks,
    Ann. Math. Stat. 12 (1941) 91-96, doi 10.1214/aoms/1177731788.
    """
    n = 1.0 / false_alarm - 1.0 if promise == "average" else math.log1p(-confidence) / math.log1p(-false_alarm)
    return max(1, math.ceil(n * (1.0 - 1e-12)))  # 1e-12: rounding errors


def _threshold_rank(n: int, false_alarm: float, promise: Promise, confidence: float) -> int:
    """Find which of `n` leak-free scores is the lowest possible threshold; return its rank, 1 for the highest score.

    With the score of rank r as the threshold, the true false-alarm probability is distributed as Beta(r, n + 1 - r).
    The result is the largest r <= n whose mean r/(n + 1) is at most `false_alarm` ("average"), or with which the true
    probability is at most `false_alarm` with at least the probability `confidence` ("bound"); 0 if `n` is too small.
    """
    from scipy.special import betainc

    if promise == "average":
        return min(n, math.floor(false_alarm * (n + 1) * (1.0 + 1e-12)))  # 1e-12, here and below: for rounding errors
    ranks = np.arange(1, n + 1)
    p_kept = betainc(ranks, n + 1 - ranks, false_alarm)  # falls with the rank: the count is the largest such rank
    return int(np.count_nonzero(p_kept >= confidence * (1.0 - 1e-12)))


def quantile_threshold(
    scores: Sequence[float], false_alarm: float, confidence: float = 0.95, promise: Promise = "average"
) -> Threshold:
    """Compute the lowest threshold that keeps a false-alarm probability p, from scores of leak-free records.

    `scores` (n,) are high for a leak, with n at least `records_needed`; `false_alarm` is p. With the promise "average",
    the threshold is the ``floor(p (n + 1))``-th highest score, which the next leak-free record exceeds with a
    probability of at most p (split conformal). With "bound", it is the lowest score whose true false-alarm probability
    is at most p with the probability `confidence` (tolerance limit). Both are exact for independent records of any
    continuous distribution. Source: Wilks (1941), doi 10.1214/aoms/1177731788; Vovk, Proc. Mach. Learn. Res. 25 (2012)
    475-490, proposition 2.
    """
    from scipy.special import betaincinv

    n = len(scores)
    rank = _threshold_rank(n, false_alarm, promise, confidence)
    tail = (1.0 - confidence) / 2.0
    return Threshold(
        value=float(sorted(scores)[-rank]),
        false_alarm_probability=false_alarm,
        rank=rank,
        n=n,
        expected=rank / (n + 1),
        low=float(betaincinv(rank, n + 1 - rank, tail)),
        high=float(betaincinv(rank, n + 1 - rank, 1.0 - tail)),
    )
