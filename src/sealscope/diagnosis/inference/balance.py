"""Blocks of a volume balance from the samples of a whole recording or of a stream.

A block is a few seconds of samples, reduced to Gram matrices of a linear regression (`blocks.Blocks`). `BlockStream`
computes the blocks of a live stream, `recorded_blocks` those of a whole recording, for valves that are open or shut
while the pump rests (`regimes`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.control.drive import Drive
from sealscope.diagnosis.estimate.change import MIN_BLOCKS
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, Weighting, sorted_part_means
from sealscope.diagnosis.inference.delays import (
    DelayChange,
    DelayTest,
    SampleClock,
    align_samples,
    drop_delay_columns,
)
from sealscope.diagnosis.inference.equations.balances import (
    equations,
    is_separate_at_rest,
    shut_at_rest,
    with_delays,
    with_rests,
)
from sealscope.diagnosis.inference.equations.feed import FeedSums, HoldCounts, feed_one_chamber, flag_circulation
from sealscope.diagnosis.inference.equations.signals import (
    AVERAGING_TIME,
    HALF_DIFFERENCE,
    MIN_ABSOLUTE_PRESSURE,
    MIN_REST,
    LoweringLimits,
    RestLimits,
    Signals,
    extend_flags,
    find_rests,
)
from sealscope.diagnosis.inference.equations.terms import MOVING_BIAS, START, Equation, Flow
from sealscope.diagnosis.inference.hypotheses import Valves
from sealscope.diagnosis.inference.pressure_offset import (
    area_mismatch,
    fit_pressure_offset,
    remove_pressure_offset,
)
from sealscope.diagnosis.inference.regimes import apply_regime, has_rests, shut_odds
from sealscope.diagnosis.inference.rows import flow_sign
from sealscope.diagnosis.inference.rows.row_weights import SD_PER_MEDIAN, SUPPORT
from sealscope.diagnosis.inference.rows.weak_form import (
    SPAN,
    stride_samples,
    strides_in,
    weak_form_rows,
    weights_near_holes,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.corrections.gaps import flag_holes
from sealscope.recordings.corrections.unsigned import UNSIGNED, is_one_sided, is_two_way, restore_flow
from sealscope.recordings.motion import find_runs
from sealscope.recordings.quality import find_rails
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.smoothing import average_over
from sealscope.storage.plain_state import SavedAttributes, plain_array, require_part, restore_array
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_BLOCKS = INFERENCE.blocks
#: Maximum and minimum length of a block [s].
MAX_BLOCK_TIME: float = _BLOCKS.longest
MIN_BLOCK_TIME: float = _BLOCKS.shortest
#: Sensor offset of p_A - p_B [standard deviations of its prior] from which the terms are computed again without it,
#: since the root of p_A - p_B and the side that carries the load do not depend on the offset linearly.
NEGLIGIBLE_OFFSET = 1.0
#: Channels that balances read.
READ = ("u", "theta", "omega", *METERS, "x", "p_1", "p_2", "p_A", "p_B")
#: Name of a signal that is 1 in holes (long gaps of missing samples that were filled in), else 0; absent without holes.
HOLE = "hole"
#: Name of p_A - p_B as recorded, among the samples of a recording in which pressures are clipped.
CLIPPED_DIFFERENCE = "p_A - p_B, clipped"
#: Limit of a rest for a pump or piston that never counts as resting: no speed is below it.
NEVER = -1.0
#: Quantile of the magnitudes of speeds up to which they count in a mean: glitches are rarer than motion.
SPEED_QUANTILE = 0.999
#: Time over which samples tell whether an interval belongs to a motion past the resting pump (`flag_lowering`), beyond
#: that for rests [s]: a window, and twice the time by which flags are extended. A longer pause is cut at its ends.
LOWERING_MARGIN = MIN_REST + 2.0 * AVERAGING_TIME
#: Number of samples whose increments are computed together, so that they stay in the processor's cache.
BATCH_SAMPLES = 8192
#: Samples by channel, and the index of the first one, counted from the beginning of a stream.
Piece = tuple[dict[str, Array], int]


class BlockStream(SavedAttributes):
    """Division of a stream of samples into blocks, each reduced to Gram matrices of the volume balance.

    The blocks do not depend on how many samples arrive at a time, unless `n_first` is None.

    - `balances`: volume balances of the machine (`balances.equations`); `rate`: sampling rate [Hz].
    - `block_s`: length of a block [s], rounded to whole strides of the weak form.
    - `n_first`: number of first blocks whose rows are weighted together; None for all blocks of the first `push`.
    - `start`: time of the first sample [s]; `offset`: sensor offset [Pa] that is subtracted from p_A - p_B.
    - `left_signs`: factor on the left side of each balance, -1 if the recorded flow has the wrong sign, else 1; empty
      to estimate the factors. The left sides of a stream (`n_first` not None) stay as recorded: the factors are then
      those of all blocks up to the first that surely move, after which `has_signs` is true.
    - `on_samples`: called with the start time [s] and the samples of each block.
    - `flow_channel`: channel of the pump's flow if the samples come as recorded: a flow without a sign gets one
      (`corrections.unsigned`), and is left out while the piston moves past the resting pump (`flag_lowering`).
    - `feeds_one_chamber`: with `flow_channel`, the circuit is open; the only balance is adapted to what the blocks so
      far show of it, and a flow that circulates is left out (`equations.feed`). `n_meanings` counts how often its terms
      or the sign have changed their meaning.
    """

    SAVED = (
        *("_begin", "_first", "_n_closed", "_absolute_offsets", "left_signs", "has_signs"),
        *(
            "_rest_limits",
            "_weighting",
            "_sign_evidence",
            "_feed_sums",
            "_flow_range",
            "n_meanings",
            "_lowering_limits",
        ),
    )
    SAVED_TYPES: ClassVar = {
        "_absolute_offsets": dict[str, float],
        "left_signs": tuple[float, ...],
        "_rest_limits": RestLimits,
        "_lowering_limits": LoweringLimits,
    }

    def __init__(
        self,
        balances: Sequence[Equation],
        rate: float,
        block_s: float = MAX_BLOCK_TIME,
        n_first: int | None = SUPPORT,
        start: float = 0.0,
        offset: float = 0.0,
        left_signs: tuple[float, ...] = (),
        on_samples: Callable[[float, Mapping[str, Array]], None] | None = None,
        flow_channel: str = "",
        feeds_one_chamber: bool = False,
    ) -> None:
        self._on_samples, self._flow_channel, self._feeds_one_chamber = on_samples, flow_channel, feeds_one_chamber
        self.columns = tuple(ColumnRoles(balance) for balance in balances)
        self._balances, self._rate, self._offset = balances, rate, offset
        self._stride = stride_samples(rate)
        self._strides_per_block = strides_in(block_s, rate)
        self._length = self._strides_per_block * self._stride  # samples in a block
        # samples on either side of a block on which its speeds and rests depend; 2 for differences of neighbours
        self._margin = max(1, round(HALF_DIFFERENCE * rate)) + 2
        self._drops_rests = is_separate_at_rest(balances[0])
        has_rest_terms = self._drops_rests or any(MOVING_BIAS in columns.names for columns in self.columns)
        self._finds_rests = has_rest_terms or bool(flow_channel)
        if self._finds_rests or feeds_one_chamber:  # some terms differ at rest
            self._margin += round(AVERAGING_TIME * rate) + round(MIN_REST * rate)
        if flow_channel:
            self._margin += math.ceil(LOWERING_MARGIN * rate)
        if self._drops_rests:  # rows within the length of a test function from motion count
            self._margin += SPAN * self._stride
        self._n_first, self.n_meanings = n_first, 0
        self.has_lowered = False  # True once the piston has moved past the resting pump
        self.sign_log_odds: tuple[float, ...] = ()  # log odds that recorded signs are right, from the first blocks
        self.forget()
        self.left_signs, self.has_signs = left_signs, bool(left_signs)
        self.restart(start)

    def forget(self) -> None:
        """Forget what the blocks so far have told of the machine; their weights, too, do not affect later blocks."""
        self._used_balances = tuple(self._balances)  # adapted to an open circuit, if it is one
        self._rest_limits: RestLimits | None = None  # known after the first motion
        self._lowering_limits: LoweringLimits | None = None  # of all blocks so far
        self._sign_evidence = SignEvidence(self._balances, self.columns)
        self._feed_sums = FeedSums()
        self.left_signs, self.has_signs = tuple[float, ...](), False
        self._flow_range = (0.0, 0.0)  # lowest and highest value of the flow's channel
        self._weighting = Weighting(self.columns)
        self._absolute_offsets: dict[str, float] | None = None  # absolute minus gauge pressure [Pa] by channel

    def restart(self, begin: float) -> None:
        """Restart the stream after a gap, at the time `begin` [s] of the next sample, and drop an incomplete block.

        Pressure offsets, signs and weights that earlier samples determined are kept.
        """
        self._begin = begin
        self._pieces: list[Mapping[str, Array]] = []  # joined only when they complete a block
        self._first = 0  # index of the first stored sample, counted from `begin`
        self._end = 0  # index past the last stored sample
        self._n_closed = 0  # number of blocks computed since `begin`

    def push(self, samples: Mapping[str, Array], last: bool = False) -> Blocks | None:
        """Add samples of the stream and return the blocks that they complete; None if they complete none.

        `samples`: arrays by channel name, NaN where missing, or empty to add none; `last`: true if no samples follow.
        The first `n_first` blocks are returned together. A block is complete when it is followed by the samples on
        which its rows, speeds and rests depend. With `last` true, the samples for its rows suffice, and fewer than
        `n_first` blocks may be returned.
        """
        if samples:
            self._pieces.append(samples)
            self._end += len(next(iter(samples.values())))
        # samples needed after a block: those of its last rows, and a margin for its speeds and rests
        tail = (SPAN - 1) * self._stride + 1 + (0 if last else self._margin)
        n_complete = max(0, (self._end - tail) // self._length)
        is_waiting = not (last or self._weighting.has_blocks)  # until the first `n_first` blocks are complete
        min_blocks = (self._n_first or 1) if is_waiting else 1
        if n_complete < self._n_closed + min_blocks:
            return None
        joined = self._join_pieces()
        # groups of blocks whose rows are weighted together, by the index past their last block
        group_ends = [n_complete]
        if self._n_first is not None:  # the first blocks in one group, later ones one by one
            n_together = 1 if self._weighting.has_blocks else self._n_first
            first_end = min(self._n_closed + n_together, n_complete)
            group_ends = list(range(first_end, n_complete + 1))
        groups = zip([self._n_closed, *group_ends[:-1]], group_ends, strict=True)
        blocks = Blocks.join([self._build_blocks(joined, first, end) for first, end in groups])
        self._n_closed = n_complete
        first_stored = max(0, n_complete * self._length - self._margin)  # later blocks need these samples
        self._pieces = [{name: values[first_stored - self._first :].copy() for name, values in joined.items()}]
        self._first = first_stored
        return blocks

    def _join_pieces(self) -> dict[str, Array]:
        """Join the stored samples of several calls of `push` to one array for each channel, by its name."""
        if len(self._pieces) == 1:  # a whole recording: no copy
            return dict(self._pieces[0])
        names = self._pieces[0] if self._pieces else ()
        return {name: np.concatenate([piece[name] for piece in self._pieces]) for name in names}

    def state(self) -> dict[str, Any]:
        """Return the state of the stream as plain values for JSON, from which `load_state` continues."""
        return {
            **super().state(),
            "samples": {name: plain_array(values) for name, values in self._join_pieces().items()},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore what `state` returned; raise InputError if the values do not fit the balances of this stream."""
        super().load_state(state)
        samples = require_part(state, "samples", Mapping)
        self._pieces = [{name: restore_array(values, name) for name, values in samples.items()}] if samples else []
        # the shortest array, should the lengths in a saved state differ
        self._end = self._first + min((len(values) for piece in self._pieces for values in piece.values()), default=0)

    def _signals(self, samples: Mapping[str, Array]) -> Signals:
        """Make the signals of samples, arrays by channel name, with what earlier samples told of the machine."""
        return Signals(
            samples, self._rate, to_absolute=self._absolute_offsets, offset=self._offset, rest_limits=self._rest_limits
        )

    def _learn_limits(self, samples: Mapping[str, Array]) -> None:
        """Find the speeds at which the machine rests, or raise those of earlier samples, which may be all at rest."""
        if self._finds_rests:
            limits = find_rest_limits(samples, self._rate, self._balances[0])
            self._rest_limits = _raise_limits(limits, self._rest_limits)

    def _learn_flow(self, samples: Mapping[str, Array], first: int, end: int) -> Piece | None:
        """Add the blocks `first` to `end` - 1 to what is known of the pump's flow: its sign, and an open circuit.

        A flow without a sign counts with one from the first blocks on that show the piston moving both ways. Returns
        the samples of `_with_margins`, None if the sign of their flow no longer holds.
        """
        (balance,) = self._balances
        was_unsigned, feed_before = self.is_unsigned, self._feed_sums.find_feed(balance.area_ratio)
        piece, begin = self._with_margins(samples, first, end)
        signals = self._signals(piece)
        span = slice(first * self._length - begin, end * self._length - begin)
        self._feed_sums = self._feed_sums.add(FeedSums.measure(balance, signals, span))
        recorded = samples[self._flow_channel][first * self._length - self._first : end * self._length - self._first]
        self._flow_range = (
            min(self._flow_range[0], float(np.nanmin(recorded, initial=0.0))),
            max(self._flow_range[1], float(np.nanmax(recorded, initial=0.0))),
        )
        if self.is_unsigned != was_unsigned:
            # what earlier blocks told of the sign is of no use
            self._feed_sums = self._feed_sums._replace(work=abs(self._feed_sums.work))
            self._sign_evidence, self.has_signs = SignEvidence(self._balances, self.columns), False
        feed = self._feed_sums.find_feed(balance.area_ratio)
        if self._feeds_one_chamber:
            self._used_balances = (feed_one_chamber(balance, feed),)
        feeds_as_before = not self._feeds_one_chamber or feed == feed_before
        self.n_meanings += self.is_unsigned != was_unsigned or not feeds_as_before
        return None if was_unsigned or self.is_unsigned else (piece, begin)

    @property
    def is_unsigned(self) -> bool:
        """True if the pump's flow stays on one side of zero while the piston moves both ways."""
        has_one_sign = self._flow_channel in UNSIGNED and is_one_sided(*self._flow_range)
        return has_one_sign and is_two_way(*self._feed_sums.ways)

    def _restore_sign(self, samples: Mapping[str, Array]) -> dict[str, Array]:
        """Restore the sign of the pump's flow, if it has none; each block by its samples with margins."""
        if not self.is_unsigned:
            return dict(samples)
        # flow [m^3/s] of one unit of the channel
        unit = float(self._balances[0].left(Signals({self._flow_channel: np.ones(2)}, self._rate))[0]) * self._rate
        out, inward = self._feed_sums.flow_per_speed
        difference = samples["p_A"] - samples["p_B"]
        values = samples[self._flow_channel]
        signed = restore_flow(values, samples["x"], difference, self._rate, (out / unit, inward / unit))
        return {**samples, self._flow_channel: signed}

    def _build_blocks(self, samples: Mapping[str, Array], first: int, end: int) -> Blocks:
        """Compute the blocks with the indices `first` to `end` - 1 from `samples`, arrays by channel name.

        The indices count from the start of the stream. One robust fit to all rows of these blocks determines their
        weights. The first call also determines absolute minus gauge pressures. All calls up to the first that surely
        moves determine the signs of the left sides, and the speeds below which the machine rests; for a whole recording
        that is its only call. Later blocks keep all of these, and learn on what is a motion past the resting pump.
        """
        length = self._length
        group = {
            name: values[first * length - self._first : end * length - self._first] for name, values in samples.items()
        }
        if self._absolute_offsets is None:
            self._absolute_offsets = {name: absolute_offset(group[name]) for name in ("p_A", "p_B") if name in group}
            self._learn_limits(group)
        elif not self.has_signs:
            self._learn_limits(group)
        piece = None
        if self._flow_channel:
            signals = Signals(group, self._rate)
            limits = find_lowering_limits(self._balances[0].left(signals), signals)
            if np.isfinite(limits).all():  # not so for impossible readings
                self._lowering_limits = self._lowering_limits.average_with(limits) if self._lowering_limits else limits
            piece = self._learn_flow(samples, first, end)
        if self._on_samples is not None:
            for k in range(first * length, end * length, length):
                block = slice(k - self._first, k - self._first + length)
                self._on_samples(self._begin + k / self._rate, {name: samples[name][block] for name in samples})
        size = max(1, BATCH_SAMPLES // length)  # blocks in a batch, whose rows are computed together
        piece = piece if end - first <= size else None  # the samples of one batch are selected once
        batches = [self._compute_rows(samples, k, min(k + size, end), piece) for k in range(first, end, size)]
        row_parts, *block_parts = zip(*batches, strict=True)
        weights, is_counted, flow, pressures = (np.concatenate(parts) for parts in block_parts)
        root_weights = np.sqrt(weights[is_counted])[:, None]  # roots, since sums are over products of two entries
        rows = [np.concatenate(parts)[is_counted] * root_weights for parts in zip(*row_parts, strict=True)]
        if not self.has_signs:
            self._sign_evidence.add(rows)
            self.sign_log_odds = self._sign_evidence.log_odds
            self.left_signs = tuple(-1.0 if log_odds < 0.0 else 1.0 for log_odds in self.sign_log_odds)
            # a stream may begin at rest, which tells no sign
            self.has_signs = self._n_first is None or self._sign_evidence.shows_motion
        if self._n_first is None:
            for equation_rows, columns, sign in zip(rows, self.columns, self.left_signs, strict=True):
                equation_rows[:, columns.left] *= sign
        # index past the last counted row of each block
        block_ends = np.cumsum(is_counted.reshape(-1, self._strides_per_block).sum(axis=1))
        stride = self._stride / self._rate  # distance of two rows [s]
        first_rows = np.arange(first, end, dtype=float) * self._strides_per_block
        start = self._begin + (first_rows + 0.5 * SPAN) * stride  # middle of each block's first test function
        return Blocks(
            start=start,
            end=start + (self._strides_per_block - 1) * stride,
            gram=self._weighting.compute_gram_matrices(rows, block_ends),
            rows=weights.reshape(-1, self._strides_per_block).sum(axis=1),
            flow=flow,
            pressures=pressures,
            zero=np.full(end - first, self._offset),
        )

    def _with_margins(self, samples: Mapping[str, Array], first: int, end: int) -> Piece:
        """Select the samples on which the blocks `first` to `end` - 1 depend; also return the index of the first one.

        The test functions of the last rows extend beyond the last block, and speeds and rests beyond these.
        """
        stop = end * self._length + (SPAN - 1) * self._stride + 1
        begin = max(self._first, first * self._length - self._margin)
        selected = slice(begin - self._first, stop + self._margin - self._first)
        piece = self._restore_sign({name: values[selected] for name, values in samples.items()})
        if self._flow_channel:
            lowered = _without_lowering(piece, self._rate, self._balances[0], self._lowering_limits)
            self.has_lowered |= any(lowered[name] is not values for name, values in piece.items())
            piece = lowered
        return piece, begin

    def _compute_rows(
        self, samples: Mapping[str, Array], first: int, end: int, piece: Piece | None
    ) -> tuple[list[Array], Array, NDArray[np.bool_], Array, Array]:
        """Compute the rows of each volume balance in the K blocks with the indices `first` to `end` - 1.

        `samples`: arrays by channel name; `piece`: the result of `_with_margins`, if it is known. Returns five items:

        - for each balance an array (r, m) of its terms and left side, with one row for each test function;
        - weights (r,) of the rows: 1, a fraction next to a hole (a long gap), and 0 with a missing sample;
        - flags (r,) of the rows that count: those with a positive weight and, in a balance with terms of its own at
          rest (`is_separate_at_rest`), within the length of a test function from motion. Rows at rest repeat better
          than those in motion, and many of them would determine the scale of the errors;
        - `Blocks.flow` (K,) and `Blocks.pressures` (K, p).
        """
        length = self._length
        start, stop = first * length, end * length + (SPAN - 1) * self._stride + 1
        channels, begin = piece or self._with_margins(samples, first, end)
        signals = self._signals(channels)
        if self._feeds_one_chamber:
            circulates = flag_circulation(self._balances[0], signals, self._feed_sums.mean_flow)
            if circulates.any():
                signals = self._signals(_without_flow(channels, circulates))
        without_margins = slice(start - begin, stop - 1 - begin)  # selects increments, one fewer than samples
        is_whole = np.ones((end - first) * self._strides_per_block, dtype=bool)
        lefts = [balance.left(signals) for balance in self._used_balances]
        rows = []
        for balance, left in zip(self._used_balances, lefts, strict=True):
            columns = [*(term.increments(signals) for term in balance.terms), left]
            weak_rows = weak_form_rows([column[without_margins] for column in columns], self._rate)
            is_whole &= weak_rows.whole
            rows.append(weak_rows.values)
        in_blocks = slice(start - begin, end * length - begin)
        # clipped pressures are used as recorded: they are closer to the true ones than the mean of the other samples
        difference = (
            channels[CLIPPED_DIFFERENCE] if CLIPPED_DIFFERENCE in channels else channels["p_A"] - channels["p_B"]
        )
        pressure = difference[in_blocks].reshape(-1, length)
        flow = np.abs(lefts[0][in_blocks].reshape(-1, length)) * self._rate  # volume per interval times rate [m^3/s]
        is_known = np.isfinite(flow)
        mean_flow = np.where(is_known, flow, 0.0).sum(axis=1) / np.maximum(is_known.sum(axis=1), 1)
        pressures = np.array([sorted_part_means(block, self._rate) for block in pressure])
        hole_weights = (
            weights_near_holes(channels[HOLE][start - begin : stop - begin], self._rate) if HOLE in channels else 1.0
        )
        row_weights = np.where(is_whole, hole_weights, 0.0)
        is_counted = row_weights > 0.0
        if self._drops_rests:
            reach = SPAN * self._stride  # length of a test function, on either side of motion [samples]
            is_moving = signals.moving(self._balances[0].left) > 0.0
            # `extend_flags` extends flags forwards by twice the reach; the slice shifts them back by once
            is_far = ~extend_flags(is_moving, 2 * reach + 1)[reach:-reach]
            time_far = np.asarray(is_far[without_margins] * signals.dt)
            # a row counts if its test function contains no interval far from motion
            is_counted &= weak_form_rows([time_far], self._rate).values[:, 0] == 0.0
        return rows, row_weights, is_counted, mean_flow, pressures


class SignEvidence(SavedAttributes):
    """Evidence on the sign of the recorded flow of each volume balance, from sums over the rows of all blocks so far.

    The flow is the left side of the balance, in a valve's chamber the volume -A dx (`Equation.flow_sign` -1). The
    symptoms are those of `rows.flow_sign`; in a valve's chamber the position is no evidence.
    """

    SAVED = ("_grams", "_counts", "_motions", "_loads")

    def __init__(self, balances: Sequence[Equation], columns: Sequence[ColumnRoles]) -> None:
        self._balances, self._columns = balances, columns
        # for each balance: Gram matrix and number of the rows; sums of the products of flow and motion, and of their
        # squares, by the columns of `_motion_columns`; sums of `flow_sign.add_load` by p_A - p_B and the force
        self._grams = [np.zeros((roles.left + 1, roles.left + 1)) for roles in columns]
        self._counts = np.zeros(len(balances))
        self._motions = [np.zeros((len(_motion_columns(roles)), flow_sign.N_MOTION_SUMS)) for roles in columns]
        self._loads = np.zeros((len(balances), 2, flow_sign.N_LOAD_SUMS))

    def add(self, rows: Sequence[Array]) -> None:
        """Add the rows (r, m) of the regression of each balance."""
        for e, (balance, roles, values) in enumerate(zip(self._balances, self._columns, rows, strict=True)):
            self._grams[e] += values.T @ values
            self._counts[e] += len(values)
            motions = [values[:, indices].sum(axis=1) for indices in _motion_columns(roles)]
            loads = [_load_pressure(values, roles, area_ratio) for area_ratio in (1.0, balance.area_ratio)]
            flow = balance.flow_sign * values[:, roles.left]  # into A
            flow_sign.add_rows(
                self._motions[e], self._loads[e], np.reshape(motions, (len(motions), len(flow))), np.array(loads), flow
            )

    @property
    def log_odds(self) -> tuple[float, ...]:
        """Log odds, for each balance, that the recorded flow has the right sign."""
        odds_by_balance = []
        for roles, gram, count, motions, loads in zip(
            self._columns, self._grams, self._counts, self._motions, self._loads, strict=True
        ):
            motion_z = flow_sign.compute_z_score(*motions[0]) if roles.piston else 0.0
            leak_z = _leak_z_score(gram, roles, int(count))
            odds_by_balance.append(float(flow_sign.compute_log_odds(leak_z, loads, motion_z)))
        return tuple(odds_by_balance)

    @property
    def shows_motion(self) -> bool:
        """True if flow and motion correlate by `sense.motion_score` (`priors.toml`) standard errors, either way."""
        z_scores = [abs(flow_sign.compute_z_score(*sums)) for motions in self._motions for sums in motions]
        return not z_scores or max(z_scores) > flow_sign.MOTION_SCORE


def _motion_columns(roles: ColumnRoles) -> list[list[int]]:
    """List the groups of columns whose sums are the piston's motion or, in a valve's chamber, the flow of an edge."""
    return [list(roles.piston)] if roles.piston else [[k] for k in roles.motion]


def _raise_limits(limits: RestLimits, earlier: RestLimits | None) -> RestLimits:
    """Return the larger of two limits of pump and piston; `earlier` is None for the first samples."""
    if earlier is None:
        return limits
    return limits._replace(pump=max(limits.pump, earlier.pump), piston=max(limits.piston, earlier.piston))


def _load_pressure(rows: Array, columns: ColumnRoles, area_ratio: float) -> Array:
    """Compute p_A - `area_ratio` p_B in each row of a regression, i.e. the pressures' force over the area of A.

    `rows` (r, m): rows of a volume balance; `area_ratio`: area of the piston on side B over that on side A. p_A and
    -p_B are the columns of the two external leaks: 0 while the pressure is negative or, with a meter in a valve's
    supply line, while its side is not fed. If the balance lacks one of them, or if `area_ratio` is 1, the result is the
    column of the leak, p_A - p_B.
    """
    names = [f"external leak {side}" for side in "AB"]
    if area_ratio == 1.0 or not set(names) <= set(columns.names):
        return np.asarray(rows[:, columns.leak])
    p_A, negative_p_B = (rows[:, columns.names.index(name)] for name in names)
    return np.asarray(p_A + area_ratio * negative_p_B)


def _leak_z_score(gram: Array, roles: ColumnRoles, n_rows: int) -> float:
    """Compute the z score of the leak's coefficient (`flow_sign.leak_score`); `gram` (m, m): of the `n_rows` rows."""
    nuisance = [k for k in roles.nuisance if k != roles.leak]
    leak = Gaussian.from_gram(gram).marginal([roles.leak], nuisance)
    energy, moment, whole_energy = (
        float(leak.precision[0, 0]),
        float(leak.moment[0]),
        float(gram[roles.leak, roles.leak]),
    )
    freedom = float(n_rows - len(nuisance) - 1)
    return float(flow_sign.compute_leak_score(energy, moment, leak.square, whole_energy, freedom))


def max_rest_rate(increments: Array, rate: float, fraction: float = INFERENCE.rest.share) -> float:
    """Compute the speed [m/s] or flow [m^3/s] v below which a piston or a pump counts as resting.

    It is the larger of two values: a `fraction` of the mean speed in motion, sum(v^2) / sum(abs(v)), and three standard
    deviations of the noise of a mean of v over `AVERAGING_TIME`. `increments` (n,): increments of the position [m] or
    of the pump's volume [m^3] between samples; `rate`: sampling rate [Hz]. Speeds above the quantile `SPEED_QUANTILE`,
    as of a glitch, count as that quantile.
    """
    return _limit_of_rest(*_speed_and_noise(increments, rate), rate, fraction)


def _limit_of_rest(mean_speed: float, noise: float, rate: float, fraction: float) -> float:
    """Compute the limit of `max_rest_rate` from the results of `_speed_and_noise`."""
    # 2: neighbouring increments may be means that share a sample, which doubles the variance of their sum
    return max(fraction * mean_speed, 3.0 * noise * math.sqrt(2.0 / max(1.0, AVERAGING_TIME * rate)))


def _speed_and_noise(increments: Array, rate: float) -> tuple[float, float]:
    """Compute the mean speed in motion, and the standard deviation of the noise of a speed (`max_rest_rate`)."""
    velocity = increments[np.isfinite(increments)]
    velocity *= rate
    # sixth differences of white noise have 924 times its variance; every second value only, since neighbouring
    # increments share a sample
    differences = np.abs(np.diff(velocity[::2], 6))
    noise = SD_PER_MEDIAN * float(np.median(differences)) / math.sqrt(924.0) if len(differences) else 0.0
    del differences
    speed = np.abs(velocity, out=velocity)
    if speed.size:
        np.minimum(speed, np.quantile(speed, SPEED_QUANTILE), out=speed)
    mean_speed = float(speed @ speed) / max(float(speed.sum()), np.finfo(float).tiny)
    return mean_speed, noise


def find_lowering_limits(pump_volume: Array, signals: Signals) -> LoweringLimits:
    """Find the limits for `flag_lowering`; the load is the median while the pump turns, 0 if it never does.

    `pump_volume`: as in `flag_lowering`.
    """
    max_flow = max_rest_rate(pump_volume, signals.rate)
    speed_and_noise = _speed_and_noise(np.diff(signals["x"]), signals.rate)
    load = signals.compute_pressure_difference()[~find_rests(pump_volume, signals.rate, max_flow)]  # while it turns
    np.nan_to_num(np.abs(load, out=load), copy=False)
    return LoweringLimits(
        pump=max_flow,
        creep=_limit_of_rest(*speed_and_noise, signals.rate, INFERENCE.rest.lowers),
        load=float(np.median(load)) if load.size else 0.0,
        noise=_limit_of_rest(*speed_and_noise, signals.rate, fraction=0.0),
        time=len(load) / signals.rate,
    )


def flag_lowering(pump_volume: Array, signals: Signals, limits: LoweringLimits | None = None) -> NDArray[np.bool_]:
    """Flag the sampling intervals (n,) in which the piston moves for a time although the pump rests.

    A valve then lowers a load past the pump, or connects the chambers of an actuator that is moved from outside. A leak
    is slower: it passes little of the pump's flow, and less at a smaller load. The piston must therefore be faster than
    the fraction `rest.lowers` (`priors.toml`) of its mean speed in motion, on average over `MIN_REST`. The fraction is
    reduced by the root, as the flow of an orifice, of abs(p_A - p_B) over its median while the pump turns; abs(p_A -
    p_B) is the largest of the last `MIN_REST`.
    Pauses shorter than `rest.lasting` count as motion. The flags reach `AVERAGING_TIME`, over which speeds are
    averaged, beyond either end. `pump_volume` (n,): increments of the pump's volume [m^3], NaN where missing. `limits`:
    by default those of the same samples.
    """
    limits = limits or find_lowering_limits(pump_volume, signals)
    rate = signals.rate
    rests = find_rests(pump_volume, rate, limits.pump)
    usual_load = max(limits.load, np.finfo(float).tiny)
    # arrays are changed in place: a long recording has few copies
    relative_load = signals.compute_pressure_difference()
    np.abs(relative_load, out=relative_load)
    is_missing = ~np.isfinite(relative_load)
    np.minimum(relative_load, usual_load, out=relative_load)
    relative_load /= usual_load
    relative_load[is_missing] = 1.0
    # a leak may equalise the pressures: the piston that it moves is as fast as the load was just before
    limit = largest_before(relative_load, max(1, round(MIN_REST * rate)))
    del relative_load, is_missing
    np.sqrt(limit, out=limit)
    limit *= limits.creep
    np.maximum(limit, limits.noise, out=limit)
    velocity = np.nan_to_num(np.diff(signals["x"]), copy=False)
    velocity *= rate
    excess = average_over(AVERAGING_TIME, velocity, rate)
    np.abs(excess, out=excess)
    excess -= limit
    del velocity, limit
    margin = math.ceil(AVERAGING_TIME * rate)

    def extend_both_ways(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Flag `margin` more samples at either end of each run of flags."""
        return extend_flags(flags, 2 * margin + 1)[margin:-margin]

    is_turning = extend_both_ways(~rests)  # averages next to motion contain some of it
    window = min(max(1, round(MIN_REST * rate)), len(rests))  # [samples]
    # over the window after each sample, times its length
    mean_excess, n_turning = (_window_sums(values, window) for values in (excess, is_turning))
    is_lowering = ~is_turning & (excess > 0.0) & extend_flags((mean_excess > 0.0) & (n_turning == 0), window)
    for first, length in find_runs(~is_lowering).tolist():
        if length < INFERENCE.rest.lasting * rate and not is_turning[first : first + length].any():
            is_lowering[first : first + length] = True
    return extend_both_ways(is_lowering)


def _window_sums(values: NDArray[Any], length: int) -> NDArray[Any]:
    """Sum each of the values (n,) and the `length` - 1 values after it, shape (n - `length` + 1,)."""
    sums = np.cumsum(values)
    windows = sums[length - 1 :].copy()
    windows[1:] -= sums[:-length]
    return windows


def largest_before(values: Array, length: int) -> Array:
    """Find the largest of each value (n,) and the `length` - 1 values before it."""
    from scipy.ndimage import maximum_filter1d

    return np.asarray(maximum_filter1d(values, length, mode="nearest", origin=(length - 1) // 2))


def absolute_offset(pressure: Array) -> float:
    """Compute absolute minus gauge pressure [Pa] for a sensor with the readings `pressure` (n,) [Pa].

    It is the atmospheric pressure, or more where the lowest reading would otherwise lie below `MIN_ABSOLUTE_PRESSURE`.
    """
    finite = pressure[np.isfinite(pressure)]
    min_reading = float(np.min(finite)) if finite.size else 0.0
    return max(P_ATM, MIN_ABSOLUTE_PRESSURE - min_reading)


def samples_without_holes(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples (n,) of the channels `names` as `bridged_samples` does, but NaN in long gaps."""
    samples = bridged_samples(recording, names)
    is_hole = samples.pop(HOLE, np.zeros(0)) > 0.0
    return {name: np.where(is_hole, np.nan, values) for name, values in samples.items()} if is_hole.any() else samples


def bridged_samples(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples (n,) of those channels `names` that are recorded, with clipped pressures as NaN.

    Holes, i.e. long gaps of missing samples, keep the values with which the inspection filled them
    (`corrections.gaps`); the additional entry `HOLE` is then 1 there and 0 elsewhere. If a pressure is clipped, the
    additional entry `CLIPPED_DIFFERENCE` is p_A - p_B as recorded, for the pressure level of a block: clipped values
    are closer to the true ones than the mean of the other samples.
    """
    samples, is_clipped = {}, False
    is_hole = flag_holes(recording)
    if is_hole.any():
        samples[HOLE] = is_hole.astype(float)
    for name, values in recording.channels.items():
        if name in names:
            # rails: values at which the pressure transducer clips
            rails = list[float]()
            if name.startswith("p_"):
                finite = values[np.isfinite(values)]
                rails = [rail.value for rail in find_rails(finite, recording.units[name])]
            samples[name] = np.where(np.isin(values, rails), np.nan, values) if rails else values
            is_clipped |= bool(rails)
    if is_clipped and {"p_A", "p_B"} <= samples.keys():
        samples[CLIPPED_DIFFERENCE] = recording["p_A"] - recording["p_B"]
    return samples


def derive_drive_signals(
    samples: Mapping[str, Array], rig: Rig, rate: float, *, loaded: bool = False
) -> dict[str, Array]:
    """Add signals from a model of the drive to the samples of a recording, each an array (n,) by channel name.

    `rate`: sampling rate [Hz]. The added entry `START` is exp(-t/lag) at the time t since the first sample: the effect
    of the drive's unknown initial state decays with the time constant lag. If only the command u shows the pump's flow,
    the drive's response to u is added as the pump's speed "omega" [rad/s], NaN where u is missing. If `loaded` is true,
    the drive responds to the load p_A - p_B as well. Otherwise the droop of the real speed under load counts as
    leakage.
    """
    drive = Drive.from_rig(rig)
    derived = {START: np.exp(-np.arange(len(samples["p_A"])) / (rate * drive.lag))}
    if flow_source(samples) == "u":
        u = _hold_missing(samples["u"])
        load = np.zeros(len(u))
        if loaded:
            dp = _hold_missing(samples["p_A"] - samples["p_B"])
            # the order of the pump's ports is unknown: the load is dp or -dp, whichever correlates positively with u
            load = dp if float((u - u.mean()) @ (dp - dp.mean())) >= 0.0 else -dp
        speed = drive.speed(u, load, rate)
        derived["omega"] = np.where(np.isnan(samples["u"]), np.nan, speed)
    return {**samples, **derived}


def _hold_missing(values: Array) -> Array:
    """Replace each missing value (NaN) of an array (n,) by the last known one; by 0 before the first."""
    last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))
    return np.where(last < 0, 0.0, values[last])


def min_samples_for_step(rate: float) -> int:
    """Compute the minimum number of samples, at a `rate` [Hz], to test for a leak that begins within a recording.

    A test needs `MIN_BLOCKS` blocks of minimum length, and the samples to the end of the last test function.
    """
    strides = MIN_BLOCKS * strides_in(MIN_BLOCK_TIME, rate) + SPAN - 1
    return strides * stride_samples(rate) + 1


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
        samples = _without_lowering(samples, recording.rate, balances[0])
        if rig.circuit.feeds_one_chamber:
            limits = find_rest_limits(samples, recording.rate, balances[0])
            signals = Signals(samples, recording.rate, rest_limits=limits)
            sums = FeedSums.measure(balances[0], signals)
            balances = (feed_one_chamber(balances[0], sums.find_feed(balances[0].area_ratio)),)
            circulates = flag_circulation(balances[0], signals, sums.mean_flow, healthy_holds)
            holds = HoldCounts.measure(signals.holding(balances[0].left) > 0.0, circulates, recording.rate)
            samples = _without_flow(samples, circulates)
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


def _without_lowering(
    samples: Mapping[str, Array], rate: float, balance: Equation, limits: LoweringLimits | None = None
) -> dict[str, Array]:
    """Set the channel of the pump's flow to NaN while the piston moves past the resting pump (`flag_lowering`).

    `samples`: arrays by channel name at the `rate` [Hz]; `balance`: volume balance, whose left side is the pump's flow;
    `limits`: as in `flag_lowering`.
    """
    signals = Signals(samples, rate)
    return _without_flow(samples, flag_lowering(balance.left(signals), signals, limits))


def _without_flow(samples: Mapping[str, Array], is_unknown: NDArray[np.bool_]) -> dict[str, Array]:
    """Set the channel of the pump's flow to NaN on either side of the sampling intervals that `is_unknown` flags."""
    source = flow_source(samples)  # not None: the balance has a recorded flow
    if source is None or not is_unknown.any():
        return dict(samples)
    is_touched = np.append(is_unknown, False) | np.append(False, is_unknown)
    return {**samples, source: np.where(is_touched, np.nan, samples[source])}


def _longest_hold(samples: Mapping[str, Array], rate: float, balance: Equation) -> float:
    """Find the longest time [s] for which the piston rests while the pump turns to hold a load; 0 if it never does.

    `samples`, `rate`, `balance`: as in `_without_lowering`.
    """
    signals = Signals(samples, rate, rest_limits=find_rest_limits(samples, rate, balance))
    _, lengths = find_runs(signals.holding(balance.left) > 0.0).T  # [samples]
    return float(lengths.max(initial=0)) / rate


def find_rest_limits(samples: Mapping[str, Array], rate: float, balance: Equation) -> RestLimits:
    """Compute the flow of the pump and the speed of the piston below which they count as resting.

    Both are those of `max_rest_rate`, with two exceptions:

    - A balance with terms of its own at rest (`is_separate_at_rest`) needs the stops of the piston only. The flow never
      counts as resting (`NEVER`), so that a stop of the piston is `holding`. The piston's limit is the fraction
      `rest.motion_fraction` (`priors.toml`) of its mean speed in motion, and stops shorter than `MIN_REST` count.
    - If the flow is that of a meter (`q_pump`), it alone decides. Below the same fraction of its mean in motion, the
      valves are taken as shut, and a piston that still moves creeps by a leak: it never counts as resting.

    `samples`, `rate`, `balance`: as in `_without_lowering`.
    """
    signals = Signals(samples, rate)
    if is_separate_at_rest(balance):
        max_speed = max_rest_rate(signals.step("x"), rate, fraction=INFERENCE.rest.motion_fraction)
        return RestLimits(pump=NEVER, piston=max_speed, shortest=AVERAGING_TIME)
    if flow_source(samples) == "q_pump":  # no angle or speed of the pump is recorded
        max_flow = max_rest_rate(balance.left(signals), rate, fraction=INFERENCE.rest.motion_fraction)
        return RestLimits(pump=max_flow, piston=NEVER)
    return RestLimits(pump=max_rest_rate(balance.left(signals), rate), piston=max_rest_rate(signals.step("x"), rate))


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
