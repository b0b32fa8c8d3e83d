"""A threshold from leak-free scores, with the distribution of its true false-alarm probability.

An order statistic: exact, whatever the scores' distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import numbers, share

#: `average`: the probability holds on average over sets of leak-free records; `bound`: with the stated confidence.
Promise = Literal["average", "bound"]


@dataclass(frozen=True)
class Threshold:
    """Alarm where score > `value`, the `rank`-th largest of `n` leak-free scores.

    The true false-alarm probability is Beta(`rank`, n + 1 - rank) distributed (scores that tie make it smaller):
    `expected` is its mean, (`low`, `high`) its interval at `confidence`; `false_alarm_probability` is what was asked
    for, by which `promise`.
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
    """Compute the fewest leak-free records for a false-alarm probability.

    Without `confidence` on average: ``ceil(1/p) - 1``. With it, the fewest n with ``1 - (1 - p)^n >= confidence``, 299
    for 1 % at 95 %. Raises InputError for an impossible probability or confidence. Source: Wilks, Ann. Math. Stat. 12
    (1941) 91-96, doi 10.1214/aoms/1177731788.
    """
    share(false_alarm, "the false-alarm probability")
    if confidence is None:
        return max(1, math.ceil(1.0 / false_alarm * (1.0 - 1e-12)) - 1)
    ratio = math.log1p(-share(confidence, "confidence")) / math.log1p(-false_alarm)
    return max(1, math.ceil(ratio * (1.0 - 1e-12)))


def _rank(n: int, false_alarm: float, promise: Promise, confidence: float) -> int:
    """Find the largest rank, counted from the largest score, that keeps the promise; 0 where none does."""
    from scipy.special import betainc

    if promise == "average":
        return min(n, math.floor(false_alarm * (n + 1) * (1.0 + 1e-12)))
    ranks = np.arange(1, n + 1)
    return int(np.count_nonzero(betainc(ranks, n + 1 - ranks, false_alarm) >= confidence * (1.0 - 1e-12)))


def quantile_threshold(
    scores: npt.ArrayLike, false_alarm: float, confidence: float = 0.95, promise: Promise = "average"
) -> Threshold:
    """Find the lowest threshold that keeps the false-alarm probability, from the scores of leak-free records.

    `scores` (n,), high means leak. `average`: rank ``floor(p (n + 1))``, so that the next record's score exceeds it
    with probability <= p (split conformal). `bound`: the largest rank whose true probability is <= p with probability
    >= `confidence` (a tolerance limit). Exact for any continuous distribution of independent records. Raises
    InputError where the records are too few, saying how many are needed. Source: Wilks (1941), doi
    10.1214/aoms/1177731788; Vovk, Proc. Mach. Learn. Res. 25 (2012) 475-490, proposition 2.
    """
    from scipy.special import betaincinv

    values = numbers(scores, "leak-free scores")
    share(false_alarm, "the false-alarm probability")
    share(confidence, "confidence")
    if promise not in ("average", "bound"):
        raise InputError(f"the promise must be 'average' or 'bound', got {promise!r}")
    n = values.size
    rank = _rank(n, false_alarm, promise, confidence)
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
