"""Single samples that leap and return, beside pressures that change as fast as they leap."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.recordings.corrections.samples import find_spikes

T = np.arange(2000) / 20.0
#: A pressure [Pa] that reverses by 75 bar within a sample or two, as an actuator's does at 20 Hz.
REVERSING = 80e5 + 37e5 * np.tanh(40.0 * np.sin(2.0 * np.pi * 0.4 * T))


def with_noise(values: np.ndarray, noise: float = 2e4) -> np.ndarray:
    """Add noise [Pa], and round to 0.01 bar."""
    return np.round(values + noise * np.random.default_rng(3).standard_normal(len(values)), -3)


@pytest.mark.parametrize("value", [0.0, 400e5])
@pytest.mark.parametrize("index", [3, 607, 1990])
def test_a_sample_at_zero_or_full_scale_is_found_beside_fast_reversals(value: float, index: int) -> None:
    pressure = with_noise(REVERSING)
    assert find_spikes(pressure).tolist() == []
    pressure[index] = value
    assert find_spikes(pressure).tolist() == [index]


def test_what_has_slopes_or_recurs_is_no_spike() -> None:
    flat = with_noise(np.full(len(T), 80e5))
    step, peak, ringing = flat.copy(), flat.copy(), flat.copy()
    step[500:] += 100e5
    peak[500:507] += 1e5 * np.array([10.0, 40.0, 80.0, 100.0, 80.0, 40.0, 10.0])
    ringing[500:520] += 50e5 * (-1.0) ** np.arange(20) * np.exp(-np.arange(20) / 8.0)
    for pressure in (step, peak, ringing):
        assert find_spikes(pressure).tolist() == []


def test_a_few_spikes_in_a_short_recording_are_a_logger_s_errors_and_many_are_a_signal() -> None:
    pressure = with_noise(np.full(1400, 80e5))
    pressure[[200, 700, 1200]] = 0.0, 400e5, 0.0
    assert find_spikes(pressure).tolist() == [200, 700, 1200]
    pressure[15::40] += 50e5
    assert find_spikes(pressure).tolist() == []
