"""Linear regression with normal errors where some responses are only known to lie below or above a limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.checks import Array

Side = npt.NDArray[np.int_]
_LOG_ROOT_2PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class Tobit:
    """Maximum-likelihood fit: `coefficients` (p,), error `sigma`, `covariance` (p+1, p+1) of both, sigma last."""

    coefficients: Array
    sigma: float
    covariance: Array
    log_likelihood: float


def _terms(design: Array, y: Array, side: Side, gamma: Array, h: float) -> tuple[float, Array, Array]:
    """Log-likelihood, gradient and Hessian in Olsen's parameters gamma = beta/sigma, h = 1/sigma, where it is
    concave: ``ln h + ln phi(h y - x gamma)`` known, ``ln Phi(+-(h y - x gamma))`` for at most / at least y."""
    from scipy.special import log_ndtr

    e = h * y - design @ gamma
    known = side == 0
    s = side[~known] * -1.0  # -1: at most y, probability Phi(e); +1: at least y, Phi(-e)
    u = s * e[~known]
    log_tail = log_ndtr(u)
    mills = np.exp(-0.5 * u * u - _LOG_ROOT_2PI - log_tail)
    value = known.sum() * (math.log(h) - _LOG_ROOT_2PI) - 0.5 * float(e[known] @ e[known]) + float(log_tail.sum())
    slope, curve = np.empty_like(e), np.empty_like(e)
    slope[known], curve[known] = -e[known], -1.0
    slope[~known], curve[~known] = s * mills, -mills * (u + mills)
    directions = np.column_stack([-design, y])  # d e / d (gamma, h)
    gradient = directions.T @ slope
    hessian = directions.T @ (directions * curve[:, None])
    gradient[-1] += known.sum() / h
    hessian[-1, -1] -= known.sum() / (h * h)
    return float(value), gradient, hessian


def fit_tobit(design: Array, y: Array, side: Side) -> Tobit:
    """Maximum-likelihood regression with censored responses.

    `design` (n, p); `y` (n,); `side` (n,): 0 where y is known, -1 where the response is at most y, +1 where it is at
    least y. Newton's method from the least-squares fit; the log-likelihood is concave, so there is one maximum.
    Raises InputError where the known responses do not determine it. Source: Tobin, Econometrica 26 (1958) 24-36, doi
    10.2307/1907382; Olsen, Econometrica 46 (1978) 1211-1215, doi 10.2307/1911445.
    """
    p = design.shape[1]
    known = side == 0
    if known.sum() <= p or np.linalg.matrix_rank(design[known]) < p:
        raise InputError(f"a censored fit needs more than {p} known responses at different sizes, got {known.sum()}")
    beta, *_ = np.linalg.lstsq(design, y, rcond=None)
    sigma = float(np.sqrt(np.mean((y - design @ beta) ** 2)))
    if not sigma > 1e-12 * float(np.ptp(y) + np.abs(y).max()):
        raise InputError("the responses lie exactly on a line: there is no scatter to judge a detection by")
    theta = np.append(beta / sigma, 1.0 / sigma)
    value, gradient, hessian = _terms(design, y, side, theta[:-1], float(theta[-1]))
    for _ in range(100):
        step = np.linalg.solve(hessian, gradient)
        length = 1.0
        while length > 1e-10:
            trial = theta - length * step
            if trial[-1] > 0.0:
                found = _terms(design, y, side, trial[:-1], float(trial[-1]))
                if found[0] >= value - 1e-12 * abs(value):
                    break
            length *= 0.5
        else:
            break
        gained = found[0] - value
        theta, (value, gradient, hessian) = trial, found
        if length == 1.0 and abs(gained) <= 1e-13 * (1.0 + abs(value)):
            break
    sigma = 1.0 / float(theta[-1])
    beta = theta[:-1] * sigma
    # d(beta, sigma)/d(gamma, h): beta = gamma/h, sigma = 1/h
    jacobian = np.zeros((p + 1, p + 1))
    jacobian[:p, :p] = sigma * np.eye(p)
    jacobian[:p, p] = -beta * sigma
    jacobian[p, p] = -sigma * sigma
    covariance = jacobian @ np.linalg.inv(-hessian) @ jacobian.T
    return Tobit(beta, sigma, np.asarray(covariance, dtype=np.float64), value)
