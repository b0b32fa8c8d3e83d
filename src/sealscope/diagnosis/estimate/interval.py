"""An estimate with its standard error, or with its 95 % interval."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY

#: Quantiles of the standard normal distribution for a stated interval and a stated upper bound: 1.96 and 1.645.
WITHIN_95 = round(NormalDist().inv_cdf(0.5 + 0.5 * BOUND_PROBABILITY), 2)
UPPER_95 = round(NormalDist().inv_cdf(BOUND_PROBABILITY), 3)


class Estimate(NamedTuple):
    """An estimate `value` and its standard error `deviation`."""

    value: float
    deviation: float

    def nonnegative_interval(self) -> Interval:
        """Compute the 95 % interval of a quantity that is never below 0, such as a flow down a pressure difference.

        Where the interval of the normal distribution begins below 0, it is that from 0 to the 95 % quantile of the
        distribution truncated at 0, and the value is at least 0.
        """
        half_width = WITHIN_95 * self.deviation
        if self.value >= half_width:
            return Interval(self.value, self.value - half_width, self.value + half_width)
        from scipy.special import log_ndtr, ndtri_exp

        log_tail = math.log(1.0 - BOUND_PROBABILITY) + float(log_ndtr(self.value / self.deviation))
        high = self.value - self.deviation * float(ndtri_exp(log_tail))
        return Interval(max(self.value, 0.0), 0.0, high)


class Interval(NamedTuple):
    """An estimate `value` with its 95 % interval from `low` to `high`."""

    value: float
    low: float
    high: float

    @property
    def deviation(self) -> float:
        """Standard deviation of a normal distribution with a 95 % interval of this width."""
        return (self.high - self.low) / (2.0 * WITHIN_95)
