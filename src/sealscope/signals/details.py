"""Wavelet details d_1 .. d_levels of a whole signal, by PyWavelets.

Three readings of the thesis's "db8 details" are offered. They differ in length, in the scale of the levels and in how
white noise of standard deviation sigma looks in them:

===============  ======================================================  ====================================
transform        what d_j is                                             RMS of white noise
===============  ======================================================  ====================================
`stationary`     a trous transform, unit l2 norm per level (default)     sigma in every level
`decimated`      Mallat's transform, each coefficient held 2^j samples   sigma in every level
`reconstructed`  what the d_j alone give back; all of them sum up to x   sigma 2^(-j/2): d_2/d_1 = 0.71
===============  ======================================================  ====================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from sealscope.errors import InputError
from sealscope.signals.filters import Array, IntArray, checked_levels, discrete_wavelet, finite_array, reach

#: What is measured of a chamber's pressure: its details to level 4, and the sample product of the third and the fourth.
QUANTITIES = ("d1", "d2", "d3", "d4", "d3d4")
Transform = Literal["stationary", "decimated", "reconstructed"]
Edge = Literal["symmetric", "periodic", "reflect", "constant", "zero", "smooth", "antisymmetric", "antireflect"]


@dataclass(frozen=True, eq=False)
class Details:
    """The details of one signal, each level at the signal's own length and in the signal's unit.

    `values`: (levels, n), row 0 is d_1; `approximation`: (n,), what the deepest level leaves over; `edges`: (levels,
    2), how many samples at the beginning and at the end of each level were computed with padding and not with the
    signal alone. ``details[3]`` is d_3.
    """

    values: Array
    approximation: Array
    edges: IntArray

    @property
    def levels(self) -> int:
        """The number of levels."""
        return int(self.values.shape[0])

    def __getitem__(self, level: int) -> Array:
        """d_level, (n,), edges included."""
        if not 1 <= level <= self.levels:
            raise InputError(f"level must be 1 to {self.levels}, got {level!r}")
        return np.asarray(self.values[level - 1])

    def product(self) -> Array:
        """Compute the sample product d_3 d_4, (n,) [unit^2], edges included: the thesis's d3d4."""
        return self[3] * self[4]

    def quantities(self) -> Array:
        """Stack d1..d4 [unit] and d3d4 [unit^2] of details to level 4, (5, n), edges included (`QUANTITIES`)."""
        return np.vstack([self.values, self.product()])

    def inside(self, level: int | None = None) -> slice:
        """Find the samples that do not touch the padding at a level, by default the deepest and so at any."""
        before, after = self.edges[(level or self.levels) - 1]
        return slice(int(before), self.values.shape[1] - int(after))


def edge_samples(wavelet: str = "db8", levels: int = 4, transform: Transform = "stationary") -> IntArray:
    """Count the samples at the beginning and the end of each level that touch the padding, (levels, 2).

    Stationary: the filters' reach. Decimated: from sample ``2^j ceil(2 before_j / 2^j) - before_j`` the first held
    coefficient that saw no padding. Reconstructed: analysis and synthesis together reach ``(L - 1)(2^j - 1)`` to both
    sides.
    """
    _one_of(transform, Transform, "transform")
    stationary = reach(wavelet, levels)
    if transform == "stationary":
        return stationary
    if transform == "decimated":
        step = 2 ** np.arange(1, levels + 1, dtype=np.int64)
        before = -(-2 * stationary[:, 0] // step) * step - stationary[:, 0]
        return np.stack([before, stationary[:, 1]], axis=1)
    both = stationary.sum(axis=1)
    return np.stack([both, both], axis=1)


def shortest(wavelet: str = "db8", levels: int = 4, transform: Transform = "stationary") -> int:
    """Compute the fewest samples that leave each level one free of padding; db8 to level 4 needs 226."""
    return int(edge_samples(wavelet, levels, transform)[-1].sum()) + 1


def details(
    signal: ArrayLike,
    *,
    wavelet: str = "db8",
    levels: int = 4,
    transform: Transform = "stationary",
    edge: Edge = "symmetric",
) -> Details:
    """Compute the wavelet details d_1 .. d_levels of `signal`, (n,), all at its length and on its time base.

    ``a_0 = signal, d_j[n] = sum_k g[k] a_(j-1)[n + 2^(j-1)(L/2 - k)]``, a_j the same with h (stationary; `reach` says
    how far each level looks). This is PyWavelets' alignment; the energy of an event stands 5, 7, 9 and 13 samples
    early in db8's d_1 .. d_4 (5 in every decimated level, 0 in every reconstructed one). A causal system has d_j of
    sample n when sample ``n + (L/2)(2^j - 1)`` has arrived, for db8 8, 24, 56 and 120 samples later. `edge` says what
    the signal is taken to be beyond its ends; reports drop the samples that saw it (`Details.inside`).

    Raises InputError for a signal that is not finite and one-dimensional or is shorter than `shortest`, and for an
    unknown wavelet, transform or edge. Source: "Understanding Effect and Diagnosis of Internal Leakage in Hydrostatic
    Actuation Systems", chapter 5; Mallat, A Wavelet Tour of Signal Processing, 3rd ed. (2009), sections 5.2.2 and
    7.3; PyWavelets `swt(norm=False)`, `wavedec`, `waverec`.
    """
    _one_of(edge, Edge, "edge")
    levels = checked_levels(levels)
    x = finite_array(signal, ndim=1)
    needed = shortest(wavelet, levels, transform)
    if x.size < needed:
        raise InputError(
            f"signal must have at least {needed} samples for {levels} {transform} levels of {wavelet}, got {x.size}"
        )
    compute = {"stationary": _stationary, "decimated": _decimated, "reconstructed": _reconstructed}[transform]
    values, approximation = compute(x, discrete_wavelet(wavelet), levels, edge)
    return Details(values, approximation, edge_samples(wavelet, levels, transform))


def mean_squares(transformed: Details, bounds: ArrayLike) -> Array:
    """Compute the mean squares of the `QUANTITIES` between consecutive samples `bounds`, (len(bounds) - 1, 5)."""
    return segment_means(np.square(transformed.quantities()), bounds).T


def segment_means(values: Array, bounds: ArrayLike) -> Array:
    """Compute the means of rows (r, n) between consecutive samples `bounds`, (r, len(bounds) - 1)."""
    begin = np.asarray(bounds)
    sums = np.add.reduceat(values, begin[:-1], axis=1)
    sums[:, -1] = values[:, begin[-2] : begin[-1]].sum(axis=1)
    return np.asarray(sums / np.diff(begin))


def _one_of(value: object, choices: Any, name: str) -> None:
    allowed = get_args(choices)
    if value not in allowed:
        raise InputError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")


def _stationary(x: Array, wavelet: Any, levels: int, edge: Edge) -> tuple[Array, Array]:
    import pywt

    before, after = (int(samples) for samples in reach(wavelet.name, levels)[-1])
    # swt wraps around: with the padding at least as long as the filters' reach, what wraps never meets the signal
    after += -(x.size + before + after) % 2**levels
    padded = pywt.pad(x, (before, after), edge)
    approximation, *deepest_first = pywt.swt(padded, wavelet, level=levels, trim_approx=True, norm=False)
    inside = slice(before, before + x.size)
    return np.array([detail[inside] for detail in reversed(deepest_first)]), approximation[inside].copy()


def _decimated(x: Array, wavelet: Any, levels: int, edge: Edge) -> tuple[Array, Array]:
    import pywt

    approximation, *deepest_first = pywt.wavedec(x, wavelet, mode=edge, level=levels)
    before = [0, *reach(wavelet.name, levels)[:, 0].tolist()]

    def hold(coefficients: Array, level: int) -> Array:
        # coefficient o is the stationary detail at sample 2^j o - before_j
        return np.repeat(coefficients, 2**level)[before[level] : before[level] + x.size]

    values = [hold(coefficients, level) for level, coefficients in enumerate(reversed(deepest_first), start=1)]
    return np.array(values), hold(approximation, levels)


def _reconstructed(x: Array, wavelet: Any, levels: int, edge: Edge) -> tuple[Array, Array]:
    import pywt

    coefficients = pywt.wavedec(x, wavelet, mode=edge, level=levels)

    def reconstruct_level(place: int) -> Array:
        single = [c if i == place else np.zeros_like(c) for i, c in enumerate(coefficients)]
        return np.asarray(pywt.waverec(single, wavelet, mode=edge), dtype=np.float64)[: x.size]

    return np.array([reconstruct_level(place) for place in range(levels, 0, -1)]), reconstruct_level(0)
