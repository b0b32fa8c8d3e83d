"""The area under the receiver operating characteristic, its intervals, and the comparison of detectors by it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import Array, numbers, share

Method = Literal["delong", "hanley-mcneil", "newcombe"]


@dataclass(frozen=True)
class Area:
    """Area under the curve `value` = P(leaky score > leak-free score) + half of the ties, its `standard_error` (0
    where the sample shows none) and interval (`low`, `high`) at `confidence` by `method`."""

    value: float
    standard_error: float
    low: float
    high: float
    method: Method
    confidence: float


@dataclass(frozen=True)
class AreaDifference:
    """`value`: first detector's area less the second's on the same records, its `standard_error`, interval (`low`,
    `high`) at `confidence` and two-sided `p`-value of no difference."""

    value: float
    standard_error: float
    low: float
    high: float
    p: float
    confidence: float


def _placements(leak_free: Array, leaky: Array) -> tuple[Array, Array]:
    """Share of the other kind's scores on the right side of each score, ties half: (n leak-free), (m leaky)."""
    a, b = np.sort(leak_free), np.sort(leaky)
    below = (np.searchsorted(a, leaky, "left") + np.searchsorted(a, leaky, "right")) / (2.0 * a.size)
    above = 1.0 - (np.searchsorted(b, leak_free, "left") + np.searchsorted(b, leak_free, "right")) / (2.0 * b.size)
    return np.asarray(above, dtype=np.float64), np.asarray(below, dtype=np.float64)


def _covariance(placements: list[tuple[Array, Array]]) -> Array:
    """Covariance (k, k) of the areas of k detectors from their placements: eq. (5)-(8) of DeLong et al."""
    sides = []
    for side in (0, 1):
        rows = np.stack([pair[side] for pair in placements])
        n = rows.shape[1]
        if n < 2:
            raise InputError(f"an interval of the area needs at least 2 records of each kind, got {n}")
        centred = rows - rows.mean(axis=1, keepdims=True)
        sides.append(centred @ centred.T / (n - 1) / n)
    return np.asarray(sides[0] + sides[1], dtype=np.float64)


def hanley_mcneil_error(value: float, leak_free: int, leaky: int) -> float:
    """Standard error of an area when the scores are about exponential.

    ``sqrt((A(1-A) + (m-1)(Q1 - A^2) + (n-1)(Q2 - A^2)) / (m n))``, ``Q1 = A/(2-A)``, ``Q2 = 2A^2/(1+A)``, m leaky and
    n leak-free records. Source: Hanley and McNeil, Radiology 143 (1982) 29-36, doi
    10.1148/radiology.143.1.7063747, eq. (2).
    """
    q1, q2 = value / (2.0 - value), 2.0 * value**2 / (1.0 + value)
    spread = value * (1.0 - value) + (leaky - 1) * (q1 - value**2) + (leak_free - 1) * (q2 - value**2)
    return math.sqrt(max(spread, 0.0) / (leaky * leak_free))


def _newcombe(value: float, leak_free: int, leaky: int, z: float) -> tuple[float, float]:
    """Limits t with ``|t - A| = z SE(t)``, SE as Hanley and McNeil's with both numbers at their mean; they keep a
    width where A is 1. Source: Newcombe, Stat. Med. 25 (2006) 559-573, doi 10.1002/sim.2324, method 5."""
    middle = (leak_free + leaky) / 2.0

    def outside(t: float) -> bool:
        q = (1.0 - t) / (2.0 - t) + t / (1.0 + t)
        return (t - value) ** 2 > z * z * t * (1.0 - t) * (1.0 + (middle - 1.0) * q) / (leak_free * leaky)

    limits = []
    for end in (0.0, 1.0):
        inner, outer = value, end
        for _ in range(60):
            half = 0.5 * (inner + outer)
            inner, outer = (inner, half) if outside(half) else (half, outer)
        limits.append(inner)
    return limits[0], limits[1]


def auc(leak_free: npt.ArrayLike, leaky: npt.ArrayLike, confidence: float = 0.95, method: Method = "delong") -> Area:
    """Area under the curve of a score that is high for leaks, ``sum of (b > a) + (b = a)/2`` over all pairs / (n m).

    `leak_free` (n,), `leaky` (m,). `delong`: distribution-free normal interval, cut at 0 and 1; where all scores are
    apart it has no width and Newcombe's is given instead, `method` saying so. `hanley-mcneil`: normal interval with
    their error. Raises InputError for fewer than 2 records of a kind. Source: DeLong, DeLong and Clarke-Pearson,
    Biometrics 44 (1988) 837-845, doi 10.2307/2531595.
    """
    from scipy.special import ndtri

    a, b = numbers(leak_free, "leak-free scores"), numbers(leaky, "scores with a leak")
    z = float(ndtri(0.5 + share(confidence, "confidence") / 2.0))
    placements = _placements(a, b)
    value = float(placements[1].mean())
    error = math.sqrt(max(float(_covariance([placements])[0, 0]), 0.0))
    if method not in ("delong", "hanley-mcneil", "newcombe"):
        raise InputError(f"the method must be 'delong', 'hanley-mcneil' or 'newcombe', got {method!r}")
    if method == "newcombe" or (method == "delong" and error < 1e-12):
        return Area(value, error, *_newcombe(value, a.size, b.size, z), "newcombe", confidence)
    if method == "hanley-mcneil":
        error = hanley_mcneil_error(value, a.size, b.size)
    return Area(value, error, max(0.0, value - z * error), min(1.0, value + z * error), method, confidence)


def auc_difference(
    first: tuple[npt.ArrayLike, npt.ArrayLike],
    second: tuple[npt.ArrayLike, npt.ArrayLike],
    confidence: float = 0.95,
) -> AreaDifference:
    """Difference of the areas of two detectors that scored the same records in the same order.

    `first`, `second`: (leak-free scores (n,), scores with a leak (m,)) of each. Raises InputError where the numbers
    differ. Source: DeLong et al. (1988), doi 10.2307/2531595, eq. (9).
    """
    from scipy.special import ndtr, ndtri

    pairs = [(numbers(a, "leak-free scores"), numbers(b, "scores with a leak")) for a, b in (first, second)]
    counts = [(a.size, b.size) for a, b in pairs]
    if counts[0] != counts[1]:
        raise InputError(f"both detectors must have scored the same records, got {counts[0]} and {counts[1]}")
    placements = [_placements(a, b) for a, b in pairs]
    value = float(placements[0][1].mean() - placements[1][1].mean())
    covariance = _covariance(placements)
    error = math.sqrt(max(float(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]), 0.0))
    z = float(ndtri(0.5 + share(confidence, "confidence") / 2.0))
    same = 1.0 if abs(value) < 1e-12 else 0.0
    p = same if error < 1e-12 else float(2.0 * ndtr(-abs(value) / error))
    return AreaDifference(value, error, value - z * error, value + z * error, p, confidence)
