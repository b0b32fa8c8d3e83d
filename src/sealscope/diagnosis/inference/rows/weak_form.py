"""The weak form of a balance: rows of a linear regression from the samples, without a derivative and without a cycle.

A balance  dl = sum_j c_j f_j dg_j  is multiplied by test functions of compact support and integrated,

    integral of phi_i dl = sum_j c_j integral of phi_i f_j dg_j,    phi_i(t) = (1 - s^2)^4 / norm,  s = (t - t_i) / h,

one row for each test function, over the increments of each sampling interval. That is summation by parts of the form in
which every derivative stands on phi. phi and its first three derivatives vanish at its ends, so that noise and what a
row cuts off do not matter. Rows are `STRIDE` apart and overlap; any rate serves, and ten seconds are a short recording.

Sources: M. Shinbrot, Trans. ASME 79 (1957) 547 (modulating functions); H. A. Preisig and D. W. T. Rippin, Computers and
Chemical Engineering 17 (1993) 1; D. A. Messenger and D. M. Bortz, Multiscale Model. Simul. 19 (2021) 1474 (weak form).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: Distance of neighbouring test functions [s], and how many of these distances a test function spans.
STRIDE = 0.125
SPAN = 4
#: A row of which holes leave less tells nothing.
LEAST_WEIGHT = 0.1
#: Sums of increments beyond it are no values of a sensor: their squares would overflow.
LARGEST = 1e100


class Rows(NamedTuple):
    """Rows of a regression.

    `time` (r,) of each test function's middle [s]; `values` (r, c), one a column, over the test function's integral, so
    that a row is a mean rate; `whole` (r,): no sample it rests on is missing.
    """

    time: Array
    values: Array
    whole: NDArray[np.bool_]


def stride_samples(rate: float) -> int:
    """Return the samples between neighbouring test functions."""
    return max(1, round(STRIDE * rate))


@lru_cache(maxsize=8)
def test_function(rate: float) -> Array:
    """Return phi at the middle of each sampling interval of its support [1/s], shape (SPAN, stride)."""
    stride = stride_samples(rate)
    s = (np.arange(SPAN * stride) + 0.5) * 2.0 / (SPAN * stride) - 1.0
    phi = (1.0 - s * s) ** 4
    return np.asarray(phi * (rate / phi.sum())).reshape(SPAN, stride)


@lru_cache(maxsize=8)
def _weights(rate: float) -> Array:
    """Return the transpose of `test_function` as BLAS reads it fastest, shape (stride, SPAN)."""
    return np.ascontiguousarray(test_function(rate).T)


def _overlap() -> float:
    phi = test_function(1e4).ravel()
    stride, energy = len(phi) // SPAN, float(phi @ phi)
    return 1.0 + 2.0 * sum(float(phi[k * stride :] @ phi[: -k * stride]) / energy for k in range(1, SPAN))


#: Long-run variance of white noise in the rows over their variance, for overlapping rows repeat each other: the sum of
#: the test function's correlations with its neighbours.
OVERLAP = _overlap()


def rows(increments: Sequence[Array], rate: float, start: float = 0.0) -> Rows:
    """Return the rows of increments over sampling intervals.

    Parameters
    ----------
    increments : sequence of c arrays of float, shape (n,)
        Increments of each column over each sampling interval; NaN where a sample is missing.
    rate : float
        Sampling rate [Hz].
    start : float
        Time of the first sample [s].

    Returns
    -------
    Rows
        Every test function whose support lies within the samples: n // stride - SPAN + 1 rows.
    """
    stride = stride_samples(rate)
    pieces = len(increments[0]) // stride
    count = max(0, pieces - SPAN + 1)
    samples = np.concatenate([increment[: pieces * stride] for increment in increments]).reshape(-1, stride)
    parts: Array = (samples @ _weights(rate)).reshape(len(increments), pieces, SPAN)
    small = np.abs(parts) < LARGEST
    missing = np.zeros(pieces, dtype=bool) if small.all() else np.asarray(~small.all(axis=(0, 2)))
    parts[:, missing] = 0.0
    values: Array = np.zeros((count, len(increments)))
    touched = np.zeros(count, dtype=bool)
    for piece in range(SPAN):
        values += parts[:, piece : piece + count, piece].T
        touched |= missing[piece : piece + count]
    time: Array = start + (np.arange(count, dtype=float) + 0.5 * SPAN) * stride / rate
    return Rows(time, values, ~touched)


def weights_beside_holes(holes: Array, rate: float) -> Array:
    """Compute the weight of each row beside bridged holes, the share of its test function that lies in none.

    Parameters
    ----------
    holes : array of float, shape (n,)
        1 for a sample in a hole, else 0.
    rate : float
        Sampling rate [Hz].

    Returns
    -------
    array of float, shape (r,)
        1 for a row that no hole touches, falling to 0 for one that holes leave less than `LEAST_WEIGHT` of.
    """
    weights = 1.0 - rows([np.maximum(holes[1:], holes[:-1]) / rate], rate).values[:, 0]
    return np.where(weights < LEAST_WEIGHT, 0.0, np.minimum(weights, 1.0))
