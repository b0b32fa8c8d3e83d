"""The filters of a wavelet and their reach in each level, and checks of numeric arguments."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sealscope.calls import suggestion
from sealscope.errors import InputError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Largest number of levels: one coefficient of db8 at level 12 depends on 61 000 samples.
MAX_LEVELS = 12


@cache
def _wavelet_names() -> list[str]:
    """List the names of all discrete wavelets of PyWavelets."""
    import pywt

    return list(pywt.wavelist(kind="discrete"))


def discrete_wavelet(name: str) -> Any:
    """Load the discrete wavelet of PyWavelets with this name; raise InputError if there is none."""
    import pywt

    if not isinstance(name, str) or name not in _wavelet_names():
        hint = suggestion(str(name), _wavelet_names())
        raise InputError(f"wavelet must be a discrete wavelet such as db8, got {name!r}{hint}")
    return pywt.Wavelet(name)


def decomposition_filters(wavelet: str = "db8") -> tuple[Array, Array]:
    """Return the low-pass filter h and the high-pass filter g that split a signal, each (taps,).

    The taps are in the order of a causal convolution. With a_0 the signal, the approximation of level j is ``a_j[n] =
    sum_k h[k] a_(j-1)[n - 2^(j-1) k]``, and its detail d_j the same with g. For an orthogonal wavelet both filters have
    unit l2 norm. Source: Daubechies, Ten Lectures on Wavelets (1992), Table 6.1, in PyWavelets.
    """
    filters = discrete_wavelet(wavelet)
    return np.array(filters.dec_lo, dtype=np.float64), np.array(filters.dec_hi, dtype=np.float64)


def require_levels(levels: int) -> int:
    """Return `levels` as an int if it is a whole number from 1 to 12 (`MAX_LEVELS`); raise InputError otherwise."""
    if isinstance(levels, bool) or not isinstance(levels, (int, np.integer)) or not 1 <= levels <= MAX_LEVELS:
        raise InputError(f"levels must be a whole number from 1 to {MAX_LEVELS}, got {levels!r}")
    return int(levels)


def reach(wavelet: str = "db8", levels: int = 4) -> IntArray:
    """Count the samples before and after a sample on which its detail depends, for each level, (levels, 2).

    Row j - 1 is for d_j, from the finest level j = 1 on: ``before_j = (L/2 - 1)(2^j - 1)`` and ``after_j = (L/2)(2^j -
    1)`` with L taps, in the alignment of PyWavelets. For db8: 7, 21, 49, 105 before and 8, 24, 56, 120 after.
    """
    half_length = int(discrete_wavelet(wavelet).dec_len) // 2
    # 2^j - 1 = 1 + 2 + ... + 2^(j-1): d_j passes the filters of levels 1 to j, whose taps are 2^(level-1) samples apart
    total_dilation = 2 ** np.arange(1, require_levels(levels) + 1, dtype=np.int64) - 1
    return np.stack([(half_length - 1) * total_dilation, half_length * total_dilation], axis=1)


def require_finite(values: ArrayLike, name: str = "signal", ndim: int | None = None) -> Array:
    """Convert `values` to an array of doubles; raise InputError unless they are real and finite.

    The array must have `ndim` dimensions, or at least one by default. `name` names the values in the error message.
    """
    try:
        array = np.asarray(values)
        if np.iscomplexobj(array) or array.dtype.kind in "SUMm":  # bytes, text, dates, time differences
            raise TypeError
        array = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be real numbers, got {type(values).__name__}") from None
    if array.ndim == 0 or (ndim is not None and array.ndim != ndim):
        dimensions = f"{ndim}-dimensional" if ndim else "at least one-dimensional"
        raise InputError(f"{name} must be {dimensions}, got shape {array.shape}")
    is_finite = np.isfinite(array)
    if not is_finite.all():
        first = tuple(int(i) for i in np.argwhere(~is_finite)[0])
        n_bad = int(array.size - np.count_nonzero(is_finite))
        sample = first[0] if array.ndim == 1 else first
        raise InputError(
            f"{name} must be finite, got {array[first]} at sample {sample} ({n_bad} of {array.size} samples)"
        )
    return array


def require_whole(value: object, name: str, least: int = 1, unit: str = "") -> int:
    """Return `value` as an int if it is a whole number >= `least`; raise InputError otherwise.

    The message states `name`, and the text `unit`, such as " sample", after the smallest number.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name} must be a whole number >= {least}{unit}, got {value!r}")
    return int(value)
