"""The leak as a volume balance measures it: tests, mean flows, bounds and course, in the machine's size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sealscope.diagnosis.inference.leak_law import EXPONENTS, mixed_flow, rise_flow, step_flow
from sealscope.diagnosis.inference.observable import Flow, Remark
from sealscope.diagnosis.inference.onset import BELOW_95, WITHIN_95, Interval, StepTest
from sealscope.diagnosis.inference.scatter import RecordingSums, Rise, compare_laws, conditions_beyond, held_rise, rise
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import Cause, LeakCourse, RelativeLeak, TotalLeakage
from sealscope.diagnosis.verdict.machine import healthy_leakage
from sealscope.units import LITRE_PER_MINUTE


@dataclass(frozen=True, eq=False)
class BalanceLeak:
    """The leakage of a recording by its balance of volumes (`observable.LeakMeasure`).

    Parameters
    ----------
    provider : str
        Name of the detector.
    balance : RecordedBalance
    healthy : sequence of RecordingSums
        What healthy recordings of the machine with the same terms teach.
    """

    provider: str
    balance: RecordedBalance
    healthy: Sequence[RecordingSums] = ()

    @property
    def cause(self) -> Cause:
        """Cause of a leak: behind a servo valve, or where valves surely hold pressures, the pump has no part in it."""
        is_piston = len(self.balance.columns) > 1 or self._held_rise is not None
        return "piston leak" if is_piston else "piston or pump leak"

    @property
    def step(self) -> StepTest | None:
        """Test of a step of the leakage."""
        return self.balance.test

    @cached_property
    def step_flow(self) -> Flow:
        """Mean flow of the step while it lasts, over laws, growths and onsets by their likelihoods."""
        balance, test = self.balance, self.balance.test
        if test is None:
            return Flow(0.0, np.inf)
        return self._with_law(step_flow(balance.blocks, balance.columns, balance.leak, test))

    @property
    def step_driving(self) -> float:
        """Mean flow [m^3/s] of a conductance of one, at the recording's pressures."""
        return self.balance.mean_pressure()

    def _with_law(self, flow: Flow) -> Flow:
        """Widen a flow by what its law and smoothed pressures leave open."""
        law: float = priors("inference")["size"]["law"]
        return Flow(flow.value, float(np.hypot(flow.deviation, flow.value * law)))

    @cached_property
    def rise(self) -> Rise | None:
        """Rise of the mean leakage beyond the healthy recordings, None without any; of holds alone where they tell."""
        return self._swept_rise if self._held_rise is None else self._held_rise

    @cached_property
    def _swept_rise(self) -> Rise | None:
        if not self.healthy:
            return None
        return rise(self.balance.recording_sums, self.healthy, self.balance.columns)

    @cached_property
    def _held_rise(self) -> Rise | None:
        return held_rise(self.balance.recording_sums, self.healthy) if self.balance.shut else None

    @cached_property
    def rise_flow(self) -> Flow:
        """The rise while it lasts, over laws and onsets, or without healthy recordings the leakage in all."""
        balance = self.balance
        if self.rise is None:
            value, low, high = (balance.mean_pressure() * end for end in balance.level)
            return self._with_law(Flow(value, (high - low) / (2.0 * WITHIN_95)))
        swept = self._swept_rise
        assert swept is not None
        low, high = swept.interval()
        flow = rise_flow(
            balance.blocks,
            balance.columns,
            balance.leak,
            self.step,
            (swept.value, (high - low) / (2.0 * WITHIN_95)),
            self._rise_laws(),
            balance.moving,
        )
        held, believed = self._held_rise, priors("inference")["held_oil"]
        if held is not None and held.chance < believed["rare"]:  # two ways that need not agree: it lies between them
            flows = flow, self._held_flow(held)
            flow = mixed_flow(np.array([1.0 - believed["right"], believed["right"]]), *np.array(flows).T)
        return self._with_law(flow)

    def _held_flow(self, rise: Rise) -> Flow:
        """Return the mean flow of what the holds show, over laws by their likelihoods."""
        balance, held = self.balance, self.balance.chambers
        assert held is not None
        recording, (onset, zero) = balance.recording, held.piston
        difference = np.abs(recording["p_A"] - recording["p_B"] - zero)[recording.t >= onset]
        units = np.array([float(np.nanmean(difference**exponent)) for exponent in EXPONENTS])
        levels = [held.level(onset, zero, exponent) for exponent in EXPONENTS]
        values, deviations, by_oil, likelihoods = np.array(levels).T
        low, high = rise.interval()
        scatter = (high - low) / (2.0 * WITHIN_95) * units[0]
        return mixed_flow(
            np.exp(likelihoods - likelihoods.max()),
            values * units,
            np.hypot(scatter, np.hypot(deviations, by_oil) * units),
        )

    def _rise_laws(self) -> list[tuple[float, float]]:
        """Return the mean flow of a rise of one under each of `EXPONENTS`, and the logarithm of the law's weight."""
        balance, pressure = self.balance, self.balance.mean_pressure()
        law = compare_laws(balance.recording_sums, self.healthy, balance.columns)
        if law is None:
            return [(pressure, 0.0)] * len(EXPONENTS)
        root = balance.mean_of_blocks(balance.blocks.driving(root=True)) / law.regression
        readings: float = priors("inference")["size"]["readings"]
        laminar: float = priors("inference")["size"]["laminar"]
        believed = np.log([laminar, *[(1.0 - laminar) / (len(EXPONENTS) - 1)] * (len(EXPONENTS) - 1)])
        return [
            (pressure ** (1.0 - share) * root**share, float(prior) + share * readings * law.log_ratio)
            for share, prior in zip(2.0 * (1.0 - np.array(EXPONENTS)), believed, strict=True)
        ]

    @property
    def excess(self) -> float | None:
        """Leakage in all beyond a healthy machine's by the rig's file, in deviations; None where not stated."""
        balance = self.balance
        limit = healthy_leakage(balance.rig)
        # a drive's droop with the load passes for a level of the leak
        is_measured = len(balance.columns) == 1 and not balance.equations[0].by_command
        if not (limit > 0.0 and self.rise is None and balance.size.stated and is_measured):
            return None
        level = balance.level
        deviation = float(np.hypot((level.high - level.low) / (2 * WITHIN_95), level.value * balance.size.deviation))
        return (level.value - limit) / max(deviation, np.finfo(float).tiny)

    @property
    def bound_flow(self) -> float:
        """95 % upper bound of the mean flow of a leak that began, or came since the healthy recordings [m^3/s]."""
        test = self.step if self.rise is None else self._swept_rise
        if test is None:
            return np.inf
        size = float(np.hypot(self.balance.size.deviation, priors("inference")["size"]["law"]))
        return test.bound() * self.balance.mean_pressure() * (1.0 + BELOW_95 * size)

    @property
    def pump_flow(self) -> tuple[float, float]:
        """Mean flow of the pump [m^3/s], and that while it flows."""
        return self.balance.mean_flow, self.balance.moving

    @cached_property
    def share_after(self) -> float:
        """Share of what the recording tells of its mean leakage that lies after the step's onset."""
        if self.step is None:
            return 0.0
        after = self.balance.blocks.time >= self.step.onset().value
        weights = self.balance.leak.precision.sum(axis=0)
        return float(np.clip(weights[after].sum() / max(weights.sum(), np.finfo(float).tiny), 0.0, 1.0))

    @property
    def litres(self) -> float | None:
        """L/min of a flow of 1 m^3/s, None where the machine's size is not stated."""
        size = self.balance.size
        return size.scale / LITRE_PER_MINUTE if size.stated else None

    @property
    def size_deviation(self) -> float:
        """Relative standard deviation of the machine's size."""
        return self.balance.size.deviation

    @property
    def ratio(self) -> Interval | None:
        """Displacement over area as measured, over the assumed one."""
        return self.balance.size.ratio

    def relative(self, flow: Flow) -> RelativeLeak:
        """Return a flow over the pump's mean flow, and over the piston's area."""
        pump, area = self.balance.mean_flow, self.balance.size.area
        half = WITHIN_95 * flow.deviation
        ends = (flow.value - half, flow.value + half)
        return RelativeLeak(
            pump_share=flow.value / pump if pump > 0.0 else None,
            pump_share_interval=_quotient(ends, pump),
            creep=None if area is None else flow.value / area,
            creep_interval=_quotient(ends, area),
        )

    def total(self, findable: float | None) -> TotalLeakage:
        """Return the total leakage of pump and piston; `findable`: the smallest step that would be found [m^3/s]."""
        balance = self.balance
        size, pressure, pump, level = balance.size, balance.mean_pressure(), balance.mean_flow, balance.level
        limit, litres = healthy_leakage(balance.rig), size.scale / LITRE_PER_MINUTE
        is_single = len(balance.columns) == 1  # a valve's edges pass as well, by an amount that is not known
        stated, wide = size.stated and is_single, 1.0 + WITHIN_95 * size.deviation
        low, high = (
            end * pressure * litres * (wide if (end > 0.0) == upper else 1.0 / wide)
            for end, upper in zip(level[1:], (False, True), strict=True)
        )
        return TotalLeakage(
            lpm=level.value * pressure * litres if stated else None,
            interval_lpm=(low, high) if stated else None,
            pressure=pressure,
            findable_lpm=None if findable is None or not size.stated else findable * litres,
            healthy_lpm=limit * pressure / LITRE_PER_MINUTE if limit > 0.0 else None,
            pump_share=max(level.value, 0.0) * pressure / pump if pump > 0.0 and is_single else None,
            findable_share=None if findable is None or not pump > 0.0 else findable / pump,
        )

    def course(self, onset_s: float | None) -> LeakCourse | None:
        """Return the leakage over the recording: what came with the onset, or what passes in all without one."""
        balance = self.balance
        if not balance.size.stated:
            return None
        time = balance.blocks.time
        course = balance.total_course if onset_s is None else balance.course(step=True).relative_to(time < onset_s)
        value, deviation = course.mean, np.sqrt(np.maximum(np.diag(course.covariance), 0.0))
        unit = balance.blocks.driving(balance.zero) * balance.size.scale / LITRE_PER_MINUTE
        half = WITHIN_95 * np.hypot(deviation, value * balance.size.deviation)
        low, high = (value - half) * unit, (value + half) * unit
        return LeakCourse(time, value * unit, low, high, whole=onset_s is None)

    @property
    def remarks(self) -> Sequence[Remark]:
        """Remarks of the balance on sizes, zeros, delays and conditions."""
        balance = self.balance
        size, zero, remarks = balance.size, balance.zero, list[Remark]()
        if size.ratio is not None and size.disagrees:
            remarks.append(Remark("sizes disagree", {"ratio": size.ratio.value}))
        if abs(zero) > 2.0 * WITHIN_95 * priors("inference")["zero"]["pressure"]:
            remarks.append(Remark("zero too high" if zero > 0.0 else "zero too low", {"bar": abs(zero) / 1e5}))
        if (late := balance.delay) is not None and abs(late[0]) > 1.0 / balance.recording.rate + WITHIN_95 * late[1]:
            remarks.append(Remark("x late" if late[0] > 0.0 else "x early", {"ms": 1e3 * abs(late[0])}))
        return [*remarks, *self._conditions()]

    def _conditions(self) -> Iterator[Remark]:
        """Yield the conditions that no healthy recording had."""
        for condition in conditions_beyond(self.balance.recording_sums, self.healthy):
            value, low, high = condition.value, condition.low, condition.high
            if condition.name == "load":
                yield Remark("load beyond", {"value": value / 1e5, "low": low / 1e5, "high": high / 1e5})
            elif condition.name == "speed":
                yield Remark("speed beyond", {"ratio": value / (high if value > high else low)})
            else:
                yield Remark("oil beyond", {"value": value, "low": low, "high": high})


def _quotient(interval: tuple[float, float], unit: float | None) -> tuple[float, float] | None:
    return None if unit is None or not unit > 0.0 else (max(interval[0], 0.0) / unit, interval[1] / unit)
