"""Information in blocks: what a stretch of a recording says of the coefficients of a balance, and how it is added up.

A block keeps, of the rows within it, the Gram matrix of all columns (terms and left side). Blocks add: the sum of their
matrices is that of their union, so that a stream and a whole recording are handled alike, and a recording of hours
costs no more than one of minutes. Rows are weighted once, when their block is closed (`row_weights`).

For one coefficient g, a number for each block, everything else is eliminated (`information`). The other coefficients
are a level with a slow drift, c_j(t) = sum_p c_jp P_p(t), whose size is believed within a width (`priors.toml`):

    Lambda = (diag N - B M^-1 B') / s^2,    eta = (n - B M^-1 m) / s^2,

with the sums N_k of d^2 and n_k of d y, B_k of d o, M of o o' (plus the priors) and m of o y over the rows of block
k (d the column of g, o the others with their drifts, y the left side); its likelihood is exp(eta' g - g' Lambda g/2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.rows.row_weights import MOST_TURNS, RIDGE, SUPPORT, TOLERANCE, weighted
from sealscope.diagnosis.inference.rows.weak_form import OVERLAP
from sealscope.diagnosis.inference.terms import BIAS, LEAK, REST_LEAK, RESTS, Equation
from sealscope.diagnosis.priors import priors
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import array_of, part_of, plain_array

#: Most blocks that are handled at once; neighbours are added up beyond.
MOST_BLOCKS = 240
#: Degree of the drifts.
DRIFT_DEGREE = 2
#: Priors of the coefficients that are free in each block while its rows are weighted.
UNSTEADY = ("leak", "pump", "bias", "outside")
_TURNS = 3


@dataclass(frozen=True, eq=False)
class Blocks:
    """Consecutive blocks of a recording.

    Parameters
    ----------
    start, end : array of float, shape (K,)
        Times of the first and the last row of each block [s].
    gram : array of float, shape (K, E, m, m)
        Sums of the products, over the rows' variances, of the m columns over the rows of each of E equations, the left
        side last.
    rows : array of float, shape (K,)
        Number of rows that no missing sample touches; beside a hole a row counts as a share.
    flow : array of float, shape (K,)
        Mean size of the left side's rate [m^3/s].
    pressures : array of float, shape (K, p)
        Distribution of p_A - p_B [Pa]: means of p equal parts of it, in rising order (`distribution`).
    zero : array of float, shape (K,)
        What the sums have taken off p_A - p_B [Pa] (`zero.about_zero`); `pressures` are as recorded.
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

    @property
    def time(self) -> Array:
        """Middle of each block [s]."""
        return 0.5 * (self.start + self.end)

    def merged(self, most: int = MOST_BLOCKS) -> Blocks:
        """Return at most so many blocks, neighbours added up."""
        group = -(-len(self) // most)
        if group <= 1:
            return self
        first = np.arange(0, len(self), group)
        last = np.append(first[1:], len(self)) - 1
        rows = np.add.reduceat(self.rows, first)
        shares = self.rows[:, None] / np.maximum(np.repeat(rows, np.diff(np.append(first, len(self)))), 1.0)[:, None]
        return Blocks(
            self.start[first],
            self.end[last],
            np.add.reduceat(self.gram, first, axis=0),
            rows,
            np.add.reduceat(self.flow * shares[:, 0], first),
            np.add.reduceat(self.pressures * shares, first, axis=0),
            self.zero[first],
        )

    def driving(self, zero: float | None = None, root: bool = False) -> Array:
        """Return the mean of abs(p_A - p_B - zero) [Pa] over each block, shape (K,), by default about that of the sums.

        With `root` that of the root of p_A - p_B, about the sums' zero and then about `zero` [Pa^0.5]. A leak's
        coefficient times it is the leak's mean flow (`zero_of`).
        """
        if not root:
            return np.asarray(np.abs(self.pressures - (self.zero[:, None] if zero is None else zero)).mean(axis=1))
        difference = self.pressures - self.zero[:, None]
        return np.asarray(np.abs(np.sign(difference) * np.sqrt(np.abs(difference)) - (zero or 0.0)).mean(axis=1))

    @classmethod
    def join(cls, parts: Sequence[Blocks]) -> Blocks:
        """Return blocks one after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


class Columns:
    """Where the columns of a balance stand in its Gram matrices, and what is believed of them."""

    def __init__(self, equation: Equation) -> None:
        self.names = tuple(term.name for term in equation.terms)
        self.left = len(self.names)
        self.nuisance = tuple(k for k, term in enumerate(equation.terms) if term.nuisance)
        self.compared = tuple(k for k, term in enumerate(equation.terms) if term.nuisance or term.compared)
        self.leak = self.names.index(LEAK)
        believed = priors("inference")["drift"]
        self.drift = np.array([believed[term.drift] if term.nuisance else 0.0 for term in equation.terms])
        differs = priors("inference")["between"]
        self.between = np.zeros(len(equation.terms))
        self.between[list(self.compared)] = [differs[equation.terms[k].drift] for k in self.compared]
        levels = priors("inference")["level"]
        self.levels = np.array([levels.get(term.drift, np.inf) for term in equation.terms])
        self.motion = tuple(k for k in self.nuisance if equation.terms[k].drift in ("motion", "edge"))
        self.support = tuple(k for k in self.nuisance if equation.terms[k].drift not in UNSTEADY)
        self.fast = tuple(k for k in self.nuisance if k not in self.support)
        self.rest = tuple(self.names.index(name) for name in RESTS) if REST_LEAK in self.names else None
        self.support = (*self.support, *(self.rest or ()))
        self.bias = self.names.index(BIAS) if BIAS in self.names else None
        self.driven = tuple(term.driven for term in equation.terms)
        self.healthy = priors("inference")["healthy"][equation.healthy] if equation.healthy else float("inf")

    def level_deviation(self, test: int, blocks: Blocks) -> float:
        """Return the standard deviation of a healthy machine's coefficient of a column; infinite for other columns."""
        driven = self.driven[test] if test < self.left else ""
        pressure, root = (float(np.mean(blocks.driving(root=of_root))) for of_root in (False, True))
        return (
            self.healthy * {"": float("inf"), "pressure": 1.0, "root": pressure / root if root > 0.0 else 1.0}[driven]
        )

    def zero_deviation(self, test: int, blocks: Blocks) -> float:
        """Return the standard deviation of the zero of a column's pressure, by its slope; 0 where none drives it.

        No more than the pressure itself, which may be in counts.
        """
        driven = self.driven[test] if test < self.left and self.bias is not None else ""
        root = float(np.mean(blocks.driving(root=True)))
        slope = {"": 0.0, "pressure": 1.0, "root": 0.5 / root if root > 0.0 else 0.0}[driven]
        return float(min(priors("inference")["zero"]["pressure"], np.mean(blocks.driving()))) * slope


class Weighting:
    """Closes blocks: weighs the rows of each by what the block and those before it say, and keeps their sums."""

    def __init__(self, columns: Sequence[Columns]) -> None:
        self._columns = columns
        self._known = [np.zeros((len(column.support) + 1, len(column.support) + 1)) for column in columns]
        self._count = 0

    @property
    def has_blocks(self) -> bool:
        """True once blocks were closed."""
        return self._count > 0

    def state(self) -> dict[str, Any]:
        """Return the learnt sums in plain values for JSON."""
        return {"count": self._count, "known": [plain_array(sums) for sums in self._known]}

    def recall(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`; raises InputError where it does not fit."""
        self._count = int(part_of(state, "count", int))
        known = [array_of(sums, "known") for sums in part_of(state, "known", list)]
        shapes = [sums.shape for sums in self._known]
        if [sums.shape for sums in known] != shapes:
            raise InputError(
                f"saved state's known must be of the shapes {shapes}, got {[sums.shape for sums in known]}"
            )
        self._known = known

    def close(self, values: Sequence[Array], ends: NDArray[np.intp]) -> Array:
        """Return the Gram matrices (K, E, m, m) of K blocks that are weighted together.

        `values`: of each equation, the rows (r, m) of all of them; `ends`: index past the last row of each block.
        """
        self._count += len(ends)
        share = min(1.0, SUPPORT / self._count)
        grams = []
        for equation_rows, columns, known in zip(values, self._columns, self._known, strict=True):
            fast, slow = columns.fast, (*columns.support, columns.left)
            grams.append(weighted(equation_rows, ends, np.array(fast), np.array(slow), known, share))
        return np.stack(grams, axis=1)


def solve(matrix: Array, right: Array) -> Array:
    """Return matrix^-1 right of a symmetric matrix >= 0; directions that nothing is known of are left at zero."""
    size = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    size[~(size > 0.0)] = 1.0
    column = size[:, None]
    scaled = matrix / column / size
    scaled.flat[:: len(size) + 1] += RIDGE
    shaped = right / (size if right.ndim == 1 else column)
    _, solved, failed = _cholesky()(scaled, shaped) if shaped.size else (None, shaped, 0)
    if failed:  # rounding made it no longer positive
        solved = np.asarray(np.linalg.solve(scaled, shaped))
    return np.asarray(solved / (size if right.ndim == 1 else column))


@cache
def _cholesky() -> Callable[[Array, Array], tuple[Array, Array, int]]:
    """Return LAPACK's solution of a positive definite system: a third of the time of NumPy's for a few columns."""
    from scipy.linalg.lapack import dposv

    return dposv  # type: ignore[no-any-return]


def information(blocks: Blocks, columns: Sequence[Columns], test: int, replaces: int | None = None) -> Information:
    """Estimate the coefficient of one column in each block, all other coefficients eliminated.

    `test`: index of the column, the left side's for a change of scale; `replaces`: a column that is left out for it.
    """
    count = len(blocks)
    precision, vector = np.zeros((count, count)), np.zeros(count)
    for e, equation in enumerate(columns):
        nuisance = [k for k in equation.nuisance if k not in (test, replaces)]
        part, lead = _eliminated(blocks.gram[:, e], blocks, equation, test, nuisance)
        precision += part
        vector += lead
    return Information(blocks.time, precision, vector, columns[0].level_deviation(test, blocks))


def _drifts(blocks: Blocks) -> tuple[Array, float]:
    """Return the drifts' shapes over the blocks, shape (K, DRIFT_DEGREE + 1), and the recording's length in minutes."""
    minutes = max(float(blocks.end[-1] - blocks.start[0]), 1e-9) / 60.0
    tau = (blocks.time - blocks.start[0]) / (60.0 * minutes) * 2.0 - 1.0
    return np.polynomial.legendre.legvander(tau, DRIFT_DEGREE if len(blocks) > 1 else 0), minutes


class _Normal(NamedTuple):
    """Sums over the blocks of the other columns, each with its drifts in turn (c in all).

    `cross` (c, c), `left` (c,) with the left side, `along` (K, c) with the tested column in each block; of that column
    `energy` (K,) and `lead` (K,), its product with the left side; `square`: of the left side.
    """

    cross: Array
    left: Array
    along: Array
    energy: Array
    lead: Array
    square: float


def _normal(gram: Array, powers: Array, nuisance: list[int], test: int, left: int) -> _Normal:
    n, degrees = len(nuisance), powers.shape[1]
    size = n * degrees
    squares = (powers[:, :, None] * powers[:, None, :]).reshape(len(gram), degrees**2)
    cross = gram[:, nuisance][:, :, nuisance].reshape(len(gram), n * n).T @ squares
    return _Normal(
        cross.reshape(n, n, degrees, degrees).transpose(0, 2, 1, 3).reshape(size, size),
        np.einsum("ki,kp->ip", gram[:, nuisance, left], powers).ravel(),
        np.einsum("ki,kp->kip", gram[:, nuisance, test], powers).reshape(len(gram), size),
        gram[:, test, test],
        gram[:, test, left],
        float(gram[:, left, left].sum()),
    )


class _Prior(NamedTuple):
    """Prior on the other coefficients.

    Standard deviations of each one's `level` and of its `drift`, (c,); `zero`, that of the last one; `at`: what it is
    counted from.
    """

    level: Array
    drift: Array
    zero: float
    at: float = 0.0


class _Fitted(NamedTuple):
    """The other coefficients with their drifts, and what is believed of them, (c,) each.

    `precision` and `lead`, its product with the mean; `variance` of a row, inflated for the overlap of the rows.
    """

    coefficients: Array
    precision: Array
    lead: Array
    variance: float


def _fitted(normal: _Normal, believed: _Prior, degrees: int, rows: float) -> _Fitted:
    """Return the fit of the other coefficients; the tested column's coefficient is free in each block."""
    energy = np.maximum(normal.energy, np.finfo(float).tiny)
    cross = normal.cross - (normal.along / energy[:, None]).T @ normal.along
    left = normal.left - normal.along.T @ (normal.lead / energy)
    square = normal.square - float((normal.lead**2 / energy).sum())
    least = 1e-14 * normal.square / rows
    variance = max(square / rows, least)
    for _ in range(MOST_TURNS):
        prior, mean = np.zeros((2, len(believed.drift), degrees))
        with np.errstate(divide="ignore", over="ignore"):
            prior[:, 0] = OVERLAP * variance / believed.level**2
            prior[:, 1:] = (OVERLAP * variance / believed.drift**2)[:, None]
        if believed.zero > 0.0:
            prior[-1, 0], mean[-1, 0] = OVERLAP * variance / believed.zero**2, -believed.at
        # a coefficient that is zero drifts by nothing
        precision = np.minimum(prior.ravel(), 1e9 * np.diag(normal.cross))
        lead = precision * mean.ravel()
        coefficients = solve(cross + np.diag(precision), left + lead)
        before, variance = variance, max(square - float(left @ coefficients), least) / rows
        if abs(variance - before) <= TOLERANCE * before:
            break
    return _Fitted(coefficients, precision, lead, max(OVERLAP * variance, np.finfo(float).tiny))


class _Fit(NamedTuple):
    """The sums that a fit is to, the fit, its last coefficient that of the zero's error, and the zero [Pa]."""

    normal: _Normal
    fitted: _Fitted
    zero: float


def _fit(gram: Array, blocks: Blocks, columns: Columns, test: int, nuisance: list[int]) -> _Fit:
    """Return the fit of one equation, the tested column's coefficient free in each block.

    A leak g (p_A - p_B - z) has a zero z of the pressures' difference, one number: beside a change of g there is one of
    the bias, by -g z. About the zero of the sums (`zero.about_zero`) it is small, and found by Gauss's and Newton's
    steps.
    """
    zero, width = 0.0, columns.zero_deviation(test, blocks)
    powers, minutes = _drifts(blocks)
    rows, degrees = max(float(blocks.rows.sum()), 1.0), powers.shape[1]
    total = gram.sum(axis=0)
    level = solve(total[np.ix_(nuisance, nuisance)], total[nuisance, columns.left])
    size = np.append(np.minimum(np.abs(level), columns.levels[nuisance]) * columns.drift[nuisance] * minutes, 0.0)
    believed = _Prior(np.append(columns.levels[nuisance], np.inf), size, width)
    chosen, slope = [*nuisance, gram.shape[1]], np.zeros(len(blocks))
    for turn in range(_TURNS + 1):
        normal = _normal(_shift_zero(gram, columns, test, slope, zero), powers, chosen, test, columns.left)
        fitted = _fitted(normal, believed._replace(at=zero), degrees, rows)
        step = float(fitted.coefficients[-degrees])
        if turn == _TURNS or not width > 0.0 or (turn > 0 and abs(step) <= TOLERANCE * width):
            break
        zero += step
        slope = (normal.lead - normal.along @ fitted.coefficients) / np.maximum(normal.energy, np.finfo(float).tiny)
    return _Fit(normal, fitted, zero)


def _shift_zero(gram: Array, columns: Columns, test: int, slope: Array, zero: float) -> Array:
    """Return the sums with the tested column taken about a zero of the pressures.

    Last the column of the zero's error: -slope dt, of each block.
    """
    size = gram.shape[1]
    turned = np.zeros((len(gram), size, size + 1))
    turned[:, :, :size] = np.eye(size)
    if columns.bias is not None:
        turned[:, columns.bias, test] -= zero
        turned[:, columns.bias, size] -= slope
    return np.asarray(turned.transpose(0, 2, 1) @ gram @ turned)


def _eliminated(gram: Array, blocks: Blocks, columns: Columns, test: int, nuisance: list[int]) -> tuple[Array, Array]:
    """Return precision (K, K) and vector (K,) of one equation."""
    normal, fitted, _ = _fit(gram, blocks, columns, test, nuisance)
    right = np.column_stack([normal.along.T, normal.left + fitted.lead])
    solved = solve(normal.cross + np.diag(fitted.precision), right)
    precision = (np.diag(normal.energy) - normal.along @ solved[:, :-1]) / fitted.variance
    vector = (normal.lead - normal.along @ solved[:, -1]) / fitted.variance
    return 0.5 * (precision + precision.T), vector


def _nuisance_columns(columns: Columns) -> list[int]:
    """Return the columns whose coefficients are unknown beside the leak's."""
    return [k for k in columns.nuisance if k != columns.leak]


def cost_of_zero(zero: float) -> float:
    """Return minus twice the logarithm of what is believed of a zero of the pressures [Pa], over that of none."""
    usual, far, odds = (priors("inference")["zero"][name] for name in ("pressure", "far", "odds"))
    return float(min((zero / usual) ** 2, (zero / far) ** 2 + 2.0 * np.log(far / usual / odds)))


def zero_of(blocks: Blocks, columns: Sequence[Columns], test: int | None = None) -> float:
    """Return the zero of p_A - p_B [Pa] that a change of the leak shows, the equations' mean; near 0 without one.

    `test`: the column of the leak through an orifice, then the zero is that of its root [Pa^0.5], beside the sums'.
    """
    fits = [
        _fit(blocks.gram[:, e], blocks, equation, equation.leak if test is None else test, _nuisance_columns(equation))
        for e, equation in enumerate(columns)
    ]
    zero = float(np.mean([fit.zero for fit in fits]))
    return zero if test is not None else float(np.mean(blocks.zero)) + zero


def pair(blocks: Blocks, columns: Columns) -> tuple[Array, Array, Array]:
    """Return precision (2 K, 2 K) and vector (2 K,) of leak and offset of the flow, and where offsets are taken (K,).

    They are two numbers a block, uncorrelated within it: the offset is that at the block's mean pressure difference.
    """
    leak, bias = columns.leak, columns.bias
    assert bias is not None
    gram = blocks.gram[:, 0].copy()
    middle = gram[:, leak, bias] / np.maximum(gram[:, bias, bias], np.finfo(float).tiny)
    fit = _fit(gram, blocks, columns, leak, _nuisance_columns(columns))
    gram[:, leak] -= middle[:, None] * gram[:, bias]
    gram[:, :, leak] -= middle[:, None] * gram[:, :, bias]
    nuisance = [k for k in columns.nuisance if k not in (leak, bias)]
    position = _nuisance_columns(columns).index(bias)
    powers, _ = _drifts(blocks)
    prior = np.delete(fit.fitted.precision.reshape(-1, powers.shape[1])[:-1], position, axis=0).ravel()
    of_leak, of_bias = (_normal(gram, powers, nuisance, k, columns.left) for k in (leak, bias))
    coupling = np.vstack([of_leak.along, of_bias.along])
    solved = solve(of_leak.cross + np.diag(prior), np.column_stack([coupling.T, of_leak.left]))
    precision = np.diag(np.concatenate([of_leak.energy, of_bias.energy])) - coupling @ solved[:, :-1]
    vector = np.concatenate([of_leak.lead, of_bias.lead]) - coupling @ solved[:, -1]
    return 0.5 * (precision + precision.T) / fit.fitted.variance, vector / fit.fitted.variance, middle


def mean_of(blocks: Blocks, columns: Columns, shares: Mapping[int, float]) -> tuple[float, float]:
    """Return a mean of coefficients, by their columns' `shares`, and its deviation; the leak is free in each block."""
    nuisance = _nuisance_columns(columns)
    normal, fitted, _ = _fit(blocks.gram[:, 0], blocks, columns, columns.leak, nuisance)
    weights = np.zeros((len(nuisance) + 1, len(fitted.coefficients) // (len(nuisance) + 1)))
    for column, share in shares.items():
        weights[nuisance.index(column), 0] = share
    energy = np.maximum(normal.energy, np.finfo(float).tiny)
    matrix = normal.cross - (normal.along / energy[:, None]).T @ normal.along + np.diag(fitted.precision)
    variance = float(weights.ravel() @ solve(matrix, weights.ravel())) * fitted.variance
    return float(weights.ravel() @ fitted.coefficients), float(np.sqrt(max(variance, 0.0)))


def total(blocks: Blocks, columns: Sequence[Columns]) -> Array:
    """Return a recording's sums (E, m, m), over the rows' variance."""
    sums = []
    for e, equation in enumerate(columns):
        nuisance = _nuisance_columns(equation)
        fit = _fit(blocks.gram[:, e], blocks, equation, equation.leak, nuisance)
        sums.append(blocks.gram[:, e].sum(axis=0) / fit.fitted.variance)
    return np.array(sums)
