"""Leakage that a volume balance measures in a recording: tests, mean flows, bounds and history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from sealscope.diagnosis.estimate.change import StepTest, bound_steps, fit_history
from sealscope.diagnosis.estimate.interval import UPPER_95, WITHIN_95, Estimate, Interval
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, Mixture, weigh_alternatives
from sealscope.diagnosis.inference.circuit.holds.chambers import HeldChambers
from sealscope.diagnosis.inference.circuit.holds.leaks import growth_factor
from sealscope.diagnosis.inference.comparison import (
    RecordingSums,
    Rise,
    compare_laws,
    find_unusual_conditions,
    held_rise,
    rise,
)
from sealscope.diagnosis.inference.equations.terms import Flow
from sealscope.diagnosis.inference.hypotheses import LAWS
from sealscope.diagnosis.inference.leak_flow import RiseFits, estimate_step_flow, fit_rise, mixture_flow
from sealscope.diagnosis.inference.observable import UNKNOWN_FLOW, LeakMeasure, LeakRise, Remark
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.evidence import VOLUME_BALANCE, Cause, LeakCourse, RelativeLeak, TotalLeakage
from sealscope.diagnosis.verdict.machine_sizes import healthy_leakage
from sealscope.recordings.recording import Array
from sealscope.units import BAR, LITRE_PER_MINUTE


class BalanceLeak(LeakMeasure):
    """The leakage of a recording as measured by its volume balance; its flows are averaged over the laws of a leak.

    Parameters
    ----------
    balance : RecordedBalance
        Volume balance of the recording.
    healthy : sequence of RecordingSums
        Summaries of the healthy recordings of the machine whose volume balance has the same terms.
    """

    provider = VOLUME_BALANCE

    def __init__(self, balance: RecordedBalance, healthy: Sequence[RecordingSums] = ()) -> None:
        self.balance, self.healthy = balance, healthy

    @property
    def cause(self) -> Cause:
        """Cause of a leak, such as "piston leak", or "piston or pump leak" if the balance cannot separate them.

        The creep of a held load shows leaks of the piston, of valves and of lines alike. Holds, in which shut valves
        separate the pump from the cylinder, measure the leakage if `rise` is the rise in holds, and if the balance
        assumes shut valves at every rest or the rise is too high for a healthy machine. Behind a servo valve or a flow
        meter, too, the pump's leakage is not measured.
        """
        balance, prior = self.balance, INFERENCE.held_oil
        if balance.flow is Flow.CREEP:
            return "piston or external leak"
        hold_rise, chambers = self._rises.get(True), balance.chambers
        is_in_holds = (
            hold_rise is not None
            and hold_rise is self.rise
            and (balance.separates_pump or hold_rise.chance < prior.significance)
        )
        if is_in_holds and chambers is not None:
            # with one chamber open to the tank, the other loses oil alike by a leak past the piston or to the outside
            is_certain = chambers.piston_leak.probability >= 1.0 - prior.significance
            return "piston leak" if is_certain else "piston or external leak"
        is_behind_pump = balance.flow is Flow.VALVE or balance.flow.is_measured
        return "piston leak" if is_behind_pump else "piston or pump leak"

    @property
    def step(self) -> StepTest | None:
        """Test for a leak that begins within the recording; None if too few blocks have information."""
        return self.balance.test

    @cached_property
    def step_flow(self) -> Estimate:
        """Mean flow [m^3/s] of a leak that begins within the recording, from its onset to the end.

        It is averaged over laws, growths and onsets. The rise over healthy recordings counts, if there is one
        (`fit_rise`), and so does the flow in holds (`_mix_with_holds`).
        """
        balance, test = self.balance, self.balance.test
        if test is None:
            return UNKNOWN_FLOW
        flow = None if self._motion_rise is None else self._rise_fits.flow_within
        if flow is None:
            flow = estimate_step_flow(balance.running_blocks, balance.columns, balance.leak, test)
        return self._add_law_uncertainty(self._mix_with_holds(flow))

    @property
    def flow_per_conductance(self) -> float:
        """Mean flow [m^3/s] of a leak with a conductance of 1 m^3/(s Pa): the mean of abs(p_A - p_B)."""
        return self.balance.mean_pressure()

    def _add_law_uncertainty(self, flow: Estimate) -> Estimate:
        """Add the uncertainty of a leak's law, the fraction `size.law` (`priors.toml`) of the flow, to its error."""
        return Estimate(flow.value, float(np.hypot(flow.deviation, flow.value * INFERENCE.size.law)))

    @cached_property
    def rise(self) -> Rise | None:
        """Amount by which the mean leakage [m^3/(s Pa)] exceeds that of healthy recordings; None without these.

        It is the one of `_rises` with the smaller p-value; if both are equal, the rise in holds.
        """
        return min(self._rises.values(), key=lambda rise: rise.chance, default=None)

    @cached_property
    def _rises(self) -> dict[bool, Rise]:
        """Rises of the leakage over healthy recordings, each with its share of the false alarms; empty without these.

        The key False is for the rise in the whole recording, True for the rise in holds (`_hold_rise`). Holds do not
        show a leak that begins after them. If s is the prior probability of such a leak, the rise in the whole
        recording gets the fraction s of the false alarms, and the rise in holds 1 - s (weighted Bonferroni correction).
        """
        motion_rise, hold_rise, chambers = self._motion_rise, self._hold_rise, self.balance.chambers
        if motion_rise is None:
            return {}
        if hold_rise is None or chambers is None:
            return {False: motion_rise}
        share = chambers.probability_after_holds
        return {True: hold_rise.share_alarms(1.0 - share), False: motion_rise.share_alarms(share)}

    @cached_property
    def _motion_rise(self) -> Rise | None:
        """Rise [m^3/(s Pa)] of the leakage in the whole recording over healthy recordings; None without these."""
        if not self.healthy:
            return None
        return rise(self.balance.recording_sums, self.healthy, self.balance.columns)

    @cached_property
    def _hold_rise(self) -> Rise | None:
        """Rise of the leakage over healthy recordings [m^3/(s Pa)], from the times in which shut valves hold the load.

        None if it cannot be estimated, or if it shows no leak and is too uncertain beside the rise in the whole
        recording: its error exceeds both the error and the value of that rise.
        """
        motion_rise = self._motion_rise
        if motion_rise is None:
            return None
        hold_rise = held_rise(self.balance.recording_sums, self.healthy)
        if hold_rise is None:
            return None
        is_precise = hold_rise.deviation < max(motion_rise.deviation, motion_rise.value)
        return hold_rise if is_precise or hold_rise.chance < INFERENCE.held_oil.significance else None

    @cached_property
    def rise_flow(self) -> Estimate:
        """Mean flow [m^3/s] since its onset of the leakage above healthy recordings, or of the total without these."""
        if self.rise is None:
            if (flow := self.balance.total_flow) is not None:
                return Estimate(flow.value, flow.deviation)
            total, pressure = self.balance.conductance, self.balance.mean_pressure()
            return self._add_law_uncertainty(Estimate(pressure * total.value, pressure * total.deviation))
        return self._add_law_uncertainty(self._mix_with_holds(self._rise_fits.flow))

    @cached_property
    def _block_weights(self) -> Array:
        """Weight (K,) of each block with motion in the rise over the healthy recordings."""
        return self.balance.block_weights(self.healthy)

    @cached_property
    def _rise_fits(self) -> RiseFits:
        """Fits of a leak to the rise over healthy recordings and to the course of the leakage (`fit_rise`).

        There must be healthy recordings.
        """
        balance, motion_rise = self.balance, self._motion_rise
        assert motion_rise is not None
        return fit_rise(
            balance.running_blocks,
            balance.columns,
            balance.leak,
            self._block_weights,
            self.step,
            rise=Estimate(motion_rise.value, motion_rise.normal_deviation),
            laws=self._rise_laws(),
            max_flow=balance.blocks.moving_flow,
        )

    def _mix_with_holds(self, flow: Estimate) -> Estimate:
        """Combine the flow of a leak since its onset with its flow during holds, if the holds show a leak.

        The weight of the estimate from holds, `held_oil.weight_of_holds` of `priors.toml`, is the probability that it
        is right if the two disagree.
        """
        hold_rise, prior = self._hold_rise, INFERENCE.held_oil
        if hold_rise is None or not hold_rise.chance < prior.significance:
            return flow
        flows, deviations = np.array([flow, self._hold_flow(hold_rise)]).T  # first of the recording, then of the holds
        return mixture_flow(np.array([1.0 - prior.weight_of_holds, prior.weight_of_holds]), flows, deviations)

    @property
    def rise_onset(self) -> Interval | None:
        """Onset [s] of the leakage above healthy recordings, estimated while shut valves keep the load in place.

        None if these holds do not clearly show the leakage, or if the leak may have begun before them.
        """
        hold_rise, chambers = self._hold_rise, self.balance.chambers
        if hold_rise is None or chambers is None or not hold_rise.chance < INFERENCE.held_oil.significance:
            return None
        return chambers.piston_onset

    def _hold_flow(self, hold_rise: Rise) -> Estimate:
        """Estimate the mean flow of a leak from the times in which shut valves hold the load, averaged over its laws.

        The variance of `hold_rise`, the rise over healthy recordings in these times, and the relative scatter
        `held_oil.scatter` (`priors.toml`) are added to the variances of the fits.
        """
        weights, unit_flows, flows, deviations = self._hold_laws
        rise_deviation = hold_rise.normal_deviation * unit_flows[0]  # the rise is that of a laminar leak
        deviations = np.sqrt(rise_deviation**2 + deviations**2 + (INFERENCE.held_oil.scatter * flows) ** 2)
        return mixture_flow(weights, flows, deviations)

    @cached_property
    def _hold_laws(self) -> Array:
        """Leak past the piston, fitted to holds, under k laws of flow, (4, k).

        The rows are the probability of each law, with the sum 1; the mean flow [m^3/s] after the onset for a
        coefficient of 1; and the fitted mean flow and its standard deviation [m^3/s]. Each of
        `HeldChambers.law_fits`, of which the first is laminar without growth, is repeated for each piston area of
        `HeldChambers.area_variants`.
        """
        assert self.balance.chambers is not None
        variants = self.balance.chambers.area_variants()
        return np.hstack([self._fit_hold_laws(variant, probability) for probability, variant in variants])

    def _fit_hold_laws(self, chambers: HeldChambers, probability: float) -> Array:
        """Compute for one piston area the leak by each law, (4, laws), as columns of `_hold_laws`.

        Rows: weights of the laws, which sum to the `probability` of the area; mean flow for a coefficient of 1; mean
        flow [m^3/s] and its standard deviation, which includes the uncertain starts of the holds
        (`HeldChambers.start_error`).
        """
        recording, rows = self.balance.recording, []
        for leak, fit, log_weight in chambers.law_fits:
            after_onset = recording.t >= leak.onset
            t = recording.t[after_onset]
            difference = (recording["p_A"] - recording["p_B"])[after_onset]
            pressure = np.abs(chambers.pressure_difference(t, difference, leak.offset))
            growth = growth_factor(t, leak.growth, leak.onset, chambers.end)
            unit_flow = float(np.nanmean(pressure**leak.exponent * growth))
            deviation = np.linalg.norm([fit.deviation, fit.by_oil, chambers.start_error(leak) * fit.value])
            rows.append((log_weight, unit_flow, fit.value * unit_flow, deviation * unit_flow))
        laws = np.array(rows).T
        laws[0] = probability * weigh_alternatives(laws[0])
        return laws

    def _rise_laws(self) -> list[tuple[float, float]]:
        """Weigh the laws of a leak's flow by their fit to the rise over healthy recordings.

        Returns for each exponent e of `LAWS` a log weight, and before it the mean flow per conductance [Pa] of a
        leak that looks like a laminar one with a conductance of 1. The law lies the fraction f = 2 (1 - e) of the way
        from laminar to orifice flow:

            flow = laminar^(1 - f) orifice^f,    log weight = log prior + f L,

        with the log likelihood ratio L of an orifice to a laminar leak (`compare_laws`). If L is unknown, all laws have
        the laminar flow and the log weight 0.
        """
        balance = self.balance
        laminar_flow = balance.mean_pressure()
        fit = compare_laws(balance.recording_sums, self.healthy, balance.columns)
        if fit is None:
            return [(laminar_flow, 0.0)] * len(LAWS)
        # an orifice with the coefficient 1 / `regression` looks like a laminar leak with the coefficient 1
        root = np.average(balance.blocks.mean_root(), weights=balance.blocks.pressure_weights)
        orifice_flow = float(root) / fit.regression
        fractions = 2.0 * (1.0 - np.array([*LAWS]))
        return [
            (laminar_flow ** (1.0 - f) * orifice_flow**f, float(log_prior) + f * fit.log_ratio)
            for f, log_prior in zip(fractions, np.log([*LAWS.values()]), strict=True)
        ]

    @property
    def excess(self) -> float | None:
        """Total leakage minus the limit in the rig's file, in standard deviations of the leakage.

        None without a limit or a flow in L/min (`Size.stated`), behind a servo valve, if no channel measures the flow,
        or if healthy recordings are compared instead.
        """
        balance = self.balance
        limit, size = healthy_leakage(balance.rig), balance.size
        # the edges of a servo valve (several balances) leak, too; without a measured flow, a drive that slows down
        # under load seems to leak
        is_measured = balance.flow not in (Flow.VALVE, Flow.COMMAND)
        if not (limit > 0.0 and self.rise is None and size.stated and is_measured):
            return None
        total = Interval(*(size.scale * conductance for conductance in balance.conductance))
        deviation = float(np.hypot(total.deviation, total.value * size.deviation))
        return (total.value - limit) / max(deviation, np.finfo(float).tiny)

    @property
    def bound_flow(self) -> float:
        """95 % upper bound of the leak's mean flow over the recording [m^3/s]; infinite if nothing was tested.

        With healthy recordings it is a bound on the leakage above theirs, otherwise on a leak that begins within the
        recording. The uncertain scale of the flows and the uncertain law of the leak raise it.
        """
        test = self.step if self._motion_rise is None else self._motion_rise
        if test is None:
            return np.inf
        if self._hold_rise is not None:
            bound = max(self._hold_bound(), self._bound_after_holds())
        else:
            bound = test.bound() * self.balance.mean_pressure()
            if self._motion_rise is not None:
                bound = max(bound, self._rise_fits.bound)  # a leak may have begun, or grown, within the recording
        return bound * (1.0 + UPPER_95 * float(np.hypot(self.balance.size.deviation, INFERENCE.size.law)))

    def _hold_bound(self) -> float:
        """Compute the 95 % upper bound of a leak's mean flow [m^3/s] from holds and from the whole recording.

        It is a quantile of a mixture of three hypotheses: the holds say nothing about the leak, so that the whole
        recording counts; they show a leak past the piston; they show a leak to the outside. There must be a rise in
        holds (`_hold_rise`).
        """
        motion_rise, hold_rise, chambers = self._motion_rise, self._hold_rise, self.balance.chambers
        assert motion_rise is not None and hold_rise is not None and chambers is not None
        piston_probability, fraction_after, fit = chambers.piston_leak
        mean_leak, pressure = fraction_after * fit.value, self.balance.mean_pressure()
        weights, _, _, deviations = self._hold_laws
        # mean deviation of the flow over that under the laminar law without growth, the first
        relative_deviation = float(weights @ deviations) / max(float(deviations[0]), np.finfo(float).tiny)
        # mean flow per conductance of a leak past the piston, increased where its law makes the flow less certain
        unit = pressure * max(relative_deviation, 1.0)
        # the holds show the leak if they are right about it and it did not begin after them
        hold_probability = INFERENCE.held_oil.weight_of_holds * (1.0 - chambers.probability_after_holds)
        # `hold_rise.value` contains the piston's leak times its probability; here the leak is either whole or absent.
        # The error of `hold_rise` excludes the oil's uncertain properties, so a whole leak adds them
        by_motion = _flow_mixture(motion_rise, motion_rise.value, unit=pressure, weight=1.0 - hold_probability)
        past_piston = _flow_mixture(
            hold_rise,
            hold_rise.value + (1.0 - piston_probability) * mean_leak,
            unit=unit,
            weight=hold_probability * piston_probability,
            oil_deviation=fraction_after * fit.by_oil,
        )
        to_outside = _flow_mixture(
            hold_rise,
            hold_rise.value - piston_probability * mean_leak,
            unit=unit,
            weight=hold_probability * (1.0 - piston_probability),
        )
        parts = by_motion, past_piston, to_outside
        return Mixture(*(np.concatenate(values) for values in zip(*parts, strict=True))).quantile(BOUND_PROBABILITY)

    def _bound_after_holds(self) -> float:
        """Compute the 95 % upper bound of the mean flow [m^3/s] of a leak that begins after the last hold.

        No hold shows it, and the rise over the healthy recordings is mostly that of the holds: its step within the
        recording is what bounds it. The result is 0 if a leak hardly begins so late, by the likelihood of its onset.
        """
        test, chambers = self.step, self.balance.chambers
        if test is None or chambers is None:
            return 0.0
        is_later = test.onsets > chambers.holds[-1].t[0]
        if not test.weights[is_later].sum() > 1.0 - BOUND_PROBABILITY:
            return 0.0
        weights, size, deviation = (values[is_later] for values in (test.weights, test.size, test.deviation))
        return bound_steps(weights, size, deviation, BOUND_PROBABILITY) * self.balance.mean_pressure()

    @property
    def pump_flow(self) -> tuple[float, float]:
        """Mean flow of the pump [m^3/s] over the whole recording, and while the pump delivers (`moving_flow`)."""
        return self.balance.mean_flow, self.balance.blocks.moving_flow

    @cached_property
    def step_rise(self) -> LeakRise | None:
        """Leakage above that of healthy recordings, and whether a step within the recording explains it (`LeakRise`).

        If shut valves hold the load after the step's onset, the rise in these holds is compared with the whole step.
        Otherwise the mean rise over the recording is compared with the part of the step that this mean contains. None
        without healthy recordings.
        """
        step, total_rise, motion_rise = self.step, self.rise, self._motion_rise
        if total_rise is None or motion_rise is None:  # both are None, or neither
            return None
        if step is None:
            return LeakRise(total_rise)
        balance, chambers = self.balance, self.balance.chambers
        leaks = None if self._hold_rise is None or chambers is None else chambers.leaks_since(step.onset().value)
        sums = replace(balance.recording_sums, held=leaks)
        rise_after = None if leaks is None else held_rise(sums, self.healthy)
        if rise_after is not None:
            # after the onset the holds show the whole step; `agrees`: standard deviation of log(rise / step)
            return LeakRise(total_rise, rise_after.log_ratio(step.fitted.value, INFERENCE.held_oil.agreement))
        is_after = balance.running_blocks.time >= step.onset().value
        # the weight of a block may be negative
        mean_rise = step.fitted.value * float(np.clip(self._block_weights[is_after].sum(), 0.0, 1.0))
        return LeakRise(total_rise, motion_rise.log_ratio_within(mean_rise, tail=INFERENCE.scatter.tail))

    @property
    def lpm_per_flow(self) -> float | None:
        """Factor from a computed flow [m^3/s] to the true one [L/min]; None if it is not known (`Size.stated`)."""
        size = self.balance.size
        return size.scale / LITRE_PER_MINUTE if size.stated else None

    @property
    def size_deviation(self) -> float:
        """Relative standard deviation of the scale of all flows, from displacement, area or flow meter."""
        return self.balance.size.deviation

    @property
    def ratio(self) -> Interval | None:
        """Measured over assumed ratio of the pump's displacement to the piston's area; None if it is not measured."""
        return self.balance.size.ratio

    def relative(self, flow: Estimate) -> RelativeLeak:
        """Convert a leak's flow to a fraction of the pump's mean flow, and to the speed [m/s] of a creeping piston.

        Both have 95 % intervals. The fraction is None if the pump's flow is zero, the speed if the area is unknown.
        """
        pump_flow, area = self.balance.mean_flow, self.balance.size.area
        half_width = WITHIN_95 * flow.deviation
        interval = (flow.value - half_width, flow.value + half_width)
        return RelativeLeak(
            pump_share=flow.value / pump_flow if pump_flow > 0.0 else None,
            pump_share_interval=_divide_interval(interval, pump_flow),
            creep=None if area is None else flow.value / area,
            creep_interval=_divide_interval(interval, area),
        )

    def total(self, detectable_flow: float | None) -> TotalLeakage:
        """Return the total leakage of pump and piston, with its interval and the limit for a healthy machine.

        The flow is stated where the recording identifies it (`RecordedBalance.total_flow`). `detectable_flow`: as in
        `LeakMeasure.total`, computed with the assumed piston area and displacement.
        """
        balance = self.balance
        size, pressure, pump_flow, flow = balance.size, balance.mean_pressure(), balance.mean_flow, balance.total_flow
        limit, lpm_per_flow = healthy_leakage(balance.rig), size.scale / LITRE_PER_MINUTE
        lpm = interval_lpm = None
        if flow is not None and size.stated:
            deviation = float(np.hypot(flow.deviation, flow.value * size.deviation))
            lpm, *interval = Estimate(flow.value * lpm_per_flow, deviation * lpm_per_flow).nonnegative_interval()
            interval_lpm = (interval[0], interval[1])
        return TotalLeakage(
            lpm=lpm,
            interval_lpm=interval_lpm,
            pressure=pressure,
            findable_lpm=None if detectable_flow is None or not size.stated else detectable_flow * lpm_per_flow,
            # the limit is a true conductance, and so is not multiplied by `size.scale`
            healthy_lpm=limit * pressure / LITRE_PER_MINUTE if limit > 0.0 and self.rise is None else None,
            pump_share=None if flow is None or not pump_flow > 0.0 else max(flow.value, 0.0) / pump_flow,
            findable_share=None if detectable_flow is None or not pump_flow > 0.0 else detectable_flow / pump_flow,
        )

    def history(self, onset_s: float | None) -> LeakCourse | None:
        """Return the leakage over time [L/min], or its rise over the mean before `onset_s` [s].

        It is NaN in blocks that allow more than the pump delivers. Return None if no L/min can be stated, or without an
        onset if the total leakage is not known block by block: shut valves separate pump and piston at rest.
        """
        balance = self.balance
        if not balance.size.stated or (onset_s is None and (balance.separates_pump or balance.total_flow is None)):
            return None
        if onset_s is None:
            blocks, history = balance.blocks, balance.total_history
        else:
            blocks = balance.running_blocks
            history = fit_history(balance.leak, balance.test, with_step=True).relative_to(blocks.time < onset_s)
        value, deviation = history.mean, np.sqrt(np.maximum(np.diag(history.covariance), 0.0))
        lpm = blocks.mean_pressure(balance.pressure_offset) * balance.size.scale / LITRE_PER_MINUTE  # per conductance
        half_width = WITHIN_95 * np.hypot(deviation, value * balance.size.deviation)
        max_flow = balance.blocks.moving_flow * balance.size.scale / LITRE_PER_MINUTE
        lpm = np.where((np.abs(value) + half_width) * lpm <= max_flow, lpm, np.nan)
        low, high = (value - half_width) * lpm, (value + half_width) * lpm
        return LeakCourse(blocks.time, value * lpm, low, high, whole=onset_s is None)

    @property
    def remarks(self) -> Sequence[Remark]:
        """Remarks on contradicting sizes, the offset of p_A - p_B, delays and their changes, and unusual conditions."""
        balance = self.balance
        size, offset, delay = balance.size, balance.pressure_offset, balance.position_delay
        remarks = list[Remark]()
        if size.ratio is not None and size.disagrees:
            remarks.append(Remark("sizes disagree", {"ratio": size.ratio.value}))
        if abs(offset) > 2.0 * WITHIN_95 * INFERENCE.zero.pressure:  # twice the 95 % limit of usual sensors
            remarks.append(Remark("zero too high" if offset > 0.0 else "zero too low", {"bar": abs(offset) / BAR}))
        # a delay of one sample is usual
        if delay is not None and abs(delay.value) > 1.0 / balance.recording.rate + WITHIN_95 * delay.deviation:
            remarks.append(Remark("x late" if delay.value > 0.0 else "x early", {"ms": 1e3 * abs(delay.value)}))
        for change in balance.delay_changes:
            keys = ("delay grows", "delay shrinks")
            if change.rival_channel:
                keys = ("delay grows, or flow's shrinks", "delay shrinks, or flow's grows")
            values = {"ms": 1e3 * abs(change.seconds), "seconds": change.onset.value}
            remarks.append(
                Remark(keys[change.seconds < 0.0], {**values, "channel": change.channel, "flow": change.rival_channel})
            )
        for condition in find_unusual_conditions(balance.recording_sums, self.healthy):
            value, low, high = condition.value, condition.low, condition.high
            if condition.name == "load":
                remarks.append(Remark("load beyond", {"value": value / BAR, "low": low / BAR, "high": high / BAR}))
            elif condition.name == "speed":  # over the nearer end of the range of the healthy recordings
                remarks.append(Remark("speed beyond", {"ratio": value / (high if value > high else low)}))
            else:
                remarks.append(Remark("oil beyond", {"value": value, "low": low, "high": high}))
        return remarks


def _flow_mixture(rise: Rise, value: float, *, unit: float, weight: float, oil_deviation: float = 0.0) -> Mixture:
    """Compute the distribution of a leak's mean flow [m^3/s] from the rise of its coefficient over healthy recordings.

    It is a part of a larger mixture, in which it has the `weight`. `value`: estimated rise, a negative one counting as
    0; `rise`: source of the distribution of this estimate's error, normal if it has no mixture; `unit`: mean flow
    [m^3/s] for a coefficient of 1; `oil_deviation`: standard deviation of the coefficient that uncertain properties of
    the oil cause.
    """
    # the true rise is `value` minus an error that is distributed as a healthy recording's rise
    weights, deviations, centres = rise.mixture or Mixture(np.ones(1), np.array([rise.deviation]), np.zeros(1))
    return Mixture(weight * weights, unit * np.hypot(deviations, oil_deviation), unit * (max(value, 0.0) - centres))


def _divide_interval(interval: tuple[float, float], divisor: float | None) -> tuple[float, float] | None:
    """Divide an interval by `divisor` and raise a negative lower end to 0; None unless the divisor is positive."""
    if divisor is None or not divisor > 0.0:
        return None
    return max(interval[0], 0.0) / divisor, interval[1] / divisor
