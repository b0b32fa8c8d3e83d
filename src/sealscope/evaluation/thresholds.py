"""A threshold from leak-free scores, with the exact distribution of the false-alarm rate that it really has."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import Array, numbers, share

#: `average`: the rate holds on average over calibrations; `bound`: it is held with the stated confidence.
Promise = Literal["average", "bound"]


@dataclass(frozen=True)
class Threshold:
    """Alarm where score > `value`, the `rank`-th largest of `n` leak-free scores.

    The true false-alarm rate is Beta(`rank`, n + 1 - rank) distributed (scores that tie make it smaller): `expected`
    is its mean, (`low`, `high`) its interval at `confidence`; `rate` is what was asked for, by which `promise`.
    """

    value: float
    rate: float
    promise: Promise
    rank: int
    n: int
    expected: float
    low: float
    high: float
    confidence: float

    def probability_at_most(self, rate: float) -> float:
        """Probability that the true false-alarm rate is at most `rate`: ``I_rate(rank, n + 1 - rank)``."""
        from scipy.special import betainc

        if not 0.0 <= rate <= 1.0:
            raise InputError(f"a false-alarm rate must be within 0 to 1, got {rate}")
        return float(betainc(self.rank, self.n + 1 - self.rank, rate))


@dataclass(frozen=True)
class GroupThresholds:
    """A threshold for each group (an operating point), and the groups that are `too_few`: how many records they have.

    `needed`: records that a group needs; `expected`: mean false-alarm rate over the groups with a threshold, each
    weighted by its number of records.
    """

    thresholds: Mapping[Hashable, Threshold]
    too_few: Mapping[Hashable, int]
    needed: int
    expected: float


def records_needed(rate: float, confidence: float | None = None, rank: int = 1) -> int:
    """Fewest leak-free records for a false-alarm `rate`.

    Without `confidence` on average: ``ceil(rank/rate) - 1``. With it, the fewest n with ``I_rate(rank, n + 1 - rank)
    >= confidence``; for rank 1 ``ln(1 - confidence)/ln(1 - rate)``, 299 for 1 % at 95 %. Raises InputError for an
    impossible rate or confidence. Source: Wilks, Ann. Math. Stat. 12 (1941) 91-96, doi 10.1214/aoms/1177731788.
    """
    from scipy.special import betainc

    share(rate, "the false-alarm rate")
    if rank < 1:
        raise InputError(f"the rank must be >= 1, got {rank}")
    fewest = max(rank, math.ceil(rank / rate * (1.0 - 1e-12)) - 1)
    if confidence is None:
        return fewest
    share(confidence, "confidence")
    low, high = rank - 1, max(fewest, rank)
    while betainc(rank, high + 1 - rank, rate) < confidence:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if betainc(rank, middle + 1 - rank, rate) >= confidence else (middle, high)
    return high


def _rank(n: int, rate: float, promise: Promise, confidence: float) -> int:
    """The largest rank, counted from the largest score, that keeps the promise; 0 where none does."""
    from scipy.special import betainc

    largest = min(n, math.floor(rate * (n + 1) * (1.0 + 1e-12)))
    if promise == "average" or largest == 0:
        return largest
    ranks = np.arange(1, largest + 1)
    return int(np.count_nonzero(betainc(ranks, n + 1 - ranks, rate) >= confidence))


def quantile_threshold(
    scores: npt.ArrayLike, rate: float, confidence: float = 0.95, promise: Promise = "average"
) -> Threshold:
    """The lowest threshold that keeps the false-alarm `rate`, from the scores of leak-free records.

    `scores` (n,), high means leak. `average`: rank ``floor(rate (n + 1))``, so that the next record's score exceeds
    it with probability <= rate (split conformal). `bound`: the largest rank whose true rate is <= `rate` with
    probability >= `confidence` (a tolerance limit). Exact for any continuous distribution of independent records.
    Raises InputError where the records are too few, saying how many are needed. Source: Wilks (1941), doi
    10.1214/aoms/1177731788; Vovk, Proc. Mach. Learn. Res. 25 (2012) 475-490, proposition 2.
    """
    from scipy.special import betaincinv

    values = numbers(scores, "leak-free scores")
    share(rate, "the false-alarm rate")
    share(confidence, "confidence")
    if promise not in ("average", "bound"):
        raise InputError(f"the promise must be 'average' or 'bound', got {promise!r}")
    n = values.size
    rank = _rank(n, rate, promise, confidence)
    if rank == 0:
        needed = records_needed(rate, confidence if promise == "bound" else None)
        raise InputError(f"leak-free records must be at least {needed} for a false-alarm rate of {rate:g}, got {n}")
    tail = (1.0 - confidence) / 2.0
    return Threshold(
        value=float(np.partition(values, n - rank)[n - rank]),
        rate=rate,
        promise=promise,
        rank=rank,
        n=n,
        expected=rank / (n + 1),
        low=float(betaincinv(rank, n + 1 - rank, tail)),
        high=float(betaincinv(rank, n + 1 - rank, 1.0 - tail)),
        confidence=confidence,
    )


def group_thresholds(
    scores: npt.ArrayLike,
    groups: Sequence[Hashable],
    rate: float,
    confidence: float = 0.95,
    promise: Promise = "average",
) -> GroupThresholds:
    """A threshold of its own for each group of leak-free records; groups with too few records get none.

    Raises InputError where every group has too few. Source: as `quantile_threshold`; by group Vovk (2012).
    """
    values = numbers(scores, "leak-free scores")
    if len(groups) != values.size:
        raise InputError(f"groups must be as many as the scores, got {len(groups)} for {values.size}")
    members: dict[Hashable, list[int]] = {}
    for place, group in enumerate(groups):
        members.setdefault(group, []).append(place)
    needed = records_needed(rate, confidence if promise == "bound" else None)
    few = {group: len(places) for group, places in members.items() if len(places) < needed}
    found = {
        group: quantile_threshold(values[places], rate, confidence, promise)
        for group, places in members.items()
        if group not in few
    }
    if not found:
        most = max(few.values())
        raise InputError(f"leak-free records must be at least {needed} in a group for {rate:g}, got at most {most}")
    total = sum(one.n for one in found.values())
    return GroupThresholds(found, few, needed, sum(one.expected * one.n for one in found.values()) / total)


def conformal_p(leak_free: npt.ArrayLike, scores: npt.ArrayLike) -> Array:
    """Probability, for each score, that a leak-free record scores as high: ``(1 + #(leak_free >= score)) / (n + 1)``.

    `leak_free` (n,), `scores` (m,); returns (m,) p-values, at most `rate` with probability <= rate on leak-free
    records. Source: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World (2005), eq. 2.19.
    """
    known = np.sort(numbers(leak_free, "leak-free scores"))
    above = known.size - np.searchsorted(known, numbers(scores, "scores"), side="left")
    return np.asarray((1.0 + above) / (known.size + 1.0), dtype=np.float64)
