"""The testable sentences of chapter 3, each judged by its own numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters import chapter3
from sealscope.thesis.chapters.chapter4.cases import visible_pressure
from sealscope.thesis.claims.judged import judged
from sealscope.thesis.engine.context import Context, RunSpec
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim

#: Pressures without a leak and with the largest mean leak among the tests at 3 sin(4t).
_NO_LEAK = RunSpec(command="3 sin(4t)", duration=40.0)
_LEAK = replace(_NO_LEAK, leaks=("0.0163 L/min",))


def claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 3.1 to 3.6."""
    return (*_fourier(), *_wavelet(), _leak(context))


def _fourier() -> Iterator[Claim]:
    t = np.arange(round(chapter3.RATE)) / chapter3.RATE
    frequency, amplitude, phase = chapter3.amplitude_spectrum(chapter3.two_tone_signal(t), chapter3.RATE)
    tones = [chapter3.nearest(frequency, tone) for tone, _ in chapter3.TONES]
    elsewhere = np.delete(amplitude, tones).max()
    present = np.abs(amplitude[tones] - [height for _, height in chapter3.TONES]).max() < 1e-6
    high, low = amplitude[tones]
    yield judged("3.1", [present, elsewhere < 1e-6], high=high, low=low, elsewhere=elsewhere)
    high, low = phase[tones]
    yield judged("3.2", np.abs(phase[tones]) < 1e-3, high=high, low=low)


def _wavelet() -> Iterator[Claim]:
    _, psi, t = chapter3.mother_wavelet()
    step = float(t[1] - t[0])
    mean, energy = float(psi.sum() * step), float((psi**2).sum() * step)
    moments, peak = chapter3.vanishing_moments(psi, t), chapter3.wavelet_centre()[1]
    yield judged("3.3", [abs(mean) < 1e-9], length=t[-1] - t[0], mean=mean, moments=moments, peak=peak)
    scaled = []
    for a in (0.5, 2.0, 10.0):
        fine = np.arange(0.0, a * t[-1], a * step)
        scaled.append(float(np.sum((a**-0.5 * np.interp(fine / a, t, psi)) ** 2) * a * step))
    tests = [abs(of - 1.0) < 1e-3 for of in (energy, *scaled)]
    yield judged("3.4", tests, energy=energy, scaled=", ".join(f"{of:.4f}" for of in scaled))
    gains = (chapter3.inverse_gain(np.array([30.0, 100.0]), weight) for weight in (2.0, 0.0))
    (constant, at_100), (printed, printed_at_100) = gains
    spread, falls = constant / at_100, printed / printed_at_100
    yield judged("3.5", [abs(falls - 1.0) < 0.01], printed=falls, proper=spread, constant=constant)


def _leak(context: Context) -> Claim:
    without, leaking = context.run(_NO_LEAK), context.run(_LEAK)
    failed = without.diverged or leaking.diverged
    if failed:
        return replace(judged("3.6", [None], leak=0.0, moved=""), simulation=failed, why="a run failed")
    late = without.t > 10.0
    changes: dict[str, list[float]] = {
        name: [
            float(of(leaking.outputs[name][late]) - of(without.outputs[name][late])) for of in (np.mean, np.max, np.ptp)
        ]
        for name in CHAMBERS
    }
    moved = ["{}: mean {:+.0f} Pa, peak {:+.0f} Pa, range {:+.0f} Pa".format(name, *of) for name, of in changes.items()]
    tests = [change < -visible_pressure() for of in changes.values() for change in of]
    return judged("3.6", tests, leak=leaking.mean_leak_lpm, moved="; ".join(moved))


ITEMS: tuple[Item, ...] = (Item("chapter-3-claims", 3, "claims", "What chapter 3 claims", claims),)
