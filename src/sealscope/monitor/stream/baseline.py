"""What an actuator is compared with: learned over stated hours of healthy running, then frozen, with a version."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from sealscope.diagnosis.beliefs import beliefs


@dataclass(frozen=True)
class WatchBaseline:
    """A healthy machine, as it was while the baseline was learned.

    Parameters
    ----------
    version : int
        1 for the first, one more after each repair.
    learned_s : float
        Clock when it was complete [s].
    hours : float
        Operating hours it rests on.
    level, low, high : float
        Conductance of pump and piston: mean, and least and largest mean of successive blocks [m^3/(s Pa)].
    lpm : float or None
        The mean as a flow under the pressure difference learned with [L/min], None where L/min cannot be stated.
    duty_low, duty_high : tuple of two floats
        Least and largest logarithm of mean pressure difference [Pa] and of rms flow of the pump [m^3/s].
    """

    version: int
    learned_s: float
    hours: float
    level: float
    low: float
    high: float
    lpm: float | None
    duty_low: tuple[float, float]
    duty_high: tuple[float, float]

    def knows(self, duty: tuple[float, float]) -> bool:
        """Return whether a duty is among those learned."""
        return within(duty, self.duty_low, self.duty_high)

    def rise(self, at: float, g: float, deviation: float, probability: float) -> WatchedRise | None:
        """Return the rise where a mean conductance is over what warm oil makes of the baseline's least; None where not.

        `deviation`: of `g`; `probability`: of a look at a healthy machine as warm as that.
        """
        from scipy.special import ndtri

        warmest = beliefs("inference")["oil"]["warmest"]
        ceiling = warmest * max(self.low, 0.0)
        score, threshold = (g - ceiling) / deviation, -float(ndtri(probability))
        if score <= threshold:
            return None
        reason = (
            f"the leakage conductance is {g:.3g} m^3/(s Pa), over {warmest:g} times the least of the baseline: more "
            f"than the warmest oil makes of it (score {score:.1f}, threshold {threshold:.1f})"
        )
        # what is healthy may be anywhere from the least of the baseline to the ceiling
        healthy = max(self.level - self.low, ceiling - self.level, 0.0) / 1.96
        size = g - max(self.level, 0.0)
        onset = at, self.learned_s, at
        return WatchedRise("level", onset, size, math.hypot(deviation, healthy), reason, score, threshold)


class WatchedRise(NamedTuple):
    """A rise of the conductance that a test shows.

    `test`: which one; `onset`: value, low and high [s]; `size`, `deviation` [m^3/(s Pa)]; `reason`: in words; `score`,
    `threshold`.
    """

    test: str
    onset: tuple[float, float, float]
    size: float
    deviation: float
    reason: str
    score: float
    threshold: float


def within(duty: tuple[float, float], low: tuple[float, float], high: tuple[float, float]) -> bool:
    """Return whether a duty lies between two others, give or take; a leak may take more of the pressure."""
    believed = beliefs("inference.live")["watch"]
    margin = believed["margin"]
    below = (low[0] - believed["damped"], low[1] - margin)
    return all(least <= own <= most + margin for own, least, most in zip(duty, below, high, strict=True))


@dataclass
class BaselineLearning:
    """Sums of the baseline that is being learned; what no block has shown yet is None."""

    blocks: int = 0
    total: float = 0.0
    flow: float = 0.0
    low: float | None = None
    high: float | None = None
    duty_low: tuple[float, float] | None = None
    duty_high: tuple[float, float] | None = None
    group: list[float] = field(default_factory=list)

    def add(self, g: float, flow: float, duty: tuple[float, float], group: int) -> None:
        """Take a block's conductance, flow of a unit of it [L/min] and duty; means are of `group` blocks."""
        self.blocks += 1
        self.total += g
        self.flow += flow
        low, high = self.duty_low or duty, self.duty_high or duty
        self.duty_low = min(low[0], duty[0]), min(low[1], duty[1])
        self.duty_high = max(high[0], duty[0]), max(high[1], duty[1])
        self.group.append(g)
        if len(self.group) == group:
            mean = sum(self.group) / group
            self.low = mean if self.low is None else min(self.low, mean)
            self.high, self.group = mean if self.high is None else max(self.high, mean), []

    def frozen(self, version: int, at: float, hours: float, litres: bool) -> WatchBaseline:
        """Return the baseline of one block or more."""
        assert self.duty_low is not None and self.duty_high is not None
        level = self.total / self.blocks
        low = min(self.group) if self.low is None else self.low  # shorter than one group
        high = max(self.group) if self.high is None else self.high
        lpm = level * self.flow / self.blocks if litres else None
        return WatchBaseline(version, at, hours, level, low, high, lpm, self.duty_low, self.duty_high)
