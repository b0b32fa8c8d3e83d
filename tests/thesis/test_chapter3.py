"""Chapter 3: the transforms against their own definitions, and the claims they decide."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.parameters import load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters import chapter3
from sealscope.thesis.chapters.chapter3 import (
    continuous_transform,
    inverse_gain,
    scales_for,
    wavelet_centre,
    wavelet_spectrum,
)
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.products import Claim, Figure, claim_verdict

from .conftest import ITEMS, Kept, numbers


@pytest.fixture(scope="module")
def made() -> dict[str, tuple[Figure | Claim, ...]]:
    context = Kept()
    return {name: item.make(context, item) for name, item in ITEMS.items() if item.chapter == 3}  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [1000, 999])
def test_spectrum_is_the_sum_of_equation_3_2(size: int) -> None:
    x = np.random.default_rng(1).standard_normal(size)
    frequency, amplitude, phase = chapter3.amplitude_spectrum(x, 1000.0)
    n = 37
    by_hand = np.sum(x * np.exp(-2j * np.pi * n * np.arange(size) / size)) * 2.0 / size
    assert frequency[n] == pytest.approx(n * 1000.0 / size)
    assert amplitude[n] == pytest.approx(abs(by_hand), rel=1e-10)
    assert phase[n] == pytest.approx(np.degrees(np.angle(by_hand)), rel=1e-10)
    assert amplitude[0] == pytest.approx(abs(x.mean()), rel=1e-10)
    power = amplitude[0] ** 2 + np.sum(amplitude[1:] ** 2) / 2.0
    if size % 2 == 0:  # the last line stands for itself alone
        power += amplitude[-1] ** 2 / 2.0
    assert power == pytest.approx(np.mean(x**2), rel=1e-10)


def test_two_tones_are_found_where_the_equation_puts_them(made: dict) -> None:
    (figure,) = made["fig-3.2"]
    result = numbers(figure)
    assert result["amplitude at 100 Hz"] == pytest.approx(1.0)
    assert result["amplitude at 30 Hz"] == pytest.approx(0.5)
    assert result["phase at 100 Hz (cosine 0)"] == pytest.approx(0.0, abs=1e-9)
    assert result["phase at 30 Hz (cosine 0)"] == pytest.approx(-90.0)
    assert result["largest amplitude elsewhere"] < 1e-12


def test_db8_has_eight_vanishing_moments_and_db4_four() -> None:
    import pywt

    for name, moments in (("db8", 8), ("db4", 4), ("db1", 1)):
        _, psi, t = pywt.Wavelet(name).wavefun(level=10)
        assert chapter3.vanishing_moments(psi, t) == moments


def test_short_time_spectrum_gives_a_tone_its_amplitude_and_time() -> None:
    t = np.arange(1000) / 1000.0
    x = np.where(t < 0.5, 3.0 * np.cos(2 * np.pi * 125.0 * t), 0.0)
    times, bins, values = chapter3.short_time_spectrum(x, 1000.0, 128, 4)
    row = values[np.abs(bins - 125.0).argmin()]
    assert row[times < 0.4] == pytest.approx(3.0, rel=1e-6)
    assert row[times > 0.6].max() < 1e-12


def test_wavelet_spectrum_is_the_transform_of_the_cascade() -> None:
    import pywt

    _, psi, t = pywt.Wavelet("db8").wavefun(level=14)
    omega = np.linspace(0.5, 12.0, 40)
    direct = np.array([np.sum(psi * np.exp(-1j * w * t)) * (t[1] - t[0]) for w in omega])
    assert np.abs(wavelet_spectrum(omega) - direct).max() < 1e-3
    fine = np.linspace(1e-6, 200.0, 40_000)
    energy = np.trapezoid(np.abs(wavelet_spectrum(fine)) ** 2, fine) / np.pi
    assert energy == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("frequency", [10.0, 35.0])
def test_transform_is_the_integral_of_equation_3_4(frequency: float) -> None:
    import pywt

    rate = 2000.0
    t = np.arange(4000) / rate
    x = np.sin(2 * np.pi * (5.0 + 12.0 * t) * t) + 0.3 * np.cos(2 * np.pi * 40.0 * t)
    (a,) = scales_for(np.array([frequency]))
    rows = continuous_transform(x, rate, np.array([a]))
    _, psi, tau = pywt.Wavelet("db8").wavefun(level=12)
    centre = wavelet_centre()[0]
    for k in (1500, 2000, 2777):
        atom = a**-0.5 * np.interp((t - t[k]) / a + centre, tau, psi, left=0.0, right=0.0)
        assert rows[0, k] == pytest.approx(np.sum((x - x.mean()) * atom) / rate, abs=2e-3 * np.abs(rows).max())


def test_only_the_measure_with_a_squared_gives_every_frequency_back() -> None:
    frequencies = np.array([7.0, 30.0, 100.0])
    proper = inverse_gain(frequencies)
    assert proper == pytest.approx(np.full(3, proper[0]), rel=1e-3)
    printed = inverse_gain(frequencies, weight=0.0)
    assert printed[1] / printed[2] == pytest.approx((100.0 / 30.0) ** 2, rel=1e-3)


def test_scalogram_finds_the_resonance_of_the_oil_columns_and_its_damping(made: dict) -> None:
    (figure,) = made["eq-3.4"]
    rig = load_rig("thesis")
    stiffness = 2.0 * rig.cylinder.A_A**2 * rig.fluid.K_oil / rig.cylinder.V
    resonance = np.sqrt(stiffness / rig.cylinder.M_eq) / (2 * np.pi)
    result = numbers(figure)
    assert result["frequency of the ringing"] == pytest.approx(resonance, rel=0.25)
    assert result["rms at the ringing, leak / no leak"] < 0.7
    assert result["mean leak"] == pytest.approx(0.0163, rel=0.02)
    assert figure.resolved is True


def test_every_view_of_one_signal_tells_what_it_should(made: dict) -> None:
    (figure,) = made["fig-3.4"]
    result = numbers(figure)
    assert result["width of the pulse at 300 Hz in (d)"] < result["width of the pulse at 300 Hz in (c)"] / 2
    assert [panel.image is not None for panel in figure.panels] == [False, False, True, True]
    short, wavelet = figure.panels[2].image, figure.panels[3].image
    early, late = short.x < 0.4, short.x > 0.6
    assert short.y[short.values[:, early].mean(axis=1).argmax()] == pytest.approx(100.0, abs=8.0)
    assert short.y[short.values[:, late].mean(axis=1).argmax()] == pytest.approx(30.0, abs=8.0)
    assert wavelet.values.shape == (wavelet.y.size, wavelet.x.size)


def test_claims_are_judged_by_their_numbers(made: dict) -> None:
    claims = {claim.id: claim for claim in made["chapter-3-claims"]}
    verdicts = {name: claim.verdict for name, claim in claims.items()}
    assert verdicts["claim-3.1"] == "holds"
    assert verdicts["claim-3.2"] == "holds in part"
    assert verdicts["claim-3.3"] == verdicts["claim-3.4"] == "holds"
    assert verdicts["claim-3.5"] == "does not hold"
    assert verdicts["claim-3.6"] == "does not hold"
    assert "p_A: mean -0 Pa" in claims["claim-3.6"].simulation or "p_A: mean +0 Pa" in claims["claim-3.6"].simulation


def test_a_pressure_that_drops_makes_claim_3_6_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    class Dropping(Kept):
        def run(self, spec: Experiment, *, prove: bool = True) -> SimulatedRun:
            run = super().run(spec, prove=prove)
            if not spec.leaks:
                return run
            return replace(run, outputs={name: 0.5 * values for name, values in run.outputs.items()})

    result = {claim.id: claim.verdict for claim in chapter3.judge_claims(Dropping(), ITEMS["chapter-3-claims"])}
    assert result["claim-3.6"] == "holds"


@pytest.mark.parametrize(
    ("tests", "verdict"),
    [
        ([True, True], "holds"),
        ([True, False], "holds in part"),
        ([False], "does not hold"),
        ([], "cannot be tested"),
    ],
)
def test_verdict_follows_from_the_tests(tests: list[bool], verdict: str) -> None:
    assert claim_verdict(tests) == verdict
