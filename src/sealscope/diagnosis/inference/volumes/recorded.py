"""Volume balance of one recording: the leakage, tests of all terms, holds of the load, and the scale of its flows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import (
    MIN_BLOCKS,
    History,
    Information,
    StepTest,
    fit_history,
    step_test,
)
from sealscope.diagnosis.estimate.interval import WITHIN_95, Estimate, Interval
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.inference.blocks import (
    Blocks,
    ColumnRoles,
    estimate_offset,
    estimate_weighted_mean,
    information,
    offset_cost,
    scale_grams,
)
from sealscope.diagnosis.inference.changes.charge_pressure import estimate_charge_trend
from sealscope.diagnosis.inference.changes.motion_fit import fit_difference, fit_robustly
from sealscope.diagnosis.inference.changes.volumes import delay_observables, volume_observables
from sealscope.diagnosis.inference.circuit.holds.chambers import HeldChambers
from sealscope.diagnosis.inference.circuit.holds.hold_oil import CylinderSides
from sealscope.diagnosis.inference.circuit.holds.leaks import HeldLeaks
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import (
    LockedHold,
    find_charge_pressure,
    find_locked_holds,
)
from sealscope.diagnosis.inference.circuit.without_position import recorded_oil_loss_tests
from sealscope.diagnosis.inference.comparison import RecordingSums, block_weights
from sealscope.diagnosis.inference.equations.balances import (
    READ,
    derive_drive_signals,
    find_rest_limits,
    motions_of_side,
)
from sealscope.diagnosis.inference.equations.terms import (
    CYLINDER,
    LAG,
    LINES,
    MIN_ABSOLUTE_PRESSURE,
    TURNING,
    Equation,
    Flow,
    Signals,
    interval_means,
)
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.inference.leak_flow import (
    StateLoad,
    StateLoads,
    TotalFlow,
    estimate_total_flow,
    find_leak_step,
    with_turbulence,
)
from sealscope.diagnosis.inference.machine_states import extend_rests, find_rests, flag_lowering
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.regimes import RegimeBlocks, fit_with_robust_covariance, rest_log_odds
from sealscope.diagnosis.inference.rows import half_width
from sealscope.diagnosis.inference.sensor_errors import DelayChange, DelayTest
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.evidence import RAREST
from sealscope.diagnosis.verdict.machine_sizes import measures_flow
from sealscope.recordings.channels import COUNTS, METERS, flow_source
from sealscope.recordings.header import oil_temperature, start_seconds
from sealscope.recordings.recording import Array, Recording, compute_once
from sealscope.signals.smoothing import average_over
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Fraction of the samples beyond each end of the stroke, and beyond the largest load.
END_QUANTILE = 0.02
#: Number of ratios of the two piston areas, and of shares of a side's motion, that are compared; the smallest share.
N_RATIOS, N_SHARES, MIN_SHARE = 801, 51, 1e-3
#: Smallest number that is divided by.
TINY = float(np.finfo(float).tiny)
#: Time over which the flow that does not move the piston is averaged [s].
LOST_FLOW_TIME = 0.05
#: Averaging time of flow, speed and pressures [s]. Rate [Hz] to which samples are thinned, or up to twice as much.
PUMP_AVERAGING_TIME, MAX_RATE = 0.1, 50.0
#: Minimum number of samples of the fit.
MIN_PUMP_SAMPLES = 30


class Size(NamedTuple):
    """Factor `scale` from flows computed with the machine's assumed sizes to its true flows.

    - `deviation`: relative standard deviation of the factor.
    - `stated`: true if flows can be stated in L/min. The pressures must have units, and a flow meter must be recorded
      or the rig's file must state the size.
    - `ratio`: measured over assumed ratio of displacement to area, None if it is not measured.
    - `area`: area of the piston's loaded side, measured with the assumed displacement or a flow meter [m^2], or None.
    - `disagrees`: true if stated displacement and stated area contradict each other.
    """

    scale: float
    deviation: float
    stated: bool
    ratio: Interval | None = None
    area: float | None = None
    disagrees: bool = False


@dataclass(frozen=True, eq=False)
class RecordedBalance:
    """Volume balance of a recording, and the estimates that follow from it.

    - `blocks`, `equations`, `columns`: blocks with the Gram matrices of the balances, of which there is one or, behind
      a servo valve, one for each chamber; and the roles of their columns.
    - `cycle_oil_loss`: `oil_loss` of a balance over cycles or holds; None with a position.
    - `plain`: the blocks without the correction of the pressure offset, None if there is no such correction.
    - `valves`: those between pump and cylinder at rest; if they hold the load, these times measure the leaks
      (`chambers`).
    - `known_stroke`: ends of the motion in other recordings of the machine [m], None if unknown.
    - `delay_changes`: changes of channels' delays, which the blocks no longer contain; `delay_tests`: tests for them.
    - `by_state`: the blocks for shut valves, which separate the states of the pump; None if it never rests.
    """

    blocks: Blocks
    equations: tuple[Equation, ...]
    columns: tuple[ColumnRoles, ...]
    rig: Rig
    recording: Recording
    cycle_oil_loss: Mapping[str, StepTest] | None = None
    plain: Blocks | None = None
    valves: Valves = Valves.OPEN
    known_stroke: tuple[float, float] | None = None
    delay_changes: tuple[DelayChange, ...] = ()
    delay_tests: tuple[DelayTest, ...] = ()
    by_state: RegimeBlocks | None = None

    @property
    def flow(self) -> Flow:
        """Source of the flow in the balance."""
        return self.equations[0].flow

    @property
    def oil_loss(self) -> Mapping[str, StepTest]:
        """Tests for external leaks by the volume of the accumulator, by the name of the term; cached."""
        if self.cycle_oil_loss is not None:
            return self.cycle_oil_loss
        offset = float(self.blocks.zero[0])  # sensor offset that was removed from p_A - p_B [Pa]

        test = partial(recorded_oil_loss_tests, rig=self.rig, offset=offset)
        return compute_once(self.recording, ("lost oil", self.rig, offset), test, READ)

    @property
    def has_position_and_flow(self) -> bool:
        """True if the balance has the position, and the flow of a pump, a meter or a valve's opening."""
        return self.equations[0].name == CYLINDER or self.flow is Flow.VALVE

    @property
    def separates_pump(self) -> bool:
        """True if the pump's leakage has terms of its own, as valves cut it off at rest (`regimes`)."""
        return TURNING in self.columns[0].names

    @cached_property
    def _first_motion(self) -> int:
        """Index of the first block tested for steps: the first moving one, or the first after the machine's start.

        The later of the two counts. The machine starts with the flow of its pump or, behind a servo valve (two
        balances), with the motion of the piston. Without a position or a flow its start is not known. The index is 0 if
        too few blocks would remain.
        """
        first = int(np.argmax(self.blocks.is_moving))
        if self.has_position_and_flow:
            rate = self.recording.rate
            begin = float(self.recording.t[0]) + int(np.argmin(self._pump_rests)) / rate
            starts = self.blocks.start - half_width(rate)  # of the first test functions
            first = max(first, int(np.searchsorted(starts, begin)))
        return first if len(self.blocks) - first >= MIN_BLOCKS else 0

    @property
    def running_blocks(self) -> Blocks:
        """Blocks from the first motion on, which are tested for steps.

        Before that, the machine may be off: when its pump begins to hold the load, the flow rises without a leak.
        """
        return self.blocks[self._first_motion :]

    @property
    def leak(self) -> Information:
        """Likelihood of the leak's conductance in each of `running_blocks` (`onset.Information`)."""
        return self._leak_and_test[0]

    def block_weights(self, healthy: Sequence[RecordingSums]) -> Array:
        """Compute the weights (K,) of `running_blocks` in the rise of the leakage over `healthy` recordings.

        A leak with the coefficient g_k in block k causes the rise sum_k w_k g_k (`comparison.block_weights`). The
        weights of all blocks have the sum 1.
        """
        grams = scale_grams(self.blocks, self.columns)
        reference = np.sum([recording.sums for recording in healthy], axis=0)
        return block_weights(grams, reference, self.columns)[self._first_motion :]

    @property
    def test(self) -> StepTest | None:
        """Test for a leak that begins within the recording; None if too few blocks have information."""
        return self._leak_and_test[1]

    @cached_property
    def _leak_and_test(self) -> tuple[Information, StepTest | None]:
        """Likelihood of the leak's conductance in each of `running_blocks`, and the test for a step of it.

        The healthy leakage may be laminar, or turbulent in part (`with_turbulence`); the larger p-value counts, 1
        without a test.
        """
        laminar = information(self.running_blocks, self.columns, self.columns[0].leak, with_expansion=True)
        candidates = [
            (leak, find_leak_step(self.running_blocks, self.columns, leak))
            for leak in (laminar, with_turbulence(laminar, self.running_blocks, self.columns))
        ]
        return max(candidates, key=lambda candidate: 1.0 if candidate[1] is None else candidate[1].chance)

    @cached_property
    def observables(self) -> tuple[Observable, ...]:
        """Tests of the balance's coefficients for a step, the highest score first, and then of the channels' delays."""
        plain = self.running_blocks if self.plain is None else self.plain[self._first_motion :]
        # the fall of the charge pressure is compared with losses of oil as true flows
        charge = estimate_charge_trend(self.recording) if self.size.stated else None
        volume_tests = volume_observables(
            self.running_blocks, plain, self.equations, self.columns, self.oil_loss,
            volume_ratio=self.volume_ratio, charge=charge, flow_scale=self.size.scale, port_offset=self._port_offset,
        )  # fmt: skip
        return volume_tests + delay_observables(self.delay_tests, self.delay_changes)

    @cached_property
    def _port_offset(self) -> Estimate | None:
        """Sensor offset of p_A - p_B minus that of p_1 - p_2 [Pa], from the lines' pressure drop; None if unknown.

        The drop is fitted by terms that are odd in the pump's flow q: sign(q), q and q abs(q). The standard deviation
        is that of the residuals, since valves in the lines may drop pressure in one direction only.
        """
        if LINES not in self.columns[0].names:
            return None
        ports, chambers = (self.recording[a] - self.recording[b] for a, b in (("p_1", "p_2"), ("p_A", "p_B")))
        flow, drop = self._pumped, interval_means(chambers - ports)
        is_known = np.isfinite(flow) & np.isfinite(drop)
        flow, drop = flow[is_known] / max(float(np.abs(flow[is_known]).max(initial=0.0)), TINY), drop[is_known]
        design = np.column_stack([np.ones_like(flow), np.sign(flow), flow, flow * np.abs(flow)])
        coefficients, *_ = np.linalg.lstsq(design, drop, rcond=None)
        return Estimate(float(coefficients[0]), float(np.std(drop - design @ coefficients)))

    @property
    def volume_ratio(self) -> float:
        """Measured over assumed ratio of the piston's area to the pump's displacement; 1 if not measured."""
        ratio = self.size.ratio  # of displacement to area
        return 1.0 if ratio is None else 1.0 / max(ratio.value, np.finfo(float).tiny)

    @cached_property
    def recording_sums(self) -> RecordingSums:
        """Summary of the recording for comparison with others; what is not known is None."""
        start_s, oil_degC = start_seconds(self.recording), oil_temperature(self.recording)
        sums = RecordingSums.from_blocks(self.blocks, self.columns, start_s, oil_degC)
        if self.flow is Flow.CREEP:
            sums = replace(sums, flow=self.mean_flow)  # a test of creep records no flow of a pump
        hold_leaks = None if self.chambers is None else np.array(self.chambers.leaks)
        pump_leakage = None if self.held_pump_leakage is None else np.array(self.held_pump_leakage)
        fit = fit_difference(self.recording)
        is_determined = fit is not None and min(fit.friction_error, fit.drop_error) > 0.0  # 0: without information
        resistance = np.array(fit) if is_determined else None
        return replace(sums, held=hold_leaks, held_pump=pump_leakage, resistance=resistance)

    @cached_property
    def chambers(self) -> HeldChambers | None:
        """Estimator of the chambers' leaks from holds: times in which the pump rests and shut valves hold the load.

        None unless `valves` hold the load for long, or if pressures have no unit or the areas are unknown.
        """
        is_held = self.valves is Valves.SURELY_SHUT
        sides = self._cylinder_sides() if is_held and self.recording.units["p_A"] != COUNTS else None
        if sides is None:
            return None
        recording, rests = self.recording, self._pump_rests
        pressures = {name: recording[name] for name in ("p_A", "p_B")}
        lower_pressure = np.minimum(pressures["p_A"], pressures["p_B"])
        charge = find_charge_pressure(lower_pressure, rests, recording.rate)
        # absolute minus gauge pressure; larger if sensor offsets would make the least pressure too low
        to_absolute = max(P_ATM, MIN_ABSOLUTE_PRESSURE - float(np.nanmin(lower_pressure)))
        # time, absolute pressures of A and B, position
        channels = (recording.t, *(values + to_absolute for values in pressures.values()), recording["x"])
        held_rests = extend_rests(rests, self._lost_flow(sides), recording.rate)
        holds = [
            hold
            for hold in find_locked_holds(channels, held_rests, recording.rate)
            if self._is_pump_off(hold) and self._is_loaded(hold)
        ]
        begin, end = float(recording.t[0]), float(recording.t[-1])
        return HeldChambers(holds, sides, begin, end, charge + to_absolute) if holds else None

    @cached_property
    def held_pump_leakage(self) -> Estimate | None:
        """Leakage conductance of the pump [m^3/(s Pa)] just before valves shut the chambers, None if unknown."""
        if self.chambers is None:
            return None
        return estimate_pump_leakage(self.recording, self._pumped, self.chambers.holds, self.chambers.leaks)

    @cached_property
    def _pumped(self) -> Array:
        """Volume that the pump delivers between the samples of the recording [m^3], shape (n - 1,).

        It is NaN while the piston moves past the resting pump (`flag_lowering`). It is computed once for the balances
        with open and with shut valves.
        """
        return compute_once(
            self.recording, ("pumped", self.rig, self.flow, self.equations[0].left), self._compute_pumped
        )

    @property
    def _pump_rests(self) -> NDArray[np.bool_]:
        """Flags (n - 1,) of the sampling intervals in which the pump rests; computed once, as `_pumped`."""
        key = ("pump rests", self.rig, self.flow, self.equations[0].left)
        return compute_once(self.recording, key, lambda recording: find_rests(self._pumped, recording.rate))

    def _compute_pumped(self, recording: Recording) -> Array:
        """Compute the volume that the pump delivers between the samples (`_pumped`)."""
        channels, rate = dict(recording.channels), recording.rate
        if self.flow is Flow.COMMAND:
            channels = derive_drive_signals(channels, self.rig, rate)
        signals = Signals(channels, rate)
        pumped = self.equations[0].left(signals)
        difference = signals.compute_pressure_difference()
        del signals  # its arrays are as long as the recording
        is_lowering = flag_lowering(pumped, channels["x"], difference, rate)
        return np.where(is_lowering, np.nan, pumped)

    def _lost_flow(self, sides: CylinderSides) -> Array:
        """Compute the pump's flow [m^3/s] beyond the one that moves the piston, shape (n - 1,), at least 0.

        It is positive while the pump holds a load or compresses oil. The flow that moves the piston is its speed times
        the area of the side with the higher pressure or, in an open circuit, of the side that the pump feeds. Both are
        magnitudes of means over `LOST_FLOW_TIME`.
        """
        recording, fed_outward = self.recording, self.equations[0].fed_outward
        step = np.diff(recording["x"])
        moves_A = recording["p_A"][1:] > recording["p_B"][1:]
        if fed_outward:
            moves_A = (step >= 0.0) == (fed_outward == "A")
        area = np.where(moves_A, abs(sides.area_A), abs(sides.area_B))
        flow, displaced = (
            np.abs(average_over(LOST_FLOW_TIME, volume * recording.rate, recording.rate))
            for volume in (self._pumped, area * step)
        )
        return np.asarray(np.maximum(flow - displaced, 0.0))

    def _is_pump_off(self, hold: LockedHold) -> bool:
        """Return True if the pump's mean flow in a hold is probably too small to hold the load, False if it is missing.

        To hold a load, a pump is assumed to deliver the fraction `rest.holding_flow` (`priors.toml`) of its flow in
        motion.
        """
        recording = self.recording
        # time in which the pump's flow may still fall: the first interval, and the longest extension by `extend_rests`
        falling = hold.t[hold.edges[1]] - hold.t[0] + INFERENCE.rest.averaging_time
        begin, end = np.searchsorted(recording.t, [hold.t[0] + falling, hold.t[-1]])
        flow = self._pumped[begin:end] * recording.rate
        flow = flow[np.isfinite(flow)]
        if not flow.size:
            return False
        variance = float(flow.var()) / flow.size  # variance of the mean flow
        holding_flow = INFERENCE.rest.holding_flow * self.blocks.moving_flow  # counts as exact
        log_odds = rest_log_odds(
            abs(float(flow.mean())), holding_flow, rest_variance=variance, difference_variance=variance
        )
        return log_odds > 0.0

    def _is_loaded(self, hold: LockedHold) -> bool:
        """Return True if p_A - p_B in a hold almost certainly is a load, not the sensors' offset at equal pressures.

        At equal pressures a leak has no flow to show. The largest abs(p_A - p_B) in the hold or just before it counts,
        since a large leak equalises the pressures while the valves are shutting.
        """
        oil, t = INFERENCE.held_oil, self.recording.t
        # just before the hold the pump stops and the valves shut
        first, last = np.searchsorted(t, hold.t[0] - np.array([oil.shutting_time, 0.0]))
        before = slice(first, last + 1)
        difference_before = np.nanmedian(np.abs(self.recording["p_A"][before] - self.recording["p_B"][before]))
        pressure = float(np.nanmax([np.abs(hold.mean(hold.p_A - hold.p_B)).max(), difference_before]))
        return float(self._load_log_odds(np.array([pressure]))[0]) > oil.load_odds

    def _load_log_odds(self, pressure: Array) -> Array:
        """Compute the log odds (n,) that a load causes abs(p_A - p_B) = `pressure` (n,) [Pa], not a sensor offset.

        All loads up to the largest of the recording are equally probable; the offset has the prior of `offset_cost`.
        """
        # an offset z has the log probability density -offset_cost(z) / 2 - log_offset_norm
        log_offset_norm = float(np.log(INFERENCE.zero.pressure * np.sqrt(2.0 * np.pi)))
        return np.asarray(0.5 * offset_cost(pressure) + log_offset_norm - self._log_max_load)

    @cached_property
    def _log_max_load(self) -> float:
        """Logarithm of the largest load of the recording, a difference of the pressures [Pa]."""
        difference = np.abs(self.recording["p_A"] - self.recording["p_B"])
        max_load = float(np.nanquantile(difference, 1.0 - END_QUANTILE))
        return float(np.log(max(max_load, np.finfo(float).tiny)))

    def locked_log_odds(self, conductance: Interval) -> float | None:
        """Compute the log odds that valves are shut in holds, and not open; None without holds.

        With open valves the leakage in holds would be the total leakage of pump and piston. This is the sum of the
        pump's leakage around the holds (`held_pump_leakage`) and the leak in them, or, if the former is unknown,
        `conductance` [m^3/(s Pa)], that of the whole recording with open valves.
        """
        if self.chambers is None:
            return None
        hold_leak, pump = self.chambers.total_leak(), self.held_pump_leakage
        variance = hold_leak.deviation**2
        if pump is not None:  # the total leakage is that of the pump and the leak in holds, whose error then cancels
            total, difference_variance = pump.value + hold_leak.value, pump.deviation**2
        else:
            total, difference_variance = conductance.value, variance + conductance.deviation**2
        return rest_log_odds(hold_leak.value, total, rest_variance=variance, difference_variance=difference_variance)

    def _cylinder_sides(self) -> CylinderSides | None:
        """Estimate piston areas and ends of the stroke; None without motion or `x`, or for an implausible area ratio.

        The stroke covers the motion of this recording and of the others that are known (`known_stroke`).
        """
        if (stroke := self.recorded_stroke) is None:
            return None
        # the dead volumes are beyond the motion of all recordings
        lows, highs = zip(stroke, self.known_stroke or stroke, strict=True)
        low, high = min(lows), max(highs)
        (area_A, deviation_A), (area_B, deviation_B) = self._signed_areas()
        max_area_ratio: float = INFERENCE.held_oil.largest_area_ratio
        if not (area_A and high > low and 1.0 / max_area_ratio < area_A / area_B < max_area_ratio):
            return None
        return CylinderSides(area_A, area_B, low, high, deviation_A, deviation_B)

    @property
    def recorded_stroke(self) -> tuple[float, float] | None:
        """Ends of the recorded motion [m], as quantiles of the position (`END_QUANTILE`); None without a position."""
        x = self.recording["x"] if "x" in self.recording else np.empty(0)
        x = x[np.isfinite(x)]
        if not x.size:
            return None
        low, high = np.quantile(x, (END_QUANTILE, 1.0 - END_QUANTILE))
        return float(low), float(high)

    def _signed_areas(self) -> list[tuple[float, float]]:
        """Estimate the piston areas of A and B [m^2], as measured with the assumed displacement of the pump.

        Returns for either side the area and the standard deviation of the logarithm of its magnitude. The areas are
        negative if the position x is reversed, and zero if nothing moves. Areas in the rig's file are used if they are
        stated and can be scaled to the flows of the balance. Otherwise the area of a side is the mean coefficient of
        its motions (`motions_of_side`), weighted by the sums of squares of the columns. The main side is the one with
        more motion in which it surely carries the load. The other area is corrected for motion that may belong to the
        main side (`log_area_ratio`).
        """
        roles, total = self.columns[0], self.blocks.gram[:, 0].sum(axis=0)
        nuisance = list(roles.nuisance)
        coefficients = dict(zip(nuisance, Gaussian.from_gram(total).among(nuisance).mean, strict=True))
        areas, energies = [], []  # for A and B
        for side in "AB":  # columns of the motion with the area of this side
            motion = [k for k in roles.motion if roles.names[k] in motions_of_side(self.equations[0], side)]
            squares = np.diag(total)[motion]
            energy = float(squares.sum())
            areas.append(float(squares @ [coefficients[k] for k in motion]) / max(energy, np.finfo(float).tiny))
            energies.append(energy)
        shares = self._loaded_shares()
        main = int(np.argmax(np.array(energies) * shares))  # index of the main side: 0 for A, 1 for B
        other = 1 - main
        deviation: float = INFERENCE.size.area
        if self.rig.states("cylinder.A_A", "cylinder.A_B") and self.size.stated:
            sign, cylinder = float(np.sign(areas[main])), self.rig.cylinder
            return [(sign * area / self.size.scale, deviation) for area in (cylinder.A_A, cylinder.A_B)]
        measured = areas[other] / areas[main] if areas[main] else 0.0  # 0: no information
        # the side that carries the largest load is more probably the one without a rod
        highest = [float(np.nanquantile(self.recording[name], 1.0 - END_QUANTILE)) for name in ("p_A", "p_B")]
        log_ratio = log_area_ratio(measured, shares[other], is_larger=highest[other] > highest[main])
        other_area, other_deviation = areas[main] * np.exp(log_ratio.value), np.hypot(deviation, log_ratio.deviation)
        sides = [(areas[main], deviation), (float(other_area), float(other_deviation))]
        return sides if main == 0 else sides[::-1]

    def _loaded_shares(self) -> tuple[float, float]:
        """Compute the fractions of A's and of B's motion under load in which the load is certain (`_load_log_odds`).

        A side counts as loaded while it has the higher pressure. The motion is measured by the sum of squared speeds
        over the samples. A side that is never loaded has the fraction 0.
        """
        recording = self.recording
        difference = recording["p_A"] - recording["p_B"] - self.pressure_offset
        speed = Signals(dict(recording.channels), recording.rate).speed
        is_load = self._load_log_odds(np.abs(difference)) > INFERENCE.held_oil.load_odds
        shares = []
        for is_loaded in (difference > 0.0, difference <= 0.0):  # A, B
            squares = np.where(is_loaded & np.isfinite(speed * difference), speed**2, 0.0)
            shares.append(float(squares[is_load].sum()) / max(float(squares.sum()), np.finfo(float).tiny))
        return shares[0], shares[1]

    @cached_property
    def pressure_offset(self) -> float:
        """Estimated sensor offset of p_A - p_B [Pa]; near `Blocks.zero` unless a change of the leak reveals another."""
        return estimate_offset(self.blocks, self.columns)

    @cached_property
    def position_delay(self) -> Estimate | None:
        """Time by which the recorded position lags behind the flow [s], negative if it is early.

        It is the coefficient of the term `LAG` [m^2 s] over the measured piston area. None without term or area.
        """
        roles, area = self.columns[0], self._loaded_area
        if LAG not in roles.names or area is None:
            return None
        value, deviation = estimate_weighted_mean(self.blocks, roles, {roles.names.index(LAG): 1.0}, self.total_history)
        return Estimate(area.sign * value / area.measured.value, deviation / area.measured.value)

    def mean_pressure(self) -> float:
        """Compute the mean of abs(p_A - p_B) [Pa] without the sensor offset."""
        pressures = self.blocks.mean_pressure(self.pressure_offset)
        return float(np.average(pressures, weights=self.blocks.pressure_weights))

    def outside_unit_flows(self) -> dict[str, float]:
        """Compute the flow [m^3/s] of each external leak with a conductance of 1 m^3/(s Pa), by the name of its term.

        The leak is driven by the root mean square of its pressure (`Blocks.driving_pressure`).
        """
        # with the pressures as recorded, as external leaks are tested (`volume_observables`)
        names, blocks = self.columns[0].names, self.blocks if self.plain is None else self.plain
        return {
            name: blocks.driving_pressure(names, name) * self.size.scale
            for name in names
            if name.startswith("external leak")
        }

    @cached_property
    def mean_flow(self) -> float:
        """Mean magnitude of the pump's flow [m^3/s]; of a creeping load, of what the larger side displaces."""
        if self.flow is not Flow.CREEP:  # weights: positive, so that a mean exists
            return float(np.average(self.blocks.flow, weights=np.maximum(self.blocks.rows, 1e-9)))
        area = max(self.rig.cylinder.A_A, self.rig.cylinder.A_B)
        return area * float(np.nanmean(np.abs(np.diff(self.recording["x"])))) * self.recording.rate

    @cached_property
    def size(self) -> Size:
        """Factor by which computed flows are multiplied to give the true ones, from the sizes in the rig's file.

        - Behind a servo valve, and for a load that shut valves hold, the areas give the flow, and the factor is 1.
          While a held load creeps, its oil also expands, which adds to the uncertainty.
        - A flow meter or a stated displacement gives the factor 1. If a stated area disagrees with the displacement,
          the difference is the uncertainty. Of an asymmetric pump, the displacement of side B may be stated; the factor
          is then the ratio of the areas.
        - If only the area is stated, the factor follows from the measured ratio of displacement to area. If neither is
          stated, or no area is measured, it is 1.
        """
        rig, is_meter = self.rig, measures_flow(self.recording.units)
        prior, source = INFERENCE.size, flow_source(self.recording.channels)
        units = self.recording.units
        # the measured area scales even a meter in counts, but not an angle, a speed or a command in counts
        is_flow_scalable = source in METERS or units.get(source or "") != COUNTS
        has_pressure_unit = COUNTS not in (units["p_A"], units["p_B"])
        states_displacement = rig.states("pump.q_b") and is_flow_scalable and source not in METERS
        states_areas = rig.states("cylinder.A_A", "cylinder.A_B")
        if self.flow in (Flow.VALVE, Flow.CREEP):
            deviation = float(np.hypot(prior.area, prior.creep)) if self.flow is Flow.CREEP else prior.area
            return Size(1.0, deviation, stated=states_areas and has_pressure_unit)
        area = self._loaded_area if units.get("x") == "m" else None
        if area is None or not is_flow_scalable:
            deviation = prior.meter if is_meter else prior.displacement
            return Size(1.0, deviation, stated=(is_meter or states_displacement) and has_pressure_unit)
        if is_meter:
            return Size(1.0, prior.meter, stated=has_pressure_unit, area=area.measured.value)
        value, low, high = area.measured
        # the ratio is inverse to the measured area, so that its lower end follows from the largest area
        ratio = Interval(area.assumed / value, area.assumed / high, area.assumed / max(low, 1e-12))
        sides = (1.0, rig.cylinder.A_A / rig.cylinder.A_B) if rig.circuit.has_asymmetric_pump else (1.0,)
        scale = min(sides, key=lambda side: abs(float(np.log(ratio.value / side))))  # by the side that is stated
        disagreement = abs(scale / ratio.value - 1.0)
        both_deviation = float(np.hypot(prior.displacement, prior.area))
        size = Size(1.0, both_deviation, stated=False, ratio=ratio, area=value)
        if states_displacement:
            disagrees = states_areas and disagreement > WITHIN_95 * both_deviation
            deviation = disagreement if disagrees else prior.displacement
            return size._replace(scale=scale, deviation=deviation, stated=has_pressure_unit, disagrees=disagrees)
        if states_areas:
            return size._replace(scale=ratio.value, deviation=prior.area, stated=has_pressure_unit)
        return size

    @cached_property
    def _loaded_area(self) -> _Area | None:
        """Piston area, a mean over the directions of motion and the loaded sides; None if unknown or 0.

        Each of these has a column in the balance, with the area as its coefficient; the mean is weighted by the sums of
        squares of the columns.
        """
        roles, cylinder = self.columns[0], self.rig.cylinder
        motion = [k for k in roles.motion if roles.names[k].startswith("motion")]
        if not motion:
            return None
        squares = np.einsum("kii->i", self.blocks.gram[:, 0])[motion]  # sums over all blocks
        weights = squares / max(float(squares.sum()), np.finfo(float).tiny)
        shares = dict(zip(motion, weights, strict=True))
        value, deviation = estimate_weighted_mean(self.blocks, roles, shares, self.total_history)
        if not abs(value) > 0.0:
            return None
        motions_of_A = motions_of_side(self.equations[0], "A")
        assumed = [cylinder.A_A if roles.names[k] in motions_of_A else cylinder.A_B for k in motion]
        half_width = WITHIN_95 * deviation
        measured = Interval(abs(value), abs(value) - half_width, abs(value) + half_width)
        return _Area(measured, float(weights @ assumed), sign=-1 if value < 0.0 else 1)

    @cached_property
    def conductance(self) -> Interval:
        """Mean total leakage of pump and piston [m^3/(s Pa)], which cannot be separated, with its 95 % interval."""
        weights = np.maximum(self.blocks.rows, 0.0)
        return self.total_history.average(weights / weights.sum())

    @cached_property
    def total_flow(self) -> TotalFlow | None:
        """Mean leakage of pump and piston over the recording [m^3/s] (`estimate_total_flow`), None if not identified.

        It needs the pump's angle or speed: a flow meter does not see the leakage inside the pump, a command not the
        drive that slows down under load, and behind a servo valve the edges leak as well. The 95 % interval must
        contain a flow above 0, and none above that which the pump delivers.
        """
        if self.flow is not Flow.PUMP:
            return None
        regime = self.by_state
        blocks, roles = (self.blocks, self.columns[0]) if regime is None else (regime.blocks, regime.columns[0])
        is_step = self.test is not None and self.test.chance < RAREST
        is_after = blocks.time >= self.test.onset().value if is_step and self.test is not None else None
        flow = estimate_total_flow(blocks, roles, self._state_loads(float(blocks.zero[0])), is_after)
        deviation = float(np.hypot(flow.deviation, flow.value * self.size.deviation))
        return flow if 0.0 < flow.value + WITHIN_95 * deviation <= blocks.moving_flow else None

    def _state_loads(self, offset: float) -> StateLoads:
        """Measure the pressure in each state of the pump, given the sensor offset of p_A - p_B [Pa].

        If the balance does not separate the states, or has no position, the piston always counts as moving.
        """
        channels, rate = dict(self.recording.channels), self.recording.rate
        regime, limits = self.by_state, None
        equation = self.equations[0] if regime is None else regime.equations[0]
        if regime is not None:
            limits = find_rest_limits(channels, rate, equation)
        signals = Signals(channels, rate, rest_limits=limits)
        is_moving, is_holding = signals.moving(equation.left) > 0.0, signals.holding(equation.left) > 0.0
        del signals  # its arrays are as long as the recording
        pressure = Signals(channels, rate, offset=offset).compute_pressure_difference()
        np.abs(pressure, out=pressure)
        states = ~is_moving & ~is_holding, is_moving, is_holding
        return StateLoads(*(StateLoad.measure(pressure, is_counted) for is_counted in states))

    def creep_log_odds(self) -> float:
        """Compute the log odds that a held load creeps by leakage, rather than that a control loop holds it.

        A loop replaces the oil that leaks: the piston displaces hardly any flow, not that of a typical machine's
        leakage. The result is 0 if the recording does not determine the flow.
        """
        holding_flow, roles = (
            INFERENCE.rest.holding_flow * self.mean_flow,
            self.columns[0],
        )  # [m^3/s] of typical leakage
        # conductance: displaced volume over the integral of p_A - p_B, the chambers' compliance being neglected
        conductance, conductance_variance = fit_with_robust_covariance(self.blocks.gram[:, 0], [roles.leak], roles.left)
        flow = float(conductance[0]) * self.mean_pressure()
        variance = float(conductance_variance[0, 0]) * self.mean_pressure() ** 2
        if not variance > 0.0:
            return 0.0
        # positive log odds of "rest" mean a flow of about zero, as under a loop
        return -rest_log_odds(flow, holding_flow, rest_variance=variance, difference_variance=variance)

    @cached_property
    def total_history(self) -> History:
        """Total leakage of pump and piston in each block, as a conductance [m^3/(s Pa)] with its covariance.

        The history includes a step of the leakage if a test finds one with a p-value below `RAREST`.
        """
        total = information(self.blocks, self.columns, self.columns[0].leak)
        test = step_test(total)
        return fit_history(total, test, with_step=test is not None and test.chance < RAREST)


def log_area_ratio(measured: float, loaded_share: float, *, is_larger: bool) -> Estimate:
    """Estimate the logarithm r of the ratio of two piston areas, first side over second, with its standard deviation.

    `measured`: fitted ratio, without information if it is not positive; the area of the second side is well known. Only
    a fraction w of the motion that was attributed to the first side belongs to it, and the rest to the second side.
    Thus log `measured` = w r, with the standard error `size.area` (`priors.toml`). The unknown w is 1 with the
    probability `held_oil.load_side_probability`; otherwise log w is uniform between 0 and log `loaded_share`, the
    fraction of that motion in which the first side surely carries the load. r is normal about `held_oil.log_area_ratio`
    if the first side is probably the larger one (`is_larger`), else about minus this value, with the standard deviation
    `held_oil.log_area_ratio_deviation`.
    """
    prior = INFERENCE.held_oil
    mean, deviation = prior.log_area_ratio if is_larger else -prior.log_area_ratio, prior.log_area_ratio_deviation
    ratios = mean + np.linspace(-4.0, 4.0, N_RATIOS) * deviation
    log_weights = np.broadcast_to(-0.5 * ((ratios - mean) / deviation) ** 2, (N_SHARES, N_RATIOS))
    if measured > 0.0:
        shares = np.geomspace(max(loaded_share, MIN_SHARE), 1.0, N_SHARES)
        share_weights = np.full(N_SHARES, (1.0 - prior.load_side_probability) / N_SHARES)
        share_weights[-1] += prior.load_side_probability  # w = 1
        misfit = (np.log(measured) - np.outer(shares, ratios)) / INFERENCE.size.area
        log_weights = log_weights + np.log(share_weights)[:, None] - 0.5 * misfit**2
    weights = weigh_alternatives(log_weights).sum(axis=0)
    value = float(weights @ ratios)
    return Estimate(value, float(np.sqrt(weights @ (ratios - value) ** 2)))


class _Area(NamedTuple):
    """Piston area of the loaded side [m^2]: as `measured` by the volume balance, and as `assumed` in the rig's file.

    The measurement uses the assumed displacement or a flow meter. `sign`: -1 if the position or the flow is recorded
    with the opposite sign, which makes the coefficients negative.
    """

    measured: Interval
    assumed: float
    sign: int


def estimate_pump_leakage(
    recording: Recording, pumped: Array, holds: Sequence[LockedHold], leaks: HeldLeaks
) -> Estimate | None:
    """Estimate the leakage conductance of the pump [m^3/(s Pa)] from the time just before each hold.

    A press builds up its pressure, the pump maintains it for some tenths of a second, and then the valves shut. In this
    time nearly all of the pump's flow q leaks. In the time `held_oil.time_before` (`priors.toml`) before each hold,

        q = G (p_A - p_B) + A v + C d(p_A - p_B)/dt,

    with the speed v of the piston. The conductance G, the area A and the compliance C are the same in all holds. The
    fit is robust, since the pump's flow falls within the last tenth of a second while the valves shut. G contains every
    leak of the loaded side; without those that the holds measure, it is the pump's own.

    `pumped` (n - 1,): volume that the pump delivers between the samples of the recording [m^3]; `leaks`: leaks measured
    in the holds, of which those past the piston and to the outside from the loaded side are subtracted. Return None for
    fewer than two holds or `MIN_PUMP_SAMPLES` samples, without any flow or pressure, or if the result is not finite.
    """
    rate, t = recording.rate, 0.5 * (recording.t[1:] + recording.t[:-1])
    difference = recording["p_A"] - recording["p_B"]
    signals = (pumped * rate, np.diff(recording["x"]) * rate, np.diff(difference) * rate, difference[1:])
    flow, speed, pressure_rate, pressure = (average_over(PUMP_AVERAGING_TIME, values, rate) for values in signals)
    is_known = np.isfinite(flow) & np.isfinite(speed) & np.isfinite(pressure_rate)
    windows, last_end = [], -np.inf
    for hold in holds:
        begin = max(last_end, hold.t[0] - INFERENCE.held_oil.time_before)  # not within the previous hold
        first, last = int(np.searchsorted(t, begin, side="right")), int(np.searchsorted(t, hold.t[0]))
        samples = first + np.flatnonzero(is_known[first:last])
        windows.append(samples[:: max(1, int(rate / MAX_RATE))])
        last_end = hold.t[-1]
    rows = np.concatenate(windows)
    if len(holds) < 2 or len(rows) < MIN_PUMP_SAMPLES:  # the errors below are those of fits without one hold each
        return None
    mean_pressure, mean_flow = (float(np.abs(values[rows]).mean()) for values in (pressure, flow))
    if not (mean_pressure > 0.0 and mean_flow > 0.0):
        return None
    # the flow is scaled to a pressure, since the robust fit has a smallest residual in Pa
    conductance = mean_flow / mean_pressure
    values = flow[rows] / conductance
    design = np.column_stack([pressure[rows], speed[rows], pressure_rate[rows]])  # column 0: leakage
    groups = np.repeat(np.arange(len(windows)), [len(samples) for samples in windows])
    (leakage,) = fit_robustly(design, values, [0], groups)
    is_A_loaded = float(np.median(pressure[rows])) > 0.0
    outside, outside_deviation = (
        (leaks.outside_A, leaks.deviation_A) if is_A_loaded else (leaks.outside_B, leaks.deviation_B)
    )
    value = conductance * leakage.value - leaks.piston - outside
    deviation = float(np.linalg.norm([conductance * leakage.deviation, leaks.deviation, outside_deviation]))
    return Estimate(value, deviation) if np.isfinite([value, deviation]).all() else None
