"""Leakage while valves cut a cylinder off from its pump and hold the load, from the balances of both chambers.

Such a hold leaves each chamber a closed volume with leaks. From the beginning of the hold on,

    m_A dx + V_A (dp_A/K - alpha p_0 d(1/p_A)) = -G I - e_A I_A,
   -m_B dx + V_B (dp_B/K - alpha p_0 d(1/p_B)) = +G I - e_B I_B,

with

- G, e_A, e_B: coefficients of the leaks past the piston, to the outside from A, and to the outside from B;
- m_A, m_B: areas of the piston, as measured with the pump's assumed displacement;
- V_A, V_B: volumes of oil, with the bulk modulus K and the fraction alpha of free air;
- I: time integral of a power of p_A - p_B - z, where z is the sensor offset; I_A, I_B: those of the gauge pressures;
- p_0: atmospheric pressure.

A leaking piston moves oil from A to B; a leaking rod seal drains one side only, and the piston gives way. A check valve
may fill a side that is at the charge pressure, or the side without the load may be open to the charge line; no balance
holds for that side then. A reading is the mean of neighbouring samples of a hold (`LockedHold.edges`). The first is of
the time in which the valves may still shut; it counts only on the side of the lower pressure, whose oil comes through a
leak alone: a large leak equalises the pressures within that time. The readings of all holds form one regression
(`oil`), each side of a hold about its mean. The onset of the leak and the offset z are those with the highest
posterior; a leak that has equalised the pressures determines z. The three leaks are hypotheses, each with its
probability. A leak may grow from its onset on.

Source: Merritt, Hydraulic Control Systems, 1967, section 6.3 (continuity of the chambers).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.interval import Estimate, Interval
from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.inference.blocks import offset_cost
from sealscope.diagnosis.inference.circuit.holds.hold_oil import (
    CylinderSides,
    OilRegression,
    build_regression,
    fit_leak,
)
from sealscope.diagnosis.inference.circuit.holds.leaks import (
    BOTH,
    NEITHER,
    UNKNOWN,
    HeldLeaks,
    LawFit,
    LeakFit,
    LeakHypothesis,
    PistonLeak,
    SideSupplies,
    SideSupply,
    UnitLeak,
    average_fits,
    flow_of_side,
    growth_factor,
)
from sealscope.diagnosis.inference.circuit.holds.onset_sums import (
    HoldSamples,
    OnsetPriors,
    iter_offset_sums,
    score_onsets,
    sum_onset_products,
)
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import (
    LockedHold,
    estimate_hold_offsets,
    small_difference_factor,
)
from sealscope.diagnosis.inference.hypotheses import GROWTHS, LAWS
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: Coarse grid of offsets of p_A - p_B [standard deviations of the prior], and number of points of the refined grid.
OFFSET_GRID, N_REFINED = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0]), 17
#: Values of a normal variable of mean 0 and variance 1, and their weights, of Gauss-Hermite quadrature.
AREA_NODES, AREA_WEIGHTS = (0.0, 3.0**0.5, -(3.0**0.5)), (2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0)
#: Supplies of the sides with a smaller log prior are not tried.
MIN_LOG_PRIOR = -30.0
#: Number of evenly spaced onsets within a hold.
N_ONSETS = 4
#: Largest number of last readings of holds that are tried as the sensor offset.
MAX_ENDS = 64
#: Probability outside of the interval of an onset.
TAIL = 0.05


@dataclass(frozen=True, eq=False)
class HeldChambers:
    """Estimator of the leaks of a cylinder's chambers from holds, i.e. times in which shut valves hold the load.

    `holds`: samples of each hold; `sides`: areas and recorded stroke of the cylinder; `begin`, `end`: times of the
    first and the last sample of the recording [s]; `charge`: absolute pressure that check valves maintain [Pa].
    """

    holds: Sequence[LockedHold]
    sides: CylinderSides
    begin: float
    end: float
    charge: float

    def area_variants(self) -> list[tuple[float, HeldChambers]]:
        """Return this estimator with three areas of the less certain side, each with its probability.

        The areas are the Gauss-Hermite quadrature of the normal distribution of the area's logarithm. How well one fits
        the holds does not count: errors by delays of the sensors repeat from hold to hold. If both areas are known
        (`size.area` in `priors.toml`), there is only this estimator.
        """
        sides = self.sides
        deviation = max(sides.deviation_A, sides.deviation_B)
        if deviation <= INFERENCE.size.area:
            return [(1.0, self)]
        name = "area_A" if sides.deviation_A > sides.deviation_B else "area_B"
        variants = []
        for node, probability in zip(AREA_NODES, AREA_WEIGHTS, strict=True):
            area = getattr(sides, name) * math.exp(node * deviation)
            variants.append((probability, replace(self, sides=sides._replace(**{name: area}))))
        return variants

    @property
    def n_readings(self) -> float:
        """Effective number of independent readings (means of neighbouring samples) of both sides in all holds."""
        independent: float = INFERENCE.held_oil.independent_readings
        return independent * 2.0 * len(self.holds)

    @cached_property
    def _samples(self) -> HoldSamples:
        """Samples of all holds, one after the other, for compiled functions."""
        return HoldSamples.from_holds(self.holds)

    @cached_property
    def _regressions(self) -> dict[SideSupplies, OilRegression]:
        """Regressions that estimate the oil's properties, one for each possible choice of the sides' supplies."""
        return {
            supplies: build_regression(self._samples, self._closed_flags(supplies), self.sides, self.n_readings)
            for supplies in (NEITHER, self._refillable_sides, BOTH, self._unloaded_open)
        }

    @cached_property
    def _onset_priors(self) -> dict[SideSupplies, OnsetPriors]:
        """Numbers by which onsets of a leak are scored, for each of the `_regressions`."""
        return {
            supplies: regression.onset_priors(self._variances_without_leak[supplies], self.n_readings)
            for supplies, regression in self._regressions.items()
        }

    @property
    def _refillable_sides(self) -> SideSupplies:
        """Supplies of A and B if a check valve refills only the side of the larger area, while the piston leaks.

        The leak moves equal volumes from one side to the other, and the piston follows the side that loses oil. If the
        other side has the larger area, its volume grows by more than the leak supplies, and the check valve opens. With
        equal areas none opens.
        """
        area_A, area_B = abs(self.sides.area_A), abs(self.sides.area_B)
        if area_A == area_B:
            return NEITHER
        return (SideSupply.CHECK, SideSupply.SHUT) if area_A > area_B else (SideSupply.SHUT, SideSupply.CHECK)

    @cached_property
    def _unloaded_open(self) -> SideSupplies:
        """Supplies of A and B if the side with the lower mean pressure is open; a check valve refills the other."""
        means = [pressure.mean() for pressure in (self._samples.p_A, self._samples.p_B)]
        return (SideSupply.CHECK, SideSupply.OPEN) if means[0] > means[1] else (SideSupply.OPEN, SideSupply.CHECK)

    def _supply_log_prior(self, supplies: SideSupplies, *, drains: bool) -> float:
        """Compute the log prior of the sides' supplies; `drains`: true if the side without the load gains oil.

        An open side has the probability `held_oil.open_probability` (`priors.toml`), any other choice 1 minus this.
        This side is above the charge pressure, by more than the back pressure `held_oil.tank_pressure` of its line,
        only while it empties: for the fraction a = `held_oil.time_above_charge` of a hold. Each hold with a larger
        fraction f multiplies the probability by exp(-(f - a) / a). If both have check valves, a side that gains oil
        drains to the tank: the charge pressure is then that of a tank line, which is normal about 0 gauge with the
        standard deviation `held_oil.tank_pressure`.
        """
        prior = INFERENCE.held_oil
        if SideSupply.OPEN in supplies:
            return self._open_log_prior
        log_prior = math.log1p(-prior.open_probability)
        if drains and supplies == BOTH:
            log_prior -= 0.5 * ((self.charge - P_ATM) / prior.tank_pressure) ** 2
        return log_prior

    @cached_property
    def _open_log_prior(self) -> float:
        """Log prior of an open unloaded side (`_supply_log_prior`)."""
        prior, side = INFERENCE.held_oil, 0 if self._unloaded_open[0] is SideSupply.OPEN else 1
        above = [self._are_closed(hold, prior.tank_pressure)[side] for hold in self.holds]
        excess = [max(float(flags.mean()) - prior.time_above_charge, 0.0) for flags in above]  # in each hold
        return math.log(prior.open_probability) - sum(excess) / prior.time_above_charge

    def _are_closed(self, hold: LockedHold, back_pressure: float = 0.0) -> NDArray[np.bool_]:
        """Flag the samples of a hold in which no check valve refills chamber A (row 0) or B (row 1), (2, n).

        The averaged absolute pressure then exceeds the charge pressure by a relative and an absolute margin,
        `held_oil.charge_margin` and `held_oil.resolution` (`priors.toml`), and by `back_pressure` [Pa].
        """
        prior = INFERENCE.held_oil
        limit = self.charge * (1.0 + prior.charge_margin) + prior.resolution + back_pressure
        return np.asarray(hold.steady_pressures > limit)

    @cached_property
    def _above_charge(self) -> NDArray[np.bool_]:
        """Flags (2, N) of the samples of all holds in which A (row 0) or B (row 1) is above the charge pressure."""
        return np.concatenate([self._are_closed(hold) for hold in self.holds], axis=1)

    @cached_property
    def _possible_supplies(self) -> list[SideSupplies]:
        """Supplies of A and B that are tried for a leak.

        Shut sides are always tried, check valves if a side that they refill is at the charge pressure in some samples.
        An open unloaded side is tried unless it is above that pressure for too long (`_supply_log_prior`).
        """
        possible = [sides for sides in (self._refillable_sides, BOTH) if self._closed_share(sides) < 1.0]
        # `drains` has no effect on an open side
        if self._supply_log_prior(self._unloaded_open, drains=True) > MIN_LOG_PRIOR:
            possible.append(self._unloaded_open)
        return [NEITHER, *possible]

    def _closed_flags(self, supplies: SideSupplies) -> NDArray[np.bool_]:
        """Flag the samples of all holds in which A (row 0) or B (row 1) is closed, (2, N).

        A side is always closed without a supply, never if it is open, and above the charge pressure if a check valve
        refills it.
        """
        is_shut, has_check = (
            np.array([[supply is kind] for supply in supplies]) for kind in (SideSupply.SHUT, SideSupply.CHECK)
        )
        return np.asarray(is_shut | (has_check & self._above_charge))

    @cached_property
    def _closed_samples(self) -> dict[SideSupplies, NDArray[np.bool_]]:
        """Flags (2, N) of the samples of all holds in which A or B is closed, by the supplies of A and B."""
        return {supplies: self._closed_flags(supplies) for supplies in self._regressions}

    @cached_property
    def _closed_shares(self) -> dict[SideSupplies, float]:
        """Fraction of samples, over both sides and all holds, in which a side is closed, by the supplies of A and B."""
        return {supplies: float(flags.mean()) for supplies, flags in self._closed_samples.items()}

    def _closed_share(self, supplies: SideSupplies) -> float:
        """Return the fraction of samples in which a side is closed (`_closed_shares`), above 0.

        While a side is not closed, its readings are constant and fit any leak: the variance of all readings is too
        small by this factor.
        """
        return max(self._closed_shares[supplies], 1.0 / self.n_readings)  # above 0, since its logarithm is used

    def _hold_offsets(self, offsets: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Estimate the sensor offset in each of H holds for g offsets of the recording, (g, H) each.

        See `estimate_hold_offsets`.
        """
        last_A, last_B = self._last_pressures
        return estimate_hold_offsets(last_A, last_B, offsets[:, None])

    @cached_property
    def _last_pressures(self) -> Array:
        """Pressures of A (row 0) and B (row 1) at the end of each of H holds [Pa] (`LockedHold.last_pressures`)."""
        return np.array([hold.last_pressures for hold in self.holds]).T

    def driving_pressure(self, offset: float) -> Array:
        """Compute p_A - p_B [Pa] at each of N samples minus its hold's offset, given the recording's `offset` [Pa].

        Once a leak has equalised the pressures, small differences d are errors of the sensors, whose integral may
        exceed that of the large difference before. In such holds d is multiplied by the `small_difference_factor` of
        `held_oil.resolution`.
        """
        (offsets,), _, (is_equalised,) = self._hold_offsets(np.array([offset]))
        difference = self._samples.difference - np.repeat(offsets, self._samples.sizes)
        factor = small_difference_factor(difference, INFERENCE.held_oil.resolution)
        return np.asarray(np.where(np.repeat(is_equalised, self._samples.sizes), difference * factor, difference))

    def _unit_piston_leak(self, leak: PistonLeak) -> UnitLeak:
        """Compute the flow past the piston in the holds for a `leak` with a coefficient of 1.

        With the exponent e and dp = p_A - p_B - z, it is sign(dp) |dp|^e times the `growth_factor`. The sensor offset z
        in a hold may differ from the recording's (`driving_pressure`).
        """
        difference = self.driving_pressure(leak.offset)
        flow = np.sign(difference) * np.abs(difference) ** leak.exponent
        flow *= growth_factor(self._samples.t, leak.growth, leak.onset, self.end)
        return self._while_closed(np.array([flow, -flow]), leak.supplies)

    def _while_closed(self, flows: Array, supplies: SideSupplies) -> UnitLeak:
        """Set `flows` (2, N) out of A and B to 0 while a side is not closed."""
        return UnitLeak(flows * self._closed_samples[supplies], supplies)

    def pressure_difference(self, t: Array, difference: Array, offset: float) -> Array:
        """Subtract the sensor offset from p_A - p_B = `difference` (n,) [Pa] at times `t` (n,) [s] of the recording.

        It is the `offset` [Pa] of the recording or, from the start of a hold to the end of its rest, that of the hold
        (`_hold_offsets`). Pressures that a leak has equalised then differ by 0.
        """
        prior, offsets = INFERENCE.held_oil, np.full(len(t), offset)
        hold_offsets = self._hold_offsets(np.array([offset]))[0][0]
        for hold, hold_offset in zip(self.holds, hold_offsets, strict=True):
            # `hold.t` leaves out the end of the rest, in which the valves open and over which the flow was averaged
            begin, end = hold.t[0], hold.t[-1] + prior.shutting_time + INFERENCE.rest.averaging_time
            offsets[slice(*np.searchsorted(t, [begin, np.nextafter(end, np.inf)]))] = hold_offset
        return np.asarray(difference - offsets)

    def _unit_outside_leak(self, is_A: bool, supplies: SideSupplies = BOTH) -> UnitLeak:
        """Compute the flow [Pa] out of A (or B, if not `is_A`) to the outside for a conductance of 1.

        It is the gauge pressure of the side, at least 0, and 0 while the side is not closed: its supply, in `supplies`,
        then replaces or takes the oil.
        """
        pressure = self._samples.p_A if is_A else self._samples.p_B
        return self._while_closed(flow_of_side(np.maximum(pressure - P_ATM, 0.0), is_A), supplies)

    def _unit_pump_leak(self, is_A: bool) -> UnitLeak:
        """Compute the flow [Pa] from A (or B, if not `is_A`) through open valves and the pump, for a conductance of 1.

        The other chamber has no flow, since check valves or a shuttle valve keep it at the charge pressure.
        """
        sign = 1.0 if is_A else -1.0
        # 0: the offset of the recording is not known here
        offsets = self._hold_offsets(np.zeros(1))[0][0]
        difference = self._samples.difference - np.repeat(offsets, self._samples.sizes)
        return UnitLeak(flow_of_side(np.maximum(sign * difference, 0.0), is_A))

    @cached_property
    def _variances_without_leak(self) -> dict[SideSupplies, float]:
        """Variance of a reading [m^6] without any leak, by the supplies of A and B."""
        return {
            supplies: fit_leak(regression, np.empty(0), self.n_readings).variance
            for supplies, regression in self._regressions.items()
        }

    def fit_piston_leak(self, leak: PistonLeak) -> LeakFit:
        """Fit the coefficient of a leak past the piston; the likelihood includes the priors on offset and supplies."""
        onset, regressors = np.array([leak.onset]), self._regressions[leak.supplies].regressors
        flows = self._unit_piston_leak(leak).flows
        sums = sum_onset_products(self._samples, flows, np.zeros(1), self.end, onset, regressors)
        return self._fit_piston_sums(leak, sums[0, :, 0])

    def _fit_piston_sums(self, leak: PistonLeak, sums: Array) -> LeakFit:
        """Fit the coefficient of a leak past the piston from its `sums` (8,) (`fit_piston_leak`)."""
        fit = self._fit_leak(leak.supplies, sums)
        return fit._replace(log_likelihood=fit.log_likelihood + self._conditions_log_prior(leak))

    def _conditions_log_prior(self, leak: PistonLeak) -> float:
        """Compute the log prior of a leak's supplies and sensor offset, up to a constant.

        A hold in which a leak has equalised the pressures adds the squared deviation of its offset from the
        recording's, in standard deviations (`_hold_offsets`).
        """
        costs = self._offset_costs(np.array([leak.offset]))
        return self._supply_log_priors[leak.supplies] - 0.5 * float(costs[0])

    def _offset_costs(self, offsets: Array) -> Array:
        """Compute -2 log prior (g,) of sensor `offsets` (g,) [Pa] of the recording, with those of its holds."""
        return np.asarray(offset_cost(offsets) + self._hold_offsets(offsets)[1].sum(axis=1))

    @cached_property
    def _supply_log_priors(self) -> dict[SideSupplies, float]:
        """Log prior of the sides' supplies while the piston leaks (`_supply_log_prior`)."""
        return {supplies: self._supply_log_prior(supplies, drains=True) for supplies in self._regressions}

    def start_error(self, leak: PistonLeak) -> float:
        """Estimate the relative standard error of a piston leak's coefficient due to the uncertain start of each hold.

        The coefficient is the volume that has left a chamber, over the time integral of the flow u of a leak with a
        coefficient of 1 without growth. The time at which the valves shut is known to within s =
        `held_oil.shutting_time` (`priors.toml`), and a large leak equalises the pressures about as fast. With the
        largest flow u_0 in the first interval of each hold, the error is

                    s sqrt(sum of u_0^2) / (sum of the integrals of u), summed over the holds after the leak's onset.
        """
        start_flows, integrals = [0.0], [0.0]
        pressures = np.split(self.driving_pressure(leak.offset), self._samples.begin[1:-1])
        for hold, pressure in zip(self.holds, pressures, strict=True):
            unit_flow = np.where(hold.t >= leak.onset, np.abs(pressure) ** leak.exponent, 0.0)
            start_flows.append(float(unit_flow[: hold.edges[1]].max()))
            integrals.append(float(np.trapezoid(unit_flow, hold.t)))
        time_error: float = INFERENCE.held_oil.shutting_time
        return time_error * float(np.linalg.norm(start_flows)) / max(sum(integrals), float(np.finfo(float).tiny))

    def leaks_since(self, onset: float) -> Array | None:
        """Estimate the conductances of three leaks and their deviations, (6,), in the order of `HeldLeaks`.

        The one past the piston is that of a leak since `onset` [s], times its probability (`piston_leak`); the leaks to
        the outside are means over the recording. Return None if no hold shows a flow past the piston after the onset.
        """
        fits = self._fits_over_offsets(onset)
        if not fits:
            return None
        leak = average_fits(fits)
        probable = self.piston_leak.probability * leak.value
        return np.array(self.leaks._replace(piston=probable, deviation=leak.deviation))

    def _fits_over_offsets(self, onset: float) -> list[LeakFit]:
        """Fit a leak past the piston since `onset` [s] for several sensor offsets, omitting fits without any flow."""
        best = self.piston_fit._replace(onset=onset)
        offsets = (*self._offset_grid.tolist(), best.offset)
        parts = self._iter_offset_sums(best, np.array(offsets), np.array([onset]))
        sums = np.concatenate([part[0].T for part in parts])
        leaks = [best._replace(offset=offset) for offset in offsets]
        fits = [self._fit_piston_sums(*pair) for pair in zip(leaks, sums, strict=True)]
        return [fit for fit in fits if fit.deviation < UNKNOWN]

    def _fit_leak(self, supplies: SideSupplies, sums: Array) -> LeakFit:
        """Fit the coefficient (>= 0) of a leak to all holds; 0 +- `UNKNOWN` if it has no flow.

        `sums` (8,): products of the leak's readings (`sum_onset_products`).
        """
        value, deviation, by_oil, variance = 0.0, UNKNOWN, 0.0, self._variances_without_leak[supplies]
        if sums[-1] > 0.0:
            fit = fit_leak(self._regressions[supplies], sums, self.n_readings)
            deviation, by_oil = fit.by_noise**0.5, max(fit.by_oil, 0.0) ** 0.5
            if not fit.coefficient < 0.0:  # no leak flows from the lower to the higher pressure
                value, variance = fit.coefficient, fit.variance
        closed_variance = variance / self._closed_share(supplies)  # without readings that fit any leak
        return LeakFit(value, deviation, by_oil, log_likelihood=-0.5 * self.n_readings * math.log(closed_variance))

    @cached_property
    def onsets(self) -> Array:
        """Possible onsets of a leak [s] in order of time: the beginning of the recording, between holds, within them.

        One within each hold is the time at which p_A - p_B changes most, as a large leak equalises the pressures at
        once.
        """
        lows, highs = self._onset_ranges
        return np.sort(np.concatenate([0.5 * (lows + highs), [hold.steepest_time() for hold in self.holds]]))

    @cached_property
    def _onset_ranges(self) -> tuple[Array, Array]:
        """First and last time [s] that each of g possible onsets, without the steepest times, stands for, (g,) each.

        An onset between two holds stands for all times between them, the others for themselves.
        """
        lows, highs = [self.begin], [self.begin]
        for k, hold in enumerate(self.holds):
            if k > 0:
                lows.append(float(self.holds[k - 1].t[-1]))
                highs.append(float(hold.t[0]))
            within = np.linspace(hold.t[0], hold.t[-1], N_ONSETS + 2)[1:-1].tolist()
            lows += within
            highs += within
        return np.array(lows), np.array(highs)

    @cached_property
    def _onset_log_priors(self) -> Array:
        """Log prior probability (o,) of `onsets`: `held_oil.share_from_start` for the first; the others are equal."""
        from_start, n_later = INFERENCE.held_oil.share_from_start, len(self.onsets) - 1  # each hold has later ones
        return np.asarray(np.log(np.append(from_start, np.full(n_later, (1.0 - from_start) / n_later))))

    def _sum_products(self, leak: UnitLeak) -> Array:
        """Sum the products of a leak's readings for each of o `onsets` and l of the `GROWTHS`, (o, 8, l)."""
        regressors, growths = self._regressions[leak.supplies].regressors, np.array(list(GROWTHS))
        return sum_onset_products(self._samples, leak.flows, growths, self.end, self.onsets, regressors)

    def _iter_offset_sums(self, leak: PistonLeak, offsets: Array, onsets: Array) -> Iterator[Array]:
        """Yield the products of a leak past the piston for sensor `offsets` (g,) [Pa] and `onsets` (o,) [s], in parts.

        Each part is an array (o, 8, l) for l of the offsets (`iter_offset_sums`).
        """
        hold_offsets, _, is_equalised = self._hold_offsets(offsets)
        return iter_offset_sums(
            self._samples, hold_offsets, is_equalised, leak.exponent, INFERENCE.held_oil.resolution,
            self._closed_samples[leak.supplies], onsets, self._regressions[leak.supplies].regressors,
        )  # fmt: skip

    def _onset_posteriors(self, supplies: SideSupplies, sums: Array) -> Array:
        """Compute the log posterior probability of each possible onset (`onsets`) of l leaks, shape (l, o).

        It is log prior - N/2 log(residual sum of squares), up to a constant, for N independent readings and a
        coefficient >= 0, with the properties of the oil eliminated (`score_onsets`). `sums` (o, 8, l): products of the
        leaks' readings.
        """
        return np.asarray(self._onset_log_priors + score_onsets(self._onset_priors[supplies], sums))

    @cached_property
    def _offset_grid(self) -> Array:
        """Candidates for the sensor offset of p_A - p_B [Pa], sorted: a fixed grid and the last reading of each hold.

        The latter is the offset if a leak has equalised the pressures by then. Of more than `MAX_ENDS` readings, so
        many with equally spaced ranks are used: the offset of a hold may differ a little from the recording's.
        """
        ends = np.sort([hold.mean(hold.difference)[-1] for hold in self.holds])
        if len(ends) > MAX_ENDS:
            ends = ends[np.linspace(0, len(ends) - 1, MAX_ENDS).round().astype(int)]
        return np.unique(np.concatenate([np.append(-OFFSET_GRID, OFFSET_GRID) * INFERENCE.zero.pressure, ends]))

    @cached_property
    def piston_fits(self) -> list[PistonLeak]:
        """Most probable leak past the piston, without growth, for each of the `LAWS`."""
        return [self._find_piston_fit(exponent) for exponent in LAWS]

    @property
    def piston_fit(self) -> PistonLeak:
        """Most probable laminar leak past the piston, without growth."""
        return self.piston_fits[0]

    def _find_piston_fit(self, exponent: float) -> PistonLeak:
        """Find the most probable onset, sensor offset and supplies for a leak past the piston with an `exponent`.

        They have the highest joint posterior probability for each possible choice of the supplies (`_fit_supplies`).
        """
        supplied = [sides for sides in self._possible_supplies if sides != NEITHER]
        fits = [self._shut_fits[exponent], *(self._fit_supplies(exponent, sides) for sides in supplied)]
        return max(fits, key=lambda fit: fit[0])[1]  # with the highest posterior

    @cached_property
    def _shut_fits(self) -> dict[float, tuple[float, PistonLeak]]:
        """Fits of a leak past the piston while no side is supplied (`_fit_supplies`), by the exponents of the `LAWS`.

        They do not depend on the charge pressure.
        """
        return {exponent: self._fit_supplies(exponent, NEITHER) for exponent in LAWS}

    def _fit_supplies(self, exponent: float, supplies: SideSupplies) -> tuple[float, PistonLeak]:
        """Find the most probable onset and sensor offset of a leak past the piston; return its log posterior, and it.

        They are searched on a grid of onsets, and a grid of offsets that is refined once.
        """
        grid, leak = self._offset_grid, PistonLeak(exponent, supplies=supplies)
        coarse_fits = self._find_onsets(leak, grid)
        best = int(np.argmax([posterior for posterior, _ in coarse_fits]))
        # the first and the last point are of the coarse grid
        refined = np.linspace(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], N_REFINED)[1:-1]
        return max([*self._find_onsets(leak, refined), coarse_fits[best]], key=lambda fit: fit[0])

    def _find_onsets(self, leak: PistonLeak, offsets: Array) -> list[tuple[float, PistonLeak]]:
        """Find the most probable onset of a `leak` for each sensor offset; return each log posterior and leak."""
        parts = self._iter_offset_sums(leak, offsets, self.onsets)
        scores = np.concatenate([self._onset_posteriors(leak.supplies, sums) for sums in parts])
        # the variance of readings, which is too small by this share, must be no evidence for sides that are not closed
        correction = 0.5 * self.n_readings * math.log(self._closed_share(leak.supplies))
        conditions = self._supply_log_priors[leak.supplies] - 0.5 * self._offset_costs(offsets)
        log_posteriors, best = scores.max(axis=1) + conditions + correction, scores.argmax(axis=1)
        return [
            (log_posterior, leak._replace(onset=onset, offset=offset))
            for log_posterior, onset, offset in zip(
                log_posteriors.tolist(), self.onsets[best].tolist(), offsets.tolist(), strict=True
            )
        ]

    @cached_property
    def _laws(self) -> list[tuple[LawFit, Array]]:
        """Fits of a leak past the piston, one for each law, and with each the log posteriors (o,) over `onsets`.

        A law states the exponent of the pressure (`LAWS`) and the growth of the leak (`GROWTHS`). The leak begins at
        the most probable onset under its law; sensor offset and supplies are those of `piston_fits`.
        """
        laws = []
        for leak, law_prior in zip(self.piston_fits, LAWS.values(), strict=True):
            sums = self._sum_products(self._unit_piston_leak(leak._replace(growth=0.0)))
            onset_posteriors = self._onset_posteriors(leak.supplies, sums)
            for k, (growth, growth_prior) in enumerate(GROWTHS.items()):
                log_prior = math.log(law_prior * growth_prior)
                posteriors = log_prior + onset_posteriors[k]
                best = int(posteriors.argmax())
                law = leak._replace(growth=growth, onset=float(self.onsets[best]))
                fit = self._fit_piston_sums(law, sums[best, :, k])
                laws.append((LawFit(law, fit, fit.log_likelihood + log_prior), posteriors))
        return laws

    @property
    def law_fits(self) -> list[LawFit]:
        """Fits of a leak past the piston for each law (exponent and growth); the first is laminar without growth."""
        return [fit for fit, _ in self._laws]

    def _fit_growing_leak(self, leaks: Sequence[UnitLeak]) -> tuple[LeakFit, int]:
        """Fit a leak that is not past the piston and may grow, and return the fit with the index of its onset.

        `leaks`: flows of this one leak, for each possible choice of the sides' supplies. Of all choices and growths,
        each with its own most probable onset, the most probable is returned. Its coefficient is the mean from the onset
        to the end; its likelihood is replaced by the sum over all choices and growths, each times its prior
        probability.
        """
        fits, log_weights = list[tuple[LeakFit, int]](), list[float]()
        for leak in leaks:
            sums = self._sum_products(leak)
            indices = self._onset_posteriors(leak.supplies, sums).argmax(axis=1).tolist()
            for k, (growth, probability) in enumerate(GROWTHS.items()):
                fit = self._fit_leak(leak.supplies, sums[indices[k], :, k])
                mean_ratio = 1.0 + 0.5 * growth  # mean over initial coefficient, for a linear growth
                fits.append((fit.scale(mean_ratio, fit.log_likelihood), indices[k]))  # with the same likelihood
                # such a leak moves no oil to the other side, which therefore does not drain
                log_prior = math.log(probability) + self._supply_log_prior(leak.supplies, drains=False)
                log_weights.append(fit.log_likelihood + log_prior)
        fit, index = fits[int(np.argmax(log_weights))]
        return fit._replace(log_likelihood=float(np.logaddexp.reduce(log_weights))), index

    def _mean_unit_flow(self, leak: PistonLeak) -> float:
        """Compute the mean magnitude of the flow past the piston in holds after the onset, for a coefficient of 1."""
        unit_leak = self._unit_piston_leak(leak._replace(supplies=NEITHER))
        after_onset = np.abs(unit_leak.flows[0])[self._samples.t >= leak.onset]  # row 0 is the flow out of A
        # at least a tiny number, as a divisor
        return max(float(after_onset.mean()) if after_onset.size else 0.0, float(np.finfo(float).tiny))

    @cached_property
    def _leak_hypotheses(self) -> list[LeakHypothesis]:
        """Hypotheses of a leak past the piston, from A to the outside, and from B to the outside, in this order.

        Leaks to the outside are fitted with check valves on both sides and with an open unloaded side, if these are
        possible.
        """
        tried = [supplies for supplies in (BOTH, self._unloaded_open) if supplies in self._possible_supplies]
        # if BOTH is not tried, no sample is at the charge pressure, and it flags the same samples as NEITHER
        possible = tried or [BOTH]
        return self._weigh_hypotheses(
            [[self._unit_outside_leak(is_A, supplies) for supplies in possible] for is_A in (True, False)]
        )

    def _weigh_hypotheses(self, leaks: Sequence[Sequence[UnitLeak]]) -> list[LeakHypothesis]:
        """Fit a leak past the piston and each of the other `leaks`, and compute their probabilities, in this order.

        Each of `leaks` is one leak, with its flow for a coefficient of 1 in each of the ways in which the two sides can
        be supplied (shut, or held by a pump). It may grow from its onset on. The coefficient past the piston is that of
        the most probable law, converted to the conductance of a laminar leak with the same mean flow in the holds; the
        others are means from the onset to the end. The likelihood of a leak is a mean over its laws and growths, by
        their priors, each at its best onset. Each hypothesis states the fraction of the recording after its onset.
        """
        best = max(self.law_fits, key=lambda fit: fit.log_weight)
        laminar = best.leak._replace(exponent=1.0, growth=0.0)
        unit_ratio = self._mean_unit_flow(best.leak) / self._mean_unit_flow(laminar)
        log_weights = [fit.log_weight for fit in self.law_fits]
        # each fit with the index of its onset in `onsets`
        index = int(np.abs(self.onsets - best.leak.onset).argmin())
        fits = [(best.fit.scale(unit_ratio, float(np.logaddexp.reduce(log_weights))), index)]
        fits += [self._fit_growing_leak(leak) for leak in leaks]
        log_posteriors = np.array([fit.log_likelihood + self._onset_log_priors[index] for fit, index in fits])
        probabilities = weigh_alternatives(log_posteriors)
        fractions_after = (self.end - self.onsets) / max(self.end - self.begin, np.finfo(float).tiny)
        return [
            LeakHypothesis(float(probability), float(fractions_after[index]), fit)
            for probability, (fit, index) in zip(probabilities, fits, strict=True)
        ]

    def total_leak(self) -> Estimate:
        """Estimate the mean conductance [m^3/(s Pa)] of all leaks in the holds, even if the valves are open.

        A leak may be past the piston, to the outside, or through open valves and the pump, each with its probability. A
        check valve would hide the oil that leaves a chamber, so no refilling is assumed.
        """
        # without a charge pressure check valves stay closed; if they do so anyway, the cached fits serve
        chambers = self
        if self._closed_share(BOTH) < 1.0:
            chambers = replace(self, charge=0.0)
            vars(chambers)["_shut_fits"] = self._shut_fits
        sides = (True, False)
        leaks = [[chambers._unit_outside_leak(is_A)] for is_A in sides]
        leaks += [[chambers._unit_pump_leak(is_A)] for is_A in sides]
        hypotheses = chambers._weigh_hypotheses(leaks)
        means = [hypothesis.mean for hypothesis in hypotheses]
        deviations = [hypothesis.fraction_after * hypothesis.fit.deviation for hypothesis in hypotheses]
        # a leak that is estimated as 0 adds no uncertainty
        variance = sum(deviation**2 for mean, deviation in zip(means, deviations, strict=True) if mean > 0.0)
        # without any leak, the deviation is that of a leak past the piston
        return Estimate(sum(means), variance**0.5 if any(means) else deviations[0])

    @cached_property
    def leaks(self) -> HeldLeaks:
        """Mean leaks over the recording, from the times in which shut valves hold the load.

        Each is its estimate times its probability. Its standard deviation is not multiplied by the probability, and
        excludes the uncertainty of the oil's properties.
        """
        values_and_deviations = []
        for leak in self._leak_hypotheses:
            values_and_deviations += [leak.mean, leak.fraction_after * leak.fit.deviation]
        # the standard deviation of the piston's leak includes the uncertainty of the offset of p_A - p_B
        fits = [fit._replace(by_oil=0.0) for fit in self._fits_over_offsets(self.piston_fit.onset)]
        deviation = average_fits(fits).deviation if fits else UNKNOWN
        return HeldLeaks(*values_and_deviations)._replace(deviation=self.piston_leak.fraction_after * deviation)

    @property
    def piston_leak(self) -> LeakHypothesis:
        """Hypothesis of a leak past the piston while shut valves hold the load."""
        return self._leak_hypotheses[0]

    @property
    def probability_after_holds(self) -> float:
        """Prior probability that a leak, if there is one, begins after the last hold, so that no hold shows it."""
        time_after, begins_within = self.end - float(self.holds[-1].t[-1]), 1.0 - INFERENCE.held_oil.share_from_start
        return begins_within * time_after / max(self.end - self.begin, np.finfo(float).tiny)

    @cached_property
    def piston_onset(self) -> Interval | None:
        """Median onset of the leak past the piston [s], and 95 % interval; None if it may have begun before the holds.

        The interval is widened on either side to the next of the evenly spaced onsets within holds, or to the whole
        time between two holds.
        """
        posteriors = np.logaddexp.reduce([posteriors for _, posteriors in self._laws])
        up_to = np.cumsum(weigh_alternatives(posteriors))  # probability of an onset up to each
        first, best, last = np.searchsorted(up_to, [0.5 * TAIL, 0.5, 1.0 - 0.5 * TAIL])
        if first < 2:  # the onset may be the beginning of the recording or the first one within a hold
            return None
        lows, highs = self._onset_ranges
        low = lows[lows < self.onsets[first]][-1]
        high = min(highs[highs > self.onsets[last]], default=self.end)
        return Interval(float(self.onsets[best]), float(low), float(high))
