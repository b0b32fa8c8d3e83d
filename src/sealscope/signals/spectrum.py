"""Power spectra of signals, averaged over segments.

`scipy.signal` computes the same, but its import takes as long as a short diagnosis. Called by the fit of the
pressures' ringing. Source: P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70.
"""

from __future__ import annotations

import numpy as np

from sealscope.signals.details import Array


def average_power(values: Array, segment: int, n_fft: int) -> Array:
    """Average the power density of signals over half-overlapping segments, by Welch's method with a Hann window.

    Parameters
    ----------
    values : ndarray of float, shape (k, n)
        The signals, of `segment` samples or more.
    segment : int
        Samples of a segment.
    n_fft : int
        Samples to which segments are padded with zeros, even.

    Returns
    -------
    ndarray of float, shape (k, n_fft // 2 + 1)
        One-sided power density at the frequencies k / n_fft cycles per sample.
    """
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi / segment * np.arange(segment))
    segments = np.lib.stride_tricks.sliding_window_view(values, segment, axis=-1)[..., :: segment - segment // 2, :]
    power = np.zeros((len(values), n_fft // 2 + 1))
    for place in range(segments.shape[1]):
        power += np.abs(np.fft.rfft(segments[:, place] * window, n_fft)) ** 2
    power[..., 1:-1] *= 2.0
    return np.asarray(power / (segments.shape[1] * (window @ window)))
