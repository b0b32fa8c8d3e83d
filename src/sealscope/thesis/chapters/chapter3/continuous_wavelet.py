"""The continuous wavelet transform of a record with an orthogonal wavelet, eqs. (3.4)-(3.6), by its exact spectrum."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.recording import Array

_OCTAVES = 24


def _filters(wavelet: str) -> tuple[Array, Array]:
    from sealscope.signals.filters import discrete_wavelet

    chosen = discrete_wavelet(wavelet)
    return np.array(chosen.rec_lo, dtype=np.float64), np.array(chosen.rec_hi, dtype=np.float64)


def _response(taps: Array, omega: Array) -> np.ndarray:
    """Frequency response sum_k taps_k exp(-j omega k), of the shape of `omega`."""
    return np.asarray(np.polynomial.polynomial.polyval(np.exp(-1j * omega), taps))


def wavelet_spectrum(omega: Array, wavelet: str = "db8") -> np.ndarray:
    """Fourier transform of the mother wavelet at `omega` [rad per unit of its own time], of the shape of `omega`.

    Psi(w) = G(w/2)/sqrt(2) prod_(j>=2) H(w/2^j)/sqrt(2), with H and G the synthesis filters' responses; unit l2 norm.
    Source: Daubechies, Ten Lectures on Wavelets (1992), eqs. (5.1.17), (6.2.2).
    """
    low, high = _filters(wavelet)
    product = _response(high, omega / 2.0) / np.sqrt(2.0)
    for octave in range(2, _OCTAVES):
        product = product * _response(low, omega / 2.0**octave) / np.sqrt(2.0)
    return np.asarray(product)


def wavelet_centre(wavelet: str = "db8") -> tuple[float, float]:
    """Centre of the mother wavelet in its own time (of |psi|^2), and the frequency [1 per unit of its own time] at
    which its spectrum is greatest."""
    from sealscope.signals.filters import discrete_wavelet

    _, psi, t = discrete_wavelet(wavelet).wavefun(level=10)
    omega = np.linspace(0.1, 12.0, 12000)
    peak = omega[np.abs(wavelet_spectrum(omega, wavelet)).argmax()]
    return float(np.sum(t * psi**2) / np.sum(psi**2)), float(peak / (2.0 * np.pi))


def scales_for(frequencies: Array, wavelet: str = "db8") -> Array:
    """Scales a [s] whose wavelet is strongest at `frequencies` [Hz]."""
    return np.asarray(wavelet_centre(wavelet)[1] / np.asarray(frequencies, dtype=np.float64))


def continuous_transform(x: Array, rate: float, scales: Array, wavelet: str = "db8") -> Array:
    """CWT(a, b) of the samples `x` (n,) at `rate` [Hz] for each scale a [s], (scales, n) [unit of x times s^0.5].

    CWT(a, b) = integral of x(t) |a|^(-1/2) psi((t - b)/a) dt, eqs. (3.4), (3.6), with the sum over samples as the
    integral. b is the middle of the wavelet (the centre of its energy). The record is mirrored at its ends.
    """
    reach = int(np.ceil(16.0 * float(np.max(scales)) * rate))
    pad = min(x.size - 1, reach)
    padded = np.pad(x - x.mean(), pad, mode="symmetric")
    omega = 2.0 * np.pi * np.fft.rfftfreq(padded.size, 1.0 / rate)
    spectrum = np.fft.rfft(padded)
    centre, _ = wavelet_centre(wavelet)
    rows = np.empty((len(scales), x.size))
    for k, a in enumerate(scales):
        atom = np.sqrt(a) * wavelet_spectrum(a * omega, wavelet) * np.exp(1j * a * omega * centre)
        rows[k] = np.fft.irfft(spectrum * np.conj(atom), padded.size)[pad : pad + x.size]
    return rows


def inverse_gain(frequencies: Array, wavelet: str = "db8", weight: float = 2.0, scales: Array | None = None) -> Array:
    """Gain at `frequencies` [Hz] of transforming by eq. (3.4) and going back with the measure da db / |a|^weight.

    gain(w) = integral over a > 0 of a^(1 - weight) |Psi(a w)|^2 da; with weight 2 it is the same at every frequency
    (the wavelet's admissibility constant), and dividing by it gives the signal back. Eq. (3.5) is printed with
    weight 0, whose gain falls as 1/w^2. `scales` [s], default 12 decades about the frequencies.
    """
    omega = 2.0 * np.pi * np.asarray(frequencies, dtype=np.float64)
    middle = float(np.exp(np.mean(np.log(omega))))
    a = np.geomspace(1e-3, 1e3, 12000) / middle if scales is None else scales
    gains = [
        np.trapezoid(a ** (1.0 - weight) * np.abs(wavelet_spectrum(a * one, wavelet)) ** 2 * a, np.log(a))
        for one in omega
    ]
    return np.array(gains)
