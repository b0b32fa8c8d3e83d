"""Chapter 3: what Fourier, short-time Fourier and wavelet transforms show of a signal (Figs. 3.2-3.4, eqs. 3.3-3.6)."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.chapter3.continuous_wavelet import continuous_transform, scales_for, wavelet_centre
from sealscope.thesis.engine.context import Context, RunSpec
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Curve, Figure, Image, Number, Panel, Role, thinned

RATE = 1000.0
"""Sampling rate [Hz] of the signals of this chapter; the thesis gives none."""
TONES = ((100.0, 1.0), (30.0, 0.5))
"""Frequency [Hz] and amplitude of the two components of eq. (3.3)."""
#: Sine command and leak of the pressure record of eq. (3.4): the largest mean leak at 3 sin(4t) among the tests.
RECORD = RunSpec(command="3 sin(4t)", duration=20.0, leaks=("0.0163 L/min from 10 s",), prove=True)
_ONSET, _SETTLED, _BLOCK = 10.0, 1.0, 0.05

ITEMS: tuple[Item, ...] = (
    Item("fig-3.2", 3, "figure", "Two tones and their spectrum", f"{__name__}:two_tones"),
    Item(
        "fig-3.3",
        3,
        "figure",
        "The db8 wavelet and its scaling function",
        f"{__name__}:db8",
    ),
    Item("fig-3.4", 3, "figure", "One signal in four views", f"{__name__}:four_views"),
    Item(
        "eq-3.4",
        3,
        "figure",
        "Continuous wavelet transform of a pressure record",
        f"{__name__}:pressure_scalogram",
    ),
    Item("chapter-3-claims", 3, "claims", "What chapter 3 claims", "sealscope.thesis.claims.chapter3:claims"),
)


def two_tone_signal(t: Array) -> Array:
    """x(t) = cos(2 pi 100 t) + 0.5 sin(2 pi 30 t), eq. (3.3)."""
    return np.asarray(np.cos(2.0 * np.pi * 100.0 * t) + 0.5 * np.sin(2.0 * np.pi * 30.0 * t))


def amplitude_spectrum(x: Array, rate: float) -> tuple[Array, Array, Array]:
    """Frequencies [Hz], amplitudes and phases [degree, of a cosine] of real samples `x` by the DFT of eq. (3.2)."""
    spectrum = np.asarray(np.fft.rfft(x), dtype=np.complex128) * (2.0 / x.size)
    spectrum[0] /= 2.0
    if x.size % 2 == 0:
        spectrum[-1] /= 2.0
    frequency = np.asarray(np.fft.rfftfreq(x.size, 1.0 / rate), dtype=np.float64)
    return frequency, np.abs(spectrum), np.degrees(np.angle(spectrum))


def short_time_spectrum(x: Array, rate: float, window: int, step: int) -> tuple[Array, Array, Array]:
    """Times [s] of the windows' middles, frequencies [Hz] and amplitudes (frequencies, times) under a Hann window."""
    starts = np.arange(0, x.size - window + 1, step)
    shape = np.hanning(window + 1)[:-1]
    pieces = np.lib.stride_tricks.sliding_window_view(x, window)[starts] * shape
    values = np.abs(np.fft.rfft(pieces, axis=1)).T * 2.0 / shape.sum()
    frequency = np.asarray(np.fft.rfftfreq(window, 1.0 / rate), dtype=np.float64)
    return np.asarray((starts + window / 2.0) / rate, dtype=np.float64), frequency, np.asarray(values)


def tones_in_turn(t: Array) -> Array:
    """The two tones of eq. (3.3) one after the other, 100 Hz before 0.5 s and 30 Hz after, and one sample of height
    8 at 0.75 s."""
    x = np.where(t < 0.5, np.cos(2.0 * np.pi * 100.0 * t), 0.5 * np.sin(2.0 * np.pi * 30.0 * t))
    x[np.abs(t - 0.75).argmin()] += 8.0
    return np.asarray(x)


def two_tones(context: Context, item: Item) -> tuple[Figure, ...]:
    """Fig. 3.2: the signal of eq. (3.3) and its amplitude spectrum."""
    t = np.arange(round(RATE)) / RATE
    x = two_tone_signal(t)
    frequency, amplitude, phase = amplitude_spectrum(x, RATE)
    numbers = []
    for tone, _ in TONES:
        k = int(np.abs(frequency - tone).argmin())
        numbers.append(Number(f"amplitude at {tone:g} Hz", float(amplitude[k])))
        numbers.append(Number(f"phase at {tone:g} Hz (cosine 0)", float(phase[k]), "deg"))
    others = np.ones(frequency.size, dtype=bool)
    others[[int(np.abs(frequency - tone).argmin()) for tone, _ in TONES]] = False
    numbers.append(Number("largest amplitude elsewhere", float(amplitude[others].max())))
    shown, lines = t < 0.2, amplitude > 1e-6
    panels = (
        Panel("t [s]", "x(t) [1]", (Curve(t[shown], x[shown], "x(t), eq. 3.3", "reference"),), "(a) Signal"),
        Panel(
            "frequency [Hz]",
            "amplitude [1]",
            (Curve(frequency[lines], amplitude[lines], "2 |X[n]| / N, eq. 3.2", "reference", "stems"),),
            "(b) Amplitude spectrum",
            x_range=(0.0, 150.0),
        ),
    )
    notes = (
        "1 s sampled at 1000 Hz; the thesis gives neither. Its text names two cosines, eq. (3.3) has a sine at 30 Hz: "
        "the amplitudes are the same, the phase at 30 Hz is -90 degrees."
    )
    return (Figure(item.id, item.title, panels, tuple(numbers), ("claim-3.1", "claim-3.2"), None, notes),)


def db8(context: Context, item: Item) -> tuple[Figure, ...]:
    """Fig. 3.3: mother wavelet and scaling function of db8, by the cascade of their filters."""
    from sealscope.signals.filters import discrete_wavelet

    phi, psi, t = discrete_wavelet("db8").wavefun(level=10)
    step = float(t[1] - t[0])
    frequency = wavelet_centre("db8")[1]
    panels = (
        Panel("t [samples]", "psi(t) [1]", (Curve(*thinned(t, psi), "psi(t)", "reference"),), "(a) Mother wavelet"),
        Panel("t [samples]", "phi(t) [1]", (Curve(*thinned(t, phi), "phi(t)", "other"),), "(b) Scaling function"),
    )
    numbers = (
        Number("integral of psi", float(psi.sum() * step)),
        Number("integral of psi squared", float((psi**2).sum() * step)),
        Number("integral of phi", float(phi.sum() * step)),
        Number("length of both", float(t[-1] - t[0]), "samples"),
        Number("vanishing moments", float(vanishing_moments(psi, t))),
        Number("frequency of the largest response", frequency, "1/sample"),
    )
    notes = "The wavelet is asymmetric and of finite length: 15 sampling intervals at scale 1."
    return (Figure(item.id, item.title, panels, numbers, ("claim-3.3",), None, notes),)


def vanishing_moments(psi: Array, t: Array) -> int:
    """How many of the moments integral of t^k psi(t) dt, k = 0, 1, ..., are zero against the integral of |t^k psi|."""
    moments = 0
    centred = t - t.mean()
    while moments < 20 and abs(np.sum(centred**moments * psi)) < 1e-6 * np.sum(np.abs(centred**moments * psi)):
        moments += 1
    return moments


def four_views(context: Context, item: Item) -> tuple[Figure, ...]:
    """Fig. 3.4: one signal in time, in frequency, under a short-time Fourier and under a wavelet transform."""
    t = np.arange(round(RATE)) / RATE
    x = tones_in_turn(t)
    frequency, amplitude, _ = amplitude_spectrum(x, RATE)
    window = 128
    times, bins, short = short_time_spectrum(x, RATE, window, 4)
    wanted = np.geomspace(10.0, 450.0, 64)
    wavelet = np.abs(continuous_transform(x, RATE, scales_for(wanted)))
    panels = (
        Panel("t [s]", "x(t) [1]", (Curve(t, x, "x(t)", "reference"),), "(a) Time"),
        Panel(
            "frequency [Hz]",
            "amplitude [1]",
            (Curve(frequency, amplitude, "2 |X[n]| / N", "reference"),),
            "(b) Frequency",
        ),
        Panel(
            "t [s]",
            "frequency [Hz]",
            title=f"(c) Short-time Fourier transform, window {window / RATE * 1e3:g} ms",
            image=Image(times, bins, short, "amplitude [1]"),
        ),
        Panel(
            "t [s]",
            "frequency [Hz]",
            title="(d) Wavelet transform, db8",
            image=Image(t, wanted, wavelet, "|CWT| [s^0.5]"),
            log_y=True,
        ),
    )
    pulse = (t > 0.6) & (t < 0.9)
    high = int(np.abs(wanted - 300.0).argmin())
    numbers = (
        Number("resolution in frequency of (b)", RATE / x.size, "Hz"),
        Number("resolution in frequency of (c)", RATE / window, "Hz"),
        Number("width of the pulse at 300 Hz in (c)", _width(times, short[int(np.abs(bins - 300.0).argmin())]), "s"),
        Number("width of the pulse at 300 Hz in (d)", _width(t[pulse], wavelet[high][pulse]), "s"),
    )
    notes = (
        "A signal of our own choice, for the thesis's figure is a sketch: the tones of eq. (3.3) in turn and one "
        "sample of height 8 at 0.75 s. Only (c) and (d) tell when a tone sounds; (d) places the pulse more sharply at "
        "high frequencies and less at low ones."
    )
    return (Figure(item.id, item.title, panels, numbers, (), None, notes),)


def _width(t: Array, values: Array) -> float:
    """Root mean square half-width [s] of the energy of `values` about its middle, near its largest value."""
    near = np.abs(t - t[values.argmax()]) < 0.1
    weight = values[near] ** 2 / np.sum(values[near] ** 2)
    middle = np.sum(t[near] * weight)
    return float(np.sqrt(np.sum((t[near] - middle) ** 2 * weight)))


def pressure_scalogram(context: Context, item: Item) -> tuple[Figure, ...]:
    """Eqs. (3.4)-(3.6) on a simulated record of p_A: the ringing after each reversal, before and with a leak."""
    run = context.run(RECORD)
    if run.recording is None:
        return (Figure(item.id, item.title, (), notes=f"the run failed: {run.diverged}", resolved=False),)
    t = run.recording.t
    rate = 1.0 / float(t[1] - t[0])
    wanted = np.geomspace(12.0, 0.45 * rate, 64)
    recorded, clean = run.recording["p_A"] * 1e-6, run.outputs["p_A"] * 1e-6
    leak = ((_ONSET, "leak"),)
    panels = [Panel("t [s]", "p_A [MPa]", (Curve(*thinned(t, recorded), "p_A, recorded", "A"),), "(a) Record", leak)]
    for letter, p_A, name in (("b", recorded, "as recorded"), ("c", clean, "without the instruments' noise")):
        rows = continuous_transform(p_A, rate, scales_for(wanted))
        middles, power = _running_rms(t, rows, round(_BLOCK * rate))
        image = Image(middles, wanted, power * 1e3, "rms of CWT [kPa s^0.5]")
        title = f"({letter}) CWT(a, b), db8, {name}"
        panels.append(Panel("t [s]", "frequency [Hz]", title=title, marks=leak, image=image, log_y=True))
    parts: tuple[tuple[Role, np.ndarray], ...] = (("no leak", (t > _SETTLED) & (t < _ONSET)), ("leak", t >= _ONSET))
    strength = {role: np.sqrt(np.mean(rows[:, part] ** 2, axis=1)) * 1e3 for role, part in parts}
    curves = tuple(Curve(wanted, strength[role], role, role) for role, _ in parts)
    panels.append(Panel("frequency [Hz]", "rms of CWT [kPa s^0.5]", curves, "(d) rms of (c) over time", log_x=True))
    fast = wanted > 30.0
    ring = int(np.flatnonzero(fast)[strength["no leak"][fast].argmax()])
    numbers = (
        Number("frequency of the ringing", float(wanted[ring]), "Hz"),
        Number("rms at the ringing, leak / no leak", float(strength["leak"][ring] / strength["no leak"][ring])),
        Number("mean leak", run.mean_leak_lpm, "L/min"),
    )
    notes = (
        f"Simulated at {RECORD.command}, a leak from {_ONSET:g} s. The vertical axis is the frequency at which the "
        f"wavelet of scale a responds most, b the middle of the wavelet; grey is the rms over {_BLOCK:g} s. The "
        "ringing of the oil columns stands between the reversals, and the leak damps it."
    )
    return (Figure(item.id, item.title, tuple(panels), numbers, ("claim-3.5",), run.resolved, notes),)


def _running_rms(t: Array, rows: Array, size: int) -> tuple[Array, Array]:
    """Middles [s] of blocks of `size` samples, and the rms of each row of `rows` in them, (rows, blocks)."""
    whole = t.size // size * size
    power = np.sqrt(np.mean(rows[:, :whole].reshape(rows.shape[0], -1, size) ** 2, axis=2))
    return t[:whole].reshape(-1, size).mean(axis=1), power
