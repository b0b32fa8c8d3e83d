"""Functions of statistics for kernels, and searches for a root or a minimum of a function of one variable.

Those for kernels are of arithmetic, exponentials and logarithms alone, as controllers have them. `scipy.optimize` finds
the same roots and minima, but its import takes a fifth of the time of a diagnosis. Sources: T. R. Chandrupatla, Adv.
Eng. Softw. 28 (1997) 145 (roots); J. Kiefer, Proc. Amer. Math. Soc. 4 (1953) 502 (golden section).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sealscope.compiled import law

#: Logarithm of a number that is 0.
LOG_ZERO = -1e30
#: Beyond so many standard deviations the normal distribution is 0 or 1 in double precision.
_FAR = 37.0
#: Standard deviations from which on the tail of the normal distribution is a continued fraction.
_FRACTION_FROM = 7.07106781186547
#: Standard deviation of normal values over the median of their magnitudes.
SD_PER_MEDIAN = 1.4826
ROOT_TWO_PI = math.sqrt(2.0 * math.pi)
#: Argument from which Stirling's series for the logarithm of the gamma function is exact to 1e-15.
_STIRLING_FROM = 16.0
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@law
def add_logs(a: float, b: float) -> float:
    """Compute log(exp(a) + exp(b)); `LOG_ZERO` stands for the logarithm of 0."""
    high, low = max(a, b), min(a, b)
    return high if low - high < -745.0 else high + math.log1p(math.exp(low - high))


@law
def log_gamma(x: float) -> float:
    """Compute the logarithm of the gamma function for x > 0, by recurrence and Stirling's series.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 1964, 6.1.15 and 6.1.41.
    """
    shift = 0.0
    while x < _STIRLING_FROM:
        shift += math.log(x)
        x += 1.0
    y = 1.0 / (x * x)
    series = 1.0 / 12.0 - y * (1.0 / 360.0 - y * (1.0 / 1260.0 - y * (1.0 / 1680.0 - y * (1.0 / 1188.0))))
    return (x - 0.5) * math.log(x) - x + _HALF_LOG_TWO_PI + series / x - shift


@law
def normal_probability(z: float) -> float:
    """Compute the probability that a standard normal variable is at most z, to an absolute error of 1e-15.

    Source: J. F. Hart et al., Computer Approximations, 1968, algorithm 5666; as printed by G. West, Wilmott Magazine,
    May 2005, 70.
    """
    x = abs(z)
    if x > _FAR:
        tail = 0.0
    else:
        density = math.exp(-0.5 * x * x)
        if x < _FRACTION_FROM:
            above = 0.0352624965998911 * x + 0.700383064443688
            above = above * x + 6.37396220353165
            above = above * x + 33.912866078383
            above = above * x + 112.079291497871
            above = above * x + 221.213596169931
            above = above * x + 220.206867912376
            below = 0.0883883476483184 * x + 1.75566716318264
            below = below * x + 16.064177579207
            below = below * x + 86.7807322029461
            below = below * x + 296.564248779674
            below = below * x + 637.333633378831
            below = below * x + 793.826512519948
            below = below * x + 440.413735824752
            tail = density * above / below
        else:
            tail = density / _tail_fraction(x) / ROOT_TWO_PI
    return 1.0 - tail if z > 0.0 else tail


@law
def _tail_fraction(x: float) -> float:
    """Compute the density over the tail of a normal distribution, for x far above 0, as a continued fraction."""
    fraction = x + 0.65
    fraction = x + 4.0 / fraction
    fraction = x + 3.0 / fraction
    fraction = x + 2.0 / fraction
    return float(x + 1.0 / fraction)


@law
def log_scaled_tail(z: float) -> float:
    """Compute log(2 P exp(z^2/2)), where P is the probability that a standard normal variable is at most z."""
    if z < -_FRACTION_FROM:
        return math.log(2.0 / ROOT_TWO_PI / _tail_fraction(-z))
    return 0.5 * z * z + math.log(2.0 * normal_probability(z))


#: The golden section, 0.618: each step of `find_minimum` shortens the interval to this fraction.
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
#: Relative and absolute tolerance of a root, and largest number of steps to it.
_RELATIVE_TOLERANCE, _ABSOLUTE_TOLERANCE = 4.0 * float(np.finfo(float).eps), float(np.finfo(float).tiny)
_MAX_STEPS = 200


def find_root(function: Callable[[float], float], low: float, high: float) -> float:
    """Find a zero of a continuous function between `low` and `high` by Chandrupatla's method.

    The search ends when a value is exactly 0, when the zero is enclosed to a relative width of 8 machine epsilons, or
    after 200 steps. Raises ValueError if the function has the same sign at both ends, or is NaN there.
    """
    # a: newest point; b: the root is between a and b; c: point that was dropped last
    a, b, f_a, f_b = high, low, function(high), function(low)
    if not (f_a <= 0.0 <= f_b or f_b <= 0.0 <= f_a):
        raise ValueError(f"the function must change its sign between {low!r} and {high!r}")
    if f_a == 0.0 or f_b == 0.0:
        return high if f_a == 0.0 else low
    best = a
    fraction = 0.5  # fraction of the way from a to b; 0.5 bisects
    for _ in range(_MAX_STEPS):
        x = a + fraction * (b - a)
        f_x = function(x)
        if (f_x > 0.0) == (f_a > 0.0):
            c, f_c = a, f_a
        else:
            c, f_c, b, f_b = b, f_b, a, f_a
        a, f_a = x, f_x
        best = a if abs(f_a) < abs(f_b) else b
        tolerance = _RELATIVE_TOLERANCE * abs(best) + _ABSOLUTE_TOLERANCE
        width = abs(b - a)
        if f_a == 0.0 or width <= 2.0 * tolerance:
            return best
        fraction = 0.5
        margin = min(0.5, tolerance / width)  # keeps the next point away from a and b by the tolerance
        xi, phi = (a - b) / (c - b), (f_a - f_b) / (f_c - f_b)  # Chandrupatla's notation
        if 1.0 - (1.0 - xi) ** 0.5 < phi < xi**0.5:  # inverse quadratic interpolation stays inside
            fraction = f_a / (f_b - f_a) * f_c / (f_b - f_c)
            fraction += (c - a) / (b - a) * f_a / (f_c - f_a) * f_b / (f_c - f_b)
        fraction = min(max(fraction, margin), 1.0 - margin)
    return best


def find_minimum(function: Callable[[float], float], low: float, high: float, tolerance: float) -> tuple[float, float]:
    """Find the minimum of a function with a single minimum between `low` and `high`, by golden section search.

    `tolerance`: largest error of the position. Returns the position, and the function's value there.
    """
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f_left, f_right = function(left), function(right)
    while high - low > 2.0 * tolerance:
        if f_left < f_right:
            high, right, f_right = right, left, f_left
            left = high - _GOLDEN * (high - low)
            f_left = function(left)
        else:
            low, left, f_left = left, right, f_right
            right = low + _GOLDEN * (high - low)
            f_right = function(right)
    return (left, f_left) if f_left < f_right else (right, f_right)
