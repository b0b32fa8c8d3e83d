"""Chapter 3: Fourier, short-time Fourier and wavelet transforms of a signal (Figs. 3.2-3.4, eqs. 3.2-3.6)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import discrete_wavelet
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters.chapter4.cases import visible_pressure
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Figure, FigureCurve, Image, Number, Panel, Role
from sealscope.thesis.engine.texts import format_note, judge_claim

#: Sampling rate [Hz] of the signals of this chapter; the thesis gives none.
RATE = 1000.0
#: Frequency [Hz] and amplitude of the two components of eq. (3.3).
TONES = ((100.0, 1.0), (30.0, 0.5))
WAVELET = "db8"
#: Command of the simulated pressures, and the largest mean leak of Appendix C with it.
_COMMAND, _LEAK = "3 sin(4t)", "0.0163 L/min"
#: Onset of the leak, end of the start-up, and length of the blocks in which an rms is computed [s].
_ONSET, _SETTLED, _BLOCK = 10.0, 1.0, 0.05
#: Octave before which the infinite product of the wavelet's spectrum is cut; it has converged there.
_N_FACTORS = 24


class WaveletCentre(NamedTuple):
    """Centre of a wavelet: of its energy in `time` [samples at scale 1], of its response in `frequency` [1/sample]."""

    time: float
    frequency: float


def mother_wavelet() -> tuple[Array, Array, Array]:
    """Compute scaling function, mother wavelet and time [samples] of db8, (n,) each, by the cascade algorithm."""
    phi, psi, t = discrete_wavelet(WAVELET).wavefun(level=10)  # 2^10 values per sample
    return phi, psi, t


def wavelet_spectrum(omega: Array) -> np.ndarray:
    """Compute the Fourier transform Psi of the mother wavelet db8 at `omega` [rad per sample at scale 1].

    Psi(w) = G(w/2)/sqrt(2) prod_(j>=2) H(w/2^j)/sqrt(2). H and G are the frequency responses sum_k taps_k exp(-i w k)
    of the low-pass and of the high-pass synthesis filter. The wavelet has unit l2 norm. Source: Daubechies, Ten
    Lectures on Wavelets (1992), eqs. (5.1.17), (6.2.2).
    """

    def response(taps: list[float], omega: Array) -> np.ndarray:
        """Compute the frequency response of a filter with the coefficients `taps`."""
        return np.asarray(np.polynomial.polynomial.polyval(np.exp(-1j * omega), np.array(taps, dtype=np.float64)))

    filters = discrete_wavelet(WAVELET)
    product = response(filters.rec_hi, omega / 2.0) / np.sqrt(2.0)
    for octave in range(2, _N_FACTORS):
        product = product * response(filters.rec_lo, omega / 2.0**octave) / np.sqrt(2.0)
    return np.asarray(product)


def wavelet_centre() -> WaveletCentre:
    """Compute the centre of db8 in time, weighted by |psi|^2, and in frequency, the peak of its spectrum |Psi|."""
    _, psi, t = mother_wavelet()
    omega = np.linspace(0.1, 12.0, 12000)  # [rad per sample], around the peak
    peak = omega[np.abs(wavelet_spectrum(omega)).argmax()]
    return WaveletCentre(float(np.sum(t * psi**2) / np.sum(psi**2)), float(peak / (2.0 * np.pi)))


def scales_for(frequencies: Array) -> Array:
    """Compute the scales f_c/f [s] for `frequencies` f [Hz], with f_c the centre frequency of db8 at scale 1."""
    return np.asarray(wavelet_centre().frequency / np.asarray(frequencies, dtype=np.float64))


def continuous_transform(x: Array, rate: float, scales: Array) -> Array:
    """Compute the continuous wavelet transform of samples `x` (n,) at `rate` [Hz] for `scales` a [s].

    CWT(a, b) = integral of x(t) |a|^(-1/2) psi((t - b)/a) dt, eqs. (3.4), (3.6). The mean of x is subtracted, and the
    record is mirrored at its ends. Returns the transform (scales, n) [unit of x times s^0.5]; the centre of the
    wavelet's energy is at each sample in turn.
    """
    # db8 is 15 samples long at scale 1; 16 leaves a margin. The mirror images are shorter than the record
    pad = min(x.size - 1, int(np.ceil(16.0 * float(np.max(scales)) * rate)))
    padded = np.pad(x - x.mean(), pad, mode="symmetric")
    omega = 2.0 * np.pi * np.fft.rfftfreq(padded.size, 1.0 / rate)
    spectrum = np.fft.rfft(padded)
    centre = wavelet_centre().time
    rows = np.empty((len(scales), x.size))
    for k, a in enumerate(scales):
        # spectrum of the wavelet at scale a, moved so that its middle is at the time 0
        atom = np.sqrt(a) * wavelet_spectrum(a * omega) * np.exp(1j * a * omega * centre)
        correlation = np.fft.irfft(spectrum * np.conj(atom), padded.size)
        rows[k] = correlation[pad : pad + x.size]  # without the mirrored ends
    return rows


def inverse_gain(frequencies: Array, weight: float = 2.0) -> Array:
    """Compute the gain, at `frequencies` [Hz], of the wavelet transform (3.4) followed by its inverse.

    The inverse integrates with da db / |a|^weight: gain(w) = integral over a > 0 of a^(1 - weight) |Psi(a w)|^2 da,
    with w = 2 pi f and Psi the spectrum of db8. With weight 2 the gain is the same at all frequencies (the wavelet's
    admissibility constant). With weight 0, as in eq. (3.5), it falls as 1/w^2.
    """
    omega = 2.0 * np.pi * np.asarray(frequencies, dtype=np.float64)
    geometric_mean = float(np.exp(np.mean(np.log(omega))))
    a = np.geomspace(1e-3, 1e3, 12000) / geometric_mean  # six decades of scales around the frequencies
    # da = a d(ln a)
    gains = [np.trapezoid(a ** (1.0 - weight) * np.abs(wavelet_spectrum(a * w)) ** 2 * a, np.log(a)) for w in omega]
    return np.array(gains)


def two_tone_signal(t: Array) -> Array:
    """Compute the sum of two tones x(t) = cos(2 pi 100 t) + 0.5 sin(2 pi 30 t), eq. (3.3), at times t [s]."""
    return np.asarray(np.cos(2.0 * np.pi * 100.0 * t) + 0.5 * np.sin(2.0 * np.pi * 30.0 * t))


def amplitude_spectrum(x: Array, rate: float) -> tuple[Array, Array, Array]:
    """Compute the cosines whose sum is the signal `x` (n,), sampled at `rate` [Hz], from its DFT, eq. (3.2).

    Returns their frequencies [Hz], amplitudes, and phases [degree].
    """
    spectrum = np.asarray(np.fft.rfft(x), dtype=np.complex128) * (2.0 / x.size)
    # 2: half of a cosine's amplitude is at its negative frequency; mean and Nyquist frequency have no such half
    spectrum[0] /= 2.0
    if x.size % 2 == 0:
        spectrum[-1] /= 2.0
    frequency = np.asarray(np.fft.rfftfreq(x.size, 1.0 / rate), dtype=np.float64)
    return frequency, np.abs(spectrum), np.degrees(np.angle(spectrum))


def short_time_spectrum(x: Array, rate: float, window: int, step: int) -> tuple[Array, Array, Array]:
    """Compute the amplitudes of the cosines in successive Hann windows of `x` (n,), sampled at `rate` [Hz].

    `window`, `step`: length of a window, and distance to the next [samples]. Returns the middles of the windows [s],
    the frequencies [Hz], and the amplitudes (frequencies, windows).
    """
    starts = np.arange(0, x.size - window + 1, step)
    hann = np.hanning(window + 1)[:-1]  # periodic: the last value is the first of the next period
    segments = np.lib.stride_tricks.sliding_window_view(x, window)[starts] * hann
    # 2: half of a cosine's amplitude is at its negative frequency; mean and Nyquist frequency have no such half,
    # and come out doubled
    amplitudes = np.abs(np.fft.rfft(segments, axis=1)).T * 2.0 / hann.sum()
    frequency = np.asarray(np.fft.rfftfreq(window, 1.0 / rate), dtype=np.float64)
    middles = np.asarray((starts + window / 2.0) / rate, dtype=np.float64)
    return middles, frequency, np.asarray(amplitudes)


def nearest_index(values: Array, target: float) -> int:
    """Return the index of the element of `values` that is nearest to `target`."""
    return int(np.abs(values - target).argmin())


def two_tone_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 3.2: the signal of eq. (3.3) and its amplitude spectrum; `context` is not used."""
    t = np.arange(round(RATE)) / RATE
    x = two_tone_signal(t)
    frequency, amplitude, phase = amplitude_spectrum(x, RATE)
    tone_indices = {tone: nearest_index(frequency, tone) for tone, _ in TONES}
    numbers = []
    for tone, k in tone_indices.items():
        numbers.append(Number(f"amplitude at {tone:g} Hz", float(amplitude[k])))
        numbers.append(Number(f"phase at {tone:g} Hz (cosine 0)", float(phase[k]), "deg"))
    elsewhere = np.delete(amplitude, list(tone_indices.values()))
    numbers.append(Number("largest amplitude elsewhere", float(elsewhere.max())))
    beginning = t < 0.2  # [s]
    lines = amplitude > 1e-6  # smaller amplitudes are rounding errors
    signal = FigureCurve(t[beginning], x[beginning], "x(t), eq. 3.3", "reference")
    spectrum = FigureCurve(frequency[lines], amplitude[lines], "2 |X[n]| / N, eq. 3.2", "reference", "stems")
    x_range = (0.0, 150.0)
    panels = (
        Panel("t [s]", "x(t) [1]", (signal,), "(a) Signal"),
        Panel("frequency [Hz]", "amplitude [1]", (spectrum,), "(b) Amplitude spectrum", x_range=x_range),
    )
    return (item.figure(panels, numbers, notes=format_note("two-tones")),)


def wavelet_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 3.3: mother wavelet and scaling function of db8; `context` is not used."""
    phi, psi, t = mother_wavelet()
    step = float(t[1] - t[0])
    panels = (
        Panel("t [samples]", "psi(t) [1]", (FigureCurve(t, psi, "psi(t)", "reference"),), "(a) Mother wavelet"),
        Panel("t [samples]", "phi(t) [1]", (FigureCurve(t, phi, "phi(t)", "other"),), "(b) Scaling function"),
    )
    numbers = (
        Number("integral of psi", float(psi.sum() * step)),
        Number("integral of psi squared", float((psi**2).sum() * step)),
        Number("integral of phi", float(phi.sum() * step)),
        Number("length of both", float(t[-1] - t[0]), "samples"),
        Number("vanishing moments", float(vanishing_moments(psi, t))),
        Number("frequency of the largest response", wavelet_centre().frequency, "1/sample"),
    )
    return (item.figure(panels, numbers, notes=format_note("db8")),)


def vanishing_moments(psi: Array, t: Array) -> int:
    """Count the vanishing moments of a wavelet `psi` (n,) over the time `t` (n,), at most 20.

    These are the integrals of t^k psi(t), k = 0, 1, ..., before the first that differs from 0 by more than rounding.
    """
    k = 0
    centred = t - t.mean()  # smaller powers, the same number of vanishing moments
    while k < 20 and abs(np.sum(centred**k * psi)) < 1e-6 * np.sum(np.abs(centred**k * psi)):
        k += 1
    return k


def transform_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 3.4: a signal in time, its spectrum, its short-time Fourier transform and its wavelet transform.

    The signal is the tone of 100 Hz of eq. (3.3) before 0.5 s, its tone of 30 Hz after, and a pulse of one sample and
    height 8 at 0.75 s. `context` is not used.
    """
    t = np.arange(round(RATE)) / RATE
    x = np.where(t < 0.5, np.cos(2.0 * np.pi * 100.0 * t), 0.5 * np.sin(2.0 * np.pi * 30.0 * t))
    x[nearest_index(t, 0.75)] += 8.0
    frequency, amplitude, _ = amplitude_spectrum(x, RATE)
    window = 128  # [samples]
    times, bins, short_time = short_time_spectrum(x, RATE, window, step=4)
    frequencies = np.geomspace(10.0, 450.0, 64)
    wavelet = np.abs(continuous_transform(x, RATE, scales_for(frequencies)))
    signal = FigureCurve(t, x, "x(t)", "reference")
    spectrum = FigureCurve(frequency, amplitude, "2 |X[n]| / N", "reference")
    axes = "t [s]", "frequency [Hz]"
    short_time_title = f"(c) Short-time Fourier transform, window {window / RATE * 1e3:g} ms"
    wavelet_image = Image(t, frequencies, wavelet, "|CWT| [s^0.5]")
    panels = (
        Panel("t [s]", "x(t) [1]", (signal,), "(a) Time"),
        Panel("frequency [Hz]", "amplitude [1]", (spectrum,), "(b) Frequency"),
        Panel(*axes, title=short_time_title, image=Image(times, bins, short_time, "amplitude [1]")),
        Panel(*axes, title="(d) Wavelet transform, db8", image=wavelet_image, log_y=True),
    )
    pulse = (t > 0.6) & (t < 0.9)  # [s]
    high = nearest_index(frequencies, 300.0)  # [Hz], where the tones do not hide the pulse
    numbers = (
        Number("resolution in frequency of (b)", RATE / x.size, "Hz"),
        Number("resolution in frequency of (c)", RATE / window, "Hz"),
        Number("width of the pulse at 300 Hz in (c)", _width(times, short_time[nearest_index(bins, 300.0)]), "s"),
        Number("width of the pulse at 300 Hz in (d)", _width(t[pulse], wavelet[high][pulse]), "s"),
    )
    return (item.figure(panels, numbers, notes=format_note("four-views")),)


def _width(t: Array, values: Array) -> float:
    """Compute the width [s] of the largest peak: deviation of the times within 0.1 s of it, weighted by `values`^2."""
    near_peak = np.abs(t - t[values.argmax()]) < 0.1  # [s]
    weight = values[near_peak] ** 2 / np.sum(values[near_peak] ** 2)
    centre = np.sum(t[near_peak] * weight)
    return float(np.sqrt(np.sum((t[near_peak] - centre) ** 2 * weight)))


def scalogram_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the wavelet transform of the simulated pressure p_A, which rings, before and after a leak opens.

    The panels are the pressure, the rms of its transform in blocks of 0.05 s, with and without the noise of the
    instruments, and the rms of the latter before and after the leak opens.
    """
    run = context.run(Experiment.of(command=_COMMAND, duration=20.0, leak=f"{_LEAK} from {_ONSET:g} s"))
    t = run.recorded.t
    rate = 1.0 / float(t[1] - t[0])
    frequencies = np.geomspace(12.0, 0.45 * rate, 64)  # [Hz], to below the Nyquist frequency
    recorded, noise_free = run.recorded["p_A"] * 1e-6, run.outputs["p_A"] * 1e-6
    leak = ((_ONSET, "leak"),)
    panels = [Panel("t [s]", "p_A [MPa]", (FigureCurve(t, recorded, "p_A, recorded", "A"),), "(a) Record", leak)]
    for letter, p_A, name in (("b", recorded, "as recorded"), ("c", noise_free, "without the instruments' noise")):
        transform = continuous_transform(p_A, rate, scales_for(frequencies))
        middles, block_rms = _running_rms(t, transform, round(_BLOCK * rate))
        image = Image(middles, frequencies, block_rms * 1e3, "rms of CWT [kPa s^0.5]")
        title = f"({letter}) CWT(a, b), db8, {name}"
        panels.append(Panel("t [s]", "frequency [Hz]", title=title, marks=leak, image=image, log_y=True))
    parts: dict[Role, np.ndarray] = {"no leak": (t > _SETTLED) & (t < _ONSET), "leak": t >= _ONSET}
    # `transform` is now the last one, without noise
    part_rms = {role: np.sqrt(np.mean(transform[:, part] ** 2, axis=1)) * 1e3 for role, part in parts.items()}
    curves = tuple(FigureCurve(frequencies, values, role, role) for role, values in part_rms.items())
    panels.append(Panel("frequency [Hz]", "rms of CWT [kPa s^0.5]", curves, "(d) rms of (c) over time", log_x=True))
    above_30_hz = frequencies > 30.0  # at lower frequencies the motion has peaks
    ring = int(np.flatnonzero(above_30_hz)[part_rms["no leak"][above_30_hz].argmax()])
    numbers = (
        Number("frequency of the ringing", float(frequencies[ring]), "Hz"),
        Number("rms at the ringing, leak / no leak", float(part_rms["leak"][ring] / part_rms["no leak"][ring])),
        Number("mean leak", run.mean_leak_lpm, "L/min"),
    )
    notes = format_note("scalogram", command=_COMMAND, onset=_ONSET, block=_BLOCK)
    return (item.figure(panels, numbers, run.resolved, notes),)


def _running_rms(t: Array, rows: Array, size: int) -> tuple[Array, Array]:
    """Compute mean time [s] and rms (rows, blocks) of `rows` (rows, n) in successive whole blocks of `size` samples."""
    n_used = t.size // size * size
    block_rms = np.sqrt(np.mean(rows[:, :n_used].reshape(rows.shape[0], -1, size) ** 2, axis=2))
    return t[:n_used].reshape(-1, size).mean(axis=1), block_rms


def judge_claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 3.1 to 3.6 on transforms, the wavelet db8, and leaks in the pressures; `item` is not used."""
    return (*_fourier_claims(), *_wavelet_claims(), _leak_claim(context))


def _fourier_claims() -> Iterator[Claim]:
    """Judge claims 3.1 and 3.2: the spectrum of eq. (3.3) has the two stated lines and no other; both have phase 0."""
    t = np.arange(round(RATE)) / RATE
    frequency, amplitude, phase = amplitude_spectrum(two_tone_signal(t), RATE)
    tones = [nearest_index(frequency, tone) for tone, _ in TONES]
    elsewhere = np.delete(amplitude, tones).max()
    error = np.abs(amplitude[tones] - [height for _, height in TONES]).max()
    high, low = amplitude[tones]
    yield judge_claim("3.1", [error < 1e-6, elsewhere < 1e-6], high=high, low=low, elsewhere=elsewhere)
    high, low = phase[tones]
    yield judge_claim("3.2", np.abs(phase[tones]) < 1e-3, high=high, low=low)


def _wavelet_claims() -> Iterator[Claim]:
    """Judge claims 3.3 to 3.5 on the wavelet db8.

    3.3: its mean is 0. 3.4: its energy is 1, also when scaled by eq. (3.6). 3.5: the transform and its inverse as
    printed in eq. (3.5) have the same gain at 30 and at 100 Hz, within 1 %.
    """
    _, psi, t = mother_wavelet()
    step = float(t[1] - t[0])
    mean, energy = float(psi.sum() * step), float((psi**2).sum() * step)
    moments, peak = vanishing_moments(psi, t), wavelet_centre().frequency
    yield judge_claim("3.3", [abs(mean) < 1e-9], length=t[-1] - t[0], mean=mean, moments=moments, peak=peak)
    scaled_energies = []
    for a in (0.5, 2.0, 10.0):  # |a|^(-1/2) psi(t/a), eq. (3.6)
        scaled_t = np.arange(0.0, a * t[-1], a * step)
        scaled_energies.append(float(np.sum((a**-0.5 * np.interp(scaled_t / a, t, psi)) ** 2) * a * step))
    tests = [abs(value - 1.0) < 1e-3 for value in (energy, *scaled_energies)]
    yield judge_claim("3.4", tests, energy=energy, scaled=", ".join(f"{value:.4f}" for value in scaled_energies))
    gains = (inverse_gain(np.array([30.0, 100.0]), weight) for weight in (2.0, 0.0))  # proper, and as printed
    (proper_at_30, proper_at_100), (printed_at_30, printed_at_100) = gains
    proper_ratio, printed_ratio = proper_at_30 / proper_at_100, printed_at_30 / printed_at_100
    is_constant = abs(printed_ratio - 1.0) < 0.01
    yield judge_claim("3.5", [is_constant], printed=printed_ratio, proper=proper_ratio, constant=proper_at_30)


def _leak_claim(context: Context) -> Claim:
    """Judge claim 3.6: a leak lowers mean, peak and range of both pressures by more than a transducer's noise."""
    experiments = (Experiment.of(command=_COMMAND, duration=40.0, leak=leak) for leak in (None, _LEAK))
    healthy, leaking = (context.run(experiment, prove=False) for experiment in experiments)
    is_settled = healthy.t > 10.0  # [s]
    statistics = (np.mean, np.max, np.ptp)  # mean, peak and range
    changes = {
        name: [float(f(leaking.outputs[name][is_settled]) - f(healthy.outputs[name][is_settled])) for f in statistics]
        for name in CHAMBERS
    }
    text = "{}: mean {:+.0f} Pa, peak {:+.0f} Pa, range {:+.0f} Pa"
    texts = [text.format(name, *shifts) for name, shifts in changes.items()]
    tests = [shift < -visible_pressure() for shifts in changes.values() for shift in shifts]
    return judge_claim("3.6", tests, leak=leaking.mean_leak_lpm, moved="; ".join(texts))
