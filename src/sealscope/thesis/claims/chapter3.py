"""The testable sentences of chapter 3, each judged by its own numbers."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.chapter3 import (
    RATE,
    TONES,
    amplitude_spectrum,
    inverse_gain,
    mother_wavelet,
    nearest,
    two_tone_signal,
    vanishing_moments,
    wavelet_centre,
)
from sealscope.thesis.chapters.chapter4.cases import visible_pressure
from sealscope.thesis.engine.context import Context, RunSpec
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, verdict_of

_ABSENT = "not a matter of the sheet"
#: Pressures without a leak and with the largest mean leak among the tests at 3 sin(4t).
_NO_LEAK = RunSpec(command="3 sin(4t)", duration=40.0, rig="thesis")
_LEAK = RunSpec(command="3 sin(4t)", duration=40.0, rig="thesis", leaks=("0.0163 L/min",))


def claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 3.1 to 3.6."""
    return (*_fourier(), *_wavelet(), _leak(context))


def _fourier() -> tuple[Claim, ...]:
    t = np.arange(round(RATE)) / RATE
    frequency, amplitude, phase = amplitude_spectrum(two_tone_signal(t), RATE)
    tones = [nearest(frequency, tone) for tone, _ in TONES]
    elsewhere = np.delete(amplitude, tones).max()
    present = all(abs(amplitude[k] - height) < 1e-6 for k, (_, height) in zip(tones, TONES, strict=True))
    return (
        Claim(
            "claim-3.1",
            "section 3.2.1, Fig. 3.2",
            "The spectrum of the signal of eq. (3.3) shows its two components and nothing else.",
            _ABSENT,
            f"amplitudes {amplitude[tones[0]]:.6f} at 100 Hz and {amplitude[tones[1]]:.6f} at 30 Hz, at most "
            f"{elsewhere:.1e} elsewhere",
            verdict_of([present, elsewhere < 1e-6]),
            "A record of whole periods leaves no leakage between the DFT's lines.",
        ),
        Claim(
            "claim-3.2",
            "section 3.2.1, text before eq. (3.3)",
            "The example consists of two cosines.",
            _ABSENT,
            f"phases against a cosine: {phase[tones[0]]:.1f} degrees at 100 Hz, {phase[tones[1]]:.1f} degrees at 30 Hz",
            verdict_of([abs(phase[k]) < 1e-3 for k in tones]),
            "Eq. (3.3) has a cosine at 100 Hz and a sine at 30 Hz; the amplitude spectrum cannot tell them apart.",
        ),
    )


def _wavelet() -> tuple[Claim, ...]:
    _, psi, t = mother_wavelet()
    step = float(t[1] - t[0])
    mean, energy = float(psi.sum() * step), float((psi**2).sum() * step)
    scaled = []
    for a in (0.5, 2.0, 10.0):
        fine = np.arange(0.0, a * t[-1], a * step)
        scaled.append(float(np.sum((abs(a) ** -0.5 * np.interp(fine / a, t, psi)) ** 2) * a * step))
    both = np.array([30.0, 100.0])
    proper, printed = inverse_gain(both, weight=2.0), inverse_gain(both, weight=0.0)
    spread, falls = float(proper[0] / proper[1]), float(printed[0] / printed[1])
    return (
        Claim(
            "claim-3.3",
            "section 3.2.2, Fig. 3.3",
            "A wavelet is of limited duration and has a mean of zero.",
            _ABSENT,
            f"db8: {t[-1] - t[0]:g} sampling intervals long, integral {mean:.1e}, {vanishing_moments(psi, t)} "
            f"vanishing moments, strongest at {wavelet_centre()[1]:.3f} of the sampling rate at scale 1",
            verdict_of([abs(mean) < 1e-9, np.isfinite(t[-1])]),
            "Its integrals with 1, t, ..., t^7 are zero, so slow changes of a record leave no trace in the details.",
        ),
        Claim(
            "claim-3.4",
            "section 3.2.2.1, eq. (3.6)",
            "The factor |a|^(-1/2) keeps the length of the scaled wavelet at one.",
            _ABSENT,
            f"integral of psi^2 {energy:.6f}; scaled by 0.5, 2 and 10: {', '.join(f'{of:.4f}' for of in scaled)}",
            verdict_of([abs(of - 1.0) < 1e-3 for of in (energy, *scaled)]),
            "Follows from substituting (t - b)/a in the integral.",
        ),
        Claim(
            "claim-3.5",
            "section 3.2.2.1, eq. (3.5)",
            "Integrating the transform with the wavelets over a and b gives the signal back.",
            _ABSENT,
            f"gain at 30 Hz over gain at 100 Hz after going forth and back: {falls:.2f} with the measure da db as "
            f"printed, {spread:.4f} with da db / a^2",
            verdict_of([abs(falls - 1.0) < 0.01]),
            f"The measure da db / a^2 and the division by the admissibility constant ({proper[0]:.3f} for db8) are "
            "missing in eq. (3.5); as printed, low frequencies come back too large, as 1/f^2. The complex conjugate "
            "belongs in eq. (3.4), not in eq. (3.5).",
        ),
    )


def _leak(context: Context) -> Claim:
    without, leaking = context.run(_NO_LEAK), context.run(_LEAK)
    where, claim = "section 3.3", "With a leak the pressure at both ends of the cylinder drops significantly."
    if without.diverged or leaking.diverged:
        text = without.diverged or leaking.diverged
        return Claim("claim-3.6", where, claim, _ABSENT, text, "cannot be tested", "a run failed")
    changes: dict[str, list[float]] = {}
    late = without.t > 10.0
    for name in CHAMBERS:
        before, after = without.outputs[name][late], leaking.outputs[name][late]
        changes[name] = [float(of(after) - of(before)) for of in (np.mean, np.max, np.ptp)]
    moved = ["{}: mean {:+.0f} Pa, peak {:+.0f} Pa, range {:+.0f} Pa".format(name, *of) for name, of in changes.items()]
    return Claim(
        "claim-3.6",
        where,
        claim,
        "the sheet holds RMS values of wavelet details only, no pressures",
        f"{leaking.mean_leak_lpm:.4f} L/min at 3 sin(4t) against none: {'; '.join(moved)}",
        verdict_of([change < -visible_pressure() for of in changes.values() for change in of]),
        "A drop counts when it exceeds a transducer's noise. Oil that passes the piston stays in the closed circuit: "
        "what chamber A loses chamber B gains, and the load is friction alone. What falls is the ringing of the oil "
        "columns.",
    )


ITEMS: tuple[Item, ...] = (Item("chapter-3-claims", 3, "claims", "What chapter 3 claims", claims),)
