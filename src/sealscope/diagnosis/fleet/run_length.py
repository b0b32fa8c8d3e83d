"""Thresholds of sequential tests from a stated average run length, for standard normal, independent observations.

The average run length is the mean number of observations from the beginning to a false alarm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from sealscope.errors import InputError

#: Run lengths for which a threshold is given.
SHORTEST, LONGEST = 50.0, 1e10


def cusum_run_length(threshold: float, reference: float) -> float:
    """Return the average run length of the one-sided CUSUM ``S = max(0, S + z - k)`` until ``S >= h``, z ~ N(0, 1).

    Solves ``L(s) = 1 + L(0) Phi(k - s) + int_0^h L(x) phi(x + k - s) dx`` on Gauss-Legendre nodes.
    Source: E. S. Page, Continuous inspection schemes, Biometrika 41 (1954) 100-115.
    """
    h, k = threshold, reference
    nodes, weights = np.polynomial.legendre.leggauss(max(32, math.ceil(4.0 * h)))
    x, w = 0.5 * h * (nodes + 1.0), 0.5 * h * weights
    starts = np.concatenate([[0.0], x])
    density = np.exp(-0.5 * (x[None, :] + k - starts[:, None]) ** 2) / math.sqrt(2.0 * math.pi)
    to_zero = np.array([0.5 * math.erfc((s - k) / math.sqrt(2.0)) for s in starts])
    system = np.eye(starts.size)
    system[:, 0] -= to_zero
    system[:, 1:] -= density * w
    return float(np.linalg.solve(system, np.ones(starts.size))[0])


def glr_run_length(threshold: float, window: int) -> float:
    """Return the average run length of ``max_{1 <= n <= W} |z_(k-n+1) + .. + z_k| / sqrt(n)`` to b, z ~ N(0, 1).

    ``1 / (2 phi(b)/b sum_n (x_n^2/2)^2 nu(x_n)^2)`` with ``x_n = b/sqrt(n)``: the discrete form, over a window, of
    ``sqrt(2 pi) exp(b^2/2) / (b int x nu(x)^2 dx)``. Source: D. Siegmund, E. S. Venkatraman, Using the generalized
    likelihood ratio statistic for sequential detection of a change-point, Annals of Statistics 23 (1995) 255-271.
    """
    b = threshold
    x = b / np.sqrt(np.arange(1, window + 1))
    half = np.array([0.5 * math.erf(value / (2.0 * math.sqrt(2.0))) for value in x])  # Phi(x/2) - 1/2
    density = np.exp(-0.125 * x**2) / math.sqrt(2.0 * math.pi)
    nu = (2.0 / x) * half / (0.5 * x * (half + 0.5) + density)
    tail = math.exp(-0.5 * b * b) / math.sqrt(2.0 * math.pi) / b
    return 1.0 / (2.0 * tail * float(np.sum((0.5 * x**2 * nu) ** 2)))


@cache
def cusum_threshold(average_run_length: float, reference: float = 0.5) -> float:
    """Return h of the two-sided CUSUM (one for either direction) of the stated average run length.

    `reference`: k, half the change looked for, in standard deviations. Raises InputError for a run length or a
    reference out of range.
    """
    _check_run_length(average_run_length)
    if not 0.25 <= reference <= 2.0:
        raise InputError(f"reference must be 0.25 to 2 standard deviations, got {reference}")
    return _solved(lambda h: cusum_run_length(h, reference), 2.0 * average_run_length, 0.01)


@cache
def glr_threshold(average_run_length: float, window: int = 60) -> float:
    """Return b of the generalised likelihood ratio test over a window, for either direction, at that run length.

    Raises InputError for a run length out of range or a window below 1.
    """
    _check_run_length(average_run_length)
    if window < 1:
        raise InputError(f"window must be 1 or more, got {window}")
    return _solved(lambda b: glr_run_length(b, window), average_run_length, 2.0)


def _check_run_length(wanted: float) -> None:
    if not SHORTEST <= wanted <= LONGEST:
        raise InputError(f"average run length must be {SHORTEST:g} to {LONGEST:g} observations, got {wanted:.4g}")


def _solved(run_length: Callable[[float], float], wanted: float, low: float) -> float:
    """Return where an increasing run length reaches the wanted value, by bisection."""
    high = low + 1.0
    while run_length(high) < wanted:
        low, high = high, high + 1.0
    for _ in range(45):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if run_length(middle) < wanted else (low, middle)
    return 0.5 * (low + high)
