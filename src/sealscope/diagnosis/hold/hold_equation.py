"""Estimates of one hold: creep and leak with intervals, what may leak, and the result against a limit.

The loaded chamber of area A and volume V loses the volume Q t through a leak. With the piston's travel s towards that
chamber, the oil's relative compression c(p) and its thermal expansion a,

    s(t) - (V/A) (c(p(t)) - c(p(0))) = (Q/A) I(t) - a (V/A) (T(t) - T(0)) + what settles + noise,

where I(t) is the time, weighted by the leak's flow |p_A - p_B|^e nu(T)^(1 - 2 e) over its mean: a leak whose pressure
or viscosity changes is stated by its mean over the hold. `regression` estimates Q/A, with an interval; its prior is a
tight cylinder or a leak of unknown size (`leak_prior`). The creep is the mean speed of s over the hold; its bends, by
compression, the leak's law and oil that cools unlogged, are fitted without the chords between their ends. The travel
by a temperature that was logged or stated is left out of both. A piston at rest on its stop is a hypothesis of its own:
then the pressure alone tells the leak.

Source: Merritt, Hydraulic Control Systems, 1967, sections 2.2 and 6.3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.estimate.population import LEAST_WEIGHT, Mixture, pool_mixtures, weigh_alternatives
from sealscope.diagnosis.hold.readings import (
    N_PARTS,
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
    log_overlap,
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
#: Number of errors of such a course, the largest first, that are fitted beside it.
N_SHAPES = 3
#: Time [s] by which a logged temperature is moved to find its slope.
DELAY = 1.0
#: Least driving pressure from which a flow is converted, in deviations of the zero of the sensors.
LEAST_DRIVE = 0.2
#: Error of a rounded temperature at a passage, and of its change over a hold without passages, in steps.
PASSED, ROUNDED = 0.15, 0.4
#: Standard deviation of the logarithm of a time constant within a step of its grid, and a step of a derivative by it.
GRID_DEVIATION, SLIGHTLY = 0.3, 1.05
#: Least bend of a travel [mm] that is fitted.
LEAST_BEND = 1e-6
#: Millimetres of a metre.
_MM = 1e3


class LeakClock(NamedTuple):
    """Time weighted by the flow of a leak under one law, over its mean: prior `weight`, `minutes` (m,).

    `laminar`: power by which the flow goes with the inverse of the viscosity; `errors`: changes (m,) of the minutes by
    a standard deviation of the sensors' zeros, and of the oil's viscosity; `conversions`: probability, factor to the
    flow at the reference pressure, and deviation of its logarithm; `belief`: power of the evidence for the law.
    """

    weight: float
    minutes: Array
    laminar: float
    errors: tuple[Array, ...] = ()
    conversions: tuple[tuple[float, float, float], ...] = ()
    belief: float = 1.0

    def convert(self, rate: Mixture) -> Mixture | None:
        """Convert a rate to the reference pressure; None without one."""
        if not self.conversions:
            return None
        shares = np.array([share for share, _, _ in self.conversions])
        rates = [rate.scale(factor, deviation).condense() for _, factor, deviation in self.conversions]
        return pool_mixtures(rates, shares / shares.sum()).condense()


class TemperatureCourse(NamedTuple):
    """Smooth course of a logged temperature over a hold of a `span` [s], about its level.

    `coefficients` (k,) [K] of a `course_basis`, their `covariance` (k, k) by what the readings leave open, and the
    `error` [K] of the change from the start of the hold to its end.
    """

    span: float
    coefficients: Array
    covariance: Array
    error: float

    def basis(self, t: Array) -> Array:
        """Compute the courses (m, k) at times `t` (m,) [s] of which the temperature is a sum."""
        return course_basis(t / self.span, SMOOTH_DEGREE, COURSE_TIMES)

    def warmth(self, t: Array) -> Array:
        """Compute the temperature (m,) [K] at times `t` (m,) [s], less its level."""
        return np.asarray(self.basis(t) @ self.coefficients)


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


def _exponential(
    readings: Readings, time: float, size: float, mean: float = 0.0, thinning: float = 0.0, duration: float = 1.0
) -> tuple[Column, Column]:
    """Build the columns of an exponential with an amplitude of the given `mean` and deviation `size`.

    The second column is its derivative by the logarithm of the time constant, which the grid of these leaves open.
    `thinning` [1/s]: effect on a leak, whose speed changes by so much for a change of 1 in the exponential; that on its
    mean speed over the `duration` [s] of the hold is left out.
    """

    def course(time: float) -> Array:
        """Compute the exponential from 0, with what the leak adds that it thins or thickens."""
        decay = readings.decay(time)
        mean_decay = -time * math.expm1(-duration / time) / duration
        return decay - 1.0 + thinning * (time * (1.0 - decay) - mean_decay * readings.t)

    slope = (course(SLIGHTLY * time) - course(time / SLIGHTLY)) / (2.0 * math.log(SLIGHTLY))
    return Column(course(time), mean, size), Column(slope, 0.0, math.hypot(size, mean) * GRID_DEVIATION)


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
        p, collected = self._channel(f"p_{self.loaded}"), self.set_up.collected
        return float(np.mean(p)) if p is not None else collected and collected[2]

    def _settling(self, readings: Readings, sizes: Sequence[float]) -> list[Alternative]:
        """List what may settle in `readings` after the valve has shut; `sizes`: deviations of its amplitude."""
        prior = HOLD.settling
        least = prior.shortest * readings.step * readings.n_samples  # over within the first reading
        times = [time for time in prior.times if least <= time <= prior.longest * self.duration]
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
    def temperature(self) -> TemperatureCourse | None:
        """Course of the oil's temperature; None if less than half of it was logged."""
        T = self._channel("T_oil")
        if T is None or np.isfinite(T).mean() < 0.5:
            return None
        t, T = self.t[np.isfinite(T)], T[np.isfinite(T)]
        logged = read_channel(t, T, HOLD.cooling.step)
        course = TemperatureCourse(self.duration, np.zeros(0), np.zeros((0, 0)), 0.0)
        basis, change = course.basis(logged.t), np.diff(course.basis(np.array([0.0, self.duration])), axis=0)[0]
        errors = np.hypot(logged.loose, max(PASSED * logged.quantum, 1e-3))
        values = (logged.values - float(logged.values.mean())) / errors
        weighted = basis / errors[:, None]
        size = float(np.ptp(logged.values)) + (logged.quantum or estimate_quantum(T) or HOLD.cooling.step)
        deviations = size * np.array([*HOLD.cooling.shapes, *np.full(len(COURSE_TIMES), HOLD.cooling.shapes[0])])
        covariance = np.linalg.inv(weighted.T @ weighted + np.diag([0.0, *deviations**-2.0]))
        coefficients = covariance @ (weighted.T @ values)
        covariance = np.asarray(covariance) * max(float(np.mean((values - weighted @ coefficients) ** 2)), 1.0)
        error = math.sqrt(float(change @ covariance @ change))
        if not logged.quantum:  # means of rounded values
            error = math.hypot(error, ROUNDED * estimate_quantum(T))
        return course._replace(coefficients=coefficients, covariance=covariance, error=error)

    def _thermal_columns(self, t: Array, length: float, deviation: float) -> list[Column]:
        """Build the columns [mm] of a logged temperature at times `t`, for a column of oil of a `length`; or none.

        They are its effect, known to a relative `deviation` beside that of the oil's expansion, that of the
        thermometer's delay, a line for what the log does not tell of the change, and errors of the course's shape.
        """
        course, prior = self.temperature, HOLD.cooling
        if course is None:
            return []
        scale = -prior.expansion * length
        warmth = course.warmth(t)
        travel, delayed = scale * (warmth - course.warmth(np.zeros(1))), scale * (course.warmth(t + DELAY) - warmth)
        unread = math.hypot(scale * course.error, prior.misfit * float(np.ptp(travel)))
        # shapes vanish at both ends of the hold, whose difference has an error of its own
        first, last = course.basis(np.array([0.0, self.duration]))
        bends = course.basis(t) - first - (t / self.duration)[:, None] * (last - first)
        shapes, sizes, _ = np.linalg.svd(bends @ np.linalg.cholesky(course.covariance), full_matrices=False)
        return [
            Column(travel, 1.0, math.hypot(deviation, prior.expansion_deviation)),
            Column(delayed / DELAY, *prior.lag),
            Column(t / self.duration, 0.0, unread),
            *(Column(scale * shape, 0.0, 1.0) for shape in (shapes * sizes)[:, :N_SHAPES].T),
        ]

    def _cooling(self, readings: Readings, length: float, deviation: float, viscous: float = 0.0) -> list[Alternative]:
        """List the alternatives for the travel [mm] due to the oil's temperature in `readings` (`_thermal_columns`).

        `viscous` [mm/min]: speed by a leak, times the power by which that goes with the inverse of the viscosity.
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
            mean, share = prior.stated
            mean *= excess if set_up.oil_course == "falling" else -excess
            sizes = [(mean, share * excess), (mean, share * max(prior.sizes))]  # some workshops are colder
        factor = prior.expansion * length
        thinning = -viscous / 60.0 * INFERENCE.oil.per_kelvin / factor
        return [
            Alternative(
                weight / len(sizes),
                _exponential(readings, time, factor * d, -factor * mean, thinning, self.duration),
            )
            for time, weight in zip(prior.times, self._weigh_cooling_times(), strict=True)
            for mean, d in sizes
        ]

    def _weigh_cooling_times(self) -> list[float]:
        """Weigh the times in which oil cools by the bore of the cylinder; equal weights if that is unknown."""
        prior, area = HOLD.cooling, self.set_up.area("A")
        logs = np.zeros(len(prior.times))
        if area is not None:
            usual, spread = prior.bore
            logs = -0.5 * (np.log(np.array(prior.times) / (usual * math.sqrt(4.0 * area / math.pi))) / spread) ** 2
        return [float(weight) for weight in weigh_alternatives(logs)]

    @property
    def warming(self) -> float:
        """Standard deviation [K] of a change of the oil's temperature that is neither logged nor stated to be small."""
        if self.temperature is not None:
            return 0.0
        return HOLD.cooling.steady if self.set_up.oil_course == "steady" else max(HOLD.cooling.sizes)

    @property
    def thermal_error(self) -> float:
        """Standard deviation [mm] of the travel over the hold by what a logged temperature does not tell."""
        logged = self._thermal_columns(self.t, *self.column)
        return logged[2].deviation if logged else 0.0

    def _clocks(self, readings: Readings, driven: bool = True) -> list[LeakClock]:
        """List the clocks of the laws of a leak, as `readings` see them: by its driving pressure and its viscosity.

        A flow of the power e of the pressure goes with the power 1 - 2 e of the viscosity: no other combination of
        flow, gap, density, viscosity and pressure has a unit of 1. `driven`: by a pressure that is logged, too.
        """
        p, other = (self._pressure(side) if driven else None for side in (self.loaded, self.unloaded))
        oil = INFERENCE.oil
        t, courses, warmth = np.zeros(1), [], np.zeros(1)
        if not self.t.size:
            courses = [] if self.mean_pressure is None else [np.array([self.mean_pressure])]
        elif p is not None:  # past the piston, or out of the cylinder
            differences = [self._implied_difference(p) if other is None else p - other, p - P_ATM]
            (t, first), (_, second) = (smooth_course(self.t, difference) for difference in differences)
            courses = [first, second]
        else:
            t, _ = average_parts(self.t, self.t, N_PARTS)
        if self.temperature is not None:
            warmth = self.temperature.warmth(t) - float(np.mean(self.temperature.warmth(t)))
        is_steady = all(course.max() < STEADY_PRESSURE * course.min() for course in courses)
        ratios = [course / np.where(courses[0] > 0.0, courses[0], np.nan) for course in courses]
        is_alike = all(ratio.max() < STEADY_PRESSURE * ratio.min() for ratio in ratios)
        groups = [courses] if is_steady or is_alike else [[course] for course in courses]
        zero = (
            0.0
            if is_steady or p is None
            else math.hypot(HOLD.other.offset * BAR, INFERENCE.held_oil.gain * float(np.mean(p)))
        )
        clocks, k, d = [], oil.per_kelvin, oil.per_kelvin_deviation
        for group in groups:
            for exponent, weight in reversed(LAWS.items()):
                laminar = 2.0 * exponent - 1.0
                drive = np.ones(len(t)) if is_steady else group[0]
                run = partial(self._weigh_by_law, readings, t, warmth, exponent)
                errors = [0.5 * (run(drive + zero, k) - run(drive - zero, k))] if zero else []
                errors += [0.5 * (run(drive, k + d) - run(drive, k - d))] if laminar * float(np.ptp(warmth)) else []
                conversions = tuple(filter(None, (self._convert(course, exponent, weight) for course in group)))
                clocks.append(LeakClock(weight / len(groups), run(drive, k), laminar, tuple(errors), conversions))
        if is_steady and oil.per_kelvin * float(np.ptp(warmth)) < math.log(STEADY_PRESSURE):
            steadily = tuple(entry for clock in clocks for entry in clock.conversions)
            return [LeakClock(1.0, readings.t / 60.0, 0.0, (), steadily)]
        return clocks

    def _implied_difference(self, p: Array) -> Array:
        """Estimate the difference (n,) of an absolute pressure `p` (n,) to that of a closed side that nobody logs.

        Under a free piston the other side rises with the loaded one, by the ratio of their areas. At a stop a leak has
        equalised the sides at the end.
        """
        area, other_area = self.set_up.area(self.loaded), self.set_up.area(self.unloaded)
        if self.travel is None or area is None or other_area is None:
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

    def _weigh_by_law(
        self, readings: Readings, t: Array, warmth: Array, exponent: float, drive: Array, slope: float
    ) -> Array:
        """Compute times [min] of `readings` weighted by a leak's flow over its mean, by a law of the power `exponent`.

        `drive`, `warmth` (m,): pressure difference [Pa], and temperature less its mean [K], at times `t` (m,); `slope`:
        fall of the logarithm of the viscosity, per kelvin.
        """
        flow = np.sign(drive) * np.abs(drive) ** exponent * np.exp((2.0 * exponent - 1.0) * slope * warmth)
        steps = 0.5 * (flow[1:] + flow[:-1]) * np.diff(t)
        volume = flow[0] * t[0] + np.concatenate([[0.0], np.cumsum(steps)])
        total = float(volume[-1] + flow[-1] * (self.duration - t[-1]))
        return sample_course(readings, t, volume) * (self.duration / (total or 1.0) / 60.0)

    @cached_property
    def creep(self) -> RateFit | None:
        """Speed at which the piston sinks [mm/min], with what settles fitted; None without a position."""
        if self.travel is None:
            return None
        readings, (_, at_rest, logs) = self._travel_readings, self._motion
        alternatives = [self._settling(readings, self._strain_sizes(self.column[0])), self._bends(readings)]
        if self.set_up.oil_course or self.temperature:
            alternatives.append(self._cooling(readings, *self.column))
        base = [Column(np.ones_like(readings.t))]
        sinking = self._fit_laws(self._regression, base, alternatives, self._clocks(readings, driven=False))
        fit = pool_fits([sinking, at_rest], logs)
        bend = fit.fit - np.linspace(fit.fit[0], fit.fit[-1], len(fit.fit))
        return fit._replace(rate=fit.rate.add_error(HOLD.cooling.misfit * float(np.ptp(bend)) / (self.duration / 60.0)))

    @cached_property
    def _motion(self) -> tuple[RateFit, RateFit, tuple[float, float]]:
        """Fits of the travel for a piston that a leak lets sink, and for one at rest on its stop; log probabilities.

        At rest it follows neither pressure nor temperature.
        """
        readings, level = self._travel_readings, Column(np.ones_like(self._travel_readings.t))
        sinking = self._fit_leak(self._regression, [level, *self._column_terms()], 0.0)
        at_rest = self._regression.fit_rate(
            [Column(readings.t / 60.0), level], [self._settling(readings, self._strain_sizes(self.column[0]))]
        )
        still, stopped = Mixture(np.ones(1), np.array([HOLD.settling.rest]), np.zeros(1)), HOLD.settling.stopped
        logs = (
            math.log(1.0 - stopped) + sinking.log_evidence + log_overlap(sinking.rate, leak_prior()),
            math.log(stopped) + at_rest.log_evidence + log_overlap(at_rest.rate, still),
        )
        return sinking, at_rest._replace(rate=still), logs

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

    @property
    def is_closed(self) -> bool:
        """True if the side without the load is closed, as stated, or by a pressure above that of a tank line."""
        p = self._channel(f"p_{self.unloaded}")
        is_raised = p is not None and float(np.median(p)) > HOLD.other.tank * BAR
        return self.unloaded in self.set_up.capped or is_raised

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
        thermal = closed
        if not self.is_closed:
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
            volume, time, _ = set_up.collected
            prior = HOLD.collected
            deviation = math.hypot(prior.deviation * volume, prior.drop * 1e-6) / time
            metered = Mixture(np.ones(1), np.array([deviation]), np.array([volume / time]))
        elif (meter := self._channel("q_leak")) is not None:
            metered = self._metered_flow(meter)
        else:
            leaks, weights = self._leaks()
            if not leaks:
                return LeakEstimate(None, None)

            def pool(estimates: list[Mixture | None]) -> Mixture | None:
                """Pool the estimates of all leaks; None if there are none."""
                known = [estimate for estimate in estimates if estimate is not None]
                return pool_mixtures(known, weights).condense() if known else None

            best, rate = leaks[int(np.argmax(weights))], pool([entry.rate for entry in leaks])
            if area is None:
                return best._replace(rate=rate, flow=None, converted=None)
            flows = pool([entry.flow for entry in leaks]), pool([entry.converted for entry in leaks])
            flow, converted = (estimate and estimate.scale(MM_PER_MINUTE * area) for estimate in flows)
            return best._replace(rate=rate, flow=flow, converted=converted)
        clocks = self._clocks(Readings(np.zeros(1), np.zeros(1), np.zeros(1), 0.0))
        at_clocks = [entry for clock in clocks if (entry := clock.convert(metered)) is not None]
        at_reference = pool_mixtures(at_clocks, np.array([clock.weight for clock in clocks])) if at_clocks else None
        return LeakEstimate(
            None if area is None else metered.scale(1.0 / (MM_PER_MINUTE * area)), metered, at_reference
        )

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
        """Estimate the mean flow [m^3/s] of a leakage flow meter: the speed of a piston that its oil would move.

        A leak flows from the higher pressure to the lower, whichever way the meter was mounted.
        """
        step, scale = estimate_quantum(meter) or ML_PER_MINUTE, float(np.abs(meter).max()) or ML_PER_MINUTE
        minutes = np.diff(self.t, prepend=self.t[0]) / 60.0
        volume = np.cumsum(minutes * 0.5 * (meter + np.concatenate([meter[:1], meter[:-1]]))) / scale
        mean_t, means = average_parts(self.t, volume, HOLD.noise.nodes)
        n_samples = len(self.t) / len(means)
        readings = Readings(
            mean_t, means, np.zeros(len(means)), 0.0, self.duration / max(len(self.t) - 1, 1), n_samples
        )
        settling = self._settling(readings, [share * float(np.ptp(volume)) or 1.0 for share in HOLD.meter.settling])
        fit = self._fit_laws(
            RateRegression(readings, self.duration),
            [Column(np.ones_like(mean_t))],
            [settling, self._bends(readings)],
            self._clocks(readings),
        )
        flow = fit.rate.scale(math.copysign(scale, fit.rate.mean))
        return flow.add_error(math.hypot(INFERENCE.size.meter * flow.mean, 12.0**-0.5 * step))

    def _leaks(self) -> tuple[list[LeakEstimate], Array]:
        """Estimate the leak of a piston that sinks, and of one at rest on its stop, with their probabilities.

        The former is known from a position alone, the latter from a pressure. Flows are over the area, as the rates.
        """
        p, prior = self._pressure(self.loaded), leak_prior()
        if self.travel is not None:
            fit, _, logs = self._motion
            curve, converted = self._make_curve("x", "mm", self._travel_readings, fit, 1.0), fit.converted
            rate, flow = fit.rate.multiply(prior), self._widen(fit.rate).multiply(prior)
            widened = None if converted is None else self._widen(converted).multiply(prior)
            leaks = [LeakEstimate(rate, flow, widened, curve, fit)]
            if p is not None and logs[1] - logs[0] > math.log(LEAST_WEIGHT):
                leaks.append(self._leak_by_pressure(p)[0])
        elif p is not None:
            at_rest, logs = self._leak_by_pressure(p)
            leaks = [LeakEstimate(prior, prior, at_rest.converted and prior, at_rest.curve, at_rest.fit), at_rest]
        else:
            return [], np.zeros(0)
        return leaks, weigh_alternatives(np.array(logs[: len(leaks)]))

    def _leak_by_pressure(self, p: Array) -> tuple[LeakEstimate, tuple[float, float]]:
        """Estimate the leak from the fall of the pressure `p` of a chamber whose piston stands still.

        Returns also the log probabilities that the piston sinks instead, at a pressure that friction alone lets vary,
        and that it rests.
        """
        length, deviation = self.column
        pressures, compression, base = self._read_compression(p, -length)
        fit = self._fit_leak(RateRegression(compression, self.duration), base, INFERENCE.held_oil.deviation)
        width = math.hypot(deviation, INFERENCE.held_oil.deviation)
        rate, converted = fit.rate.scale(1.0, width).condense(), fit.converted
        if converted is not None:
            converted = converted.scale(1.0, width).condense().multiply(leak_prior())
        size = HOLD.load.steady * INFERENCE.held_oil.compressibility * BAR * length / (self.duration / 60.0)
        steady = Mixture(np.ones(1), np.array([size]), np.zeros(1))
        alternatives = [self._settling(compression, self._strain_sizes(length)), self._bends(compression)]
        sinking = RateRegression(compression, self.duration).fit_rate(
            [Column(compression.t / 60.0), *base], alternatives
        )
        logs = (
            math.log(HOLD.load.sinking) + sinking.log_evidence + log_overlap(sinking.rate, steady),
            math.log(1.0 - HOLD.load.sinking) + fit.log_evidence + log_overlap(rate, leak_prior()),
        )
        rate = rate.multiply(leak_prior())
        # the fit is drawn as a pressure, by the slope of the compression over the hold
        travelled, fallen = np.ptp(compression.values), np.ptp(pressures.values) / BAR
        in_bar = pressures._replace(values=(pressures.values - P_ATM) / BAR)
        slope = -float(fallen / travelled) if travelled > 0.0 else 0.0
        curve = self._make_curve(f"p_{self.loaded}", "bar", in_bar, fit, slope)
        return LeakEstimate(rate, rate, converted, curve, fit), logs

    def _fit_laws(
        self,
        regression: RateRegression,
        base: Sequence[Column],
        alternatives: Sequence[Sequence[Alternative]],
        clocks: Sequence[LeakClock],
        cooling: Callable[[float], list[Alternative]] | None = None,
    ) -> RateFit:
        """Fit the rate [mm/min] under each law of a leak (`clocks`), and pool the laws.

        `cooling`: lists the alternatives of the oil's temperature by the speed [mm/min] that follows the viscosity
        (`_cooling`), which for each law is estimated by the one before it.
        """
        fits, logs = [], []
        speed = float(np.ptp(regression.readings.values)) / (self.duration / 60.0)
        viscous = 0.0  # the first law is that of an orifice
        for clock in clocks:
            law = [Column(speed * error, 0.0, 1.0) for error in clock.errors]
            thermal = [cooling(clock.laminar * viscous)] if cooling else []
            fits.append(regression.fit_rate([Column(clock.minutes), *base, *law], [*alternatives, *thermal]))
            viscous = fits[-1].rate.multiply(leak_prior()).mean
            fits[-1] = fits[-1]._replace(converted=clock.convert(fits[-1].rate))
            logs.append(math.log(clock.weight) + clock.belief * fits[-1].log_evidence)
        return pool_fits(fits, logs)

    def _fit_leak(self, regression: RateRegression, base: Sequence[Column], deviation: float) -> RateFit:
        """Fit the rate of a leak [mm/min] under each law, with temperature and what settles.

        `deviation`: of the effect of a logged temperature, relative to the terms of `base`.
        """
        readings = regression.readings
        length, _ = self.column
        alternatives = [self._settling(readings, self._strain_sizes(length)), self._bends(readings)]
        clocks = self._clocks(readings)
        if len(clocks) == 1 and self.warming > HOLD.cooling.steady:  # at a steady pressure the laws differ by viscosity
            share = sum((2.0 * exponent - 1.0) * weight for exponent, weight in LAWS.items())
            laws = (0.0, 1.0 - share), (1.0, share)
            clocks = [clocks[0]._replace(weight=weight, laminar=power, belief=0.0) for power, weight in laws]
        cooling = partial(self._cooling, readings, length, deviation)
        fit = self._fit_laws(regression, base, alternatives, clocks, cooling)
        # oil that cools unlogged follows an exponential but for a share, which is as straight as a leak
        misfit = 0.0 if self.temperature else HOLD.cooling.misfit * float(np.ptp(fit.last))
        return fit._replace(rate=fit.rate.add_error(misfit / (self.duration / 60.0)))

    def _make_curve(self, channel: str, unit: str, readings: Readings, fit: RateFit, factor: float) -> HoldCurve:
        """Make the curve of a hold from readings to be drawn; `factor`: from the unit of the fit to theirs."""
        start = float(self.recording.t[0]) if self.recording is not None else 0.0
        line, half = factor * fit.fit, abs(factor) * WITHIN_95 * fit.band
        line = line + float(np.mean(readings.values) - np.mean(line))
        return HoldCurve(channel, unit, readings.t + start, readings.values, line, line - half, line + half)
