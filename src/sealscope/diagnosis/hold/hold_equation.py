"""Estimates of one hold: creep and leak with intervals, what may leak, and the result against a limit.

The loaded chamber of area A and volume V loses the volume Q t through a leak. With the piston's travel s towards that
chamber, the oil's relative compression c(p) and its thermal expansion a,

    s(t) - (V/A) (c(p(t)) - c(p(0))) = (Q/A) I(t) - a (V/A) (T(t) - T(0)) + what settles + noise,

where I(t) is the time, weighted by the leak's law |p_A - p_B|^e. `regression` estimates Q/A, with an interval; its
prior is a tight cylinder or a leak of unknown size (`leak_prior`). The creep is the mean speed of s; its bends, by
compression, the leak's law and oil that cools unlogged, are fitted without the chords between their ends. A temperature
that was logged or stated is a term of it.

Source: Merritt, Hydraulic Control Systems, 1967, sections 2.2 and 6.3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.estimate.population import Mixture, pool_mixtures
from sealscope.diagnosis.hold.readings import (
    Readings,
    average_parts,
    course_basis,
    read_channel,
    sample_course,
    smooth_course,
)
from sealscope.diagnosis.hold.regression import (
    Alternative,
    Column,
    RateFit,
    RateRegression,
    leak_prior,
    pool_fits,
)
from sealscope.diagnosis.hold.result import HoldCurve
from sealscope.diagnosis.hold.set_up import SetUp
from sealscope.diagnosis.inference.circuit.holds.hold_oil import relative_compression
from sealscope.diagnosis.inference.hypotheses import LAWS
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import chambers_of, estimate_quantum
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR, ML_PER_MINUTE, MM_PER_MINUTE, P_ATM

#: Lowest absolute pressure [Pa] at which oil with free air is compressed; below, its vapour fills the chamber.
LOWEST = 2e4
#: Ratio of the highest to the lowest pressure difference of a hold, above which the law of the leak counts.
STEADY_PRESSURE = 1.02
#: Start of the last part of a hold, over its duration.
LAST_PART = 0.97
#: Degree of the polynomial that smooths a logged temperature.
SMOOTH_DEGREE = 3
#: Time constants [durations of the hold] of the exponentials that such a smooth course has as well.
COURSE_TIMES = (0.06, 0.2)
#: Time [s] by which a logged temperature is moved to find its slope.
DELAY = 1.0
#: Least driving pressure from which a flow is converted, in deviations of the zero of the sensors.
LEAST_DRIVE = 0.2
#: Factor by which the travel equivalent to a pressure's change exceeds a piston's travel, where that is at a stop: of a
#: travel that may be none, and of one that the noise does not explain.
AT_STOP, SURELY_AT_STOP = 3.0, 30.0
#: Error of a rounded temperature at a passage, and of its change over a hold without passages, in steps.
PASSED, ROUNDED = 0.15, 0.4
#: Standard deviation of the logarithm of a time constant within a step of its grid, and a step of a derivative by it.
GRID_DEVIATION, SLIGHTLY = 0.3, 1.05
#: Least bend of a travel [mm] that is fitted.
LEAST_BEND = 1e-6
#: Millimetres of a metre.
_MM = 1e3


class LeakClock(NamedTuple):
    """Time weighted by the flow of a leak under one law: prior `weight`, `minutes` (m,) of mean `flow` (m,) 1.

    `zero` (m,): its change by a standard deviation of the sensors' zeros, None for a steady flow;
    `conversions`: probability, factor to the flow at the reference pressure, and deviation of its logarithm.
    """

    weight: float
    minutes: Array
    flow: Array
    zero: Array | None = None
    conversions: tuple[tuple[float, float, float], ...] = ()

    def convert(self, rate: Mixture) -> Mixture | None:
        """Convert a rate to the reference pressure; None without one."""
        if not self.conversions:
            return None
        shares = np.array([share for share, _, _ in self.conversions])
        rates = [rate.scale(factor, deviation).condense() for _, factor, deviation in self.conversions]
        return pool_mixtures(rates, shares / shares.sum()).condense()


class LeakEstimate(NamedTuple):
    """Leak of a hold: `rate` [mm/min] of the piston that it equals, without cooling, and its `flow` [m^3/s].

    `converted` [m^3/s]: flow at the reference pressure, None without one.
    """

    rate: Mixture | None
    flow: Mixture | None
    converted: Mixture | None = None
    curve: HoldCurve | None = None
    fit: RateFit | None = None


def _compress_oil(p: Array) -> Array:
    """Compute the relative compressions of oil and of its air (2, n) at absolute pressures `p` (n,) [Pa]."""
    return relative_compression(np.maximum(p, LOWEST))


def _compress_zero(p: Array) -> Array:
    """Compute the error of the relative compression at pressures `p` (n,) [Pa] by the zero of a sensor, from its start.

    Near a vacuum the air makes it large.
    """
    low, high = (_compress_oil(p + side * HOLD.other.offset * BAR).sum(axis=0) for side in (-0.5, 0.5))
    return np.asarray(high - low - (high[0] - low[0]))


def _exponential(readings: Readings, time: float, size: float, mean: float = 0.0) -> tuple[Column, Column]:
    """Build the columns of an exponential with an amplitude of the given `mean` and deviation `size`.

    The second column is its derivative by the logarithm of the time constant, which the grid of these leaves open.
    """
    slope = (readings.decay(SLIGHTLY * time) - readings.decay(time / SLIGHTLY)) / (2.0 * math.log(SLIGHTLY))
    course = Column(readings.decay(time) - 1.0, mean, size)
    return course, Column(slope, 0.0, math.hypot(size, mean) * GRID_DEVIATION)


class HeldLoad:
    """Estimator of one hold, from the samples of its `recording` and what the caller states (`set_up`)."""

    def __init__(
        self,
        recording: Recording | None,
        set_up: SetUp,
        file: str,
        findings: Sequence[Finding] = (),
        start: str | None = None,
    ) -> None:
        """Prepare the estimates; `file`, `findings`, `start`: name of the whole recording, its defects and its date."""
        self.recording, self.set_up, self.file, self.findings, self.start = recording, set_up, file, findings, start
        self.t = np.zeros(0) if recording is None else recording.t - recording.t[0]
        self.duration = float(self.t[-1]) if self.t.size else 0.0

    def _channel(self, name: str) -> Array | None:
        """Return the samples of a channel; None if it is absent."""
        return None if self.recording is None else self.recording.channels.get(name)

    @cached_property
    def loaded(self) -> str:
        """Side of the load: stated, of the greater force or, without pressures, ahead of the moving piston."""
        if self.set_up.loaded:
            return self.set_up.loaded
        pressures = (
            {} if self.recording is None else {name[-1]: self.recording[name] for name in chambers_of(self.recording)}
        )
        if pressures:  # by force at the start, where the areas are known
            begin = self.t <= (1.0 - LAST_PART) * self.duration
            forces = {side: float(p[begin].mean()) * (self.set_up.area(side) or 1.0) for side, p in pressures.items()}
            return max(forces, key=lambda side: forces[side])
        x = self._channel("x")
        return "B" if x is not None and self._slope_of(x) > 0.0 else "A"

    @property
    def unloaded(self) -> str:
        """Side without the load."""
        return "B" if self.loaded == "A" else "A"

    def _slope_of(self, values: Array) -> float:
        """Compute the slope of a channel's readings by least squares, per second."""
        t, means = average_parts(self.t, values, HOLD.noise.nodes)
        return float(np.polyfit(t, means, 1)[0])

    @cached_property
    def travel(self) -> Array | None:
        """Travel of the piston towards the loaded chamber [mm], (n,)."""
        x = self._channel("x")
        return None if x is None else (_MM if self.loaded == "B" else -_MM) * (x - x[0])

    @cached_property
    def column(self) -> tuple[float, float]:
        """Length of the loaded side's oil column [mm], and the standard deviation of its logarithm."""
        x = self._channel("x")
        # without a pressure the side is a guess, and the position tells nothing of its column
        is_known = x is not None and self.mean_pressure is not None
        length, deviation = self.set_up.column(self.loaded, float(np.mean(x)) if is_known and x is not None else None)
        return _MM * length, deviation

    def _pressure(self, side: str) -> Array | None:
        """Return the absolute pressure of a side [Pa], (n,); None if it is absent."""
        p = self._channel(f"p_{side}")
        return None if p is None else p + P_ATM

    @property
    def mean_pressure(self) -> float | None:
        """Mean gauge pressure of the loaded side [Pa]; None if it is not recorded."""
        p = self._channel(f"p_{self.loaded}")
        return None if p is None else float(np.mean(p))

    def _settling(self, readings: Readings, sizes: Sequence[float]) -> list[Alternative]:
        """List what may settle in `readings` after the valve has shut; `sizes`: deviations of its amplitude."""
        prior = HOLD.settling
        times = [time for time in prior.times if time <= prior.longest * self.duration]
        weight = prior.present / max(len(times) * len(sizes), 1)
        terms = [_exponential(readings, time, size) for time in times for size in sizes]
        return [Alternative(1.0 - prior.present), *(Alternative(weight, term) for term in terms)]

    def _strain_sizes(self, length: float) -> list[float]:
        """Compute the deviations of what settles of a column of a `length`, within what a pressure may settle by."""
        p = self.mean_pressure
        largest = math.inf if p is None else HOLD.part.fall * INFERENCE.held_oil.compressibility * p
        return [length * min(strain, largest) for strain in HOLD.settling.strain]

    def _bends(self, readings: Readings) -> list[Alternative]:
        """List slow changes of the speed of `readings` about its mean, by a load, a leak or oil that changes.

        Their courses vanish at both ends of the hold: exponentials without their chords, and polynomials.
        """
        prior, span = HOLD.bend, self.duration
        z = readings.t / span
        courses = [readings.decay(time * span) - 1.0 - z * math.expm1(-1.0 / time) for time in prior.times]
        courses += [z * (1.0 - z), z * (1.0 - z) * (1.0 - 2.0 * z)]
        courses = [course / (float(np.abs(course).max()) or 1.0) for course in courses]
        travel, weight = max(float(np.ptp(readings.values)), LEAST_BEND), prior.present / len(prior.sizes)
        bends = [tuple(Column(course, 0.0, size * travel) for course in courses) for size in prior.sizes]
        return [Alternative(1.0 - prior.present), *(Alternative(weight, columns) for columns in bends)]

    @cached_property
    def logged_temperature(self) -> Readings | None:
        """Readings of the oil's temperature; None if less than half of it was logged."""
        T = self._channel("T_oil")
        if T is None or np.isfinite(T).mean() < 0.5:
            return None
        return read_channel(self.t[np.isfinite(T)], T[np.isfinite(T)], HOLD.cooling.step)

    def _thermal_columns(self, t: Array, length: float, deviation: float) -> list[Column]:
        """Build the columns [mm] of a logged temperature at times `t`, for a column of oil of a `length`; or none.

        They are its effect, known to a relative `deviation` beside that of the oil's expansion, that of the
        thermometer's delay, and a line for what the log does not tell of the change.
        """
        T, logged, prior = self._channel("T_oil"), self.logged_temperature, HOLD.cooling
        if T is None or logged is None:
            return []
        errors = np.hypot(logged.loose, max(PASSED * logged.quantum, 1e-3))
        times = np.concatenate([t, t + DELAY, [0.0, self.duration], logged.t]) / self.duration
        basis = course_basis(times, SMOOTH_DEGREE, COURSE_TIMES)
        now, later, ends, read = np.split(basis, np.cumsum([len(t), len(t), 2]))
        weighted = read / errors[:, None]
        ridge = np.diag([0.0, *np.full(basis.shape[1] - 1, max(prior.sizes) ** -2.0)])
        covariance = np.linalg.inv(weighted.T @ weighted + ridge)
        middle = float(logged.values.mean())
        coefficients = covariance @ (weighted.T @ ((logged.values - middle) / errors))
        residual = (logged.values - middle - read @ coefficients) / errors
        change = ends[1] - ends[0]
        error = math.sqrt(float(change @ covariance @ change) * max(float(np.mean(residual**2)), 1.0))
        if not logged.quantum:  # means of rounded values
            error = math.hypot(error, ROUNDED * estimate_quantum(T))
        scale = -prior.expansion * length
        travel, delayed = scale * ((now - ends[0]) @ coefficients), scale * ((later - now) @ coefficients) / DELAY
        unread = math.hypot(scale * error, prior.misfit * float(np.ptp(travel)))
        return [
            Column(travel, 1.0, math.hypot(deviation, prior.expansion_deviation)),
            Column(delayed, *prior.lag),
            Column(t / self.duration, 0.0, unread),
        ]

    def _cooling(self, readings: Readings, length: float, deviation: float) -> list[Alternative]:
        """List the alternatives for the travel [mm] due to the oil's temperature in `readings` (`_thermal_columns`).

        Where no pressure is logged, the other side may be locked: the travel by a logged temperature then has either
        sign.
        """
        prior, set_up = HOLD.cooling, self.set_up
        if logged := self._thermal_columns(readings.t, length, deviation):
            if self.travel is None or self.mean_pressure is not None:
                return [Alternative(1.0, tuple(logged))]
            locked = logged[0]._replace(mean=0.0, deviation=1.0), *logged[1:]
            return [Alternative(1.0 - HOLD.other.locked, tuple(logged)), Alternative(HOLD.other.locked, locked)]
        sizes = [(0.0, size) for size in prior.sizes]
        if set_up.oil_course == "steady":
            sizes = [(0.0, prior.steady)]
        elif set_up.oil_course:
            excess = max(prior.sizes)
            if set_up.oil_temperature is not None and set_up.oil_course == "falling":
                excess = max(set_up.oil_temperature - prior.ambient, min(prior.sizes))
            mean, deviation = prior.stated
            sizes = [((1.0 if set_up.oil_course == "falling" else -1.0) * mean * excess, deviation * excess)]
        factor = prior.expansion * length
        weight = 1.0 / (len(sizes) * len(prior.times))
        terms = [_exponential(readings, time, factor * d, -factor * mean) for time in prior.times for mean, d in sizes]
        return [Alternative(weight, term) for term in terms]

    @property
    def warming(self) -> float:
        """Standard deviation [K] of a change of the oil's temperature that is neither logged nor stated to be small."""
        if self.logged_temperature is not None:
            return 0.0
        return HOLD.cooling.steady if self.set_up.oil_course == "steady" else max(HOLD.cooling.sizes)

    @property
    def thermal_error(self) -> float:
        """Standard deviation [mm] of the travel over the hold by what a logged temperature does not tell."""
        logged = self._thermal_columns(self.t, *self.column)
        return logged[-1].deviation if logged else 0.0

    def _clocks(self, readings: Readings) -> list[LeakClock]:
        """List the clocks of the laws of a leak, as `readings` see them."""
        p, other = self._pressure(self.loaded), self._pressure(self.unloaded)
        steady = LeakClock(1.0, readings.t / 60.0, np.ones_like(readings.t))
        if p is None:
            return [steady]
        # past the piston, or out of the cylinder
        differences = [self._implied_difference(p) if other is None else p - other, p - P_ATM]
        courses = [smooth_course(self.t, difference) for difference in differences]
        if all(course.max() < STEADY_PRESSURE * course.min() for _, course in courses):
            steadily = [self._convert(course, *law) for _, course in courses for law in LAWS.items()]
            return [steady._replace(conversions=tuple(filter(None, steadily)))]
        clocks = []
        for part_t, course in courses:
            zero = math.hypot(HOLD.other.offset * BAR, INFERENCE.held_oil.gain * float(np.mean(p)))
            for exponent, weight in LAWS.items():
                minutes, flow = self._weigh_time(readings, part_t, course, exponent)
                high, low = (self._weigh_time(readings, part_t, course + d, exponent)[0] for d in (zero, -zero))
                conversions = tuple(filter(None, [self._convert(course, exponent, 1.0)]))
                clocks.append(LeakClock(weight / len(differences), minutes, flow, 0.5 * (high - low), conversions))
        return clocks

    def _implied_difference(self, p: Array) -> Array:
        """Estimate the difference (n,) of an absolute pressure `p` (n,) to that of a closed side that nobody logs.

        Under a free piston the other side rises with the loaded one, by the ratio of their areas. At a stop a leak has
        equalised the sides at the end.
        """
        area, other_area = self.set_up.area(self.loaded), self.set_up.area(self.unloaded)
        if self.travel is None or self._is_at_stop or area is None or other_area is None:
            return p - float(np.mean(p[self.t >= self.duration * LAST_PART]))
        start = float(np.mean(p[self.t <= self.duration * (1.0 - LAST_PART)]))
        return start - P_ATM - (area / other_area - 1.0) * (p - start)

    def _convert(self, driving: Array, exponent: float, weight: float) -> tuple[float, float, float] | None:
        """Convert a mean flow by the `driving` pressure (k,) to the reference (`LeakClock.conversions`), if any.

        The zero of the sensors makes a small pressure uncertain.
        """
        if (reference := self.set_up.reference_pressure) is None:
            return None
        offset = HOLD.other.offset * BAR
        mean = max(float(np.mean(np.abs(driving) ** exponent)) ** (1.0 / exponent), LEAST_DRIVE * offset)
        return weight, (reference / mean) ** exponent, exponent * offset / mean

    def _weigh_time(self, readings: Readings, t: Array, difference: Array, exponent: float) -> tuple[Array, Array]:
        """Compute times [min] of `readings` weighted by a power of a pressure `difference` at `t`, and the weights.

        Their mean is 1.
        """
        flow = np.sign(difference) * np.abs(difference) ** exponent
        steps = 0.5 * (flow[1:] + flow[:-1]) * np.diff(t)
        volume = flow[0] * t[0] + np.concatenate([[0.0], np.cumsum(steps)])
        total = float(volume[-1] + flow[-1] * (self.duration - t[-1]))
        scale = self.duration / (total or 1.0)
        return sample_course(readings, t, volume) * (scale / 60.0), sample_course(readings, t, flow) * scale

    @cached_property
    def creep(self) -> RateFit | None:
        """Speed at which the piston sinks [mm/min], with what settles fitted; None without a position."""
        if self.travel is None:
            return None
        readings, stopped = self._travel_readings, HOLD.settling.stopped
        base = [Column(readings.t / 60.0), Column(np.ones_like(readings.t))]
        thermal = self._cooling(readings, *self.column) if self.set_up.oil_course or self.logged_temperature else []
        resting = [Alternative(stopped if thermal else 1.0)]  # a piston on its stop follows no temperature
        thermal = [entry._replace(weight=(1.0 - stopped) * entry.weight) for entry in thermal]
        alternatives = [self._settling(readings, self._strain_sizes(self.column[0])), self._bends(readings)]
        fits = [self._regression.fit_rate(base, [*alternatives, terms]) for terms in (thermal, resting) if terms]
        logs = [fit.log_evidence for fit in fits]
        if thermal:  # ... and does not creep
            logs[1] -= 0.5 * (fits[1].rate.mean / fits[1].rate.deviation) ** 2
        fit = pool_fits(fits, logs)
        bend = fit.fit - np.linspace(fit.fit[0], fit.fit[-1], len(fit.fit))
        return fit._replace(rate=fit.rate.add_error(HOLD.cooling.misfit * float(np.ptp(bend)) / (self.duration / 60.0)))

    def _column_terms(self) -> list[Column]:
        """Build the columns of the travel [mm] by compression of the loaded side's oil and air, and by its length.

        An error of the length changes these and the effect of a logged temperature in proportion.
        """
        p, readings, (length, deviation) = self._pressure(self.loaded), self._travel_readings, self.column
        columns = self._thermal_columns(readings.t, length, 0.0)[:1]
        if p is not None:
            oil, (t, course) = INFERENCE.held_oil, smooth_course(self.t, p)
            for compression, width in zip(_compress_oil(course), (oil.deviation, oil.air_deviation), strict=True):
                travel = sample_course(readings, t, length * (compression - compression[0]))
                columns.append(Column(travel, 1.0, width))
        if not columns:
            return []
        scaled = Column(np.sum([entry.values for entry in columns], axis=0), 0.0, deviation)
        if p is None:
            return [scaled]
        zero = Column(sample_course(readings, t, length * _compress_zero(course)), 0.0, 1.0)
        return [*columns[-2:], zero, scaled]

    @cached_property
    def _travel_readings(self) -> Readings:
        """Readings of the travel [mm]."""
        return read_channel(self.t, np.asarray(self.travel), HOLD.noise.position)

    @cached_property
    def _regression(self) -> RateRegression:
        """Regression of the travel."""
        return RateRegression(self._travel_readings, self.duration)

    def _read_compression(self, p: Array, length: float) -> tuple[Readings, Readings, list[Column]]:
        """Read an absolute pressure `p` (n,) [Pa], and the travel [mm] that a column of a `length` [mm] gives way.

        Returns both, and the columns of a fit to the latter that hold its level and what the oil's law leaves.
        """
        readings = read_channel(self.t, p, HOLD.noise.pressure * BAR)
        middle = float(np.mean(p)) + np.array([-0.5, 0.5]) * BAR
        slope = length * float(np.diff(_compress_oil(middle).sum(axis=0))[0]) / BAR
        compression = length * _compress_oil(readings.values).sum(axis=0)
        travel = readings._replace(values=compression, loose=slope * readings.loose, quantum=slope * readings.quantum)
        zero = Column(length * _compress_zero(readings.values), 0.0, 1.0)
        return readings, travel, [Column(np.ones_like(readings.t)), zero]

    @cached_property
    def gain(self) -> Mixture | None:
        """Rate [mm/min] at which the other side is compressed, as travel of its own area; None without its pressure."""
        p = self._pressure(self.unloaded)
        if p is None:
            return None
        length, deviation = self.set_up.column(self.unloaded, None)
        _, compression, base = self._read_compression(p, _MM * length)
        # oil that cools in a closed chamber loses pressure; a side that is open to the tank follows no temperature
        width = INFERENCE.held_oil.deviation
        closed = [
            Alternative(entry.weight, tuple(column._replace(values=-column.values) for column in entry.columns))
            for entry in self._cooling(compression, _MM * length, width)
        ]
        thermal = [Alternative(0.5), *(Alternative(0.5 * weight, columns) for weight, columns in closed)]
        settling = self._settling(compression, self._strain_sizes(_MM * length))
        alternatives = [settling, self._bends(compression), thermal]
        clocks = [clock._replace(conversions=()) for clock in self._clocks(compression)[: len(LAWS)]]
        fit = self._fit_laws(RateRegression(compression, self.duration), base, alternatives, clocks)
        return fit.rate.scale(1.0, math.hypot(deviation, width))

    @cached_property
    def leak(self) -> LeakEstimate:
        """Leak of the hold, by the best of its sources: collected oil, a flow meter, position, pressure."""
        set_up, area = self.set_up, self.set_up.area(self.loaded)
        if set_up.collected is not None:
            volume, time = set_up.collected
            prior = HOLD.collected
            deviation = math.hypot(prior.deviation * volume, prior.drop * 1e-6) / time
            flow = Mixture(np.ones(1), np.array([deviation]), np.array([volume / time]))
        elif (meter := self._channel("q_leak")) is not None:
            flow = self._metered_flow(meter)
        else:
            leak = (
                self._leak_by_travel() if self.travel is not None and not self._is_at_stop else self._leak_by_pressure()
            )
            if leak.rate is None:
                return leak
            rate = leak.rate.multiply(leak_prior())
            if area is None:
                return leak._replace(rate=rate, converted=None)
            scale = MM_PER_MINUTE * area
            flow, *converted = (
                self._widen(estimate).multiply(leak_prior()).scale(scale)
                for estimate in (leak.rate, leak.converted)
                if estimate is not None
            )
            return leak._replace(rate=rate, flow=flow, converted=converted[0] if converted else None)
        clocks = self._clocks(Readings(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)) if self.t.size else []
        at_clocks = [entry for clock in clocks if (entry := clock.convert(flow)) is not None]
        at_reference = pool_mixtures(at_clocks, np.array([clock.weight for clock in clocks])) if at_clocks else None
        return LeakEstimate(None if area is None else flow.scale(1.0 / (MM_PER_MINUTE * area)), flow, at_reference)

    def _widen(self, rate: Mixture) -> Mixture:
        """Add the errors by which a flow over the area differs from the `rate` [mm/min] of a piston.

        They are those of area and position and, where no pressure is logged, of the oil that friction, a locked other
        side or a sprung load compress.
        """
        prior = HOLD.load
        free = rate.scale(1.0, prior.gauge).condense()
        if self.mean_pressure is not None:
            return free
        per_bar = INFERENCE.held_oil.compressibility * BAR * self.column[0] / (self.duration / 60.0)
        free = free.add_error(prior.friction * per_bar)
        held = rate.scale(1.0, prior.stiffness).add_error(prior.change * per_bar)
        return pool_mixtures([free, held], np.array([1.0 - HOLD.other.locked, HOLD.other.locked])).condense()

    def _metered_flow(self, meter: Array) -> Mixture:
        """Estimate the mean flow [m^3/s] of a leakage flow meter, whose gain is uncertain, under each law of a leak."""
        readings = read_channel(self.t, meter, ML_PER_MINUTE)
        scale = float(np.abs(readings.values).max()) or ML_PER_MINUTE
        scaled = readings._replace(
            values=readings.values / scale, loose=readings.loose / scale, quantum=readings.quantum / scale
        )
        regression = RateRegression(scaled, self.duration, from_first=False)
        settling, clocks = self._settling(readings, (0.1, 1.0)), self._clocks(readings)
        fits = [regression.fit_rate([Column(clock.flow)], [settling]) for clock in clocks]
        logs = [math.log(clock.weight) + fit.log_evidence for clock, fit in zip(clocks, fits, strict=True)]
        fit = pool_fits(fits, logs)
        return fit.rate.scale(scale).add_error(INFERENCE.size.meter * abs(fit.rate.mean) * scale)

    def _leak_by_travel(self) -> LeakEstimate:
        """Estimate the leak from the travel, corrected for the compression of the loaded chamber's oil."""
        readings = self._travel_readings
        base = [Column(np.ones_like(readings.t)), *self._column_terms()]
        fit = self._fit_leak(self._regression, base, 0.0)
        return LeakEstimate(fit.rate, None, fit.converted, self._make_curve("x", "mm", readings, fit, 1.0), fit)

    def _leak_by_pressure(self) -> LeakEstimate:
        """Estimate the leak from the fall of the pressure of a chamber whose piston stands still."""
        p = self._pressure(self.loaded)
        if p is None:
            return LeakEstimate(None, None)
        length, deviation = self.column
        pressures, compression, base = self._read_compression(p, -length)
        fit = self._fit_leak(RateRegression(compression, self.duration), base, INFERENCE.held_oil.deviation)
        width = math.hypot(deviation, INFERENCE.held_oil.deviation)
        rate, converted = fit.rate.scale(1.0, width).condense(), fit.converted
        if converted is not None:
            converted = converted.scale(1.0, width).condense()
        if self.creep is not None:
            rate = rate.add_error(self.creep.rate.deviation)
        # the fit is drawn as a pressure, by the slope of the compression over the hold
        travelled, fallen = np.ptp(compression.values), np.ptp(pressures.values) / BAR
        in_bar = pressures._replace(values=(pressures.values - P_ATM) / BAR)
        slope = -float(fallen / travelled) if travelled > 0.0 else 0.0
        return LeakEstimate(rate, None, converted, self._make_curve(f"p_{self.loaded}", "bar", in_bar, fit, slope), fit)

    @cached_property
    def _is_at_stop(self) -> bool:
        """True if the piston stands still while the loaded chamber's pressure changes."""
        p = self._pressure(self.loaded)
        if p is None or self.creep is None:
            return False
        _, compression = average_parts(self.t, _compress_oil(p).sum(axis=0), 10)
        low, high = self.creep.rate.interval
        travel = abs(self.creep.rate.mean) * self.duration / 60.0
        factor = AT_STOP if low <= 0.0 <= high else SURELY_AT_STOP
        return float(np.ptp(compression)) * self.column[0] > factor * travel

    def _fit_laws(
        self,
        regression: RateRegression,
        base: Sequence[Column],
        alternatives: Sequence[Sequence[Alternative]],
        clocks: Sequence[LeakClock],
    ) -> RateFit:
        """Fit the rate [mm/min] under each law of a leak (`clocks`), and pool the laws."""
        fits, logs = [], []
        speed = float(np.ptp(regression.readings.values)) / (self.duration / 60.0)
        for clock in clocks:
            law = [] if clock.zero is None else [Column(speed * clock.zero, 0.0, 1.0)]
            fits.append(regression.fit_rate([Column(clock.minutes), *base, *law], alternatives))
            fits[-1] = fits[-1]._replace(converted=clock.convert(fits[-1].rate))
            logs.append(math.log(clock.weight) + fits[-1].log_evidence)
        return pool_fits(fits, logs)

    def _fit_leak(self, regression: RateRegression, base: Sequence[Column], deviation: float) -> RateFit:
        """Fit the rate of a leak [mm/min] under each law, with temperature and what settles.

        `deviation`: of the effect of a logged temperature, relative to the terms of `base`.
        """
        readings = regression.readings
        length, _ = self.column
        settling = self._settling(readings, self._strain_sizes(length))
        alternatives = [settling, self._bends(readings), self._cooling(readings, length, deviation)]
        fit = self._fit_laws(regression, base, alternatives, self._clocks(readings))
        # oil that cools unlogged follows an exponential but for a share, which is as straight as a leak
        misfit = 0.0 if self.logged_temperature else HOLD.cooling.misfit * float(np.ptp(fit.last))
        return fit._replace(rate=fit.rate.add_error(misfit / (self.duration / 60.0)))

    def _make_curve(self, channel: str, unit: str, readings: Readings, fit: RateFit, factor: float) -> HoldCurve:
        """Make the curve of a hold from readings to be drawn; `factor`: from the unit of the fit to theirs."""
        start = float(self.recording.t[0]) if self.recording is not None else 0.0
        line, half = factor * fit.fit, abs(factor) * WITHIN_95 * fit.band
        line = line + float(np.mean(readings.values) - np.mean(line))
        return HoldCurve(channel, unit, readings.t + start, readings.values, line, line - half, line + half)
