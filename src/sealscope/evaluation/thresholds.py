"""Set the threshold of an alarm from leak-free scores, and state how uncertain the false-alarm probability then is.

The threshold is one of the scores, so that the results are exact for any distribution of the scores.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

#: Relative rounding error of the products from which numbers of records are rounded.
_ROUNDING = 1e-12


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


def records_needed(false_alarm: float) -> int:
    """Compute the smallest number of leak-free records that can set a threshold for a false-alarm probability p.

    It is ``ceil(1/p) - 1``. Source: Wilks, Ann. Math. Stat. 12 (1941) 91-96, doi 10.1214/aoms/1177731788.
    """
    return max(1, math.ceil((1.0 / false_alarm - 1.0) * (1.0 - _ROUNDING)))


def quantile_threshold(scores: Sequence[float], false_alarm: float, confidence: float = 0.95) -> Threshold:
    """Compute the lowest threshold that keeps a false-alarm probability p, from scores of leak-free records.

    `scores` (n,) are high for a leak, with n at least `records_needed`; `false_alarm` is p. The threshold is the
    ``floor(p (n + 1))``-th highest score, which the next leak-free record exceeds with a probability of at most p on
    average over sets of leak-free records (split conformal). This is exact for independent records of any continuous
    distribution. Source: Wilks (1941), doi 10.1214/aoms/1177731788; Vovk, Proc. Mach. Learn. Res. 25 (2012) 475-490,
    proposition 2.
    """
    from scipy.special import betaincinv

    n = len(scores)
    rank = min(n, math.floor(false_alarm * (n + 1) * (1.0 + _ROUNDING)))
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
