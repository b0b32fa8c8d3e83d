"""Set a threshold from leak-free scores, with the distribution of its true false-alarm probability.

The threshold is an order statistic, so that the result is exact for any distribution of the scores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import as_numbers, as_probability

#: `average`: the false-alarm probability is kept on average over sets of leak-free records; `bound`: with confidence.
Promise = Literal["average", "bound"]


@dataclass(frozen=True)
class Threshold:
    """A threshold, the `rank`-th largest of `n` leak-free scores; an alarm is raised if score > `value`.

    The true false-alarm probability is distributed as Beta(`rank`, n + 1 - rank), and smaller with ties. `expected`:
    its mean; (`low`, `high`): its interval at `confidence`; `false_alarm_probability`, `promise`: the requested
    probability and how it is kept.
    """

    value: float
    false_alarm_probability: float
    promise: Promise
    rank: int
    n: int
    expected: float
    low: float
    high: float
    confidence: float


def records_needed(false_alarm: float, confidence: float | None = None) -> int:
    """Compute the smallest number of leak-free records that can set a threshold for a false-alarm probability.

    On average, without `confidence`: ``ceil(1/p) - 1``. As a bound with `confidence`: the smallest n with
    ``1 - (1 - p)^n >= confidence``, such as 299 for 1 % at 95 %. Raises InputError for an impossible probability or
    confidence. Source: Wilks, Ann. Math. Stat. 12 (1941) 91-96, doi 10.1214/aoms/1177731788.
    """
    as_probability(false_alarm, "the false-alarm probability")
    if confidence is None:
        return max(1, math.ceil(1.0 / false_alarm * (1.0 - 1e-12)) - 1)  # 1e-12, here and below: rounding
    ratio = math.log1p(-as_probability(confidence, "confidence")) / math.log1p(-false_alarm)
    return max(1, math.ceil(ratio * (1.0 - 1e-12)))


def _threshold_rank(n: int, false_alarm: float, promise: Promise, confidence: float) -> int:
    """Compute the largest rank, counted from the highest score, that keeps `promise`; 0 if none does.

    `n`: number of leak-free scores; `promise`, `confidence`: as in `quantile_threshold`.
    """
    from scipy.special import betainc

    if promise == "average":
        return min(n, math.floor(false_alarm * (n + 1) * (1.0 + 1e-12)))  # 1e-12, here and below: rounding
    ranks = np.arange(1, n + 1)
    return int(np.count_nonzero(betainc(ranks, n + 1 - ranks, false_alarm) >= confidence * (1.0 - 1e-12)))


def quantile_threshold(
    scores: npt.ArrayLike, false_alarm: float, confidence: float = 0.95, promise: Promise = "average"
) -> Threshold:
    """Compute the lowest threshold that keeps a false-alarm probability, from the scores of leak-free records.

    `scores`: (n,), high for a leak. `promise` "average": rank ``floor(p (n + 1))``, so that the next record's score
    exceeds the threshold with probability <= p (split conformal); "bound": the largest rank whose true probability is
    <= p with probability >= `confidence` (tolerance limit). Exact for independent records of any continuous
    distribution. Raises InputError with the number needed if there are too few records. Source: Wilks (1941), doi
    10.1214/aoms/1177731788; Vovk, Proc. Mach. Learn. Res. 25 (2012) 475-490, proposition 2.
    """
    from scipy.special import betaincinv

    values = as_numbers(scores, "leak-free scores")
    as_probability(false_alarm, "the false-alarm probability")
    as_probability(confidence, "confidence")
    if promise not in ("average", "bound"):
        raise InputError(f"the promise must be 'average' or 'bound', got {promise!r}")
    n = values.size
    rank = _threshold_rank(n, false_alarm, promise, confidence)
    if rank == 0:
        needed = records_needed(false_alarm, confidence if promise == "bound" else None)
        raise InputError(
            f"leak-free records must be at least {needed} for a false-alarm probability of {false_alarm:g}, got {n}"
        )
    tail = (1.0 - confidence) / 2.0
    return Threshold(
        value=float(np.partition(values, n - rank)[n - rank]),
        false_alarm_probability=false_alarm,
        promise=promise,
        rank=rank,
        n=n,
        expected=rank / (n + 1),
        low=float(betaincinv(rank, n + 1 - rank, tail)),
        high=float(betaincinv(rank, n + 1 - rank, 1.0 - tail)),
        confidence=confidence,
    )
