"""Probability of detection over the size of the leak from the score itself: a censored line and a decision threshold,
as MIL-HDBK-1823A treats a-hat against a."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import Array, numbers, share
from sealscope.evaluation.pod import Scale, scaled, unscaled
from sealscope.evaluation.tobit import fit_tobit


@dataclass(frozen=True)
class SignalPod:
    """``POD(a) = Phi((x - location)/spread)``, x the size or its logarithm (`scale`), for one decision threshold.

    `covariance` (2, 2) of location and spread, by the delta method.
    """

    scale: Scale
    decision: float
    location: float
    spread: float
    covariance: Array

    def detection(self, size: npt.ArrayLike) -> Array:
        """Probability of detection at each size."""
        from scipy.special import ndtr

        x = scaled(np.atleast_1d(np.asarray(size, dtype=np.float64)), self.scale, "sizes")
        return np.asarray(ndtr((x - self.location) / self.spread), dtype=np.float64)

    def size_at(self, detection: float) -> float:
        """The size found with probability `detection`: ``x = location + Phi^-1(p) spread``."""
        from scipy.special import ndtri

        z = float(ndtri(share(detection, "the probability of detection")))
        return unscaled(self.location + z * self.spread, self.scale)

    def size_bound(self, detection: float = 0.9, confidence: float = 0.95) -> float:
        """One-sided upper confidence bound of `size_at(detection)` (a90/95 by default), Wald's:
        ``x + Phi^-1(c) sqrt(v11 + 2 z v12 + z^2 v22)``. Source: MIL-HDBK-1823A (2009), appendix G."""
        from scipy.special import ndtri

        z = float(ndtri(share(detection, "the probability of detection")))
        v = self.covariance
        error = math.sqrt(max(0.0, v[0, 0] + 2.0 * z * v[0, 1] + z * z * v[1, 1]))
        bound = self.location + z * self.spread + float(ndtri(share(confidence, "confidence"))) * error
        return unscaled(bound, self.scale)

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
        """The size found nine times in ten, with 95 % confidence (Wald)."""
        return self.size_bound()


@dataclass(frozen=True)
class SignalResponse:
    """``y = intercept + slope x + normal error of standard deviation sigma``, y the signal and x the size, each on its
    scale; `covariance` (3, 3) of intercept, slope, sigma; `n` records, `below` and `above` the limits of the signal."""

    size_scale: Scale
    signal_scale: Scale
    intercept: float
    slope: float
    sigma: float
    covariance: Array
    log_likelihood: float
    n: int
    below: int
    above: int

    def pod(self, decision: float) -> SignalPod:
        """The curve for alarms where signal > `decision` (in the signal's unit).

        ``location = (y_d - intercept)/slope, spread = sigma/slope``, covariance by the delta method. Raises
        InputError where the signal does not rise with the size. Source: MIL-HDBK-1823A (2009), appendix G.
        """
        if not self.slope > 0.0:
            raise InputError(f"the signal must rise with the size of the leak, got a slope of {self.slope:.3g}")
        y = float(scaled([decision], self.signal_scale, "the decision threshold")[0])
        location, spread = (y - self.intercept) / self.slope, self.sigma / self.slope
        jacobian = -np.array([[1.0, location, 0.0], [0.0, spread, -1.0]]) / self.slope
        covariance = np.asarray(jacobian @ self.covariance @ jacobian.T, dtype=np.float64)
        return SignalPod(self.size_scale, decision, location, spread, covariance)


def fit_signal_response(
    leaks: npt.ArrayLike,
    signals: npt.ArrayLike,
    size_scale: Scale = "log",
    signal_scale: Scale = "linear",
    lowest: float | None = None,
    highest: float | None = None,
) -> SignalResponse:
    """The line of the signal (a detector's score) over the size of the leak, by maximum likelihood.

    `leaks`, `signals` (n,); > 0 where their scale is `log`. A signal at or below `lowest` is only known to be at most
    that, at or above `highest` at least that (a noise floor, a saturated sensor); sigma is the maximum-likelihood one
    (divisor n). The model asks for a straight line, even scatter and normal errors: look at the residuals. Raises
    InputError where the data do not determine a line. Source: MIL-HDBK-1823A (2009), appendix G.
    """
    x = scaled(leaks, size_scale, "leak sizes")
    raw = numbers(signals, "signals")
    if raw.size != x.size:
        raise InputError(f"signals must be as many as the leak sizes, got {raw.size} for {x.size}")
    if lowest is not None and highest is not None and not lowest < highest:
        raise InputError(f"the lowest signal must be below the highest, got {lowest} and {highest}")
    side = np.zeros(x.size, dtype=np.int_)
    if lowest is not None:
        side[raw <= lowest] = -1
        raw = np.maximum(raw, lowest)
    if highest is not None:
        side[raw >= highest] = 1
        raw = np.minimum(raw, highest)
    y = scaled(raw, signal_scale, "signals")
    fit = fit_tobit(np.column_stack([np.ones(x.size), x]), y, side)
    return SignalResponse(
        size_scale=size_scale,
        signal_scale=signal_scale,
        intercept=float(fit.coefficients[0]),
        slope=float(fit.coefficients[1]),
        sigma=fit.sigma,
        covariance=fit.covariance,
        log_likelihood=fit.log_likelihood,
        n=int(x.size),
        below=int(np.count_nonzero(side < 0)),
        above=int(np.count_nonzero(side > 0)),
    )
