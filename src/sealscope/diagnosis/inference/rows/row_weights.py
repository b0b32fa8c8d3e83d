"""Huber's weights of the rows of blocks, and Gram matrices of the weighted rows: compiled laws on the caller's arrays.

A block's rows are v = (fast, slow, left side). Coefficients of fast columns are free in each block; those of slow
columns are the same in all blocks, with a prior from the sums of earlier blocks. The weights are
min(1, HUBER sigma / abs(residual)) at the fit with these weights, sigma from the median of abs(residual), by
iteration. No law allocates memory: a unit for other simulators (`fmu`) runs the same laws in C.

Source: P. J. Huber, Ann. Math. Statist. 35 (1964) 73 (weights).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import large_law, law
from sealscope.recordings.recording import Array

#: Blocks whose rows are weighted together at the beginning of a stream; later the prior counts as so many blocks.
SUPPORT = 5
#: Where Huber's function turns from square to linear, in standard deviations: 95 % efficiency for normal errors.
HUBER = 1.345
#: Relative increase of a matrix diagonal, against rounding.
RIDGE = 1e-10
#: Maximum number of iterations to a fixed point, and the mean relative change of the weights that ends them.
MAX_ITERATIONS, TOLERANCE = 50, 1e-2
#: Standard deviation of normal values over the median of their magnitudes.
_SIGMA = 1.4826
_Indices = NDArray[np.intp]


class Workspace(NamedTuple):
    """Scratch arrays of `weigh_rows`, for r rows of K blocks with c columns, s of them slow.

    `weights`, `residual`, `ordered` (r,); `reduced` (K, c, c); `fit` (K, c - 1); `normal` (s + 1, s + 1).
    """

    weights: Any
    residual: Any
    ordered: Any
    reduced: Any
    fit: Any
    normal: Any


def workspace_shapes(rows: int, blocks: int, columns: int, slow: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of a `Workspace`."""
    return (rows,), (rows,), (rows,), (blocks, columns, columns), (blocks, columns - 1), (slow + 1, slow + 1)


@large_law
def eliminate(matrix: Any, count: int) -> None:
    """Eliminate the first `count` unknowns of a positive semidefinite matrix with appended right sides, in place.

    Gauss-Jordan elimination: the first rows then contain the unknowns in terms of the other columns, the other rows the
    reduced system. Unknowns without information become zero.
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
    """Return the median of the first n values, by quickselect, which reorders them."""
    k, low, high = (n - 1) // 2, 0, n - 1
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
    above = values[k + 1]
    for i in range(k + 2, n):
        above = min(above, values[i])
    return float(0.5 * (values[k] + above))


@law
def _sum_products(values: Any, begin: int, end: int, weights: Any, gram: Any) -> None:
    """Compute the Gram matrix (m, m) of the weighted rows `begin` to `end` of `values` (r, m), written to `gram`."""
    width = values.shape[1]
    for i in range(width):
        for j in range(width):
            gram[i, j] = 0.0
    for r in range(begin, end):
        for i in range(width):
            value = weights[r] * values[r, i]
            for j in range(width):
                gram[i, j] += value * values[r, j]


@large_law
def _eliminate_fast(gram: Any, column_order: Any, n_fast: int, reduced: Any) -> None:
    """Write a block's Gram matrix in `column_order` to `reduced`, with its first `n_fast` columns eliminated."""
    for i in range(len(column_order)):
        for j in range(len(column_order)):
            reduced[i, j] = gram[column_order[i], column_order[j]]
    eliminate(reduced, n_fast)


@large_law
def _reweigh(values: Any, ends: Any, column_order: Any, workspace: Any) -> bool:
    """Compute Huber's weights from the residuals of the fit in the workspace; return True if they have converged."""
    count, left, block = len(values), len(column_order) - 1, 0
    for r in range(count):
        while r >= ends[block]:
            block += 1
        residual = values[r, column_order[left]]
        for i in range(left):
            residual -= workspace.fit[block, i] * values[r, column_order[i]]
        workspace.residual[r] = workspace.ordered[r] = abs(residual)
    limit, change = HUBER * _SIGMA * median(workspace.ordered, count), 0.0
    for r in range(count):
        weight = limit / workspace.residual[r] if limit > 0.0 and workspace.residual[r] > limit else 1.0
        change += abs(weight / workspace.weights[r] - 1.0)
        workspace.weights[r] = weight
    return change < TOLERANCE * count or not limit > 0.0


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
    """Weight the rows (r, m) of K blocks, compute their Gram matrices (K, m, m), and update the prior, in place.

    `ends`: index past the last row of each block. `column_order`: column indices, the `n_fast` fast ones first, the
    left side last. `earlier_sums` (s + 1, s + 1): sums over earlier blocks for the slow columns, scaled to `SUPPORT`
    blocks; they change by `update_fraction` of their difference from the sums of these blocks. `gram`: the result.
    """
    n_rows, left, n_blocks = len(values), len(column_order) - 1, len(ends)
    n_slow, normal, reduced = left - n_fast, workspace.normal, workspace.reduced
    for r in range(n_rows):
        workspace.weights[r] = 1.0
    converged = n_rows == 0
    for iteration in range(MAX_ITERATIONS + 1):
        for block in range(n_blocks):
            begin = int(ends[block - 1]) if block else 0
            _sum_products(values, begin, int(ends[block]), workspace.weights, gram[block])
            _eliminate_fast(gram[block], column_order, n_fast, reduced[block])
        converged = converged or iteration == MAX_ITERATIONS
        for i in range(n_slow + 1):  # once converged, the sums of these blocks alone
            for j in range(n_slow + 1):
                normal[i, j] = 0.0 if converged else earlier_sums[i, j]
                for block in range(n_blocks):
                    normal[i, j] += reduced[block, n_fast + i, n_fast + j]
        if converged:
            break
        eliminate(normal, n_slow)  # gives the slow coefficients; then the fast ones of each block
        for block in range(n_blocks):
            for i in range(left):
                workspace.fit[block, i] = reduced[block, i, left] if i < n_fast else normal[i - n_fast, n_slow]
            for i in range(n_fast):
                for j in range(n_fast, left):
                    workspace.fit[block, i] -= reduced[block, i, j] * workspace.fit[block, j]
        converged = _reweigh(values, ends, column_order, workspace)
    for i in range(n_slow + 1):
        for j in range(n_slow + 1):
            earlier_sums[i, j] += update_fraction * (SUPPORT / n_blocks * normal[i, j] - earlier_sums[i, j])


def block_gram_matrices(
    values: Array, ends: _Indices, fast: _Indices, slow: _Indices, earlier_sums: Array, update_fraction: float
) -> Array:
    """Compute the Gram matrix (K, m, m) of the weighted rows (r, m) of each block, and update `earlier_sums`.

    `ends`: index past the last row of each block; `fast`, `slow`: indices of columns whose coefficients are free in
    each block, and of those shared by all blocks; the last of `slow` is the left side. Weights are as in `weigh_rows`.
    """
    column_order = np.concatenate([fast, slow])
    workspace = Workspace(*map(np.empty, workspace_shapes(len(values), len(ends), len(column_order), len(slow) - 1)))
    gram = np.empty((len(ends), values.shape[1], values.shape[1]))
    weigh_rows(values, ends, column_order, len(fast), earlier_sums, update_fraction, workspace, gram)
    return gram
