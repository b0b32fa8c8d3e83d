"""Averages of a signal over a time around each sample, with missing samples left out."""

from __future__ import annotations

import numpy as np

from sealscope.signals.filters import Array

#: Smallest number that is divided by.
TINY = 1e-300


def average_over(seconds: float, values: Array, rate: float) -> Array:
    """Average the known values (n,) over a window of `seconds` [s] around each sample, which removes noise and ripple.

    `rate`: sampling rate [Hz]. The result (n,) is NaN where no value in the window is known.
    """
    from scipy.ndimage import uniform_filter1d

    size, is_known = max(1, round(seconds * rate)), np.isfinite(values)
    if is_known.all():
        return np.asarray(uniform_filter1d(values, size))
    fraction = uniform_filter1d(is_known.astype(float), size)
    average = uniform_filter1d(np.where(is_known, values, 0.0), size)
    return np.where(fraction * size > 0.5, average / np.maximum(fraction, TINY), np.nan)
