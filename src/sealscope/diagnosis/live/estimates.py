"""Results of a watch: estimates of each block, a detected leak, and the healthy machine that both are compared with.

The baseline is learned over a stated number of hours of healthy running. It is then frozen and has a version number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sealscope.diagnosis.estimate.interval import WITHIN_95, Estimate
from sealscope.diagnosis.estimate.interval import Interval as EstimatedInterval
from sealscope.diagnosis.inference.comparison import Rise
from sealscope.diagnosis.live.sequential import LEVEL, LiveRise
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Array

Interval = tuple[float, float]
#: Load and motion in a block: logarithms of its mean |p_A - p_B| [Pa] and mean pump flow [m^3/s].
Duty = tuple[float, float]
#: Blocks per mean that is compared with the baseline.
GROUP: int = LIVE.watch.group


@dataclass(frozen=True)
class BlockEstimate:
    """Leakage of a running machine in one block.

    Flows and 95 % intervals are None if unknown. After an alarm, the interval of `leak_lpm` allows for colder or warmer
    oil.

    Attributes
    ----------
    number, t : int, float
        Number of blocks so far, including this one, and end of the block [s].
    status : str
        "learning", "watched" or "alarm", or the reason why the block is not judged, such as "at standstill".
    total_lpm, total_interval_lpm : float and pair of floats, or None
        Flow past pump and piston together, and its interval [L/min].
    leak_lpm, leak_interval_lpm : float and pair of floats, or None
        Leak: increase of that flow over the healthy machine, or of a leak to the outside what leaves the chamber, and
        its interval [L/min].
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
        """True if the leakage of the block was estimated and tested, also while the baseline is learned."""
        return self.status in ("learning", "watched", "alarm")


@dataclass(frozen=True)
class WatchedLeak:
    """A leak that a test has detected; it stays until `Watch.dismiss` or `Watch.relearn` is called.

    Attributes
    ----------
    raised_s : float
        Time of the alarm [s].
    onset_s, onset_interval_s : float and pair of floats
        Time at which the leak began, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, or None
        Size of the leak at the alarm, and its 95 % interval [L/min].
    conductance_before : float
        Leakage conductance before the onset [m^3/(s Pa)].
    rise, rise_sd : float
        Increase of the conductance, and its standard deviation [m^3/(s Pa)].
    pressure : float
        Mean absolute pressure difference p_A - p_B [Pa].
    test, score, threshold : str, float, float
        Test that detected the leak, "step" or "level", its score and threshold (`sequential.LiveRise`).
    cause, reason : str
        Path of the leaking oil, and reason for the alarm in one line.
    is_settled : bool
        True if the `cause` rests on enough blocks after the onset to tell a leak to the outside.
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
    is_settled: bool = False

    @property
    def estimate(self) -> LiveRise:
        """Result of the test that detected the leak: score, onset, and increase of the conductance [m^3/(s Pa)]."""
        onset = EstimatedInterval(self.onset_s, *self.onset_interval_s)
        return LiveRise(self.test, self.score, onset, self.rise, self.rise_sd)

    @property
    def allowed(self) -> float:
        """The p-value of the test at its `threshold`: the allowed probability, or less (`sequential.StepNull`)."""
        return LiveRise(self.test, self.threshold).chance

    @property
    def rarity(self) -> float:
        """Ratio of the test's p-value to the `allowed` false-alarm probability, limited to 1e-9 to 1."""
        log_ratio = self.estimate.log_chance - LiveRise(self.test, self.threshold).log_chance
        return math.exp(min(0.0, max(log_ratio, math.log(1e-9))))


@dataclass(frozen=True)
class HealthyLevel:
    """Leakage conductance of a healthy machine, from recordings or from groups of blocks.

    Attributes
    ----------
    level, low, high, deviation : float
        Mean, minimum, maximum and standard deviation over recordings or groups of blocks [m^3/(s Pa)].
    known_s : float
        Time until which the machine is known to be healthy [s]; for recordings the start of the last one.
    count : int
        Number of recordings or groups of blocks.
    """

    level: float
    low: float
    high: float
    deviation: float
    known_s: float
    count: int


@dataclass(frozen=True)
class WatchBaseline(HealthyLevel):
    """Leakage, pressure difference and flow of the healthy machine, measured while the baseline was learned.

    Attributes
    ----------
    version, hours : int, float
        1 for the first baseline, increased by one whenever it is learned anew; operating time of learning [h].
    lpm : float or None
        The mean conductance `level` as a flow at the mean pressure difference [L/min], None if it cannot be stated.
    duty_low, duty_high : Duty
        Minimum and maximum over the blocks, of either quantity.
    short_term_deviation : float or None
        Standard deviation of a group of blocks, by the differences of successive groups [m^3/(s Pa)]. Oil that warms
        adds to `deviation`, but hardly to this. None if errors of the estimates change slowly as well.
    """

    version: int
    hours: float
    lpm: float | None
    duty_low: Duty
    duty_high: Duty
    short_term_deviation: float | None


def find_level_rise(
    healthy: HealthyLevel, onset: EstimatedInterval, g: float, deviation: float, probability: float
) -> LiveRise | None:
    """Find a rise of the mean conductance above that of the healthy machine; None if it is not significant.

    `g` and `deviation` are the mean conductance and its standard error [m^3/(s Pa)]; `onset` is copied to the result.
    Two tests must both be significant at the false-alarm `probability`:

    - g against the lowest healthy mean, increased for the warmest oil (normal distribution),
    - g against the average of the healthy means, at least two, given their scatter (Student's t with Welch's degrees of
      freedom). If they are those of a baseline, whose course shows how much of the scatter slow changes of the oil may
      be, the first test with the rest of the scatter is enough, too (`_unexplained_scatter`; twice the smaller p-value
      of both counts).
    """
    from scipy.special import ndtr, ndtri

    if healthy.count < 2:
        return None
    max_healthy = INFERENCE.oil.warmest * max(healthy.low, 0.0)
    # one more healthy mean scatters about the average
    chance = _rise_above(healthy.level, healthy.deviation * math.sqrt(1.0 + 1.0 / healthy.count), healthy, g, deviation)
    if isinstance(healthy, WatchBaseline) and healthy.short_term_deviation is not None:
        scatter = _unexplained_scatter(healthy, healthy.short_term_deviation, max_healthy)
        chance = min(1.0, 2.0 * min(chance, _rise_above(max_healthy, scatter, healthy, g, deviation)))
    chance = max(float(ndtr((max_healthy - g) / deviation)), chance)
    if chance >= probability:
        return None
    # the present healthy conductance may be anywhere from the lowest healthy mean to `max_healthy`
    healthy_sd = max(healthy.level - healthy.low, max_healthy - healthy.level, 0.0) / WITHIN_95
    size = g - max(healthy.level, 0.0)
    score = -float(ndtri(max(chance, 1e-300)))  # finite for a chance of 0
    return LiveRise(LEVEL, score, onset, size, deviation=math.hypot(deviation, healthy_sd))


def _rise_above(limit: float, scatter: float, healthy: HealthyLevel, g: float, deviation: float) -> float:
    """Compute the p-value of a mean `g` above a `limit`, which has the standard deviation `scatter` by `healthy` means.

    `deviation`: standard error of `g`. All are in m^3/(s Pa).
    """
    variance = deviation**2 + scatter**2
    degrees_of_freedom = (healthy.count - 1) * (variance / max(scatter**2, np.finfo(float).tiny)) ** 2
    degrees_of_freedom = min(degrees_of_freedom, 1e9)  # beyond it Student's t is normal
    return Rise(g - limit, deviation=math.sqrt(variance), degrees_of_freedom=degrees_of_freedom).chance


def _unexplained_scatter(healthy: HealthyLevel, short_term_deviation: float, max_healthy: float) -> float:
    """Compute the scatter of the ceiling `max_healthy` that no oil explains [m^3/(s Pa)].

    Oil explains slow changes between the lowest `healthy` group of blocks and `max_healthy`. It explains neither the
    differences of successive groups, which the lowest group has as an error, nor higher groups, nor the day-to-day
    differences of a pump's leakage.
    """
    excess = max(healthy.high - max_healthy, 0.0)
    daily = INFERENCE.held_oil.pump_session * max_healthy
    return math.hypot(INFERENCE.oil.warmest * short_term_deviation, excess, daily)


def level_before_leak(leak: WatchedLeak, t: float) -> EstimatedInterval:
    """Estimate the conductance without the leak at time `t` [s]: that before its onset, with limits for other oil.

    Warming of the oil raises a conductance by the factor `warmest` at most, which takes the time `shift` [h] (table
    `oil` of `priors.toml`); cooling lowers it as much. A negative conductance is an error of the estimate: the limits
    are then the conductance itself and 0.
    """
    oil, before = INFERENCE.oil, leak.conductance_before
    hours = max(0.0, t - leak.onset_s) / 3600.0
    max_ratio = float(oil.warmest ** min(1.0, hours / oil.shift))
    return EstimatedInterval(before, min(before, before / max_ratio), max(before, 0.0) * max_ratio)


def mean_flow(flows: Array, errors: Array) -> Estimate:
    """Compute the mean of n `flows`, whose standard error is due to their own `errors` and to their scatter."""
    count = len(flows)
    scatter = float(flows.std(ddof=1)) / math.sqrt(count) if count > 1 else 0.0
    return Estimate(float(flows.mean()), math.hypot(math.sqrt(float(np.sum(errors**2))) / count, scatter))


def is_known_duty(duty: Duty, low: Duty, high: Duty) -> bool:
    """Return True if a `duty` is in the range from `low` to `high`, extended by a margin.

    The margin towards low pressures is larger, because a leak lowers the pressure difference.
    """
    margin = LIVE.watch.margin
    (pressure, flow), (min_pressure, min_flow), (max_pressure, max_flow) = duty, low, high
    return (
        min_pressure - LIVE.watch.damped <= pressure <= max_pressure + margin
        and min_flow - margin <= flow <= max_flow + margin
    )


@dataclass
class BaselineLearning:
    """Running sums over blocks, from which the baseline of a watch is computed."""

    blocks: int = 0  # number of blocks
    total: float = 0.0  # sum of the blocks' conductances [m^3/(s Pa)]
    flow: float = 0.0  # sum of the blocks' flows at a conductance of 1 [L/min per m^3/(s Pa)]
    # minimum and maximum of either quantity of the duty so far
    duty_low: Duty | None = None
    duty_high: Duty | None = None
    group: list[float] = field(default_factory=list)  # conductances of an incomplete group of `GROUP` blocks
    count: int = 0  # number of complete groups
    # mean of the group means, and sum of their squared deviations from it
    mean: float = 0.0
    squares: float = 0.0
    # last group mean, and sum of the squared differences of successive ones
    last: float | None = None
    square_differences: float = 0.0
    # smallest and largest group mean
    low: float | None = None
    high: float | None = None

    def add(self, g: float, flow: float, duty: Duty) -> None:
        """Add a block: its conductance `g` [m^3/(s Pa)], `flow` at a conductance of 1 [L/min] and `duty`."""
        self.blocks += 1
        self.total += g
        self.flow += flow
        pressure, pump_flow = duty
        min_pressure, min_flow = self.duty_low or duty
        max_pressure, max_flow = self.duty_high or duty
        self.duty_low = min(min_pressure, pressure), min(min_flow, pump_flow)
        self.duty_high = max(max_pressure, pressure), max(max_flow, pump_flow)
        self.group.append(g)
        if len(self.group) == GROUP:
            mean = sum(self.group) / GROUP
            self.group = []
            self.low = mean if self.low is None else min(self.low, mean)
            self.high = mean if self.high is None else max(self.high, mean)
            self.square_differences += 0.0 if self.last is None else (mean - self.last) ** 2
            self.last = mean
            # Welford's recursion of mean and sum of squared deviations
            self.count += 1
            difference = mean - self.mean
            self.mean += difference / self.count
            self.squares += difference * (mean - self.mean)

    def freeze(self, version: int, end: float, hours: float, *, states_litres: bool) -> WatchBaseline:
        """Compute the baseline from the sums over at least `GROUP` blocks, the last of which ends at `end` [s].

        `states_litres`: true if flows are in L/min.
        """
        assert self.duty_low and self.duty_high and self.low is not None and self.high is not None
        level = self.total / self.blocks
        lpm = level * (self.flow / self.blocks) if states_litres else None
        # standard deviation between the `count` groups of blocks
        deviation, short_term = 0.0, None
        if self.count > 1:
            deviation = math.sqrt(self.squares / (self.count - 1))
            short_term = math.sqrt(0.5 * self.square_differences / (self.count - 1))  # J. von Neumann's estimate
        healthy = HealthyLevel(level, self.low, self.high, deviation, known_s=end, count=self.count)
        return WatchBaseline(
            **vars(healthy),
            version=version,
            hours=hours,
            lpm=lpm,
            duty_low=self.duty_low,
            duty_high=self.duty_high,
            short_term_deviation=short_term,
        )
