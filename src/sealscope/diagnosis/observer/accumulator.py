"""The observers' bookkeeping: what a block of samples says of the conductance by itself, and how white the innovations
were.

Tally (11,): 0 samples in this block, 1 log likelihood so far, 2 sum of the squared normalised innovations, 3, 4 mean
and variance of G before this block, 5 whether a first sample was seen, 6 the sample before, 7 sum of |p_A - p_B|, 8
sum of the products of successive innovations, 9, 10 the innovations before.

Row of a block (5 + 2 m,): G by itself, its deviation, mean squared innovation, correlation of successive ones, mean
|p_A - p_B|, then the m parameters and their deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sealscope.compiled import law
from sealscope.recordings.recording import Array

_LEAD = 5


class Estimates(NamedTuple):
    """What blocks of equal length say, k of them: `G`, `sd` (k,) the conductance from each alone and its deviation by
    the filter's covariance, in units of `observer_model.G_UNIT`; `square` (k,) mean square of the normalised
    innovations, 1 where the model describes the recording; `correlation` (k,) of successive ones, 0 there; `dp` (k,)
    mean |p_A - p_B| [Pa]; `parameters`, `deviations` (k, m)."""

    G: Array
    sd: Array
    square: Array
    correlation: Array
    dp: Array
    parameters: Array
    deviations: Array


def new_tally(G: float, deviation: float) -> Array:
    """An empty tally before a first sample."""
    tally = np.zeros(11)
    tally[3], tally[4] = G, deviation**2
    return tally


@law
def close_block(
    q: np.ndarray,
    P: np.ndarray,
    offset: int,
    number: int,
    tally: np.ndarray,
    walk: np.ndarray,
    G_prior: float,
    row: np.ndarray,
) -> None:
    """Write a block's row and begin the next: G starts anew, the other parameters walk by `walk`.

    With the block's prior N(m_0, P_0) and posterior N(m_1, P_1) of G, the block by itself says G = (m_1/P_1 -
    m_0/P_0)/(1/P_1 - 1/P_0), of variance 1/(1/P_1 - 1/P_0): information adds. `offset`: row of the first parameter in
    P; `number`: G's number among the parameters.
    """
    g = offset + number
    m = q.size
    information = 1.0 / P[g, g] - 1.0 / tally[4]
    row[0] = (q[number] / P[g, g] - tally[3] / tally[4]) / information
    row[1] = math.sqrt(1.0 / information) if information > 0.0 else math.inf
    row[2] = tally[2] / tally[0]
    row[3] = tally[8] / tally[2] if tally[2] > 0.0 else 0.0
    row[4] = tally[7] / tally[0]
    for j in range(m):
        row[_LEAD + j] = q[j]
        row[_LEAD + m + j] = math.sqrt(max(P[offset + j, offset + j], 0.0))
        P[offset + j, offset + j] += walk[j]
    for j in range(P.shape[0]):
        P[g, j] = 0.0
        P[j, g] = 0.0
    P[g, g] = G_prior**2
    tally[0] = 0.0
    tally[2] = 0.0
    tally[3] = q[number]
    tally[4] = P[g, g]
    tally[7] = 0.0
    tally[8] = 0.0


class Blocks:
    """Rows of blocks, in the order they were closed."""

    def __init__(self, parameters: int) -> None:
        self._m = parameters
        self._rows: list[Array] = []

    def room(self, most: int) -> Array:
        """Empty rows for at most so many blocks."""
        return np.empty((most, _LEAD + 2 * self._m))

    def add(self, rows: Array) -> None:
        """Keep rows that were written."""
        if len(rows):
            self._rows.append(rows.copy())

    def estimates(self) -> Estimates:
        """All blocks so far."""
        rows = np.concatenate(self._rows) if self._rows else self.room(0)
        G, sd, square, correlation, dp = rows[:, :_LEAD].T
        return Estimates(G, sd, square, correlation, dp, rows[:, _LEAD : _LEAD + self._m], rows[:, _LEAD + self._m :])
