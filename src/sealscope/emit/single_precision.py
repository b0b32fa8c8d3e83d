"""Single precision: columns in which it computes, learned from healthy recordings, and proof that it suffices there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sealscope.diagnosis.live.coefficients import ENERGY, NOISE, ROWS
from sealscope.diagnosis.live.kernel.stream import WINDOW, Basis
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

    The nuisances are made orthogonal to each other, by a Cholesky factorisation of their products. Scales make the leak
    of unit size, and the residuals of unit variance. The flow without a leak is subtracted from the left side.
    """
    state, bias = stream.state, stream.unit.settings.bias
    sums = np.reshape(state.model_sums, (-1, len(stream.unit.settings.expressions)))
    numbers, n = state.model_numbers, len(sums) - 2
    rows = numbers[ROWS]
    nuisances = sums[:n, :n] - np.outer(sums[:n, n], sums[n, :n]) / sums[n, n]
    order = [bias, *(k for k in range(n) if k != bias)]
    products = nuisances[np.ix_(order, order)] / rows
    factor = np.zeros((n, n))
    for i in range(n):
        for k in range(i):
            factor[i, k] = (products[i, k] - factor[i, :k] @ factor[k, :k]) / factor[k, k]
        least = max(_LEAST_PIVOT * sums[order[i], order[i]] / rows, 0.0)
        pivot = max(products[i, i] - factor[i, :i] @ factor[i, :i], least)
        factor[i, i] = np.sqrt(pivot) if pivot > 0.0 else 1.0
    combination = np.zeros((n, n))
    combination[np.ix_(order, order)] = np.linalg.inv(factor)
    constant = combination[:, bias].copy()
    combination[:, bias] = 0.0
    return Basis(
        constant=tuple(constant.tolist()),
        combination=tuple(float(combination[i, k]) for i in range(n) for k in range(i + 1)),
        prediction=tuple(float(stream.state.angle_sign * value) for value in state.model_values),
        leak_scale=float(np.sqrt(rows / numbers[ENERGY])),
        left_scale=float(1.0 / np.sqrt(numbers[NOISE])),
    )


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

    Infinite where the two do not estimate the same blocks.
    """
    largest = 0.0
    for k, samples in enumerate(recordings):
        if k:
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
