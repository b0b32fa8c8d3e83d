"""Wavelet details d_1 .. d_levels of a complete signal, by PyWavelets, and the filters of a wavelet.

The thesis's "db8 details" are those of the stationary (a trous) transform, with unit l2 norm in each level: white noise
of standard deviation sigma has the RMS sigma in every level.

Numeric arguments are checked here for all of `signals`.
"""

from __future__ import annotations

from dataclasses import dataclass
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


#: Quantities of a chamber pressure: its details to level 4, and the sample product of the third and the fourth.
QUANTITIES = ("d1", "d2", "d3", "d4", "d3d4")
#: Mode of PyWavelets by which a signal is continued beyond its ends: its mirror image.
_PADDING = "symmetric"


@dataclass(frozen=True, eq=False)
class Details:
    """The wavelet details of one signal; each level has the signal's length and unit.

    ``details[3]`` is d_3.

    Attributes
    ----------
    values : array, (levels, n)
        The details; row 0 is d_1.
    edges : array, (levels, 2)
        Number of samples at the beginning and at the end of each level that can depend on padding.
    """

    values: Array
    edges: IntArray

    @property
    def levels(self) -> int:
        """Number of levels of the wavelet transform."""
        return int(self.values.shape[0])

    def __getitem__(self, level: int) -> Array:
        """Return the detail d_j (n,) of the level j, from 1, the finest, to `levels`; raise InputError for others."""
        return np.asarray(self.values[self._find_row(level)])

    def _find_row(self, level: int) -> int:
        """Find the row of a level in `values` and `edges`; raise InputError if there is no such level."""
        if not 1 <= level <= self.levels:
            raise InputError(f"level must be 1 to {self.levels}, got {level!r}")
        return level - 1

    def product(self) -> Array:
        """Compute the product (n,) of the details d_3 and d_4 of each sample [unit^2], called d3d4 in the thesis."""
        return self[3] * self[4]

    def quantities(self) -> Array:
        """Stack d1, d2, d3, d4 [unit] and d3d4 [unit^2] as the rows of an array (5, n); there must be four levels."""
        return np.vstack([self.values, self.product()])

    def inside(self, level: int | None = None) -> slice:
        """Return the slice of the samples whose details of a `level` (default: all levels) do not depend on padding.

        Raises InputError for a level that is not 1 to `levels`.
        """
        # the deepest level has the longest edges
        before, after = self.edges[-1 if level is None else self._find_row(level)]
        return slice(int(before), self.values.shape[1] - int(after))


def min_samples(wavelet: str = "db8", levels: int = 4) -> int:
    """Compute the length of the shortest signal in which each level has a sample that does not depend on padding.

    It is 226 samples for db8 to level 4.
    """
    deepest_reach = reach(wavelet, levels)[-1]  # the largest of all levels
    return int(deepest_reach.sum()) + 1


def find_inside(n_samples: int, wavelet: str = "db8", levels: int = 4) -> slice:
    """Return the slice of a signal's samples whose details do not depend on padding; InputError for a shorter signal.

    The shortest signal has `min_samples`.
    """
    needed = min_samples(wavelet, levels)
    if n_samples < needed:
        raise InputError(
            f"signal must have at least {needed} samples for {levels} levels of {wavelet}, got {n_samples}"
        )
    before, after = reach(wavelet, levels)[-1]
    return slice(int(before), n_samples - int(after))


def details(signal: ArrayLike, *, wavelet: str = "db8", levels: int = 4) -> Details:
    """Compute the stationary wavelet details d_1 .. d_levels of a `signal` (n,), all at its length and sampling times.

    Let g and h be the wavelet's decomposition filters, high-pass and low-pass, with L taps each. Then
    ``a_0 = signal, d_j[n] = sum_k g[k] a_(j-1)[n + 2^(j-1)(L/2 - k)]``, and a_j is the same with h in place of g
    (`reach` gives the support of each level). Beyond its ends the signal is continued by its mirror image;
    `Details.inside` excludes the samples that depend on this padding.

    The alignment is that of PyWavelets: the energy of a pulse appears 5, 7, 9 and 13 samples early in db8's d_1 .. d_4.
    A causal system knows d_j of sample n only at sample ``n + (L/2)(2^j - 1)``, for db8 8, 24, 56, 120 samples later.

    Raises InputError for a signal that is not finite and one-dimensional or is shorter than `min_samples`, for an
    unknown wavelet, and for invalid levels. Source: "Understanding Effect and Diagnosis of Internal Leakage in
    Hydrostatic Actuation Systems", chapter 5; Mallat, A Wavelet Tour of Signal Processing, 3rd ed. (2009), section
    5.2.2; PyWavelets `swt(norm=False)`.
    """
    levels = require_levels(levels)
    x = require_finite(signal, ndim=1)
    find_inside(x.size, wavelet, levels)
    return Details(_atrous_details(x, discrete_wavelet(wavelet), levels), reach(wavelet, levels))


def mean_squares(transformed: Details, bounds: ArrayLike) -> Array:
    """Compute the mean squares (k, 5) of d1, d2, d3, d4 [unit^2] and d3d4 [unit^4] in segments of a transformed signal.

    `bounds` (k + 1,): segment i has the samples bounds[i] to bounds[i + 1] - 1. The signal must have four levels.
    """
    quantities = (*transformed.values, transformed.product())  # squared one by one, as they are long
    return np.concatenate([segment_means(np.square(quantity)[None], bounds) for quantity in quantities]).T


def segment_means(values: Array, bounds: ArrayLike) -> Array:
    """Compute the means (r, k) of `values` (r, n) in k segments.

    `bounds` (k + 1,), increasing: segment i has the columns bounds[i] to bounds[i + 1] - 1.
    """
    limits = np.asarray(bounds)
    sums = np.add.reduceat(values, limits[:-1], axis=1)
    # reduceat sums the last segment to the end of the row, not to its limit
    sums[:, -1] = values[:, limits[-2] : limits[-1]].sum(axis=1)
    return np.asarray(sums / np.diff(limits))


def _atrous_details(x: Array, wavelet: Any, levels: int) -> Array:
    """Compute the stationary details (levels, n), d_1 first, of a signal x (n,) with a `pywt.Wavelet`."""
    import pywt

    before, after = (int(samples) for samples in reach(wavelet.name, levels)[-1])
    # swt is periodic: padding at least as long as the filters' reach keeps the wrapped samples away from the signal
    after += -(x.size + before + after) % 2**levels  # swt needs a multiple of 2^levels samples
    padded = pywt.pad(x, (before, after), _PADDING)
    _, *deepest_first = pywt.swt(padded, wavelet, level=levels, trim_approx=True, norm=False)
    values = np.empty((levels, x.size))
    for row in values:  # frees each detail before the next is copied
        row[:] = deepest_first.pop()[before : before + x.size]
    return values
