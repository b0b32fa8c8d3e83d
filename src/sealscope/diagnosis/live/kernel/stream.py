"""The leakage of a running actuator, sample by sample, as kernels on one state record of fixed size.

The equations are those of the live volume balance (`diagnosis.live`, `diagnosis.inference`); its terms are the
expressions of `equations.terms`. A row is this balance, integrated with a test function over `SPAN` strides
(`rows`); a row begins every stride of about 0.125 s. `add_sample` adds the increments of the balance's terms
to the unfinished rows. At the end of a block of 3 s, its rows are weighted and summed to a Gram matrix, the products of
all terms, from which the block's leakage conductance is estimated and tested for a step. This work is divided into
parts of similar length: each call of `advance` does one, so that a controller spreads the end of a block over its
cycles, until `phase` is 0. Only the last samples are stored, about 2 `HALF_DIFFERENCE` seconds.

The mean conductance G of the last n blocks (at most `WINDOW`) has the interval

    G +- hypot(t_(n-1) sqrt(v/n), 1.96 o),    v = max(s^2, mean of sd^2)

with the standard deviation s of the blocks' estimates, their standard errors sd, Student's t, and the systematic
standard error o due to the other coefficients and to the machine's sizes (displacement, piston area). The flow is G
times the mean of abs(p_A - p_B) as recorded; the live balance also subtracts the sensors' noise from this mean, a few
per cent. A leak is a step of the conductance that the detector of steps finds (`kernel.step`), at a stated rate of
false alarms.

No counter grows without limit but those of blocks, which last for 200 years of blocks in 32 bits. A state of any
numbers, even of readings that are none, leads to no index beyond its array.
"""

from __future__ import annotations

import math
from functools import lru_cache
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from sealscope.compiled import large_law, law, record_dtype
from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.equations.balances import PUMP_VOLUMES
from sealscope.diagnosis.inference.equations.terms import HALF_DIFFERENCE, build_increments, channels_of
from sealscope.diagnosis.inference.rows import (
    BEYOND,
    MAX_ITERATIONS,
    MAX_READING,
    MIN_STRIDE,
    MOTION_SCORE,
    N_LOAD_SUMS,
    N_MOTION_SUMS,
    SPAN,
    STRIDE,
    SUPPORT,
    Workspace,
    add_load,
    add_motion,
    add_reduced,
    add_to_rows,
    eliminate,
    eliminate_fast,
    fit_blocks,
    leak_score,
    median,
    move_sums,
    peak_weight,
    reweigh,
    start_normal,
    stride_samples,
    strides_in,
    sum_log_odds,
    sum_products,
    workspace_shapes,
    z_score,
)
from sealscope.diagnosis.live.coefficients import (
    MISFIT,
    NOISE,
    OUTDATED,
    UNCERTAIN,
    Coefficients,
    add_block,
    coefficient_shapes,
    estimate_leak,
    fit_coefficients,
    is_waking,
    judge_estimate,
    load_block,
    relative_motion,
)
from sealscope.diagnosis.live.kernel import step
from sealscope.diagnosis.live.live_balance import (
    BLOCK_SECONDS,
    LEARNED,
    live_equations,
    size_error,
)
from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.quality import sensor_limit
from sealscope.units import P_ATM

#: Number of blocks of a mean.
WINDOW = 20
#: Blocks after a pause of so many seconds are not compared with earlier ones.
PAUSE = float(LIVE.watch.pause)
#: Onsets that a call of `advance` weighs, and for the bound adds up; halvings of the bound's interval after each block.
WEIGHED_A_CALL, ADDED_A_CALL, HALVINGS = 2, 12, 20
#: Blocks from which on the times of the detector of steps begin anew, and by how many.
_MOST_BLOCKS, _SHIFTED_BLOCKS = 1 << 19, 1 << 18
#: Parts of the work at the end of a block: `phase` of the record.
(
    IDLE, PRODUCTS, REDUCE, NORMAL, REWEIGH, BLOCK, FIT_SIGN, FIT_ADD, FIT, FIT_PRECISION, FIT_APPEND, TAKE, WEIGH,
    DECIDE, BOUND, FINISH,
) = range(16)  # fmt: skip
#: Columns of `history`, the results of the last blocks: conductance G estimated with the present coefficients [m^3/(s
#: Pa)], a conductance g that can be compared between blocks, its variance, the systematic variance of G, the mean of
#: abs(p_A - p_B) [Pa], and the block's number.
_G, _COMPARABLE_G, _VARIANCE, _SYSTEMATIC_VARIANCE, _PRESSURE, _HISTORY_NUMBER = range(6)
#: Columns of `pressure_sums`: the sum of abs(p_A - p_B) [Pa] over a block's samples, and their number.
_SUM, _NUMBER = 0, 1
#: Columns of `waiting_sizes`: number of rows, mean abs(p_A - p_B) [Pa], and number of a block.
_BLOCK_ROWS, _BLOCK_PRESSURE, _BLOCK_NUMBER = 0, 1, 2
#: Results, in the order of `write_results`: leakage of pump and piston together with its interval [m^3/s]; leak since
#: its onset, or 0 without an alarm, with its interval [m^3/s]; bound of an undetected leak [m^3/s]; score (log M) and
#: its threshold; 1 for an alarm; seconds since the onset; conductance [m^3/(s Pa)]; variance of the last block's rows
#: over the usual one; number of estimated blocks; reason of `REASONS`, 0 for none.
RESULTS = (
    *("q", "q_low", "q_high", "q_leak", "q_leak_low", "q_leak_high", "q_bound", "score", "threshold", "alarm"),
    *("since", "conductance", "misfit", "blocks", "reason"),
)
(
    _OUT_Q, _OUT_Q_LOW, _OUT_Q_HIGH, _OUT_LEAK, _OUT_LEAK_LOW, _OUT_LEAK_HIGH, _OUT_BOUND, _OUT_SCORE, _OUT_THRESHOLD,
    _OUT_ALARM, _OUT_SINCE, _OUT_G, _OUT_MISFIT, _OUT_BLOCKS, _OUT_REASON,
) = range(len(RESULTS))  # fmt: skip
#: Why there is no result: the number in `reason`, with its words.
REASONS = MappingProxyType(
    {
        0: "",
        1: "learning: the first blocks are fitted together",
        2: "at standstill",
        3: "missing values",
        4: "the cycle calls `step` too rarely: a block was dropped",
        5: "learning anew: what was learned is not that of the machine",
    }
)
_LEARNING, _STANDSTILL, _MISSING, _OVERRUN, _RELEARNING = 1, 2, 3, 4, 5
_REAL_NUMBERS = (
    *("size_error", "leak_error", "displacement", "log_threshold", "angle_sign", "usual_precision", "leak_size"),
    *("leak_deviation", "leak_onset", "block_end"),
)
_WHOLE_NUMBERS = (
    # samples so far, less whole periods; blocks: ended, weighted, open, being worked on, that wait for the first fit,
    # successive ones of larger motion and of none, estimated, of these taken by the detector, dropped; and how often
    # all was learned anew
    *(
        "sample_count",
        "n_ended",
        "n_weighted",
        "n_open",
        "n_closed",
        "n_waiting",
        "n_moving",
        "n_still",
        "n_estimated",
        "n_tested",
        "n_dropped",
        "n_relearned",
    ),
    # rows: of open blocks, and of those that are worked on; part of the work, the block or onset it is at, iterations
    *("n_rows", "n_closed_rows", "phase", "place", "iteration", "has_converged", "is_fitting", "halvings"),
    *("has_sign", "alarm", "reason", "first_closed", "first_number"),
)


class Basis(NamedTuple):
    """Columns of rows in which single precision computes: well conditioned, and of magnitudes near 1.

    Terms of a balance are nearly collinear; the squares of their rows have a condition number of 1e8, more than single
    precision resolves. A row u of the n nuisances (all columns but the leak and the left side) is replaced by a
    triangular combination, which only changes what the nuisances' coefficients mean: column i becomes the sum over
    k <= i of `combination`[i (i + 1)/2 + k] u[k]. The left side becomes (left - sum over j of `prediction`[j] u[j])
    times `left_scale`.
    """

    combination: tuple[float, ...]  # (n (n + 1)/2,)
    prediction: tuple[float, ...]  # (n,)
    leak_scale: float
    left_scale: float

    @property
    def conductance_unit(self) -> float:
        """Unit of the estimated conductances [m^3/(s Pa)]."""
        return self.leak_scale / self.left_scale


class StreamSettings(NamedTuple):
    """The settings of a stream, which become constants of its kernels."""

    rate: float  # sampling rate [Hz]
    channels: tuple[str, ...]  # of a sample, in this order
    expressions: tuple[str, ...]  # of the terms of the balance, last of its left side
    # indices into `expressions`: first the `n_fast` terms fitted to each block, then the others, last the left side
    column_order: tuple[int, ...]
    n_fast: int
    piston: tuple[int, ...]  # indices of the piston's motion in `expressions`
    area_ratio: float  # area of the piston on side B over that on side A
    displacement: float  # of the pump [m^3/rad], 1 if a meter gives the flow
    size_error: float  # relative standard error of the leakage due to the machine's displacement and piston area
    log_threshold: float  # of the score
    basis: Basis | None = None  # for single precision
    # absolute minus gauge pressures p_A and p_B [Pa], more than atmospheric pressure for a sensor that reads too low
    to_absolute: tuple[float, float] = (P_ATM, P_ATM)

    @classmethod
    def from_rig(
        cls, rig: Rig, rate: float, flow: str = "theta", false_alarms_per_1000_h: float = 1.0
    ) -> StreamSettings:
        """Choose the settings for a rig, a sampling `rate` [Hz] and the channel of the pump's `flow`.

        Raises InputError if the rate is too low, or the balance needs terms that no stream computes.
        """
        if not MIN_STRIDE / STRIDE <= rate < math.inf:
            raise InputError(f"rate of a stream must be >= {MIN_STRIDE / STRIDE:g} Hz, got {rate:g}")
        circuit, channels = rig.circuit, ("p_A", "p_B", flow, "x")
        if flow not in PUMP_VOLUMES:
            raise InputError(f"a controller must have the pump's flow as {', '.join(PUMP_VOLUMES)}, got {flow!r}")
        if circuit.feeds_one_chamber:
            raise InputError(
                f"a controller must have a pump that feeds both chambers, got {circuit}: the piston's leakage is told "
                "from the pump's by rests under load, which a controller does not find"
            )
        if flow != "q_pump" and not circuit.pump_moves_piston:
            raise InputError(
                f"a controller must have a pump that moves the piston, or a meter (q_pump), got {circuit}: the "
                "balances of two chambers, by a valve's flow, are not computed on a controller"
            )
        if flow != "q_pump" and not rig.states(*circuit.size_parameters):
            raise InputError(
                f"a controller must have the pump's displacement to compute a flow from {flow}, got none that is "
                "stated: state it to commission (--displacement), or in [pump] of the machine's file"
            )
        (balance,) = live_equations(rig, channels)
        unknown = [term.name for term in balance.terms if not term.expression]
        if unknown:
            raise InputError(f"a controller must have terms that are expressions, got {', '.join(unknown)}")
        columns = ColumnRoles(balance)
        fast = columns.fast
        expressions = (*(term.expression for term in balance.terms), balance.left_expression)
        assert set().union(*map(channels_of, expressions)) <= set(channels)
        probability = float(LIVE.watch.step) * false_alarms_per_1000_h * BLOCK_SECONDS / 3600.0 / 1000.0
        return cls(
            rate,
            channels,
            expressions,
            column_order=(*fast, *columns.slow, columns.left),
            n_fast=len(fast),
            piston=columns.piston,
            area_ratio=balance.area_ratio,
            displacement=rig.pump.q_b / (2.0 * math.pi) if flow in ("theta", "omega") else 1.0,
            size_error=size_error(rig),
            log_threshold=-math.log(probability),
        )

    @property
    def increments(self) -> tuple[str, ...]:
        """Expressions that a stream integrates: those of a row and, if the areas differ, the force over area A."""
        force = f"(mean(p_A) - {self.area_ratio!r} * mean(p_B)) * dt"
        return self.expressions if self.area_ratio == 1.0 else (*self.expressions, force)

    @property
    def row_width(self) -> int:
        """Number of columns of a row: with a `basis`, the measured volume, too, which shows motion."""
        return len(self.expressions) + (self.basis is not None)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Samples in a stride, strides in a block, and samples in half a difference.

        The difference is the central one of the position, whose sign is the direction of motion.
        """
        return (
            stride_samples(self.rate),
            strides_in(BLOCK_SECONDS, self.rate),
            max(1, round(HALF_DIFFERENCE * self.rate)),
        )


def stream_layout(settings: StreamSettings) -> np.dtype[Any]:
    """Build the layout of a stream's state: a numpy record of numbers and arrays.

    Arrays that are used at different times share memory. Until the first fit there are no onsets; their sums give place
    to the blocks that wait for it, and to the rows of the first `SUPPORT` blocks, which are weighted together. While
    onsets are weighed, no rows are; and no row is weighted while a block's leakage is estimated.
    """
    _, block_strides, half = settings.counts
    n_columns, n_increments = len(settings.expressions), len(settings.increments)
    n_slow = len(settings.column_order) - settings.n_fast - 1  # - 1: the left side
    support_rows = SUPPORT * block_strides
    width = settings.row_width
    n_packed = width * (width + 1) // 2
    # finished rows: of the blocks that are worked on, then of the open ones; later than the first blocks, one of each
    n_rows, n_later = (support_rows + block_strides) * width, 2 * block_strides * width
    arena = max(LEARNED * n_packed, n_rows - n_later + SUPPORT * n_packed)
    steps = step.detector_layout(gap=n_later, sums=arena)
    end_of_sums, end_of_steps = _offset(steps, step.SCRATCH[0]), steps.itemsize
    workspace = record_dtype(
        **dict(
            zip(
                Workspace._fields,
                workspace_shapes(support_rows, SUPPORT, len(settings.column_order), n_slow),
                strict=True,
            )
        )
    )
    # nuisances: all columns but the leak and the left side
    shapes = dict(zip(Coefficients._fields, coefficient_shapes(n_columns - 2), strict=True))
    gram_bytes = 8 * width * width
    workspace_begin = end_of_sums + gram_bytes
    model_begin = workspace_begin + _offset(workspace, "reduced")
    end_of_work = max(end_of_steps, workspace_begin + workspace.itemsize)
    model = _model_layout(shapes, end_of_work - model_begin)
    fields: dict[str, tuple[Any, int]] = {
        "steps": (steps, 0),
        "rows": (("f8", (support_rows + block_strides, width)), _offset(steps, "sums") - 8 * n_later),
        # lower triangles of the Gram matrices of blocks that wait for the first fit, the first block at the end
        "waiting_grams": (("f8", (LEARNED, n_packed)), end_of_sums - 8 * LEARNED * n_packed),
        "gram": (("f8", (width, width)), end_of_sums),  # of the block that is worked on
        "workspace": (workspace, workspace_begin),
        "model": (model, model_begin),
    }
    further = record_dtype(
        *_REAL_NUMBERS,
        ring=(len(settings.channels), 2 * half + 2),  # last samples, those that the increments need
        increments=(n_increments,),  # of each term of the balance over the last sampling interval
        unfinished=(SPAN, n_increments),  # the rows to which the present sample adds
        # sums over rows, until the sign is known (`sum_log_odds`); loads: p_A - p_B and, if it differs, the force
        sign_motion=(N_MOTION_SUMS,),
        sign_loads=(n_increments - n_columns + 1, N_LOAD_SUMS),
        ends=(SUPPORT,),  # index past the last row of each open block
        closed_ends=(SUPPORT,),  # the same of the blocks that are worked on
        # sum of abs(p_A - p_B), and number of samples; + 1: the last rows of a block end when the next has begun
        pressure_sums=(SUPPORT + 1, 2),
        slow_sums=(n_slow + 1, n_slow + 1),  # over earlier blocks, for the coefficients not fitted to each block
        waiting_sizes=(LEARNED, 3),  # `_BLOCK_ROWS`, `_BLOCK_PRESSURE` and `_BLOCK_NUMBER` of the waiting blocks
        precisions=(LEARNED,),  # of their estimates
        history=(WINDOW, 6),  # results of each of the last blocks (`_G` ... `_HISTORY_NUMBER`)
    )
    begin = model_begin + model.itemsize
    fields |= {name: (further[name], begin + _offset(further, name)) for name in further.names or ()}
    begin += further.itemsize
    fields |= {name: (np.dtype("i8"), begin + 8 * k) for k, name in enumerate(_WHOLE_NUMBERS)}
    formats, offsets = zip(*fields.values(), strict=True)
    end = begin + 8 * len(_WHOLE_NUMBERS)
    return np.dtype({"names": [*fields], "formats": [*formats], "offsets": [*offsets], "itemsize": end})


def _offset(layout: np.dtype[Any], name: str) -> int:
    """Return the offset of a field in bytes."""
    assert layout.fields is not None
    return layout.fields[name][1]


def _model_layout(shapes: dict[str, tuple[int, ...]], work_bytes: int) -> np.dtype[Any]:
    """Build the layout of a `Coefficients` whose work arrays, its first three fields, take `work_bytes` or more."""
    sizes = [8 * math.prod(shape) for shape in shapes.values()]
    begin = max(work_bytes, sum(sizes[:3]))
    offsets = [*(sum(sizes[:k]) for k in range(3)), *(begin + sum(sizes[3:k]) for k in range(3, len(sizes)))]
    formats = [("f8", shape) for shape in shapes.values()]
    end = begin + sum(sizes[3:])
    return np.dtype({"names": [*shapes], "formats": formats, "offsets": offsets, "itemsize": end})


@law
def packed_index(i: int, j: int) -> int:
    """Compute the index of row i, column j <= i in the packed lower triangle of a symmetric matrix."""
    return i * (i + 1) // 2 + j


@lru_cache(maxsize=8)
def stream_kernels(settings: StreamSettings) -> SimpleNamespace:
    """Build the kernels of a stream: `start`, `add_sample`, `advance`, `write_results` and `acknowledge`.

    - ``start(m)`` sets the state m to its beginning.
    - ``add_sample(m, p_A, p_B, flow, x)`` adds a sample in SI units, NaN or more than a sensor reads if missing.
    - ``advance(m)`` does a part of the work at the end of a block, if there is any (`m.phase`).
    - ``write_results(m, out)`` writes the results, in the order of `RESULTS`.
    - ``acknowledge(m)`` withdraws an alarm, and begins the tests anew.
    - ``resume(m)`` begins with samples anew, with what was learned before.
    """
    from scipy.special import stdtrit

    rate = settings.rate
    n_stride, block_strides, half = settings.counts
    n_block = n_stride * block_strides
    block_seconds, pause = n_block / rate, PAUSE * rate / n_block
    channels, n_columns = settings.channels, len(settings.expressions)
    row_p_A, row_p_B, row_flow, row_x = range(len(channels))
    limit_p, _, limit_flow, limit_x = (sensor_limit(CHANNEL_UNITS[name]) for name in channels)
    response, leak = n_columns - 1, n_columns - 2
    column_order, n_fast, all_columns = settings.column_order, settings.n_fast, tuple(range(n_columns))
    capacity = (SUPPORT + 1) * block_strides
    width = 2 * half + 2
    # a number of samples after which all that is counted modulo repeats
    period = math.lcm(width, n_stride * SPAN, n_block * (SUPPORT + 1))
    peak = peak_weight(rate)
    order = 0.5 + 0.5 * BOUND_PROBABILITY  # of a two-sided interval
    quantiles = tuple(float(stdtrit(freedom, order)) for freedom in range(1, WINDOW))  # Student's t
    own_size_error, own_displacement, own_threshold = settings.size_error, settings.displacement, settings.log_threshold
    leak_error = math.hypot(settings.size_error, float(LIVE.watch.law))
    basis = settings.basis
    row_width, volume = settings.row_width, settings.row_width - 1  # volume: column of the measured volume
    # without a basis the names are not used
    combination, prediction, leak_scale, left_scale = basis or ((), (), 1.0, 1.0)
    unit = 1.0 if basis is None else basis.conductance_unit
    limits = {"MAX_READING": MAX_READING, "BEYOND": BEYOND}
    to_absolute = dict(zip(("p_A", "p_B"), settings.to_absolute, strict=True))
    n_increments, n_nuisances = len(settings.increments), n_columns - 2  # all columns but the leak and the left side
    piston = settings.piston
    increments = build_increments(
        settings.increments, {name: k for k, name in enumerate(channels)}, limits, to_absolute
    )
    compute_increments = large_law(increments)

    @law
    def forget_sign(m: Any) -> None:
        """Forget the sign of the pump's recorded flow, and begin its evidence anew."""
        m.has_sign = 0
        m.sign_motion[:] = 0.0
        m.sign_loads[:, :] = 0.0

    @law
    def start(m: Any) -> None:
        """Set the state to its beginning."""
        m.size_error, m.displacement, m.log_threshold = own_size_error, own_displacement, own_threshold
        m.leak_error, m.angle_sign = leak_error, 1.0
        m.usual_precision = m.leak_size = m.leak_deviation = m.leak_onset = m.block_end = 0.0
        m.sample_count = m.n_ended = m.n_weighted = m.n_open = m.n_closed = m.n_waiting = m.n_moving = m.n_still = 0
        m.n_estimated = m.n_tested = m.n_dropped = m.n_relearned = m.n_rows = m.n_closed_rows = m.phase = m.place = 0
        m.iteration = 0
        m.has_converged = m.is_fitting = m.halvings = m.alarm = m.first_closed = m.first_number = 0
        m.reason = _LEARNING
        forget_sign(m)
        m.slow_sums[:, :] = 0.0
        m.model.sums[:, :] = 0.0
        m.model.values[:] = 0.0
        m.model.leak_products[:] = 0.0
        m.model.numbers[:] = 0.0
        step.start_detector(m.steps)

    @law
    def add_pressure_difference(m: Any, k: int) -> None:
        """Add abs(p_A - p_B) [Pa] of sample interval k to the sums of its block."""
        slot = (k // n_block) % (SUPPORT + 1)  # of this block in the ring buffer `pressure_sums`
        if k % n_block == 0:
            m.pressure_sums[slot, _SUM] = m.pressure_sums[slot, _NUMBER] = 0.0
        # the leak's increment: mean of p_A - p_B over the interval, times its duration 1/rate. An interval with a
        # missing measurement, also of the pump's flow, is left out, as by the volume balance
        difference = abs(m.increments[leak]) * rate
        if difference < MAX_READING and abs(m.increments[response]) < MAX_READING:
            m.pressure_sums[slot, _SUM] += difference
            m.pressure_sums[slot, _NUMBER] += 1.0

    @law
    def copy_row(m: Any, place: int, slot: int) -> None:
        """Copy the row that is finished in `slot` to `place` of the rows."""
        for j in range(n_columns):
            m.rows[place, j] = m.unfinished[slot, j]

    @large_law
    def transform_row(m: Any, place: int, slot: int) -> None:
        """Write the row that is finished in `slot` to `place` of the rows, in the columns of the basis."""
        entry, left = 0, m.unfinished[slot, response]
        m.rows[place, volume] = left * left_scale
        for i in range(n_columns - 2):
            total = 0.0
            for k in range(i + 1):
                total += combination[entry + k] * m.unfinished[slot, k]
            entry += i + 1
            m.rows[place, i] = total
            left -= prediction[i] * m.unfinished[slot, i]
        m.rows[place, leak] = m.unfinished[slot, leak] * leak_scale
        m.rows[place, response] = left * left_scale

    store_row = copy_row if basis is None else transform_row

    @large_law
    def add_sign_evidence(m: Any, slot: int) -> None:
        """Add the row that is finished in `slot` to the evidence on the sign of the pump's recorded flow."""
        motion, flow = 0.0, m.unfinished[slot, response]
        for j in piston:
            motion += m.unfinished[slot, j]
        add_motion(m.sign_motion, motion, flow)
        add_load(m.sign_loads[0], m.unfinished[slot, leak], flow)
        for j in range(n_columns, n_increments):
            add_load(m.sign_loads[1], m.unfinished[slot, j], flow)

    @law
    def add_sample(m: Any, p_A: float, p_B: float, flow: float, x: float) -> None:
        """Add a sample to the state; after the last row of a block, begin the work at its end."""
        n_samples = int(m.sample_count)
        newest = n_samples % width
        has_pressures = abs(p_A) <= limit_p and abs(p_B) <= limit_p  # False for NaN
        if has_pressures and abs(flow) <= limit_flow and abs(x) <= limit_x:
            m.ring[row_p_A, newest], m.ring[row_p_B, newest] = p_A, p_B
            m.ring[row_flow, newest], m.ring[row_x, newest] = flow, x
        else:  # the leak's increment is beyond `MAX_READING` in each interval with such a sample
            m.ring[row_p_A, newest], m.ring[row_p_B, newest] = BEYOND, -BEYOND
            m.ring[row_flow, newest] = m.ring[row_x, newest] = BEYOND
        m.sample_count = n_samples + 1 if n_samples + 1 < 2 * period else n_samples + 1 - period
        k = n_samples - half - 1  # the newest interval that has `half` samples after it
        if k < 0:
            return
        compute_increments(m.ring, k, half, rate, m.displacement, m.increments)
        add_pressure_difference(m, k)
        stride, k_in_stride = k // n_stride, k % n_stride
        add_to_rows(m.unfinished, m.increments, k, n_stride, peak)
        # number of the row that is finished at the end of this stride; < 0 if it began before the first sample
        row = stride - SPAN + 1
        if k_in_stride < n_stride - 1 or row < 0:
            return
        is_finite, place = True, int(m.n_rows)
        if place < capacity:
            store_row(m, place, row % SPAN)
            for j in range(row_width):
                is_finite = is_finite and abs(m.rows[place, j]) < MAX_READING
            if is_finite:  # a row with a missing measurement is overwritten by the next
                m.n_rows = place + 1
                if m.has_sign == 0:
                    add_sign_evidence(m, row % SPAN)
        if row % block_strides == block_strides - 1:
            end_block(m, (row // block_strides) % (SUPPORT + 1))

    @law
    def end_block(m: Any, slot: int) -> None:
        """End the newest block, and begin the work on all open ones; `slot`: its place in `pressure_sums`.

        A block is open until its rows are weighted. The first `SUPPORT` blocks stay open until the last of them ends.
        """
        m.n_ended += 1
        if m.phase != IDLE:  # the work on an earlier block is not done: leave this one out
            m.n_rows = m.n_closed_rows
            m.n_dropped += 1
            m.reason = _OVERRUN
            return
        m.ends[int(m.n_open)] = m.n_rows
        m.n_open += 1
        if m.n_weighted == 0 and m.n_open < SUPPORT:
            return
        for b in range(int(m.n_open)):
            m.closed_ends[b] = m.ends[b]
        m.n_closed, m.n_closed_rows, m.n_open = m.n_open, m.n_rows, 0
        m.first_closed, m.first_number = (slot - m.n_closed + 1) % (SUPPORT + 1), m.n_ended - m.n_closed
        m.n_weighted = min(m.n_weighted + m.n_closed, 1000000)
        for r in range(int(m.n_closed_rows)):
            m.workspace.weights[r] = 1.0
        m.place = m.iteration = 0
        m.has_converged = 1 if m.n_closed_rows == 0 else 0  # then one pass computes Gram matrices of zeros
        m.phase = PRODUCTS

    @large_law
    def weigh_part(m: Any) -> None:
        """Do a part of the weighting of rows: see `rows.weigh_rows`.

        In the last pass, with the final weights, each block is used as soon as its Gram matrix is computed.
        """
        b, n_closed, n_closed_rows = int(m.place), int(m.n_closed), int(m.n_closed_rows)
        is_last = m.has_converged == 1 or m.iteration == MAX_ITERATIONS
        if m.phase == PRODUCTS:
            begin = int(m.closed_ends[max(b - 1, 0)]) if b > 0 else 0
            sum_products(m.rows, begin, int(m.closed_ends[b]), m.workspace.weights, m.gram)
            m.phase = REDUCE
        elif m.phase == REDUCE:
            if b == 0:
                start_normal(m.workspace.normal, m.slow_sums, is_last)
            eliminate_fast(m.gram, column_order, n_fast, m.workspace.reduced)
            add_reduced(m.workspace, b, n_fast)
            if is_last:
                m.phase = BLOCK
            else:
                begin_next_block(m)
        elif m.phase == NORMAL:
            if is_last:
                if m.n_weighted > 0:  # a later block changes the sums less
                    move_sums(m.workspace.normal, m.slow_sums, n_closed, min(1.0, SUPPORT / m.n_weighted))
                else:
                    m.slow_sums[:, :] = 0.0
                m.place = 0
                m.phase = WEIGH if m.steps.n_onsets > 0 else FINISH
            else:
                fit_blocks(m.workspace, n_closed, n_fast)
                m.phase = REWEIGH
        else:
            has_converged = reweigh(m.rows[:n_closed_rows], m.closed_ends[:n_closed], column_order, m.workspace)
            m.has_converged = 1 if has_converged else 0
            m.iteration += 1
            m.place = 0
            m.phase = PRODUCTS

    @law
    def begin_next_block(m: Any) -> None:
        """Begin the work on the next block of a pass, or after the last one on the normal equations."""
        m.place += 1
        m.phase = PRODUCTS if m.place < m.n_closed else NORMAL

    @large_law
    def find_flow_sign(m: Any) -> None:
        """Find the sign of the pump's recorded flow, `m.angle_sign`, 1 or -1, by `sum_log_odds`.

        The leak is that of the blocks that wait for the first fit. The sign is final once the piston has surely moved.
        """
        block, n_rows = m.model.block, 0.0
        for i in range(n_columns):
            for j in range(i + 1):
                total = 0.0
                for k in range(LEARNED):
                    total += m.waiting_grams[k, packed_index(i, j)]
                block[i, j] = block[j, i] = total
        for k in range(LEARNED):
            n_rows += m.waiting_sizes[k, _BLOCK_ROWS]
        whole_energy = block[leak, leak]
        eliminate(block, n_nuisances)
        energy, moment, square = block[leak, leak], block[leak, response], block[response, response]
        leak_z = leak_score(energy, moment, square, whole_energy, n_rows - n_nuisances - 1.0)
        motion_z = z_score(m.sign_motion[0], m.sign_motion[1])
        log_odds = sum_log_odds(leak_z, m.sign_loads[0], m.sign_loads[n_increments - n_columns], motion_z)
        m.angle_sign = -1.0 if log_odds < 0.0 else 1.0
        m.has_sign = 1 if abs(motion_z) > MOTION_SCORE else 0

    @law
    def correct_sign(m: Any) -> None:
        """Correct the sign of the response in `m.model.block` by `m.angle_sign`."""
        for j in range(response):
            m.model.block[j, response] *= m.angle_sign
            m.model.block[response, j] *= m.angle_sign

    @law
    def load_waiting_block(m: Any, k: int) -> None:
        """Copy the Gram matrix of waiting block k to `m.model.block`, with the sign of `m.angle_sign`."""
        for i in range(n_columns):
            for j in range(i + 1):
                m.model.block[i, j] = m.waiting_grams[LEARNED - 1 - k, packed_index(i, j)]
                m.model.block[j, i] = m.model.block[i, j]
        m.model.volume[0] = m.waiting_grams[LEARNED - 1 - k, packed_index(volume, volume)]
        correct_sign(m)

    @large_law
    def append_conductance(m: Any, n_rows: float, pressure: float, number: float, is_learned: bool) -> None:
        """Estimate the leakage conductance of the block loaded in `m.model`, and append it to the history.

        An estimate is left out if it is too uncertain. `n_rows`, `pressure` [Pa], `number`: rows of the volume balance
        in the block, its mean abs(p_A - p_B), and its number; `is_learned`: True if the balance's other coefficients
        are updated with the block.
        """
        model = m.model
        motion = relative_motion(model.volume[0], n_rows, model.numbers)
        # G and the shift are multiplied by the precision, the systematic variance of G by the square of the precision
        precision, weighted_G, weighted_shift, weighted_systematic = estimate_leak(model, n_rows, is_learned=is_learned)
        results = precision + weighted_G + weighted_shift + weighted_systematic + model.numbers[NOISE]
        misfit = model.numbers[MISFIT] if is_learned else 1.0
        judgement = judge_estimate(m, motion, misfit, results, precision, 0.0)
        if judgement == OUTDATED:
            learn_anew(m)
            return
        if judgement == UNCERTAIN:
            m.reason = _STANDSTILL
            return
        G, history, k = weighted_G / precision, m.history, int(m.n_estimated) % WINDOW
        comparable_G = G - weighted_shift / precision  # without jumps where the other coefficients improve
        history[k, _G], history[k, _COMPARABLE_G], history[k, _VARIANCE] = G, comparable_G, 1.0 / precision
        history[k, _SYSTEMATIC_VARIANCE] = weighted_systematic / precision / precision + (m.size_error * G) ** 2
        history[k, _PRESSURE], history[k, _HISTORY_NUMBER] = pressure, number
        m.n_estimated += 1
        m.reason = 0

    @large_law
    def take_part(m: Any) -> None:
        """Give the next block of the history to the detector of steps, whose unit of time is a block."""
        k, steps = int(m.n_tested) % WINDOW, m.steps
        if steps.n_blocks > _MOST_BLOCKS:  # times remain small, also in single precision
            shift_times(m)
        number, g = m.history[k, _HISTORY_NUMBER], m.history[k, _COMPARABLE_G]
        if steps.has_level == 1 and number - steps.end > pause:
            step.forget_onsets(steps)
        step.take_estimate(steps, number - steps.end + 1.0, number, number + 1.0, g, math.sqrt(m.history[k, _VARIANCE]))
        m.block_end = number + 1.0
        m.n_tested += 1

    @law
    def shift_times(m: Any) -> None:
        """Count blocks and their times from a later block on."""
        steps = m.steps
        steps.n_blocks -= _SHIFTED_BLOCKS
        steps.end -= _SHIFTED_BLOCKS
        m.n_ended -= _SHIFTED_BLOCKS
        m.leak_onset -= _SHIFTED_BLOCKS
        for b in range(int(steps.n_stored)):
            steps.blocks[b, step.BLOCK] -= _SHIFTED_BLOCKS
            steps.blocks[b, step.BEGIN] -= _SHIFTED_BLOCKS
            steps.blocks[b, step.END] -= _SHIFTED_BLOCKS
        for k in range(WINDOW):
            m.history[k, _HISTORY_NUMBER] -= _SHIFTED_BLOCKS

    @law
    def forget_coefficients(m: Any) -> None:
        """Discard coefficients and estimates, such as those of a standstill, which do not hold in motion.

        The weighting of the rows (`slow_sums`) remains, as after `LiveBalance.relearn`.
        """
        model = m.model
        model.sums[:, :] = 0.0
        model.leak_products[:] = 0.0
        model.numbers[:] = 0.0
        m.usual_precision = 0.0
        m.n_moving = m.n_still = m.n_estimated = m.n_tested = 0
        m.reason = _LEARNING
        step.forget_onsets(m.steps)

    @law
    def learn_anew(m: Any) -> None:
        """Discard all that was learned, and count it."""
        forget_coefficients(m)
        step.start_detector(m.steps)
        forget_sign(m)
        m.n_weighted = 0
        m.n_relearned += 1
        m.reason = _RELEARNING

    @law
    def use_block(m: Any) -> None:
        """Estimate the leakage of the block at `place`, or store it until `LEARNED` blocks are fitted together.

        Before the first fit, blocks are only stored, beginning with the first that has motion. If the machine is taken
        to have stood still before (`is_waking`), all estimates are discarded, and the first fit is repeated.
        """
        b = int(m.place)
        n_rows = m.closed_ends[b] - (m.closed_ends[max(b - 1, 0)] if b > 0 else 0.0)
        slot = (m.first_closed + b) % (SUPPORT + 1)  # of this block in the ring buffer `pressure_sums`
        pressure = m.pressure_sums[slot, _SUM] / max(m.pressure_sums[slot, _NUMBER], 1.0)
        number = float(m.first_number + b)
        if not n_rows > 0.0:
            m.reason = _MISSING
            return
        motion_square = m.gram[volume, volume]
        if m.usual_precision > 0.0:  # after the first fit
            if is_waking(m, relative_motion(motion_square, n_rows, m.model.numbers)):
                forget_coefficients(m)
                return
            load_block(m.model, m.gram, all_columns)
            m.model.volume[0] = motion_square
            correct_sign(m)
            append_conductance(m, n_rows, pressure, number, is_learned=True)
            return
        k = int(m.n_waiting)
        if k == 0 and not motion_square > 0.0:  # blocks before the first motion are left out
            m.reason = _STANDSTILL
            return
        m.waiting_sizes[k, _BLOCK_ROWS], m.waiting_sizes[k, _BLOCK_PRESSURE] = n_rows, pressure
        m.waiting_sizes[k, _BLOCK_NUMBER] = number
        if m.steps.n_stored > 0:  # its memory is now that of the waiting blocks
            step.forget_onsets(m.steps)
        for i in range(row_width):
            for j in range(i + 1):
                m.waiting_grams[LEARNED - 1 - k, packed_index(i, j)] = m.gram[i, j]
        m.n_waiting = k + 1
        if k + 1 == LEARNED:
            m.is_fitting = 1

    @large_law
    def fit_part(m: Any) -> None:
        """Do a part of the first fit: of the balance to the first `LEARNED` blocks, and of the leakage in each."""
        if m.phase == FIT_SIGN:
            if m.has_sign == 0:
                find_flow_sign(m)
            m.phase = FIT_ADD
            return
        k, model = int(m.n_waiting) - LEARNED, m.model  # `n_waiting` counts on from `LEARNED` in each part
        if m.phase == FIT:
            fit_coefficients(model)
            m.n_waiting, m.phase = LEARNED, FIT_PRECISION
            return
        load_waiting_block(m, k)
        n_rows, pressure = m.waiting_sizes[k, _BLOCK_ROWS], m.waiting_sizes[k, _BLOCK_PRESSURE]
        if m.phase == FIT_ADD:
            add_block(model, n_rows, weight=1.0, has_stepped=False)
        elif m.phase == FIT_PRECISION:  # is_learned: False, as the blocks are in the sums already
            m.precisions[k], _, _, _ = estimate_leak(model, n_rows, is_learned=False)
        else:
            append_conductance(m, n_rows, pressure, m.waiting_sizes[k, _BLOCK_NUMBER], is_learned=False)
        m.n_waiting += 1
        if k + 1 < LEARNED:
            return
        m.n_waiting = LEARNED
        if m.phase == FIT_ADD:
            m.phase = FIT
        elif m.phase == FIT_PRECISION:
            m.usual_precision = median(m.precisions, LEARNED)
            m.phase = FIT_APPEND
        else:
            m.n_waiting = m.is_fitting = 0
            m.phase = TAKE

    @large_law
    def test_part(m: Any) -> None:
        """Do a part of the test for a step: weigh the onsets, decide, and find the bound."""
        steps, n_onsets, first = m.steps, int(m.steps.n_onsets), int(m.place)
        last = min(first + (WEIGHED_A_CALL if m.phase == WEIGH else ADDED_A_CALL), n_onsets)
        if m.phase == WEIGH:
            if first == 0:
                step.start_evidence(steps)
            for j in range(first, last):
                step.weigh_onset(steps, j)
            m.place = last
            if last == n_onsets:
                m.phase = DECIDE
        elif m.phase == DECIDE:
            step.finish_evidence(steps)
            if steps.log_e > m.log_threshold:
                m.alarm = 1
                m.leak_size, m.leak_deviation, m.leak_onset = steps.size, steps.size_deviation, steps.onset
            step.start_bound(steps)
            m.place = m.halvings = 0
            m.phase = BOUND if n_onsets > 0 and m.alarm == 0 else FINISH
        else:
            x = 0.5 * (steps.low + steps.high) if m.halvings > 0 else 0.0
            for j in range(first, last):
                step.add_exceedance(steps, j, x)
            m.place = last
            if last == n_onsets:
                step.bisect_bound(steps)
                m.halvings += 1
                m.place = 0
                if m.halvings > HALVINGS:
                    m.phase = FINISH

    @law
    def finish_blocks(m: Any) -> None:
        """End the work on the closed blocks: the rows of open ones move to the beginning."""
        n_closed_rows, n_rows = int(m.n_closed_rows), int(m.n_rows)
        for r in range(n_closed_rows, n_rows):
            for j in range(row_width):
                m.rows[r - n_closed_rows, j] = m.rows[r, j]
        m.n_rows = n_rows - n_closed_rows
        m.n_closed = m.n_closed_rows = m.place = 0
        m.phase = IDLE

    @law
    def advance(m: Any) -> None:
        """Do a part of the work at the end of a block, if there is any."""
        if m.phase == IDLE:
            return
        if m.phase <= REWEIGH:
            weigh_part(m)
        elif m.phase == BLOCK:
            use_block(m)
            if m.is_fitting == 1:
                m.n_waiting, m.phase = LEARNED, FIT_SIGN
            else:
                m.phase = TAKE
        elif m.phase <= FIT_APPEND:
            fit_part(m)
        elif m.phase == TAKE:
            if m.n_tested < m.n_estimated:
                take_part(m)
            else:
                begin_next_block(m)
        elif m.phase <= BOUND:
            test_part(m)
        else:
            finish_blocks(m)

    @large_law
    def mean_of(history: Any, newest: int, n: int, column: int) -> float:
        """Compute the mean of a `column` of the ring buffer `history` over the n blocks up to block number `newest`."""
        total = 0.0
        for k in range(n):
            total += history[(newest - k) % WINDOW, column] / n
        return float(total)

    @law
    def acknowledge(m: Any) -> None:
        """Withdraw an alarm, and begin the tests anew."""
        m.alarm = 0
        m.leak_size = m.leak_deviation = m.leak_onset = 0.0
        step.forget_onsets(m.steps)
        if m.phase >= WEIGH:  # the onsets are gone
            m.phase = FINISH

    @law
    def resume(m: Any) -> None:
        """Begin with samples anew, after a power cut, with what was learned before."""
        m.sample_count = m.n_ended = m.n_open = m.n_closed = m.n_waiting = m.n_moving = m.n_still = m.n_estimated = 0
        m.n_tested = m.n_rows = m.n_closed_rows = m.phase = m.place = m.iteration = m.has_converged = m.is_fitting = 0
        m.block_end = m.leak_onset = 0.0
        m.reason = 0 if m.usual_precision > 0.0 else _LEARNING
        step.forget_onsets(m.steps)

    @law
    def write_results(m: Any, out: Any) -> None:
        """Write the results in the order of `RESULTS`, by the formulas of the module's docstring.

        At most the last `WINDOW` blocks count. The leakage needs two blocks; without them it is 0.
        """
        history, n_estimated, newest = m.history, int(m.n_estimated), int(m.n_estimated) - 1
        for k in range(len(RESULTS)):
            out[k] = 0.0
        out[_OUT_MISFIT], out[_OUT_BLOCKS], out[_OUT_REASON] = m.model.numbers[MISFIT], m.n_estimated, m.reason
        out[_OUT_THRESHOLD], out[_OUT_ALARM] = m.log_threshold, m.alarm
        out[_OUT_SCORE] = max(m.steps.log_e, 0.0) if m.steps.n_onsets > 0 else 0.0
        n = min(n_estimated, WINDOW)
        if n < 2:
            return
        G, pressure = mean_of(history, newest, n, _G), mean_of(history, newest, n, _PRESSURE)
        g, scatter = mean_of(history, newest, n, _COMPARABLE_G), 0.0
        for k in range(n):
            scatter += (history[(newest - k) % WINDOW, _COMPARABLE_G] - g) ** 2 / (n - 1.0)
        variance = max(scatter, mean_of(history, newest, n, _VARIANCE)) / n
        half_width = math.hypot(  # of random and systematic errors; quantiles[n - 2] has n - 1 degrees of freedom
            quantiles[n - 2] * math.sqrt(variance),
            WITHIN_95 * math.sqrt(mean_of(history, newest, n, _SYSTEMATIC_VARIANCE)),
        )
        pressure *= unit
        out[_OUT_G], out[_OUT_Q] = unit * G, pressure * G
        out[_OUT_Q_LOW], out[_OUT_Q_HIGH] = pressure * (G - half_width), pressure * (G + half_width)
        if m.alarm == 1:
            half_width = WITHIN_95 * math.hypot(m.leak_deviation, m.leak_error * m.leak_size)
            out[_OUT_LEAK] = pressure * m.leak_size
            out[_OUT_LEAK_LOW] = pressure * max(m.leak_size - half_width, 0.0)
            out[_OUT_LEAK_HIGH] = pressure * (m.leak_size + half_width)
            out[_OUT_SINCE] = (m.block_end - m.leak_onset) * block_seconds
        elif m.steps.n_onsets > 0:
            out[_OUT_BOUND] = pressure * m.steps.bound * (1.0 + WITHIN_95 * m.leak_error)

    return SimpleNamespace(
        start=start,
        add_sample=add_sample,
        advance=advance,
        write_results=write_results,
        acknowledge=acknowledge,
        resume=resume,
    )
