"""Estimates with intervals, by regressions whose errors follow each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Half width of an interval of 95 % in standard deviations of a normal law.
_Z = 1.959964


@dataclass(frozen=True)
class Estimate:
    """A parameter of a rig by its dotted `name`, its `value` and its standard deviation `sd`, in SI units."""

    name: str
    value: float
    sd: float

    def with_model_error(self, share: float) -> Estimate:
        """Return the estimate with a deviation of `share` of its value beside the scatter: what the laws leave out."""
        return replace(self, sd=math.hypot(self.sd, share * self.value))

    @property
    def interval(self) -> tuple[float, float]:
        """Interval of 95 %."""
        return self.value - _Z * self.sd, self.value + _Z * self.sd


def long_run(moments: Array, lags: int) -> Array:
    """Return the sum of the covariances of moments (n, m) with themselves up to `lags` apart: (m, m).

    Bartlett's weights 1 - k/(lags + 1). Source: W. K. Newey, K. D. West, A simple, positive semi-definite,
    heteroskedasticity and autocorrelation consistent covariance matrix, Econometrica 55 (1987) 703-708.
    """
    total = moments.T @ moments
    for k in range(1, min(lags, len(moments) - 1) + 1):
        cross = moments[k:].T @ moments[:-k]
        total = total + (1.0 - k / (lags + 1.0)) * (cross + cross.T)
    return np.asarray(total)


def instrumented(y: Array, X: Array, Z: Array, lags: int) -> tuple[Array, Array, Array]:
    """Return coefficients (m,), covariance (m, m) and residuals (n,) of y = X b, with instruments Z as many as columns.

    b = (Z'X)^-1 Z'y: errors in the columns of X do not bias it where those of Z are independent of them.
    """
    size = np.sqrt(np.mean(np.square(X), axis=0))
    inverse = np.linalg.inv(Z.T @ (X / size))
    b = inverse @ (Z.T @ y)
    rest = y - (X / size) @ b
    covariance = inverse @ long_run(Z * rest[:, None], lags) @ inverse.T
    freedom = len(y) / max(1, len(y) - len(b))
    return b / size, freedom * covariance / np.outer(size, size), rest


def least_squares(residual: Callable[[Array], Array], start: Sequence[float], lags: int) -> tuple[Array, Array, Array]:
    """Return parameters (m,), covariance (m, m) and residuals of a least-squares fit, with `long_run` errors."""
    from scipy.optimize import least_squares as fit

    scale = np.maximum(np.abs(np.asarray(start, dtype=float)), 1e-12)

    def scaled(q: Array) -> Array:
        return residual(np.asarray(q * scale))

    done = fit(scaled, np.asarray(start) / scale, method="lm", max_nfev=400)
    J = np.asarray(done.jac)
    inverse = np.linalg.pinv(J.T @ J)
    covariance = inverse @ long_run(J * done.fun[:, None], lags) @ inverse
    freedom = len(done.fun) / max(1, len(done.fun) - len(scale))
    return done.x * scale, freedom * covariance * np.outer(scale, scale), np.asarray(done.fun)
