"""The Cramer-Rao bound: closed forms, straight derivatives, the published figures of the check rig."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sealscope.campaigns.cases.bound import (
    UNKNOWN,
    cramer_rao,
    in_lpm,
    information,
    leak_bound,
    noise_covariance,
    smallest_detectable,
)
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.leaks import Leak
from sealscope.simulation.sensitivity import clean_channels, leak_sensitivity, parameter_sensitivity

PSI = 6894.757293168361
#: The rig of the figures: no throttles, 26.7 rad/s per volt, a leaking pump; white noise of 1.25 psi on each chamber.
CHECK = {"omega_per_volt": 26.7, "G_pump": 2.4e-13}
WHITE = np.eye(2) * (1.25 * PSI) ** 2
#: command -> start [m] that keeps the piston off the caps, standard deviation of the leak [L/min] over 90 s.
FIGURES = {
    "3 sin(4t)": (0.0, 0.00019),
    "5 sin(2t)": (0.0, 0.00032),
    "7 sin(4t)": (0.0, 0.00024),
    "8 sin(t)": (-0.263, 0.00044),
}


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("thesis").with_overrides(CHECK)


@pytest.fixture(scope="module")
def short(rig: Rig) -> Experiment:
    return run_of(rig, "3 sin(4t)", 8.0)


def run_of(rig: Rig, command: str, duration: float, x_0: float = 0.0) -> Experiment:
    from sealscope.simulation.experiment import Experiment

    return Experiment.of(rig=rig, command=command, duration=duration, x_0=x_0)


def test_bound_of_a_straight_line_is_the_textbooks() -> None:
    """Kay, Fundamentals of Statistical Signal Processing I (1993), example 3.7: x[n] = A + B n + w[n]."""
    n, sigma = 50, 0.7
    slopes = np.stack([np.ones(n), np.arange(n, dtype=float)])[:, None, :]
    bound = cramer_rao(information(slopes, np.array([[sigma**2]])))
    assert bound[0, 0] == pytest.approx(2 * (2 * n - 1) * sigma**2 / (n * (n + 1)), rel=1e-12)
    assert bound[1, 1] == pytest.approx(12 * sigma**2 / (n * (n**2 - 1)), rel=1e-12)


def test_bound_uses_the_correlation_of_channels() -> None:
    """Two channels that carry the signal with opposite signs gain from positively correlated noise: variance
    sigma^2 (1 - r) / (2 n)."""
    n, sigma, r = 40, 2.0, 0.6
    slopes = np.stack([np.ones(n), -np.ones(n)])[None]
    covariance = sigma**2 * np.array([[1.0, r], [r, 1.0]])
    assert cramer_rao(information(slopes, covariance))[0, 0] == pytest.approx(sigma**2 * (1 - r) / (2 * n), rel=1e-12)


def test_bound_is_reached_by_least_squares_on_a_linear_gaussian_model() -> None:
    random = np.random.default_rng(5)
    basis = np.stack([np.sin(0.1 * np.arange(200)), np.cos(0.1 * np.arange(200)), np.ones(200)])
    bound = cramer_rao(information(basis[:, None, :], np.array([[0.25]])))
    noise = 0.5 * random.standard_normal((20_000, 200))
    estimates = noise @ np.linalg.pinv(basis)
    assert np.var(estimates, axis=0) == pytest.approx(np.diag(bound), rel=0.04)


def test_unknown_parameters_can_only_raise_the_bound() -> None:
    random = np.random.default_rng(1)
    slopes = random.standard_normal((4, 2, 30))
    alone = 1.0 / information(slopes[:1], np.eye(2))[0, 0]
    bounds = [cramer_rao(information(slopes[:k], np.eye(2)))[0, 0] for k in (1, 2, 3, 4)]
    assert bounds[0] == pytest.approx(alone)
    assert all(after >= before for before, after in pairwise(bounds))


def test_what_cannot_be_separated_is_refused() -> None:
    slopes = np.stack([np.ones(10), 2.0 * np.ones(10)])[:, None, :]
    with pytest.raises(InputError, match="must be told apart"):
        cramer_rao(information(slopes, np.eye(1)))
    with pytest.raises(InputError, match="must be told apart"):
        cramer_rao(np.zeros((1, 1)))
    with pytest.raises(InputError, match="positive definite"):
        information(slopes, np.zeros((1, 1)))


def test_noise_of_the_rig_holds_own_common_and_conversion(rig: Rig) -> None:
    result = noise_covariance(rig)
    assert np.sqrt(np.diag(result)) / PSI == pytest.approx([1.23, 1.50], abs=2e-3)  # the rig's d1, Appendix C
    assert result[0, 1] == pytest.approx(rig.sensors.common_noise**2)
    with pytest.raises(InputError, match="pressure channels"):
        noise_covariance(rig, ("x",))


def test_leak_derivative_is_a_slope(short: Experiment) -> None:
    """It foretells a run it was not made from, and better than in proportion as the leak shrinks."""
    result = leak_sensitivity(short)
    none = clean_channels(short)
    assert np.abs(result).max() > 0
    misses = []
    for G in (4e-14, 2e-14):
        change = clean_channels(short, (Leak("laminar", coefficient=G),)) - none
        misses.append(np.sqrt(np.mean((change - G * result) ** 2)))
        assert misses[-1] < 0.05 * np.sqrt(np.mean(change**2))
    assert misses[0] / misses[1] > 2.5  # 4 for a smooth rig; friction has corners


def test_leak_derivative_does_not_depend_on_the_solvers_step(short: Experiment) -> None:
    coarse, fine = (leak_sensitivity(replace(short, step=step)) for step in (None, 2.5e-4))
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.03 * np.sqrt(np.mean(fine**2))
    assert np.sum(coarse**2) == pytest.approx(np.sum(fine**2), rel=0.01)  # what the bound is made from


def test_parameter_derivative_is_a_slope(short: Experiment) -> None:
    result = parameter_sensitivity(short, "F_v")
    rig = short.rig.with_overrides({"F_v": short.rig.friction.F_v * 1.002})
    change = clean_channels(replace(short, rig=rig)) - clean_channels(short)
    assert np.sqrt(np.mean((change - 0.002 * result) ** 2)) < 0.05 * np.sqrt(np.mean(change**2))
    for name in ("integrator", "F_l"):
        with pytest.raises(InputError, match="a number other than 0"):
            parameter_sensitivity(short, name)


def test_pump_leakage_and_piston_leakage_look_alike_without_throttles(short: Experiment) -> None:
    """Both pass oil from one chamber to the other, so their derivatives are parallel and neither can be had alone."""
    leak, pump = leak_sensitivity(short), parameter_sensitivity(short, "G_pump")
    cosine = np.sum(leak * pump) / math.sqrt(np.sum(leak**2) * np.sum(pump**2))
    assert cosine == pytest.approx(1.0, abs=1e-3)


def test_bound_falls_with_time_and_rises_with_noise(rig: Rig) -> None:
    lengths = (math.pi * 8, math.pi * 16, math.pi * 32)
    result = [leak_bound(run_of(rig, "3 sin(4t)", one), covariance=WHITE) for one in lengths]
    assert result[0] / result[1] == pytest.approx(math.sqrt(2.0), rel=0.02)
    assert result[1] / result[2] == pytest.approx(math.sqrt(2.0), rel=0.02)
    louder = leak_bound(run_of(rig, "3 sin(4t)", lengths[0]), covariance=9.0 * WHITE)
    assert louder / result[0] == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize("command", FIGURES)
def test_published_figures_with_all_else_known(rig: Rig, command: str) -> None:
    x_0, figure = FIGURES[command]
    experiment = run_of(rig, command, 90.0, x_0)
    assert in_lpm(leak_bound(experiment, covariance=WHITE)) == pytest.approx(figure, rel=0.15)


def test_unknown_friction_stiffness_and_gain_cost_a_known_share(rig: Rig) -> None:
    """Change between two 90 s halves: 0.00048 L/min where everything is found from each half, 1.5 times what it is
    with all else known."""
    unknown = in_lpm(leak_bound(run_of(rig, "7 sin(4t)", 90.0), UNKNOWN, WHITE))
    assert math.sqrt(2.0) * unknown == pytest.approx(0.0005, rel=0.15)
    assert 1.2 < unknown / FIGURES["7 sin(4t)"][1] < 2.0


def test_litres_a_minute_are_counted_at_a_stated_pressure() -> None:
    assert in_lpm(6.1e-13) == pytest.approx(0.0042, rel=0.01)  # at 0.115 MPa
    assert in_lpm(6.1e-13, 0.23e6) == pytest.approx(2 * in_lpm(6.1e-13))


def test_best_test_finds_what_its_normal_law_says() -> None:
    assert smallest_detectable(1.0, 0.01, 0.9) == pytest.approx(2.3263 + 1.2816, abs=1e-3)
    assert smallest_detectable(2.0, 0.05, 0.5) == pytest.approx(2 * 1.6449, abs=1e-3)
    for bad in (0.0, 1.0, -0.1, math.nan):
        with pytest.raises(InputError, match="between 0 and 1"):
            smallest_detectable(1.0, bad)
