"""What the instruments add to the pressures that no machine does: narrow lines of hum, and channels read in turn.

A line is seen in the residual of a model, since the motion itself is a comb of lines; it is found by how far it stands
out of its neighbourhood, at whatever frequency, so that harmonics and their aliases are lines of their own. The
chambers ring against each other, so the phase between p_A and -p_B grows with frequency by the skew of their channels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: Length of the segments of the averaged spectrum [s], and half the width of a line in it, in bins of 1 / length.
SEGMENT, _HALF_WIDTH = 20.0, 3
#: A line stands out of the median, and of the largest, of its neighbours within this distance [Hz] by these factors.
_NEAR, _OVER_MEDIAN, _OVER_LARGEST = 2.0, 8.0, 6.0
#: ... and of its neighbours by this factor where it may be a harmonic of the duty: that near to a multiple of 1 / cycle
#: [Hz], for cycles up to this length [s]. Longer ones make a comb so dense that no line of it stands alone.
_ON_COMB, _COMB_WIDTH, _LONGEST_CYCLE = 50.0, 0.03, 4.0
#: Most lines that are taken out, and the lowest frequency of one [Hz]: below, the motion itself is narrow.
_MOST_LINES, _LOWEST = 20, 15.0
#: A line's amplitude and phase may change over this width (Gaussian, standard deviation) [s]: mains wander.
_STEADY = 4.0
#: Length of the segments and range of frequencies [s, Hz] in which the chambers are compared, and largest skew [s].
_COMPARED, _LOW, _HIGH, LARGEST_SKEW = 2.0, 4.0, 150.0, 5e-3
#: Share of the rate above which nothing rings.
_QUIET = 0.35
#: Coherence from which a frequency counts, distance from the median beyond which it does not [s], largest error [s],
#: and fewest frequencies that carry the weight.
_COHERENT, _OUTLYING, _SURE, _FEWEST = 0.1, 1e-3, 1e-4, 5.0


def _spectra(channels: Sequence[Array], rate: float, seconds: float) -> tuple[Array, NDArray[np.complex128]]:
    """Return frequencies [Hz] and spectra (channels, segments, frequencies) of half overlapping segments."""
    length = min(round(seconds * rate), channels[0].size)
    parts = np.array(
        [np.lib.stride_tricks.sliding_window_view(each, length)[:: max(1, length // 2)] for each in channels]
    )
    parts -= parts.mean(axis=-1, keepdims=True)
    parts *= np.hanning(length)
    return np.asarray(np.fft.rfftfreq(length, 1.0 / rate), dtype=np.float64), np.fft.rfft(parts)


def line_frequencies(residual: Array, rate: float, cycle: float | None = None) -> Array:
    """Return the frequencies (m,) [Hz] of the narrow lines in a residual (n,), strongest first.

    `cycle` [s] of the duty, None where it does not repeat: what a model misses of the motion, a leak above all, lies at
    its harmonics.
    """
    frequency, spectra = _spectra([residual], rate, SEGMENT)
    power = np.sum(np.abs(spectra[0]) ** 2, axis=0)
    reach = round(_NEAR / frequency[1])
    candidates = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])) + 1
    candidates = candidates[frequency[candidates] >= _LOWEST]
    lines: list[float] = []
    known = np.zeros(power.size, dtype=bool)
    for k in candidates[np.argsort(-power[candidates])][: 4 * _MOST_LINES]:
        around = np.abs(np.arange(power.size) - k)
        beside = power[(around <= reach) & (around > _HALF_WIDTH) & np.logical_not(known)]
        if beside.size < reach or len(lines) == _MOST_LINES:
            continue
        # the vertex of the parabola through the logarithms of three bins (a Gaussian main lobe)
        left, middle, right = np.log(power[k - 1 : k + 2])
        line = float(frequency[1] * (k + 0.5 * (left - right) / (left - 2.0 * middle + right)))
        harmonic = (
            cycle is not None and cycle <= _LONGEST_CYCLE and abs(line - round(line * cycle) / cycle) < _COMB_WIDTH
        )
        factor = _ON_COMB if harmonic else _OVER_LARGEST
        if power[k] > _OVER_MEDIAN * np.median(beside) and power[k] > factor * beside.max():
            lines.append(line)
            known[around <= _HALF_WIDTH] = True
    return np.array(lines)


def lines_in(residual: Array, rate: float, cycle: float | None = None) -> Array:
    """Return the sum of the narrow lines in a residual (n,) under a duty of that cycle [s].

    Each is ``2 Re(e(t) exp(i w t))`` with the envelope e of residual exp(-i w t), smoothed by a Gaussian.
    """
    from scipy.ndimage import gaussian_filter1d

    total = np.zeros(residual.size)
    # envelopes are slow: they are formed from means over a tenth of a second
    block = max(1, round(0.1 * rate))
    whole = residual.size // block * block
    t = np.arange(residual.size) / rate
    middles = (np.arange(whole // block) + 0.5) * block - 0.5
    for frequency in line_frequencies(residual, rate, cycle):
        turn = np.exp(-2j * np.pi * frequency * t)
        means = ((residual - total) * turn)[:whole].reshape(-1, block).mean(axis=1)
        envelope = gaussian_filter1d(means, _STEADY / (block / rate), mode="nearest")
        total += 2.0 * np.real(np.interp(np.arange(residual.size), middles, envelope) * np.conj(turn))
    return total


def skew(p_A: Array, p_B: Array, rate: float) -> float:
    """Return by how much p_B (n,) is read later than p_A (n,) [s].

    The weighted mean of ``arg(-S_AB) / (2 pi f)`` over the frequencies near its weighted median, with the weight f^2
    c / (1 - c) of coherence c; lines of hum, where the phase is anything, weigh as their neighbours do. 0 where the
    scatter leaves it uncertain by more than 0.1 ms, or it is beyond `LARGEST_SKEW`.
    """
    frequency, (of_A, of_B) = _spectra([p_A, p_B], rate, _COMPARED)
    cross = np.sum(of_A * np.conj(of_B), axis=0)
    own_A, own_B = (np.sum(np.abs(each) ** 2, axis=0) for each in (of_A, of_B))
    # noise that both channels share is in phase and white: what is left of it where nothing rings any more
    cross = cross - max(0.0, float(np.median(np.real(cross[frequency > _QUIET * rate]))))
    here = (frequency >= _LOW) & (frequency <= min(_HIGH, 0.4 * rate))
    coherence = np.clip(np.abs(cross[here]) ** 2 / np.maximum(own_A[here] * own_B[here], 1e-300), 0.0, 0.8)
    late = np.angle(-cross[here]) / (2.0 * np.pi * frequency[here])
    odds = np.where(coherence > _COHERENT, coherence / (1.0 - coherence), 0.0)
    neighbours = np.lib.stride_tricks.sliding_window_view(np.pad(odds, 5, mode="reflect"), 11)
    weight = frequency[here] ** 2 * np.minimum(odds, 2.0 * np.median(neighbours, axis=1))
    if not np.any(weight > 0.0):
        return 0.0
    order = np.argsort(late)
    total = np.cumsum(weight[order])
    middle = float(late[order][np.searchsorted(total, 0.5 * total[-1])])
    near = np.where(np.abs(late - middle) < _OUTLYING, weight, 0.0)
    mean = float(near @ late / near.sum())
    error = float(np.sqrt(np.sum((near * (late - mean)) ** 2)) / near.sum())
    several = near.sum() ** 2 > _FEWEST * np.sum(near**2) and near.sum() > 0.5 * weight.sum()
    certain = several and error < _SURE and abs(mean) <= LARGEST_SKEW
    return mean if certain else 0.0


def advanced(values: Array, seconds: float, rate: float) -> Array:
    """Return a channel (n,) that many seconds earlier, by the phases of its spectrum; its ends are mirrored."""
    if seconds == 0.0:
        return values
    reach = min(values.size - 1, round(0.2 * rate))
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    spectrum = np.fft.rfft(padded) * np.exp(2j * np.pi * np.fft.rfftfreq(padded.size, 1.0 / rate) * seconds)
    return np.asarray(np.fft.irfft(spectrum, padded.size)[reach : reach + values.size])
