"""Likelihood of a volume balance's coefficients in blocks of a recording, from sums over the rows of each block.

A volume balance (`terms`) is linear: its left side is a sum of terms, each a coefficient times a column of data. A
block is a few seconds of a recording. It stores the Gram matrix of its rows over all columns (terms and left side). A
row is the balance integrated with one test function of the weak form (`rows.weak_form`). The Gram matrix of several
blocks together is the sum of their Gram matrices. A stream and a whole recording are therefore handled alike, and a
recording of hours costs no more than one of minutes. Rows are weighted once, when their block is closed
(`row_weights`).

All samples of the balance's channels count, also those that bridge a short gap. A row with a clipped sample does not
count, and one beside a long gap by its share outside of the gap (`balance.BlockStream`). A step is sought from the
first motion on (`RecordedBalance.running_blocks`).

To estimate one coefficient g in each block, all other coefficients are eliminated (`information`). Each of them has a
level and a slow drift, c_j(t) = sum_p c_jp P_p(t) with polynomials P_p, and a normal prior on its size (`priors.toml`).
Let d be the column of g (the tested column), o the other columns with their drifts, y the left side and s^2 the
residual variance of a row. N_k, n_k and B_k are the sums of d^2, d y and d o' over the rows of block k; M is the sum of
o o' over all rows, plus the precision of the priors, and m the sum of o y. The likelihood is exp(eta'g - g'Lambda g/2)
with

    Lambda = (diag N - B M^-1 B') / s^2,    eta = (n - B M^-1 m) / s^2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.rows.row_weights import (
    MAX_ITERATIONS,
    RIDGE,
    SUPPORT,
    TOLERANCE,
    block_gram_matrices,
)
from sealscope.diagnosis.inference.rows.weak_form import OVERLAP
from sealscope.diagnosis.inference.terms import BIAS, HOLDING, LEAK, MOVING_BIAS, TURNING, Equation
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import plain_array, require_part, restore_array

#: Maximum number of blocks of a fit; if there are more, neighbouring blocks are added up.
MAX_BLOCKS = 240
#: Degree of the Legendre polynomials of the drifts.
DRIFT_DEGREE = 2
#: Kinds of coefficients (`Term.drift`) that are free in each block while its rows are weighted.
UNSTEADY = ("leak", "pump", "bias", "outside")
#: Maximum number of Gauss-Newton steps to the offset of p_A - p_B.
_MAX_OFFSET_STEPS = 3


@dataclass(frozen=True, eq=False)
class Blocks:
    """Consecutive blocks of a recording, each a few seconds long and reduced to a regression's Gram matrices.

    Parameters
    ----------
    start, end : array of float, shape (K,)
        Times of the first and the last row of each block [s].
    gram : array of float, shape (K, E, m, m)
        Gram matrices of each block for each of E equations: weighted sums, over the rows, of the products of the m
        columns with each other. The left side is the last column.
    rows : array of float, shape (K,)
        Number of the regression's rows (one for each test function of the weak form) without missing samples; a row
        next to a hole counts as a fraction of one.
    flow : array of float, shape (K,)
        Mean magnitude of the first equation's left side, as a flow [m^3/s].
    pressures : array of float, shape (K, p)
        Means of p equal parts of the sorted samples of p_A - p_B [Pa], as recorded (`sorted_part_means`).
    zero : array of float, shape (K,)
        Sensor offset [Pa] that was subtracted from p_A - p_B in `gram` (`pressure_offset.remove_pressure_offset`).
    """

    start: Array
    end: Array
    gram: Array
    rows: Array
    flow: Array
    pressures: Array
    zero: Array

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, index: slice | NDArray[np.bool_]) -> Blocks:
        """Select blocks by a slice or a mask."""
        return Blocks(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def pack(self) -> Blocks:
        """Return the blocks for storage, with the upper triangles of their symmetric Gram matrices only.

        For K blocks, E equations and m columns, `gram` then has the shape (K, E, m (m + 1) / 2).
        """
        return replace(self, gram=self.gram[..., *np.triu_indices(self.gram.shape[-1])])

    def unpack(self, size: int) -> Blocks:
        """Return the blocks with full Gram matrices, from blocks in which `pack` has stored the upper triangles only.

        `size`: number of columns m of the full matrices (K, E, m, m). Raise InputError if the stored shapes do not fit
        this number, or if the arrays have different numbers of blocks.
        """
        upper, lower = np.triu_indices(size)
        lengths = {len(getattr(self, name)) for name in self.__dataclass_fields__}
        if self.gram.shape[2:] != upper.shape or lengths != {len(self.start)}:
            raise InputError(f"saved state's gram must have {len(upper)} sums a block, got {self.gram.shape}")
        gram = np.zeros((*self.gram.shape[:2], size, size))
        gram[..., upper, lower] = gram[..., lower, upper] = self.gram
        return replace(self, gram=gram)

    @property
    def time(self) -> Array:
        """Time in the middle of each block [s], shape (K,)."""
        return 0.5 * (self.start + self.end)

    @property
    def moving_flow(self) -> float:
        """Mean flow while the machine moves [m^3/s].

        It is sum(flow^2) / sum(flow) over the blocks, i.e. the mean of `flow` weighted by itself, so that standstills
        do not contribute.
        """
        return float(self.flow @ self.flow) / max(float(self.flow.sum()), np.finfo(float).tiny)

    @property
    def is_moving(self) -> NDArray[np.bool_]:
        """Flags (K,) of the blocks in which the machine moves.

        In these blocks the mean flow is at least the fraction `rest.moves` (`priors.toml`) of `moving_flow`. The flow
        of a pump that only holds a load is smaller.
        """
        return np.asarray(self.flow >= INFERENCE.rest.moves * self.moving_flow)

    def merge(self, max_blocks: int = MAX_BLOCKS) -> Blocks:
        """Return at most `max_blocks` blocks, each the sum or weighted mean of several neighbouring ones.

        Groups of equally many neighbours are merged; the last group may be smaller. Gram matrices and numbers of rows
        are added. Flow and pressures are averaged with the numbers of rows as weights. The first block of a group
        gives `zero`.
        """
        group_size = -(-len(self) // max_blocks)  # rounded up
        if group_size <= 1:
            return self
        first = np.arange(0, len(self), group_size)
        end = np.append(first[1:], len(self))
        rows = np.add.reduceat(self.rows, first)
        weights = self.rows / np.maximum(np.repeat(rows, end - first), 1.0)
        return Blocks(
            start=self.start[first],
            end=self.end[end - 1],
            gram=np.add.reduceat(self.gram, first, axis=0),
            rows=rows,
            flow=np.add.reduceat(self.flow * weights, first),
            pressures=np.add.reduceat(self.pressures * weights[:, None], first, axis=0),
            zero=self.zero[first],
        )

    def mean_pressure(self, offset: float | None = None) -> Array:
        """Compute the mean of abs(p_A - p_B - offset) [Pa] in each block, shape (K,).

        `offset` [Pa]: sensor offset of p_A - p_B, by default `zero`, which is already subtracted in `gram`. The mean
        flow of a laminar leak is its coefficient times this pressure.
        """
        subtracted = self.zero[:, None] if offset is None else offset
        return np.asarray(np.abs(self.pressures - subtracted).mean(axis=1))

    def mean_root(self) -> Array:
        """Compute the mean of sqrt(abs(p_A - p_B - zero)) [Pa^0.5] in each block, shape (K,).

        The mean flow of a leak through an orifice is its coefficient times this mean.
        """
        return np.asarray(np.sqrt(np.abs(self.pressures - self.zero[:, None])).mean(axis=1))

    def driving_pressure(self, names: Sequence[str], term: str) -> float:
        """Estimate the root mean square of the pressure that drives a term [Pa], such as p_B for a leak out of side B.

        `names`: names of the columns, in the order of `gram`. s_term^2 and s_leak^2 are the sums of squares of the
        columns of the term and of the leak, over the equations that contain the term, and rms is a root mean square:

            pressure = rms(p_A - p_B) s_term / s_leak.
        """
        squares = np.einsum("keii->ei", self.gram)  # (E, m): sum of squares of each column in each equation
        squares = squares[squares[:, names.index(term)] > 0.0].sum(axis=0)  # equations that contain the term
        ratio = squares[names.index(term)] / max(squares[names.index(LEAK)], np.finfo(float).tiny)
        mean_squares = ((self.pressures - self.zero[:, None]) ** 2).mean(axis=1)  # mean of (p_A - p_B)^2 in each block
        weights = np.maximum(self.rows, 1e-9)  # positive, so that the mean over the blocks exists
        return float(np.sqrt(np.average(mean_squares, weights=weights) * ratio))

    @classmethod
    def join(cls, parts: Sequence[Blocks]) -> Blocks:
        """Concatenate the blocks of consecutive `parts` of one recording."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


class ColumnRoles:
    """Indices of the columns of one equation's Gram matrices by role, and the priors on their coefficients.

    The m columns are the m - 1 terms of the volume balance and, last, its left side. Indices of columns:

    - `left`: left side; `leak`: laminar leak, or the term that is tested in its place; `bias`: flow offset, or None;
    - `nuisance`: terms whose coefficients are unknown in any machine;
    - `compared`: the nuisance terms, and those that are fitted only to compare recordings;
    - `motion`: motion of the piston, or flow of the valve's edges; `compliance`: the chambers' oil and its air;
    - `hold_leak`: leakage of a pump that holds the load (`terms.HOLDING`), which a comparison of recordings leaves out,
      or None;
    - `fast`, `slow`: terms whose coefficients are free in each block, or common to all, while rows are weighted.

    Prior standard deviations of the coefficients (m - 1,):

    - `drift_rate`: drift, relative to the coefficient [1/min];
    - `between_deviation`: relative difference between recordings, infinite without a prior, 0 for a flow offset that
      repeats in all recordings;
    - `level_deviation`: constant part of the coefficient, in the coefficient's unit, infinite without a prior.

    `names` and `drivers` (m - 1,): names and drivers of the terms (`Term`); `healthy_conductance` [m^3/(s Pa)]:
    standard deviation of a healthy machine's leak.
    """

    def __init__(self, equation: Equation) -> None:
        self.names = tuple(term.name for term in equation.terms)
        self.left = len(self.names)
        self.nuisance = tuple(k for k, term in enumerate(equation.terms) if term.nuisance)
        self.compared = tuple(k for k, term in enumerate(equation.terms) if term.nuisance or term.compared)
        # true for a balance that `terms.shut_at_rest` made
        is_shut = HOLDING in self.names and MOVING_BIAS not in self.names
        self.hold_leak = self.names.index(HOLDING) if is_shut else None
        self.leak = self.names.index(LEAK)
        drift_priors = vars(INFERENCE.drift)
        self.drift_rate = np.array([drift_priors[term.drift] if term.nuisance else 0.0 for term in equation.terms])
        between_priors = vars(INFERENCE.between)
        self.between_deviation = np.zeros(len(equation.terms))
        self.between_deviation[list(self.compared)] = [between_priors[equation.terms[k].drift] for k in self.compared]
        self.level_deviation = np.array(
            [INFERENCE.level.outside if term.drift == "outside" else np.inf for term in equation.terms]
        )
        self.motion = tuple(k for k in self.nuisance if equation.terms[k].drift in ("motion", "edge"))
        self.compliance = tuple(k for k in self.nuisance if equation.terms[k].drift in ("compliance", "air"))
        self.fast = tuple(k for k in self.nuisance if equation.terms[k].drift in UNSTEADY)
        # columns that are zero at rest; HOLDING is left out, since separate leakages of holds and other rests would
        # follow outliers
        in_motion = [self.names.index(name) for name in (TURNING, MOVING_BIAS)] if MOVING_BIAS in self.names else []
        self.slow = (*(k for k in self.nuisance if k not in self.fast), *in_motion)
        self.bias = self.names.index(BIAS) if BIAS in self.names else None
        # a flow offset repeats in all recordings, unless its term stands for an external leak (drift "outside") or,
        # if valves shut at rest, for losses of the pump in motion
        if self.bias is not None and equation.terms[self.bias].drift == "bias" and not is_shut:
            self.between_deviation[self.bias] = 0.0
        self.drivers = tuple(term.driver for term in equation.terms)
        self.healthy_conductance = equation.healthy

    def difference_precisions(self, indices: Sequence[int], coefficients: Array, leak_coefficient: float) -> Array:
        """Compute the precisions of the priors on the differences of c coefficients between recordings.

        The differences are those of one recording from the other recordings. `indices` (c,): indices of the columns of
        the coefficients; `coefficients` (c,): coefficients in the other recordings; `leak_coefficient`: the leak's
        coefficient in the other recordings [m^3/(s Pa)]. The prior deviations are relative to the coefficients:
        `between_deviation`, for the leak `between.pump` of `priors.toml`. An exception is a flow offset that repeats:
        it differs only by the leak's flow at the pressure `zero.pressure`, the standard deviation of a sensor offset of
        p_A - p_B. A deviation of 0 gives an infinite precision.
        """
        is_leak = np.array(indices) == self.names.index(LEAK)
        deviations = np.abs(coefficients) * np.where(is_leak, INFERENCE.between.pump, self.between_deviation[indices])
        repeats = (np.array(indices) == self.bias) & (self.between_deviation[indices] == 0.0)
        deviations[repeats] = abs(leak_coefficient) * INFERENCE.zero.pressure
        with np.errstate(divide="ignore", over="ignore"):
            return np.asarray(1.0 / deviations**2)

    def with_free_zero(self) -> ColumnRoles:
        """Return a copy of these roles whose flow offset (zero of the flow) may differ freely between recordings."""
        roles = copy(self)
        if self.bias is not None:
            roles.between_deviation = self.between_deviation.copy()
            roles.between_deviation[self.bias] = INFERENCE.between.bias
        return roles

    def replace_leak(self, name: str) -> ColumnRoles:
        """Return a copy of these column roles in which the term `name` is tested instead of the leak.

        The leak becomes an ordinary term, whose coefficient differs between recordings within the prior `between.pump`
        of `priors.toml`.
        """
        roles = copy(self)
        roles.leak, roles.between_deviation = self.names.index(name), self.between_deviation.copy()
        roles.between_deviation[self.leak] = INFERENCE.between.pump
        return roles

    def leak_deviation(self, column: int, blocks: Blocks) -> float:
        """Compute the prior standard deviation of a leak's coefficient in a healthy machine, in the coefficient's unit.

        `column`: index of the leak's column. For a flow through an orifice, the prior gives the same mean flow over
        `blocks` as the prior of a laminar leak. The result is infinite for a column that no pressure drives, such as
        the left side, or without a prior.
        """
        driver = self.drivers[column] if column < self.left else ""
        pressure, root = float(np.mean(blocks.mean_pressure())), float(np.mean(blocks.mean_root()))
        per_conductance = {"": float("inf"), "pressure": 1.0, "root": pressure / root if root > 0.0 else 1.0}
        return self.healthy_conductance * per_conductance[driver]

    def offset_deviation(self, column: int, blocks: Blocks) -> float:
        """Compute the prior standard deviation of the error that a pressure sensor's offset causes in a column.

        `column`: index of the regression's column. The result is in Pa for the column of a laminar leak, in Pa^0.5 for
        the column of an orifice. It is 0 if no pressure drives the flow of the column's term. It is also 0 in an
        equation without flow offset, since the error is removed by means of the flow offset's column (`_shift_offset`).
        The standard deviation of the offset itself is limited to the mean of abs(p_A - p_B) over `blocks`, since
        recordings may be in counts instead of Pa.
        """
        # what drives the flow of the column's term: "pressure", "root" (square root of a pressure), or "" for neither
        driver = self.drivers[column] if column < self.left and self.bias is not None else ""
        root = float(np.mean(blocks.mean_root()))
        # derivatives of the driver by the pressure: d sqrt(p)/dp = 1/(2 sqrt(p))
        per_pascal = {"": 0.0, "pressure": 1.0, "root": 0.5 / root if root > 0.0 else 0.0}
        return min(INFERENCE.zero.pressure, float(np.mean(blocks.mean_pressure()))) * per_pascal[driver]


class Weighting:
    """Weighting of the rows of successive blocks by Huber's weights, which limit the effect of outliers.

    The weights follow from a fit that also uses weighted sums over earlier blocks. These sums are the state of the
    object. `columns`: for each equation the indices of its columns by role (leak, motion, left side).
    """

    def __init__(self, columns: Sequence[ColumnRoles]) -> None:
        self._columns = columns
        self._earlier_sums = [np.zeros((len(column.slow) + 1, len(column.slow) + 1)) for column in columns]
        self._count = 0

    @property
    def has_blocks(self) -> bool:
        """True if the rows of at least one block have been weighted."""
        return self._count > 0

    def state(self) -> dict[str, Any]:
        """Return the number of earlier blocks and the weighted sums over their rows, as plain values for JSON."""
        return {"count": self._count, "known": [plain_array(sums) for sums in self._earlier_sums]}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the sums over earlier blocks from a saved `state`; raise InputError if its shapes do not fit."""
        self._count = int(require_part(state, "count", int))
        restored = [restore_array(sums, "known") for sums in require_part(state, "known", list)]
        shapes = [sums.shape for sums in self._earlier_sums]
        if [sums.shape for sums in restored] != shapes:
            raise InputError(
                f"saved state's known must be of the shapes {shapes}, got {[sums.shape for sums in restored]}"
            )
        self._earlier_sums = restored

    def compute_gram_matrices(self, values: Sequence[Array], ends: NDArray[np.intp]) -> Array:
        """Compute the Gram matrices (K, E, m, m) of K blocks, in which outlying rows have smaller weights.

        `values`: for each equation the rows (r, m) of all blocks; `ends` (K,): index past the last row of each block.
        Huber's weights follow from a fit to these and earlier blocks. In this fit the coefficients of fast columns are
        free in each block, and the coefficients of slow columns are common to all blocks (`ColumnRoles`). The number of
        blocks and the sums over earlier blocks, which this object stores, are updated.
        """
        self._count += len(ends)
        update_fraction = min(1.0, SUPPORT / self._count)  # the last fifth of all blocks counts most
        grams = []
        for equation_rows, columns, earlier_sums in zip(values, self._columns, self._earlier_sums, strict=True):
            fast, slow = np.array(columns.fast), np.array([*columns.slow, columns.left])
            grams.append(block_gram_matrices(equation_rows, ends, fast, slow, earlier_sums, update_fraction))
        return np.stack(grams, axis=1)


def solve(matrix: Array, right: Array) -> Array:
    """Solve matrix x = right for a positive semidefinite `matrix` (n, n) and `right` (n,) or (n, k).

    The matrix is scaled to a unit diagonal, to which a small ridge is added. Components of x in the null space of the
    matrix are about zero.
    """
    scale = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    scale[~(scale > 0.0)] = 1.0  # a column of zeros stays as it is
    column = scale[:, None]
    scaled = matrix / column / scale
    scaled.flat[:: len(scale) + 1] += RIDGE  # this stride selects the diagonal
    right_scale = scale if right.ndim == 1 else column
    scaled_right = right / right_scale
    if not scaled_right.size:  # nothing to solve
        return np.asarray(scaled_right)
    _, solution, has_failed = _positive_definite_solver()(scaled, scaled_right)
    if has_failed:  # not positive definite, by rounding
        solution = np.asarray(np.linalg.solve(scaled, scaled_right))
    return np.asarray(solution / right_scale)


@cache
def _positive_definite_solver() -> Callable[[Array, Array], tuple[Array, Array, int]]:
    """Return LAPACK's solver for positive definite matrices, imported when first used.

    For a few columns it takes a third of the time of NumPy's solver.
    """
    from scipy.linalg.lapack import dposv

    return dposv  # type: ignore[no-any-return]


def information(blocks: Blocks, columns: Sequence[ColumnRoles], test: int, left_out: int | None = None) -> Information:
    """Compute the joint likelihood of one coefficient's values in all blocks, with the other coefficients eliminated.

    The coefficient is that of one term of a volume balance. Its likelihood is normal: the result contains the precision
    matrix, and the product of this matrix with the mean. For a leak it also contains the prior standard deviation of
    the coefficient in a healthy machine (`level`). `columns`: for each equation the indices of its columns by role
    (leak, motion, left side); the likelihoods of the equations are multiplied. `test`: index of the coefficient's
    column, or of the left side to test a change of the left side's scale. `left_out`: index of another column to leave
    out of the regression, or None.
    """
    count = len(blocks)
    precision, vector = np.zeros((count, count)), np.zeros(count)
    for e, roles in enumerate(columns):
        nuisance = [k for k in roles.nuisance if k not in (test, left_out)]
        equation_precision, equation_vector = _eliminate_nuisance(blocks.gram[:, e], blocks, roles, test, nuisance)
        precision += equation_precision
        vector += equation_vector
    return Information(blocks.time, precision, vector, level=columns[0].leak_deviation(test, blocks))


def _drift_polynomials(blocks: Blocks) -> tuple[Array, float]:
    """Compute Legendre polynomials in time over K blocks, (K, DRIFT_DEGREE + 1), and the recording's length [min].

    Slow drifts of coefficients are weighted sums of these polynomials. A single block has only the constant polynomial.
    """
    minutes = max(float(blocks.end[-1] - blocks.start[0]), 1e-9) / 60.0
    position = (blocks.time - blocks.start[0]) / (60.0 * minutes) * 2.0 - 1.0  # -1 to 1, the polynomials' range
    return np.polynomial.legendre.legvander(position, DRIFT_DEGREE if len(blocks) > 1 else 0), minutes


class _NormalEquations(NamedTuple):
    """Gram matrices and moments of a regression on nuisance columns, whose coefficients drift, and on a tested column.

    The tested column belongs to the coefficient to estimate. Each nuisance column is multiplied by each drift
    polynomial, which gives c columns in all. Sums over the rows of all blocks, or of each of K blocks:

    - `gram` (c, c), `moment` (c,): products of these c columns with each other and with the left side;
    - `coupling` (K, c): products of the tested column with the c columns, in each block;
    - `energy` (K,): sum of squares of the tested column, in each block;
    - `tested_moment` (K,): product of the tested column with the left side, in each block;
    - `left_square`: sum of squares of the left side.
    """

    gram: Array
    moment: Array
    coupling: Array
    energy: Array
    tested_moment: Array
    left_square: float

    def eliminate_tested(self) -> tuple[Array, Array, float]:
        """Eliminate the tested coefficient, which is free in each block, from the normal equations.

        Returns the reduced sums: the Gram matrix (c, c) of the other columns, their products (c,) with the left side,
        and the sum of squares of the left side.
        """
        energy = np.maximum(self.energy, np.finfo(float).tiny)
        gram = self.gram - (self.coupling / energy[:, None]).T @ self.coupling
        moment = self.moment - self.coupling.T @ (self.tested_moment / energy)
        return gram, moment, self.left_square - float((self.tested_moment**2 / energy).sum())


def _build_normal_equations(
    gram: Array, polynomials: Array, nuisance: list[int], test: int, left: int
) -> _NormalEquations:
    """Build the normal equations of a regression on drifting nuisance columns and one tested column.

    `gram` (K, m, m): Gram matrices of K blocks; `polynomials` (K, n_polynomials): drift polynomials; `nuisance`:
    indices of the columns that are multiplied by each polynomial; `test`, `left`: indices of the tested column and of
    the left side.
    """
    n, n_polynomials = len(nuisance), polynomials.shape[1]
    size = n * n_polynomials
    # sum over k of gram[k, i, j] P_p P_q by one matrix product, which is faster than einsum
    products = (polynomials[:, :, None] * polynomials[:, None, :]).reshape(len(gram), n_polynomials**2)
    sums = gram[:, nuisance][:, :, nuisance].reshape(len(gram), n * n).T @ products
    return _NormalEquations(
        # a column for each pair of a nuisance column (i or j) and a polynomial (p or q): (i, j, p, q) to (i p, j q)
        gram=sums.reshape(n, n, n_polynomials, n_polynomials).transpose(0, 2, 1, 3).reshape(size, size),
        moment=np.einsum("ki,kp->ip", gram[:, nuisance, left], polynomials).ravel(),
        coupling=np.einsum("ki,kp->kip", gram[:, nuisance, test], polynomials).reshape(len(gram), size),
        energy=gram[:, test, test],
        tested_moment=gram[:, test, left],
        left_square=float(gram[:, left, left].sum()),
    )


class _Prior(NamedTuple):
    """Prior standard deviations of c nuisance coefficients: of their `level` and their `drift`, (c,) each.

    The level is the constant part of a coefficient. The last of the c coefficients is the remaining error [Pa] of the
    sensor offset of p_A - p_B. `offset` [Pa]: prior standard deviation of the whole offset, of which `current_offset`
    is already subtracted; the error therefore has the prior mean -`current_offset`.
    """

    level: Array
    drift: Array
    offset: float
    current_offset: float = 0.0


class _NuisanceFit(NamedTuple):
    """Fit of the nuisance coefficients: `coefficients` (c,), and `variance` of a row's residual.

    Each nuisance column has `n_polynomials` successive coefficients, first that of the constant polynomial. The last
    column is that of the sensor offset's error. The variance is inflated for overlapping rows. `prior_precision` (c,):
    prior precision of the coefficients, times `variance`; `prior_moment` (c,): product of `prior_precision` and the
    prior mean of the coefficients.
    """

    coefficients: Array
    prior_precision: Array
    prior_moment: Array
    variance: float
    n_polynomials: int


def _fit_nuisance(normal: _NormalEquations, prior: _Prior, n_polynomials: int, n_rows: float) -> _NuisanceFit:
    """Fit all coefficients of a regression except the tested one, and the residual variance of a row.

    `normal`: normal equations of the regression, from which the tested coefficient, free in each block, is eliminated.
    Each other (nuisance) column has `n_polynomials` coefficients, one for each polynomial of its drift, the constant
    polynomial first. `prior`: prior standard deviations of the coefficients; `n_rows`: number of rows in all blocks.
    The residual variance determines the weight of the prior, and so the fit. Both are found by iteration, until the
    variance changes by at most the fraction `TOLERANCE`.
    """
    gram, moment, left_square = normal.eliminate_tested()
    min_variance = 1e-14 * normal.left_square / n_rows  # rounding errors of the sums
    variance = max(left_square / n_rows, min_variance)
    for _ in range(MAX_ITERATIONS):
        # prior of each coefficient: its mean, and its precision times the variance of a row; rows that overlap are
        # correlated, as if their variance were OVERLAP times as large
        precision, mean = np.zeros((2, len(prior.drift), n_polynomials))
        with np.errstate(divide="ignore", over="ignore"):
            # infinite for a deviation of 0: the drift is relative to the coefficient, which may be 0
            precision[:, 0] = OVERLAP * variance / prior.level**2
            precision[:, 1:] = (OVERLAP * variance / prior.drift**2)[:, None]
        if prior.offset > 0.0:  # the last coefficient is the error of the sensor offset (`_Prior`)
            precision[-1, 0], mean[-1, 0] = OVERLAP * variance / prior.offset**2, -prior.current_offset
        # limited to a precision that is enough to fix a coefficient
        prior_precision = np.minimum(precision.ravel(), 1e9 * np.diag(normal.gram))
        prior_moment = prior_precision * mean.ravel()
        coefficients = solve(gram + np.diag(prior_precision), moment + prior_moment)
        previous, variance = variance, max((left_square - float(moment @ coefficients)) / n_rows, min_variance)
        if abs(variance - previous) <= TOLERANCE * previous:
            break
    row_variance = max(OVERLAP * variance, np.finfo(float).tiny)
    return _NuisanceFit(coefficients, prior_precision, prior_moment, row_variance, n_polynomials)


class _EquationFit(NamedTuple):
    """Fit of one equation: sensor offset of p_A - p_B and nuisance coefficients.

    `offset`: the fitted offset [Pa], relative to the one already removed; `normal`: normal equations after subtracting
    this offset; `nuisance`: coefficients, the last of which is the remaining error of the offset.
    """

    normal: _NormalEquations
    nuisance: _NuisanceFit
    offset: float


def _fit_equation(gram: Array, blocks: Blocks, roles: ColumnRoles, test: int, nuisance: list[int]) -> _EquationFit:
    """Fit the nuisance coefficients of one equation and the sensor offset z of p_A - p_B, by Gauss-Newton steps.

    The tested coefficient g is free in each block. The leakage is g (p_A - p_B - z) = g (p_A - p_B) - g z. A change of
    g between blocks also changes the constant flow -g z, and so reveals z. z is small, since a first estimate of the
    offset is already removed from the Gram matrices (`pressure_offset.remove_pressure_offset`).

    `gram` (K, m, m): Gram matrices of the equation in K blocks; `roles`: indices of its columns by role (leak, motion,
    left side); `test`: index of the column of g; `nuisance`: indices of the nuisance columns.
    """
    polynomials, minutes = _drift_polynomials(blocks)
    n_rows, n_polynomials = max(float(blocks.rows.sum()), 1.0), polynomials.shape[1]
    total = gram.sum(axis=0)
    constants = solve(total[np.ix_(nuisance, nuisance)], total[nuisance, roles.left])  # without drifts
    magnitudes = np.minimum(np.abs(constants), roles.level_deviation[nuisance])  # at most the prior deviation
    # standard deviations of the drifts over the recording; the last one is the offset's, which does not drift
    drift = np.append(magnitudes * roles.drift_rate[nuisance] * minutes, 0.0)
    offset_deviation = roles.offset_deviation(test, blocks)
    # inf: the level of the offset has the prior deviation `offset_deviation` instead
    prior = _Prior(np.append(roles.level_deviation[nuisance], np.inf), drift, offset_deviation)
    nuisance_and_offset = [*nuisance, gram.shape[1]]  # `_shift_offset` appends the offset's column
    offset, coefficients = 0.0, np.zeros(len(blocks))  # z, and g in each block
    for iteration in range(_MAX_OFFSET_STEPS + 1):
        shifted = _shift_offset(gram, roles, test, coefficients, offset)
        normal = _build_normal_equations(shifted, polynomials, nuisance_and_offset, test, roles.left)
        fit = _fit_nuisance(normal, prior._replace(current_offset=offset), n_polynomials, n_rows)
        step = float(fit.coefficients[-n_polynomials])  # constant part of the last coefficient, the offset's error
        is_last = iteration == _MAX_OFFSET_STEPS or not offset_deviation > 0.0
        # in the first iteration g is 0, so that the offset has no effect
        if is_last or (iteration > 0 and abs(step) <= TOLERANCE * offset_deviation):
            break
        offset += step
        tested_residual = normal.tested_moment - normal.coupling @ fit.coefficients
        coefficients = tested_residual / np.maximum(normal.energy, np.finfo(float).tiny)
    return _EquationFit(normal, fit, offset)


def _shift_offset(gram: Array, roles: ColumnRoles, test: int, coefficients: Array, offset: float) -> Array:
    """Correct one column of Gram matrices for a sensor offset, and append a column for the error of that offset.

    `gram` (K, m, m): Gram matrices of K blocks; `roles`: indices of the columns by role (leak, motion, left side);
    `test`: index of the tested column, a pressure times the sampling interval dt, whose coefficient g is to be
    estimated; `coefficients` (K,): g in each block; `offset` [Pa]: subtracted from the pressure. The appended column -g
    dt is the derivative of the volume balance with respect to the offset. It becomes the last of the m + 1 columns of
    the result. In an equation without flow offset, nothing is corrected and the appended column is zero.
    """
    size = gram.shape[1]
    transform = np.zeros((len(gram), size, size + 1))
    transform[:, :, :size] = np.eye(size)
    if roles.bias is not None:  # the column of the flow offset is dt
        transform[:, roles.bias, test] -= offset  # tested column minus offset dt
        transform[:, roles.bias, size] -= coefficients  # appended column -g dt
    return np.asarray(transform.transpose(0, 2, 1) @ gram @ transform)


def _eliminate_nuisance(
    gram: Array, blocks: Blocks, roles: ColumnRoles, test: int, nuisance: list[int]
) -> tuple[Array, Array]:
    """Compute the likelihood of the tested coefficient in K blocks by one equation: precision (K, K) and vector (K,).

    `gram` (K, m, m): Gram matrices of the blocks; `roles`: indices of the columns by role (leak, motion, left side);
    `test`: index of the tested column; `nuisance`: indices of the columns to eliminate. With the residual variance s^2
    of a row, the results are the Schur complements

        precision = (N - C (G + P)^-1 C') / s^2,    vector = (n - C (G + P)^-1 (b + P mu)) / s^2.

    N is the diagonal matrix of the tested column's sums of squares, n its products with the left side, and C its
    products with the nuisance columns. G is the Gram matrix of the nuisance columns and b their products with the left
    side. P / s^2 is the prior precision of the nuisance coefficients, and mu their prior mean.
    """
    normal, fit, _ = _fit_equation(gram, blocks, roles, test, nuisance)
    right_sides = np.column_stack([normal.coupling.T, normal.moment + fit.prior_moment])
    solution = solve(normal.gram + np.diag(fit.prior_precision), right_sides)
    precision = (np.diag(normal.energy) - normal.coupling @ solution[:, :-1]) / fit.variance
    vector = (normal.tested_moment - normal.coupling @ solution[:, -1]) / fit.variance
    return 0.5 * (precision + precision.T), vector


def _nuisance_columns(roles: ColumnRoles) -> list[int]:
    """Return the indices of the nuisance columns, whose coefficients are unknown in any machine, without the leak's."""
    return [k for k in roles.nuisance if k != roles.leak]


def offset_cost(offset: float) -> float:
    """Compute -2 log of the prior density of a sensor offset of p_A - p_B [Pa], relative to the density of no offset.

    The prior is a normal density of standard deviation s for good sensors or, with small odds o, a wide one of standard
    deviation w for sensors that are far off (`zero` in `priors.toml`). The more favourable of the two counts:

        cost = min((offset / s)^2, (offset / w)^2 + 2 log(w / (s o))).
    """
    return float(offset_costs(np.asarray(offset)))


def offset_costs(offsets: Array) -> Array:
    """Compute `offset_cost`, the lower of the costs by a narrow and by a wide prior, for an array of offsets [Pa]."""
    usual, far, odds = INFERENCE.zero.pressure, INFERENCE.zero.far, INFERENCE.zero.odds
    return np.asarray(np.minimum((offsets / usual) ** 2, (offsets / far) ** 2 + 2.0 * np.log(far / usual / odds)))


def estimate_offset(blocks: Blocks, columns: Sequence[ColumnRoles]) -> float:
    """Estimate the total sensor offset of p_A - p_B [Pa] in a recording, as the mean of one estimate per equation.

    `columns`: for each equation the indices of its columns by role (leak, motion, left side). The result includes the
    offset that is already removed from `blocks`. Only changes of the leak between blocks show the offset; without them
    the estimate stays near the removed offset.
    """
    fits = [
        _fit_equation(blocks.gram[:, e], blocks, roles, roles.leak, _nuisance_columns(roles))
        for e, roles in enumerate(columns)
    ]
    return float(np.mean(blocks.zero)) + float(np.mean([fit.offset for fit in fits]))


class LeakAndBias(NamedTuple):
    """Joint likelihood of the leak coefficient and the flow offset in K blocks, the K leaks first.

    `precision` (2 K, 2 K) and `vector` (2 K,) are as in `onset.Information`. The flow offset is the flow at the mean
    pressure difference `pressure` (K,) [Pa] of each block; there leak and offset are uncorrelated within the block.
    """

    precision: Array
    vector: Array
    pressure: Array


def estimate_leak_and_bias(blocks: Blocks, roles: ColumnRoles) -> LeakAndBias:
    """Compute the joint likelihood of leak coefficient and flow offset (bias) in K blocks, for the first equation.

    All other coefficients are eliminated. Returns the precision (2 K, 2 K) and the information vector (2 K,), leaks
    first, and the mean pressure difference (K,) in each block (`LeakAndBias`). `roles`: indices of the equation's
    columns by role (leak, motion, left side); they must include the flow offset (`roles.bias`).
    """
    leak, bias = roles.leak, roles.bias
    assert bias is not None
    gram = blocks.gram[:, 0].copy()
    bias_energy = gram[:, bias, bias]
    has_bias = bias_energy > RIDGE * bias_energy.max()  # false if the flow offset's column is zero, as at rest
    # mean of p_A - p_B in each block: the leak's column is (p_A - p_B) dt, that of the flow offset is dt
    mean_pressure = np.where(has_bias, gram[:, leak, bias], 0.0) / np.where(has_bias, bias_energy, 1.0)
    fit = _fit_equation(gram, blocks, roles, leak, _nuisance_columns(roles))
    # subtract this mean from the leak's column, so that leak and flow offset are uncorrelated in the block
    gram[:, leak] -= mean_pressure[:, None] * gram[:, bias]
    gram[:, :, leak] -= mean_pressure[:, None] * gram[:, :, bias]
    nuisance = [k for k in roles.nuisance if k not in (leak, bias)]
    position = _nuisance_columns(roles).index(bias)
    polynomials, _ = _drift_polynomials(blocks)
    # prior precisions of the fit, a row for each nuisance column; the last row is the sensor offset's, not used here
    prior = fit.nuisance.prior_precision.reshape(-1, polynomials.shape[1])[:-1]
    prior = np.delete(prior, position, axis=0).ravel()  # without the flow offset, which is estimated here
    leaks, biases = (_build_normal_equations(gram, polynomials, nuisance, k, roles.left) for k in (leak, bias))
    coupling = np.vstack([leaks.coupling, biases.coupling])
    solution = solve(leaks.gram + np.diag(prior), np.column_stack([coupling.T, leaks.moment]))
    precision = np.diag(np.concatenate([leaks.energy, biases.energy])) - coupling @ solution[:, :-1]
    vector = np.concatenate([leaks.tested_moment, biases.tested_moment]) - coupling @ solution[:, -1]
    variance = fit.nuisance.variance
    return LeakAndBias(0.5 * (precision + precision.T) / variance, vector / variance, mean_pressure)


def estimate_weighted_mean(blocks: Blocks, roles: ColumnRoles, weights: Mapping[int, float]) -> tuple[float, float]:
    """Estimate a weighted mean of several coefficients of the first volume balance, and its standard error.

    `roles`: indices of the columns of this balance by role (leak, motion, left side). `weights` maps the index of a
    nuisance column to the weight of its coefficient; the weights sum to 1. Only the constant part of each coefficient
    is averaged, not its drift.
    """
    nuisance = _nuisance_columns(roles)
    normal, fit, _ = _fit_equation(blocks.gram[:, 0], blocks, roles, roles.leak, nuisance)
    contrast = np.zeros(len(fit.coefficients))  # weights of all coefficients of the fit
    for column, weight in weights.items():
        constant = nuisance.index(column) * fit.n_polynomials  # index of the first of the column's coefficients
        contrast[constant] = weight
    gram, _, _ = normal.eliminate_tested()
    precision = gram + np.diag(fit.prior_precision)
    variance = float(contrast @ solve(precision, contrast)) * fit.variance
    return float(contrast @ fit.coefficients), float(np.sqrt(max(variance, 0.0)))


def sum_blocks(blocks: Blocks, columns: Sequence[ColumnRoles]) -> Array:
    """Compute the Gram matrix of a whole recording for each of E equations, divided by the residual variance of a row.

    The result has the shape (E, m, m), where the m columns are the terms of the volume balance and, last, its left
    side. `columns`: for each equation the indices of its columns by role (leak, motion, left side).
    """
    grams = []
    for e, roles in enumerate(columns):
        fit = _fit_equation(blocks.gram[:, e], blocks, roles, roles.leak, _nuisance_columns(roles))
        grams.append(blocks.gram[:, e].sum(axis=0) / fit.nuisance.variance)
    return np.array(grams)
