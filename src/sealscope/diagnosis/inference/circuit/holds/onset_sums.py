"""Compiled sums over the readings of all holds, from which a leak since any of many onsets is fitted.

A leak that begins at s has lost nothing before, and in the holds after it as much as one from their beginning: only in
the hold about s does its column of readings (`HeldChambers`) depend on s. The products of the columns of all onsets
with the regressors are therefore sums over the later holds, which are accumulated from the last hold backwards, and
the products within one hold. Time and memory are proportional to the number of samples.

With the relative growth g from s to the end e of the recording, the flow u of a leak becomes

    (1 + g (t - s)/(e - s)) u = (1 + g) u - g/(e - s) (e - t) u,

so that the products follow from those of the flows u and (e - t) u.

The products of several leaks are summed side by side: arrays have the leaks along their last axis, over which the
innermost loops run on the vector registers of the processor.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel, large_law
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import LockedHold, small_difference_factor
from sealscope.recordings.recording import Array

#: Number of properties of the oil, and of the regressors whose products are summed: displaced volume and volumes that
#: are taken up by oil and air (`OilRegression`).
N_OIL, N_REGRESSORS = 4, 7
#: All choices of the properties of the oil that are free in a fit, the others being at their limits, (16, 4).
_FREE: NDArray[np.bool_] = np.array(list(itertools.product((True, False), repeat=N_OIL)))
#: Smallest pivot of a scaled matrix, and smallest energy of a leak's column over the largest, that counts.
_MIN_PIVOT, _MIN_ENERGY = 1e-15, 1e-12
#: Relative rounding error that a property may lie outside of its limits.
ROUNDING = 1e-9
#: Most leaks whose products are summed side by side, so that the arrays of a hold stay in the processor's cache, and
#: number of leaks in a whole round of the innermost loops.
_MOST_LEAKS, _WIDTH = 32, 16
_TINY = float(np.finfo(float).tiny)


class HoldSamples(NamedTuple):
    """Samples of all holds, one after the other, for compiled functions.

    - `t`, `p_A`, `p_B`, `x`, `difference` (N,): time [s], absolute pressures [Pa], position [m] and recorded p_A - p_B
      [Pa] of the samples of H holds.
    - `begin` (H + 1,): index of the first sample of each hold, and N.
    - `edges` (E,), `first_edge` (H + 1,): indices of the samples that bound the readings of all holds, and of the first
      of these edges of each hold.
    - `is_A_loaded` (H,): true for a hold in which A has the higher pressure at first.
    """

    t: Any
    p_A: Any
    p_B: Any
    x: Any
    difference: Any
    begin: Any
    edges: Any
    first_edge: Any
    is_A_loaded: Any

    @classmethod
    def from_holds(cls, holds: Sequence[LockedHold]) -> HoldSamples:
        """Join the samples of the `holds`."""
        begin = np.cumsum([0, *(len(hold.t) for hold in holds)])
        edges = [hold.edges + first for hold, first in zip(holds, begin.tolist(), strict=False)]
        return cls(
            np.concatenate([hold.t for hold in holds]),
            np.concatenate([hold.p_A for hold in holds]),
            np.concatenate([hold.p_B for hold in holds]),
            np.concatenate([hold.x for hold in holds]),
            np.concatenate([hold.difference for hold in holds]),
            begin,
            np.concatenate(edges),
            np.cumsum([0, *(len(bounds) for bounds in edges)]),
            np.array([hold.is_A_loaded for hold in holds]),
        )

    @property
    def sizes(self) -> NDArray[np.intp]:
        """Number of samples of each hold, (H,)."""
        return np.asarray(np.diff(self.begin))

    def readings(self, values: Array) -> Array:
        """Average `values` (N,) of the samples to the r readings of one side of all holds, (r,)."""
        is_within_hold = np.ones(len(self.edges) - 1, dtype=bool)
        is_within_hold[self.first_edge[1:-1] - 1] = False  # from the last edge of a hold to the first of the next
        starts, sizes = self.edges[:-1][is_within_hold], np.diff(self.edges)[is_within_hold]
        return np.asarray(np.add.reduceat(values, starts) / sizes)

    def centre(self, readings: Array, is_A: bool) -> Array:
        """Subtract the mean over each hold from `readings` (r, ...) of side A, or of side B if `is_A` is False.

        In a hold, the first reading of the side with the higher pressure becomes 0 and does not count in the mean,
        since the valves may still be shutting.
        """
        counts = np.diff(self.first_edge) - 1  # readings of each hold
        first = np.cumsum(counts) - counts
        is_counted = np.ones(len(readings), dtype=bool)
        is_counted[first[self.is_A_loaded == is_A]] = False
        weights = is_counted.astype(float).reshape(-1, *[1] * (readings.ndim - 1))
        means = np.add.reduceat(readings * weights, first) / np.add.reduceat(weights, first)
        return np.asarray((readings - np.repeat(means, counts, axis=0)) * weights)


class OnsetPriors(NamedTuple):
    """Numbers of a regression that the onsets of leaks are scored by, for compiled functions.

    - `products` (7, 7): products of the regressors.
    - `precisions` (4,): inflated prior precisions of the properties; `lowest` (4,): their lower limits.
    - `misfit_variance`: variance of a reading in addition to the noise [m^6]; `variance`: that without a leak [m^6].
    - `n_rows`, `n_readings`: number of rows, and effective number of independent readings.
    """

    products: Any
    precisions: Any
    lowest: Any
    misfit_variance: float
    variance: float
    n_rows: float
    n_readings: float


class SumWorkspace(NamedTuple):
    """Scratch arrays for the sums over n samples, the most of a hold, and o onsets of l leaks side by side.

    - `flow` (2, n, l): flow out of A and out of B of each leak with a coefficient of 1, in one hold.
    - `volume` (2, n, l), `sums` (2, n + 1, l): volumes of these flows since the beginning of the hold, and their sums.
    - `column` (n, l), `before`, `mean` (l,): readings of one side, and parts of these.
    - `later` (9, l), `products` (o, 9, l): products (`_add_products`) of later holds, and for each onset.
    """

    flow: Any
    volume: Any
    sums: Any
    column: Any
    before: Any
    mean: Any
    later: Any
    products: Any

    @classmethod
    def with_sizes(cls, n_samples: int, n_onsets: int, n_leaks: int) -> SumWorkspace:
        """Allocate the arrays."""
        n, rows = n_samples, N_REGRESSORS + 2
        shapes = [(2, n), (2, n), (2, n + 1), (n,), (), (), (rows,), (n_onsets, rows)]
        return cls._make([np.zeros((*shape, n_leaks)) for shape in shapes])


class Workspace(NamedTuple):
    """Scratch arrays for the scores of o onsets, since compiled laws allocate no memory.

    - `squares` (o,): results for each onset; `per_leak` (o, 4), `with_column` (o, 5), `column_squares`, `energies`
      (o,).
    - `basis` (7, 5), `gram` (5, 5), `masked`, `factor`, `inverse` (4, 4), `scale`, `limits`, `remainder`,
      `without_leak`, `slope_without` (4,): parts of a fit; `unsolved` (o,): onsets whose least squares are not found;
      `cases`, `n_solved` (16,): cases of properties at their limits, in the order in which they are tried, and the
      number of onsets whose least squares each has found.
    """

    squares: Any
    per_leak: Any
    with_column: Any
    column_squares: Any
    energies: Any
    basis: Any
    gram: Any
    masked: Any
    factor: Any
    inverse: Any
    scale: Any
    limits: Any
    remainder: Any
    without_leak: Any
    slope_without: Any
    unsolved: Any
    cases: Any
    n_solved: Any

    @classmethod
    def with_onsets(cls, n_onsets: int) -> Workspace:
        """Allocate the arrays for a number of onsets."""
        n, k = N_OIL, N_OIL + 1
        shapes: list[tuple[int, ...]] = [(n_onsets,), (n_onsets, n), (n_onsets, k), (n_onsets,), (n_onsets,)]
        shapes += [(N_REGRESSORS, k), (k, k), *[(n, n)] * 3, *[(n,)] * 5]
        cases, n_solved = np.arange(len(_FREE)), np.zeros(len(_FREE), dtype=np.intp)
        return cls._make([*map(np.empty, shapes), np.empty(n_onsets, dtype=np.intp), cases, n_solved])


@large_law
def _integrate(samples: Any, hold: int, work: Any) -> None:
    """Integrate `work.flow` of a hold to the `volume` that has left since its beginning, and to the `sums` of these.

    The sums are those of the volumes of the hold's samples before each.
    """
    begin, n_leaks = samples.begin[hold], len(work.before)
    for side in range(2):
        flow, volume, sums = work.flow[side], work.volume[side], work.sums[side]
        for j in range(n_leaks):
            volume[0, j] = sums[0, j] = sums[1, j] = 0.0
        for i in range(1, samples.begin[hold + 1] - begin):
            half_step = 0.5 * (samples.t[begin + i] - samples.t[begin + i - 1])
            for j in range(n_leaks):
                volume[i, j] = volume[i - 1, j] + (flow[i, j] + flow[i - 1, j]) * half_step
                sums[i + 1, j] = sums[i, j] + volume[i, j]


@large_law
def _fill_column(samples: Any, hold: int, side: int, onset: float, work: Any) -> None:
    """Write the readings of one side of a hold for leaks since `onset` [s], less their mean, to `work.column` (k, l).

    A sample at t shows the volume V(t) - V(onset) that has left since the onset, 0 before it (`_integrate`). `side`: 0
    for A, 1 for B. See `HoldSamples.centre` for the mean.
    """
    volume, sums, column, before, mean = work.volume[side], work.sums[side], work.column, work.before, work.mean
    begin, n_leaks = samples.begin[hold], len(before)
    edge, last_edge = samples.first_edge[hold], samples.first_edge[hold + 1] - 1
    first, after = 0, samples.begin[hold + 1] - begin  # by bisection, the first sample that is not before the onset
    while first < after:
        middle = (first + after) // 2
        if samples.t[begin + middle] < onset:
            first = middle + 1
        else:
            after = middle
    for j in range(n_leaks):
        before[j] = mean[j] = 0.0
    if first > 0:  # V(onset)
        step = samples.t[begin + first] - samples.t[begin + first - 1]
        part = (onset - samples.t[begin + first - 1]) / step
        for j in range(n_leaks):
            before[j] = volume[first - 1, j] + (volume[first, j] - volume[first - 1, j]) * part
    skipped = 1 if samples.is_A_loaded[hold] == (side == 0) else 0  # the valves may still be shutting
    n_readings = last_edge - edge
    for k in range(n_readings):
        low, high = samples.edges[edge + k] - begin, samples.edges[edge + k + 1] - begin
        start = min(max(low, first), high)
        share, part = 1.0 / (high - low), (high - start) / (high - low)
        for j in range(n_leaks):
            column[k, j] = (sums[high, j] - sums[start, j]) * share - part * before[j]
        if k >= skipped:
            for j in range(n_leaks):
                mean[j] += column[k, j]
    for j in range(n_leaks):
        mean[j] /= n_readings - skipped
    for k in range(n_readings):
        for j in range(n_leaks):
            column[k, j] = column[k, j] - mean[j] if k >= skipped else 0.0


@large_law
def _add_products(
    samples: Any, hold: int, onset: float, are_paired: bool, regressors: Any, work: Any, products: Any
) -> None:
    """Add the products of l leaks' readings in one hold, of both sides, to `products` (9, l).

    They are those with the regressors (7), of the readings with themselves and, if the leaks `are_paired`, of the first
    leak's readings with the second's.
    """
    n_readings, n_leaks, column = (
        samples.first_edge[hold + 1] - samples.first_edge[hold] - 1,
        len(work.before),
        work.column,
    )
    for side in range(2):
        _fill_column(samples, hold, side, onset, work)
        row = 2 * (samples.first_edge[hold] - hold) + side * n_readings
        for k in range(n_readings):
            for i in range(N_REGRESSORS):
                regressor = regressors[row + k, i]
                for j in range(n_leaks):
                    products[i, j] += column[k, j] * regressor
            for j in range(n_leaks):
                products[N_REGRESSORS, j] += column[k, j] * column[k, j]
            if are_paired:
                products[N_REGRESSORS + 1, 0] += column[k, 0] * column[k, 1]


@large_law
def _copy_later(work: Any, onset: int) -> None:
    """Copy the products of later holds, `work.later`, to those of the onset with an index."""
    for i in range(N_REGRESSORS + 2):
        for j in range(len(work.before)):
            work.products[onset, i, j] = work.later[i, j]


@large_law
def _sum_hold(samples: Any, hold: int, k: int, are_paired: bool, onsets: Any, regressors: Any, work: Any) -> int:
    """Write the products for the onsets up to `k` that lie after the beginning of a hold to `work.products`.

    `work.flow` holds the flows in the hold, `work.later` the products of later holds, to which those of this hold are
    added. The holds are visited from the last one backwards. Returns the last of the sorted `onsets` that remains.
    """
    _integrate(samples, hold, work)
    begin, last = samples.t[samples.begin[hold]], samples.t[samples.begin[hold + 1] - 1]
    while k >= 0 and onsets[k] > begin:
        _copy_later(work, k)
        if onsets[k] <= last:
            _add_products(samples, hold, onsets[k], are_paired, regressors, work, work.products[k])
        k -= 1
    _add_products(samples, hold, begin, are_paired, regressors, work, work.later)
    return k


@large_law
def _fill_basis(changes: Any, is_fixed: Any, first: int, basis: Any) -> None:
    """Write the oil's part of a fit as combinations of the regressors (7) to five columns of `basis` from `first` on.

    These are the derivatives of the compressed volumes by the `changes` (4,) of the properties of the oil
    (`OilRegression`), and the volume that is lost with these changes. The derivative by a property whose `is_fixed`
    (4,) is not 0 is 0.
    """
    oil, air, left = math.exp(changes[0]), math.exp(changes[3]), first + N_OIL
    for i in range(N_REGRESSORS):
        for j in range(N_OIL + 1):
            basis[i, first + j] = 0.0
    basis[0, left] = 1.0
    for i in range(3):  # volumes of the stroke, which is known, and dead volumes of A and of B
        volume = 1.0 + (changes[i] if i else 0.0)
        basis[1 + i, left], basis[4 + i, left] = -oil * volume, -air * volume
        if not is_fixed[0]:
            basis[1 + i, first] = oil * volume
        if i and not is_fixed[i]:
            basis[1 + i, first + i], basis[4 + i, first + i] = oil, air
        if not is_fixed[3]:
            basis[4 + i, first + 3] = air * volume


@large_law
def _transform(products: Any, basis: Any, gram: Any) -> None:
    """Write the products of m combinations of n columns to `gram` (m, m), from the columns' `products` (n, n).

    `basis` (n, m): the combinations. Of the symmetric result both halves are written.
    """
    n, m = basis.shape
    for a in range(m):
        for b in range(a + 1):
            value = 0.0
            for i in range(n):
                for j in range(n):
                    value += basis[i, a] * products[i, j] * basis[j, b]
            gram[a, b] = gram[b, a] = value


@large_law
def _factorise(matrix: Any, factor: Any) -> None:
    """Write the Cholesky factor of a matrix (n, n) with a unit diagonal to `factor`; a pivot is at least a rounding."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(max(value, _MIN_PIVOT)) if i == j else value / factor[j, j]


@large_law
def _solve(factor: Any, values: Any) -> None:
    """Solve a system of equations by its Cholesky `factor` (n, n), in place of the right side `values` (n,)."""
    n = len(values)
    for i in range(n):
        for k in range(i):
            values[i] -= factor[i, k] * values[k]
        values[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            values[i] -= factor[k, i] * values[k]
        values[i] /= factor[i, i]


@large_law
def _residual_squares(priors: Any, variance: float, work: Any) -> None:
    """Write the residual sum of squares of the fit of a leak since each of o onsets to `work.squares` (o,).

    `work.with_column` holds the products of the leak's readings with the combinations `work.basis` (`_fill_basis`),
    `work.column_squares` those with themselves; `variance`: variance of a reading, which weights the priors. The least
    squares within the limits of the properties are the smallest of 16 cases: some properties are at their limits, and
    the others are free and within them. If the squares do not fall either where a property leaves its limit, no other
    case has less, as the squares are convex. The case that ends the search at the most onsets is the first of the next
    fit.
    """
    basis, gram, masked, factor, squares = work.basis, work.gram, work.masked, work.factor, work.squares
    scale, limits, remainder = work.scale, work.limits, work.remainder
    without_leak, per_leak, with_column, energies = work.without_leak, work.per_leak, work.with_column, work.energies
    inverse, slope_without, unsolved = work.inverse, work.slope_without, work.unsolved
    _transform(priors.products, basis, gram)  # its last column is the lost volume
    for a in range(N_OIL):
        gram[a, a] += variance * priors.precisions[a]
        scale[a] = math.sqrt(gram[a, a])
    n_left = len(squares)  # number of onsets with other cases to try, the first of `unsolved`
    for o in range(n_left):
        squares[o], unsolved[o] = np.inf, o
    largest = 0.0  # the largest energy so far
    for k in range(len(_FREE)):
        if n_left == 0:
            break
        case, n_before = work.cases[k], n_left
        total = gram[N_OIL, N_OIL]
        for a in range(N_OIL):
            limits[a] = 0.0 if _FREE[case, a] else priors.lowest[a]
        for a in range(N_OIL):
            remainder[a] = gram[a, N_OIL]  # products with the lost volume beyond the limits' contribution
            for b in range(N_OIL):
                remainder[a] -= limits[b] * gram[b, a]
                masked[a, b] = 1.0 if a == b else 0.0
                if a != b and _FREE[case, a] and _FREE[case, b]:
                    masked[a, b] = gram[a, b] / (scale[a] * scale[b])
                inverse[a, b] = 1.0 if a == b and _FREE[case, a] else 0.0
        _factorise(masked, factor)
        for a in range(N_OIL):
            _solve(factor, inverse[a])  # 0 for properties at their limits
            for b in range(N_OIL):
                inverse[a, b] /= scale[a] * scale[b]
        for a in range(N_OIL):
            without_leak[a] = 0.0  # changes of the free properties without a leak
            for b in range(N_OIL):
                without_leak[a] += inverse[a, b] * remainder[b]
        for a in range(N_OIL):
            total -= limits[a] * (gram[a, N_OIL] + remainder[a]) + remainder[a] * without_leak[a]
            # half the derivative of the squares by a property at its limit, without a leak
            slope_without[a] = -remainder[a]
            for b in range(N_OIL):
                slope_without[a] += gram[a, b] * without_leak[b]
        for k_left in range(n_left):
            o = unsolved[k_left]
            energy = work.column_squares[o]
            for a in range(N_OIL):
                change = 0.0  # decrease of this change for a leak with a coefficient of 1
                for b in range(N_OIL):
                    change += inverse[a, b] * with_column[o, b]
                per_leak[o, a] = change
                energy -= with_column[o, a] * change
            energies[o] = energy
            largest = max(largest, energy)
        n_left = 0
        for k_left in range(n_before):
            o = unsolved[k_left]
            moment = with_column[o, N_OIL]
            for a in range(N_OIL):
                moment -= limits[a] * with_column[o, a] + remainder[a] * per_leak[o, a]
            moment = max(moment, 0.0)  # the coefficient of a leak is not negative
            # a leak that no reading shows, such as one after the last hold, has the coefficient 0
            leak = moment / energies[o] if energies[o] > _MIN_ENERGY * max(largest, _TINY) else 0.0
            is_within, is_least = True, True
            for a in range(N_OIL):
                if _FREE[case, a]:
                    is_within = (
                        is_within and without_leak[a] - leak * per_leak[o, a] >= (1.0 + ROUNDING) * priors.lowest[a]
                    )
                else:  # half the derivative of the squares by this property, at its limit
                    slope = with_column[o, a]
                    for b in range(N_OIL):
                        slope -= gram[a, b] * per_leak[o, b]
                    is_least = is_least and slope_without[a] + leak * slope >= 0.0
            if is_within:
                squares[o] = min(squares[o], max(total - leak * moment, 0.0))
            if not (is_within and is_least):
                unsolved[n_left] = o
                n_left += 1
        n_solved = n_before - n_left
        rank = k  # among the cases tried so far, by the number of onsets
        while rank > 0 and work.n_solved[rank - 1] < n_solved:
            work.cases[rank], work.n_solved[rank] = work.cases[rank - 1], work.n_solved[rank - 1]
            rank -= 1
        work.cases[rank], work.n_solved[rank] = case, n_solved


@kernel
def _score(priors: Any, sums: Any, work: Any, log_likelihoods: Any) -> None:
    """Write the log likelihoods (l, o) of `score_onsets`.

    The variance of the readings weights the priors: first that without a leak, then that of the most probable onset.
    """
    for leak in range(len(log_likelihoods)):
        for a in range(N_OIL):
            work.limits[a] = 0.0  # no changes, and no fixed properties
        _fill_basis(work.limits, work.limits, 0, work.basis)
        for o in range(len(sums)):
            work.column_squares[o] = sums[o, N_REGRESSORS, leak]
            for a in range(N_OIL + 1):
                value = 0.0
                for i in range(N_REGRESSORS):
                    value += sums[o, i, leak] * work.basis[i, a]
                work.with_column[o, a] = value
        variance = priors.variance
        for _ in range(2):
            _residual_squares(priors, variance, work)
            least = np.inf
            for o in range(len(sums)):
                work.squares[o] += priors.misfit_variance * priors.n_rows
                least = min(least, work.squares[o])
            variance = least / priors.n_rows
        for o in range(len(sums)):
            log_likelihoods[leak, o] = -0.5 * priors.n_readings * math.log(work.squares[o])


def score_onsets(priors: OnsetPriors, sums: Array) -> Array:
    """Compute the log likelihood of l leaks since each of o onsets, (l, o), up to a constant, from `sums` (o, 8, l).

    It is -N/2 log(residual sum of squares).
    """
    log_likelihoods = np.empty((sums.shape[2], len(sums)))
    _score(priors, np.ascontiguousarray(sums), Workspace.with_onsets(len(sums)), log_likelihoods)
    return log_likelihoods


@kernel
def _sum_products(samples: Any, flows: Any, end: float, onsets: Any, regressors: Any, work: Any) -> None:
    """Write the products of the leaks with the flows u, in `flows` (2, N), and (`end` - t) u to `work.products`."""
    k = len(onsets) - 1
    for hold in range(len(samples.begin) - 2, -1, -1):
        for i in range(samples.begin[hold], samples.begin[hold + 1]):
            for side in range(2):
                work.flow[side, i - samples.begin[hold], 0] = flows[side, i]
                work.flow[side, i - samples.begin[hold], 1] = flows[side, i] * (end - samples.t[i])
        k = _sum_hold(samples, hold, k, True, onsets, regressors, work)
    for o in range(k + 1):
        _copy_later(work, o)


def sum_onset_products(
    samples: HoldSamples, flows: Array, growths: Array, end: float, onsets: Array, regressors: Array
) -> Array:
    """Compute products of a leak's readings, for each of o onsets and l growths, (o, 8, l).

    They are those with the regressors (7) and with themselves. `flows` (2, N): flows out of A and B for a coefficient
    of 1; `growths` (l,): relative growths of the leak from its onset to the `end` of the recording [s]; `onsets` (o,):
    sorted [s]; `regressors` (r, 7): of the rows of `build_regression`.
    """
    work = SumWorkspace.with_sizes(int(samples.sizes.max()), len(onsets), 2)
    _sum_products(samples, flows, end, onsets, regressors, work)
    without, rate = 1.0 + growths, -growths / np.maximum(end - onsets, _TINY)[:, None]
    products, n = work.products[..., :1], N_REGRESSORS
    late_products, both = work.products[..., 1], work.products[:, n + 1, :1]
    sums = without * products[:, : n + 1]
    sums[:, :n] += rate[:, None] * late_products[:, :n, None]
    sums[:, n] = without**2 * products[:, n] + rate * (2.0 * without * both + rate * late_products[:, n, None])
    np.maximum(sums[:, n], 0.0, out=sums[:, n])
    return np.asarray(sums)


@kernel
def _sum_offsets(
    samples: Any,
    offsets: Any,
    is_equalised: Any,
    exponent: float,
    resolved: float,
    is_closed: Any,
    onsets: Any,
    regressors: Any,
    work: Any,
) -> None:
    """Write the products of `iter_offset_sums` for l offsets to `work.products`."""
    k = len(onsets) - 1
    n_leaks = len(work.before)
    for hold in range(len(samples.begin) - 2, -1, -1):
        for i in range(samples.begin[hold], samples.begin[hold + 1]):
            flow, opposite = work.flow[0, i - samples.begin[hold]], work.flow[1, i - samples.begin[hold]]
            for j in range(n_leaks):
                difference = samples.difference[i] - offsets[hold, j]
                if is_equalised[hold, j]:
                    difference *= small_difference_factor(difference, resolved)
                # a power costs more than all other steps of a sample
                magnitude = abs(difference)
                if exponent == 0.5:
                    magnitude = math.sqrt(magnitude)
                elif exponent == 0.75:
                    magnitude = math.sqrt(magnitude) * math.sqrt(math.sqrt(magnitude))
                elif exponent != 1.0:
                    magnitude = magnitude**exponent
                flow[j] = math.copysign(magnitude, difference)
            for j in range(n_leaks):
                opposite[j] = -flow[j] if is_closed[1, i] else 0.0
                flow[j] = flow[j] if is_closed[0, i] else 0.0
        k = _sum_hold(samples, hold, k, False, onsets, regressors, work)
    for o in range(k + 1):
        _copy_later(work, o)


def iter_offset_sums(
    samples: HoldSamples,
    offsets: Array,
    is_equalised: NDArray[np.bool_],
    exponent: float,
    resolved: float,
    is_closed: NDArray[np.bool_],
    onsets: Array,
    regressors: Array,
) -> Iterator[Array]:
    """Yield products of a leak past the piston for g sensor offsets and o onsets, (o, 8, l), l of the offsets a time.

    `offsets`, `is_equalised` (g, H): the sensor offset of each hold [Pa], and true if a leak has equalised its
    pressures (`estimate_hold_offsets`); `exponent`: of the leak's law; `resolved`: as for
    `small_difference_factor`; `is_closed` (2, N): true while A, B are closed; `onsets`, `regressors`: as for
    `sum_onset_products`. The law of the flow is that of `HeldChambers._unit_piston_leak`.
    """
    work: SumWorkspace | None = None
    for first in range(0, len(offsets), _MOST_LEAKS):
        rows = np.arange(first, min(first + _MOST_LEAKS, len(offsets)))
        leaks = np.append(rows, np.full(-len(rows) % _WIDTH, rows[-1]))  # the last offset is repeated
        if work is None or len(work.before) != len(leaks):
            work = SumWorkspace.with_sizes(int(samples.sizes.max()), len(onsets), len(leaks))
        work.later[:] = 0.0
        hold_offsets, are_equalised = (np.ascontiguousarray(table[leaks].T) for table in (offsets, is_equalised))
        _sum_offsets(samples, hold_offsets, are_equalised, exponent, resolved, is_closed, onsets, regressors, work)
        yield work.products[:, : N_REGRESSORS + 1, : len(rows)].copy()


class FitWorkspace(NamedTuple):
    """Scratch arrays of `fit_oil` for c leaks: n = c + 4 unknowns.

    `basis` (7 + c, n + 1), `gram` (n + 1, n + 1): columns of the fit, and the lost volumes, as combinations of the
    regressors, and their products; `matrix`, `factor`, `inverse` (n, n); `scale`, `solution`, `moments` (n,);
    `changes`, `is_lowest` (4,): changes of the properties of the oil, and flags of those that stay at their limits.
    """

    basis: Any
    gram: Any
    matrix: Any
    factor: Any
    inverse: Any
    scale: Any
    solution: Any
    moments: Any
    changes: Any
    is_lowest: Any

    @classmethod
    def with_leaks(cls, n_leaks: int) -> FitWorkspace:
        """Allocate the arrays for a number of leaks."""
        n = n_leaks + N_OIL
        shapes: list[tuple[int, ...]] = [(N_REGRESSORS + n_leaks, n + 1), (n + 1, n + 1)]
        shapes += [(n, n)] * 3 + [(n,)] * 3 + [(N_OIL,)]
        return cls._make([*(np.empty(shape) for shape in shapes), np.empty(N_OIL, dtype=bool)])


@kernel
def fit_oil(
    products: Array,
    precisions: Array,
    lowest: Array,
    misfit_variance: float,
    n_rows: float,
    n_readings: float,
    max_iterations: int,
    max_step: float,
    tolerance: float,
    ridge: float,
    work: FitWorkspace,
) -> float:
    """Fit c leaks together with the properties of the oil (`fit_leak`), from products of the readings.

    `products` (7 + c, 7 + c): of the regressors and the leaks' columns; `precisions` (4,): inflated prior precisions of
    the properties; `lowest` (4,): lower limits of these; the other arguments: as in `fit_leak`. Returns the
    variance of a reading; `work.solution` and `work.inverse` receive the coefficients (c,), then the last corrections
    of the properties, and the inverse (c + 4, c + 4) of the weighted normal matrix.
    """
    n_leaks = len(products) - N_REGRESSORS
    size, degrees_of_freedom = n_leaks + N_OIL, max(n_readings - n_leaks, 1.0)
    basis, gram, matrix, factor, inverse = work.basis, work.gram, work.matrix, work.factor, work.inverse
    scale, solution, moments, changes, is_lowest = work.scale, work.solution, work.moments, work.changes, work.is_lowest
    for i in range(N_OIL):
        changes[i], is_lowest[i] = 0.0, False
    for i in range(len(products)):
        for j in range(size + 1):
            basis[i, j] = 1.0 if i >= N_REGRESSORS and i - N_REGRESSORS == j else 0.0
    variance = 0.0
    for iteration in range(max_iterations):
        _fill_basis(changes, is_lowest, n_leaks, basis)
        _transform(products, basis, gram)
        square = gram[size, size]
        if not iteration:
            variance = max(square / n_rows, misfit_variance)
        for i in range(size):
            scale[i] = math.sqrt(gram[i, i]) if gram[i, i] > 0.0 else 1.0
        for i in range(size):
            for j in range(size):
                matrix[i, j] = gram[i, j] / (scale[i] * scale[j])
            moments[i] = gram[i, size]
            if i >= n_leaks:
                weight = variance * precisions[i - n_leaks]
                matrix[i, i] += weight / scale[i] ** 2
                # the prior mean of a change is 0, so that of a correction is minus the change
                moments[i] -= 0.0 if is_lowest[i - n_leaks] else weight * changes[i - n_leaks]
            matrix[i, i] += ridge
        _factorise(matrix, factor)
        for j in range(size):
            for i in range(size):
                inverse[j, i] = 1.0 if i == j else 0.0
            _solve(factor, inverse[j])
        for i in range(size):
            solution[i] = 0.0
            for j in range(size):
                inverse[i, j] /= scale[i] * scale[j]
                solution[i] += inverse[i, j] * moments[j]
        for i in range(size):
            square -= 2.0 * solution[i] * gram[i, size]
            for j in range(size):
                square += solution[i] * gram[i, j] * solution[j]
        square, largest, has_settled = max(square, 0.0), 0.0, True
        for i in range(N_OIL):
            square += variance * precisions[i] * (changes[i] + solution[n_leaks + i]) ** 2
        previous = variance
        variance = square / n_rows * n_readings / degrees_of_freedom + misfit_variance
        for i in range(N_OIL):
            step = min(max(solution[n_leaks + i], -max_step), max_step)
            largest = max(largest, abs(step))
            if changes[i] + step < lowest[i] and not is_lowest[i]:
                is_lowest[i], has_settled = True, False
            changes[i] = max(changes[i] + step, lowest[i])
        if has_settled and abs(variance - previous) <= tolerance * previous and largest <= tolerance:
            break
    return float(variance)
