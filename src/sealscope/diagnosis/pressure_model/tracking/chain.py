"""The precision matrix of parameters that wander from block to block, solved in time and memory linear in the blocks.

It is block tridiagonal, with a diagonal matrix beside the diagonal, but for the weight on the record's mean parameters,
which couples all blocks by one vector a parameter. The banded part is solved by itself, the vectors are added by the
identities of Woodbury and Sylvester.

Source: G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed., 2013, secs. 2.1.4 and 4.3.5.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded

from sealscope.recordings.recording import Array


class Chain:
    """Lambda (b p, b p) of all blocks' parameters.

    Parameters
    ----------
    N : (b, p, p) array
        Information of each block.
    walk : (b - 1, p) array
        Standard deviation of the walk from each block to the next.
    anchor : (p,) array
        Weight on the mean over the blocks.
    """

    def __init__(self, N: Array, walk: Array, anchor: Array) -> None:
        blocks, p, _ = N.shape
        weights = np.zeros((blocks, p))
        weights[:-1] += 1.0 / walk**2
        weights[1:] += 1.0 / walk**2
        band = np.zeros((p + 1, blocks, p))  # band[d, b, k]: element (k + d, k) of block b, or further down
        for d in range(p):
            band[d, :, : p - d] = np.diagonal(N, -d, axis1=1, axis2=2)
        held = np.flatnonzero(anchor > 0)
        # a parameter that no block shows is known by the anchor alone: its first block takes as much, and gives it back
        loan = anchor[held] / blocks**2
        band[0] += 1e-10 * np.diagonal(N, axis1=1, axis2=2) + weights
        band[0, 0, held] += loan
        band[p, :-1] = -1.0 / walk**2
        self._lower = band.reshape(p + 1, blocks * p)
        vectors = np.zeros((blocks, p, 2 * held.size))
        columns = np.arange(held.size)
        vectors[:, held, columns] = 1.0
        vectors[0, held, held.size + columns] = 1.0
        self._vectors = vectors.reshape(blocks * p, -1)
        self._weights = np.concatenate([loan, -loan])[:, None]

    def _without_anchor(self, right: Array) -> Array:
        """Return the banded part's inverse times right (b p, m)."""
        width, size = self._lower.shape[0] - 1, self._lower.shape[1]
        band = np.zeros((2 * width + 1, size))
        band[width:] = self._lower
        for d in range(1, width + 1):
            band[width - d, d:] = self._lower[d, : size - d]
        return np.asarray(solve_banded((width, width), band, right, overwrite_ab=True), dtype=np.float64)

    def _core(self, spread: Array) -> Array:
        return np.eye(self._weights.size) + self._weights * (self._vectors.T @ spread)

    def solve(self, right: Array) -> Array:
        """Return Lambda^-1 right (b p, m)."""
        columns = right.shape[1]
        solved = self._without_anchor(np.column_stack([right, self._vectors]))
        first, spread = solved[:, :columns], solved[:, columns:]
        return first - spread @ np.linalg.solve(self._core(spread), self._weights * (self._vectors.T @ first))

    def log_determinant(self) -> float:
        """Return log det Lambda; raises LinAlgError where it is not positive definite."""
        factor = cholesky_banded(self._lower, lower=True)
        sign, core = np.linalg.slogdet(self._core(self._without_anchor(self._vectors)))
        if sign <= 0:
            raise np.linalg.LinAlgError("the precision matrix is not positive definite")
        return float(2.0 * np.sum(np.log(factor[0])) + core)


class Drifting:
    """A chain whose parameters drift besides, along given courses by amounts that are the whole record's.

    The amounts are standard normal and eliminated: all that is asked is of the chain and its drift together.

    Parameters
    ----------
    chain : Chain
        The chain without a drift.
    N : (b, p, p) array
        Information of each block.
    courses : (b, p, q) array
        What a unit of each amount adds; over the blocks each course has the mean 0, so that no anchor sees it.
    """

    def __init__(self, chain: Chain, N: Array, courses: Array) -> None:
        size = courses.shape[-1]
        self._chain, self._courses = chain, courses.reshape(-1, size)
        self._seen = (N @ courses).reshape(-1, size)
        self._shared = chain.solve(self._seen)
        self._own = np.eye(size) + self._courses.T @ self._seen - self._seen.T @ self._shared

    def solve(self, right: Array) -> Array:
        """Return what `Chain.solve` returns, of chain and drift together."""
        wandered = self._chain.solve(right)
        amounts = np.linalg.solve(self._own, self._courses.T @ right - self._seen.T @ wandered)
        return wandered + (self._courses - self._shared) @ amounts

    def log_determinant(self) -> float:
        """Return log det of the precision of wandering and amounts."""
        return self._chain.log_determinant() + float(np.linalg.slogdet(self._own)[1])
