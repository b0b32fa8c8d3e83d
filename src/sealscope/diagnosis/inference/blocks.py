"""Likelihood of a volume balance's coefficients in blocks of a recording, from sums over the rows of each block.

A volume balance (`terms`) is linear: its left side is a sum of terms, each a coefficient times a column of data. A row
is the balance integrated with one test function of the weak form (`rows`). A block is a few seconds of a
recording, of which only the Gram matrix of its rows over all columns (terms and left side) is stored. Gram matrices of
several blocks add up, so that a stream and a recording of hours are handled alike. Rows are weighted once, when their
block is closed (`rows`).

All samples of the balance's channels count, also those that bridge a short gap. A row with a clipped sample does not
count, and one beside a long gap by its share outside of the gap (`block_stream.BlockStream`).

To estimate one coefficient g in each block, all other coefficients are eliminated (`information`). Each of them has a
level and a slow drift, c_j(t) = sum_p c_jp P_p(t) with polynomials P_p, and a normal prior on its size (`priors.toml`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel, law
from sealscope.diagnosis.estimate.change import History, Information
from sealscope.diagnosis.estimate.linear import MAX_PRIOR, RIDGE, Gaussian, solve, solve_in_place
from sealscope.diagnosis.inference.equations.terms import BIAS, HOLDING, LAG, LEAK, MOVING_BIAS, TURNING, Equation
from sealscope.diagnosis.inference.rows import (
    MAX_ITERATIONS,
    OVERLAP,
    SUPPORT,
    TOLERANCE,
    block_gram_matrices,
    stride_samples,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import SavedAttributes

#: Number of equal parts of the sorted samples.
PARTS = 9
#: Averaging time of the pressure [s].
SMOOTHED = 0.025
#: Order of the differences that remove the signal and leave the noise.
_ORDER = 6


def sorted_part_means(pressure: Array, rate: float) -> Array:
    """Summarise the distribution of a pressure by the means of `PARTS` equal parts of its sorted samples [Pa].

    A sensor offset may be subtracted from these means afterwards. `pressure` (n,): samples [Pa] at the sampling `rate`
    [Hz], NaN where missing, for at least `SMOOTHED` seconds. Only whole pieces within whole strides of the weak form
    count, without a missing sample; less than a stride counts as one. The means (PARTS,) are zeros if no piece counts.

    Means over pieces of `SMOOTHED` seconds would hide the ringing of a stiff circuit, but single samples contain noise.
    Therefore the samples' deviations from these means are reduced. If their variance is v, estimated separately in each
    stride of the weak form, they are multiplied by sqrt(max(v - s^2, 0) / v). The variance of white noise is s^2 =
    (mean square of the sixth differences of all samples) / 924, where 924 is the sum of the squared coefficients of
    such a difference.
    """
    piece = max(1, round(SMOOTHED * rate))  # averaging time [samples]
    stride = min(stride_samples(rate), max(len(pressure), 1))  # [samples]
    n_pieces = stride // piece
    strides = pressure[: len(pressure) // stride * stride].reshape(-1, stride)[:, : n_pieces * piece]
    pieces = strides.reshape(-1, n_pieces, piece)
    mean = pieces.mean(axis=2, keepdims=True)  # NaN, as the deviation, in pieces that do not count
    deviation = pieces - mean
    if piece > 1:  # else each sample is its own mean
        differences = np.diff(pressure, _ORDER)
        differences = differences[np.isfinite(differences)]
        noise_gain = math.comb(2 * _ORDER, _ORDER)  # variance of a difference of white noise of variance 1
        # not by BLAS (@), whose rounding depends on the number of threads
        noise_variance = float((differences**2).sum()) / max(len(differences), 1) / noise_gain
        n_complete = np.isfinite(mean).sum(axis=1, keepdims=True)  # pieces without a missing sample in each stride
        squares = deviation**2
        squares[np.isnan(squares)] = 0.0
        variance = squares.sum(axis=(1, 2), keepdims=True) / (np.maximum(n_complete, 1) * (piece - 1))
        min_variance = max(noise_variance, np.finfo(float).tiny)  # a smaller variance is all noise: the factor is 0
        deviation *= np.sqrt(1.0 - noise_variance / np.maximum(variance, min_variance))
    values = (mean + deviation).ravel()
    values = np.sort(values[np.isfinite(values)])
    # sum of each part from the cumulative sum, interpolated where a part ends between two samples
    part_ends, cumulative_sums = np.linspace(0.0, len(values), PARTS + 1), np.concatenate([[0.0], np.cumsum(values)])
    part_sums = np.diff(np.interp(part_ends, np.arange(len(cumulative_sums)), cumulative_sums))
    return np.asarray(part_sums * (PARTS / max(len(values), 1)))


#: Maximum number of blocks of a fit; if there are more, neighbouring blocks are added up.
MAX_BLOCKS = 240
#: Degree of the Legendre polynomials of the drifts.
DRIFT_DEGREE = 2
#: Kinds of coefficients (`Term.drift`) that are free in each block while its rows are weighted.
UNSTEADY = ("piston", "pump", "bias", "outside")
#: Maximum number of Gauss-Newton steps to the offset of p_A - p_B.
_MAX_OFFSET_STEPS = 3
_TINY = float(np.finfo(float).tiny)


@lru_cache(maxsize=16)
def _upper_triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the upper triangle of a matrix (`size`, `size`)."""
    return np.triu_indices(size)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Consecutive blocks of a recording, each a few seconds long and reduced to a regression's Gram matrices.

    Parameters
    ----------
    start, end : array of float, shape (K,)
        Times of the first and the last row of each block [s], i.e. of the middles of their test functions.
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
        Sensor offset [Pa] that was subtracted from p_A - p_B in `gram` (`sensor_errors.remove_pressure_offset`), the
        same in all blocks of a recording.
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
        """Return the blocks for storage, with only the upper triangles of `gram`, shape (K, E, m (m + 1) / 2)."""
        return replace(self, gram=self.gram[..., *_upper_triangle(self.gram.shape[-1])])

    def unpack(self, size: int) -> Blocks:
        """Restore the Gram matrices (`size`, `size`) after `pack`; raise InputError if the stored shapes do not fit."""
        upper, lower = _upper_triangle(size)
        lengths = {len(getattr(self, name)) for name in self.__dataclass_fields__}
        if self.gram.shape[2:] != upper.shape or lengths != {len(self.start)}:
            raise InputError(f"saved state's gram must have {len(upper)} sums in each block, got {self.gram.shape}")
        gram = np.zeros((*self.gram.shape[:2], size, size))
        gram[..., upper, lower] = gram[..., lower, upper] = self.gram
        return replace(self, gram=gram)

    @property
    def time(self) -> Array:
        """Time in the middle of each block [s], shape (K,)."""
        return 0.5 * (self.start + self.end)

    @property
    def moving_flow(self) -> float:
        """Mean of `flow`, weighted by itself so that standstills do not count [m^3/s]."""
        return float(self.flow @ self.flow) / max(float(self.flow.sum()), np.finfo(float).tiny)

    @property
    def is_moving(self) -> NDArray[np.bool_]:
        """Flags (K,) of the blocks in which the pump moves the piston; all are flagged if all flows are 0.

        Their flow is at least `rest.motion_fraction` (`priors.toml`) times `moving_flow`; that of a pump that
        holds a load is less.
        """
        return np.asarray(self.flow >= INFERENCE.rest.motion_fraction * self.moving_flow)

    @property
    def pressure_weights(self) -> Array:
        """Weights (K,) for averaging a function of p_A - p_B over the blocks.

        The weight is 1, or nearly 0 for a block without samples of the pressure (`pressures` are then 0). The numbers
        of rows would be wrong weights: a row with a clipped pressure is dropped, though the pressure is roughly known.
        """
        return np.where((self.pressures != 0.0).any(axis=1), 1.0, 1e-9)  # positive, so that a mean exists

    def merge(self, max_blocks: int = MAX_BLOCKS) -> Blocks:
        """Merge neighbouring blocks in groups of equal size, so that at most `max_blocks` blocks remain.

        The last group may be smaller. Gram matrices and numbers of rows are added; flows are averaged with the numbers
        of rows as weights (0 without rows), and pressures with `pressure_weights`.
        """
        group_size = -(-len(self) // max_blocks)  # rounded up
        if group_size <= 1:
            return self
        first = np.arange(0, len(self), group_size)
        end = np.append(first[1:], len(self))
        rows, sizes = np.add.reduceat(self.rows, first), end - first
        rows_per_group = np.where(rows > 0.0, rows, 1.0)  # 1.0 avoids 0/0 in a group without rows
        weights = self.rows / np.repeat(rows_per_group, sizes)
        pressure_weights = self.pressure_weights / np.repeat(np.add.reduceat(self.pressure_weights, first), sizes)
        return Blocks(
            start=self.start[first],
            end=self.end[end - 1],
            gram=np.add.reduceat(self.gram, first, axis=0),
            rows=rows,
            flow=np.add.reduceat(self.flow * weights, first),
            pressures=np.add.reduceat(self.pressures * pressure_weights[:, None], first, axis=0),
            zero=self.zero[first],
        )

    def mean_pressure(self, offset: float | None = None) -> Array:
        """Compute the mean of abs(p_A - p_B - offset) [Pa] in each block, shape (K,).

        The flow of a laminar leak is proportional to it. `offset` [Pa]: sensor offset of p_A - p_B, by default `zero`.
        """
        subtracted = self.zero[:, None] if offset is None else offset
        return np.asarray(np.abs(self.pressures - subtracted).mean(axis=1))

    def mean_root(self) -> Array:
        """Compute the mean of sqrt(abs(p_A - p_B - zero)) [Pa^0.5] in each block, shape (K,), for an orifice."""
        return np.asarray(np.sqrt(np.abs(self.pressures - self.zero[:, None])).mean(axis=1))

    def driving_pressure(self, names: Sequence[str], term: str) -> float:
        """Estimate the root mean square (rms) [Pa] of the pressure that drives the flow of a leak or another `term`.

        This pressure is p_B, for example, for a leak out of side B. `term`: name of the term; `names`: names of the
        columns of `gram`. The result is rms(p_A - p_B) s_term / s_leak. s_term^2 and s_leak^2 are sums of squares of
        the columns of the term and of the leak, whose increments are (p_A - p_B) dt, over the equations that contain
        the term.
        """
        squares = np.einsum("keii->ei", self.gram)  # (E, m): sum of squares of each column in each equation
        squares = squares[squares[:, names.index(term)] > 0.0].sum(axis=0)  # equations that contain the term
        ratio = squares[names.index(term)] / max(squares[names.index(LEAK)], np.finfo(float).tiny)
        mean_squares = ((self.pressures - self.zero[:, None]) ** 2).mean(axis=1)  # mean of (p_A - p_B)^2 in each block
        return float(np.sqrt(np.average(mean_squares, weights=self.pressure_weights) * ratio))

    @classmethod
    def join(cls, parts: Sequence[Blocks]) -> Blocks:
        """Concatenate the blocks of consecutive `parts` of one recording."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


class ColumnRoles:
    """Indices of the columns of one equation's Gram matrices by role, and the priors on their coefficients.

    The m columns are the m - 1 terms of the volume balance and, last, its left side. Indices of columns:

    - `left`: left side; `leak`: laminar leak, or the term that is tested in its place; `bias`: flow offset, or None;
    - `nuisance`: terms whose coefficients are unknown in any machine, the leak among them;
    - `compared`: the nuisance terms, and those that are fitted only to compare recordings;
    - `piston`: motion of the piston; `motion`: the same with its delay, or the flow of the valve's edges;
    - `compliance`: the chambers' oil and its air;
    - `hold_leak`: leakage of a pump that holds the load, left out in a comparison of recordings (`regimes`); None
      unless valves shut at rest;
    - `fast`, `slow`: terms whose coefficients are free in each block, or common to all, while rows are weighted.

    Prior standard deviations of the coefficients (m - 1,):

    - `drift_rate`: drift, relative to the coefficient [1/min];
    - `between_deviation`: relative difference between recordings, infinite without a prior, 0 if it repeats, or if the
      term is not among `compared`;
    - `level_deviation`: constant part, in the coefficient's unit, infinite without a prior (`level_deviations`).

    `names` and `drivers` (m - 1,): names and drivers of the terms (`Term`); `healthy_conductance` [m^3/(s Pa)]:
    standard deviation of a healthy machine's leak.
    """

    def __init__(self, equation: Equation) -> None:
        terms = equation.terms
        self.names, self.drivers = tuple(term.name for term in terms), tuple(term.driver for term in terms)
        self.healthy_conductance = equation.healthy
        self.left, self.leak = len(terms), self.names.index(LEAK)
        self.bias = self.names.index(BIAS) if BIAS in self.names else None
        self.nuisance = tuple(k for k, term in enumerate(terms) if term.is_fitted)
        self.compared = tuple(k for k, term in enumerate(terms) if term.is_fitted or term.is_compared)

        def fitted_columns(*drifts: str) -> tuple[int, ...]:
            """List the nuisance columns with the given kinds of drift."""
            return tuple(k for k in self.nuisance if terms[k].drift in drifts)

        self.motion, self.compliance = fitted_columns("motion", "edge"), fitted_columns("compliance", "air")
        self.piston = tuple(k for k in self.motion if self.names[k].startswith("motion"))
        self.fast = fitted_columns(*UNSTEADY)
        # columns that are zero at rest; HOLDING is left out, since separate leakages of holds and other rests would
        # follow outliers
        in_motion = [self.names.index(name) for name in (TURNING, MOVING_BIAS)] if MOVING_BIAS in self.names else []
        self.slow = (*(k for k in self.nuisance if k not in self.fast), *in_motion)
        # true for a balance that `balances.shut_at_rest` made
        is_shut = HOLDING in self.names and MOVING_BIAS not in self.names
        self.hold_leak = self.names.index(HOLDING) if is_shut else None
        drift, between = vars(INFERENCE.drift), vars(INFERENCE.between)
        self.drift_rate = np.array([drift[term.drift] if term.is_fitted else 0.0 for term in terms])
        self.level_deviation = np.array(
            [INFERENCE.level.outside if term.drift == "outside" else np.inf for term in terms]
        )
        self.between_deviation = np.array(
            [between[term.drift] if k in self.compared else 0.0 for k, term in enumerate(terms)]
        )
        # a flow offset repeats in all recordings, unless its term stands for an external leak (drift "outside") or,
        # if valves shut at rest, for losses of the pump in motion
        if self.bias is not None and terms[self.bias].drift == "bias" and not is_shut:
            self.between_deviation[self.bias] = 0.0

    @property
    def unshared(self) -> list[int]:
        """Columns of the terms, except the leak, of whose differences between recordings nothing is known."""
        return [k for k in self.compared if k != self.leak and not np.isfinite(self.between_deviation[k])]

    def level_deviations(self, total: Array) -> Array:
        """Compute the prior standard deviations (m - 1,) of the constant parts of all coefficients.

        They are those of `level_deviation`, with two exceptions: a piston that always moves at one speed and pressure
        does not separate a pump's flow offset, or the delay of the position, from its area. The deviation of the flow
        offset is therefore `level.bias` (`priors.toml`) times the rms flow, that of the delay's term (`LAG`)
        `level.lag` [s] times the area, the rms flow over the rms speed. `total` (m, m): Gram matrix of the recording.
        """
        deviations, energies = self.level_deviation.copy(), np.diag(total)
        if not self.piston:  # behind a servo valve, or in a balance without motion
            return deviations
        # finite for an external leak, which has a prior of its own (`level.outside`)
        if self.bias is not None and not np.isfinite(deviations[self.bias]) and energies[self.bias] > 0.0:
            deviations[self.bias] = INFERENCE.level.bias * np.sqrt(energies[self.left] / energies[self.bias])
        motion_energy = float(energies[list(self.piston)].sum())
        if LAG in self.names and motion_energy > 0.0:
            deviations[self.names.index(LAG)] = INFERENCE.level.lag * np.sqrt(energies[self.left] / motion_energy)
        return deviations

    def clock_drifts(self, total: Array) -> Array:
        """Compute the standard deviations (m - 1,) of drifts in a minute by the clocks of two recorders.

        Only the delay of the position (`LAG`) drifts by them: by `delay.clock` (`priors.toml`) [s] in a minute times
        the area, the rms flow over the rms speed. `total` (m, m): Gram matrix of the recording.
        """
        deviations, energies = np.zeros(len(self.names)), np.diag(total)
        motion_energy = float(energies[list(self.piston)].sum())
        if LAG in self.names and motion_energy > 0.0:
            deviations[self.names.index(LAG)] = INFERENCE.delay.clock * np.sqrt(energies[self.left] / motion_energy)
        return deviations

    def difference_precisions(self, indices: Sequence[int], coefficients: Array, leak_coefficient: float) -> Array:
        """Compute the prior precisions (c,) of the differences of c coefficients from those of other recordings.

        `indices` (c,): columns of the coefficients, each the leak's or with a finite `between_deviation`;
        `coefficients` (c,): their values in the other recordings; `leak_coefficient` [m^3/(s Pa)]: the leak's value
        there. The prior deviation is the magnitude of the coefficient times `between_deviation`, or for the leak times
        `between.pump` (`priors.toml`). That of a flow offset that repeats in all recordings (`between_deviation` 0) is
        the leak's flow at the pressure `zero.pressure`, the standard deviation of a sensor offset of p_A - p_B. The
        precision is infinite if the deviation is 0.
        """
        is_leak = np.array(indices) == self.names.index(LEAK)
        deviations = np.abs(coefficients) * np.where(is_leak, INFERENCE.between.pump, self.between_deviation[indices])
        repeats = (np.array(indices) == self.bias) & (self.between_deviation[indices] == 0.0)
        deviations[repeats] = abs(leak_coefficient) * INFERENCE.zero.pressure
        with np.errstate(divide="ignore", over="ignore"):
            return np.asarray(1.0 / deviations**2)

    def with_free_zero(self) -> ColumnRoles:
        """Return a copy with an infinite prior deviation of the flow offset between recordings (`between.bias`).

        Balances for shut valves have it already; those for open valves are then compared in the same way.
        """
        roles = copy(self)
        if self.bias is not None:
            roles.between_deviation = self.between_deviation.copy()
            roles.between_deviation[self.bias] = INFERENCE.between.bias
        return roles

    def replace_leak(self, name: str) -> ColumnRoles:
        """Return a copy in which the term `name` takes the place of the leak, which becomes an ordinary term.

        The prior deviation of the old leak between recordings becomes `between.pump` (`priors.toml`).
        """
        roles = copy(self)
        roles.leak, roles.between_deviation = self.names.index(name), self.between_deviation.copy()
        roles.between_deviation[self.leak] = INFERENCE.between.pump
        return roles

    def leak_deviation(self, column: int, blocks: Blocks) -> float:
        """Compute the prior standard deviation of the leak coefficient of `column` in a healthy machine.

        It is infinite if no pressure drives the flow of this column, and for a laminar leak if `healthy_conductance`
        is. The coefficient of an orifice is converted from a laminar conductance by equal mean flows over `blocks`, or
        equals it without a pressure difference. This conductance is at most that of a healthy piston, since the pump's
        leakage is laminar.
        """
        driver = self.drivers[column]
        pressure, root = float(np.mean(blocks.mean_pressure())), float(np.mean(blocks.mean_root()))
        per_conductance = {"": float("inf"), "pressure": 1.0, "root": pressure / root if root > 0.0 else 1.0}
        conductance = self.healthy_conductance
        if driver == "root":
            conductance = min(conductance, INFERENCE.healthy.piston)
        return conductance * per_conductance[driver]

    def offset_deviation(self, column: int, blocks: Blocks) -> float:
        """Compute the prior standard deviation of the error that a pressure sensor's offset causes in a `column`.

        The error is that of the driving pressure [Pa] for a laminar leak, that of its root [Pa^0.5] for an orifice. It
        is 0 if no pressure drives the column's term, and in an equation without flow offset, whose column is needed to
        remove the error (`_sum_products`). The prior standard deviation of the sensor's offset [Pa] is limited to the
        mean of abs(p_A - p_B - zero) over `blocks`: pressures recorded in counts are much smaller numbers.
        """
        driver = self.drivers[column] if self.bias is not None else ""
        root = float(np.mean(blocks.mean_root()))
        # derivatives of the driver by the pressure: d sqrt(p)/dp = 1/(2 sqrt(p))
        per_pascal = {"": 0.0, "pressure": 1.0, "root": 0.5 / root if root > 0.0 else 0.0}
        return min(INFERENCE.zero.pressure, float(np.mean(blocks.mean_pressure()))) * per_pascal[driver]


class Weighting(SavedAttributes):
    """Huber's weights of the rows of successive blocks, which limit the effect of outliers.

    The weights follow from a fit to the rows and to weighted sums over earlier blocks, the state of the object.
    """

    SAVED = ("_count", "_earlier_sums")

    def __init__(self, columns: Sequence[ColumnRoles]) -> None:
        self._columns = columns
        self._earlier_sums = [np.zeros((len(column.slow) + 1, len(column.slow) + 1)) for column in columns]
        self._count = 0

    @property
    def has_blocks(self) -> bool:
        """True if the rows of at least one block have been weighted."""
        return self._count > 0

    def compute_gram_matrices(self, values: Sequence[Array], ends: NDArray[np.intp]) -> Array:
        """Compute the Gram matrices (K, E, m, m) of K blocks, and add these blocks to the sums over earlier ones.

        `values`: for each equation the rows (r, m) of all blocks; `ends` (K,): index past the last row of each block.
        The weights follow from one fit to these and earlier blocks. The coefficients of fast columns are free in each
        block, those of slow columns common to all (`ColumnRoles`).
        """
        self._count += len(ends)
        update_fraction = min(1.0, SUPPORT / self._count)  # the last fifth of many blocks has two thirds of the weight
        grams = []
        for equation_rows, columns, earlier_sums in zip(values, self._columns, self._earlier_sums, strict=True):
            fast, slow = np.array(columns.fast), np.array([*columns.slow, columns.left])
            grams.append(block_gram_matrices(equation_rows, ends, fast, slow, earlier_sums, update_fraction))
        return np.stack(grams, axis=1)


def information(blocks: Blocks, columns: Sequence[ColumnRoles], test: int, with_expansion: bool = False) -> Information:
    """Compute the joint likelihood of one coefficient's values in all blocks, with the other coefficients eliminated.

    `test`: index of the coefficient's column; `with_expansion`: add the errors of the coefficient by an imperfect model
    of the oil's expansion (`_expansion_errors`). The likelihoods of the equations are multiplied. The result also
    contains the prior standard deviation of the coefficient in a healthy machine (`level`,
    `ColumnRoles.leak_deviation`).

    With the residual variance s^2 of a row, precision and vector of an equation are the Schur complements

        precision = (N - C (G + P)^-1 C') / s^2,    vector = (n - C (G + P)^-1 (b + P mu)) / s^2.

    The nuisance columns are those of the other coefficients. N is the diagonal matrix of the tested column's sums of
    squares in each block, n contains its products with the left side, and C those with the nuisance columns. G is the
    Gram matrix of the nuisance columns and b their products with the left side. P / s^2 is the prior precision of their
    coefficients, and mu the prior mean.
    """
    count = len(blocks)
    precision, vector = np.zeros((count, count)), np.zeros(count)
    for e, roles in enumerate(columns):
        fit = _fit_equation(blocks, e, roles, test)
        tested = fit.tested_likelihood()
        if with_expansion:
            tested = tested.widen(_expansion_errors(fit, roles) ** 2)
        precision += 0.5 * (tested.precision + tested.precision.T)
        vector += tested.moment
    return Information(blocks.time, precision, vector, level=columns[0].leak_deviation(test, blocks))


def _expansion_errors(fit: _EquationFit, roles: ColumnRoles) -> Array:
    """Compute the error (K,) that an imperfect model of the oil's expansion causes in the tested coefficient.

    The error in a block is the fitted volume of expansion, as a value of the tested coefficient with the same effect,
    times the relative error `blocks.expansion` (`priors.toml`). The terms of the compliance hardly describe air at low
    pressures. The error is small where pressures rise and fall again, and large where they only relax.
    """
    n_polynomials = fit.polynomials.shape[1]
    # a flag for each polynomial of each nuisance column, and of the offset's, which is the last
    is_compliance = np.repeat([*(k in roles.compliance for k in fit.nuisance), False], n_polynomials)
    coupling = np.where(is_compliance, fit.normal.coupling, 0.0)
    posterior = fit.normal.eliminate_tested() + fit.prior
    covariances = solve(posterior.precision, coupling.T) * fit.variance
    # squared product of the tested column and the fitted volume of expansion, minus its variance by errors of the fit
    squares = (coupling @ fit.coefficients) ** 2 - np.einsum("kc,ck->k", coupling, covariances)
    has_energy = fit.normal.energy > 0.0
    products = np.where(has_energy, np.sqrt(np.maximum(squares, 0.0)), 0.0)
    return np.asarray(INFERENCE.blocks.expansion * products / np.where(has_energy, fit.normal.energy, 1.0))


class _NormalEquations(NamedTuple):
    """Gram matrices and moments of a regression on drifting nuisance columns and the column of the tested coefficient.

    Each nuisance column is multiplied by each drift polynomial, which gives c columns. Sums over rows:

    - `nuisance`: products of these columns with each other and with the left side, and its sum of squares;
    - `coupling` (K, c): products of the tested column with these, in each block;
    - `energy`, `tested_moment` (K,): products of the tested column with itself and with the left side, in each block.
    """

    nuisance: Gaussian
    coupling: Array
    energy: Array
    tested_moment: Array

    def eliminate_tested(self) -> Gaussian:
        """Return `nuisance` with the tested coefficient, free in each block, integrated out."""
        energy = np.maximum(self.energy, np.finfo(float).tiny)  # where it is 0, `coupling` and `tested_moment` are 0
        # of a diagonal matrix: no equations to solve
        return Gaussian(
            self.nuisance.precision - (self.coupling / energy[:, None]).T @ self.coupling,
            self.nuisance.moment - self.coupling.T @ (self.tested_moment / energy),
            self.nuisance.square - float((self.tested_moment**2 / energy).sum()),
        )


def _build_normal_equations(
    gram: Array, polynomials: Array, nuisance: Sequence[int], test: int, left: int
) -> _NormalEquations:
    """Build the normal equations of a regression on drifting nuisance columns and one tested column.

    `gram` (K, m, m): Gram matrices of K blocks; `polynomials` (K, n_polynomials): drift polynomials; `nuisance`,
    `test`, `left`: indices of the nuisance columns, of the tested one and of the left side.
    """
    sums, size = _Sums.allocate(len(gram), (len(nuisance) + 1) * polynomials.shape[1]), polynomials.shape[1]
    blocks, factors = np.ascontiguousarray(gram), np.ascontiguousarray(polynomials)  # as in `_fit_equation`
    _sum_products(blocks, factors, np.array(nuisance, np.int64), (test, left, -1), 0.0, np.zeros(len(gram)), 0, sums)
    normal = sums.normal_equations(gram, left)  # last are the columns of the offset, which are zero
    nuisance_sums = Gaussian(
        normal.nuisance.precision[:-size, :-size], normal.nuisance.moment[:-size], normal.nuisance.square
    )
    return normal._replace(nuisance=nuisance_sums, coupling=normal.coupling[:, :-size])


class _Sums(NamedTuple):
    """Arrays of `_NormalEquations` that `_sum_products` writes, with c columns and K blocks."""

    precision: Array  # (c, c)
    moment: Array  # (c,)
    coupling: Array  # (K, c)
    energy: Array  # (K,)
    tested_moment: Array  # (K,)

    @staticmethod
    def allocate(n_blocks: int, size: int) -> _Sums:
        """Make the arrays for `size` columns."""
        return _Sums(*(np.empty(shape) for shape in ((size, size), size, (n_blocks, size), n_blocks, n_blocks)))

    def normal_equations(self, gram: Array, left: int) -> _NormalEquations:
        """Make the normal equations of a regression from its sums; `gram`, `left`: as in `_build_normal_equations`."""
        nuisance = Gaussian(self.precision, self.moment, float(gram[:, left, left].sum()))
        return _NormalEquations(nuisance, self.coupling, self.energy, self.tested_moment)


@kernel
def _sum_products(
    gram: Any,
    polynomials: Any,
    nuisance: Any,
    columns: tuple[int, int, int],
    offset: float,
    tested: Any,
    first: int,
    sums: Any,
) -> None:
    """Write the sums of products of a regression's columns over the rows of K blocks to `sums` (`_Sums`).

    Each nuisance column, and last that of an error of the sensor offset, is multiplied by each drift polynomial.
    `columns`: indices of the tested column, of the left side, and of the flow offset's column, -1 without one. The
    tested column is a pressure or its root times the sampling interval dt, and the flow offset's is dt: `offset` [Pa]
    or [Pa^0.5] times dt is subtracted from the former, and the column of the error is -g dt, the derivative of the
    volume balance with respect to the offset, where g are the coefficients `tested` (K,). Without a flow offset nothing
    is corrected, and the last column is zero. Products of nuisance columns before the one at index `first`, which do
    not depend on the offset, stay as they are. For the other arguments see `_build_normal_equations`.
    """
    test, left, bias = columns
    n, n_polynomials = len(nuisance), polynomials.shape[1]
    shift = offset if bias >= 0 else 0.0
    for i in range(first * n_polynomials, len(sums.moment)):
        sums.moment[i] = 0.0
        for j in range(i + 1):
            sums.precision[i, j] = 0.0
    for k in range(len(gram)):
        block, factors = gram[k], polynomials[k]
        sums.energy[k] = block[test, test] - 2.0 * shift * block[bias, test] + shift * shift * block[bias, bias]
        sums.tested_moment[k] = block[test, left] - shift * block[bias, left]
        for i in range(n + 1):
            # the column of the error is a multiple of the flow offset's column
            row, factor = (nuisance[i], 1.0) if i < n else (bias, -tested[k] if bias >= 0 else 0.0)
            by_test = factor * (block[row, test] - shift * block[row, bias])
            for p in range(n_polynomials):
                sums.coupling[k, i * n_polynomials + p] = by_test * factors[p]
            if i < first:
                continue
            for p in range(n_polynomials):
                place, weight = i * n_polynomials + p, factor * factors[p]
                sums.moment[place] += weight * block[row, left]
                for j in range(i + 1):
                    product = weight * (block[row, nuisance[j]] if j < n else factor * block[row, row])
                    for q in range(n_polynomials):
                        sums.precision[place, j * n_polynomials + q] += product * factors[q]
    for i in range(first * n_polynomials, len(sums.moment)):
        for j in range(i):
            sums.precision[j, i] = sums.precision[i, j]


@kernel
def _fit_regression(
    gram: Any,
    polynomials: Any,
    nuisance: Any,
    columns: tuple[int, int, int],
    deviations: Any,
    offset_deviation: float,
    n_rows: float,
    sums: Any,
    scratch: Any,
    fitted: Any,
) -> tuple[float, float]:
    """Fit the coefficients of an equation but the tested one, and the sensor offset, by Gauss-Newton steps.

    `deviations` (c,): standard deviations of the normal priors on the coefficients (0 fixes a coefficient, an infinite
    one is no prior), whose means are 0 except for the last column's, the offset's error; `n_rows`: number of rows in
    all blocks; for the other arguments see `_sum_products`. Writes the last normal equations to `sums`, and to the rows
    of `fitted` (3, c) `coefficients`, `prior_precision` and `prior_moment` of `_EquationFit`; returns its `offset` and
    `variance`. `scratch`: arrays (c, c), (c, c), (c,), (c,) and (K,) of working memory.

    The variance of a row weights the prior, and so determines the fit: both are found by iteration, until the variance
    changes by at most the fraction `TOLERANCE`, or for `MAX_ITERATIONS`. Rows that overlap are correlated, as if their
    variance were OVERLAP times as large. The weight of the prior and the returned variance contain this factor.
    """
    n_blocks, size, left = len(gram), len(deviations), columns[1]
    n_polynomials = polynomials.shape[1]
    last, offset, variance = size - n_polynomials, 0.0, 0.0  # `last`: constant of the offset's error
    precision, factors, moment, scale, tested = scratch  # tested: g in each block
    total = 0.0
    for k in range(n_blocks):
        tested[k] = 0.0
        total += gram[k, left, left]
    min_variance = 1e-14 * total / n_rows  # rounding errors of the sums
    for iteration in range(_MAX_OFFSET_STEPS + 1):
        first = len(nuisance) if iteration else 0
        _sum_products(gram, polynomials, nuisance, columns, offset, tested, first, sums)
        square = _eliminate_tested(sums, precision, moment, total)
        variance = max(square / n_rows, min_variance)
        for _ in range(MAX_ITERATIONS):
            for i in range(size):
                # the diagonal of `precision` would be no measure of the limit, as the elimination may leave only
                # rounding errors; the deviation of a drift is relative to the coefficient, which may be 0
                limit = MAX_PRIOR * sums.precision[i, i]
                prior = OVERLAP * variance / deviations[i] ** 2 if deviations[i] > 0.0 else np.inf
                fitted[1, i] = min(prior, limit)
                fitted[2, i] = -offset * fitted[1, i] if i == last else 0.0
                fitted[0, i] = moment[i] + fitted[2, i]
                for j in range(i, size):
                    factors[i, j] = precision[i, j]
                factors[i, i] += fitted[1, i]
            solve_in_place(factors, fitted[0], scale)
            # by the normal equations, the difference is the sum of squared residuals plus c' P (c - mu), with the
            # prior's precision P and mean mu; this is about OVERLAP row variances for each coefficient with a prior, a
            # small share with many rows
            previous, explained = variance, 0.0
            for i in range(size):
                explained += moment[i] * fitted[0, i]
            variance = max((square - explained) / n_rows, min_variance)
            if abs(variance - previous) <= TOLERANCE * previous:
                break
        step = fitted[0, last]
        # in the first iteration g is 0, so that the offset has no effect
        if iteration == _MAX_OFFSET_STEPS or not offset_deviation > 0.0:
            break
        if iteration > 0 and abs(step) <= TOLERANCE * offset_deviation:
            break
        offset += step
        for k in range(n_blocks):
            residual = sums.tested_moment[k]
            for i in range(size):
                residual -= sums.coupling[k, i] * fitted[0, i]
            tested[k] = residual / max(sums.energy[k], _TINY)
    return offset, max(OVERLAP * variance, _TINY)


@law
def _eliminate_tested(sums: Any, precision: Any, moment: Any, square: float) -> float:
    """Write `_NormalEquations.eliminate_tested` of `sums` to `precision` (upper triangle) and `moment`.

    `square`: sum of squares of the left side; returns it after the elimination.
    """
    size = len(moment)
    for i in range(size):
        moment[i] = sums.moment[i]
        for j in range(i, size):
            precision[i, j] = sums.precision[i, j]
    for k in range(len(sums.energy)):
        energy = max(sums.energy[k], _TINY)  # where it is 0, `coupling` and `tested_moment` are 0
        square -= sums.tested_moment[k] ** 2 / energy
        for i in range(size):
            factor = sums.coupling[k, i] / energy
            moment[i] -= factor * sums.tested_moment[k]
            for j in range(i, size):
                precision[i, j] -= factor * sums.coupling[k, j]
    return square


class _EquationFit(NamedTuple):
    """Fit of one equation to K blocks: sensor offset of p_A - p_B and nuisance coefficients.

    - `nuisance`: indices of the nuisance columns; `polynomials` (K, n): those of their drifts;
    - `normal`: normal equations after subtracting `offset` [Pa], relative to that already removed. If an orifice is
      tested, it is an error of the root of p_A - p_B [Pa^0.5];
    - `coefficients` (c,): n for each nuisance column, the constant first; the last n are the error that remains of the
      offset, which does not drift;
    - `prior_precision` (c,): prior precision times `variance`; `prior_moment` (c,): its product with the prior mean;
    - `variance`: variance of a row's residual, inflated for overlapping rows.
    """

    nuisance: list[int]
    polynomials: Array
    normal: _NormalEquations
    offset: float
    coefficients: Array
    prior_precision: Array
    prior_moment: Array
    variance: float

    @property
    def prior(self) -> Gaussian:
        """The priors of the coefficients, times `variance`."""
        return Gaussian(np.diag(self.prior_precision), self.prior_moment)

    def tested_likelihood(self) -> Gaussian:
        """Compute the likelihood of the tested coefficient in K blocks, with all other coefficients integrated out."""
        tested = Gaussian(np.diag(self.normal.energy), self.normal.tested_moment)
        nuisance = self.normal.nuisance + self.prior
        return nuisance.integrate_out(self.normal.coupling, tested) / self.variance


@lru_cache(maxsize=64)
def _fit_equation(blocks: Blocks, equation: int, roles: ColumnRoles, test: int) -> _EquationFit:
    """Fit the nuisance coefficients of an equation and the sensor offset z of p_A - p_B, by Gauss-Newton steps.

    The tested coefficient g is free in each block. The leakage is g (p_A - p_B - z) = g (p_A - p_B) - g z. A change of
    g between blocks also changes the constant flow -g z, and so reveals z. z is small, since a first estimate of the
    offset is already removed from the Gram matrices (`sensor_errors.remove_pressure_offset`).

    `test`: column of g. The result is cached for the last blocks.
    """
    gram = blocks.gram[:, equation]
    nuisance = [k for k in roles.nuisance if k != test]
    seconds = max(float(blocks.end[-1] - blocks.start[0]), 1e-9)
    position = (blocks.time - blocks.start[0]) / seconds * 2.0 - 1.0  # -1 to 1, the range of Legendre polynomials
    polynomials = np.polynomial.legendre.legvander(position, DRIFT_DEGREE if len(blocks) > 1 else 0)  # of the drifts
    n_rows, n_polynomials = max(float(blocks.rows.sum()), 1.0), polynomials.shape[1]
    total = gram.sum(axis=0)
    constants = Gaussian.from_gram(total).among(nuisance).mean  # without drifts
    level = roles.level_deviations(total)[nuisance]
    magnitudes = np.minimum(np.abs(constants), level)  # at most the prior deviation, which `constants` may exceed
    offset_deviation = roles.offset_deviation(test, blocks)
    # prior standard deviations of constants and drifts; last those of the offset, whose drift is 0, and whose constant
    # has no prior if the offset has no effect
    deviations = np.zeros((len(nuisance) + 1, n_polynomials))
    deviations[:-1, 0] = level
    drifts = np.hypot(magnitudes * roles.drift_rate[nuisance], roles.clock_drifts(total)[nuisance])  # in a minute
    deviations[:-1, 1:] = (drifts * (seconds / 60.0))[:, None]
    deviations[-1, 0] = offset_deviation if offset_deviation > 0.0 else np.inf
    size = deviations.size
    sums, fitted = _Sums.allocate(len(gram), size), np.empty((3, size))
    scratch = tuple(np.empty(shape) for shape in ((size, size), (size, size), size, size, len(gram)))
    columns, places = (test, roles.left, -1 if roles.bias is None else roles.bias), np.array(nuisance, np.int64)
    offset, variance = _fit_regression(
        np.ascontiguousarray(gram),  # numba compiles a function once for each layout of its arrays
        np.ascontiguousarray(polynomials),
        places,
        columns,
        deviations.ravel(),
        offset_deviation,
        n_rows,
        sums,
        scratch,
        fitted,
    )
    normal = sums.normal_equations(gram, roles.left)
    if not 0.0 < normal.nuisance.square < np.inf:  # no row, or an overflow: nothing is known
        offset, variance, fitted = np.nan, np.nan, np.full_like(fitted, np.nan)
    coefficients, prior_precision, prior_moment = fitted
    return _EquationFit(nuisance, polynomials, normal, offset, coefficients, prior_precision, prior_moment, variance)


def offset_cost(offset: Any) -> Any:
    """Compute -2 log of the prior density of a sensor offset of p_A - p_B [Pa], relative to the density of no offset.

    The prior is a normal density of standard deviation s for good sensors or, with small odds o, a wide one of standard
    deviation w for sensors that are far off (`zero` in `priors.toml`). The more favourable counts:

        cost = min((offset / s)^2, (offset / w)^2 + 2 log(w / (s o))).
    """
    usual, far, odds = INFERENCE.zero.pressure, INFERENCE.zero.far, INFERENCE.zero.odds
    return np.minimum((offset / usual) ** 2, (offset / far) ** 2 + 2.0 * np.log(far / usual / odds))


def offset_penalty(offset: float) -> float:
    """Compute how improbable a sensor offset of p_A - p_B [Pa] is: -2 log of its density over the largest one.

    Of a sensor that is far off, the largest density is that of such sensors, times their odds. Penalties of sizes of
    other changes (`hypotheses.step_penalty`), with which it is compared, are relative to their largest density as well.
    """
    usual, far, odds = INFERENCE.zero.pressure, INFERENCE.zero.far, INFERENCE.zero.odds
    return float(min((offset / usual) ** 2, (offset / far) ** 2 - 2.0 * np.log(odds)))


def estimate_offset(blocks: Blocks, columns: Sequence[ColumnRoles]) -> float:
    """Estimate the total sensor offset of p_A - p_B [Pa] in a recording, as the mean of one estimate per equation.

    Only a leak that changes between blocks reveals it; otherwise it stays near `blocks.zero`, the offset already
    removed.
    """
    offsets = [_fit_equation(blocks, e, roles, roles.leak).offset for e, roles in enumerate(columns)]
    return float(np.mean(blocks.zero)) + float(np.mean(offsets))


def estimate_leak_and_bias(blocks: Blocks, roles: ColumnRoles) -> tuple[Array, Array, Array]:
    """Compute the joint likelihood of the leak and the flow offset in K blocks, from their first volume balance.

    The flow offset is the constant flow in the balance, in the column `roles.bias`. Returns

    - `precision` (2 K, 2 K) and `vector` (2 K,) as in `onset.Information`, for the K leaks and then the K flow offsets;
    - the mean of p_A - p_B (K,) [Pa] in each block, 0 in blocks without a flow offset. The flow offset of a block is
      its constant flow at this mean, not at p_A = p_B, which makes the columns of leak and offset orthogonal.
    """
    leak, bias = roles.leak, roles.bias
    assert bias is not None
    fit = _fit_equation(blocks, 0, roles, roles.leak)
    gram = blocks.gram[:, 0].copy()
    bias_energy = gram[:, bias, bias]
    has_bias = bias_energy > RIDGE * bias_energy.max()  # false if the flow offset's column is zero, as at rest
    # the leak's column is (p_A - p_B) dt, that of the flow offset is dt
    mean_pressure = np.where(has_bias, gram[:, leak, bias], 0.0) / np.where(has_bias, bias_energy, 1.0)
    gram[:, leak] -= mean_pressure[:, None] * gram[:, bias]
    gram[:, :, leak] -= mean_pressure[:, None] * gram[:, :, bias]
    nuisance = [k for k in roles.nuisance if k not in (leak, bias)]
    # prior precisions of the fit, a row for each nuisance column; the last row is the sensor offset's, not used here
    prior = fit.prior_precision.reshape(-1, fit.polynomials.shape[1])[:-1]
    prior = np.delete(prior, fit.nuisance.index(bias), axis=0).ravel()  # without the flow offset
    leaks, biases = (_build_normal_equations(gram, fit.polynomials, nuisance, k, roles.left) for k in (leak, bias))
    tested = Gaussian(
        np.diag(np.concatenate([leaks.energy, biases.energy])),
        np.concatenate([leaks.tested_moment, biases.tested_moment]),
    )
    rest = leaks.nuisance + Gaussian(np.diag(prior), np.zeros(len(prior)))
    joint = rest.integrate_out(np.vstack([leaks.coupling, biases.coupling]), tested)
    return 0.5 * (joint.precision + joint.precision.T) / fit.variance, joint.moment / fit.variance, mean_pressure


def estimate_weighted_mean(
    blocks: Blocks, roles: ColumnRoles, weights: Mapping[int, float], leak: History
) -> tuple[float, float]:
    """Estimate a weighted mean of several coefficients of the first volume balance, and its standard error.

    `weights`: weight of each coefficient by the index of its nuisance column, with the sum 1; `leak`: the leak's
    coefficient in each block. A coefficient is averaged, with its drift, over the rows by the squares of its column:
    its level over the whole recording is extrapolated if the piston moves in a few blocks only. With mean m and
    covariance V of the leak, and C, G, b, P and s^2 as in `information`, the coefficients are

        (G + P)^-1 (b + P mu - C' m),    covariance = (G + P)^-1 s^2 + (G + P)^-1 C' V C (G + P)^-1.

    A leak that is free in each block would take the place of a steady motion.
    """
    fit = _fit_equation(blocks, 0, roles, roles.leak)
    normal, n_polynomials = fit.normal, fit.polynomials.shape[1]
    contrast = np.zeros(len(fit.coefficients))  # weights of all coefficients of the fit
    for column, weight in weights.items():
        squares = blocks.gram[:, 0, column, column]
        first = fit.nuisance.index(column) * n_polynomials  # index of the column's first coefficient
        mean_polynomials = squares @ fit.polynomials / max(float(squares.sum()), np.finfo(float).tiny)
        contrast[first : first + n_polynomials] = weight * mean_polynomials
    posterior = normal.nuisance + fit.prior
    factors = solve(posterior.precision, contrast)
    by_leak = normal.coupling @ factors
    value = factors @ posterior.moment - by_leak @ leak.mean
    variance = float(contrast @ factors * fit.variance + by_leak @ leak.covariance @ by_leak)
    return float(value), float(np.sqrt(max(variance, 0.0)))


def scale_grams(blocks: Blocks, columns: Sequence[ColumnRoles]) -> Array:
    """Divide the Gram matrices (K, E, m, m) of K blocks by the residual variance of a row in each of E equations."""
    variances = [_fit_equation(blocks, e, roles, roles.leak).variance for e, roles in enumerate(columns)]
    return np.asarray(blocks.gram / np.array(variances)[:, None, None])


def sum_blocks(blocks: Blocks, columns: Sequence[ColumnRoles]) -> Array:
    """Compute the Gram matrix (E, m, m) of a whole recording for each of E equations, scaled as by `scale_grams`."""
    return np.asarray(scale_grams(blocks, columns).sum(axis=0))
