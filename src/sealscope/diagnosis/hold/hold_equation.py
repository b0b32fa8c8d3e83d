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
    pool_fits,
)
from sealscope.diagnosis.hold.result import HoldCurve
from sealscope.diagnosis.hold.set_up import SetUp
from sealscope.diagnosis.inference.circuit.holds.hold_oil import relative_compression
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import estimate_hold_offsets, small_difference_factor
from sealscope.diagnosis.inference.hypotheses import LAWS
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import chambers_of
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR, ML_PER_MINUTE, MM_PER_MINUTE, P_ATM

#: Lowest absolute pressure [Pa] at which oil with free air is compressed; below, its vapour fills the chamber.
LOWEST = 2e4
#: Ratio of the highest to the lowest pressure difference of a hold, above which the law of the leak counts.
STEADY_PRESSURE = 1.02
#: Start of the last part of a hold, over its duration, and the smallest difference of pressures that it resolves, in
#: standard deviations of the noise of parts.
LAST_PART, RESOLVED = 0.97, 4.0
#: Least noise [Pa] of a difference of pressures, which rounding may hide.
LEAST_NOISE = 1.0
#: Degree of the polynomial that smooths a logged temperature.
SMOOTH_DEGREE = 3
#: Time constants [durations of the hold] of the exponentials that such a smooth course has as well, and the number of
#: its passages from step to step, or of its means, that are needed for them.
COURSE_TIMES, MIN_PASSAGES = (0.2,), 24
#: Time [s] by which a logged temperature is moved to find its slope.
DELAY = 1.0
#: Number of time constants of what settles that are tried, to find the best.
N_TIMES = 30
#: Least driving pressure from which a flow is converted, in deviations of the zero of the sensors.
LEAST_DRIVE = 0.2
#: Factor by which the travel equivalent to a pressure's fall exceeds a piston's travel, where that is at a stop.
AT_STOP = 3.0
#: Error of the change of a rounded temperature over a hold, in steps.
ROUNDED = 0.15
#: Standard deviation of the logarithm of a time constant within a step of its grid, and a step of a derivative by it.
GRID_DEVIATION, SLIGHTLY = 0.3, 1.05
#: Least bend of a travel [mm] that is fitted.
LEAST_BEND = 1e-6
#: Millimetres of a metre.
_MM = 1e3


class LeakClock(NamedTuple):
    """Time weighted by the flow of a leak under one law: prior `weight`, `minutes` (m,) of mean `flow` (m,) 1.

    `spare` (m,): how much of it is due to the sensors' offset in a hold whose pressures a leak has equalised;
    `conversions`: probability, factor to the flow at the reference pressure, and deviation of its logarithm.
    """

    weight: float
    minutes: Array
    flow: Array
    spare: Array | None = None
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


def _exponential(
    readings: Readings, time: float, size: float, mean: float = 0.0, span: float = math.inf
) -> tuple[Column, Column]:
    """Build the columns of an exponential with an amplitude of the given `mean` and deviation `size`.

    The second column is its derivative by the logarithm of the time constant, which the grid of these leaves open.
    `span`: duration [s] of a hold without mean speed, by the chord of each column; infinite to leave it.
    """

    def course(ratio: float) -> Array:
        """Compute the exponential of `ratio` times the time constant."""
        chord = math.expm1(-span / (ratio * time)) / span if math.isfinite(span) else 0.0
        return readings.decay(ratio * time) - 1.0 - chord * readings.t

    slope = (course(SLIGHTLY) - course(1.0 / SLIGHTLY)) / (2.0 * math.log(SLIGHTLY))
    return Column(course(1.0), mean, size), Column(slope, 0.0, math.hypot(size, mean) * GRID_DEVIATION)


def _refine_times(readings: Readings, times: Sequence[float]) -> list[float]:
    """Replace the nearest of some time constants [s] by that of the exponential that fits the readings best.

    The rest of the readings is a polynomial meanwhile. Passages between the steps of an encoder are too few for it.
    """
    if readings.quantum or not times or len(readings.t) < MIN_PASSAGES:
        return list(times)
    tried = np.geomspace(times[0], times[-1], N_TIMES)
    basis = np.linalg.qr(course_basis(readings.t / readings.t[-1], SMOOTH_DEGREE))[0]
    rest = readings.values - basis @ (basis.T @ readings.values)
    courses = np.array([readings.decay(time) for time in tried])
    courses -= (courses @ basis) @ basis.T
    explained = (courses @ rest) ** 2 / np.maximum((courses**2).sum(axis=1), np.finfo(float).tiny)
    best = float(tried[int(explained.argmax())])
    nearest = int(np.abs(np.log(np.array(times) / best)).argmin())
    return [*times[:nearest], best, *times[nearest + 1 :]]


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
        if pressures:  # by force where the areas are known
            return max(pressures, key=lambda side: float(np.median(pressures[side])) * (self.set_up.area(side) or 1.0))
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
        """List what may settle in `readings` after the valve has shut; `sizes`: deviations of its amplitude.

        Without a pressure, a leak that falls off bends the readings, too, which takes nothing of its mean.
        """
        prior = HOLD.settling
        times = _refine_times(readings, [time for time in prior.times if time <= prior.longest * self.duration])
        weight = prior.present / max(len(times) * len(sizes), 1)
        terms = [_exponential(readings, time, size) for time in times for size in sizes]
        settling = [Alternative(1.0 - prior.present), *(Alternative(weight, term) for term in terms)]
        if self.mean_pressure is not None:
            return settling
        share, size = HOLD.other.locked / len(prior.emptying), max(float(np.ptp(readings.values)), LEAST_BEND)
        bends = [_exponential(readings, time * self.duration, size, span=self.duration) for time in prior.emptying]
        held = [entry._replace(weight=(1.0 - HOLD.other.locked) * entry.weight) for entry in settling]
        return held + [Alternative(share, bend) for bend in bends]

    def _thermal_columns(self, t: Array) -> list[Column]:
        """Build the columns [mm] of a logged temperature at times `t`; none without a log."""
        T = self._channel("T_oil")
        if T is None or np.isfinite(T).mean() < 0.5:
            return []
        logged = read_channel(self.t[np.isfinite(T)], T[np.isfinite(T)], HOLD.cooling.step)
        weights = 1.0 / np.hypot(logged.loose, max(logged.quantum, 1e-3))
        n_exact = int(np.count_nonzero(logged.loose == 0.0))
        degree = max(min(SMOOTH_DEGREE, n_exact - 1), 1)
        times = COURSE_TIMES if n_exact >= MIN_PASSAGES else ()
        basis = weights[:, None] * course_basis(logged.t / self.duration, degree, times)
        coefficients = np.linalg.lstsq(basis, weights * logged.values, rcond=None)[0]
        residual = (logged.values - basis @ coefficients / weights)[logged.loose == 0.0]
        error = float(np.sqrt(np.mean(residual**2) * basis.shape[1] / max(len(residual), 1))) if n_exact else 0.0
        length, deviation = self.column
        scale = -HOLD.cooling.expansion * length
        change = course_basis(t / self.duration, degree, times) - course_basis(np.zeros(1), degree, times)
        travel = scale * np.asarray(change @ coefficients)
        later = (
            course_basis((t + DELAY) / self.duration, degree, times) - change - course_basis(np.zeros(1), degree, times)
        )
        delayed = scale * np.asarray(later @ coefficients) / DELAY  # [mm/s]
        uncertainty = math.hypot(deviation, HOLD.cooling.expansion_deviation)
        unread = scale * math.hypot(0.5 * ROUNDED * logged.quantum, error)
        size = math.hypot(HOLD.cooling.misfit * float(np.ptp(travel)), unread)
        misfit = [Column(np.exp(-t / (time * self.duration)), 0.0, size) for time in times]
        lag = Column(delayed, *HOLD.cooling.lag)
        return [Column(travel, 1.0, uncertainty), lag, *self._misfit(t, t, size), *misfit]

    def _misfit(self, t: Array, course: Array, size: float) -> list[Column]:
        """Build the slope, of a standard deviation `size` [mm], and bends that a correction leaves at times `t` [s].

        `course` (m,): what the correction depends on, such as a pressure or the time; the bends are polynomials of it.
        """
        z = 2.0 * (course - course.min()) / (float(np.ptp(course)) or 1.0) - 1.0
        courses = 2.0 * t / self.duration - 1.0, 1.5 * z**2 - 0.5, 2.5 * z**3 - 1.5 * z  # Legendre polynomials
        return [Column(values, 0.0, size) for values in courses]

    def _cooling(self, readings: Readings, span: float = math.inf) -> list[Alternative]:
        """List the alternatives for the travel [mm] due to the oil's temperature in `readings`.

        `span`: as of `_exponential`, for oil that nobody logs. Where no pressure is logged, the other side may be
        locked: the travel by a logged temperature then has either sign.
        """
        prior, set_up = HOLD.cooling, self.set_up
        if logged := self._thermal_columns(readings.t):
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
        factor = prior.expansion * self.column[0]
        weight = 1.0 / (len(sizes) * len(prior.times))
        terms = [
            _exponential(readings, time, factor * d, -factor * mean, span) for time in prior.times for mean, d in sizes
        ]
        return [Alternative(weight, term) for term in terms]

    @property
    def warming(self) -> float:
        """Standard deviation [K] of a change of the oil's temperature that is neither logged nor stated to be small."""
        if self._thermal_columns(self.t[:1]):
            return 0.0
        return HOLD.cooling.steady if self.set_up.oil_course == "steady" else max(HOLD.cooling.sizes)

    def _clocks(self, readings: Readings) -> list[LeakClock]:
        """List the clocks of the laws of a leak, as `readings` see them."""
        p, other = self._pressure(self.loaded), self._pressure(self.unloaded)
        steady = LeakClock(1.0, readings.t / 60.0, np.ones_like(readings.t))
        if p is None:
            return [steady]
        # past the piston, or out of the cylinder
        differences = [p - P_ATM] if other is None else [p - other, p - P_ATM]
        courses = [smooth_course(self.t, difference) for difference in differences]
        if all(course.max() < STEADY_PRESSURE * course.min() for _, course in courses):
            conversions = [self._convert(course, *law) for _, course in courses for law in LAWS.items()]
            return [steady._replace(conversions=tuple(filter(None, conversions)))]
        clocks = []
        for k, (part_t, course) in enumerate(courses):
            driving = course
            if k == 0 and other is not None:
                # what is left of the difference after a leak has equalised the pressures is an error of the sensors
                last = self.t >= self.duration * LAST_PART
                offset, _, is_equalised = estimate_hold_offsets(float(p[last].mean()), float(other[last].mean()), 0.0)
                if is_equalised:
                    noise = float(np.std(p[last] - other[last])) / math.sqrt(max(len(p) / N_PARTS, 1.0))
                    driving = (course - offset) * small_difference_factor(
                        course - offset, RESOLVED * noise + LEAST_NOISE
                    )
            for exponent, weight in LAWS.items():
                minutes, flow = self._weigh_time(readings, part_t, driving, exponent)
                spare = minutes - self._weigh_time(readings, part_t, course, exponent)[0]
                clock = LeakClock(weight / len(differences), minutes, flow, None if driving is course else spare)
                conversion = self._convert(driving, exponent, 1.0)
                clocks.append(clock._replace(conversions=(conversion,) if conversion else ()))
        return clocks

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
        t = readings.t
        base = [Column(t / 60.0), Column(np.ones_like(t)), *self._pressure_bends()]
        resting = [Alternative(stopped)]
        if logged := self._thermal_columns(t):
            thermal = [Alternative(1.0 - stopped, tuple(logged))]
        elif self.set_up.oil_course:
            thermal = [Alternative((1.0 - stopped) * weight, columns) for weight, columns in self._cooling(readings)]
        else:
            bends = self._cooling(readings, self.duration)
            thermal = resting + [Alternative((1.0 - stopped) * weight, columns) for weight, columns in bends]
            resting = []
        settling = self._settling(readings, HOLD.settling.travel)
        fits = [self._regression.fit_rate(base, [settling, terms]) for terms in (thermal, resting) if terms]
        logs = [fit.log_evidence for fit in fits]
        if resting:  # a piston on its stop follows no temperature, and does not creep
            logs[1] -= 0.5 * (fits[1].rate.mean / fits[1].rate.deviation) ** 2
        fit = pool_fits(fits, logs)
        change = float(fit.fit[-1] - fit.fit[0]) * self.duration / float(t[-1] - t[0])
        bend = float(np.ptp(self._bend(t, fit.fit, change)))
        bent = HOLD.cooling.misfit * bend / (self.duration / 60.0)
        return fit._replace(rate=fit.rate.add_error(bent))

    def _pressure_bends(self) -> list[Column]:
        """Build the bends [mm] of the travel by pressures that change: compression, and laws of a leak."""
        readings = self._travel_readings
        columns, clocks = self._compression_columns(is_bend=True), self._clocks(readings)
        speed = float(np.ptp(readings.values)) / (self.duration / 60.0)
        for k, clock in enumerate(clocks):
            if len(clocks) > 1 and k % len(LAWS) != 1:  # the law between is nearly their mean
                columns.append(Column(speed * self._bend(readings.t, clock.minutes, self.duration / 60.0), 0.0, 1.0))
        return [column for column in columns if np.ptp(column.values) > LEAST_BEND]

    def _compression_columns(self, *, is_bend: bool = False) -> list[Column]:
        """Build the columns of the travel [mm] by compression of the loaded side's oil and air, and what these leave.

        `is_bend`: without the chords between their ends, which leaves no mean speed.
        """
        p = self._pressure(self.loaded)
        if p is None:
            return []
        oil, readings, (length, deviation) = INFERENCE.held_oil, self._travel_readings, self.column
        t, course = smooth_course(self.t, p)
        columns = []
        for compression, width in zip(_compress_oil(course), (oil.deviation, oil.air_deviation), strict=True):
            travel = length * (compression - compression[0])
            columns.append(Column(travel, 1.0, math.hypot(deviation, width)))
            if np.ptp(travel) > LEAST_BEND:
                columns += self._misfit(t, travel, oil.misfit * float(np.ptp(travel)))
        if is_bend:
            columns = [
                entry._replace(values=self._bend(t, entry.values, float(entry.values[-1] - entry.values[0])))
                for entry in columns
            ]
        return [entry._replace(values=sample_course(readings, t, entry.values)) for entry in columns]

    def _bend(self, t: Array, course: Array, change: float) -> Array:
        """Subtract from a `course` at times `t` [s] a line with its `change` over the hold: no mean speed is left."""
        return np.asarray(course - change * t / self.duration)

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
        size = INFERENCE.held_oil.misfit * float(np.ptp(compression))
        course = sample_course(readings, *smooth_course(self.t, p))
        misfit = self._misfit(readings.t, course, size) if size > LEAST_BEND else []
        return readings, travel, [Column(np.ones_like(readings.t)), *misfit]

    @cached_property
    def gain(self) -> Mixture | None:
        """Rate [mm/min] at which the other side is compressed, as travel of its own area; None without its pressure."""
        p = self._pressure(self.unloaded)
        if p is None:
            return None
        length, deviation = self.set_up.column(self.unloaded, None)
        _, compression, base = self._read_compression(p, _MM * length)
        t = compression.t
        # oil that cools in a closed chamber loses pressure; a side that is open to the tank follows no temperature
        logged = [column._replace(values=-column.values) for column in self._thermal_columns(t)]
        closed = [Alternative(1.0, tuple(logged))] if logged else self._cooling(compression)
        thermal = [Alternative(0.5), *(Alternative(0.5 * weight, columns) for weight, columns in closed)]
        sizes = [_MM * length * strain for strain in HOLD.settling.strain]
        alternatives = [self._settling(compression, sizes), thermal]
        clocks = [clock._replace(conversions=()) for clock in self._clocks(compression)[: len(LAWS)]]
        if len(clocks) > 1:  # a steady gain, too, whatever its law
            clocks.append(LeakClock(clocks[0].weight, t / 60.0, np.ones_like(t)))
        fit = self._fit_laws(RateRegression(compression, self.duration), base, alternatives, clocks)
        return fit.rate.scale(1.0, math.hypot(deviation, INFERENCE.held_oil.deviation))

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
            rates = leak.rate.multiply(leak_prior()), leak.converted and leak.converted.multiply(leak_prior())
            if area is None:
                return leak._replace(rate=rates[0], converted=None)
            flows = [rate and rate.scale(MM_PER_MINUTE * area) for rate in rates]
            return leak._replace(rate=rates[0], flow=flows[0], converted=flows[1])
        clocks = self._clocks(Readings(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)) if self.t.size else []
        converted = [entry for clock in clocks if (entry := clock.convert(flow)) is not None]
        at_reference = pool_mixtures(converted, np.array([clock.weight for clock in clocks])) if converted else None
        return LeakEstimate(None if area is None else flow.scale(1.0 / (MM_PER_MINUTE * area)), flow, at_reference)

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
        base = [Column(np.ones_like(readings.t)), *self._compression_columns()]
        fit = self._fit_leak(self._regression, base, HOLD.settling.travel)
        return LeakEstimate(fit.rate, None, fit.converted, self._make_curve("x", "mm", readings, fit, 1.0), fit)

    def _leak_by_pressure(self) -> LeakEstimate:
        """Estimate the leak from the fall of the pressure of a chamber whose piston stands still."""
        p = self._pressure(self.loaded)
        if p is None:
            return LeakEstimate(None, None)
        length, deviation = self.column
        pressures, compression, base = self._read_compression(p, -length)
        sizes = [length * strain for strain in HOLD.settling.strain]
        fit = self._fit_leak(RateRegression(compression, self.duration), base, sizes)
        width = math.hypot(deviation, INFERENCE.held_oil.deviation)
        rate, converted = fit.rate.scale(1.0, width), fit.converted and fit.converted.scale(1.0, width)
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
        return low <= 0.0 <= high and float(np.ptp(compression)) * self.column[0] > AT_STOP * travel

    def _fit_laws(
        self,
        regression: RateRegression,
        base: Sequence[Column],
        alternatives: Sequence[Sequence[Alternative]],
        clocks: Sequence[LeakClock],
    ) -> RateFit:
        """Fit the rate [mm/min] under each law of a leak (`clocks`), and pool the laws."""
        t = regression.readings.t
        fits, logs = [], []
        speed = float(np.ptp(regression.readings.values)) / (self.duration / 60.0)
        for clock in clocks:
            law = [] if clock.spare is None else [Column(speed * clock.spare, 0.0, 1.0)]
            bend = float(np.ptp(speed * self._bend(t, clock.minutes, self.duration / 60.0)))
            if bend > LEAST_BEND:
                law += self._misfit(t, clock.minutes, INFERENCE.held_oil.misfit * bend)
            fits.append(regression.fit_rate([Column(clock.minutes), *base, *law], alternatives))
            fits[-1] = fits[-1]._replace(converted=clock.convert(fits[-1].rate))
            logs.append(math.log(clock.weight) + fits[-1].log_evidence)
        return pool_fits(fits, logs)

    def _fit_leak(self, regression: RateRegression, base: Sequence[Column], sizes: Sequence[float]) -> RateFit:
        """Fit the rate of a leak [mm/min] under each law, with temperature and what settles."""
        readings = regression.readings
        alternatives = [self._settling(readings, sizes), self._cooling(readings)]
        fit = self._fit_laws(regression, base, alternatives, self._clocks(readings))
        # oil that cools unlogged follows an exponential but for a share, which is as straight as a leak
        is_logged = bool(self._thermal_columns(readings.t[:1]))
        misfit = 0.0 if is_logged else HOLD.cooling.misfit * float(np.ptp(fit.last)) / (self.duration / 60.0)
        return fit._replace(rate=fit.rate.add_error(misfit))

    def _make_curve(self, channel: str, unit: str, readings: Readings, fit: RateFit, factor: float) -> HoldCurve:
        """Make the curve of a hold from readings to be drawn; `factor`: from the unit of the fit to theirs."""
        start = float(self.recording.t[0]) if self.recording is not None else 0.0
        line, half = factor * fit.fit, abs(factor) * WITHIN_95 * fit.band
        line = line + float(np.mean(readings.values) - np.mean(line))
        return HoldCurve(channel, unit, readings.t + start, readings.values, line, line - half, line + half)
