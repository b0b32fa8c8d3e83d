"""Find roots and minima of functions of one variable, for commands that must start fast.

`scipy.optimize` finds the same, but its import takes a fifth of the time of a diagnosis. Sources: T. R. Chandrupatla,
Adv. Eng. Softw. 28 (1997) 145 (roots); J. Kiefer, Proc. Amer. Math. Soc. 4 (1953) 502 (golden section).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

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
