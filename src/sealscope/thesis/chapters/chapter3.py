"""Chapter 3: Fourier, short-time Fourier and wavelet transforms of a signal (Figs. 3.2-3.4, eqs. 3.3-3.6)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.filters import discrete_wavelet
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters.chapter4.cases import visible_pressure
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Figure, FigureCurve, Image, Number, Panel, Role
from sealscope.thesis.engine.texts import judge_claim, note

#: Sampling rate [Hz] of the signals of this chapter; the thesis gives none.
RATE = 1000.0
#: Frequency [Hz] and amplitude of the two components of eq. (3.3).
TONES = ((100.0, 1.0), (30.0, 0.5))
WAVELET = "db8"
#: Command of the pressures that are looked at, and the largest mean leak among the tests at it.
_COMMAND, _LEAK = "3 sin(4t)", "0.0163 L/min"
_ONSET, _SETTLED, _BLOCK = 10.0, 1.0, 0.05
_OCTAVES = 24


def mother_wavelet() -> tuple[Array, Array, Array]:
    """Compute scaling function, mother wavelet and their time [samples] by the cascade of db8's filters."""
    phi, psi, t = discrete_wavelet(WAVELET).wavefun(level=10)
    return phi, psi, t


def wavelet_spectrum(omega: Array) -> np.ndarray:
    """Compute the Fourier transform of the mother wavelet at `omega` [rad per unit of its own time].

    Psi(w) = G(w/2)/sqrt(2) prod_(j>=2) H(w/2^j)/sqrt(2), with H and G the synthesis filters' responses
    sum_k taps_k exp(-j w k); unit l2 norm.
    Source: Daubechies, Ten Lectures on Wavelets (1992), eqs. (5.1.17), (6.2.2).
    """

    def response(taps: list[float], omega: Array) -> np.ndarray:
        return np.asarray(np.polynomial.polynomial.polyval(np.exp(-1j * omega), np.array(taps, dtype=np.float64)))

    filters = discrete_wavelet(WAVELET)
    product = response(filters.rec_hi, omega / 2.0) / np.sqrt(2.0)
    for octave in range(2, _OCTAVES):
        product = product * response(filters.rec_lo, omega / 2.0**octave) / np.sqrt(2.0)
    return np.asarray(product)


def wavelet_centre() -> tuple[float, float]:
    """Compute the centre of |psi|^2 in the wavelet's own time and the frequency [1 per unit] of its peak response."""
    _, psi, t = mother_wavelet()
    omega = np.linspace(0.1, 12.0, 12000)
    peak = omega[np.abs(wavelet_spectrum(omega)).argmax()]
    return float(np.sum(t * psi**2) / np.sum(psi**2)), float(peak / (2.0 * np.pi))


def scales_for(frequencies: Array) -> Array:
    """Compute the scales a [s] whose wavelet responds most at `frequencies` [Hz]."""
    return np.asarray(wavelet_centre()[1] / np.asarray(frequencies, dtype=np.float64))


def continuous_transform(x: Array, rate: float, scales: Array) -> Array:
    """Compute CWT(a, b) of samples `x` (n,) at `rate` [Hz] for scales a [s]: (scales, n) [unit of x times s^0.5].

    CWT(a, b) = integral of x(t) |a|^(-1/2) psi((t - b)/a) dt, eqs. (3.4), (3.6), with the sum over samples as the
    integral. b is the middle of the wavelet (the centre of its energy). The record is mirrored at its ends.
    """
    reach = int(np.ceil(16.0 * float(np.max(scales)) * rate))
    pad = min(x.size - 1, reach)
    padded = np.pad(x - x.mean(), pad, mode="symmetric")
    omega = 2.0 * np.pi * np.fft.rfftfreq(padded.size, 1.0 / rate)
    spectrum = np.fft.rfft(padded)
    centre, _ = wavelet_centre()
    rows = np.empty((len(scales), x.size))
    for k, a in enumerate(scales):
        atom = np.sqrt(a) * wavelet_spectrum(a * omega) * np.exp(1j * a * omega * centre)
        rows[k] = np.fft.irfft(spectrum * np.conj(atom), padded.size)[pad : pad + x.size]
    return rows


def inverse_gain(frequencies: Array, weight: float = 2.0) -> Array:
    """Compute the gain at `frequencies` [Hz] of eq. (3.4) and its inverse with the measure da db / |a|^weight.

    gain(w) = integral over a > 0 of a^(1 - weight) |Psi(a w)|^2 da, over 12 decades of scales about the frequencies.
    With weight 2 it is the same at every frequency (the wavelet's admissibility constant), and dividing by it gives
    the signal back. Eq. (3.5) is printed with weight 0, whose gain falls as 1/w^2.
    """
    omega = 2.0 * np.pi * np.asarray(frequencies, dtype=np.float64)
    middle = float(np.exp(np.mean(np.log(omega))))
    a = np.geomspace(1e-3, 1e3, 12000) / middle
    gains = [np.trapezoid(a ** (1.0 - weight) * np.abs(wavelet_spectrum(a * w)) ** 2 * a, np.log(a)) for w in omega]
    return np.array(gains)


def two_tone_signal(t: Array) -> Array:
    """Compute x(t) = cos(2 pi 100 t) + 0.5 sin(2 pi 30 t), eq. (3.3)."""
    return np.asarray(np.cos(2.0 * np.pi * 100.0 * t) + 0.5 * np.sin(2.0 * np.pi * 30.0 * t))


def amplitude_spectrum(x: Array, rate: float) -> tuple[Array, Array, Array]:
    """Compute frequencies [Hz], amplitudes and phases [degree, of a cosine] of real samples by the DFT of eq. (3.2)."""
    spectrum = np.asarray(np.fft.rfft(x), dtype=np.complex128) * (2.0 / x.size)
    spectrum[0] /= 2.0
    if x.size % 2 == 0:
        spectrum[-1] /= 2.0
    frequency = np.asarray(np.fft.rfftfreq(x.size, 1.0 / rate), dtype=np.float64)
    return frequency, np.abs(spectrum), np.degrees(np.angle(spectrum))


def short_time_spectrum(x: Array, rate: float, window: int, step: int) -> tuple[Array, Array, Array]:
    """Compute the windows' middles [s], frequencies [Hz] and amplitudes (frequencies, times) under a Hann window."""
    starts = np.arange(0, x.size - window + 1, step)
    shape = np.hanning(window + 1)[:-1]
    pieces = np.lib.stride_tricks.sliding_window_view(x, window)[starts] * shape
    values = np.abs(np.fft.rfft(pieces, axis=1)).T * 2.0 / shape.sum()
    frequency = np.asarray(np.fft.rfftfreq(window, 1.0 / rate), dtype=np.float64)
    return np.asarray((starts + window / 2.0) / rate, dtype=np.float64), frequency, np.asarray(values)


def nearest(values: Array, target: float) -> int:
    """Find the index of the value nearest to `target`."""
    return int(np.abs(values - target).argmin())


def two_tones(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 3.2: the signal of eq. (3.3) and its amplitude spectrum."""
    t = np.arange(round(RATE)) / RATE
    x = two_tone_signal(t)
    frequency, amplitude, phase = amplitude_spectrum(x, RATE)
    places = {tone: nearest(frequency, tone) for tone, _ in TONES}
    numbers = []
    for tone, k in places.items():
        numbers.append(Number(f"amplitude at {tone:g} Hz", float(amplitude[k])))
        numbers.append(Number(f"phase at {tone:g} Hz (cosine 0)", float(phase[k]), "deg"))
    numbers.append(Number("largest amplitude elsewhere", float(np.delete(amplitude, list(places.values())).max())))
    early, lines = t < 0.2, amplitude > 1e-6
    signal = FigureCurve(t[early], x[early], "x(t), eq. 3.3", "reference")
    spectrum = FigureCurve(frequency[lines], amplitude[lines], "2 |X[n]| / N, eq. 3.2", "reference", "stems")
    shown_range = (0.0, 150.0)
    panels = (
        Panel("t [s]", "x(t) [1]", (signal,), "(a) Signal"),
        Panel("frequency [Hz]", "amplitude [1]", (spectrum,), "(b) Amplitude spectrum", x_range=shown_range),
    )
    return (item.figure(panels, numbers, notes=note("two-tones")),)


def db8(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 3.3: mother wavelet and scaling function of db8, by the cascade of their filters."""
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
        Number("frequency of the largest response", wavelet_centre()[1], "1/sample"),
    )
    return (item.figure(panels, numbers, notes=note("db8")),)


def vanishing_moments(psi: Array, t: Array) -> int:
    """Count the moments integral of t^k psi(t) dt, k = 0, 1, ..., that are zero against the integral of |t^k psi|."""
    moments = 0
    centred = t - t.mean()
    while moments < 20 and abs(np.sum(centred**moments * psi)) < 1e-6 * np.sum(np.abs(centred**moments * psi)):
        moments += 1
    return moments


def four_views(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 3.4: one signal in time, in frequency, under a short-time Fourier and under a wavelet transform.

    The signal is the two tones of eq. (3.3) one after the other, 100 Hz before 0.5 s and 30 Hz after, and one sample of
    height 8 at 0.75 s.
    """
    t = np.arange(round(RATE)) / RATE
    x = np.where(t < 0.5, np.cos(2.0 * np.pi * 100.0 * t), 0.5 * np.sin(2.0 * np.pi * 30.0 * t))
    x[nearest(t, 0.75)] += 8.0
    frequency, amplitude, _ = amplitude_spectrum(x, RATE)
    window = 128
    times, bins, short = short_time_spectrum(x, RATE, window, 4)
    frequencies = np.geomspace(10.0, 450.0, 64)
    wavelet = np.abs(continuous_transform(x, RATE, scales_for(frequencies)))
    signal = FigureCurve(t, x, "x(t)", "reference")
    spectrum = FigureCurve(frequency, amplitude, "2 |X[n]| / N", "reference")
    of_time = "t [s]", "frequency [Hz]"
    by_window = f"(c) Short-time Fourier transform, window {window / RATE * 1e3:g} ms"
    by_wavelet = Image(t, frequencies, wavelet, "|CWT| [s^0.5]")
    panels = (
        Panel("t [s]", "x(t) [1]", (signal,), "(a) Time"),
        Panel("frequency [Hz]", "amplitude [1]", (spectrum,), "(b) Frequency"),
        Panel(*of_time, title=by_window, image=Image(times, bins, short, "amplitude [1]")),
        Panel(*of_time, title="(d) Wavelet transform, db8", image=by_wavelet, log_y=True),
    )
    pulse = (t > 0.6) & (t < 0.9)
    high = nearest(frequencies, 300.0)
    numbers = (
        Number("resolution in frequency of (b)", RATE / x.size, "Hz"),
        Number("resolution in frequency of (c)", RATE / window, "Hz"),
        Number("width of the pulse at 300 Hz in (c)", _width(times, short[nearest(bins, 300.0)]), "s"),
        Number("width of the pulse at 300 Hz in (d)", _width(t[pulse], wavelet[high][pulse]), "s"),
    )
    return (item.figure(panels, numbers, notes=note("four-views")),)


def _width(t: Array, values: Array) -> float:
    """Compute the rms half-width [s] of the energy of `values` about its middle, near its largest value."""
    near = np.abs(t - t[values.argmax()]) < 0.1
    weight = values[near] ** 2 / np.sum(values[near] ** 2)
    middle = np.sum(t[near] * weight)
    return float(np.sqrt(np.sum((t[near] - middle) ** 2 * weight)))


def pressure_scalogram(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw eqs. (3.4)-(3.6) on a simulated record of p_A: the ringing after each reversal, before and with a leak."""
    run = context.run(Experiment.of(command=_COMMAND, duration=20.0, leak=f"{_LEAK} from {_ONSET:g} s"))
    t = run.recorded.t
    rate = 1.0 / float(t[1] - t[0])
    frequencies = np.geomspace(12.0, 0.45 * rate, 64)
    recorded, clean = run.recorded["p_A"] * 1e-6, run.outputs["p_A"] * 1e-6
    leak = ((_ONSET, "leak"),)
    panels = [Panel("t [s]", "p_A [MPa]", (FigureCurve(t, recorded, "p_A, recorded", "A"),), "(a) Record", leak)]
    for letter, p_A, name in (("b", recorded, "as recorded"), ("c", clean, "without the instruments' noise")):
        rows = continuous_transform(p_A, rate, scales_for(frequencies))
        middles, power = _running_rms(t, rows, round(_BLOCK * rate))
        image = Image(middles, frequencies, power * 1e3, "rms of CWT [kPa s^0.5]")
        title = f"({letter}) CWT(a, b), db8, {name}"
        panels.append(Panel("t [s]", "frequency [Hz]", title=title, marks=leak, image=image, log_y=True))
    parts: tuple[tuple[Role, np.ndarray], ...] = (("no leak", (t > _SETTLED) & (t < _ONSET)), ("leak", t >= _ONSET))
    strength = {role: np.sqrt(np.mean(rows[:, part] ** 2, axis=1)) * 1e3 for role, part in parts}
    curves = tuple(FigureCurve(frequencies, strength[role], role, role) for role, _ in parts)
    panels.append(Panel("frequency [Hz]", "rms of CWT [kPa s^0.5]", curves, "(d) rms of (c) over time", log_x=True))
    fast = frequencies > 30.0
    ring = int(np.flatnonzero(fast)[strength["no leak"][fast].argmax()])
    numbers = (
        Number("frequency of the ringing", float(frequencies[ring]), "Hz"),
        Number("rms at the ringing, leak / no leak", float(strength["leak"][ring] / strength["no leak"][ring])),
        Number("mean leak", run.mean_leak_lpm, "L/min"),
    )
    notes = note("scalogram", command=_COMMAND, onset=_ONSET, block=_BLOCK)
    return (item.figure(panels, numbers, run.resolved, notes),)


def _running_rms(t: Array, rows: Array, size: int) -> tuple[Array, Array]:
    """Compute the middles [s] of blocks of `size` samples and the rms of each row in them, (rows, blocks)."""
    used = t.size // size * size
    power = np.sqrt(np.mean(rows[:, :used].reshape(rows.shape[0], -1, size) ** 2, axis=2))
    return t[:used].reshape(-1, size).mean(axis=1), power


def judge_claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 3.1 to 3.6."""
    return (*_fourier(), *_wavelet(), _leak(context))


def _fourier() -> Iterator[Claim]:
    t = np.arange(round(RATE)) / RATE
    frequency, amplitude, phase = amplitude_spectrum(two_tone_signal(t), RATE)
    tones = [nearest(frequency, tone) for tone, _ in TONES]
    elsewhere = np.delete(amplitude, tones).max()
    present = np.abs(amplitude[tones] - [height for _, height in TONES]).max() < 1e-6
    high, low = amplitude[tones]
    yield judge_claim("3.1", [present, elsewhere < 1e-6], high=high, low=low, elsewhere=elsewhere)
    high, low = phase[tones]
    yield judge_claim("3.2", np.abs(phase[tones]) < 1e-3, high=high, low=low)


def _wavelet() -> Iterator[Claim]:
    _, psi, t = mother_wavelet()
    step = float(t[1] - t[0])
    mean, energy = float(psi.sum() * step), float((psi**2).sum() * step)
    moments, peak = vanishing_moments(psi, t), wavelet_centre()[1]
    yield judge_claim("3.3", [abs(mean) < 1e-9], length=t[-1] - t[0], mean=mean, moments=moments, peak=peak)
    scaled = []
    for a in (0.5, 2.0, 10.0):
        fine = np.arange(0.0, a * t[-1], a * step)
        scaled.append(float(np.sum((a**-0.5 * np.interp(fine / a, t, psi)) ** 2) * a * step))
    tests = [abs(value - 1.0) < 1e-3 for value in (energy, *scaled)]
    yield judge_claim("3.4", tests, energy=energy, scaled=", ".join(f"{value:.4f}" for value in scaled))
    gains = (inverse_gain(np.array([30.0, 100.0]), weight) for weight in (2.0, 0.0))
    (constant, at_100), (printed, printed_at_100) = gains
    spread, falls = constant / at_100, printed / printed_at_100
    yield judge_claim("3.5", [abs(falls - 1.0) < 0.01], printed=falls, proper=spread, constant=constant)


def _leak(context: Context) -> Claim:
    without, leaking = (
        context.run(Experiment.of(command=_COMMAND, duration=40.0, leak=leak), prove=False) for leak in (None, _LEAK)
    )
    late = without.t > 10.0
    measures = (np.mean, np.max, np.ptp)
    changes = {
        name: [
            float(measure(leaking.outputs[name][late]) - measure(without.outputs[name][late])) for measure in measures
        ]
        for name in CHAMBERS
    }
    moved = [
        "{}: mean {:+.0f} Pa, peak {:+.0f} Pa, range {:+.0f} Pa".format(name, *shifts)
        for name, shifts in changes.items()
    ]
    tests = [shift < -visible_pressure() for shifts in changes.values() for shift in shifts]
    return judge_claim("3.6", tests, leak=leaking.mean_leak_lpm, moved="; ".join(moved))
