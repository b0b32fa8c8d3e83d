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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: Distance of neighbouring test functions [s] and its minimum [samples]; how many distances a test function spans.
STRIDE, MIN_STRIDE = 0.125, 2
SPAN = 4
#: Weight below which a row next to holes is omitted.
MIN_WEIGHT = 0.1
#: Limit of integrals that count as readings of a sensor: squares of larger ones might overflow.
MAX_READING = 1e100


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
def test_function(rate: float) -> Array:
    """Compute the test function phi [1/s], bell-shaped with the integral 1, in the middle of each sampling interval.

    `rate`: sampling rate [Hz]. The result has the shape (SPAN, stride): each row is the part of the test function over
    one stride of samples.
    """
    stride = stride_samples(rate)
    s = (np.arange(SPAN * stride) + 0.5) * 2.0 / (SPAN * stride) - 1.0  # -1 to 1 over the support
    phi = (1.0 - s * s) ** 4
    # stored by columns: BLAS reads the transpose fastest
    return np.asfortranarray((phi * (rate / phi.sum())).reshape(SPAN, stride))


_phi = test_function(1e4).ravel()  # at a rate [Hz] at which `OVERLAP` has converged
_stride = len(_phi) // SPAN
#: Variance of a sum over overlapping rows of white noise, relative to independent rows.
OVERLAP = 1.0 + 2.0 * sum(
    float(_phi[k * _stride :] @ _phi[: -k * _stride]) / float(_phi @ _phi) for k in range(1, SPAN)
)


def weak_form_rows(increments: Sequence[Array], rate: float) -> Rows:
    """Compute the rows of a regression in weak form: the integrals of c columns, weighted by each test function.

    `increments`: for each column its increments (n,) between samples, NaN where missing; `rate`: sampling rate [Hz].
    Each test function spans `SPAN` pieces of samples as long as the distance of neighbouring ones (`stride_samples`),
    and gives one row if it lies within the samples. A piece with a missing sample, or with integrals beyond
    `MAX_READING`, counts as zeros, and its rows are not `whole`.
    """
    stride = stride_samples(rate)
    n_pieces = len(increments[0]) // stride
    n_rows = max(0, n_pieces - SPAN + 1)
    pieces = np.concatenate([increment[: n_pieces * stride] for increment in increments]).reshape(-1, stride)
    # integrals of each column over each piece, times each of the SPAN parts of the test function
    integrals: Array = (pieces @ test_function(rate).T).reshape(len(increments), n_pieces, SPAN)
    is_usable = np.asarray((np.abs(integrals) < MAX_READING).all(axis=(0, 2)))  # False for NaN
    integrals[:, ~is_usable] = 0.0
    values: Array = np.zeros((n_rows, len(increments)))
    is_whole = np.ones(n_rows, dtype=bool)
    for part in range(SPAN):  # row i is the sum over the pieces i + part
        values += integrals[:, part : part + n_rows, part].T
        is_whole &= is_usable[part : part + n_rows]
    time = (np.arange(n_rows, dtype=float) + 0.5 * SPAN) * stride / rate
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
