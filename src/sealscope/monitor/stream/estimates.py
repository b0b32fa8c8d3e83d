"""What a watch gives: an estimate of every block, and the leak that its tests show."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class BlockEstimate:
    """What one block shows.

    Parameters
    ----------
    number : int
        Blocks so far, this one included.
    t : float
        End of the block [s].
    status : str
        "learning", "watched", "alarm", or why the block is not judged: "at standstill", "missing values", ...
    total_lpm, total_interval_lpm : float and pair of floats, optional
        Flow past pump and piston together, and its 95 % interval [L/min]; None where it is not known.
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Flow beyond that of the healthy machine, and its interval [L/min], in which the oil may have warmed.
    """

    number: int
    t: float
    status: str
    total_lpm: float | None = None
    total_interval_lpm: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None

    @property
    def judged(self) -> bool:
        """Whether the block was compared with the machine before it."""
        return self.status in ("learning", "watched", "alarm")


@dataclass(frozen=True)
class WatchedLeak:
    """A leak that the tests show, until `dismiss` or `relearn` is called.

    Parameters
    ----------
    raised_s : float
        Clock when it was first shown [s].
    onset_s, onset_interval_s : float and pair of floats
        Since when it leaks, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Size when it was shown, and its 95 % interval [L/min].
    before : float
        Conductance before the onset [m^3/(s Pa)].
    before_sd : float
        Its deviation [m^3/(s Pa)].
    test, cause, reason : str
        Which test shows it, where the oil goes, and why, in one line.
    score, threshold : float
        The test's statistic and threshold.
    """

    raised_s: float
    onset_s: float
    onset_interval_s: tuple[float, float]
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    before: float
    before_sd: float
    test: str
    cause: str
    reason: str
    score: float
    threshold: float

    @property
    def rarity(self) -> float:
        """How much rarer than at the stated rate a healthy machine shows such a score, as a share of 1e-9 to 1.

        For a level by the normal tail; for a step half the score is the logarithm of an e-value (`sequential`).
        """
        from scipy.special import log_ndtr

        if self.test == "level":
            exponent = float(log_ndtr(-self.score) - log_ndtr(-self.threshold))
        else:
            exponent = 0.5 * (self.threshold - self.score)
        return math.exp(min(0.0, max(exponent, math.log(1e-9))))
