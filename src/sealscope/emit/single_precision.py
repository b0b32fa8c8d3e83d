"""Single precision: columns in which it computes, learned from healthy recordings, and proof that it suffices there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sealscope.diagnosis.inference.equations.terms import channels_of
from sealscope.diagnosis.live.coefficients import ENERGY, MOTION, NOISE, ROWS, SHIFT
from sealscope.diagnosis.live.kernel.stream import WINDOW, Basis, StreamSettings
from sealscope.emit.c_export import parts_a_sample
from sealscope.emit.run_program import CompiledStream
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: Least part of a column's sum of squares that the other columns do not explain; less is due to rounding.
_LEAST_PIVOT = 1e-11
#: Largest error of single precision, in standard deviations of a block's conductance.
MOST_ERROR = 0.1


def learn_basis(stream: CompiledStream) -> Basis:
    """Compute the basis from what a stream in double precision has learned: the sums of its volume balance.

    Columns of one group (`_group_columns`) are made orthogonal to each other, by a Cholesky factorisation of their
    products. Scales make the leak of unit size, and the residuals of unit variance. The flow without a leak is
    subtracted from the left side.
    """
    state, expressions = stream.state, stream.unit.settings.expressions
    sums = np.reshape(state.model_sums, (-1, len(expressions)))
    numbers, n = state.model_numbers, len(sums) - 2
    rows = numbers[ROWS]
    products = (sums[:n, :n] - np.outer(sums[:n, n], sums[n, :n]) / sums[n, n]) / rows
    combination = np.zeros((n, n))
    for group in _group_columns(stream.unit.settings):
        factor = np.zeros((len(group), len(group)))
        for i, column in enumerate(group):
            for k in range(i):
                factor[i, k] = (products[column, group[k]] - factor[i, :k] @ factor[k, :k]) / factor[k, k]
            least = max(_LEAST_PIVOT * sums[column, column] / rows, 0.0)
            pivot = max(products[column, column] - factor[i, :i] @ factor[i, :i], least)
            factor[i, i] = np.sqrt(pivot) if pivot > 0.0 else 1.0
        combination[np.ix_(group, group)] = np.linalg.inv(factor)
    return Basis(
        combination=tuple(float(combination[i, k]) for i in range(n) for k in range(i + 1)),
        prediction=tuple(float(stream.state.angle_sign * value) for value in state.model_values),
        leak_scale=float(np.sqrt(rows / numbers[ENERGY])),
        left_scale=float(1.0 / np.sqrt(numbers[NOISE])),
    )


def convert_learned(double: CompiledStream, single: CompiledStream) -> None:
    """Give a stream in single precision what one in double precision has learned, in the columns of its basis.

    With the basis' matrix T and the sums S of the products of columns, those of its columns are T S T'.
    """
    basis, known, state = single.unit.settings.basis, double.state, single.state
    assert basis is not None
    unit, size = basis.conductance_unit, len(known.model_values) + 2
    to_basis = np.zeros((size, size))
    to_basis[np.tril_indices(size - 2)] = basis.combination
    to_basis[-2, -2], to_basis[-1, -1] = basis.leak_scale, basis.left_scale
    to_basis[-1, :-2] = np.multiply(basis.prediction, -basis.left_scale)
    slow = list(single.unit.settings.column_order[single.unit.settings.n_fast :])
    # `slow_sums` are of the flow as recorded, and the other sums of the flow with its sign
    _fill(state.slow_sums, _transform(known.slow_sums, to_basis[np.ix_(slow, slow)]))
    to_basis[-1, :-2] *= known.angle_sign
    _fill(state.model_sums, _transform(known.model_sums, to_basis))
    _fill(state.model_leak_products, basis.leak_scale * to_basis[:-2, :-2] @ np.array(known.model_leak_products))
    _fill(state.model_values, np.zeros(size - 2))  # the left side is less their prediction
    factors = {MOTION: basis.left_scale**2, NOISE: basis.left_scale**2, ENERGY: basis.leak_scale**2, SHIFT: 1.0 / unit}
    for k, number in enumerate(known.model_numbers):
        state.model_numbers[k] = number * factors.get(k, 1.0)
    state.usual_precision = known.usual_precision * unit**2
    for name in ("angle_sign", "has_sign", "n_weighted", "steps_count"):
        setattr(state, name, getattr(known, name))
    state.steps_unit = known.steps_unit / unit
    for name in ("level", "level_variance", "squares", "log_variances", "log_weights"):
        _fill(getattr(state, f"steps_{name}"), getattr(known, f"steps_{name}"))


def _transform(sums: Sequence[float], matrix: Array) -> Array:
    """Compute the sums of products of the columns that a `matrix` (m, m) makes of those of `sums` (m m,)."""
    return np.asarray(matrix @ np.reshape(sums, matrix.shape) @ matrix.T)


def _fill(field: Any, values: Any) -> None:
    """Write values of any shape to an array of a state."""
    field[:] = np.ravel(values).tolist()


def _group_columns(settings: StreamSettings) -> list[list[int]]:
    """Group the columns of the nuisances: those of one chamber's oil and air, which change together.

    All others stay alone. A combination of columns of which one is 0 for hours, as the motion under a load that is
    rare, would depend on the others, and its coefficient would be that of rounding errors.
    """
    groups: dict[object, list[int]] = {}
    for column, expression in enumerate(settings.expressions[:-2]):
        channels = channels_of(expression) - {"x"}
        groups.setdefault(channels if len(channels) == 1 else column, []).append(column)
    return [*groups.values()]


def iter_blocks(stream: CompiledStream, samples: Array) -> Iterator[tuple[float, Array]]:
    """Feed samples; yield number, and conductance with its standard deviation [m^3/(s Pa)], of each estimated block."""
    basis = stream.unit.settings.basis
    unit = 1.0 if basis is None else basis.conductance_unit
    n_estimated = int(stream.state.n_estimated)
    for _ in stream.feed(samples, parts_a_sample(stream.unit.settings)):
        n_now = int(stream.state.n_estimated)
        history = np.reshape(stream.state.history, (WINDOW, -1))
        for k in range(n_estimated if n_now > n_estimated else 0, n_now):
            G, _, variance, *_, number = history[k % WINDOW].tolist()
            yield number, unit * np.array([G, np.sqrt(variance)])
        n_estimated = n_now


def measure_error(double: CompiledStream, single: CompiledStream, recordings: Sequence[Array]) -> float:
    """Compute the largest error of single precision in any block, in standard deviations of its conductance.

    Both begin with what they have learned. Infinite where the two do not estimate the same blocks.
    """
    largest = 0.0
    for samples in recordings:
        double.resume()
        single.resume()
        expected, found = dict(iter_blocks(double, samples)), dict(iter_blocks(single, samples))
        if expected.keys() != found.keys():
            return float("inf")
        for number, (G, deviation) in expected.items():
            error = max(abs(found[number][0] - G), abs(found[number][1] - deviation)) / deviation
            largest = max(largest, error if np.isfinite(error) else np.inf)
    return largest


def check_error(error: float) -> None:
    """Raise InputError unless the `error` of single precision is small."""
    if not error <= MOST_ERROR:
        raise InputError(
            f"single precision must err by at most {MOST_ERROR:g} standard deviations on the recordings to learn from, "
            f"got {error:.2g}: export double precision"
        )
