"""Statistics by stretches equal those of whole arrays, and the mains' lines those of one long Fourier transform."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.recordings import quality
from sealscope.recordings.channels import (
    finite_range,
    iter_stretches,
    largest_steps,
    summarize_intervals,
    take_finite,
)

SIZES = (0, 1, 2, 3, 2**16 - 1, 2**16, 2**16 + 1, 150_000)


@pytest.mark.parametrize("size", SIZES)
def test_stretches_cover_all_samples_once_and_their_intervals(size: int) -> None:
    parts = list(iter_stretches(size))
    assert [row for part in parts for row in range(part.start, part.stop)] == list(range(size))
    intervals = [row for part in iter_stretches(size, overlap=1) for row in range(part.start, part.stop - 1)]
    assert intervals == list(range(size - 1))


@pytest.mark.parametrize("size", SIZES)
def test_intervals_and_ranges_equal_those_of_the_whole_array(size: int) -> None:
    random = np.random.default_rng(size)
    for defect in (None, np.nan, np.inf, -np.inf):
        t = np.round(np.cumsum(random.normal(1.0, 0.5, size)), 1)
        if defect is not None and size:
            t[random.integers(0, size, 3)] = defect
        with np.errstate(invalid="ignore"):
            steps, summary = np.diff(t), summarize_intervals(t)
            expected = (steps.min(), steps.max()) if steps.size else (0.0, 0.0)
        assert summary.number == steps.size
        assert summary.n_changes == np.count_nonzero(steps)
        np.testing.assert_equal((summary.shortest, summary.longest), expected)
        finite = t[np.isfinite(t)]
        np.testing.assert_array_equal(take_finite(t), finite)
        assert finite_range(t) == ((finite.min(), finite.max()) if finite.size else None)


@pytest.mark.parametrize("size", SIZES)
def test_the_largest_steps_are_those_of_the_whole_array(size: int) -> None:
    values = np.random.default_rng(size).normal(size=size)
    expected = np.argsort(np.abs(np.diff(values)), kind="stable")[-2:].tolist() if size else []
    assert largest_steps(values, 2) == expected


def _amplitudes(values: np.ndarray, n_fft: int) -> np.ndarray:
    """Compute the amplitudes of all frequencies by one Fourier transform of the whole array."""
    x = np.arange(values.size) - (values.size - 1) / 2
    detrended = values - values.mean() - x * ((x @ values) / (x @ x))
    window = np.hanning(values.size)
    return np.abs(np.fft.rfft(detrended * window, n_fft)) * 2.0 / window.sum()


def test_lines_of_the_mains_equal_those_of_one_transform() -> None:
    random = np.random.default_rng(89)
    n_lines = 0
    for n in (600, 1234, 40_000, 2**17 + 1, 300_007):
        rate = float(random.choice([200.0, 333.3, 500.0, 1000.0]))
        t = np.arange(n) / rate
        values = 3e5 + 40.0 * t + 1e4 * np.sin(3.0 * t) + random.normal(0.0, 300.0, n)
        values += 2e3 * np.sin(2.0 * np.pi * (50.0 + random.uniform(-0.02, 0.02)) * t)
        n_fft = quality.fast_length(n)
        amplitudes, frequencies = _amplitudes(values, n_fft), np.arange(n_fft // 2 + 1) * rate / n_fft
        near = np.abs(frequencies - 50.0) <= max(0.1, 0.5 * rate / n)
        fast = amplitudes[np.ceil(20.0 * n_fft / rate - 1e-9).astype(int) :]
        for line in quality.find_hum(values, rate):
            assert line.frequency == 50.0
            assert line.amplitude == pytest.approx(amplitudes[near].max(), rel=1e-9)
            power = float((fast**2).sum()) / 2.0 / (1.5 * n_fft / n)
            assert line.power_fraction == pytest.approx(min(1.0, line.amplitude**2 / 2.0 / power), rel=1e-9)
            n_lines += 1
    assert n_lines >= 3
