"""Observables and a leak's measure by hand, for what is decided of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.diagnosis.estimate.change import Information, StepTest, step_test
from sealscope.diagnosis.estimate.interval import Estimate, Interval
from sealscope.diagnosis.inference.comparison import Rise
from sealscope.diagnosis.inference.observable import LeakMeasure, LeakRise, Observable
from sealscope.diagnosis.verdict.evidence import TotalLeakage

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


def measured_leak(
    step: StepTest | None = None, rise: Rise | None = None, bound_flow: float = 2e-7, **fields: Any
) -> LeakMeasure:
    """Measure a leak as a detector would, with a flow of `DRIVING` per unit of a step and of a rise."""
    step_size, step_deviation = (0.0, 1.0) if step is None else step.fitted
    return LeakMeasure(
        provider="volume balance",
        cause="piston or pump leak",
        step=step,
        step_flow=Estimate(step_size * DRIVING, step_deviation * DRIVING),
        rise=rise,
        rise_flow=None if rise is None else Estimate(rise.value * DRIVING, rise.deviation * DRIVING),
        step_rise=None if rise is None else LeakRise(rise, rise.log_ratio(0.5 * step_size)),
        bound_flow=bound_flow,
        flow_per_conductance=DRIVING,
        pump_flow=(PUMP_FLOW, PUMP_FLOW),
        total_leakage=TotalLeakage(lpm=0.01, interval_lpm=(0.009, 0.011), pressure=1e5, healthy_lpm=0.001),
        lpm_per_flow=LITRES,
        **fields,
    )
