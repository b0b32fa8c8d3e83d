"""Probability of detection over the size of the leak.

The detection at each size, and the logistic curve through hits and misses with its a50, a90 and a90/95, as
MIL-HDBK-1823A fits hit/miss data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Proportion, lower_bound, proportion
from sealscope.evaluation.checks import Array, flags, share, sizes

#: Spans of the tested sizes' logarithms beyond which a bound counts as infinite.
_FARTHEST = 1e4


@dataclass(frozen=True)
class SizeDetection:
    """Detection at one `size`: its `proportion` with a two-sided interval, and the one-sided `lower` bound."""

    size: float
    proportion: Proportion
    lower: float


def by_size(leaks: npt.ArrayLike, hits: npt.ArrayLike, confidence: float = 0.95) -> list[SizeDetection]:
    """Compute the detection at each size of leak, with Clopper-Pearson's bounds, in rising order.

    `leaks` (n,) sizes, any unit; `hits` (n,) whether each was found. Raises InputError for sizes <= 0.
    """
    leak = sizes(leaks)
    hit = flags(hits, leak.size, "hits")
    rows = []
    for size in np.unique(leak):
        hits_at_size = hit[leak == size]
        k, n = int(hits_at_size.sum()), int(hits_at_size.size)
        rows.append(SizeDetection(float(size), proportion(k, n, confidence), lower_bound(k, n, confidence)))
    return rows


def proven_size(rows: list[SizeDetection], detection: float = 0.9) -> float:
    """Find the smallest size from which on every tested size has its lower bound >= `detection`.

    Infinite where none has. With 29 hits of 29 at 95 % the size proves 90 % (a90/95 without a model). Nothing is said
    between the sizes, and the confidence is that of each size alone. Source: Clopper and Pearson (1934), doi
    10.1093/biomet/26.4.404.
    """
    share(detection, "the probability of detection")
    proven = math.inf
    for row in sorted(rows, key=lambda row: -row.size):
        if row.lower < detection:
            break
        proven = row.size
    return proven


def _log_odds(p: float) -> float:
    return math.log(p / (1.0 - p))


def _information(design: Array, n: Array, eta: Array) -> Array:
    odds = np.exp(-np.abs(eta))
    weight = n * odds / (1.0 + odds) ** 2  # n p (1 - p)
    return np.asarray(design.T @ (design * weight[:, None]), dtype=np.float64)


def _log_likelihood(design: Array, n: Array, k: Array, eta: Array, firth: bool) -> float:
    """Compute ``sum of k eta - n ln(1 + exp eta)``; Firth's penalty adds half the log determinant."""
    value = float(np.sum(k * eta - n * np.logaddexp(0.0, eta)))
    if not firth:
        return value
    sign, log_determinant = np.linalg.slogdet(_information(design, n, eta))
    return value + 0.5 * float(log_determinant) if sign > 0 else -math.inf


def _fitted(design: Array, n: Array, k: Array, firth: bool) -> Array:
    """Compute the coefficients at the maximum of the log-likelihood."""
    from scipy.optimize import minimize
    from scipy.special import expit

    def loss(beta: Array) -> tuple[float, Array]:
        eta = design @ beta
        p = expit(eta)
        residual = k - n * p
        if firth:  # leverage of each size times (1/2 - p): Firth (1993), Heinze and Schemper (2002)
            inverse = np.linalg.pinv(_information(design, n, eta))
            residual += n * p * (1.0 - p) * np.einsum("ij,jk,ik->i", design, inverse, design) * (0.5 - p)
        return -_log_likelihood(design, n, k, eta, firth), -design.T @ residual

    start = np.array([_log_odds((k.sum() + 0.5) / (n.sum() + 1.0)), 0.0])
    return np.asarray(minimize(loss, start, jac=True, method="BFGS", options={"gtol": 1e-9}).x, dtype=np.float64)


def _is_separated(n: Array, k: Array) -> bool:
    """Return True if misses and hits of rising sizes overlap in one size at most: no maximum at a finite slope."""
    hits = k / n
    mixed = np.count_nonzero((hits > 0.0) & (hits < 1.0))
    steps = np.diff(hits)
    return bool(mixed <= 1 and (np.all(steps >= 0.0) or np.all(steps <= 0.0)))


@dataclass(frozen=True)
class HitMiss:
    """``ln(POD/(1 - POD)) = intercept + slope ln(size)``.

    `covariance` (2, 2) of both; `estimator`: Firth's penalised likelihood where hits and misses are separated by size,
    else maximum likelihood; `log_likelihood` of the fit and `null` without the size (both with the penalty where there
    is one); `size`, `tested`, `hits` (m,): the data by size.
    """

    intercept: float
    slope: float
    covariance: Array
    estimator: Literal["maximum likelihood", "firth"]
    log_likelihood: float
    null: float
    size: Array
    tested: Array
    hits: Array

    def detection(self, size: npt.ArrayLike) -> Array:
        """Compute the probability of detection at each size."""
        from scipy.special import expit

        return np.asarray(expit(self.intercept + self.slope * _log_sizes(size)), dtype=np.float64)

    def detection_band(self, size: npt.ArrayLike, confidence: float = 0.95) -> tuple[Array, Array]:
        """Compute the two-sided pointwise Wald interval, on the log odds, of the detection at each size."""
        from scipy.special import expit, ndtri

        x, v = _log_sizes(size), self.covariance
        z = float(ndtri(0.5 + share(confidence, "confidence") / 2.0))
        half = z * np.sqrt(v[0, 0] + 2.0 * v[0, 1] * x + v[1, 1] * x * x)
        eta = self.intercept + self.slope * x
        return np.asarray(expit(eta - half), dtype=np.float64), np.asarray(expit(eta + half), dtype=np.float64)

    def size_at(self, detection: float) -> float:
        """Compute the size found with probability `detection`: ``ln(size) = (ln(p/(1-p)) - intercept)/slope``.

        Infinite where detection does not rise with the size.
        """
        share(detection, "the probability of detection")
        return _size((_log_odds(detection) - self.intercept) / self.slope) if self.slope > 0.0 else math.inf

    def size_bound(self, detection: float = 0.9, confidence: float = 0.95) -> float:
        """Compute the one-sided upper confidence bound of `size_at(detection)`, by default a90/95.

        It is the largest size whose profile log-likelihood is within ``z_c^2/2`` of the maximum (chi square, one
        degree of freedom); infinite where there is none. Source: MIL-HDBK-1823A (2009), appendix G; Cheng and Iles,
        Technometrics 25 (1983) 77-86, doi 10.1080/00401706.1983.10487822, gives the simultaneous counterparts, which
        are wider.
        """
        from scipy.optimize import brentq
        from scipy.special import ndtri

        share(detection, "the probability of detection")
        if not 0.5 <= confidence < 1.0:
            raise InputError(f"confidence must be from 0.5 to 1, got {confidence}")
        odds, drop = _log_odds(detection), 0.5 * float(ndtri(confidence)) ** 2
        if not self.slope > 0.0 or self.log_likelihood - self.null <= drop:
            return math.inf

        def excess(log_size: float) -> float:
            return self.log_likelihood - self._profile(odds, log_size) - drop

        span = float(np.ptp(_log_sizes(self.size)))
        near, step = (odds - self.intercept) / self.slope, span / 8.0
        far = near + step
        while excess(far) < 0.0:
            near, step = far, 2.0 * step
            far += step
            if step > _FARTHEST * span:
                return math.inf
        return _size(float(brentq(excess, near, far, xtol=1e-10 * max(1.0, abs(far)))))

    @property
    def a50(self) -> float:
        """The size found half of the time."""
        return self.size_at(0.5)

    @property
    def a90(self) -> float:
        """The size found nine times in ten."""
        return self.size_at(0.9)

    @property
    def a90_95(self) -> float:
        """The size found nine times in ten, with 95 % confidence (likelihood ratio)."""
        return self.size_bound()

    def _profile(self, odds: float, log_size: float) -> float:
        """Maximise the log-likelihood over the slope of lines with these log odds at `log_size`."""
        from scipy.optimize import minimize_scalar

        x = _log_sizes(self.size)
        design = np.column_stack([np.ones(x.size), x])

        def loss(slope: float) -> float:
            eta = odds + slope * (x - log_size)
            value = _log_likelihood(design, self.tested, self.hits, eta, self.estimator == "firth")
            return -value if math.isfinite(value) else 1e300

        width = max(float(np.abs(x - log_size).max()), 1e-300)
        return -float(minimize_scalar(loss, bracket=(0.0, 1.0 / width), options={"xtol": 1e-9}).fun)


def _log_sizes(values: npt.ArrayLike) -> Array:
    return np.asarray(np.log(sizes(np.atleast_1d(np.asarray(values, dtype=np.float64)), "sizes")), dtype=np.float64)


def _size(log_size: float) -> float:
    """Compute the size of a natural logarithm; infinite where it overflows."""
    return math.exp(log_size) if log_size < 709.0 else math.inf


def fit_hit_miss(leaks: npt.ArrayLike, hits: npt.ArrayLike) -> HitMiss:
    """Fit the logistic curve through hits and misses over the logarithm of the size, by maximum likelihood.

    `leaks` (n,) sizes > 0 in any unit; `hits` (n,) whether each was found. Where no finite
    maximum exists (hits and misses separated by size), Firth's penalised likelihood is used and said so; its bound is
    the penalised profile's. Raises InputError for a single size, or where all are hits or all misses. The curve goes
    to 0 for small leaks: it does not know the false-alarm rate. Source: MIL-HDBK-1823A (2009), appendix G; Firth,
    Biometrika 80 (1993) 27-38, doi 10.1093/biomet/80.1.27; Heinze and Schemper, Stat. Med. 21 (2002) 2409-2419, doi
    10.1002/sim.1047.
    """
    x = np.log(sizes(leaks))
    hit = flags(hits, x.size, "hits")
    if hit.all() or not hit.any():
        raise InputError(f"a curve needs hits and misses, got {int(hit.sum())} hits of {hit.size}")
    values, where = np.unique(x, return_inverse=True)
    if values.size < 2:
        raise InputError(f"a curve needs leaks of at least 2 sizes, got {hit.size} of one size")
    n, k = (np.asarray(np.bincount(where, counts), dtype=np.float64) for counts in (None, hit.astype(np.float64)))
    firth = _is_separated(n, k)
    # centred and scaled while fitting, so that the size's unit does not matter
    centre, spread = float(values.mean()), float(np.ptp(values)) / 2.0
    design = np.column_stack([np.ones(values.size), (values - centre) / spread])
    beta = _fitted(design, n, k, firth)
    unscale = np.array([[1.0, -centre / spread], [0.0, 1.0 / spread]])
    covariance = unscale @ np.linalg.inv(_information(design, n, design @ beta)) @ unscale.T
    intercept, slope = (float(b) for b in unscale @ beta)
    plain = np.column_stack([np.ones(values.size), values])
    more = 1.0 if firth else 0.0  # with slope 0 Firth's penalty is ln(p(1 - p)) and a constant: a hit and a miss more
    level = np.full(n.size, _log_odds((k.sum() + more) / (n.sum() + 2.0 * more)))
    return HitMiss(
        intercept=intercept,
        slope=slope,
        covariance=np.asarray(covariance, dtype=np.float64),
        estimator="firth" if firth else "maximum likelihood",
        log_likelihood=_log_likelihood(plain, n, k, intercept + slope * values, firth),
        null=_log_likelihood(plain, n, k, level, firth),
        size=np.exp(values),
        tested=n,
        hits=k,
    )
