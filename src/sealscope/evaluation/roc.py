"""The receiver operating characteristic of a score, with bands, and the detection that a false-alarm rate buys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Rate, clopper_pearson, rate_of
from sealscope.evaluation.checks import Array, numbers, share

Band = Literal["simultaneous", "pointwise"]


@dataclass(frozen=True)
class Roc:
    """The curve by falling threshold, from (0, 0) to (1, 1), and its band.

    `threshold`, `false_alarm`, `detection` (k,): alarm where score >= threshold; (`low`, `high`) (k,): band of the
    detection at that false-alarm rate (`simultaneous`) or threshold (`pointwise`) at `confidence`.
    """

    threshold: Array
    false_alarm: Array
    detection: Array
    low: Array
    high: Array
    band: Band
    confidence: float


@dataclass(frozen=True)
class Operating:
    """Detection at a false-alarm rate: alarm where score > `threshold`.

    `detection`: at that threshold as if it were known; (`low`, `high`): for the threshold that truly has
    `false_alarm`, at `confidence`, with the error of the threshold in it.
    """

    false_alarm: float
    threshold: float
    detection: Rate
    low: float
    high: float
    confidence: float


@dataclass(frozen=True)
class PartialArea:
    """Area under the curve up to the false-alarm rate `up_to`: `area`, `mean` detection over that range, and
    `standardised` to 0.5 for chance and 1 for perfect; (`low`, `high`): interval of `mean` at `confidence`, nan
    without a generator."""

    up_to: float
    area: float
    mean: float
    standardised: float
    low: float
    high: float
    confidence: float


def _scores(leak_free: npt.ArrayLike, leaky: npt.ArrayLike) -> tuple[Array, Array]:
    return numbers(leak_free, "leak-free scores"), numbers(leaky, "scores with a leak")


def _exceeding(scores: Array, thresholds: Array) -> Array:
    """How many of the scores are >= each threshold."""
    return np.asarray(scores.size - np.searchsorted(np.sort(scores), thresholds, side="left"), dtype=np.float64)


def _corners(leak_free: Array, leaky: Array) -> tuple[Array, Array, Array]:
    thresholds = np.concatenate([[np.inf], np.unique(np.concatenate([leak_free, leaky]))[::-1]])
    return (
        thresholds,
        _exceeding(leak_free, thresholds) / leak_free.size,
        _exceeding(leaky, thresholds) / leaky.size,
    )


def kolmogorov_margin(n: int, confidence: float) -> float:
    """Half width of a band that holds the whole distribution function of n samples: ``sqrt(ln(2/alpha) / (2n))``.

    Holds for every n and every distribution. Source: Massart, Ann. Probab. 18 (1990) 1269-1283, doi
    10.1214/aop/1176990746.
    """
    return math.sqrt(math.log(2.0 / (1.0 - share(confidence, "confidence"))) / (2.0 * n))


def roc_curve(
    leak_free: npt.ArrayLike, leaky: npt.ArrayLike, confidence: float = 0.95, band: Band = "simultaneous"
) -> Roc:
    """The curve of detection over false alarms for a score that is high for leaks, ties kept as slanted steps.

    `simultaneous`: the whole true curve lies in the band: each point moves by the margins d (false alarms) and e
    (detection) of `kolmogorov_margin`, each at sqrt(confidence), and the band is their envelope. `pointwise`:
    Clopper-Pearson's interval of the detection at each threshold. Raises InputError without scores of both kinds.
    Source: Campbell, Stat. Med. 13 (1994) 499-508, doi 10.1002/sim.4780130512.
    """
    a, b = _scores(leak_free, leaky)
    share(confidence, "confidence")
    thresholds, false_alarm, detection = _corners(a, b)
    if band == "pointwise":
        limits = [clopper_pearson(round(k * b.size), b.size, confidence) for k in detection]
        low, high = (np.array(side) for side in zip(*limits, strict=True))
    elif band == "simultaneous":
        d = kolmogorov_margin(a.size, math.sqrt(confidence))
        e = kolmogorov_margin(b.size, math.sqrt(confidence))
        # the sample's point at the true threshold is a corner within d of the true false-alarm rate
        first = np.searchsorted(false_alarm, false_alarm - d, side="left")
        last = np.searchsorted(false_alarm, false_alarm + d, side="right") - 1
        low, high = np.maximum(detection[first] - e, 0.0), np.minimum(detection[last] + e, 1.0)
    else:
        raise InputError(f"the band must be 'simultaneous' or 'pointwise', got {band!r}")
    return Roc(thresholds, false_alarm, detection, low, high, band, confidence)


def detection_at(
    leak_free: npt.ArrayLike, leaky: npt.ArrayLike, false_alarm: float, confidence: float = 0.95
) -> Operating:
    """Detection probability at a false-alarm rate, with the error of the threshold in its interval.

    The threshold is the rank ``floor(rate (n + 1))`` of the leak-free scores (infinite below rank 1: no alarms). The
    threshold of the true rate lies between two leak-free order statistics with confidence 1 - alpha/2 (ranks by the
    binomial distribution), the detection at each of them within Clopper-Pearson's bounds at 1 - alpha/2; together at
    least 1 - alpha (Bonferroni). Raises InputError for an impossible rate. That the threshold's error belongs in:
    Linnet, Stat. Med. 6 (1987) 147-158, doi 10.1002/sim.4780060207.
    """
    from sealscope.evaluation.quantiles import order_ranks

    a, b = _scores(leak_free, leaky)
    share(false_alarm, "the false-alarm rate")
    half = 0.5 + share(confidence, "confidence") / 2.0
    falling = np.concatenate([[np.inf], np.sort(a)[::-1], [-np.inf]])
    rank = math.floor(false_alarm * (a.size + 1) * (1.0 + 1e-12))
    first, last = order_ranks(a.size, false_alarm, half)
    found = [int(np.count_nonzero(b > falling[place])) for place in (first, min(rank, a.size), last)]
    return Operating(
        false_alarm=false_alarm,
        threshold=float(falling[min(rank, a.size)]),
        detection=rate_of(found[1], b.size, confidence),
        low=clopper_pearson(found[0], b.size, half)[0],
        high=clopper_pearson(found[2], b.size, half)[1],
        confidence=confidence,
    )


def _area_up_to(false_alarm: Array, detection: Array, up_to: float) -> float:
    after = int(np.searchsorted(false_alarm, up_to, side="left"))
    before = after - 1
    slope = (detection[after] - detection[before]) / (false_alarm[after] - false_alarm[before])
    x = np.append(false_alarm[:after], up_to)
    y = np.append(detection[:after], detection[before] + slope * (up_to - false_alarm[before]))
    return float(np.sum(np.diff(x) * (y[1:] + y[:-1])) / 2.0)


def partial_auc(
    leak_free: npt.ArrayLike,
    leaky: npt.ArrayLike,
    up_to: float,
    confidence: float = 0.95,
    generator: np.random.Generator | None = None,
    resamples: int = 1000,
) -> PartialArea:
    """Area under the curve over false-alarm rates from 0 to `up_to` (at most 1), straight between its corners.

    ``standardised = (1 + (area - up_to^2/2) / (up_to - up_to^2/2)) / 2``. With a `generator` the interval is the
    percentile bootstrap's, leak-free and leaky records resampled apart. Source: McClish, Med. Decis. Making 9 (1989)
    190-195, doi 10.1177/0272989X8900900307.
    """
    a, b = _scores(leak_free, leaky)
    share(confidence, "confidence")
    if not 0.0 < up_to <= 1.0:
        raise InputError(f"the range of false-alarm rates must end between 0 and 1, got {up_to}")
    area = _area_up_to(*_corners(a, b)[1:], up_to)
    least = up_to * up_to / 2.0
    low = high = math.nan
    if generator is not None:
        drawn = [
            _area_up_to(*_corners(generator.choice(a, a.size), generator.choice(b, b.size))[1:], up_to) / up_to
            for _ in range(resamples)
        ]
        low, high = (float(q) for q in np.quantile(drawn, [(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0]))
    standardised = 0.5 * (1.0 + (area - least) / (up_to - least))
    return PartialArea(up_to, area, area / up_to, standardised, low, high, confidence)
