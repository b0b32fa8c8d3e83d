"""Sines by least squares: amplitudes, phases and slope of made-up signals come back."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.thesis.sines import sine_fit


def test_amplitudes_and_slope_come_back_beside_each_other() -> None:
    t = np.arange(0, 33.3, 0.01)
    fit = sine_fit(t, 0.7 - 2.0 * t + 3.0 * np.sin(2.0 * t + 0.4) + 0.5 * np.cos(5.0 * t), 2.0, 5.0)
    assert fit.slope == pytest.approx(-2.0, abs=1e-10)
    np.testing.assert_allclose(fit.amplitudes, [3.0 * np.exp(1j * (0.4 - np.pi / 2)), 0.5], atol=1e-9)
    np.testing.assert_allclose(fit.residual, 0.0, atol=1e-9)


def test_what_is_left_is_what_no_sine_explains() -> None:
    t = np.arange(6000) / 100.0
    fit = sine_fit(t, np.sin(4.0 * t) + 0.1 * np.sin(12.0 * t), 4.0)
    assert abs(fit.amplitudes[0]) == pytest.approx(1.0, rel=0.01)
    assert np.std(fit.residual) == pytest.approx(0.1 / np.sqrt(2.0), rel=0.02)
