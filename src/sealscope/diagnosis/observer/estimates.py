"""Estimates of the conductance from each block of samples, and the sums from which they are closed.

`sums` (11,): 0 samples in this block, 1 log likelihood so far, 2 sum of the squared normalised innovations, 3, 4 mean
and variance of G before this block, 5 whether a first sample was seen, 6 the sample before, 7 sum of |p_A - p_B|, 8
sum of the products of successive innovations, 9, 10 the innovations before.

Row of a block (5 + 2 m,): G from the block alone, its deviation, mean squared innovation, correlation of successive
innovations, mean |p_A - p_B|, then the m parameters and their deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sealscope.compiled import law
from sealscope.recordings.recording import Array

#: Length of the sums, and of a row without the parameters.
SUMS, LEAD = 11, 5


class Estimates(NamedTuple):
    """Estimates from k blocks of equal length.

    `G`, `sd` (k,): conductance from each block alone and its deviation by the filter's covariance, in units of
    `model.G_UNIT`; `square` (k,): mean square of the normalised innovations, 1 where the model describes the recording;
    `correlation` (k,): of successive innovations, 0 there; `dp` (k,): mean |p_A - p_B| [Pa]; `parameters`,
    `deviations` (k, m).
    """

    G: Array
    sd: Array
    square: Array
    correlation: Array
    dp: Array
    parameters: Array
    deviations: Array


@law
def begin_sums(G: float, deviation: float, sums: np.ndarray) -> None:
    """Write the sums before a first sample, with the prior of G."""
    for i in range(SUMS):
        sums[i] = 0.0
    sums[3] = G
    sums[4] = deviation**2


@law
def close_block(
    q: np.ndarray,
    P: np.ndarray,
    offset: int,
    number: int,
    sums: np.ndarray,
    walk: np.ndarray,
    G_prior: float,
    row: np.ndarray,
) -> None:
    """Write a block's row and begin the next: G starts anew, the other parameters walk by `walk`.

    With the block's prior N(m_0, P_0) and posterior N(m_1, P_1) of G, the block alone gives G = (m_1/P_1 -
    m_0/P_0)/(1/P_1 - 1/P_0), of variance 1/(1/P_1 - 1/P_0): information adds. `offset`: row of the first parameter in
    P; `number`: G's number among the parameters.
    """
    g = offset + number
    m = q.size
    information = 1.0 / P[g, g] - 1.0 / sums[4]
    row[0] = (q[number] / P[g, g] - sums[3] / sums[4]) / information
    row[1] = math.sqrt(1.0 / information) if information > 0.0 else math.inf
    row[2] = sums[2] / sums[0]
    row[3] = sums[8] / sums[2] if sums[2] > 0.0 else 0.0
    row[4] = sums[7] / sums[0]
    for j in range(m):
        row[LEAD + j] = q[j]
        row[LEAD + m + j] = math.sqrt(max(P[offset + j, offset + j], 0.0))
        P[offset + j, offset + j] += walk[j]
    for j in range(P.shape[0]):
        P[g, j] = 0.0
        P[j, g] = 0.0
    P[g, g] = G_prior**2
    sums[0] = 0.0
    sums[2] = 0.0
    sums[3] = q[number]
    sums[4] = P[g, g]
    sums[7] = 0.0
    sums[8] = 0.0


class BlockRows:
    """Rows of closed blocks, in order."""

    def __init__(self, parameters: int) -> None:
        self._m = parameters
        self._rows: list[Array] = []

    def buffer(self, most: int) -> Array:
        """Return empty rows for at most `most` blocks."""
        return np.empty((most, LEAD + 2 * self._m))

    def add(self, rows: Array) -> None:
        """Append a copy of written rows."""
        if len(rows):
            self._rows.append(rows.copy())

    def clear(self) -> None:
        """Keep no row that was added."""
        self._rows = []

    def estimates(self) -> Estimates:
        """Return the estimates of all blocks so far."""
        rows = np.concatenate(self._rows) if self._rows else self.buffer(0)
        G, sd, square, correlation, dp = rows[:, :LEAD].T
        return Estimates(G, sd, square, correlation, dp, rows[:, LEAD : LEAD + self._m], rows[:, LEAD + self._m :])
