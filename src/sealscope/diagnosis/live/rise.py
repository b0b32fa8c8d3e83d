"""A rise of the conductance in a stream, with its test, and its verdict by the one decision (`decision.decide`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.decision.null import HealthyNull
from sealscope.diagnosis.inference.observable import Flow, Observed, Remark
from sealscope.diagnosis.inference.onset import Interval
from sealscope.diagnosis.verdict.evidence import Cause, Evidence

#: Name of the watch as a provider, and of its tests: for a step within the stream, and over a healthy level.
WATCH, STEP, LEVEL = "watch", "step", "level"
_UNDATED = Interval(math.nan, math.nan, math.nan)


class LiveRise(NamedTuple):
    """A rise of the conductance in a stream, with its test (`observable.DatedTest`).

    `test`: "step" or "level"; `score`: for a step twice the logarithm of an e-value, for a level a normal quantile;
    `interval`: onset with its 95 % interval [s]; `size`, `deviation`: the rise and its standard deviation [m^3/(s Pa)].
    """

    test: str
    score: float
    interval: Interval = _UNDATED
    size: float = 0.0
    deviation: float = math.inf

    @property
    def log_chance(self) -> float:
        """Logarithm of the largest probability that a healthy machine scores this high (for a step, Ville's bound)."""
        from scipy.special import log_ndtr

        return -0.5 * max(self.score, 0.0) if self.test == STEP else float(log_ndtr(-self.score))

    @property
    def chance(self) -> float:
        """Largest probability that a healthy machine scores this high."""
        return math.exp(self.log_chance)

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy machine exceeds with at most the probability `chance`."""
        from scipy.special import ndtri

        return -2.0 * math.log(chance) if self.test == STEP else -float(ndtri(chance))

    def onset(self) -> Interval:
        """Return the onset [s] with its 95 % interval."""
        return self.interval

    def detectable_step(self, chance: float) -> float:
        """Return infinity, as the smallest detectable step depends on the stream's random walk and is not known."""
        return math.inf


@dataclass(frozen=True, eq=False)
class LiveLeak:
    """The leakage of a watched machine (`observable.LeakMeasure`).

    `test`: rise that a test has shown, or a step that is no alarm; `flow_per_conductance`: mean of abs(p_A - p_B) [Pa].
    """

    test: LiveRise
    cause: Cause
    flow_per_conductance: float
    flow_factors: tuple[float, float]
    bound_flow: float
    pump_flow: tuple[float, float]
    lpm_per_flow: float | None
    size_deviation: float
    provider: str = WATCH
    excess: None = None
    step_rise: None = None
    ratio: Interval | None = None
    remarks: tuple[Remark, ...] = ()

    @property
    def step(self) -> LiveRise | None:
        """Test of a step within the stream."""
        return self.test if self.test.test == STEP else None

    @property
    def rise(self) -> LiveRise | None:
        """Test of the level over that of the healthy machine."""
        return self.test if self.test.test == LEVEL else None

    @property
    def step_flow(self) -> Flow:
        """Mean flow of the rise [m^3/s], with its standard deviation."""
        pressure = self.flow_per_conductance
        return Flow(self.test.size * pressure, self.test.deviation * pressure)

    rise_flow = step_flow

    @property
    def rise_onset(self) -> Interval:
        """Onset of the rise over the healthy level."""
        return self.test.interval

    def relative(self, flow: Flow) -> None:
        """Return None: a stream states no flow relative to the pump's."""

    def total(self, detectable_flow: float | None) -> None:
        """Return None: each block's estimate states the total leakage."""

    def history(self, onset_s: float | None) -> None:
        """Return None: the blocks' estimates are the history."""


def decide_on_stream(leak: LiveLeak | None, false_alarm_probability: float, lack: str = "") -> Evidence:
    """Decide whether a watched machine leaks; `lack`: why there is no estimate of its `leak`, in one line.

    Rivals of the leak are not weighed here, but once, when its test raises an alarm (`explanation`).
    """
    report = Observed(WATCH, lack=lack, leak=leak)
    return decide(report, (), HealthyNull(), false_alarm_probability, weigh_rivals=False)
