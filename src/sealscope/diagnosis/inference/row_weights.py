"""Huber's weights of the rows of blocks, and the sums of their products: compiled laws on arrays that the caller gives.

A block's rows are v = (fast, slow, left side). Coefficients of fast columns are free in each block, those of slow ones
are the same in all blocks and believed as the sums `known` say. The weights are min(1, HUBER sigma / abs(residual)) at
the fit that they give, sigma from the median of abs(residual). Nothing here allocates: a unit for other simulators
(`fmu`) runs the same laws in C.

Source: P. J. Huber, Ann. Math. Statist. 35 (1964) 73 (weights).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import large_law, law
from sealscope.recordings.recording import Array

#: Blocks whose rows are weighted together at the beginning of a stream, and that stand for what is known later.
SUPPORT = 5
#: Where Huber's function turns from square to linear, in standard deviations: 95 % efficiency for normal errors.
HUBER = 1.345
_RIDGE = 1e-10  # of a matrix whose diagonal is 1
_MOST, _TOLERANCE = 50, 1e-2  # turns to a fixed point at most, and the mean change of a weight that ends them
_SIGMA = 1.4826  # standard deviation of normal values over the median of their size


_Places = NDArray[np.intp]


class Workspace(NamedTuple):
    """Arrays to work in, for r rows of K blocks, f fast and s slow columns.

    `weights`, `residual`, `ordered` (r,); `inner` (f, f); `cross` (K, f, s + 1); `total` (s + 1, s + 1); `normal` (s,
    s); `right` (s, 1); `scale` (f + s,).
    """

    weights: Any
    residual: Any
    ordered: Any
    inner: Any
    cross: Any
    total: Any
    normal: Any
    right: Any
    scale: Any


def workspace_shapes(rows: int, blocks: int, fast: int, slow: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of a `Workspace`."""
    own = slow + 1
    by_row = (rows,), (rows,), (rows,)
    return *by_row, (fast, fast), (blocks, fast, own), (own, own), (slow, slow), (slow, 1), (fast + slow,)


@large_law
def solve_in_place(matrix: Any, right: Any, scale: Any) -> None:
    """Put matrix^-1 right into `right` (n, k), of a symmetric matrix >= 0 (n, n) that is lost, with `scale` (n,).

    Directions that nothing is known of are left at zero.
    """
    n, k = right.shape
    for i in range(n):
        scale[i] = math.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else 1.0
    for i in range(n):
        for j in range(i + 1):
            matrix[i, j] /= scale[i] * scale[j]
        matrix[i, i] += _RIDGE
        for c in range(k):
            right[i, c] /= scale[i]
    for i in range(n):  # L L', and L^-1 right
        for j in range(i):
            for q in range(j):
                matrix[i, j] -= matrix[i, q] * matrix[j, q]
            matrix[i, j] /= matrix[j, j]
            matrix[i, i] -= matrix[i, j] ** 2
            for c in range(k):
                right[i, c] -= matrix[i, j] * right[j, c]
        matrix[i, i] = math.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else math.inf
        for c in range(k):
            right[i, c] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for c in range(k):
            right[i, c] /= matrix[i, i]
        for j in range(i):
            for c in range(k):
                right[j, c] -= matrix[i, j] * right[i, c]
        for c in range(k):
            right[i, c] /= scale[i]


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
def _add_reduced(gram: Any, fast: Any, own: Any, workspace: Any, cross: Any) -> None:
    """Add to `workspace.total` what a block says of the columns `own`, whatever the fast ones' coefficients are.

    `cross` (f, s + 1): the fast ones' coefficients for each of these.
    """
    for i in range(len(fast)):
        for j in range(len(fast)):
            workspace.inner[i, j] = gram[fast[i], fast[j]]
        for j in range(len(own)):
            cross[i, j] = gram[fast[i], own[j]]
    solve_in_place(workspace.inner, cross, workspace.scale)
    for i in range(len(own)):
        for j in range(len(own)):
            value = gram[own[i], own[j]]
            for k in range(len(fast)):
                value -= gram[own[i], fast[k]] * cross[k, j]
            workspace.total[i, j] += value


@large_law
def _reweigh(values: Any, ends: Any, fast: Any, own: Any, workspace: Any) -> bool:
    """Put Huber's weights at a fit into the workspace; return whether they are those at which it was made."""
    count, slow, b = len(values), len(own) - 1, 0
    for r in range(count):
        while r >= ends[b]:
            b += 1
        residual = values[r, own[slow]]
        for k in range(len(fast)):
            residual -= workspace.cross[b, k, slow] * values[r, fast[k]]
        for i in range(slow):
            of_slow = values[r, own[i]]
            for k in range(len(fast)):
                of_slow -= workspace.cross[b, k, i] * values[r, fast[k]]
            residual -= workspace.right[i, 0] * of_slow
        workspace.residual[r] = abs(residual)
        workspace.ordered[r] = abs(residual)
    size, change = HUBER * _SIGMA * median(workspace.ordered, count), 0.0
    for r in range(count):
        weight = size / workspace.residual[r] if size > 0.0 and workspace.residual[r] > size else 1.0
        change += abs(weight / workspace.weights[r] - 1.0)
        workspace.weights[r] = weight
    return change < _TOLERANCE * count or not size > 0.0


@large_law
def weigh(values: Any, ends: Any, fast: Any, own: Any, known: Any, share: float, workspace: Any, gram: Any) -> None:
    """Put the sums of weighted products of rows (r, m), of K blocks that end before the rows `ends`, into `gram`.

    `fast`, `own`: columns, of `own` the last is the left side. `known` (s + 1, s + 1): sums over `own` that count as
    `SUPPORT` blocks; it moves to those of these blocks by `share`. `gram` (K, m, m).
    """
    count, slow, blocks = len(values), len(own) - 1, len(ends)
    for r in range(count):
        workspace.weights[r] = 1.0
    settled = count == 0
    for turn in range(_MOST + 1):
        for i in range(slow + 1):
            for j in range(slow + 1):
                workspace.total[i, j] = 0.0
        for b in range(blocks):
            _sum_products(values, int(ends[b - 1]) if b else 0, int(ends[b]), workspace.weights, gram[b])
            _add_reduced(gram[b], fast, own, workspace, workspace.cross[b])
        if settled or turn == _MOST:
            break
        for i in range(slow):
            workspace.right[i, 0] = workspace.total[i, slow] + known[i, slow]
            for j in range(slow):
                workspace.normal[i, j] = workspace.total[i, j] + known[i, j]
        solve_in_place(workspace.normal, workspace.right, workspace.scale)
        settled = _reweigh(values, ends, fast, own, workspace)
    for i in range(slow + 1):
        for j in range(slow + 1):
            known[i, j] += share * (SUPPORT / blocks * workspace.total[i, j] - known[i, j])


def weighted(values: Array, ends: _Places, fast: _Places, own: _Places, known: Array, share: float) -> Array:
    """Return the Gram matrices (K, m, m) of blocks, and learn from them (`weigh`)."""
    workspace = Workspace(
        *(np.empty(shape) for shape in workspace_shapes(len(values), len(ends), len(fast), len(own) - 1))
    )
    gram = np.empty((len(ends), values.shape[1], values.shape[1]))
    weigh(values, ends, fast, own, known, share, workspace, gram)
    return gram
