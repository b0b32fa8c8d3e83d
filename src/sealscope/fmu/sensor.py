"""The code of a soft sensor: the live volume balance, sample by sample, as functions that C can call.

Its laws are those of a running machine's balance (`diagnosis.inference`): each sample adds the increments of the terms
to the open rows of the weak form, a block's rows are weighted and summed, and the sums tell the conductance of the
block. No samples are kept but those of `HALF_DIFFERENCE` around the present one.

The mean conductance of the last n blocks (`WINDOW` at most) has the interval

    G +- hypot(t_(n-1) sqrt(v/n), 1.96 o),    v = max(s^2, mean of sd^2)

with the scatter s of the blocks, the deviations sd that the sums tell, Student's t, and the deviation o of the level,
by the other coefficients and the size of the machine. Its rise over the first N = `WINDOW` blocks, d blocks before, is
uncertain by theirs and by the walk of a healthy machine, w times a block's noise a block:

    variance of the rise = v/n + v_0/N + w d sigma^2,    sigma^2 = v_0/(1 + w (N + 1)/6)

(N blocks of such a walk scatter by w (N + 1)/6 beside their noise). The flow is G times the mean of abs(p_A - p_B) as
recorded; the live balance takes the sensors' noise off it, a few per cent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numba import carray

from sealscope.compiled import large_law, law, layout_of, record_at
from sealscope.diagnosis.inference.blocks import Columns
from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.diagnosis.inference.rows.row_weights import SUPPORT, Workspace, median, weigh, workspace_shapes
from sealscope.diagnosis.inference.rows.weak_form import LARGEST, SPAN, STRIDE, stride_samples, test_function
from sealscope.diagnosis.inference.terms import HALF_DIFFERENCE, LEAST_ABSOLUTE
from sealscope.diagnosis.live.balance import BLOCK_SECONDS, LEARNED, TELLS, WAKES, live_equations, size_error
from sealscope.diagnosis.live.known import (
    MISFIT,
    STANDSTILL,
    TINY,
    Known,
    add,
    begin,
    known_shapes,
    motion,
    says,
    take,
)
from sealscope.errors import InputError
from sealscope.fmu.machine import unit_code
from sealscope.fmu.variables import SENSOR_RESULTS, VALUES, Variable, inputs, outputs, parameter
from sealscope.parameters import Rig
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES
from sealscope.units import P_ATM

#: Channels that a soft sensor reads, in the order of the samples.
INPUTS = ("p_A", "p_B", "theta", "x")
#: What a function of a soft sensor returns where it fails.
FAILURES = MappingProxyType({1: "pump.q_b must be > 0 m^3/rev"})
#: The parameter of the rig that the balance reads.
READ = "pump.q_b"
#: Blocks of a mean, and of the baseline.
WINDOW = 20
#: Walk of a block over its noise (variances) in a healthy machine: the oil's warming shows from block to block.
WALK = 3.0
_SIZE = VALUES.index(READ)
#: The columns in the order of `_increments`: the terms' names, and the left side.
COLUMNS = (
    *(f"motion {way}, {side} carries" for way in ("out", "in") for side in "AB"),
    *(name for s in "AB" for name in (f"compliance {s}", f"compliance {s} over the stroke", f"free air {s}",
                                      f"dissolving air {s}")),
    "lag", "bias", "leak", "left",
)  # fmt: skip
_WIDTH, _LEAK, _LEFT = len(COLUMNS), len(COLUMNS) - 2, len(COLUMNS) - 1
_PLACE = tuple(range(_WIDTH))
#: Numbers of a soft sensor's memory.
_COUNTERS = (
    "clock", "sample_count", "sign", "closed", "pending", "row_count", "wait_count", "precision", "woken", "blocks",
    "base", "base_square", "base_variance",
)  # fmt: skip


def variables(rig: Rig) -> Iterator[Variable]:
    """Yield the variables of a soft sensor."""
    yield from inputs({name: (CHANNEL_UNITS[name], f"reading: {LONG_NAMES[name]}") for name in INPUTS})
    yield from filter(None, [parameter(rig, READ, "fixed")])
    yield from outputs(SENSOR_RESULTS)


class SensorChoice(NamedTuple):
    """The parameters that the code of a soft sensor depends on.

    `rate` [Hz]; `size_error`: how far the machine's size is known; `place`, `fast`: columns as `weigh` takes them.
    """

    rate: float
    size_error: float
    place: tuple[int, ...]
    fast: int

    @classmethod
    def from_rig(cls, rig: Rig, rate: float) -> SensorChoice:
        """Return a rig's choice; raise InputError where its balance has other terms than the code."""
        (balance,) = live_equations(rig, INPUTS)
        columns = Columns(balance)
        if columns.names != COLUMNS[:-1]:
            raise InputError(f"a soft sensor's terms must be {', '.join(COLUMNS[:-1])}, got {', '.join(columns.names)}")
        fast = columns.fast
        return cls(rate, size_error(rig), (*fast, *columns.support, columns.left), len(fast))


class _Numbers(NamedTuple):
    """Counts of the code: samples of a stride, strides of a block, half the samples of a difference."""

    stride: int
    strides: int
    half: int

    @classmethod
    def from_rate(cls, rate: float) -> _Numbers:
        return cls(stride_samples(rate), round(BLOCK_SECONDS / STRIDE), max(1, round(HALF_DIFFERENCE * rate)))


def memory_of(choice: SensorChoice) -> np.dtype[Any]:
    """Build the layout of a soft sensor's memory.

    `ring`: the last samples; `increments`, `opened`: of an interval, and the rows that it is part of; `rows`, `ends`,
    `gram`: of the blocks that are weighted together; `sizes`: sum and number of abs(p_A - p_B) in the last blocks;
    `support`: what supports the weights; `waits`, `waiting`, `ordered`: sums, rows and size, and precisions of the
    blocks that are learned from; `last`: of each of the last blocks total, conductance, its variance, that of the
    level, and abs(p_A - p_B); `workspace`, `known`: a `Workspace` and a `Known`.
    """
    n, slow = _Numbers.from_rate(choice.rate), len(choice.place) - choice.fast - 1
    rows = SUPPORT * n.strides
    workspace = workspace_shapes(rows, SUPPORT, len(choice.place), slow)
    return layout_of(
        *_COUNTERS,
        ring=(len(INPUTS), 2 * n.half + 3),
        increments=(_WIDTH,),
        opened=(SPAN, _WIDTH),
        rows=(rows, _WIDTH),
        ends=(SUPPORT,),
        gram=(SUPPORT, _WIDTH, _WIDTH),
        sizes=(SUPPORT + 1, 2),
        support=(slow + 1, slow + 1),
        waits=(LEARNED, _WIDTH, _WIDTH),
        waiting=(LEARNED, 3),
        ordered=(LEARNED,),
        last=(WINDOW, 5),
        workspace=layout_of(**dict(zip(Workspace._fields, workspace, strict=True))),
        known=layout_of(**dict(zip(Known._fields, known_shapes(_LEAK), strict=True))),
    )


def functions(choice: SensorChoice) -> dict[str, Callable[..., Any]]:
    """Build the functions of a soft sensor: ``start``, ``advance`` and ``report`` as of a machine."""
    from scipy.special import stdtrit

    layout = memory_of(choice)
    sample, memory, length, interval = _sample(choice), record_at(layout), layout.itemsize // 8, 1.0 / choice.rate
    n_inputs, n_results, n_values = len(INPUTS), len(SENSOR_RESULTS), len(VALUES)
    error = choice.size_error
    quantiles = tuple(float(stdtrit(freedom, 0.975)) for freedom in range(1, WINDOW))  # Student's t

    def start(values: Any, inputs: Any, x_0: float, y: Any) -> int:
        carray(y, length)[:] = 0.0
        return 0 if carray(values, n_values)[_SIZE] > 0.0 else 1

    def advance(values: Any, inputs: Any, slopes: Any, y: Any, span: float, steps: int) -> int:
        m, displacement = memory(y), carray(values, n_values)[_SIZE] / (2.0 * math.pi)
        a, b = carray(inputs, n_inputs), carray(slopes, n_inputs)
        t = m.clock
        while t < span - 1e-6 * interval:  # a sample at the end is the next step's first
            sample(m, displacement, a[0] + b[0] * t, a[1] + b[1] * t, a[2] + b[2] * t, a[3] + b[3] * t)
            t += interval
        m.clock = t - span
        return 0

    def report(values: Any, inputs: Any, y: Any, results: Any) -> int:
        _write_results(memory(y), error, quantiles, carray(results, n_results))
        return 0

    return {"start": start, "advance": advance, "report": report}


def _sample(choice: SensorChoice) -> Callable[..., Any]:
    """Build the law that takes a sample of the channels `INPUTS`."""
    (stride, strides, half), rate = _Numbers.from_rate(choice.rate), choice.rate
    support, weight = SPAN * stride, float(test_function(rate)[0, 0]) / (1.0 - (1.0 / (SPAN * stride) - 1.0) ** 2) ** 4
    close, length = _close(choice), stride * strides

    @law
    def sample(m: Any, displacement: float, p_A: float, p_B: float, theta: float, x: float) -> None:
        count, width = int(m.sample_count), m.ring.shape[1]
        newest = count % width
        m.ring[0, newest], m.ring[1, newest], m.ring[2, newest], m.ring[3, newest] = p_A, p_B, theta, x
        m.sample_count += 1.0
        k = count - half - 1  # the interval from sample k on, which half a difference is known after
        if k < 0:
            return
        _increments(m.ring, k, half, rate, displacement, m.increments)
        piece, inside, slot = k // stride, k % stride, (k // length) % (SUPPORT + 1)
        if k % length == 0:
            m.sizes[slot, 0] = m.sizes[slot, 1] = 0.0
        if not math.isnan(m.increments[_WIDTH - 2] + m.increments[_WIDTH - 1]):
            m.sizes[slot, 0] += abs(m.increments[_WIDTH - 2]) * rate
            m.sizes[slot, 1] += 1.0
        for p in range(SPAN):
            row = (piece - p) % SPAN
            s = (p * stride + inside + 0.5) * 2.0 / support - 1.0
            phi = weight * (1.0 - s * s) ** 4
            for j in range(_WIDTH):
                before = 0.0 if p == 0 and inside == 0 else m.opened[row, j]
                m.opened[row, j] = before + phi * m.increments[j]
        row = piece - SPAN + 1
        if inside < stride - 1 or row < 0:
            return
        finite, place = True, int(m.row_count)
        for j in range(_WIDTH):
            m.rows[place, j] = m.opened[row % SPAN, j]
            finite = finite and abs(m.rows[place, j]) < LARGEST
        m.row_count += finite
        if row % strides == strides - 1:
            close(m, m.rows[: int(m.row_count)], m.ends[: int(m.pending) + 1], row // strides)

    return sample  # type: ignore[no-any-return]


@large_law
def _increments(ring: Any, k: int, half: int, rate: float, displacement: float, out: Any) -> None:
    """Write the increments of the interval from sample k on, in the order of `COLUMNS`, into `out`."""
    width = ring.shape[1]
    slot, next_slot = k % width, (k + 1) % width
    dx, x = ring[3, next_slot] - ring[3, slot], 0.5 * (ring[3, next_slot] + ring[3, slot])
    out_A, outward, by_A = 0.0, 0.0, 0.0
    for i in range(k, k + 2):
        moves = 0.5 * (ring[3, (i + half) % width] >= ring[3, max(i - half, 0) % width])
        carries = ring[0, i % width] > ring[1, i % width]
        out_A, outward, by_A = out_A + moves * carries, outward + moves, by_A + 0.5 * carries
    out[0], out[1] = out_A * dx, (outward - out_A) * dx
    out[2], out[3] = (by_A - out_A) * dx, (1.0 - outward - by_A + out_A) * dx
    for side in range(2):
        before, after = ring[side, slot], ring[side, next_slot]
        low, high = max(before + P_ATM, LEAST_ABSOLUTE), max(after + P_ATM, LEAST_ABSOLUTE)
        column = 4 + 4 * side
        out[column], out[column + 1] = after - before, x * (after - before)
        out[column + 2], out[column + 3] = 1.0 / high - 1.0 / low, math.log(high) - math.log(low)
    earlier, later = max(k - 1, 0), k + 1
    slope = ring[3, (later + 1) % width] - ring[3, later % width]
    slope -= ring[3, (earlier + 1) % width] - ring[3, earlier % width]
    out[12] = rate * slope / (later - earlier)
    out[13] = 1.0 / rate
    out[14] = 0.5 * (ring[0, slot] + ring[0, next_slot] - ring[1, slot] - ring[1, next_slot]) / rate
    out[15] = displacement * (ring[2, next_slot] - ring[2, slot])


@law
def _orient(m: Any, count: int) -> None:
    """Determine the sign of the left side's counts (`BlockStream`) from the first rows."""
    mean, work = 0.0, 0.0
    for r in range(count):
        mean += m.rows[r, _LEAK] / count
    for r in range(count):
        work += (m.rows[r, _LEAK] - mean) * m.rows[r, _LEFT]
    m.sign = -1.0 if work < 0.0 else 1.0


@large_law
def _show(m: Any, error: float, rows: float, size: float, adds: bool) -> None:
    """Append the result of the block `known.own` to the last ones."""
    known = m.known
    movement = motion(known.own[-1, -1], rows, known.numbers)
    precision, lead, shift, leaning = says(known, rows, adds)
    if not precision > (TELLS * m.precision if movement < STANDSTILL else 0.0):
        return
    total, last, k = lead / precision, m.last, int(m.blocks) % WINDOW
    g = total - shift / precision
    last[k, 0], last[k, 1], last[k, 2], last[k, 4] = total, g, 1.0 / precision, size
    last[k, 3] = leaning / precision**2 + (error * total) ** 2
    m.blocks += 1.0
    if m.blocks <= WINDOW:
        m.base += g
        m.base_square += g * g
        m.base_variance += 1.0 / precision


@large_law
def _learn(m: Any, error: float) -> None:
    """Learn from the waiting blocks, and append their results."""
    known = m.known
    for again in range(3):
        for k in range(LEARNED):
            rows, size = m.waiting[k, 0], m.waiting[k, 1]
            take(known, m.waits[k], _PLACE)
            if again == 0:
                add(known, rows, 1.0, False)
            elif again == 1:
                m.ordered[k] = says(known, rows, False)[0]
            else:
                _show(m, error, rows, size, False)
        if again == 0:
            begin(known)
        elif again == 1:
            m.precision = median(m.ordered, LEARNED)
    m.wait_count = 0.0


@large_law
def _take(m: Any, error: float, b: int, rows: float, size: float) -> None:
    """Take the sums of a block: the first `LEARNED` blocks are learnt from together, the others one by one."""
    known = m.known
    if m.precision > 0.0:
        movement = motion(m.gram[b, _LEFT, _LEFT], rows, known.numbers)
        m.woken = m.woken + 1.0 if movement > 1.0 / STANDSTILL else 0.0
        if m.woken >= WAKES:  # all before were of a machine at standstill: nothing is compared with them
            known.sums[:, :] = 0.0
            known.along[:] = 0.0
            known.numbers[:] = 0.0
            m.precision = m.woken = m.blocks = m.base = m.base_square = m.base_variance = 0.0
            return
        take(known, m.gram[b], _PLACE)
        _show(m, error, rows, size, True)
        return
    waiting = int(m.wait_count)
    if waiting == 0 and not m.gram[b, _LEFT, _LEFT] > 0.0:
        return
    m.waiting[waiting, 0], m.waiting[waiting, 1] = rows, size
    for i in range(_WIDTH):
        for j in range(_WIDTH):
            m.waits[waiting, i, j] = m.gram[b, i, j]
    m.wait_count += 1.0
    if waiting + 1 == LEARNED:
        _learn(m, error)


def _close(choice: SensorChoice) -> Callable[..., Any]:
    """Build the law that closes a block."""
    place, fast, error = choice.place, choice.fast, choice.size_error

    @large_law
    def close(m: Any, rows: Any, ends: Any, block: int) -> None:
        count, pending, first = len(rows), len(ends), m.closed == 0.0
        ends[pending - 1] = count
        m.pending = pending
        if first and pending < SUPPORT:
            return
        if first:
            _orient(m, count)
        for r in range(count):
            rows[r, _LEFT] *= m.sign
        m.closed += pending
        weigh(rows, ends, place, fast, m.support, min(1.0, SUPPORT / m.closed), m.workspace, m.gram)
        m.pending = m.row_count = 0.0
        for b in range(pending):
            of_block = ends[b] - (ends[b - 1] if b else 0.0)
            slot = (block - pending + 1 + b) % (SUPPORT + 1)
            if of_block > 0.0:
                _take(m, error, b, of_block, max(m.sizes[slot, 0] / max(m.sizes[slot, 1], 1.0), TINY))

    return close  # type: ignore[no-any-return]


@large_law
def _mean(last: Any, newest: int, n: int, column: int) -> float:
    """Compute the mean of a column of the last n blocks up to the `newest`."""
    total = 0.0
    for k in range(n):
        total += last[(newest - k) % WINDOW, column] / n
    return float(total)


@large_law
def _variance(last: Any, newest: int, n: int) -> float:
    """Compute the variance of the mean conductance of the last n blocks up to the `newest`."""
    mean, square = _mean(last, newest, n, 1), 0.0
    for k in range(n):
        square += (last[(newest - k) % WINDOW, 1] - mean) ** 2 / (n - 1.0)
    return float(max(square, _mean(last, newest, n, 2)) / n)


@law
def _write_results(m: Any, error: float, quantiles: Any, out: Any) -> None:
    """Write the outputs (`SENSOR_RESULTS`).

    `error`: that of the machine's size, relative; `quantiles`: Student's t for 1, 2, ... degrees of freedom.
    """
    out[:] = 0.0
    last, count, newest = m.last, int(m.blocks), int(m.blocks) - 1
    out[7], out[8], n = m.known.numbers[MISFIT], m.blocks, min(count, WINDOW)
    if n < 2:
        return
    G, flow = _mean(last, newest, n, 0), _mean(last, newest, n, 4)
    half = math.hypot(
        quantiles[n - 2] * math.sqrt(_variance(last, newest, n)), WITHIN_95 * math.sqrt(_mean(last, newest, n, 3))
    )
    out[0], out[1], out[2], out[6] = flow * G, flow * (G - half), flow * (G + half), G
    n = min(count - WINDOW, WINDOW)
    if n < 2:
        return
    base, flow = m.base / WINDOW, _mean(last, newest, n, 4)
    rise = _mean(last, newest, n, 1) - base
    before = max((m.base_square - WINDOW * base**2) / (WINDOW - 1.0), m.base_variance / WINDOW)
    walked = WALK * (count - 0.5 * (n + WINDOW)) / (1.0 + WALK * (WINDOW + 1.0) / 6.0)
    variance = _variance(last, newest, n) + before * (1.0 / WINDOW + walked)
    half = math.hypot(quantiles[n - 2] * math.sqrt(variance), WITHIN_95 * error * rise)
    out[3], out[4], out[5], out[9] = flow * rise, flow * (rise - half), flow * (rise + half), 1.0


@lru_cache(maxsize=8)
def sensor_code(choice: SensorChoice) -> Mapping[str, str]:
    """Compile the LLVM code of a soft sensor (`unit_code`)."""
    return unit_code(functions(choice))
