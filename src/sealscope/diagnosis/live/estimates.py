"""What a watch gives and compares with: an estimate of every block, the leak that its tests show, and the baseline.

The baseline is learned over stated hours of healthy running, then frozen, with a version.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.live.sequential import StepEstimate
from sealscope.diagnosis.priors import priors

Interval = tuple[float, float]
Duty = tuple[float, float]


@dataclass(frozen=True)
class BlockEstimate:
    """Estimate of one block.

    `number`: blocks so far, with this one; `t`: its end [s]; `status`: "learning", "watched", "alarm", or why it is not
    judged ("at standstill", "missing values", ...); `total_lpm`: flow past pump and piston together, `leak_lpm`: beyond
    that of the healthy machine, each with a 95 % interval, in which the oil may have warmed [L/min], None where it is
    not known.
    """

    number: int
    t: float
    status: str
    total_lpm: float | None = None
    total_interval_lpm: Interval | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: Interval | None = None

    @property
    def judged(self) -> bool:
        """True if the block was compared with the machine before it."""
        return self.status in ("learning", "watched", "alarm")


@dataclass(frozen=True)
class WatchedLeak:
    """A leak that the tests show, until `dismiss` or `relearn` is called.

    `raised_s`: clock when it was first shown, `onset_s`: since when it leaks [s], `leak_lpm`: its size when it was
    shown [L/min], both with 95 % intervals; `conductance_before`, `conductance_before_sd`: that before the onset and
    its deviation [m^3/(s Pa)]; `test`, `cause`, `reason`: which test shows it, where the oil goes, and why, in one
    line; `score`, `threshold`: of the test's statistic.
    """

    raised_s: float
    onset_s: float
    onset_interval_s: Interval
    leak_lpm: float | None
    leak_interval_lpm: Interval | None
    conductance_before: float
    conductance_before_sd: float
    test: str
    cause: str
    reason: str
    score: float
    threshold: float

    @property
    def rarity(self) -> float:
        """Share of the stated false-alarm rate at which a healthy machine shows such a score, from 1e-9 to 1.

        For a level by the normal tail; for a step half the score is the logarithm of an e-value (`sequential`).
        """
        from scipy.special import log_ndtr

        if self.test == "level":
            exponent = float(log_ndtr(-self.score) - log_ndtr(-self.threshold))
        else:
            exponent = 0.5 * (self.threshold - self.score)
        return math.exp(min(0.0, max(exponent, math.log(1e-9))))


@dataclass(frozen=True)
class HealthyLevel:
    """Leakage conductance of a machine in its healthy recordings, which a watch begins with.

    `level`, `low`, `high`: mean, least and largest of the recordings', `deviation` of one of them [m^3/(s Pa)];
    `known_s`: when the last of them was made [s since 1970].
    """

    level: float
    low: float
    high: float
    deviation: float
    known_s: float


@dataclass(frozen=True)
class WatchBaseline:
    """A healthy machine, as it was while the baseline was learned.

    `version`: 1 for the first, one more after each repair; `learned_s`: clock when it was complete [s]; `hours` of
    operation that it rests on; `level`, `low`, `high`: conductance of pump and piston, its mean, and least and largest
    mean of successive blocks [m^3/(s Pa)]; `lpm`: the mean as a flow under the pressure difference learned with
    [L/min], None where that cannot be stated; `duty_low`, `duty_high`: least and largest logarithm of mean pressure
    difference [Pa] and of rms flow of the pump [m^3/s].
    """

    version: int
    learned_s: float
    hours: float
    level: float
    low: float
    high: float
    lpm: float | None
    duty_low: Duty
    duty_high: Duty

    def rise(self, now: float, g: float, deviation: float, probability: float) -> StepEstimate | None:
        """Estimate the rise of a mean conductance that warm oil cannot explain; None where there is none.

        The ceiling is the least conductance of the baseline with the warmest oil.

        `deviation`: of `g`; `probability`: of a look at a healthy machine as warm as that.
        """
        return estimate_rise(self, "baseline", (now, self.learned_s, now), g, deviation, probability)


def estimate_rise(
    healthy: HealthyLevel | WatchBaseline,
    name: str,
    onset: tuple[float, float, float],
    g: float,
    deviation: float,
    probability: float,
) -> StepEstimate | None:
    """Estimate the rise of a mean conductance over a healthy level called `name`, as `WatchBaseline.rise` does.

    `onset`: since when, and its interval [s], where there is a rise.
    """
    from scipy.special import ndtri

    warmest = priors("inference")["oil"]["warmest"]
    ceiling = warmest * max(healthy.low, 0.0)
    score, threshold = (g - ceiling) / deviation, -float(ndtri(probability))
    if score <= threshold:
        return None
    reason = (
        f"the leakage conductance is {g:.3g} m^3/(s Pa), over {warmest:g} times the least of the {name}: more than the "
        f"warmest oil makes of it (score {score:.1f}, threshold {threshold:.1f})"
    )
    # what is healthy may be anywhere from the least to the ceiling
    spread = max(healthy.level - healthy.low, ceiling - healthy.level, 0.0) / WITHIN_95
    size = g - max(healthy.level, 0.0)
    return StepEstimate(score, onset, size, math.hypot(deviation, spread), "level", threshold, reason)


def within(duty: Duty, low: Duty, high: Duty) -> bool:
    """Test whether a duty lies between two others, within a margin; a leak may take more of the pressure."""
    believed = priors("live")["watch"]
    margin = believed["margin"]
    below = (low[0] - believed["damped"], low[1] - margin)
    return all(least <= value <= most + margin for value, least, most in zip(duty, below, high, strict=True))


@dataclass
class BaselineLearning:
    """Sums of the baseline during learning; None where no block gave a value yet."""

    blocks: int = 0
    total: float = 0.0
    flow: float = 0.0
    low: float | None = None
    high: float | None = None
    duty_low: Duty | None = None
    duty_high: Duty | None = None
    group: list[float] = field(default_factory=list)

    def add(self, g: float, flow: float, duty: Duty, group: int) -> None:
        """Add a block's conductance, flow of a unit of it [L/min] and duty; means are of `group` blocks."""
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

    def frozen(self, version: int, end: float, hours: float, litres: bool) -> WatchBaseline:
        """Return the baseline of one block or more."""
        assert self.duty_low is not None and self.duty_high is not None
        level = self.total / self.blocks
        low = min(self.group) if self.low is None else self.low  # shorter than one group
        high = max(self.group) if self.high is None else self.high
        lpm = level * self.flow / self.blocks if litres else None
        return WatchBaseline(version, end, hours, level, low, high, lpm, self.duty_low, self.duty_high)
