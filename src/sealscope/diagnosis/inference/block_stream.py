"""Division of samples into blocks: a few seconds each, reduced to Gram matrices of a volume balance (`blocks.Blocks`).

`BlockStream` computes the blocks of a live stream and, with all samples at once, those of a whole recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import MIN_BLOCKS
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, Weighting, sorted_part_means
from sealscope.diagnosis.inference.equations.balances import (
    CLIPPED_DIFFERENCE,
    HOLE,
    FeedSums,
    absolute_offset,
    feed_one_chamber,
    find_rest_limits,
    flag_circulation,
    is_separate_at_rest,
    without_flow,
    without_lowering,
)
from sealscope.diagnosis.inference.equations.terms import HALF_DIFFERENCE, MOVING_BIAS, Equation, Signals
from sealscope.diagnosis.inference.machine_states import (
    AVERAGING_TIME,
    LOWERING_MARGIN,
    MIN_REST,
    LoweringLimits,
    RestLimits,
    extend_flags,
    find_lowering_limits,
)
from sealscope.diagnosis.inference.rows import (
    MOTION_SCORE,
    N_LOAD_SUMS,
    N_MOTION_SUMS,
    SPAN,
    SUPPORT,
    add_rows,
    leak_score,
    stride_samples,
    strides_in,
    sum_log_odds,
    weak_form_rows,
    weights_near_holes,
    z_score,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.corrections.unsigned import UNSIGNED, is_one_sided, is_two_way, restore_flow
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import SavedAttributes, plain_array, require_part, restore_array

#: Maximum and minimum length of a block [s].
MAX_BLOCK_TIME: float = INFERENCE.blocks.longest
MIN_BLOCK_TIME: float = INFERENCE.blocks.shortest
#: Number of samples whose increments are computed together, so that they stay in the processor's cache.
BATCH_SAMPLES = 8192
#: Samples by channel, their signals, and the index of the first one, counted from the beginning of a stream.
Piece = tuple[dict[str, Array], Signals, int]


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
            self._rest_limits = limits if self._rest_limits is None else limits.larger(self._rest_limits)

    def _learn_flow(self, samples: Mapping[str, Array], first: int, end: int) -> Piece | None:
        """Add the blocks `first` to `end` - 1 to what is known of the pump's flow: its sign, and an open circuit.

        A flow without a sign counts with one from the first blocks on that show the piston moving both ways. Returns
        the samples of `_with_margins`, None if the sign of their flow no longer holds. Of an angle in a closed circuit
        there is nothing to learn.
        """
        if self._flow_channel not in UNSIGNED and not self._feeds_one_chamber:
            return self._with_margins(samples, first, end)
        (balance,) = self._balances
        was_unsigned, feed_before = self.is_unsigned, self._feed_sums.find_feed(balance.area_ratio)
        piece, signals, begin = self._with_margins(samples, first, end)
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
        return None if was_unsigned or self.is_unsigned else (piece, signals, begin)

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
            pump_volume, difference = self._balances[0].left(signals), signals.compute_pressure_difference()
            limits = find_lowering_limits(pump_volume, signals["x"], difference, self._rate)
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
        """Select the samples on which the blocks `first` to `end` - 1 depend.

        The test functions of the last rows extend beyond the last block, and speeds and rests beyond these.
        """
        stop = end * self._length + (SPAN - 1) * self._stride + 1
        begin = max(self._first, first * self._length - self._margin)
        selected = slice(begin - self._first, stop + self._margin - self._first)
        piece = self._restore_sign({name: values[selected] for name, values in samples.items()})
        if self._flow_channel:
            lowered = without_lowering(piece, self._rate, self._balances[0], self._lowering_limits)
            self.has_lowered |= any(lowered[name] is not values for name, values in piece.items())
            piece = lowered
        return piece, self._signals(piece), begin

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
        channels, signals, begin = piece or self._with_margins(samples, first, end)
        if self._feeds_one_chamber:
            circulates = flag_circulation(self._balances[0], signals, self._feed_sums.mean_flow)
            if circulates.any():
                signals = self._signals(without_flow(channels, circulates))
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


def min_samples_for_step(rate: float) -> int:
    """Compute the minimum number of samples, at a `rate` [Hz], to test for a leak that begins within a recording.

    A test needs `MIN_BLOCKS` blocks of minimum length, and the samples to the end of the last test function.
    """
    strides = MIN_BLOCKS * strides_in(MIN_BLOCK_TIME, rate) + SPAN - 1
    return strides * stride_samples(rate) + 1


class SignEvidence(SavedAttributes):
    """Evidence on the sign of the recorded flow of each volume balance, from sums over the rows of all blocks so far.

    The flow is the left side of the balance, in a valve's chamber the volume -A dx (`Equation.flow_sign` -1). The
    symptoms are those of `rows`; in a valve's chamber the position is no evidence.
    """

    SAVED = ("_grams", "_counts", "_motions", "_loads")

    def __init__(self, balances: Sequence[Equation], columns: Sequence[ColumnRoles]) -> None:
        self._balances, self._columns = balances, columns
        # for each balance: Gram matrix and number of the rows; sums of the products of flow and motion, and of their
        # squares, by the columns of `_motion_columns`; sums of `add_load` by p_A - p_B and the force
        self._grams = [np.zeros((roles.left + 1, roles.left + 1)) for roles in columns]
        self._counts = np.zeros(len(balances))
        self._motions = [np.zeros((len(_motion_columns(roles)), N_MOTION_SUMS)) for roles in columns]
        self._loads = np.zeros((len(balances), 2, N_LOAD_SUMS))

    def add(self, rows: Sequence[Array]) -> None:
        """Add the rows (r, m) of the regression of each balance."""
        for e, (balance, roles, values) in enumerate(zip(self._balances, self._columns, rows, strict=True)):
            self._grams[e] += values.T @ values
            self._counts[e] += len(values)
            motions = [values[:, indices].sum(axis=1) for indices in _motion_columns(roles)]
            loads = [_load_pressure(values, roles, area_ratio) for area_ratio in (1.0, balance.area_ratio)]
            flow = balance.flow_sign * values[:, roles.left]  # into A
            add_rows(
                self._motions[e], self._loads[e], np.reshape(motions, (len(motions), len(flow))), np.array(loads), flow
            )

    @property
    def log_odds(self) -> tuple[float, ...]:
        """Log odds, for each balance, that the recorded flow has the right sign."""
        odds_by_balance = []
        for roles, gram, count, motions, loads in zip(
            self._columns, self._grams, self._counts, self._motions, self._loads, strict=True
        ):
            motion_z = z_score(*motions[0].tolist()) if roles.piston else 0.0
            nuisance = [k for k in roles.nuisance if k != roles.leak]
            leak = Gaussian.from_gram(gram).marginal([roles.leak], nuisance)
            energy, moment, whole_energy = (
                float(leak.precision[0, 0]),
                float(leak.moment[0]),
                float(gram[roles.leak, roles.leak]),
            )
            freedom = float(int(count) - len(nuisance) - 1)
            leak_z = leak_score(energy, moment, leak.square, whole_energy, freedom)
            difference_sums, force_sums = loads.tolist()
            odds_by_balance.append(sum_log_odds(leak_z, difference_sums, force_sums, motion_z))
        return tuple(odds_by_balance)

    @property
    def shows_motion(self) -> bool:
        """True if flow and motion correlate by `sense.motion_score` (`priors.toml`) standard errors, either way."""
        z_scores = [abs(z_score(*sums)) for motions in self._motions for sums in motions.tolist()]
        return not z_scores or max(z_scores) > MOTION_SCORE


def _motion_columns(roles: ColumnRoles) -> list[list[int]]:
    """List the groups of columns whose sums are the piston's motion or, in a valve's chamber, the flow of an edge."""
    return [list(roles.piston)] if roles.piston else [[k] for k in roles.motion]


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
