"""Leaks of closed chambers: their laws, their flows with a coefficient of 1, and the results of fits."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.inference.leak_flow import mixture_flow
from sealscope.recordings.recording import Array

#: Standard deviation of a leak without information.
UNKNOWN = 1e30


class SideSupply(Enum):
    """Connection of a side of the cylinder to the charge line while valves hold the load.

    `SHUT`: none; `CHECK`: a check valve, which refills the side while it is at the charge pressure; `OPEN`: a line that
    takes and gives oil at any time.
    """

    SHUT = "shut"
    CHECK = "check valve"
    OPEN = "open"


#: Supplies of the sides A and B.
SideSupplies = tuple[SideSupply, SideSupply]
NEITHER: SideSupplies = (SideSupply.SHUT, SideSupply.SHUT)
BOTH: SideSupplies = (SideSupply.CHECK, SideSupply.CHECK)


class UnitLeak(NamedTuple):
    """Flow of a leak with a coefficient of 1 while shut valves hold the load.

    `flows` (2, N): at the N samples of all holds, one after the other, the flow out of A (first row) and out of B, in
    Pa^e for the exponent e of the law (laminar: 1), 0 while the side's supply replaces or takes the oil; `supplies`:
    those of A and B.
    """

    flows: Array
    supplies: SideSupplies = NEITHER


class HeldLeaks(NamedTuple):
    """Mean conductances of three leaks over a recording with holds, each with its standard deviation [m^3/(s Pa)].

    They are past the `piston`, and to the outside from A and from B, as measured with the pump's assumed displacement.
    """

    piston: float
    deviation: float
    outside_A: float
    deviation_A: float
    outside_B: float
    deviation_B: float


class PistonLeak(NamedTuple):
    """A leak past the piston: its flow is a coefficient times |p_A - p_B - z|^`exponent`, with the sensor offset z.

    `growth`: relative increase of the coefficient from the `onset` [s] to the end of the recording; `offset`: z [Pa];
    `supplies`: those of A and B.
    """

    exponent: float = 1.0
    growth: float = 0.0
    onset: float = 0.0
    offset: float = 0.0
    supplies: SideSupplies = NEITHER


class LeakFit(NamedTuple):
    """Fitted coefficient of a leak, its `value` [m^3/(s Pa^e)] for the exponent e of the leak's law.

    It has two standard deviations: `deviation` due to noise, and `by_oil` due to the uncertain properties of the oil.
    """

    value: float
    deviation: float
    by_oil: float
    log_likelihood: float

    def scale(self, factor: float, log_likelihood: float) -> LeakFit:
        """Multiply coefficient and standard deviations (except `UNKNOWN`) by a `factor`; set the `log_likelihood`."""
        deviation = factor * self.deviation if self.deviation < UNKNOWN else UNKNOWN
        return LeakFit(factor * self.value, deviation, factor * self.by_oil, log_likelihood)


class LawFit(NamedTuple):
    """Fitted coefficient of a `leak` past the piston with one law, i.e. one exponent and one growth.

    `log_weight`: log likelihood of the fit plus the log prior probability of the law.
    """

    leak: PistonLeak
    fit: LeakFit
    log_weight: float


class LeakHypothesis(NamedTuple):
    """A possible leak: its `probability`, the fraction of the recording's time after its onset, and its `fit`."""

    probability: float
    fraction_after: float
    fit: LeakFit

    @property
    def mean(self) -> float:
        """Expected mean conductance over the recording: the fitted one times its probability and `fraction_after`."""
        return self.probability * self.fraction_after * self.fit.value


def growth_factor(t: Array, growth: float, onset: float, end: float) -> Array:
    """Compute the coefficient of a growing leak at times `t` (n,) [s], relative to its value at the `onset` [s].

    It is 1 before the onset, and grows linearly to 1 + `growth` at the `end` of the recording [s].
    """
    return 1.0 + growth * np.clip((t - onset) / max(end - onset, np.finfo(float).tiny), 0.0, 1.0)


def flow_of_side(flow: Array, is_A: bool) -> Array:
    """Arrange a flow (n,) out of side A, or out of B if `is_A` is False, as the flows out of both sides, (2, n)."""
    no_flow = np.zeros_like(flow)
    return np.array([flow, no_flow] if is_A else [no_flow, flow])


def average_fits(fits: Sequence[LeakFit]) -> Estimate:
    """Average alternative fits of a leak by their likelihoods; the deviation includes noise and uncertain oil."""
    values, deviations, by_oil, log_likelihoods = np.array(fits).T
    return mixture_flow(weigh_alternatives(log_likelihoods), values, np.hypot(deviations, by_oil))
