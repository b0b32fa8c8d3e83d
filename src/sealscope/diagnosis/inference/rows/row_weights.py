"""Huber's weights of the rows of blocks, and Gram matrices of the weighted rows.

A row of a block consists of fast columns, slow columns, and the left side of the regression. Coefficients of fast
columns are free in each block. Coefficients of slow columns are the same in all blocks, with a prior from the sums of
earlier blocks. The weights are min(1, HUBER sigma / abs(residual)), where sigma follows from the median of
abs(residual). Weights and fit depend on each other and are found by iteration. The functions are compiled and write to
arrays of the caller. They allocate no memory, since a unit for other simulators (`fmu`) runs the same functions in C.

Source: P. J. Huber, Ann. Math. Statist. 35 (1964) 73 (weights).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import large_law, law
from sealscope.diagnosis.estimate.linear import RIDGE
from sealscope.diagnosis.estimate.special import SD_PER_MEDIAN
from sealscope.recordings.recording import Array

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
