"""Distribution of the evidence of a step in a healthy machine, by which the threshold of the alarm is set.

The detector of steps (`sequential`) assumes that a healthy conductance follows a random walk. Starts after a rest, oil
that warms and other duties depart from it, and raise the evidence M of a step. While the baseline is learned, the
largest M of each `WINDOW` blocks is therefore stored. As for healthy recordings, the posterior of an inflation
(`decision.null`) turns these values into the chance that M rises as high once more.
"""

from __future__ import annotations

import math
from functools import lru_cache

from sealscope.diagnosis.decision.null import HealthyNull
from sealscope.diagnosis.live.live_rise import STEP
from sealscope.diagnosis.live.signal_window import WINDOW
from sealscope.diagnosis.priors.live import LIVE
from sealscope.storage.plain_state import SavedAttributes

_MIN_WINDOWS: int = LIVE.step.windows
_LOG_WINDOW = math.log(WINDOW)


class StepNull(SavedAttributes):
    """Largest evidence of a step in each window of a healthy machine, and the threshold of the alarm that follows.

    If the random walk is right, P(max M > A) <= `WINDOW` / A in a window. The surprisal of a window is therefore u =
    log max M - log `WINDOW`, or 0 if that is negative.
    """

    SAVED = ("_count", "_surprisal", "_highest", "_blocks")

    def __init__(self) -> None:
        self._count, self._surprisal = 0, 0.0  # number of windows, and sum of their surprisals
        # largest log M, at least 0 (`add_window` counts larger ones only), and number of blocks in the present window
        self._highest, self._blocks = 0.0, 0

    def add(self, log_e: float) -> None:
        """Add log M (`log_e`), the evidence of a step after a block of a healthy machine."""
        self._highest = max(self._highest, log_e)
        self._blocks += 1
        if self._blocks == WINDOW:
            self.add_window(self._highest)
            self._highest, self._blocks = 0.0, 0

    def add_window(self, log_e: float) -> None:
        """Add a window of blocks whose largest log M is `log_e`, such as the window of a withdrawn alarm."""
        self._count += 1
        self._surprisal += max(log_e - _LOG_WINDOW, 0.0)

    def log_threshold(self, probability: float) -> float:
        """Compute the threshold of log M, the log e-value of a step, for a false-alarm `probability` per block."""
        return _find_threshold(self._count, self._surprisal, probability)


@lru_cache(maxsize=1024)
def _find_threshold(count: int, surprisal: float, probability: float) -> float:
    """Compute the threshold of log M for a false-alarm `probability` per block: at least -log(probability).

    `count` is the number of windows of a healthy machine, and `surprisal` the sum of their surprisals. With fewer than
    `_MIN_WINDOWS` the threshold is the lower limit, else that of a window with the false-alarm probability `WINDOW` *
    `probability`.
    """
    if count < _MIN_WINDOWS:
        return -math.log(probability)
    null = HealthyNull({STEP: [surprisal / count] * count})  # of the surprisals, only sum and number matter
    # probability of a window, kept below 1 by the limit
    chance = null.uncalibrated_chance(STEP, min(WINDOW * probability, 0.5))
    return max(_LOG_WINDOW - math.log(chance), -math.log(probability))
