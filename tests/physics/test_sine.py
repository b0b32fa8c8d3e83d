"""The sine of the solver's inputs against NumPy's, and its shapes."""

import numpy as np
import pytest

from sealscope.physics.sine import sine_wave


@pytest.mark.parametrize("span", [1.0, 1e3, 1e6])
def test_sine_wave_equals_numpys(span: float) -> None:
    random = np.random.default_rng(7)
    t = random.uniform(-span, span, 20_000)
    amplitude, omega, phase, offset = random.uniform(0.1, 3.0, 4)
    expected = offset + amplitude * np.sin(omega * t + phase)
    rounding = np.spacing(omega * span)  # of the angle, in which the product and the sum may be fused
    assert np.abs(sine_wave(t, amplitude, omega, phase, offset) - expected).max() < amplitude * (1e-15 + 2 * rounding)


def test_whole_multiples_of_half_a_turn_and_any_shape() -> None:
    n = np.arange(-4000.0, 4000.0)
    np.testing.assert_allclose(sine_wave(n + 0.5, 1.0, np.pi, 0.0, 0.0), np.where(n % 2 == 0, 1.0, -1.0), atol=1e-12)
    assert sine_wave(np.zeros((3, 2))[:, ::2], 1.0, 1.0, 0.0, 2.0).shape == (3, 1)
    assert sine_wave(np.zeros(()), 1.0, 1.0, 0.0, 2.0).shape == ()
