"""Huber's weights of the rows of blocks, and the sums of their products: compiled laws on arrays that the caller gives.

A block's rows are v = (fast, slow, left side). Coefficients of fast columns are free in each block, those of slow ones
are the same in all blocks and believed as the sums `known` say. The weights are min(1, HUBER sigma / abs(residual)) at
the fit that they give, sigma from the median of abs(residual). Nothing here allocates: a unit for other simulators
(`fmu`) runs the same laws in C.

Source: P. J. Huber, Ann. Math. Statist. 35 (1964) 73 (weights).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import large_law, law
from sealscope.recordings.recording import Array

#: Blocks whose rows are weighted together at the beginning of a stream, and that stand for what is known later.
SUPPORT = 5
#: Where Huber's function turns from square to linear, in standard deviations: 95 % efficiency for normal errors.
HUBER = 1.345
#: What is added to a matrix, as a share of its diagonal.
RIDGE = 1e-10
#: Turns to a fixed point at most, and the relative change that ends them, the mean one of weights.
MOST_TURNS, TOLERANCE = 50, 1e-2
_SIGMA = 1.4826  # standard deviation of normal values over the median of their size


_Places = NDArray[np.intp]


class Workspace(NamedTuple):
    """Arrays to work in, for r rows of K blocks and of c columns s slow ones.

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
    by_row = (rows,), (rows,), (rows,)
    return *by_row, (blocks, columns, columns), (blocks, columns - 1), (slow + 1, slow + 1)


@large_law
def eliminate(matrix: Any, count: int) -> None:
    """Eliminate the first `count` unknowns of a symmetric matrix >= 0 with right sides beside it (Gauss and Jordan).

    Their rows then hold their coefficients in terms of the other columns, the other rows what is left without them.
    Directions that nothing is known of are left at zero.
    """
    rows, columns = matrix.shape
    for i in range(count):
        matrix[i, i] *= 1.0 + RIDGE
    for i in range(count):
        scale = 1.0 / matrix[i, i] if matrix[i, i] > 0.0 else 0.0
        for q in range(i, columns):
            matrix[i, q] *= scale
        for j in range(rows):
            size = matrix[j, i] if j != i else 0.0
            for q in range(i, columns):
                matrix[j, q] -= size * matrix[i, q]


@law
def median(values: Any, n: int) -> float:
    """Return the median of the first n values, whose order is lost (Hoare's selection)."""
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
    """Put the sums of weighted products of rows (r, m) into `gram` (m, m)."""
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
def _reduce(gram: Any, place: Any, fast: int, reduced: Any) -> None:
    """Put a block's sums into `reduced`, without the fast columns (`eliminate`)."""
    for i in range(len(place)):
        for j in range(len(place)):
            reduced[i, j] = gram[place[i], place[j]]
    eliminate(reduced, fast)


@large_law
def _reweigh(values: Any, ends: Any, place: Any, workspace: Any) -> bool:
    """Put Huber's weights at a fit into the workspace; return whether they are those at which it was made."""
    count, last, b = len(values), len(place) - 1, 0
    for r in range(count):
        while r >= ends[b]:
            b += 1
        residual = values[r, place[last]]
        for i in range(last):
            residual -= workspace.fit[b, i] * values[r, place[i]]
        workspace.residual[r] = workspace.ordered[r] = abs(residual)
    size, change = HUBER * _SIGMA * median(workspace.ordered, count), 0.0
    for r in range(count):
        weight = size / workspace.residual[r] if size > 0.0 and workspace.residual[r] > size else 1.0
        change += abs(weight / workspace.weights[r] - 1.0)
        workspace.weights[r] = weight
    return change < TOLERANCE * count or not size > 0.0


@large_law
def weigh(values: Any, ends: Any, place: Any, fast: int, known: Any, share: float, workspace: Any, gram: Any) -> None:
    """Put the sums of weighted products of rows (r, m), of K blocks that end before the rows `ends`, into `gram`.

    `place`: columns, first those that are `fast`, the left side last. `known` (s + 1, s + 1): sums over the others that
    count as `SUPPORT` blocks; it moves to those of these blocks by `share`. `gram` (K, m, m).
    """
    count, last, blocks = len(values), len(place) - 1, len(ends)
    slow, normal, reduced = last - fast, workspace.normal, workspace.reduced
    for r in range(count):
        workspace.weights[r] = 1.0
    converged = count == 0
    for turn in range(MOST_TURNS + 1):
        for b in range(blocks):
            _sum_products(values, int(ends[b - 1]) if b else 0, int(ends[b]), workspace.weights, gram[b])
            _reduce(gram[b], place, fast, reduced[b])
        converged = converged or turn == MOST_TURNS
        for i in range(slow + 1):
            for j in range(slow + 1):
                normal[i, j] = 0.0 if converged else known[i, j]
                for b in range(blocks):
                    normal[i, j] += reduced[b, fast + i, fast + j]
        if converged:
            break
        eliminate(normal, slow)
        for b in range(blocks):
            for i in range(last):
                workspace.fit[b, i] = reduced[b, i, last] if i < fast else normal[i - fast, slow]
            for i in range(fast):
                for j in range(fast, last):
                    workspace.fit[b, i] -= reduced[b, i, j] * workspace.fit[b, j]
        converged = _reweigh(values, ends, place, workspace)
    for i in range(slow + 1):
        for j in range(slow + 1):
            known[i, j] += share * (SUPPORT / blocks * normal[i, j] - known[i, j])


def weighted(values: Array, ends: _Places, fast: _Places, slow: _Places, known: Array, share: float) -> Array:
    """Return the Gram matrices (K, m, m) of blocks, and learn from them (`weigh`)."""
    place = np.concatenate([fast, slow])
    workspace = Workspace(*map(np.empty, workspace_shapes(len(values), len(ends), len(place), len(slow) - 1)))
    gram = np.empty((len(ends), values.shape[1], values.shape[1]))
    weigh(values, ends, place, len(fast), known, share, workspace, gram)
    return gram
