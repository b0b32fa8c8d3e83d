"""The leak as the response of the pressures measures it: changes of the conductance, whose level states no flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sealscope.diagnosis.inference.observable import Flow, Remark
from sealscope.diagnosis.inference.onset import WITHIN_95, Interval, StepTest, course
from sealscope.diagnosis.inference.pressures.evidence import PRIORS, PressureEvidence, flow_scale
from sealscope.diagnosis.inference.scatter import Rise, student
from sealscope.diagnosis.verdict.evidence import Cause, LeakCourse, RelativeLeak, TotalLeakage
from sealscope.units import LITRE_PER_MINUTE


@dataclass(frozen=True, eq=False)
class ResponseLeak:
    """The leakage of a recording by the response of its pressures (`observable.LeakMeasure`).

    Parameters
    ----------
    provider : str
        Name of the detector.
    reading : PressureEvidence
    levels : sequence of float
        Conductance of healthy recordings of the machine [m^3/(s Pa)].
    """

    provider: str
    reading: PressureEvidence
    levels: Sequence[float] = ()

    #: Without a position what leaves the circuit shows alike.
    cause: Cause = "leak inside or outside"
    ratio: Interval | None = None
    remarks: Sequence[Remark] = ()
    excess: float | None = None
    #: Levels of the conductance lean on the friction: they state no flow.
    rise_flow: Flow | None = None

    @property
    def step(self) -> StepTest | None:
        """Test of a step of the conductance."""
        return self.reading.test

    @property
    def step_flow(self) -> Flow:
        """Mean flow of the step while it lasts, of a law between that of a worn seal and of an orifice."""
        reading, test = self.reading, self.reading.test
        if test is None:
            return Flow(0.0, np.inf)
        pressure, (size, deviation) = float(reading.pressure.mean()), test.fitted
        middle, half = 0.5 * (reading.orifice + 1.0), 0.5 * (reading.orifice - 1.0)
        by_law = half * abs(size) / WITHIN_95
        return Flow(middle * size * pressure, float(np.hypot(middle * deviation, by_law)) * pressure)

    @property
    def step_driving(self) -> float:
        """Mean flow [m^3/s] of a conductance of one, at the recording's pressures."""
        return float(self.reading.pressure.mean())

    @cached_property
    def rise(self) -> Rise | None:
        """Rise of the level of the conductance beyond the healthy recordings, None without any."""
        levels, count = self.levels, len(self.levels)
        if not count:
            return None
        total = sum(levels)
        differences = [level - (total - level) / (count - 1) for level in levels] if count > 1 else [0.0]
        return student(self.reading.level[0] - total / count, differences, PRIORS["conductance"]["level"])

    @property
    def bound_flow(self) -> float:
        """95 % upper bound of the leak's mean flow [m^3/s]."""
        test = self.step if self.rise is None else self.rise
        if test is None:
            return np.inf
        unit = self.reading.orifice * float(self.reading.pressure.mean())
        return test.bound() * unit * (1.0 + WITHIN_95 * flow_scale())

    @property
    def pump_flow(self) -> tuple[float, float]:
        """Mean flow of the pump [m^3/s], twice."""
        return self.reading.pump, self.reading.pump

    @property
    def share_after(self) -> float:
        """Share of what the recording tells of its mean conductance that lies after the step's onset."""
        if self.step is None:
            return 0.0
        information = self.reading.information
        weights = information.precision.sum(axis=0)
        after = information.time >= self.step.onset().value
        return float(np.clip(weights[after].sum() / max(weights.sum(), np.finfo(float).tiny), 0.0, 1.0))

    @property
    def litres(self) -> float | None:
        """L/min of a flow of 1 m^3/s, None where the machine's size is not stated."""
        return 1.0 / LITRE_PER_MINUTE if self.reading.stated else None

    @property
    def size_deviation(self) -> float:
        """Relative standard deviation of the machine's size."""
        return flow_scale()

    def relative(self, flow: Flow) -> RelativeLeak | None:
        """Return None: the pump's flow is not measured."""
        return None

    def total(self, findable: float | None) -> TotalLeakage:
        """Return the smallest step that would have been found; what passes in all is not known from pressures."""
        pump, litres = self.reading.pump, self.litres
        return TotalLeakage(
            lpm=None,
            interval_lpm=None,
            pressure=float(self.reading.pressure.mean()),
            findable_lpm=None if findable is None or litres is None else findable * litres,
            findable_share=None if findable is None or not pump > 0.0 else findable / pump,
        )

    def course(self, onset_s: float | None) -> LeakCourse | None:
        """Return the leak since an onset; None without one."""
        reading, test = self.reading, self.step
        if onset_s is None or test is None or not reading.stated:
            return None
        time = reading.information.time
        growth = course(reading.information, test, step=True).relative_to(time < onset_s)
        unit = reading.pressure * 0.5 * (1.0 + reading.orifice) / LITRE_PER_MINUTE
        value, half = growth.mean * unit, WITHIN_95 * np.sqrt(np.maximum(np.diag(growth.covariance), 0.0)) * unit
        return LeakCourse(time, value, value - half, value + half)
