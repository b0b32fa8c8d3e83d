"""The weak form of a volume balance: rows of a linear regression from samples, without differentiating any signal.

A balance  dl = sum_j c_j f_j dg_j  has unknown coefficients c_j; l, f_j and g_j are functions of the recorded channels.
It is multiplied by test functions phi_i of compact support, with the middle t_i and the half-width h, and integrated,

    integral of phi_i dl = sum_j c_j integral of phi_i f_j dg_j,    phi_i(t) = (1 - s^2)^4 / norm,  s = (t - t_i) / h,

which gives one row for each test function, computed from the increments over each sampling interval. Noise is not
amplified, since summation by parts could move all derivatives to the smooth phi. phi and its first three derivatives
vanish at its ends, so noise there and the truncation do not matter. Test functions are `STRIDE` apart and overlap.

Sources: M. Shinbrot, Trans. ASME 79 (1957) 547 (modulating functions); H. A. Preisig and D. W. T. Rippin, Computers
and Chemical Engineering 17 (1993) 1; D. A. Messenger and D. M. Bortz, Multiscale Model. Simul. 19 (2021) 1474 (weak
form).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel, large_law, law
from sealscope.recordings.recording import Array

#: Distance of neighbouring test functions [s] and its minimum [samples]; how many distances a test function spans.
STRIDE, MIN_STRIDE = 0.125, 2
SPAN = 4
#: Weight below which a row next to holes is omitted.
MIN_WEIGHT = 0.1
#: Limit of integrals that count as readings of a sensor: squares of larger ones might overflow.
MAX_READING = 1e100
#: Reading of a missing sample in streams, whose increments are beyond `MAX_READING`.
BEYOND = 1e20 * MAX_READING


class Rows(NamedTuple):
    """Rows of a linear regression, one for each of r test functions.

    `time` (r,): middle of each test function [s since the first sample]; `values` (r, c): integral of the test function
    times the increments of each of c columns, i.e. a weighted mean rate of change [unit of the column's increments per
    second]; `whole` (r,): flags of the rows without a missing sample.
    """

    time: Array
    values: Array
    whole: NDArray[np.bool_]


def stride_samples(rate: float) -> int:
    """Compute the distance of neighbouring test functions [samples], at least `MIN_STRIDE`, at a `rate` [Hz]."""
    return max(MIN_STRIDE, round(STRIDE * rate))


def half_width(rate: float) -> float:
    """Compute half the length of a test function [s] at a sampling `rate` [Hz]."""
    return 0.5 * SPAN * stride_samples(rate) / rate


def strides_in(seconds: float, rate: float) -> int:
    """Convert a time [s] to a number of strides (distances of test functions), at least `SPAN`, one test function.

    A stride is `STRIDE`, or its length in samples if that is longer, as for slow loggers.
    """
    return max(SPAN, round(seconds / max(STRIDE, stride_samples(rate) / rate)))


@lru_cache(maxsize=8)
def peak_weight(rate: float) -> float:
    """Compute the value of the test function in its middle [1/s], by which its sum over the samples is the `rate`."""
    n_support = SPAN * stride_samples(rate)
    s = (np.arange(n_support) + 0.5) * 2.0 / n_support - 1.0
    return float(rate / np.sum((1.0 - s * s) ** 4))


@law
def row_weight(interval: int, n_stride: int, peak: float) -> float:
    """Compute the value of the test function phi [1/s] in the middle of its sampling interval number `interval`."""
    s = (interval + 0.5) * 2.0 / (SPAN * n_stride) - 1.0  # -1 to 1 over the support
    return peak * (1.0 - s * s) ** 4


@large_law
def add_to_rows(unfinished: Any, increments: Any, k: int, n_stride: int, peak: float) -> None:
    """Add the increments (c,) over sampling interval k, weighted by the test function, to the rows that contain it.

    The row that began `age` strides ago is at its number modulo `SPAN` of `unfinished` (SPAN, c); a new one begins at
    0. At the end of a stride, row k // `n_stride` - `SPAN` + 1 is finished. Streams and files sum in this order.
    """
    stride, k_in_stride = k // n_stride, k % n_stride
    if k_in_stride == 0:
        for j in range(len(increments)):
            unfinished[stride % SPAN, j] = 0.0
    for age in range(SPAN):
        slot = (stride - age) % SPAN
        weight = row_weight(age * n_stride + k_in_stride, n_stride, peak)
        for j in range(len(increments)):
            unfinished[slot, j] += weight * increments[j]


@kernel
def _integrate(
    increments: Any, n_stride: int, peak: float, present: Any, unfinished: Any, values: Any, is_whole: Any
) -> None:
    """Write the rows (r, c) of `increments` (c, n), and flag those without a missing sample; others are zeros.

    `present` (c,) is scratch; `unfinished` (SPAN, c) as in `add_to_rows`.
    """
    for k in range((len(values) + SPAN - 1) * n_stride if len(values) else 0):
        for j in range(len(increments)):
            present[j] = increments[j, k]
        add_to_rows(unfinished, present, k, n_stride, peak)
        row = k // n_stride - SPAN + 1
        if k % n_stride == n_stride - 1 and row >= 0:
            for j in range(values.shape[1]):
                is_whole[row] &= abs(unfinished[row % SPAN, j]) < MAX_READING  # False for NaN
            for j in range(values.shape[1]):
                values[row, j] = unfinished[row % SPAN, j] if is_whole[row] else 0.0


_stride = stride_samples(1e4)  # at a rate [Hz] at which `OVERLAP` has converged
_phi = np.array([row_weight(k, _stride, 1.0) for k in range(SPAN * _stride)])
#: Variance of a sum over overlapping rows of white noise, relative to independent rows.
OVERLAP = 1.0 + 2.0 * sum(
    float(_phi[k * _stride :] @ _phi[: -k * _stride]) / float(_phi @ _phi) for k in range(1, SPAN)
)


def weak_form_rows(increments: Sequence[Array], rate: float) -> Rows:
    """Compute the rows of a regression in weak form: the integrals of c columns, weighted by each test function.

    `increments`: for each column its increments (n,) between samples, NaN where missing; `rate`: sampling rate [Hz].
    Each test function gives one row if it lies within the samples. A row with a missing sample, or with an integral
    beyond `MAX_READING`, is of zeros and not `whole`.
    """
    n_stride, columns = stride_samples(rate), np.stack(increments)
    n_rows = max(0, columns.shape[1] // n_stride - SPAN + 1)
    values, is_whole = np.zeros((n_rows, len(increments))), np.ones(n_rows, dtype=bool)
    present, unfinished = np.empty(len(increments)), np.zeros((SPAN, len(increments)))
    _integrate(columns, n_stride, peak_weight(rate), present, unfinished, values, is_whole)
    time = (np.arange(n_rows, dtype=float) + 0.5 * SPAN) * n_stride / rate
    return Rows(time, values, is_whole)


def weights_near_holes(holes: Array, rate: float) -> Array:
    """Compute the weight (r,) of each row: the fraction of its test function outside of holes, 0 below `MIN_WEIGHT`.

    `holes` (n,): 1 for a sample in a hole, a long gap of missing samples that was filled in, else 0; `rate`: sampling
    rate [Hz].
    """
    # length [s] of each sampling interval that touches a hole, else 0; the sum of these lengths, weighted by a test
    # function of integral 1, is the fraction of the function in holes
    hole_time = np.maximum(holes[1:], holes[:-1]) / rate
    weights = 1.0 - weak_form_rows([hole_time], rate).values[:, 0]
    return np.where(weights < MIN_WEIGHT, 0.0, np.minimum(weights, 1.0))  # at most 1, but for rounding
