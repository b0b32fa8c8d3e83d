"""Averages of a signal over a time around each sample, with missing samples left out; quantiles of short blocks.

Quantiles and medians are the numbers of NumPy's functions, at a fraction of their time.
"""

from __future__ import annotations

import math

import numpy as np

from sealscope.signals.details import Array

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


def quantiles(values: Array, *fractions: float) -> Array:
    """Compute quantiles, 0 to 1, of values (..., n) without NaN over their last axis, shape (k, ...) for k `fractions`.

    A quantile lies between two of the sorted values, in proportion (definition 7). The result is NaN without values.
    Source: R. J. Hyndman and Y. Fan, The American Statistician 50 (1996) 361.
    """
    last = values.shape[-1] - 1
    if last < 0:
        return np.full((len(fractions), *values.shape[:-1]), np.nan)
    places = [last * fraction for fraction in fractions]
    lower = [math.floor(place) for place in places]
    ordered = np.partition(values, sorted({*lower, *(min(k + 1, last) for k in lower)}), axis=-1)
    results = np.empty((len(fractions), *values.shape[:-1]))
    for q, (place, k) in enumerate(zip(places, lower, strict=True)):
        below, above, share = ordered[..., k], ordered[..., min(k + 1, last)], place - k
        step = above - below
        results[q] = above - step * (1.0 - share) if share >= 0.5 else below + step * share
    return results


def medians(values: Array) -> Array:
    """Compute medians of values (..., n), n > 0 and none NaN, over their last axis."""
    lower, upper = (values.shape[-1] - 1) // 2, values.shape[-1] // 2
    ordered = np.partition(values, (lower, upper), axis=-1)
    return np.asarray(0.5 * (ordered[..., lower] + ordered[..., upper]))
