"""What the last blocks say of all coefficients of an equation: sums that are added up and forgotten, compiled.

Columns are in the order others, leak, left side. With C, m the sums over the others, and with the left side, from which
the leak's column is eliminated,

    c = C^-1 m,    g_k = (n_k - b_k' c) / N_k,    Var g_k = s^2 / N_k,

N_k, n_k, b_k the products of the leak's column with itself, the left side and the others over the rows of block k, s^2
the long-run variance of a row. A leak does not enter c, so that a step of g_k is a step of the leak. Nothing here
allocates: a unit for other simulators (`fmu`) runs the same laws in C.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sealscope.compiled import large_law, law
from sealscope.diagnosis.inference.rows.row_weights import eliminate
from sealscope.diagnosis.inference.rows.weak_form import OVERLAP
from sealscope.diagnosis.priors import priors

JUMP: float = priors("live")["coefficients"]["jump"]
STANDSTILL: float = priors("live")["block"]["standstill"]
#: What is left after a block of what those before said, and of how far the series stands from the present level.
_KEEP, _RETURNS = (math.exp(-1.0 / priors("live")["coefficients"][name]) for name in ("memory", "returns"))
TINY = float(np.finfo(float).tiny)

#: Places in `Known.numbers`: rows and motion that the sums are of, variance of a row, energy of the leak's column, how
#: far the series stands from the level, and the variance of the last block's rows over the usual one.
NUMBERS = ("rows", "motion", "noise", "energy", "shift", "misfit")
ROWS, MOTION, NOISE, ENERGY, SHIFT, MISFIT = range(len(NUMBERS))


class Known(NamedTuple):
    """The sums over n other columns, and arrays to work in.

    `sums` (n + 2, n + 2); `coefficients`, `along` (n,), the leak's products with the others; `numbers`; `own` (n + 2,
    n + 2), those of the block; `matrix` (n, n + 3), the others' and their right sides.
    """

    sums: Any
    coefficients: Any
    along: Any
    numbers: Any
    own: Any
    matrix: Any


def known_shapes(n: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of a `Known`."""
    return (n + 2, n + 2), (n,), (n,), (len(NUMBERS),), (n + 2, n + 2), (n, n + 3)


@law
def take(known: Any, gram: Any, place: Any) -> None:
    """Copy a block's sums (m, m) into `known.own`, in the order `place`: nuisances, leak, left side."""
    for i in range(len(place)):
        for j in range(len(place)):
            known.own[i, j] = gram[place[i], place[j]]


@large_law
def add(known: Any, rows: float, weight: float, stepped: bool) -> None:
    """Add the block `known.own` to the sums; forget a part of the blocks before.

    The leak walks between blocks by as much as a block tells of it, or any distance where it `stepped`.
    """
    sums, gram, n, leak = known.sums, known.own, len(known.own), len(known.own) - 2
    walked = sums[leak, leak] + (0.0 if stepped else max(gram[leak, leak], TINY))
    for i in range(n):  # the leak's row is needed until the last
        for j in range(n):
            if leak not in (i, j):
                less = sums[i, leak] * sums[leak, j] / walked if walked > 0.0 else 0.0
                sums[i, j] = _KEEP * (sums[i, j] - less) + weight * gram[i, j]
    rest = 1.0 - sums[leak, leak] / walked if walked > 0.0 else 1.0
    for i in range(n):
        if i != leak:
            sums[leak, i] = sums[i, leak] = _KEEP * rest * sums[i, leak] + weight * gram[i, leak]
    sums[leak, leak] = _KEEP * rest * sums[leak, leak] + weight * gram[leak, leak]
    for i in range(leak):
        known.along[i] = _KEEP * known.along[i] + gram[i, leak]
    known.numbers[ENERGY] = _KEEP * known.numbers[ENERGY] + gram[leak, leak]
    known.numbers[ROWS] = _KEEP * known.numbers[ROWS] + weight * rows
    known.numbers[MOTION] = _KEEP * known.numbers[MOTION] + weight * gram[n - 1, n - 1]


@large_law
def _solve(known: Any) -> None:
    """Put the other coefficients, whatever the leak is, and C^-1 times the other right sides in the latter's place."""
    sums, n = known.sums, len(known.matrix)
    leak = max(sums[n, n], TINY)
    for i in range(n):
        known.matrix[i, n] = sums[i, n + 1] - sums[i, n] * sums[n, n + 1] / leak
        for j in range(n):
            known.matrix[i, j] = sums[i, j] - sums[i, n] * sums[n, j] / leak
    eliminate(known.matrix, n)


@large_law
def _sum_residual_squares(sums: Any, right: Any) -> float:
    """Return the sum of squares that the coefficients right[:, 0] leave, whatever the leak is."""
    n, square, direction = len(right), 0.0, 0.0
    for i in range(n + 2):
        rest = sums[i, n + 1]
        for j in range(n):
            rest -= sums[i, j] * right[j, 0]
        if i < n:
            square -= right[i, 0] * rest
        elif i == n:
            direction = rest
        else:
            square += rest
    return float(square - direction**2 / max(sums[n, n], TINY))


@large_law
def begin(known: Any) -> None:
    """Compute the coefficients and the variance of a row from the sums."""
    n = len(known.matrix)
    right = known.matrix[:, n:]
    right[:] = 0.0
    _solve(known)
    for i in range(n):
        known.coefficients[i] = right[i, 0]
    left = _sum_residual_squares(known.sums, right)
    known.numbers[NOISE] = max(left, 1e-14 * known.sums[n + 1, n + 1], TINY) / known.numbers[ROWS]


@large_law
def says(known: Any, rows: float, adds: bool) -> tuple[float, float, float, float]:
    """Estimate the leak's coefficient from the block `known.own` and those before it; with `adds`, keep the block.

    The precision of the leak's coefficient; that times its estimate, and times what is to be taken from it so that the
    series does not move with the other coefficients; the variance that these leave, times the precision squared.
    """
    gram, n, numbers = known.own, len(known.matrix), known.numbers
    right = known.matrix[:, n:]
    energy, usual = max(gram[n, n], TINY), max(numbers[ENERGY], TINY)
    for i in range(n):
        right[i, 1] = gram[i, n]
        right[i, 2] = gram[i, n] - energy * (known.along[i] / usual)
    _solve(known)
    lead, numbers[SHIFT], turned, leaning = gram[n, n + 1], _RETURNS * numbers[SHIFT], 0.0, 0.0
    for i in range(n):
        lead -= gram[i, n] * right[i, 0]
        numbers[SHIFT] -= known.along[i] / usual * (right[i, 0] - known.coefficients[i])
        turned += (gram[i, n] - energy * (known.along[i] / usual)) * right[i, 2]
        leaning += gram[i, n] * right[i, 1]
        known.coefficients[i] = right[i, 0]
    g, weight = lead / energy, 1.0
    if adds:
        left = max(_sum_residual_squares(gram, right), 0.0) / rows
        numbers[MISFIT] = left / numbers[NOISE]
        weight = min(1.0, JUMP**2 * numbers[NOISE] / max(left, TINY))
        before, information = known.sums[n, n + 1], max(known.sums[n, n], TINY)
        for i in range(n):
            before -= known.sums[n, i] * right[i, 0]
        spread = OVERLAP * numbers[NOISE] * (2.0 / (energy * weight) + 1.0 / information)
        add(known, rows, weight, (g - before / information) ** 2 > JUMP**2 * spread)
        numbers[NOISE] += (1.0 - _KEEP) * (left * weight - numbers[NOISE])
    # beside its rows' noise a block has what it leans on the others otherwise than the usual one
    variance = OVERLAP * numbers[NOISE] * (1.0 / weight + max(turned, 0.0) / energy)
    precision = energy / variance
    leaning = max(leaning, 0.0) * OVERLAP * numbers[NOISE] / variance**2
    return precision, precision * g, precision * numbers[SHIFT], leaning


@law
def motion(square: float, rows: float, numbers: Any) -> float:
    """Compute a block's motion, the left side's sum of squares, over the usual one of as many rows.

    Infinite where none was usual.
    """
    usual = numbers[MOTION] * rows
    return square * numbers[ROWS] / usual if usual > 0.0 else (math.inf if square > 0.0 else 1.0)
