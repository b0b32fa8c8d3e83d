"""An increase of a running machine's leakage conductance, with the test that found it."""

from __future__ import annotations

import math
from typing import NamedTuple

from sealscope.diagnosis.estimate.interval import Interval

#: Names of the tests: for a step within the stream, and for a level above that of the healthy machine.
STEP, LEVEL = "step", "level"


class LiveRise(NamedTuple):
    """An increase of a running machine's leakage conductance, with its test; an `observable.DatedTest`."""

    test: str  # `STEP` or `LEVEL`
    score: float  # score of the test: twice the logarithm of an e-value for a step, a normal quantile for a level
    interval: Interval = Interval(math.nan, math.nan, math.nan)  # onset with its 95 % interval [s]
    # the increase and its standard deviation [m^3/(s Pa)]
    size: float = 0.0
    deviation: float = math.inf

    @property
    def log_chance(self) -> float:
        """Logarithm of the probability that a healthy machine has at least this score in the test.

        For a step the result is an upper bound, -score/2 by Ville's inequality. For a level it follows from the normal
        distribution.
        """
        from scipy.special import log_ndtr

        return -0.5 * max(self.score, 0.0) if self.test == STEP else float(log_ndtr(-self.score))

    @property
    def chance(self) -> float:
        """Probability that a healthy machine has at least this score in the test; for a step an upper bound."""
        return math.exp(self.log_chance)

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy machine exceeds with the probability `chance`, for a step at most."""
        from scipy.special import ndtri

        return -2.0 * math.log(chance) if self.test == STEP else -float(ndtri(chance))

    def onset(self) -> Interval:
        """Return the onset of the increase of the leakage [s] with its 95 % interval."""
        return self.interval

    def detectable_step(self, chance: float) -> float:
        """Return infinity: the smallest step that is detectable depends on the conductance's unknown random walk."""
        return math.inf
