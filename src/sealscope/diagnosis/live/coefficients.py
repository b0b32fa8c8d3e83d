"""Estimate a volume balance's coefficients recursively, from sums over the last blocks; compiled.

The columns are ordered as n nuisances (coefficients other than the leak's), leak, left side. C (n, n) are the products
of the nuisances' columns with each other and m (n,) those with the left side, summed over the blocks, with the leak's
column eliminated from both. Then the nuisances c, and the leak's coefficient g_k in block k, are

    c = C^-1 m,    g_k = (n_k - b_k' c) / N_k,    Var g_k = s^2 / N_k,

where N_k, n_k and b_k are the products of the leak's column with itself, the left side and the nuisances over the
rows (equations) of block k, and s^2 is the long-run variance of a row. A leak does not enter c, so that a step of g_k
is a step of the leak. No function allocates memory, as controllers and units of other
programs run the same functions in C (`emit`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sealscope.compiled import large_law, law
from sealscope.diagnosis.inference.rows import OVERLAP, eliminate
from sealscope.diagnosis.priors.live import LIVE

#: Standard deviations beyond which a residual is a glitch or a step; fraction of the usual motion at a standstill.
JUMP: float = LIVE.coefficients.jump
STANDSTILL: float = LIVE.block.standstill
#: Successive blocks at a standstill, or far closer to the fit than usual, after which all is learned anew: what was
#: learned has faded by `STANDSTILL` then, and motion would be as never before.
OUTDATED_BLOCKS = round(LIVE.coefficients.memory * -math.log(STANDSTILL))
#: A block at standstill counts if its precision is over this fraction of the usual precision. After `N_WAKING`
#: successive blocks that move far more than usual, the machine is taken to have stood still before.
MIN_REST_PRECISION: float = LIVE.block.rest_precision
N_WAKING: int = LIVE.block.waking_blocks
#: Factor per block by which the weight of earlier blocks decays, and the same for the shift of the series.
_MEMORY: float = math.exp(-1.0 / LIVE.coefficients.memory)
_SHIFT_DECAY: float = math.exp(-1.0 / LIVE.coefficients.returns)
TINY = float(np.finfo(float).tiny)
#: A residual's sum of squares below this fraction of the left side's is due to rounding.
ROUNDING = 1e-14

#: Indices of `Coefficients.numbers`.
ROWS = 0  # number of equations in the sums
MOTION = 1  # sum of squares of their left sides
NOISE = 2  # variance of an equation's residual
ENERGY = 3  # sum of squares of the leak's column
SHIFT = 4  # subtracted from the estimates of the leak, so that their series remains continuous
MISFIT = 5  # residual variance of the last block over the usual variance


class Coefficients(NamedTuple):
    """Nuisances of a volume balance, n in number, and the sums over blocks from which they are computed."""

    # work arrays
    block: Any  # (n + 2, n + 2): products of one block
    matrix: Any  # (n, n + 3): normal equations
    volume: Any  # (1,): sum of squares of the measured volume in one block
    sums: Any  # (n + 2, n + 2): weighted products of the columns of nuisances, leak and left side
    values: Any  # (n,): the nuisances
    leak_products: Any  # (n,): products of the leak's column with the nuisances' columns
    numbers: Any  # (6,): by the indices above


def coefficient_shapes(n: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of the arrays of a `Coefficients` with n nuisances, in the order of its fields."""
    return (n + 2, n + 2), (n, n + 3), (1,), (n + 2, n + 2), (n,), (n,), (6,)


@law
def load_block(model: Any, gram: Any, column_order: Any) -> None:
    """Copy the products of a volume balance's columns in one block to `model.block` (n + 2, n + 2).

    `model` is a `Coefficients`, and `gram` (m, m) holds the products of all m columns. `column_order` (n + 2,): indices
    of the columns to copy, n nuisances (terms other than the leak), the leak, the left side.
    """
    for i in range(len(column_order)):
        for j in range(len(column_order)):
            model.block[i, j] = gram[column_order[i], column_order[j]]
    model.volume[0] = gram[column_order[-1], column_order[-1]]


@large_law
def add_block(model: Any, rows: float, weight: float, has_stepped: bool) -> None:
    """Add the products in `model.block` to the sums over earlier blocks, which lose weight exponentially.

    `model` is a `Coefficients`, `rows` the number of equations in the block, and `weight` the weight of the block, 0 to
    1. The leak's coefficient is assumed to take a random step before each block, and its value before this step is
    eliminated. The variance of this step is that of the block's estimate of the leak or, if `has_stepped`, infinite.
    With the sums S, their column S_l and diagonal element S_ll of the leak, and the block's products B,

        S <- exp(-1/memory) (S - S_l S_l' / (S_ll + B_ll)) + weight B,

    where `memory` is a number of blocks (`priors.toml`). If `has_stepped`, B_ll is left out of the denominator.
    `leak_products` and `ENERGY`, of which `estimate_leak` uses the ratio, need no `weight`.
    """
    sums, block, size = model.sums, model.block, len(model.block)
    leak = size - 2  # index of the leak's column, before the left side
    leak_column = model.matrix[0]  # free memory, for a copy of the column, as the sums change below
    for i in range(size):
        leak_column[i] = sums[i, leak]
    information = leak_column[leak] + (0.0 if has_stepped else max(block[leak, leak], TINY))
    for i in range(size):
        for j in range(size):
            # information that is lost as the leak before the random step is eliminated
            loss = leak_column[i] * (leak_column[j] / information) if information > 0.0 else 0.0
            sums[i, j] = _MEMORY * (sums[i, j] - loss) + weight * block[i, j]
    for i in range(leak):
        model.leak_products[i] = _MEMORY * model.leak_products[i] + block[i, leak]
    model.numbers[ENERGY] = _MEMORY * model.numbers[ENERGY] + block[leak, leak]
    model.numbers[ROWS] = _MEMORY * model.numbers[ROWS] + weight * rows
    model.numbers[MOTION] = _MEMORY * model.numbers[MOTION] + weight * model.volume[0]


@large_law
def _solve(model: Any) -> None:
    """Estimate the coefficients of all columns but the leak's by least squares, and solve for two further right sides.

    With the normal equations C c = m of these n nuisances, computed from the sums (module's docstring), the columns n
    to n + 2 of `model.matrix` receive c and the two solutions x of C x = r. The right sides r stand in the last two
    columns before.
    """
    sums, n = model.sums, len(model.matrix)
    leak, left_side = n, n + 1  # indices of these columns, after those of the n unknowns
    leak_energy = max(sums[leak, leak], TINY)  # never 0, as it divides
    for i in range(n):
        model.matrix[i, n] = sums[i, left_side] - sums[i, leak] * sums[leak, left_side] / leak_energy
        for j in range(n):
            model.matrix[i, j] = sums[i, j] - sums[i, leak] * sums[leak, j] / leak_energy
    eliminate(model.matrix, n)


@large_law
def _sum_residual_squares(sums: Any, solution: Any) -> float:
    """Compute a volume balance's residual sum of squares, with the leak's coefficient that minimises it.

    `sums` (n + 2, n + 2) are the products of the columns of n nuisances, leak and left side. Column 0 of `solution`
    (n, k) holds the nuisances.
    """
    n, square, leak_moment = len(solution), 0.0, 0.0
    # with the left side y, the columns X of the nuisances c and the column l of the leak, the sum is
    # y'(y - X c) - c'X'(y - X c) - (l'(y - X c))^2 / l'l
    for i in range(n + 2):
        residual = sums[i, n + 1]  # product of column i with the left side less the nuisances
        for j in range(n):
            residual -= sums[i, j] * solution[j, 0]
        if i < n:
            square -= solution[i, 0] * residual
        elif i == n:
            leak_moment = residual
        else:
            square += residual
    return float(square - leak_moment**2 / max(sums[n, n], TINY))


@large_law
def fit_coefficients(model: Any) -> None:
    """Estimate the nuisances (`values`) by least squares, and the variance of an equation's residual (`NOISE`)."""
    n = len(model.matrix)
    solution = model.matrix[:, n:]
    solution[:] = 0.0  # only column 0, the estimate, is needed
    _solve(model)
    for i in range(n):
        model.values[i] = solution[i, 0]
    square = _sum_residual_squares(model.sums, solution)
    rounding = ROUNDING * model.sums[n + 1, n + 1]
    model.numbers[NOISE] = max(square, rounding, TINY) / model.numbers[ROWS]


@large_law
def _learn_block(model: Any, rows: float, g: float) -> float:
    """Add the products in `model.block` to the sums over blocks, update the usual noise, and return the block's weight.

    `model` is a `Coefficients`, `rows` the number of equations in the block, and `g` its leak coefficient. Column n of
    `model.matrix` holds the nuisances (`_solve`). The weight is 1, or `JUMP`^2 / MISFIT if this is less: residuals
    whose rms exceeds `JUMP` usual standard deviations are due to a glitch or a step within the block, and count as if
    the rms were `JUMP` deviations. If g differs from its earlier estimate by more than `JUMP` standard deviations, the
    leak has stepped, and earlier blocks do not constrain it any more.
    """
    sums, numbers, n = model.sums, model.numbers, len(model.matrix)
    variance = max(_sum_residual_squares(model.block, model.matrix[:, n:]), 0.0) / rows
    numbers[MISFIT] = variance / numbers[NOISE]
    weight = min(1.0, JUMP**2 * numbers[NOISE] / max(variance, TINY))
    # earlier estimate of the leak, from the sums: `n` is the index of the leak's column
    moment, information = sums[n, n + 1], max(sums[n, n], TINY)
    for i in range(n):
        moment -= sums[n, i] * model.matrix[i, n]
    step = g - moment / information
    energy = max(model.block[n, n], TINY)
    # variances over that of an equation: 1/(energy weight) of g, the same of the leak's random step, and 1/information
    # of the earlier estimate; `add_block` takes 1/energy for the random step, without the weight. As successive
    # equations overlap, all are raised by the factor OVERLAP
    step_variance = OVERLAP * numbers[NOISE] * (2.0 / (energy * weight) + 1.0 / information)
    has_stepped = step**2 > JUMP**2 * step_variance
    add_block(model, rows, weight, has_stepped)
    numbers[NOISE] += (1.0 - _MEMORY) * (variance * weight - numbers[NOISE])
    return float(weight)


@large_law
def estimate_leak(model: Any, rows: float, is_learned: bool) -> tuple[float, float, float, float]:
    """Estimate the leak's coefficient in one block of a volume balance.

    `model` is a `Coefficients`, whose `block` holds the products of the block's columns, and `rows` is the block's
    number of equations. With `is_learned`, the block is also added to the sums over earlier blocks in `model`. Returns
    (w, w g, w s, w^2 V): g is the estimate, and w its precision. The shift s, to be subtracted from g, keeps the series
    continuous while the other coefficients (nuisances) improve. V is the variance of g due to errors of the nuisances.
    """
    block, n, numbers = model.block, len(model.matrix), model.numbers
    # C: normal matrix of the n nuisances c; b: products of the leak's column (index n) with theirs in this block; b_u:
    # usual value of b. The columns of `solution` become c, C^-1 b and C^-1 (b - b_u)
    solution = model.matrix[:, n:]
    # sums of squares of the leak's column, in this block and in the last blocks
    energy, usual_energy = max(block[n, n], TINY), max(numbers[ENERGY], TINY)
    for i in range(n):
        solution[i, 1] = block[i, n]
        solution[i, 2] = block[i, n] - energy * (model.leak_products[i] / usual_energy)
    _solve(model)
    # moment: product of the leak's column with the left side less the nuisances; unusual: (b - b_u)' C^-1 (b - b_u);
    # systematic: b' C^-1 b
    moment, unusual, systematic = block[n, n + 1], 0.0, 0.0
    numbers[SHIFT] *= _SHIFT_DECAY
    for i in range(n):
        # regression of the nuisance's column on the leak's column over the last blocks
        usual_slope = model.leak_products[i] / usual_energy
        moment -= block[i, n] * solution[i, 0]
        numbers[SHIFT] -= usual_slope * (solution[i, 0] - model.values[i])
        unusual += (block[i, n] - energy * usual_slope) * solution[i, 2]
        systematic += block[i, n] * solution[i, 1]
        model.values[i] = solution[i, 0]
    g, weight = moment / energy, 1.0
    if is_learned:
        weight = _learn_block(model, rows, g)
    # errors of the nuisances add to the noise of the series only if b differs from b_u; as successive equations
    # overlap, all variances are raised by the factor OVERLAP
    precision = energy / (OVERLAP * numbers[NOISE] * (1.0 / weight + max(unusual, 0.0) / energy))
    systematic_variance = max(systematic, 0.0) * OVERLAP * numbers[NOISE] * (precision / energy) ** 2  # w^2 V
    return precision, precision * g, precision * numbers[SHIFT], systematic_variance


@law
def relative_motion(square: float, rows: float, numbers: Any) -> float:
    """Compute the mean square of the measured volume in a block, divided by that in earlier blocks.

    `square` is the sum of squares over the block's `rows` equations, and `numbers` is `Coefficients.numbers`. Returns
    infinity if only this block moved, and 1 if no block has moved.
    """
    usual_square = numbers[MOTION] * rows
    return square * numbers[ROWS] / usual_square if usual_square > 0.0 else (math.inf if square > 0.0 else 1.0)


#: Results of `judge_estimate`: the estimate counts; it is too uncertain; what was learned is not that of the machine.
COUNTS, UNCERTAIN, OUTDATED = range(3)


@law
def is_waking(m: Any, motion: float) -> bool:
    """Count a block by its relative `motion`, and return True after `N_WAKING` successive ones that move far more.

    If the usual blocks stood still and this one moves, its relative motion is above 1/`STANDSTILL`. `m` has the fields
    `n_moving`, and for `judge_estimate` `n_still` and `usual_precision`.
    """
    m.n_moving = m.n_moving + 1 if motion > 1.0 / STANDSTILL else 0
    return bool(m.n_moving >= N_WAKING)


@law
def judge_estimate(m: Any, motion: float, misfit: float, results: float, precision: float, min_precision: float) -> int:
    """Decide whether the estimate of a block counts: `COUNTS`, `UNCERTAIN` or `OUTDATED`.

    At standstill, i.e. with a relative `motion` below `STANDSTILL`, the precision must be above `MIN_REST_PRECISION`
    times the usual one, otherwise above `min_precision`; it must not be NaN. What was learned is outdated if `results`,
    a sum of all numbers, is not finite, or after `OUTDATED_BLOCKS` successive blocks at standstill or with a `misfit`
    below `STANDSTILL`: readings of a faulty sensor may have been learned, beside which any motion is none.
    """
    is_still = motion < STANDSTILL
    m.n_still = m.n_still + 1 if is_still or misfit < STANDSTILL else 0
    if not math.isfinite(results) or m.n_still >= OUTDATED_BLOCKS:
        return OUTDATED
    least = max(min_precision, MIN_REST_PRECISION * m.usual_precision) if is_still else min_precision
    return COUNTS if precision > least else UNCERTAIN
