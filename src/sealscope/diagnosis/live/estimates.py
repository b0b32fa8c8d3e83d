"""Estimates of a watch: of every block, of a leak, and of the healthy machine that they are compared with.

The baseline is learned over stated hours of healthy running, then frozen, with a version.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sealscope.diagnosis.inference.observable import Flow
from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.inference.onset import Interval as Onset
from sealscope.diagnosis.inference.scatter import Rise
from sealscope.diagnosis.live.rise import LEVEL, LiveRise
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Array

Interval = tuple[float, float]
Duty = tuple[float, float]
#: Blocks per mean that is compared with the baseline.
GROUP: int = LIVE.watch.group


@dataclass(frozen=True)
class BlockEstimate:
    """Estimate of one block.

    `number`: count of blocks, including this one; `t`: end of the block [s]; `status`: "learning", "watched", "alarm",
    or the reason why it is not judged ("at standstill", "missing values", ...); `total_lpm`: flow past pump and piston
    together [L/min]; `leak_lpm`: its rise over the healthy machine [L/min]. Each has a 95 % interval that allows for
    warmer oil, and is None if unknown.
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
        """True if the block has an estimate that is tested, also while the baseline is learned."""
        return self.status in ("learning", "watched", "alarm")


@dataclass(frozen=True)
class WatchedLeak:
    """A leak that a test has detected, present until `dismiss` or `relearn` is called.

    `raised_s`: time of the alarm [s]; `onset_s`: start of the leak [s], `leak_lpm`: its size at the alarm [L/min], both
    with 95 % intervals; `conductance_before`: conductance before the onset, `rise`: increase of it, `rise_sd`: standard
    deviation of the increase [m^3/(s Pa)]; `pressure`: mean pressure difference [Pa]; `test`: "step" or "level";
    `cause`: path of the leaking oil; `reason`: one line of text; `score`, `threshold`: of the test (`rise.LiveRise`).
    """

    raised_s: float
    onset_s: float
    onset_interval_s: Interval
    leak_lpm: float | None
    leak_interval_lpm: Interval | None
    conductance_before: float
    rise: float
    rise_sd: float
    pressure: float
    test: str
    cause: Cause
    reason: str
    score: float
    threshold: float

    @property
    def estimate(self) -> LiveRise:
        """The rise with its test."""
        onset = Onset(self.onset_s, *self.onset_interval_s)
        return LiveRise(self.test, self.score, onset, self.rise, self.rise_sd)

    @property
    def allowed(self) -> float:
        """False-alarm probability of the test."""
        return LiveRise(self.test, self.threshold).chance

    @property
    def rarity(self) -> float:
        """Chance of the score in a healthy machine, as a fraction of the test's allowed chance, 1e-9 to 1."""
        exponent = self.estimate.log_chance - LiveRise(self.test, self.threshold).log_chance
        return math.exp(min(0.0, max(exponent, math.log(1e-9))))


@dataclass(frozen=True)
class HealthyLevel:
    """Leakage conductance of a healthy machine in `count` recordings, or means of successive blocks.

    `level`, `low`, `high`, `deviation`: mean, minimum, maximum and standard deviation of these [m^3/(s Pa)]; `known_s`:
    time until which the machine is known to be healthy [s], with recordings the start of the last one.
    """

    level: float
    low: float
    high: float
    deviation: float
    known_s: float
    count: int


@dataclass(frozen=True)
class WatchBaseline(HealthyLevel):
    """Leakage and duty of the healthy machine while the baseline was learned.

    `version`: 1 for the first baseline, increased by one after each repair; `hours`: learning time in operating hours;
    `lpm`: `level` as a flow at the mean pressure difference [L/min], None if it cannot be stated; `duty_low`,
    `duty_high`: minima and maxima of the logarithms of mean pressure difference [Pa] and mean flow of the pump [m^3/s].
    """

    version: int
    hours: float
    lpm: float | None
    duty_low: Duty
    duty_high: Duty


def find_level_rise(
    healthy: HealthyLevel, onset: Onset, g: float, deviation: float, probability: float
) -> LiveRise | None:
    """Estimate the rise of a mean conductance over a healthy level; None if it is not significant.

    `g`, `deviation`: conductance and its standard error [m^3/(s Pa)]; `onset`: onset to state for the rise. Two tests
    must both be significant at the false-alarm `probability`. The first compares g with the lowest healthy mean,
    increased for the warmest oil. The second compares g with the average of the healthy means by their scatter
    (Student's t, Welch's degrees of freedom). None also for fewer than two healthy means.
    """
    from scipy.special import ndtr, ndtri

    if healthy.count < 2:
        return None
    max_healthy = INFERENCE.oil.warmest * max(healthy.low, 0.0)
    scatter = healthy.deviation**2 * (1.0 + 1.0 / healthy.count)
    variance = deviation**2 + scatter
    degrees_of_freedom = (healthy.count - 1) * (variance / max(scatter, np.finfo(float).tiny)) ** 2
    rise = Rise(g - healthy.level, math.sqrt(variance), min(degrees_of_freedom, 1e9))  # beyond it Student's t is normal
    chance = max(float(ndtr((max_healthy - g) / deviation)), rise.chance)
    if chance >= probability:
        return None
    # the healthy conductance now may be anywhere from the least healthy mean to the largest
    healthy_sd = max(healthy.level - healthy.low, max_healthy - healthy.level, 0.0) / WITHIN_95
    size = g - max(healthy.level, 0.0)
    score = -float(ndtri(max(chance, 1e-300)))  # finite for a chance of 0
    return LiveRise(LEVEL, score, onset, size, math.hypot(deviation, healthy_sd))


def level_before_leak(leak: WatchedLeak, t: float) -> HealthyLevel:
    """Return the conductance before a leak, with its possible range at time `t` [s] due to oil temperature.

    The range widens from the onset on. After `shift` hours it spans from the coldest to the warmest oil.
    """
    oil, hours, before = INFERENCE.oil, max(0.0, t - leak.onset_s) / 3600.0, leak.conductance_before
    max_ratio = float(oil.warmest ** min(1.0, hours / oil.shift))
    low, high = before / max_ratio, max(before, 0.0) * max_ratio
    return HealthyLevel(before, low, high, deviation=leak.rise_sd, known_s=leak.onset_s, count=1)


def mean_flow(flows: Array, errors: Array) -> Flow:
    """Average the flows of blocks [L/min]; the standard error covers their own standard `errors` and their scatter."""
    count = len(flows)
    scatter = float(flows.std(ddof=1)) / math.sqrt(count) if count > 1 else 0.0
    return Flow(float(flows.mean()), math.hypot(math.sqrt(float(np.sum(errors**2))) / count, scatter))


def is_known_duty(duty: Duty, low: Duty, high: Duty) -> bool:
    """Test whether a duty is between `low` and `high`, extended by a margin.

    The margin towards low pressures is larger, as a leak lowers the pressure difference.
    """
    margin = LIVE.watch.margin
    min_duty = (low[0] - LIVE.watch.damped, low[1] - margin)
    return all(lower <= value <= upper + margin for value, lower, upper in zip(duty, min_duty, high, strict=True))


@dataclass
class BaselineLearning:
    """Running sums from which the baseline is computed.

    Over all `blocks` blocks: `total`, sum of the conductances; `flow`, sum of the flows of a unit conductance;
    `duty_low`, `duty_high`, range of the duty. Over the `count` complete groups of `GROUP` blocks: `mean` of the group
    means, sum `squares` of their squared deviations, and their extremes `low`, `high`. `group`: conductances of the
    incomplete group.
    """

    blocks: int = 0
    total: float = 0.0
    flow: float = 0.0
    duty_low: Duty | None = None
    duty_high: Duty | None = None
    group: list[float] = field(default_factory=list)
    count: int = 0
    mean: float = 0.0
    squares: float = 0.0
    low: float | None = None
    high: float | None = None

    def add(self, g: float, flow: float, duty: Duty) -> None:
        """Add a block: its conductance `g` [m^3/(s Pa)], the `flow` of a unit conductance [L/min], and its duty."""
        self.blocks += 1
        self.total += g
        self.flow += flow
        low, high = self.duty_low or duty, self.duty_high or duty
        self.duty_low = min(low[0], duty[0]), min(low[1], duty[1])
        self.duty_high = max(high[0], duty[0]), max(high[1], duty[1])
        self.group.append(g)
        if len(self.group) == GROUP:
            mean, self.group = sum(self.group) / GROUP, []
            self.low = mean if self.low is None else min(self.low, mean)
            self.high = mean if self.high is None else max(self.high, mean)
            # Welford's recursion of mean and sum of squared deviations
            self.count, difference = self.count + 1, mean - self.mean
            self.mean += difference / self.count
            self.squares += difference * (mean - self.mean)

    def freeze(self, version: int, end: float, hours: float, *, states_lpm: bool) -> WatchBaseline:
        """Compute the baseline from the sums, which must contain at least `GROUP` blocks.

        `version`, `hours`: as in `WatchBaseline`; `end`: end of the last block [s]; `states_lpm`: state the level as a
        flow [L/min], too.
        """
        assert self.duty_low and self.duty_high and self.low is not None and self.high is not None
        level = self.total / self.blocks
        lpm = level * self.flow / self.blocks if states_lpm else None
        deviation = math.sqrt(self.squares / (self.count - 1)) if self.count > 1 else 0.0
        period = {"version": version, "hours": hours, "lpm": lpm, "known_s": end}
        duty = {"duty_low": self.duty_low, "duty_high": self.duty_high}
        return WatchBaseline(level, self.low, self.high, deviation, count=self.count, **period, **duty)  # type: ignore[arg-type]
