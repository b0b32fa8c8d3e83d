"""A single-rod cylinder: its valves and accumulator against closed forms, oil, standstill, an independent program."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from sealscope.parameters import load_rig
from sealscope.physics.external import pilot_valve_flow, polytropic_pressure
from sealscope.physics.standstill import initial_state
from sealscope.simulation.experiment import Experiment
from sealscope.units import P_ATM

from ..refusals import refusal

#: Constant volumes: volume flows are balanced.
FIXED = {"volumes": "fixed", "d_load": 500.0}


def single_rod(**values):
    return load_rig("single-rod-eha").with_overrides(values)


def accumulator(rig, run) -> np.ndarray:
    """Pressure of the accumulator [Pa], (n,), from the polytropic law."""
    f, m = rig.fluid, rig.makeup
    return (f.p_charge + P_ATM) * (m.V_gas / (m.V_gas + run["V_up"])) ** m.n_gas - P_ATM


def valve_flows(rig, run) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Flows [m^3/s] into A and B through the check valves, and out of A and B through the relief valves."""
    m, supply = rig.makeup, accumulator(rig, run)

    def check(side, other):
        opening = (supply - run[side] + m.k_pilot * np.maximum(run[other] - supply, 0.0) - m.p_crack) / m.p_open
        return m.G_check * (supply - run[side]) * np.clip(opening, 0.0, 1.0)

    def relief(side):
        return m.G_relief * np.maximum(run[side] - supply - m.p_relief, 0.0)

    return check("p_A", "p_B"), check("p_B", "p_A"), relief("p_A"), relief("p_B")


@given(back=st.floats(0.0, 5e6), p_crack=st.floats(0.0, 1e5), k=st.floats(1.0, 10.0), p_open=st.floats(1e3, 1e6))
def test_the_pilot_opens_where_its_force_reaches_that_of_the_line_and_the_spring(back, p_crack, k, p_open):
    """Against a line `back` above the inlet: begins at (p_crack + back)/k, fully open p_open/k later, shut before."""
    begins = (p_crack + back) / k
    pilots = [begins + more * p_open / k for more in (-0.1, 0.0, 0.5, 1.1)]
    flow = np.array([pilot_valve_flow(-back, pilot, p_crack, 1e-9, k, p_open) for pilot in pilots])
    tolerance = 1e-6 + 1e-9 * (back + p_crack) / p_open
    # 1e-300: flows below the smallest normal number have few digits
    assert flow / 1e-9 == pytest.approx(-back * np.array([0.0, 0.0, 0.5, 1.0]), abs=max(tolerance * back, 1e-300))


def test_without_a_pilot_it_is_a_check_valve():
    for dp, share in ((-1e6, 0.0), (2e4, 0.0), (4.5e4, 0.5), (7e4, 1.0), (1e6, 1.0)):
        for pilot in (0.0, -1e6):  # a low pilot does not close it
            assert pilot_valve_flow(dp, pilot, 2e4, 1e-9, 3.0, 5e4) == pytest.approx(1e-9 * dp * share, abs=1e-20)


@given(V_up=st.floats(-1e-3, 5e-3), n=st.floats(1.0, 1.7))
def test_what_the_gas_gives_is_the_work_of_a_polytropic(V_up, n):
    p_0, V_gas = 6e5, 2e-3
    work, _ = quad(lambda V: polytropic_pressure(V, p_0, V_gas, n) + P_ATM, 0.0, V_up, epsrel=1e-11)
    ratio = (V_gas + V_up) / V_gas
    closed = V_gas * (math.log(ratio) if n == 1.0 else (ratio ** (1.0 - n) - 1.0) / (1.0 - n))
    if abs(n - 1.0) > 1e-3 and abs(V_up) > 1e-6:
        assert work == pytest.approx((p_0 + P_ATM) * closed, rel=1e-6)
    assert polytropic_pressure(0.0, p_0, V_gas, n) == pytest.approx(p_0)


@pytest.fixture(scope="module")
def strokes(drive):
    """Long strokes, out and in."""
    rig = single_rod()
    return rig, drive(rig, 8.0, u=lambda t: 10.0 * np.sin(2.0 * t), rate=4000.0, step=6.25e-5)


@pytest.mark.slow
def test_the_accumulator_takes_and_gives_what_the_rod_displaces(strokes):
    rig, run = strokes
    c = rig.cylinder
    rod = (c.A_A - c.A_B) * (run["x"] - run["x"][0])
    assert np.ptp(rod) > 5e-5
    assert np.abs(run["V_up"] - rod).max() < 0.01 * np.ptp(rod)  # but for what the oil is compressed
    assert run["q_up"].max() > 5e-5
    assert run["q_up"].min() < -5e-5  # through a pilot
    np.testing.assert_allclose(run["q_up"], np.subtract(sum(valve_flows(rig, run)[:2]), sum(valve_flows(rig, run)[2:])))


@pytest.mark.slow
def test_mass_of_chambers_and_accumulator_is_kept(strokes):
    rig, run = strokes
    c, f, m = rig.cylinder, rig.fluid, rig.makeup
    held = (c.V + c.A_A * run["x"]) * np.exp(run["p_A"] / f.K_oil)
    held = held + (c.V - c.V_rod - c.A_B * run["x"]) * np.exp(run["p_B"] / f.K_oil)
    given = np.linspace(run["V_up"].min(), run["V_up"].max(), 401)
    density = np.exp([polytropic_pressure(V, f.p_charge, m.V_gas, m.n_gas) / f.K_oil for V in given])
    lost = CubicSpline(given, density).antiderivative()
    total = held - lost(run["V_up"])
    assert np.abs(total - total[0]).max() <= 1e-9 * total[0]


@settings(max_examples=6, deadline=None)
@given(
    amplitude=st.floats(0.5, 10.0), force=st.floats(-3e3, 3e3), G=st.floats(0.0, 1e-11), p_relief=st.floats(5e5, 2e6)
)
@pytest.mark.slow
def test_where_volumes_are_fixed_no_oil_is_lost(drive, amplitude, force, G, p_relief):
    """Compressed oil, what the accumulator gave, what the rod displaced: a linear invariant."""
    rig = single_rod(**FIXED, F_l=force, p_relief=p_relief)
    run = drive(rig, 3.0, u=amplitude, G=G)
    c = rig.cylinder
    held = (c.V * run["p_A"] + (c.V - c.V_rod) * run["p_B"]) / rig.fluid.K_oil
    total = held - run["V_up"] + (c.A_A - c.A_B) * run["x"]
    assert np.abs(total - total[0]).max() <= 1e-9 * c.V


@pytest.mark.slow
def test_a_dead_headed_pump_turns_on_over_the_relief_valve(drive):
    """p_A - p_s = p_relief + Q/G once the piston stands at its cap."""
    rig = single_rod(**FIXED, p_relief="1 MPa", G_pump=0.0)
    run = drive(rig, 3.0, u=lambda t: np.full_like(t, 4.0), x_0=0.19)
    over = run["p_A"] - accumulator(rig, run)
    expected = rig.makeup.p_relief + run["Q_1"] / rig.makeup.G_relief
    assert run["Q_1"][-1] > 5e-5
    np.testing.assert_allclose(over[-200:], expected[-200:], rtol=1e-3)


@pytest.mark.parametrize("force", [0.0, 200.0, 2000.0, -2000.0])
@pytest.mark.parametrize("x_0", [0.0, 0.1])
def test_a_run_starts_in_equilibrium_whatever_the_load(drive, force, x_0):
    rig = single_rod(F_l=force, k_load=3000.0, G_pump=0.0)
    run = drive(rig, 1.0, u=0.0, x_0=x_0)
    c, carried = rig.cylinder, force + 3000.0 * x_0
    assert run["p_A"][0] * c.A_A - run["p_B"][0] * c.A_B == pytest.approx(carried, abs=1e-6)
    assert min(run["p_A"][0], run["p_B"][0]) == rig.fluid.p_charge
    assert np.abs(run["x"] - x_0).max() < 1e-12
    assert np.abs(run["omega"]).max() < 1e-9
    assert np.ptp(run["p_A"]) < 1e-3


def test_a_closed_circuit_carries_a_load_with_the_oil_it_has(check_rig):
    rig = check_rig(F_l=200.0)
    p_A, p_B = initial_state(rig, 0.0)[6:8]
    assert p_A + p_B == pytest.approx(2 * rig.fluid.p_charge)
    assert (p_A - p_B) * rig.cylinder.A_A == pytest.approx(200.0)
    unloaded = initial_state(check_rig(), 0.1)
    assert set(unloaded[6:10]) == {rig.fluid.p_charge}
    assert not unloaded[[0, 1, 2, 3, 5, 10, 11]].any()


def test_a_load_that_nothing_can_hold_is_refused_in_a_line(check_rig):
    with refusal("2000 N", "p_charge"):
        initial_state(check_rig(F_l=2000.0), 0.0)
    with refusal("4e+04 N", "23 A"):
        initial_state(single_rod(F_l=4e4), 0.0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"check_valves": "absent"}, "relief valves, accumulator"),
        ({"check_valves": "absent", "G_relief": 0.0}, "A_A, 3117.25"),
        ({"check_valves": "present", "G_relief": 0.0}, "makeup.check_valves"),
        ({"V_gas": "0.3 L"}, "V_gas, 0.000384848 m^3, 0.0003 m^3"),
        ({"V_rod": "800[cm^3]"}, "V_rod, 0.0007735 m^3, 0.0008 m^3"),
        ({"V_rod": "400[cm^3]"}, "cylinder.V, V_rod, A_B, L/2"),
    ],
)
def test_an_impossible_circuit_is_one_line(values, words):
    with refusal(*words.split(", ")):
        Experiment.of(rig="single-rod-eha", set=values, duration=1.0)
