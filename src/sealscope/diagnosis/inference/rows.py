"""Rows of the regression: the weak form of a volume balance, Huber's weights of the rows, and the flow's sign by them.

A balance  dl = sum_j c_j f_j dg_j  has unknown coefficients c_j; l, f_j and g_j are functions of the recorded channels.
It is multiplied by test functions phi_i of compact support, with the middle t_i and the half-width h, and integrated,

    integral of phi_i dl = sum_j c_j integral of phi_i f_j dg_j,    phi_i(t) = (1 - s^2)^4 / norm,  s = (t - t_i) / h,

which gives one row for each test function, computed from the increments over each sampling interval. Noise is not
amplified, since summation by parts could move all derivatives to the smooth phi. phi and its first three derivatives
vanish at its ends, so noise there and the truncation do not matter. Test functions are `STRIDE` apart and overlap.

A row of a block consists of fast columns, slow columns, and the left side of the regression. Coefficients of fast
columns are free in each block. Coefficients of slow columns are the same in all blocks, with a prior from the sums of
earlier blocks. The weights are min(1, HUBER sigma / abs(residual)), where sigma follows from the median of
abs(residual). Weights and fit depend on each other and are found by iteration (`weigh_rows`).

The flow l is that into chamber A in a row. Three symptoms of its correct sign are tested, and their log odds
(`sign_log_odds`) are added:

- Oil leaks from high to low pressure: the leak's coefficient is positive.
- The force of the pressures on the piston correlates with l, since friction dissipates energy. The mean force, weighted
  by abs(l), is subtracted first, since a constant load also correlates with a motion in one direction. The same test is
  made with p_A - p_B instead of the force, and the two log odds are averaged: a load disturbs p_A - p_B less than the
  force, throttling on the rod side disturbs it more.
- The position grows with l. A negative correlation does not count, since the position may be reversed.

Compiled functions allocate no memory and write to arrays of the caller, as controllers and the unit for other
simulators (`emit`, `fmu`) run them in C.

Sources: M. Shinbrot, Trans. ASME 79 (1957) 547 (modulating functions); H. A. Preisig and D. W. T. Rippin, Computers
and Chemical Engineering 17 (1993) 1; D. A. Messenger and D. M. Bortz, Multiscale Model. Simul. 19 (2021) 1474 (weak
form); P. J. Huber, Ann. Math. Statist. 35 (1964) 73 (weights).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel, large_law, law
from sealscope.diagnosis.estimate.linear import RIDGE
from sealscope.diagnosis.estimate.special import SD_PER_MEDIAN, normal_probability
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Distance of neighbouring test functions [s] and its minimum [samples]; how many distances a test function spans.
STRIDE, MIN_STRIDE = 0.125, 2
SPAN = 4
#: Weight below which a row next to holes is omitted.
MIN_WEIGHT = 0.1
#: Limit of integrals that count as readings of a sensor: squares of larger ones might overflow.
MAX_READING = 1e100
#: Reading of a missing sample in streams, whose increments are beyond `MAX_READING`.
BEYOND = 1e20 * MAX_READING


class Rows(NamedTuple):
    """Rows of a linear regression, one for each of r test functions.

    `time` (r,): middle of each test function [s since the first sample]; `values` (r, c): integral of the test function
    times the increments of each of c columns, i.e. a weighted mean rate of change [unit of the column's increments per
    second]; `whole` (r,): flags of the rows without a missing sample.
    """

    time: Array
    values: Array
    whole: NDArray[np.bool_]


def stride_samples(rate: float) -> int:
    """Compute the distance of neighbouring test functions [samples], at least `MIN_STRIDE`, at a `rate` [Hz]."""
    return max(MIN_STRIDE, round(STRIDE * rate))


def half_width(rate: float) -> float:
    """Compute half the length of a test function [s] at a sampling `rate` [Hz]."""
    return 0.5 * SPAN * stride_samples(rate) / rate


def strides_in(seconds: float, rate: float) -> int:
    """Convert a time [s] to a number of strides (distances of test functions), at least `SPAN`, one test function.

    A stride is `STRIDE`, or its length in samples if that is longer, as for slow loggers.
    """
    return max(SPAN, round(seconds / max(STRIDE, stride_samples(rate) / rate)))


@lru_cache(maxsize=8)
def peak_weight(rate: float) -> float:
    """Compute the value of the test function in its middle [1/s], by which its sum over the samples is the `rate`."""
    n_support = SPAN * stride_samples(rate)
    s = (np.arange(n_support) + 0.5) * 2.0 / n_support - 1.0
    return float(rate / np.sum((1.0 - s * s) ** 4))


@law
def row_weight(interval: int, n_stride: int, peak: float) -> float:
    """Compute the value of the test function phi [1/s] in the middle of its sampling interval number `interval`."""
    s = (interval + 0.5) * 2.0 / (SPAN * n_stride) - 1.0  # -1 to 1 over the support
    return peak * (1.0 - s * s) ** 4


@large_law
def add_to_rows(unfinished: Any, increments: Any, k: int, n_stride: int, peak: float) -> None:
    """Add the increments (c,) over sampling interval k, weighted by the test function, to the rows that contain it.

    Row r begins with stride r and lasts `SPAN` strides. Its sums are in `unfinished` (SPAN, c), at the place r modulo
    `SPAN`, and begin at 0. At the end of a stride, row k // `n_stride` - `SPAN` + 1 is finished. Streams and files sum
    in this order.
    """
    stride, k_in_stride = k // n_stride, k % n_stride
    if k_in_stride == 0:
        for j in range(len(increments)):
            unfinished[stride % SPAN, j] = 0.0
    for age in range(SPAN):
        slot = (stride - age) % SPAN
        weight = row_weight(age * n_stride + k_in_stride, n_stride, peak)
        for j in range(len(increments)):
            unfinished[slot, j] += weight * increments[j]


@kernel
def _integrate(
    increments: Any, n_stride: int, peak: float, present: Any, unfinished: Any, values: Any, is_whole: Any
) -> None:
    """Write the rows (r, c) of `increments` (c, n), and flag those without a missing sample; others are zeros.

    `present` (c,) is scratch; `unfinished` (SPAN, c) as in `add_to_rows`.
    """
    for k in range((len(values) + SPAN - 1) * n_stride if len(values) else 0):
        for j in range(len(increments)):
            present[j] = increments[j, k]
        add_to_rows(unfinished, present, k, n_stride, peak)
        row = k // n_stride - SPAN + 1
        if k % n_stride == n_stride - 1 and row >= 0:
            for j in range(values.shape[1]):
                is_whole[row] &= abs(unfinished[row % SPAN, j]) < MAX_READING  # False for NaN
            for j in range(values.shape[1]):
                values[row, j] = unfinished[row % SPAN, j] if is_whole[row] else 0.0


_stride = stride_samples(1e4)  # at a rate [Hz] at which `OVERLAP` has converged
_phi = np.array([row_weight(k, _stride, 1.0) for k in range(SPAN * _stride)])
#: Variance of a sum over overlapping rows of white noise, relative to independent rows.
OVERLAP = 1.0 + 2.0 * sum(
    float(_phi[k * _stride :] @ _phi[: -k * _stride]) / float(_phi @ _phi) for k in range(1, SPAN)
)


def weak_form_rows(increments: Sequence[Array], rate: float) -> Rows:
    """Compute the rows of a regression in weak form: the integrals of c columns, weighted by each test function.

    `increments`: for each column its increments (n,) between samples, NaN where missing; `rate`: sampling rate [Hz].
    Each test function gives one row if it lies within the samples. A row with a missing sample, or with an integral
    beyond `MAX_READING`, is of zeros and not `whole`.
    """
    n_stride, columns = stride_samples(rate), np.stack(increments)
    n_rows = max(0, columns.shape[1] // n_stride - SPAN + 1)
    values, is_whole = np.zeros((n_rows, len(increments))), np.ones(n_rows, dtype=bool)
    present, unfinished = np.empty(len(increments)), np.zeros((SPAN, len(increments)))
    _integrate(columns, n_stride, peak_weight(rate), present, unfinished, values, is_whole)
    time = (np.arange(n_rows, dtype=float) + 0.5 * SPAN) * n_stride / rate
    return Rows(time, values, is_whole)


def weights_near_holes(holes: Array, rate: float) -> Array:
    """Compute the weight (r,) of each row: the fraction of its test function outside of holes, 0 below `MIN_WEIGHT`.

    `holes` (n,): 1 for a sample in a hole, a long gap of missing samples that was filled in, else 0; `rate`: sampling
    rate [Hz].
    """
    # length [s] of each sampling interval that touches a hole, else 0; the sum of these lengths, weighted by a test
    # function of integral 1, is the fraction of the function in holes
    hole_time = np.maximum(holes[1:], holes[:-1]) / rate
    weights = 1.0 - weak_form_rows([hole_time], rate).values[:, 0]
    return np.where(weights < MIN_WEIGHT, 0.0, np.minimum(weights, 1.0))  # at most 1, but for rounding


#: Number of blocks whose rows are weighted together at the beginning of a stream. Later the prior from all earlier
#: blocks counts as this many.
SUPPORT = 5
#: Where Huber's function turns from square to linear, in standard deviations: 95 % efficiency for normal errors.
HUBER = 1.345
#: Maximum number of iterations to a fixed point, and the mean relative change of the weights that ends them.
MAX_ITERATIONS, TOLERANCE = 50, 1e-2
_Indices = NDArray[np.intp]


class Workspace(NamedTuple):
    """Scratch arrays of `weigh_rows`, for r rows of K blocks.

    The c columns are fast ones with a coefficient in each block, s slow ones with one for all, and the left side.

    - `weights`, `residual` (r,): weight and magnitude of the residual of each row;
    - `ordered` (r,): copy of `residual`, which the median reorders;
    - `fast` (K, f, c): the f fast coefficients of each block as sums of the other columns;
    - `fit` (K, c - 1): coefficients in each block;
    - `normal` (s + 1, s + 1): normal equations of the slow coefficients;
    - `reduced` (c, c): a block's Gram matrix, in which the fast coefficients are eliminated.
    """

    weights: Any
    fast: Any
    fit: Any
    normal: Any
    # not used while coefficients are estimated from a block
    reduced: Any
    residual: Any
    ordered: Any


def workspace_shapes(rows: int, blocks: int, columns: int, slow: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of a `Workspace`; `columns` includes the left side, `slow` does not."""
    fast = (blocks, columns - slow - 1, columns)
    return (rows,), fast, (blocks, columns - 1), (slow + 1, slow + 1), (columns, columns), (rows,), (rows,)


@large_law
def eliminate(matrix: Any, count: int) -> None:
    """Eliminate the first `count` unknowns of a positive semidefinite system with appended right sides, in place.

    After this Gauss-Jordan elimination the first `count` rows of `matrix` express the unknowns by the other columns,
    and the other rows contain the reduced system. The diagonal is first increased by the fraction `RIDGE`, which limits
    rounding errors. Unknowns without information become zero.
    """
    rows, columns = matrix.shape
    for i in range(count):
        matrix[i, i] *= 1.0 + RIDGE
    for i in range(count):
        scale = 1.0 / matrix[i, i] if matrix[i, i] > 0.0 else 0.0
        for q in range(i, columns):
            matrix[i, q] *= scale
        for j in range(rows):
            factor = matrix[j, i] if j != i else 0.0
            for q in range(i, columns):
                matrix[j, q] -= factor * matrix[i, q]


@law
def median(values: Any, n: int) -> float:
    """Compute the median of the first n > 0 values, by quickselect, which reorders them."""
    k, low, high = (n - 1) // 2, 0, n - 1  # k: index of the middle value, the lower one of two
    while low < high:
        pivot, i, j = values[k], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if j < k:
            low = i
        if k < i:
            high = j
    if n % 2:
        return float(values[k])
    above = values[k + 1]  # the smallest value above the lower middle one
    for i in range(k + 2, n):
        above = min(above, values[i])
    return float(0.5 * (values[k] + above))


@law
def sum_products(values: Any, begin: int, end: int, weights: Any, gram: Any) -> None:
    """Write the Gram matrix of the rows `begin` to `end` - 1 of `values` (r, m), with `weights` (r,), to `gram`."""
    width = values.shape[1]
    for i in range(width):
        for j in range(i, width):
            gram[i, j] = 0.0
    for r in range(begin, end):
        for i in range(width):
            value = weights[r] * values[r, i]
            for j in range(i, width):
                gram[i, j] += value * values[r, j]
    for i in range(width):
        for j in range(i):
            gram[i, j] = gram[j, i]


@large_law
def eliminate_fast(gram: Any, column_order: Any, n_fast: int, reduced: Any) -> None:
    """Copy a block's Gram matrix `gram` (m, m) to `reduced` (c, c), and eliminate its fast coefficients there.

    `column_order` (c,): the copied columns in their order, the `n_fast` fast ones first.
    """
    for i in range(len(column_order)):
        for j in range(len(column_order)):
            reduced[i, j] = gram[column_order[i], column_order[j]]
    eliminate(reduced, n_fast)


@large_law
def reweigh(values: Any, ends: Any, column_order: Any, workspace: Any) -> bool:
    """Compute Huber's weights of the rows from the residuals of the current fit; return True once they have converged.

    The weights have converged if their mean relative change is below `TOLERANCE`, or if the median residual is 0, which
    makes all weights 1. The arguments are those of `weigh_rows`.
    """
    count, left, block = len(values), len(column_order) - 1, 0  # left: position of the left side in `column_order`
    for r in range(count):
        while r >= ends[block]:  # find the block of row r
            block += 1
        residual = values[r, column_order[left]]
        for i in range(left):
            residual -= workspace.fit[block, i] * values[r, column_order[i]]
        workspace.residual[r] = workspace.ordered[r] = abs(residual)
    limit, change = HUBER * SD_PER_MEDIAN * median(workspace.ordered, count), 0.0
    for r in range(count):
        weight = limit / workspace.residual[r] if limit > 0.0 and workspace.residual[r] > limit else 1.0
        change += abs(weight / workspace.weights[r] - 1.0)
        workspace.weights[r] = weight
    return change < TOLERANCE * count or not limit > 0.0


@law
def start_normal(normal: Any, earlier_sums: Any, converged: bool) -> None:
    """Begin the normal equations of the slow coefficients: with those of earlier blocks, unless `converged`."""
    for i in range(len(normal)):
        for j in range(len(normal)):
            normal[i, j] = 0.0 if converged else earlier_sums[i, j]


@law
def add_reduced(workspace: Any, block: int, n_fast: int) -> None:
    """Add a block's reduced Gram matrix to the normal equations, and store the rows of its fast coefficients."""
    normal, reduced = workspace.normal, workspace.reduced
    for i in range(len(normal)):
        for j in range(len(normal)):
            normal[i, j] += reduced[n_fast + i, n_fast + j]
    for i in range(n_fast):
        for j in range(len(reduced)):
            workspace.fast[block, i, j] = reduced[i, j]


@large_law
def fit_blocks(workspace: Any, n_blocks: int, n_fast: int) -> None:
    """Solve the normal equations for the slow coefficients, from which the fast ones of each block follow."""
    normal, fast, fit = workspace.normal, workspace.fast, workspace.fit
    n_slow = len(normal) - 1
    left = n_fast + n_slow
    eliminate(normal, n_slow)
    for block in range(n_blocks):
        for i in range(left):
            fit[block, i] = fast[block, i, left] if i < n_fast else normal[i - n_fast, n_slow]
        for i in range(n_fast):
            for j in range(n_fast, left):
                fit[block, i] -= fast[block, i, j] * fit[block, j]


@law
def move_sums(normal: Any, earlier_sums: Any, n_blocks: int, update_fraction: float) -> None:
    """Move the sums over earlier blocks towards those of `n_blocks` new ones, by a fraction of the difference."""
    for i in range(len(normal)):
        for j in range(len(normal)):
            earlier_sums[i, j] += update_fraction * (SUPPORT / n_blocks * normal[i, j] - earlier_sums[i, j])


@large_law
def weigh_rows(
    values: Any,
    ends: Any,
    column_order: Any,
    n_fast: int,
    earlier_sums: Any,
    update_fraction: float,
    workspace: Any,
    gram: Any,
) -> None:
    """Weight the rows of K blocks by Huber's weights, and compute the Gram matrix of each block.

    - `values` (r, m): rows of all blocks; `ends` (K,): index past the last row of each block.
    - `column_order`: indices of the columns that are fitted: first the `n_fast` fast ones, then the slow ones, the left
      side last.
    - `earlier_sums` (s + 1, s + 1): sums over earlier blocks for the s slow columns and the left side, scaled to
      `SUPPORT` blocks: the prior of the fit. In the end they are moved in place towards the sums of these K blocks, by
      the fraction `update_fraction` of the difference.
    - `workspace`: scratch arrays (`Workspace`); `gram` (K, m, m): receives the Gram matrices of the weighted rows.
    """
    n_rows, n_blocks = len(values), len(ends)
    for r in range(n_rows):
        workspace.weights[r] = 1.0
    converged = n_rows == 0  # then one pass writes Gram matrices of zeros
    for iteration in range(MAX_ITERATIONS + 1):
        converged = converged or iteration == MAX_ITERATIONS
        start_normal(workspace.normal, earlier_sums, converged)
        for block in range(n_blocks):
            begin = int(ends[block - 1]) if block else 0
            sum_products(values, begin, int(ends[block]), workspace.weights, gram[block])
            eliminate_fast(gram[block], column_order, n_fast, workspace.reduced)
            add_reduced(workspace, block, n_fast)
        if converged:
            break
        fit_blocks(workspace, n_blocks, n_fast)
        converged = reweigh(values, ends, column_order, workspace)
    move_sums(workspace.normal, earlier_sums, n_blocks, update_fraction)


def block_gram_matrices(
    values: Array, ends: _Indices, fast: _Indices, slow: _Indices, earlier_sums: Array, update_fraction: float
) -> Array:
    """Compute the Gram matrices (K, m, m) of K blocks from rows with Huber's weights, and update `earlier_sums`.

    `fast`, `slow`: indices of the columns, the left side last. For the other arguments see `weigh_rows`.
    """
    column_order = np.concatenate([fast, slow])
    shapes = workspace_shapes(rows=len(values), blocks=len(ends), columns=len(column_order), slow=len(slow) - 1)
    workspace = Workspace(*(np.empty(shape) for shape in shapes))
    gram = np.empty((len(ends), values.shape[1], values.shape[1]))
    weigh_rows(values, ends, column_order, len(fast), earlier_sums, update_fraction, workspace, gram)
    return gram


_PRIORS = INFERENCE.sense
#: Probabilities that something else than the flow's sign causes each symptom: of the leak, the load and the motion.
OTHER_LEAK, OTHER_LOAD, OTHER_MOTION = float(_PRIORS.leak), float(_PRIORS.driving_load), float(_PRIORS.sides)
#: Standard errors by which flow and motion correlate where a piston moves.
MOTION_SCORE = float(_PRIORS.motion_score)
#: Numbers of the sums over rows of a motion, and of a load.
N_MOTION_SUMS, N_LOAD_SUMS = 2, 7
TINY = float(np.finfo(float).tiny)


@law
def add_motion(sums: Any, motion: float, flow: float) -> None:
    """Add a row to the sums of m l and (m l)^2 with the `motion` m and the `flow` l."""
    product = motion * flow
    sums[0] += product
    sums[1] += product * product


@law
def add_load(sums: Any, load: float, flow: float) -> None:
    """Add a row to the sums of l, |l|, l^2, p l, p |l|, p l^2 and (p l)^2 with the `load` p and the `flow` l."""
    magnitude, square, work = abs(flow), flow * flow, load * flow
    sums[0] += flow
    sums[1] += magnitude
    sums[2] += square
    sums[3] += work
    sums[4] += load * magnitude
    sums[5] += load * square
    sums[6] += work * work


@kernel
def add_rows(motion_sums: Any, load_sums: Any, motions: Any, loads: Any, flow: Any) -> None:
    """Add r rows to the sums of g motions (g, 2) and k loads (k, 7): `motions` (g, r), `loads` (k, r), `flow` (r,)."""
    for r in range(len(flow)):
        for g in range(len(motions)):
            add_motion(motion_sums[g], motions[g, r], flow[r])
        for k in range(len(loads)):
            add_load(load_sums[k], loads[k, r], flow[r])


@law
def z_score(total: float, square: float) -> float:
    """Compute the z score of a sum of products, each of the flow and another quantity in one row.

    `total`, `square`: sums of the products, and of their squares.
    """
    return total / max(math.sqrt(max(square, 0.0) * OVERLAP), TINY)  # rows overlap


@law
def work_score(sums: Any) -> float:
    """Compute the z score of the products (p - c) l of load and flow, with the mean load c weighted by the flow.

    `sums` (7,): those of `add_load`.
    """
    if not sums[1] > 0.0:
        return 0.0
    mean = sums[4] / sums[1]
    return z_score(sums[3] - mean * sums[0], sums[6] - 2.0 * mean * sums[5] + mean * mean * sums[2])


@law
def leak_score(energy: float, moment: float, square: float, whole_energy: float, freedom: float) -> float:
    """Compute the z score of the leak's coefficient by least squares: positive for oil from high to low pressure.

    `energy`, `moment` and `square` are the products of the leak's column with itself, with the left side, and of the
    left side with itself, all other columns eliminated; `whole_energy` is the first without that. `freedom`: degrees of
    freedom of the residual. The result is 0 if the rows do not determine the coefficient.
    """
    if not energy > RIDGE * whole_energy or not freedom > 0.0:
        return 0.0
    variance = OVERLAP * max(square - moment * (moment / energy), 0.0) / freedom
    return moment / max(math.sqrt(variance * energy), TINY)


@law
def sign_log_odds(z: float, other_cause: float) -> float:
    """Compute the log odds that a flow has the correct sign, from the z score `z` of one symptom of correct wiring.

    c = `other_cause` is the probability that something else causes the score; both signs are then equally probable.
    With the standard normal distribution Phi, log odds = log((Phi(z) + c/2) / (Phi(-z) + c/2)).
    """
    return math.log((normal_probability(z) + 0.5 * other_cause) / (normal_probability(-z) + 0.5 * other_cause))


@law
def sum_log_odds(leak_z: float, difference_sums: Any, force_sums: Any, motion_z: float) -> float:
    """Compute the log odds that a flow has the right sign, from all symptoms.

    `leak_z`, `motion_z`: z scores of the leak and the motion; `difference_sums`, `force_sums`: those of `add_load` for
    p_A - p_B and for the force.
    """
    load_odds = sign_log_odds(work_score(difference_sums), OTHER_LOAD) + sign_log_odds(
        work_score(force_sums), OTHER_LOAD
    )
    log_odds = sign_log_odds(leak_z, OTHER_LEAK) + 0.5 * load_odds
    if motion_z > 0.0:  # else either the position or the flow may be reversed
        log_odds += sign_log_odds(motion_z, OTHER_MOTION)
    return log_odds
