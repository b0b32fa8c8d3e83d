"""The volume balance as a leak detector: tests of a recording, and its leakage relative to healthy recordings.

Such faults are an external leak, wear of the pump, and free air. Each has a term in the volume balance. The change of
its coefficient is fitted to the residual of a recording under the healthy coefficients, with priors on the changes of
all other coefficients (`priors.toml`). The scatter of the coefficient among the healthy recordings shows which change
is normal (`observable.compare_with_healthy`). An external leak and a leak past the piston look nearly alike: the
likelihood ratio of the two is stated with the observable.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.estimate.population import MIN_HEALTHY, ScatterPrior, excess_error
from sealscope.diagnosis.healthy import Healthy, healthy_summaries
from sealscope.diagnosis.inference.block_stream import min_samples_for_step
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.circuit.holds.leaks import HeldLeaks
from sealscope.diagnosis.inference.circuit.without_position import cycle_balances
from sealscope.diagnosis.inference.comparison import (
    RISE,
    BalanceSummary,
    RecordingSums,
    Rise,
    coefficient_level,
    compare_laws,
    compare_with_leak,
    find_unusual_conditions,
    held_pump_rise,
    leak_deviations_from_mean,
    marginal_difference,
    motion_change,
    oil_hypotheses,
    rise,
)
from sealscope.diagnosis.inference.equations.balances import READ, circulation, equations, locked, shut_at_rest
from sealscope.diagnosis.inference.equations.terms import AIR, HOLDING, LEAK, SPEED_LOSS, TURNING, Flow
from sealscope.diagnosis.inference.hypotheses import PRIOR_ODDS, VALVES, HoldCounts, MachineOdds, Valves, step_penalty
from sealscope.diagnosis.inference.observable import (
    Observable,
    Observed,
    compare_estimates,
    compare_with_healthy,
)
from sealscope.diagnosis.inference.regimes import RecordedBlocks, RegimeBlocks, add_pump_columns, recorded_blocks
from sealscope.diagnosis.inference.volumes.balance_leak import BalanceLeak
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.evidence import VOLUME_BALANCE
from sealscope.recordings.channels import CHAMBERS, flow_source
from sealscope.recordings.recording import Array, Recording, compute_once

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: `Observable.data` of the leakage of the turning pump, in a machine whose rests show the piston's leakage alone.
TURNING_DATA = "turning"
#: Smallest number that is divided by.
TINY = float(np.finfo(float).tiny)


def rival_rises(
    judged: RecordingSums,
    healthy: Sequence[RecordingSums],
    columns: Sequence[ColumnRoles],
    volume_ratio: float = 1.0,
    unit_flows: Mapping[str, float] | None = None,
) -> tuple[Observable, ...]:
    """Test for faults other than a leak past the piston that may explain a change since the healthy recordings.

    The result has one test for each rival that can be compared. Leakages that are measured while shut valves hold the
    load (`held_rivals`), or just before (`held_pump_rise`), are compared only by these measurements.

    `columns`: roles of the columns of each balance, the same for all recordings. `volume_ratio`: measured over assumed
    ratio of the piston's area to the pump's displacement, by which prior volumes of air are multiplied. `unit_flows`:
    flow [m^3/s] of an external leak with a conductance of 1 m^3/(s Pa), by the name of its term. A leak without an
    entry is assumed to be driven by the mean of abs(p_A - p_B) in the judged recording.
    """
    names, hold_rivals = columns[0].names, held_rivals(judged, healthy, unit_flows)
    laws = compare_laws(judged, healthy, columns)
    # if an orifice fits better than a laminar leak, a rival is compared with the orifice
    orifice_log_ratio = 0.0 if laws is None else max(laws.log_ratio, 0.0)
    observables = list[Observable | None]()
    for k, name in enumerate(names):
        # a balance without a speed loss has a flow meter downstream of the pump, which does not show the pump's leakage
        if name == TURNING and SPEED_LOSS in names:
            observables.append(_turning_rise(judged, healthy, columns, k))
            continue
        is_outside = name.startswith("external leak") and hold_rivals is None
        if name != AIR and not is_outside:
            continue
        (*healthy_values, value), error, _ = _compare_changes(judged, healthy, columns, k)
        prior_change = np.inf if is_outside else INFERENCE.free_air.size * volume_ratio
        rival = compare_with_healthy(
            name, RISE, value, healthy_values, error, above=is_outside, prior_change=prior_change
        )  # free air may also decrease
        if rival is None:
            continue
        if is_outside:
            rival = _penalise_size(rival, judged, unit_flows)
        # likelihood ratio of the rival to a leak past the piston
        log_ratio = compare_with_leak(judged, healthy, columns, name)
        if log_ratio is not None:
            rival = replace(rival, log_ratio_to_leak=log_ratio - orifice_log_ratio)
        observables.append(rival)
    return (*filter(None, observables), *(hold_rivals or ()))


def _compare_changes(
    judged: RecordingSums, healthy: Sequence[RecordingSums], columns: Sequence[ColumnRoles], tested: int
) -> tuple[list[float], float, list[RecordingSums]]:
    """Estimate the change of a coefficient from the healthy recordings, in each of these and in the judged recording.

    A healthy recording is compared with the other healthy ones, and left out if no pressure drives the flow of the
    tested term. Returns the changes, that of the judged recording last; the part of its standard error that the scatter
    of the others does not contain (`excess_error`); and the healthy recordings that were compared. `tested`: column of
    the coefficient.
    """
    total = np.sum([recording.sums for recording in healthy], axis=0)
    change, error = _estimate_change(judged.sums, total, columns, tested)
    known, values, errors = list[RecordingSums](), list[float](), list[float]()
    for recording in healthy:
        healthy_change, healthy_error = _estimate_change(recording.sums, total - recording.sums, columns, tested)
        if np.isfinite(healthy_error):
            known.append(recording)
            values.append(healthy_change)
            errors.append(healthy_error)
    return [*values, change], excess_error(error, errors), known


def _turning_rise(
    judged: RecordingSums, healthy: Sequence[RecordingSums], columns: Sequence[ColumnRoles], tested: int
) -> Observable | None:
    """Test the leakage of the turning pump, the coefficient of the column `tested`, for a rise over healthy recordings.

    It describes data of its own, and so does not compete with the leak for the rise of the leakage. Return None if too
    few healthy recordings show it.
    """
    pump_rise = held_pump_rise(judged, healthy)
    if pump_rise is not None:  # measured just before valves shut to hold a load
        score = max(pump_rise.score, 0.0) ** 2  # a fall does not count
        return Observable(name=TURNING, data=TURNING_DATA, score=score, chance=pump_rise.chance, size=pump_rise.value)
    changes, error, known = _compare_changes(judged, healthy, columns, tested)
    turning_columns = [roles.replace_leak(TURNING) for roles in columns]
    level, _ = coefficient_level(np.sum([recording.sums for recording in healthy], axis=0), turning_columns)
    # levels instead of changes, since the oil's viscosity scales the whole leakage
    likeliest_oil, *_ = oil_hypotheses([*known, judged])
    levels = _without_oil(level + np.array(changes), likeliest_oil.thinning)
    *healthy_values, value = levels.tolist()
    observable = compare_with_healthy(TURNING, TURNING_DATA, value, healthy_values, error, above=True)
    if observable is None:
        return None
    # a rise that warmer oil explains does not count
    return replace(observable, chance=max(observable.chance, rise(judged, healthy, turning_columns).chance))


def _without_oil(coefficients: Array, thinning: Array) -> Array:
    """Remove the effect of the oil's viscosity from leakage coefficients (n + 1,), if healthy ones then scatter less.

    `thinning` (n + 1,): logarithm of the factor by which thinner oil raises each coefficient. The last coefficient is
    that of the judged recording.
    """

    def relative_scatter(values: Array) -> float:
        """Compute the standard deviation of the healthy values over their mean."""
        return float(np.std(values[:-1])) / max(abs(float(values[:-1].mean())), TINY)

    corrected = coefficients * np.exp(-thinning)
    return min(coefficients, corrected, key=relative_scatter)


def held_rivals(
    judged: RecordingSums, healthy: Sequence[RecordingSums], unit_flows: Mapping[str, float] | None = None
) -> tuple[Observable, ...] | None:
    """Test chambers A and B for larger external leaks than in healthy recordings, while shut valves hold the load.

    Return one test for each chamber that can be compared, None without such holds in the judged recording and in at
    least `MIN_HEALTHY` healthy ones. `unit_flows`: as in `rival_rises`.
    """
    healthy_leaks = [HeldLeaks(*recording.held) for recording in healthy if recording.held is not None]
    if judged.held is None or len(healthy_leaks) < MIN_HEALTHY:
        return None
    judged_leaks = HeldLeaks(*judged.held)
    # no machine repeats its leakage to less than the fraction `scatter.finest` of the pump's mean flow
    min_error = INFERENCE.scatter.finest * judged.conductance_of_flow
    observables = list[Observable]()
    for side in "AB":
        value, *healthy_values = (float(getattr(leaks, f"outside_{side}")) for leaks in (judged_leaks, *healthy_leaks))
        errors = [getattr(leaks, f"deviation_{side}") for leaks in (judged_leaks, *healthy_leaks)]
        error = max(float(np.median(errors)), min_error)
        observable = compare_with_healthy(f"external leak {side}", RISE, value, healthy_values, error, above=True)
        if observable is not None:
            observables.append(_penalise_size(observable, judged, unit_flows))
    return tuple(observables)


def _penalise_size(observable: Observable, judged: RecordingSums, unit_flows: Mapping[str, float] | None) -> Observable:
    """Set the `advantage` of a test for an external leak to a penalty for the size of the leak, which is at most 0.

    A large external leak is improbable, since someone would have noticed the oil outside. The penalty is 2 log(prior
    density / largest prior density) of the leak's flow, and 0 for flows below the centre of the prior (`outside` in
    `priors.toml`). `unit_flows`: as in `rival_rises`.
    """
    flow = observable.size * (unit_flows or {}).get(observable.name, judged.pressure)
    return replace(observable, advantage=-step_penalty(flow, INFERENCE.outside, above=True))


def _estimate_change(gram: Array, reference: Array, columns: Sequence[ColumnRoles], tested: int) -> tuple[float, float]:
    """Estimate the change of a coefficient of a recording from healthy recordings, with its standard error.

    `gram`, `reference` (E, m, m): Gram matrices (`RecordingSums.sums`) of the recording, and of the sum of the healthy
    recordings, for E equations; `tested`: column of the coefficient, which counts as 0 in the healthy recordings. The
    differences of the other coefficients have normal priors and are eliminated. Except for the leak, columns without a
    finite prior deviation are left out: `sums` no longer contain them. Without information the result is (0, inf).
    """
    precision, moment = 0.0, 0.0
    for e, roles in enumerate(columns):
        leak = roles.names.index(LEAK)
        fitted = [k for k in roles.compared if k != tested and (k == leak or np.isfinite(roles.between_deviation[k]))]
        coefficients = np.zeros(roles.left)
        coefficients[fitted] = Gaussian.from_gram(reference[e]).among(fitted).mean
        prior = roles.difference_precisions(fitted, coefficients[fitted], coefficients[leak])
        residual = Gaussian.from_gram(gram[e]).subtract(coefficients)
        change = marginal_difference(residual, [tested], fitted, prior)
        precision, moment = precision + change.precision[0, 0], moment + change.moment[0]
    return (moment / precision, precision**-0.5) if precision > 0.0 else (0.0, np.inf)


#: Reason for having no balance; the key is True if the position is recorded.
_NO_BALANCE = {
    True: "finds no time in which the piston is held under a constant command u, for long enough, in {:.3g} s",
    False: "needs the position x, or a piston that returns to where it was, or is held under a pressure difference, "
    "for longer than in these {:.3g} s",
}
#: Reason for having no balance if a channel is missing and the healthy recordings show no creep of a held load.
_NO_CREEP = "needs {}; without them it judges a held load that creeps in the healthy recordings"
#: Time that is longer than the life of any machine [s].
_MAX_AGE_S = 1e11
#: Minimum number of healthy recordings whose scatter shows whether valves cut the pump off at rest.
MIN_FOR_SCATTER = 3


def compensates_leakage(balance: RecordedBalance) -> bool:
    """Return True if the pump replaces the oil that leaks, as a control loop holds the piston or returns it.

    The balance then shows at least the leakage of the pump itself: the lower end of the 95 % interval of the leakage
    must exceed the fraction `held.least_leakage` (`priors.toml`) of the pump's mean flow.
    """
    min_fraction: float = INFERENCE.held.least_leakage
    return balance.conductance.low * balance.mean_pressure() > min_fraction * balance.mean_flow


class VolumeBalance:
    """Leak detector by a volume balance: flow of the pump that the piston's motion does not explain is leakage.

    It needs both chamber pressures, and one of these sets of channels:

    - the position, and the pump's angle, its speed, a flow meter or the command;
    - one of these channels without the position, if a loop brings the piston back or holds it (`without_position`);
    - behind a servo valve: position, command and the pressure of the supply; without the latter, leaks are measured
      only while shut valves hold the load;
    - only the position, if the held load creeps in the healthy recordings.
    """

    name, summary_type = VOLUME_BALANCE, BalanceSummary

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return the reason why a recording cannot be used for a volume balance; None if it can."""
        channels = frozenset(recording.channels)
        if not (equations(self.rig, channels) or circulation(self.rig, channels) or locked(self.rig, channels)):
            return f"needs {self.rig.circuit.needed_channels}"
        min_rate: float = INFERENCE.blocks.slowest
        if recording.rate < min_rate:
            return f"needs {min_rate:g} Hz or more, got {recording.rate:g} Hz: is the unit of the time right?"
        min_samples = min_samples_for_step(recording.rate)
        if len(recording) < min_samples:
            return f"needs {min_samples} samples or more at {recording.rate:g} Hz, got {len(recording)}"
        for name in ("x", *CHAMBERS):
            if name not in recording:
                continue
            values = recording[name][np.isfinite(recording[name])]
            if not values.size or values.min() == values.max():
                return f"{name} is constant or missing"
        return None

    def balance(self, recording: Recording, odds: MachineOdds = PRIOR_ODDS) -> RecordedBalance | None:
        """Set up the volume balance of a recording; return None if its channels or its length allow no balance.

        `odds`: what is known of the machine before this recording.
        """
        if not equations(self.rig, frozenset(recording.channels)):
            balance = self._balance_without_position(recording)
        elif odds.creep > 0.0 and (creeping := self._balance_of_creep(recording)) is not None:
            balance = creeping
        elif (recorded := self._compute_blocks(recording, odds.holds)) is None:
            return None
        else:
            recorded = recorded.with_sign_prior(np.asarray(odds.flow_sign))
            # a leak in this recording can look like open valves, so its evidence is limited
            regime = recorded.regime(float(VALVES._replace(prior=odds.valves).add([recorded.odds])))
            balance = self._build_balance(recording, regime, recorded.shut)
        return replace(balance, valves=Valves.SURELY_SHUT) if balance is not None and odds.is_valve_certain else balance

    def _balance_without_position(self, recording: Recording) -> RecordedBalance | None:
        """Choose the volume balance with the smallest upper bound of a leak, without a position or without a flow.

        It is one of a load behind shut valves, or of a pump that replaces the leakage (`compensates_leakage`). Return
        None if there is no such balance.
        """
        balances = compute_once(
            recording, (self.name, self.rig), lambda samples: cycle_balances(samples, self.rig), READ
        )
        candidates = (
            RecordedBalance(cycle.blocks, (cycle.equation,), (cycle.columns,), self.rig, recording, cycle.oil_loss)
            for cycle in balances
        )
        usable = (balance for balance in candidates if balance.flow is Flow.CREEP or compensates_leakage(balance))
        return min(usable, key=lambda balance: BalanceLeak(balance).bound_flow, default=None)

    def _balance_of_creep(self, recording: Recording) -> RecordedBalance | None:
        """Set up the volume balance of a load that creeps under a constant command, if no channel but u shows a flow.

        A command shows the flow of a pump only roughly, and that of a valve depends on the load as well. Return None if
        a flow is recorded, or if no load is held.
        """
        channels = frozenset(recording.channels)
        is_by_command = any(balance.flow is Flow.COMMAND for balance in equations(self.rig, channels))
        if not is_by_command or locked(self.rig, channels) is None:
            return None
        return self._balance_without_position(recording)

    def _learn_balance(self, recording: Recording) -> tuple[RecordedBalance | None, RecordedBlocks | None]:
        """Choose the balance of a healthy recording, which other recordings of its machine may choose otherwise.

        The second result is None if it is one without a position, or of a load that creeps (`_balance_of_creep`).
        """
        creeping = self._balance_of_creep(recording)
        if creeping is not None and creeping.creep_log_odds() > 0.0:
            return creeping, None
        recorded = self._compute_blocks(recording)
        if recorded is None:
            return self.balance(recording), None
        return self._build_balance(recording, recorded.open), recorded

    def _compute_blocks(self, recording: Recording, healthy_holds: HoldCounts | None = None) -> RecordedBlocks | None:
        """Compute the blocks for a volume balance with a position, once for each recording; None if it allows none.

        `healthy_holds`: holds of the healthy recordings, which count in an open circuit.
        """
        if not equations(self.rig, frozenset(recording.channels)):
            return None
        holds = healthy_holds if self.rig.circuit.feeds_one_chamber else None
        return compute_once(
            recording, (self.name, self.rig, holds), lambda samples: recorded_blocks(samples, self.rig, holds), READ
        )

    def _build_balance(
        self, recording: Recording, regime: RegimeBlocks, by_state: RegimeBlocks | None = None
    ) -> RecordedBalance:
        """Build the volume balance of a recording from its blocks for open or for shut valves while the pump rests.

        `by_state`: as in `RecordedBalance`.
        """
        return RecordedBalance(
            regime.blocks, regime.equations, regime.columns, self.rig, recording,
            plain=regime.plain, valves=regime.valves, by_state=by_state,
            delay_changes=regime.delay_changes, delay_tests=regime.delay_tests,
        )  # fmt: skip

    def learn(self, recording: Recording) -> BalanceSummary | None:
        """Summarise a healthy recording for later comparisons; None if it allows no volume balance."""
        balance, recorded = self._learn_balance(recording)
        if balance is None:
            return None
        summary = BalanceSummary(
            **vars(balance.recording_sums),
            terms=list(balance.columns[0].names),
            scale=balance.size.scale if balance.size.stated else 0.0,
            delivered=balance.blocks.moving_flow,
            stroke=None if balance.recorded_stroke is None else np.array(balance.recorded_stroke),
            creep_odds=balance.creep_log_odds() if balance.flow is Flow.CREEP else None,
            sign_log_odds=None if recorded is None else np.array(recorded.sign_log_odds),
            holds=None if recorded is None else np.array(recorded.holds, dtype=float),
        )
        if recorded is None or recorded.shut is None:
            return summary
        shut_balance = replace(self._build_balance(recording, recorded.shut), valves=Valves.SURELY_SHUT)
        shut = shut_balance.recording_sums
        return replace(
            summary,
            shut_sums=shut.sums,
            shut_odds=recorded.odds,
            held=shut.held,
            held_odds=shut_balance.locked_log_odds(balance.conductance),
            held_pump=shut.held_pump,
        )

    def predict_rise(self, summaries: Sequence[BalanceSummary], channels: frozenset[str], n_repeats: int = 1) -> Rise:
        """Predict the distribution of the rise [m^3/(s Pa)] that a healthy recording of a later day will seem to show.

        The rise is the leakage of a recording minus that of the healthy recordings with the given `summaries`
        (`learn`). The later recording is taken to have the Gram matrices of the first healthy one, and the median flow
        and pressure. `channels`: channels of the recordings; `n_repeats`: number of times that each healthy recording
        counts, as if it were repeated on later days.
        """
        odds = self._learn_odds(summaries, channels)
        columns = self._columns(channels, Valves.SHUT if odds.valves > 0.0 else Valves.OPEN, creeps=odds.creep > 0.0)
        healthy = [_fit_sums(summary, columns) for summary in summaries]
        repetitions = [replace(sums, start_s=_shift_start(sums, k)) for k in range(n_repeats) for sums in healthy]
        flow = float(np.median([summary.flow for summary in summaries]))
        pressure = float(np.median([summary.pressure for summary in summaries]))
        typical = replace(healthy[0], flow=flow, pressure=pressure, start_s=None, held=None)
        first_dated = next((sums for sums in healthy if sums.start_s is not None), typical)
        # after all repetitions; undated if no healthy recording has a date
        later_recording = replace(typical, start_s=_shift_start(first_dated, n_repeats))
        return rise(later_recording, repetitions, columns)

    def _learn_odds(self, summaries: Sequence[BalanceSummary], channels: frozenset[str]) -> MachineOdds:
        """Learn the odds of what is unknown about the machine from summaries of healthy recordings (`learn`).

        The right assumption on the valves also makes the estimated leakage scatter less: n recordings with rests
        (`MIN_FOR_SCATTER` or more) together add (n - 1) log(scatter if open / scatter if shut) to its log odds.
        """
        with_rests, log_ratio = [summary for summary in summaries if summary.shut_sums is not None], 0.0
        if len(with_rests) >= MIN_FOR_SCATTER:
            scatter = []
            for valves in (Valves.OPEN, Valves.SHUT):
                columns = self._columns(channels, valves)
                sums = [_fit_sums(summary, columns) for summary in with_rests]
                values = leak_deviations_from_mean(sums, columns)
                scatter.append(max(float(values.std(ddof=1)), np.finfo(float).tiny))
            log_ratio = (len(with_rests) - 1) * float(np.log(scatter[0] / scatter[1]))
        return MachineOdds.from_healthy(summaries, len(equations(self.rig, channels)), log_ratio)

    def _columns(self, channels: frozenset[str], valves: Valves, *, creeps: bool = False) -> list[ColumnRoles]:
        """Return the column roles of each volume balance of channels with a position, for open or shut `valves`.

        `creeps`: prefer the balance of a load that creeps, if the channels allow it.
        """
        balances = equations(self.rig, channels)
        if (creeps or not balances) and (hold_balance := locked(self.rig, channels)) is not None:
            balances = (hold_balance,)
        return [ColumnRoles(equation if valves is Valves.OPEN else shut_at_rest(equation)) for equation in balances]

    def observe(self, recording: Recording, baseline: Sequence[Healthy] = ()) -> Observed:
        """Test each term of a recording's volume balance for a step, measure the leakage, and report both.

        The leakage is compared with that of the healthy recordings in `baseline` whose balance has the same terms.
        Without a recorded flow of the pump, the creep of a load that valves hold shows the leakage. If the leakage
        cannot be measured, the report says what is missing.
        """
        summaries = healthy_summaries(self, baseline)
        odds = self._learn_odds(summaries, frozenset(recording.channels))
        balance = self.balance(recording, odds)
        has_flow, has_position = flow_source(recording.channels) is not None, "x" in recording
        if balance is None and (has_flow or not has_position):
            if equations(self.rig, frozenset(recording.channels)):
                return Observed(self.name, lack=f"finds the recording too short, {recording.duration:.3g} s")
            needed = f"; it needs {self.rig.circuit.needed_channels}" if has_position else ""
            return Observed(self.name, lack=_NO_BALANCE[has_position].format(recording.duration) + needed)
        # a balance without a flow (`Flow.CREEP`) shows the leakage only if no loop controls the position: a meter,
        # speed or command of the pump is recorded, or the load creeps in the healthy recordings as well
        if balance is None or (balance.flow is Flow.CREEP and not (has_flow or odds.creep > 0.0)):
            return Observed(self.name, lack=_NO_CREEP.format(self.rig.circuit.needed_channels))
        balance = replace(balance, known_stroke=_joint_stroke(summaries))
        # the summaries list the terms without those that only a balance for shut valves has
        names = [name for name in balance.columns[0].names if name not in (TURNING, HOLDING)]
        comparable = [summary for summary in summaries if summary.terms == names]
        healthy = [_fit_sums(summary, balance.columns) for summary in comparable]
        report = self._report(balance, healthy)
        if comparable or not summaries or report.lack:
            return report
        return replace(report, refusal="the channels of the healthy recordings give another balance of volumes")

    def observe_alone(self, recording: Recording, valves: Valves) -> Observed | None:
        """Report on a healthy recording without a baseline; None without a balance.

        `valves`: those that are assumed if the pump rests in the recording; without rests the report is the same.
        """
        balance, recorded = self._learn_balance(recording)
        if recorded is None:  # a balance without a position, or of a load that creeps, or None
            return None if balance is None else self._report(balance, ())
        regime = recorded.regime(-np.inf if valves is Valves.OPEN else np.inf)
        return compute_once(
            recording,
            (self.name, self.rig, "alone", regime is recorded.open),
            lambda samples: self._report(self._build_balance(samples, regime, recorded.shut), ()),
        )

    def _report(self, balance: RecordedBalance, healthy: Sequence[RecordingSums]) -> Observed:
        """Report on a volume balance: test results, leakage, and the judged part of the recording.

        The leakage is tested for a step within the recording and compared with that of the `healthy` recordings; in a
        single balance with a position, the motion (`compare_motion`) and the rivals of a leak (`rival_rises`) are, too.
        If neither is possible, the report states only the reason.
        """
        leak, rows = BalanceLeak(balance, healthy), balance.blocks.rows
        if leak.step is None and leak.rise is None:
            reason = "finds p_A and p_B too similar, or too few samples without gaps, to show a leak"
            return Observed(self.name, lack=reason)
        # a block with missing samples has fewer rows; but in a balance over cycles or holds (`without_position`) the
        # number of rows also depends on the motion, and the whole recording counts as judged; only a position gives the
        # balance of the cylinder, or two balances, one a chamber
        has_position = balance.has_position_and_flow
        share = float(rows.mean() / max(rows.max(), 1.0)) if has_position else 1.0
        # end of the last block with rows, over the number of blocks
        judged_until = (np.flatnonzero(rows > 0.0)[-1] + 1.0) / len(rows) if has_position and rows.any() else 1.0
        observables = balance.observables
        if healthy and has_position and balance.flow is not Flow.VALVE:
            observables += tuple(compare_motion(balance.recording_sums, healthy, balance.columns[0]))
            observables += rival_rises(
                balance.recording_sums,
                healthy,
                balance.columns,
                volume_ratio=balance.volume_ratio,
                unit_flows=balance.outside_unit_flows(),
            )
        return Observed(self.name, observables, leak, share=share, judged_until=float(judged_until))


def compare_motion(
    judged_sums: RecordingSums, healthy: Sequence[RecordingSums], roles: ColumnRoles
) -> Iterator[Observable]:
    """Test the ratio of the pump's flow, without leakage, to the piston's speed for a change from healthy recordings.

    Yields the result, or nothing for too few healthy recordings. A change means another machine, or another scale of a
    sensor. A load or speed outside of the healthy range makes the comparison less certain. `roles`: roles of the
    columns of the volume balance.
    """
    prior, healthy_sums = INFERENCE.repeats, np.sum([recording.sums[0] for recording in healthy], axis=0)
    # logarithm of the ratio over that of all healthy recordings together
    judged, *healthy_estimates = (
        Estimate(*motion_change(sums.sums[0], healthy_sums, roles)) for sums in (judged_sums, *healthy)
    )
    excess = sum(condition.log_excess for condition in find_unusual_conditions(judged_sums, healthy))
    observable = compare_estimates(
        name="motion",
        data="motion",
        judged=judged,
        healthy=healthy_estimates,
        prior=ScatterPrior(prior.scatter, prior.recordings, prior.inflation),
        further_deviation=INFERENCE.conditions.motion * excess,
    )
    if observable is not None:
        yield observable


def _joint_stroke(summaries: Sequence[BalanceSummary]) -> tuple[float, float] | None:
    """Return the ends of the motion in all recordings with the given `summaries` [m]; None if none has a position."""
    strokes = [summary.stroke for summary in summaries if summary.stroke is not None]
    return (float(min(low for low, _ in strokes)), float(max(high for _, high in strokes))) if strokes else None


def _shift_start(recorded: RecordingSums, n_ages: int) -> float | None:
    """Return the start of a recording [s since 1970], postponed by `n_ages` lives of a machine; None if undated.

    Copies with different `n_ages` thus count as recordings of different days.
    """
    return None if recorded.start_s is None else recorded.start_s + n_ages * _MAX_AGE_S


def _fit_sums(summary: BalanceSummary, columns: Sequence[ColumnRoles]) -> BalanceSummary:
    """Give a healthy recording the Gram matrices for the balances with the given `columns`.

    If these have columns for the leakage of a pump that valves cut off at rest, so have the Gram matrices; they are
    added here if the recording has no rests.
    """
    if TURNING not in columns[0].names:
        return summary
    shut = summary.shut_sums
    return replace(summary, sums=add_pump_columns(summary.sums, summary.terms) if shut is None else shut)
