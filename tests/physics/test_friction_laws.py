"""Karnopp's and LuGre's friction: closed forms, the Stribeck curve they share, energy, and whole runs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from sealscope.parameters import load_rig
from sealscope.physics.friction import (
    bristle_rate,
    karnopp_friction,
    lugre_friction,
    stribeck_force,
    stribeck_friction,
    stuck_velocity,
)
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal

F_C, K_BRK, C_C, F_V, V_TH = 25.0, 3.0, 10.0, 300.0, 0.002
SIGMA_0, SIGMA_1 = 1e6, 1e3


def level(v: float) -> float:
    return stribeck_force(abs(v), F_C, K_BRK, C_C)


@pytest.mark.parametrize("v", [-0.3, -0.02, 0.0021, 0.05, 0.4])
def test_sliding_evenly_all_laws_are_the_stribeck_curve(v):
    expected = stribeck_friction(v, F_C, K_BRK, C_C, F_V, V_TH, False)
    z = math.copysign(level(v) / SIGMA_0, v)
    assert bristle_rate(v, z, level(v), SIGMA_0) == pytest.approx(0.0, abs=1e-15)
    assert lugre_friction(v, z, 0.0, SIGMA_0, SIGMA_1, F_V, V_TH) == pytest.approx(expected, rel=1e-12)
    assert karnopp_friction(v, 12.0, 75.0, F_C, K_BRK, C_C, F_V, V_TH) == pytest.approx(expected, rel=1e-12)


def test_bristles_settle_as_the_closed_form():
    """At a steady v: z = g/sigma_0 (1 - exp(-sigma_0 v t/g)), by steps of RK4."""
    v, h, z = 0.01, 2e-6, 0.0
    g = level(v)
    for _ in range(4000):
        k_1 = bristle_rate(v, z, g, SIGMA_0)
        k_2 = bristle_rate(v, z + 0.5 * h * k_1, g, SIGMA_0)
        k_3 = bristle_rate(v, z + 0.5 * h * k_2, g, SIGMA_0)
        z += h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + bristle_rate(v, z + h * k_3, g, SIGMA_0))
    t = 4000 * h
    assert z == pytest.approx(g / SIGMA_0 * (1 - math.exp(-SIGMA_0 * v * t / g)), rel=1e-9)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), size=st.floats(0.001, 0.3), slow=st.integers(1, 40))
def test_bristles_take_energy_and_never_give_more_than_they_hold(seed, size, slow):
    """The work done on the contact is at least what its bristles store, 0.5 sigma_0 z^2, whatever the motion."""
    random = np.random.default_rng(seed)
    velocity = size * np.interp(
        np.arange(1500), np.arange(0, 1501 + slow, slow), random.standard_normal(2 + 1500 // slow)
    )
    h, z, work, least = 2e-6, 0.0, 0.0, 0.0
    for v in velocity.tolist():
        g = level(v)
        decay = SIGMA_0 * abs(v) / g
        settled = math.copysign(g / SIGMA_0, v)
        after = settled + (z - settled) * math.exp(-decay * h)  # exact over the interval
        middle = settled + (z - settled) * math.exp(-0.5 * decay * h)
        work += h * v * lugre_friction(v, middle, bristle_rate(v, middle, g, SIGMA_0), SIGMA_0, SIGMA_1, F_V, V_TH)
        z = after
        least = min(least, work - 0.5 * SIGMA_0 * z * z)
        assert abs(z) <= K_BRK * F_C / SIGMA_0 * (1 + 1e-12)
    assert least >= -1e-6 * max(work, 1e-9)


@given(v=st.floats(-0.4, 0.4), applied=st.floats(-500, 500))
def test_a_stuck_piston_balances_what_pushes_it_and_takes_no_power(v, applied):
    force = karnopp_friction(v, applied, K_BRK * F_C, F_C, K_BRK, C_C, F_V, V_TH)
    moves = stuck_velocity(v, V_TH)
    assert force * moves >= 0.0
    if abs(v) < V_TH:
        assert moves == 0.0
        assert force == pytest.approx(min(max(applied, -75.0), 75.0))
    else:
        assert moves == v


def test_a_law_needs_a_force_to_go_by():
    with refusal("friction.law", "lugre", "coulomb_pressure", "sum"):
        load_rig("thesis").with_overrides({"friction.law": "lugre", "coulomb_pressure": "difference"})


LUGRE = {"friction.law": "lugre", "v_th": 0.002, "sigma_0": 2e5, "sigma_1": 800.0}


def lugre_oracle(t, y):
    """The rig without throttles under 3 sin(4t), with bristles, and friction 1.3 times as large backward."""
    integral, i, w, _x, v, pa, pb, z = y
    wd = 26.7 * 3.0 * math.sin(4.0 * t)
    volts = 1.2 * (wd - w) + 0.1 * integral
    q1 = 4.9e-6 * w / (2 * math.pi)
    side = 1.3 if v < 0 else 1.0
    g = side * (25 + 1e-6 * (pa + pb)) * (1 + 2 * math.exp(-10 * abs(v)))
    dz = v - 2e5 * abs(v) / g * z
    force = 2e5 * z + 800.0 * math.exp(-((v / 0.002) ** 2)) * dz + side * 300 * v
    return [
        wd - w, (volts - 0.73 * i - 0.6963 * w) / 3.55e-3,
        (0.6963 * i - 4.855e-4 * w - 4.9e-6 * (pa - pb) / (2 * math.pi)) / 8.74e-4,
        v, (633e-6 * (pa - pb) - force) / 12.3,
        689e6 / 234e-6 * (q1 - 633e-6 * v), 689e6 / 234e-6 * (633e-6 * v - q1), dz,
    ]  # fmt: skip


@pytest.mark.slow
def test_an_independent_right_hand_side_with_bristles_gives_the_same_run(check_rig, drive):
    ours = drive(check_rig(**LUGRE, backward=1.3), 2.0, step=5e-5)
    start = [0.0] * 5 + [0.25e6, 0.25e6, 0.0]
    scale = [1e-9, 1e-9, 1e-8, 1e-12, 1e-11, 1e-3, 1e-3, 1e-14]
    span = (0.0, float(ours.t[-1]))
    theirs = solve_ivp(lugre_oracle, span, start, method="LSODA", t_eval=ours.t[::5], rtol=1e-9, atol=scale)
    assert theirs.success
    for name, row, tolerance in [
        ("omega", 2, 1e-3),
        ("x", 3, 1e-8),
        ("p_A", 5, 50.0),
        ("p_B", 6, 50.0),
        ("z", 7, 1e-8),
    ]:
        np.testing.assert_allclose(ours[name][::5], theirs.y[row], rtol=0, atol=tolerance, err_msg=name)
    assert np.abs(ours["z"]).max() > 2e-4


@pytest.mark.slow
def test_karnopps_piston_stands_still_until_it_breaks_away():
    """A pump that hardly turns builds up pressure; the piston does not creep, then it moves in jerks."""
    rig = {"friction.law": "karnopp", "v_th": 0.002}
    sticking, creeping = (
        simulate_experiment(Experiment.of(command="0.05 sin(1t)", set=values, duration=6.0)).truth.outputs
        for values in (rig, {})
    )
    early = slice(0, 100)
    assert np.ptp(sticking["x"][early]) == 0.0
    assert np.ptp(creeping["x"][early]) > 0.0
    stands = np.diff(sticking["x"]) == 0.0
    assert 0.05 < stands.mean() < 1.0
    assert np.ptp(sticking["x"]) > 1e-4
