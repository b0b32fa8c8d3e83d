"""The distribution of p_A - p_B over a block, without what its sensors add: a zero may be taken off it afterwards.

Means over `SMOOTHED` seconds hide how a stiff circuit rings, and samples hold noise. In each stride of the weak form
the samples' deviations from these means, of variance v, are taken times sqrt(max(v - s^2, 0) / v); s^2, the variance
of white noise, is that of the sixth differences over 924, the sum of their squared coefficients.
"""

from __future__ import annotations

import math

import numpy as np

from sealscope.diagnosis.inference.rows.weak_form import stride_samples
from sealscope.recordings.recording import Array

#: Equal parts of a block's distribution whose means are kept, and the time over which the pressure is averaged [s].
PARTS, SMOOTHED = 9, 0.025
#: Order of the differences that leave noise alone.
_ORDER = 6


def distribution(pressure: Array, rate: float) -> Array:
    """Return the means of `PARTS` equal parts of the samples of a pressure [Pa], in rising order; zeros without any.

    Parameters
    ----------
    pressure : array of float, shape (n,)
        Samples, NaN where missing; what remains of whole strides of the weak form is left out.
    rate : float
        Sampling rate [Hz].
    """
    piece, stride = max(1, round(SMOOTHED * rate)), min(stride_samples(rate), max(len(pressure), 1))
    pieces = stride // piece
    strides = pressure[: len(pressure) // stride * stride].reshape(-1, stride)[:, : pieces * piece]
    parts = strides.reshape(-1, pieces, piece)
    mean = parts.mean(axis=2, keepdims=True)
    deviation = parts - mean
    if piece > 1:
        differences = np.diff(pressure, _ORDER)
        differences = differences[np.isfinite(differences)]
        energy = math.comb(2 * _ORDER, _ORDER)  # sum of the squared coefficients
        noise = float((differences**2).sum()) / max(len(differences), 1) / energy  # the same bits in any thread
        variance = np.nansum(deviation**2, axis=(1, 2), keepdims=True) / (pieces * (piece - 1))
        deviation *= np.sqrt(1.0 - noise / np.maximum(variance, max(noise, np.finfo(float).tiny)))
    values = (mean + deviation).ravel()
    values = np.sort(values[np.isfinite(values)])
    ends, sums = np.linspace(0.0, len(values), PARTS + 1), np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(np.diff(np.interp(ends, np.arange(len(sums)), sums)) * (PARTS / max(len(values), 1)))
