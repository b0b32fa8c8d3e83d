"""Compiled sums over the readings of all holds, from which a leak since any of many onsets is fitted.

A leak that begins at s has lost nothing before, and in the holds after it as much as one from their beginning: only in
the hold about s does its column of readings (`HeldChambers`) depend on s. The products of the columns of all onsets
with the regressors are therefore sums over the later holds, which are accumulated from the last hold backwards, and
the products within one hold. Time and memory are proportional to the number of samples.

With the relative growth g from s to the end e of the recording, the flow u of a leak becomes

    (1 + g (t - s)/(e - s)) u = (1 + g) u - g/(e - s) (e - t) u,

so that the products follow from those of the flows u and (e - t) u.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
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


class Workspace(NamedTuple):
    """Scratch arrays for N samples and o onsets, since compiled laws allocate no memory.

    - `flows` (4, N): flow out of A and out of B of a leak with a coefficient of 1, and both times the time to the end.
    - `integrals` (8, N + 1): volumes of these flows since the beginning of a hold, and the sums of these volumes.
    - `columns` (2, N): readings of one side; `later`, `here` (2, 9): products (`_add_products`).
    - `sums` (o, 8), `squares` (o,): results for each onset; `per_leak` (o, 4), `with_column` (o, 5), `energies` (o,).
    - `basis` (7, 5), `gram` (5, 5), `masked`, `factor`, `inverse` (4, 4), `scale`, `limits`, `remainder`,
      `without_leak`, `slope_without` (4,): parts of a fit; `unsolved` (o,): onsets whose least squares are not found;
      `cases`, `n_solved` (16,): cases of properties at their limits, in the order in which they are tried, and the
      number of onsets whose least squares each has found.
    """

    flows: Any
    integrals: Any
    columns: Any
    later: Any
    here: Any
    sums: Any
    squares: Any
    per_leak: Any
    with_column: Any
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
    def with_sizes(cls, n_samples: int, n_onsets: int) -> Workspace:
        """Allocate the arrays."""
        n, k = N_OIL, N_OIL + 1
        shapes: list[tuple[int, ...]] = [(4, n_samples), (8, n_samples + 1), (2, n_samples)]
        shapes += [(2, N_REGRESSORS + 2)] * 2 + [(n_onsets, N_REGRESSORS + 1), (n_onsets,), (n_onsets, n)]
        shapes += [(n_onsets, k), (n_onsets,), (N_REGRESSORS, k), (k, k), *[(n, n)] * 3, *[(n,)] * 5]
        cases, n_solved = np.arange(len(_FREE)), np.zeros(len(_FREE), dtype=np.intp)
        return cls._make([*map(np.empty, shapes), np.empty(n_onsets, dtype=np.intp), cases, n_solved])


@large_law
def _integrate(samples: Any, hold: int, flow: Any, volume: Any, sums: Any) -> None:
    """Write the volume that a `flow` (N,) has lost since the beginning of a hold to `volume` (N,), and its sums.

    `sums` (N + 1,): sum of the volumes of the hold's samples before each.
    """
    begin, end = samples.begin[hold], samples.begin[hold + 1]
    volume[begin] = sums[begin] = sums[begin + 1] = 0.0
    for i in range(begin + 1, end):
        volume[i] = volume[i - 1] + 0.5 * (flow[i] + flow[i - 1]) * (samples.t[i] - samples.t[i - 1])
        sums[i + 1] = sums[i] + volume[i]


@large_law
def _fill_column(samples: Any, hold: int, volume: Any, sums: Any, onset: float, is_A: bool, column: Any) -> None:
    """Write the readings of one side of a hold for a leak since `onset` [s], less their mean, to `column` (k,).

    `volume`, `sums`: as by `_integrate`. A sample at t shows the volume V(t) - V(onset) that has left since the onset,
    0 before it. See `HoldSamples.centre` for the mean.
    """
    begin, end = samples.begin[hold], samples.begin[hold + 1]
    edge, last_edge = samples.first_edge[hold], samples.first_edge[hold + 1] - 1
    first, after = begin, end  # by bisection, the first sample that is not before the onset
    while first < after:
        middle = (first + after) // 2
        if samples.t[middle] < onset:
            first = middle + 1
        else:
            after = middle
    before = 0.0  # V(onset)
    if first > begin:
        step = samples.t[first] - samples.t[first - 1]
        part = (onset - samples.t[first - 1]) / step
        before = volume[first - 1] + (volume[first] - volume[first - 1]) * part
    mean, n_counted = 0.0, 0
    skipped = 1 if samples.is_A_loaded[hold] == is_A else 0  # the valves may still be shutting
    for k in range(last_edge - edge):
        low, high = samples.edges[edge + k], samples.edges[edge + k + 1]
        start = min(max(low, first), high)
        column[k] = (sums[high] - sums[start] - (high - start) * before) / (high - low)
        if k >= skipped:
            mean += column[k]
            n_counted += 1
    mean /= n_counted
    for k in range(last_edge - edge):
        column[k] = column[k] - mean if k >= skipped else 0.0


@large_law
def _add_products(
    samples: Any,
    hold: int,
    integrals: Any,
    onset: float,
    is_growing: bool,
    regressors: Any,
    columns: Any,
    products: Any,
) -> None:
    """Add the products of a leak's readings in one hold, of both sides, to `products` (2, 9).

    `integrals` (8, N + 1): volumes and sums of the flow out of A, out of B, and both times the time to the end of the
    recording (`_integrate`). `products` are those of each of these two leaks with the regressors (7), with the first
    leak and with the second. `columns` (2, N): work array.
    """
    n_readings = samples.first_edge[hold + 1] - samples.first_edge[hold] - 1
    n_flows = 2 if is_growing else 1
    for side in range(2):
        row = 2 * (samples.first_edge[hold] - hold) + side * n_readings
        for j in range(n_flows):
            flow = 2 * (2 * j + side)
            _fill_column(samples, hold, integrals[flow], integrals[flow + 1], onset, side == 0, columns[j])
        for j in range(n_flows):
            for i in range(N_REGRESSORS):
                product = 0.0
                for k in range(n_readings):
                    product += columns[j, k] * regressors[row + k, i]
                products[j, i] += product
            for i in range(n_flows):
                product = 0.0
                for k in range(n_readings):
                    product += columns[j, k] * columns[i, k]
                products[j, N_REGRESSORS + i] += product


@large_law
def _combine_products(products: Any, growth: float, time_left: float, combined: Any) -> None:
    """Write the products of a growing leak's column with the regressors and with itself to `combined` (8,)."""
    without, rate = 1.0 + growth, -growth / max(time_left, _TINY)
    for i in range(N_REGRESSORS):
        combined[i] = without * products[0, i] + (rate * products[1, i] if growth else 0.0)
    n, squares = N_REGRESSORS, without**2 * products[0, N_REGRESSORS]
    if growth:
        squares += rate * (2.0 * without * products[0, n + 1] + rate * products[1, n + 1])
    combined[n] = max(squares, 0.0)


@large_law
def _sum_over_onsets(samples: Any, growth: float, end: float, onsets: Any, regressors: Any, work: Any) -> None:
    """Write the products of a leak's column, for each of the sorted `onsets` (o,), to `work.sums` (o, 8).

    They are those with the regressors (7) and the column's sum of squares. `work.flows` holds the flows, those times
    the time to the `end` of the recording only if the leak grows. `_add_products` computes the products of one hold;
    those of later holds are accumulated.
    """
    is_growing = growth != 0.0
    for j in range(2):
        for i in range(N_REGRESSORS + 2):
            work.later[j, i] = 0.0
    k = len(onsets) - 1
    for hold in range(len(samples.begin) - 2, -1, -1):
        for flow in range(4 if is_growing else 2):
            _integrate(samples, hold, work.flows[flow], work.integrals[2 * flow], work.integrals[2 * flow + 1])
        begin, last = samples.t[samples.begin[hold]], samples.t[samples.begin[hold + 1] - 1]
        while k >= 0 and onsets[k] > begin:
            for j in range(2):
                for i in range(N_REGRESSORS + 2):
                    work.here[j, i] = work.later[j, i]
            if onsets[k] <= last:
                _add_products(samples, hold, work.integrals, onsets[k], is_growing, regressors, work.columns, work.here)
            _combine_products(work.here, growth, end - onsets[k], work.sums[k])
            k -= 1
        _add_products(samples, hold, work.integrals, begin, is_growing, regressors, work.columns, work.later)
    while k >= 0:
        _combine_products(work.later, growth, end - onsets[k], work.sums[k])
        k -= 1


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
def _residual_squares(priors: Any, sums: Any, variance: float, work: Any) -> None:
    """Write the residual sum of squares of the fit of a leak since each of o onsets to `work.squares` (o,).

    `sums` (o, 8): products by `_sum_over_onsets`, of which `work.with_column` holds those with the combinations
    `work.basis` (`_fill_basis`); `variance`: variance of a reading, which weights the priors. The least squares within
    the limits of the properties are the smallest of 16 cases: some properties are at their limits, and the others are
    free and within them. If the squares do not fall either where a property leaves its limit, no other case has less,
    as the squares are convex. The case that ends the search at the most onsets is the first of the next fit.
    """
    basis, gram, masked, factor, squares = work.basis, work.gram, work.masked, work.factor, work.squares
    scale, limits, remainder = work.scale, work.limits, work.remainder
    without_leak, per_leak, with_column, energies = work.without_leak, work.per_leak, work.with_column, work.energies
    inverse, slope_without, unsolved = work.inverse, work.slope_without, work.unsolved
    _transform(priors.products, basis, gram)  # its last column is the lost volume
    for a in range(N_OIL):
        gram[a, a] += variance * priors.precisions[a]
        scale[a] = math.sqrt(gram[a, a])
    n_left = len(sums)  # number of onsets with other cases to try, the first of `unsolved`
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
            energy = sums[o, N_REGRESSORS]
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


@large_law
def _score(priors: Any, sums: Any, work: Any, log_likelihoods: Any) -> None:
    """Write the log likelihood of a leak at each onset, -N/2 log(residual sum of squares), to `log_likelihoods` (o,).

    The variance of the readings weights the priors: first that without a leak, then that of the most probable onset.
    """
    for a in range(N_OIL):
        work.limits[a] = 0.0  # no changes, and no fixed properties
    _fill_basis(work.limits, work.limits, 0, work.basis)
    for o in range(len(sums)):
        for a in range(N_OIL + 1):
            value = 0.0
            for i in range(N_REGRESSORS):
                value += sums[o, i] * work.basis[i, a]
            work.with_column[o, a] = value
    variance = priors.variance
    for _ in range(2):
        _residual_squares(priors, sums, variance, work)
        least = np.inf
        for o in range(len(sums)):
            work.squares[o] += priors.misfit_variance * priors.n_rows
            least = min(least, work.squares[o])
        variance = least / priors.n_rows
    for o in range(len(sums)):
        log_likelihoods[o] = -0.5 * priors.n_readings * math.log(work.squares[o])


@kernel
def _sum_products(samples: Any, flows: Any, growth: float, end: float, onsets: Any, regressors: Any, work: Any) -> None:
    """Write the products of a leak with `flows` (2, N) for each onset to `work.sums` (`sum_onset_products`)."""
    for side in range(2):
        for i in range(len(samples.t)):
            work.flows[side, i] = flows[side, i]
            work.flows[2 + side, i] = flows[side, i] * (end - samples.t[i])
    _sum_over_onsets(samples, growth, end, onsets, regressors, work)


def sum_onset_products(
    samples: HoldSamples, flows: Array, growth: float, end: float, onsets: Array, regressors: Array
) -> Array:
    """Compute the products of a leak's readings with the regressors (7) and with themselves, for each onset, (o, 8).

    `flows` (2, N): flows out of A and B for a coefficient of 1; `growth`: relative growth of the leak from its onset to
    the `end` of the recording [s]; `onsets` (o,): sorted [s]; `regressors` (r, 7): of the rows of `build_regression`.
    """
    work = Workspace.with_sizes(len(samples.t), len(onsets))
    _sum_products(samples, flows, growth, end, onsets, regressors, work)
    return np.asarray(work.sums)


@kernel
def _score_offsets(
    priors: Any,
    samples: Any,
    offsets: Any,
    is_equalised: Any,
    exponent: float,
    resolved: float,
    is_closed: Any,
    onsets: Any,
    regressors: Any,
    work: Any,
    log_likelihoods: Any,
) -> None:
    """Write the log likelihoods (g, o) of `score_offsets`."""
    for g in range(len(offsets)):
        for hold in range(len(samples.begin) - 1):
            for i in range(samples.begin[hold], samples.begin[hold + 1]):
                difference = samples.difference[i] - offsets[g, hold]
                if is_equalised[g, hold]:
                    difference *= small_difference_factor(difference, resolved)
                # a power costs more than all other steps of a sample
                magnitude = abs(difference)
                flow = magnitude
                if exponent != 1.0:
                    flow = math.sqrt(magnitude) if exponent == 0.5 else magnitude**exponent
                flow = math.copysign(flow, difference)
                work.flows[0, i] = flow if is_closed[0, i] else 0.0
                work.flows[1, i] = -flow if is_closed[1, i] else 0.0
        _sum_over_onsets(samples, 0.0, 0.0, onsets, regressors, work)
        _score(priors, work.sums, work, log_likelihoods[g])


def score_offsets(
    priors: OnsetPriors,
    samples: HoldSamples,
    offsets: Array,
    is_equalised: NDArray[np.bool_],
    exponent: float,
    resolved: float,
    is_closed: NDArray[np.bool_],
    onsets: Array,
    regressors: Array,
) -> Array:
    """Compute the log likelihood of a leak past the piston for each of g sensor offsets and o onsets, (g, o).

    `offsets`, `is_equalised` (g, H): the sensor offset of each hold [Pa], and true if a leak has equalised its
    pressures (`estimate_hold_offsets`); `exponent`: of the leak's law; `resolved`: as for
    `small_difference_factor`; `is_closed` (2, N): true while A, B are closed; `onsets`, `regressors`: as for
    `sum_onset_products`. The law of the flow is that of `HeldChambers._unit_piston_leak`.
    """
    log_likelihoods = np.empty((len(offsets), len(onsets)))
    _score_offsets(
        priors, samples, offsets, is_equalised, exponent, resolved, is_closed, onsets, regressors,
        Workspace.with_sizes(len(samples.t), len(onsets)), log_likelihoods,
    )  # fmt: skip
    return log_likelihoods


@kernel
def _score_sums(priors: Any, sums: Any, work: Any, log_likelihoods: Any) -> None:
    """Write the log likelihoods (o,) of `score_onsets`."""
    _score(priors, sums, work, log_likelihoods)


def score_onsets(priors: OnsetPriors, sums: Array) -> Array:
    """Compute the log likelihood of a leak since each of o onsets, (o,), up to a constant, from its `sums` (o, 8)."""
    log_likelihoods = np.empty(len(sums))
    _score_sums(priors, sums, Workspace.with_sizes(0, len(sums)), log_likelihoods)
    return log_likelihoods


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
