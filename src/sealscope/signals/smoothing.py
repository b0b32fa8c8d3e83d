"""Averages of a signal over a time around each sample, with missing samples left out."""

from __future__ import annotations

import numpy as np

from sealscope.signals.filters import Array

#: Smallest divisor, which avoids a division by 0.
TINY = 1e-300


def average_over(seconds: float, values: Array, rate: float, *, in_place: bool = False) -> Array:
    """Average a signal (..., n) over a window of `seconds` [s] around each sample, to remove noise and ripple.

    `values`: the signal, NaN where a sample is missing; `rate` [Hz]: sampling rate. A mean is over the known samples of
    its window, and NaN if there are none. Beyond its ends the signal is continued by its mirror image. `in_place`: True
    if `values` (n,) are no longer needed, and may hold the result.
    """
    from scipy.ndimage import uniform_filter1d

    size = max(1, round(seconds * rate))
    is_known = np.isfinite(values)
    if is_known.all():
        return np.asarray(uniform_filter1d(values, size, output=values if in_place else None))
    fraction = uniform_filter1d(is_known.astype(float), size)
    average = uniform_filter1d(np.where(is_known, values, 0.0), size)
    has_known_value = fraction * size > 0.5  # `fraction` * `size` is the number of known values, up to rounding
    return np.where(has_known_value, average / np.maximum(fraction, TINY), np.nan)
