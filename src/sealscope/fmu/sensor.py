"""The code of a soft sensor, a functional mock-up unit (FMU) that estimates leakage: functions that C can call.

The equations are those of the live volume balance (`diagnosis.live`, `diagnosis.inference`). A row is this balance,
integrated with a test function over `SPAN` strides (`rows.weak_form`); a row begins every stride of about 0.125 s. Each
sample adds the increments of the balance's terms to the unfinished rows. The rows of a block of 3 s are weighted and
summed to a Gram matrix, the products of all terms, from which the block's leakage conductance is estimated. Only the
last samples are stored, about 2 `HALF_DIFFERENCE` seconds.

The mean conductance G of the last n blocks (at most `WINDOW`) has the interval

    G +- hypot(t_(n-1) sqrt(v/n), 1.96 o),    v = max(s^2, mean of sd^2)

with the standard deviation s of the blocks' estimates, their standard errors sd, Student's t, and the systematic
standard error o due to the other coefficients and to the machine's sizes (displacement, piston area). The rise is the
mean of the last n blocks minus that of the first N = `WINDOW` blocks, the baseline, d blocks earlier from middle to
middle. Its variance is

    variance of the rise = v/n + v_0/N + w d sigma^2,    sigma^2 = v_0/(1 + w (N + 1)/6)

with the variance v_0 of the baseline's blocks. The last term is the random walk of a healthy machine: in each block
its variance grows by w = `WALK` times the variance sigma^2 of a block's noise. The divisor is there because this walk
adds w (N + 1)/6 times sigma^2 to v_0. The interval of the rise is formed like that of G, with o from the machine's
sizes alone. The flow is G times the mean of abs(p_A - p_B) as recorded; the live balance also subtracts the sensors'
noise from this mean, a few per cent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numba import carray

from sealscope.compiled import large_law, law, record_dtype, record_view
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.equations.signals import HALF_DIFFERENCE, MIN_ABSOLUTE_PRESSURE
from sealscope.diagnosis.inference.onset import BOUND_PROBABILITY, WITHIN_95
from sealscope.diagnosis.inference.rows.row_weights import SUPPORT, Workspace, median, weigh_rows, workspace_shapes
from sealscope.diagnosis.inference.rows.weak_form import MAX_READING, SPAN, STRIDE, stride_samples, test_function
from sealscope.diagnosis.live.balance import (
    BLOCK_SECONDS,
    LEARNED,
    MIN_REST_PRECISION,
    N_WAKING,
    live_equations,
    size_error,
)
from sealscope.diagnosis.live.coefficients import (
    MISFIT,
    STANDSTILL,
    Coefficients,
    add_block,
    coefficient_shapes,
    estimate_leak,
    fit_coefficients,
    load_block,
    relative_motion,
)
from sealscope.errors import InputError
from sealscope.fmu.machine import unit_code
from sealscope.fmu.variables import SENSOR_RESULTS, VALUES, Variable, input_variables, output_variables, rig_variable
from sealscope.parameters import Rig
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES
from sealscope.units import P_ATM

#: Channels that a soft sensor reads, in the order of the samples.
INPUTS = ("p_A", "p_B", "theta", "x")
_P_A, _P_B, _THETA, _X = range(len(INPUTS))
#: Results of a function of a soft sensor: success, or a code of `FAILURES` with its message.
_SUCCESS, _NO_DISPLACEMENT = 0, 1
FAILURES = MappingProxyType({_NO_DISPLACEMENT: "pump.q_b must be > 0 m^3/rev"})
#: The only parameter of the rig that the balance reads: the pump's displacement [m^3/rev], and its index in `VALUES`.
DISPLACEMENT = "pump.q_b"
_DISPLACEMENT_INDEX = VALUES.index(DISPLACEMENT)
#: Number of blocks of a mean, and of the baseline.
WINDOW = 20
#: Variance of a healthy machine's random walk in a block, as the oil warms, relative to that of a block's noise.
WALK = 3.0
#: Columns of a row in the order of `_compute_increments`: the regressors, then the response, the pump's flow.
COLUMNS = (
    *(f"motion {way}, {side} carries" for way in ("out", "in") for side in "AB"),
    *(name for s in "AB" for name in (f"compliance {s}", f"compliance {s} over the stroke", f"free air {s}",
                                      f"dissolving air {s}")),
    "lag", "bias", "leak through a gap", "response",
)  # fmt: skip
_N_COLUMNS, _MOTION, _COMPLIANCE = len(COLUMNS), 0, (COLUMNS.index("compliance A"), COLUMNS.index("compliance B"))
_LAG, _BIAS, _LEAK, _RESPONSE = (COLUMNS.index(name) for name in ("lag", "bias", "leak through a gap", "response"))
_ALL_COLUMNS = tuple(range(_N_COLUMNS))
#: Columns of `history`, the results of the last blocks: conductance G estimated with the present coefficients [m^3/(s
#: Pa)], a conductance g that can be compared between blocks, its variance, the systematic variance of G, and the mean
#: of abs(p_A - p_B) [Pa].
_G, _COMPARABLE_G, _VARIANCE, _SYSTEMATIC_VARIANCE, _PRESSURE = range(5)
#: Indices of the outputs.
(
    _OUT_Q, _OUT_Q_LOW, _OUT_Q_HIGH, _OUT_RISE, _OUT_RISE_LOW, _OUT_RISE_HIGH, _OUT_G, _OUT_MISFIT, _OUT_BLOCKS,
    _OUT_SETTLED,
) = range(len(SENSOR_RESULTS))  # fmt: skip
#: Columns of `pressure_sums`: the sum of abs(p_A - p_B) [Pa] over a block's samples, and their number.
_SUM, _NUMBER = 0, 1
#: Columns of `waiting_sizes`: number of rows, and mean abs(p_A - p_B) [Pa], of a block.
_BLOCK_ROWS, _BLOCK_PRESSURE = 0, 1
#: Scalars of a soft sensor's memory: `size_error` of its `SensorChoice`; time to the next sample [s]; number of
#: samples; sign of the angle, 1 or -1; number of blocks weighted, of open blocks and of their rows, and of blocks that
#: wait for the first fit; median precision of a block; number of successive blocks of larger motion, and of blocks
#: estimated; sums over the baseline of g, of g^2 and of its variance.
_SCALARS = (
    "size_error", "clock", "sample_count", "angle_sign", "n_weighted", "n_open", "n_rows", "n_waiting",
    "usual_precision", "n_moving", "n_estimated", "base_sum", "base_square_sum", "base_variance_sum",
)  # fmt: skip


def variables(rig: Rig) -> Iterator[Variable]:
    """Yield the variables of a soft sensor's FMU: measurements, the pump's displacement and the estimated leakage."""
    yield from input_variables({name: (CHANNEL_UNITS[name], f"reading: {LONG_NAMES[name]}") for name in INPUTS})
    yield from filter(None, [rig_variable(rig, DISPLACEMENT, "fixed")])
    yield from output_variables(SENSOR_RESULTS)


class SensorChoice(NamedTuple):
    """The settings that are compiled into a soft sensor."""

    rate: float  # sampling rate [Hz]
    size_error: float  # relative standard error of the leakage due to the machine's displacement and piston area
    # indices into `COLUMNS`: first the `n_fast` terms fitted to each block, then the other terms, last the response
    column_order: tuple[int, ...]
    n_fast: int

    @classmethod
    def from_rig(cls, rig: Rig, rate: float) -> SensorChoice:
        """Choose the settings of a soft sensor for a rig and the sampling rate `rate` [Hz].

        Raises InputError if the terms of the rig's volume balance are not those of `COLUMNS`.
        """
        (balance,) = live_equations(rig, INPUTS)  # these channels allow one balance only
        columns = ColumnRoles(balance)
        if columns.names != COLUMNS[:-1]:
            raise InputError(f"a soft sensor's terms must be {', '.join(COLUMNS[:-1])}, got {', '.join(columns.names)}")
        fast = columns.fast
        column_order = (*fast, *columns.slow, columns.left)  # left: the response, the balance's left side
        return cls(rate, size_error=size_error(rig), column_order=column_order, n_fast=len(fast))


def _count_samples(rate: float) -> tuple[int, int, int]:
    """Compute the samples in a stride, the strides in a block, and the samples in half a difference, at `rate` [Hz].

    The difference is the central one of the position, whose sign is the direction of motion.
    """
    return stride_samples(rate), round(BLOCK_SECONDS / STRIDE), max(1, round(HALF_DIFFERENCE * rate))


def memory_layout(choice: SensorChoice) -> np.dtype[Any]:
    """Build the layout of a soft sensor's memory: a numpy record of the scalars `_SCALARS` and some arrays."""
    _, block_strides, half = _count_samples(choice.rate)
    n_slow = len(choice.column_order) - choice.n_fast - 1  # - 1: the response
    max_rows = SUPPORT * block_strides
    workspace = workspace_shapes(max_rows, SUPPORT, len(choice.column_order), n_slow)
    return record_dtype(
        *_SCALARS,
        ring=(len(INPUTS), 2 * half + 2),  # last samples, those that `_compute_increments` reads
        increments=(_N_COLUMNS,),  # of each term of the balance over the last sampling interval
        unfinished=(SPAN, _N_COLUMNS),  # the rows to which the present sample adds
        rows=(max_rows, _N_COLUMNS),  # finished rows of the open blocks, whose rows are not weighted yet
        ends=(SUPPORT,),  # index past the last row of each open block
        gram=(SUPPORT, _N_COLUMNS, _N_COLUMNS),  # of the blocks weighted last
        # sum of abs(p_A - p_B), and number of samples; + 1: the last rows of a block end when the next has begun
        pressure_sums=(SUPPORT + 1, 2),
        slow_sums=(n_slow + 1, n_slow + 1),  # over earlier blocks, for the coefficients not fitted to each block
        waiting_grams=(LEARNED, _N_COLUMNS, _N_COLUMNS),  # of the blocks that wait for the first fit
        waiting_sizes=(LEARNED, 2),  # `_BLOCK_ROWS` and `_BLOCK_PRESSURE` of these blocks
        precisions=(LEARNED,),  # of their estimates
        history=(WINDOW, 5),  # results of each of the last blocks (`_G` ... `_PRESSURE`)
        workspace=record_dtype(**dict(zip(Workspace._fields, workspace, strict=True))),
        # `_LEAK`, the index of the leak, is also the number of the terms before it
        model=record_dtype(**dict(zip(Coefficients._fields, coefficient_shapes(_LEAK), strict=True))),
    )


def build_functions(choice: SensorChoice) -> dict[str, Callable[..., Any]]:
    """Build the functions ``start``, ``advance`` and ``report`` of a soft sensor's FMU; return them by name.

    ``start`` clears the sensor's memory `y`, ``advance`` adds the samples of a communication step to it, and ``report``
    writes the outputs to `results`. Their arguments, some of them unused here, are those of
    `fmu.machine.build_functions`.
    """
    from scipy.special import stdtrit

    layout = memory_layout(choice)
    interval = 1.0 / choice.rate  # [s] between samples
    add_sample, memory = _build_add_sample(choice), record_view(layout)  # `memory` views `y` as a record
    n_memory = layout.itemsize // 8  # doubles
    n_inputs, n_results, n_values = len(INPUTS), len(SENSOR_RESULTS), len(VALUES)
    size_error = choice.size_error
    quantile_order = 0.5 + 0.5 * BOUND_PROBABILITY  # of a two-sided interval
    quantiles = tuple(float(stdtrit(freedom, quantile_order)) for freedom in range(1, WINDOW))  # Student's t

    def start(values: Any, inputs: Any, x_0: float, y: Any) -> int:
        carray(y, n_memory)[:] = 0.0
        memory(y).size_error = size_error
        return _SUCCESS if carray(values, n_values)[_DISPLACEMENT_INDEX] > 0.0 else _NO_DISPLACEMENT

    def advance(values: Any, inputs: Any, slopes: Any, y: Any, span: float, steps: int) -> int:
        m, displacement = memory(y), carray(values, n_values)[_DISPLACEMENT_INDEX] / (2.0 * math.pi)  # [m^3/rad]
        first, slope = carray(inputs, n_inputs), carray(slopes, n_inputs)
        t = m.clock
        while t < span - 1e-6 * interval:  # a sample at the end is the next step's first
            add_sample(
                m,
                displacement,
                p_A=first[_P_A] + slope[_P_A] * t,
                p_B=first[_P_B] + slope[_P_B] * t,
                theta=first[_THETA] + slope[_THETA] * t,
                x=first[_X] + slope[_X] * t,
            )
            t += interval
        m.clock = t - span
        return _SUCCESS

    def report(values: Any, inputs: Any, y: Any, results: Any) -> int:
        _write_results(memory(y), quantiles, carray(results, n_results))
        return _SUCCESS

    return {"start": start, "advance": advance, "report": report}


def _build_add_sample(choice: SensorChoice) -> Callable[..., Any]:
    """Build the compiled function that adds one sample of the channels `INPUTS` to a soft sensor's memory."""
    rate = choice.rate
    n_stride, block_strides, half = _count_samples(rate)
    n_support, n_block = SPAN * n_stride, n_stride * block_strides
    # phi = peak (1 - s^2)^4; the first value of `test_function` is in the middle of the first sampling interval, where
    # s = 1/n_support - 1
    peak = float(test_function(rate)[0, 0]) / (1.0 - (1.0 / n_support - 1.0) ** 2) ** 4
    finish_block = _build_finish_block(choice)

    @law
    def add_sample(m: Any, displacement: float, p_A: float, p_B: float, theta: float, x: float) -> None:
        """Add a sample to the sensor's memory m; after the last row of a block, call `finish_block`.

        `displacement` [m^3/rad] of the pump; `p_A`, `p_B` [Pa]; `theta` [rad]: angle of the pump; `x` [m]: position.
        """
        n_samples, width = int(m.sample_count), m.ring.shape[1]
        newest = n_samples % width
        m.ring[_P_A, newest], m.ring[_P_B, newest], m.ring[_THETA, newest], m.ring[_X, newest] = p_A, p_B, theta, x
        m.sample_count += 1.0
        k = n_samples - half - 1  # the newest interval that has `half` samples after it
        if k < 0:
            return
        _compute_increments(m.ring, k, half, rate, displacement, m.increments)
        _add_pressure_difference(m, k, n_block, rate)
        stride, k_in_stride = k // n_stride, k % n_stride
        for age in range(SPAN):  # add to the row that began `age` strides ago, weighted by its test function phi(s)
            slot = (stride - age) % SPAN  # of this row in `unfinished`
            s = (age * n_stride + k_in_stride + 0.5) * 2.0 / n_support - 1.0  # -1 .. 1 over the row
            phi = peak * (1.0 - s * s) ** 4
            for j in range(_N_COLUMNS):
                row_sum = 0.0 if age == 0 and k_in_stride == 0 else m.unfinished[slot, j]  # a new row begins at 0
                m.unfinished[slot, j] = row_sum + phi * m.increments[j]
        # number of the row that is finished at the end of this stride; < 0 if it began before the first sample
        row = stride - SPAN + 1
        if k_in_stride < n_stride - 1 or row < 0:
            return
        is_finite, place = True, int(m.n_rows)
        for j in range(_N_COLUMNS):
            m.rows[place, j] = m.unfinished[row % SPAN, j]
            is_finite = is_finite and abs(m.rows[place, j]) < MAX_READING
        m.n_rows += is_finite  # a row with a missing measurement is overwritten by the next
        if row % block_strides == block_strides - 1:
            # the rows of this block and of the `n_open` earlier ones, and room for the ends of all of them
            finish_block(m, m.rows[: int(m.n_rows)], m.ends[: int(m.n_open) + 1], row // block_strides)

    return add_sample  # type: ignore[no-any-return]


@law
def _add_pressure_difference(m: Any, k: int, n_block: int, rate: float) -> None:
    """Add abs(p_A - p_B) [Pa] of sample interval k to the sums of its block of `n_block` samples at `rate` [Hz]."""
    slot = (k // n_block) % (SUPPORT + 1)  # of this block in the ring buffer `pressure_sums`
    if k % n_block == 0:
        m.pressure_sums[slot, _SUM] = m.pressure_sums[slot, _NUMBER] = 0.0
    # increments[_LEAK]: mean of p_A - p_B over the interval, times its duration 1/rate. An interval with a missing
    # measurement, also of the pump's angle, is left out, as by the volume balance
    if not math.isnan(m.increments[_LEAK] + m.increments[_RESPONSE]):
        m.pressure_sums[slot, _SUM] += abs(m.increments[_LEAK]) * rate
        m.pressure_sums[slot, _NUMBER] += 1.0


@large_law
def _compute_increments(ring: Any, k: int, half: int, rate: float, displacement: float, out: Any) -> None:
    """Compute the increments of all terms of the volume balance over the interval from sample k to k + 1.

    They are written to `out` (n,) in the order of `COLUMNS`: for example, that of the response is the volume that the
    pump displaces [m^3], and that of the leak the time integral of p_A - p_B [Pa s]. `ring`: the last samples, where
    sample k has the column k modulo the width of `ring`; `half`: samples on either side of the central difference that
    shows the direction of motion; `displacement` [m^3/rad] of the pump.
    """
    width = ring.shape[1]
    slot, next_slot = k % width, (k + 1) % width
    dx, x = ring[_X, next_slot] - ring[_X, slot], 0.5 * (ring[_X, next_slot] + ring[_X, slot])
    # each end of the interval assigns half of its motion to a direction and to the side with the higher pressure,
    # which carries the load; columns: out and A, out and B, in and A, in and B
    out[_MOTION : _MOTION + 4] = 0.0
    for i in range(k, k + 2):
        is_inward = 0 if ring[_X, (i + half) % width] >= ring[_X, max(i - half, 0) % width] else 1
        B_carries = 0 if ring[_P_A, i % width] > ring[_P_B, i % width] else 1
        out[_MOTION + 2 * is_inward + B_carries] += 0.5 * dx
    for side in (_P_A, _P_B):
        before, after = ring[side, slot], ring[side, next_slot]
        absolute_before = max(before + P_ATM, MIN_ABSOLUTE_PRESSURE)
        absolute_after = max(after + P_ATM, MIN_ABSOLUTE_PRESSURE)
        column = _COMPLIANCE[side]  # then compliance over the stroke, free air and dissolving air of this side
        out[column], out[column + 1] = after - before, x * (after - before)
        out[column + 2] = 1.0 / absolute_after - 1.0 / absolute_before
        out[column + 3] = math.log(absolute_after) - math.log(absolute_before)
    earlier, later = max(k - 1, 0), k + 1
    velocity_change = ring[_X, (later + 1) % width] - ring[_X, later % width]
    velocity_change -= ring[_X, (earlier + 1) % width] - ring[_X, earlier % width]
    # change of velocity over one interval: this term corrects a position that lags the angle or leads it
    out[_LAG] = rate * velocity_change / (later - earlier)
    out[_BIAS] = 1.0 / rate
    out[_LEAK] = 0.5 * (ring[_P_A, slot] + ring[_P_A, next_slot] - ring[_P_B, slot] - ring[_P_B, next_slot]) / rate
    out[_RESPONSE] = displacement * (ring[_THETA, next_slot] - ring[_THETA, slot])


@law
def _find_angle_sign(m: Any) -> None:
    """Find the sign of the pump's recorded angle, and store it in the sensor's memory m: `m.angle_sign`, 1 or -1.

    It is the sign of the covariance between p_A - p_B and the pump's flow in the blocks that wait for the first fit:
    with the right sign, the flow rises with p_A - p_B. Blocks at standstill do not tell the sign.
    """
    weight = leak = response = product = 0.0  # sums over the rows; the bias has the same value in each row
    for k in range(LEARNED):
        gram = m.waiting_grams[k]
        weight += gram[_BIAS, _BIAS]
        leak += gram[_BIAS, _LEAK]
        response += gram[_BIAS, _RESPONSE]
        product += gram[_LEAK, _RESPONSE]
    m.angle_sign = -1.0 if product < leak * response / weight else 1.0


@law
def _load_block(m: Any, gram: Any) -> None:
    """Copy the Gram matrix of a block to `m.model.block`; correct the sign of the response by `m.angle_sign`."""
    load_block(m.model, gram, _ALL_COLUMNS)
    for j in range(_RESPONSE):
        m.model.block[j, _RESPONSE] *= m.angle_sign
        m.model.block[_RESPONSE, j] *= m.angle_sign


@large_law
def _append_conductance(m: Any, n_rows: float, pressure: float, is_learned: bool) -> None:
    """Estimate the leakage conductance of the block of samples loaded in `m.model`, and append it to the history.

    An estimate is left out if its precision (1/variance) is not positive or, at standstill, at most
    `MIN_REST_PRECISION` times the usual one. The first `WINDOW` estimates are also added to the sums of the baseline.
    `n_rows`, `pressure` [Pa]: number of rows of the volume balance in the block, and its mean abs(p_A - p_B);
    `is_learned`: True if the balance's other coefficients are updated with the block.
    """
    model = m.model
    motion = relative_motion(model.block[-1, -1], n_rows, model.numbers)  # [-1, -1]: sum of the squared response
    # G and the shift are multiplied by the precision, the systematic variance of G by the square of the precision
    precision, weighted_G, weighted_shift, weighted_systematic = estimate_leak(model, n_rows, is_learned=is_learned)
    if not precision > (MIN_REST_PRECISION * m.usual_precision if motion < STANDSTILL else 0.0):
        return
    G, history, k = weighted_G / precision, m.history, int(m.n_estimated) % WINDOW
    comparable_G = G - weighted_shift / precision  # without jumps where the other coefficients improve
    history[k, _G], history[k, _COMPARABLE_G], history[k, _VARIANCE] = G, comparable_G, 1.0 / precision
    history[k, _SYSTEMATIC_VARIANCE] = weighted_systematic / precision**2 + (m.size_error * G) ** 2
    history[k, _PRESSURE] = pressure
    m.n_estimated += 1.0
    if m.n_estimated <= WINDOW:
        m.base_sum += comparable_G
        m.base_square_sum += comparable_G * comparable_G
        m.base_variance_sum += 1.0 / precision


@large_law
def _fit_to_waiting(m: Any) -> None:
    """Fit the volume balance to the first `LEARNED` blocks of samples, and append their leakage to the history.

    These blocks wait in the sensor's memory m for the fit; afterwards no block waits. The median precision of their
    estimates is stored as `usual_precision`, with which each precision at standstill is compared.
    """
    model = m.model
    _find_angle_sign(m)
    for k in range(LEARNED):
        _load_block(m, m.waiting_grams[k])
        add_block(model, m.waiting_sizes[k, _BLOCK_ROWS], weight=1.0, has_stepped=False)
    fit_coefficients(model)
    for k in range(LEARNED):  # is_learned: False below, as the blocks are in the sums already
        _load_block(m, m.waiting_grams[k])
        m.precisions[k], _, _, _ = estimate_leak(model, m.waiting_sizes[k, _BLOCK_ROWS], is_learned=False)
    m.usual_precision = median(m.precisions, LEARNED)
    for k in range(LEARNED):
        _load_block(m, m.waiting_grams[k])
        n_rows, pressure = m.waiting_sizes[k, _BLOCK_ROWS], m.waiting_sizes[k, _BLOCK_PRESSURE]
        _append_conductance(m, n_rows, pressure, is_learned=False)
    m.n_waiting = 0.0


@law
def _forget_standstill(m: Any) -> None:
    """Discard the coefficients and estimates of a standstill in the sensor's memory m: they do not hold in motion.

    The weighting of the rows (`slow_sums`) remains, as after `LiveBalance.relearn`. What else remains is not read
    again: the history counts only up to `n_estimated`, and the next fit sets the coefficients and the angle's sign.
    """
    model = m.model
    model.sums[:, :] = 0.0
    model.leak_products[:] = 0.0
    model.numbers[:] = 0.0
    m.usual_precision = m.n_moving = m.n_estimated = m.base_sum = m.base_square_sum = m.base_variance_sum = 0.0


@large_law
def _update_with_block(m: Any, b: int, n_rows: float, pressure: float) -> None:
    """Estimate the leakage of block b from its Gram matrix `m.gram[b]`, and append it to the history.

    Before the first fit, blocks are only stored, beginning with the first that has motion; the coefficients are fitted
    to the first `LEARNED` blocks together. After `N_WAKING` successive blocks whose mean square motion is more than
    1/`STANDSTILL` times that of earlier blocks, the machine is taken to have stood still before: all estimates are
    discarded, and the first fit is repeated. `n_rows`, `pressure`: as in `_append_conductance`.
    """
    model, motion_square = m.model, m.gram[b, _RESPONSE, _RESPONSE]
    if m.usual_precision > 0.0:  # after the first fit
        motion = relative_motion(motion_square, n_rows, model.numbers)
        m.n_moving = m.n_moving + 1.0 if motion > 1.0 / STANDSTILL else 0.0
        if m.n_moving >= N_WAKING:
            _forget_standstill(m)
            return
        _load_block(m, m.gram[b])
        _append_conductance(m, n_rows, pressure, is_learned=True)
        return
    k = int(m.n_waiting)
    if k == 0 and not motion_square > 0.0:  # blocks before the first motion are left out
        return
    m.waiting_sizes[k, _BLOCK_ROWS], m.waiting_sizes[k, _BLOCK_PRESSURE] = n_rows, pressure
    for i in range(_N_COLUMNS):
        for j in range(_N_COLUMNS):
            m.waiting_grams[k, i, j] = m.gram[b, i, j]
    m.n_waiting += 1.0
    if k + 1 == LEARNED:
        _fit_to_waiting(m)


def _build_finish_block(choice: SensorChoice) -> Callable[..., Any]:
    """Build the compiled function of a soft sensor that is called when a block's last row is complete."""
    column_order, n_fast = choice.column_order, choice.n_fast

    @large_law
    def finish_block(m: Any, rows: Any, ends: Any, block: int) -> None:
        """Finish the newest block: weight the rows of all open blocks, and use each in the estimate of the leakage.

        A block is open until its rows are weighted. The first `SUPPORT` blocks stay open until the last of them ends.
        `rows`: rows of the volume balance in the open blocks; `ends`: index past the last row of each open block, the
        last to be set here; `block`: number of the newest block in the run, from 0.
        """
        n_rows, n_open, is_first = len(rows), len(ends), m.n_weighted == 0.0
        ends[n_open - 1] = n_rows
        m.n_open = n_open
        if is_first and n_open < SUPPORT:
            return
        m.n_weighted += n_open
        weigh_rows(
            rows,
            ends,
            column_order=column_order,
            n_fast=n_fast,
            earlier_sums=m.slow_sums,
            update_fraction=min(1.0, SUPPORT / m.n_weighted),  # a later block changes the sums less
            workspace=m.workspace,
            gram=m.gram,
        )
        m.n_open = m.n_rows = 0.0  # no block is open any more
        for b in range(n_open):
            block_rows = ends[b] - (ends[b - 1] if b else 0.0)
            slot = (block - n_open + 1 + b) % (SUPPORT + 1)  # of this block in the ring buffer `pressure_sums`
            pressure = m.pressure_sums[slot, _SUM] / max(m.pressure_sums[slot, _NUMBER], 1.0)
            if block_rows > 0.0:
                _update_with_block(m, b, block_rows, pressure)

    return finish_block  # type: ignore[no-any-return]


@large_law
def _mean(history: Any, newest: int, n: int, column: int) -> float:
    """Compute the mean of a `column` of the ring buffer `history` over the n blocks up to block number `newest`."""
    total = 0.0
    for k in range(n):
        total += history[(newest - k) % WINDOW, column] / n
    return float(total)


@large_law
def _variance_of_mean(history: Any, newest: int, n: int) -> float:
    """Compute the variance of the mean conductance of the n >= 2 blocks up to block `newest`.

    It is the larger of two variances, divided by n: the sample variance of the blocks' comparable estimates g, and the
    mean of the variances that the fit gives these estimates. `history` (WINDOW, 5): ring buffer of the blocks' results.
    """
    mean, sample_variance = _mean(history, newest, n, _COMPARABLE_G), 0.0
    for k in range(n):
        sample_variance += (history[(newest - k) % WINDOW, _COMPARABLE_G] - mean) ** 2 / (n - 1.0)
    return float(max(sample_variance, _mean(history, newest, n, _VARIANCE)) / n)


@law
def _write_results(m: Any, quantiles: Any, out: Any) -> None:
    """Compute the outputs of the soft sensor by the formulas of the module's docstring, and write them to `out`.

    With means over the last blocks, and p = abs(p_A - p_B),

        leakage = (mean of p) (mean of G),
        rise = (mean of p) ((mean of g) - (mean of g in the baseline)),

    where G is a block's conductance, and g the one that can be compared between blocks (`_COMPARABLE_G`), whose scatter
    gives both intervals. At most the last `WINDOW` blocks count, for the rise without those of the baseline. The
    leakage needs two blocks, the rise and the flag `settled` need two blocks after the baseline; without them these
    outputs are 0. `quantiles`: Student's t for 1, 2, ... degrees of freedom; `out`: in the order of `SENSOR_RESULTS`.
    """
    out[:] = 0.0
    history, n_estimated, newest = m.history, int(m.n_estimated), int(m.n_estimated) - 1
    out[_OUT_MISFIT], out[_OUT_BLOCKS] = m.model.numbers[MISFIT], m.n_estimated
    n = min(n_estimated, WINDOW)
    if n < 2:
        return
    G, pressure = _mean(history, newest, n, _G), _mean(history, newest, n, _PRESSURE)
    half_width = math.hypot(  # of random and systematic errors; quantiles[n - 2] has n - 1 degrees of freedom
        quantiles[n - 2] * math.sqrt(_variance_of_mean(history, newest, n)),
        WITHIN_95 * math.sqrt(_mean(history, newest, n, _SYSTEMATIC_VARIANCE)),
    )
    out[_OUT_G], out[_OUT_Q] = G, pressure * G
    out[_OUT_Q_LOW], out[_OUT_Q_HIGH] = pressure * (G - half_width), pressure * (G + half_width)
    n = min(n_estimated - WINDOW, WINDOW)  # blocks after the baseline
    if n < 2:
        return
    base, pressure = m.base_sum / WINDOW, _mean(history, newest, n, _PRESSURE)
    rise = _mean(history, newest, n, _COMPARABLE_G) - base
    # of a block in the baseline: the larger of two variances, as in `_variance_of_mean`
    base_variance = max((m.base_square_sum - WINDOW * base**2) / (WINDOW - 1.0), m.base_variance_sum / WINDOW)
    # variance of a healthy machine's random walk from the middle of the baseline to the middle of the last n blocks,
    # divided by `base_variance`. In units of the variance of a block's noise, the walk adds WALK to its variance in
    # each block; `base_variance` is 1 for the noise plus WALK (WINDOW + 1)/6 for the walk within the baseline
    walk = WALK * (n_estimated - 0.5 * (n + WINDOW)) / (1.0 + WALK * (WINDOW + 1.0) / 6.0)
    variance = _variance_of_mean(history, newest, n) + base_variance * (1.0 / WINDOW + walk)
    half_width = math.hypot(quantiles[n - 2] * math.sqrt(variance), WITHIN_95 * m.size_error * rise)
    out[_OUT_SETTLED], out[_OUT_RISE] = 1.0, pressure * rise
    out[_OUT_RISE_LOW], out[_OUT_RISE_HIGH] = pressure * (rise - half_width), pressure * (rise + half_width)


@lru_cache(maxsize=8)
def sensor_code(choice: SensorChoice) -> Mapping[str, str]:
    """Compile the functions of a soft sensor to LLVM code; return the text of each function by its name."""
    return unit_code(build_functions(choice))
