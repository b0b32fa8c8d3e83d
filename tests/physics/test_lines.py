"""What stands in the lines and loads the drive: shut-off valves, filters, losses, an opposing cylinder, warm oil.

Each against a closed form, then all of them at once: oil, energy, an independent program.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson, simpson
from scipy.optimize import brentq

from sealscope.parameters import load_rig
from sealscope.physics.cylinder import opposing_force
from sealscope.physics.fluid import kinematic_viscosity, thermal_density_ratio, thermal_stiffness_ratio
from sealscope.physics.pump import friction_torque, loss_coefficients
from sealscope.physics.restrictors import (
    clogged_resistance,
    filtered_flow,
    flow_through_filter,
    implicit_orifice_flow,
    orifice_flow,
    series_coefficient,
)
from sealscope.physics.rig import rig_numbers
from sealscope.physics.standstill import initial_state
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.simulation.leaks import opening_from
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal

LINES = {"orifices": "present", "closed_A": "50 %", "closed_B": "50 %", "p_charge": "2 MPa"}
LOSSES = {"T_f": 0.09, "C_f": 0.03, "C_h": 60.0, "C_st": 2e-5, "G_pump": 2e-13}
#: All parts at once.
PARTS = {
    **LINES,
    **LOSSES,
    **{"R_A": 2e9, "R_B": 5e9, "open_B": 0.3, "G_circ": 1e-9, "B_M": 1e-3},
    **{"A_opp": "100[mm^2]", "p_opp": "1 MPa", "C_opp": 1e-7},
}
QUIET = {f"sensors.{channel}.{what}": 0.0 for channel in ("p_A", "p_B") for what in ("noise", "drift")}
QUIET["sensors.common_noise"] = 0.0
#: The line shuts and the pump's oil circulates meanwhile.
OPERATED = ("shut-off A to 0 % from 1 s to 1.6 s within 0.2 s", "circulation from 1 s to 1.6 s within 0.2 s")


def rig_with(**values):
    return load_rig("thesis").with_overrides(values)


@given(c=st.floats(1e-8, 1e-5), c_line=st.floats(1e-7, 1e-5), s=st.floats(1e-3, 0.999), dp=st.floats(1e3, 2e7))
def test_a_shut_off_valve_s_pressure_drop_adds_to_that_of_the_throttle(c, c_line, s, dp):
    """Throttle and what the valve takes beyond its open line, each by the root of its own pressure drop."""

    def left(Q):
        return (Q / c) ** 2 + (Q / (s * c_line)) ** 2 - (Q / c_line) ** 2 - dp

    Q = brentq(left, 0.0, c * math.sqrt(dp) * (1 + 1e-9), xtol=1e-20)
    assert series_coefficient(c, c_line, s) * math.sqrt(dp) == pytest.approx(Q, rel=1e-9)
    assert series_coefficient(c, c_line, 1.0) == pytest.approx(c, rel=1e-14)
    assert series_coefficient(c, c_line, 0.0) == 0.0


@given(dp=st.floats(-2e7, 2e7), R=st.floats(1e6, 1e12))
def test_a_filter_takes_its_share_of_the_pressure_difference_by_darcy_s_law(dp, R):
    Q = implicit_orifice_flow(dp, R, 1.2e-6, 6e-7, 2000.0)
    assert orifice_flow(dp - R * Q, 1.2e-6 if dp > 0 else 6e-7, 2000.0) == pytest.approx(Q, rel=1e-7, abs=1e-17)


@given(omega=st.floats(2.0, 500.0), dp=st.floats(1e4, 2e7), rho=st.floats(800.0, 1000.0))
def test_losses_go_with_speed_pressure_and_size_as_published(omega, dp, rho):
    q_b, C_st, C_h = 4.9e-6, 1e-4, 50.0
    D = q_b / (2 * math.pi)
    c_slip, k_h = loss_coefficients(q_b, C_st, C_h, rho)
    assert orifice_flow(dp, c_slip, 2000.0) == pytest.approx(C_st * D ** (2 / 3) * math.sqrt(2 * dp / rho), rel=0.02)
    torque = friction_torque(omega, -dp, q_b, 0.09, 0.05, k_h, 1.0)
    assert torque == pytest.approx(0.09 + 0.05 * D * dp + C_h * rho * D ** (5 / 3) * omega**2 / 2, rel=1e-12)
    assert friction_torque(-omega, dp, q_b, 0.09, 0.05, k_h, 1.0) == -torque
    assert friction_torque(0.25, dp, q_b, 0.09, 0.0, 0.0, 1.0) == pytest.approx(0.0225)  # smooth through standstill


@given(v=st.floats(-0.5, 0.5), A=st.floats(1e-5, 1e-2), p=st.floats(0.0, 1e7), C=st.floats(1e-7, 1e-4))
def test_an_opposing_cylinder_s_oil_passes_its_orifice(v, A, p, C):
    inside = opposing_force(v, A, p, C) / A
    if inside > -101324.0:  # else the oil boils
        assert C * math.copysign(math.sqrt(abs(inside - p)), inside - p) == pytest.approx(A * v, rel=1e-6, abs=1e-4 * C)


def test_viscosity_follows_the_chart():
    """32 and 5.4 mm^2/s at 40 and 100 deg C are 8.5 at 80 deg C (ASTM D341)."""
    T = np.array([313.15, 353.15, 373.15])
    assert np.round(1e6 * kinematic_viscosity(T, 32e-6, 5.4e-6), 1).tolist() == [32.0, 8.5, 5.4]
    assert thermal_density_ratio(np.array([333.15]), 313.15, 7e-4) == pytest.approx(1 - 0.014)
    assert thermal_stiffness_ratio(np.array([333.15]), 313.15) == pytest.approx(10**-0.048)


@pytest.fixture(scope="module")
def stops(drive):
    """The piston has reached a constant speed; both lines shut at 0.6 s, at once or within 0.4 s."""
    values = {"p_charge": "8 MPa", "F_pr": 0.1, "F_cfr": 0.0, "F_v": 0.1, "G_circ": 1e-9, "orifices": "present"}
    rig = rig_with(**values)

    def run(ramp):
        words = [f"shut-off {side} to 0 % from 0.6 s within {ramp} s" for side in "AB"]
        words.append(f"circulation from 0.6 s within {ramp} s")
        u = {"u": lambda t: 3.0 - 3.0 * np.cos(np.pi * np.minimum(t / 0.5, 1.0))}
        return drive(rig, 1.2, **u, rate=4000.0, faults=tuple(map(parse_fault, words)))

    return rig, run(0.0), run(0.4)


def test_a_line_that_shuts_at_once_surges_and_one_that_shuts_slowly_does_not(stops):
    """Of a mass on two shut-in columns: v sqrt(M K/(2 V)), without friction."""
    rig, at_once, slowly = stops
    before = at_once.t < 0.6
    v = at_once["v"][before][-1]
    assert v > 0.02
    level = at_once["p_B"][before][-1]
    surge = v * math.sqrt(rig.cylinder.M_eq * rig.fluid.K_oil / (2.0 * rig.cylinder.V))
    after = at_once["p_B"][(at_once.t >= 0.6) & (at_once.t < 0.62)] - level
    assert after.max() == pytest.approx(surge, rel=0.03)
    assert np.abs(slowly["p_B"][slowly.t >= 0.6] - level).max() < 0.1 * surge
    assert np.abs(slowly["v"][slowly.t > 1.1]).max() < 0.1 * v  # rings down
    for run in (at_once, slowly):  # what the pump gives circulates
        np.testing.assert_allclose(run["Q_A"][run.t > 1.05], 0.0, atol=1e-12)
        over = rig.line.G_circ * (run["p_1"] - run["p_2"])
        np.testing.assert_allclose((rig.pump.q_b / (2 * math.pi) * run["omega"])[-400:], over[-400:], rtol=1e-3)


def flows(rig, run):
    """Flows [m^3/s] past piston and pump, and pressure drops [Pa] of the lines, written from the outputs."""
    D, dp = rig.pump.q_b / (2 * math.pi), run["p_1"] - run["p_2"]
    slip = rig.pump.C_st * D ** (2 / 3) * math.sqrt(2 / rig.fluid.rho) * dp / (dp**2 + rig.line.dp_0**2) ** 0.25
    return D, dp, slip


@pytest.fixture(scope="module")
def finely(drive):
    """All parts, with fixed volumes and a leak, while line A shuts and opens again, at a step of 10 us."""
    rig = rig_with(**PARTS)

    class Operated(Experiment):
        def effects(self):
            """Outputs have the flows of their steps."""
            return tuple(replace(effect, min_block=1e-3) for effect in super().effects())

    step, faults = 1e-5, tuple(map(parse_fault, OPERATED))
    u = {"u": lambda t: 4.0 * np.sin(3.0 * t)}
    return rig, drive(rig, 2.0 + step, **u, G=1e-12, rate=1e5, step=step, faults=faults, kind=Operated)


@pytest.mark.slow
def test_no_oil_is_lost(finely):
    rig, run = finely
    c, line, K = rig.cylinder, rig.line, rig.fluid.K_oil
    held = (c.V * (run["p_A"] + run["p_B"]) + line.V_1 * run["p_1"] + line.V_2 * run["p_2"]) / K
    assert np.abs(held - held[0]).max() <= 1e-9 * c.V
    assert np.ptp(run["p_1"]) > 2e5


@pytest.mark.slow
def test_what_the_wires_bring_is_found_again(finely):
    rig, run = finely
    m, c, f, line, K = rig.motor, rig.cylinder, rig.friction, rig.line, rig.fluid.K_oil
    D, dp, slip = flows(rig, run)
    omega, v = run["omega"], run["v"]
    Q_A, Q_B = run["Q_A"], run["Q_B"]
    F_C = f.F_pr + f.F_cfr * (run["p_A"] + run["p_B"])
    speed = np.abs(v)
    running = F_C * (1 + (f.K_brk - 1) * np.exp(-f.C_c * speed)) + f.F_v * speed
    standing = speed / f.v_th * (F_C * (1 + (f.K_brk - 1) * np.exp(-f.C_c * f.v_th)) + f.F_v * f.v_th)
    rubbing = np.clip(np.abs(omega), 0, 1) * (m.T_f + rig.pump.C_f * D * np.abs(dp))
    drag = 0.5 * rig.pump.C_h * rig.fluid.rho * D ** (5 / 3) * omega**2
    opposing = c.A_opp * (c.p_opp + v * speed * (c.A_opp / c.C_opp) ** 2)

    def total(power):
        return float(simpson(power, x=run.t))

    def gained(energy):
        return float(energy[-1] - energy[0])

    terms = {
        "copper": total(m.R_c * run["i"] ** 2),
        "viscous": total(m.B_M * omega**2),
        "rubbing": total(rubbing * np.abs(omega)),
        "hydrodynamic": total(drag * np.abs(omega)),
        "slip and circulation": total((D * omega - run["Q_1"]) * dp),
        "lines": total(Q_A * (run["p_1"] - run["p_A"]) + Q_B * (run["p_B"] - run["p_2"])),
        "piston leakage": total(1e-12 * (run["p_A"] - run["p_B"]) ** 2),
        "friction": total(np.where(speed > f.v_th, running, standing) * speed),
        "opposing cylinder": total(opposing * v),
        "winding": gained(0.5 * m.L_c * run["i"] ** 2),
        "rotor": gained(0.5 * m.J_M * omega**2),
        "piston": gained(0.5 * c.M_eq * v**2),
        "oil": gained(
            0.5 * (c.V * (run["p_A"] ** 2 + run["p_B"] ** 2) + line.V_1 * run["p_1"] ** 2 + line.V_2 * run["p_2"] ** 2)
        )
        / K,
    }
    came = total(run["V"] * run["i"])
    assert came > 5.0
    assert sum(terms.values()) == pytest.approx(came, rel=1e-6), terms
    for name in ("rubbing", "hydrodynamic", "slip and circulation", "lines", "opposing cylinder"):
        assert abs(terms[name]) > 1e-4 * came, (name, terms)
    moving = (run.t < 1.0) | (run.t > 1.8)
    np.testing.assert_allclose((D * omega - run["Q_1"] - slip)[moving], (rig.pump.G_pump * dp)[moving], atol=1e-15)


@pytest.mark.slow
def test_a_run_starts_in_equilibrium_against_an_opposing_cylinder(drive):
    rig = rig_with(**{**PARTS, "p_opp": "3 MPa", "G_pump": 0.0, "C_st": 0.0})
    run = drive(rig, 0.5, u=0.0)
    carried = run["p_A"][0] * rig.cylinder.A_A - run["p_B"][0] * rig.cylinder.A_B
    assert carried == pytest.approx(300.0)
    assert np.abs(run["x"]).max() < 1e-9
    assert np.abs(run["omega"]).max() < 1e-6


def test_the_supply_of_a_valve_turns_against_the_losses():
    """C_m i = D dp + B_M omega + T_f + C_f D dp + k_h omega^2, with the speed loop's integral behind the voltage."""
    rig = load_rig("servo-valve").with_overrides(LOSSES)
    y, m, omega = initial_state(rig, 0.0), rig.motor, rig.supply.omega_P
    pressed = rig.pump.q_b / (2 * math.pi) * (y[8] - y[9])
    drag = 30.0 * rig.fluid.rho * (rig.pump.q_b / (2 * math.pi)) ** (5 / 3) * omega**2
    assert m.C_m * y[1] == pytest.approx(1.03 * pressed + m.B_M * omega + 0.09 + drag, rel=1e-12)
    assert m.K_i * y[0] == pytest.approx(m.R_c * y[1] + m.C_e * omega, rel=1e-12)


@pytest.mark.parametrize("warmer", [-10.0, 25.0])
def test_a_leak_passes_what_the_oil_s_viscosity_lets_it(warmer):
    """Q_L = G dp mu_0/mu, whatever was asked for: a mean is what flows while it is open."""
    leak, fault = "0.02 L/min", f"oil {warmer:+g} K"
    truth = simulate_experiment(Experiment.of(leak=leak, fault=fault, duration=1.0)).truth
    assert truth.mean_leak_lpm == pytest.approx(0.02, rel=2e-3)
    dp = truth.outputs["p_A"] - truth.outputs["p_B"]
    G = truth.leaks[0].coefficient
    thick = parse_fault(fault).viscosity_ratio(load_rig("thesis"))(np.zeros(1))[0]
    np.testing.assert_allclose(truth.outputs["q_leak"], G / thick * dp, rtol=1e-9, atol=1e-15)
    assert (thick < 1.0) == (warmer > 0.0)
    o = truth.outputs
    np.testing.assert_allclose(o["P_electric"], o["V"] * o["i"])
    np.testing.assert_allclose(o["P_hydraulic"], o["Q_1"] * (o["p_1"] - o["p_2"]))


@given(k=st.floats(1.0, 1e4), passed=st.floats(0.0, 4e-5), R=st.floats(1e7, 1e11))
def test_a_filter_clogs_by_what_passed_as_hermia_s_laws_say(k, passed, R):
    s = k * passed
    for n, grown in ((0.0, 1 + s), (1.0, math.exp(s)), (1.5, (1 - s / 2) ** -2), (2.0, 1 / (1 - s))):
        assert clogged_resistance(R, passed, k, n) == pytest.approx(R * grown, rel=1e-6)
    assert clogged_resistance(R, 1e9, 1e9, 2.0) == pytest.approx(1e3 * R)


@given(
    total=st.floats(-3e6, 3e6),
    g=st.floats(0.0, 1e11),
    R=st.floats(1e7, 1e11),
    bypass=st.tuples(st.floats(1e4, 1e6), st.floats(0.0, 1e-8)),
)
def test_throttle_filter_and_bypass_share_the_pressure(total, g, R, bypass):
    """The filter takes R Q_f, the bypass opens at its pressure, and both are under the same."""
    c, (p_b, G_b), assumed = 1.7e-6, bypass, abs(total) > 1.0
    Q = filtered_flow(total, g, R, p_b, G_b, c, 0.5 * c, 2000.0)
    Q_f = flow_through_filter(Q, R, p_b, G_b)
    dp_f = R * Q_f
    assert Q_f + G_b * max(dp_f - p_b, 0.0) == pytest.approx(abs(Q), rel=1e-9)
    d = abs(total) - dp_f - g * abs(Q)
    if assumed:
        assert orifice_flow(math.copysign(d, total), c if total > 0 else 0.5 * c, 2000.0) == pytest.approx(
            Q, rel=1e-5, abs=1e-12 * abs(total)
        )


@pytest.mark.slow
def test_a_filter_s_pressure_drop_over_what_passed_until_its_bypass_opens():
    """One stroke, dp = R Q (1 - k V/2)^-2 with V the integral of the flow; the valve then takes what is above."""
    values = {**PARTS, "k_clog_A": 4e4, "k_clog_B": 1e4, "n_clog": 1.5, "p_bypass": "2 bar", "G_bypass": 1e-9}
    run = simulate_experiment(Experiment.of(set={**values, "open_B": 1.0}, command="5 sin(0.5t)", duration=3.0))
    o, t, line = run.truth.outputs, run.truth.t, rig_with(**values).line
    Q = np.abs(o["Q_A"])
    c = rig_numbers(rig_with(**values)).c_A_in
    left = np.array([brentq(lambda d, q=q: orifice_flow(d, c, line.dp_0) - q, 0.0, 1e6, xtol=1e-9) for q in Q[::50]])
    dp = (o["p_1"] - o["p_A"])[::50] - left
    shut = dp < 0.95 * line.p_bypass
    V = cumulative_simpson(Q, x=t, initial=0.0)
    np.testing.assert_allclose(o["passed_A"][::50][shut], V[::50][shut], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(dp[shut], (line.R_A * Q / (1 - 2e4 * V) ** 2)[::50][shut], rtol=1e-3, atol=20.0)
    R = clogged_R(o["passed_A"], line.R_A, 4e4)[::50]
    open_ = dp > 1.05 * line.p_bypass
    np.testing.assert_allclose(dp[open_] / R[open_] + 1e-9 * (dp[open_] - line.p_bypass), Q[::50][open_], rtol=1e-4)
    assert min(shut.sum(), open_.sum()) > 5
    assert np.ptp(o["x_s"]) == 0.0


def clogged_R(V, R, k):
    return R * (1 - k * V / 2) ** -2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "fault", "words"),
    [
        ({"R_A": 1e9}, None, "line.R_A, 1e+09, line.orifices, absent"),
        ({"open_B": 0.5}, None, "line.open_B, 0.5"),
        ({}, "shut-off A to 0 %", "line.orifices, absent"),
        ({}, "circulation from 1 s", "line.G_circ, 0"),
        (
            {**LINES, "k_clog_A": 5.0},
            None,
            "line.k_clog_A, R_A, 5",
        ),
        (LINES, "filter B x3", "line.R_B, 0"),
        (LINES, "shut-off B to 120 %", "1.2"),
        (LINES, "shut-off B to 0 % from 2 s to 2.1 s within 0.5 s", "0.5 s, 2.1 s"),
        ({}, "oil +200 K", "temperature, 100 K, 200"),
        ({"nu_100": "40[mm^2/s]"}, None, "nu_100, nu_40, 3.2e-05 m^2/s"),
    ],
)
def test_an_impossible_line_is_one_line(values, fault, words):
    with refusal(*words.split(", ")):
        Experiment.of(set=values, fault=fault, duration=3.0)


def test_operations_are_read_back_from_their_own_words():
    for fault in (*OPERATED, "filter A x10 growing from 1 s to 3 s", "oil -5 K from 1 s"):
        assert str(parse_fault(str(parse_fault(fault)))) == str(parse_fault(fault))
    assert parse_fault(OPERATED[0]) == Fault("shut-off", 0.0, "A", parse_fault(OPERATED[0]).opening)
    assert parse_fault("circulation") == Fault("circulation", opening=opening_from(0.0))
