"""The distribution of p_A - p_B over a block, without what its sensors add: a zero may be taken off it afterwards.

Means over `SMOOTHED` seconds hide how a stiff circuit rings, and samples hold noise. In each stride of the weak form
the samples' deviations from these means, of variance v, are taken times sqrt(max(v - s^2, 0) / v); s^2, the variance
of white noise, is that of the sixth differences over 924, the sum of their squared coefficients.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import kernel
from sealscope.diagnosis.inference.weak_form import stride_samples
from sealscope.recordings.recording import Array

#: Equal parts of a block's distribution whose means are kept, and the time over which the pressure is averaged [s].
PARTS, SMOOTHED = 9, 0.025
#: Sum of the squared coefficients of the sixth differences, which leave noise alone.
_ENERGY = 924.0
_TINY = float(np.finfo(float).tiny)


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
    values = np.sort(_without_noise(np.ascontiguousarray(pressure), stride, piece))
    ends, sums = np.linspace(0.0, len(values), PARTS + 1), np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(np.diff(np.interp(ends, np.arange(len(sums)), sums)) * (PARTS / max(len(values), 1)))


@kernel
def _without_noise(pressure: Any, stride: int, piece: int) -> Any:
    """Return the known samples of whole strides without their noise."""
    square, differences = 0.0, 0
    for i in range(len(pressure) - 6 if piece > 1 else 0):
        difference = pressure[i] + pressure[i + 6] - 6.0 * (pressure[i + 1] + pressure[i + 5])
        difference += 15.0 * (pressure[i + 2] + pressure[i + 4]) - 20.0 * pressure[i + 3]
        if math.isfinite(difference):
            square += difference**2
            differences += 1
    noise, pieces, count = square / max(differences, 1) / _ENERGY, stride // piece, 0
    values, means = np.empty(len(pressure)), np.empty(pieces)
    for begin in range(0, len(pressure) - stride + 1, stride):
        variance = 0.0
        for j in range(pieces):
            first = begin + j * piece
            means[j] = 0.0
            for k in range(first, first + piece):
                means[j] += pressure[k] / piece
            if math.isfinite(means[j]):
                for k in range(first, first + piece):
                    variance += (pressure[k] - means[j]) ** 2
        share = 1.0
        if piece > 1:
            share = math.sqrt(1.0 - noise / max(variance / (pieces * (piece - 1)), noise, _TINY))
        for j in range(pieces):
            if math.isfinite(means[j]):
                for k in range(begin + j * piece, begin + (j + 1) * piece):
                    values[count] = means[j] + share * (pressure[k] - means[j])
                    count += 1
    return values[:count]
