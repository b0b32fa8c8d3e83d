"""Blocks of a volume balance of a recording, for valves that are open or shut while the pump rests (`regimes`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.balance_samples import (
    READ,
    bridged_samples,
    derive_drive_signals,
    without_flow,
    without_lowering,
)
from sealscope.diagnosis.inference.block_stream import MAX_BLOCK_TIME, MIN_BLOCK_TIME, BlockStream
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.delays import (
    DelayChange,
    DelayTest,
    SampleClock,
    align_samples,
    drop_delay_columns,
)
from sealscope.diagnosis.inference.equations.balances import (
    equations,
    find_rest_limits,
    shut_at_rest,
    with_delays,
    with_rests,
)
from sealscope.diagnosis.inference.equations.feed import FeedSums, HoldCounts, feed_one_chamber, flag_circulation
from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.inference.equations.terms import Equation, Flow
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.inference.pressure_offset import (
    area_mismatch,
    fit_pressure_offset,
    remove_pressure_offset,
)
from sealscope.diagnosis.inference.regimes import apply_regime, has_rests, shut_odds
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import flow_source
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

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
        """Return the blocks for shut valves if there are any and `odds`, their log odds, is positive; else for open."""
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
    has_holds = may_shut and _longest_hold(samples, recording.rate, balances[0]) >= INFERENCE.rest.lasting

    def compute_regime_blocks(offset: float, valves: Valves) -> Blocks:
        """Compute the blocks after subtracting `offset` [Pa] from p_A - p_B, for these `valves` at rest."""
        blocks = compute_blocks(offset)
        return apply_regime(blocks, columns, valves, has_holds=has_holds) if may_shut else blocks

    delays: dict[str, Any] = {"delay_changes": aligned.changes, "delay_tests": aligned.tests}
    # stated areas are exact, to within tolerances
    ratio_deviation: float = (
        INFERENCE.size.area if rig.states("cylinder.A_A", "cylinder.A_B") else INFERENCE.held_oil.sides_deviation
    )
    open_blocks = partial(compute_regime_blocks, valves=Valves.OPEN)
    open_regime = _build_regime(balances, open_blocks, ratio_deviation)._replace(**delays)
    if not may_shut or not has_rests(recorded, columns):
        return RecordedBlocks(open_regime, None, 0.0, stream.sign_log_odds, holds)
    shut_balances = tuple(shut_at_rest(balance) for balance in balances)
    shut = Valves.SURELY_SHUT if odds > INFERENCE.rest.locked else Valves.SHUT
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
