"""The receiver operating characteristic of a score with its band, and the area under it with its interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import Array, numbers, share


@dataclass(frozen=True)
class Roc:
    """The curve by falling threshold, from (0, 0) to (1, 1), and its band.

    `threshold`, `false_alarm`, `detection` (k,): alarm where score >= threshold; (`low`, `high`) (k,): simultaneous
    band of the detection at that false-alarm probability.
    """

    threshold: Array
    false_alarm: Array
    detection: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Area:
    """Area under the curve `value` = P(leaky score > leak-free score) + half of the ties.

    `standard_error` is 0 where the sample shows none; (`low`, `high`): interval by `method`.
    """

    value: float
    standard_error: float
    low: float
    high: float
    method: Literal["delong", "newcombe"]


def _scores(leak_free: npt.ArrayLike, leaky: npt.ArrayLike) -> tuple[Array, Array]:
    return numbers(leak_free, "leak-free scores"), numbers(leaky, "scores with a leak")


def _exceeding(scores: Array, thresholds: Array) -> Array:
    """Count the scores that are >= each threshold."""
    return np.asarray(scores.size - np.searchsorted(np.sort(scores), thresholds, side="left"), dtype=np.float64)


def kolmogorov_margin(n: int, confidence: float) -> float:
    """Compute the half width of a band that holds the whole distribution function of n samples.

    ``sqrt(ln(2/alpha) / (2n))``, for every n and every distribution. Source: Massart, Ann. Probab. 18 (1990)
    1269-1283, doi 10.1214/aop/1176990746.
    """
    return math.sqrt(math.log(2.0 / (1.0 - share(confidence, "confidence"))) / (2.0 * n))


def roc_curve(leak_free: npt.ArrayLike, leaky: npt.ArrayLike, confidence: float = 0.95) -> Roc:
    """Compute detection over false alarms for a score that is high for leaks, ties as slanted steps.

    The whole true curve lies in the band: each point moves by the margins d (false alarms) and e (detection) of
    `kolmogorov_margin`, each at sqrt(confidence), and the band is their envelope. Raises InputError without scores of
    both kinds. Source: Campbell, Stat. Med. 13 (1994) 499-508, doi 10.1002/sim.4780130512.
    """
    a, b = _scores(leak_free, leaky)
    share(confidence, "confidence")
    thresholds = np.concatenate([[np.inf], np.unique(np.concatenate([a, b]))[::-1]])
    false_alarm, detection = _exceeding(a, thresholds) / a.size, _exceeding(b, thresholds) / b.size
    d, e = (kolmogorov_margin(scores.size, math.sqrt(confidence)) for scores in (a, b))
    # the sample's point at the true threshold is a corner within d of the true false-alarm probability
    first = np.searchsorted(false_alarm, false_alarm - d, side="left")
    last = np.searchsorted(false_alarm, false_alarm + d, side="right") - 1
    low, high = np.maximum(detection[first] - e, 0.0), np.minimum(detection[last] + e, 1.0)
    return Roc(thresholds, false_alarm, detection, low, high)


def placements(leak_free: Array, leaky: Array) -> tuple[Array, Array]:
    """Compute the share of the other kind's scores on the right side of each score, ties half: (n,), (m,)."""
    a, b = np.sort(leak_free), np.sort(leaky)
    below = (np.searchsorted(a, leaky, "left") + np.searchsorted(a, leaky, "right")) / (2.0 * a.size)
    above = 1.0 - (np.searchsorted(b, leak_free, "left") + np.searchsorted(b, leak_free, "right")) / (2.0 * b.size)
    return np.asarray(above, dtype=np.float64), np.asarray(below, dtype=np.float64)


def _newcombe(value: float, leak_free: int, leaky: int, z: float) -> tuple[float, float]:
    """Find the limits t with ``|t - A| = z SE(t)``, which keep a width where A is 1.

    SE as Hanley and McNeil's with both numbers at their mean. Source: Newcombe, Stat. Med. 25 (2006) 559-573, doi
    10.1002/sim.2324, method 5.
    """
    from scipy.optimize import brentq

    middle = (leak_free + leaky) / 2.0

    def excess(t: float) -> float:
        q = (1.0 - t) / (2.0 - t) + t / (1.0 + t)
        return (t - value) ** 2 - z * z * t * (1.0 - t) * (1.0 + (middle - 1.0) * q) / (leak_free * leaky)

    low = brentq(excess, 0.0, value * (1.0 - 1e-9)) if value > 0.0 else 0.0
    high = brentq(excess, value + (1.0 - value) * 1e-9, 1.0) if value < 1.0 else 1.0
    return float(low), float(high)


def auc(leak_free: npt.ArrayLike, leaky: npt.ArrayLike, confidence: float = 0.95) -> Area:
    """Compute the area under the curve, ``sum of (b > a) + (b = a)/2`` over all pairs / (n m).

    `leak_free` (n,), `leaky` (m,) scores, high for leaks. The interval is DeLong's, distribution-free, normal and cut
    at 0 and 1; where all scores are apart that has no width and Newcombe's is given instead, as `method` says. Raises
    InputError for fewer than 2 records of a kind. Source: DeLong, DeLong and Clarke-Pearson, Biometrics 44 (1988)
    837-845, doi 10.2307/2531595, eq. (5)-(8).
    """
    from scipy.special import ndtri

    a, b = _scores(leak_free, leaky)
    z = float(ndtri(0.5 + share(confidence, "confidence") / 2.0))
    n = min(a.size, b.size)
    if n < 2:
        raise InputError(f"an interval of the area needs at least 2 records of each kind, got {n}")
    sides = placements(a, b)
    value = float(sides[1].mean())
    error = math.sqrt(sum(side.var(ddof=1) / side.size for side in sides))
    if error < 1e-12:
        return Area(value, error, *_newcombe(value, a.size, b.size, z), "newcombe")
    return Area(value, error, max(0.0, value - z * error), min(1.0, value + z * error), "delong")
