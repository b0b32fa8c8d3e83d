"""The distribution of a block's pressure difference: ringing is kept, the sensors' noise is not, zeros shift it."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.blocks import PARTS, sorted_part_means

RATE, SECONDS, NOISE = 500.0, 3.0, 7e3


def mean_size(parts: np.ndarray) -> float:
    return float(np.abs(parts).mean())


@pytest.mark.parametrize("amplitude", [5e4, 2e5])
@pytest.mark.parametrize("frequency", [8.0, 25.0, 40.0])
@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_ringing_counts_and_noise_does_not(amplitude: float, frequency: float, noise: float) -> None:
    t = np.arange(0.0, SECONDS, 1.0 / RATE)
    clean = amplitude * np.sin(2.0 * np.pi * frequency * t) * np.exp(-(t % 1.0) / 0.3)
    recorded = clean + noise * np.random.default_rng(1).standard_normal(len(t))
    assert mean_size(sorted_part_means(recorded, RATE)) == pytest.approx(
        np.abs(clean).mean(), rel=0.03, abs=0.25 * noise
    )


def test_noise_alone_leaves_little_of_itself() -> None:
    noise = np.random.default_rng(2).standard_normal(int(SECONDS * RATE))
    assert mean_size(sorted_part_means(noise, RATE)) < 0.4 * np.abs(noise).mean()


def test_parts_rise_and_keep_the_mean_and_a_zero() -> None:
    pressure = 1e5 * np.random.default_rng(3).standard_normal(992).cumsum()  # whole strides of 62 samples
    parts = sorted_part_means(pressure, RATE)
    assert parts.shape == (PARTS,)
    assert (np.diff(parts) >= 0.0).all()
    np.testing.assert_allclose(sorted_part_means(pressure + 3e5, RATE), parts + 3e5, rtol=1e-9)


def test_ringing_beside_missing_samples_counts_in_full() -> None:
    """Of each stride of 62 samples, three of the five pieces of 12 lack a sample."""
    t = np.arange(62 * 40) / RATE
    recorded = 1e4 * np.sin(2.0 * np.pi * 40.0 * t) + NOISE * np.random.default_rng(4).standard_normal(len(t))
    complete = mean_size(sorted_part_means(recorded, RATE))
    for first in (0, 12, 24):
        recorded[first::62] = np.nan
    assert mean_size(sorted_part_means(recorded, RATE)) == pytest.approx(complete, rel=0.05)


@pytest.mark.parametrize("missing", [slice(0), slice(100, 107), slice(None, None, 50), slice(None)])
@pytest.mark.parametrize("rate", [8.0, 40.0, 100.0, 500.0])
def test_missing_samples_and_low_rates_are_no_trouble(missing: slice, rate: float) -> None:
    pressure = np.full(int(SECONDS * rate), 1e6)
    pressure[missing] = np.nan
    expected = 0.0 if np.isnan(pressure).all() else 1e6
    got = sorted_part_means(pressure, rate)
    assert np.isfinite(got).all()
    assert expected == 0.0 or rate < 100.0 or got == pytest.approx(np.full(PARTS, expected))
