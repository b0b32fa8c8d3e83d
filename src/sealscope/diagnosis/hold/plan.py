"""Predict a hold test by the formula of its own fit: minutes to hold, and the smallest creep and leak it will show."""

from __future__ import annotations

import math
from bisect import bisect_left
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.estimate.population import Mixture
from sealscope.diagnosis.hold.hold_equation import ROUNDED
from sealscope.diagnosis.hold.regression import Column, Noise, leak_prior, predict_deviation
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.errors import InputError
from sealscope.units import BAR, LITRE_PER_MINUTE, ML_PER_MINUTE, MM_PER_MINUTE

#: Durations that are tried [min], and the duration that is planned if no leak to detect is stated.
HOLD_MINUTES, DEFAULT_MINUTES = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 240.0), 10.0
#: Most readings in the formula; more count by their smaller noise.
MAX_READINGS = 120
#: Readings a second that are assumed of a logger.
READINGS_PER_SECOND = 1.0
#: Ratio of the error with a noise of unknown colour to that with white noise, measured (benchmarks/hold_tests.py).
UNKNOWN_NOISE = 1.2
#: Leaks that are tried, in standard errors, to find the smallest that is told from none.
TRIED_ERRORS: tuple[float, ...] = tuple(np.arange(1.5, 8.0, 0.1).tolist())


def predict_rate_error(
    minutes: float, n_readings: float, noise: Noise, s: float, duration: float, length: float, warming: float
) -> float:
    """Predict the standard deviation of the leak's rate [mm/min] in a hold of so many `minutes`.

    `n_readings`: number of readings with the `noise`, whose white part has the standard deviation `s` [mm] and whose
    random walk reaches its ratio after `duration` [s]; `length` [mm]: of the oil column; `warming` [K]: standard
    deviation of a temperature change that is not logged, 0 for none.
    """
    m = int(min(max(n_readings, 4.0), MAX_READINGS))
    t = 60.0 * minutes * (np.arange(m) + 0.5) / m
    columns = [Column(t / 60.0), Column(np.ones(m))]
    size = HOLD.cooling.expansion * length * warming
    courses = [[Column(np.expm1(-t / time), 0.0, size)] for time in HOLD.cooling.times] if size else [[]]
    return predict_deviation(t, columns, courses, noise, s, duration, m / n_readings)


def find_shown_rate(error: float) -> float:
    """Find the smallest rate [mm/min] whose interval excludes 0, measured with a standard `error` [mm/min]."""
    prior, one = leak_prior(), np.ones(1)

    def is_shown(z: float) -> bool:
        """Test whether the interval of a leak of z errors excludes 0."""
        return Mixture(one, error * one, z * error * one).multiply(prior).interval[0] > 0.0

    k = bisect_left(TRIED_ERRORS, True, key=is_shown)
    return error * TRIED_ERRORS[min(k, len(TRIED_ERRORS) - 1)]


class PlannedHold(NamedTuple):
    """A planned hold: its load `force` [N] and `minutes`, and what it shows.

    `pressure` [Pa]: that of the loaded side; `creep` [m/s], `leak` [m^3/s]: smallest ones whose interval excludes zero
    with the wanted probability; `warming` [K]: change of the oil's temperature that nobody logs; `per_kelvin` [m^3/s]:
    what each kelvin of a logged change adds to the leak that is shown; `find` [m^3/s]: leak that was to be shown, 0 if
    none was stated.
    """

    force: float
    minutes: float
    pressure: float
    creep: float
    leak: float
    warming: float
    per_kelvin: float
    find: float

    def as_dict(self) -> dict[str, Any]:
        """Convert the hold to plain JSON values."""
        return {
            "load_N": self.force,
            "minutes": self.minutes,
            "pressure_Pa": self.pressure,
            "smallest_creep_mm_per_min": self.creep / MM_PER_MINUTE,
            "smallest_leak_lpm": self.leak / LITRE_PER_MINUTE,
            "unlogged_K": self.warming,
            "smallest_leak_lpm_per_logged_K": self.per_kelvin / LITRE_PER_MINUTE,
        }

    def text(self) -> str:
        """Format the planned hold as text, with a last line if no hold shows the leak that was to be found."""
        creep, leak, rise = self.creep / MM_PER_MINUTE, self.leak / ML_PER_MINUTE, self.per_kelvin / ML_PER_MINUTE
        oil = f"the oil's temperature logged (each K of its change adds {rise:.2g} mL/min)"
        oil = f"oil that changes by {self.warming:g} K unlogged" if self.warming else oil
        text = (
            f"hold {self.force / 1e3:.3g} kN for {self.minutes:g} min at {self.pressure / BAR:.3g} bar, valves shut: "
            f"`sealscope hold`\n  shows creep of {creep:.2g} mm/min and a leak of {leak:.2g} mL/min,\n"
            f"  with the loaded side's pressure logged, and {oil}"
        )
        if not 0.0 < self.find < self.leak:
            return text
        return f"{text}\n  no hold of up to {self.minutes:g} min shows {self.find / ML_PER_MINUTE:.2g} mL/min"


def plan_hold(
    force: float,
    area: float,
    length: float,
    step: float,
    *,
    noise: float = 0.0,
    warming: float = 0.0,
    find: float | None = None,
    detection: float = 0.9,
    length_deviation: float = HOLD.column.deviation,
) -> PlannedHold:
    """Find the shortest hold that shows a leak of the flow `find` [m^3/s], or what ten minutes show without it.

    `force` [N]: load; `area` [m^2]: of the loaded side; `length` [m]: of its oil column, known to the relative
    `length_deviation`; `step`, `noise` [m]: encoder step and noise of the position, beside which the pressure of the
    loaded side is logged: a position alone shows less of a leak; `warming` [K]: as of `PlannedHold`,
    of which the test allows what its prior does; `detection`: probability that the leak's interval excludes zero. If no
    duration in `HOLD_MINUTES` suffices, the longest is planned. Raises InputError for a load or an area that is not
    above 0.
    """
    for name, value in (("load", force), ("area", area), ("length of the oil column", length)):
        if not value > 0.0:
            raise InputError(f"{name} of a hold must be above 0, got {value:g}")
    quantile = NormalDist().inv_cdf(detection)
    s = max(1e3 * math.hypot(noise, step / math.sqrt(12.0)), 1e-6)
    cooling, plans = HOLD.cooling, []
    allowed = max(warming, *cooling.sizes) if warming else 0.0
    share = math.hypot(cooling.expansion_deviation, cooling.misfit, length_deviation)
    for minutes in HOLD_MINUTES:
        n_readings = 60.0 * minutes * READINGS_PER_SECOND
        white = Noise(0.0, math.inf, 1.0)
        error = predict_rate_error(minutes, n_readings, white, s, 60.0 * minutes, 1e3 * length, allowed)
        error *= UNKNOWN_NOISE
        if not warming:  # the rounding of the logged temperature
            error = math.hypot(error, ROUNDED * cooling.step * cooling.expansion * 1e3 * length / minutes)
        if noise < step / 3.0:  # a position that stays within one step tells the creep by that step alone
            error = math.hypot(error, 1e3 * step / math.sqrt(6.0) / minutes)
        creep = (find_shown_rate(error) + quantile * error) * MM_PER_MINUTE
        per_kelvin = WITHIN_95 * share * cooling.expansion * length * area / (60.0 * minutes)
        plans.append(PlannedHold(force, minutes, force / area, creep, creep * area, warming, per_kelvin, find or 0.0))
    if find is None:
        return plans[HOLD_MINUTES.index(DEFAULT_MINUTES)]
    return next((plan for plan in plans if plan.leak <= find), plans[-1])
