"""The distribution of p_A - p_B over a block, from which a sensor offset may be subtracted afterwards.

Means over pieces of `SMOOTHED` seconds hide the ringing of a stiff circuit, but single samples contain noise. Therefore
the samples' deviations from these means are reduced. If their variance is v, estimated separately in each stride of the
weak form from its pieces without a missing sample, they are multiplied by sqrt(max(v - s^2, 0) / v). The variance of
white noise is s^2 = (mean square of the sixth differences of all samples) / 924, where 924 is the sum of the squared
coefficients of such a difference.
"""

from __future__ import annotations

import math

import numpy as np

from sealscope.diagnosis.inference.rows.weak_form import stride_samples
from sealscope.recordings.recording import Array

#: Number of equal parts of the sorted samples.
PARTS = 9
#: Averaging time of the pressure [s].
SMOOTHED = 0.025
#: Order of the differences that remove the signal and leave the noise.
_ORDER = 6


def sorted_part_means(pressure: Array, rate: float) -> Array:
    """Summarise the distribution of a pressure by the means of `PARTS` equal parts of its sorted samples [Pa].

    The spread due to white noise is removed first (see the module). `pressure` (n,): samples [Pa] at the sampling
    `rate` [Hz], NaN where missing, for at least `SMOOTHED` seconds. Only whole pieces within whole strides of the weak
    form count, without a missing sample; less than a stride counts as one. The means (PARTS,) are zeros if no piece
    counts.
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
        squares = np.nansum(deviation**2, axis=(1, 2), keepdims=True)
        variance = squares / (np.maximum(n_complete, 1) * (piece - 1))
        min_variance = max(noise_variance, np.finfo(float).tiny)  # a smaller variance is all noise: the factor is 0
        deviation *= np.sqrt(1.0 - noise_variance / np.maximum(variance, min_variance))
    values = (mean + deviation).ravel()
    values = np.sort(values[np.isfinite(values)])
    # sum of each part from the cumulative sum, interpolated where a part ends between two samples
    part_ends, cumulative_sums = np.linspace(0.0, len(values), PARTS + 1), np.concatenate([[0.0], np.cumsum(values)])
    part_sums = np.diff(np.interp(part_ends, np.arange(len(cumulative_sums)), cumulative_sums))
    return np.asarray(part_sums * (PARTS / max(len(values), 1)))
