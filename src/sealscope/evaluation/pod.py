"""Estimate the probability of detection (POD) as a function of the size of the leak.

These are proportions at each size, and a logistic curve with a50, a90 and a90/95 as in MIL-HDBK-1823A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Proportion, lower_bound, proportion
from sealscope.recordings.channels import Array

#: The search for a bound ends, and the bound is infinite, if a step exceeds this many ranges of the sizes' logarithms.
_MAX_SPANS = 1e4


@dataclass(frozen=True)
class SizeDetection:
    """Proportion of detected leaks among the tested leaks of one `size`.

    `proportion` has a two-sided confidence interval; `lower` is the one-sided lower confidence bound.
    """

    size: float
    proportion: Proportion
    lower: float


def detection_by_size(leaks: npt.ArrayLike, hits: npt.ArrayLike, confidence: float = 0.95) -> list[SizeDetection]:
    """Compute the proportion of detected leaks of each size, in the order of rising size, with confidence bounds.

    `leaks` (n,): sizes > 0 in any unit; `hits` (n,): True for the detected leaks.
    """
    sizes, is_hit = np.asarray(leaks), np.asarray(hits, dtype=bool)
    rows = []
    for size in np.unique(sizes):
        hits_at_size = is_hit[sizes == size]
        k, n = int(hits_at_size.sum()), hits_at_size.size
        rows.append(SizeDetection(float(size), proportion(k, n, confidence), lower_bound(k, n, confidence)))
    return rows


def proven_size(rows: list[SizeDetection], detection: float = 0.9) -> float:
    """Find the smallest tested size such that this and all larger tested sizes are proven to be detected.

    `rows`: proportion of detected leaks of each size, in rising order. A size is proven if the lower confidence bound
    of its proportion is at least `detection`; the confidence applies to each size separately. For example, 29 hits of
    29 prove 90 % at 95 % confidence: this is a90/95 without a model. Returns infinity if the largest size is not
    proven. Source: Clopper and Pearson (1934), doi 10.1093/biomet/26.4.404.
    """
    proven = math.inf
    for row in reversed(rows):
        if row.lower < detection:
            break
        proven = row.size
    return proven


def _log_odds(p: float) -> float:
    """Compute the log odds ``ln(p/(1 - p))`` of a probability."""
    return math.log(p / (1.0 - p))


def _information(design: Array, n: Array, eta: Array) -> Array:
    """Compute the Fisher information (2, 2) of intercept and slope of the logistic curve.

    `design` (m, 2): columns 1 and logarithm of size; `n` (m,): numbers of trials; `eta` (m,): log odds of detection.
    """
    # with p the probability of a hit, p (1 - p) is the same for eta and -eta, and exp(-|eta|) does not overflow
    odds = np.exp(-np.abs(eta))
    weight = n * odds / (1.0 + odds) ** 2  # n p (1 - p)
    return np.asarray(design.T @ (design * weight[:, None]), dtype=np.float64)


def _log_likelihood(design: Array, n: Array, k: Array, eta: Array, *, firth: bool) -> float:
    """Compute the log-likelihood of `k` hits in `n` trials at m sizes with the log odds `eta` of a hit, all (m,).

    It is ``sum of k eta - n ln(1 + exp eta)``. With `firth`, half the log determinant of the Fisher information is
    added as a penalty, minus infinity if it is singular; `design` (m, 2): columns 1 and logarithm of size.
    """
    value = float(np.sum(k * eta - n * np.logaddexp(0.0, eta)))
    if not firth:
        return value
    sign, log_determinant = np.linalg.slogdet(_information(design, n, eta))
    return value + 0.5 * float(log_determinant) if sign > 0 else -math.inf


def _fit_coefficients(design: Array, n: Array, k: Array, *, firth: bool) -> Array:
    """Find intercept and slope of the logistic curve by maximum likelihood, or with `firth` by penalised likelihood.

    `design` (m, 2) has the columns 1 and logarithm of size; `n`, `k` (m,): numbers of trials and of hits at each size.
    """
    from scipy.optimize import minimize
    from scipy.special import expit

    def loss(beta: Array) -> tuple[float, Array]:
        """Compute the negative log-likelihood of the curve `beta` (2,), intercept and slope, and its gradient (2,)."""
        eta = design @ beta
        p = expit(eta)
        residual = k - n * p
        # adds h (1/2 - p), with the leverage h = n p (1 - p) x' I^-1 x of a size, x its row of the design and I the
        # information: Firth (1993), Heinze and Schemper (2002)
        if firth:
            inverse = np.linalg.pinv(_information(design, n, eta))  # may be singular far from the maximum
            residual += n * p * (1.0 - p) * np.einsum("ij,jk,ik->i", design, inverse, design) * (0.5 - p)
        return -_log_likelihood(design, n, k, eta, firth=firth), -design.T @ residual

    # slope 0 and the overall fraction of hits; 0.5 and 1.0 keep it from being 0 or 1
    start = np.array([_log_odds((k.sum() + 0.5) / (n.sum() + 1.0)), 0.0])
    return np.asarray(minimize(loss, start, jac=True, method="BFGS", options={"gtol": 1e-9}).x, dtype=np.float64)


def _is_separated(n: Array, k: Array) -> bool:
    """Return True if all leaks above one size are hits and all below it are misses, or the reverse.

    The likelihood of the logistic curve then has no finite maximum. `n`, `k` (m,): trials and hits at rising sizes.
    """
    hit_fraction = k / n
    n_mixed_sizes = np.count_nonzero((hit_fraction > 0.0) & (hit_fraction < 1.0))
    steps = np.diff(hit_fraction)
    return bool(n_mixed_sizes <= 1 and (np.all(steps >= 0.0) or np.all(steps <= 0.0)))


@dataclass(frozen=True)
class HitMiss:
    """A logistic curve fitted to hits and misses: ``ln(POD/(1 - POD)) = intercept + slope ln(size)``.

    - `covariance` (2, 2): that of intercept and slope
    - `estimator`: method of the fit, Firth's penalised likelihood if hits and misses are separated by size, else
      maximum likelihood
    - `log_likelihood`, `null`: log-likelihood of the fit and of the best curve with slope 0, including the penalty if
      there is one
    - `size`, `tested`, `hits` (m,): tested sizes, and at each the number of leaks and of hits
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
        """Compute the fitted probability of detection at each `size` > 0."""
        from scipy.special import expit

        return np.asarray(expit(self.intercept + self.slope * np.log(size)))

    def detection_band(self, size: npt.ArrayLike, confidence: float = 0.95) -> tuple[Array, Array]:
        """Compute a two-sided confidence interval (low, high) of the probability of detection at each `size`.

        The interval is Wald's for the log odds; the confidence applies to each size separately.
        """
        from scipy.special import expit, ndtri

        x = np.log(size)
        v = self.covariance  # covariance of intercept and slope
        z = float(ndtri(0.5 + confidence / 2.0))
        margin = z * np.sqrt(v[0, 0] + 2.0 * v[0, 1] * x + v[1, 1] * x * x)
        eta = self.intercept + self.slope * x
        return np.asarray(expit(eta - margin)), np.asarray(expit(eta + margin))

    def size_at(self, detection: float) -> float:
        """Compute the size that is detected with the probability p = `detection`, such as a90 for 0.9.

        Its logarithm is ``(ln(p/(1-p)) - intercept)/slope``. The size is infinite if the detection does not rise with
        it (slope <= 0).
        """
        return _exp_size((_log_odds(detection) - self.intercept) / self.slope) if self.slope > 0.0 else math.inf

    def size_bound(self, detection: float = 0.9, confidence: float = 0.95) -> float:
        """Compute the one-sided upper confidence bound of the size detected with the probability `detection`.

        By default it is a90/95. The bound is the largest size whose profile log-likelihood is within ``z^2/2`` of the
        maximum, with z the normal quantile of `confidence` (chi square with one degree of freedom). It is infinite if
        this holds for arbitrarily large sizes, or if the detection does not rise with the size. `confidence`: from 0.5,
        which gives the estimate itself, to below 1. Source: MIL-HDBK-1823A (2009), appendix G. Cheng and Iles,
        Technometrics 25 (1983) 77-86, doi 10.1080/00401706.1983.10487822, give simultaneous bounds, which are wider.
        """
        from scipy.optimize import brentq
        from scipy.special import ndtri

        log_odds = _log_odds(detection)
        allowed_drop = 0.5 * float(ndtri(confidence)) ** 2  # largest drop of the log-likelihood
        # a curve with slope 0, the limit for large sizes, may be within the drop
        if not self.slope > 0.0 or self.log_likelihood - self.null <= allowed_drop:
            return math.inf

        def excess_drop(log_size: float) -> float:
            """Compute how far the profile log-likelihood is below its maximum at a size, minus the allowed drop."""
            return self.log_likelihood - self._profile_log_likelihood(log_odds, log_size) - allowed_drop

        # bracket the root with growing steps from the estimate upwards
        log_range = float(np.ptp(np.log(self.size)))
        lower = (log_odds - self.intercept) / self.slope
        step = log_range / 8.0
        upper = lower + step
        while excess_drop(upper) < 0.0:
            lower, step = upper, 2.0 * step
            upper += step
            if step > _MAX_SPANS * log_range:
                return math.inf
        log_bound = brentq(excess_drop, lower, upper, xtol=1e-10 * max(1.0, abs(upper)))
        return _exp_size(float(log_bound))

    @property
    def a50(self) -> float:
        """The size that is detected with a probability of 50 %."""
        return self.size_at(0.5)

    @property
    def a90(self) -> float:
        """The size that is detected with a probability of 90 %."""
        return self.size_at(0.9)

    @property
    def a90_95(self) -> float:
        """The upper 95 % confidence bound of the size that is detected with a probability of 90 %."""
        return self.size_bound()

    def _profile_log_likelihood(self, log_odds: float, log_size: float) -> float:
        """Compute the largest log-likelihood of all logistic curves through one point (log size, log odds)."""
        from scipy.optimize import minimize_scalar

        x = np.log(self.size)
        design = np.column_stack([np.ones(x.size), x])

        def loss(slope: float) -> float:
            """Compute the negative log-likelihood of the curve with this slope; 1e300 for inf, to go on searching."""
            eta = log_odds + slope * (x - log_size)
            value = _log_likelihood(design, self.tested, self.hits, eta, firth=self.estimator == "firth")
            return -value if math.isfinite(value) else 1e300

        # first slopes of the search: the log odds change by 0, and by 1 from the point to the farthest size
        width = float(np.abs(x - log_size).max())
        return -float(minimize_scalar(loss, bracket=(0.0, 1.0 / width), options={"xtol": 1e-9}).fun)


def _exp_size(log_size: float) -> float:
    """Compute a size from its natural logarithm; infinite if it is too large for a float."""
    return math.exp(log_size) if log_size < 709.0 else math.inf  # exp overflows above 709.78


def fit_hit_miss(leaks: npt.ArrayLike, hits: npt.ArrayLike) -> HitMiss:
    """Fit a logistic curve of the probability of detection to hits and misses over the logarithm of the leak's size.

    `leaks` (n,): positive sizes in any unit; `hits` (n,): True for the detected leaks. The likelihood is maximised, or
    Firth's penalised likelihood if the size separates hits from misses, as the likelihood has no finite maximum then.
    The curve goes to 0 for small leaks, as it does not include the false-alarm rate. Raises InputError for a single
    size, only hits or only misses. Source: MIL-HDBK-1823A (2009), appendix G; Firth, Biometrika 80 (1993) 27-38, doi
    10.1093/biomet/80.1.27; Heinze and Schemper, Stat. Med. 21 (2002) 2409-2419, doi 10.1002/sim.1047.
    """
    x, is_hit = np.log(leaks), np.asarray(hits, dtype=bool)
    if is_hit.all() or not is_hit.any():
        raise InputError(f"a curve needs hits and misses, got {int(is_hit.sum())} hits of {is_hit.size}")
    values, index = np.unique(x, return_inverse=True)  # logarithms of the tested sizes; index of each leak in them
    if values.size < 2:
        raise InputError(f"a curve needs leaks of at least 2 sizes, got {is_hit.size} of one size")
    n, k = np.bincount(index).astype(float), np.bincount(index[is_hit], minlength=values.size).astype(float)
    firth = _is_separated(n, k)
    # centred and scaled for the fit, so that the unit of the size does not matter
    centre, half_range = float(values.mean()), float(np.ptp(values)) / 2.0
    scaled_design = np.column_stack([np.ones(values.size), (values - centre) / half_range])
    scaled_intercept, scaled_slope = _fit_coefficients(scaled_design, n, k, firth=firth).tolist()
    slope = scaled_slope / half_range
    intercept = scaled_intercept - slope * centre
    design, eta = np.column_stack([np.ones(values.size), values]), intercept + slope * values
    # with slope 0 Firth's penalty is ln(p(1 - p)) + constant, which acts as one more hit and one more miss
    n_added = 1.0 if firth else 0.0
    null_eta = np.full(n.size, _log_odds((k.sum() + n_added) / (n.sum() + 2.0 * n_added)))
    return HitMiss(
        intercept=intercept,
        slope=slope,
        covariance=np.asarray(np.linalg.inv(_information(design, n, eta)), dtype=np.float64),
        estimator="firth" if firth else "maximum likelihood",
        log_likelihood=_log_likelihood(design, n, k, eta, firth=firth),
        null=_log_likelihood(design, n, k, null_eta, firth=firth),
        size=np.exp(values),
        tested=n,
        hits=k,
    )
