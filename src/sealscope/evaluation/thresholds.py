"""A threshold from leak-free scores, with the distribution of the false-alarm probability that it really has.

From as many records as the probability asks for, an order statistic: exact, whatever the scores' distribution. From
fewer, the tail is extrapolated by a normal law of a power of the scores (`predictive_threshold`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import numbers, share

#: `average`: the probability holds on average over calibrations; `bound`: it is held with the stated confidence.
Promise = Literal["average", "bound"]


@dataclass(frozen=True)
class Threshold:
    """Alarm where score > `value`, the `rank`-th largest of `n` leak-free scores.

    The true false-alarm probability is Beta(`rank`, n + 1 - rank) distributed (scores that tie make it smaller):
    `expected` is its mean, (`low`, `high`) its interval at `confidence`; `false_alarm_probability` is what was asked
    for, by which `promise`. `rank` 0: the tail was extrapolated from fewer records than an order statistic needs.
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


#: Fewest leak-free records from which a tail is extrapolated.
FEWEST = 5


@dataclass(frozen=True)
class LevelWander:
    """What is assumed of how far the mean score moves after the calibration, in deviations of its scatter.

    The shift is normal; its deviation has a scaled inverse chi-square prior of `scale` and degrees of `freedom`.
    """

    scale: float
    freedom: float


#: Points of the posterior at which the false-alarm probability is computed, a power of two.
_POINTS = 2**14


def records_needed(false_alarm: float, confidence: float | None = None) -> int:
    """Return the fewest leak-free records for a false-alarm probability.

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
    """Return the largest rank, counted from the largest score, that keeps the promise; 0 where none does."""
    from scipy.special import betainc

    if promise == "average":
        return min(n, math.floor(false_alarm * (n + 1) * (1.0 + 1e-12)))
    ranks = np.arange(1, n + 1)
    return int(np.count_nonzero(betainc(ranks, n + 1 - ranks, false_alarm) >= confidence * (1.0 - 1e-12)))


def quantile_threshold(
    scores: npt.ArrayLike, false_alarm: float, confidence: float = 0.95, promise: Promise = "average"
) -> Threshold:
    """Return the lowest threshold that keeps the false-alarm probability, from the scores of leak-free records.

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


def predictive_threshold(
    scores: npt.ArrayLike,
    false_alarm: float,
    confidence: float = 0.95,
    promise: Promise = "average",
    *,
    power: float = 1.0,
    wander: LevelWander | None = None,
) -> Threshold:
    """Return a threshold from few leak-free scores, by a normal law of `score^power`.

    `scores` (n,), high means leak; n at least `FEWEST`. With the mean m and the variance s^2 of y = score^power, flat
    priors of the mean and of log sigma, the mean and the scatter behind the next record have the posterior

        sigma^2 = (n - 1) s^2 / chi^2_{n-1},   mu = m + sigma z / sqrt(n) + sigma d,

    d the `wander` of the mean (0 without). `average`: the probability ``P(y > t)``, averaged over the posterior, is the
    one asked for; without wander that is ``t = m + s sqrt(1 + 1/n) t_{n-1}(1 - p)``. `bound`: the probability holds
    with the stated `confidence`. Scores under 0 are taken as they are (`power` 1). Raises InputError for too few scores
    and for scores that do not scatter. Source: Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sec. 3.2.
    """
    values = numbers(scores, "leak-free scores")
    share(false_alarm, "the false-alarm probability")
    share(confidence, "confidence")
    n = values.size
    if n < FEWEST:
        raise InputError(f"leak-free records must be at least {FEWEST} to extrapolate the tail of a score, got {n}")
    if values.min() < 0.0:
        power = 1.0
    y = values**power
    m, s = float(y.mean()), float(y.std(ddof=1))
    if not s > 1e-12 * abs(m):
        raise InputError(f"leak-free scores must scatter, got {n} equal to {values[0]:.4g}")
    at, expected, low, high = _standardised(n, false_alarm, confidence, promise, wander)
    value = max(m + s * at, 0.0) ** (1.0 / power) if power != 1.0 else m + s * at
    return Threshold(value, false_alarm, promise, 0, n, expected, low, high, confidence)


@lru_cache(maxsize=1024)
def _standardised(
    n: int, false_alarm: float, confidence: float, promise: Promise, wander: LevelWander | None
) -> tuple[float, float, float, float]:
    """Return (threshold - m)/s, which no score changes, with the mean and the interval of the true probability."""
    from scipy.optimize import brentq
    from scipy.special import ndtr, ndtri

    shift, sigma = _posterior(n, wander)
    if promise == "bound":
        at = float(np.quantile(shift - sigma * ndtri(false_alarm), confidence))
    else:
        span = 10.0 * float(np.max(np.abs(shift) + 10.0 * sigma))
        at = float(brentq(lambda t: float(np.mean(ndtr((shift - t) / sigma))) - false_alarm, -span, span, rtol=1e-10))
    true = ndtr((shift - at) / sigma)
    low, high = np.quantile(true, [(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0])
    return at, float(np.mean(true)), float(low), float(high)


@cache
def _posterior(n: int, wander: LevelWander | None) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return mean and deviation behind the next record at the points of a Sobol sequence, as (y - m)/s."""
    from scipy.special import chdtri, ndtri
    from scipy.stats.qmc import Sobol

    u = Sobol(4, scramble=True, rng=0).random(_POINTS)
    sigma = np.sqrt((n - 1) / chdtri(n - 1, u[:, 0]))
    shift = sigma * ndtri(u[:, 1]) / math.sqrt(n)
    if wander is not None:
        shift += sigma * wander.scale * np.sqrt(wander.freedom / chdtri(wander.freedom, u[:, 2])) * ndtri(u[:, 3])
    return shift, sigma
