"""What instruments add to the pressures: lines of hum at any frequency, and chambers that are read in turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.pressure_model.detector import PressureModel
from sealscope.diagnosis.pressure_model.interference import LARGEST_SKEW, advanced, line_frequencies, lines_in, skew
from sealscope.parameters import load_rig

from .pressure_machine import LEAK, ONSET, recorded

RATE = 500.0


def noise(seed: int = 1, n: int = 60_000) -> np.ndarray:
    return 1e4 * np.random.default_rng(seed).standard_normal(n)


@pytest.mark.parametrize("frequency", [49.97, 60.0, 133.3, 237.013])
def test_lines_at_any_frequency_are_taken_out(frequency: float) -> None:
    """With phase and frequency that wander as those of mains do: less than a tenth of the line's power is left."""
    t = np.arange(60_000) / RATE
    hum = 4e3 * np.sin(2.0 * np.pi * frequency * t + 0.8 * np.sin(0.1 * t))
    residual = noise() + hum
    assert line_frequencies(residual, RATE) == pytest.approx([frequency], abs=0.03)
    left = residual - lines_in(residual, RATE) - noise()
    assert np.var(left) < 0.1 * np.var(hum)


def test_noise_and_a_comb_under_a_resonance_have_no_lines() -> None:
    """What a model misses of the ringing repeats with every reversal: a comb as narrow as any line."""
    for seed in range(20):
        assert line_frequencies(noise(seed), RATE).size == 0
    t = np.arange(60_000) / RATE
    since = np.mod(t, 0.8)
    assert line_frequencies(noise() + 2e4 * np.exp(-8.0 * since) * np.sin(430.0 * since), RATE).size == 0


def test_a_harmonic_of_the_duty_is_no_hum_unless_it_is_far_above_the_others() -> None:
    """A leak changes the ringing at harmonics of the duty: one was taken for hum, and the leak with it."""
    t = np.arange(60_000) / RATE
    cycle = np.pi / 2.0
    harmonic = 101.0 / cycle
    weak, strong = (noise() + size * np.sin(2.0 * np.pi * harmonic * t) for size in (1e3, 6e3))
    assert line_frequencies(weak, RATE) == pytest.approx([harmonic], abs=0.03)
    assert line_frequencies(weak, RATE, cycle).size == 0
    assert line_frequencies(strong, RATE, cycle) == pytest.approx([harmonic], abs=0.03)


def test_skew_of_the_chambers_is_measured_under_hum() -> None:
    """With noise that both channels share, which is not skewed."""
    for late in (0.0, 1.2e-3, 2.5e-3):
        seen = recorded(2, command="stepped", duration=60.0, sensors__p_B__delay=late)
        hum = 4e3 * np.sin(2.0 * np.pi * 50.0 * seen.t)
        assert skew(seen["p_A"] + hum, seen["p_B"] + 0.5 * hum, RATE) == pytest.approx(late, abs=1.5e-4)


def test_a_channel_is_moved_by_a_share_of_a_sample() -> None:
    t = np.arange(4000) / RATE
    wave = np.sin(2.0 * np.pi * 60.0 * t)
    late = np.sin(2.0 * np.pi * 60.0 * (t + 1.3e-3))
    np.testing.assert_allclose(advanced(wave, 1.3e-3, RATE)[200:-200], late[200:-200], atol=1e-3)


def test_channels_that_do_not_belong_together_have_no_skew() -> None:
    assert skew(noise(3), noise(4), RATE) == 0.0
    assert LARGEST_SKEW < 0.5 / 70.0  # half a ring


def test_a_leak_is_found_under_hum_and_skew() -> None:
    """0.0042 L/min with 3 kPa of hum at 50 Hz and its harmonics, and p_B read 2.5 ms late: `cannot tell` before."""
    clean = recorded(1, leak=LEAK, sensors__p_B__delay=2.5e-3)
    lines = [(50.02, 6e3, 2e3), (100.04, 1e3, 3e3), (150.06, 2e3, 1e3)]
    hum = {
        name: sum(line[k] * np.sin(2.0 * np.pi * line[0] * clean.t + k) for line in lines)
        for k, name in ((1, "p_A"), (2, "p_B"))
    }
    seen = {**clean.channels, **{name: clean[name] + hum[name] for name in hum}}
    evidence = PressureModel(load_rig("thesis")).examine(replace(clean, channels=seen), [], 0.01)
    assert evidence.verdict == "leak", evidence.reason
    assert evidence.onset_s == pytest.approx(ONSET, abs=7.0)
    low, high = evidence.leak_interval_lpm
    assert low <= 0.0042 <= high
