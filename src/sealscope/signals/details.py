"""Wavelet details d_1 .. d_levels of a complete signal, by PyWavelets.

The thesis's "db8 details" are those of the stationary (a trous) transform, with unit l2 norm in each level: white noise
of standard deviation sigma has the RMS sigma in every level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.filters import Array, IntArray, discrete_wavelet, reach, require_finite, require_levels

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
