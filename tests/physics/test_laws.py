"""Friction, throttle areas, pump, motor limits, volumes and stops: each law against its own closed statements."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealscope.physics.cylinder import chamber_volumes, hard_stop_force
from sealscope.physics.friction import coulomb_friction, stribeck_friction
from sealscope.physics.leakage import leakage_series, piston_leakage
from sealscope.physics.motor import controller_voltage, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.restrictors import orifice_flow
from sealscope.physics.rig import throttle_coefficients

TABLE_4_1 = {"K_brk": 3.0, "C_c": 10.0, "F_v": 300.0, "v_th": 0.01}


def friction(v: float, F_C: float = 25.0, literal: bool = False) -> float:
    return stribeck_friction(v, F_C, 3.0, 10.0, 300.0, 0.01, literal)


def test_friction_at_the_threshold_is_73_newton_on_both_sides():
    below, above = friction(0.01), friction(math.nextafter(0.01, 1.0))
    assert below == pytest.approx(73.242, abs=5e-4)  # 25 (1 + 2 exp(-0.1)) + 3
    assert above == pytest.approx(below, rel=1e-12)


def test_the_literal_bracket_jumps_to_145_newton():
    below, above = friction(0.01, literal=True), friction(math.nextafter(0.01, 1.0), literal=True)
    assert below == pytest.approx(145.24, abs=5e-3)  # 25 (1 + 2 exp(-0.1) + 3)
    assert above == pytest.approx(73.242, abs=5e-4)


@given(v=st.floats(-1.0, 1.0), F_C=st.floats(0.0, 1e4), literal=st.booleans())
def test_friction_is_odd_and_opposes_the_motion(v, F_C, literal):
    assert friction(-v, F_C, literal) == -friction(v, F_C, literal)
    assert friction(v, F_C, literal) * v >= 0


def test_friction_falls_below_0_051_m_s_and_rises_above():
    # dF/dv = 300 - 500 exp(-10 v) with 25 N
    v = np.linspace(0.011, 0.2, 2000)
    slope = np.gradient([friction(speed) for speed in v], v)
    assert v[np.argmax(slope > 0)] == pytest.approx(math.log(5 / 3) / 10, abs=2e-4)


def test_the_coulomb_force_takes_the_sum_or_the_difference_of_the_pressures():
    assert coulomb_friction(3e5, 1e5, 25.0, 1e-6, False) == pytest.approx(25.4)
    assert coulomb_friction(3e5, 1e5, 25.0, 1e-6, True) == pytest.approx(25.2)


@pytest.mark.parametrize(("means", "share"), [("area", [0.75, 0.5, 0.25]), ("diameter", [0.5625, 0.25, 0.0625])])
def test_a_closed_share_is_of_the_area_or_of_the_diameter(check_rig, means, share):
    for closed, left in zip((0.25, 0.5, 0.75), share, strict=True):
        free, throttled, _, _ = throttle_coefficients(
            check_rig(orifices="present", closed_A=closed, closed_B=closed, closed_means=means)
        )
        assert throttled / free == pytest.approx(left, rel=1e-12)


def test_three_quarters_closed_by_diameter_drops_sixteen_times_the_pressure():
    # the turbulent drop is (Q/c)^2
    area, diameter = 0.25, 0.25**2
    c = 1.7e-6
    q = orifice_flow(1e7, c * diameter, 1.0)
    assert orifice_flow(1e7 / 16, c * area, 1.0) == pytest.approx(q, rel=1e-10)


def test_metering_out_throttles_the_return_on_both_sides_and_the_literal_reading_does_not(check_rig):
    values = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.75}
    free, A_out, B_in, B_out = throttle_coefficients(check_rig(**values))
    assert (A_out / free, B_in / free, B_out / free) == pytest.approx((0.5, 1.0, 0.25))
    assert throttle_coefficients(check_rig(**values, metering="literal")) == (free, A_out, B_out, B_in)


@pytest.mark.parametrize("metering", ["meter-out", "literal"])
def test_metering_as_a_run_shows_it(check_rig, drive, metering):
    """The piston extends, oil returns from B: the drop there is 16 times that of the free throttle A, or as small."""
    rig = check_rig(orifices="present", closed_A=0.75, closed_B=0.75, metering=metering, dp_0=1.0)
    run = drive(rig, 1.0, u=lambda t: 8.0 * np.minimum(t / 0.7, 1.0))
    supply, back = run["p_1"][-1] - run["p_A"][-1], run["p_B"][-1] - run["p_2"][-1]
    assert run["v"][-1] > 0
    assert back / supply == pytest.approx(16.0 if metering == "meter-out" else 1.0, rel=0.02)


def test_the_pump_is_an_ideal_transformer_less_its_leakage():
    # power in at the shaft = power out in the oil + leakage loss
    omega, dp, q_b, G = 30.0, 4e5, 4.9e-6, 2e-13
    assert pump_torque(dp, q_b) * omega == pytest.approx(pump_flow(omega, dp, q_b, G) * dp + G * dp**2, rel=1e-14)
    assert pump_flow(2 * math.pi, 0.0, q_b, G) == pytest.approx(q_b)  # one revolution a second


def test_voltage_and_current_hold_at_their_limits_and_come_back():
    assert controller_voltage(1e6, 0.0, 1.2, 0.1, 260.0) == 260.0
    assert controller_voltage(-1e6, 0.0, 1.2, 0.1, 260.0) == -260.0
    assert controller_voltage(10.0, 5.0, 1.2, 0.1, 260.0) == pytest.approx(12.5)
    assert winding_current_rate(260.0, 23.0, 0.0, 0.73, 3.55e-3, 0.7, 23.0) == 0.0
    assert winding_current_rate(-260.0, -23.0, 0.0, 0.73, 3.55e-3, 0.7, 23.0) == 0.0
    assert winding_current_rate(-260.0, 23.0, 0.0, 0.73, 3.55e-3, 0.7, 23.0) < 0.0


def test_chamber_volumes_are_equal_or_follow_the_piston():
    assert chamber_volumes(0.1, 234e-6, 235e-6, 633e-6, 600e-6, False) == (234e-6, 235e-6)
    V_A, V_B = chamber_volumes(0.1, 234e-6, 234e-6, 633e-6, 600e-6, True)
    assert pytest.approx(234e-6 + 63.3e-6) == V_A
    assert pytest.approx(234e-6 - 60.0e-6) == V_B


@given(x=st.floats(-0.31, 0.31), v=st.floats(-1.0, 1.0))
def test_a_cap_pushes_back_only_and_only_in_contact(x, v):
    force = hard_stop_force(x, v, 0.6, 1e7, 1.1e4)
    if abs(x) <= 0.3:
        assert force == 0.0
    else:
        assert force * x <= 0.0
        assert force == -hard_stop_force(-x, -v, 0.6, 1e7, 1.1e4)
        assert abs(force) <= 1e7 * 0.01 + 1.1e4 * abs(v) + 1e-6


def test_leakage_adds_a_gap_and_an_orifice():
    both = piston_leakage(1e5, 6e-13, 2e-10, 2000.0)
    assert both == pytest.approx(6e-8 + 2e-10 * math.sqrt(1e5), rel=1e-3)
    dp, Q_L = np.array([-1e5, 0.0, 1e5]), np.empty(3)
    leakage_series(dp, np.full(3, 6e-13), np.full(3, 2e-10), 2000.0, Q_L)
    np.testing.assert_allclose(Q_L, [-both, 0.0, both])
