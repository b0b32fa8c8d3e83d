"""Functions of statistics for kernels, of arithmetic, exponentials and logarithms alone, as controllers have them."""

from __future__ import annotations

import math

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
