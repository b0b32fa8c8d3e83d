"""The viscous pressure drop of the motion: its size and error, and the oil that it shows."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.changes.motion_fit import estimate_viscous_drop
from sealscope.recordings.recording import Recording

RATE, SECONDS = 100.0, 60.0
T = np.arange(round(RATE * SECONDS)) / RATE
#: Viscous pressure drop over the speed [Pa s/m].
DROP = 2e6


def record(drop: float = DROP, seed: int = 0, noise: float = 2e4, turned: bool = False) -> Recording:
    """Record strokes of several speeds against dry friction, a spring and a viscous drop; noise lasts 0.5 s."""
    rng = np.random.default_rng(seed)
    x = 0.1 * np.sin(2.0 * np.pi * 0.2 * T) + 0.03 * np.sin(2.0 * np.pi * 0.53 * T)
    v = np.gradient(x, T)
    slow_noise = np.repeat(rng.standard_normal((2, len(T) // 50)), 50, axis=1) * noise
    difference = 1e5 * np.sign(v) + drop * v + 2e6 * x
    p_A, p_B = 40e5 + 0.6 * difference + slow_noise[0], 20e5 - 0.4 * difference + slow_noise[1]
    if turned:
        x, p_A, p_B = -x, p_B, p_A
    return Recording(T, {"p_A": p_A, "p_B": p_B, "x": x}, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE)


def log_drop(recording: Recording) -> tuple[float, float]:
    """Return the logarithm of the drop and its standard error."""
    estimate = estimate_viscous_drop(recording)
    assert estimate is not None
    return float(estimate[0]), float(estimate[1])


def test_the_ratio_of_two_drops_is_theirs() -> None:
    """The unit of the speed is the recording's own: ratios count."""
    (thick, thick_error), (thin, thin_error) = log_drop(record(2.0 * DROP)), log_drop(record(DROP, seed=1))
    assert thick - thin == pytest.approx(np.log(2.0), abs=3.0 * np.hypot(thick_error, thin_error))
    assert thick_error < thin_error < 0.1


@pytest.mark.slow
def test_its_standard_error_is_the_scatter_of_records() -> None:
    estimates = np.array([log_drop(record(seed=seed)) for seed in range(30)])
    assert 0.6 < estimates[:, 0].std() / np.median(estimates[:, 1]) < 1.6


def test_a_drop_that_does_not_show_counts_as_its_error() -> None:
    for drop in (0.0, -DROP):
        assert log_drop(record(drop, noise=2e5))[1] == pytest.approx(1.0, abs=0.5)


def test_the_sign_of_the_motion_does_not_matter() -> None:
    plain, turned = (log_drop(record(turned=turned)) for turned in (False, True))
    assert turned == pytest.approx(plain, abs=1e-6)


def test_without_motion_or_pressures_there_is_none() -> None:
    whole = record()
    still = Recording(T, {**whole.channels, "x": np.zeros(len(T))}, whole.units, RATE)
    assert estimate_viscous_drop(still) is None
    assert estimate_viscous_drop(whole.only(("p_A", "x"))) is None
