"""Observables and a leak's measure by hand, for what is decided of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sealscope.diagnosis.inference.comparison.rise import Rise
from sealscope.diagnosis.inference.observable import Flow, LeakRise, Observable
from sealscope.diagnosis.inference.onset import Information, Interval, StepTest, step_test
from sealscope.diagnosis.verdict.evidence import Cause, TotalLeakage

#: Flow of the pump, and of a step of one [m^3/s]; L/min of 1 m^3/s.
PUMP_FLOW, DRIVING, LITRES = 1e-4, 1e-7, 6e4


def observable(key: str, chance: float, onset: float | None = 60.0, **values: Any) -> Observable:
    """Make the observable of "data: name" with an onset that is known to a second."""
    data, name = key.split(": ")
    when = None if onset is None else Interval(onset, onset - 1.0, onset + 1.0)
    return Observable(name=name, data=data, score=-2.0 * np.log(chance), chance=chance, onset=when, **values)


def step(size: float, blocks: int = 40, seed: int = 0) -> StepTest:
    """Test blocks of unit noise for a step of a size half-way."""
    values = np.random.default_rng(seed).standard_normal(blocks)
    values[blocks // 2 :] += size
    test = step_test(Information(3.0 * np.arange(blocks) + 1.5, np.eye(blocks), values, slope=1.0, walk=1.0))
    assert test is not None
    return test


@dataclass(frozen=True, eq=False)
class MeasuredLeak:
    """A leak as a provider would measure it (`observable.LeakMeasure`)."""

    step: StepTest | None = None
    rise: Rise | None = None
    excess: float | None = None
    bound: float = 2e-7
    provider: str = "volume balance"
    cause: Cause = "piston or pump leak"
    lpm_per_flow: float | None = LITRES
    size_deviation: float = 0.0
    ratio: None = None
    remarks: tuple[()] = ()
    rise_onset: Interval | None = None
    flow_factors: tuple[float, float] = (1.0, 1.0)
    flow_per_conductance: float = DRIVING
    pump_flow: tuple[float, float] = (PUMP_FLOW, PUMP_FLOW)

    @property
    def step_flow(self) -> Flow:
        size, deviation = (0.0, 1.0) if self.step is None else self.step.fitted
        return Flow(size * DRIVING, deviation * DRIVING)

    @property
    def step_rise(self) -> LeakRise | None:
        size = 0.0 if self.step is None else 0.5 * self.step.fitted[0]
        return None if self.rise is None else LeakRise(self.rise, self.rise.log_ratio(size))

    @property
    def rise_flow(self) -> Flow | None:
        return None if self.rise is None else Flow(self.rise.value * DRIVING, self.rise.deviation * DRIVING)

    @property
    def bound_flow(self) -> float:
        return self.bound

    def relative(self, flow: Flow) -> None:
        return None

    def total(self, detectable_flow: float | None) -> TotalLeakage:
        return TotalLeakage(lpm=0.01, interval_lpm=(0.009, 0.011), pressure=1e5, healthy_lpm=0.001)

    def history(self, onset_s: float | None) -> None:
        return None
