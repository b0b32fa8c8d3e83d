"""Two hypotheses on the valves while the pump rests: they connect it to the cylinder (open), or cut it off (shut).

With open valves, pump and piston leak at rest and in motion, and one coefficient describes both. With shut valves only
the piston leaks at rest. The pump's leakage while it moves the piston then has a second coefficient, and the pump's
flow offset counts in motion only. A pump may also turn slowly to hold the load for seconds, and is then connected. The
leakage of all these holds has a third coefficient within a recording; otherwise a drive that is switched off would look
like a leak that ends. Between recordings one coefficient is compared for all rests, since many machines show the
piston's leak only in such holds. If a flow meter measures the flow to the cylinder, only its flow tells motion from
rest. Both balances select from the same columns, so one set of Gram matrices serves both.

Let g be the leakage coefficient (of p_A - p_B) in motion and r the coefficient at rest, given the compliances in
motion; their covariance allows for errors that differ from block to block. With open valves r scatters about g; with
shut valves and a healthy piston, about zero:

    log odds = log N(r; 0, V_r + (s g)^2) - log N(r - g; 0, V_(r - g) + (w g)^2),

where V are the variances of the estimates, and s and w the prior scatters of r over g (`shut` and `open` of `[rest]` in
`priors.toml`). The odds of the recordings of one machine multiply. Since a leaking piston moves r towards g, the
healthy recordings decide (`volume_detector`).

Source: H. White, Econometrica 48 (1980) 817 (covariance where the errors differ).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.linear import Gaussian, solve
from sealscope.diagnosis.estimate.population import normal_log_density
from sealscope.diagnosis.inference.block_stream import MAX_BLOCK_TIME, MIN_BLOCK_TIME, BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.balances import (
    READ,
    FeedSums,
    bridged_samples,
    derive_drive_signals,
    equations,
    feed_one_chamber,
    find_rest_limits,
    flag_circulation,
    shut_at_rest,
    with_delays,
    with_rests,
    without_flow,
    without_lowering,
)
from sealscope.diagnosis.inference.equations.terms import (
    BIAS,
    HOLDING,
    LEAK,
    MOVING_BIAS,
    STATES,
    TURNING,
    Equation,
    Flow,
    Signals,
)
from sealscope.diagnosis.inference.hypotheses import HoldCounts, Valves
from sealscope.diagnosis.inference.sensor_errors import (
    DelayChange,
    DelayTest,
    SampleClock,
    align_samples,
    area_mismatch,
    drop_delay_columns,
    fit_pressure_offset,
    remove_pressure_offset,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import flow_source
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Fraction of the sum of squares of p_A - p_B below which a state of the machine does not occur, but for rounding.
NEGLIGIBLE = 1e-6
#: Least number of blocks with motion, and without, for an estimate of the leakage of either state.
MIN_STATE_BLOCKS = 2


def apply_regime(blocks: Blocks, roles: ColumnRoles, valves: Valves, *, has_holds: bool) -> Blocks:
    """Convert blocks to the volume balance for `valves` that are open, or shut, while the pump rests.

    `roles` includes the columns `STATES` that `balances.with_rests` adds.

    - Open valves: the columns `STATES` are dropped from the Gram matrices.
    - Shut valves: the column of the flow offset in motion (`MOVING_BIAS`) replaces that of the flow offset at all times
      (`BIAS`). The column `HOLDING`, the leakage of a pump that turns only to hold the load, remains if some hold lasts
      for seconds (`has_holds`) and the pump is off at other times. Otherwise it is set to zero, and the leak's
      coefficient describes the holds as well.

    If all holds are short and the pump is off at other times, the machine is a press, whose pump builds up the pressure
    through open valves in these holds. If its valves are certainly shut at rest (`Valves.SURELY_SHUT`), holds count as
    motion: the column `HOLDING` is added to the column `TURNING` before it is set to zero.
    """
    names = (*roles.names, "left")  # the last column is the left side of the balance
    if valves is Valves.OPEN:
        columns = [k for k, name in enumerate(names) if name not in STATES]
        return replace(blocks, gram=np.asarray(blocks.gram[..., columns, :][..., columns]))
    moving_bias, turning, holding = (names.index(name) for name in (MOVING_BIAS, TURNING, HOLDING))
    columns = [moving_bias if name == BIAS else k for k, name in enumerate(names) if name != MOVING_BIAS]
    gram = blocks.gram.copy()
    is_always_on = _rest_share(blocks, roles, TURNING, HOLDING) < NEGLIGIBLE  # the pump moves or holds the load
    if valves is Valves.SURELY_SHUT and not is_always_on and not has_holds:
        gram[..., turning, :] += gram[..., holding, :]
        gram[..., turning] += gram[..., holding]
    if not has_holds or is_always_on:
        gram[..., holding, :] = gram[..., holding] = 0.0
    return replace(blocks, gram=np.asarray(gram[..., columns, :][..., columns]))


def add_pump_columns(gram: Array, names: Sequence[str]) -> Array:
    """Add the columns of a pump that is cut off at rest to Gram matrices (E, m, m) of a recording without rests.

    The two new columns precede the column of the leak: `TURNING`, the leakage of the turning pump, and `HOLDING`, that
    of a pump that only holds the load. Without rests the first equals the column of the leak, and the second is zero.
    `names` (m - 1,): names of the old columns without the left side. The result has the shape (E, m + 2, m + 2).
    """
    leak = names.index(LEAK)
    index = [*range(len(names) + 1)]
    index[leak:leak] = [leak, leak]  # two copies of the leak's column in front of it
    expanded = np.asarray(gram[:, index][:, :, index])
    holding = leak + 1
    expanded[:, holding] = expanded[:, :, holding] = 0.0
    return expanded


def _rest_share(blocks: Blocks, roles: ColumnRoles, *states: str) -> float:
    """Compute the fraction of the sum of squares of p_A - p_B outside the given states of the machine.

    `states`: names of columns that equal p_A - p_B in one state and 0 otherwise, such as `TURNING` (pump in motion).
    """
    leak, *columns = (roles.names.index(name) for name in (LEAK, *states))
    energies = np.diagonal(blocks.gram[:, 0], axis1=1, axis2=2).sum(axis=0)
    return float(1.0 - energies[columns].sum() / max(energies[leak], np.finfo(float).tiny))


def shut_odds(blocks: Blocks, roles: ColumnRoles) -> float:
    """Compute the log odds that valves cut the pump off from the cylinder while the pump rests (`rest_log_odds`).

    `roles` includes the columns of `balances.with_rests`. All coefficients are estimated from blocks with motion; then
    leakage and flow offset at rest are estimated from the other blocks, given all other coefficients. A single
    regression could make both leakage and compliance zero at rest, since the rate at which the pressures relax shows
    only their ratio. With the columns X of leakage and flow offset at rest, the left side y, the other columns Z and
    their coefficients b in motion, the leakage r at rest is the first of

        (X'X)^-1 X'(y - Z b),    variance = White's variance + J cov(b) J' + k^2 sum (J_c b_c)^2,

    where J = d r/db is the first row of -(X'X)^-1 X'Z, and the sum is over the compliances c. This sum allows for a
    relative error k = `rest.compliance_error` (`priors.toml`) of each compliance, which air in the oil makes larger at
    low pressures. It vanishes if the pressures stay the same at rest, for example because a pump replaces the leaking
    oil. The result is 0 if fewer than `MIN_STATE_BLOCKS` blocks are in motion or at rest, or if a variance is not
    positive.
    """
    gram, left = blocks.gram[:, 0], roles.left
    turning, holding, moving_bias = (roles.names.index(name) for name in (TURNING, HOLDING, MOVING_BIAS))
    energies = np.diagonal(gram, axis1=1, axis2=2)
    is_rest = energies[:, turning] + energies[:, holding] <= NEGLIGIBLE * energies[:, roles.leak]
    if min(np.count_nonzero(is_rest), np.count_nonzero(~is_rest)) < MIN_STATE_BLOCKS:
        return 0.0
    columns = [*roles.nuisance, turning, holding, moving_bias]
    coefficients, covariance = fit_with_robust_covariance(gram[~is_rest], columns, left)
    # in motion the leakage is the sum of the leak's coefficient and that of the turning pump
    in_motion = [columns.index(roles.leak), columns.index(turning)]
    # leakage and flow offset, which are fitted to the rests alone
    rest_columns = [column for column in (roles.leak, roles.bias) if column is not None]
    shared = [k for k, column in enumerate(columns) if column not in (*rest_columns, turning, holding, moving_bias)]
    shared_columns = [columns[k] for k in shared]
    # transform that subtracts the shared columns, times their coefficients, from the left side
    residual = np.eye(left + 1)
    residual[shared_columns, left] = -coefficients[shared]
    rest_gram = residual.T @ gram[is_rest] @ residual
    rest, rest_covariance = fit_with_robust_covariance(rest_gram, rest_columns, left)
    total = rest_gram.sum(axis=0)
    normal, coupling = total[np.ix_(rest_columns, rest_columns)], total[np.ix_(rest_columns, shared_columns)]
    sensitivity = -solve(normal, coupling)[0]  # derivatives of the leakage at rest by the shared coefficients
    by_compliance = (sensitivity * coefficients[shared])[np.isin(shared_columns, roles.compliance)]
    rest_variance = float(rest_covariance[0, 0] + INFERENCE.rest.compliance_error**2 * (by_compliance @ by_compliance))
    rest_variance += float(sensitivity @ covariance[np.ix_(shared, shared)] @ sensitivity)
    motion_variance = float(covariance[np.ix_(in_motion, in_motion)].sum())
    common = float(sensitivity @ covariance[np.ix_(shared, in_motion)].sum(axis=1))  # covariance of r and g
    motion = float(coefficients[in_motion].sum())
    difference_variance = rest_variance + motion_variance - 2.0 * common
    if not (rest_variance > 0.0 and difference_variance > 0.0):
        return 0.0
    return rest_log_odds(float(rest[0]), motion, rest_variance=rest_variance, difference_variance=difference_variance)


def rest_log_odds(rest: float, motion: float, *, rest_variance: float, difference_variance: float) -> float:
    """Compute the log odds that the leakage at rest is about zero rather than about equal to the leakage in motion.

    With the leakage r = `rest` at rest, the leakage g = `motion` in motion, and the normal density N(x; variance),

        log odds = log N(r; rest_variance + (s g)^2) - log N(r - g; difference_variance + (w g)^2),

    limited to +-`rest.odds_limit` (`priors.toml`). The variances are those of the errors of r and of r - g; s and w are
    the prior scatters of r relative to g (`rest.leakage_if_shut` and `rest.scatter_if_open`). All leakages are
    conductances [m^3/(s Pa)], or all are flows [m^3/s].
    """
    prior = INFERENCE.rest
    if_shut = normal_log_density(rest, rest_variance + (prior.leakage_if_shut * motion) ** 2)
    if_open = normal_log_density(rest - motion, difference_variance + (prior.scatter_if_open * motion) ** 2)
    return float(np.clip(if_shut - if_open, -prior.odds_limit, prior.odds_limit))


def fit_with_robust_covariance(gram: Array, columns: list[int], left: int) -> tuple[Array, Array]:
    """Fit coefficients (c,) by least squares, with White's covariance (c, c) for errors that differ between K blocks.

    `gram` (K, m, m): Gram matrix of each of K > 1 blocks; `columns`, `left`: indices of the columns to fit and of the
    left side.
    """
    grams, moments = gram[:, columns][:, :, columns], gram[:, columns, left]
    fit = Gaussian(grams.sum(axis=0), moments.sum(axis=0))
    coefficients = fit.mean
    scores = moments - grams @ coefficients  # (K, c), products of the residual with the columns
    return coefficients, fit.robust_covariance(scores.T @ scores * (len(grams) / (len(grams) - 1.0)))


_BLOCKS = INFERENCE.blocks
#: Sensor offset of p_A - p_B [standard deviations of its prior] from which the terms are computed again without it,
#: since the root of p_A - p_B and the side that carries the load do not depend on the offset linearly.
NEGLIGIBLE_OFFSET = 1.0


class RegimeBlocks(NamedTuple):
    """Blocks of a recording under one assumption on the valves while the pump rests.

    - `blocks`, `plain`: the blocks after removal of the sensor offset of p_A - p_B, and with p_A - p_B as recorded;
    - `equations`: the volume balances; `columns`: the roles of their columns;
    - `valves`: the assumption;
    - `delay_changes`: changes of channels' delays that were removed before; `delay_tests`: tests for them.
    """

    blocks: Blocks
    plain: Blocks
    equations: tuple[Equation, ...]
    columns: tuple[ColumnRoles, ...]
    valves: Valves = Valves.OPEN
    delay_changes: tuple[DelayChange, ...] = ()
    delay_tests: tuple[DelayTest, ...] = ()

    def reverse_flow(self, is_reversed: NDArray[np.bool_]) -> RegimeBlocks:
        """Reverse the sign of the left side, a recorded flow, in each balance that is flagged in `is_reversed` (E,)."""
        signs = np.ones((len(self.columns), self.blocks.gram.shape[-1]))
        signs[is_reversed, -1] = -1.0  # the left side is the last column
        factors = signs[:, :, None] * signs[:, None, :]  # of products of two columns
        blocks, plain = (replace(series, gram=series.gram * factors) for series in (self.blocks, self.plain))
        return self._replace(blocks=blocks, plain=plain)


class RecordedBlocks(NamedTuple):
    """Blocks of a recording under both assumptions on the valves while the pump rests (`regimes`).

    `open`: the pump stays connected to the cylinder; `shut`: valves cut it off, None if the machine never rests or the
    balance does not allow this case; `odds`: log odds that valves cut it off, 0 if `shut` is None. `sign_log_odds`
    (E,): log odds of each balance that the recorded flow has the right sign; the blocks have the more probable sign.
    `holds`: holds of an open circuit.
    """

    open: RegimeBlocks
    shut: RegimeBlocks | None
    odds: float
    sign_log_odds: tuple[float, ...]
    holds: HoldCounts = HoldCounts()

    def with_sign_prior(self, log_odds: Array) -> RecordedBlocks:
        """Reverse the flows whose more probable sign changes when the evidence of other recordings is added.

        `log_odds` (E,): log odds from other recordings that each balance's recorded flow has the right sign. The field
        `sign_log_odds` stays unchanged.
        """
        recorded = np.array(self.sign_log_odds)
        is_reversed = (recorded >= 0.0) != (recorded + log_odds >= 0.0)
        if not is_reversed.any():
            return self
        shut = None if self.shut is None else self.shut.reverse_flow(is_reversed)
        return self._replace(open=self.open.reverse_flow(is_reversed), shut=shut)

    def regime(self, odds: float) -> RegimeBlocks:
        """Choose the blocks for shut valves if there are any and their log `odds` are positive, else those for open."""
        return self.shut if self.shut is not None and odds > 0.0 else self.open


def recorded_blocks(recording: Recording, rig: Rig, healthy_holds: HoldCounts | None = None) -> RecordedBlocks | None:
    """Compute the blocks of a recording for the volume balances of the machine, for open and for shut valves.

    `healthy_holds`: holds of the healthy recordings of an open circuit.

    Shut valves are considered only if a channel gives the pump's flow and the machine rests at times. Return None if
    the channels of the recording allow no balance, or if the recording is too short.
    """
    names = frozenset(name for name in recording.channels if name in READ)
    balances = equations(rig, names)
    if not balances:
        return None
    source = flow_source(names)
    # only a recorded flow of a pump shows whether valves cut the pump off
    may_shut = balances[0].flow in (Flow.PUMP, Flow.METER)
    channels = {"x", "p_A", "p_B", str(source)}  # no channel is named "None"
    channels |= {name for balance in balances for term in balance.terms for name in term.needs}
    samples = bridged_samples(recording, channels)
    if balances[0].flow is Flow.COMMAND:
        samples = derive_drive_signals(samples, rig, recording.rate)
    holds = HoldCounts()
    if may_shut:
        samples = without_lowering(samples, recording.rate, balances[0])
        if rig.circuit.feeds_one_chamber:
            limits = find_rest_limits(samples, recording.rate, balances[0])
            signals = Signals(samples, recording.rate, rest_limits=limits)
            sums = FeedSums.measure(balances[0], signals)
            balances = (feed_one_chamber(balances[0], sums.find_feed(balances[0].area_ratio)),)
            circulates = flag_circulation(balances[0], signals, sums.mean_flow, healthy_holds)
            holds = HoldCounts.measure(signals.holding(balances[0].left) > 0.0, circulates, recording.rate)
            samples = without_flow(samples, circulates)
    stream_balances = tuple(with_rests(balance) for balance in balances) if may_shut else balances
    start = float(recording.t[0])
    block_s = min(MAX_BLOCK_TIME, max(MIN_BLOCK_TIME, recording.duration / _BLOCKS.blocks))  # length of a block
    make_stream = partial(BlockStream, rate=recording.rate, block_s=block_s, n_first=None, start=start)
    delay_balances = tuple(map(with_delays, stream_balances))
    stream = make_stream(delay_balances)
    with_delay_columns = stream.push(samples, last=True)
    if with_delay_columns is None:
        return None

    def compute_with_delay_columns(shifted: Mapping[str, Array]) -> Blocks | None:
        """Compute the blocks of samples of which a channel was shifted, with the columns of delays."""
        return make_stream(delay_balances, left_signs=stream.left_signs).push(shifted, last=True)

    clock = SampleClock(
        recording.rate, start, flow_channel="omega" if balances[0].flow is Flow.COMMAND else source or ""
    )
    aligned = align_samples(samples, with_delay_columns, compute_with_delay_columns, stream.columns, clock)
    samples = dict(aligned.samples)
    recorded = drop_delay_columns(aligned.blocks, stream.columns[0])

    @cache
    def compute_blocks(offset: float) -> Blocks:
        """Compute the blocks after subtracting `offset` [Pa] from p_A - p_B."""
        if not offset:
            return recorded
        blocks = make_stream(stream_balances, offset=offset, left_signs=stream.left_signs).push(samples, last=True)
        assert blocks is not None  # as many samples as for `recorded`
        return blocks

    columns = ColumnRoles(stream_balances[0])
    odds = shut_odds(recorded, columns) if may_shut else 0.0
    has_holds = may_shut and _longest_hold(samples, recording.rate, balances[0]) >= INFERENCE.rest.shortest_hold

    def compute_regime_blocks(offset: float, valves: Valves) -> Blocks:
        """Compute the blocks after subtracting `offset` [Pa] from p_A - p_B, for these `valves` at rest."""
        blocks = compute_blocks(offset)
        return apply_regime(blocks, columns, valves, has_holds=has_holds) if may_shut else blocks

    delays: dict[str, Any] = {"delay_changes": aligned.changes, "delay_tests": aligned.tests}
    # stated areas are exact, to within tolerances
    ratio_deviation: float = (
        INFERENCE.size.area
        if rig.states("cylinder.A_A", "cylinder.A_B")
        else INFERENCE.held_oil.log_area_ratio_deviation
    )
    open_blocks = partial(compute_regime_blocks, valves=Valves.OPEN)
    open_regime = _build_regime(balances, open_blocks, ratio_deviation)._replace(**delays)
    if not may_shut or not (_rest_share(recorded, columns, TURNING) > NEGLIGIBLE):
        return RecordedBlocks(open_regime, None, 0.0, stream.sign_log_odds, holds)
    shut_balances = tuple(shut_at_rest(balance) for balance in balances)
    shut = Valves.SURELY_SHUT if odds > INFERENCE.rest.sure_odds else Valves.SHUT
    shut_blocks = partial(compute_regime_blocks, valves=shut)
    shut_regime = _build_regime(shut_balances, shut_blocks, ratio_deviation)._replace(valves=Valves.SHUT, **delays)
    return RecordedBlocks(open_regime, shut_regime, odds, stream.sign_log_odds, holds)


def _longest_hold(samples: Mapping[str, Array], rate: float, balance: Equation) -> float:
    """Find the longest time [s] for which the piston rests while the pump turns to hold a load; 0 if it never does.

    `samples`, `rate`, `balance`: as in `without_lowering`.
    """
    signals = Signals(samples, rate, rest_limits=find_rest_limits(samples, rate, balance))
    _, lengths = find_runs(signals.holding(balance.left) > 0.0).T  # [samples]
    return float(lengths.max(initial=0)) / rate


def _build_regime(
    balances: tuple[Equation, ...], compute_blocks: Callable[[float], Blocks], ratio_deviation: float
) -> RegimeBlocks:
    """Compute the blocks of the volume balances, both as recorded and without the sensor offset of p_A - p_B.

    `compute_blocks(offset)` computes the blocks after subtracting an offset [Pa] from p_A - p_B. The estimated offset
    is removed from the Gram matrices, which assumes terms that are linear in it. If it exceeds `NEGLIGIBLE_OFFSET`
    standard deviations of its prior, the blocks are computed again after subtracting it, and the error that remains
    is estimated and removed. Such an offset is replaced by the best smaller one if the areas of the piston speak
    against it (`area_mismatch`, with `ratio_deviation`).
    """
    columns = tuple(ColumnRoles(balance) for balance in balances)
    plain = compute_blocks(0.0)  # as recorded
    fit = fit_pressure_offset(plain, columns)
    blocks, offset, negligible = fit.blocks, float(fit.blocks.zero[0]), NEGLIGIBLE_OFFSET * INFERENCE.zero.pressure
    if abs(offset) >= negligible:
        blocks = remove_pressure_offset(compute_blocks(offset), columns)
        mismatch, plain_mismatch = (
            area_mismatch(series, columns, balances[0], ratio_deviation) for series in (blocks, plain)
        )
        if fit.log_posterior < 0.5 * (mismatch - plain_mismatch):
            blocks = fit_pressure_offset(plain, columns, max_offset=negligible).blocks
    return RegimeBlocks(blocks.merge(), plain.merge(), balances, columns)
